"""Azimuth ambiguities that a plan tells, against images of what folds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from strips import DISTANCE, strip_collection

from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.planning.ambiguity import azimuth_ambiguities, worst_ambiguity
from blocksar.processors.exact.sums import form_image
from blocksar.simulation.antenna import named_pattern
from blocksar.simulation.scatterers import simulate_pulses


def strip(prf: float, *, pattern: bool = False) -> Collection:
    collection = strip_collection(1.2, prf=prf, curve=2.0)
    if not pattern:
        return collection
    offset, gain = named_pattern("sinc2", collection.beam_width or 0.0)
    return replace(collection, beam_offset=offset, beam_pattern=gain)


@pytest.mark.parametrize("pattern", [False, True])
def test_a_ghost_lies_where_it_is_told_and_is_as_strong(pattern: bool) -> None:
    collection = strip(260.0, pattern=pattern)
    geometry, grid = Geometry(collection=collection), Grid(DISTANCE - 30, DISTANCE + 30, 0.7, -10.0, 10.0, 0.3)
    found = worst_ambiguity(geometry, grid)
    assert found is not None and found.amplitude > 0.02
    x, y = (np.array([value]) for value in found.source)
    signal = simulate_pulses(collection, x, y, np.ones(1), threads=1)
    about = found.ghost[0] + np.arange(-6, 6, 0.2), found.ghost[1] + np.arange(-9, 9, 0.1)
    image = np.nan_to_num(form_image(lambda pulses: signal[pulses], geometry, *about, threads=2))
    assert np.abs(image).max() == pytest.approx(found.amplitude, rel=0.15)


def test_a_stagger_spreads_the_ghost_as_the_plan_says() -> None:
    whole = strip(1300.0)
    pulses = np.cumsum(np.tile([3, 7], whole.n_pulse // 10))[:-1]
    by_pulse = ("time", "reference_range", "antenna_position", "beam_axis", "beam_steering", "beam_azimuth")
    taken = {name: value[pulses] for name in by_pulse if (value := getattr(whole, name)) is not None}
    collection = replace(whole, **taken)
    geometry, grid = Geometry(collection=collection), Grid(DISTANCE - 30, DISTANCE + 30, 0.7, -10.0, 10.0, 0.3)
    assert not collection.pulses.even and collection.prf == pytest.approx(260, rel=0.01)
    found = worst_ambiguity(geometry, grid)
    assert found is not None
    x, y = (np.array([value]) for value in found.source)
    signal = simulate_pulses(collection, x, y, np.ones(1), threads=1)
    about = found.ghost[0] + np.arange(-6, 6, 0.2), found.ghost[1] + np.arange(-9, 9, 0.1)
    image = np.nan_to_num(form_image(lambda pulses: signal[pulses], geometry, *about, threads=2))
    assert np.abs(image).max() == pytest.approx(found.amplitude, rel=0.2)
    assert ", spread by the uneven pulses, such as from" in azimuth_ambiguities([geometry], grid)[0]


def test_a_prf_that_holds_what_is_lit_together_has_none() -> None:
    grid = Grid(DISTANCE - 30, DISTANCE + 30, 0.7, -10.0, 10.0, 0.3)
    assert worst_ambiguity(Geometry(collection=strip(1600.0)), grid) is None
