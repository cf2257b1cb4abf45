"""Bands that are wide for their carrier: all range frequencies have equal weight, as in back-projection."""

from __future__ import annotations

from pathlib import Path

from beside_exact import beside_exact

UHF = """
[radar]
carrier = 450e6
bandwidth = 150e6
range_sampling = 180e6
prf = 150.0
[track]
position = [0.0, 0.0, 1500.0]
velocity = [0.0, 60.0, 0.0]
[time]
duration = 8.0
[scene]
swath = [1900.0, 2400.0]
centre_yaw_deg = 12.0
reference_range = "scene_centre"
[clutter]
scatterers = 6000
seed = 3
x = [1450.0, 1570.0]
y = [260.0, 380.0]
"""
GRID = (1490.0, 1530.0, 0.77), (300.0, 340.0, 0.72)


def test_range_migration_that_is_corrected_in_doppler_leaves_all_frequencies_equal_weight(tmp_path: Path) -> None:
    """A third of the carrier: weights of sqrt(1 + f / fc) over the band would cost 0.001 of coherence."""
    alike = beside_exact(tmp_path, UHF, GRID, "high-order-phase")
    assert abs(alike.coherence) > 0.9993
