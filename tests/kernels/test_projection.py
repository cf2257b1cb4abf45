"""The series of a pixel's range about the centre of its tile."""

from __future__ import annotations

from decimal import Decimal, getcontext

import numpy as np
import pytest

from blocksar.kernels.projection import SERIES_ERROR, series_error

getcontext().prec = 50


def left_out(distance: float, elevation: float, dx: float, dy: float) -> float:
    """Range minus the series to 14 q^4, m, of an offset from a point seen along x, in 50 digits."""
    far, x, y, ex = (Decimal(v) for v in (distance, dx, dy, np.cos(elevation)))
    g = 1 / (2 * far)
    z = ex * x + g * (x * x + y * y)
    q = g * z
    exact = (far * far + 2 * far * ex * x + x * x + y * y).sqrt() - far
    return float(exact - z * (1 - q + 2 * q**2 - 5 * q**3 + 14 * q**4))


@pytest.mark.parametrize("distance", [100.0, 3e3, 30e3, 700e3])
def test_the_series_errs_no_more_than_stated(distance: float) -> None:
    """Least margin where the offset is towards the antenna, which lies low: all terms then have one sign."""
    for share in (1e-3, 1e-2, 0.1, 0.3):
        reach = share * distance
        stated = float(series_error(reach, distance))
        angles = np.linspace(0, 2 * np.pi, 25)
        errors = [
            abs(left_out(distance, elevation, reach * np.cos(a), reach * np.sin(a)))
            for elevation in (0.0, 0.6)
            for a in angles
        ]
        assert max(errors) <= stated
        assert share == 0.3 or stated < 2 * max(errors)
    assert series_error(distance, distance) == np.inf
    assert series_error(0.0, distance) == 0


def test_the_series_reaches_over_tiles_of_usual_grids() -> None:
    """Half the diagonal of 64 x 64 pixels: of 1 m at 30 km, of 0.2 m at 3 km, of 20 m at 700 km."""
    for pixel, distance in ((1.0, 30e3), (0.2, 3e3), (20.0, 700e3)):
        assert series_error(32 * np.sqrt(2) * pixel, distance) < SERIES_ERROR
