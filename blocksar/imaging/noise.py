"""Noise of an image's pixels, derived from the noise of the samples.

The image is sum w W signal exp() / sum w W g, so that independent noise of mean squared magnitude N in each sample
gives a pixel

    noise_equivalent = N sum (w W)^2 / (sum w W g)^2 = N (sum w^2 / (sum w g)^2) (sum W^2 / (sum W)^2)

over its lit valid pulses and all range frequencies, whichever processor computes it. Both sums over pulses are smooth
over the ground, apart from bends where dwells begin to be cut: they are computed at every NODE_PIXELS-th pixel. On a
terrain they lie at their heights, which count under a beam about its axis. The mean of a pattern in elevation, which
may have zeros, is computed at every pixel. Where a raw echo recorded parts of pulses, the noise is times the mean share
of W^2 over the square of that of W (`recorded_pulses`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from blocksar.arrays import FloatArray, IntArray
from blocksar.collection.axis_beam import Height
from blocksar.collection.beam import GAIN_PARTS, pulses_before
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import Weighting
from blocksar.imaging.pattern_sums import mean_elevations
from blocksar.imaging.recorded_pulses import divide_by_recorded
from blocksar.kernels.phase import Float32Array

NODE_PIXELS = 16  # between nodes, at most
# Bits of a float32 that are kept zero, so that images of noise compress: values are rounded to 1.2e-4, or 0.0005 dB.
SPARED_BITS = 11


class PulseSums(NamedTuple):
    """Sums over the lit valid pulses of points (...): of w^2, and of w g; not positive outside the beam."""

    squares: FloatArray
    gains: FloatArray


def pulse_sums(
    geometry: Geometry, x: FloatArray, y: FloatArray, valid: FloatArray, weighting: Weighting, z: Height | None = None
) -> PulseSums:
    """Compute the sums at points x, y (...), m, on the ground, or at heights z, m.

    Dwells begin and end between pulses here, so that the sums are continuous. A point beyond the beam has a dwell of
    negative length, so that the sums go through 0 where the light ends, without a bend.

    Parameters
    ----------
    valid : (n_pulse,) float
        Fraction of each pulse's samples that are valid.
    """
    collection, taper = geometry.collection, weighting.azimuth
    if taper.uniform and not collection.has_pattern:
        [(count, squares, _)] = dwell_parts(geometry, x, y, valid, z, 1)
        return PulseSums(squares, count)
    squares, gains = np.zeros(np.shape(x)), np.zeros(np.shape(x))
    for count, square, middle in dwell_parts(geometry, x, y, valid, z, GAIN_PARTS):
        weight = geometry.beam.weights(x, y, middle, taper, z)
        squares += square * weight**2
        gains += count * weight * geometry.beam.gain(x, y, middle, z)
    return PulseSums(squares, gains)


def dwell_parts(
    geometry: Geometry, x: FloatArray, y: FloatArray, valid: FloatArray, z: Height | None, parts: int
) -> Iterator[tuple[FloatArray, FloatArray, IntArray]]:
    """Divide the dwells of points (...), as of `pulse_sums`.

    Yields, of each part, the sums of the shares of time of valid pulses and of the squares of shares, which are both
    their number where pulses are uniform, and the middle pulse.
    """
    collection = geometry.collection
    shares = collection.pulses.shares
    ends = geometry.beam.dwell(x, y, z=z)
    never = ~(np.isfinite(ends[0]) & np.isfinite(ends[1]))
    low, high = (np.where(never, 0.0, pulses_before(collection, end)) for end in ends)
    n = valid.size
    sums = [np.concatenate([[0.0], np.cumsum(valid if shares is None else valid * shares**k)]) for k in (1, 2)]

    def counted(first: FloatArray, last: FloatArray, before: FloatArray) -> FloatArray:
        parts = (
            np.interp(pulse, np.arange(n + 1.0), before) + (np.minimum(pulse, 0.0) + np.maximum(pulse - n, 0.0))
            for pulse in (last, first)
        )
        return np.asarray(next(parts) - next(parts))

    for part in range(parts):
        first = low + (high - low) * part / parts
        last = high if part + 1 == parts else low + (high - low) * (part + 1) / parts
        count = counted(first, last, sums[0])
        square = count if shares is None else counted(first, last, sums[1])
        yield count, square, np.clip((first + last) / 2, 0, n - 1).astype(np.int64)


@dataclass(frozen=True, kw_only=True, eq=False)
class NoiseMap:
    """The noise of an image's pixels.

    Attributes
    ----------
    geometry : Geometry
    weighting : Weighting
    valid : (n_pulse,) float
        Fraction of each pulse's samples that are valid.
    sample : float
        sum W^2 N / (sum W)^2, N being that of each range frequency: the noise of a pixel that one pulse of weight 1
        lights.
    """

    geometry: Geometry
    weighting: Weighting
    valid: FloatArray
    sample: float

    @classmethod
    def of(
        cls, geometry: Geometry, weighting: Weighting, valid: FloatArray, spectrum: FloatArray | float = 1.0
    ) -> Self | None:
        """Make the noise map of a collection's images; None if the noise of its samples is unknown or 0.

        `spectrum` (n_range_frequency,) is the noise of samples at each range frequency over `noise_power`; for a raw
        echo, that of `RawCompression.noise_spectrum`.
        """
        collection = geometry.collection
        if not collection.noise_power:
            return None
        weights = weighting.range.weights(collection.range_frequency, collection.band)
        sample = collection.noise_power * float((weights**2 * spectrum).sum() / weights.sum() ** 2)
        return cls(geometry=geometry, weighting=weighting, valid=valid, sample=sample)

    def over(self, x: FloatArray, y: FloatArray, height: FloatArray | None = None) -> Float32Array:
        """Mean squared magnitude of the noise at pixels of columns x (n_x,) and rows y (n_y,), m: (n_y, n_x).

        NaN where no pulse lights a pixel, or the pattern in elevation is too small for an image. On a terrain, `height`
        (n_y, n_x) has z of the pixels, m; NaN where unknown.
        """
        geometry, columns, rows = self.geometry, nodes_of(x.size), nodes_of(y.size)
        pixels = np.arange(y.size, dtype=np.float64), np.arange(x.size, dtype=np.float64)
        elevated = geometry.collection.elevation_pattern is not None
        if elevated:
            geometry = geometry.lit_by(geometry.collection.without_elevation)
        counts = geometry.collection.has_axis or elevated
        z = _at_nodes(height, rows, columns) if counts and height is not None else None
        sums = pulse_sums(geometry, *np.meshgrid(x[columns], y[rows]), self.valid, self.weighting, z)
        squares, gains = (over_pixels(part, rows, columns, *pixels) for part in sums)
        if elevated:
            if z is not None and height is not None:
                z = np.where(np.isfinite(height), height, over_pixels(z, rows, columns, *pixels))
            gains = gains * self._elevation(x, y, z)
        lit = (squares > 0) & (gains > 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            noise = np.where(lit, self.sample * squares / gains**2, np.nan).astype(np.float32)
        if (recorded := self.geometry.collection.recorded) is not None and recorded.partial:
            divide_by_recorded(
                noise, self.geometry, x, y[:, None], height, weighting=self.weighting,
                divisor=lambda means: means.amplitude**2 / means.power,
            )  # fmt: skip
            lit = np.isfinite(noise)
        bits = noise.view(np.int32)  # a NaN stays one
        half = np.int32(1 << (SPARED_BITS - 1))
        return np.where(lit, (bits + half) & np.int32(-1 << SPARED_BITS), bits).view(np.float32)

    def _elevation(self, x: FloatArray, y: FloatArray, z: FloatArray | None) -> FloatArray:
        """Means of the pattern in elevation at pixels (n_y, n_x); 0 where they are too small for an image."""
        geometry, mesh = self.geometry, np.meshgrid(x, y)
        shares = geometry.collection.pulses.shares
        valid = self.valid if shares is None else self.valid * shares
        at = *mesh, geometry.known_height(*mesh)[0] if z is None else z
        means = mean_elevations(
            geometry, *at, passes=geometry.beam.passes(*at), valid=valid, taper=self.weighting.azimuth
        )
        return np.where(means.dark(geometry), 0.0, means.weighed)


def _at_nodes(height: FloatArray, rows: IntArray, columns: IntArray) -> FloatArray | None:
    """Heights of pixels (n_y, n_x), m, at nodes; interpolated where unknown, None if none is known."""
    if not np.isfinite(height).any():
        return None
    z = height[np.ix_(rows, columns)]
    for lines in (z, z.T):
        for line in lines:
            unknown = ~np.isfinite(line)
            if unknown.any() and not unknown.all():
                line[unknown] = np.interp(np.flatnonzero(unknown), np.flatnonzero(~unknown), line[~unknown])
    return z if np.isfinite(z).all() else np.full(z.shape, np.nanmean(height))


def nodes_of(n: int, step: int = NODE_PIXELS) -> IntArray:
    """Indices of every `step`-th of n pixels, and of the last one."""
    return np.unique(np.append(np.arange(0, n, step), n - 1))


def over_pixels(values: FloatArray, rows: IntArray, columns: IntArray, y: FloatArray, x: FloatArray) -> FloatArray:
    """Values (n_row, n_column) at nodes of the axes y (n_y,) and x (n_x,), even or not, at all pixels: (n_y, n_x)."""
    return _between(_between(values, y, rows).T, x, columns).T


def _between(values: FloatArray, axis: FloatArray, nodes: IntArray) -> FloatArray:
    """Values (n_node, m) at nodes of an axis (n,), linear in between: (n, m)."""
    if nodes.size == 1:
        return values
    first = np.clip(np.searchsorted(nodes, np.arange(axis.size), side="right") - 1, 0, nodes.size - 2)
    start, end = axis[nodes[first]], axis[nodes[first + 1]]
    part = ((axis - start) / (end - start))[:, None]
    return np.asarray(values[first] * (1 - part) + values[first + 1] * part)
