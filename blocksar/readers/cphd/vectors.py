"""Assignment of vectors to pulses, and resampling of uneven vectors to uniform pulses.

Unusable vectors are reported with the parameter that is wrong.

Files hold vectors of pulses that were lost: without position, with NaN or zeros in any parameter, flagged by SIGNAL or
not. Such a vector is a missing pulse. A parameter that is wrong in more than half of the vectors is no lost pulse: the
file means something else, and is refused.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

import numpy as np

from blocksar import texts
from blocksar.arrays import UNIFORM_TOLERANCE, BoolArray, FloatArray, IntArray
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.readers.cphd.files import NEEDED, CphdFile
from blocksar.readers.registry import refuse_few
from blocksar.readers.resampling import OCCUPIED, Resampling, plan_resampling

SMALLEST_ORBIT, LARGEST_ORBIT = 6.3e6, 1e9  # m from the Earth's centre
FARTHEST_SRP = 1e6  # m, largest distance of the SRP from the IARP
MOST_LOST = 0.5  # share of vectors with a wrong parameter
LEAST = 8  # vectors
PLACING = ("TxTime", "TxPos", "RcvTime", "RcvPos", "SRPPos")  # parameters that give a vector its time and place
FLAG = "SIGNAL is not 1"
ZEROS = "all samples are 0"
NOT_FINITE = "samples are not finite"
MOST_RANGES, MOST_NAMES = 8, 4  # in a message


class Lost(NamedTuple):
    """Mask (n_vector,) of the vectors that are lost for one reason, and the reason."""

    reason: str
    vectors: BoolArray


class Usable(NamedTuple):
    """Masks (n_vector,) of the vectors with echoes and of those with time and place, and why others are lost."""

    normal: BoolArray
    placed: BoolArray
    lost: list[Lost]


class _Fault(NamedTuple):
    name: str
    wrong: BoolArray
    words: str  # the start of a sentence that refuses the file
    remedy: str


def find_usable(file: CphdFile, origin: FloatArray) -> Usable:
    """Find usable vectors; `origin` (3,) is the scene's reference point, Earth-centred, m.

    Raises
    ------
    InputError
        If a parameter is wrong in more than `MOST_LOST` of the vectors, or fewer than half or `LEAST` can be used.
    """
    normal = placed = np.ones(file.shape[0], np.bool_)
    lost: list[Lost] = []
    if "SIGNAL" in (file.vectors.dtype.names or ()):
        normal = np.asarray(file.vectors["SIGNAL"] == 1)
        lost.append(Lost(FLAG, ~normal))
        if np.count_nonzero(normal) < LEAST:
            raise InputError(
                f"PVP SIGNAL is 1 in {np.count_nonzero(normal)} of {normal.size} vectors; at least {LEAST} are needed"
            )
    flagged = normal
    for name, wrong, words, remedy in chain(_not_finite(file), _out_of_range(file, origin)):
        count = np.count_nonzero(wrong & flagged)
        if count > MOST_LOST * np.count_nonzero(flagged):
            first = file.first_vector + int(np.argmax(wrong & flagged))
            raise InputError(f"PVP {words} in {count} of {wrong.size} vectors (first: vector {first}); {remedy}")
        if name in PLACING:
            placed = placed & ~wrong
        normal = normal & ~wrong
        lost.append(Lost(name, wrong & flagged))
    if np.count_nonzero(normal) < LEAST:
        raise InputError(
            f"{np.count_nonzero(normal)} of {normal.size} vectors with valid parameters and a normal signal; at least "
            f"{LEAST} are needed ({describe_lost(lost, file.first_vector)})"
        )
    check_most_used(normal, lost, file.first_vector)
    return Usable(normal, placed, lost)


def _not_finite(file: CphdFile) -> Iterator[_Fault]:
    """Iterate over parameters, each with the vectors in which it is NaN or infinite."""
    for name in (*NEEDED, *(("AmpSF",) if file.scaled else ())):
        wrong = ~_finite(file, name)
        yield _Fault(name, wrong, f"{name} is not finite", "correct it, or mark them with SIGNAL = 0")


def _finite(file: CphdFile, *names: str) -> BoolArray:
    """Mask of the vectors in which parameters are finite."""
    return np.asarray(
        np.all([np.isfinite(file.parameter(name)).reshape(file.shape[0], -1).all(axis=1) for name in names], axis=0)
    )


def _out_of_range(file: CphdFile, origin: FloatArray) -> Iterator[_Fault]:
    """Iterate over parameters with the vectors in which they are finite but impossible."""
    time, travel = file.parameter("TxTime"), file.parameter("RcvTime") - file.parameter("TxTime")
    yield _Fault("TxTime", _odd_zeros(time), "TxTime is 0 among other times", "correct it")
    for name in ("TxPos", "RcvPos"):
        radius = np.linalg.norm(file.parameter(name), axis=1)
        known = radius[np.isfinite(radius)]
        yield _Fault(
            name, (radius <= SMALLEST_ORBIT) | (radius >= LARGEST_ORBIT),
            f"{name} lies {known.min(initial=np.inf):.6g} .. {known.max(initial=0):.6g} m from the Earth's centre, "
            "where no antenna is,", "it must be Earth-centred, in m",
        )  # fmt: skip
    distance = np.linalg.norm(file.parameter("SRPPos") - origin, axis=1)
    yield _Fault(
        "SRPPos", distance >= FARTHEST_SRP,
        f"SRPPos lies up to {np.nanmax(np.append(distance, 0)):.6g} m from the scene's reference point",
        "it must be Earth-centred, in m",
    )  # fmt: skip
    late = travel[travel > 0].size > MOST_LOST * travel.size  # else files give one time for both
    yield _Fault("RcvTime", travel <= 0 if late else travel < 0, "RcvTime is before TxTime", "correct them")
    for name in ("SCSS", "FX1", *(("SC0",) if file.domain == "FX" else ()), *(("AmpSF",) if file.scaled else ())):
        values = file.parameter(name)
        least = float(np.nanmin(np.append(values, np.inf)))
        yield _Fault(name, values <= 0, f"{name} falls to {least:.6g}, but must be above 0,", "correct it")
    if file.scaled:
        with np.errstate(over="ignore"):
            single = file.parameter("AmpSF").astype(np.float32)
        wrong = _finite(file, "AmpSF") & ((single == 0) | np.isinf(single))
        yield _Fault("AmpSF", wrong, "AmpSF is no float32 above 0", "correct it")
    for low, high in (("FX1", "FX2"), ("TOA1", "TOA2")):
        first, last = file.parameter(low), file.parameter(high)
        wrong = _finite(file, low, high) & ((first >= last) | filled_with_zeros(first) | filled_with_zeros(last))
        yield _Fault(f"{low} or {high}", wrong, f"{low} is not below {high}", "correct them")


def _odd_zeros(time: FloatArray) -> BoolArray:
    """Mask of times of 0 that mean no time: all but one that lies a pulse away from its neighbours."""
    zero = time == 0
    others = np.asarray(np.flatnonzero(~zero & np.isfinite(time)), np.int64)
    if not zero.any() or others.size < LEAST:
        return np.zeros(time.shape, np.bool_)
    near = 1.5 * float(np.median(np.abs(np.diff(time[others]))))
    before, after = _neighbours(time, zero, others)
    before, after = np.nan_to_num(before, nan=-near), np.nan_to_num(after, nan=near)
    return zero & ~((before < 0) & (before >= -near) & (after > 0) & (after <= near))


def filled_with_zeros(values: FloatArray) -> BoolArray:
    """Mask of zeros that mean no value: those between other values of the usual size."""
    zero = values == 0
    others = np.asarray(np.flatnonzero(~zero & np.isfinite(values)), np.int64)
    if not zero.any() or not others.size:
        return np.zeros(values.shape, np.bool_)
    usual = float(np.median(np.abs(values[others])))
    neighbours = np.nan_to_num(np.abs(_neighbours(values, zero, others)), nan=np.inf)
    return zero & (neighbours.min(axis=0) >= usual / 2)


def _neighbours(values: FloatArray, zero: BoolArray, others: IntArray) -> FloatArray:
    """Nearest other value before and after each zero, (2, n); NaN where there is none, or for other values."""
    at = np.searchsorted(others, np.arange(values.size))
    padded = np.concatenate([[np.nan], values[others], [np.nan]])
    return np.where(zero, np.stack([padded[at], padded[at + 1]]), np.nan)


def check_most_used(used: BoolArray, lost: Sequence[Lost], first: int) -> None:
    """Refuse if less than half of the vectors (n_vector,) are used, and name the part with most of the usable ones."""
    ends = np.flatnonzero(np.diff(np.concatenate([[0], used, [0]]))).reshape(-1, 2)
    low, high = ends[np.diff(ends, axis=1).argmax()] if ends.size else (0, 0)
    refuse_few(
        int(np.count_nonzero(used)), used.size, f"vectors are lost: {describe_lost(lost, first)}",
        f"take a part that has echoes, such as --pulses {first + low}:{first + high}",
    )  # fmt: skip


def describe_lost(lost: Sequence[Lost], first: int = 0) -> str:
    """Describe lost vectors: ranges of vectors with their reasons; empty if none is lost.

    `first` is the number of the first one in the file.
    """
    reasons: dict[tuple[str, ...], list[int]] = {}
    for vector in np.flatnonzero(np.any([each.vectors for each in lost], axis=0)):
        why = tuple(dict.fromkeys(each.reason for each in lost if each.vectors[vector]))
        reasons.setdefault(why, []).append(first + int(vector))
    return "; ".join(f"{_ranges(vectors)} ({_joined(why)})" for why, vectors in reasons.items())


def _joined(why: Iterable[str]) -> str:
    """Join reasons; those of parameters are combined."""
    words = [reason for reason in why if reason in (FLAG, ZEROS, NOT_FINITE)]
    names = [reason for reason in why if reason not in words]
    more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
    return ", ".join([*words, *([f"invalid PVP {', '.join(names[:MOST_NAMES])}{more}"] if names else [])])


def _ranges(vectors: Sequence[int]) -> str:
    """Write ascending numbers as ranges, the first `MOST_RANGES` of them.

    Examples
    --------
    >>> _ranges([0, 1, 2, 9, 11, 12])
    '0 .. 2, 9, 11 .. 12'
    """
    breaks = np.flatnonzero(np.diff(vectors) > 1)
    first, last = np.append(0, breaks + 1), np.append(breaks, len(vectors) - 1)
    ranges = [f"{vectors[a]}" if a == b else f"{vectors[a]} .. {vectors[b]}" for a, b in zip(first, last, strict=True)]
    more = len(ranges) - MOST_RANGES
    return ", ".join(ranges[:MOST_RANGES]) + (f" and {texts.count(more, 'more range')}" if more > 0 else "")


MAX_GAPS = 1.0  # missing vectors over those present


@dataclass(frozen=True, kw_only=True, eq=False)
class Pulses:
    """Vector of each pulse. A pulse without a vector, or with an abnormal one, is missing.

    Attributes
    ----------
    vector : (n_pulse,) int
        -1 where missing.
    time, reference_time : (n_pulse,) float
        Time of transmission and the standard's reference time, s.
    even : bool
        Whether time is uniform; if not, every pulse is a vector with a normal signal.
    position, reference_point : (n_pulse, 3) float
        ARP and SRP, Earth-centred, m.
    separation : float
        Largest |TxPos - RcvPos|, m.
    lost : list of Lost
        Vectors that hold no echoes, by reason.
    """

    vector: IntArray
    time: FloatArray
    reference_time: FloatArray
    position: FloatArray
    reference_point: FloatArray
    separation: float
    lost: list[Lost]
    even: bool = True


def assign_pulses(file: CphdFile, origin: FloatArray) -> Pulses:
    """Check the per-vector parameters and assign vectors to pulses.

    Parameters
    ----------
    file : CphdFile
    origin : (3,) float
        The scene's reference point, Earth-centred, m.

    Raises
    ------
    InputError
        If parameters of most vectors are not finite or contradict each other, or they do not describe pulses.
    """
    normal, placed, lost = find_usable(file, origin)
    try:
        return _placed(file, normal, placed, lost)
    except InputError:
        if normal.all():
            raise
        # Lost vectors need no position: many files have arbitrary values there.
        return _placed(file, normal, normal, lost)


def _placed(file: CphdFile, normal: BoolArray, placed: BoolArray, lost: list[Lost]) -> Pulses:
    """Pulses of the vectors with time and positions; those with an abnormal signal are missing."""
    vector = np.asarray(np.flatnonzero(placed), dtype=np.int64)
    time = file.parameter("TxTime", vector)
    index, step, off = _slots(time, file.first_vector + vector)
    if off > UNIFORM_TOLERANCE:
        vector = vector[normal[vector]]
        time = file.parameter("TxTime", vector)
        index = np.arange(vector.size)
    transmitter, receiver, srp = (file.parameter(name, vector) for name in ("TxPos", "RcvPos", "SRPPos"))
    transmit_range = np.linalg.norm(transmitter - srp, axis=1)
    receive_range = np.linalg.norm(receiver - srp, axis=1)
    moment = time + transmit_range / (transmit_range + receive_range) * (file.parameter("RcvTime", vector) - time)
    separation = float(np.linalg.norm(transmitter - receiver, axis=1).max())
    if off > UNIFORM_TOLERANCE:
        return Pulses(
            vector=vector, time=time, reference_time=moment, position=(transmitter + receiver) / 2,
            reference_point=srp, separation=separation, lost=lost, even=False,
        )  # fmt: skip
    filled = np.full(index[-1] + 1, -1, dtype=np.int64)
    filled[index] = np.where(normal[vector], vector, -1)
    slots = np.arange(filled.size)
    return Pulses(
        vector=filled,
        time=time if slots.size == time.size else time[0] + step * slots,
        reference_time=np.interp(slots, index, moment),
        position=_interpolate_positions(slots, index, (transmitter + receiver) / 2),
        reference_point=np.stack([np.interp(slots, index, column) for column in srp.T], axis=1),
        separation=separation,
        lost=lost,
    )


def _slots(time: FloatArray, number: IntArray) -> tuple[IntArray, float, float]:
    """Pulse index of each vector on a uniform time axis, its step, s, and the largest deviation in steps.

    `number` are those of the vectors in the file.

    Raises
    ------
    InputError
        If times do not ascend, or leave more than half of the axis empty.
    """
    if time.size < 8:
        raise InputError(f"{texts.count(time.size, 'vector')} with a time and positions; at least 8 are needed")
    steps = np.diff(time)
    if not (steps > 0).all():
        where = number[1:][int(np.argmin(steps > 0))]
        raise InputError(f"PVP TxTime does not ascend at vector {where}; sort the vectors")
    step = float(np.median(steps))
    for _ in range(3):
        index = np.rint((time - time[0]) / step)
        step = float((time[-1] - time[0]) / index[-1]) if index[-1] > 0 else step
    off = float(np.abs((time - time[0]) / step - index).max())
    if not (np.diff(index) > 0).all():
        off = 1.0
    if index[-1] + 1 > (1 + MAX_GAPS) * time.size:
        raise InputError(
            f"PVP TxTime has {time.size} vectors on an axis of {index[-1] + 1:.0f} pulses {step:.6g} s apart: most are "
            "missing; cut the collection at its gaps"
        )
    return index.astype(np.int64), step, off


@dataclass(frozen=True, kw_only=True, eq=False)
class VectorResampling:
    """Resampling of uneven vectors to uniform pulses, after their signals have a common reference.

    Attributes
    ----------
    vector : (n_vector,) int
        The vectors that are summed.
    range_shift : (n_vector,) float
        Added to their reference range for the common reference, m.
    """

    vector: IntArray
    range_shift: FloatArray
    resampling: Resampling
    message: str

    @property
    def error(self) -> float:
        """Bound on the error of any echo, relative to its amplitude."""
        return float(self.resampling.bound[self.resampling.good].max())


def resample_vectors(
    pulses: Pulses, reference: FloatArray, ground: FloatArray, highest: float
) -> tuple[Pulses, FloatArray, VectorResampling]:
    """Plan pulses at uniform times: the pulses, their reference range, and the resampling of the vectors.

    Parameters
    ----------
    reference : (n_vector,) float
        Reference range of the vectors, m.
    ground : (n, 3) float
        Points all over the image area, Earth-centred, m.
    highest : float
        Highest frequency, Hz.

    Raises
    ------
    InputError
        If the image area's Doppler band is wider than the vectors sample, or more than half of the pulses would be
        missing.
    """
    from scipy.interpolate import CubicSpline

    time, steps = pulses.time, np.diff(pulses.time)
    n = round((time[-1] - time[0]) / float(np.mean(steps))) + 1
    uniform = np.linspace(time[0], time[-1], n)
    interval = float(uniform[1] - uniform[0])
    point = pulses.reference_point.mean(axis=0)
    offset = float(np.mean(reference - np.linalg.norm(pulses.position - pulses.reference_point, axis=1)))
    common = np.linalg.norm(pulses.position - point, axis=1) + offset
    rate = 0.0
    for corner in ground:
        difference = np.linalg.norm(pulses.position - corner, axis=1) - common
        rate = max(rate, float(np.abs(np.diff(difference) / steps).max()))
    band, prf = 4 * highest / SPEED_OF_LIGHT * rate, 1 / interval
    uneven = f"PVP TxTime is not uniform: steps run from {steps.min():.6g} to {steps.max():.6g} s"
    if not band <= OCCUPIED * prf:
        raise InputError(
            f"{uneven}, and the image area's Doppler of {band:.6g} Hz is too wide to resample at {prf:.6g} Hz "
            "on average; resample the vectors to uniform times"
        )
    resampling = plan_resampling(time, uniform, band=band)
    good = np.flatnonzero(resampling.good)
    remedy = "take a part without gaps with --pulses"
    refuse_few(good.size, n, f"{uneven}, so that most uniform pulses cannot be computed from them", remedy)
    usable = slice(int(good[0]), int(good[-1]) + 1)
    resampling, uniform = resampling.part(usable), uniform[usable]
    position, moment = (
        np.asarray(CubicSpline(time, values, axis=0)(uniform)) for values in (pulses.position, pulses.reference_time)
    )
    nearest = np.rint(np.interp(uniform, time, np.arange(time.size))).astype(np.int64)
    even = Pulses(
        vector=np.where(resampling.good, pulses.vector[nearest], -1), time=uniform,
        reference_time=moment, position=position,
        reference_point=np.tile(point, (uniform.size, 1)), separation=pulses.separation, lost=pulses.lost,
    )  # fmt: skip
    bound, spread = (20 * np.log10(error[resampling.good].max()) for error in (resampling.bound, resampling.spread))
    message = (
        f"vectors are {steps.min():.6g} to {steps.max():.6g} s apart: resampled to {uniform.size} pulses, one every "
        f"{interval:.6g} s, with an error of at most {bound:.0f} dB on any echo of the image area, {spread:.0f} dB "
        f"r.m.s. over all of them ({band:.4g} Hz of Doppler)"
    )
    slow_time = VectorResampling(
        vector=pulses.vector, range_shift=common - reference, resampling=resampling, message=message
    )
    return even, np.linalg.norm(position - point, axis=1) + offset, slow_time


def _interpolate_positions(slots: IntArray, index: IntArray, values: FloatArray) -> FloatArray:
    """Interpolate positions of all pulses by a cubic spline through the known ones."""
    if slots.size == index.size:
        return values
    from scipy.interpolate import CubicSpline

    return np.asarray(CubicSpline(index, values, axis=0)(slots))
