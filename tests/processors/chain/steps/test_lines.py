"""Time-frequency lines against signals that are multiplied and transformed, and series against exact algebra."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial import polynomial as power
from numpy.polynomial.legendre import leggauss

from blocksar import solvers
from blocksar.arrays import FloatArray
from blocksar.kernels import fourier, rows
from blocksar.kernels.fourier import Axis
from blocksar.processors.chain.steps.lines import Line, RowPolynomial, focus, row_polynomial

# -- Phases along rows --------------------------------------------------------------------------------------


def some_phase(*, order: int = 5, seed: int = 0) -> RowPolynomial:
    rng = np.random.default_rng(seed)
    return RowPolynomial(series=rng.normal(0, 100, (4, order + 1)), near=-2000.0, far=2400.0, centre=0.3, scale=0.25)


@pytest.mark.parametrize("order", [0, 1, 2, 5])
@pytest.mark.parametrize("shape", [(), (3,), (3, 2)])
def test_derivatives_along_the_row_equal_those_of_the_phase(order: int, shape: tuple[int, ...]) -> None:
    phases = some_phase(order=order)
    rng = np.random.default_rng(1)
    ranges, values = rng.uniform(-2000, 2400, shape), rng.uniform(0.1, 0.5, (*shape, 7))
    phase, slope, bend = phases.evaluate(ranges, values)
    assert phase.shape == slope.shape == bend.shape == (*shape, 7)

    def at(step: float) -> FloatArray:
        return phases.evaluate(ranges, values + step)[0]

    h = 2e-3  # s: the error of the fourth-order differences below is h^4 f^(5) / 30, 1e-9 of these phases
    np.testing.assert_allclose(slope, (8 * (at(h) - at(-h)) - at(2 * h) + at(-2 * h)) / (12 * h), rtol=1e-6, atol=1e-5)
    bent = (16 * (at(h) + at(-h)) - at(2 * h) - at(-2 * h) - 30 * at(0)) / (12 * h**2)
    np.testing.assert_allclose(bend, bent, rtol=1e-5, atol=1e-2)


def test_a_row_polynomial_passes_through_its_polynomials() -> None:
    """Each polynomial has the centre of its range, also when the phase has a common centre."""
    rng = np.random.default_rng(2)
    ranges = 150.0 + 1650.0 * solvers.end_nodes(6)
    coefficients, centres = rng.normal(0, 30, (6, 5)), rng.uniform(-40, 60, 6)
    phases = row_polynomial(coefficients, ranges=ranges, centres=centres, scale=500.0, degree=5)
    v = np.linspace(-600, 600, 13)
    wanted = [np.polyval(c[::-1], (v - centre) / 500.0) for c, centre in zip(coefficients, centres, strict=True)]
    np.testing.assert_allclose(phases.evaluate(ranges, np.tile(v, (6, 1)))[0], wanted, atol=1e-9)
    smooth = row_polynomial(coefficients[:, :1] * 0 + 3.0, ranges=ranges, centres=centres, scale=500.0, degree=9)
    np.testing.assert_allclose(smooth.evaluate(np.array(77.0), v)[0], 3.0, atol=1e-12)


# -- Lines traced through operations on samples -------------------------------------------------------------

LENGTH, STEP, SIZE = 1.2, 1e-4, 12_000  # s, s, samples
NODES, WEIGHTS = leggauss(16)


def chirp(phase: FloatArray, *, middle: float, dwell: float) -> tuple[FloatArray, Line]:
    """Return the polynomial and the line of a dwell whose phase, in cycles, is this polynomial in t."""
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
    """Smooth envelope: what a line neglects is then of second order in 1 / (time-bandwidth product)."""
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


@pytest.mark.slow
@pytest.mark.parametrize("in_doppler", IN_DOPPLER)
@pytest.mark.parametrize("in_time", IN_TIME)
@pytest.mark.parametrize("kind", CHIRPS)
def test_a_chirp_through_time_and_doppler_multiplication_follows_its_line(
    kind: str, in_time: str, in_doppler: str
) -> None:
    """Compare phase, Doppler, amplitude and place of the samples: multiply, transform, multiply, transform."""
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
    # Stationary phase neglects terms of 1 / (2 pi time-bandwidth), about 1 / 3000 here, times the envelope's curvature.
    assert np.abs(np.angle(found * wanted.conj())).max() < 0.01
    np.testing.assert_allclose(np.abs(found), shape, rtol=0.01)
    h = STEP / 4
    ahead, behind = value_at(signal, time_axis, moved.time + h), value_at(signal, time_axis, moved.time - h)
    doppler = np.angle(ahead * behind.conj())[inner] / (4 * np.pi * h)
    np.testing.assert_allclose(doppler, moved.doppler[inner], atol=0.3)  # Hz, of a band of 1000
    # The traced rate equals the slope of the traced line.
    slope = np.gradient(moved.doppler, moved.time, edge_order=2)
    np.testing.assert_allclose(moved.rate[inner], slope[inner], rtol=0.03)


def test_a_line_that_turns_back_in_time_is_folded() -> None:
    _, line = chirp(np.array([0.0, 0.0, 2000.0]), middle=0.0, dwell=0.3)
    for curvature, folded in ((1 / 4100, False), (1 / 3900, True)):
        rate = np.asarray(line.doppler * curvature)
        moved = line.multiply_doppler(line.doppler**2 * curvature / 2, rate, np.full(16, curvature))
        assert moved.folded is folded or (not folded and moved.stretch.min() > 0.02)
        assert (np.diff(moved.time) > 0).all() is not folded


@pytest.mark.slow
def test_levelled_lines_focus_where_the_sum_over_the_dwell_peaks() -> None:
    """Compare `focus` with a scan of the sum: place, phase and gain, also with a residual phase."""
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
        # A cubic moves the peak of the sum off that of the regression: third order in the residual.
        assert abs(offsets[np.abs(response).argmax()] - found.doppler) < 2e-3 + 20 * residual**2
        assert abs(np.angle(response[100] * np.exp(-2j * np.pi * found.phase))) < 1e-6
        assert abs(found.gain - np.abs(response[100])) < 1e-6
        assert found.time == pytest.approx(middle, abs=1e-12)
        assert found.residual == pytest.approx(2 * np.pi * np.abs(curve(z)).max(), abs=1e-9)
