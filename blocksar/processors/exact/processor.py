"""Exact back-projection as a processor: chunks of the image directly from the samples."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.chunks import BACKPROJECTION_CHUNK
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.sampling import refuse_departures
from blocksar.collection.weighting import Weighting
from blocksar.errors import InputError
from blocksar.graph import compiling
from blocksar.imaging.backprojection import ReadPulses
from blocksar.imaging.method import ChainOptions, Method
from blocksar.inspection.samples import doubts_of_track
from blocksar.kernels.device import on_device
from blocksar.planning import effort
from blocksar.planning.tiling import chunks_of, window_around
from blocksar.processors.base import ChunkPlan, ImagePlan, Problem, Window
from blocksar.processors.exact.memory import checked_back_projection_memory, gpu_back_projection_memory
from blocksar.processors.exact.sums import form_image
from blocksar.processors.sentences import lit_pulses
from blocksar.progress import Work
from blocksar.texts import count, size_text

if TYPE_CHECKING:
    from blocksar.tasks.forming import Form, FormParts


class Backprojection:
    """Exact back-projection: slow, and the reference for all others.

    It keeps the chains' options at their defaults in the settings of runs, where other programs have read them.
    """

    name = "backprojection"
    summary = "exact but slow"
    options = ChainOptions
    universal = True
    general = True
    compared = True
    on_gpu = True

    def check(self, options: Any) -> None:
        """Refuse the options of chains.

        Raises
        ------
        InputError
            If one is.
        """
        Method(**asdict(options))  # their values are some
        if departures := options.departures:
            raise InputError(f"processor {self.name} has no {' or '.join(departures)} to choose; leave it out")

    def plan(self, problem: Problem) -> ImagePlan:
        """Plan an image without dividing it.

        Raises
        ------
        InputError
            If the grid is missing, a worker has too little memory, or a bistatic collection is to be imaged on a
            terrain, of whose layers none is known for two antennas.
        """
        if problem.terrain is not None:
            for each in problem.collections:
                refuse_departures("a terrain", each.two_antennas, FLAT)
        grid, machine = problem.points, problem.machine
        chunks = None if problem.device == "cpu" else GPU_CHUNKS
        memory = max(
            checked_back_projection_memory(each, grid, machine.threads, machine.memory_limit, chunks)
            for each in problem.collections
        )
        on_gpu = [
            0 if chunks is None else gpu_back_projection_memory(each, grid, chunks) for each in problem.collections
        ]
        return BackprojectionPlan(
            processor=self.name, grid=grid, pieces=problem.pieces, terrain=problem.terrain, needed=memory,
            device=problem.device, chunks=chunks or (1, 1), on_gpu=max(on_gpu),
        )  # fmt: skip


EXACT = Backprojection()
FLAT = "leave the terrain out, and give ground_height"
GPU_CHUNKS = (8, 8)  # of the image, in a unit of work: enough that reading and transforming the samples costs little


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class BackprojectionPlan(ChunkPlan):
    """Plan of an image by exact back-projection."""

    @property
    def result(self) -> Grid:
        return self.grid

    def seconds(self, geometry: Geometry, x: FloatArray, y: FloatArray) -> float:
        return effort.projection_seconds(geometry, [(x, y)])[0]

    def work(self) -> Work:
        geometries = [piece.geometry for piece in self.pieces]
        if self.device == "cpu":  # as `ChunkPlan.work`, with all chunks at once
            chunks = chunks_of(self.grid)
            each = [effort.projection_seconds(geometry, chunks) for geometry in geometries]
            costs = [sum(parts) for parts in zip(*each, strict=True)]
        else:
            costs = [
                sum(effort.gpu_seconds(each, self.grid, windows) for each in geometries)
                for windows in self.parts().values()
            ]
        return effort.of_parts(geometries, self.grid, self.processor, costs)

    def forming(self, weighting: Weighting) -> Form:
        return partial(form_parts, weighting=weighting)

    def forming_parts(self, number: int, weighting: Weighting) -> FormParts:
        if self.device == "cpu":
            return super().forming_parts(number, weighting)
        return partial(form_together, weighting=weighting, device=self.device, memory=self.on_gpu)

    def loops(self) -> Sequence[str]:
        return compiling.PULSES

    def lines(self) -> list[str]:
        pixels = self.grid.shape[0] * self.grid.shape[1]
        lit = sum(lit_pulses(piece.geometry, self.grid) for piece in self.pieces)
        doubts = (line for piece in self.pieces for line in doubts_of_track(piece.geometry.collection, exact=True))
        return [
            f"exact back-projection of {self.grid.shape[1]} x {self.grid.shape[0]} pixels, {count(lit, 'lit pulse')} "
            "each: "
            f"{pixels * lit / 1e9:.3g} G updates at most",
            *self.memory_lines(),
            f"a run writes at most {size_text(self.stored_bytes())}",
            *dict.fromkeys(doubts),
            *self._of_two_antennas(),
            *self.notes(),
        ]

    def _of_two_antennas(self) -> list[str]:
        if self.device == "cpu" or not any(piece.geometry.collection.bistatic for piece in self.pieces):
            return []
        return ["the sums of bistatic collections are computed on the CPU"]


def form_parts(
    read: ReadPulses, geometry: Geometry, x: FloatArray, y: FloatArray, *, threads: int, weighting: Weighting
) -> ComplexArray:
    """Form an image as `form_image` does, in parts that bound its memory."""
    image = np.empty((y.size, x.size), np.complex64)
    for i in range(0, y.size, BACKPROJECTION_CHUNK):
        for j in range(0, x.size, BACKPROJECTION_CHUNK):
            rows, columns = slice(i, i + BACKPROJECTION_CHUNK), slice(j, j + BACKPROJECTION_CHUNK)
            image[rows, columns] = form_image(
                read, geometry, x[columns], y[rows], threads=threads, weighting=weighting
            )  # fmt: skip
    return image


def form_together(
    read: ReadPulses, geometry: Geometry, x: FloatArray, y: FloatArray, windows: Sequence[Window], *, threads: int,
    weighting: Weighting, device: str, memory: int,
) -> Iterator[tuple[Window, ComplexArray]]:  # fmt: skip
    """Form the bounding box of windows in one pass over the samples."""
    rows, columns = window_around(windows)
    with on_device(device, memory) as opened:
        image = form_image(read, geometry, x[columns], y[rows], threads=threads, weighting=weighting, device=opened)
    for window in windows:
        yield (
            window,
            image[
                window[0].start - rows.start : window[0].stop - rows.start,
                window[1].start - columns.start : window[1].stop - columns.start,
            ],
        )
