"""Simulation of scene files as phase histories, raw echoes and CPHD files."""
