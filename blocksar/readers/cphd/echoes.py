"""Samples of a channel as pulses of a store: reading, sign of the phase, and lost pulses.

*Sign.* A source states the window of delays that its samples hold, or the grid has the ground that they show. The
conjugate of a signal lies in the mirror image of that window about the reference range. A spotlight about a fixed point
may be as sharp there, so that its energy tells what its sharpness does not.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import BinaryIO, NamedTuple

import numpy as np

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.chunks import TILE
from blocksar.collection.collection import Collection
from blocksar.collection.empty_pulses import missing_pulses
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.kernels.fourier import fft_rows
from blocksar.readers.cphd.files import CphdFile, reading_file
from blocksar.readers.cphd.frequency_grid import Delays, Resampler, phasor
from blocksar.readers.cphd.vectors import NOT_FINITE, ZEROS, Lost, Pulses, VectorResampling, describe_lost
from blocksar.readers.registry import Piece, refuse_few
from blocksar.readers.resampling import MOST_ERROR, Area, AreaCut, plan_cut

# ---------------------------------------------------------------- sign

GROUP = 256  # pulses that are transformed at a time
GUARD = 8  # bins about the ends of the window that are left out: a Hann weighting leaks 1e-6 of a target beyond
LEAK = 1e-4  # of all energy: with less in either part, both hold only leakage from between them
CLEAR = 3.0  # dB
SIGNIFICANT = 5.0  # standard deviations; by chance once in 3 million


class WindowEnergy(NamedTuple):
    """Energy of a signal inside a stated range window and inside its mirror image.

    Attributes
    ----------
    inside, mirrored : float
        Share of the energy inside the window as given, and with the signal conjugated.
    gain : float
        Power per bin where only the window is, over that where only its mirror image is, dB; 0 where nothing lies in
        either, as with a window that is its own mirror image.
    deviation : float
        Standard deviation of `gain` if both hold speckle of the same power, dB.
    """

    inside: float
    mirrored: float
    gain: float
    deviation: float

    @property
    def conjugated(self) -> bool | None:
        """Tell whether the signal is conjugated; None if its energy does not show it."""
        if abs(self.gain) < max(CLEAR, SIGNIFICANT * self.deviation):
            return None
        return self.gain < 0


def energy_in_window(
    signal: ComplexArray, *, frequency_step: float, near: FloatArray | float, far: FloatArray | float
) -> WindowEnergy:
    """Compare the energy inside a window of range with that inside its mirror image about the reference range.

    Under either sign the part of the range axis that only the true window covers holds echoes and noise, and the part
    that only the mirror image covers holds noise. Speckle whose power is averaged over m independent bins deviates by
    10 / ln 10 / sqrt(m) dB; range profiles of a spotlight hardly change from pulse to pulse, so only the bins of one
    pulse count as independent.

    Parameters
    ----------
    signal : (n_pulse, n_frequency) complex64
        With the phase -4 pi (fc + f) / c (R - reference_range); NaN where missing. Not changed.
    frequency_step : float
        Hz. Ranges are told apart up to c / (4 frequency_step) on either side of the reference; those beyond fold back.
    near, far : float or (n_pulse,) float
        Ends of the window, R - reference_range, m: c / 2 times TOA1 and TOA2 of a CPHD file.

    Returns
    -------
    WindowEnergy

    Raises
    ------
    ValueError
        If the window is empty.
    """
    n_pulse, n = signal.shape
    ends = [np.broadcast_to(np.asarray(end, np.float64), (n_pulse,))[:, None] for end in (near, far)]
    if not (ends[0] < ends[1]).all():
        raise ValueError(f"need near < far, got {near=} {far=}")
    spacing = SPEED_OF_LIGHT / (2 * n * frequency_step)
    offset = spacing * ((np.arange(n) + n // 2) % n - n // 2)  # of the bins, as the transform has them
    span, guard = n * spacing, GUARD * spacing
    hann = (1 + np.cos(2 * np.pi * (np.arange(n) - (n - 1) / 2) / n)).astype(np.float32)
    energy, bins = np.zeros(5), np.zeros(5)  # all, inside, mirrored, only inside, only mirrored
    for first in range(0, n_pulse, GROUP):
        rows = slice(first, first + GROUP)
        low, high = ends[0][rows], ends[1][rows]
        profile = fft_rows(np.nan_to_num(signal[rows]) * hann, inverse=True)
        power = np.abs(profile).astype(np.float64) ** 2
        inside, mirrored = (np.mod(each - low, span) <= high - low for each in (offset, -offset))
        around, around_mirrored = (
            np.mod(each - low + guard, span) <= high - low + 2 * guard for each in (offset, -offset)
        )
        for k, part in enumerate((None, inside, mirrored, inside & ~around_mirrored, mirrored & ~around)):
            energy[k] += power.sum() if part is None else power[part].sum()
            bins[k] += power.size if part is None else part.sum()
    shares = energy / max(energy[0], 1e-300)
    gain, independent = 0.0, bins[3:].min() / n_pulse
    if independent >= 1 and shares[3:].max() > LEAK:
        gain = float(10 * np.log10(max(energy[3] / bins[3], 1e-300) / max(energy[4] / bins[4], 1e-300)))
    # Neighbouring bins of a Hann-weighted profile are not independent: two in three are.
    deviation = 10 / np.log(10) * np.sqrt(2 * 1.5 / max(independent, 1.0))
    return WindowEnergy(float(shares[1]), float(shares[2]), gain, float(deviation))


# ---------------------------------------------------------------- samples

ROWS = TILE[0]  # pulses written at a time
PART = 64  # vectors resampled in frequency at a time
MOST_ROWS = 64  # vectors that tell the sign


@dataclass(frozen=True, kw_only=True, eq=False)
class ChannelEchoes:
    """Source of a channel's samples, and their processing.

    Attributes
    ----------
    collection : Collection
        Of all pulses.
    slow_time : VectorResampling or None
        None if times are uniform.
    area : ((x0, x1), (y0, y1)) or None
        Ground, m, of which no more is stored than it needs; None: all is.
    """

    file: CphdFile
    collection: Collection
    pulses: Pulses
    slow_time: VectorResampling | None
    resampler: Resampler
    delays: Delays
    area: Area | None = None

    @cached_property
    def cut(self) -> AreaCut | None:
        """Selection of the area's samples from all; None if everything is stored."""
        return None if self.area is None else plan_cut(self.collection, self.area, self.pulses.vector >= 0)

    @property
    def stored(self) -> Collection:
        """The collection that is stored."""
        return self.collection if self.cut is None else self.cut.collection

    def cut_without(self, missing: BoolArray) -> AreaCut | None:
        """Repeat `cut` with filters that leave out missing pulses (n_pulse,)."""
        if self.area is None or self.cut is None:
            return None
        again = plan_cut(self.collection, self.area, (self.pulses.vector >= 0) & ~missing)
        return replace(self.cut, pulses=again.pulses)


