"""Resampling of vectors to one frequency grid, and removal of the tropospheric delay left in them.

Grids are selected where they agree, interpolated where they differ, transformed from TOA.

*Delays* after that of the SRP are those of TOA1 .. TOA2, or those about the SRP. Samples SCSS apart tell delays apart
only within 1 / SCSS: an echo beyond folds back by whole multiples of it. TOA1 .. TOA2 may be a little longer, where the
echoes end before. Some files give many times as much, or an interval that holds nothing of the image area. Whether the
echoes are those about the SRP then, nothing in the file tells; the user does.

*Troposphere.* The standard's reference delay is that of the SRP through the troposphere: 2 R_SRP / c + TDTropoSRP.
Samples hold delays after it, so that an echo of the SRP has dTOA = 0, and nothing is to be done but for the change of
the delay over the scene, which stays. In files whose reference delay is 2 R_SRP / c alone, all echoes are late by the
delay td:

    dTOA = 2 (R - R_SRP) / c + td = 2 (R - (R_SRP - c td / 2)) / c,

so that reference_range is R_SRP - c td / 2 and the samples stay as they are. td is that of the file, or, where the file
has none, that of a standard atmosphere (`atmosphere`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.collection.georeference import Georeference
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.readers.atmosphere import delay_words, slant_delay
from blocksar.readers.cphd.areas import ImageArea, area_delays
from blocksar.readers.cphd.files import MAX_SAMPLES, CphdFile

MAX_FOLD = 2.0  # saved delays over the unambiguous ones; no file is sampled more sparsely
RangeWindow = Literal["saved", "reference"]


class Delays(NamedTuple):
    """Selected delays: their middle by vector, their largest extent, s, and messages."""

    middle: FloatArray
    extent: float
    messages: tuple[str, ...] = ()


def find_delays(file: CphdFile, used: IntArray, area: ImageArea, window: RangeWindow | None) -> Delays:
    """Select the delays to keep; `used` are the relevant vectors.

    Parameters
    ----------
    window : {"saved", "reference"} or None
        TOA1 .. TOA2, or the unambiguous delays about the SRP; None for the first, if the image area has any of them.

    Raises
    ------
    InputError
        If TOA1 .. TOA2 cannot be what the samples hold.
    """
    early, late = file.parameter("TOA1"), file.parameter("TOA2")
    unambiguous = float(1 / file.parameter("SCSS")[used].max()) if file.domain == "FX" else np.inf
    if window == "reference":
        if file.domain != "FX":
            raise InputError(
                "--range-window reference is given, but the samples are over delay (DomainType TOA), and SC0 and SCSS "
                "say where; leave it out"
            )
        window_text = f"the {_metres(unambiguous):.6g} m of range about the SRP are taken, whatever TOA1 and TOA2 say"
        return Delays(np.zeros(early.size), unambiguous, (window_text,))
    own = late - early
    where = int(used[own[used].argmax()])
    fold = float(own[where] / unambiguous)
    if fold > MAX_FOLD or (window is None and not _meets(file, used, area)):
        raise InputError(_reason(file, where, area, unambiguous))
    first, last = early[used].min(), late[used].max()
    middle, extent = (first + last) / 2, last - first
    if abs(middle) < 1e-3 * extent:
        middle = 0.0
    messages: list[str] = []
    if middle:
        ends = [_metres(float(value[where])) for value in (early, late)]
        messages.append(
            f"the saved delays are not centred at the SRP, but run from {ends[0]:.6g} to {ends[1]:.6g} m of range "
            f"after it (vector {file.first_vector + where}): reference_range is at their middle"
        )
    if fold > 1:
        messages.append(
            f"TOA1 .. TOA2 has {fold:.3g} times the delays that samples SCSS apart tell apart: echoes more than "
            f"{_metres(unambiguous) / 2:.6g} m of range off its middle fold back into the image"
        )
    if extent * 1.05 <= unambiguous or np.ptp(early[used]) + np.ptp(late[used]) == 0:
        return Delays(
            np.full(early.size, middle),
            min(float(2 * max(last - middle, middle - first)), unambiguous),
            tuple(messages),
        )
    # The saved delays move too far to have one middle.
    return Delays((early + late) / 2, min(float(own[used].max()), unambiguous), tuple(messages))


def _metres(delay: float) -> float:
    return delay * SPEED_OF_LIGHT / 2


def _meets(file: CphdFile, used: IntArray, area: ImageArea) -> bool:
    """Tell whether any of the saved delays falls on the image area."""
    for vector in used[[0, used.size // 2, -1]]:
        first, last = area_delays(file, area, int(vector))
        if first <= file.parameter("TOA2")[vector] and last >= file.parameter("TOA1")[vector]:
            return True
    return False


def _reason(file: CphdFile, vector: int, area: ImageArea, unambiguous: float) -> str:
    """Explain why a vector's TOA1 .. TOA2 contradict its samples."""
    early, late = (_metres(float(file.parameter(name)[vector])) for name in ("TOA1", "TOA2"))
    first, last = (_metres(delay) for delay in area_delays(file, area, vector))
    apart = ""
    if np.isfinite(unambiguous):
        apart = (
            f"; samples SCSS = {file.parameter('SCSS')[vector]:.6g} Hz apart tell {_metres(unambiguous):.6g} m apart, "
            f"{(late - early) / _metres(unambiguous):.3g} times less"
            if late - early > _metres(unambiguous)
            else f"; samples SCSS apart tell {_metres(unambiguous):.6g} m apart"
        )
    remedy = "--range-window reference takes those about the SRP" if apart else "correct TOA1 and TOA2"
    return (
        f"PVP TOA1 .. TOA2 saves echoes from {early:.6g} to {late:.6g} m of range after the SRP (vector "
        f"{file.first_vector + vector}), and the image area lies {first:.6g} to {last:.6g} m after it{apart}: {remedy}"
    )


