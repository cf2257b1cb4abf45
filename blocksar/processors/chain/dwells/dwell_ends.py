"""Ends of dwells after a chain's steps: their times, their smear, and the energy lost there.

Steps in Doppler delay a signal by more the farther its Doppler is from the block's: after the steps of a chain, a dwell
begins and ends at other times than those at which its target was lit, and its ends are no longer sharp.

SMEARED ENDS. Steps in Doppler that delay by D(f) smear a sharp end of the dwell gate into a Fresnel integral of area D'
(less the mean of the block, with which the gate is made), and displace it where the gate's fit does not meet it. The
keystone scales time by 1 + f / fc, which displaces the ends at the band's edges. With F the smeared end and H the sharp
one displaced by d, the weights differ by the energy

    integral of |F(t) - H(t - d)|^2 dt = sqrt(a) h(d / sqrt(a)),    z = sqrt(2) d / sqrt(a),
    h = (z (C(z) + S(z)) + (cos(pi z^2 / 2) - sin(pi z^2 / 2)) / pi) / sqrt(2),

from |F - H|^2 integrated at d = 0 in frequency, sqrt(a / 2) / pi, and d/dd = 2 Re F(d) - 1. Half of it, over the dwell,
would be lost at each end if every pulse held all Dopplers (`blurred_energy`).

LOSS at the ends of whole dwells in the echoes of what is lit there. At the begin of a pixel's dwell its own Doppler has
just entered the beam. The echoes of that moment come from there to the other edge of the beam: in the signal without
the pixel's own phase they have Dopplers from 0 to B, the band that is lit at a time, all to one side. An error e(t) of
the weights at that end then has the energy

    integral from 0 to B of g(f / B)^2 |E(f)|^2 df

with E the spectrum of e and g the antenna's pattern over the beam, from the edge at the pixel. Only if a pulse's echoes
filled all Dopplers was it that of e itself, which `blurred_energy` has: at most half of that, and much less where the
PRF is high over the band.

The definition sums pulses, an interval p apart: from the first one in a dwell on, the sum of exp(2j pi f t) p is that
of an integral from half an interval before, over sinc(f p). Where that begins is spread evenly over an interval. The
chain integrates, from an end that is spread over +-b (`dwell_gate`), smeared by an area a, and displaced by d, either
way alike:

    |E(f)|^2 = (1 / sinc(f p)^2 + s^2 - 2 s cos(pi a f^2) cos(2 pi f d)) / (2 pi f)^2,    s = sinc(2 f b).
"""

from __future__ import annotations

from functools import cache

import numpy as np

from blocksar import solvers
from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import FLAT, Taper
from blocksar.kernels.fresnel import FAR, far_fresnel_integral
from blocksar.processors.chain.dwells.dwell_weights import beam_moves
from blocksar.processors.chain.steps.lines import Focus, Line

GUARD = 0.05  # of a dwell, kept beyond the ends of lines in time
SMEAR_ROOM = 100.0  # see `smear_room`
FULL = 0.999  # of the longest dwell: a full one

Moments = tuple[FloatArray, FloatArray]  # of each target in the first and in the second half of its dwell, s


def dwell_ends(line: Line) -> tuple[FloatArray, FloatArray]:
    """Times at which the dwells of lines (..., n) begin and end after all steps, (...) s: beyond the outer nodes."""
    outside = line.weight.sum(axis=-1) * (1 + solvers.gauss_legendre(line.time.shape[-1])[0][0]) / 2
    begins = line.time[..., 0] - outside * line.stretch[..., 0]
    return begins, line.time[..., -1] + outside * line.stretch[..., -1]


def reaches_full(geometry: Geometry, epoch_range: FloatArray, yaw: FloatArray) -> bool:
    """Tell whether any target at epoch ranges (n), m, and yaws (m), rad, is lit over its full dwell.

    Not where it begins and ends while the beam is over a target: such a dwell is a part of a full one.
    """
    if not beam_moves(geometry.collection):
        return True
    first, last = geometry.beam.dwell_at(yaw, epoch_range[:, None], uncut=True)
    begin, end = geometry.beam.dwell_at(yaw, epoch_range[:, None])
    return bool(((last > first) & (end - begin >= FULL * (last - first))).any())


def full_dwells(line: Line, geometry: Geometry, epoch_range: FloatArray, yaw: FloatArray) -> BoolArray:
    """Mask of lines (..., n) of targets at epoch ranges (m) and yaws (rad), broadcast, with full dwell.

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
    """Extra time, s, beyond GUARD, for which ungated ends must be summed to contain their smear.

    What is smeared further than d wraps around: with a = |D'|, the energy a / (2 pi^2 d) of either end. Measured, the
    loss falls faster, and is about 1e-4 of coherence at d = 100 a / dwell.
    """
    dwell = float(np.max(line.weight.sum(axis=-1)))
    return max(SMEAR_ROOM * float(np.abs(end_smear(line, rate)).max()) / dwell - GUARD * dwell, 0.0)


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
    """Mean energy (...), s, of the difference of a chain's dwell ends from those at whole pulses, within lit Doppler.

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


BAND_NODES = 4  # of the means over range frequency
KNOTS = 128  # of the table of the energy of an end, per unit of z
KNOT_NODES = 6  # of the integrals from one of them to the next


