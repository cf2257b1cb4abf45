"""Lines of targets on the ground of a block: coarse ones to plan its chain by, and fine ones through the whole chain.

Coarse lines go as far as range compression. They tell the block's part of the spectrum, the coefficients of its steps
and how its samples are spaced. Fine lines tell the dwell gate, where each target focuses and how sharp it becomes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev

from blocksar import solvers
from blocksar.arrays import FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import AxisTaper
from blocksar.focusing.ground_map import tile_extent
from blocksar.focusing.lines import LEAST_STRETCH, Focus, Line, focus
from blocksar.planning.binding import AzimuthPart
from blocksar.planning.dwell_ends import DwellEnds, band_moves, full_dwells
from blocksar.planning.dwell_weights import DwellWeights, beam_moves, level_aperture, levelled
from blocksar.planning.sector import Sector
from blocksar.planning.steadiness import scans_evenly
from blocksar.planning.target_lines import Dwells, TracedTargets

RANGE_STEPS = 3  # of the iteration that finds the targets of an apparent range
MOST_BEYOND = 1.05  # half swaths from its middle at which the series of that iteration is trusted


def nodes_between(low: float, high: float, count: int) -> FloatArray:
    """`solvers.end_nodes` from low to high."""
    return low + (high - low) * (1 + solvers.end_nodes(count)) / 2


def common_ranges(
    trace: Callable[[FloatArray], Line], line: Line, nodes: FloatArray, *, origin: float, least: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Apparent ranges that span those of lines (n_range, n_yaw), and the epoch range of each yaw's target there.

    Targets of one output row share its coefficients but not always the range at the epoch: correcting range curvature
    at a target's own Doppler moves the target by that curvature (paper C, below (5)). No epoch range is below
    `least`, m.

    Returns
    -------
    ranges : (n_range,) m from the origin, ascending
    epoch_range : (n_range, n_yaw) m
    """
    apparent = line.range.mean(axis=-1)
    ranges = nodes_between(float(apparent.min()), float(apparent.max()), nodes.size)
    # How far ranges move, as a series over the nodes; targets beyond the nodes need one step with their own lines.
    moved = solvers.node_series(apparent - (nodes[:, None] - origin), nodes.size - 1)
    epoch_range = origin + ranges[:, None] - moved[0]
    for _ in range(RANGE_STEPS):
        u = np.clip((2 * epoch_range - nodes[0] - nodes[-1]) / (nodes[-1] - nodes[0]), -MOST_BEYOND, MOST_BEYOND)
        epoch_range = origin + ranges[:, None] - chebyshev.chebval(u, moved[:, None], tensor=False)
        epoch_range = np.maximum(epoch_range, least)
    epoch_range = epoch_range + ranges[:, None] - trace(epoch_range).range.mean(axis=-1)
    return ranges, np.maximum(epoch_range, least)


COARSE_NODES = 9, 15  # along range and yaw
FINE_NODES, MORE_RANGES = (13, 33), 25
YAWS_PER_INTERVAL, MOST_YAWS = 0.6, 129  # of fine lines, where a spline's intervals pass from yaw to yaw
MOST_WIDER = 2.0  # times as many yaws, where lines go on beyond a block
FOLDED = 1.0  # octaves of stretch, of lines that are not followed
GATE_RANGES = 25  # of the lines that a dwell gate on a terrain follows


class CoarseLines(NamedTuple):
    """Lines (n_range, n_yaw) in the recovered signal."""

    line: Line
    everywhere: Line  # on a terrain also those of the lowest and of the highest targets
    nodes: FloatArray  # (n_range,) epoch ranges, m
    dwells: Dwells  # at yaws (n_yaw,)

    @classmethod
    def of(cls, sector: Sector) -> CoarseLines:
        """Trace the lines of the targets of a sector."""
        n_range, n_yaw = COARSE_NODES
        nodes, yaw = nodes_between(sector.near, sector.far, n_range), np.linspace(sector.low, sector.high, n_yaw)
        dwells = sector.dwells(yaw, coarsely=True)
        line = dwells.lines(nodes[:, None])
        everywhere = sector.with_relief(line, lambda part: part.dwells(yaw, like=line).lines(nodes[:, None]))
        return cls(line, everywhere, nodes, dwells)

    @property
    def duration(self) -> float:
        """The longest dwell, s."""
        return float(self.line.weight.sum(axis=-1).max())


