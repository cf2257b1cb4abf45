"""Plan of a collection for a chain: the beam of its gates, division into blocks, and reasons to refuse.

No sample is read.

Division: the fewest angular blocks that keep the fidelity. Blocks reduce all errors that vary with angle; where they do
not suffice, hierarchical back-projection does.

Beams that stay on their ground, as in a spotlight (`steadiness`), and targets that share their Doppler, or stay
blurred, are refused. Exact back-projection has none of these limits; the caller adds that remedy to the reason, with
its time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from itertools import pairwise
from typing import Literal, Protocol, TypeVar

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.budget import FIDELITY, MOST_BLOCKS, image_tap_error
from blocksar.collection.beam import aperture
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry, over_terrain
from blocksar.collection.grid import Grid
from blocksar.collection.region import Extent, Owned, Region, block_seams, default_grid, grid_extent, plan_region
from blocksar.collection.staying import MOST_DWELL, beam_stays, longest_stay
from blocksar.collection.terrain import Terrain
from blocksar.collection.track_shape import find_flaw
from blocksar.collection.weighting import UNIFORM, Weighting
from blocksar.constants import MIB, SPEED_OF_LIGHT
from blocksar.errors import InputError, OutsideSwath, Unfocusable
from blocksar.imaging.method import DEFAULT, Method
from blocksar.planning.memory import MEMORY_SHARE, PROCESS_MEMORY
from blocksar.processors.chain.dwells.steadiness import Smoothed, smoothed_beam
from blocksar.processors.chain.dwells.target_lines import Sector, ground_range
from blocksar.processors.chain.ground.relief import Relief, ReliefPoints, find_relief, sample_terrain
from blocksar.processors.chain.planning.block import BlockPlan, plan_block
from blocksar.processors.chain.planning.coefficients import Choice
from blocksar.processors.chain.planning.plan import Plan
from blocksar.processors.chain.planning.spectrum_recovery import plan_recovery
from blocksar.processors.chain.steps.recovery import Recovery


def find_refusal(blocks: Sequence[BlockPlan], method: Method) -> str | None:
    """Find the reason to refuse a plan, or None; variants may blur, which they exist to show."""
    blur = None if method.variant else find_blur(blocks)
    return _find_lingering(blocks) or find_folding(blocks, method) or _find_uneven(blocks) or blur


def _find_lingering(blocks: Sequence[BlockPlan]) -> str | None:
    """Find a block on whose ground a beam about its axis stays too long for a dwell gate; the reason, or None."""
    for block in blocks:
        geometry = block.ground.geometry
        if not geometry.collection.has_axis:
            return None
        ranges = np.linspace(block.ground.near, block.ground.far, 9)[:, None]
        longest = longest_stay(geometry, ranges, np.linspace(block.low, block.high, 33))
        start, stop = aperture(geometry.collection)
        if longest > MOST_DWELL * (stop - start):
            stays = "for ever" if longest == np.inf else f"for {longest:.3g} s"
            return (
                f"{_describe_block(block)}: beam_steering turns with the line of sight of some ground, so that the "
                f"beam would stay on it {stays}, beyond the {stop - start:.3g} s of the collection, and passes over "
                "more; cut the collection, or image a smaller grid"
            )
    return None


def find_folding(blocks: Sequence[BlockPlan], method: Method = DEFAULT) -> str | None:
    """Find a block whose yaws share their Doppler, so that no transform separates them; the reason, or None.

    Yaws along the velocity share it in the echo itself. Where the platform's acceleration cancels the Doppler rate, as
    on a circle, yaws share it after a deramp without a bias chirp before it.
    """
    for block in blocks:
        slope = block.ground.doppler_slope() * np.pi / 180
        if slope.min() * slope.max() > 0:
            continue
        change = f"Doppler changes by {slope.min():.3g} .. {slope.max():.3g} Hz a degree of yaw, through zero"
        echo = _echo_slope(block)
        if echo.min() * echo.max() <= 0:
            return (
                f"{_describe_block(block)} looks along the velocity: {change}, so yaws cannot be told apart; image "
                "ground away from the direction of flight"
            )
        cause = f"{change}, after its last step, as acceleration cancels the Doppler rate"
        biased = method.processor == DEFAULT.processor
        remedy = "" if biased else f"; --processor {DEFAULT.processor} may add a bias chirp"
        return f"{_describe_block(block)}: {cause}{remedy}"
    return None


def _find_uneven(blocks: Sequence[BlockPlan]) -> str | None:
    """Find a block whose Doppler resampling cannot be applied; the reason, or None."""
    for block in blocks:
        if not block.even:
            return (
                f"{_describe_block(block)} would resample Doppler by more than a factor of two, or too unevenly, "
                "beyond its targets; use --coefficients fitted, or --processor angular-division"
            )
    return None


def _echo_slope(block: BlockPlan) -> FloatArray:
    """Range rate at the middle of the dwell per yaw, m/s per rad, over a block's ranges and yaws (9, 33)."""
    geometry = block.ground.geometry
    yaw = np.linspace(block.low, block.high, 33)
    rng, yaws = np.meshgrid(np.linspace(block.ground.near, block.ground.far, 9), yaw, indexing="ij")
    start, end = geometry.beam.dwell_at(yaws, rng)
    _, rate = geometry.range_history(geometry.ground_point(rng, yaws), (start + end) / 2)
    return np.gradient(rate, yaw, axis=1)


