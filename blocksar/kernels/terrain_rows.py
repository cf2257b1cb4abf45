"""Heights and local incidence angles for rows of pixels on a terrain; compiled.

A height is a weighted sum over 4 x 4 samples of the terrain, by taps along x and along y. The sums along x are made
once for every row of samples; those along y run over all pixels of a row.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit, types
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from blocksar.arrays import FloatArray, IntArray
from blocksar.kernels.loops import COMPILED, PART, REAL_ROW, REAL_ROWS, UNCHECKED, UNCONTRACTED, fixed, loop, record

INDICES = types.Array(types.int64, 1, "C", readonly=True)
PLANES = types.Array(types.float64, 3, "C", readonly=True)
EXACT: dict[str, Any] = {**UNCONTRACTED, **UNCHECKED}
_ARC_DEGREE = 8  # 1e-8 rad
_ARC = tuple(
    np.float32(c)
    for c in chebyshev.Chebyshev.interpolate(
        lambda c: np.where(c < 1, np.arccos(c) / np.sqrt(np.maximum(1 - c, 1e-300)), np.sqrt(2)), _ARC_DEGREE, [0, 1]
    )
    .convert(kind=np.polynomial.Polynomial, domain=[-1, 1], window=[-1, 1])
    .coef
)
_A0, _A1, _A2, _A3, _A4, _A5, _A6, _A7, _A8 = _ARC
_PI = np.float32(np.pi)


class TerrainTaps(NamedTuple):
    """Samples of a terrain, with the 4 x 4 taps of each pixel's height.

    Attributes
    ----------
    strip : (n_row, n_column) float
        Heights, m.
    columns, rows : (n_x,) and (n_y,) int
        The first samples of the columns and the rows of pixels.
    along_x, along_y : (4, n_x) and (4, n_y) float
    """

    strip: FloatArray
    columns: IntArray
    along_x: FloatArray
    rows: IntArray
    along_y: FloatArray

    @classmethod
    def of(
        cls, strip: FloatArray, columns: IntArray, along_x: FloatArray, rows: IntArray, along_y: FloatArray
    ) -> TerrainTaps:
        """Make arrays contiguous and read-only, as the loops require."""
        x, y = np.ascontiguousarray(along_x), np.ascontiguousarray(along_y)
        return cls(fixed(strip), fixed(columns), fixed(x), fixed(rows), fixed(y))


class SeenGround(NamedTuple):
    """Ground of a window, (n_y, n_x) each: heights, m, the same in float32, and local incidence angles, rad."""

    height: FloatArray
    rounded: NDArray[np.float32]
    angle: NDArray[np.float32]


TAPS = record(TerrainTaps, REAL_ROWS, INDICES, REAL_ROWS, INDICES, REAL_ROWS)
GROUND = record(SeenGround, types.float64[:, ::1], types.float32[:, ::1], types.float32[:, ::1])


@njit(**PART, **EXACT)
def _along(strip: FloatArray, columns: IntArray, taps: FloatArray, out: FloatArray) -> None:
    """Interpolate along x: out[i, k] = sum_j strip[i, columns[k] + j] taps[j, k], in the order of j."""
    for i in range(strip.shape[0]):
        for k in range(columns.size):
            c = columns[k]
            total = strip[i, c] * taps[0, k] + strip[i, c + 1] * taps[1, k]
            out[i, k] = (total + strip[i, c + 2] * taps[2, k]) + strip[i, c + 3] * taps[3, k]


@njit(**PART, **EXACT)
def _height_row(along: FloatArray, r: int, a: float, b: float, c: float, d: float, out: FloatArray) -> None:
    """Interpolate along y: out[k] = a along[r, k] + .. + d along[r + 3, k], in this order."""
    for k in range(out.size):
        out[k] = ((along[r, k] * a + along[r + 1, k] * b) + along[r + 2, k] * c) + along[r + 3, k] * d


@loop(TAPS, types.float64[:, ::1], **EXACT)
def sum_taps(taps: TerrainTaps, out: FloatArray) -> None:
    """Sum taps: out[i, k] = sum_jl strip[rows[i] + l, columns[k] + j] along_x[j, k] along_y[l, i], (n_y, n_x)."""
    strip, columns, along_x, rows, along_y = taps
    along = np.empty((strip.shape[0], columns.size))
    _along(strip, columns, along_x, along)
    for i in range(rows.size):
        _height_row(along, rows[i], along_y[0, i], along_y[1, i], along_y[2, i], along_y[3, i], out[i])


@njit(**PART, **COMPILED)
def _arc_cosine(cosine: float) -> Any:
    """Arc cosine, rad, in float32; arguments are clipped to +-1."""
    size = abs(cosine)
    left = 1.0 - size
    root = np.float32(np.sqrt(left if not left < 0.0 else 0.0))  # not NaN's
    c = np.float32(size)
    inner = _A4 + c * (_A5 + c * (_A6 + c * (_A7 + c * _A8)))
    angle = root * (_A0 + c * (_A1 + c * (_A2 + c * (_A3 + c * inner))))
    return angle if cosine >= 0.0 else _PI - angle


@loop(
    TAPS, REAL_ROWS, REAL_ROWS, REAL_ROW, REAL_ROW, PLANES, INDICES, REAL_ROW, GROUND, **COMPILED, **UNCHECKED
)  # fmt: skip
def find_surface(
    taps: TerrainTaps, rate_x: FloatArray, rate_y: FloatArray, x: FloatArray, y: FloatArray, antenna: FloatArray,
    node: IntArray, part: FloatArray, seen: SeenGround,
) -> None:  # fmt: skip
    """Compute the height of every pixel, and the angle between the terrain's normal and the line of sight.

    Parameters
    ----------
    taps : TerrainTaps
        Heights are those of `sum_taps`, to the bit.
    rate_x, rate_y : (4, n_x) and (4, n_y) float
        Taps of the derivatives, 1/m.
    x, y : (n_x,) and (n_y,) float
        m
    antenna : (3, m, n_x) float
        x, y and z of the antenna as the columns of m rows see it, m; at least two rows, linear in between.
    node, part : (n_y,)
        Which of the m rows is before each row, and the part of the way to the next.
    seen : SeenGround
        Written; NaN where a sample is.
    """
    (strip, columns, along_x, rows, along_y), (height, rounded, angle), n = taps, seen, taps.columns.size
    along, rate = np.empty((strip.shape[0], n)), np.empty((strip.shape[0], n))
    _along(strip, columns, along_x, along)
    _along(strip, columns, rate_x, rate)
    for i in range(rows.size):
        r, m, v = rows[i], node[i], part[i]
        a, b, c, d = along_y[0, i], along_y[1, i], along_y[2, i], along_y[3, i]
        e, f, g, h = rate_y[0, i], rate_y[1, i], rate_y[2, i], rate_y[3, i]
        z = height[i]
        _height_row(along, r, a, b, c, d, z)
        for k in range(n):
            slope_x = rate[r, k] * a + rate[r + 1, k] * b + rate[r + 2, k] * c + rate[r + 3, k] * d
            slope_y = along[r, k] * e + along[r + 1, k] * f + along[r + 2, k] * g + along[r + 3, k] * h
            ux = antenna[0, m, k] + v * (antenna[0, m + 1, k] - antenna[0, m, k]) - x[k]
            uy = antenna[1, m, k] + v * (antenna[1, m + 1, k] - antenna[1, m, k]) - y[i]
            uz = antenna[2, m, k] + v * (antenna[2, m + 1, k] - antenna[2, m, k]) - z[k]
            normal = 1.0 + slope_x * slope_x + slope_y * slope_y
            rounded[i, k] = z[k]
            cosine = uz - ux * slope_x - uy * slope_y
            angle[i, k] = _arc_cosine(cosine / np.sqrt(normal * (ux * ux + uy * uy + uz * uz)))
