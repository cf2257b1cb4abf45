"""Hierarchical back-projection as a processor: parts of the image from data decimated to their bandwidth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from blocksar.collection.weighting import Weighting
from blocksar.graph import compiling
from blocksar.inspection.samples import doubts_of_track
from blocksar.planning import effort
from blocksar.planning.memory import MEMORY_SHARE, PROCESS_MEMORY, checked_memory
from blocksar.processors.base import ImagePlan, NoOptions, PartPlan, Problem
from blocksar.processors.hierarchy.division import Division, coherence_of, divide
from blocksar.processors.hierarchy.parts import form_windows
from blocksar.progress import Work
from blocksar.texts import count, size_text

if TYPE_CHECKING:
    from blocksar.tasks.forming import FormParts


class HierarchicalBackprojection:
    """Back-projection by a hierarchy of parts: any track, beam and ground, with an error that `fidelity` sets.

    See `processors.hierarchy.derivation` for the derivation. Between the levels nothing is stored: a unit of work reads
    its samples in pieces, decimates them at once, and writes chunks of the image.
    """

    name = "hierarchical-backprojection"
    summary = "as exact as is asked for, any geometry"
    options = NoOptions
    universal = True
    compared = True
    on_gpu = True

    def check(self, options: Any) -> None:
        """Accept the options: there are none."""

    def plan(self, problem: Problem) -> ImagePlan:
        """Plan an image: the levels, and the parts that tasks form.

        Raises
        ------
        InputError
            If the grid is missing, or a worker has too little memory.
        """
        grid, pieces, machine = problem.points, problem.pieces, problem.machine
        share = PROCESS_MEMORY + (MEMORY_SHARE * machine.memory_limit - PROCESS_MEMORY) / len(pieces)
        divisions = tuple(
            divide(
                piece.geometry, grid, fidelity=problem.fidelity, weighting=problem.weighting,
                workers=max(machine.workers, 1), memory_limit=share, device=problem.device,
            )
            for piece in pieces
        )  # fmt: skip
        coherence = min(coherence_of(each.error) for each in divisions)
        memory = PROCESS_MEMORY + sum(each.memory - PROCESS_MEMORY for each in divisions)
        return HierarchicalPlan(
            processor=self.name, grid=grid, pieces=pieces, terrain=problem.terrain, divisions=divisions,
            device=problem.device, on_gpu=sum(each.on_gpu for each in divisions),
            chunks=(min(each.chunks[0] for each in divisions), min(each.chunks[1] for each in divisions)),
            needed=checked_memory("hierarchical back-projection", memory, machine.memory_limit),
            coherence=coherence, faithful=coherence >= problem.fidelity,
        )  # fmt: skip


HIERARCHICAL = HierarchicalBackprojection()


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class HierarchicalPlan(PartPlan):
    """Plan of an image by hierarchical back-projection; `divisions` holds that of each collection."""

    divisions: tuple[Division, ...]

    def forming_parts(self, number: int, weighting: Weighting) -> FormParts:
        return partial(
            form_windows, levels=self.divisions[number].levels, weighting=weighting, device=self.device,
            memory=self.on_gpu,
        )  # fmt: skip

    def work(self) -> Work:
        count, seconds = len(self.parts()), sum(each.seconds for each in self.divisions)
        geometries = [piece.geometry for piece in self.pieces]
        return effort.of_parts(geometries, self.grid, self.processor, [seconds / count] * count)

    def loops(self) -> Sequence[str]:
        return *compiling.PULSES, *compiling.HIERARCHY

    def lines(self) -> list[str]:
        worst = max(self.divisions, key=lambda each: each.error)
        sides = " > ".join(f"{side:.3g}" for side in worst.levels.sides)
        divided = f"divided into parts of at most {sides} m" if sides else "each summed as a whole"
        error = -10 * math.log10(worst.error)
        doubts = (line for piece in self.pieces for line in doubts_of_track(piece.geometry.collection, exact=True))
        return [
            f"hierarchical back-projection of {self.grid.shape[1]} x {self.grid.shape[0]} pixels in "
            f"{count(len(self.parts()), 'part')} of {self.chunks[1]} x {self.chunks[0]} chunks, {divided}",
            f"predicted coherence with exact back-projection: at least {self.coherence:.8f}; errors are "
            f"{error:.0f} dB below the power of all that a part's data hold, bright places beside it as well",
            *self.memory_lines(),
            f"a run writes at most {size_text(self.stored_bytes())}",
            *dict.fromkeys(doubts),
            *self.notes(),
        ]