def find_blur(blocks: Sequence[BlockPlan]) -> str | None:
    """Find a block that cannot be in focus; the reason, or None."""
    for block in blocks:
        phase, migration = block.prediction.residual_phase, block.prediction.migration
        error = None
        if not phase < np.pi / 2:
            error = f"a phase error of {phase:.3g} rad"
        elif not migration < 1.0:
            error = f"a range migration of {migration:.3g} resolution cells"
        if error is not None:
            return f"{_describe_block(block)} would keep {error} over the dwell"
    return None


def _describe_block(block: BlockPlan) -> str:
    return f"block {block.name} (yaw {np.degrees(block.low):.2f} .. {np.degrees(block.high):.2f} degrees)"


MAX_BLOCKS = 32  # that `auto` tries
GROWTH = 1.5  # factor by which the number of blocks, or of segments, grows at a time
# Factor by which excesses may differ although blocks are equally good: on a terrain each division is predicted at other
# places of it (1.5 .. 3.0 from 1 to 10 blocks of hills of 60 m every 450 m under Table 1, without a trend).
ALIKE = 1.5


class Planned(Protocol):
    """Interface of a plan for the search for a division."""

    @property
    def blocks(self) -> tuple[BlockPlan, ...]: ...

    @property
    def refusal(self) -> str | None: ...

    def excess(self) -> float: ...


P = TypeVar("P", bound=Planned)


def fewest_blocks(workers: int) -> int:
    """The number of blocks of the coarsest division that is tried: one a worker."""
    return min(max(workers, 1), MAX_BLOCKS)


def find_division(plan: Callable[[int, bool], P], *, workers: int) -> P:
    """Find the plan with the fewest blocks that keep the fidelity, at least one for each worker.

    Where MAX_BLOCKS are far from it, none keep it, and it is the fewest whose excess is like theirs. Numbers grow until
    one serves, and those in between are tried by bisection. Probes of the outermost blocks and the middle one decide
    while plans are far from what is wanted.

    Parameters
    ----------
    plan : callable
        Plan for a number of blocks; True for a probe.
    workers : int
    """
    plan, numbers, far = cache(plan), [fewest_blocks(workers)], False
    while numbers[-1] < MAX_BLOCKS:
        numbers.append(min(math.ceil(GROWTH * numbers[-1]), MAX_BLOCKS))
    first = plan(numbers[0], True)
    if first.refusal is not None and find_folding(first.blocks) is not None:  # more blocks share their Doppler as well
        return plan(numbers[0], False)
    if excess_of(first) > 1.0 and (finest := _probe_finest(plan)) is not None:
        if first.refusal is not None and finest.refusal is not None:
            return first  # only its reason is used
        far = ALIKE < excess_of(finest) < math.inf
    if not far and (found := _fewest_blocks(plan, numbers, 1.0)) is not None:
        return found
    closest = min(excess_of(plan(count, True)) for count in (numbers[-1:] if far else numbers))
    return _fewest_blocks(plan, numbers, ALIKE * closest) or plan(MAX_BLOCKS, False)


