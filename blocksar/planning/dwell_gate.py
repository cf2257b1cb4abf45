"""Planning of the dwell gate of a block, from the lines of its targets."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev

from blocksar import solvers
from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.weighting import Taper
from blocksar.focusing.dwell_gate import DwellGate, DwellTaper, HalfDwell
from blocksar.focusing.lines import Focus, RowPolynomial
from blocksar.focusing.step import Sampling
from blocksar.kernels import fourier
from blocksar.kernels.fourier import Axis
from blocksar.planning.block_lines import FineLines
from blocksar.planning.dwell_ends import LitTimes, Moments, band_spread, end_lift, end_smear, gate_blur
from blocksar.planning.dwell_weights import beam_moves
from blocksar.planning.relief import FINE_DEGREE
from blocksar.planning.sector import Sector

LENGTHS, MOST_LENGTHS = {1e-3: 1, 0.04: 2, 0.15: 3}, 4  # windows by the relative spread of the halves' lengths
MOST_SPREAD = 1.6  # the longest half over the shortest, between which so many windows are blended


def divide_dwells(times: LitTimes, ends: Moments, middle: FloatArray) -> Moments:
    """Lengths of both halves of the dwells that begin and end at `ends` after all steps, (n_range, n_yaw), s.

    The beam's centre passes targets at the moment `middle`, s from the epoch.
    """
    divide = times.after(middle)
    return divide - ends[0], ends[1] - divide


def plan_taper(
    taper: Taper, halves: Sequence[FloatArray], lengths: Sequence[RowPolynomial], *, full: BoolArray
) -> DwellTaper:
    """The taper over dwells with halves of these lengths (n_range, n_yaw), s, which polynomials fit."""
    begin, end = (
        HalfDwell(length=length, lengths=_window_lengths(*_blended(half, full)))
        for half, length in zip(halves, lengths, strict=True)
    )
    return DwellTaper(taper=taper, begin=begin, end=end)


def _blended(lengths: FloatArray, full: BoolArray) -> tuple[float, float]:
    """Shortest and longest half for which windows are made, s.

    Where a beam turns slowly near the collection's ends, dwells that these cut may be several times as long as those
    with `full` dwell; windows for both would lie too far apart to be blended. Then they are made for full dwells, and
    for others as far as `MOST_SPREAD` reaches.
    """
    shortest, longest = float(lengths.min()), float(lengths.max())
    if longest > MOST_SPREAD * shortest and full.any():
        least, most = float(lengths[full].min()), float(lengths[full].max())
        room = max(MOST_SPREAD * least / most, 1.0) ** 0.5
        shortest = max(shortest, least / room)
        longest = min(longest, max(most, MOST_SPREAD * shortest))
    return shortest, longest


def _window_lengths(shortest: float, longest: float) -> tuple[float, ...]:
    """So many lengths between two, s, that blending windows of them errs by less than a thousandth."""
    count = next((n for spread, n in LENGTHS.items() if longest <= (1 + spread) * shortest), MOST_LENGTHS)
    if count == 1:
        return ((shortest + longest) / 2,)
    return tuple(np.linspace(shortest, longest, count).tolist())


class RowFit(NamedTuple):
    """Where polynomials along rows lie: ranges, m, and the centre and scale of Doppler, Hz."""

    near: float
    far: float
    centre: float
    scale: float

    @classmethod
    def over(cls, rows: Axis, spots: Focus) -> RowFit:
        """Over the rows of an image, and the Doppler at which targets focus."""
        doppler = spots.doppler
        scale = max(float(np.ptp(doppler) / 2), 1e-6)
        centre = float((doppler.min() + doppler.max()) / 2)
        return cls(rows.start, rows.start + rows.extent, centre=centre, scale=scale)

    def polynomial(self, series: FloatArray) -> RowPolynomial:
        return RowPolynomial(series=series, near=self.near, far=self.far, centre=self.centre, scale=self.scale)

    def fit(self, spots: Focus, values: FloatArray, degrees: tuple[int, int]) -> list[FloatArray]:
        """Fit values (n, n_range, n_yaw), s, where targets focus: series in range of powers of z, one for each."""
        u = (2 * spots.range.ravel() - self.near - self.far) / (self.far - self.near)
        z = (spots.doppler.ravel() - self.centre) / self.scale
        basis = np.asarray(chebyshev.chebvander2d(u, z, degrees).T, np.float64)
        fitted = solvers.least_squares(basis, values.reshape(values.shape[0], -1), damping=1e-20 * u.size)
        shape = degrees[0] + 1, degrees[1] + 1
        return [solvers.product(row.reshape(shape), _to_powers(degrees[1])) for row in fitted.T]

    def fit_amid(self, rng: FloatArray, values: FloatArray, which: BoolArray, *, degree: int) -> FloatArray:
        """Fit a series in range amid those of values (n_range, n_yaw) at each range that are chosen by `which`."""
        whole = which.any(axis=1)
        rows = [(values[i, which[i]], rng[i, which[i]].mean()) for i in np.flatnonzero(whole)]
        u = np.array([(2 * mean - self.near - self.far) / (self.far - self.near) for _, mean in rows])
        middles = np.array([(row.min() + row.max()) / 2 for row, _ in rows])
        terms = chebyshev.chebvander(u, min(degree, (len(rows) - 1) // 2)).T
        return np.asarray(solvers.least_squares(terms, middles, damping=1e-20 * u.size))

    def integral(self, series: FloatArray) -> RowPolynomial:
        """The polynomial whose derivative has these coefficients (n, order + 1): cycles."""
        integral = np.zeros((series.shape[0], series.shape[1] + 1))
        integral[:, 1:] = series / np.arange(1, series.shape[1] + 1) * self.scale
        return self.polynomial(integral)

    def slope(self, series: FloatArray) -> RowPolynomial:
        """The linear coefficient, per Hz."""
        return self.polynomial(series[:, 1:2] / self.scale)


@lru_cache
def _to_powers(most: int) -> FloatArray:
    """Power coefficients of the Chebyshev polynomials of degrees 0 .. most, one a row; read-only."""
    powers = np.zeros((most + 1, most + 1))
    for degree, row in enumerate(np.eye(most + 1)):
        powers[degree, : degree + 1] = chebyshev.cheb2poly(row[: degree + 1])
    powers.flags.writeable = False
    return powers


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
