"""The transform pair against its own sums, and the compiled inner loops against numpy in double precision."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference_steps import explicit_transform
from scipy.signal.windows import kaiser

from blocksar import fourier, phase
from blocksar.fourier import Axis
from blocksar.parameters import ComplexArray, FloatArray

ROUNDING = 5e-7  # of complex64 through a transform, relative to the largest sample's scale
SINGLE = 8e-7  # a complex64 product (1.2e-7) with a float32 sine and cosine, which are good to 6.3e-7 near half a cycle


def noise(*shape: int, seed: int = 0) -> ComplexArray:
    rng = np.random.default_rng(seed)
    values = (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)
    values.flags.writeable = False
    return values


def error(found: ComplexArray, wanted: np.ndarray) -> float:
    """Largest difference over the root mean square of what is wanted."""
    return float(np.abs(found - wanted).max() / np.sqrt(np.mean(np.abs(wanted) ** 2)))


def pair(n: int, size: int, *, step: float, start: float, dual_start: float) -> tuple[Axis, Axis]:
    return Axis(start, step, n), Axis(dual_start, 1 / (size * step), size)


# -- axes ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1, 2, 7, 8])
def test_a_centred_axis_holds_its_centre_and_its_parts_are_its_own_samples(size: int) -> None:
    axis = fourier.centred(3.0, 0.25, size)
    assert axis.values[size // 2] == 3.0
    assert axis.centre == 3.0
    assert axis.extent == 0.25 * size
    np.testing.assert_allclose(axis.position(axis.values), np.arange(size), atol=1e-12)
    part = axis.part(size // 2, size - size // 2)
    np.testing.assert_allclose(part.values, axis.values[size // 2 :], rtol=0, atol=1e-12)
    assert fourier.dual(axis, size=12, centre=-1.0).step == pytest.approx(1 / 3)


def test_the_fast_length_is_the_smallest_even_one_without_large_prime_factors() -> None:
    def smooth(n: int) -> bool:
        for prime in (2, 3, 5, 7, 11):
            while n % prime == 0:
                n //= prime
        return n == 1

    for minimum in [0.3, 1, 2, 3, 26, 26.5, 97, 127.9, 128, 131, 1023, 4097.2]:
        least = next(n for n in range(2, 10_000, 2) if n >= minimum and smooth(n))
        assert fourier.fast_length(minimum) == least


# -- the transform pair -------------------------------------------------------------------------------------

SIZES = [(1, 1), (1, 5), (7, 7), (12, 15), (13, 20), (64, 64), (101, 128)]
STARTS = [(0.0, 0.0), (-0.4137, 3977.77), (123.456, -9000.1)]


@pytest.mark.parametrize("inverse", [False, True])
@pytest.mark.parametrize("starts", STARTS)
@pytest.mark.parametrize("sizes", SIZES)
def test_a_transform_is_the_sum_that_it_says(
    sizes: tuple[int, int], starts: tuple[float, float], inverse: bool
) -> None:
    source, target = pair(*sizes, step=1.25e-4, start=starts[0], dual_start=starts[1])
    x = noise(5, source.size)
    wanted = explicit_transform(x, source, target, inverse=inverse, period=target.size)
    found = fourier.transform(x, source, target, inverse=inverse)
    assert found.dtype == np.complex64
    assert error(found, wanted) < 4 * ROUNDING


@settings(max_examples=60, deadline=None)
@given(
    n=st.integers(1, 60),
    padding=st.integers(0, 40),
    step=st.floats(1e-5, 1e5),
    start=st.floats(-50, 50),
    dual_start=st.floats(-50, 50),
)
def test_forth_and_back_is_the_identity(n: int, padding: int, step: float, start: float, dual_start: float) -> None:
    """Starts in samples, any of them; the padding comes back as zeros."""
    size = n + padding
    time, doppler = pair(n, size, step=step, start=start * step, dual_start=dual_start / (size * step))
    x = noise(3, n)
    long = Axis(time.start, time.step, size)
    back = fourier.to_time(fourier.to_doppler(x, time, doppler), doppler, long)
    assert np.abs(back[:, :n] - x).max() < 4 * ROUNDING
    assert np.abs(back[:, n:]).max(initial=0.0) < 4 * ROUNDING


@pytest.mark.parametrize("inverse", [False, True])
@pytest.mark.parametrize(
    ("n", "period", "kept", "n_column"),
    [(1, 1, 1, 1), (9, 9, 9, 33), (12, 15, 4, 5), (13, 40, 40, 32), (80, 108, 61, 77)],
)
def test_a_transform_of_columns_is_padded_and_cut(n: int, period: int, kept: int, n_column: int, inverse: bool) -> None:
    source = Axis(-3.3e6, 0.625e6, n)
    target = Axis(-7.7e-7, 1 / (period * source.step), kept)
    x = noise(n, n_column)
    wanted = explicit_transform(x.T, source, target, inverse=inverse, period=period).T
    found = fourier.transform_columns(x, source, target, period, inverse=inverse)
    assert found.shape == (kept, n_column)
    assert error(found, wanted) < 4 * ROUNDING


def test_work_before_and_after_is_done_on_the_rows_that_it_is_told() -> None:
    source, target = pair(1000, 1200, step=0.01, start=-2.0, dual_start=-40.0)
    x = noise(2 * 54 + 9, 1000)  # three groups of rows, the last one short
    assert len(fourier.row_groups(x.shape[0], target.size)) == 3
    before, after = np.arange(1.0, 118.0, dtype=np.float32), np.arange(3.0, 120.0, dtype=np.float32)

    def weigh(weights: np.ndarray) -> fourier.RowWork:
        def work(rows: ComplexArray, which: slice) -> None:
            rows *= weights[which, None]

        return work

    found = fourier.transform(x, source, target, inverse=False, before=weigh(before), after=weigh(after), threads=2)
    wanted = fourier.to_doppler(x, source, target) * (before * after)[:, None]
    assert np.abs(found - wanted).max() < 4 * ROUNDING * np.abs(wanted).max()

    columns = noise(40, 77)  # three groups of columns
    axis = Axis(0.0, 1.0, 40)

    def weigh_columns(values: ComplexArray, which: slice) -> None:
        values *= before[which]

    dual = fourier.dual(axis, size=40, centre=0.0)
    found = fourier.transform_columns(columns, axis, dual, 40, inverse=True, before=weigh_columns, threads=2)
    wanted = fourier.transform_columns(columns * before[:77], axis, dual, 40, inverse=True)
    np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("inverse", [False, True])
def test_the_number_of_threads_changes_no_bit(inverse: bool) -> None:
    source, target = pair(900, 1000, step=0.01, start=-2.0, dual_start=-40.0)
    rows, columns = noise(301, 900), noise(90, 77)
    assert 301 % fourier.row_groups(301, 1000)[0].stop
    column_axis, short = Axis(-1.0, 0.1, 90), Axis(2.0, 1 / (0.1 * 100), 31)
    one = fourier.transform(rows, source, target, inverse=inverse)
    one_column = fourier.transform_columns(columns, column_axis, short, 100, inverse=inverse)
    for threads in (2, 3, 7):
        np.testing.assert_array_equal(fourier.transform(rows, source, target, inverse=inverse, threads=threads), one)
        np.testing.assert_array_equal(
            fourier.transform_columns(columns, column_axis, short, 100, inverse=inverse, threads=threads), one_column
        )


def test_inputs_are_not_written_to() -> None:
    """`noise` is read-only already; a caller's writeable array must stay as it is, too."""
    source, target = pair(64, 64, step=1.0, start=0.0, dual_start=0.0)
    x = noise(64, 64).copy()

    def spoil(values: ComplexArray, which: slice) -> None:
        values[:] = 7

    fourier.transform(x, source, target, inverse=False, before=spoil)
    fourier.transform(x, source, target, inverse=True)
    fourier.transform_columns(x, source, target, 64, inverse=True, before=spoil)
    np.testing.assert_array_equal(x, noise(64, 64))


