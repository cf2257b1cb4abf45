"""Ingestion of the AFRL Gotcha volumetric SAR data set (MATLAB files)."""
