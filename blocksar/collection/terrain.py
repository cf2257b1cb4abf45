"""The height of the ground: samples on a grid of the scene frame, and the height between them.

All heights of the ground, from simulation to products, come from a `Terrain`. It interpolates by cubic convolution
(Keys, IEEE Trans. ASSP 29(6), 1981), which is smooth to its first derivative and exact for a paraboloid. The arithmetic
is the same for scattered points and for grids, and for a terrain and its windows, so that the same point has the same
height everywhere, to the bit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from blocksar.arrays import BoolArray, FloatArray, IntArray
from blocksar.errors import InputError

MARGIN = 3  # samples that a window keeps beyond the points that it is for
LEAST = 4  # samples along each axis


# First of four samples at each place of an axis, their weights, and whether the place is inside.
Taps = tuple[IntArray, list[FloatArray], BoolArray]


@dataclass(frozen=True, kw_only=True, eq=False)
class Terrain:
    """Heights of the ground on a regular grid of the scene frame.

    Attributes
    ----------
    x0, y0 : float
        Of the first column and row of the whole terrain, m.
    dx, dy : float
        Steps, m, above 0.
    heights : (n_y, n_x) float64
        z in the scene frame, m; NaN where unknown.
    row, column : int
        Of the first sample, counted in the whole terrain: not 0 in a window of it.
    refined : int
        Samples to one of what the terrain was made of, along each axis, see `thinned`.
    remarks : tuple of str
        Sentences about what its file may not mean.

    Raises
    ------
    InputError
        If the steps are not above 0, or there are too few samples.
    """

    x0: float
    dx: float
    y0: float
    dy: float
    heights: FloatArray
    row: int = 0
    column: int = 0
    refined: int = 1
    remarks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not (self.dx > 0 and self.dy > 0 and np.isfinite([self.x0, self.dx, self.y0, self.dy]).all()):
            raise InputError(
                f"terrain: x and y need finite, ascending, uniform steps, got {self.dx:g} and {self.dy:g} m"
            )
        if self.heights.ndim != 2 or min(self.heights.shape) < LEAST:
            raise InputError(
                f"terrain: {' x '.join(map(str, self.heights.shape))} heights (y, x) are too few; give at least "
                f"{LEAST} x {LEAST}, on a grid that reaches beyond the image"
            )

    @classmethod
    def flat(cls, height: float, x: tuple[float, float], y: tuple[float, float]) -> Terrain:
        """A level terrain that covers a box."""
        step = max(x[1] - x[0], y[1] - y[0]) / 2
        return cls(x0=x[0] - step, dx=step, y0=y[0] - step, dy=step, heights=np.full((5, 5), height))

    @property
    def x(self) -> FloatArray:
        """Positions of the columns, m."""
        return np.asarray(self.x0 + self.dx * (self.column + np.arange(self.heights.shape[1])))

    @property
    def y(self) -> FloatArray:
        """Positions of the rows, m."""
        return np.asarray(self.y0 + self.dy * (self.row + np.arange(self.heights.shape[0])))

    @cached_property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest known sample, m; NaN if none is known."""
        known = self.heights[np.isfinite(self.heights)]
        return (float(known.min()), float(known.max())) if known.size else (np.nan, np.nan)

    @cached_property
    def mean(self) -> float:
        """Mean of the known samples, m."""
        known = np.isfinite(self.heights)
        return float(self.heights[known].mean()) if known.any() else np.nan

    def __call__(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Heights z (...), m, of points x, y (m), broadcast; NaN outside, and where a sample is unknown."""
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        columns, along_x, inside_x = self._taps((x - self.x0) / self.dx, self.column, self.heights.shape[1])
        rows, along_y, inside_y = self._taps((y - self.y0) / self.dy, self.row, self.heights.shape[0])
        total = np.zeros(x.shape)
        for j in range(4):
            along = np.zeros(x.shape)
            for i in range(4):
                along = along + self.heights[rows + j, columns + i] * along_x[i]
            total = total + along * along_y[j]
        return np.where(inside_x & inside_y, total, np.nan)

    def on_grid(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Heights (n_y, n_x), m, at columns x (n_x,) and rows y (n_y,), m: bit-identical to `__call__`."""
        return self._sum(*self.taps_of(x, y))

    def taps_of(self, x: FloatArray, y: FloatArray) -> tuple[Taps, Taps]:
        """The samples and weights whose sums are the heights at columns x (n_x,) and rows y (n_y,), m."""
        in_x = self._taps((x - self.x0) / self.dx, self.column, self.heights.shape[1])
        return in_x, self._taps((y - self.y0) / self.dy, self.row, self.heights.shape[0])

    def rates_of(self, x: FloatArray, y: FloatArray, taps: tuple[Taps, Taps]) -> tuple[Taps, Taps]:
        """Tap weights whose sums are derivatives, per sample, with `taps` of the other direction, as in `taps_of`."""
        in_x, in_y = taps
        up_x = self._rates((x - self.x0) / self.dx, self.column, in_x)
        return up_x, self._rates((y - self.y0) / self.dy, self.row, in_y)

    def _sum(self, in_x: Taps, in_y: Taps) -> FloatArray:
        """Weighted sums of the heights by the taps of columns (n_x,) and rows (n_y,): (n_y, n_x)."""
        (columns, along_x, inside_x), (rows, along_y, inside_y) = in_x, in_y
        first, last = int(rows.min()), int(rows.max()) + 4
        strip = self.heights[first:last]
        along, part = np.zeros((strip.shape[0], columns.size)), np.empty((strip.shape[0], columns.size))
        for i in range(4):
            np.multiply(np.take(strip, columns + i, axis=1, out=part, mode="clip"), along_x[i], out=part)
            along += part
        total, part = np.zeros((rows.size, columns.size)), np.empty((rows.size, columns.size))
        for j in range(4):
            np.multiply(np.take(along, rows - first + j, axis=0, out=part, mode="clip"), along_y[j][:, None], out=part)
            total += part
        total[~inside_y] = np.nan
        total[:, ~inside_x] = np.nan
        return total

    def slopes_on_grid(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Derivatives (n_y, n_x) of the height along x and y at columns x (n_x,) and rows y (n_y,), m."""
        in_x, in_y = self.taps_of(x, y)
        up_x, up_y = self.rates_of(x, y, (in_x, in_y))
        return self._sum(up_x, in_y) / self.dx, self._sum(in_x, up_y) / self.dy

    def slope(self, x: float, y: float) -> tuple[float, float]:
        """Derivatives of the height along x and y at a point, over a fraction of a sample."""
        hx, hy = self.dx / 16, self.dy / 16
        along_x = self(np.array([x - hx, x + hx]), np.array([y, y]))
        along_y = self(np.array([x, x]), np.array([y - hy, y + hy]))
        return float(along_x[1] - along_x[0]) / (2 * hx), float(along_y[1] - along_y[0]) / (2 * hy)

    def thinned(self) -> Terrain:
        """Copy with every `refined`-th sample, for loops that march over it: finer samples are interpolated."""
        n = self.refined
        row, column = -self.row % n, -self.column % n
        return replace(
            self, dx=self.dx * n, dy=self.dy * n, heights=self.heights[row::n, column::n], row=(self.row + row) // n,
            column=(self.column + column) // n, refined=1,
        )  # fmt: skip

    def window(self, x: tuple[float, float], y: tuple[float, float]) -> Terrain:
        """Part of the terrain for heights in a box, x and y from .. to, m; the nearest edge if the box lies outside."""
        columns, rows = self.span(x, y)
        return replace(self, heights=self.heights[rows, columns], row=self.row + rows.start,
                       column=self.column + columns.start)  # fmt: skip

    def span(self, x: tuple[float, float], y: tuple[float, float]) -> tuple[slice, slice]:
        """Columns and rows of `window`, in this terrain's samples."""
        return (
            _span((x[0] - self.x0) / self.dx - self.column, (x[1] - self.x0) / self.dx - self.column,
                  self.heights.shape[1], MARGIN * self.refined),
            _span((y[0] - self.y0) / self.dy - self.row, (y[1] - self.y0) / self.dy - self.row, self.heights.shape[0],
                  MARGIN * self.refined),
        )  # fmt: skip

    @staticmethod
    def _taps(position: FloatArray, first: int, size: int) -> Taps:
        """First of four samples, their weights, and whether the position lies between the second and the third.

        Within the outermost interval, where a fourth sample is missing, the weights are those of the parabola through
        the other three.
        """
        whole = np.floor(position)
        inside = (position >= first) & (position <= first + size - 1)
        start = np.clip(np.where(inside, whole, first) - first - 1, 0, size - 4).astype(np.int64)
        u = position - (start + first + 1)  # 0 .. 1 inside, -1 .. 0 and 1 .. 2 in the outermost intervals
        u = np.where(inside, u, 0.0)
        before = ((-0.5 * u + 1.0) * u - 0.5) * u, (1.5 * u - 2.5) * u * u + 1.0
        after = ((-1.5 * u + 2.0) * u + 0.5) * u, (0.5 * u - 0.5) * u * u
        weights = [*before, *after]
        if (outer := (u < 0)).any():
            parabola = [u * (u - 1) / 2, 1 - u * u, u * (u + 1) / 2, np.zeros_like(u)]
            weights = [np.where(outer, p, w) for p, w in zip(parabola, weights, strict=True)]
        if (outer := (u > 1)).any():
            v = u - 1
            parabola = [np.zeros_like(v), v * (v - 1) / 2, 1 - v * v, v * (v + 1) / 2]
            weights = [np.where(outer, p, w) for p, w in zip(parabola, weights, strict=True)]
        return start, weights, np.asarray(inside)

    @staticmethod
    def _rates(position: FloatArray, first: int, taps: Taps) -> Taps:
        """The taps of the derivative, per sample."""
        start, _, inside = taps
        u = np.where(inside, position - (start + first + 1), 0.0)
        weights = [(-1.5 * u + 2.0) * u - 0.5, (4.5 * u - 5.0) * u, (-4.5 * u + 4.0) * u + 0.5, (1.5 * u - 1.0) * u]
        for outer, v, k in ((u < 0, u, 0), (u > 1, u - 1, 1)):
            if outer.any():
                parabola = [np.zeros_like(u)] * 4
                parabola[k : k + 3] = [v - 0.5, -2 * v, v + 0.5]
                weights = [np.where(outer, p, w) for p, w in zip(parabola, weights, strict=True)]
        return start, weights, inside


def _span(low: float, high: float, size: int, margin: int) -> slice:
    """Range of samples around low .. high with a margin, at least LEAST of `size`."""
    first = int(np.clip(np.floor(low) - margin, 0, size - LEAST))
    last = int(np.clip(np.ceil(high) + margin + 1, first + LEAST, size))
    return slice(first, last)
