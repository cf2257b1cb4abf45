"""Planning of the dwell gate of a block, from the lines of its targets, and of the parts of it over the band."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.weighting import FLAT, AxisTaper
from blocksar.focusing.dwell_gate import DwellGate
from blocksar.focusing.lines import RowPolynomial
from blocksar.focusing.sampling import Sampling
from blocksar.kernels import fourier
from blocksar.planning.band_parts import NO_SCALING, Scaling, gate_parts
from blocksar.planning.block_lines import FineLines
from blocksar.planning.dwell_ends import LitTimes, Moments, end_smear
from blocksar.planning.dwell_taper import Half, divide_dwells, plan_taper, stretch_levels
from blocksar.planning.dwell_weights import beam_moves
from blocksar.planning.end_windows import band_spread, end_lift, gate_blur
from blocksar.planning.relief import FINE_DEGREE
from blocksar.planning.row_fit import RowFit
from blocksar.planning.sector import Sector

# Dwells that the sampling in Doppler has room for; of a look it needs room for what the whole beam lights, which would
# wrap into it.
GATE_ROOM = 1.62
FADE_ROOM = 9.0  # sqrt(e) on either side of a dwell for which it has room where edges fade out, at least
GATE_DEGREES = 4, 5  # of the ends of dwells in range and in Doppler
FIT_PRECISION = 0.02  # of the time in which an edge fades out, to which the ends of dwells are fitted
UNCUT = 1e-4  # of a dwell: by less, the collection does not cut it
LEAST_SPREAD = 0.02  # of the longest dwell: where the middles of dwells differ by less, no gate separates them
UNEVEN_SHARE = 0.1  # of the allowed loss, that the stretch of lines may cost before windows make up for it


def plan_dwell_gate(
    sector: Sector, sampling: Sampling, lines: FineLines, beside: FineLines | None, scaling: Scaling = NO_SCALING
) -> DwellGate | None:
    """The gate that follows the ends of the dwells along Doppler, at a range frequency with a `scaling` by a keystone.

    It follows those of the lines, and `beside` the block too where that has some (`block_lines.lit_beside`).

    Dwells that the ends of the collection cut are gated as if they continued: nothing lies beyond. None where all is
    lit all the time, and where all targets dwell at the same time: a gate could not separate them. Without a gate the
    sum over time is that over the pulses, however the steps in Doppler smear the collection's ends.
    """
    if not beam_moves(sector.geometry.collection):
        return None
    line, spots, taper, fade = lines.line, lines.spots, sector.taper, sector.fade
    weighed = fade > 0 or not taper.uniform

    dwells = _dwells_of(lines, scaling, weighed=weighed)
    times, begins, ends = dwells.times, *dwells.ends
    lengths = ends - begins
    if np.ptp((begins + ends) / 2) < LEAST_SPREAD * lengths.max() and not weighed:  # a taper needs its windows anyway
        return None

    # Both ends and the lengths of halves along Doppler; phases that move the ends, and all dwells, to t = 0.
    length, followed = float(lengths.mean()), lines if beside is None else beside
    fit = RowFit.over(sampling.rows, followed.spots)
    shown = dwells if beside is None else _dwells_of(beside, scaling, weighed=weighed)
    begin, end, *fitted = _fit_ends(sector, fit, followed, shown, length=length)
    phases = fit.integral(begin), fit.integral(end)
    at_middle = fit.integral((begin + end) / 2).coefficients(np.array((fit.near + fit.far) / 2))[None]
    common = fit.polynomial(at_middle)

    # The smear that the windows have to have, and the time that they need.
    (_, shared, _), *along = (each.evaluate(spots.range, spots.doppler[..., None]) for each in (common, *phases))
    apart = max(float(np.abs(at - shared).max()) for _, at, _ in along)
    smear = end_smear(line, lines.ends.rate, faded=fade > 0)
    begin_slope, end_slope = (
        _end_slope(fit, series, lines, smear[..., i] + along[i][2][..., 0]) for i, series in enumerate((begin, end))
    )
    room = GATE_ROOM * length
    if fade:
        steepest = max(float(np.abs(slope.series[0]).max()) for slope in (begin_slope, end_slope))
        room = max(room, faded_room(length, steepest))
    if (whole := sector.lighting.collection.lit_widths) > 1:
        room = max(room, length * (GATE_ROOM / 2 + whole))
    size = min(fourier.fast_length((room + 2 * apart) / sampling.long_time.step), sampling.long_time.size)

    full, uneven = lines.ends.full, UNEVEN_SHARE * (1 - sector.fidelity)
    levels = stretch_levels(times, dwells.middle, full, uneven=uneven) if fade else (0.0, 0.0)
    polynomials = [fit.polynomial(series) for series in fitted]
    spread = band_spread(sector.geometry.collection, lines.ends.uncut, scaled_about=lines.ends.scaled_about)
    blur = gate_blur(sector.geometry.collection, spread)
    lift = 0.0 if fade else end_lift(blur, spread, sector.weighting.range, follows=sector.gate_parts > 1)
    return DwellGate(
        begin=phases[0],
        end=phases[1],
        common=common,
        begin_slope=begin_slope,
        end_slope=end_slope,
        blur=blur,
        lift=lift,
        length=length,
        time=fourier.centred(0.0, sampling.long_time.step, size),
        taper=plan_taper(taper, fade, dwells.halves, polynomials, full=full, levels=levels) if weighed else None,
    )


def faded_room(length: float, slope: float) -> float:
    """Time that a gate needs where the edges of dwells fade out, s: beyond a dwell, it fades out clear of the smear."""
    return length + 2 * FADE_ROOM * math.sqrt(slope)


class _Dwells(NamedTuple):
    """Dwells of lines after all steps."""

    times: LitTimes
    ends: Moments  # (n_range, n_yaw), s, uncut
    middle: FloatArray  # when the beam's centre passes, s from the epoch
    halves: tuple[Half, ...]  # both of them, where dwells are weighed


def _dwells_of(lines: FineLines, scaling: Scaling, *, weighed: bool) -> _Dwells:
    times = LitTimes.of(lines.lit, lines.line)
    uncut = scaling(lines.ends.uncut[0]), scaling(lines.ends.uncut[1])
    passing = lines.ends.passing.scaled(scaling)
    middle = (uncut[0] + uncut[1]) / 2 if passing.centre is None else passing.centre
    ends = times.ends(uncut)
    return _Dwells(times, ends, middle, divide_dwells(times, ends, passing, middle) if weighed else ())


def _fit_ends(sector: Sector, fit: RowFit, lines: FineLines, dwells: _Dwells, *, length: float) -> list[FloatArray]:
    """Fit begins and ends, and under a weighting the lengths of halves: (2 or 4, n_range, n_yaw), s.

    Where edges fade out, those that the collection cuts off are left to the others: there is nothing to gate where
    they lie.
    """
    spots, degree = lines.spots, FINE_DEGREE if sector.gates_by_height else GATE_DEGREES
    begins, ends = dwells.ends
    values = np.stack([begins + length / 2, ends - length / 2, *(half.length for half in dwells.halves)])
    if not sector.fade:
        return fit.fit(spots, values, degree, known=np.ones(values.shape[1:], np.bool_))
    cut = dwells.times.first - lines.ends.uncut[0], lines.ends.uncut[1] - dwells.times.last
    known = [time < UNCUT * length for time in cut]
    known = [each if each.any() else np.ones_like(each) for each in known]
    precision = FIT_PRECISION * length / (2 * sector.fade)
    fitted = [fit.fit(spots, values[i::2], degree, known=known[i], precision=precision) for i in (0, 1)]
    return [series for pair in zip(*fitted, strict=True) for series in pair]


def _end_slope(fit: RowFit, series: FloatArray, lines: FineLines, slopes: FloatArray) -> RowPolynomial:
    """Slope of an end in Doppler with which its window is made, s/Hz.

    At each range it lies amid those of the targets with full dwell there, `slopes`, their smear included.
    """
    slope, spots = fit.slope(series), lines.spots
    left = slopes - slope.coefficients(spots.range)[..., 0]
    amid = fit.fit_amid(spots.range, left, lines.ends.full, degree=GATE_DEGREES[0])
    slope.series[: amid.size, 0] += amid
    return slope


def plan_over_band(
    sector: Sector, sampling: Sampling, lines: FineLines, beside: FineLines | None, gate: DwellGate
) -> tuple[DwellGate, ...]:
    """The gate's parts over the band, with the samples of `gate`; none where it serves all of it."""
    if sector.gate_parts == 1 or lines.ends.scaled_about is None:
        return ()
    collection, places = sector.geometry.collection, gate_parts(sector.gate_parts)
    middle, half = collection.range_frequency.mean(), collection.range_frequency_step * collection.n_range_frequency / 2
    factors = 1 + (middle + half * places.nodes) / collection.carrier
    parts = []
    for factor, share in zip(factors.tolist(), places.series, strict=True):
        part = plan_dwell_gate(sector, sampling, lines, beside, Scaling(lines.ends.scaled_about, factor))
        if part is not None:
            level = AxisTaper(FLAT, float(middle), half, tuple(share.tolist()))
            parts.append(replace(part, common=gate.common, time=gate.time, share=level))
    return tuple(parts)
