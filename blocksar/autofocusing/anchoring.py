"""Control points: they determine the constant and linear error of the track, which samples alone leave open.

Let e(t) = a + b s(t) be the remaining error of the track, s from -1 at the first pulse to 1 at the last. A point whose
place is known then appears displaced by u . e in range, and its deramped phase is arg(sigma) - k u . e. Range, Doppler
and the bend of the phase over a dwell give a coarse solution; the phases, known up to whole turns, a fine one, for the
likeliest numbers of turns. A linear e bends the phases where the line of sight turns. Components that the points do not
determine stay as they are: of all solutions the smallest is taken.

The chip of a control point reaches far beyond it: over some range cells, and along azimuth over its whole band of
Doppler, often 100 m to either side, so that the brightest response in it may be a neighbour's. All that stand out are
measured. The coarse solution then decides which is the point's: one e puts all points at their places. Points that lie
elsewhere are left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.autofocusing.chips import ChipPart, Chips, join_chips
from blocksar.autofocusing.finishing import Result
from blocksar.autofocusing.selection import Points
from blocksar.autofocusing.track_correction import Correction
from blocksar.autofocusing.work import Work
from blocksar.errors import InputError
from blocksar.kernels.fourier import fast_length, fft_rows
from blocksar.solvers import least_squares, vertex

BENDS = np.linspace(-6.0, 6.0, 121)  # rad: that are looked for
STANDS_OUT = 20.0  # times the median power of its chip: of a response that is found
FAINTEST = 1e-3  # times the power of the brightest: below it are sidelobes
MOST_RESPONSES = 16  # of a chip, the brightest
PADDING = 8  # of the dwell, so that the Doppler of a peak is read between cells
APART = 2 * PADDING  # samples of Doppler: half the main lobe of a Hann window


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """Response in the chip of a control point, measured relative to its known place along the corrected track.

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
    noise : float
        Amplitude of its surroundings over its own.
    sight : (3, 3) float
        Unit vectors to the point where its dwell begins, in its middle, and where it ends.
    at : (3,) float
        s there.
    doubt : float
        Standard deviation of the phase that is said of the point, rad; infinite if none is said.
    """

    range: float
    rate: float
    phase: float
    bend: float
    noise: float
    sight: FloatArray
    at: FloatArray
    doubt: float = 0.0

    @property
    def terms(self) -> FloatArray:
        """Factors (3, 6) of a and b in u . e where the dwell begins, in its middle, and where it ends."""
        return np.concatenate([self.sight, self.sight * self.at[:, None]], axis=1)


def find_responses(work: Work, name: str, values: ComplexArray, s: FloatArray, sight: FloatArray) -> list[Seen]:
    """Measure the responses in the chip (n_line, n) of a control point, the brightest first.

    Parameters
    ----------
    name : str
        Of the point, for messages.
    s : (n,) float
        Times of the samples, from -1 at the first pulse of the collection to 1 at the last.
    sight : (at least n, 3) float
        Unit vectors to the point.

    Raises
    ------
    InputError
        If nothing stands out.
    """
    n = values.shape[1]
    padded = np.zeros((values.shape[0], fast_length(PADDING * n)), np.complex64)
    values = values * np.hanning(n + 2)[1:-1]  # a neighbour's sidelobes are not to hide or to move the point
    padded[:, :n] = values
    power = np.abs(fft_rows(padded, inverse=False)).astype(np.float64) ** 2
    above = float(power.max() / max(float(np.median(power)), 1e-300))
    if not above > STANDS_OUT:
        raise InputError(
            f"control point {name} is not seen: its surroundings have {above:.2g} times their median power at most, "
            f"and {STANDS_OUT:g} times are needed; leave it out, or correct its place"
        )
    floor = max(STANDS_OUT * float(np.median(power)), FAINTEST * float(power.max()))
    curves = np.exp(-1j * BENDS[:, None] * np.linspace(-1, 1, n) ** 2)
    return [_measure(work, values, s, sight, *peak, power, curves) for peak in _peaks(power, floor)]


def _peaks(power: FloatArray, floor: float) -> list[tuple[int, int]]:
    """Find line and column of peaks of power (n_line, n), at least `floor` high and `APART` apart along Doppler."""
    best: FloatArray = power.max(axis=0)
    order: IntArray = np.argsort(-best, kind="stable")
    free, found = best >= floor, []
    for column in order[: int(free.sum())]:
        if free[column]:
            near = np.arange(column - APART, column + APART + 1) % best.size
            if best[column] >= best[near].max():
                found.append((int(power[:, column].argmax()), int(column)))
            free[near] = False
        if len(found) == MOST_RESPONSES:
            break
    return found


def _measure(
    work: Work,
    values: ComplexArray,
    s: FloatArray,
    sight: FloatArray,
    line: int,
    column: int,
    power: FloatArray,
    curves: ComplexArray,
) -> Seen:
    """Measure the response whose power (n_line, n_column) has its peak at `line` and `column`.

    `curves` (n_bend, n) are phasors that straighten each of `BENDS`.
    """
    n_line, n = values.shape
    near = power[line, [column - 1, column, (column + 1) % power.shape[1]]]
    cycles = ((column + vertex(near)) / power.shape[1] + 0.5) % 1 - 0.5  # a sample
    samples = (n - 1) / float(s[-1] - s[0])  # for each unit of s
    rate, centre = 2 * np.pi * cycles * samples, float(s[0] + s[-1]) / 2
    level = (values * np.exp(-1j * rate * (s - centre))).astype(np.complex128)
    bend = _at_vertex(BENDS, np.abs((level[line] * curves).sum(axis=1)))
    lines = (level * np.exp(-1j * bend * np.linspace(-1, 1, n) ** 2)).sum(axis=1)
    offset = (np.arange(n_line) - (n_line - 1) / 2) * work.settings.line_spacing  # range cells
    low, high = max(line - 1, 0), min(line + 1, n_line - 1)
    tried = np.linspace(offset[low], offset[high], 100 * (high - low) + 1)
    sums = (np.sinc(offset - tried[:, None]) * lines).sum(axis=1)
    around = float(np.median(power)) / math.log(2)  # the mean of noise, whose power is exponential
    return Seen(
        noise=math.sqrt(around / float(power[line, column])),
        range=_at_vertex(tried, np.abs(sums)) * work.cell, rate=float(rate), bend=bend,
        phase=float(np.angle(sums[int(np.abs(sums).argmax())])),
        sight=sight[[0, n // 2, n - 1]], at=np.array([s[0], s[n // 2], s[-1]]),
    )  # fmt: skip


def _at_vertex(at: FloatArray, values: FloatArray) -> float:
    """Locate the maximum of values (n,) at evenly spaced `at` (n,), by a parabola through its neighbours."""
    best = int(values.argmax())
    if not 0 < best < values.size - 1:
        return float(at[best])
    return float(at[best] + (at[1] - at[0]) * vertex(values[best - 1 : best + 2]))


FREE = 1.0  # m: standard deviation of each component of a and b before the points are looked at
RANGE_ERROR = 0.02, 0.3  # range cells: of the measured range of a point, and for noise of its own amplitude
RATE_ERROR = 0.05, 0.5  # turns over a dwell: likewise of its measured Doppler
BEND_ERROR = 0.05, 3.6  # rad: of the bend of its phase
PHASE_ERROR = 0.1, 0.8  # rad: of its phase in the middle of its dwell
TURNS = 4  # by which the phases of all points may be off together, on either side of the coarse solution
BELONGS = 5.0  # times the errors of range, Doppler and bend, r.s.s.: within which a response may be the point's
ROUNDS = 4  # in which responses are chosen by e, and e is solved for from them
MOST_MISFIT = 2.0  # times their errors, r.m.s., by which points that agree may be off
MOST_MOVED = 5 * FREE  # m: of the track
MOST_LEFT_OUT, LEAST_KEPT = 0.25, 3  # share of the points that may be left out, and how many have to remain
BEND_TO_RMS = math.sqrt(4 / 45)  # r.m.s. over a dwell of a parabola that bends by 1 from its middle to its ends


@dataclass(frozen=True, kw_only=True, eq=False)
class Control:
    """Control points: targets with known places and, where given, known phases.

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
        first, last = work.geometry.beam.longest_pass(self.x, self.y)
        for name, a, b in zip(self.names, first, last, strict=True):
            if b - a < 2 * work.decimation:
                raise InputError(f"control point {name} is not lit; leave it out, or correct its place")
        return Points(x=self.x, y=self.y, z=self.z, first=first, last=last)


