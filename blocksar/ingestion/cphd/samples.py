"""Bring samples to one frequency grid: select where grids agree, interpolate where they differ, transform from TOA."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.errors import InputError
from blocksar.ingestion.cphd.files import MAX_SAMPLES, CphdFile

TAPS = 64  # samples used for one interpolated sample
STEPS = 512  # offsets per sample in the table of interpolators
ACCURACY = 1e-3  # largest interpolation error relative to the reflectivity: -60 dB
NOISE_GAIN = 1.5  # largest noise gain of interpolation, in amplitude
LEAST_BAND = 0.5  # share of a vector's band that must be common to all
MAX_FOLD = 2.0  # saved delays over the unambiguous ones; no file is sampled more sparsely, units are wrong then


class Delays(NamedTuple):
    """The saved part of the echo: middle of the saved delays, by vector, and their largest extent, s."""

    middle: FloatArray
    extent: float


def find_delays(file: CphdFile, used: IntArray) -> Delays:
    """Determine the saved delays from TOA1 and TOA2; `used` are the vectors that matter."""
    early, late = file.parameter("TOA1"), file.parameter("TOA2")
    first, last = early[used].min(), late[used].max()
    middle, extent = (first + last) / 2, last - first
    if abs(middle) < 1e-3 * extent:
        middle = 0.0
    unambiguous = 1 / file.parameter("SCSS")[used].max() if file.domain == "FX" else np.inf
    own = late - early
    if not own[used].max() <= MAX_FOLD * unambiguous:
        where = int(used[own[used].argmax()])
        raise InputError(
            f"PVP TOA1 .. TOA2 is {own[where]:.6g} s long in vector {where}, but samples SCSS = "
            f"{file.parameter('SCSS')[where]:.6g} Hz apart have only {unambiguous:.6g} s of unambiguous delays; "
            "correct them"
        )
    if extent * 1.05 <= unambiguous or np.ptp(early[used]) + np.ptp(late[used]) == 0:
        return Delays(np.full(early.size, middle), float(2 * max(last - middle, middle - first)))
    # The saved delays move too far to have one middle.
    return Delays((early + late) / 2, float((late - early)[used].max()))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Selected:
    """FX vectors on one grid: some of their samples, unchanged."""

    frequency: FloatArray  # Hz, absolute
    first: IntArray  # by vector: the sample of the first frequency
    used: IntArray  # vectors that matter
    error: float = 0.0

    @cached_property
    def samples(self) -> slice:
        """The samples that any vector needs."""
        first = self.first[self.used]
        return slice(int(first.min()), int(first.max()) + self.frequency.size)

    def apply(self, rows: ComplexArray, vectors: IntArray) -> ComplexArray:
        first = self.first[vectors] - self.samples.start
        if (first == first[0]).all():
            return rows[:, first[0] : first[0] + self.frequency.size]
        return np.take_along_axis(rows, first[:, None] + np.arange(self.frequency.size), axis=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Interpolated:
    """FX vectors on different grids: local interpolation. `table` (offset steps, TAPS) begins at `margin`."""

    frequency: FloatArray
    start: FloatArray  # by vector: SC0
    step: FloatArray  # by vector: SCSS
    first: IntArray  # by vector: the first sample within FX1 .. FX2; samples beyond carry no meaning
    last: IntArray  # by vector: the last one
    samples: slice
    table: FloatArray
    margin: int
    middle: FloatArray  # by vector: delay, s, at which the table is centred
    error: float

    def apply(self, rows: ComplexArray, vectors: IntArray) -> ComplexArray:
        taps = self.table.shape[1]
        sample = np.arange(self.samples.start, self.samples.stop)
        fx = self.start[vectors, None] + self.step[vectors, None] * sample
        centred = (rows * phasor(fx * self.middle[vectors, None])).astype(np.complex64)
        position = (self.frequency - self.start[vectors, None]) / self.step[vectors, None] - self.samples.start
        base = np.clip(
            np.floor(position).astype(np.int64) - taps // 2 + 1,
            self.first[vectors, None] - self.samples.start,
            self.last[vectors, None] - self.samples.start - taps + 1,
        )
        step = (position - base - self.margin) * STEPS
        low = np.clip(step.astype(np.int64), 0, len(self.table) - 2)
        share = (step - low).astype(np.float32)
        out = np.zeros(position.shape, np.complex64)
        for tap in range(taps):
            weights = self.table[:, tap].astype(np.float32)
            weight = weights[low] * (1 - share) + weights[low + 1] * share
            out += weight * np.take_along_axis(centred, base + tap, axis=1)
        return (out * phasor(-self.frequency * self.middle[vectors, None])).astype(np.complex64)


@dataclass(frozen=True, kw_only=True, eq=False)
class Transformed:
    """TOA vectors: their Fourier sum at the grid's frequencies."""

    frequency: FloatArray
    start: FloatArray  # by vector: SC0
    step: FloatArray  # by vector: SCSS
    centre: FloatArray  # by vector: fx_C
    band: FloatArray  # by vector: FX2 - FX1
    samples: slice
    error: float = 0.0

    def apply(self, rows: ComplexArray, vectors: IntArray) -> ComplexArray:
        from scipy.signal import CZT

        n, count = self.frequency.size, rows.shape[1]
        df = (self.frequency[-1] - self.frequency[0]) / (n - 1)
        sample = np.arange(count)
        out = np.empty((rows.shape[0], n), np.complex64)
        transforms: dict[float, Any] = {}
        for row, v in enumerate(vectors):
            step = float(self.step[v])
            if step not in transforms:
                if len(transforms) > 64:
                    transforms.clear()
                transforms[step] = CZT(count, n, np.exp(-2j * np.pi * df * step))
            offset = self.centre[v] - self.frequency[0]
            shifted = rows[row].astype(np.complex128) * phasor(offset * step * sample)
            ramp = phasor((self.centre[v] - self.frequency) * self.start[v])
            out[row] = transforms[step](shifted) * ramp * (step * self.band[v])
        return out