SAME_GRID = 0.05  # samples, by which grids may differ to be taken as one: an error of 0.16 rad at most
EXACT_GRID = 1e-4  # samples, within which grids are the same but for rounding
TAPS = (64, 128, 256)  # samples used for one interpolated sample: as few as will do
STEPS = 128  # offsets per sample in the table of interpolators
MOST_MARGIN = 1 / 16  # of a vector's samples, left out at either end of the band
SMALLER = (0.94, 0.9, 0.8, 0.7, 0.6, 0.5)  # of the unambiguous delays, for which interpolators are tried if need be
LEAST_DELAYS = 0.75  # of the saved delays, for which they must be accurate
ACCURACY = 1e-3  # largest interpolation error relative to the reflectivity: -60 dB
NOISE_GAIN = 1.5  # largest noise gain of interpolation, in amplitude
LEAST_BAND = 0.5  # share of a vector's band that must be common to all


@dataclass(frozen=True, kw_only=True, eq=False)
class Selected:
    """Resampler that selects samples of FX vectors on one grid, or next to it, unchanged."""

    frequency: FloatArray  # Hz, absolute
    start: FloatArray  # by vector: SC0
    step: FloatArray  # by vector: SCSS
    first: IntArray  # by vector: the sample of the first frequency
    used: IntArray  # vectors that matter
    off: float  # samples, by which the grids of vectors differ from the common one
    error: float  # at the ends of the saved delays

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

    def frequency_of(self, vectors: IntArray) -> FloatArray:
        """Frequencies, Hz, of the samples of vectors, (n, n_frequency) or (n_frequency,)."""
        if self.off == 0:
            return self.frequency
        sample = self.first[vectors, None] + np.arange(self.frequency.size)
        return np.asarray(self.start[vectors, None] + self.step[vectors, None] * sample)


@dataclass(frozen=True, kw_only=True, eq=False)
class Interpolated:
    """Resampler of FX vectors on different grids by interpolation; `table` (offset steps, TAPS) starts at `margin`."""

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
    exact: float  # share of the saved delays, about their middle, for which the error holds

    def frequency_of(self, vectors: IntArray) -> FloatArray:
        """Return frequencies as `Selected.frequency_of` does."""
        return self.frequency

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
    """Resampler of TOA vectors: their Fourier sum at the grid's frequencies."""

    frequency: FloatArray
    start: FloatArray  # by vector: SC0
    step: FloatArray  # by vector: SCSS
    centre: FloatArray  # by vector: fx_C
    band: FloatArray  # by vector: FX2 - FX1
    samples: slice
    error: float = 0.0

    def frequency_of(self, vectors: IntArray) -> FloatArray:
        """Return frequencies as `Selected.frequency_of` does."""
        return self.frequency

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


Resampler = Selected | Interpolated | Transformed


def phasor(cycles: FloatArray) -> NDArray[np.complex128]:
    """Compute exp(2j pi cycles) after removing whole cycles."""
    return np.asarray(np.exp(2j * np.pi * (cycles - np.rint(cycles))))


