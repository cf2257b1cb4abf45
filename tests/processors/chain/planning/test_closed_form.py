"""Closed forms of the coefficients, for a squinted straight track."""

from __future__ import annotations

import numpy as np
import pytest
from steps import sampling
from straight_track import CARRIER, COS, LAMBDA, SIN, SPEED, history, levelled, straight_lines, straight_series

from blocksar import solvers
from blocksar.arrays import FloatArray
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.kernels import fourier
from blocksar.processors.chain.planning import coefficients
from blocksar.processors.chain.steps.lines import focus
from blocksar.processors.chain.steps.range_steps import DopplerCompression

# ---------------------------------------------------------------- Closed forms


def test_high_order_phase_of_the_straight_track() -> None:
    """The general form, applied to the squinted hyperbola, equals paper C's in R', v and theta_0."""
    cell = 15e3
    found = coefficients.corrected(straight_series(cell), wavelength=LAMBDA)
    wanted = -cell * LAMBDA**2 * SIN / (12 * SPEED**3 * COS**4)
    assert found.doppler[0, 3] == pytest.approx(wanted, rel=1e-6)
    wanted = -cell * LAMBDA**3 * (3 + 7 * SIN**2) / (192 * SPEED**4 * COS**6)
    assert found.doppler[0, 4] == pytest.approx(wanted, rel=1e-5)
    assert found.deramp[0, 2] == pytest.approx(SPEED**2 * COS**2 / (LAMBDA * cell), rel=1e-9)
    assert found.deramp[0, 3] == pytest.approx(SPEED**3 * SIN * COS**2 / (3 * LAMBDA * cell**2), rel=1e-6)
    # The cubic term equals that of paper A's (30), in any azimuth coordinate.
    printed = coefficients.printed(straight_series(cell), wavelength=LAMBDA)
    assert printed.doppler[0, 3] == pytest.approx(found.doppler[0, 3], rel=1e-6)


@pytest.mark.parametrize(("kind", "order"), [("corrected", 3), ("resampled", 3), ("deramped", 1)])
def test_the_residual_of_a_closed_form_decreases_with_its_order(kind: str, order: int) -> None:
    """The residual Doppler rate grows as place^order: at half the distance it is smaller by 2^order."""
    k = straight_series(15e3)
    settings = {"half_dwell": 1.0} if kind == "resampled" else {}
    found = getattr(coefficients, kind)(k, wavelength=LAMBDA, **settings)
    for side in (-1.0, 1.0):
        line = levelled(straight_lines(15e3, side * np.array([100.0, 200.0, 400.0]), dwell=2e-3), found)
        slope = np.abs(np.ptp(line.doppler, axis=1) / np.ptp(line.time, axis=1))
        assert (slope[1:] > 0.75 * 2**order * slope[:-1]).all(), (kind, slope)


def test_closed_forms_level_lines_that_a_deramp_does_not_level() -> None:
    """Largest phase error over a dwell of 2 s, for targets within 300 m: rad."""
    k, line = straight_series(15e3), straight_lines(15e3, np.linspace(-300, 300, 7))
    left = {
        "deramped": coefficients.deramped(k, wavelength=LAMBDA),
        "printed": coefficients.printed(k, wavelength=LAMBDA),
        "corrected": coefficients.corrected(k, wavelength=LAMBDA),
        "resampled": coefficients.resampled(k, wavelength=LAMBDA, half_dwell=1.0),
    }
    errors = {name: float(focus(levelled(line, found)).residual.max()) for name, found in left.items()}
    assert errors["deramped"] > 10
    assert errors["printed"] < 0.5
    assert errors["corrected"] < 0.2
    assert errors["resampled"] < 0.2


def test_without_variation_there_is_no_perturbation() -> None:
    """At broadside r1 = 0: the time perturbation would be infinite, and is omitted."""
    k = np.zeros((1, 5, 5))
    k[0, 0, 0], k[0, 1, 1], k[0, 2, 0] = 15e3, -300.0, 3.0
    found = coefficients.resampled(k, wavelength=LAMBDA, half_dwell=1.0)
    assert not found.time.any() and not found.resampling.any()
    assert found.deramp[0, 2] == pytest.approx(2 * 3.0 / LAMBDA)


