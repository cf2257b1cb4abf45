"""What the samples tell: missing pulses, outliers, saturation, and the Doppler centroid."""
