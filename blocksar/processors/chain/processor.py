"""The chains of the three papers as processors: recovery, blocks focused by a list of steps, mosaic.

A plan is described by tables, and by sentences, one a line.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from itertools import chain, product
from typing import TYPE_CHECKING, Any

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.budget import side_lobe_budget
from blocksar.collection.collection import Collection
from blocksar.collection.grid import folds, ground_spectrum
from blocksar.constants import MIB
from blocksar.errors import InputError, OutsideSwath
from blocksar.graph import compiling
from blocksar.imaging.method import Chain as Name
from blocksar.imaging.method import ChainOptions, Method
from blocksar.inspection.samples import doubts_of_track
from blocksar.measurement.axes import MIN_OVERSAMPLING, response_axes
from blocksar.planning import effort
from blocksar.processors.base import (
    Bound,
    Execution,
    ImagePlan,
    PlannedSegment,
    Problem,
    outside_window,
    usual_seconds,
)
from blocksar.processors.chain.dwells.dwell_ends import reaches_full
from blocksar.processors.chain.planning import stage_work
from blocksar.processors.chain.planning.block import BlockPlan
from blocksar.processors.chain.planning.plan import Plan
from blocksar.processors.chain.planning.planner import (
    DivisionPlanner,
    explain_refusal,
    fewest_blocks,
    plan_collection,
    prepare_division,
)
from blocksar.processors.chain.planning.probes import find_shortfall, plan_coarsest, prepare_segment
from blocksar.processors.chain.planning.strip_segments import plan_segments
from blocksar.processors.chain.planning.written_bytes import run_bytes
from blocksar.processors.chain.tables import block_table, plan_details
from blocksar.processors.sentences import lit_pulses
from blocksar.progress import Work
from blocksar.runs.record import PredictedBlock, Receipt
from blocksar.table import Table
from blocksar.texts import count, digits, size_text, time_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from blocksar.graph.machine import Resources

OTHER, SMALLER, TAPER = (
    "try --processor auto", "image a smaller --grid", "taper the dwells, for example with --weighting-azimuth hann"
)  # fmt: skip
# Remedies where no number of blocks suffices, by the main cause of lost coherence.
REMEDIES = {
    "residual phase": (OTHER, SMALLER),
    "range migration": (OTHER, SMALLER),
    "the ends of the dwell": (OTHER, TAPER),
    "noise of the track": ("smooth the positions",),
}


def describe_shortfall(plan: Plan, *, compared: bool = False) -> str:
    """Describe the fidelity that is not kept, and the best remedy; `compared`: the plan is the best of several."""
    worst = max(plan.blocks, key=lambda block: block.prediction.excess(plan.fidelity))
    p = worst.prediction
    losses = {
        "residual phase": p.phase_loss, "range migration": p.range_loss, "the ends of the dwell": p.dispersion_loss,
        "noise of the track": p.track_loss,
    }  # fmt: skip
    cause = max(losses, key=losses.__getitem__)
    if plan.searched:
        useless = {OTHER} if compared else set()
        useless |= set() if plan.weighting.azimuth.uniform else {TAPER}  # where dwells have one
        ways = [way for way in REMEDIES[cause] if way not in useless]
        remedy = ", or ".join([*ways, "take --processor backprojection, which is exact"])
    elif cause == "noise of the track":
        remedy = REMEDIES[cause][0]
    else:
        remedy = "ask for more --blocks, or for --blocks auto"
    if plan.method.variant:
        remedy += ", or leave the alternative methods out"
    if 1 - p.coherence > 1 - plan.fidelity:
        subject, figure = f"fidelity {plan.fidelity:.12g} is", f"coherence {p.coherence:.6g}"
    else:  # stated separately, since it is not about coherence
        allowed = side_lobe_budget(plan.fidelity, p.ideal_pslr)
        subject = f"fidelity {plan.fidelity:.12g} is kept in coherence, but side lobes to {allowed:.2g} dB are"
        figure = f"side lobes of {p.pslr:.2f} dB instead of {p.ideal_pslr:.2f}"
    if plan.searched:
        closest = "block comes" if plan.n_blocks == 1 else "blocks come"
        return (
            f"{subject} not kept by any division that was tried: {plan.n_blocks} {closest} closest, with {figure} "
            f"predicted in block {worst.name}, and most is lost by {cause}; {remedy}"
        )
    return f"{subject} not kept: block {worst.name} predicts {figure}, and most is lost by {cause}; {remedy}"


TRACK_TOLD = 0.01  # rad: noise of the track that leaves less is not mentioned
PLACES = 9  # of a block along range and yaw, at which full dwells are looked for
MEASURED_AT = 5  # points along a side of a grid, whose responses tell which steps they are measured on
SHORT_DWELL = 12  # pulses, below which a coherence of up to 0.002 less than is predicted was measured


def plan_lines(plan: Plan, *, compared: bool = False) -> list[str]:
    """Describe a plan in sentences besides its tables; `compared` as for `describe_shortfall`."""
    recovery, collection, grid = plan.recovery, plan.geometry.collection, plan.grid
    spectrum = recovery.doppler.size * collection.n_range_frequency * 8
    blocks = count(plan.n_blocks, "block")
    if plan.parts > 1:
        blocks += f" of {plan.parts} range sub-blocks{' each' if plan.n_blocks > 1 else ''}"
    lines = [
        f"{blocks}, {plan.method.coefficients} coefficients; "
        f"track: {plan.geometry.track}, misfit {plan.geometry.track.max_misfit:.2g} m",
        f"derotated band {recovery.band[1] - recovery.band[0]:.0f} Hz at PRF {collection.prf:.0f} Hz; recovered "
        f"spectrum {recovery.doppler.size} x {collection.n_range_frequency} ({size_text(spectrum)}), "
        f"{recovery.doppler.extent:.0f} Hz wide",
        f"image {grid.shape[1]} x {grid.shape[0]} pixels: x {grid.x[0]:g} .. {grid.x[-1]:g} m every {grid.dx:g} m, "
        f"y {grid.y[0]:g} .. {grid.y[-1]:g} m every {grid.dy:g} m",
    ]
    if plan.geometry.terrain is not None:
        low, high = plan.geometry.terrain.limits
        lines.append(f"terrain: z = {low:.5g} .. {high:.5g} m; blocks are fitted on its smooth part")
    share = plan.full_dwell_share
    lines.append(
        f"predicted coherence with exact back-projection: at least {digits(plan.coherence)} for targets with full dwell"
        + (f" ({100 * share:.0f} % of the grid)" if 0 < share < 1 else "")
    )
    if not plan.weighting.uniform:
        azimuth = plan.weighting.azimuth.ideal.pslr
        lines.append(
            f"weighting {plan.weighting.text}: ideal side lobes {plan.weighting.range.ideal.pslr:.2f} dB in range, "
            f"{azimuth:.2f} dB in azimuth"
        )
    lines.append(_disk_line(plan))
    lines += doubts_of_track(plan.geometry.collection)
    doubts = undersampling, short_dwells, cut_dwells, cut_lobes, jittering_beam
    lines += [line for doubt in doubts if (line := doubt(plan)) is not None]
    noise = max(block.prediction.track_phase for block in plan.blocks)
    if noise > TRACK_TOLD:
        lines.append(
            f"the noise of the track leaves a phase of {noise:.2g} rad r.m.s. over a dwell; smooth the positions"
        )
    if not plan.faithful:
        lines.append(describe_shortfall(plan, compared=compared))
    return lines


def missed_fidelity(plan: Plan) -> str | None:
    """State that the best division found does not keep the fidelity; None if it does."""
    return describe_shortfall(plan) if plan.searched and not plan.faithful and plan.refusal is None else None


def cut_dwells(plan: Plan) -> str | None:
    """Warn that no point of the grid has a full dwell, which the prediction assumes; None if one has."""
    if plan.full_dwell_share > 0:
        return None
    return (
        "no point of the grid is lit for a full dwell: the prediction holds for none, and cut dwells differ more from "
        "back-projection"
    )


def cut_lobes(plan: Plan) -> str | None:
    """Warn that blocks have cut dwells only, so that the weighting is cut and side lobes rise; None if not."""
    if plan.weighting.azimuth.uniform:
        return None
    cut = [block for block in plan.blocks if not reaches_full(plan.geometry, *_places(block))]
    if not cut:
        return None
    worst = max(cut, key=lambda block: block.prediction.ideal_pslr)
    verb = "has" if len(cut) == 1 else "have"
    some = f"{len(cut)} of {len(plan.blocks)} blocks {verb}" if len(plan.blocks) > 1 else "the block has"
    return (
        f"{some} no full dwell: the weighting of cut dwells is cut as well, with side lobes of up to "
        f"{worst.prediction.ideal_pslr:.2f} dB in back-projection (block {worst.name})"
    )


def _places(block: BlockPlan) -> tuple[FloatArray, FloatArray]:
    """Epoch ranges and yaws of some places in a block."""
    ground = block.ground
    return np.linspace(ground.near, ground.far, PLACES), np.linspace(block.low, block.high, PLACES)


def _disk_line(plan: Plan) -> str:
    """Describe the disk space of a run, without the range compression of a raw echo, which plans do not know."""
    stores = run_bytes(plan)
    parts = ", ".join(f"{name} {size / MIB:.0f}" for name, size in stores.items())
    return f"a run writes about {sum(stores.values()) / MIB:.0f} MiB ({parts})"


def undersampling(plan: Plan) -> str | None:
    """Warn that spectra fold on the grid in a block, or are too wide to be measured; None if not."""
    grid, places = plan.grid, [((b.ground.near + b.ground.far) / 2, (b.low + b.high) / 2) for b in plan.blocks]
    folded = any(folds(ground_spectrum(plan.geometry, *place), grid.dx, grid.dy) for place in places)
    if not (bands := list(_bands(plan))):
        return None
    needed = [_rounded_down(1 / (2 * MIN_OVERSAMPLING * max(each))) for each in zip(*bands, strict=True)]
    if not folded and grid.dx <= needed[0] and grid.dy <= needed[1]:
        return None
    steps = f"the grid's steps of {grid.dx:g} x {grid.dy:g} m"
    enough = f"{needed[0]:.2g} m in x and {needed[1]:.2g} m in y"
    if folded:
        return (
            f"{steps} undersample the image: spectra fold, and targets between its points are lost; steps of {enough} "
            "show everything"
        )
    return f"{steps} hold the image, but `blocksar quality` measures responses on steps of at most {enough}"


def _bands(plan: Plan) -> Iterator[tuple[float, float]]:
    """Iterate over the largest wavenumbers in x and y, cycles/m, of responses at some lit points of the grid."""
    x, y = (np.linspace(axis[0], axis[-1], MEASURED_AT) for axis in (plan.grid.x, plan.grid.y))
    for at in product(x.tolist(), y.tolist()):
        if (axes := response_axes(plan.geometry, *at)) is not None:
            yield float(axes.band[0]), float(axes.band[1])


def _rounded_down(value: float) -> float:
    """Round down to two significant digits.

    Examples
    --------
    >>> _rounded_down(0.0159), _rounded_down(3.0)
    (0.015, 3.0)
    """
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.floor(value / unit * (1 + 1e-12)) * unit:.2g}")


def short_dwells(plan: Plan) -> str | None:
    """Warn that no point of the grid is lit by enough pulses; None if one is."""
    n_pulse, lit = plan.geometry.collection.n_pulse, lit_pulses(plan.geometry, plan.grid)
    if lit >= SHORT_DWELL or n_pulse < SHORT_DWELL:
        return None
    return (
        f"a target is lit by at most {lit} of {n_pulse} pulses, and predictions hold from {SHORT_DWELL} pulses "
        "on; is beam_width in rad, and what says where the beam points?"
    )


def jittering_beam(plan: Plan) -> str | None:
    """Warn that dwells are gated by a smoothed beam; None if not."""
    width = plan.geometry.collection.beam_width
    if not plan.away or width is None:
        return None
    return (
        f"the beam's pointing jitters by {np.rad2deg(plan.away):.2g} deg on average, {100 * plan.away / width:.2g} % "
        "of its width: dwells are gated by a smoothed beam"
    )


@dataclass(frozen=True)
class Chain:
    """A chain of steps: those of `processors.chain.steps.chains`."""

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
            As `processors.chain.planning.strip_segments.plan_segments`.
        """
        return self._plan(problem, {})

    def plan_within(self, problem: Problem, seconds: float) -> ImagePlan | Bound:
        """Plan an image, or say why it does not keep the fidelity in so many seconds: see
        `processors.chain.planning.probes`.

        Raises
        ------
        InputError
            As `plan`.
        """
        if problem.blocks != "auto":
            return self.plan(problem)
        machine, joint = problem.machine, problem.terrain is not None or len(problem.collections) > 1
        grid = problem.points if joint else problem.grid
        prepare = partial(
            prepare_division, method=self.method(problem.options), fidelity=problem.fidelity,
            weighting=problem.weighting, grid=grid, terrain=problem.terrain,
        )  # fmt: skip
        prepared: dict[int, DivisionPlanner] = {}
        works: list[Work] = []  # of what is known of each collection
        for collection in problem.collections:
            if (late := _is_late(works, machine, seconds)) is not None:
                return late
            try:
                segment = prepare_segment(prepare, collection, grid)
                if segment is not None and (short := find_shortfall(segment)) is not None:
                    return _unfaithful(short, segment)
                division = prepare(collection)
            except OutsideSwath:
                continue
            if (late := _is_late([*works, _least_work(division.undivided())], machine, seconds)) is not None:
                return late
            if segment is None and (coarse := division.middle(fewest_blocks(machine.workers))) is not None:
                if (late := _is_late([*works, _least_work(coarse)], machine, seconds)) is not None:
                    return late
                if (short := find_shortfall(division, coarse)) is not None:
                    return _unfaithful(short, division)
            works.append(_least_work(plan_coarsest(division, machine.workers)))
            prepared[id(collection)] = division
        if (late := _is_late(works, machine, seconds)) is not None:
            return late
        return self._plan(problem, prepared)

    def _plan(self, problem: Problem, prepared: Mapping[int, DivisionPlanner]) -> ChainPlan:
        """Plan an image; `prepared` has what is known of whole collections, by their identity."""
        machine, grid, collections = problem.machine, problem.grid, problem.collections

        def plan(collection: Collection, **more: Any) -> Plan:
            settings = {
                "method": self.method(problem.options), "blocks": problem.blocks, "fidelity": problem.fidelity,
                "weighting": problem.weighting, "terrain": problem.terrain, "workers": machine.workers,
                "memory_limit": machine.memory_limit, **more,
            }  # fmt: skip
            return plan_collection(collection, prepared=prepared.get(id(collection)), **settings)

        if problem.terrain is not None:  # the grid that its heights were read for
            grid = problem.points
        return chain_plan(self.name, plan_segments(plan, collections, grid=grid, cut=problem.blocks == "auto"))


