"""Filters that decimate rows and columns, against plain convolutions in double precision."""

from __future__ import annotations

import numpy as np
import pytest

from blocksar.arrays import ComplexArray
from blocksar.kernels.decimation import WHOLE, Decimation, add_decimated, padded, turn_and_decimate

FILTERS = [Decimation(1, 0.0, 70.0), Decimation(2, 0.42, 70.0), Decimation(3, 0.38, 50.0), Decimation(5, 0.2, 90.0)]


def samples(*shape: int) -> ComplexArray:
    generator = np.random.default_rng(sum(shape))
    return (generator.standard_normal(shape) + 1j * generator.standard_normal(shape)).astype(np.complex64)


def decimated(row: ComplexArray, filters: Decimation, at: int, size: int) -> ComplexArray:
    """The filtered row at the places at, at + factor, ...; zero beyond its tails."""
    taps = np.asarray(filters.taps, np.float64) if filters.factor > 1 else np.ones(1)
    full = np.convolve(row, taps)  # begins `half` before the row
    places = at + filters.factor * np.arange(size) + filters.half
    inside = (places >= 0) & (places < full.size)
    return np.where(inside, full[np.clip(places, 0, full.size - 1)], 0)


@pytest.mark.parametrize("filters", FILTERS, ids=str)
@pytest.mark.parametrize("n", [7, 64, 403])
def test_rows_are_turned_and_decimated(filters: Decimation, n: int) -> None:
    values, source = samples(5, n), np.array([4, 0, 1, 1, 2, 3])
    first, step = np.linspace(-1e6, 1e6, 6), np.linspace(-0.3, 0.3, 6)
    count, start = filters.span(n)
    out, others = (np.zeros((rows, padded(count)), np.complex64) for rows in (2, 6))
    turn_and_decimate(values, source, first, step, filters, np.array([-1, -1, 1, -1, 0, -1]), out, others)
    found = np.stack([others[0], others[1], out[1], others[3], out[0], others[5]])
    turned = values[source] * np.exp(2j * np.pi * ((first % 1)[:, None] + np.outer(step, np.arange(n))))
    wanted = [decimated(row, filters, start, found.shape[1]) for row in turned]
    assert found.shape[1] % WHOLE == 0
    assert start + filters.factor * count > n - 1 + filters.half  # all of the tail
    assert np.abs(found - wanted).max() < 3e-6 * np.abs(wanted).max()  # float32


@pytest.mark.parametrize("filters", FILTERS, ids=str)
@pytest.mark.parametrize("columns", [8, 72])
def test_rows_come_in_runs(filters: Decimation, columns: int) -> None:
    """In three, before which and behind which stand others; what becomes of them stands amid other rows."""
    values, ends = samples(100, columns), np.array([0, 1, 40, 100])
    size, at = filters.span(100)
    rows = np.concatenate([samples(3, columns), values[40:], values[:40], samples(2, columns)])
    out = np.ones((size + 7, columns), np.complex64)
    runs = [
        [[63, 64, 3][k], n, 4, at - first, size]
        for k, (first, n) in enumerate(zip(ends[:-1], np.diff(ends), strict=True))
    ]
    add_decimated(rows, np.array(runs), filters, out)
    wanted = np.transpose([decimated(column, filters, at, size) for column in values.T])
    assert np.abs(out[4 : 4 + size] - 1 - wanted).max() < 3e-6 * np.abs(wanted).max()
    assert (out[:4] == 1).all() and (out[4 + size :] == 1).all()


@pytest.mark.parametrize("attenuation", [40.0, 60.0, 80.0])
@pytest.mark.parametrize("edge", [0.25, 0.4])
def test_filters_pass_and_stop_as_they_should(attenuation: float, edge: float) -> None:
    filters = Decimation(4, edge, attenuation)
    nu = np.linspace(0, 0.5, 4001)
    turns = np.exp(-2j * np.pi * np.outer(nu, np.arange(-filters.half, filters.half + 1)))
    response = np.abs(turns @ filters.taps.astype(np.float64)) / filters.factor
    error = 10 ** (-(attenuation - 8) / 20)  # Kaiser's formula is right to some dB
    assert np.abs(response[nu <= edge / 4] - 1).max() < error
    assert response[nu >= (1 - edge) / 4].max() < error
