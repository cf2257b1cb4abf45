"""Ends of dwells along traced lines: when targets are lit, when their lines then are, and what smears the ends.

Steps in Doppler delay a signal, and the more the farther its Doppler is from the block's: a dwell begins and ends at
other times after the steps of a chain than when its target was lit, and its ends are no longer sharp.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blocksar import solvers
from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.beam import dwell_at
from blocksar.collection.geometry import Geometry
from blocksar.focusing.lines import Line
from blocksar.planning.dwell_weights import beam_moves

GUARD = 0.05  # of a dwell, kept beyond the ends of lines in time
SMEAR_ROOM = 100.0  # see `smear_room`
FULL = 0.999  # of the longest dwell: a full one

Moments = tuple[FloatArray, FloatArray]  # of each target in the first and in the second half of its dwell, s


class DwellEnds(NamedTuple):
    """What the ends of dwells depend on besides the lines."""

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
        """Of the same targets before and after all steps."""
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
    """Whether the collection cuts not all of the dwells at epoch ranges (n), m, and yaws (m), rad.

    Not where it begins and ends while the beam is over a target: such a dwell is a part of a full one.
    """
    if not beam_moves(geometry.collection):
        return True
    first, last = dwell_at(geometry, yaw, epoch_range[:, None], uncut=True)
    begin, end = dwell_at(geometry, yaw, epoch_range[:, None])
    return bool(((last > first) & (end - begin >= FULL * (last - first))).any())


def full_dwells(line: Line, geometry: Geometry, epoch_range: FloatArray, yaw: FloatArray) -> BoolArray:
    """Which lines (..., n) of targets at epoch ranges (m) and yaws (rad), broadcast, are lit over a full dwell.

    It is the target's own dwell as if the ends of the collection did not cut it: dwells depend on range under a beam
    about its axis, and on yaw under one that does not turn evenly. Where there is no such target, or the beam stays, it
    is the longest of them, or nearly.
    """
    lit = np.broadcast_to(line.weight, line.time.shape).sum(axis=-1)
    if beam_moves(geometry.collection):
        first, last = dwell_at(geometry, yaw, epoch_range, uncut=True)
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
