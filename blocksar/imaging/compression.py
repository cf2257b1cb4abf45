"""Range compression of a raw echo."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import BoolArray, ComplexArray, FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.raw_echo import RawEcho
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.imaging.recorded_pulses import LEAST_SHARE
from blocksar.kernels import fourier, rows
from blocksar.kernels.fourier import Axis, chirp_spectrum

COMPRESSED_ROWS = 32  # pulses with spectra in memory at a time, in double precision too
GAPPED_ROWS = 4  # pulses with gaps that are transformed to delay at a time


@dataclass(frozen=True, kw_only=True, eq=False)
class RawCompression:
    """Range compression of a raw echo to the range-frequency signal (second factor of paper A (7)).

    The echo is padded with zeros to the transform that has the steps of the range frequencies, see `RawEcho`. The
    signal is divided by the chirp's own spectrum with its ripples, where (7) uses the stationary phase
    exp(-j pi f^2 / K): a unit target's signal then has modulus 1 at every frequency of the band.

    Gaps in a pulse (NaN), as of transmit events between a pulse and its echo, are taken as zeros, and divided out. The
    compressed value at the delay tau of a target is the correlation of what was recorded with the chirp, of which a
    sample adds as much as any other, as the chirp's envelope is 1. A target is therefore too low by

        q(tau) = samples recorded within tau +- T / 2 / samples of the window within tau +- T / 2,

    and the signal, transformed to delay, is divided by it, but by no less than LEAST_SHARE. Ends of the window are in
    neither count: see `collection.raw_echo`. A gap is a notch in the target's band, whose place moves with its delay:
    under a taper q is right for the mean over pulses in which short gaps are elsewhere in the chirp; gaps as long as
    the pulse leave ends of the band, which a taper lowers (0.87 under Hann, where 1 would be right).

    Attributes
    ----------
    fast_time : Axis
        s, two-way delay.
    length : int
        Samples N of the transform.
    pulse_width : float
        T, s.
    weight : (n_range_frequency,) complex
        Sampling interval over the chirp's spectrum.
    range_frequency : (n_range_frequency,) float
        Hz.
    reference_range : (n_pulse,) float
        m; its phase is removed over the band, as it is on the carrier.
    """

    fast_time: Axis
    length: int
    pulse_width: float
    weight: NDArray[np.complex128]
    range_frequency: FloatArray
    reference_range: FloatArray

    @classmethod
    def of(
        cls,
        *,
        fast_time: FloatArray,
        chirp_rate: float,
        pulse_width: float,
        range_frequency: FloatArray,
        reference_range: FloatArray,
    ) -> Self:
        """Bind to an echo's axes; the sampling rate must be a whole multiple of the step of range_frequency."""
        step = float((fast_time[-1] - fast_time[0]) / (fast_time.size - 1))
        length = round((range_frequency.size - 1) / (float(range_frequency[-1] - range_frequency[0]) * step))
        return cls(
            fast_time=Axis(float(fast_time[0]), step, fast_time.size),
            length=length,
            pulse_width=pulse_width,
            weight=step / chirp_spectrum(range_frequency, chirp_rate=chirp_rate, pulse_width=pulse_width),
            range_frequency=range_frequency,
            reference_range=reference_range,
        )

    @classmethod
    def of_echo(cls, raw: RawEcho, collection: Collection) -> Self:
        """The compression of a collection's raw echo."""
        return cls.of(
            fast_time=raw.fast_time, chirp_rate=raw.chirp_rate, pulse_width=raw.pulse_width,
            range_frequency=collection.range_frequency, reference_range=collection.reference_range,
        )  # fmt: skip

    @property
    def noise_spectrum(self) -> FloatArray:
        """Noise power of the signal relative to that of an echo's sample, by frequency: (n_range_frequency,).

        As if all N samples of the transform had noise: a pixel sums neighbouring frequencies, whose noise is not
        independent where only n of N have, so that as much of it comes from the delays that were recorded.
        """
        return np.asarray(self.length * np.abs(self.weight) ** 2)

    def cycles(self, pulses: slice) -> tuple[FloatArray, FloatArray]:
        """Delays (n,), s, and range frequencies, Hz, whose product is the phase shift of these pulses, cycles."""
        return 2 / SPEED_OF_LIGHT * self.reference_range[pulses], self.range_frequency

    def apply(self, echo: ComplexArray, *, pulses: slice, threads: int = 1) -> ComplexArray:
        """Compress pulses (n, n_fast_time), NaN in gaps, to (n, n_range_frequency) complex64; NaN where all was NaN."""
        step = 1 / (self.length * self.fast_time.step)
        axis = Axis(float(self.range_frequency[0]), step, self.range_frequency.size)
        delay, frequency = self.cycles(pulses)
        out = np.empty((echo.shape[0], self.range_frequency.size), np.complex64)
        for first in range(0, echo.shape[0], COMPRESSED_ROWS):
            part = slice(first, first + COMPRESSED_ROWS)
            samples, gaps = echo[part], ~np.isfinite(echo[part])
            lost, gapped = gaps.all(axis=1), np.flatnonzero(gaps.any(axis=1) & ~gaps.all(axis=1))
            if lost.any() or gapped.size:
                samples = np.where(gaps, np.complex64(0), samples)
            band = rows.transform(samples, self.fast_time, axis, inverse=False, threads=threads) * self.weight
            for some in np.split(gapped, range(GAPPED_ROWS, gapped.size, GAPPED_ROWS)) if gapped.size else ():
                band[some] = self._over_recorded(band[some], gaps[some])
            out[part] = band * fourier.unit_phasor(delay[part, None] * frequency)
            out[part][lost] = np.nan
        return out

    def _over_recorded(self, band: NDArray[np.complex128], gaps: BoolArray) -> NDArray[np.complex128]:
        """Divide pulses (n, n_range_frequency) with gaps (n, n_fast_time) by their recorded parts at all N delays."""
        turn = fourier.unit_phasor(self.range_frequency * self.fast_time.start)  # delays count from the window's start
        delays = np.zeros((len(band), self.length), np.complex128)
        delays[:, : band.shape[1]] = band * turn
        delays = fourier.fft_rows(delays, inverse=True)
        delays /= np.maximum(self.recorded_parts(gaps), LEAST_SHARE)
        return np.asarray(fourier.fft_rows(delays, inverse=False)[:, : band.shape[1]] * turn.conj())

    def recorded_parts(self, gaps: BoolArray) -> FloatArray:
        """Recorded part q of pulses with gaps (n, n_fast_time) at N delays: (n, N); 1 off all gaps."""
        half = self.pulse_width / self.fast_time.step / 2
        room = int(np.ceil(half)) + 1
        beyond = ((0, 0), (0, self.length - self.fast_time.size))
        held = np.concatenate([np.ones((1, self.fast_time.size)), ~gaps])
        held = np.pad(np.pad(held, beyond), ((0, 0), (room, room)), mode="wrap")  # as the transform does
        sums = np.pad(np.cumsum(held, axis=1), ((0, 0), (1, 0)))

        def up_to(end: float) -> FloatArray:
            first = int(np.floor(room + 0.5 + end))
            share = room + 0.5 + end - first
            found = (sums[:, at : at + self.length] for at in (first, first + 1))
            return np.asarray((1 - share) * next(found) + share * next(found))

        window, *parts = up_to(half) - up_to(-half)
        return np.asarray(np.where(window > 0.5, np.array(parts) / np.maximum(window, 0.5), 1.0))
