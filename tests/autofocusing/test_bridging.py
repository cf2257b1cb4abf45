"""Gaps of the collection, over which the estimate is bridged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from blocksar.arrays import FloatArray
from blocksar.autofocusing.bridging import between, bridged, jump, sight_across, stitched, straddling, whole_turns
from blocksar.autofocusing.chips import Chips, mean_sight
from blocksar.autofocusing.correction import Correction
from blocksar.autofocusing.finishing import told_across_gaps
from blocksar.autofocusing.work import Work, begin
from blocksar.collection.geometry import Geometry
from tests.helpers.samples import noise
from tests.helpers.track_errors import CENTRE, GRID, spotlight

GAP = slice(200, 240)
POINTS = 20


@pytest.fixture(scope="module")
def work() -> Work:
    return begin(Geometry(collection=spotlight()), GRID)


def chips_of(work: Work, phase: FloatArray, gap: slice | None = GAP, spread: float = 0.4) -> Chips:
    """Chips of points that are lit all the time, with Dopplers and phases of their own and a phase (n_sample,), rad."""
    random, n = np.random.default_rng(3), work.n_sample
    at, seen = np.arange(n), np.ones(n, bool)
    values = 0.1 * noise(POINTS, 7, n, seed=3)
    for i in range(POINTS):
        values[i, 3] += np.exp(1j * (phase + random.uniform(-spread, spread) * at + random.uniform(0, 6)))
    if gap is not None:
        values[..., gap], seen[gap] = 0, False
    position = work.geometry.collection.antenna_position[:n]
    vector = np.broadcast_to(CENTRE - position, (POINTS, n, 3)).copy()
    distance = np.sqrt((vector * vector).sum(axis=2))
    return Chips(
        work=work, time=work.sample_times, values=values.astype(np.complex64), first=np.zeros(POINTS, np.int64),
        count=np.full(POINTS, n, np.int64), sight=vector / distance[..., None], distance=distance, seen=seen,
    )  # fmt: skip


def smooth(n: int) -> FloatArray:
    u = np.linspace(-1, 1, n)
    return 3 * u**3 - 2 * u**2 + u


@pytest.mark.parametrize("ahead", [-3.0, -0.7, 0.0, 1.234, 3.0])
def test_the_jump_over_a_gap_is_that_of_the_brightest_points(work: Work, ahead: float) -> None:
    after = np.arange(work.n_sample) >= GAP.stop
    found = jump(chips_of(work, ahead * after), GAP, np.ones(POINTS))
    assert abs(np.angle(np.exp(1j * (found - ahead)))) < 0.05


def test_both_sides_are_stitched(work: Work) -> None:
    after = np.arange(work.n_sample) >= GAP.stop
    chips = chips_of(work, 2.0 * after)
    moved = stitched(chips, np.zeros((work.n_sample, 3)), np.ones(POINTS))
    phase = work.wavenumber * (moved * mean_sight(chips)).sum(axis=1)
    assert phase == pytest.approx(2.0 * after, abs=0.05)


def test_points_on_one_side_alone_tell_no_jump(work: Work) -> None:
    chips = chips_of(work, 2.0 * (np.arange(work.n_sample) >= GAP.stop))
    chips = replace(chips, count=np.where(np.arange(POINTS) < 3, work.n_sample, GAP.stop + 5))
    assert straddling(chips, GAP).tolist() == [True] * 3 + [False] * (POINTS - 3)
    assert jump(chips, GAP, np.ones(POINTS)) == pytest.approx(2.0, abs=0.1)
    assert jump(chips, GAP, (np.arange(POINTS) >= 3).astype(np.float64)) == 0.0


def test_error_across_a_gap_is_told_by_what_is_left_of_the_points_that_see_both_sides(work: Work) -> None:
    found, at = np.zeros((work.n_sample, 3)), np.arange(work.n_sample)
    correction = Correction(displacement=found, previous=found, weights=np.ones(POINTS))
    turned = np.exp(0.3j * np.where(np.arange(POINTS) % 2, 1, -1)[:, None] * (at >= GAP.stop)).astype(np.complex64)

    def told(which: int, gap: slice | None = GAP) -> float:
        chips = chips_of(work, np.zeros(at.size), gap, spread=0.01)
        chips = replace(chips, values=chips.values * turned[:, None])
        return told_across_gaps(
            replace(chips, count=np.where(np.arange(POINTS) < which, at.size, GAP.start)), correction
        )

    there = np.delete(at, GAP)
    phase = 0.3 * (there >= GAP.stop)
    left = phase - np.polyval(np.polyfit(there, phase, 1), there)
    rms = float(np.sqrt((left * left).mean()))
    assert told(POINTS) == pytest.approx(rms / np.sqrt(POINTS - 1), rel=0.15)
    assert told(4) == pytest.approx(rms / np.sqrt(3) * np.sqrt(4 / POINTS), rel=0.3)
    assert told(POINTS, None) == told(1) == 0.0


def test_displacements_along_the_sight_across_a_gap_are_a_constant_and_a_line_to_other_points(work: Work) -> None:
    chips = chips_of(work, np.zeros(work.n_sample))
    place = CENTRE + np.array([300.0, -500.0, 0.0])
    vector = place - work.geometry.collection.antenna_position[: work.n_sample]
    other = vector / np.linalg.norm(vector, axis=1)[:, None]
    phase = work.wavenumber * 0.1 * (sight_across(chips, GAP) * other).sum(axis=1)  # 10 turns
    at = np.linspace(-1, 1, phase.size)
    assert np.abs(phase - np.polyval(np.polyfit(at, phase, 1), at)).max() < 0.01


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