def _least_work(plan: Plan) -> Work:
    """The work of what is planned; nothing is known of that of a plan that is refused."""
    return stage_work.of_plan(plan) if plan.refusal is None else {}


LEAST = 0.7  # of the time of the blocks of the coarsest division, that of finer ones: 0.75 was found, as lengths differ


def _is_late(works: Sequence[Work], machine: Resources, seconds: float) -> Bound | None:
    """Bound the time where works together, of coarsest divisions or parts of them, take more than so many seconds."""
    work = effort.together(works)
    needed = usual_seconds(work, machine)
    if needed <= seconds:
        return None
    least = usual_seconds({**work, "focus": [LEAST * each for each in work.get("focus", ())]}, machine)
    what = "its coarsest division" if work.get("focus") else "it"
    return Bound(f"{what} takes at least {time_text(needed)}", least)


def _unfaithful(short: Plan, division: DivisionPlanner) -> Bound:
    """Bound the coherence by that of a block of a fine division, which does not keep the fidelity.

    Raises
    ------
    InputError
        If the block cannot be focused at all.
    """
    if short.refusal is not None:
        raise InputError(explain_refusal(replace(short, searched=True), division))
    figure = f"coherence {short.coherence:.6g} at most"
    reason = f"even fine divisions do not keep the fidelity ({figure})"
    return Bound(reason, coherence=short.coherence, faithful=False)


