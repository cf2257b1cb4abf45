"""Exact back-projection of chips: its speed, and the coherence of the image with it."""

from __future__ import annotations

import importlib
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.environment import version_of
from benchmarks.figures import spread
from blocksar import stores
from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.errors import InputError
from blocksar.imaging.backprojection import accumulate, pulse_block_size
from blocksar.imaging.profiles import range_profiles
from blocksar.kernels.device import TILE
from blocksar.kernels.projection import LitPixels
from blocksar.measurement.coherence import coherence
from blocksar.processors.chain.planning.plan import Plan
from blocksar.processors.exact.sums import form_points

CHIP = 2 * TILE  # pixels per side, whole tiles: one that lies in two chips would be summed far more slowly
SAMPLED_PIXELS = 1e6  # at about so many pixels of the image, lit pulses are counted


@dataclass(frozen=True)
class Chips:
    """Windows of the image, one below the other: x, y (n * CHIP, CHIP) in m, and the name of each place."""

    names: list[str]
    windows: list[tuple[slice, slice]]
    x: FloatArray
    y: FloatArray


def place_chips(plan: Plan, run: Path) -> Chips:
    """Place chips at near, middle and far range of every block, and on the seams, where the image covers them.

    Raises
    ------
    InputError
        If the image has no room for a chip.
    """
    names, windows = [], []
    for name, slant_range, yaw in _places(plan):
        x, y, _ = plan.geometry.ground_point(np.array(slant_range), np.array(yaw))
        row = round((float(y) - plan.grid.y[0]) / plan.grid.dy) - CHIP // 2
        column = round((float(x) - plan.grid.x[0]) / plan.grid.dx) - CHIP // 2
        if not (0 <= row <= plan.grid.shape[0] - CHIP and 0 <= column <= plan.grid.shape[1] - CHIP):
            continue
        window = (slice(row, row + CHIP), slice(column, column + CHIP))
        if np.isfinite(stores.read_region(run / "image.zarr", "image", window).real).mean() > 0.5:
            names.append(name)
            windows.append(window)
    if not windows:
        raise InputError(f"the image of scene {run.name} has no room for a chip of {CHIP} x {CHIP} pixels")
    meshes = [np.meshgrid(plan.grid.x[columns], plan.grid.y[rows]) for rows, columns in windows]
    x, y = (np.concatenate([mesh[axis] for mesh in meshes]) for axis in (0, 1))
    return Chips(names, windows, x, y)


def _places(plan: Plan) -> Iterator[tuple[str, float, float]]:
    for block in plan.blocks:
        near, far = block.ground.near, block.ground.far
        for where, share in (("near", 0.1), ("middle", 0.5), ("far", 0.9)):
            yield f"block {block.name}, {where} range", near + share * (far - near), (block.low + block.high) / 2
    for seam in plan.seams[1:-1]:
        near, far = plan.region.limits(seam, seam)
        yield f"seam at {np.degrees(seam):.2f} degrees", (near + far) / 2, seam


class Projected(NamedTuple):
    """Seconds for reading and range profiles of all pulses, seconds for updates, and the number of updates."""

    profiles: float
    accumulation: float
    updates: int


def back_project(history: stores.PhaseHistory, geometry: Geometry, chips: Chips, threads: int) -> Projected:
    """Time the two parts of back-projection separately, as they grow differently with the image."""
    collection = geometry.collection
    profiling, accumulation = 0.0, 0.0
    started = time.perf_counter()
    (z, _), (first, last) = geometry.known_height(chips.x, chips.y), geometry.beam.longest_pass(chips.x, chips.y)
    image, outside = np.zeros(chips.x.shape, np.complex64), np.zeros(chips.x.shape, np.bool_)
    accumulation += time.perf_counter() - started
    step = pulse_block_size(collection)
    for begin in range(0, collection.n_pulse, step):
        pulses = slice(begin, min(begin + step, collection.n_pulse))
        started = time.perf_counter()
        samples = history.read(pulses, slice(None))
        profiles = range_profiles(samples, collection=collection, pulses=pulses, threads=threads)
        ready = time.perf_counter()
        pixels = LitPixels(chips.x, chips.y, z, first, last)
        accumulate(image, outside, profiles, geometry=geometry, pixels=pixels, threads=threads)
        profiling += ready - started
        accumulation += time.perf_counter() - ready
    return Projected(profiling, accumulation, int((last - first).sum()))


