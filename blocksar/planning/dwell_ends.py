"""Find the ends of dwells after a chain's steps: when targets are lit, when their lines are, smear, and lost energy.

Steps in Doppler delay a signal, and the more the farther its Doppler is from the block's: a dwell begins and ends at
other times after the steps of a chain than when its target was lit, and its ends are no longer sharp.

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

LOSS at the ends of whole dwells in the echoes of what is lit there. At the begin of a pixel's dwell its own Doppler has
just entered the beam. The echoes of that moment come from there to the other edge of the beam: in the signal without
the pixel's own phase they have Dopplers from 0 to B, the band that is lit at a time, all to one side. An error e(t) of
the weights at that end then has the energy

    integral from 0 to B of g(f / B)^2 |E(f)|^2 df

with E the spectrum of e and g the antenna's pattern over the beam, from the edge at the pixel. Only if a pulse's echoes
filled all Dopplers was it that of e itself, which `prediction.blurred_energy` has: at most half of that, and much less
where the PRF is high over the band.

The definition sums pulses, an interval p apart: from the first one in a dwell on, the sum of exp(2j pi f t) p is that
of an integral from half an interval before, over sinc(f p). Where that begins is spread evenly over an interval. The
chain integrates, from an end that is spread over +-b (`dwell_gate`), smeared by an area a, and displaced by d, either
way alike:

    |E(f)|^2 = (1 / sinc(f p)^2 + s^2 - 2 s cos(pi a f^2) cos(2 pi f d)) / (2 pi f)^2,    s = sinc(2 f b).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from blocksar import solvers
from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import FLAT, Taper
from blocksar.focusing.lines import Line
from blocksar.planning.dwell_weights import beam_moves

BAND_NODES = 32  # of a mean over the band


def band_spread(collection: Collection, uncut: tuple[FloatArray, FloatArray], *, scaled_about: float | None) -> float:
    """Half of the time over which a keystone about a time spreads the ends of dwells, s; 0 without one.

    `uncut` are the ends, s from the epoch, as if the collection did not cut them.
    """
    if scaled_about is None:
        return 0.0
    return float(np.abs(np.array(uncut) - scaled_about).mean()) * collection.bandwidth / 2 / collection.carrier


def gate_blur(collection: Collection, spread: float) -> float:
    """Half of the time over which the ends of dwells are spread, s: over the band, and by the grid of pulses."""
    return math.hypot(spread, collection.pulse_interval / 2)


def end_lift(blur: float, spread: float, band: Taper = FLAT) -> float:
    """`DwellGate.lift`: the height h of the triangle, for ends at +-`spread`, s, over a band with a weighting."""
    if not spread:
        return 0.0
    nodes, weights = solvers.gauss_legendre(BAND_NODES)
    shares = weights * band(nodes)
    squared = spread**2 * float((shares * nodes**2).sum() / shares.sum())
    return (blur**2 + squared) / (4 * blur) / (2 * blur - squared / (8 * blur))


def at_ends(blur: float, lift: float, time: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Nodes and weights that raised end windows add to sums over dwells with weights (..., 2) at the ends, at `time`.

    Times (..., 4), s, and weights (..., 4), s, to be summed like the nodes of a quadrature.
    """
    inside, area = time + 2 * blur * np.array([1.0, -1.0]), 2 * blur * lift
    return np.concatenate([time, inside], axis=-1), area * np.concatenate([-weight, weight], axis=-1)


def lift_energy(blur: float, lift: float) -> float:
    """Energy by which raised windows differ from others at one end, s."""
    return 4 / 3 * blur * lift**2


TURNS = 3.0  # of f, in the time by which ends are smeared and displaced, up to which cosines are followed
LEAST_SINC = 0.2  # echoes of the far edge of the beam last too briefly for their sum to be ambiguous
NODES, FAR_NODES = 40, 12  # of the integrals up to there and beyond, where cosines vanish in the mean


