"""Demonstration: the scene and the settings of `blocksar demo`."""

from __future__ import annotations

SCENE = "table1"
HISTORY = "phase_history.zarr"  # in the run folder
BLOCKS = 3
ROOM = 600_000_000  # bytes that it takes while it runs
# The lit sector. Steps, m, are the coarsest at which every target's response is measured, 1.2 times its band: with the
# default of 1 m, a half of the resolution, a run takes 0.9 GB instead of 0.6.
GRID = ((10914.0, 21636.0, 1.45), (13482.0, 25137.0, 1.4))