def count_updates(plan: Plan, run: Path) -> tuple[int, int]:
    """Number of covered pixels of the image, and of their lit pulses in all; both from every n-th row and column."""
    height, width = plan.grid.shape
    step = max(1, int(math.sqrt(height * width / SAMPLED_PIXELS)))
    rows, columns = slice(0, height, step), slice(0, width, step)
    covered = stores.read_region(run / "image.zarr", "block", (rows, columns)) >= 0
    x, y = np.meshgrid(plan.grid.x[columns], plan.grid.y[rows])
    first, last = plan.geometry.beam.longest_pass(x[covered], y[covered])
    return int(covered.sum()) * step**2, int((last - first).sum()) * step**2


def compare_chips(
    history: stores.PhaseHistory, plan: Plan, run: Path, chips: Chips, threads: int
) -> tuple[list[dict[str, Any]], ComplexArray]:
    """Coherence, gain and phase of the image with exact back-projection, by chip; and the exact chips."""
    exact = form_points(lambda p: history.read(p, slice(None)), plan.geometry, chips.x, chips.y, threads=threads)
    comparisons = []
    for i, (name, window) in enumerate(zip(chips.names, chips.windows, strict=True)):
        ours = stores.read_region(run / "image.zarr", "image", window)
        c = coherence(ours, exact[i * CHIP : (i + 1) * CHIP])
        comparisons.append({"place": name, "coherence": abs(c.coherence), "gain": c.gain, "phase_radians": c.phase})
    return comparisons, exact


def run_peer(
    history: stores.PhaseHistory, plan: Plan, chips: Chips, exact: ComplexArray, repeats: int
) -> dict[str, Any]:
    """Time torchbp's backprojection_cart_2d on the first chip, for its dwell only: the function has no steered beam.

    On the CPU, with its own default of threads (all processors). Range profiles are computed here and not timed.
    torchbp computes phases in float32, which is too coarse at tens of kilometres of range and centimetres of
    wavelength, as the reported coherence shows: only the speed can be compared.
    """
    try:
        torch, torchbp = importlib.import_module("torch"), importlib.import_module("torchbp")
    except ImportError as error:
        return {"name": "torchbp", "status": "not installed", "reason": str(error)}
    collection, x, y = plan.geometry.collection, chips.x[:CHIP], chips.y[:CHIP]
    first, last = plan.geometry.beam.longest_pass(x, y)
    pulses = slice(int(first.min()), int(last.max()))
    reference = collection.reference_range[pulses]
    if np.ptp(reference) > 0:
        return {"name": "torchbp", "status": "not run", "reason": "it needs a constant reference range"}
    samples = history.read(pulses, slice(None))
    profiles = range_profiles(samples, collection=collection, pulses=pulses, threads=1)
    corner = np.array([x[0, 0], y[0, 0], collection.ground_height])  # its ground is z = 0
    position = (collection.antenna_position[pulses] - corner).astype(np.float32)
    arguments = {
        "data": torch.from_numpy(profiles.values),
        "grid": {"x": (0.0, CHIP * plan.grid.dx), "y": (0.0, CHIP * plan.grid.dy), "nx": CHIP, "ny": CHIP},
        "fc": float(collection.carrier + collection.range_frequency[collection.n_range_frequency // 2]),
        "r_res": profiles.spacing,
        "pos": torch.from_numpy(position),
        "d0": profiles.centre * profiles.spacing - float(reference[0]),
    }
    image, seconds = None, []
    for _ in range(repeats + 1):
        started = time.perf_counter()
        image = torchbp.ops.backprojection_cart_2d(**arguments)
        seconds.append(time.perf_counter() - started)
    theirs = np.asarray(image).reshape(CHIP, CHIP).T.astype(np.complex64)
    updates = CHIP * CHIP * (pulses.stop - pulses.start)
    return {
        "name": "torchbp",
        "status": "run",
        "versions": {"torch": str(torch.__version__), "torchbp": version_of("torchbp")},
        "what": f"backprojection_cart_2d, one chip of {CHIP} x {CHIP} pixels, {pulses.stop - pulses.start} pulses, CPU",
        "updates_per_second": spread([updates / s for s in seconds[1:]]),
        "coherence": abs(coherence(theirs, exact[:CHIP]).coherence),
    }
