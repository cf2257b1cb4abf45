"""Assign vectors to pulses, and resample vectors at uneven times to pulses at uniform ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from blocksar.arrays import UNIFORM_TOLERANCE, BoolArray, FloatArray, IntArray
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.ingestion.cphd.faults import Lost, find_usable
from blocksar.ingestion.cphd.files import CphdFile
from blocksar.ingestion.resampling import OCCUPIED, Resampling, plan_resampling

MAX_GAPS = 1.0  # missing vectors over those present


@dataclass(frozen=True, kw_only=True, eq=False)
class Pulses:
    """The vector of each pulse. A pulse without a vector, or whose vector is not normal, is missing.

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
        # Vectors that are lost need no position: many files have anything there.
        return _placed(file, normal, normal, lost)


def _placed(file: CphdFile, normal: BoolArray, placed: BoolArray, lost: list[Lost]) -> Pulses:
    """Pulses of the vectors that have a time and positions; those whose signal is not normal are missing."""
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
    """Index of each vector's pulse on a uniform axis of slow time, the axis' step, s, and the largest deviation, steps.

    `number` are those of the vectors in the file.

    Raises
    ------
    InputError
        If times do not ascend, or leave more than half of the axis empty.
    """
    if time.size < 8:
        raise InputError(f"only {time.size} vectors have a time and positions; at least 8 are needed")
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
    """Resampling of vectors at uneven times to pulses at uniform ones, once their signals have a common reference.

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
    if good.size < max(8, n // 2):
        raise InputError(
            f"{uneven}, so that {n - good.size} of {n} uniform pulses cannot be computed from them; "
            "cut the collection at its gaps"
        )
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
    """Positions of all pulses, by a cubic spline through those that are known."""
    if slots.size == index.size:
        return values
    from scipy.interpolate import CubicSpline

    return np.asarray(CubicSpline(index, values, axis=0)(slots))
