"""Interpolation along rows: taps, stretched rows and resampled rows."""

from __future__ import annotations

import numpy as np
import pytest
from samples import largest, power_sum
from scipy.signal.windows import kaiser

from blocksar.arrays import FloatArray
from blocksar.kernels import interpolation
from blocksar.kernels.interpolation import PIECE

# -- interpolation ------------------------------------------------------------------------------------------


def interpolated(taps: np.ndarray, f: FloatArray) -> np.ndarray:
    """Interpolate exp(2j pi f n) with taps (n_fraction, n_tap): (n_fraction, n_f)."""
    k = np.arange(taps.shape[1]) - (taps.shape[1] // 2 - 1)
    return taps @ np.exp(2j * np.pi * np.multiply.outer(k, f))


@pytest.mark.parametrize(("n_tap", "occupancy"), [(4, 0.3), (8, 0.7), (12, 0.7), (16, 0.8), (20, 0.8)])
def test_taps_meet_their_stated_error_and_no_other_taps_err_less(n_tap: int, occupancy: float) -> None:
    nodes, share = np.polynomial.legendre.leggauss(200)
    f = occupancy / 2 * nodes
    fraction = np.arange(257) / 256
    exact = np.exp(2j * np.pi * np.multiply.outer(fraction, f))
    taps = interpolation.interpolation_taps(n_tap, occupancy=occupancy)
    assert taps.dtype == np.float32

    def worst(weights: np.ndarray) -> FloatArray:
        wanted = exact if weights.shape[0] == 257 else exact[::64]
        return np.sqrt(np.abs(interpolated(weights, f) - wanted) ** 2 @ share / 2)

    found = worst(taps)
    told = interpolation.interpolation_error(n_tap, occupancy)
    # The stated error gives slightly too much weight to the band's edges, where the error is largest: a safe estimate.
    assert 0.7 * told - 1e-7 < found.max() < 1.01 * told + 1e-7
    # At either end of the table, the place coincides with a sample, and the error is smaller.
    assert found[[0, -1]].max() < 0.3 * told + 3e-7

    # Slow twin: the same least squares over sampled frequencies instead of sinc integrals.
    k = np.arange(n_tap) - (n_tap // 2 - 1)
    tones = np.exp(2j * np.pi * np.multiply.outer(f, k)) * np.sqrt(share / 2)[:, None]
    aims = exact[::64].T * np.sqrt(share / 2)[:, None]
    best = np.linalg.lstsq(np.vstack([tones.real, tones.imag]), np.vstack([aims.real, aims.imag]), rcond=1e-14)[0].T
    np.testing.assert_allclose(worst(taps[::64]), worst(best), rtol=1e-3, atol=2e-7)
    # A windowed sinc cannot do better; the best Kaiser window comes within a few per cent at high occupancy.
    distance = fraction[::64, None] - k
    for beta in np.linspace(0, 12, 25):
        window = np.interp(np.abs(distance) / (n_tap / 2), np.linspace(0, 1, 501), kaiser(1001, beta)[500:])
        assert worst(best).max() <= worst(np.sinc(distance) * window).max()


def test_fewer_taps_would_not_reach_the_error() -> None:
    for occupancy in (0.3, 0.62, 0.8):
        for wanted in (1e-2, 1e-3, 1e-4):
            n_tap = interpolation.taps_needed(occupancy, error=wanted)
            assert interpolation.interpolation_error(n_tap, occupancy) <= wanted
            assert n_tap == 4 or interpolation.interpolation_error(n_tap - 2, occupancy) > wanted
    assert interpolation.taps_needed(0.99, error=1e-6, at_most=24) == 24


@pytest.mark.parametrize(("n_tap", "occupancy"), [(4, 0.3), (8, 0.7), (16, 0.8), (22, 0.78)])
def test_expanded_taps_equal_the_computed_taps(n_tap: int, occupancy: float) -> None:
    fine = interpolation.TAP_PHASES * 40
    taps = interpolation.interpolation_taps(n_tap, occupancy=occupancy, n_phase=fine)
    table = interpolation.tap_polynomials(n_tap, occupancy=occupancy)
    assert table.dtype == np.float32
    assert table.shape == (interpolation.TAP_PHASES + 1, n_tap, interpolation.TAP_ORDER + 1)
    for q in range(interpolation.TAP_PHASES + 1):
        at = np.arange(
            max(40 * q - int(interpolation.TAP_REACH * fine), 0),
            min(40 * q + int(interpolation.TAP_REACH * fine), fine) + 1,
        )
        mu = at / fine - q / interpolation.TAP_PHASES
        powers = mu[:, None] ** np.arange(interpolation.TAP_ORDER + 1)
        assert largest(powers @ table[q].T.astype(np.float64) - taps[at]) < 1e-5


SCALES = [0.9, 0.99993, 1.0, 1.001, 1.3]
PLACES = [(1201, 600.0), (600, -200.0), (600, 900.5), (3 * PIECE + 5, 1700.0)]


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize(("n", "middle"), PLACES)
def test_stretched_rows_equal_the_exact_signal_between_samples(scale: float, n: int, middle: float) -> None:
    """Test with a sum of 200 tones over 0.7 of the band, whose value between samples is known."""
    rng = np.random.default_rng(n)
    f = rng.uniform(-0.35, 0.35, 200)
    tones = np.exp(2j * np.pi * rng.uniform(0, 1, (2, 200))) / np.sqrt(200)

    def signal(position: FloatArray) -> np.ndarray:
        return tones @ np.exp(2j * np.pi * np.multiply.outer(f, position))

    n_tap = 16
    taps = interpolation.tap_polynomials(n_tap, occupancy=0.7)
    values = signal(np.arange(n)).astype(np.complex64)
    scales = np.array([scale, 2 - scale])
    values.flags.writeable = scales.flags.writeable = taps.flags.writeable = False
    found = np.full((2, n), np.nan, np.complex64)
    interpolation.stretch_rows(values, found, scales, middle, taps)
    for row in range(2):
        position = middle + (np.arange(n) - middle) * scales[row]
        # The window of a strip may be off by a fraction of a sample from the place at which it is read.
        inside = (position >= n_tap / 2) & (position <= n - n_tap / 2 - 2)
        outside = (position < -n_tap / 2 - 1) | (position > n + n_tap / 2)
        error = np.abs(found[row] / scales[row] - signal(position)[row])
        # Sixteen taps err by at most 1e-4, half-way between samples; expanding their weights adds 1e-5.
        assert np.sqrt(np.mean(error[inside] ** 2)) < interpolation.interpolation_error(n_tap, 0.7)
        assert largest(error[inside]) < 3e-4
        assert (found[row, outside] == 0).all()
        padded = np.abs(found[row, ~inside & ~outside])
        assert np.isfinite(padded).all() and padded.max(initial=0.0) < 1.5 * np.abs(values).max()


@pytest.mark.parametrize("scale", [0.95, 1.0, 1.03])
def test_a_stretched_row_keeps_its_sum(scale: float) -> None:
    row = (np.hanning(1201) * np.exp(2e-3j * np.arange(1201)))[None].astype(np.complex64)
    found = np.empty_like(row)
    interpolation.stretch_rows(row, found, np.array([scale]), 600.0, interpolation.tap_polynomials(12, occupancy=0.5))
    assert found.sum() == pytest.approx(row.sum(), rel=1e-4)


def curve(n: int, slopes: FloatArray) -> FloatArray:
    """Positions (1, order + 1) that start at 0.3; the slope is a polynomial of u through these values at even steps."""
    u, at = (np.array([0, n - 1]) - n // 2) * (2 / n), np.linspace(-1, 1, slopes.size)
    slope = np.polynomial.Polynomial.fit(at, slopes, slopes.size - 1).convert() * (n / 2)
    positions = (slope.integ(lbnd=u[0]) + 0.3).coef
    return np.pad(positions, (0, slopes.size + 1 - positions.size))[None, :]  # zeros at the end are left out


def position_and_slope(positions: FloatArray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Position and slope (samples per sample) along the only row, in extended precision."""
    u = np.longdouble(np.arange(n) - n // 2) * 2 / n
    order = np.arange(1, positions.shape[1])
    return power_sum(positions, u)[0], power_sum(positions[:, 1:] * order, u)[0] * 2 / n


CURVES = {
    "gentle": np.array([1.003, 0.998, 1.004]),
    "of paper B": np.array([0.95, 1.0, 1.04]),
    "steep": np.array([0.6, 1.3, 1.9]),
    "winding": 1 + 0.1 * np.cos(np.arange(12.0)) * np.hanning(12),
    "even": np.array([1.0, 1.0]),
}


@pytest.mark.slow
@pytest.mark.parametrize("slopes", CURVES.values(), ids=CURVES.keys())
@pytest.mark.parametrize(("n_tap", "occupancy", "n"), [(8, 0.5, 90), (22, 0.8, 777), (32, 0.9, 2 * PIECE + 5)])
def test_resampled_rows_equal_the_exact_signal_between_samples(
    n_tap: int, occupancy: float, n: int, slopes: FloatArray
) -> None:
    rng = np.random.default_rng(n)
    f = rng.uniform(-occupancy / 2, occupancy / 2, 200)
    tones = np.exp(2j * np.pi * rng.uniform(0, 1, 200)) / np.sqrt(200)

    def signal(position: np.ndarray) -> np.ndarray:
        return np.exp(2j * np.pi * np.multiply.outer(np.float64(position) - n / 3, f)) @ tones

    positions = curve(n, slopes)
    values = signal(np.arange(n)).astype(np.complex64)[None]
    values.flags.writeable = positions.flags.writeable = False
    found = np.full((1, n), np.nan, np.complex64)
    interpolation.resample_rows(values, found, positions, interpolation.tap_polynomials(n_tap, occupancy=occupancy))
    position, slope = position_and_slope(positions, n)
    inside = (position >= n_tap / 2) & (position <= n - n_tap / 2 - 2)
    outside = (position < -n_tap / 2 - 1) | (position > n + n_tap / 2)
    assert inside.sum() > n / 3
    assert outside.any() or slopes[-1] < 1.1
    error = np.abs(found[0] / np.sqrt(slope) - signal(position))
    told = interpolation.interpolation_error(n_tap, occupancy)
    assert np.sqrt(np.mean(error[inside] ** 2)) < told + 1e-5
    assert largest(error[inside]) < 4 * told + 2e-5
    assert (found[0, outside] == 0).all()
    assert np.isfinite(found).all() and largest(found) < 2 * np.sqrt(slopes.max()) * largest(values)
