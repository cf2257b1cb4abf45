"""Series of the range and of the yaw, against exact geometry and the figures of paper A."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from numpy.polynomial import polynomial as power
from samples import derivatives
from steps import collection

from blocksar.collection.geometry import Geometry
from blocksar.collection.range_series import range_series, yaw_series
from blocksar.constants import SPEED_OF_LIGHT

# -- Series of the range ------------------------------------------------------------------------------------

GEOMETRIES = {
    "table-1": collection(n_pulse=4800),
    "t = 0 off centre": collection(n_pulse=1200, middle=0.21),
    "jerk": collection(n_pulse=1200, jerk=(40.0, -60.0, 25.0), yaw_deg=-50.0),
}


@pytest.mark.parametrize("name", GEOMETRIES)
def test_the_range_series_squares_to_the_exact_squared_range(name: str) -> None:
    """R^2 is a polynomial in t: compute it in fractions from the track and compare it with the square of the series."""
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
            about = [Fraction(0)] * 4  # the track's polynomial about the epoch, by the binomial theorem
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
def test_the_range_series_equals_the_range(name: str) -> None:
    case = GEOMETRIES[name]
    geometry = Geometry(collection=case)
    yaw = np.radians(-50.0 if name == "jerk" else 50.0) + np.radians([-6.0, 0.0, 6.0])
    ranges = np.array([27.6e3, 30e3, 32.4e3])[:, None]
    slow = np.linspace(case.time[0], case.time[-1], 9) - geometry.epoch
    k = range_series(geometry, ranges, yaw, order=12)
    series = power.polyval(slow, np.moveaxis(k, -1, 0))
    exact, _ = geometry.range_history(geometry.ground_point(ranges, yaw)[..., None, :], slow + geometry.epoch)
    assert np.abs(series - exact).max() < 1e-7  # m: a thousandth of a milliradian at a wavelength of 2 cm


def test_the_first_two_coefficients_follow_from_velocity_and_acceleration() -> None:
    geometry = Geometry(collection=GEOMETRIES["table-1"])
    yaw, ranges = np.radians([44.0, 50.0, 56.0]), np.array([28e3, 30e3, 32e3])
    k = range_series(geometry, ranges, yaw, order=2)
    sight = geometry.ground_point(ranges, yaw) - [0.0, 0.0, 16500.0]
    velocity, acceleration = np.array([-40.0, 1300.0, -600.0]), np.array([-15.0, -30.0, -35.0])
    rate = -sight @ velocity / ranges
    np.testing.assert_allclose(k[:, 1], rate, rtol=1e-11)
    pull = velocity @ velocity - sight @ acceleration - rate**2
    np.testing.assert_allclose(k[:, 2], pull / (2 * ranges), rtol=1e-10)


@pytest.mark.parametrize("name", GEOMETRIES)
def test_the_yaw_series_contains_the_yaw_derivatives(name: str) -> None:
    geometry = Geometry(collection=GEOMETRIES[name])
    yaw = np.radians(-50.0 if name == "jerk" else 50.0)
    ranges = np.array([27.6e3, 30e3, 32.4e3])
    k = yaw_series(geometry, ranges, yaw, order=4, half_width=np.radians(7.87))
    assert k.shape == (3, 5, 5)
    for m in range(5):
        direct = derivatives(lambda turn: range_series(geometry, ranges, np.array(yaw + turn), order=4), m, 0.03)
        # Differences over 0.12 rad have a ninth-order error, and both have the rounding of 3e4 m.
        np.testing.assert_allclose(k[:, 1:, m], direct[:, 1:], rtol=2e-5, atol=2e-5)
    np.testing.assert_allclose(k[:, 0, 0], ranges, rtol=1e-12)
    assert np.abs(k[:, 0, 1:]).max() < 1e-5  # the epoch range is the coordinate and does not depend on yaw


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
