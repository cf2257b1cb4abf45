"""Gaps of the collection, over which the estimate is bridged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from blocksar.arrays import FloatArray
from blocksar.autofocusing import selection
from blocksar.autofocusing.bridging import (
    PADDING,
    between,
    bridged,
    jump,
    sight_across,
    stitched,
    straddling,
    whole_turns,
)
from blocksar.autofocusing.chips import Chips, mean_sight
from blocksar.autofocusing.fine_phase import own_phase, point_phases, strongest_rows
from blocksar.autofocusing.finishing import told_across_gaps
from blocksar.autofocusing.information import information, told_within_sides
from blocksar.autofocusing.selection import best_points, find_candidates, gaps_between
from blocksar.autofocusing.track_correction import Correction, Knots
from blocksar.autofocusing.work import Work, begin
from blocksar.collection.beam import Beam
from blocksar.collection.geometry import Geometry
from blocksar.kernels.fourier import fast_length
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


@pytest.mark.parametrize(("ahead", "steps"), [(-3.0, 0), (-0.7, 3), (0.0, 0), (1.234, -7), (3.0, 1)])
def test_the_jump_over_a_gap_is_that_of_the_brightest_points(work: Work, ahead: float, steps: int) -> None:
    since = np.arange(work.n_sample) - GAP.stop
    slope = 2 * np.pi * steps / fast_length(PADDING * work.n_sample)
    chips = chips_of(work, np.where(since < 0, 0.0, ahead + slope * since))
    chips = replace(chips, count=np.where(np.arange(POINTS) < 9, GAP.stop + 60, work.n_sample))
    found = jump(replace(chips, values=chips.values * chips.lit[:, None]), GAP, np.ones(POINTS))
    assert abs(np.angle(np.exp(1j * (found.phase - ahead)))) < 0.1
    assert found.slope == pytest.approx(slope, abs=1e-12)


def test_both_sides_are_stitched(work: Work) -> None:
    since = np.arange(work.n_sample) - GAP.stop
    phase = np.where(since < 0, 0.0, 2.0 + 2 * np.pi * 2 / fast_length(PADDING * work.n_sample) * since)
    chips = chips_of(work, phase)
    moved = stitched(chips, np.zeros((work.n_sample, 3)), np.ones(POINTS))
    assert work.wavenumber * (moved * mean_sight(chips)).sum(axis=1) == pytest.approx(phase, abs=0.05)


def test_points_on_one_side_alone_tell_no_jump(work: Work) -> None:
    chips = chips_of(work, 2.0 * (np.arange(work.n_sample) >= GAP.stop))
    chips = replace(chips, count=np.where(np.arange(POINTS) < 3, work.n_sample, GAP.stop + 5))
    assert straddling(chips, GAP).tolist() == [True] * 3 + [False] * (POINTS - 3)
    assert jump(chips, GAP, np.ones(POINTS)).phase == pytest.approx(2.0, abs=0.1)
    assert jump(chips, GAP, (np.arange(POINTS) >= 3).astype(np.float64)) == (0.0, 0.0)


def test_points_on_one_side_alone_have_a_phase_of_their_own(work: Work) -> None:
    wave = 0.2 * np.sin(np.arange(work.n_sample) / 9)
    chips = chips_of(work, wave)
    for lit in (chips.index >= GAP.stop, chips.index < GAP.start, chips.index < GAP.stop + 3):
        some = replace(chips, values=chips.values * lit[:, None], seen=chips.seen & lit[0])
        there = some.told[0]
        own, noise = own_phase(strongest_rows(some), some)
        assert (np.abs(own[:, there]) > 0.5).all() and noise.max() < 0.2
        found = point_phases(some)[:, there].mean(axis=0)
        flat = wave[there] - np.polyval(np.polyfit(np.flatnonzero(there), wave[there], 1), np.flatnonzero(there))
        assert np.abs(found - flat).max() < 0.15


def test_how_both_sides_fit_is_not_told_within_sides(work: Work) -> None:
    chips, at = chips_of(work, np.zeros(work.n_sample)), np.arange(work.n_sample)
    knots, weights = Knots(work=work, n_interval=64, time=chips.time), np.ones(POINTS)

    def told(phase: FloatArray, form: FloatArray) -> float:
        """Mean square of a phase (n_sample,) along the sight that a form tells, rad^2."""
        c = knots.fit(phase[:, None] * chips.sight[0]).ravel()
        return float(c @ form @ c) / POINTS

    across = np.where(at < (GAP.start + GAP.stop) // 2, 0.0, 1 + 0.01 * (at - GAP.stop))
    within, whole = told_within_sides(chips, knots, weights), information(chips, knots, weights).told
    assert told(across, whole) > 0.05 > 50 * told(across, within)
    wave = np.sin(at / 30.0)
    parts = [(wave[p] - np.polyval(np.polyfit(at[p], wave[p], 1), at[p])) for p in (at < GAP.start, at >= GAP.stop)]
    assert told(wave, within) == pytest.approx(np.mean(np.concatenate(parts) ** 2), rel=0.01)
    full = replace(chips, seen=np.ones(work.n_sample, bool))
    assert (told_within_sides(full, knots, weights) == information(full, knots, weights).told).all()


def test_gaps_are_seen_by_the_short_apertures(work: Work) -> None:
    samples = np.ones((work.geometry.collection.n_pulse, work.geometry.collection.n_range_frequency), np.complex64)
    samples[150:290] = np.nan
    seen = [find_candidates(samples[part], work, part).seen for part in work.apertures]
    after = next(part.start for part in work.apertures if part.stop > 290)
    assert gaps_between(seen, work) == [slice(150, max(after, 290))]
    samples[:] = 1
    assert not gaps_between([find_candidates(samples[part], work, part).seen for part in work.apertures], work)


def test_points_that_see_both_sides_of_a_gap_are_kept(work: Work, monkeypatch: pytest.MonkeyPatch) -> None:
    random, n, n_pulse = np.random.default_rng(4), 300, work.geometry.collection.n_pulse
    x, y = CENTRE[0] + random.uniform(-65, 65, n), random.uniform(-65, 65, n)
    weak = np.arange(n) >= 200  # these alone see both sides
    monkeypatch.setattr(Beam, "longest_pass", lambda *_: (np.where(weak, 100, 0), np.where(weak, n_pulse, 200)))
    middles = np.array([50.0, 150.0, 350.0, 450.0])
    kept = {
        len(gaps): best_points(x, y, np.where(weak, 5.0, 500.0), middles, gaps, work)[0]
        for gaps in ([], [slice(200, 240)])
    }
    assert weak[kept[0]].sum() < weak[kept[1]].sum() == selection.ACROSS
    assert len(set(kept[1])) == len(kept[1]) == len(kept[0])


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