Resampler = _Selected | Interpolated | Transformed


def phasor(cycles: FloatArray) -> NDArray[np.complex128]:
    """exp(2j pi cycles); whole cycles are removed first."""
    return np.asarray(np.exp(2j * np.pi * (cycles - np.rint(cycles))))


def choose_resampler(file: CphdFile, used: IntArray, delays: Delays) -> Resampler:
    """Choose how samples are brought to one frequency grid; `used` are the vectors that matter.

    Raises
    ------
    InputError
        If the vectors have no common band, or cannot be resampled accurately enough.
    """
    start, step = file.parameter("SC0"), file.parameter("SCSS")
    low, high = file.parameter("FX1"), file.parameter("FX2")
    n = file.shape[1]
    if file.domain == "TOA":
        first, last = _common(low[used], high[used], file.band)
        span = float((step[used] * n).max())
        early, late = (start - delays.middle)[used], (start + (n - 1) * step - delays.middle)[used]
        window = max(span, 2 * float(np.abs(early).max()), 2 * float(np.abs(late).max()))
        count = int(np.floor((last - first) * window + 1e-6))
        if not 8 <= count <= MAX_SAMPLES:
            raise InputError(
                f"PVP FX1, FX2, SC0 and SCSS give {count} frequencies over a band of {last - first:.6g} Hz and delays "
                f"of {window:.6g} s; correct them"
            )
        frequency = np.asarray((first + last) / 2 + (np.arange(count) - (count - 1) / 2) / window, np.float64)
        return Transformed(
            frequency=frequency, start=start, step=step, centre=(low + high) / 2, band=high - low, samples=slice(0, n)
        )
    slack = 1e-3 * step
    low, high = np.maximum(low - slack, start), np.minimum(high + slack, start + (n - 1) * step)
    if not (low[used] < high[used]).all():
        raise InputError(
            "PVP FX1 .. FX2 does not meet the samples that SC0 and SCSS give in every vector; correct them"
        )
    df = float(step[used].min())
    first, last = _common(low[used], high[used], file.band)
    reference = used[0]
    places = (start - start[reference]) / df
    off = np.abs(places - np.rint(places))[used]
    if np.ptp(step[used]) * n < 1e-4 * df and off.max() < 1e-4:
        begin = int(np.ceil((first - start[reference]) / df - 1e-3))
        stop = int(np.floor((last - start[reference]) / df + 1e-3)) + 1
        _check_count(stop - begin)
        shift = np.full(start.size, begin, dtype=np.int64)
        shift[used] -= np.rint(places[used]).astype(np.int64)
        return _Selected(frequency=start[reference] + df * np.arange(begin, stop), first=shift, used=used)
    inner, outer = np.zeros(start.size, np.int64), np.zeros(start.size, np.int64)
    inner[used] = np.ceil(((low - start) / step)[used] - 1e-9)
    outer[used] = np.floor(((high - start) / step)[used] + 1e-9)
    table, margin, error = _interpolators(float(step[used].max()) * delays.extent, int((outer - inner)[used].min()) + 1)
    first = max(first, float((start + (inner + margin) * step)[used].max()))
    last = min(last, float((start + (outer - margin) * step)[used].min()))
    count = int(np.floor((last - first) / df)) + 1
    _check_count(count)
    return Interpolated(
        frequency=np.asarray(first + df * np.arange(count), np.float64), start=start, step=step,
        first=inner, last=outer, samples=slice(int(inner[used].min()), int(outer[used].max()) + 1),
        table=table, margin=margin, middle=delays.middle, error=error,
    )  # fmt: skip


