"""Places in the beam that points pass, and tapers over dwells that move over the band."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from axis_beams import axis_collection

import blocksar
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry

CANCELLING = """
[radar]
carrier = 24.1e9
bandwidth = 150e6
range_sampling = 180e6
prf = 2600
[track]
position = [0.0, 0.0, 1800.0]
velocity = [-8.0, 75.0, 6.0]
acceleration = [1.5, -1.0, 0.8]
jerk = [0.6, 0.3, -0.4]
[time]
duration = 0.36
[beam]
start_deg = -31.0
stop_deg = -33.4
dwell = 0.16
[scene]
swath = [4180.0, 4300.0]
reference_range = "scene_centre"
[clutter]
scatterers = 4000
seed = 5
range = [4160.0, 4320.0]
yaw_deg = [-34.5, -30.0]
"""


@pytest.mark.parametrize("kind", ["squinted", "sliding spotlight", "scan", "scan back"])
def test_points_pass_places_in_the_beam(kind: str) -> None:
    collection = axis_collection(kind if not kind.startswith("scan") else "stripmap")
    if kind.startswith("scan"):
        azimuth = (0.06 if kind == "scan" else -0.06) * (collection.time + 0.05 * collection.time**2)
        beam = {"beam_axis": None, "beam_steering": None, "beam_azimuth": azimuth}
        collection = Collection(**{**collection.as_dict(), **beam})
    geometry = Geometry(collection=collection)
    yaw = (0.274 if kind == "squinted" else 0.0) + np.linspace(-2e-3, 2e-3, 5)
    rng = np.linspace(9700, 10000, 3)[:, None]
    first, last = geometry.beam.dwell_at(yaw, rng, uncut=True)
    x, y = geometry.ground_axes(rng, yaw)
    beam = geometry.beam
    for place in (-0.9, 0.0, 0.6):
        times = geometry.beam.passing_at(yaw, rng, place)
        found = np.abs(beam.at_times(times, lambda pulses: beam.offset(x, y, pulses))) / beam.half
        inside = (times > collection.time[0]) & (times < collection.time[-1])
        assert inside.mean() > 0.5
        np.testing.assert_allclose(found[inside], abs(place), atol=1e-6)
    for place, end in ((-1.0, first), (1.0, last)):
        np.testing.assert_allclose(
            geometry.beam.passing_at(yaw, rng, place), np.broadcast_to(end, times.shape), atol=1e-9
        )


def test_tapers_move_over_the_band_where_the_doppler_rate_is_small(tmp_path: Path) -> None:
    """Acceleration nearly cancels the rate in a corner of the swath: 8 Hz/s, and 46 Hz/s at the other side.

    Before this was predicted, 0.9999 was promised of a scene of eight degrees of which a chip had 0.974.
    """
    path, store = tmp_path / "scene.toml", tmp_path / "ph.zarr"
    path.write_text(CANCELLING)
    blocksar.simulate(path, store)
    asked: dict[str, Any] = {"grid": ((3230.0, 3255.0, 1.0), (-2000.0, -1975.0, 1.0)), "weighting_azimuth": "hann"}
    chain: dict[str, Any] = {"processor": "high-order-phase", "blocks": 1}
    images = []
    for name, how in (("chain", chain), ("exact", {"processor": "backprojection"})):
        blocksar.focus(store, tmp_path / name, workers=0, threads=1, **asked, **how)
        images.append(blocksar.open(tmp_path / name).image.values)
    measured = 1 - abs(np.vdot(*images)) / np.linalg.norm(images[0]) / np.linalg.norm(images[1])
    predicted = 1 - blocksar.plan(store, **asked, **chain).result.coherence
    assert predicted == pytest.approx(measured, rel=0.3)
    assert predicted > 2e-3
