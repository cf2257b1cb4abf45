"""Planning of the dwell gate of a block, from the lines of its targets."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.focusing.dwell_gate import DwellGate
from blocksar.focusing.lines import Focus, RowPolynomial
from blocksar.focusing.sampling import Sampling
from blocksar.kernels import fourier
from blocksar.planning.block_lines import FineLines
from blocksar.planning.dwell_ends import LitTimes, Moments, end_smear
from blocksar.planning.dwell_taper import divide_dwells, plan_taper
from blocksar.planning.dwell_weights import beam_moves
from blocksar.planning.end_windows import band_spread, end_lift, gate_blur
from blocksar.planning.relief import FINE_DEGREE
from blocksar.planning.row_fit import RowFit
from blocksar.planning.sector import Sector

# Dwells that the sampling in Doppler has room for; of a look it needs room for what the whole beam lights, which would
# wrap into it.
GATE_ROOM = 1.62
GATE_DEGREES = 4, 5  # of the ends of dwells in range and in Doppler
LEAST_SPREAD = 0.02  # of the longest dwell: where the middles of dwells differ by less, no gate separates them


def plan_dwell_gate(sector: Sector, sampling: Sampling, lines: FineLines, beside: FineLines | None) -> DwellGate | None:
    """The gate that follows the ends of the dwells along Doppler.

    It follows those of the lines, and `beside` the block too where that has some (`block_lines.lit_beside`).

    Dwells that the ends of the collection cut are gated as if they continued: nothing lies beyond. None where all is
    lit all the time, and where all targets dwell at the same time: a gate could not separate them. Without a gate the
    sum over time is that over the pulses, however the steps in Doppler smear the collection's ends.
    """
    if not beam_moves(sector.geometry.collection):
        return None
    line, spots, taper = lines.line, lines.spots, sector.taper
    weighed = not taper.uniform

    dwells = _dwells_of(lines, weighed=weighed)
    begins, ends = dwells.ends
    lengths = ends - begins
    if np.ptp((begins + ends) / 2) < LEAST_SPREAD * lengths.max() and not weighed:  # a taper needs its windows anyway
        return None

    # Both ends and the lengths of halves along Doppler; phases that move the ends, and all dwells, to t = 0.
    length, followed = float(lengths.mean()), lines if beside is None else beside
    fit = RowFit.over(sampling.rows, followed.spots)
    shown = dwells if beside is None else _dwells_of(beside, weighed=weighed)
    begin, end, *fitted = _fit_ends(sector, fit, followed.spots, shown, length=length)
    phases = fit.integral(begin), fit.integral(end)
    at_middle = fit.integral((begin + end) / 2).coefficients(np.array((fit.near + fit.far) / 2))[None]
    common = fit.polynomial(at_middle)

    # The smear that the windows have to have, and the time that they need.
    (_, shared, _), *along = (each.evaluate(spots.range, spots.doppler[..., None]) for each in (common, *phases))
    apart = max(float(np.abs(at - shared).max()) for _, at, _ in along)
    smear = end_smear(line, lines.ends.rate)
    begin_slope, end_slope = (
        _end_slope(fit, series, lines, smear[..., i] + along[i][2][..., 0]) for i, series in enumerate((begin, end))
    )
    room = GATE_ROOM * length
    if (whole := sector.geometry.collection.lit_widths) > 1:
        room = max(room, length * (GATE_ROOM / 2 + whole))
    size = min(fourier.fast_length((room + 2 * apart) / sampling.long_time.step), sampling.long_time.size)

    polynomials = [fit.polynomial(series) for series in fitted]
    spread = band_spread(sector.geometry.collection, lines.ends.uncut, scaled_about=lines.ends.scaled_about)
    blur = gate_blur(sector.geometry.collection, spread)
    return DwellGate(
        begin=phases[0],
        end=phases[1],
        common=common,
        begin_slope=begin_slope,
        end_slope=end_slope,
        blur=blur,
        lift=end_lift(blur, spread, sector.weighting.range),
        length=length,
        time=fourier.centred(0.0, sampling.long_time.step, size),
        taper=plan_taper(taper, dwells.halves, polynomials, full=lines.ends.full) if weighed else None,
    )


class _Dwells(NamedTuple):
    """Dwells of lines after all steps, (n_range, n_yaw), s."""

    ends: Moments  # uncut
    halves: tuple[FloatArray, ...]  # the lengths of both halves, where dwells are weighed


def _dwells_of(lines: FineLines, *, weighed: bool) -> _Dwells:
    times, uncut, middle = LitTimes.of(lines.lit, lines.line), lines.ends.uncut, lines.ends.passing
    ends = times.ends(uncut)
    middle = (uncut[0] + uncut[1]) / 2 if middle is None else middle
    return _Dwells(ends, divide_dwells(times, ends, middle) if weighed else ())


def _fit_ends(sector: Sector, fit: RowFit, spots: Focus, dwells: _Dwells, *, length: float) -> list[FloatArray]:
    """Fit begins and ends, and under a weighting the lengths of halves: (2 or 4, n_range, n_yaw), s."""
    degree = FINE_DEGREE if sector.gates_by_height else GATE_DEGREES
    begins, ends = dwells.ends
    return fit.fit(spots, np.stack([begins + length / 2, ends - length / 2, *dwells.halves]), degree)


def _end_slope(fit: RowFit, series: FloatArray, lines: FineLines, slopes: FloatArray) -> RowPolynomial:
    """Slope of an end in Doppler with which its window is made, s/Hz.

    At each range it lies amid those of the targets with full dwell there, `slopes`, their smear included.
    """
    slope, spots = fit.slope(series), lines.spots
    left = slopes - slope.coefficients(spots.range)[..., 0]
    amid = fit.fit_amid(spots.range, left, lines.ends.full, degree=GATE_DEGREES[0])
    slope.series[: amid.size, 0] += amid
    return slope
