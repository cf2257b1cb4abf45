"""Spectra over the dwell, of chips that are summed pulse by pulse over a known part of it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from axis_beams import axis_collection

from blocksar.collection.geometry import Geometry
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.products.look_spectra import dwell_spectrum, shares

pytestmark = pytest.mark.slow

SIDE, STEP = 48, 0.8


def chip_of(geometry: Geometry, x: Any, y: Any, part: tuple[float, float]) -> Any:
    """Image of random points from the pulses of a part of each point's dwell: the definition, as a plain sum."""
    collection, rng = geometry.collection, np.random.default_rng(5)
    at = np.stack(np.broadcast_arrays(x[None, :], y[:, None], 0.0), axis=-1)
    image = np.zeros(at.shape[:2], complex)
    frequency = collection.carrier + np.linspace(-0.5, 0.5, 25) * collection.bandwidth
    for px, py in rng.uniform([x[0], y[0]], [x[-1], y[-1]], (12, 2)):
        start, end = (float(t) for t in geometry.beam.dwell(np.array(px), np.array(py)))
        for time in start + np.linspace(*part, 25) * (end - start):
            antenna = geometry.track.position(np.array(time))
            distance = np.linalg.norm(at - antenna, axis=-1) - np.linalg.norm([px, py, 0.0] - antenna)
            for f in frequency:
                image += np.exp(4j * np.pi / SPEED_OF_LIGHT * f * distance)
    return image


def test_power_lies_in_the_part_of_the_dwell_that_was_summed() -> None:
    geometry = Geometry(collection=axis_collection("tops").centred())
    x, y = 9000 + STEP * (np.arange(SIDE) - SIDE // 2), STEP * (np.arange(SIDE) - SIDE // 2)

    def span(px: float, py: float) -> tuple[float, float]:
        start, end = geometry.beam.dwell(np.array(px), np.array(py))
        return float(start), float(end)

    for part in ((0.0, 0.5), (0.5, 1.0)):
        power = np.nan_to_num(dwell_spectrum(chip_of(geometry, x, y, part), x, y, geometry, span))
        own = (shares() > part[0] - 0.1) & (shares() < part[1] + 0.1)
        assert power[own].sum() > 0.97 * power.sum()
        inner = (shares() > part[0] + 0.1) & (shares() < part[1] - 0.1)
        assert power[inner].min() > 0.1 * power.max()
    assert dwell_spectrum(np.ones((SIDE, SIDE)), 5 * x, 5 * y, geometry, span) is None  # pixels too far apart
