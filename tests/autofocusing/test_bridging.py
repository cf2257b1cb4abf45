"""Gaps of the collection, over which the estimate is bridged."""

from __future__ import annotations

import numpy as np
import pytest

from blocksar.arrays import FloatArray
from blocksar.autofocusing.bridging import between, bridged, jump, stitched, whole_turns
from blocksar.autofocusing.chips import Chips, mean_sight
from blocksar.autofocusing.work import Work, begin
from blocksar.collection.geometry import Geometry
from tests.helpers.samples import noise
from tests.helpers.track_errors import GRID, spotlight

GAP = slice(200, 240)
POINTS = 20


@pytest.fixture(scope="module")
def work() -> Work:
    return begin(Geometry(collection=spotlight()), GRID)


def chips_of(work: Work, phase: FloatArray, gap: slice | None = GAP) -> Chips:
    """Chips of points that are lit all the time, with Dopplers and phases of their own and a phase (n_sample,), rad."""
    random, n = np.random.default_rng(3), work.n_sample
    at, seen = np.arange(n), np.ones(n, bool)
    values = 0.1 * noise(POINTS, 7, n, seed=3)
    for i in range(POINTS):
        values[i, 3] += np.exp(1j * (phase + random.uniform(-0.4, 0.4) * at + random.uniform(0, 6)))
    if gap is not None:
        values[..., gap], seen[gap] = 0, False
    sight = np.broadcast_to([0.8, 0.0, -0.6], (POINTS, n, 3)).copy()
    return Chips(
        work=work, time=work.sample_times, values=values.astype(np.complex64), first=np.zeros(POINTS, np.int64),
        count=np.full(POINTS, n, np.int64), sight=sight, distance=np.full((POINTS, n), 6000.0), seen=seen,
    )  # fmt: skip


def smooth(n: int) -> FloatArray:
    u = np.linspace(-1, 1, n)
    return 3 * u**3 - 2 * u**2 + u


@pytest.mark.parametrize("ahead", [-3.0, -0.7, 0.0, 1.234, 3.0])
def test_the_jump_over_a_gap_is_that_of_the_brightest_points(work: Work, ahead: float) -> None:
    after = np.arange(work.n_sample) >= GAP.stop
    found = jump(chips_of(work, ahead * after), GAP.stop, np.ones(POINTS))
    assert abs(np.angle(np.exp(1j * (found - ahead)))) < 0.05


def test_both_sides_are_stitched(work: Work) -> None:
    after = np.arange(work.n_sample) >= GAP.stop
    chips = chips_of(work, 2.0 * after)
    moved = stitched(chips, np.zeros((work.n_sample, 3)), np.ones(POINTS))
    phase = work.wavenumber * (moved * mean_sight(chips)).sum(axis=1)
    assert phase == pytest.approx(2.0 * after, abs=0.05)


@pytest.mark.parametrize("turns", [-4, 0, 1, 7])
def test_whole_turns_are_those_of_the_smoothest_phase(turns: int) -> None:
    n = 512
    seen = np.ones(n, bool)
    seen[GAP] = False
    phase = 5 * smooth(n) + 2 * np.pi * turns * (np.arange(n) >= GAP.stop)
    phase[GAP] = 99.0  # not looked at
    assert whole_turns(phase, GAP, seen) == turns


def test_a_gap_is_bridged_smoothly(work: Work) -> None:
    chips = chips_of(work, np.zeros(work.n_sample))
    sight, n = mean_sight(chips), work.n_sample
    true = 0.01 * smooth(n)[:, None] * sight
    turn = np.where(np.arange(n) < GAP.stop, 0.0, 2 * 2 * np.pi / work.wavenumber)[:, None] * sight
    wrong = true + turn
    wrong[GAP] = 5.0
    before = 0.02 * np.sin(4 * smooth(n))[:, None] * np.ones(3)
    found = bridged(chips, wrong, before)
    there = np.delete(np.arange(n), GAP)
    assert found[there] == pytest.approx(true[there], abs=1e-9)
    assert found[GAP] == pytest.approx(true[GAP], abs=1e-3)
    whole = chips_of(work, np.zeros(n), None)
    assert bridged(whole, wrong, before) is wrong
    assert stitched(whole, wrong, np.ones(POINTS)) is wrong


def test_between_has_the_values_and_slopes_of_either_side() -> None:
    at = np.arange(60.0)
    values = np.stack([at, 1e-3 * at**2, 2.0 - at], axis=1)
    found = between(values, slice(20, 40))
    assert found[:, [0, 2]] == pytest.approx(values[20:40, [0, 2]], abs=1e-9)
    assert found[:, 1] == pytest.approx(values[20:40, 1], abs=0.05)  # of 1.2: slopes are those of some samples
