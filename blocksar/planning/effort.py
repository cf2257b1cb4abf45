"""Predicted effort of a command: seconds for every unit of work of its stages, for `progress.Estimate`.

While a command runs only ratios between stages matter, since the pace is measured; `plan` multiplies by
`graph.machine.pace`. The constants below are CPU seconds of one thread where that pace is 1, on a virtual machine of 2
cores (EPYC with AVX-512) that are both busy. Those of layers are from the receipts of `table1` over hills; that of
back-projection from a TOPS scene of 3000 pulses besides. Those of compression and inspection are estimates; each
matters only relative to the others of its own command.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.chunks import IMAGE_CHUNK, LAYER_CHUNKS, PYRAMID_LEVELS, TILE
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.planning.disk import has_pyramid
from blocksar.planning.tiling import chunks_of, image_chunk, inspection_width, window_around
from blocksar.progress import Work
from blocksar.progress.estimate import finishing_times

LAYERS = 1.1e-8  # per pixel of a chunk whose layers are added, on a terrain
PYRAMID = 1e-9  # per pixel of an image with a pyramid, of the levels after the first
INSPECT = 2e-8  # per sample
GPU_UPDATE = 6e-12  # per lit pulse and pixel, on a GPU
GPU_PIXEL = 1.7e-7  # per pixel, besides, and per sample that is read, sent and transformed: work of the CPU
GPU_SAMPLE = 2e-9
BACK_PROJECT = 2.2e-9  # per lit pulse and pixel
PROFILES = 7e-8  # per sample that is compressed in range, or in which interference is looked for; of each chunk anew
GAINS = 7e-9  # more under an antenna's pattern, whose sums it divides by
FINISH = 0.4  # to end the cluster and flush files to the disk

# `blocksar demo` predicts its stages before there is a plan: seconds on two cores of an earlier machine, of which only
# ratios matter.
DEMO = {
    "simulate": 0.3,
    "plan": 0.2,
    "compile": 0.1,
    "start-workers": 0.9,
    "recover": 0.7,
    "focus": 2.5,
    "mosaic": 0.3,
    "finish": 0.1,
    "measure": 3.3,
    "draw": 6.8,
    "report": 1.2,
    "responses": 5.4,
}
COMPILE = 9.0  # while no kernel is in numba's cache
START = 1.8  # s to start workers
THREAD_GAIN = 0.5  # of a further thread of a worker, over the first: 0.9 of two, 0.5 of four, 0.3 of eight
FOCUS: Work = dict.fromkeys(("plan", "compile", "start-workers", "recover", "focus", "mosaic", "finish"), ())


def of_layers(chunks: int, side: tuple[int, int]) -> Work:
    """Work of the terrain layers of `chunks` image chunks of `side` pixels; empty without chunks."""
    counts = [min(chunks - first, LAYER_CHUNKS) for first in range(0, chunks, LAYER_CHUNKS)]
    return {"layers": [LAYERS * count * side[0] * side[1] for count in counts]} if counts else {}


def of_pyramid(grid: Grid, asked: bool | None = None) -> dict[str, list[float]]:
    """Work of an image's pyramid; empty without one."""
    if not has_pyramid(grid, asked):
        return {}
    side = IMAGE_CHUNK * 2**PYRAMID_LEVELS  # pixels
    n_y, n_x = (np.diff([*range(0, n, side), n]) for n in grid.shape)
    return {"pyramid": (PYRAMID * np.multiply.outer(n_y, n_x).ravel()).tolist()}


def together(works: Sequence[Work]) -> Work:
    """Combine the work of several segments stage by stage."""
    stages = dict.fromkeys(stage for work in works for stage in work)
    return {stage: [cost for work in works for cost in work.get(stage, ())] for stage in stages} | {"finish": [FINISH]}


def of_chunks(
    geometries: Sequence[Geometry], grid: Grid, stage: str, seconds: Callable[[Geometry, FloatArray, FloatArray], float]
) -> Work:
    """Work of forming each image chunk from all samples, without raw echoes; `seconds` predicts that of a chunk."""
    costs = [sum(seconds(geometry, x, y) for geometry in geometries) for x, y in chunks_of(grid)]
    return of_parts(geometries, grid, stage, costs)


