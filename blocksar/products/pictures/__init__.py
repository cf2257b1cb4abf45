"""Pictures for people: mosaic, quick look, point responses and panels of curves."""
