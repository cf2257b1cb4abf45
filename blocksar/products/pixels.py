"""The pixels of a raster product: what they hold, averaged over looks, as floating-point or scaled whole numbers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import FloatArray
from blocksar.errors import InputError
from blocksar.focusing.terrain_layers import Sight, box_of, by_owner, gamma_factor
from blocksar.kernels.occlusion import UNKNOWN, VISIBLE
from blocksar.measurement.looks import checked_looks, decibels, multilook, power_of
from blocksar.products.options import Content, Decibels, Scale
from blocksar.products.pictures.overview import overview, stretch
from blocksar.runs.finished import STRIP, FinishedRun

LAYERS = {"height": "height", "incidence": "incidence_angle", "visibility": "visibility"}  # in image.zarr, on a terrain
CONTENTS: tuple[Content, ...] = get_args(Content)
SCALES: tuple[Scale, ...] = get_args(Scale)
STRETCHED = 1000  # cells along the longer side of what the range in dB is chosen from


@dataclass(frozen=True, eq=False)
class Pixels:
    """Pixels of an image, or cells of `looks` pixels with their mean power.

    Attributes
    ----------
    source : FinishedRun
        The image.
    content : str
        "amplitude": the root of the power; "power": |image|^2; "db": 10 log10 of it; "complex": the image itself. On a
        terrain also "height", m; "incidence", local angle, rad; "visibility", 0 visible, 1 layover, 2 shadow; "gamma":
        the power times `gamma_factor` of `focusing.terrain_layers`, which removes what slopes do to it, so that level
        ground keeps its power; NaN in layover and shadow.
    looks : (int, int)
        Pixels along y and along x in a cell, whose power is averaged.
    scale : str, optional
        Type of whole numbers in which dB are stored: 1 at the lower end of `limits`, the largest number at the upper
        end, 0 where not covered.
    limits : (float, float)
        dB; only with `scale`.
    """

    source: FinishedRun
    content: Content
    looks: tuple[int, int] = (1, 1)
    scale: Scale | None = None
    limits: tuple[float, float] = (0.0, 0.0)

    @cached_property
    def x(self) -> FloatArray:
        """Middles of the pixels, m."""
        return _middles(self.source.x, self.looks[1])

    @cached_property
    def y(self) -> FloatArray:
        return _middles(self.source.y, self.looks[0])

    @property
    def spacing(self) -> tuple[float, float]:
        """Distance between pixels in x and in y, m."""
        dx, dy = self.source.spacing
        return dx * self.looks[1], dy * self.looks[0]

    @property
    def dtype(self) -> str:
        return self.scale or {"complex": "complex64", "visibility": "uint8"}.get(self.content, "float32")

    @property
    def nodata(self) -> float:
        """Find what a pixel that is not covered holds."""
        if self.content == "visibility":
            return UNKNOWN
        return np.nan if self.scale is None else 0

    @property
    def step(self) -> float:
        """dB between neighbouring whole numbers."""
        assert self.scale is not None
        return (self.limits[1] - self.limits[0]) / (np.iinfo(self.scale).max - 1)

    @property
    def offset(self) -> float:
        """dB that 0 would stand for."""
        return self.limits[0] - self.step

    def strips(self) -> Iterator[slice]:
        """Divide the rows into parts of bounded size."""
        if self.looks == (1, 1):
            yield from self.source.strips(0)
            return
        step = max(STRIP // (self.source.x.size * self.looks[0]), 1)
        for first in range(0, self.y.size, step):
            yield slice(first, min(first + step, self.y.size))

    def measured(self, rows: slice) -> NDArray[Any]:
        """Read whole rows of what `coded` makes the product of: power, complex pixels, or a layer."""
        if self.content in LAYERS:
            layer = self.source.read_layer(LAYERS[self.content], rows, slice(None))
            layer[self.source.read_block(rows, slice(None)) < 0] = self.nodata
            return layer
        side = self.looks[0]
        part = slice(rows.start * side, rows.stop * side)
        pixels = self.source.read(part, slice(None))
        if self.content == "complex":
            return pixels
        power = power_of(pixels)
        if self.content == "gamma":
            power = power * self._gamma_factor(part)
        return multilook(power, self.looks)

    def coded(self, values: NDArray[Any]) -> NDArray[Any]:
        """Find what the product holds of values that were measured."""
        if self.content == "db":
            return self._scaled(decibels(values))
        return np.sqrt(values) if self.content == "amplitude" else values

    @cached_property
    def _sights(self) -> list[Sight]:
        """The antenna as the pixels of each segment see it."""
        source, terrain = self.source, self.source.geometry.terrain
        assert terrain is not None
        box = box_of(source.x, source.y)
        return [Sight.of(geometry, box, terrain.limits) for geometry in source.segments or (source.geometry,)]

    def _gamma_factor(self, rows: slice) -> NDArray[np.float32]:
        """Find what the power of whole rows is multiplied by; NaN in layover and shadow."""
        terrain = self.source.geometry.terrain
        assert terrain is not None
        owner = self.source.read_block(rows, slice(None))
        sights = {int(block): self._sights[self.source.segment_of(int(block))] for block in np.unique(owner)}
        factor = by_owner(
            sights, owner, lambda sight: gamma_factor(terrain, sight, self.source.x, self.source.y[rows]), np.nan
        ).astype(np.float32)
        factor[self.source.read_layer("visibility", rows, slice(None)) != VISIBLE] = np.nan
        return factor

    def _scaled(self, values: NDArray[np.float32]) -> NDArray[Any]:
        if self.scale is None:
            return values
        most = np.iinfo(self.scale).max
        number = np.clip(np.rint((values - self.offset) / self.step), 1, most)
        return np.where(np.isnan(values), 0, number).astype(self.scale)


def _middles(axis: FloatArray, side: int) -> FloatArray:
    """Middles of whole cells of `side` pixels along an axis, m."""
    if side == 1:
        return axis
    n = axis.size // side
    return axis[: n * side].reshape(n, side).mean(axis=1)


def pixels_of(
    source: FinishedRun,
    *,
    content: Content | None,
    looks: tuple[int, int],
    scale: Scale | None,
    limits: Decibels | None,
) -> Pixels:
    """Check what is asked of the pixels; choose the range in dB if it is needed and not given.

    Raises
    ------
    InputError
        If the content, the looks or the scale are none, or do not go together.
    """
    content = content or ("db" if scale else "amplitude")
    if content not in CONTENTS:
        raise InputError(f"content = {content!r}: give one of {', '.join(CONTENTS)}")
    looks = checked_looks(looks, (source.y.size, source.x.size))
    if content in LAYERS or content == "gamma":
        source.check_layer(LAYERS.get(content, "visibility"))
    if content in LAYERS and looks != (1, 1):
        raise InputError(f"content = {content!r} has no looks: it is no power; leave looks out")
    if content == "complex" and looks != (1, 1):
        raise InputError("content = 'complex' has no looks: the mean of complex pixels is no image; take power")
    if scale is not None and scale not in SCALES:
        raise InputError(f"scale = {scale!r}: give one of {', '.join(SCALES)}")
    if scale is not None and content != "db":
        raise InputError(f"scale = {scale!r} stores dB, but the content is {content}; take content db")
    if limits is not None and scale is None:
        raise InputError("a range in dB serves to scale pixels to whole numbers; give a scale, such as uint8, too")
    if scale is not None and limits is None:
        limits = _stretched(source)
    return Pixels(source, content, looks, scale, limits or (0.0, 0.0))


def _stretched(source: FinishedRun) -> tuple[float, float]:
    reduced = overview(source.read, source.x, source.y, max_pixels=STRETCHED, looks="mean")
    with np.errstate(divide="ignore"):
        low, high = stretch(10 * np.log10(reduced.power))
    return float(np.floor(low)), float(np.ceil(high))
