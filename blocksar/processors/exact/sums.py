"""Images, points and chips by exact back-projection, as `imaging.backprojection` defines it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import UNIFORM, Weighting
from blocksar.imaging.backprojection import (
    DevicePixels,
    PixelSums,
    ReadPulses,
    gpu_pulse_block,
    pulse_block_size,
    pulse_blocks,
    weighed,
)
from blocksar.imaging.profiles import profile_bins, range_profiles
from blocksar.kernels.device import CPU, TILE, Device
from blocksar.kernels.groups import GROUP_BYTES
from blocksar.kernels.projection import UPSAMPLING


def form_points(
    read: ReadPulses,
    geometry: Geometry,
    x: FloatArray,
    y: FloatArray,
    *,
    threads: int,
    pulse_block: int | None = None,
    weighting: Weighting = UNIFORM,
    device: Device = CPU,
) -> ComplexArray:
    """Back-project to any points on the ground: the plane, or the geometry's terrain.

    Parameters
    ----------
    read : callable
        Returns the samples (n, n_range_frequency) complex64 of a slice of pulses. The slices hold each lit pulse once,
        in ascending order.
    geometry : Geometry
    x, y : (...) float
        m, scene frame; of one shape. Keep neighbours on the ground adjacent in the array, for the cache.
    threads : int
        The result does not depend on it.
    pulse_block : int, optional
        Pulses in memory at a time.
    weighting : Weighting
        Tapers along range frequency and over the dwell, normalised by the sum of weights.
    device : Device
        A bistatic collection is summed on the CPU.

    Returns
    -------
    (...) complex64
        1 + 0j at a target of reflectivity 1. NaN where no valid sample is lit, the pattern in elevation or the recorded
        part of pulses is too small, outside the unambiguous window, or where the terrain has no height.

    Raises
    ------
    ValueError
        If x and y are not finite or differ in shape, or `read` returns a wrong shape.
    InputError
        From `Beam.passes`.
    """
    collection = geometry.collection
    device = CPU if collection.bistatic else device
    if np.shape(x) != np.shape(y):
        raise ValueError(f"{np.shape(x)=} but {np.shape(y)=}")
    shape = np.shape(x)
    rows = (-1, shape[-1]) if len(shape) > 1 and shape[-1] else (1, -1)
    x, y = (np.ascontiguousarray(axis, np.float64).reshape(rows) for axis in (x, y))
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise ValueError("x and y must be finite")
    sums = PixelSums(geometry, x, y, weighting, threads)
    pixels = DevicePixels(sums, device)
    for pulses in pulse_blocks(
        sums.lit(), pulse_block or (pulse_block_size if device.name == "cpu" else gpu_pulse_block)(collection)
    ):
        profiles = range_profiles(
            read(pulses), collection=collection, pulses=pulses, threads=threads, taper=weighting.range,
            upsampling=device.upsampling, device=device,
        )  # fmt: skip
        if sums.over_pulses is not None:
            profiles = weighed(profiles, sums.over_pulses[pulses], device)
        sums.note_valid(pulses, profiles.valid)
        pixels.add(profiles, threads)
        del profiles  # before the next block is read: otherwise two blocks are in memory
        if collection.has_pattern:
            sums.add_gains(pulses)
    return sums.mean(pixels.take()).reshape(shape)


def form_image(
    read: ReadPulses,
    geometry: Geometry,
    x: FloatArray,
    y: FloatArray,
    *,
    threads: int,
    pulse_block: int | None = None,
    weighting: Weighting = UNIFORM,
    device: Device = CPU,
) -> ComplexArray:
    """Back-project to the grid of columns `x` (n_column,) and rows `y` (n_row,), m: `form_points` on their mesh.

    Returns
    -------
    (n_row, n_column) complex64
    """
    mesh_x, mesh_y = np.meshgrid(np.asarray(x, np.float64), np.asarray(y, np.float64))
    return form_points(
        read, geometry, mesh_x, mesh_y, threads=threads, pulse_block=pulse_block, weighting=weighting, device=device
    )


def form_chips(
    read: ReadPulses,
    geometry: Geometry,
    chips: Sequence[tuple[FloatArray, FloatArray]],
    *,
    threads: int,
    weighting: Weighting = UNIFORM,
) -> list[ComplexArray]:
    """Back-project to several small grids in one pass over the pulses: each range profile is formed once.

    Parameters
    ----------
    chips : sequence of (x, y)
        Columns (n_column,) and rows (n_row,) of each chip, m, as in `form_image`.

    Returns
    -------
    list of (n_row, n_column) complex64
    """
    meshes = [np.meshgrid(np.asarray(x, np.float64), np.asarray(y, np.float64)) for x, y in chips]
    if not meshes:
        return []
    points_x, points_y = (np.concatenate([mesh[axis].ravel() for mesh in meshes]) for axis in (0, 1))
    image = form_points(read, geometry, points_x, points_y, threads=threads, weighting=weighting)
    ends = np.cumsum([mesh[0].size for mesh in meshes])[:-1]
    return [part.reshape(mesh[0].shape) for part, mesh in zip(np.split(image, ends), meshes, strict=True)]


def image_memory(n_pixels: int, collection: Collection, *, threads: int = 1) -> int:
    """Upper bound of the memory for an image of n_pixels, bytes, including the samples that `read` returns."""
    n, bins = collection.n_range_frequency, profile_bins(collection)
    pulses = pulse_block_size(collection)
    pixel = 8 * 5 + 4 + 1 + 2  # bytes: x, y, first, last and image; weight; outside and a mask
    pixel += 16 if collection.has_pattern else 0  # sums of gains, and divisors
    scratch = 4 * (GROUP_BYTES + 8 * bins) + 16 * 8 * TILE**2
    return n_pixels * pixel + pulses * 8 * (n + bins) + threads * scratch + 16 * 8 * (bins + collection.n_pulse)


def gpu_memory(n_pixels: int, collection: Collection) -> int:
    """Peak memory of a GPU that forms an image of n_pixels, bytes."""
    n, bins = collection.n_range_frequency, profile_bins(collection, UPSAMPLING["gpu"])
    pixel = 8 * 6 + 4 + 1  # bytes: x, y, height, first, last and image; weight; outside
    pixel += 4 * 8  # distances of neighbours, in turn
    return n_pixels * pixel + gpu_pulse_block(collection) * 8 * (2 * n + 4 * bins)
