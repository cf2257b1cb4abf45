"""Echoes from beside the grid where no beam limits them: in a block's spectrum, but at other times than its targets."""

from __future__ import annotations

from pathlib import Path

from beside_exact import beside_exact

SQUINTED = """
[radar]
carrier = 9.6e9
bandwidth = 100e6
range_sampling = 120e6
prf = 900.0
[track]
position = [0.0, 0.0, 2500.0]
velocity = [60.0, 150.0, -90.0]
[time]
duration = 2.4
[scene]
swath = [3300.0, 3900.0]
centre_yaw_deg = 50.0
reference_range = "scene_centre"
[clutter]
scatterers = 20000
seed = 3
x = [1390.0, 1940.0]
y = [1710.0, 2260.0]
"""
GRID = (1630.0, 1700.0, 0.54), (1970.0, 2000.0, 0.22)


def test_resampling_brings_no_echoes_from_the_end_of_the_aperture_into_the_image(tmp_path: Path) -> None:
    """They wrapped around in slow time, and the deramp took them to Doppler of the image: 0.989 here for 0.998."""
    alike = beside_exact(tmp_path, SQUINTED, GRID, "keystone-resampling", blocks=2)
    assert abs(alike.coherence) > 0.9985
