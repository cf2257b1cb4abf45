"""Looks: mean power over cells of pixels, with less speckle and less resolution."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import ComplexArray
from blocksar.errors import InputError
from blocksar.texts import count

Float32Array = NDArray[np.float32]
LEAST_POWER = 1e-30  # pixels that are exactly zero have this much, -300 dB


def power_of(pixels: ComplexArray) -> Float32Array:
    """Return |pixels|^2, float32."""
    return np.asarray(pixels.real**2 + pixels.imag**2, np.float32)


def decibels(power: Float32Array) -> Float32Array:
    """Return 10 log10 of power, float32; at least -300 dB."""
    return np.asarray(10 * np.log10(np.maximum(power, np.float32(LEAST_POWER))), np.float32)


def multilook(power: Float32Array, looks: tuple[int, int]) -> Float32Array:
    """Average power over whole cells of looks[0] x looks[1] pixels.

    Fully developed speckle of a cell of n independent pixels has a relative variance of 1 / n; neighbours of an image
    that is finer than its resolution are not independent.

    Parameters
    ----------
    power : (n_y, n_x) float32
        NaN where not covered.
    looks : (int, int)
        Pixels of a cell along y and along x.

    Returns
    -------
    (n_y // looks[0], n_x // looks[1]) float32
        Means, summed in double precision; NaN where any pixel of the cell is not covered. Pixels beyond the last whole
        cell are left out.
    """
    n_y, n_x = (n // side for n, side in zip(power.shape, looks, strict=True))
    whole = power[: n_y * looks[0], : n_x * looks[1]]
    cells = whole.reshape(n_y, looks[0], n_x, looks[1])
    return np.asarray(cells.mean(axis=(1, 3), dtype=np.float64), np.float32)


def checked_looks(looks: Sequence[Any], shape: tuple[int, int]) -> tuple[int, int]:
    """Return looks that fit an image of `shape`: along y and along x.

    Raises
    ------
    InputError
        If they are no two whole numbers above zero, or the image has no two cells along an axis.
    """
    whole = all(isinstance(n, int | np.integer) and not isinstance(n, bool) and n >= 1 for n in looks)
    if len(looks) != 2 or not whole:
        raise InputError(f"looks = {looks!r}: give two whole numbers above zero, pixels along y and x, such as (4, 2)")
    for name, n, side in zip("yx", shape, looks, strict=True):
        if n < 2 * side:
            raise InputError(
                f"looks of {looks[0]} x {looks[1]} pixels (y x x) leave fewer than two cells along {name}, where the "
                f"image has {count(n, 'pixel')}; take fewer looks"
            )
    return int(looks[0]), int(looks[1])
