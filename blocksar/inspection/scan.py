"""Compiled loops of the pass over the samples: levels, suspect columns, and sums over pulse pairs.

A row of samples is read from memory once, and stays in the cache for everything that is done with it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, types

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.constants import TURN
from blocksar.kernels.lanes import LANES, load_imag, load_real, store
from blocksar.kernels.loops import COMPILED, FLOATS_IN, PART, SAMPLES_IN, loop
from blocksar.kernels.phase import Float32Array

STANDS_OUT = 100.0  # an impossible sample over its neighbours, and over its column's median
BEYOND_ALL = 1e8  # an impossible sample over its column's median, whatever its neighbours

_BITS = types.Array(types.int32, 2, "C", readonly=True)
_REALS = types.float64[::1]
_LARGEST = np.float32(np.finfo(np.float32).max)
_SIGNLESS = np.int32(0x7FFFFFFF)
_LONE, _ALL = np.float32(STANDS_OUT), np.float32(BEYOND_ALL)


@njit(**PART, nogil=True)
def _moduli(row: Float32Array, modulus: Float32Array) -> None:
    """Store the modulus of the larger part of each sample; -1 if a part is not finite."""
    for c in range(modulus.size):
        a, b = abs(row[2 * c]), abs(row[2 * c + 1])
        larger = a if a > b else b
        modulus[c] = larger if (a <= _LARGEST) & (b <= _LARGEST) else np.float32(-1)


@njit(**PART, nogil=True)
def _extent(bits: Any) -> tuple[Any, int, int]:
    """The largest of a row of moduli, the number above zero and the number below zero.

    The moduli come as the integers of their bits, which have the same order and are compared a vector at a time.
    """
    largest, valid, missing = np.int32(0), 0, 0
    for c in range(bits.size):
        largest = max(largest, bits[c])
        valid += bits[c] > 0
        missing += bits[c] < 0
    return largest, valid, missing


@njit(**PART, nogil=True)
def _count(bits: Any, modulus: int) -> tuple[int, int]:
    """Count the real and the imaginary parts of a row that have this modulus; both as the integers of their bits."""
    real, imag = 0, 0
    for c in range(bits.size // 2):
        real += (bits[2 * c] & _SIGNLESS) == modulus
        imag += (bits[2 * c + 1] & _SIGNLESS) == modulus
    return real, imag


@njit(inline="always")
def _is_suspect(m: Any, before: Any, after: Any) -> Any:
    """Tell whether a modulus exceeds the largest of its neighbours before and after it by far."""
    larger, smaller = max(before, after), min(before, after)
    return ((m > _LONE * larger) & (m > 0)) | ((smaller > 0) & (m > _ALL * smaller))


@njit(**PART, nogil=True)
def _mark_suspects(moduli: Float32Array, p: int, suspect: BoolArray) -> None:
    """Mark the columns in which pulse p stands out; pulse q is row q % 5."""
    a, b, m, d, e = moduli[(p - 2) % 5], moduli[(p - 1) % 5], moduli[p % 5], moduli[(p + 1) % 5], moduli[(p + 2) % 5]
    count = 0
    for c in range(m.size):
        count += _is_suspect(m[c], max(a[c], b[c]), max(d[c], e[c]))
    if count:
        for c in range(m.size):
            suspect[c] |= _is_suspect(m[c], max(a[c], b[c]), max(d[c], e[c]))


@loop(
    FLOATS_IN, _BITS, types.float32[:, ::1], _BITS, types.int64, types.int64, types.int64[::1], types.boolean[::1],
    nogil=True,
)  # fmt: skip
def scan_pulses(
    parts: Float32Array, part_bits: Any, moduli: Float32Array, bits: Any, first: int, last: int, missing: IntArray,
    suspect: BoolArray,
) -> tuple[int, int, int, int]:  # fmt: skip
    """Scan pulses first .. last - 1 for missing samples, suspect columns and the extreme level.

    `parts` (n_pulse, 2 n_column) has real and imaginary parts side by side; `moduli` (5, n_column) is room; of both the
    bits are given as int32 too. Writes the number of missing samples of each pulse to `missing` (n_pulse,), and marks
    suspect columns in `suspect` (n_column,).

    Returns
    -------
    tuple of int
        Number of valid samples that are not zero, bits of the extreme modulus of a part, and the numbers of real and
        of imaginary parts with that modulus.
    """
    n_pulse, n_column = parts.shape[0], parts.shape[1] // 2
    valid, extreme, real, imag = 0, 0, 0, 0
    for ahead in range(first - 2, last + 2):
        if 0 <= ahead < n_pulse:
            _moduli(parts[ahead], moduli[ahead % 5])
        else:
            for c in range(n_column):
                moduli[ahead % 5, c] = 0
        p = ahead - 2
        if p < first:
            continue
        _mark_suspects(moduli, p, suspect)
        largest, count, missing[p] = _extent(bits[p % 5])
        valid += count
        if largest > extreme:
            extreme, real, imag = largest, 0, 0
        if largest == extreme and count:
            more_real, more_imag = _count(part_bits[p], extreme)
            real, imag = real + more_real, imag + more_imag
    return valid, extreme, real, imag


@njit(inline="always")
def _conjugate_product(a: Any, b: Any, i: Any, scale: Any) -> Any:
    """Real and imaginary part of conj(a) b, and the energy of a, for LANES samples from i on, times `scale`."""
    ar, ai, br, bi = load_real(a, i) * scale, load_imag(a, i) * scale, load_real(b, i) * scale, load_imag(b, i) * scale
    return ar * br + ai * bi, ar * bi - ai * br, ar * ar + ai * ai


@loop(SAMPLES_IN, types.float32, types.int64, types.int64, _REALS, _REALS, _REALS, **COMPILED)
def sum_pairs(
    signal: ComplexArray,
    scale: np.float32,
    first: int,
    last: int,
    advance: FloatArray,
    factor: FloatArray,
    out: FloatArray,
) -> None:
    """Add sum_pc conj(s[p, c]) s[p + 1, c] exp(-2j pi (factor[0] + c factor[1]) advance[p]) and the energy to `out`.

    s = scale signal, first <= p < last. The phase is linear along a row, so the sum is a polynomial in the phasor of
    one step, evaluated by Horner's rule, LANES columns at a time.
    """
    n_pulse, n_column = signal.shape
    whole = n_column - n_column % LANES
    rest, rest_next = np.empty(LANES, np.complex64), np.empty(LANES, np.complex64)
    for k in range(LANES):
        rest[k], rest_next[k] = 0.0, 0.0
    reals, imags, energies = np.empty(LANES, np.float32), np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    for p in range(first, last):
        paired = p + 1 < n_pulse
        row, after = signal[p], signal[p + 1 if paired else p]
        cycles, step = (advance[p] * factor[0], advance[p] * factor[1]) if paired else (0.0, 0.0)
        turn = -TURN * LANES * step
        wr, wi = np.float32(np.cos(turn)), np.float32(np.sin(turn))
        for c in range(whole, n_column):
            rest[c - whole], rest_next[c - whole] = row[c], after[c]
        real, imag, energy = _conjugate_product(rest, rest_next, 0, scale)
        for k in range(whole // LANES):
            pr, pi, more = _conjugate_product(row, after, whole - LANES * (k + 1), scale)
            real, imag = real * wr - imag * wi + pr, real * wi + imag * wr + pi
            energy = energy + more
        store(reals, 0, real)
        store(imags, 0, imag)
        store(energies, 0, energy)
        total_real, total_imag, phase, by = 0.0, 0.0, -TURN * (cycles - np.rint(cycles)), -TURN * step
        for k in range(LANES):
            cos, sin = np.cos(phase + k * by), np.sin(phase + k * by)
            total_real += cos * reals[k] - sin * imags[k]
            total_imag += cos * imags[k] + sin * reals[k]
            out[2] += energies[k]
        if paired:
            out[0] += total_real
            out[1] += total_imag