# ---------------------------------------------------------------- Range curvature in the 2-D frequency domain


def phi(order: int, doppler: FloatArray) -> FloatArray:
    """Phi_0, Phi_1, Phi_2 of paper C (4), as derived in `DopplerCompression`."""
    g = doppler / (2 * SPEED) + SIN * CARRIER / SPEED_OF_LIGHT
    root = np.sqrt((CARRIER / SPEED_OF_LIGHT) ** 2 - g**2)
    if order == 1:
        return (CARRIER / SPEED_OF_LIGHT - g * SIN) / (SPEED_OF_LIGHT * root)
    return root if order == 0 else -(doppler**2) / (8 * SPEED**2 * SPEED_OF_LIGHT**2 * root**3)


def spectrum_phase(frequency: float, doppler: float, crossing_range: float, place: float) -> float:
    """Phase in cycles of the transform of exact samples at one range frequency and Doppler, under a smooth window."""
    time = (np.arange(1 << 15) - (1 << 14)) / 3000.0
    window = np.exp(-(((time - place / SPEED) / 3.0) ** 8))
    cycles = -2 * (CARRIER + frequency) / SPEED_OF_LIGHT * history(time, np.array(crossing_range), np.array(place))
    cycles -= doppler * time
    return float(np.angle((window * fourier.unit_phasor(cycles)).sum()) / (2 * np.pi)) + 1 / 8


@pytest.mark.parametrize("frequency", [-75e6, 75e6])
@pytest.mark.parametrize("place", [-400.0, 0.0, 300.0])
def test_the_spectrum_of_paper_c_equals_that_of_exact_samples(frequency: float, place: float) -> None:
    crossing_range = 15e3
    for doppler in (-120.0, -40.0, 0.0, 55.0, 120.0):
        series = sum(phi(n, np.array(doppler)) * frequency**n for n in range(3))
        wanted = -2 * place * SIN * frequency / SPEED_OF_LIGHT - 2 * crossing_range * COS * series
        wanted -= 2 * crossing_range * SIN**2 / SPEED_OF_LIGHT * frequency
        wanted -= (doppler + 2 * SPEED * SIN / LAMBDA) * (crossing_range * SIN + place) / SPEED
        error = spectrum_phase(frequency, doppler, crossing_range, place) - wanted
        assert abs(error - np.rint(error)) * 2 * np.pi < 0.05, (doppler, error)


def test_on_a_straight_track_the_correction_equals_that_of_paper_c() -> None:
    """For the hyperbola: the conjugate of Phi_1's change with Doppler and of Phi_2, to second order in f."""
    crossing_range, half = 15e3, 400.0
    doppler = fourier.centred(0.0, 2.0, 400)
    frequency = fourier.centred(0.0, 5e6, 64)
    f = np.linspace(-half, half, 200)
    root = phi(0, f)
    pace = -crossing_range * COS * (CARRIER / SPEED_OF_LIGHT) ** 2 / (2 * SPEED**2 * root**3)  # dt/df = R0 A'(f)
    fitted = solvers.least_squares((f / half) ** np.arange(7)[:, None], pace)
    step = DopplerCompression(
        carrier=CARRIER, pace=fitted, half=half,
        sampling=sampling(
            doppler=doppler, range_frequency=frequency, rows=fourier.dual(frequency, size=64, centre=0.0)
        ),
    )  # fmt: skip
    found = step.correction().cycles(frequency.values)
    curvature = phi(1, doppler.values) - phi(1, np.zeros(1))
    coupling = phi(2, doppler.values)
    wanted = curvature[:, None] * frequency.values + coupling[:, None] * frequency.values**2
    inside = np.abs(doppler.values) < half
    difference = (found - 2 * crossing_range * COS * wanted)[inside]
    assert np.abs(difference).max() < 2e-3
    assert np.abs(2 * crossing_range * COS * coupling[:, None] * frequency.values**2).max() > 20e-3  # includes SRC
    # The shift in range, as traced lines have it.
    moved = -SPEED_OF_LIGHT * crossing_range * COS * curvature
    np.testing.assert_allclose(step.curvature(doppler.values)[inside], -moved[inside], atol=2e-3)