def test_axes_that_are_no_pair_are_refused() -> None:
    x = noise(2, 8)
    axis = Axis(0.0, 1.0, 8)
    with pytest.raises(ValueError, match="no transform pair"):
        fourier.transform(x, axis, Axis(0.0, 0.1, 8), inverse=False)
    with pytest.raises(ValueError, match="no transform pair"):
        fourier.transform(x, axis, Axis(0.0, 0.25, 4), inverse=False)
    with pytest.raises(ValueError, match=r"x\.shape"):
        fourier.transform(x, Axis(0.0, 1.0, 7), Axis(0.0, 0.125, 8), inverse=False)
    with pytest.raises(ValueError, match="period"):
        fourier.transform_columns(noise(8, 2), axis, Axis(0.0, 0.125, 9), 8, inverse=False)


# -- phase multiplication -----------------------------------------------------------------------------------


def turned(values: ComplexArray, cycles: np.ndarray) -> np.ndarray:
    return values.astype(np.complex128) * np.exp(2j * np.pi * np.asarray(cycles - np.rint(cycles), np.float64))


@pytest.mark.parametrize("order", [0, 1, 4, 9])
@pytest.mark.parametrize("n", [1, 7, 1000])
def test_rotation_by_a_polynomial_of_millions_of_cycles(order: int, n: int) -> None:
    rng = np.random.default_rng(order)
    coefficients = rng.uniform(-1, 1, (5, order + 1)) * 1e7
    z = np.sort(rng.uniform(-1, 1, n))
    values = noise(5, n)
    extended = np.longdouble(z)
    cycles = sum(np.longdouble(c)[:, None] * extended**k for k, c in enumerate(coefficients.T))
    found = values.copy()
    phase.rotate_polynomial(found, coefficients, z)
    # Ten terms of 1e7 cycles: float64 holds their sum to some 1e-8 of a cycle.
    assert np.abs(found - turned(values, cycles)).max() < SINGLE * np.abs(values).max()


