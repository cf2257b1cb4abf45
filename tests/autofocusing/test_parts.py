"""The estimator's parts against something slow and obviously right."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.interpolate import BSpline

from blocksar.arrays import FloatArray
from blocksar.autofocusing.chips import Chips, brightest_places, fill, gaps, join_chips
from blocksar.autofocusing.estimation import PADDING, Polish, coarse_error, entropies, minimise, without_line
from blocksar.autofocusing.fine_phase import believed, by_least_squares, is_pattern, own_phase, point_phases
from blocksar.autofocusing.finishing import alike_nearby, bends, far_from_gaps, fine_samples, unfollowed, unknown_turns
from blocksar.autofocusing.information import factor, information, solve
from blocksar.autofocusing.phase_gradient import add_rows, line_of_sight, own_errors, strongest_lines, sum_along
from blocksar.autofocusing.range_lines import DecimatingFilter, range_profiles, take_chips, take_lines, taps
from blocksar.autofocusing.selection import Points, find_candidates
from blocksar.autofocusing.spectral_drift import STEP, Spectra, phase_of_drift, products_with_others, smooth_path
from blocksar.autofocusing.track_correction import Correction, Knots, between_samples, intervals
from blocksar.autofocusing.work import Work, begin, low_pass
from blocksar.collection.geometry import Geometry
from blocksar.collection.terrain import Terrain
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.kernels.loops import fixed
from blocksar.simulation.scatterers import field, phase_history
from tests.helpers.samples import noise
from tests.helpers.track_errors import CENTRE, GRID, spotlight


@pytest.fixture(scope="module")
def work() -> Work:
    return begin(Geometry(collection=spotlight()), GRID)


def synthetic_chips(
    work: Work, phase: np.ndarray, *, points: int = 12, length: int = 160, level: float = 0.1, seed: int = 3
) -> Chips:
    """One point a chip, with a dwell, a Doppler and a phase of its own, and the phase (n_sample,) that all share."""
    random = np.random.default_rng(seed)
    first = np.linspace(0, work.n_sample - length, points).astype(np.int64)
    values = level * noise(points, 7, length, seed=seed)
    for i in range(points):
        at = first[i] + np.arange(length)
        values[i, 3] += np.exp(1j * (phase[at] + random.uniform(-0.4, 0.4) * np.arange(length) + random.uniform(0, 6)))
    sight = np.stack(
        [
            np.full((points, length), 0.8),
            random.uniform(-0.02, 0.02, (points, length)),
            np.full((points, length), -0.6),
        ],
        axis=2,
    )
    return Chips(
        work=work,
        time=work.sample_times,
        values=values,
        first=first,
        count=np.full(points, length, np.int64),
        sight=sight,
        distance=np.full((points, length), 6000.0),
        seen=np.ones(work.n_sample, bool),
    )  # fmt: skip


def test_lines_are_those_of_the_direct_sum() -> None:
    collection = spotlight(n_pulse=64)
    signal = noise(64, collection.n_range_frequency)
    # Random samples fill the whole band: the profile is compared where the interpolation is made for it.
    profiles = range_profiles(signal, collection)
    held = np.random.default_rng(0).uniform(-60, 60, (5, 64))  # m
    lines = np.empty((5, 64), np.complex64)
    middle = collection.range_frequency[collection.n_range_frequency // 2]
    cycles = 2 * (collection.carrier + middle) / SPEED_OF_LIGHT * held
    take_lines(profiles.values, held / profiles.spacing, cycles, taps(), lines)
    turns = 2 * (collection.carrier + collection.range_frequency) / SPEED_OF_LIGHT
    direct = np.array(
        [[(signal[p] * np.exp(2j * np.pi * turns * held[r, p])).mean() for p in range(64)] for r in range(5)]
    )
    assert np.abs(lines - direct).max() < 4e-3 * np.abs(direct).max()  # six taps: -50 dB


def test_chips_are_low_passed_lines() -> None:
    collection = spotlight(n_pulse=64)
    profiles = range_profiles(noise(64, collection.n_range_frequency), collection)
    random = np.random.default_rng(1)
    bins, cycles = random.uniform(-50, 50, (2, 64)), random.uniform(-9, 9, (2, 64))
    decimation, weights = 3, low_pass(3)
    ahead = (weights.size - decimation) // 2
    lit, out = np.array([[0, 64], [10, 50]]), np.zeros((2, 21, 3), np.complex64)
    take_chips(
        profiles.values, bins, cycles, lit, taps(), 2.0, DecimatingFilter(fixed(weights), decimation, ahead), out
    )
    for i in range(2):
        for line in range(3):
            row = np.empty((1, 64), np.complex64)
            take_lines(profiles.values, bins[i : i + 1] + 2.0 * (line - 1), cycles[i : i + 1], taps(), row)
            row[0, : lit[i, 0]] = row[0, lit[i, 1] :] = 0
            slow = np.convolve(row[0], weights)[ahead + 2 :: decimation][:21]  # samples lie amid three pulses
            assert np.abs(out[i, :, line] - slow).max() < 1e-5 * np.abs(slow).max()


def test_chips_are_no_larger_than_planned(work: Work) -> None:
    count = work.settings.points
    points = Points(
        x=np.full(count, 6000.0), y=np.zeros(count), z=np.zeros(count), first=np.zeros(count, np.int64),
        last=np.full(count, work.geometry.collection.n_pulse, np.int64),
    )  # fmt: skip
    chips = join_chips(work, points, [], np.zeros((work.n_sample, 3)))
    assert 0.9 * chips.values.nbytes < work.chip_bytes() <= chips.values.nbytes


def test_sums_over_rows_that_lie_anywhere_in_the_collection() -> None:
    rows, first = noise(4, 7).astype(np.complex128), np.array([0, 5, 9, 13])  # the last two end beyond it
    factors, along = noise(1, 4, seed=1)[0].astype(np.complex128), noise(1, 14, seed=2)[0].astype(np.complex128)
    placed = np.zeros((4, 20), np.complex128)
    for row, at, values in zip(placed, first, rows, strict=True):
        row[at : at + 7] = values
    summed, own = np.zeros(14, np.complex128), np.zeros(4, np.complex128)
    add_rows(rows, first, factors, summed)
    sum_along(rows, first, along, own)
    assert summed == pytest.approx((factors[:, None] * placed)[:, :14].sum(axis=0))
    assert own == pytest.approx((along * placed[:, :14]).sum(axis=1))


def test_splines_are_b_splines_and_the_adjoint_is_their_transpose(work: Work) -> None:
    knots = Knots(work=work, n_interval=9, time=work.sample_times)
    random = np.random.default_rng(2)
    coefficients, values = random.standard_normal((12, 3)), random.standard_normal((work.n_sample, 3))
    time = work.geometry.collection.time
    at = time[0] + knots.step * np.arange(-3, 13)
    assert knots.values(coefficients) == pytest.approx(BSpline(at, coefficients, 3)(work.sample_times), abs=1e-12)
    assert (knots.values(coefficients) * values).sum() == pytest.approx((coefficients * knots.adjoint(values)).sum())
    assert knots.smooth(knots.values(coefficients)) == pytest.approx(knots.values(coefficients), abs=1e-9)


def test_between_samples_parabolas_are_exact(work: Work) -> None:
    parabola = np.stack([work.sample_times**k for k in range(3)], axis=1)
    time = work.geometry.collection.time[2:-2]
    assert between_samples(work, parabola, time) == pytest.approx(
        np.stack([time**k for k in range(3)], axis=1), abs=1e-4
    )


def test_entropy_and_its_gradient() -> None:
    values, random = noise(2, 3, 20), np.random.default_rng(4)
    phase = random.uniform(-2, 2, (2, 20))

    def slow(phase: np.ndarray) -> np.ndarray:
        image = np.fft.fft(values * np.exp(1j * phase)[:, None], n=int(PADDING * 20), axis=2)
        power = np.abs(image) ** 2
        share = power / power.sum(axis=(1, 2), keepdims=True)
        return -(share * np.log(share)).sum(axis=(1, 2))

    entropy, gradient = entropies(values, phase)
    assert entropy == pytest.approx(slow(phase), rel=1e-5)
    for t in (0, 7, 19):
        step = np.zeros(20)
        step[t] = 1e-4
        assert gradient[:, t] == pytest.approx((slow(phase + step) - slow(phase - step)) / 2e-4, abs=2e-5)


def test_gradient_of_the_polish(work: Work) -> None:
    chips = synthetic_chips(work, np.zeros(work.n_sample), length=64)
    knots = Knots(work=work, n_interval=8, time=chips.time)
    start = np.linspace(-3, 5, knots.size * 3).reshape(-1, 3)
    polish = Polish(chips=chips, knots=knots, weights=np.linspace(0.5, 1, 12), start=start)
    random = np.random.default_rng(5)
    at, way = random.standard_normal((2, 33))
    at, way = 0.3 * at, way / np.linalg.norm(way)
    ahead, behind = (polish.cost(at + step * way)[0] for step in (1e-3, -1e-3))
    assert (polish.cost(at)[1] * way).sum() == pytest.approx((ahead - behind) / 2e-3, rel=2e-2)


def test_information_is_the_phase_without_mean_and_line(work: Work) -> None:
    chips = synthetic_chips(work, np.zeros(work.n_sample), length=50)
    knots = Knots(work=work, n_interval=6, time=chips.time)
    random, weights = np.random.default_rng(6), np.linspace(1, 2, 12)
    coefficients = random.standard_normal((9, 3))
    told, _ = information(chips, knots, weights)
    phase, slow = chips.los(knots.values(coefficients)), 0.0
    for i in range(12):
        line = np.polyval(np.polyfit(np.arange(50), phase[i], 1), np.arange(50))
        slow += weights[i] * np.mean((phase[i] - line) ** 2)
    assert coefficients.ravel() @ told @ coefficients.ravel() == pytest.approx(slow, rel=1e-9)
    form = told + np.eye(27)
    assert factor(form) @ factor(form).T @ form == pytest.approx(np.eye(27), abs=1e-9)
    assert form @ solve(form, coefficients.ravel()) == pytest.approx(coefficients.ravel())


def test_least_squares_is_told_by_the_points_that_stand_out(work: Work) -> None:
    """Half of the points have a phase of their own: weighed by their variance, they hardly count."""
    u = np.linspace(-1, 1, work.n_sample)
    phase = 0.1 * np.sin(7 * u)
    chips = synthetic_chips(work, phase, level=0.01)
    chips.values[::2, 3] *= np.exp(0.4j * np.sin(9 * np.linspace(-1, 1, 160) + np.arange(6)[:, None]))
    found = nothing = np.zeros((work.n_sample, 3))

    def left() -> float:
        shared = work.wavenumber * (found @ [0.8, 0, -0.6])
        return float(np.mean([np.std(without_line((shared - phase)[chips.index[i]])) for i in range(1, 12, 2)]))

    before = left()
    for _ in range(3):
        found = by_least_squares(chips, found, nothing, np.ones(12))
    assert left() < before / 4
    assert left() < 0.01


def test_phases_of_points_are_what_they_were_made_with(work: Work) -> None:
    u = np.linspace(-1, 1, work.n_sample)
    chips = synthetic_chips(work, 0.3 * np.cos(9 * u))
    for i, phase in enumerate(point_phases(chips)):
        at = chips.first[i] + np.arange(160)
        line = np.polyval(np.polyfit(u[at], 0.3 * np.cos(9 * u[at]), 1), u[at])
        assert np.std(phase[:160] - 0.3 * np.cos(9 * u[at]) + line) < 0.15  # the noise beside the points


def test_whole_turns_are_counted(work: Work) -> None:
    chips, random = synthetic_chips(work, np.zeros(work.n_sample)), np.random.default_rng(8)
    steps = random.standard_normal(work.n_sample)
    for size in (0.3, 1.5):  # rad, rms
        walk = np.cumsum(size * steps) / work.wavenumber
        beyond = work.n_sample * np.mean(np.abs(random.normal(0, size, 100000)) > np.pi)
        assert unknown_turns(chips, walk[:, None] * [0.8, 0.0, -0.6]) == pytest.approx(beyond, rel=0.3, abs=1e-6)


def test_what_splines_do_not_follow_is_told_by_what_both_halves_share(work: Work) -> None:
    """Of random walks they share the finest octaves, of a smooth error and of their noise nothing."""
    chips, random = synthetic_chips(work, np.zeros(work.n_sample)), np.random.default_rng(5)
    knots = Knots(work=work, n_interval=intervals(work), time=work.sample_times)
    walk, sight = random.standard_normal(work.n_sample).cumsum(), np.array([0.8, 0.0, -0.6])  # of the position
    for error in (4e-5 * walk.cumsum(), 1e-4 * walk, 0.02 * np.cos(9 * np.linspace(-1, 1, work.n_sample))):  # m
        halves = [error[:, None] * sight + 1e-5 * random.standard_normal((work.n_sample, 3)) for _ in range(2)]
        beyond = work.wavenumber * np.std(error - knots.smooth(error[:, None])[:, 0])
        assert (beyond > 5e-3) == (error[0] != error[-1])
        assert unfollowed(chips, Correction.none(work), halves) == pytest.approx(beyond, rel=0.5, abs=2e-3)


def test_samples_show_what_splines_do_not_follow(work: Work) -> None:
    """It limits the prediction, which supposes that a random walk goes on."""
    random = np.random.default_rng(6)
    for size in (0.05, 0.2):  # rad, rms
        phase = size * random.standard_normal(work.n_sample)
        chips = synthetic_chips(work, phase)
        everybody = replace(Correction.none(work), weights=np.ones(chips.count.size))
        assert fine_samples(chips, everybody) == pytest.approx(size, rel=0.35)


def test_what_points_nearby_have_alike_is_told(work: Work) -> None:
    """Bends alike on each of four hills are told with the root of their number; those of each point alone are not."""
    chips = synthetic_chips(work, np.zeros(work.n_sample), points=16, length=work.n_sample, level=0.0)
    hill, random = np.arange(16) // 4, np.random.default_rng(7)
    x, y = 1000.0 * hill + random.uniform(-50, 50, 16), random.uniform(-50, 50, 16)
    points = Points(x=x, y=y, z=0 * x, first=chips.first, last=chips.first + chips.count)
    u = np.linspace(-1, 1, work.n_sample)
    parabola = (u * u - np.mean(u * u)) / np.std(u * u)  # of 1 rad rms

    def told(bend: np.ndarray) -> float:
        turn = np.exp(1j * bend[:, None] * parabola[: chips.values.shape[2]]).astype(np.complex64)
        bent = replace(chips, values=chips.values * turn[:, None])
        assert bends(point_phases(bent), bent) == pytest.approx(bend, abs=0.01)
        return alike_nearby(bent, points, replace(Correction.none(work), weights=np.ones(16)))

    assert told(np.array([0.1, -0.1, 0.1, -0.1])[hill]) == pytest.approx(0.1 * np.sqrt(3 / 16), rel=0.02)
    assert told(0.1 * (-1.0) ** np.arange(16)) == 0.0


def test_a_points_own_phase_is_found_across_a_gap(work: Work) -> None:
    """The sidelobes of a gap are as bright, about, and the next lines by angles would stay in them."""
    chips = synthetic_chips(work, np.zeros(work.n_sample), level=0.01)
    seen = chips.seen.copy()
    lines = np.exp(1j * np.array([-1.3, -0.7, 0.2, 1.4])[:, None] * 2 * np.pi / 160 * np.arange(160))
    some = chips.some(np.array([5, 5, 5, 5]))
    seen[some.first[0] + 56 : some.first[0] + 104] = False
    some = replace(some, seen=seen)
    rows = np.where(some.told, lines, 0).astype(np.complex64)
    own, noise = own_phase(rows, some)
    assert np.abs(own - lines)[some.told].max() < 1e-3
    assert noise.max() < 1e-3


def test_a_point_does_not_move_because_its_dwell_has_a_gap(work: Work) -> None:
    chips = synthetic_chips(work, np.zeros(work.n_sample), points=6, length=480)
    seen = ~((np.arange(work.n_sample) >= 150) & (np.arange(work.n_sample) < 330))
    still = chips.values * seen[chips.index][:, None]
    assert own_errors(replace(chips, values=still, seen=seen)).max() < 0.15  # 0.6 and more with turns miscounted
    moving = still * np.exp(0.5j * np.sin(np.arange(480) / 30)).astype(np.complex64)
    assert own_errors(replace(chips, values=moving, seen=seen)).min() > 0.2


def test_apertures_in_a_gap_see_nothing(work: Work) -> None:
    n = work.geometry.collection.n_pulse
    samples = np.zeros((n // 4, work.geometry.collection.n_range_frequency), np.complex64)
    assert find_candidates(samples, work, slice(0, n // 4)).middle.tolist() == [n / 8]
    samples[:] = np.nan
    assert find_candidates(samples, work, slice(0, n // 4)).middle.size == 0


def test_amplitudes_at_long_gaps_do_not_count(work: Work) -> None:
    chips = synthetic_chips(work, np.zeros(work.n_sample))
    seen = np.ones(work.n_sample, bool)
    seen[[20, 21]], seen[100:110] = False, False
    far = far_from_gaps(replace(chips, seen=seen))
    assert np.flatnonzero(~far).tolist() == list(range(93, 117))


def test_short_gaps_are_filled() -> None:
    seen = np.ones(30, bool)
    seen[[0, 5, 6, 29]], seen[12:20] = False, False
    assert [(gap.start, gap.stop) for gap in gaps(seen)] == [(0, 1), (5, 7), (29, 30)]
    lines = np.tile(np.arange(30) * (1 + 2j), (2, 1)).astype(np.complex64)
    whole = lines.copy()
    lines[:, ~seen] = 0
    for gap in gaps(seen):
        fill(lines, gap.start, gap.stop, 30)
    assert lines[:, 5:7] == pytest.approx(whole[:, 5:7])
    assert not lines[:, [0, 15, 29]].any()  # nothing to either side, or too long


def test_minimum_of_a_banana() -> None:
    def rosenbrock(x: np.ndarray) -> tuple[float, np.ndarray]:
        a, b = 1 - x[0], x[1] - x[0] ** 2
        return a * a + 100 * b * b, np.array([-2 * a - 400 * x[0] * b, 200 * b])

    found = minimise(rosenbrock, np.array([-1.2, 1.0]), iterations=200, gain=1e-14, first_step=0.1)
    assert found.at == pytest.approx([1, 1], abs=1e-5)


def test_phase_gradient_stitches_dwells(work: Work) -> None:
    """Twelve points, each lit for a third of the time: together they tell the phase, except for a line."""
    u = np.linspace(-1, 1, work.n_sample)
    phase = 6 * u**2 + 2 * np.sin(9 * u)
    chips = synthetic_chips(work, phase)
    chips = replace(chips, values=strongest_lines(chips))
    total = np.zeros(work.n_sample)
    for band in (60, 30, 15):
        index = np.minimum(chips.first[:, None] + np.arange(160), work.n_sample - 1)
        total += line_of_sight(chips, total[index], band, np.ones(12))
    left = without_line(total - phase)
    assert np.std(without_line(phase)) > 2
    assert np.std(left) < 0.15


def test_the_smoothest_path_is_the_best_of_all() -> None:
    fit = np.random.default_rng(6).uniform(0, 1, (4, 6))
    scale = np.sqrt((fit * fit).mean())

    def score(path: tuple[int, ...]) -> float:
        steps = (np.diff(path) + 3) % 6 - 3  # periodic
        return float(fit[np.arange(4), path].sum() / scale - ((steps / STEP) ** 2).sum())

    best = max(product(range(6), repeat=4), key=score)
    assert smooth_path(fit).tolist() == list(best)


def test_products_of_spectra_with_those_of_other_windows() -> None:
    values, turns = noise(9, 8, seed=1), np.exp(2j * np.pi * np.random.default_rng(2).uniform(size=(5, 8)))
    window = [np.array(numbers) for numbers in ((0, 1, 3), (1, 2), (0, 1, 2, 3))]  # none has the last
    points = [values[:3], values[3:5], values[5:]]
    found = products_with_others(Spectra(points, window, np.arange(5.0)), turns)
    slow = np.zeros((5, 8), complex)
    for own, numbers in zip(points, window, strict=True):
        for i, j in product(range(numbers.size), repeat=2):
            if i != j:
                slow[numbers[i]] += own[i] * np.conj(own[j] * turns[numbers[j]])
    assert found == pytest.approx(slow, abs=1e-6)


@pytest.mark.parametrize("rough", [False, True])
def test_the_drift_serves_smooth_errors_and_the_phase_gradient_random_walks(work: Work, rough: bool) -> None:
    n = work.n_sample
    phase = 12 * np.cos(2 * np.pi * np.arange(n) / n)
    if rough:
        phase = np.cumsum(0.5 * np.random.default_rng(4).standard_normal(n))
    chips = synthetic_chips(work, phase, length=n, level=0.02)
    found = coarse_error(chips, np.ones(12))
    assert found.rough == rough
    left = work.wavenumber * chips.los(found.displacement)[0] - phase
    assert without_line(left).std() < 0.2


def test_drift_of_equal_points_at_equal_distances(work: Work) -> None:
    n = work.n_sample
    phase = 12 * np.cos(2 * np.pi * np.arange(n) / n)
    chips = synthetic_chips(work, phase, length=n, points=12, level=0.02)
    at = np.arange(n)
    comb = sum(np.exp(2j * np.pi * 0.1 * k * at + 0.4j * k * k) for k in range(-3, 4)).astype(np.complex64)
    chips = replace(chips, values=chips.values * comb)
    found = phase_of_drift(replace(chips, values=strongest_lines(chips)), np.ones(12))
    assert without_line(found - phase).std() < 0.7  # of 8


def test_a_pattern_changes_amplitudes_alike() -> None:
    a, b, common = np.random.default_rng(7).standard_normal((3, 400))
    assert not is_pattern(a, b)
    assert is_pattern(a + common, b + common)


def test_halves_are_believed_where_they_agree() -> None:
    random = np.random.default_rng(7)
    noise_a, noise_b = random.standard_normal((2, 600))
    common = np.cumsum(random.standard_normal(600))
    common -= common.mean()

    def halves(shared: FloatArray, level: float) -> list[FloatArray]:
        """Phase and relative amplitude of each, (600, 2)."""
        return [np.stack([shared + own, 1 + level * own[::-1]], axis=1) for own in (noise_a, noise_b)]

    assert np.std(believed(*halves(np.zeros(600), 1.0)).phase) < 0.2
    found = believed(*halves(common, 1.0))
    assert np.std(found.phase - common) < 0.7  # less than the mean of both has
    assert np.std(found.phase - common) == pytest.approx(np.std(found.doubt), rel=0.4)


def test_what_scatterers_add_to_all_points_is_not_believed() -> None:
    """It changes amplitudes as much as phases; an error of the track changes phases alone."""
    random = np.random.default_rng(8)
    real, imaginary, error = 0.1 * random.standard_normal((3, 600))
    noise = 0.03 * random.standard_normal((2, 600, 2))
    disturbed = [np.stack([imaginary, 1 + real], axis=1) + own for own in noise]
    assert np.std(believed(*disturbed).phase) < 0.02
    mixed = [np.stack([2 * error + imaginary, 1 + real], axis=1) + own for own in noise]
    true = [np.stack([2 * error, np.ones(600)], axis=1) + own for own in noise]
    assert np.std(believed(*true).phase - 2 * error) < 0.03
    assert np.std(believed(*mixed).phase - 2 * error) < 0.12  # hardly more than is disturbed


def test_narrowed_chips_keep_slow_phases(work: Work) -> None:
    u = np.linspace(-1, 1, work.n_sample)
    chips = synthetic_chips(work, 3 * u**2)
    narrow = chips.narrowed(4)
    assert narrow.time == pytest.approx(chips.time[: 4 * narrow.time.size].reshape(-1, 4).mean(axis=1))
    before = np.abs(np.fft.fft(chips.values[5, 3])).max()
    after = np.abs(np.fft.fft(narrow.values[5, 3])).max()
    assert after == pytest.approx(before / 4, rel=0.1)
    weights = low_pass(4)
    whole = np.zeros(work.n_sample + weights.size, np.complex64)  # of the collection, with margins
    whole[chips.first[5] + 12 : chips.first[5] + 12 + 160] = chips.values[5, 3]
    sums = [weights @ whole[4 * m : 4 * m + weights.size] for m in narrow.first[5] + np.arange(narrow.count[5])]
    assert narrow.values[5, 3, : narrow.count[5]] == pytest.approx(np.array(sums), abs=1e-5)


def test_chips_about_their_brightest_scatterers(work: Work) -> None:
    """A scatterer aside of its point leaves more than a line, until its own range is removed instead."""
    away, n = np.array([0.8, 3.0]), work.n_sample  # m
    antenna = work.geometry.collection.antenna_position
    place = np.array([6010.0, -20.0, 0.0])
    sights = [place + shift - antenna for shift in (np.zeros(3), np.append(away, 0.0))]
    distance, true = (np.linalg.norm(sight, axis=1)[None] for sight in sights)
    values = 1e-3 * noise(1, 7, n)
    for line in range(7):
        offset = (line - 3) * work.settings.line_spacing - (true - distance)[0].mean() / work.cell
        values[0, line] += np.sinc(offset) * np.exp(-1j * work.wavenumber * (true - distance)[0])
    chips = Chips(
        work=work, time=work.sample_times, values=values, first=np.zeros(1, np.int64), count=np.full(1, n, np.int64),
        sight=(sights[0] / distance[0][:, None])[None], distance=distance, seen=np.ones(n, bool),
    )  # fmt: skip
    assert brightest_places(chips)[0] == pytest.approx(away, abs=0.2)
    recentred = chips.recentred(np.zeros((n, 3)))
    left = np.unwrap(np.angle(recentred.values[0, 4]))
    assert np.ptp(without_line(left)) < 0.05 < np.ptp(without_line(np.unwrap(np.angle(values[0, 4]))))


def test_points_are_found_on_the_terrain_where_they_stand() -> None:
    """A point on a slope, 30 m above the plane, that the plane's candidates place some 60 m off."""
    collection, (x, y) = spotlight(), (CENTRE[0] + 10.0, -15.0)
    tilted = Terrain(
        x0=CENTRE[0] - 200, dx=20.0, y0=-200.0, dy=20.0,
        heights=30 + 0.2 * (np.arange(-200, 201, 20.0) - 10.0) + 0.1 * (np.arange(-200, 201, 20.0)[:, None] + 15.0),
    )  # fmt: skip
    assert tilted(np.array(x), np.array(y)) == pytest.approx(30)
    signal = phase_history(
        field(collection, *(np.array([value]) for value in (x, y, 1.0 + 0j, 30.0))), pulses=slice(0, collection.n_pulse)
    )
    places, part = [], slice(240, 280)
    for terrain in (None, tilted):
        work = begin(Geometry(collection=collection, terrain=terrain), GRID)
        found = find_candidates(signal[part], work, part)
        brightest = int(found.prominence.argmax())
        place = np.array([found.x[brightest], found.y[brightest]])
        places.append(np.append(place, float(work.geometry.height(*place))))
    on_plane, on_terrain = (np.linalg.norm(place - collection.antenna_position[259:262], axis=1) for place in places)
    assert on_terrain == pytest.approx(on_plane, abs=1e-3)  # the same range and range rate
    true = np.array([x, y, 30.0])
    cell = collection.wavelength * on_plane[1] / (2 * 120 * 40 / 400)  # of the short aperture, m
    assert np.linalg.norm(places[1] - true) < cell < np.linalg.norm(places[0] - true) / 3
