"""Planning of a block's gates: the range gate of a sub-block, and the dwell gate of the final transform."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev, legendre

from blocksar import solvers
from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.beam import dwell_at
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import FLAT, Taper
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.focusing.dwell_gate import DwellGate
from blocksar.focusing.dwell_taper import DwellTaper, HalfDwell
from blocksar.focusing.lines import LEAST_STRETCH, Focus, Line, RowPolynomial
from blocksar.focusing.range_gate import RangeGate
from blocksar.kernels import fourier
from blocksar.kernels.fourier import Axis
from blocksar.planning.target_lines import middle_line

RANGE_GUARD = 48  # range cells on either side of a sub-block, for side lobes of targets at its ends
BAND_ROOM = 0.08  # of the band, on either side of it, over which a sub-block's range frequencies fall to zero
GUARD = 0.05  # of a dwell, kept beyond the ends of lines in time
SMEAR_ROOM = 100.0  # see `smear_room`
GATE_ROOM = 1.62  # dwells that the sampling in Doppler has room for
FADE_ROOM = 9.0  # sqrt(e) on either side of a dwell for which it has room where edges fade out, at least
FULL = 0.999  # of the longest dwell: a full one
GATE_DEGREES = 4, 5  # of the ends of dwells in range and in Doppler
FIT_PRECISION = 0.02  # of the time in which an edge fades out, to which the ends of dwells are fitted
UNCUT = 1e-4  # of a dwell: by less, the collection does not cut it
UNKNOWN = 1e-4  # weight in that fit of an end that the collection cuts off: there is nothing to gate where it lies
LEAST_SPREAD = 1e-3  # of halves' lengths, over which the place in the beam halfway is fitted
EDGES = 1e-4, 0.28  # shares of a half where an edge that fades out may be over
HALFWAY = 0.3, 0.7  # shares of a half where the place in the beam may be half of that at its edge
LENGTHS, MOST_LENGTHS = {1e-3: 1, 0.04: 2, 0.15: 3}, 4  # windows by the relative spread of the halves' lengths


def plan_range_gate(full: Axis, slab: Axis, line: Line, carrier: float) -> RangeGate:
    """The gate that holds the ranges of lines (n_range, n_yaw) at each Doppler, with room for side lobes."""
    u = (2 * line.doppler - slab.start - (slab.start + slab.extent)) / slab.extent
    centre = middle_line(u.ravel(), line.range.ravel(), order=6)
    spread = line.range - chebyshev.chebval(u, centre)
    # In a Doppler bin the ends of the band belong to other times than the carrier: a smear that SRC removes later.
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


class Scaling(NamedTuple):
    """What a keystone does to times at a range frequency: t -> about + (t - about) factor."""

    about: float = 0.0  # s from the epoch
    factor: float = 1.0

    def __call__(self, time: FloatArray) -> FloatArray:
        return time if self.factor == 1 else self.about + (time - self.about) * self.factor


NO_SCALING = Scaling()


class GateParts(NamedTuple):
    """Places over the band, -1 .. 1, for which gates are made, and Lagrange's polynomials through them.

    Row k of `series` is the Legendre series of the polynomial that is 1 at node k.
    """

    nodes: FloatArray
    series: FloatArray

    def at(self, place: float) -> FloatArray:
        """The polynomials (n,) at a place."""
        return np.asarray(legendre.legval(place, self.series.T))


@lru_cache
def gate_parts(n: int) -> GateParts:
    """Of a gate of n parts, at Gauss-Legendre nodes."""
    nodes, weights = solvers.gauss_legendre(n)
    orders = np.arange(n)
    return GateParts(nodes, weights[:, None] * (orders + 0.5) * legendre.legvander(nodes, n - 1))


def plan_gate(
    line: Line,
    spots: Focus,
    rate: FloatArray,
    *,
    blur: float,
    lit: Line,
    uncut: tuple[FloatArray, FloatArray],
    full: BoolArray,
    rows: Axis,
    slow: Axis,
    taper: Taper = FLAT,
    degree: tuple[int, int] = GATE_DEGREES,
    fade: int = 0,
    passing: tuple[FloatArray, ...] = (),
    scaling: Scaling = NO_SCALING,
    uneven: float = np.inf,
) -> DwellGate | None:
    """The gate that follows the ends of the dwells along Doppler, from the lines (n_range, n_yaw) of targets.

    Dwells that the ends of the collection cut are gated as if they continued: nothing lies beyond. None where all
    targets dwell at the same time: a gate could not separate them.

    Parameters
    ----------
    line : Line
        After all steps.
    rate : (n_range, n_yaw, n) float
        The lines' Doppler rate before the steps in Doppler, Hz/s.
    blur : float
        Half of the time over which range frequency spreads an end, s.
    lit : Line
        The lines before all steps.
    uncut : pair of (n_yaw,) or (n_range, n_yaw) float
        Slow time, s from the epoch, at which the dwells would begin and end if the collection did not cut them.
    full : (n_range, n_yaw) bool
        From `full_dwells`.
    taper : Taper
        Weighting over the dwells.
    degree : (int, int)
        Of the ends of dwells, in range and in Doppler.
    fade : int
        From `planning.edges`: where positive, the edges of dwells fade out.
    passing : tuple of (n_range, n_yaw) float, optional
        Slow times, s from the epoch, at which the beam's centre passes the targets, by default amid their dwells; and
        with `fade` those at which the edge after the begin ends, and at which that before the end begins; then, where
        the place in the beam is not linear in time, those at which it is -1 / 2 and 1 / 2.
    scaling : Scaling
        Of these times, at the range frequency for which the gate is made.
    uneven : float
        Loss of coherence by the stretch of lines, above which windows with `fade` make up for it.
    """
    weighed = fade > 0 or not taper.uniform
    begins, ends = dwell_ends(line)
    first, last = dwell_ends(lit)
    cut = first - uncut[0], uncut[1] - last
    uncut, passing = (scaling(uncut[0]), scaling(uncut[1])), tuple(scaling(each) for each in passing)
    begins = begins - (first - uncut[0]) * line.stretch[..., 0]
    ends = ends + (uncut[1] - last) * line.stretch[..., -1]
    middles, lengths = (begins + ends) / 2, ends - begins
    if np.ptp(middles) < 0.02 * lengths.max() and not weighed:  # a taper needs its windows all the same
        return None
    doppler = spots.doppler
    near, far = rows.start, rows.start + rows.extent
    scale = max(float(np.ptp(spots.doppler) / 2), 1e-6)
    place = _RowPlace(near, far, centre=float((doppler.min() + doppler.max()) / 2), scale=scale)
    length, smear = float(lengths.mean()), end_smear(line, rate, faded=fade > 0)
    edges = [begins + length / 2, ends - length / 2]
    if weighed:
        middle = _crossing(line, (first, last), passing[0] if passing else (uncut[0] + uncut[1]) / 2)
        edges += [middle - begins, ends - middle]
    shares: list[FloatArray] = []
    for first_moment, last_moment in zip(passing[1::2], passing[2::2], strict=True) if fade else ():
        after, before = (_crossing(line, (first, last), moment) for moment in (first_moment, last_moment))
        shares += [(after - begins) / edges[2], (ends - before) / edges[3]]
    levels = _levels(line, (first, last), passing[0], full, uneven) if fade and passing else (0.0, 0.0)
    begin, end, *halves = _fit_ends(place, spots, np.stack(edges), degree=degree, cut=cut, length=length, fade=fade)
    phases = place.integral(begin), place.integral(end)
    at_middle = place.integral((begin + end) / 2).coefficients(np.array((near + far) / 2))[None]
    common = place.polynomial(at_middle)
    _, shared, _ = common.evaluate(spots.range, spots.doppler[..., None])
    along = [phase.evaluate(spots.range, spots.doppler[..., None]) for phase in phases]
    apart = max(float(np.abs(at - shared).max()) for _, at, _ in along)
    moves = [bend[..., 0] for _, _, bend in along]
    begin_slope = _slope(place, begin, spots, smear[..., 0] + moves[0], full=full)
    end_slope = _slope(place, end, spots, smear[..., 1] + moves[1], full=full)
    room = GATE_ROOM * length
    if fade:
        room = max(room, faded_room(length, max(float(np.abs(s.series[0]).max()) for s in (begin_slope, end_slope))))
    size = min(fourier.fast_length((room + 2 * apart) / slow.step), slow.size)
    return DwellGate(
        begin=phases[0],
        end=phases[1],
        common=common,
        begin_slope=begin_slope,
        end_slope=end_slope,
        blur=blur,
        length=length,
        time=fourier.centred(0.0, slow.step, size),
        taper=_plan_taper(
            taper, fade, [place.polynomial(series) for series in halves], edges[2:], shares, full, levels
        ),
    )


def faded_room(length: float, slope: float) -> float:
    """Time that a gate needs where the edges of dwells fade out, s: beyond a dwell, it fades out clear of the smear."""
    return length + 2 * FADE_ROOM * math.sqrt(slope)


def _fit_ends(
    place: _RowPlace,
    spots: Focus,
    edges: FloatArray,
    *,
    degree: tuple[int, int],
    cut: tuple[FloatArray, FloatArray],
    length: float,
    fade: int,
) -> list[FloatArray]:
    """Fit begins and ends, and under a weighting the lengths of halves: (2 or 4, n_range, n_yaw), s.

    Where edges fade out, those that the collection cuts off, by the times `cut`, are left to the others.
    """
    if not fade:
        return place.fit(spots, edges, degree, known=np.ones(edges.shape[1:], np.bool_))
    known = [time < UNCUT * length for time in cut]
    known = [each if each.any() else np.ones_like(each) for each in known]
    precision = FIT_PRECISION * length / (2 * fade)
    fitted = [place.fit(spots, edges[i::2], degree, known=known[i], precision=precision) for i in (0, 1)]
    return [series for pair in zip(*fitted, strict=True) for series in pair]


def _crossing(line: Line, lit: tuple[FloatArray, FloatArray], moment: FloatArray) -> FloatArray:
    """Times (n_range, n_yaw) at which lines are after all steps, of the `moment` at which they were lit, s.

    The moment is (n_yaw,) or (n_range, n_yaw).
    `lit` has the begin and the end of the dwells before all steps, (n_range, n_yaw): beyond them lines go on straight.
    """
    first, last = lit
    time = _at_moment(line.time, lit, moment)
    before, after = np.minimum(moment - first, 0.0), np.maximum(moment - last, 0.0)
    return np.asarray(time + before * line.stretch[..., 0] + after * line.stretch[..., -1])


def _at_moment(values: FloatArray, lit: tuple[FloatArray, FloatArray], moment: FloatArray) -> FloatArray:
    """Values (n_range, n_yaw, n) at the nodes of lines, at the `moment` inside their dwells, as in `_crossing`."""
    (first, last), n = lit, values.shape[-1]
    u = (2 * np.clip(moment, first, last) - first - last) / (last - first)
    series = solvers.product(values, solvers.legendre_series(n, n - 1).T)
    return np.asarray(np.polynomial.legendre.legval(u, np.moveaxis(series, -1, 0), tensor=False))


def _levels(
    line: Line, lit: tuple[FloatArray, FloatArray], middle: FloatArray, full: BoolArray, uneven: float
) -> tuple[float, float]:
    """Levels of both halves of dwells that make up for the stretch of lines; 0 where it costs less than `uneven`.

    The sum over a dwell weighs its lines by sqrt(stretch). `middle` is the time when the beam's centre passes.
    """
    full = full if full.any() else np.ones_like(full)
    stretch = np.maximum(line.stretch, LEAST_STRETCH)
    even = line.weight.sum(axis=-1) * (line.weight * stretch).sum(axis=-1)
    if np.median((1 - (line.weight * np.sqrt(stretch)).sum(axis=-1) / np.sqrt(even))[full]) < uneven:
        return 0.0, 0.0
    amid = _at_moment(stretch, lit, middle)
    begin, end = (float(np.median(np.sqrt(amid / stretch[..., i])[full])) - 1 for i in (0, -1))
    return begin, end


def _plan_taper(
    taper: Taper,
    fade: int,
    lengths: list[RowPolynomial],
    halves: list[FloatArray],
    shares: list[FloatArray],
    full: BoolArray,
    levels: tuple[float, float],
) -> DwellTaper | None:
    """The taper over dwells whose halves have the lengths of `halves`, each (n_range, n_yaw), and the polynomials.

    `shares` (n_range, n_yaw) are those of edges that fade out in the two halves; then, if known, those at which the
    place in the beam is half of that at its edge.
    """
    if not halves:
        return None
    both = []
    for i, (length, half) in enumerate(zip(lengths, halves, strict=True)):
        windows = _window_lengths(float(half.min()), float(half.max()))
        edge = float(np.median(shares[i][full])) if shares else 0.0
        knots: tuple[tuple[float, float], ...] = ()
        if len(shares) > 2:
            edges, halfways = (_by_length(each[full], half[full], windows) for each in shares[i::2])
            knots = tuple(zip(np.clip(edges, *EDGES).tolist(), np.clip(halfways, *HALFWAY).tolist(), strict=True))
        both.append(HalfDwell(length=length, lengths=windows, edge=edge, knots=knots, level=levels[i]))
    return DwellTaper(taper=taper, begin=both[0], end=both[1], fade=fade)


def _by_length(shares: FloatArray, lengths: FloatArray, windows: tuple[float, ...]) -> FloatArray:
    """Shares (n,) of halves of some lengths (n,), s, fitted linearly over the length, at those of windows."""
    middle, spread = float(np.median(lengths)), float(np.ptp(lengths))
    slope, level = 0.0, float(np.median(shares))
    if spread > LEAST_SPREAD * middle:
        away = lengths - lengths.mean()
        slope, level = float((away * shares).sum() / (away * away).sum()), float(shares.mean())
        middle = float(lengths.mean())
    return level + slope * (np.array(windows) - middle)


def _window_lengths(shortest: float, longest: float) -> tuple[float, ...]:
    """So many lengths between two, s, that blending windows of them errs by less than a thousandth."""
    count = next((n for spread, n in LENGTHS.items() if longest <= (1 + spread) * shortest), MOST_LENGTHS)
    if count == 1:
        return ((shortest + longest) / 2,)
    return tuple(np.linspace(shortest, longest, count).tolist())


@lru_cache
def _to_powers(most: int) -> FloatArray:
    """Power coefficients of the Chebyshev polynomials of degrees 0 .. most, one a row; read-only."""
    powers = np.zeros((most + 1, most + 1))
    for degree, row in enumerate(np.eye(most + 1)):
        powers[degree, : degree + 1] = chebyshev.cheb2poly(row[: degree + 1])
    powers.flags.writeable = False
    return powers


def band_moves(line: Line, rate: FloatArray) -> FloatArray:
    """Time (..., 2) by which relative range frequency moves begins and ends of dwells without a keystone, s.

    A line has the Doppler (1 + f / fc) fd at a range frequency f, so that in the Doppler domain its ends lie there.
    """
    ends = rate[..., [0, -1]]
    passed = np.abs(ends) > 1e-6 * np.abs(ends).max()
    return np.where(passed, line.doppler[..., [0, -1]] / np.where(passed, ends, 1.0), 0.0)


def full_dwells(line: Line, geometry: Geometry, epoch_range: FloatArray, yaw: FloatArray) -> BoolArray:
    """Which lines (..., n) of targets at epoch ranges (m) and yaws (rad), broadcast, are lit over a full dwell.

    That is the longest of them, or nearly. Under a beam about its axis, whose dwells depend on range, it is the
    target's own dwell as if the ends of the collection did not cut it, where there is any such target.
    """
    lit = np.broadcast_to(line.weight, line.time.shape).sum(axis=-1)
    if geometry.collection.has_axis:
        first, last = dwell_at(geometry, yaw, epoch_range, uncut=True)
        full = lit >= FULL * (last - first)
        if full.any():
            return np.asarray(full)
    longest = float(lit.max())  # not above 0 where nothing is lit
    return np.asarray(lit >= (FULL * longest if longest > 0 else longest))


def dwell_ends(line: Line) -> tuple[FloatArray, FloatArray]:
    """Times at which the dwells of lines (..., n) begin and end after all steps, (...) s: beyond the outer nodes."""
    outside = line.weight.sum(axis=-1) * (1 + solvers.gauss_legendre(line.time.shape[-1])[0][0]) / 2
    begins = line.time[..., 0] - outside * line.stretch[..., 0]
    return begins, line.time[..., -1] + outside * line.stretch[..., -1]


def end_smear(line: Line, rate: FloatArray, *, faded: bool = False) -> FloatArray:
    """Slope D' (..., 2) of the delay that the steps in Doppler give the begin and the end of dwells, s/Hz.

    `rate` is the lines' Doppler rate before these steps. Where it vanishes, so does the smear: no Doppler is passed.

    The area of the smear is D' times the stretch of the line, since the end is smeared in the time after the steps.
    Windows of ends that are `faded` are made with that. Those of whole dwells are not, which costs at most 1e-4 of
    coherence on `table1`.
    """
    ends, rate = line.stretch[..., [0, -1]], rate[..., [0, -1]]
    passed = np.abs(rate) > 1e-6 * np.abs(rate).max()
    return np.where(passed, (1 - ends) / np.where(passed, rate, 1.0), 0.0) * (ends if faded else 1.0)


def smear_room(line: Line, rate: FloatArray) -> float:
    """Time beyond GUARD that ends which no gate cuts need to be summed to the end of their smear, s.

    What is smeared further than d wraps around: with a = |D'|, the energy a / (2 pi^2 d) of either end. Measured, the
    loss falls faster, and is about 1e-4 of coherence at d = 100 a / dwell.
    """
    dwell = float(np.max(line.weight.sum(axis=-1)))
    return max(SMEAR_ROOM * float(np.abs(end_smear(line, rate)).max()) / dwell - GUARD * dwell, 0.0)


def _slope(place: _RowPlace, series: FloatArray, spots: Focus, slopes: FloatArray, *, full: BoolArray) -> RowPolynomial:
    """Slope of an end in Doppler with which its window is made, s/Hz.

    At each range it lies amid those of the targets with full dwell there, `slopes`, their smear included.
    """
    slope = place.slope(series)
    left = slopes - slope.coefficients(spots.range)[..., 0]
    whole = full.any(axis=1)
    rows = [(left[i, full[i]], spots.range[i, full[i]].mean()) for i in np.flatnonzero(whole)]
    u = np.array([(2 * rng - place.near - place.far) / (place.far - place.near) for _, rng in rows])
    middles = np.array([(values.min() + values.max()) / 2 for values, _ in rows])
    degree = min(GATE_DEGREES[0], (len(rows) - 1) // 2)
    terms = chebyshev.chebvander(u, degree).T
    slope.series[: degree + 1, 0] += solvers.least_squares(terms, middles, damping=1e-20 * u.size)
    return slope


class _RowPlace(NamedTuple):
    """Where polynomials along rows lie: ranges, m, and the centre and scale of Doppler, Hz."""

    near: float
    far: float
    centre: float
    scale: float

    def polynomial(self, series: FloatArray) -> RowPolynomial:
        return RowPolynomial(series=series, near=self.near, far=self.far, centre=self.centre, scale=self.scale)

    def fit(
        self,
        spots: Focus,
        values: FloatArray,
        degrees: tuple[int, int],
        *,
        known: BoolArray,
        precision: float = 0.0,
    ) -> list[FloatArray]:
        """Fit values (n, n_range, n_yaw), s, where targets focus: series in range of powers of z, one for each.

        With a `precision`, s, the lowest degree in Doppler is taken that meets the `known` values to it, up to that of
        `degrees`, and the others count little: the image of a block also has the ends of dwells of targets beyond it,
        and polynomials of a high degree leave them.
        """
        u = (2 * spots.range.ravel() - self.near - self.far) / (self.far - self.near)
        z = (spots.doppler.ravel() - self.centre) / self.scale
        flat, counts = values.reshape(values.shape[0], -1), np.where(known.ravel(), 1.0, UNKNOWN)
        in_range, most = degrees
        for degree in range(1 if precision > 0 else most, most + 1):
            basis = np.asarray(chebyshev.chebvander2d(u, z, [in_range, degree]).T, np.float64)
            fitted = solvers.least_squares(basis * counts, flat * counts, damping=1e-20 * u.size)
            left = solvers.product(basis.T, fitted).T - flat
            if degree == most or np.abs(left[:, known.ravel()]).max(initial=0.0) <= precision:
                break
        found = []
        for row in fitted.T:
            series = np.zeros((in_range + 1, most + 1))
            series[:, : degree + 1] = row.reshape(-1, degree + 1)
            found.append(solvers.product(series, _to_powers(most)))
        return found

    def integral(self, series: FloatArray) -> RowPolynomial:
        """The polynomial whose derivative has these coefficients (n, order + 1): cycles."""
        integral = np.zeros((series.shape[0], series.shape[1] + 1))
        integral[:, 1:] = series / np.arange(1, series.shape[1] + 1) * self.scale
        return self.polynomial(integral)

    def slope(self, series: FloatArray) -> RowPolynomial:
        """The linear coefficient, per Hz."""
        return self.polynomial(series[:, 1:2] / self.scale)
