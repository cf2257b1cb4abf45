"""Figures of the noise of an image."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, Self

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import UNIFORM, Weighting
from blocksar.measurement.axes import response_axes

SHARES = (0.05, 0.5, 0.95)  # of the pixels: least, median and greatest noise


class NoiseFigures(NamedTuple):
    """Noise-equivalent reflectivity (power, 1 is that of a target of reflectivity 1), over an image and at a place.

    `least` and `greatest` are exceeded by 95 and 5 % of the pixels. `x`, `y` (m) is the pixel nearest to the middle of
    the covered ones, `there` its noise, and `area` (m^2) the ground area of a resolution cell there: clutter of a mean
    squared reflectivity of `there / area` a square metre is as strong as the noise. NaN where there is no cell.
    """

    least: float
    median: float
    greatest: float
    x: float
    y: float
    there: float
    area: float

    @classmethod
    def of(
        cls,
        geometry_at: Callable[[float, float], Geometry],
        x: FloatArray,
        y: FloatArray,
        noise: FloatArray,
        weighting: Weighting = UNIFORM,
    ) -> Self:
        """The figures of noise (n,) at pixels x, y (n,), m; `geometry_at` is that of the collection seen at a place."""
        least, median, greatest = (float(value) for value in np.quantile(noise, SHARES))
        middle = int(np.argmin((x - x.mean()) ** 2 + (y - y.mean()) ** 2))
        there = float(x[middle]), float(y[middle])
        axes = response_axes(geometry_at(*there), *there, weighting)
        return cls(least, median, greatest, *there, float(noise[middle]), axes.area if axes else math.nan)

    def as_json(self) -> dict[str, float | None]:
        """The fields as JSON values: NaN becomes null."""
        return {name: value if math.isfinite(value) else None for name, value in self._asdict().items()}

    def sentence(self) -> str:
        """The figures in words."""
        least, median, greatest = (10 * math.log10(value) for value in (self.least, self.median, self.greatest))
        text = (
            f"noise-equivalent reflectivity {median:.1f} dB in the median, {least:.1f} .. {greatest:.1f} dB over nine "
            "tenths of the image"
        )
        if not math.isfinite(self.area):
            return text
        return (
            f"{text}; at x = {self.x:.6g}, y = {self.y:.6g} m {10 * math.log10(self.there / self.area):.1f} dB per m2, "
            f"with a cell of {self.area:.3g} m2"
        )
