"""Mean power of 2 x 2 pixels, or cells of power, of those that are covered; compiled."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types

from blocksar.arrays import ComplexArray
from blocksar.kernels.loops import loop
from blocksar.kernels.phase import Float32Array
from blocksar.kernels.signatures import UNCONTRACTED


def _rows(kind: Any) -> Any:
    return types.Array(kind, 2, "C", readonly=True)


def halve(values: ComplexArray | Float32Array) -> Float32Array:
    """Mean of |pixels|^2, or of power, over the covered of each 2 x 2; NaN where none is.

    Parameters
    ----------
    values : (n_y, n_x) complex64 or float32
        Pixels, or power; NaN where not covered.

    Returns
    -------
    ((n_y + 1) // 2, (n_x + 1) // 2) float32
        At the ends of odd lengths of the half that is there.
    """
    out = np.empty(((values.shape[0] + 1) // 2, (values.shape[1] + 1) // 2), np.float32)
    if np.iscomplexobj(values):
        _halve_pixels(np.ascontiguousarray(values, np.complex64), out)
    else:
        _halve_power(np.ascontiguousarray(values, np.float32), out)
    return out


@loop(_rows(types.complex64), types.float32[:, ::1], **UNCONTRACTED)
def _halve_pixels(values: ComplexArray, out: Float32Array) -> None:
    zero, one = np.float32(0), np.float32(1)
    power = np.empty((2, 2 * out.shape[1]), np.float32)
    for y in range(out.shape[0]):
        for part in range(2):
            row = 2 * y + part
            for x in range(power.shape[1]):
                power[part, x] = np.nan
            if row < values.shape[0]:
                for x in range(values.shape[1]):
                    value = values[row, x]
                    power[part, x] = value.real * value.real + value.imag * value.imag
        for x in range(out.shape[1]):
            total, count = zero, zero
            for part in range(2):
                for side in range(2):
                    each = power[part, 2 * x + side]
                    covered = not np.isnan(each)
                    total += each if covered else zero
                    count += one if covered else zero
            out[y, x] = total / count if count > zero else np.float32(np.nan)


@loop(_rows(types.float32), types.float32[:, ::1], **UNCONTRACTED)
def _halve_power(values: Float32Array, out: Float32Array) -> None:
    zero, one = np.float32(0), np.float32(1)
    n_y, n_x = values.shape
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            total, count = zero, zero
            for row in range(2 * y, min(2 * y + 2, n_y)):
                for column in range(2 * x, min(2 * x + 2, n_x)):
                    each = values[row, column]
                    covered = not np.isnan(each)
                    total += each if covered else zero
                    count += one if covered else zero
            out[y, x] = total / count if count > zero else np.float32(np.nan)
