"""The Gotcha volumetric data set (MAT files) to a phase history."""
