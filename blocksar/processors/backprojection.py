"""Exact back-projection as a processor: chunks of the image straight from the samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.chunks import BACKPROJECTION_CHUNK
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.weighting import Weighting
from blocksar.constants import MIB
from blocksar.errors import InputError
from blocksar.focusing.backprojection import ReadPulses, form_image
from blocksar.focusing.method import ChainOptions, Method
from blocksar.graph import compiling
from blocksar.inspection.sentences import doubts_of_track
from blocksar.planning import effort
from blocksar.planning.memory import checked_back_projection_memory
from blocksar.processors.base import ChunkPlan, ImagePlan, Problem
from blocksar.processors.lines import lit_pulses

if TYPE_CHECKING:
    from blocksar.graph.tasks import Form


class Backprojection:
    """Exact back-projection: slow, and the reference for all others.

    It keeps the chains' options at their defaults in the settings of runs, where other programs have read them.
    """

    name = "backprojection"
    summary = "exact but slow"
    options = ChainOptions
    universal = True
    compared = True

    def check(self, options: Any) -> None:
        """Check that no option of chains is chosen.

        Raises
        ------
        InputError
            If one is.
        """
        Method(**asdict(options))  # their values are some
        if departures := options.departures:
            raise InputError(f"processor {self.name} has no {' or '.join(departures)} to choose; leave it out")

    def plan(self, problem: Problem) -> ImagePlan:
        """Plan an image; nothing is divided.

        Raises
        ------
        InputError
            If the grid is missing, or a worker has too little memory.
        """
        grid, machine = problem.points, problem.machine
        memory = max(
            checked_back_projection_memory(each, grid, machine.threads, machine.memory_limit)
            for each in problem.collections
        )
        return BackprojectionPlan(
            processor=self.name, grid=grid, pieces=problem.pieces, terrain=problem.terrain, needed=memory
        )


EXACT = Backprojection()


@dataclass(frozen=True, kw_only=True, eq=False)
class BackprojectionPlan(ChunkPlan):
    """The plan of an image by exact back-projection."""

    @property
    def result(self) -> Grid:
        return self.grid

    def seconds(self, geometry: Geometry, x: FloatArray, y: FloatArray) -> float:
        return effort.projection_seconds(geometry, x, y)

    def forming(self, weighting: Weighting) -> Form:
        return partial(form_parts, weighting=weighting)

    def loops(self) -> Sequence[str]:
        return compiling.PATTERNS

    def lines(self) -> list[str]:
        pixels = self.grid.shape[0] * self.grid.shape[1]
        lit = sum(lit_pulses(piece.geometry, self.grid) for piece in self.pieces)
        doubts = (line for piece in self.pieces for line in doubts_of_track(piece.geometry.collection, exact=True))
        return [
            f"exact back-projection of {self.grid.shape[1]} x {self.grid.shape[0]} pixels, {lit} lit pulses each: "
            f"{pixels * lit / 1e9:.3g} G updates at most",
            f"peak memory of a worker {self.needed / MIB:.0f} MiB",
            f"a run writes at most {sum(self.stored().values()) / MIB:.0f} MiB",
            *dict.fromkeys(doubts),
        ]


def form_parts(
    read: ReadPulses, geometry: Geometry, x: FloatArray, y: FloatArray, *, threads: int, weighting: Weighting
) -> ComplexArray:
    """`form_image`, by parts that bound its memory."""
    image = np.empty((y.size, x.size), np.complex64)
    for i in range(0, y.size, BACKPROJECTION_CHUNK):
        for j in range(0, x.size, BACKPROJECTION_CHUNK):
            rows, columns = slice(i, i + BACKPROJECTION_CHUNK), slice(j, j + BACKPROJECTION_CHUNK)
            image[rows, columns] = form_image(
                read, geometry, x[columns], y[rows], threads=threads, weighting=weighting
            )  # fmt: skip
    return image
