"""Control points: what the samples alone do not tell, a constant and a linear error of the track.

Let e(t) = a + b s(t) be what is left of the track's error, s from -1 at the first pulse to 1 at the last. A point whose
place is known then lies off by u . e in range, and its deramped phase is arg(sigma) - k u . e. Range, Doppler and the
bend of the phase over a dwell give a coarse solution, the phases, known up to turns, a fine one: of some numbers of
turns, the likeliest. A line of e bends the phases where the line of sight turns: what is in focus stays so. What the
points do not tell stays as it is: of all solutions the smallest is taken.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.autofocusing.chips import ChipPart, join_chips
from blocksar.autofocusing.correction import Correction
from blocksar.autofocusing.finishing import Result
from blocksar.autofocusing.selection import Points
from blocksar.autofocusing.work import Work
from blocksar.collection.beam import lit_interval
from blocksar.errors import InputError
from blocksar.kernels.fourier import fast_length, fft_rows
from blocksar.solvers import least_squares

FREE = 1.0  # m: standard deviation of each component of a and b before the points are looked at
RANGE_ERROR = 0.02  # range cells: of the measured range of a point
RATE_ERROR = 0.05  # turns over a dwell: of its measured Doppler
PHASE_ERROR = 0.1  # rad: of its measured phase
BEND_ERROR = 0.1  # rad: of the bend of its phase
MOST_BEND = 6.0  # rad: that is looked for
STANDS_OUT = 20.0  # times the median power of its chip: of a point that is found
TURNS = 4  # by which the phases of all points may be off together, on either side of the coarse solution
MOST_MISFIT, MOST_MOVED = 2.0, 10.0  # times their errors, and m of the track, by which points that agree may be off
MOST_LEFT_OUT, LEAST_KEPT = 0.25, 3  # share of the points that may be left out, and how many have to remain
PADDING = 8  # of the dwell, so that the Doppler of a peak is read between cells


@dataclass(frozen=True, kw_only=True, eq=False)
class Control:
    """Points whose places, and reflectivities, are known.

    Attributes
    ----------
    names : tuple of str
    x, y, z : (n,) float
        m, scene frame.
    phase : (n,) float
        Of the reflectivity, rad.
    """

    names: tuple[str, ...]
    x: FloatArray
    y: FloatArray
    z: FloatArray
    phase: FloatArray

    def points(self, work: Work) -> Points:
        """The points with the pulses that light them.

        Raises
        ------
        InputError
            If none light one.
        """
        first, last = lit_interval(work.geometry, self.x, self.y)
        for name, a, b in zip(self.names, first, last, strict=True):
            if b - a < 2 * work.decimation:
                raise InputError(f"control point {name} is not lit; leave it out, or correct its place")
        return Points(x=self.x, y=self.y, z=self.z, first=first, last=last)


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """Where a control point is seen, relative to its known place along the corrected track.

    Attributes
    ----------
    range : float
        m, away from the antenna.
    rate : float
        Of its phase over s, rad.
    phase : float
        In the middle of its dwell, rad.
    bend : float
        Of its phase: from the middle of the dwell to its ends, rad.
    sight : (3, 3) float
        Unit vectors to it where its dwell begins, in its middle, and where it ends.
    at : (3,) float
        s there.
    """

    range: float
    rate: float
    phase: float
    bend: float
    sight: FloatArray
    at: FloatArray

    @property
    def terms(self) -> FloatArray:
        """Factors (3, 6) of a and b in u . e where the dwell begins, in its middle, and where it ends."""
        return np.concatenate([self.sight, self.sight * self.at[:, None]], axis=1)


def anchor(work: Work, result: Result, control: Control, parts: Sequence[ChipPart], correction: Correction) -> Result:
    """Take off the constant and linear error that control points tell.

    Parameters
    ----------
    parts : sequence of ChipPart
        Chips of `control.points(work)`, taken with `correction`, by block of pulses.

    Raises
    ------
    InputError
        If a point is not seen, or the points do not agree.
    """
    chips = join_chips(work, control.points(work), parts, correction.displacement)
    time = work.geometry.collection.time
    middle, half = float(time[0] + time[-1]) / 2, float(time[-1] - time[0]) / 2
    seen = []
    for i, name in enumerate(control.names):
        count, first = int(chips.count[i]), int(chips.first[i])
        values = chips.values[i, :, :count] * np.exp(-1j * control.phase[i])
        seen.append(_see(work, name, values, (chips.time[first : first + count] - middle) / half, chips.sight[i]))
    kept, left, phases = _agreeing(work, control.names, seen)
    figures = {
        "points": len(kept),
        "left_out": [name for i, name in enumerate(control.names) if i not in kept],
        "offset": left[:3].tolist(),
        "velocity": (left[3:] / half).tolist(),
        "phase_left": float(np.sqrt(np.mean(phases * phases))),
    }

    def at(when: FloatArray) -> FloatArray:
        return np.asarray(left[:3] + ((when - middle) / half)[:, None] * left[3:])

    return replace(
        result,
        antenna_position=result.antenna_position - at(time),
        track_error=result.track_error + at(result.time),
        figures={**result.figures, "control": figures},
    )


def _agreeing(work: Work, names: Sequence[str], seen: Sequence[Seen]) -> tuple[list[int], FloatArray, FloatArray]:
    """The points that agree with each other and with FREE, a and b (6,), m, and the phases that are left, rad.

    Others, a few of them, are left out one by one: each time the one without which the rest agrees best.

    Raises
    ------
    InputError
        If too many do not agree.
    """
    kept = list(range(len(seen)))
    left, phases, misfit = _solve(work, seen)
    while not (agree := misfit <= MOST_MISFIT and _moved(left) <= MOST_MOVED):
        if len(kept) - 1 < math.ceil((1 - MOST_LEFT_OUT) * len(seen)) or len(kept) - 1 < LEAST_KEPT:
            break
        without = [_solve(work, [seen[j] for j in kept if j != i]) for i in kept]
        out = min(range(len(kept)), key=lambda k: without[k][2])
        left, phases, misfit = without[out]
        del kept[out]
    if not agree:
        listed = ", ".join(names[:4]) + (", ..." if len(names) > 4 else "")
        raise InputError(
            f"control: the {len(seen)} points ({listed}) do not agree: "
            f"to see them at their places the track would have to move by {_moved(left):.3g} m, and what they measure "
            f"would still be off by {misfit:.3g} times its error ({MOST_MOVED:g} m and {MOST_MISFIT:g} times are "
            "believed); correct their x, y, z and reflectivities, take points that stand apart from their neighbours, "
            "or leave control out"
        )
    return kept, left, phases


def _moved(left: FloatArray) -> float:
    """The farthest that a + b s comes from 0, m."""
    return float(max(np.linalg.norm(left[:3] + left[3:]), np.linalg.norm(left[:3] - left[3:])))


def _see(work: Work, name: str, values: ComplexArray, s: FloatArray, sight: FloatArray) -> Seen:
    """Find a control point in its chip (n_line, n) at times s (n,), with unit vectors to it (at least n, 3).

    Raises
    ------
    InputError
        If nothing stands out.
    """
    n_line, n = values.shape
    padded = np.zeros((n_line, fast_length(PADDING * n)), np.complex64)
    padded[:, :n] = values
    power = np.abs(fft_rows(padded, inverse=False)).astype(np.float64) ** 2
    line, column = np.unravel_index(int(power.argmax()), power.shape)
    above = float(power[line, column] / max(float(np.median(power)), 1e-300))
    if not above > STANDS_OUT:
        raise InputError(
            f"control point {name} is not seen: its surroundings have {above:.2g} times their median power at most, "
            f"and {STANDS_OUT:g} times are needed; leave it out, or correct its place"
        )
    near = power[line, [column - 1, column, (column + 1) % power.shape[1]]]
    cycles = np.arange(power.shape[1])[column] + _vertex(near)
    cycles = (cycles / power.shape[1] + 0.5) % 1 - 0.5  # a sample
    samples = (n - 1) / float(s[-1] - s[0])  # for each unit of s
    rate, centre = 2 * np.pi * cycles * samples, float(s[0] + s[-1]) / 2
    w = 2 * (s - centre) / float(s[-1] - s[0])
    level = (values * np.exp(-1j * rate * (s - centre))).astype(np.complex128)
    bends = np.linspace(-MOST_BEND, MOST_BEND, 121)
    sharp = [float(np.abs((level * np.exp(-1j * q * w * w)).sum(axis=1)).max()) for q in bends]
    bend = float(bends[int(np.argmax(sharp))])
    lines = (level * np.exp(-1j * bend * w * w)).sum(axis=1)
    offset = (np.arange(n_line) - (n_line - 1) / 2) * work.settings.line_spacing  # range cells
    tried = np.linspace(offset[0], offset[-1], 100 * n_line)
    sums = (np.sinc(offset - tried[:, None]) * lines).sum(axis=1)
    best = int(np.abs(sums[1:-1]).argmax()) + 1
    step = float(tried[1] - tried[0])
    away = float(tried[best]) + step * _vertex(np.abs(sums[best - 1 : best + 2]))
    return Seen(
        range=away * work.cell, rate=float(rate), phase=float(np.angle(sums[best])), bend=bend,
        sight=sight[[0, n // 2, n - 1]], at=np.array([s[0], s[n // 2], s[-1]]),
    )  # fmt: skip


def _vertex(values: FloatArray) -> float:
    """Where the parabola through three values at -1, 0 and 1 has its vertex."""
    bend = values[0] - 2 * values[1] + values[2]
    return float(0.5 * (values[0] - values[2]) / bend) if bend else 0.0


def _solve(work: Work, seen: Sequence[Seen]) -> tuple[FloatArray, FloatArray, float]:
    """Return a and b (6,), m, the phases of the points that they leave, rad, and the misfit.

    The misfit is the root mean square of what is left of all measurements, and of a and b, over their errors.
    """
    k = work.wavenumber
    terms, values = [], []
    for one in seen:
        begin, middle, end = one.terms
        terms.append(middle / (RANGE_ERROR * work.cell))
        values.append(one.range / (RANGE_ERROR * work.cell))
        terms.append(-k * (begin - 2 * middle + end) / 2 / BEND_ERROR)
        values.append(one.bend / BEND_ERROR)
        terms.append(-k * (end - begin) / (2 * np.pi * RATE_ERROR))
        values.append(one.rate * float(one.at[2] - one.at[0]) / (2 * np.pi * RATE_ERROR))
    coarse = _least(terms, values)
    sights = np.array([one.terms[1] for one in seen])
    phases = np.array([one.phase for one in seen])
    off = phases + k * (sights * coarse).sum(axis=1)
    shared = np.exp(1j * off).sum()
    turned = np.angle(shared) + np.angle(np.exp(1j * off) * np.conj(shared))  # turns: those nearest to each other
    terms += list(-k * sights / PHASE_ERROR)
    tried = []
    for turns in range(-TURNS, TURNS + 1):
        told = (turned + 2 * np.pi * turns - k * (sights * coarse).sum(axis=1)) / PHASE_ERROR
        fine = _least(terms, [*values, *told])
        misfit = (np.array(terms) * fine).sum(axis=1) - np.array([*values, *told])
        tried.append((float((misfit * misfit).sum() + (fine * fine).sum() / FREE**2), turns, fine))
    cost, _, fine = min(tried, key=lambda one: one[:2])
    misfit = math.sqrt(cost / len(terms))
    return fine, np.angle(np.exp(1j * (phases + k * (sights * fine).sum(axis=1)))), misfit


def _least(terms: Sequence[FloatArray], values: Sequence[float]) -> FloatArray:
    return least_squares(np.array(terms).T.copy(), np.array(values), damping=1 / FREE**2)
