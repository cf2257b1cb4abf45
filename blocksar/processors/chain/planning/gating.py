"""Plan of a block's gates: dwell gates that follow Doppler by polynomials, and range gates of sub-blocks.

WINDOWS at the ends of whole dwells are spread over the band by a keystone, and targets lose by it. A keystone scales
time with range frequency, so that ends of dwells lie at +-`spread` at the edges of the band. Windows rise there as the
mean of steps over +-`blur` does. At range frequencies where a target is lit beyond its window it loses, and where the
window reaches beyond the target it gains nothing: for an end at d, |d| < b, the mean step S loses

    integral of 1 - S beyond d = (b - d)^2 / 4 b,    on average over the band (b^2 + mean of d^2) / 4 b,

of the weight at the end: b / 3 with equal weights over the band and b the spread. All targets lose that, and it changes
their side lobes, by a fifth under `hamming` and a band of 7 %. So windows are raised just inside the end, by a triangle
from 0 to 4 b. With the height h its area is 2 b h, of which half of the ends, those at d > 0, lack h d^2 / 4 b. What
remains is that the middle of the triangle lies 2 b inside the end, and its energy, h^2 4 b / 3, which is a tenth of
that by which the ends differ.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev

from blocksar import solvers
from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.weighting import FLAT, NODES, Taper
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.kernels import fourier
from blocksar.kernels.fourier import Axis
from blocksar.processors.chain.dwells.dwell_ends import end_smear
from blocksar.processors.chain.dwells.dwell_weights import beam_moves
from blocksar.processors.chain.dwells.target_lines import Sector, middle_line
from blocksar.processors.chain.ground.relief import FINE_DEGREE
from blocksar.processors.chain.planning.binding import AzimuthPart
from blocksar.processors.chain.planning.block_lines import MORE_RANGES, TracedTargets, lit_beside, trace_targets
from blocksar.processors.chain.steps.dwell_gate import DwellGate, DwellTaper, HalfDwell
from blocksar.processors.chain.steps.lines import Focus, Line, RowPolynomial
from blocksar.processors.chain.steps.range_gate import RangeGate
from blocksar.processors.chain.steps.step import Sampling

RANGE_GUARD = 48  # range cells on either side of a sub-block, for side lobes of targets at its ends
BAND_ROOM = 0.08  # of the band, on either side of it, over which a sub-block's range frequencies fall to zero


def plan_range_gate(full: Axis, slab: Axis, line: Line, carrier: float) -> RangeGate:
    """Plan the gate that holds the ranges of lines (n_range, n_yaw) at each Doppler, with room for side lobes."""
    u = (2 * line.doppler - slab.start - (slab.start + slab.extent)) / slab.extent
    centre = middle_line(u.ravel(), line.range.ravel(), order=6)
    spread = line.range - chebyshev.chebval(u, centre)
    # In a Doppler bin, the band's ends are lit at other times than the carrier: a smear that SRC removes later.
    edge = max(abs(full.start), abs(full.start + full.extent)) / carrier
    rate = np.maximum(np.abs(line.rate), 1e-3 * np.abs(line.rate).max())
    smear = SPEED_OF_LIGHT / (2 * carrier) * line.doppler**2 / rate * edge
    cell = SPEED_OF_LIGHT / (2 * full.extent)
    low = float((spread - np.abs(smear)).min()) - RANGE_GUARD * cell
    high = float((spread + np.abs(smear)).max()) + RANGE_GUARD * cell
    period = fourier.fast_length((1 + 2 * BAND_ROOM) * full.size)
    step = 1 / (period * full.step)
    size = min(fourier.fast_length((high - low) * 2 / SPEED_OF_LIGHT / step), period)
    middle = round((low + high) / SPEED_OF_LIGHT / step)
    coarse = 1 / (size * step)
    n_frequency = min(math.floor((1 + 2 * BAND_ROOM) * full.extent / coarse), size)
    band_middle = full.start + (full.size - 1) / 2 * full.step
    frequency = Axis(band_middle - (n_frequency - 1) / 2 * coarse, coarse, n_frequency)
    beyond = np.clip(np.abs(frequency.values - band_middle) / full.extent - 0.5, 0, BAND_ROOM) / BAND_ROOM
    ramp = np.clip((np.minimum(np.arange(size), np.arange(size)[::-1]) + 0.5) / (RANGE_GUARD / 2), 0, 1)
    normalised = np.clip((2 * slab.values - 2 * slab.start - slab.extent) / slab.extent, u.min(), u.max())
    return RangeGate(
        slab=slab,
        centre=np.rint(chebyshev.chebval(normalised, centre) * 2 / SPEED_OF_LIGHT / step).astype(np.intp),
        gate=Axis(step * (middle - size // 2), step, size),
        window=np.sin(np.pi / 2 * ramp) ** 2,
        full=full,
        range_frequency=frequency,
        taper=np.cos(np.pi / 2 * beyond) ** 2,
    )


# Dwells that the sampling in Doppler has room for; of a look it needs room for what the whole beam lights, which would
# wrap into it.
GATE_ROOM = 1.62
GATE_DEGREES = 4, 5  # of the ends of dwells in range and in Doppler


def plan_dwell_gate(sector: Sector, azimuth: AzimuthPart, sampling: Sampling, lines: TracedTargets) -> DwellGate | None:
    """Plan the gate that follows the dwell ends of lines, and of targets lit beside the block, along Doppler.

    On a terrain it follows dwells on the finer smooth part of that, at more ranges, if they depend on height.

    Dwells that the ends of the collection cut are gated as if they continued: nothing lies beyond. None where all is
    lit all the time: the sum over time is then that over the pulses, however steps in Doppler smear the collection's
    ends.
    """
    collection, weighed = sector.geometry.collection, not sector.taper.uniform
    if not beam_moves(collection):
        return None
    if sector.relief is not None and sector.gates_by_height:
        fine = sector.geometry.over(None, sector.relief.fine)
        lines = trace_targets(sector, azimuth, sector.ground_range.nodes(MORE_RANGES), lines.yaw, ground=fine)
    spots, (begins, ends) = lines.spots, lines.uncut_ends

    # Both ends and the lengths of halves along Doppler; phases that move the ends, and all dwells, to t = 0.
    length, followed = float((ends - begins).mean()), lit_beside(sector, azimuth, lines)
    fit = RowFit.over(sampling.rows, followed.spots)
    begins, ends = followed.uncut_ends
    values = [begins + length / 2, ends - length / 2, *(_halves(sector, followed) if weighed else ())]
    degrees = FINE_DEGREE if sector.gates_by_height else GATE_DEGREES
    begin, end, *fitted = fit.fit(followed.spots, np.stack(values), degrees)
    phases = fit.integral(begin), fit.integral(end)
    at_middle = fit.integral((begin + end) / 2).coefficients(np.array((fit.near + fit.far) / 2))[None]
    common = fit.polynomial(at_middle)

    # The smear that the windows must have, and the time span that they need.
    (_, shared, _), *along = (each.evaluate(spots.range, spots.doppler[..., None]) for each in (common, *phases))
    apart = max(float(np.abs(at - shared).max()) for _, at, _ in along)
    smear = end_smear(lines.line, lines.rate)
    begin_slope, end_slope = (
        _end_slope(fit, series, lines, smear[..., i] + along[i][2][..., 0]) for i, series in enumerate((begin, end))
    )
    room = GATE_ROOM * length
    if (whole := collection.lit_widths) > 1:
        room = max(room, length * (GATE_ROOM / 2 + whole))
    size = min(fourier.fast_length((room + 2 * apart) / sampling.long_time.step), sampling.long_time.size)

    spread = band_spread(lines)
    blur = math.hypot(spread, collection.pulse_interval / 2)  # over the band, and by the grid of pulses
    polynomials = [fit.polynomial(series) for series in fitted]
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
        taper=plan_taper(sector.taper, _halves(sector, lines), polynomials, full=lines.full) if weighed else None,
    )


def _halves(sector: Sector, targets: TracedTargets) -> tuple[FloatArray, FloatArray]:
    """Lengths (n_range, n_yaw), s, of the halves of uncut dwells after all steps: before and after the beam's centre.

    Where that passes amid dwells, they are halves of the dwell in time.
    """
    passing = sector.passing(targets.epoch_range[:, None], targets.yaw)
    divide = targets.after((targets.uncut[0] + targets.uncut[1]) / 2 if passing is None else passing)
    begins, ends = targets.uncut_ends
    return divide - begins, ends - divide


def _end_slope(fit: RowFit, series: FloatArray, lines: TracedTargets, slopes: FloatArray) -> RowPolynomial:
    """Slope of a dwell end along Doppler, s/Hz, for which its window is made.

    At each range it lies amid those of the targets with full dwell there, `slopes`, their smear included.
    """
    slope, spots = fit.slope(series), lines.spots
    left = slopes - slope.coefficients(spots.range)[..., 0]
    amid = fit.fit_amid(spots.range, left, lines.full, degree=GATE_DEGREES[0])
    slope.series[: amid.size, 0] += amid
    return slope


class RowFit(NamedTuple):
    """Scaling of polynomials along rows: ranges, m, and centre and scale of Doppler, Hz."""

    near: float
    far: float
    centre: float
    scale: float

    @classmethod
    def over(cls, rows: Axis, spots: Focus) -> RowFit:
        """Scaling over the rows of an image and the Doppler of its targets' focus."""
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
        """Fit a series in range to the mid-range of chosen values (n_range, n_yaw) at each range."""
        whole = which.any(axis=1)
        rows = [(values[i, which[i]], rng[i, which[i]].mean()) for i in np.flatnonzero(whole)]
        u = np.array([(2 * mean - self.near - self.far) / (self.far - self.near) for _, mean in rows])
        middles = np.array([(row.min() + row.max()) / 2 for row, _ in rows])
        terms = chebyshev.chebvander(u, min(degree, (len(rows) - 1) // 2)).T
        return np.asarray(solvers.least_squares(terms, middles, damping=1e-20 * u.size))

    def integral(self, series: FloatArray) -> RowPolynomial:
        """Integrate a polynomial with these coefficients (n, order + 1): cycles."""
        integral = np.zeros((series.shape[0], series.shape[1] + 1))
        integral[:, 1:] = series / np.arange(1, series.shape[1] + 1) * self.scale
        return self.polynomial(integral)

    def slope(self, series: FloatArray) -> RowPolynomial:
        """Extract the linear coefficient, per Hz."""
        return self.polynomial(series[:, 1:2] / self.scale)


@lru_cache
def _to_powers(most: int) -> FloatArray:
    """Power coefficients of the Chebyshev polynomials of degrees 0 .. most, one a row; read-only."""
    powers = np.zeros((most + 1, most + 1))
    for degree, row in enumerate(np.eye(most + 1)):
        powers[degree, : degree + 1] = chebyshev.cheb2poly(row[: degree + 1])
    powers.flags.writeable = False
    return powers


LENGTHS, MOST_LENGTHS = {1e-3: 1, 0.04: 2, 0.15: 3}, 4  # windows by the relative spread of the halves' lengths
MOST_SPREAD = 1.6  # the longest half over the shortest, between which so many windows are blended


def plan_taper(
    taper: Taper, halves: Sequence[FloatArray], lengths: Sequence[RowPolynomial], *, full: BoolArray
) -> DwellTaper:
    """Make the taper over dwells, whose halves have lengths (n_range, n_yaw), s, fitted by polynomials."""
    begin, end = (
        HalfDwell(length=length, lengths=_window_lengths(*_blended(half, full)))
        for half, length in zip(halves, lengths, strict=True)
    )
    return DwellTaper(taper=taper, begin=begin, end=end)


def _blended(lengths: FloatArray, full: BoolArray) -> tuple[float, float]:
    """Shortest and longest half of a dwell, s, for which windows are made.

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
    """Lengths between two, s, dense enough that blending their windows errs by less than a thousandth."""
    count = next((n for spread, n in LENGTHS.items() if longest <= (1 + spread) * shortest), MOST_LENGTHS)
    if count == 1:
        return ((shortest + longest) / 2,)
    return tuple(np.linspace(shortest, longest, count).tolist())


def band_spread(targets: TracedTargets) -> float:
    """Half of the time, s, over which a keystone spreads the ends of dwells; 0 without a keystone."""
    if targets.scaled_about is None:
        return 0.0
    collection, away = targets.geometry.collection, float(np.abs(np.array(targets.uncut) - targets.scaled_about).mean())
    return away * collection.bandwidth / 2 / collection.carrier


def end_lift(blur: float, spread: float, band: Taper = FLAT) -> float:
    """Height h of the triangle `DwellGate.lift`, for ends at +-`spread`, s, over a band with a weighting."""
    if not spread:
        return 0.0
    nodes, weights = solvers.gauss_legendre(NODES)
    shares = weights * band(nodes)
    squared = spread**2 * float((shares * nodes**2).sum() / shares.sum())
    return (blur**2 + squared) / (4 * blur) / (2 * blur - squared / (8 * blur))