def _probe_finest(plan: Callable[[int, bool], P]) -> P | None:
    """Probe the finest division; None if the grid has no point in the probed blocks."""
    with suppress(OutsideSwath):
        return plan(MAX_BLOCKS, True)
    return None


def excess_of(plan: Planned) -> float:
    """Excess of a plan over its limits (`Plan.excess`); infinite if it is refused."""
    return math.inf if plan.refusal is not None else plan.excess()


def _fewest_blocks(plan: Callable[[int, bool], P], numbers: Sequence[int], wanted: float) -> P | None:
    """Find the plan with the fewest blocks whose excess is at most `wanted`; None if none of the numbers suffices."""

    def serves(count: int) -> bool:
        return all(excess_of(plan(count, probe)) <= wanted for probe in (True, False))

    serving = next((count for count in numbers if serves(count)), None)
    if serving is None:
        return None
    failed = max((count for count in numbers if count < serving), default=numbers[0] - 1)
    while serving - failed > 1:
        middle = (failed + serving) // 2
        failed, serving = (failed, middle) if serves(middle) else (middle, serving)
    return plan(serving, False)


MAX_PARTS = 64  # range sub-blocks of a block
WHOLE_WINDOWS, PART_WINDOWS = 2.5, 0.97  # range windows that a whole block, and a range sub-block, may hold


def prepare_division(
    collection: Collection,
    *,
    method: Method = DEFAULT,
    fidelity: float = FIDELITY,
    weighting: Weighting = UNIFORM,
    grid: Grid | None = None,
    owned: Owned | None = None,
    terrain: Terrain | None = None,
) -> DivisionPlanner:
    """Find all that is common to the divisions of a collection; no block is planned.

    Raises
    ------
    InputError
        If the PRF is too low, the grid is empty or outside the swath, or the beam or ground is none for chains.
    """
    geometry = over_terrain(collection, terrain)
    region = plan_region(geometry, grid)
    grid = grid or default_grid(geometry, region)
    extent = grid_extent(geometry, region, grid, owned)
    if beam_stays(geometry, region, extent):
        raise Unfocusable(
            "the beam stays on its ground, as in a spotlight, and chains follow only dwells that pass over it"
        )
    if terrain is not None and collection.elevation_pattern is not None:
        raise Unfocusable("chains take a pattern in elevation over a plane only, and this ground has heights")
    beam = smoothed_beam(geometry, region, fidelity, weighting.azimuth)
    return DivisionPlanner(
        geometry=beam.geometry, beam=beam, region=region, recovery=plan_recovery(beam.geometry, region, method),
        grid=grid, extent=extent, method=method, fidelity=fidelity, weighting=weighting,
    )  # fmt: skip


def plan_collection(
    collection: Collection,
    *,
    blocks: int | Literal["auto"] = "auto",
    parts: int | Literal["auto"] = "auto",
    method: Method = DEFAULT,
    fidelity: float = FIDELITY,
    weighting: Weighting = UNIFORM,
    grid: Grid | None = None,
    owned: Owned | None = None,
    terrain: Terrain | None = None,
    workers: int = 1,
    memory_limit: int | None = None,
    prepared: DivisionPlanner | None = None,
) -> Plan:
    """Plan a collection for a method; with `owned`, only blocks with ground where it is true.

    `auto` takes the fewest blocks that keep the fidelity, at least one a worker (`find_division`), and the fewest range
    sub-blocks of each that fit a worker's memory. `prepared` is what `prepare_division` has found with these settings.

    Raises
    ------
    InputError
        As `prepare_division`, or if no number of sub-blocks fits the memory.
    """
    if blocks != "auto" and not 1 <= blocks <= MOST_BLOCKS:
        raise InputError(f"blocks = {blocks}: ask for 1 to {MOST_BLOCKS}, or for 'auto'")
    division = prepared or prepare_division(
        collection, method=method, fidelity=fidelity, weighting=weighting, grid=grid, owned=owned, terrain=terrain
    )
    n_parts = 1 if parts == "auto" else parts
    if blocks == "auto":
        first = find_division(lambda count, probe: division.plan(count, n_parts, probe), workers=workers)
    else:
        first = division.plan(blocks, n_parts, False)
    first = replace(first, searched=blocks == "auto")
    if first.refusal is not None:
        return replace(first, refusal=explain_refusal(first, division))
    if memory_limit is None:
        return first

    def divide(n_parts: int) -> Plan:
        return replace(division.plan(first.n_blocks, n_parts, False), searched=first.searched)

    return _fewest_parts(divide, first, memory_limit, fixed=parts != "auto")


