"""Inspection of the samples: missing pulses, outliers, saturation, and the Doppler centroid."""
