"""Range profiles, and deramped lines interpolated from them at exact ranges."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import types

from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.collection.collection import Collection
from blocksar.kernels.fourier import fast_length, fft_rows
from blocksar.kernels.groups import row_groups, run_groups
from blocksar.kernels.interpolation import interpolation_taps
from blocksar.kernels.loops import COMPILED, REAL_ROW, REAL_ROWS, SAMPLES_IN, loop, record
from blocksar.kernels.phase import Float32Array

UPSAMPLING = 2  # bins per range cell, at least
N_TAP = 6  # with it, errors are below -60 dB
N_PHASE = 256  # fractions of a bin at which the taps are tabulated


@dataclass(frozen=True, kw_only=True, eq=False)
class RangeProfiles:
    """Mean over frequency of signal exp(4j pi (f - f_middle) d / c), periodic in d = R - reference_range.

    Attributes
    ----------
    values : (n, n_bin) complex64
        Bin b is at d = b * spacing, modulo the range window. NaN samples count as zero.
    spacing : float
        m.
    """

    values: ComplexArray
    spacing: float


def range_profiles(signal: ComplexArray, collection: Collection, threads: int = 1) -> RangeProfiles:
    """Form range profiles of samples (n, n_range_frequency)."""
    n = collection.n_range_frequency
    period, middle = fast_length(UPSAMPLING * n), n // 2
    values = np.zeros((signal.shape[0], period), np.complex64)

    def work(rows: slice) -> None:
        samples = np.nan_to_num(signal[rows]) * np.float32(period / n)
        group = np.zeros((samples.shape[0], period), np.complex64)
        group[:, : n - middle], group[:, period - middle :] = samples[:, middle:], samples[:, :middle]
        values[rows] = fft_rows(group, inverse=True)

    run_groups(work, row_groups(0, signal.shape[0], period), threads)
    return RangeProfiles(values=values, spacing=collection.range_window / period)


class DecimatingFilter(NamedTuple):
    """A low pass along pulses: pulse p counts in sample m with taps[p + ahead - factor m].

    Attributes
    ----------
    taps : (n,) float
        Read-only, see `kernels.loops.fixed`.
    factor, ahead : int
    """

    taps: FloatArray
    factor: int
    ahead: int


@lru_cache(maxsize=1)
def taps() -> Float32Array:
    """Interpolation weights by fraction of a bin, (N_PHASE + 1, N_TAP)."""
    return interpolation_taps(N_TAP, occupancy=1 / UPSAMPLING, n_phase=N_PHASE)


@loop(
    *(SAMPLES_IN, REAL_ROWS, REAL_ROWS, types.Array(types.float32, 2, "C", readonly=True)),
    types.complex64[:, ::1],
    **COMPILED,
)
def take_lines(
    values: ComplexArray, bins: FloatArray, cycles: FloatArray, weights: Float32Array, out: ComplexArray
) -> None:
    """Interpolate deramped lines: out[r, p] = profile of pulse p at bins[r, p], turned by cycles[r, p].

    values (n_pulse, n_bin) complex64, periodic along bins; bins, cycles, out (n_row, n_pulse).
    """
    n_bin, n_tap, n_phase = values.shape[1], weights.shape[1], weights.shape[0] - 1
    for p in range(values.shape[0]):
        for r in range(bins.shape[0]):
            whole = math.floor(bins[r, p])
            fraction = int((bins[r, p] - whole) * n_phase + 0.5)
            first = int(whole) - (n_tap // 2 - 1)
            total = np.complex64(0)
            for k in range(n_tap):
                total += weights[fraction, k] * values[p, (first + k) % n_bin]
            turn = 2 * math.pi * (cycles[r, p] - math.floor(cycles[r, p] + 0.5))
            out[r, p] = total * np.complex64(complex(math.cos(turn), math.sin(turn)))


@loop(
    *(SAMPLES_IN, REAL_ROWS, REAL_ROWS, types.Array(types.int64, 2, "C", readonly=True)),
    *(types.Array(types.float32, 2, "C", readonly=True), types.float64),
    *(record(DecimatingFilter, REAL_ROW, types.int64, types.int64), types.complex64[:, :, ::1]),
    **COMPILED,
)
def take_chips(
    values: ComplexArray,
    bins: FloatArray,
    cycles: FloatArray,
    lit: IntArray,
    weights: Float32Array,
    line_bins: float,
    decimating: DecimatingFilter,
    out: ComplexArray,
) -> None:
    """Add to out[i, m, l] the low-passed, decimated lines l about each point i.

    values (n_pulse, n_bin); bins, cycles (n_point, n_pulse) of the points; lit (n_point, 2): first and last of these
    pulses; line_bins: bins between lines; out (n_point, n_sample, n_line).
    """
    low_pass, decimation, ahead = decimating
    n_bin, n_tap, n_phase = values.shape[1], weights.shape[1], weights.shape[0] - 1
    n_line, n_filter = out.shape[2], low_pass.size
    for i in range(bins.shape[0]):
        for p in range(lit[i, 0], lit[i, 1]):
            turn = 2 * math.pi * (cycles[i, p] - math.floor(cycles[i, p] + 0.5))
            rotation = np.complex64(complex(math.cos(turn), math.sin(turn)))
            latest = (p + ahead) // decimation
            earliest = max((p + ahead - n_filter) // decimation + 1, 0)
            for line in range(n_line):
                at = bins[i, p] + (line - n_line // 2) * line_bins
                whole = math.floor(at)
                fraction = int((at - whole) * n_phase + 0.5)
                first = int(whole) - (n_tap // 2 - 1)
                total = np.complex64(0)
                for k in range(n_tap):
                    total += weights[fraction, k] * values[p, (first + k) % n_bin]
                total *= rotation
                for m in range(earliest, min(latest, out.shape[1] - 1) + 1):
                    out[i, m, line] += np.float32(low_pass[p + ahead - decimation * m]) * total


@loop(
    *(types.Array(types.complex64, 3, "C", readonly=True), *(types.Array(types.int64, 1, "C", readonly=True),) * 2),
    *(types.Array(types.float32, 1, "C", readonly=True), types.int64, types.complex64[:, :, ::1]),
    **COMPILED,
)
def decimate(
    values: ComplexArray, begin: IntArray, count: IntArray, low_pass: Float32Array, factor: int, out: ComplexArray
) -> None:
    """Low-pass and decimate: out[i, l, m] = sum_k low_pass[k] values[i, l, begin[i] + factor m + k], m < count[i]."""
    n = values.shape[2]
    for i in range(values.shape[0]):
        for line in range(values.shape[1]):
            row = values[i, line]
            for m in range(count[i]):
                first, total = begin[i] + factor * m, np.complex64(0)
                for k in range(max(-first, 0), min(low_pass.size, n - first)):
                    total += low_pass[k] * row[first + k]
                out[i, line, m] = total
