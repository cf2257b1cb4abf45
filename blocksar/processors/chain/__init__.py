"""Chains of steps, as in the three papers: recovery, blocks, geometric correction, mosaic."""
