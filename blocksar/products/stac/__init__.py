"""A STAC item that describes a run and what was exported of it."""
