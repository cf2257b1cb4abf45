"""Rotation by phases and transposition of columns, against formulas in extended precision."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from samples import SINGLE, largest, noise, power_sum

from blocksar.arrays import ComplexArray
from blocksar.kernels import lanes, phase
from blocksar.kernels.fourier import Axis
from blocksar.kernels.lanes import LANES
from blocksar.kernels.phase import Phase

# -- phases -------------------------------------------------------------------------------------------------

SIZES = [1, 7, LANES - 1, LANES, LANES + 1, 1000]


def turned(values: ComplexArray, cycles: np.ndarray) -> np.ndarray:
    return values.astype(np.complex128) * np.exp(2j * np.pi * np.asarray(cycles - np.rint(cycles), np.float64))


def test_a_phase_is_the_stated_polynomial() -> None:
    given = Phase(np.array([[1.0, 2.0, 3.0], [0.0, -1.0, 0.5]]), centre=10.0, scale=4.0)
    z = (np.array([6.0, 10.0, 18.0]) - 10.0) / 4.0
    np.testing.assert_allclose(given.cycles(np.array([6.0, 10.0, 18.0])), [1 + 2 * z + 3 * z**2, -z + 0.5 * z**2])


@settings(max_examples=60, deadline=None)
@given(
    n=st.integers(1, 50),
    start=st.floats(-100, 100),
    step=st.floats(0.01, 10),
    centre=st.floats(-100, 100),
    order=st.integers(0, 9),
)
def test_a_phase_on_the_variable_of_an_axis_has_the_same_values(
    n: int, start: float, step: float, centre: float, order: int
) -> None:
    rng = np.random.default_rng(order)
    axis = Axis(start, step, n)
    scale = 1.0 + np.abs(axis.values - centre).max()
    given = Phase(rng.uniform(-1, 1, (2, order + 1)), centre=centre, scale=float(scale))
    along = given.along(axis)
    assert along.shape == (2, order + 1)
    # Shifting and scaling the powers changes only the rounding, of terms up to 2^order as large.
    np.testing.assert_allclose(
        np.asarray(power_sum(along, phase.unit(n)), np.float64),
        given.cycles(axis.values),
        rtol=0,
        atol=1e-12 * 2**order,
    )


@pytest.mark.parametrize("n", [1, 2, 7, 8])
def test_the_normalised_variable_of_an_axis(n: int) -> None:
    np.testing.assert_array_equal(phase.unit(n), (np.arange(n) - n // 2) / (n / 2))
    assert not phase.unit(n).flags.writeable


@pytest.mark.parametrize("order", [0, 1, 2, 4, 5, 9])
@pytest.mark.parametrize("n", SIZES)
def test_rotation_by_a_polynomial_of_millions_of_cycles(order: int, n: int) -> None:
    coefficients = np.random.default_rng(order).uniform(-1, 1, (5, order + 1)) * 1e7
    values = noise(5, n)
    wanted = turned(values, power_sum(coefficients, phase.unit(n)))
    found = values.copy()
    phase.rotate(found, n, coefficients)
    # Ten terms of 1e7 cycles: float64 holds their sum to about 1e-8 of a cycle.
    assert largest(found - wanted) < SINGLE * largest(values)

    # Into another, wider array: the same bits; only n samples are written, and the source does not change.
    wide, out = np.pad(values, ((0, 0), (0, 3))), np.full((5, n + 5), 7, np.complex64)
    wide.flags.writeable = coefficients.flags.writeable = False
    phase.rotate(wide, n, coefficients, out)
    np.testing.assert_array_equal(out[:, :n], found)
    assert (out[:, n:] == 7).all()

    # In place in a wider array, one row at a time: the other rows and the rest of the row do not change.
    for row in range(5):
        alone = np.full((1, n + 3), 7, np.complex64)
        alone[:, :n] = values[row]
        phase.rotate(alone, n, coefficients[row : row + 1])
        np.testing.assert_array_equal(alone[0, :n], found[row])
        assert (alone[0, n:] == 7).all()


@pytest.mark.parametrize("n", SIZES)
def test_rotation_by_a_scaled_phase_of_millions_of_cycles(n: int) -> None:
    rng = np.random.default_rng(n)
    factor, cycles = rng.uniform(0.97, 1.03, 6), rng.uniform(-1e7, 1e7, n)
    coefficients = rng.uniform(-1e6, 1e6, (6, 2))
    values = noise(6, n)
    for array in (factor, cycles, coefficients):
        array.flags.writeable = False
    found = np.full((6, n + 2), 7, np.complex64)
    phase.rotate_scaled(values, found, phase.unit(n), coefficients, factor, cycles)
    scaled = np.longdouble(factor)[:, None] * np.longdouble(cycles)
    wanted = turned(values, scaled + power_sum(coefficients, phase.unit(n)))
    assert largest(found[:, :n] - wanted) < SINGLE * largest(values)
    assert (found[:, n:] == 7).all()
    for row in range(6):
        alone = values[row : row + 1].copy()
        one = slice(row, row + 1)
        phase.rotate_scaled(alone, alone, phase.unit(n), coefficients[one], factor[one], cycles)
        np.testing.assert_array_equal(alone[0], found[row, :n])


@pytest.mark.slow
def test_sine_and_cosine_meet_their_stated_error() -> None:
    x = np.linspace(-0.5, 0.5, 20_001).astype(np.float32)
    wanted = np.exp(2j * np.pi * x.astype(np.float64))
    found = lanes.cosine(x).astype(np.float64) + 1j * lanes.sine(x)
    assert largest(found - wanted) < 4e-7
    assert np.sqrt(np.mean(np.abs(found - wanted) ** 2)) < 1.1e-7  # numpy rounds every product, the loops do not


def test_missing_samples_stay_missing_and_do_not_spread() -> None:
    values = noise(2, 100).copy()
    values[1, 40] = np.nan
    phase.rotate(values, 100, np.full((2, 3), 0.3))
    assert np.isnan(values[1, 40])
    assert np.isnan(values).sum() == 1


# -- Columns ------------------------------------------------------------------------------------------------


# -- Compilation --------------------------------------------------------------------------------------------