def choose_resampler(file: CphdFile, used: IntArray, delays: Delays) -> Resampler:
    """Choose the resampler to one frequency grid; `used` are the relevant vectors.

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
    df = float(np.median(step[used]))
    first, last = _common(low[used], high[used], file.band)
    shift, off, origin = _shifts(start, step, used, n, df)
    if off <= SAME_GRID:
        begin = int(np.ceil((first - origin) / df - off - 1e-3))
        stop = int(np.floor((last - origin) / df + off + 1e-3)) + 1
        _check_count(stop - begin)
        off = off if off > EXACT_GRID else 0.0
        return Selected(
            frequency=np.asarray(origin + df * np.arange(begin, stop), np.float64), start=start, step=step,
            first=begin - shift, used=used,
            off=off, error=2 * np.pi * off * df * delays.extent / 2,
        )  # fmt: skip
    df = float(step[used].min())
    inner, outer = np.zeros(start.size, np.int64), np.zeros(start.size, np.int64)
    inner[used] = np.ceil(((low - start) / step)[used] - 1e-9)
    outer[used] = np.floor(((high - start) / step)[used] + 1e-9)
    table, margin, error, share = _best_interpolators(
        float(step[used].max()) * delays.extent, int((outer - inner)[used].min()) + 1
    )
    first = max(first, float((start + (inner + margin) * step)[used].max()))
    last = min(last, float((start + (outer - margin) * step)[used].min()))
    count = int(np.floor((last - first) / df)) + 1
    _check_count(count)
    return Interpolated(
        frequency=np.asarray(first + df * np.arange(count), np.float64), start=start, step=step,
        first=inner, last=outer, samples=slice(int(inner[used].min()), int(outer[used].max()) + 1),
        table=table, margin=margin, middle=delays.middle, error=error, exact=share,
    )  # fmt: skip


def _shifts(start: FloatArray, step: FloatArray, used: IntArray, n: int, df: float) -> tuple[IntArray, float, float]:
    """Offset of each vector's first sample from that of a common grid, in steps `df`, and the deviation from it.

    Returns
    -------
    shift : (n_vector,) int
        0 for vectors that are not used.
    off : float
        Largest distance of a sample of a used vector from the grid, in samples.
    origin : float
        The grid's frequency 0, Hz.
    """
    middle = start + (n - 1) / 2 * step
    places = (middle - middle[used[0]]) / df
    shift = np.zeros(start.size, np.int64)
    shift[used] = np.rint(places[used])
    origin = middle[used[0]] - (n - 1) / 2 * df + df * float(np.median(places[used] - shift[used]))
    ends = [(start + k * step - origin) / df - k - shift for k in (0, n - 1)]
    return shift, float(np.abs(np.stack(ends)[:, used]).max()), float(origin)


def _common(low: FloatArray, high: FloatArray, wanted: tuple[float, float]) -> tuple[float, float]:
    """Band common to all vectors, limited to the wanted one."""
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
    """Refuse a grid with too few frequencies."""
    if count < 8:
        raise InputError(f"only {count} frequencies are common to all vectors; at least 8 are needed")


def _best_interpolators(occupancy: float, n: int) -> tuple[FloatArray, int, float, float]:
    """Interpolators with the fewest taps for samples whose delays fill a share `occupancy` of the unambiguous ones.

    Where none is accurate enough near the ends of the unambiguous delays, they are for a part of the delays.

    Returns
    -------
    table, margin, error
        See `_interpolators`.
    exact : float
        The share of the delays, about their middle, that they are for.

    Raises
    ------
    InputError
        If there are none for LEAST_DELAYS of the delays.
    """
    choices = [(occupancy, taps) for taps in TAPS]
    choices += [(part, taps) for part in SMALLER for taps in TAPS if LEAST_DELAYS * occupancy <= part < occupancy]
    for part, taps in choices:
        if 2 * taps > n and taps > TAPS[0]:
            continue
        table, margin, error = _interpolators(part, min(taps, n // 2))
        if margin <= MOST_MARGIN * n and margin < min(taps, n // 2) // 2 - 1:
            return table, margin, error, part / occupancy
    raise InputError(
        f"PVP SC0 and SCSS differ from vector to vector, and the saved delays TOA1 .. TOA2 fill {occupancy:.3g} of "
        f"the unambiguous ones of {n} samples: too much to resample within {ACCURACY:g}; resample the vectors to "
        "one grid"
    )


def _interpolators(occupancy: float, taps: int) -> tuple[FloatArray, int, float]:
    """Least-squares interpolators for samples whose delays fill a share `occupancy` of the unambiguous ones.

    Returns
    -------
    table : (n_offset, taps) float
        For offsets of margin, margin + 1 / STEPS, ... samples from the first tap.
    margin : int
        Number of samples at either end within which no interpolator is accurate enough.
    error : float
        Largest error over offsets and delays for one target of reflectivity 1, including that between two offsets.
    """
    i = np.arange(taps)
    gram = np.sinc(occupancy * (i[:, None] - i)) + 1e-8 * np.eye(taps)
    offset = np.arange((taps - 1) * STEPS + 1) / STEPS
    table = np.linalg.solve(gram, np.sinc(occupancy * (i[:, None] - offset))).T
    coarse = slice(None, None, STEPS // 16)
    cycles = occupancy / 2 * np.linspace(-1, 1, 2 * taps + 1)
    response = table[coarse] @ phasor(i[:, None] * cycles)
    error = np.abs(phasor(offset[coarse, None] * cycles) - response).max(axis=1)
    good = (error <= ACCURACY) & (np.linalg.norm(table[coarse], axis=1) <= NOISE_GAIN)
    half = error.size // 2
    bad = np.flatnonzero(~good[: half + 1])
    margin = 0 if not bad.size else int(np.ceil((bad[-1] + 1) / 16))
    inner = slice(margin * STEPS, (taps - 1 - margin) * STEPS + 1)
    worst = float(error[margin * 16 : error.size - margin * 16].max(initial=0.0))
    between = (np.pi * occupancy / STEPS) ** 2 / 8  # of linear interpolation in the table
    return table[inner], margin, worst + between


# ---------------------------------------------------------------- troposphere

Troposphere = Literal["file", "standard"]
NAME = "TDTropoSRP"


class TroposphericDelay(NamedTuple):
    """Delay removed from the ranges of vectors (n_vector,), m, with a description."""

    removed: FloatArray
    message: str | None


def find_troposphere(
    file: CphdFile, used: IntArray, frame: Georeference, wanted: Troposphere | None, cell: float
) -> TroposphericDelay:
    """Determine the tropospheric delay in the samples, and the part to remove.

    Parameters
    ----------
    used : (n,) int
        The vectors that matter.
    wanted : {"file", "standard"} or None
        The delay that the samples hold.
    cell : float
        Range resolution, m. A delay that the file lacks is told if it is longer.

    Raises
    ------
    InputError
        If that of the file is wanted, and it has none.
    """
    given = _given(file, used)
    model = np.zeros(file.shape[0])
    model[used] = _standard(file, used, frame)
    if wanted == "standard":
        return TroposphericDelay(
            model, f"the troposphere's delay is taken out: that of a standard atmosphere, {delay_words(model[used])}"
        )
    if wanted == "file":
        if given is None:
            raise InputError(
                f"--troposphere file is given, but PVP {NAME} is missing, not finite or 0; give --troposphere standard"
            )
        return TroposphericDelay(
            given, f"the troposphere's delay is taken out: that of {NAME}, {delay_words(given[used])}"
        )
    if given is not None:
        return TroposphericDelay(
            0 * model,
            f"the troposphere's delay {NAME} is {delay_words(given[used])}: a part of the file's reference, as the "
            "standard has it; if places lie too far by that much, the samples hold it: --troposphere file takes it out",
        )
    message = None
    if model.max() > cell:
        message = (
            f"{NAME} is 0: if the samples hold the troposphere's delay, places lie too far by some "
            f"{model[used].mean():.3g} m, which --troposphere standard takes out"
        )
    return TroposphericDelay(0 * model, message)


def _given(file: CphdFile, used: IntArray) -> FloatArray | None:
    """Delay stated by the file, m of range, gaps filled from neighbours; None without one."""
    if NAME not in (file.vectors.dtype.names or ()) or file.vectors.dtype[NAME] != np.dtype("f8"):
        return None
    delay = file.parameter(NAME) * SPEED_OF_LIGHT / 2
    known = used[np.isfinite(delay[used])]
    if not known.size or not np.any(delay[known]):
        return None
    return np.interp(np.arange(delay.size), known, delay[known])


def _standard(file: CphdFile, used: IntArray, frame: Georeference) -> FloatArray:
    """Delay of a standard atmosphere between antenna and SRP, m of range, for some vectors."""
    return slant_delay(file.parameter("TxPos", used), file.parameter("SRPPos", used), frame)