def of_parts(geometries: Sequence[Geometry], grid: Grid, stage: str, costs: Sequence[float]) -> Work:
    """Work of inspecting all samples, and of forming image parts from them, of `costs` seconds each."""
    inspect: list[float] = []
    for geometry in geometries:
        collection = geometry.collection
        n_tasks = math.ceil(collection.n_range_frequency / inspection_width(collection))
        inspect += [INSPECT * collection.n_pulse * collection.n_range_frequency / n_tasks] * n_tasks
    layered = 0 if geometries[0].terrain is None else len(chunks_of(grid))
    return {"inspect": inspect, stage: costs, **of_layers(layered, image_chunk(grid)), "finish": [FINISH]}


def of_demo(*, simulated: bool, compiled: bool) -> Work:
    """Work of `blocksar demo`: without simulation if `simulated`, with the kernels in numba's cache if `compiled`."""
    seconds = DEMO if compiled else DEMO | {"compile": COMPILE}
    return {stage: [cost] for stage, cost in seconds.items() if not (simulated and stage == "simulate")}


def seconds_of(work: Work, *, workers: int, threads: int, pace: float) -> dict[str, float]:
    """Predict how long each stage takes, s, with `start` as the first.

    Parameters
    ----------
    work : mapping of str to sequence of float
        Stages with the seconds of their units, as `of_plan` gives them.
    workers, threads : int
        Processes, and threads in each.
    pace : float
        Seconds that a second of work takes on this machine.

    Examples
    --------
    >>> seconds_of({"focus": [2.0, 3.0, 2.0]}, workers=2, threads=1, pace=0.5)
    {'start': 0.9, 'focus': 2.0}
    """
    rate = pace / (1 + THREAD_GAIN * (threads - 1))
    stages = {name: rate * finishing_times(costs, workers)[-1] for name, costs in work.items() if costs}
    return {"start": pace * START, **stages}


def of_preparation(echoes: Iterable[tuple[int, int]], *, raw: bool) -> Work:
    """Work of range-compressing `echoes` of pulses and samples; if not `raw`, of cutting interference."""
    units: list[float] = []
    for n_pulse, samples in echoes:
        groups = math.ceil(n_pulse / TILE[0])
        units += [PROFILES * samples / groups] * groups if samples else []
    return {"range-compress" if raw else "interference": units} if units else {}


def projection_seconds(
    geometry: Geometry, chunks: Sequence[tuple[FloatArray, FloatArray]], update: float = BACK_PROJECT,
    profiles: float = PROFILES,
) -> list[float]:  # fmt: skip
    """Seconds of back-projection of chunks at x (n_x,) and y (n_y,) each, by the lit pulses of a few of their pixels.

    Range profiles are formed of all pulses that light any of a chunk's, `profiles` seconds a sample.
    """
    collection = geometry.collection
    per_pulse = update + (GAINS if collection.has_pattern else 0.0)
    some = [np.meshgrid(x[:: max(x.size // 8, 1)], y[:: max(y.size // 8, 1)]) for x, y in chunks]
    ends = np.cumsum([x.size for x, _ in some])
    dwells = geometry.beam.dwell(*(np.concatenate([mesh[k].ravel() for mesh in some]) for k in (0, 1)))
    seconds = []
    for (x, y), start, end in zip(chunks, *(np.split(each, ends[:-1]) for each in dwells), strict=True):
        dwell, lit = np.maximum(end - start, 0.0), end > start
        spread = float(end[lit].max() - start[lit].min()) if lit.any() else 0.0
        sums = per_pulse * x.size * y.size * max(float(dwell.mean()) / collection.pulse_interval, 1.0)
        seconds.append(sums + profiles * collection.n_range_frequency * spread / collection.pulse_interval)
    return seconds


def gpu_seconds(geometry: Geometry, grid: Grid, windows: Sequence[tuple[slice, slice]]) -> float:
    """Seconds to form windows of the image together on a GPU, from one reading of the samples."""
    rows, columns = window_around(windows)
    collection, pixels = geometry.collection, (rows.stop - rows.start) * (columns.stop - columns.start)
    (sums,) = projection_seconds(geometry, [(grid.x[columns], grid.y[rows])], GPU_UPDATE, profiles=0.0)
    return sums + GPU_PIXEL * pixels + GPU_SAMPLE * collection.n_pulse * collection.n_range_frequency