def lit_energy(
    area: FloatArray,
    displaced: FloatArray,
    spread: FloatArray,
    *,
    blur: float,
    pulse_interval: float,
    lit_band: FloatArray | float,
    band: tuple[FloatArray, FloatArray],
    gain: FloatArray | None = None,
) -> FloatArray:
    """Mean energy (...) by which the ends of a chain differ from those at whole pulses, in what is lit, s.

    Parameters
    ----------
    area, displaced, spread : (...) float
        s^2, s, and s: ends lie at `displaced` -+ `spread` at the edges of the band.
    blur : float
        That of the gate, s.
    pulse_interval : float
        s.
    lit_band : (...) float
        B, Hz.
    band : pair of (n,) float
        Nodes over the band, -1 .. 1, and their shares.
    gain : (..., n) float, optional
        Legendre series of g^2 over the beam, from -1 at the edge where the end is to 1 at the other; default: 1.
    """
    area, displaced, spread, top = np.broadcast_arrays(area, displaced, spread, lit_band)
    shifts = displaced[..., None] - spread[..., None] * band[0]
    long = np.maximum(np.sqrt(np.abs(area)), np.abs(shifts).max(axis=-1))
    last = np.minimum(top, TURNS / np.maximum(long, 1e-12))

    def over(f: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """g^2, the energy of the sum over pulses over that of an integral, and s, at frequencies (..., m)."""
        at = 2 * f / top[..., None] - 1
        series = None if gain is None else np.moveaxis(gain, -1, 0)[..., None]
        power = np.ones(f.shape) if series is None else np.polynomial.legendre.legval(at, series, tensor=False)
        summed = 1 / np.maximum(np.sinc(f * pulse_interval), LEAST_SINC) ** 2
        return np.maximum(power, 0.0), summed, np.sinc(2 * f * blur)

    nodes, weights = solvers.gauss_legendre(NODES)
    f = last[..., None] * (1 + nodes) / 2
    power, summed, s = over(f)
    shifted = sum(share * np.cos(2 * np.pi * f * shifts[..., i, None]) for i, share in enumerate(band[1].tolist()))
    both = s * np.cos(np.pi * area[..., None] * f**2) * shifted
    near = (weights * power * (summed + s**2 - 2 * both) / f**2).sum(axis=-1) * last / 2

    nodes, weights = solvers.gauss_legendre(FAR_NODES)
    width = 1 / last - 1 / top
    power, summed, s = over(1 / (1 / top[..., None] + width[..., None] * (1 + nodes) / 2))
    far = (weights * power * (summed + s**2)).sum(axis=-1) * width / 2
    return np.asarray((near + far) / (4 * np.pi**2))


class ImageEdges(NamedTuple):
    """Where what is imaged begins and ends between places at which targets are traced: (n_range, n_yaw) each.

    Targets next beyond stand for targets at the edge: what those lose is interpolated between them and the next ones.
    """

    held: BoolArray  # the targets inside; where none lies inside, those on either side of it
    before: BoolArray  # those next beyond the beginning
    behind: BoolArray  # those next beyond the end
    share: FloatArray  # of the way to them at which the edge lies, from the ones next to them
    axis: int

    @classmethod
    def between(cls, places: FloatArray, first: FloatArray, last: FloatArray, *, axis: int) -> ImageEdges:
        """Edges of the imaged interval [first, last] (m,) among places (n,) along one axis, at m along the other."""
        at, step = places[:, None], np.diff(places)[:, None]
        held = (at >= first) & (at <= last)
        before, behind, share = np.zeros_like(held), np.zeros_like(held), np.zeros(held.shape)
        before[:-1], behind[1:] = (at[:-1] < first) & (at[1:] >= first), (at[1:] > last) & (at[:-1] <= last)
        share[:-1] = np.where(before[:-1], (at[1:] - first) / step, 0.0)
        share[1:] += np.where(behind[1:], (last - at[:-1]) / step, 0.0)
        held = held if held.any() else before | behind
        return cls(held.T, before.T, behind.T, share.T, axis) if axis else cls(held, before, behind, share, axis)

    def of_dwells(self, full: BoolArray) -> ImageEdges:
        """Edges where the targets on either side have full dwell."""
        before, behind = self.before & full, self.behind & full
        along = (before.T, behind.T, full.T) if self.axis else (before, behind, full)
        along[0][:-1] &= along[2][1:]
        along[1][1:] &= along[2][:-1]
        return self._replace(before=before, behind=behind)

    def beside(self, target: tuple[int, ...]) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
        """Pairs of targets, beyond an edge and next to it inside, at a target's place along the other axis."""
        row, column = target
        pairs: list[tuple[tuple[int, ...], tuple[int, ...]]] = []
        for beyond, step in ((self.before, 1), (self.behind, -1)):
            if self.axis:
                pairs += [((row, at), (row, at + step)) for at in np.flatnonzero(beyond[row]).tolist()]
            else:
                pairs += [((at, column), (at + step, column)) for at in np.flatnonzero(beyond[:, column]).tolist()]
        return pairs

    def at(self, lost: FloatArray) -> FloatArray:
        """Losses (n_range, n_yaw), with those at the edges in place of those beyond."""
        inner = lost.copy()
        into, own, behind = (inner.T, lost.T, self.behind.T) if self.axis else (inner, lost, self.behind)
        into[:-1] = own[1:]
        into[1:] = np.where(behind[1:], own[:-1], into[1:])
        return np.where(self.before | self.behind, inner + self.share * (lost - inner), lost)


GUARD = 0.05  # of a dwell, kept beyond the ends of lines in time
SMEAR_ROOM = 100.0  # see `smear_room`
FULL = 0.999  # of the longest dwell: a full one

Moments = tuple[FloatArray, FloatArray]  # of each target in the first and in the second half of its dwell, s


class DwellEnds(NamedTuple):
    """Conditions of the ends of dwells besides the lines."""

    rate: FloatArray  # of the lines before the steps in Doppler, Hz/s
    uncut: Moments  # (n_yaw,) or (n_range, n_yaw), s from the epoch, as if the collection did not cut the dwells
    scaled_about: float | None  # time about which a keystone scales time, s
    moves: FloatArray | None  # from `band_moves`, (n_range, n_yaw, n); None with a keystone
    full: BoolArray  # (n_range, n_yaw), from `full_dwells`
    passing: FloatArray | None  # from `Sector.passing`

    @property
    def longest(self) -> float:
        """The longest of the uncut dwells, s."""
        return float((self.uncut[1] - self.uncut[0]).max())


class LitTimes(NamedTuple):
    """Lines after all steps of a chain by the times at which their targets are lit.

    Moments are (n_yaw,) or (n_range, n_yaw), s from the epoch.
    """

    line: Line  # (n_range, n_yaw, n), after all steps
    first: FloatArray  # begin and end of the dwells before all steps, (n_range, n_yaw) s
    last: FloatArray

    @classmethod
    def of(cls, lit: Line, line: Line) -> LitTimes:
        """Times of targets from their lines before and after all steps."""
        return cls(line, *dwell_ends(lit))

    def after(self, moment: FloatArray) -> FloatArray:
        """Times (n_range, n_yaw) of lines after all steps, of a moment of their targets: beyond the dwells straight."""
        time = self.at(self.line.time, moment)
        before, beyond = np.minimum(moment - self.first, 0.0), np.maximum(moment - self.last, 0.0)
        return np.asarray(time + before * self.line.stretch[..., 0] + beyond * self.line.stretch[..., -1])

    def at(self, values: FloatArray, moment: FloatArray) -> FloatArray:
        """Values (n_range, n_yaw, n) at the nodes of the lines, at a moment of their targets inside the dwells."""
        n = values.shape[-1]
        u = (2 * np.clip(moment, self.first, self.last) - self.first - self.last) / (self.last - self.first)
        series = solvers.product(values, solvers.legendre_series(n, n - 1).T)
        return np.asarray(np.polynomial.legendre.legval(u, np.moveaxis(series, -1, 0), tensor=False))

    def ends(self, uncut: Moments) -> Moments:
        """Times at which uncut dwells begin and end after all steps, (n_range, n_yaw)."""
        begins, ends = dwell_ends(self.line)
        begins = begins - (self.first - uncut[0]) * self.line.stretch[..., 0]
        return begins, ends + (uncut[1] - self.last) * self.line.stretch[..., -1]


def dwell_ends(line: Line) -> tuple[FloatArray, FloatArray]:
    """Times at which the dwells of lines (..., n) begin and end after all steps, (...) s: beyond the outer nodes."""
    outside = line.weight.sum(axis=-1) * (1 + solvers.gauss_legendre(line.time.shape[-1])[0][0]) / 2
    begins = line.time[..., 0] - outside * line.stretch[..., 0]
    return begins, line.time[..., -1] + outside * line.stretch[..., -1]


def reaches_full(geometry: Geometry, epoch_range: FloatArray, yaw: FloatArray) -> bool:
    """Whether any target is lit over its full dwell, at epoch ranges (n), m, and yaws (m), rad.

    Not where it begins and ends while the beam is over a target: such a dwell is a part of a full one.
    """
    if not beam_moves(geometry.collection):
        return True
    first, last = geometry.beam.dwell_at(yaw, epoch_range[:, None], uncut=True)
    begin, end = geometry.beam.dwell_at(yaw, epoch_range[:, None])
    return bool(((last > first) & (end - begin >= FULL * (last - first))).any())


def full_dwells(line: Line, geometry: Geometry, epoch_range: FloatArray, yaw: FloatArray) -> BoolArray:
    """Find which lines (..., n) of targets at epoch ranges (m) and yaws (rad), broadcast, are lit over a full dwell.

    It is the target's own dwell as if the ends of the collection did not cut it: dwells depend on range under a beam
    about its axis, and on yaw under one that does not turn evenly. Where there is no such target, or the beam stays, it
    is the longest of them, or nearly.
    """
    lit = np.broadcast_to(line.weight, line.time.shape).sum(axis=-1)
    if beam_moves(geometry.collection):
        first, last = geometry.beam.dwell_at(yaw, epoch_range, uncut=True)
        full = lit >= FULL * (last - first)
        if full.any():
            return np.asarray(full)
    longest = float(lit.max())  # not above 0 where nothing is lit
    return np.asarray(lit >= (FULL * longest if longest > 0 else longest))


def band_moves(line: Line, rate: FloatArray) -> FloatArray:
    """Time (..., n) by which relative range frequency moves lines without a keystone, s.

    A line has the Doppler (1 + f / fc) fd at a range frequency f. Range compression in the Doppler domain makes a
    Doppler arrive when it does at the carrier, and so a pulse's echo by f / fc fd / rate later than at the carrier:
    ends of dwells and slopes of a taper move as by a keystone, and farther where the Doppler rate is small.
    """
    passed = np.abs(rate) > 1e-6 * np.abs(rate).max()
    return np.where(passed, line.doppler / np.where(passed, rate, 1.0), 0.0)


def end_smear(line: Line, rate: FloatArray) -> FloatArray:
    """Slope D' (..., 2) of the delay that the steps in Doppler give the begin and the end of dwells, s/Hz.

    `rate` is the lines' Doppler rate before these steps. Where it vanishes, so does the smear: no Doppler is passed.

    The area of the smear is D' times the stretch of the line, since the end is smeared in the time after the steps.
    Windows are not made with that, which costs at most 1e-4 of coherence on `table1`.
    """
    ends, rate = line.stretch[..., [0, -1]], rate[..., [0, -1]]
    passed = np.abs(rate) > 1e-6 * np.abs(rate).max()
    return np.where(passed, (1 - ends) / np.where(passed, rate, 1.0), 0.0)


def smear_room(line: Line, rate: FloatArray) -> float:
    """Time beyond GUARD that ends which no gate cuts need to be summed to the end of their smear, s.

    What is smeared further than d wraps around: with a = |D'|, the energy a / (2 pi^2 d) of either end. Measured, the
    loss falls faster, and is about 1e-4 of coherence at d = 100 a / dwell.
    """
    dwell = float(np.max(line.weight.sum(axis=-1)))
    return max(SMEAR_ROOM * float(np.abs(end_smear(line, rate)).max()) / dwell - GUARD * dwell, 0.0)
