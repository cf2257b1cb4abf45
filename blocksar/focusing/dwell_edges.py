"""Edges of dwells, summed pulse by pulse: what a chain fades out at the ends of dwells is back-projected.

The ends of a dwell are where a chain and back-projection differ most. Back-projection ends it at a whole pulse, which
no smooth window does, and the keystone moves the ends over the band, by +-(t - m) B / (2 fc). Both change the image by
pulses at the very ends only. So the sum over the dwell is divided:

    sum w(v) y = sum w(v) s(v) y  +  sum w(v) (1 - s(v)) y,
    s = sin^2(pi n (1 - |v|) / 2) for 1 - |v| < 1 / n, else 1,

with v = 2 offset / beam_width from -1 to 1 and y the echo of a pulse at the pixel's range, its phase removed. The
chain's dwell gate makes the first sum, whose ends fade out: s is smooth over several pulses, and a moved end changes
little. The second one has a few pulses at either end, and is exact. The number n = `fade` is planned
(`planning.edges`); without it chains sum whole dwells.
"""

from __future__ import annotations

import numpy as np

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.collection.beam import inner_interval
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import Weighting
from blocksar.focusing.backprojection import (
    ReadPulses,
    accumulate,
    image_memory,
    lit_pulses,
    pulse_block_size,
    pulse_blocks,
    range_profiles,
)


def add_edges(
    image: ComplexArray,
    read: ReadPulses,
    geometry: Geometry,
    *,
    x: FloatArray,
    y: FloatArray,
    lit: FloatArray,
    fade: int,
    weighting: Weighting,
    threads: int = 1,
) -> None:
    """Add to an image, in place, the part of each dwell that the chain's gate fades out.

    Parameters
    ----------
    image : (n_y, n_x) complex64
        From the chain, divided by `lit`; NaN where it owns no pixel.
    read : callable
        Returns the samples (n, n_range_frequency) complex64 of a slice of pulses; NaN samples are missing.
    geometry : Geometry
        With a steered beam.
    x, y : (n_x,), (n_y,) float
        m, scene frame.
    lit : (n_y, n_x) float
        Sum of the weights w, times the antenna's pattern, over each pixel's lit valid pulses: the image's denominator.
    fade : int
        n, positive.
    weighting : Weighting
    threads : int
        The result does not depend on it.
    """
    collection = geometry.collection
    owned = np.isfinite(image.real) & (lit > 0)
    rows, columns = (np.flatnonzero(owned.any(axis=axis)) for axis in (1, 0))
    if not rows.size:
        return
    part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    image, lit, owned = image[part], lit[part], owned[part]
    mesh_x, mesh_y = np.meshgrid(np.asarray(x, np.float64)[part[1]], np.asarray(y, np.float64)[part[0]])
    edges = _edges(geometry, mesh_x, mesh_y, owned, fade)
    total, weight = np.zeros(image.shape, np.complex64), np.zeros(image.shape, np.float32)
    outside = np.zeros(image.shape, np.bool_)
    wanted = np.logical_or(*(lit_pulses(*edge, collection.n_pulse) for edge in edges))
    for pulses in pulse_blocks(wanted, pulse_block_size(collection)):
        profiles = range_profiles(
            read(pulses), collection=collection, pulses=pulses, threads=threads, taper=weighting.range
        )
        for first, last in edges:
            accumulate(
                total, outside, profiles, geometry=geometry, x=mesh_x, y=mesh_y, first=first, last=last,
                threads=threads, taper=weighting.azimuth, weight=weight, fade=fade,
            )  # fmt: skip
        del profiles  # before the next block is read: otherwise two blocks are in memory
    image += total / np.where(owned, lit, 1.0).astype(np.float32)


def edge_memory(n_pixels: int, collection: Collection, *, threads: int = 1) -> int:
    """Upper bound of the memory to add edges to an image of n_pixels, bytes, without the image."""
    return image_memory(n_pixels, collection, threads=threads) + 8 * 16 * n_pixels  # and what finds lit pulses


def _edges(
    geometry: Geometry, x: FloatArray, y: FloatArray, owned: BoolArray, fade: int
) -> tuple[tuple[IntArray, IntArray], tuple[IntArray, IntArray]]:
    """Pulses first <= p < last of the two edges of each pixel's dwell; none for pixels that are not owned."""
    first, last = inner_interval(geometry, x, y, 1.0)
    inner_first, inner_last = inner_interval(geometry, x, y, 1 - 1 / fade)
    none = inner_first >= inner_last  # a dwell that the collection's end cuts short lies within one edge
    inner_first, inner_last = np.where(none, last, inner_first), np.where(none, last, inner_last)
    for pulses in (first, last, inner_first, inner_last):
        pulses[~owned] = 0
    return (first, inner_first), (inner_last, last)
