"""The chains of the three papers as processors: recovery, blocks focused by a list of steps, mosaic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import chain
from typing import TYPE_CHECKING, Any

from blocksar.focusing.method import Chain as Name
from blocksar.focusing.method import ChainOptions, Method
from blocksar.graph import compiling
from blocksar.planning import effort
from blocksar.planning.disk import run_bytes
from blocksar.planning.plan import Plan
from blocksar.planning.planner import planner_of
from blocksar.planning.segments import PlannedSegment, plan_segments
from blocksar.processors.base import Execution, ImagePlan, Problem
from blocksar.processors.chain_lines import (
    cut_dwells,
    jittering_beam,
    missed_fidelity,
    outside_window,
    plan_lines,
    short_dwells,
    undersampling,
)
from blocksar.processors.chain_tables import block_table, plan_details
from blocksar.progress import Work
from blocksar.runs.record import PredictedBlock, Receipt
from blocksar.tables import Table
from blocksar.texts import size_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class Chain:
    """A chain of steps: those of `focusing.chains`."""

    name: Name
    summary: str
    compared: bool = False
    on_gpu: bool = False
    options = ChainOptions
    universal = False

    def check(self, options: Any) -> None:
        """Check options together.

        Raises
        ------
        InputError
            As `Method`.
        """
        self.method(options)

    def method(self, options: ChainOptions) -> Method:
        """The chain with its options."""
        return Method(processor=self.name, **asdict(options))

    def plan(self, problem: Problem) -> ChainPlan:
        """Plan an image.

        Raises
        ------
        InputError
            As `planning.segments.plan_segments`.
        """
        machine, grid, collections = problem.machine, problem.grid, problem.collections
        plan = planner_of(
            self.method(problem.options), blocks=problem.blocks, fidelity=problem.fidelity,
            weighting=problem.weighting, terrain=problem.terrain, workers=machine.workers,
            memory_limit=machine.memory_limit,
        )  # fmt: skip
        if problem.terrain is not None:  # the grid that its heights were read for
            grid = problem.points
        return chain_plan(self.name, plan_segments(plan, collections, grid=grid, cut=problem.blocks == "auto"))


ANGULAR_DIVISION = Chain("angular-division", "the chain of the main paper", compared=True)
KEYSTONE_RESAMPLING = Chain("keystone-resampling", "keystone transform, then resampling in Doppler")
HIGH_ORDER_PHASE = Chain("high-order-phase", "a phase of high order in Doppler, without keystone transform")


def chain_plan(name: str, segments: Sequence[PlannedSegment]) -> ChainPlan:
    """The plan of an image from those of its segments."""
    plans = [each.plan for each in segments if each.plan is not None]
    refusal = next((plan.refusal for plan in plans if plan.refusal is not None), None)
    return ChainPlan(
        processor=name, grid=plans[0].grid, pieces=tuple(segments), refusal=refusal,
        coherence=min(plan.coherence for plan in plans), faithful=all(plan.faithful for plan in plans),
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class ChainPlan(ImagePlan):
    """The plan of an image by a chain: one of its own for each collection, or for each part of it along time."""

    @cached_property
    def plans(self) -> list[Plan]:
        """Plan of each segment."""
        return [piece.plan for piece in self.pieces if piece.plan is not None]

    @property
    def result(self) -> Plan | tuple[Plan, ...]:
        return self.plans[0] if len(self.plans) == 1 else tuple(self.plans)

    def memory(self, threads: int) -> int:
        return max(plan.memory_of(threads) for plan in self.plans)

    def work(self) -> Work:
        return effort.together([effort.of_plan(plan) for plan in self.plans])

    def stored(self) -> dict[str, int]:
        return run_bytes(*self.plans)

    def blocks(self) -> tuple[PredictedBlock, ...]:
        return tuple(chain.from_iterable(map(predicted_blocks, self.plans)))

    def loops(self) -> Sequence[str]:
        return (*(compiling.WEIGHTS if any(plan.blends for plan in self.plans) else ()),)

    def notes(self) -> list[str]:
        doubts = undersampling, short_dwells, cut_dwells, jittering_beam, missed_fidelity
        found = [next((line for plan in self.plans if (line := doubt(plan))), None) for doubt in doubts]
        return [*filter(None, found), *outside_window(self.plans)]

    def lines(self) -> list[str]:
        if len(self.plans) == 1:
            return [*plan_lines(self.plans[0], compared=self.compared is not None), *outside_window(self.plans)]
        lines = []
        for number, piece in enumerate(self.pieces):
            plan = self.plans[number]
            pulses = "" if piece.pulses is None else f", pulses {piece.pulses[0]} .. {piece.pulses[1] - 1}"
            blocks = f"blocks {piece.first_block} .. {piece.first_block + plan.n_blocks - 1}"
            lines.append(f"segment {number} (collection {piece.collection}{pulses}, {blocks}):")
            lines += [f"  {line}" for line in plan_lines(plan)]
        return [*lines, *outside_window(self.plans)]

    def tables(self) -> list[Table]:
        return [block_table(self.plans)]

    def details(self) -> list[Table]:
        return plan_details(self.plans)

    def headline(self) -> str:
        if len(self.plans) > 1:
            return self.lines()[0]
        return f"{self.plans[0].headline()}, {size_text(sum(self.stored().values()))} on the disk"

    def draw(self, axes: Axes | None) -> Axes:
        from blocksar.products.pictures.planned import draw_plan  # optional, and slow to load

        plan = self.plans[0]
        return draw_plan(plan.geometry, plan.grid, blocks=plan.blocks, region=plan.region, axes=axes)

    def form(self, execution: Execution) -> list[Receipt]:
        """Recover the spectrum, focus its blocks, lay them side by side.

        Raises
        ------
        InputError, ProcessingError
            As the stages.
        """
        from blocksar.graph import stages  # with dask

        client, run, listener, segments = execution.client, execution.run, execution.listener, execution.segments
        recovered = execution.joined(stages.recover(client, segments, run, listener))
        execution.end("recover")
        execution.accept(recovered)
        execution.input_read()
        gated = stages.gate_ranges(client, segments, run, recovered, listener)
        if any(gated):
            execution.end("gate")
        receipts = [(*each.receipts, *some) for each, some in zip(recovered, gated, strict=True)]
        inspections = [each.inspection for each in recovered]
        noises = execution.noises([inspection.lit for inspection in inspections])
        patches = stages.focus_blocks(client, segments, run, receipts, inspections, noises, listener)
        execution.end("focus")
        if execution.discard:
            stages.discard_spectra(segments, run, receipts)
        merged = stages.mosaic(client, segments, run, patches, noises, listener)
        execution.end("mosaic")
        layers = stages.layers_of_blocks(client, segments, run, patches, listener)
        if layers:
            execution.end("layers")
        read = chain.from_iterable(each.receipts for each in recovered)
        return [*read, *chain(*gated), *patches, *merged, *layers]


def predicted_blocks(plan: Plan) -> tuple[PredictedBlock, ...]:
    """Find what a plan predicts of each block."""
    return tuple(
        PredictedBlock(
            block=block.index,
            part=block.part,
            yaw=(block.low, block.high),
            range=(block.ground.near, block.ground.far),
            memory=block.memory,
            bias=block.choice.candidate.bias,
            **block.prediction._asdict(),
        )
        for block in plan.blocks
    )
