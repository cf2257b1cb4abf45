"""Exact back-projection as a processor: chunks of the image straight from the samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from blocksar.collection.geometry import Geometry, over_terrain
from blocksar.collection.grid import Grid
from blocksar.collection.terrain import Terrain
from blocksar.constants import MIB
from blocksar.errors import InputError
from blocksar.focusing.method import ChainOptions, Method
from blocksar.graph import compiling
from blocksar.inspection.sentences import doubts_of_track
from blocksar.planning import effort
from blocksar.planning.disk import exact_bytes
from blocksar.planning.memory import checked_back_projection_memory
from blocksar.planning.segments import joint_grid
from blocksar.processors.base import Execution, ImagePlan, Piece, Problem
from blocksar.processors.lines import lit_pulses
from blocksar.progress import Work
from blocksar.runs.record import Receipt


class Backprojection:
    """Exact back-projection: slow, and the reference for all others.

    It keeps the chains' options at their defaults in the settings of runs, where other programs have read them.
    """

    name = "backprojection"
    summary = "exact but slow"
    options = ChainOptions
    universal = True

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
        collections, terrain = problem.collections, problem.terrain
        grid = problem.grid or joint_grid([Geometry(collection=collection) for collection in collections])
        geometries = [
            Geometry(collection=each) if terrain is None else over_terrain(each, terrain) for each in collections
        ]
        memory = max(
            checked_back_projection_memory(each, grid, problem.machine.threads, problem.machine.memory_limit)
            for each in collections
        )
        pieces = tuple(
            Piece(collection=number, geometry=each, first_block=number) for number, each in enumerate(geometries)
        )
        return BackprojectionPlan(processor=self.name, grid=grid, pieces=pieces, terrain=terrain, needed=memory)


EXACT = Backprojection()


@dataclass(frozen=True, kw_only=True, eq=False)
class BackprojectionPlan(ImagePlan):
    """The plan of an image by exact back-projection; `needed` is a worker's memory, bytes."""

    terrain: Terrain | None
    needed: int

    @property
    def result(self) -> Grid:
        return self.grid

    def memory(self, threads: int) -> int:
        return self.needed

    def work(self, *, workers: int) -> Work:
        return effort.together([effort.of_backprojection(piece.geometry, self.grid) for piece in self.pieces])

    def stored(self) -> dict[str, int]:
        noise = any(piece.geometry.collection.noise_power for piece in self.pieces)
        return exact_bytes(self.grid, self.terrain, noise=noise)

    def loops(self) -> Sequence[str]:
        return compiling.PATTERNS

    def lines(self, *, compared: bool = False) -> list[str]:
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

    def form(self, execution: Execution) -> list[Receipt]:
        """Form chunks of the image from the samples.

        Raises
        ------
        InputError, ProcessingError
            As the stages.
        """
        from blocksar.graph import stages  # with dask

        client, run, listener, segments = execution.client, execution.run, execution.listener, execution.segments
        read = execution.joined(stages.inspect_samples(client, segments, run, listener))
        execution.end("inspect")
        execution.accept(read)
        execution.input_read()
        inspections = [each.inspection for each in read]
        noises = execution.noises([inspection.lit for inspection in inspections])
        formed = stages.back_project(
            client, segments, self.grid, inspections, execution.weighting, noises, run, listener
        )  # fmt: skip
        execution.end("backprojection")
        return [*(receipt for each in read for receipt in each.receipts), *formed]
