"""Range compression of a raw echo, in groups of pulses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.raw_echo import RawEcho
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.kernels import fourier, rows
from blocksar.kernels.chirp import chirp_spectrum
from blocksar.kernels.fourier import Axis

COMPRESSED_ROWS = 32  # pulses with spectra in memory at a time, in double precision too


@dataclass(frozen=True, kw_only=True, eq=False)
class RawCompression:
    """Range compression of a raw echo to the range-frequency signal (second factor of paper A (7)).

    The echo is padded with zeros to the transform that has the steps of the range frequencies, see `RawEcho`. The
    signal is divided by the chirp's own spectrum with its ripples, where (7) uses the stationary phase
    exp(-j pi f^2 / K): a unit target's signal then has modulus 1 at every frequency of the band.

    Attributes
    ----------
    fast_time : Axis
        s, two-way delay.
    length : int
        Samples N of the transform.
    weight : (n_range_frequency,) complex
        Sampling interval over the chirp's spectrum.
    range_frequency : (n_range_frequency,) float
        Hz.
    reference_range : (n_pulse,) float
        m; its phase is removed over the band, as it is on the carrier.
    """

    fast_time: Axis
    length: int
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
        """Mean squared noise of samples of the signal, over that of a sample of the echo: (n_range_frequency,).

        As if all N samples of the transform had noise: a pixel sums neighbouring frequencies, whose noise is not
        independent where only n of N have, so that as much of it comes from the delays that were recorded.
        """
        return np.asarray(self.length * np.abs(self.weight) ** 2)

    def apply(self, echo: ComplexArray, *, pulses: slice, threads: int = 1) -> ComplexArray:
        """Compress pulses (n, n_fast_time) to (n, n_range_frequency) complex64; a pulse with a NaN comes out NaN."""
        step = 1 / (self.length * self.fast_time.step)
        axis = Axis(float(self.range_frequency[0]), step, self.range_frequency.size)
        reference_range = self.reference_range[pulses, None]
        out = np.empty((echo.shape[0], self.range_frequency.size), np.complex64)
        for first in range(0, echo.shape[0], COMPRESSED_ROWS):
            part = slice(first, first + COMPRESSED_ROWS)
            band = rows.transform(echo[part], self.fast_time, axis, inverse=False, threads=threads)
            cycles = 2 / SPEED_OF_LIGHT * reference_range[part] * self.range_frequency
            out[part] = band * self.weight * fourier.unit_phasor(cycles)
        return out
