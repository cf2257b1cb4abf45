"""The dwell gate of a block, from the lines of its targets, and the parts of it over the band."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.weighting import FLAT, AxisTaper
from blocksar.focusing.dwell_gate import DwellGate
from blocksar.focusing.lines import Focus, Line, focus
from blocksar.focusing.sampling import Sampling
from blocksar.planning.dwell_weights import DwellWeights, beam_moves
from blocksar.planning.fidelity import gate_blur
from blocksar.planning.gates import GATE_DEGREES, NO_SCALING, Scaling, gate_parts, plan_gate
from blocksar.planning.relief import FINE_DEGREE
from blocksar.planning.sector import Sector

UNEVEN_SHARE = 0.1  # of the allowed loss, that the stretch of lines may cost before windows make up for it


class Ends(NamedTuple):
    """What the ends of dwells depend on besides the lines."""

    rate: FloatArray  # of the lines before the steps in Doppler, Hz/s
    uncut: tuple[FloatArray, FloatArray]  # (n_yaw,) or (n_range, n_yaw), s from the epoch, as if nothing cut them
    scaled_about: float | None  # time about which a keystone scales time, s
    moves: FloatArray | None  # from `band_moves`, (n_range, n_yaw, 2); None with a keystone
    full: BoolArray  # (n_range, n_yaw), from `full_dwells`
    passing: tuple[FloatArray, ...]  # (n_range, n_yaw) each, from `Sector.passing`


class FineLines(NamedTuple):
    """Lines (n_range, n_yaw) through the whole chain, for the gate, the ground map and the prediction."""

    lit: Line  # before all steps
    line: Line  # after them
    spots: Focus
    epoch_range: FloatArray  # (n_range,) m
    yaw: FloatArray  # (n_yaw,) rad
    weights: DwellWeights
    ends: Ends
    in_time: AxisTaper | None  # over the pulses of a beam that is not steered


def plan_dwell_gate(
    sector: Sector, sampling: Sampling, lines: FineLines, scaling: Scaling = NO_SCALING
) -> DwellGate | None:
    """The dwell gate, for a range frequency at which a keystone scales time; none where all is lit all the time.

    Nothing lies beyond the ends of the collection: without a gate the sum over time is that over the pulses, however
    the steps in Doppler smear those ends.
    """
    collection, ends = sector.geometry.collection, lines.ends
    if not beam_moves(collection):
        return None
    return plan_gate(
        lines.line, lines.spots, ends.rate, lit=lines.lit, scaling=scaling,
        blur=gate_blur(collection, ends.uncut, scaled_about=ends.scaled_about),
        uncut=ends.uncut, full=ends.full, rows=sampling.rows, slow=sampling.long_time, taper=sector.taper,
        degree=FINE_DEGREE if sector.gates_by_height else GATE_DEGREES,
        fade=sector.fade, passing=ends.passing, uneven=UNEVEN_SHARE * (1 - sector.fidelity),
    )  # fmt: skip


def plan_over_band(sector: Sector, sampling: Sampling, lines: FineLines, gate: DwellGate) -> tuple[DwellGate, ...]:
    """The gate's parts over the band, with the samples of `gate`; none where it serves all of it."""
    if sector.gate_parts == 1 or lines.ends.scaled_about is None:
        return ()
    collection, places = sector.geometry.collection, gate_parts(sector.gate_parts)
    middle, half = collection.range_frequency.mean(), collection.range_frequency_step * collection.n_range_frequency / 2
    factors = 1 + (middle + half * places.nodes) / collection.carrier
    parts = []
    for factor, share in zip(factors.tolist(), places.series, strict=True):
        part = plan_dwell_gate(sector, sampling, lines, Scaling(lines.ends.scaled_about, factor))
        if part is not None:
            level = AxisTaper(FLAT, float(middle), half, tuple(share.tolist()))
            parts.append(replace(part, common=gate.common, time=gate.time, share=level))
    return tuple(parts)


def level_spots(gate: DwellGate, lines: FineLines) -> FineLines:
    """The lines with their focus under a gate that makes up for their stretch; unchanged under one that does not."""
    levels = gate.levels(lines.spots.range, lines.spots.doppler, lines.line.time)
    if isinstance(levels, float):
        return lines
    return lines._replace(spots=focus(lines.weights.weigh(lines.line), levels))