def anchor(work: Work, result: Result, control: Control, parts: Sequence[ChipPart], correction: Correction) -> Result:
    """Remove the constant and linear error of the track that control points show.

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
    found = [responses_of(chips, i, name, float(control.phase[i])) for i, name in enumerate(control.names)]
    return anchored(work, result, control.names, found)


def responses_of(chips: Chips, i: int, name: str, phase: float = 0.0) -> list[Seen]:
    """The responses in the chip of control point `i`, of a reflectivity with this phase, rad; see `find_responses`."""
    middle, half = _middle_and_half(chips.work)
    count, first = int(chips.count[i]), int(chips.first[i])
    values = chips.values[i, :, :count] * np.exp(-1j * phase)
    s = (chips.time[first : first + count] - middle) / half
    return find_responses(chips.work, name, values, s, chips.sight[i])


def _middle_and_half(work: Work) -> tuple[float, float]:
    """Middle of the collection, and half of its duration, s."""
    time = work.geometry.collection.time
    return float(time[0] + time[-1]) / 2, float(time[-1] - time[0]) / 2


def anchored(work: Work, result: Result, names: Sequence[str], found: Sequence[Sequence[Seen]]) -> Result:
    """Remove the constant and linear error of the track, given the responses found at each control point.

    Raises
    ------
    InputError
        If they do not agree.
    """
    time, (middle, half) = work.geometry.collection.time, _middle_and_half(work)
    fit = _agreeing(work, names, found)
    left, bent = fit.left, BEND_TO_RMS * fit.bend
    figures = {
        "points": len(fit.kept),
        "left_out": [name for i, name in enumerate(names) if i not in fit.kept],
        "offset": left[:3].tolist(),
        "velocity": (left[3:] / half).tolist(),
        "moved": fit.moved,
        "range_left": fit.range,
        "phase_left": fit.phase,
        "bend_left": bent,
    }
    predicted = math.hypot(result.figures["predicted_error"], bent)

    def at(when: FloatArray) -> FloatArray:
        return np.asarray(left[:3] + ((when - middle) / half)[:, None] * left[3:])

    return replace(
        result,
        antenna_position=result.antenna_position - at(time),
        track_error=result.track_error + at(result.time),
        figures={**result.figures, "predicted_error": predicted, "control": figures},
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Fit:
    """Fit of the track to some control points.

    Attributes
    ----------
    kept : list of int
        Which points.
    left : (6,) float
        a and b, m.
    range, phase : float
        What they leave of the points' ranges, m, and phases, rad, rms.
    bend : float
        Bend of the phases over a dwell that they leave, rad rms.
    misfit : float
        What is left of all measurements, and of a and b, over their errors, rms.
    """

    kept: list[int]
    left: FloatArray
    range: float
    phase: float
    bend: float
    misfit: float

    @property
    def moved(self) -> float:
        """Largest length of a + b s over the collection, -1 <= s <= 1, m."""
        a, b = self.left[:3], self.left[3:]
        return float(max(np.linalg.norm(a + b), np.linalg.norm(a - b)))


def _agreeing(work: Work, names: Sequence[str], found: Sequence[Sequence[Seen]]) -> _Fit:
    """Fit the points that agree with each other and with the prior FREE; `found` has the responses of each point.

    A few others are left out: those at whose place no response is, then one by one that without which the rest agrees
    best.

    Raises
    ------
    InputError
        If too many do not agree.
    """
    seen, at_place = _associated(work, found)
    n, least = len(seen), max(math.ceil((1 - MOST_LEFT_OUT) * len(seen)), min(LEAST_KEPT, len(seen)))
    off = [name for name, there in zip(names, at_place, strict=True) if not there]
    advice = "take points that stand apart from their neighbours, or leave control out"
    if len(off) > n - least:
        reach = (work.settings.lines - 1) / 2 * work.settings.line_spacing * work.cell
        verb = "is" if len(off) == 1 else "are"
        raise InputError(
            f"control: {len(off)} of {n} points ({_listed(off)}) {verb} not seen where the same error of the track "
            f"puts the others, and {n - least} may be left out (points are looked for within {reach:.2g} m of range of "
            f"their places); correct their x, y, z (datum, height above the ellipsoid), {advice}"
        )
    fit = _solved(work, seen, [i for i in range(n) if at_place[i]])
    while fit.misfit > MOST_MISFIT and len(fit.kept) > least:
        without = [_solved(work, seen, [j for j in fit.kept if j != i]) for i in fit.kept]
        fit = min(without, key=lambda one: one.misfit)
    if fit.misfit > MOST_MISFIT:
        raise InputError(
            f"control: the {n} points ({_listed(names)}) do not agree: of the track that suits them best, which moves "
            f"by {fit.moved:.2g} m, their ranges are {fit.range:.2g} m rms off, and their phases {fit.phase:.2g} rad: "
            f"{fit.misfit:.2g} times their errors, and {MOST_MISFIT:g} times are believed; correct their x, y, z and "
            f"reflectivities, {advice}"
        )
    if fit.moved > MOST_MOVED:
        raise InputError(
            f"control: to see the {n} points ({_listed(names)}) at their places the track would have to move by "
            f"{fit.moved:.3g} m, and {MOST_MOVED:g} m are believed; correct their x, y, z (datum, height above the "
            "ellipsoid), or leave control out"
        )
    return fit


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:4]) + (", ..." if len(names) > 4 else "")


def _associated(work: Work, found: Sequence[Sequence[Seen]]) -> tuple[list[Seen], list[bool]]:
    """Choose one response of each point, by the e that fits them best; also tell which agree within `BELONGS` errors.

    e is tried from none, and from each response; all points then choose the responses next to their places, and e is
    solved for from those that belong. A response that does not belong costs `BELONGS`, however far off it is.
    """
    points, most = np.arange(len(found)), max(map(len, found))
    terms, values = np.zeros((points.size, most, 3, 6)), np.full((points.size, most, 3), np.inf)
    for i, responses in enumerate(found):
        for j, one in enumerate(responses):
            terms[i, j], values[i, j] = _measured(work, one)
    given = np.isfinite(values[:, :, 0])
    best, chosen, near = np.inf, np.zeros(points.size, np.intp), np.zeros(points.size, bool)
    for start in [np.zeros(6), *(_least(terms[i, j], values[i, j]) for i, j in zip(*np.nonzero(given), strict=True))]:
        left = start
        for _ in range(ROUNDS):
            cost = ((values - (terms * left).sum(axis=3)) ** 2).sum(axis=2)
            nearest = cost.argmin(axis=1)
            belong = cost[points, nearest] <= BELONGS**2
            total = np.minimum(cost.min(axis=1), BELONGS**2).sum() + (left * left).sum() / FREE**2
            if total < best:
                best, chosen, near = float(total), nearest, belong
            if not belong.any():
                break
            these = points[belong], nearest[belong]
            left = _least(terms[these].reshape(-1, 6), values[these].ravel())
    return [responses[k] for responses, k in zip(found, chosen.tolist(), strict=True)], near.tolist()


def _measured(work: Work, one: Seen) -> tuple[FloatArray, FloatArray]:
    """Equations for a and b: factors (3, 6) and values (3,) of range, bend and Doppler, divided by their errors."""
    k, (begin, middle, end) = work.wavenumber, one.terms
    errors = np.array([
        _error(RANGE_ERROR, one) * work.cell, _error(BEND_ERROR, one), 2 * np.pi * _error(RATE_ERROR, one),
    ])  # fmt: skip
    terms = np.stack([middle, -k * (begin - 2 * middle + end) / 2, -k * (end - begin)])
    values = np.array([one.range, one.bend, one.rate * float(one.at[2] - one.at[0])])
    return terms / errors[:, None], values / errors


def _error(kind: tuple[float, float], one: Seen) -> float:
    """Standard deviation of a measurement of a response: `kind` has a constant part, and a factor of the noise."""
    return math.hypot(kind[0], kind[1] * one.noise)


def _solved(work: Work, seen: Sequence[Seen], kept: Sequence[int]) -> _Fit:
    """Fit a and b to the points `kept`."""
    k, some = work.wavenumber, [seen[i] for i in kept]
    rows = [_measured(work, one) for one in some]
    terms, values = (np.concatenate(list(part)) for part in zip(*rows, strict=True))
    middle = np.array([one.terms[1] for one in some])
    phases = np.array([one.phase for one in some])
    errors = np.array([math.hypot(_error(PHASE_ERROR, one), one.doubt) for one in some])
    coarse = k * (middle * _least(terms, values)).sum(axis=1)
    shared = np.exp(1j * (phases + coarse)).sum()
    # Choose the phases nearest to each other, modulo whole turns.
    turned = np.angle(shared) + np.angle(np.exp(1j * (phases + coarse)) * np.conj(shared)) - coarse
    measured = values.size + int(np.isfinite(errors).sum())
    terms = np.concatenate([terms, -k * middle / errors[:, None]])
    tried = []
    for turns in range(-TURNS, TURNS + 1):
        whole = np.concatenate([values, (turned + 2 * np.pi * turns) / errors])
        fine = _least(terms, whole)
        misfit = whole - (terms * fine).sum(axis=1)
        tried.append((float((misfit * misfit).sum() + (fine * fine).sum() / FREE**2), turns, fine))
    cost, _, fine = min(tried, key=lambda one: one[:2])
    return _Fit(
        kept=list(kept), left=fine, misfit=math.sqrt(cost / measured), bend=_bend_left(work, some, terms, fine),
        range=_rms(np.array([one.range for one in some]) - (middle * fine).sum(axis=1)),
        phase=_rms(np.angle(np.exp(1j * (phases + k * (middle * fine).sum(axis=1))))),
    )  # fmt: skip


def _bend_left(work: Work, some: Sequence[Seen], terms: FloatArray, left: FloatArray) -> float:
    """Bend of the phase, rad rms, that a and b (6,) leave: as measured, without noise, plus that of their errors.

    `terms` (n, 6) are the factors of a and b in all measurements, over errors.
    """
    turning = np.array([-work.wavenumber * (one.terms[0] - 2 * one.terms[1] + one.terms[2]) / 2 for one in some])
    noise, weights = np.array([(BEND_ERROR[1] * one.noise, _error(BEND_ERROR, one) ** -2) for one in some]).T
    rest = np.array([one.bend for one in some]) - (turning * left).sum(axis=1)
    measured = float((weights * (rest * rest - noise * noise)).sum() / weights.sum())
    known = np.concatenate([terms, np.eye(6) / FREE])  # errors of these are independent, of unit variance
    solutions = least_squares(known.T.copy(), np.eye(known.shape[0]))  # of a and b for each of them, (6, n + 6)
    doubt = (turning[:, :, None] * solutions).sum(axis=1)
    return math.sqrt(max(measured, 0.0) + float((doubt * doubt).sum(axis=1).mean()))


def _least(terms: FloatArray, values: FloatArray) -> FloatArray:
    """Solve for a and b (6,), m, by least squares: factors (n, 6) and values (n,) are divided by their errors."""
    return least_squares(terms.T.copy(), values, damping=1 / FREE**2)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values * values)))