class FineLines(NamedTuple):
    """Lines (n_range, n_yaw) through the whole chain."""

    lit: Line  # before all steps
    compressed: Line  # after range compression
    line: Line  # after all steps
    spots: Focus
    epoch_range: FloatArray  # (n_range,) m, nodes of the sector's ground range
    yaw: FloatArray  # (n_yaw,) rad
    weights: DwellWeights
    ends: DwellEnds
    in_time: AxisTaper | None  # over the pulses of a beam that is not steered

    def targets(self, geometry: Geometry) -> TracedTargets:
        """Their targets on the ground of a geometry, as the chain leaves them."""
        return TracedTargets(
            geometry=geometry, epoch_range=self.epoch_range, yaw=self.yaw, line=self.line, spots=self.spots,
            weights=self.weights, uncut=self.ends.uncut, rate=self.ends.rate, scaled_about=self.ends.scaled_about,
            moves=self.ends.moves,
        )  # fmt: skip


class _Traced(NamedTuple):
    """Lines of targets along a chain."""

    lit: Line  # before all steps
    compressed: Line  # after range compression
    biased: Line  # before the transform to Doppler
    line: Line  # after all steps


def _trace(
    sector: Sector, azimuth: AzimuthPart, epoch_range: FloatArray, yaw: FloatArray, *, like: Line | None = None
) -> _Traced:
    lit = sector.dwells(yaw, like=like).lines(epoch_range[:, None])
    compressed = azimuth.range_part.trace(lit)
    biased, _, line = azimuth.trace(compressed)
    return _Traced(lit, compressed, biased, line)


def trace_finely(
    sector: Sector, azimuth: AzimuthPart, *, n_range: int = FINE_NODES[0]
) -> tuple[AzimuthPart, FineLines]:
    """The fine lines of a sector, and the steps; without steering under the taper that levels the aperture."""
    rng = sector.ground_range.nodes(n_range)
    yaw = nodes_between(sector.low, sector.high, _fine_yaws(sector))
    traced = _trace(sector, azimuth, rng, yaw)
    in_time = azimuth.range_part.constants.in_time
    if in_time is not None:
        in_time, line = level_aperture(traced.line, in_time)
        azimuth, traced = azimuth.weighed(in_time), traced._replace(line=line)
    return azimuth, _with_ends(sector, azimuth, traced, rng, yaw, in_time)


def _fine_yaws(sector: Sector) -> int:
    """Number of yaws of the fine lines: on a track that wobbles, so many that they follow it as the beam turns."""
    geometry = sector.geometry
    if geometry.track.wobble is None or not geometry.collection.steered:
        return FINE_NODES[1]
    first, last = geometry.beam.dwell_at(np.array([sector.low, sector.high]), np.array((sector.near + sector.far) / 2))
    passed = float(np.ptp(first + last)) / 2 / geometry.track.wobble.step
    return max(FINE_NODES[1], math.ceil(min(YAWS_PER_INTERVAL * passed, MOST_YAWS)))


def under_tiles(sector: Sector, azimuth: AzimuthPart, lines: FineLines) -> FineLines:
    """The lines as far beyond the block as its tiles of pixels reach, where a track wobbles; as they are elsewhere.

    Tiles at its edge take what the map knows beyond it. Series of few terms can be asked there, but not those that
    follow the waves of a track.
    """
    if sector.geometry.track.wobble is None:
        return lines
    near = max(sector.near, sector.region.limits(sector.low, sector.high)[0])
    _, beyond = tile_extent(sector.geometry, sector.low, sector.high, near, sector.far)
    return _trace_wider(sector, azimuth, lines, sector.low - beyond, sector.high + beyond)


