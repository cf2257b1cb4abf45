"""Exact back-projection: the definition of an image, and the judge of all other processors."""
