"""Dwells of targets: when they are lit, with which weights, and what steps make of their ends."""
