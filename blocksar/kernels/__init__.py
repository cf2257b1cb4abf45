"""Numerical kernels on plain arrays: transforms, phases, interpolation and row programs. No files, no logging."""
