"""Vectors of lanes: fixed point, samples at computed indices, and choices by lane."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from blocksar.kernels import lanes
from blocksar.kernels.lanes import FEW, FIXED_POINT, FIXED_RANGE, NEAR, load_few, store


@njit
def fixed(values: Any, nearest: Any, middle: Any, below: Any) -> None:
    number = load_few(values, 0) + FIXED_POINT
    store(nearest, 0, lanes.from_whole(number))
    store(middle, 0, lanes.from_half(number))
    store(below, 0, lanes.whole(number))


@njit
def triples(samples: Any, origin: Any, index: Any, parts: Any) -> None:
    found = lanes.load_triples(samples, origin, index, FEW)
    for k in range(6):
        store(parts[k], 0, found[k])


@njit
def near(samples: Any, origin: Any, offset: Any, parts: Any) -> None:
    found = lanes.load_near(samples, origin, load_few(offset, 0))
    for k in range(6):
        store(parts[k], 0, found[k])


@njit
def rounded(values: Any, number: Any, left: Any) -> None:
    n, rest = lanes.nearest(lanes.single(load_few(values, 0)))
    store(number, 0, n)
    store(left, 0, rest)


@njit
def chosen(a: Any, b: Any, begin: Any, number: Any, end: Any, out: Any) -> None:
    u, v = load_few(a, 0), load_few(b, 0)
    store(out[0], 0, lanes.smaller(u, v))
    store(out[1], 0, lanes.larger(u, 0.25))
    store(out[2], 0, lanes.square_root(v))
    store(out[3], 0, lanes.within(u, load_few(begin, 0), number, load_few(end, 0)))


def test_fixed_point_splits_numbers_of_either_sign() -> None:
    rng = np.random.default_rng(0)
    ends = [0.0, 0.5, -0.5, 1 - 2.0**-31, -1.0, FIXED_RANGE - 1, -FIXED_RANGE]
    for scale in (1.0, 1e3, FIXED_RANGE - 1):
        values = np.concatenate([ends, rng.uniform(-scale, scale, FEW - len(ends))])
        nearest, middle = np.empty((2, FEW), np.float32)
        below = np.empty(FEW, np.int32)
        fixed(values, nearest, middle, below)
        np.testing.assert_array_equal(below, np.floor(values))
        assert np.abs(middle - (values - np.floor(values) - 0.5)).max() < 1e-7
        assert np.abs(nearest).max() <= 0.5
        away = values - nearest
        assert np.abs(away - np.rint(away)).max() < 1e-7


def test_three_samples_are_loaded_about_each_of_many_places() -> None:
    rng = np.random.default_rng(1)
    samples = rng.standard_normal(200, np.float32).view(np.complex64)
    index = rng.integers(-48, 48, 2 * FEW).astype(np.int32)
    index[FEW : FEW + 2] = -48, 48  # the first and the last that the four elements of each place allow
    parts = np.empty((6, FEW), np.float32)
    triples(samples.view(np.float64), 50, index, parts)
    expected = samples[50 + index[FEW:] + np.array([[-1], [0], [1]])]
    np.testing.assert_array_equal(parts[:3] + 1j * parts[3:], expected)


def test_three_samples_are_loaded_about_each_of_near_places() -> None:
    rng = np.random.default_rng(2)
    samples = rng.standard_normal(4 * FEW, np.float32).view(np.complex64)
    for _ in range(20):
        offset = rng.integers(NEAR[0], NEAR[1] + 1, FEW).astype(np.int32)
        offset[rng.permutation(FEW)[:2]] = NEAR
        parts = np.empty((6, FEW), np.float32)
        near(samples.view(np.float64), FEW, offset, parts)  # the samples are all that may be loaded
        expected = samples[FEW + offset + np.array([[-1], [0], [1]])]
        np.testing.assert_array_equal(parts[:3] + 1j * parts[3:], expected)


def test_numbers_are_rounded_to_whole_ones() -> None:
    values = np.random.default_rng(3).uniform(-1000, 1000, FEW)
    values[:5] = 0.0, 0.4, -0.4, 4e6, -4e6
    number, left = np.empty(FEW, np.int32), np.empty(FEW, np.float32)
    rounded(values, number, left)
    np.testing.assert_array_equal(number, np.rint(values.astype(np.float32)))
    np.testing.assert_array_equal(left, values.astype(np.float32) - number)


def test_choices_are_made_lane_by_lane() -> None:
    rng = np.random.default_rng(2)
    a, b = rng.uniform(0, 1, (2, FEW))
    begin, end = np.sort(rng.integers(-3, 9, (2, FEW)).astype(np.int32), axis=0)
    out = np.empty((4, FEW))
    chosen(a, b, begin, 4, end, out)
    expected = [np.minimum(a, b), np.maximum(a, 0.25), np.sqrt(b), np.where((begin <= 4) & (end > 4), a, 0)]
    np.testing.assert_array_equal(out, expected)