def _common(low: FloatArray, high: FloatArray, wanted: tuple[float, float]) -> tuple[float, float]:
    """The band common to all vectors, as far as it is wanted."""
    first, last, own = float(low.max()), float(high.min()), float(np.median(high - low))
    if last - first < LEAST_BAND * own:
        raise InputError(
            f"PVP FX1 and FX2 (within SC0 and SCSS) leave only {max(last - first, 0.0):.6g} Hz in common to all "
            f"vectors, of {own:.6g} Hz that one has; cut the collection into parts with similar bands"
        )
    if not max(first, wanted[0]) < min(last, wanted[1]):
        raise InputError(
            f"--frequencies {wanted[0]:.10g}:{wanted[1]:.10g} has nothing of what all vectors have, {first:.10g} .. "
            f"{last:.10g} Hz; give a part of that"
        )
    return max(first, wanted[0]), min(last, wanted[1])


def _check_count(count: int) -> None:
    """Refuse a grid of too few frequencies."""
    if count < 8:
        raise InputError(f"only {count} frequencies are common to all vectors; at least 8 are needed")


def _interpolators(occupancy: float, n: int) -> tuple[FloatArray, int, float]:
    """Least-squares interpolators for samples whose delays fill the share `occupancy` of the unambiguous ones.

    Returns
    -------
    table : (n_offset, taps) float
        For offsets of margin, margin + 1 / STEPS, ... samples from the first tap.
    margin : int
        Number of samples at either end within which no interpolator is accurate enough.
    error : float
        Largest error over offsets and delays for one target of reflectivity 1, including that between two offsets.
    """
    taps = min(TAPS, n)
    i = np.arange(taps)
    gram = np.sinc(occupancy * (i[:, None] - i)) + 1e-8 * np.eye(taps)
    offset = np.arange((taps - 1) * STEPS + 1) / STEPS
    table = np.linalg.solve(gram, np.sinc(occupancy * (i[:, None] - offset))).T
    coarse = slice(None, None, STEPS // 16)
    cycles = occupancy / 2 * np.linspace(-1, 1, 129)
    response = table[coarse] @ phasor(i[:, None] * cycles)
    error = np.abs(phasor(offset[coarse, None] * cycles) - response).max(axis=1)
    good = (error <= ACCURACY) & (np.linalg.norm(table[coarse], axis=1) <= NOISE_GAIN)
    half = error.size // 2
    bad = np.flatnonzero(~good[: half + 1])
    margin = 0 if not bad.size else int(np.ceil((bad[-1] + 1) / 16))
    if margin >= taps // 2 - 1 or n < 2 * taps:
        raise InputError(
            f"PVP SC0 and SCSS differ from vector to vector, and the saved delays TOA1 .. TOA2 fill {occupancy:.3g} of "
            f"the unambiguous ones of {n} samples: too much to resample within {ACCURACY:g}; resample the vectors to "
            "one grid"
        )
    inner = slice(margin * STEPS, (taps - 1 - margin) * STEPS + 1)
    worst = float(error[margin * 16 : error.size - margin * 16].max())
    between = (np.pi * occupancy / STEPS) ** 2 / 8  # of linear interpolation in the table
    return table[inner], margin, worst + between
