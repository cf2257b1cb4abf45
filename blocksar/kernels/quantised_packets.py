"""Decoding of block-quantised packets, compiled: bypass, BAQ and FDBAQ of Sentinel-1.

A packet holds four channels one after another: in-phase even, in-phase odd, quadrature even, quadrature odd samples,
each filled up to 16 bits and cut into blocks. Every sample is a sign and a magnitude code. All compressions are one
decoder over a table of prefix codes: those of bypass and BAQ have a fixed length, those of FDBAQ are Huffman codes,
of which the first channel names one for each block (3 bits). The third channel has a threshold for each block (8 bits),
which with the kind of code gives the amplitudes of the magnitudes.

Codes and amplitudes are those of "Sentinel-1 SAR Space Packet Protocol Data Unit" (S1-IF-ASD-PL-0007), sections 4 and
5.2; the numbers of the tables were compared with those of s1isp (Apache-2.0).
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numba import njit, types

from blocksar.arrays import IntArray
from blocksar.kernels.loops import PART, UNCHECKED, UNCONTRACTED, loop
from blocksar.kernels.phase import Float32Array

BYPASS, BAQ, FDBAQ = 0, 1, 4  # first kinds of code: bypass, BAQ of 3, 4 and 5 bits, FDBAQ of 5 bit rates
KINDS, MAGNITUDES = 9, 16  # kinds of code, and most magnitudes of a compressed one
WINDOW = 10  # bits of the longest code, with its sign
PADDING = 8  # bytes that a packet's data have to be followed by, since codes are looked up ahead
WRONG_CODE, CUT = -1, -2  # instead of the bits that a packet takes

# Simple reconstruction: the largest amplitude at small thresholds, at which all others are the magnitude itself.
LARGEST = (
    (3.0, 3.0, 3.12, 3.55),
    (7.0, 7.0, 7.0, 7.17, 7.40, 7.76),
    (15.0, 15.0, 15.0, 15.0, 15.0, 15.0, 15.44, 15.56, 16.11, 16.38, 16.65),
    (3.0, 3.0, 3.16, 3.53),
    (4.0, 4.0, 4.08, 4.37),
    (6.0, 6.0, 6.0, 6.15, 6.50, 6.88),
    (9.0, 9.0, 9.0, 9.0, 9.36, 9.50, 10.1),
    (15.0, 15.0, 15.0, 15.0, 15.0, 15.0, 15.22, 15.50, 16.05),
)
# Normal reconstruction: amplitudes over the standard deviation.
NORMALISED = (
    (0.2490, 0.7681, 1.3655, 2.1864),
    (0.1290, 0.3900, 0.6601, 0.9471, 1.2623, 1.6261, 2.0793, 2.7467),
    (0.0660, 0.1985, 0.3320, 0.4677, 0.6061, 0.7487, 0.8964, 1.0510, 1.2143, 1.3896, 1.5800, 1.7914, 2.0329, 2.3234,
     2.6971, 3.2692),
    (0.3637, 1.0915, 1.8208, 2.6406),
    (0.3042, 0.9127, 1.5216, 2.1313, 2.8426),
    (0.2305, 0.6916, 1.1528, 1.6140, 2.0754, 2.5369, 3.1191),
    (0.1702, 0.5107, 0.8511, 1.1916, 1.5321, 1.8726, 2.2131, 2.5536, 2.8942, 3.3744),
    (0.1130, 0.3389, 0.5649, 0.7908, 1.0167, 1.2428, 1.4687, 1.6947, 1.9206, 2.1466, 2.3725, 2.5985, 2.8244, 3.0504,
     3.2764, 3.6623),
)  # fmt: skip
HUFFMAN = (
    ("0", "10", "110", "111"),
    ("0", "10", "110", "1110", "1111"),
    ("0", "10", "110", "1110", "11110", "111110", "111111"),
    ("00", "01", "10", "110", "1110", "11110", "111110", "1111110", "11111110", "11111111"),
    ("00", "010", "011", "100", "101", "1100", "1101", "1110", "11110", "111110", "11111100", "11111101", "111111100",
     "111111101", "111111110", "111111111"),
)  # fmt: skip


def deviations() -> Float32Array:
    """Standard deviations (256,) by threshold, rounded as in table 5.2-3: steps of sqrt(pi / 8), twice from 100 on."""
    index = np.arange(256)
    step = np.sqrt(np.pi / 8)
    coarse = 62.982 + 0.002 * (index < 137) + 2 * step * (index - 100)
    return np.minimum(np.round(np.where(index < 100, step * index, coarse), 2), 255.99).astype(np.float32)


@cache
def code_table() -> IntArray:
    """Code table (KINDS, 2**WINDOW): for a window of bits, 2**16 times the leading code's length plus its magnitude.

    The first bit of a code is its sign, which the magnitude leaves out.
    """
    table = np.zeros((KINDS, 1 << WINDOW), np.int64)
    for kind in range(KINDS):
        bits = (10, 3, 4, 5)[kind] if kind < FDBAQ else 0
        codes = HUFFMAN[kind - FDBAQ] if kind >= FDBAQ else tuple(f"{m:0{bits - 1}b}" for m in range(1 << (bits - 1)))
        for magnitude, code in enumerate(codes):
            rest = WINDOW - 1 - len(code)
            first = int(code, 2) << rest
            for sign in (0, 1 << (WINDOW - 1)):
                table[kind, sign + first : sign + first + (1 << rest)] = ((len(code) + 1) << 16) + magnitude
    table.flags.writeable = False
    return table


@cache
def amplitude_table() -> Float32Array:
    """Amplitudes (KINDS, 256, MAGNITUDES) of a magnitude at a threshold; for bypass, the magnitude itself."""
    table = np.zeros((KINDS, 256, MAGNITUDES), np.float32)
    for kind, (largest, normalised) in enumerate(zip(LARGEST, NORMALISED, strict=True), start=BAQ):
        n = len(normalised)
        table[kind, :, :n] = np.multiply.outer(deviations(), normalised)
        table[kind, : len(largest), :n] = np.arange(n)
        table[kind, : len(largest), n - 1] = largest
    table.flags.writeable = False
    return table


@njit(**PART, **UNCONTRACTED, **UNCHECKED)
def _window(data: Any, bit: int) -> int:
    """Read WINDOW bits from a position on."""
    byte = bit >> 3
    word = (int(data[byte]) << 16) | (int(data[byte + 1]) << 8) | int(data[byte + 2])
    return (word >> (24 - WINDOW - (bit & 7))) & ((1 << WINDOW) - 1)


@loop(
    types.Array(types.uint8, 1, "C", readonly=True), types.int64, types.int64, types.int64,
    types.Array(types.int64, 2, "C", readonly=True), types.Array(types.float32, 3, "C", readonly=True),
    types.int64[:, ::1], types.float32[::1], **UNCONTRACTED, **UNCHECKED,
)  # fmt: skip
def decode_packet(
    data: Any, size: int, kind: int, block: int, codes: Any, amplitudes: Any, marks: Any, parts: Any
) -> int:
    """Decode the samples of a packet; return the number of bits used, or WRONG_CODE or CUT.

    Parameters
    ----------
    data : (size + PADDING,) uint8
    size : int
        Bytes of the packet.
    kind : int
        BYPASS, BAQ + 0 .. 2 for 3 to 5 bits, or FDBAQ.
    block : int
        Samples of a channel in a block.
    codes, amplitudes : array
        From `code_table` and `amplitude_table`.
    marks : (2, n_block) int
        Written: kind of code and threshold of each block.
    parts : (4 n,) float32
        Written: real and imaginary parts of 2 n samples, n of each channel.
    """
    n = parts.size // 4
    end, bit = 8 * size, 0
    for channel in range(4):
        bit = (bit + 15) & ~15
        for b in range(marks.shape[1]):
            if channel == 0:
                marks[0, b], marks[1, b] = kind, 0
                if kind == FDBAQ:
                    if bit + 3 > end:
                        return CUT
                    marks[0, b] = FDBAQ + (_window(data, bit) >> (WINDOW - 3))
                    bit += 3
                    if marks[0, b] >= KINDS:
                        return WRONG_CODE
            if channel == 2 and kind != BYPASS:
                if bit + 8 > end:
                    return CUT
                marks[1, b] = _window(data, bit) >> (WINDOW - 8)
                bit += 8
            code = marks[0, b]
            for i in range(b * block, min((b + 1) * block, n)):
                if bit >= end:
                    return CUT
                window = _window(data, bit)
                entry = codes[code, window]
                bit += entry >> 16
                value = float(entry & 0xFFFF)
                if window >> (WINDOW - 1):
                    value = -value - 1e-3  # tells a negative zero
                # Even and odd samples alternate; each has its in-phase part before its quadrature.
                parts[4 * i + 2 * (channel & 1) + (channel >> 1)] = value
    if bit > end:
        return CUT
    if kind == BYPASS:
        for i in range(parts.size):
            parts[i] = np.float32(int(parts[i]))
        return bit
    for b in range(marks.shape[1]):
        code, threshold = marks[0, b], marks[1, b]
        for i in range(4 * b * block, min(4 * (b + 1) * block, parts.size)):
            value = parts[i]
            if value < 0:
                parts[i] = -amplitudes[code, threshold, int(-value)]
            else:
                parts[i] = amplitudes[code, threshold, int(value)]
    return bit
