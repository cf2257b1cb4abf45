"""Time-frequency lines against signals that are really multiplied and transformed, and series against exact algebra."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest
from numpy.polynomial import polynomial as power
from numpy.polynomial.legendre import leggauss
from reference_steps import collection

from blocksar.arrays import FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.range_series import range_series, yaw_series
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.focusing.lines import Line, RowPolynomial, focus, row_polynomial
from blocksar.kernels import fourier, rows
from blocksar.kernels.fourier import Axis

# -- phases along rows --------------------------------------------------------------------------------------


def some_phase(*, order: int = 5, seed: int = 0) -> RowPolynomial:
    rng = np.random.default_rng(seed)
    return RowPolynomial(series=rng.normal(0, 100, (4, order + 1)), near=-2000.0, far=2400.0, centre=0.3, scale=0.25)


@pytest.mark.parametrize("order", [0, 1, 2, 5])
@pytest.mark.parametrize("shape", [(), (3,), (3, 2)])
def test_derivatives_along_the_row_are_those_of_the_phase(order: int, shape: tuple[int, ...]) -> None:
    phases = some_phase(order=order)
    rng = np.random.default_rng(1)
    ranges, values = rng.uniform(-2000, 2400, shape), rng.uniform(0.1, 0.5, (*shape, 7))
    phase, slope, bend = phases.evaluate(ranges, values)
    assert phase.shape == slope.shape == bend.shape == (*shape, 7)

    def at(step: float) -> FloatArray:
        return phases.evaluate(ranges, values + step)[0]

    h = 2e-3  # s: the fourth-order differences below err by h^4 f^(5) / 30, 1e-9 of these phases
    np.testing.assert_allclose(slope, (8 * (at(h) - at(-h)) - at(2 * h) + at(-2 * h)) / (12 * h), rtol=1e-6, atol=1e-5)
    bent = (16 * (at(h) + at(-h)) - at(2 * h) - at(-2 * h) - 30 * at(0)) / (12 * h**2)
    np.testing.assert_allclose(bend, bent, rtol=1e-5, atol=1e-2)


def test_a_row_polynomial_goes_through_the_polynomials_that_it_is_made_of() -> None:
    """Each polynomial about its own centre, as its range says: also when the phase is about a common centre."""
    rng = np.random.default_rng(2)
    ranges = np.linspace(-1500.0, 1800.0, 6)
    coefficients, centres = rng.normal(0, 30, (6, 5)), rng.uniform(-40, 60, 6)
    phases = row_polynomial(coefficients, ranges=ranges, centres=centres, scale=500.0, degree=5)
    v = np.linspace(-600, 600, 13)
    wanted = [np.polyval(c[::-1], (v - centre) / 500.0) for c, centre in zip(coefficients, centres, strict=True)]
    np.testing.assert_allclose(phases.evaluate(ranges, np.tile(v, (6, 1)))[0], wanted, atol=1e-9)
    smooth = row_polynomial(coefficients[:, :1] * 0 + 3.0, ranges=ranges, centres=centres, scale=500.0, degree=9)
    np.testing.assert_allclose(smooth.evaluate(np.array(77.0), v)[0], 3.0, atol=1e-12)


# -- operations on samples move lines -----------------------------------------------------------------------

LENGTH, STEP, SIZE = 1.2, 1e-4, 12_000  # s, s, samples
NODES, WEIGHTS = leggauss(16)


def chirp(phase: FloatArray, *, middle: float, dwell: float) -> tuple[FloatArray, Line]:
    """A line over one dwell whose phase, cycles, is this polynomial in t: (polynomial, line)."""
    time = middle + dwell / 2 * NODES
    line = Line(
        time=time,
        doppler=power.polyval(time, power.polyder(phase)),
        rate=power.polyval(time, power.polyder(phase, 2)),
        phase=power.polyval(time, phase),
        range=np.zeros(16),
        stretch=np.ones(16),
        weight=dwell / 2 * WEIGHTS,
    )
    return phase, line


def envelope(time: FloatArray, *, middle: float, dwell: float) -> FloatArray:
    """No sharp ends: what a line leaves out is then of second order in one over the time-bandwidth product."""
    along = np.clip((time - middle) / dwell + 0.5, 0, 1)
    return np.sin(np.pi * along) ** 2


def value_at(signal: np.ndarray, axis: Axis, time: FloatArray) -> np.ndarray:
    """Value of a signal between its samples, from its whole spectrum: (n,)."""
    doppler = fourier.dual(axis, size=axis.size, centre=0.0)
    spectrum = rows.to_doppler(signal[None], axis, doppler)[0].astype(np.complex128)
    return np.exp(2j * np.pi * np.multiply.outer(time, doppler.values)) @ spectrum / axis.size


CHIRPS = {
    "up": (0.11, 150.0, 4000.0, 0.0),
    "down": (0.2, -300.0, -5000.0, 0.0),
    "bent": (0.7, 100.0, 3500.0, 4000.0),
}
IN_TIME = {
    "nothing": (0.0,),
    "shift": (0.3, 200.0),
    "cubic": (0.1, -50.0, 400.0, -900.0),
}
IN_DOPPLER = {
    "delay": (0.25, 0.07),
    "cubic": (0.05, 0.02, 8e-6, 2e-9),
}


@pytest.mark.parametrize("in_doppler", IN_DOPPLER)
@pytest.mark.parametrize("in_time", IN_TIME)
@pytest.mark.parametrize("kind", CHIRPS)
def test_a_chirp_through_time_and_doppler_multiplication_is_where_its_line_says(
    kind: str, in_time: str, in_doppler: str
) -> None:
    """Phase, Doppler and amplitude of the samples, and not only places: multiply, transform, multiply, transform."""
    middle, dwell = 0.1, 0.35
    time_axis = fourier.centred(0.0, STEP, SIZE)
    doppler_axis = fourier.dual(time_axis, size=SIZE, centre=0.0)
    phase, line = chirp(np.array(CHIRPS[kind]), middle=middle, dwell=dwell)
    t, f = time_axis.values, doppler_axis.values
    p, q = np.array(IN_TIME[in_time]), np.array(IN_DOPPLER[in_doppler])
    lit = envelope(t, middle=middle, dwell=dwell)
    samples = lit * np.exp(2j * np.pi * (power.polyval(t, phase) + power.polyval(t, p)))
    spectrum = rows.to_doppler(samples[None].astype(np.complex64), time_axis, doppler_axis)[0]
    turned = (spectrum * np.exp(2j * np.pi * power.polyval(f, q))).astype(np.complex64)
    signal = rows.to_time(turned[None], doppler_axis, time_axis)[0]

    def derivatives(c: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        return power.polyval(v, c), power.polyval(v, power.polyder(c)), power.polyval(v, power.polyder(c, 2))

    moved = line.multiply_time(*derivatives(p, line.time))
    moved = moved.multiply_doppler(*derivatives(q, moved.doppler))
    assert not moved.folded
    inner = slice(3, 13)
    found = value_at(signal, time_axis, moved.time)[inner]
    wanted = np.exp(2j * np.pi * moved.phase[inner])
    shape = envelope(line.time, middle=middle, dwell=dwell)[inner] / np.sqrt(moved.stretch[inner])
    # Stationary phase leaves out terms of 1 / (2 pi time-bandwidth), about 1 / 3000 here, times the envelope's bend.
    assert np.abs(np.angle(found * wanted.conj())).max() < 0.01
    np.testing.assert_allclose(np.abs(found), shape, rtol=0.01)
    h = STEP / 4
    ahead, behind = value_at(signal, time_axis, moved.time + h), value_at(signal, time_axis, moved.time - h)
    doppler = np.angle(ahead * behind.conj())[inner] / (4 * np.pi * h)
    np.testing.assert_allclose(doppler, moved.doppler[inner], atol=0.3)  # Hz, of a band of 1000
    # The traced rate is the slope of the traced line.
    slope = np.gradient(moved.doppler, moved.time, edge_order=2)
    np.testing.assert_allclose(moved.rate[inner], slope[inner], rtol=0.03)


def test_a_line_that_turns_back_in_time_is_called_folded() -> None:
    _, line = chirp(np.array([0.0, 0.0, 2000.0]), middle=0.0, dwell=0.3)
    for curvature, folded in ((1 / 4100, False), (1 / 3900, True)):
        rate = np.asarray(line.doppler * curvature)
        moved = line.multiply_doppler(line.doppler**2 * curvature / 2, rate, np.full(16, curvature))
        assert moved.folded is folded or (not folded and moved.stretch.min() > 0.02)
        assert (np.diff(moved.time) > 0).all() is not folded


def test_levelled_lines_focus_where_the_sum_over_the_dwell_peaks() -> None:
    """`focus` against the sum itself, scanned: place, phase, gain, also where a residual phase is left."""
    rng = np.random.default_rng(3)
    middle, dwell = -0.04, 0.3
    for residual in (0.0, 0.01, 0.05):  # cycles
        left = rng.normal(0, 1, 4) * residual
        phase, line = chirp(np.array([0.31, -40.0, 0.0]), middle=middle, dwell=dwell)
        z = 2 * (line.time - middle) / dwell
        curve = np.polynomial.legendre.Legendre([0.0, 0.0, *left[:2]])
        line = line.multiply_time(curve(z), curve.deriv(1)(z) * 2 / dwell, curve.deriv(2)(z) * 4 / dwell**2)
        found = focus(line)
        fine = middle + dwell * (np.arange(20_000) + 0.5) / 20_000 - dwell / 2
        signal = np.exp(2j * np.pi * (power.polyval(fine, phase) + curve(2 * (fine - middle) / dwell)))
        offsets = found.doppler + np.linspace(-0.1, 0.1, 201)
        response = np.array([np.mean(signal * np.exp(-2j * np.pi * f * fine)) for f in offsets])
        # A cubic moves the peak of the sum a little off the regression's: third order in the residual.
        assert abs(offsets[np.abs(response).argmax()] - found.doppler) < 2e-3 + 20 * residual**2
        assert abs(np.angle(response[100] * np.exp(-2j * np.pi * found.phase))) < 1e-6
        assert abs(found.gain - np.abs(response[100])) < 1e-6
        assert found.time == pytest.approx(middle, abs=1e-12)
        assert found.residual == pytest.approx(2 * np.pi * np.abs(curve(z)).max(), abs=1e-9)


# -- series of the range ------------------------------------------------------------------------------------

GEOMETRIES = {
    "table-1": collection(n_pulse=4800),
    "t = 0 off centre": collection(n_pulse=1200, middle=0.21),
    "jerk": collection(n_pulse=1200, jerk=(40.0, -60.0, 25.0), yaw_deg=-50.0),
}


@pytest.mark.parametrize("name", GEOMETRIES)
def test_the_range_series_squares_to_the_exact_squared_range(name: str) -> None:
    """R^2 is a polynomial in t: worked out in fractions from the track, against the square of the series."""
    geometry = Geometry(collection=GEOMETRIES[name])
    epoch = Fraction(geometry.epoch)
    jerk = (40, -60, 25) if name == "jerk" else (0, 0, 0)
    track = [
        [Fraction(p), Fraction(v), Fraction(a, 2), Fraction(j, 6)]
        for p, v, a, j in zip((0, 0, 16500), (-40, 1300, -600), (-15, -30, -35), jerk, strict=True)
    ]
    yaw = np.radians([44.0, 50.3, 56.0]) * (-1 if name == "jerk" else 1)
    ranges = np.array([27.6e3, 30e3, 32.4e3])
    k = range_series(geometry, ranges[:, None], yaw, order=6)
    np.testing.assert_allclose(k[..., 0], ranges[:, None] * np.ones(3), rtol=1e-13)
    point = geometry.ground_point(ranges[:, None], yaw)
    for index in np.ndindex(3, 3):
        squared = [Fraction(0)] * 7
        for axis, coefficients in enumerate(track):
            about = [Fraction(0)] * 4  # the track's polynomial about the epoch, by the binomial sum
            for n, c in enumerate(coefficients):
                for m in range(n + 1):
                    about[m] += c * epoch ** (n - m) * [[1], [1, 1], [1, 2, 1], [1, 3, 3, 1]][n][m]
            sight = [Fraction(float(point[index][axis])) - about[0], *(-c for c in about[1:])]
            for n in range(4):
                for m in range(4):
                    squared[n + m] += sight[n] * sight[m]
        # In units of t = 0.3 s every coefficient is a length: rounding of R^2 is some 1e-7 m^2.
        unit = 0.3 ** np.arange(7)
        series = np.convolve(k[index], k[index])[:7]
        np.testing.assert_allclose(series * unit, np.array([float(c) for c in squared]) * unit, atol=3e-4, rtol=1e-11)


@pytest.mark.parametrize("name", GEOMETRIES)
def test_the_range_series_is_the_range(name: str) -> None:
    case = GEOMETRIES[name]
    geometry = Geometry(collection=case)
    yaw = np.radians(-50.0 if name == "jerk" else 50.0) + np.radians([-6.0, 0.0, 6.0])
    ranges = np.array([27.6e3, 30e3, 32.4e3])[:, None]
    slow = np.linspace(case.time[0], case.time[-1], 9) - geometry.epoch
    k = range_series(geometry, ranges, yaw, order=12)
    series = power.polyval(slow, np.moveaxis(k, -1, 0))
    exact, _ = geometry.range_history(geometry.ground_point(ranges, yaw)[..., None, :], slow + geometry.epoch)
    assert np.abs(series - exact).max() < 1e-7  # m: a thousandth of a milliradian on 2 cm


def test_first_and_second_coefficients_are_those_of_mechanics() -> None:
    geometry = Geometry(collection=GEOMETRIES["table-1"])
    yaw, ranges = np.radians([44.0, 50.0, 56.0]), np.array([28e3, 30e3, 32e3])
    k = range_series(geometry, ranges, yaw, order=2)
    sight = geometry.ground_point(ranges, yaw) - [0.0, 0.0, 16500.0]
    velocity, acceleration = np.array([-40.0, 1300.0, -600.0]), np.array([-15.0, -30.0, -35.0])
    rate = -sight @ velocity / ranges
    np.testing.assert_allclose(k[:, 1], rate, rtol=1e-11)
    pull = velocity @ velocity - sight @ acceleration - rate**2
    np.testing.assert_allclose(k[:, 2], pull / (2 * ranges), rtol=1e-10)


def derivatives(function: Callable[[float], FloatArray], order: int, step: float) -> FloatArray:
    """Divided derivative f^(order) / order! by central differences on nine points: weights from a Vandermonde."""
    places = np.arange(-4, 5.0)
    weights = np.linalg.solve(np.vander(places, increasing=True).T, np.eye(9)[order])
    return sum(w * function(p * step) for w, p in zip(weights, places, strict=True)) / step**order


@pytest.mark.parametrize("name", GEOMETRIES)
def test_the_yaw_series_holds_the_yaw_derivatives(name: str) -> None:
    geometry = Geometry(collection=GEOMETRIES[name])
    yaw = np.radians(-50.0 if name == "jerk" else 50.0)
    ranges = np.array([27.6e3, 30e3, 32.4e3])
    k = yaw_series(geometry, ranges, yaw, order=4, half_width=np.radians(7.87))
    assert k.shape == (3, 5, 5)
    for m in range(5):
        direct = derivatives(lambda turn: range_series(geometry, ranges, np.array(yaw + turn), order=4), m, 0.03)
        # Differences over 0.12 rad err by their ninth order, and both by the rounding of 3e4 m.
        np.testing.assert_allclose(k[:, 1:, m], direct[:, 1:], rtol=2e-5, atol=2e-5)
    np.testing.assert_allclose(k[:, 0, 0], ranges, rtol=1e-12)
    assert np.abs(k[:, 0, 1:]).max() < 1e-5  # the epoch range does not depend on yaw: it is the coordinate


# Paper A, Figures 2 to 4, read off at the scene centre's range and the last yaw: units of pi.
FIGURES = {
    "swath": (7.87, (0.739, 0.639, 0.071, 0.0013), 0.459),
    "a third of it": (7.87 / 3, (0.009, 0.024, 0.009, 0.0001), 0.138),
}


@pytest.mark.parametrize("name", FIGURES)
def test_figures_2_to_4_of_the_angular_division_paper(name: str) -> None:
    """(3): phi_n = 4 pi / lambda [k_n - sum over m <= 4 - n of k_nm dtheta^m] (T_a / 2)^n; Figure 4: k_3 - k_30."""
    half_width, errors, variation = FIGURES[name]
    case = GEOMETRIES["table-1"]
    geometry = Geometry(collection=case)
    turn, half_aperture = np.radians(half_width), 0.6 / 2
    series = yaw_series(geometry, np.array([30e3]), np.radians(50.0), order=4, half_width=turn)[0]
    k = range_series(geometry, np.array(30e3), np.array(np.radians(50.0) + turn), order=4)
    cycles = 4 / case.wavelength
    for n, wanted in enumerate(errors, start=1):
        kept = power.polyval(turn, series[n, : 5 - n])
        phase = cycles * abs(k[n] - kept) * half_aperture**n
        assert phase == pytest.approx(wanted, abs=0.5001 * (1e-4 if n == 4 else 1e-3))
    assert cycles * abs(k[3] - series[3, 0]) * half_aperture**3 == pytest.approx(variation, abs=0.0005)
    assert case.wavelength == pytest.approx(SPEED_OF_LIGHT / 15e9)
