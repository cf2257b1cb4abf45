"""Heights of the ground from files, or of the Earth's ellipsoid, on a grid of the scene frame."""