def lit_beside(sector: Sector, azimuth: AzimuthPart, lines: FineLines) -> FineLines | None:
    """The lines and those of all that is lit beside the block; None where its own are enough.

    A pixel also sums what its pulses have of other targets, gated as is right for the Doppler at which those focus.
    Windows with sharp ends make that count as far as the beam reaches, beyond the seams too. Ends of a beam that scans
    evenly hardly bend along Doppler and are extrapolated. Lines end before targets beside the block that fold, as its
    steps are not made for them.
    """
    collection, region = sector.geometry.collection, sector.region
    if sector.gates_by_height or not beam_moves(collection) or scans_evenly(collection):
        return None
    reach, middle = collection.beam_width or 0.0, (sector.near + sector.far) / 2
    if collection.has_axis:
        reach *= middle / float(sector.ground_range.on_ground(np.array(middle)))
    low = min(max(sector.low - reach, float(region.yaw[0])), sector.low)
    high = max(min(sector.high + reach, float(region.yaw[-1])), sector.high)
    wider = _trace_wider(sector, azimuth, lines, low, high)
    folds = (np.abs(np.log2(np.maximum(wider.line.stretch, LEAST_STRETCH))) > FOLDED).any(axis=(0, 2))
    if not folds.any():
        return wider
    before, behind = (np.flatnonzero(folds & beside) for beside in (wider.yaw < sector.low, wider.yaw > sector.high))
    first, last = before.max(initial=-1) + 1, behind.min(initial=wider.yaw.size) - 1
    ends = min(float(wider.yaw[first]), sector.low), max(float(wider.yaw[last]), sector.high)
    return _trace_wider(sector, azimuth, lines, *ends)


def _trace_wider(sector: Sector, azimuth: AzimuthPart, lines: FineLines, low: float, high: float) -> FineLines:
    """Lines at the ranges of others, and at yaws from low to high, about as dense, rad."""
    rng, wider = lines.epoch_range, (high - low) / (sector.high - sector.low)
    yaw = nodes_between(low, high, math.ceil(min(wider, MOST_WIDER) * lines.yaw.size))
    traced = _levelled(_trace(sector, azimuth, rng, yaw), lines.in_time)
    return _with_ends(sector, azimuth, traced, rng, yaw, lines.in_time)


def follow_terrain(sector: Sector, azimuth: AzimuthPart, lines: FineLines) -> FineLines:
    """The lines of targets on the finer smooth part of a terrain, which the dwell gate follows, at more ranges."""
    rng, yaw = sector.ground_range.nodes(GATE_RANGES), lines.yaw
    traced = _levelled(_trace(sector.refined(), azimuth, rng, yaw), lines.in_time)
    return _with_ends(sector, azimuth, traced, rng, yaw, lines.in_time)


def retrace(sector: Sector, azimuth: AzimuthPart, lines: FineLines) -> tuple[Line, FloatArray]:
    """Lines after all steps of the targets at the same ranges and yaws of another ground, and `DwellEnds.rate`.

    With as many nodes, for the weights of their dwells are those of the lines: the longest dwell depends on the ground.
    """
    traced = _levelled(_trace(sector, azimuth, lines.epoch_range, lines.yaw, like=lines.lit), lines.in_time)
    return traced.line, traced.biased.rate


def _levelled(traced: _Traced, in_time: AxisTaper | None) -> _Traced:
    return traced if in_time is None else traced._replace(line=levelled(traced.line, in_time))


def _with_ends(
    sector: Sector, azimuth: AzimuthPart, traced: _Traced, rng: FloatArray, yaw: FloatArray, in_time: AxisTaper | None
) -> FineLines:
    """Traced lines with the ends and weights of their dwells, and their focus."""
    geometry, about = sector.geometry, azimuth.range_part.scales_time_about
    first, last = geometry.beam.dwell_at(yaw, rng[:, None], uncut=True)
    in_doppler = azimuth.range_part.compression.in_doppler
    ends = DwellEnds(
        rate=traced.biased.rate,
        uncut=(first - geometry.epoch, last - geometry.epoch),
        scaled_about=about,
        moves=band_moves(traced.biased, traced.biased.rate) if in_doppler else None,
        full=full_dwells(traced.line, geometry, rng[:, None], yaw),
        passing=sector.passing(rng[:, None], yaw),
    )
    moves = ends.moves if about is None else traced.lit.time - about
    weights = sector.weights(traced.lit, uncut=ends.uncut, epoch_range=rng, yaw=yaw, moves=moves)
    spots = focus(weights.weigh_chain(traced.line))
    return FineLines(traced.lit, traced.compressed, traced.line, spots, rng, yaw, weights, ends, in_time)