ANGULAR_DIVISION = Chain("angular-division", "the chain of the main paper", compared=True)
KEYSTONE_RESAMPLING = Chain("keystone-resampling", "keystone transform, then resampling in Doppler")
HIGH_ORDER_PHASE = Chain("high-order-phase", "a phase of high order in Doppler, without keystone transform")


def chain_plan(name: str, segments: Sequence[PlannedSegment]) -> ChainPlan:
    """Combine the plans of an image's segments."""
    plans = [each.plan for each in segments if each.plan is not None]
    refusal = next((plan.refusal for plan in plans if plan.refusal is not None), None)
    return ChainPlan(
        processor=name, grid=plans[0].grid, pieces=tuple(segments), refusal=refusal,
        coherence=min(plan.coherence for plan in plans), faithful=all(plan.faithful for plan in plans),
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class ChainPlan(ImagePlan):
    """Plan of an image by a chain: one plan for each collection, or for each part of it along time."""

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
        return effort.together([stage_work.of_plan(plan) for plan in self.plans])

    def stored(self) -> dict[str, int]:
        return run_bytes(*self.plans)

    def blocks(self) -> tuple[PredictedBlock, ...]:
        return tuple(chain.from_iterable(map(predicted_blocks, self.plans)))

    def _outside(self) -> list[str]:
        return outside_window([(plan.geometry, plan.region) for plan in self.plans], self.grid)

    def loops(self) -> Sequence[str]:
        resampling = compiling.RESAMPLING if self.processor == "keystone-resampling" else ()
        return (*resampling, *(compiling.WEIGHTS if any(plan.blends for plan in self.plans) else ()))

    def notes(self) -> list[str]:
        doubts = undersampling, short_dwells, cut_dwells, jittering_beam, missed_fidelity
        found = [next((line for plan in self.plans if (line := doubt(plan))), None) for doubt in doubts]
        return [*filter(None, found), *self._outside()]

    def lines(self) -> list[str]:
        if len(self.plans) == 1:
            return [*plan_lines(self.plans[0], compared=self.compared is not None), *self._outside()]
        lines = []
        for number, piece in enumerate(self.pieces):
            plan = self.plans[number]
            pulses = "" if piece.pulses is None else f", pulses {piece.pulses[0]} .. {piece.pulses[1] - 1}"
            blocks = f"blocks {piece.first_block} .. {piece.first_block + plan.n_blocks - 1}"
            lines.append(f"segment {number} (collection {piece.collection}{pulses}, {blocks}):")
            lines += [f"  {line}" for line in plan_lines(plan)]
        return [*lines, *self._outside()]

    def tables(self) -> list[Table]:
        return [block_table(self.plans)]

    def details(self) -> list[Table]:
        return plan_details(self.plans)

    def headline(self) -> str:
        if len(self.plans) > 1:
            return self.lines()[0]
        return f"{self.plans[0].headline()}, {size_text(self.stored_bytes())} on the disk"

    def draw(self, axes: Axes | None) -> Axes:
        from blocksar.products.pictures.blocks import draw_plan  # optional, and slow to load

        plan = self.plans[0]
        return draw_plan(plan.geometry, plan.grid, blocks=plan.blocks, region=plan.region, axes=axes)

    def form(self, execution: Execution) -> list[Receipt]:
        """Recover the spectrum, focus its blocks, lay them side by side.

        Raises
        ------
        InputError, ProcessingError
            As the stages.
        """
        from blocksar.processors.chain.tasks import stages  # with dask

        executor, run, segments = execution.executor, execution.run, execution.segments
        recovered = execution.accept_read("recover", stages.recover(executor, segments, run))
        gated = stages.gate_ranges(executor, recovered, run)
        if gated:
            execution.end("gate")
        spectra = [*chain.from_iterable(each.receipts for each in recovered), *gated]
        patches = stages.focus_blocks(executor, recovered, run, spectra)
        execution.end("focus")
        if execution.discard:
            stages.discard_spectra(segments, run, spectra)
        merged = stages.mosaic(executor, recovered, run, patches)
        execution.end("mosaic")
        layers = stages.layers_of_blocks(executor, segments, run, patches)
        if layers:
            execution.end("layers")
        return [*spectra, *patches, *merged, *layers]


def predicted_blocks(plan: Plan) -> tuple[PredictedBlock, ...]:
    """Predictions of each block of a plan."""
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