def explain_refusal(refused: Plan, planner: DivisionPlanner) -> str:
    """Why a plan is refused: the track, if that has a flaw, or else its own reason, with what more blocks do to it."""
    if (flaw := find_flaw(refused.geometry.collection)) is not None:
        return str(flaw)
    reason = str(refused.refusal)
    if refused.method.variant or reason != find_blur(refused.blocks):
        return reason
    if refused.searched:
        return f"{reason}, and too much of it in every division that was tried"
    finest = _probe_finest(lambda count, probe: planner.plan(count, 1, probe))
    if finest is not None and finest.refusal is not None:
        return f"{reason}, and too much of it with {MAX_BLOCKS} blocks"
    return f"{reason}; ask for more --blocks, or for --blocks auto"


def _fewest_parts(plan: Callable[[int], Plan], first: Plan, memory_limit: int, *, fixed: bool) -> Plan:
    """Find the plan with the fewest range sub-blocks that fit a worker's memory."""
    divided, room = first, MEMORY_SHARE * memory_limit
    least = max(divided.recovery_memory, PROCESS_MEMORY)
    if room <= least:
        raise InputError(
            f"memory limit {memory_limit / MIB:.0f} MiB a worker is too low: recovery needs about "
            f"{math.ceil(least / MEMORY_SHARE / MIB)} MiB, however blocks are divided; raise --memory-limit, "
            "or take fewer workers"
        )
    needed = [divided.memory]
    while divided.memory > room:
        if fixed or divided.parts == MAX_PARTS:
            break
        share = (divided.memory - PROCESS_MEMORY) / (room - PROCESS_MEMORY)
        divided = plan(min(max(divided.parts + 1, math.ceil(0.9 * divided.parts * share)), MAX_PARTS))
        needed.append(divided.memory)
        if len(needed) > 2 and needed[-1] > 0.97 * needed[-2]:
            break
    if divided.memory > room:
        raise InputError(
            f"memory limit {memory_limit / MIB:.0f} MiB a worker is too low: {divided.n_blocks} x {divided.parts} "
            f"blocks by angle and range need about {math.ceil(min(needed) / MEMORY_SHARE / MIB)} MiB; raise "
            "--memory-limit, ask for more --blocks, or image a smaller grid"
        )
    return divided


