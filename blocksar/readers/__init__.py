"""Conversion of measured data to phase-history stores: a module or folder for each format, and shared parts."""