def blurred_energy(
    area: FloatArray,
    displaced: FloatArray,
    spread: FloatArray,
    blur: FloatArray | float,
    pulse_interval: float,
    taper: Taper = FLAT,
) -> FloatArray:
    """Mean energy, s, of the difference between smeared ends, spread by +-`spread` over the band, and their gate.

    The gate is the mean of sharp ends spread by +-`blur`; the energy by which it differs from an end is the mean of the
    energies by which those do, less their own variance, blur / 3.
    """
    nodes, weights = solvers.gauss_legendre(BAND_NODES)
    _, shares = band_nodes(taper)
    shape = np.broadcast_shapes(area.shape, displaced.shape, spread.shape)
    band = nodes.reshape(-1, 1, *(1,) * len(shape))
    gate = band.swapaxes(0, 1)
    apart = np.hypot(displaced - band * spread - gate * blur, pulse_interval / np.sqrt(12))
    total = np.einsum("i,j,ij...->...", 2 * shares, weights, end_energy(area, apart)) / 4
    return np.maximum(total - blur / 3, 0.0)


def band_nodes(taper: Taper, n: int = BAND_NODES) -> tuple[FloatArray, FloatArray]:
    """Nodes over the band, -1 .. 1, and their shares in a mean under the square of the weighting."""
    nodes, weights = solvers.gauss_legendre(n)
    if taper.uniform:
        return nodes, weights / 2
    shares = weights * taper(nodes) ** 2
    return nodes, shares / shares.sum()


def end_energy(area: FloatArray, displaced: FloatArray) -> FloatArray:
    """Energy, s, of the difference between a smeared, displaced end and a sharp one; area, s^2; displacement, s."""
    size = np.sqrt(np.maximum(np.abs(area), 1e-18))
    z = np.sqrt(2) * np.abs(displaced) / size
    far = ~(z <= FAR)  # and where it is not a number
    energy = _near_energy(np.where(far, 0.0, z))
    beyond = far_fresnel_integral(z[far])
    energy[far] = beyond.real + beyond.imag
    return np.asarray(size * energy / np.sqrt(2))


def _near_energy(z: FloatArray) -> FloatArray:
    """E = z (C(z) + S(z)) + (cos(pi z^2 / 2) - sin(pi z^2 / 2)) / pi for z in 0 .. FAR, to 1e-11.

    Between the knots of a table the quintic with the values, slopes and curvatures of both. This avoids
    `scipy.special`, which takes longer to import than a plan to make.
    """
    table = _energy_table()
    low = np.minimum((z * KNOTS).astype(np.intp), table.shape[1] - 2)
    value, slope, bend, other_value, other_slope, other_bend = *table[:, low], *table[:, low + 1]
    u, step = z * KNOTS - low, other_value - value
    a = 10 * step - 6 * slope - 4 * other_slope - 1.5 * bend + 0.5 * other_bend
    b = -15 * step + 8 * slope + 7 * other_slope + 1.5 * bend - other_bend
    c = 6 * step - 3 * (slope + other_slope) - 0.5 * (bend - other_bend)
    return np.asarray(value + u * (slope + u * (bend / 2 + u * (a + u * (b + u * c)))))


@cache
def _energy_table() -> FloatArray:
    """E, E' / KNOTS and E'' / KNOTS^2 at 0, 1 / KNOTS .. FAR, (3, n) float: E'' = cos + sin of pi z^2 / 2, integrated.

    E(0) = 1 / pi and E'(0) = 0.
    """
    nodes, weights = solvers.gauss_legendre(KNOT_NODES)
    knots = np.arange(int(FAR * KNOTS) + 1) / KNOTS
    at = (1 + nodes) / 2  # of the way from a knot to the next
    bends = _bend(knots[:-1, None] + at / KNOTS) * weights / 2 / KNOTS**2
    slope = np.concatenate([[0.0], np.cumsum(bends.sum(axis=1))])
    value = 1 / np.pi + np.concatenate([[0.0], np.cumsum(slope[:-1] + (bends * (1 - at)).sum(axis=1))])
    return np.stack([value, slope, _bend(knots) / KNOTS**2])


def _bend(z: FloatArray) -> FloatArray:
    quarter = np.pi / 2 * z**2
    return np.cos(quarter) + np.sin(quarter)


def smear_loss(line: Line, spots: Focus, rate: FloatArray, geometry: Geometry, full: BoolArray) -> float:
    """Largest loss of coherence of any line at its ends, under the gate that suits them best.

    An estimate from few lines (n_range, n_yaw, n), without a gate: the slopes of the ends along Doppler are differences
    between neighbouring yaws, and only the keystone displaces them. `full` (n_range, n_yaw) is from `full_dwells`.
    """
    collection = geometry.collection
    lit = np.broadcast_to(line.weight, line.time.shape).sum(axis=-1)
    inner = full.copy()
    inner[:, 1:-1] &= full[:, :-2] & full[:, 2:]  # both neighbours, for the differences
    full = inner if inner.any() else full if full.any() else np.ones_like(full)  # of a few of the ranges none may be
    spread = lit / 2 * collection.bandwidth / 2 / collection.carrier  # by the keystone, at the band's edges
    lost = np.zeros(lit.shape)
    *moves, apart = np.gradient(np.stack([*dwell_ends(line), spots.doppler]), axis=2)
    for smear, move in zip(np.moveaxis(end_smear(line, rate), -1, 0), moves, strict=True):
        slope = smear + move / apart
        low = np.min(slope, axis=1, where=full, initial=np.inf)
        high = np.max(slope, axis=1, where=full, initial=-np.inf)
        none = ~full.any(axis=1)
        low[none], high[none] = 0.0, 0.0
        middle = (low + high)[:, None] / 2
        lost += blurred_energy(slope - middle, np.zeros(1), spread, spread, collection.pulse_interval) / (2 * lit)
    return float(lost[full].max())


def lift_energy(blur: float, lift: float) -> float:
    """Energy, s, of the difference that raising a window makes at one end."""
    return 4 / 3 * blur * lift**2
