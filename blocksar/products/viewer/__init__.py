"""A page on this machine that pans and zooms a run of any size."""
