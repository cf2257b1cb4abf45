"""Mean power of the covered pixels, or cells, in each 2 x 2; compiled."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types

from blocksar.arrays import ComplexArray
from blocksar.kernels.loops import UNCHECKED, UNCONTRACTED, loop
from blocksar.kernels.phase import Float32Array


def _rows(kind: Any) -> Any:
    return types.Array(kind, 2, "C", readonly=True)


def halve(values: ComplexArray | Float32Array) -> Float32Array:
    """Average |pixels|^2, or power, over the covered pixels of each 2 x 2; NaN where none is.

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


@loop(_rows(types.complex64), types.float32[:, ::1], **UNCONTRACTED, **UNCHECKED)
def _halve_pixels(values: ComplexArray, out: Float32Array) -> None:
    n_y, n_x = values.shape
    total, count = np.empty(2 * out.shape[1], np.float32), np.empty(2 * out.shape[1], np.float32)
    for y in range(out.shape[0]):
        total[:] = 0
        count[:] = 0
        for row in range(2 * y, min(2 * y + 2, n_y)):
            for x in range(n_x):
                value = values[row, x]
                power = value.real * value.real + value.imag * value.imag
                covered = not np.isnan(power)
                total[x] += power if covered else np.float32(0)
                count[x] += np.float32(1) if covered else np.float32(0)
        for x in range(out.shape[1]):
            # 0 / 0 is NaN: none is covered.
            out[y, x] = (total[2 * x] + total[2 * x + 1]) / (count[2 * x] + count[2 * x + 1])


@loop(_rows(types.float32), types.float32[:, ::1], **UNCONTRACTED, **UNCHECKED)
def _halve_power(values: Float32Array, out: Float32Array) -> None:
    n_y, n_x = values.shape
    total, count = np.empty(2 * out.shape[1], np.float32), np.empty(2 * out.shape[1], np.float32)
    for y in range(out.shape[0]):
        total[:] = 0
        count[:] = 0
        for row in range(2 * y, min(2 * y + 2, n_y)):
            for x in range(n_x):
                power = values[row, x]
                covered = not np.isnan(power)
                total[x] += power if covered else np.float32(0)
                count[x] += np.float32(1) if covered else np.float32(0)
        for x in range(out.shape[1]):
            out[y, x] = (total[2 * x] + total[2 * x + 1]) / (count[2 * x] + count[2 * x + 1])
