"""Conversion of measured data to a phase-history store: CPHD files and the Gotcha data set."""
