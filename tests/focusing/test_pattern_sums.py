"""Sums of the antenna's pattern over lit pulses, against the pattern and the taper by their definitions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from axis_beams import axis_collection, with_patterns

from blocksar.collection.beam import is_lit, lit_passes, pattern_gain, pulse_weights
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import Taper
from blocksar.focusing.pattern_sums import add_gains


@pytest.mark.parametrize("text", ["uniform", "taylor:4:-35", "kaiser:4"])
@pytest.mark.parametrize("angles", ["even", "uneven"])
@pytest.mark.parametrize("width", [0.01, 0.3, 1.8])  # rad
def test_sums_are_those_of_the_definitions(width: float, angles: str, text: str) -> None:
    collection = with_patterns(axis_collection("tops", n_pulse=60, beam_width=width))
    assert collection.beam_offset is not None and collection.elevation is not None
    if angles == "uneven":
        bent = np.linspace(-1, 1, 65) ** 3
        collection = replace(collection, beam_offset=0.52 * width * bent, elevation=0.45 + 0.1 * bent[::4])
    geometry, taper = Geometry(collection=collection), Taper.parse(text)
    rng = np.random.default_rng(2)
    x, y = np.meshgrid(9000 + 30.0 * np.arange(40), np.linspace(-120, 120, 5))
    over = rng.uniform(0, 300, x.shape)
    z = collection.ground_height + over
    valid = rng.uniform(0.5, 1.0, collection.n_pulse)
    pulses, expected, lit = slice(7, 55), np.zeros(x.shape), is_lit(geometry, x, y, z=z)
    for p in range(pulses.start, pulses.stop):
        weight = pulse_weights(geometry, x, y, p, taper, z) * pattern_gain(geometry, x, y, p, z)
        expected += lit[..., p] * weight * valid[p]
    assert (expected > 0).any()
    total = np.ones(x.shape)
    for first, last in zip(*lit_passes(geometry, x, y, z), strict=True):
        add_gains(total, geometry, x, y, over, first=first, last=last, pulses=pulses, valid=valid[pulses], taper=taper)
    np.testing.assert_allclose(total - 1, expected, rtol=0, atol=1e-8 * expected.max())