class SampleReader:
    """Reader of a channel's pulses that records which vectors hold no echo.

    Attributes
    ----------
    seen, empty, broken : (n_vector,) bool
        Vectors that were read; those of them whose samples are all zero; and those without a finite sample. At uneven
        times, where pulses are sums of vectors, those with any sample that is not finite, which count as zeros there.
    missing : (n_pulse,) bool
        Pulses that are given as missing, beside those that have no vector.
    """

    def __init__(self, echoes: ChannelEchoes, stream: BinaryIO, notes: BoolArray) -> None:
        self._echoes, self._stream = echoes, stream
        self.seen, self.empty, self.broken = notes
        self.missing = np.zeros(echoes.pulses.vector.size, np.bool_)
        self._some: dict[int, ComplexArray] = {}  # vectors that tell the sign, delays after the SRP

    def read(self, pulses: slice) -> ComplexArray:
        """Read pulses at the store's frequencies, (n, n_frequency); NaN where pulses are missing."""
        echoes, vector = self._echoes, self._echoes.pulses.vector
        slow_time = echoes.slow_time
        if slow_time is None:
            shape = pulses.stop - pulses.start, echoes.resampler.frequency.size
            block = np.full(shape, complex(np.nan, np.nan), np.complex64)
            lit = np.flatnonzero(vector[pulses] >= 0)
            block[lit] = self._read_in_parts(vector[pulses][lit])
        else:
            inputs = slow_time.resampling.inputs(pulses)
            cycles = 2 / SPEED_OF_LIGHT * echoes.resampler.frequency * slow_time.range_shift[inputs, None]
            used = slow_time.vector[inputs]
            rows = self._read_in_parts(used)
            rows[self.broken[used]] = 0
            block = slow_time.resampling.apply((rows * phasor(cycles)).astype(np.complex64), pulses)
        block[self.missing[pulses]] = np.nan
        return block

    def stored(self, cut: AreaCut | None, pulses: slice) -> ComplexArray:
        """Read pulses of the cut area, as they are stored."""
        read = self.read if cut is None else cut.reader(self.read, self._echoes.resampler.frequency)
        with reading_file(self._echoes.file.path):
            return read(pulses)

    def _read_in_parts(self, vectors: IntArray) -> ComplexArray:
        out = np.empty((vectors.size, self._echoes.resampler.frequency.size), np.complex64)
        for start in range(0, vectors.size, PART):
            out[start : start + PART] = self._read_vectors(vectors[start : start + PART])
        self.seen[vectors] = True
        self.empty[vectors] = ~out.any(axis=1)
        finite = np.isfinite(out)
        self.broken[vectors] = ~(finite.any(axis=1) if self._echoes.slow_time is None else finite.all(axis=1))
        return out

    def _read_vectors(self, rows: IntArray) -> ComplexArray:
        """Read ascending vectors: (rows.size, width), scaled, with sign and reference of the store."""
        file, resampler = self._echoes.file, self._echoes.resampler
        read = file.read(self._stream, int(rows[0]), int(rows[-1]) + 1, resampler.samples)[rows - rows[0]]
        if file.scaled:
            read *= file.parameter("AmpSF", rows).astype(np.float32)[:, None]
        if file.sign > 0:
            np.conjugate(read, out=read)
        out = resampler.apply(read, rows)
        self._some |= {int(rows[k]): out[k].copy() for k in np.flatnonzero(self._tells_sign(rows))}
        middle = self._echoes.delays.middle[rows]
        if not middle.any():
            return out
        return (out * phasor(resampler.frequency_of(rows) * middle[:, None])).astype(np.complex64)

    def _tells_sign(self, vectors: IntArray) -> BoolArray:
        """Mask of the vectors that are examined for the sign."""
        return np.asarray(vectors % -(-self._echoes.file.shape[0] // MOST_ROWS) == 0)

    def lost(self) -> tuple[BoolArray, list[Lost]]:
        """Mask of pulses that are missing judging by their samples, and the lost vectors by reason."""
        echoes, vector = self._echoes, self._echoes.pulses.vector
        known = (vector >= 0) & self.seen[vector]
        empty = known & self.empty[vector]
        zeros = missing_pulses(empty, known, echoes.collection, lambda pulse: self.read(slice(pulse, pulse + 1))[0])
        vectors = np.zeros(self.empty.shape, np.bool_)
        vectors[vector[zeros]] = True
        reasons = [Lost(ZEROS, vectors), Lost(NOT_FINITE, self.broken)]
        if echoes.slow_time is None:
            return zeros | (known & self.broken[vector]), reasons
        resampling = echoes.slow_time.resampling
        taps = resampling.first[:, None] + np.arange(resampling.weights.shape[1])
        gone = (vectors | self.broken)[echoes.slow_time.vector][taps]
        return np.sqrt((resampling.weights**2 * gone).sum(axis=1)) > MOST_ERROR, reasons

    def sign(self) -> WindowEnergy | None:
        """Energy of the vectors read so far by window; None in the domain TOA, whose delays have no sign."""
        file = self._echoes.file
        rows = np.flatnonzero(self.seen & self._tells_sign(np.arange(file.shape[0])))
        if file.domain == "TOA" or not rows.size:
            return None
        for row in set(rows.tolist()) - self._some.keys():  # read by an ingestion that ended early
            self._read_vectors(np.array([row]))
        near, far = (SPEED_OF_LIGHT / 2 * file.parameter(name, rows) for name in ("TOA1", "TOA2"))
        signal = np.stack([self._some[row] for row in rows.tolist()])
        step = self._echoes.collection.range_frequency_step
        return energy_in_window(signal, frequency_step=step, near=near, far=far)


@dataclass(kw_only=True, eq=False)
class ChannelFindings:
    """Findings in the samples of a channel, once all are written."""

    lost: list[Lost]
    missing: int  # pulses
    sign: WindowEnergy | None  # see `describe_sign`


def notes_of(echoes: ChannelEchoes) -> BoolArray:
    """Make the empty records of a `SampleReader` on vectors: seen, empty and broken ones."""
    return np.zeros((3, echoes.file.shape[0]), np.bool_)


def read_samples(
    channels: Sequence[ChannelEchoes], notes: Sequence[BoolArray], found: list[ChannelFindings]
) -> Iterator[Piece]:
    """Read the samples of channels by blocks of pulses; lost pulses are missing.

    Blocks that change with what is known of lost pulses at the end are given again. Notes, an array a channel, are
    filled in place. What is found is added to a list.
    """
    stored = channels[0].stored
    blocks = [slice(first, min(first + ROWS, stored.n_pulse)) for first in range(0, stored.n_pulse, ROWS)]
    for number, echoes in enumerate(channels):
        with echoes.file.path.open() as stream:
            reader = SampleReader(echoes, stream, notes[number])
            for pulses in blocks:
                yield Piece(number, pulses, partial(reader.stored, echoes.cut, pulses))
            with reading_file(echoes.file.path):
                reader.missing, lost = reader.lost()
            there = echoes.pulses.vector >= 0
            refuse_few(
                int(np.count_nonzero(there & ~reader.missing)), int(np.count_nonzero(there)),
                f"vectors are lost: {describe_lost(lost, echoes.file.first_vector)}",
                "take a part that has echoes with --pulses",
            )  # fmt: skip
            if reader.missing.any():
                cut = echoes.cut_without(reader.missing)
                affected = _affected(reader.missing, cut)
                for pulses in blocks:
                    if affected[pulses].any():
                        yield Piece(number, pulses, partial(reader.stored, cut, pulses))
            missing = int(np.count_nonzero(reader.missing & (echoes.pulses.vector >= 0)))
            with reading_file(echoes.file.path):
                found.append(ChannelFindings(lost=lost, missing=missing, sign=reader.sign()))


def _affected(missing: BoolArray, cut: AreaCut | None) -> BoolArray:
    """Mask of the stored pulses that change if pulses (n_pulse,) are missing."""
    if cut is None:
        return missing
    sums = cut.pulses.part(cut.kept[0])
    taps = cut.first + sums.first[:, None] + np.arange(sums.weights.shape[1])
    return np.asarray(missing[taps].any(axis=1))