@dataclass(frozen=True, kw_only=True, eq=False)
class DivisionPlanner:
    """Planner of one collection for any division.

    Attributes
    ----------
    beam : Smoothed
        The beam that dwell gates follow, which is that of the geometry.
    planned : dict
        The blocks by (blocks, sub-blocks, index): a plan after its probe plans the rest, and none is planned twice.
    """

    geometry: Geometry
    beam: Smoothed
    region: Region
    recovery: Recovery
    grid: Grid
    extent: Extent
    method: Method
    fidelity: float
    weighting: Weighting
    planned: dict[tuple[int, int, int], list[BlockPlan]] = field(default_factory=dict)

    def plan(self, count: int, n_parts: int, probe: bool) -> Plan:
        """Plan all blocks that the grid touches; a probe plans only the outermost ones and the middle one."""
        seams, touched = self._touched(count, probe)
        planned: list[BlockPlan] = []
        for index in touched:
            # Narrow blocks are alike: each takes the choice of the previous one, if that suffices.
            like = planned[-1].choice if planned and count > MAX_BLOCKS else None
            planned += self._plan_index(seams, index, n_parts, like)
        if not planned and probe:  # the probed block is not lit
            return self.plan(count, n_parts, False)
        if not planned:
            raise OutsideSwath(f"no block of {count} has a lit point of the grid; give it a finer step, or move it")
        return self._collect(seams, n_parts, planned)

    def _collect(self, seams: FloatArray, n_parts: int, planned: Sequence[BlockPlan]) -> Plan:
        """The plan of some blocks."""
        return Plan(
            geometry=self.geometry, grid=self.grid, region=self.region, recovery=self.recovery, seams=seams,
            parts=n_parts, blocks=tuple(planned), method=self.method, fidelity=self.fidelity,
            weighting=self.weighting, away=self.beam.away, refusal=find_refusal(planned, self.method),
        )  # fmt: skip

    def undivided(self) -> Plan:
        """A plan without any block: of what all divisions have in common."""
        return self._collect(np.zeros(1), 1, [])

    def middle(self, count: int) -> Plan | None:
        """A plan of the middle one of so many blocks alone; None where the grid has no lit point there."""
        seams, touched = self._touched(count, False)
        planned = self._plan_index(seams, touched[len(touched) // 2], 1, None) if touched else []
        return self._collect(seams, 1, planned) if planned else None

    def _touched(self, count: int, probe: bool) -> tuple[FloatArray, list[int]]:
        """Seams of `count` blocks, rad, and indices of those that the grid touches, or of a few for a probe."""
        seams = block_seams(self.geometry, self.region, count)
        touched = [i for i in range(count) if seams[i + 1] > self.extent.low and seams[i] <= self.extent.high]
        if probe and touched:
            touched = sorted({touched[0], touched[len(touched) // 2], touched[-1]})
        return seams, touched

    def _plan_index(self, seams: FloatArray, index: int, n_parts: int, neighbour: Choice | None) -> list[BlockPlan]:
        """Range sub-blocks of block `index` between seams, planned once."""
        key = seams.size - 1, n_parts, index
        if key not in self.planned:
            low, high = float(seams[index]), float(seams[index + 1])
            self.planned[key] = self._plan_angle(index, low, high, n_parts, neighbour)
        return self.planned[key]

    def _plan_angle(
        self, index: int, low: float, high: float, n_parts: int, neighbour: Choice | None
    ) -> list[BlockPlan]:
        """Range sub-blocks of one block; empty if the grid has no point there, or nothing is lit."""
        near, far = self.region.limits(low, high)
        near, far = max(near, self.extent.near), min(far, self.extent.far)
        # The range window limits ranges at each yaw, and slants over a wide block: rows continue periodically.
        windows = WHOLE_WINDOWS if n_parts == 1 else PART_WINDOWS * n_parts
        excess = max((far - near) - windows * self.geometry.collection.range_window, 0.0)
        near, far = near + excess / 2, far - excess / 2
        if far < near:
            return []
        # The nine ranges of the fit need some distance between them for meaningful polynomials.
        least = 64 * SPEED_OF_LIGHT / (2 * self.geometry.collection.bandwidth)
        room = max(least - (far - near), 0.0) / 2
        above = self.geometry.epoch_position[2] - self.geometry.collection.ground_height
        edges = np.linspace(max(near - room, (near + above) / 2), far + room, n_parts + 1)
        parts: list[BlockPlan] = []
        for part, (nearest, farthest) in enumerate(pairwise(edges.tolist())):
            relief = self._relief(low, high, nearest, farthest)
            geometry = self.geometry if relief is None else self.geometry.over(None, relief.smooth)
            sector = Sector(
                geometry=geometry, recovery=self.recovery, region=self.region, low=low, high=high, near=nearest,
                far=farthest, weighting=self.weighting, fidelity=self.fidelity, relief=relief,
                tap_error=image_tap_error(self.fidelity), beam_loss=self.beam.loss,
                imaged=(self.extent.low, self.extent.high),
            )  # fmt: skip
            like = parts[-1].choice if parts else neighbour
            number = part if n_parts > 1 else None
            with suppress(OutsideSwath):
                parts.append(plan_block(sector, self.method, index=index, part=number, neighbour=like))
        return parts

    def _relief(self, low: float, high: float, near: float, far: float) -> Relief | None:
        """The relief of a block; None on the plane."""
        if self.geometry.terrain is None:
            return None
        along = ground_range(self.geometry, near, far)
        return find_relief(self._samples, self.geometry, low=low, high=high, along=along)

    @cached_property
    def _samples(self) -> ReliefPoints:
        return sample_terrain(self.geometry, *((float(at[0]), float(at[-1])) for at in (self.grid.x, self.grid.y)))
