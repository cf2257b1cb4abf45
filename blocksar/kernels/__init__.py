"""Arrays in, arrays out: transforms, phases, interpolation and programs along rows. Nothing here knows of files."""
