"""Places in the beam that points pass."""

from __future__ import annotations

import numpy as np
import pytest
from axis_beams import axis_collection

from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry


@pytest.mark.parametrize("kind", ["squinted", "sliding spotlight", "scan", "scan back"])
def test_points_pass_places_in_the_beam(kind: str) -> None:
    collection = axis_collection(kind if not kind.startswith("scan") else "stripmap")
    if kind.startswith("scan"):
        azimuth = (0.06 if kind == "scan" else -0.06) * (collection.time + 0.05 * collection.time**2)
        scan = {"beam_axis": None, "beam_steering": None, "beam_azimuth": azimuth}
        collection = Collection(**{**collection.as_dict(), **scan})
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