def test_a_polynomial_of_too_high_an_order_is_refused() -> None:
    with pytest.raises(ValueError, match="order 10"):
        phase.rotate_polynomial(noise(1, 4).copy(), np.zeros((1, 11)), np.zeros(4))


@pytest.mark.parametrize("n", [1, 9, 1001])
def test_rotation_by_an_outer_product_of_millions_of_cycles(n: int) -> None:
    rng = np.random.default_rng(n)
    factor, cycles = rng.uniform(0.97, 1.03, 6), rng.uniform(-1e7, 1e7, n)
    values = noise(6, n)
    found = values.copy()
    phase.rotate_outer(found, factor, cycles)
    wanted = turned(values, np.longdouble(factor)[:, None] * np.longdouble(cycles))
    assert np.abs(found - wanted).max() < SINGLE * np.abs(values).max()


def test_rotation_at_whole_half_and_quarter_cycles() -> None:
    cycles = np.arange(-8, 9) / 4
    values = np.ones((1, cycles.size), np.complex64)
    phase.rotate_outer(values, np.ones(1), cycles)
    assert np.abs(values[0] - np.array([1, 1j, -1, -1j] * 4 + [1])).max() < SINGLE


# -- interpolation ------------------------------------------------------------------------------------------


def interpolated(taps: np.ndarray, f: FloatArray) -> np.ndarray:
    """What taps (n_fraction, n_tap) make of exp(2j pi f n): (n_fraction, n_f)."""
    k = np.arange(taps.shape[1]) - (taps.shape[1] // 2 - 1)
    return taps @ np.exp(2j * np.pi * np.multiply.outer(k, f))


@pytest.mark.parametrize(("n_tap", "occupancy"), [(4, 0.3), (8, 0.7), (12, 0.7), (16, 0.8), (20, 0.8)])
def test_taps_err_as_little_as_they_say_and_no_others_err_less(n_tap: int, occupancy: float) -> None:
    nodes, share = np.polynomial.legendre.leggauss(200)
    f = occupancy / 2 * nodes
    fraction = np.arange(257) / 256
    exact = np.exp(2j * np.pi * np.multiply.outer(fraction, f))
    taps = phase.interpolation_taps(n_tap, occupancy=occupancy)
    assert taps.dtype == np.float32

    def worst(weights: np.ndarray) -> FloatArray:
        wanted = exact if weights.shape[0] == 257 else exact[::64]
        return np.sqrt(np.abs(interpolated(weights, f) - wanted) ** 2 @ share / 2)

    found = worst(taps)
    told = phase.interpolation_error(n_tap, occupancy)
    # What is told counts the band's edges, where the error is largest, a little too much: on the safe side.
    assert 0.7 * told - 1e-7 < found.max() < 1.01 * told + 1e-7
    # A sample's own place is nobody else's business, at either end of the table.
    assert found[[0, -1]].max() < 0.3 * told + 3e-7

    # Slow twin: the same least squares over sampled frequencies instead of sinc integrals.
    k = np.arange(n_tap) - (n_tap // 2 - 1)
    tones = np.exp(2j * np.pi * np.multiply.outer(f, k)) * np.sqrt(share / 2)[:, None]
    aims = exact[::64].T * np.sqrt(share / 2)[:, None]
    best = np.linalg.lstsq(np.vstack([tones.real, tones.imag]), np.vstack([aims.real, aims.imag]), rcond=1e-14)[0].T
    np.testing.assert_allclose(worst(taps[::64]), worst(best), rtol=1e-3, atol=2e-7)
    # Any windowed sinc is one more candidate; the best Kaiser window comes within a few per cent at high occupancy.
    distance = fraction[::64, None] - k
    for beta in np.linspace(0, 12, 25):
        window = np.interp(np.abs(distance) / (n_tap / 2), np.linspace(0, 1, 501), kaiser(1001, beta)[500:])
        assert worst(best).max() <= worst(np.sinc(distance) * window).max()


def test_no_fewer_taps_would_do() -> None:
    for occupancy in (0.3, 0.62, 0.8):
        for wanted in (1e-2, 1e-3, 1e-4):
            n_tap = phase.taps_needed(occupancy, error=wanted)
            assert phase.interpolation_error(n_tap, occupancy) <= wanted
            assert n_tap == 4 or phase.interpolation_error(n_tap - 2, occupancy) > wanted
    assert phase.taps_needed(0.99, error=1e-6, at_most=24) == 24


SCALES = [0.97, 0.999, 0.99993, 1.0, 1.00001, 1.001, 1.03]


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize(("n", "middle"), [(2000, 1000.0), (1201, 600.0), (777, 300.37), (600, -200.0), (600, 900.5)])
def test_stretched_rows_are_the_exact_signal_elsewhere(scale: float, n: int, middle: float) -> None:
    """A signal of 200 tones over 0.7 of the band is known at any place between samples."""
    rng = np.random.default_rng(n)
    f = rng.uniform(-0.35, 0.35, 200)
    tones = np.exp(2j * np.pi * rng.uniform(0, 1, (2, 200))) / np.sqrt(200)

    def signal(position: FloatArray) -> np.ndarray:
        return tones @ np.exp(2j * np.pi * np.multiply.outer(f, position))

    n_tap = 16
    taps = phase.interpolation_taps(n_tap, occupancy=0.7)
    values = signal(np.arange(n)).astype(np.complex64)
    values.flags.writeable = False
    scales = np.array([scale, 2 - scale])
    found = np.full((2, n), np.nan, np.complex64)
    phase.stretch_rows(values, found, scales, middle, taps)
    for row in range(2):
        position = middle + (np.arange(n) - middle) * scales[row]
        inside = (position >= n_tap / 2 - 1) & (position <= n - n_tap / 2 - 1)
        outside = (position < -n_tap / 2) | (position > n - 1 + n_tap / 2)
        # Sixteen taps err by 1e-5 here, weights drawn out straight over a strip by up to 7e-5.
        assert np.sqrt(np.mean(np.abs(found[row] - signal(position)[row])[inside] ** 2)) < 2e-4
        assert np.abs(found[row] - signal(position)[row])[inside].max() < 8e-4
        assert (found[row, outside] == 0).all()
        padded = np.abs(found[row, ~inside & ~outside])
        assert np.isfinite(padded).all() and padded.max(initial=0.0) < 1.5 * np.abs(values).max()


@settings(max_examples=60, deadline=None)
@given(
    n=st.integers(1, 700), middle=st.floats(-300, 1000), scale=st.floats(0.9, 1.1), n_tap=st.sampled_from([2, 4, 10])
)
def test_stretched_rows_are_weighted_sums_of_the_nearest_samples(
    n: int, middle: float, scale: float, n_tap: int
) -> None:
    """Against taps taken one output at a time, zeros beyond the ends; any length, any fixed point."""
    values = noise(1, n, seed=n)
    taps = phase.interpolation_taps(n_tap, occupancy=0.6)
    found = np.full((1, n), np.nan, np.complex64)
    phase.stretch_rows(values, found, np.array([scale]), middle, taps)
    padded = np.concatenate([np.zeros(2000), values[0], np.zeros(2000)])
    wanted = np.zeros(n, np.complex128)
    for i in range(n):
        position = middle + (i - middle) * scale
        whole = int(np.floor(position))
        weights = [np.interp((position - whole) * 256, np.arange(257), column) for column in taps.T]
        first = whole - (n_tap // 2 - 1) + 2000
        wanted[i] = padded[first : first + n_tap] @ np.array(weights)
    # Weights change linearly over a strip in which the fraction drifts by 1/64 of a sample.
    assert np.abs(found[0] - wanted).max() < 3e-4 * np.abs(values).max() * np.sqrt(n_tap)
