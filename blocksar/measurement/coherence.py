"""Complex coherence, gain and phase between two images of the same pixels.

The errors of a chip also come from the power around it, which a comparison has to take into account.

A processor spreads an error of the power 2 (1 - g) of each target about its place, with g the coherence that is
predicted for clutter of even power. Where the ground about a chip is brighter, its error is larger than that of the
chip's own echoes. How an error is spread is not known; but if it falls with the distance along x and along y, its power
over distance is a mixture of boxes about the target. So the error of a pixel is 2 (1 - g) times at most the largest
mean power M of any box about it, and the error of a chip of mean power P relative to that is the one that is predicted

    1 / c^2 - 1 <= (1 / g^2 - 1) reach / P,    reach = mean of M over the chip, at least P,

with c the coherence of the chip, whose error does not depend on its echoes. `referred` solves this for g.

Images may also differ by what no sample shows of a track's error: a shift, and a ramp of the phase.

A constant error along the line of sight moves the image; a line over time turns it about the antenna, which moves it
and ramps its phase along azimuth. Neither blurs. What is left after both are taken out is what images really differ by.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterable, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from blocksar.arrays import Complex128Array, ComplexArray, FloatArray
from blocksar.kernels.fourier import fast_length, fft_rows

CELL = 8  # pixels along the side of the cells whose powers are averaged
SIDES = (3, 7, 15, 31, 63)  # cells along the sides of boxes: the least are wide enough for speckle to even out


def power_within_reach(power: FloatArray, rows: slice, columns: slice) -> float:
    """Mean over a chip of the highest mean power in any box around each pixel: the power whose side lobes reach it.

    Parameters
    ----------
    power : (n_y, n_x) float
        |pixels|^2 of a chip and its surroundings; NaN where not covered.
    rows, columns : slice
        The chip among them.
    """
    covered = np.isfinite(power)
    filled, share = _cells(np.where(covered, power, 0.0)), _cells(covered.astype(np.float64))
    largest = np.zeros(filled.shape)
    for sides in product(SIDES, SIDES):
        weight = _boxes(share, sides)
        np.maximum(largest, _boxes(filled, sides) / np.maximum(weight, 1e-12), out=largest, where=weight > 1e-12)
    chip = (slice(span.start // CELL, -(-span.stop // CELL)) for span in (rows, columns))
    return float(largest[tuple(chip)].mean())


def referred(coherence: float, ratio: float) -> float:
    """Scale the coherence of a chip to the power around it, `ratio` times its own, which side lobes come from.

    Examples
    --------
    >>> round(referred(0.98, 30.0), 5), referred(0.9993, 1.0)
    (0.99931, 0.9993)
    """
    ratio = max(ratio, 1.0)
    return 1 / math.sqrt(1 + (1 / coherence**2 - 1) / ratio) if coherence > 0 and ratio > 1 else coherence


def _cells(values: FloatArray) -> FloatArray:
    """Sums over cells of CELL x CELL pixels, fewer at the ends."""
    rows, columns = (np.arange(0, size, CELL) for size in values.shape)
    return np.asarray(np.add.reduceat(np.add.reduceat(values, rows, axis=0), columns, axis=1))


def _boxes(values: FloatArray, sides: tuple[int, int]) -> FloatArray:
    """Sums over boxes of `sides` cells, an odd number, about each cell; less at the ends."""
    for axis, side in enumerate(sides):
        total = np.cumsum(np.insert(values, 0, 0.0, axis=axis), axis=axis)
        index, last = np.arange(values.shape[axis]), values.shape[axis]
        high, low = np.minimum(index + side // 2 + 1, last), np.maximum(index - side // 2, 0)
        values = total.take(high, axis=axis) - total.take(low, axis=axis)
    return values


PADDING = 2  # of chips, so that they are not moved into each other's other end
COARSE = 0.5  # pixels, and cells of a spectrum: first step of the search of shift and ramp
ROUNDS = 6  # of a search, each with a quarter of the step of the one before
REACH = 3  # steps to either side in each
TURNS = 3  # of ramp and shift


class Alignment(NamedTuple):
    """Coherence of two chips: as they are, with the best shift, and with the best shift and phase ramp.

    as_is, shifted, ramped : magnitudes of the coherence, 0 .. 1.
    shift : (rows, columns) by which features of a lie ahead of those of b, pixels, with the ramp taken out.
    ramp : (rows, columns) by which the phase of a turns against that of b, rad per pixel.
    """

    as_is: float
    shifted: float
    ramped: float
    shift: tuple[float, float]
    ramp: tuple[float, float]


def align(a: ComplexArray, b: ComplexArray) -> Alignment:
    """Compare a chip (n_row, n_column) with a reference of the same shape, over pixels finite in both.

    All NaN if one of them has no power.

    Raises
    ------
    ValueError
        If the shapes differ.
    """
    if a.shape != b.shape:
        raise ValueError(f"chips must have one shape, got {a.shape} and {b.shape}")
    both = np.isfinite(a) & np.isfinite(b)
    first, second = (np.where(both, chip, 0).astype(np.complex128) for chip in (a, b))
    norm = float(np.sqrt((np.abs(first) ** 2).sum() * (np.abs(second) ** 2).sum()))
    if norm == 0:
        nan = float("nan")
        return Alignment(nan, nan, nan, (nan, nan), (nan, nan))
    level = _carrier(second)  # moved between samples, a spectrum must not wrap
    first, second = first * level, second * level
    as_is = float(np.abs((first * np.conj(second)).sum())) / norm
    shifted, shift = _best_shift(first, second)
    ramped, ramp = shifted, np.zeros(2)
    for _ in range(TURNS):
        moved = _moved(first * _ramp(-ramp, a.shape), shift)
        tried = ramp + _turning(moved * np.conj(second))
        value, place = _best_shift(first * _ramp(-tried, a.shape), second)
        if value > ramped:
            ramped, ramp, shift = value, tried, place
    return Alignment(
        as_is, shifted / norm, ramped / norm, (float(shift[0]), float(shift[1])), (float(ramp[0]), float(ramp[1]))
    )


def _spectrum(chip: Complex128Array, inverse: bool = False) -> Complex128Array:
    """Transform along both axes; a copy."""
    rows = fft_rows(chip.copy(), inverse=inverse)
    return np.ascontiguousarray(fft_rows(np.ascontiguousarray(rows.T), inverse=inverse).T)


def _padded(chip: Complex128Array) -> Complex128Array:
    out = np.zeros([fast_length(PADDING * n) for n in chip.shape], np.complex128)
    out[: chip.shape[0], : chip.shape[1]] = chip
    return out


def _cycles(n: int) -> FloatArray:
    """Frequencies (n,) of a transform of n samples, cycles a sample."""
    return np.asarray(((np.arange(n) + n // 2) % n - n // 2) / n)


def _ramp(turn: FloatArray, shape: tuple[int, ...]) -> Complex128Array:
    """Phasors (n_row, n_column) that turn by `turn` (2,), rad per pixel."""
    rows, columns = np.arange(shape[0])[:, None], np.arange(shape[1])
    return np.asarray(np.exp(1j * (turn[0] * rows + turn[1] * columns)))


def _carrier(chip: Complex128Array) -> Complex128Array:
    """Phasors that shift the mean frequency of a chip to 0."""
    power, turn = np.abs(_spectrum(chip)) ** 2, np.zeros(2)
    for axis in (0, 1):
        n = chip.shape[axis]
        turn[axis] = np.angle((power.sum(axis=1 - axis) * np.exp(2j * np.pi * np.arange(n) / n)).sum())
    return _ramp(-turn, chip.shape)


def _moved(chip: Complex128Array, shift: FloatArray) -> Complex128Array:
    """Shift the features of a chip back by `shift` (2,), pixels."""
    padded = _padded(chip)
    turn = [np.exp(2j * np.pi * _cycles(n) * by) for n, by in zip(padded.shape, shift, strict=True)]
    moved = _spectrum(_spectrum(padded) * turn[0][:, None] * turn[1], inverse=True)
    return moved[: chip.shape[0], : chip.shape[1]]


def _best_shift(a: Complex128Array, b: Complex128Array) -> tuple[float, FloatArray]:
    """Largest magnitude of sum a conj(b) over shifts of a, and the shift (2,), pixels."""
    product = _spectrum(_padded(a)) * np.conj(_spectrum(_padded(b)))
    whole = np.abs(_spectrum(product, inverse=True))
    start = [_cycles(n)[at] * n for n, at in zip(whole.shape, _peak(whole), strict=True)]
    value, shift = _highest(product, [_cycles(n) for n in product.shape], np.array(start), np.full(2, COARSE))
    return value / product.size, shift


def _turning(product: Complex128Array) -> FloatArray:
    """Mean phase step of a product of chips along rows and columns, (2,), rad per pixel."""
    power = np.abs(_spectrum(product))
    start = [_cycles(n)[at] for n, at in zip(power.shape, _peak(power), strict=True)]
    axes = [-np.arange(float(n)) for n in product.shape]
    return 2 * np.pi * _highest(product, axes, np.array(start), COARSE / np.array(product.shape))[1]


def _peak(values: FloatArray) -> tuple[np.intp, ...]:
    return np.unravel_index(int(values.argmax()), values.shape)


def _highest(
    values: Complex128Array, axes: Sequence[FloatArray], start: FloatArray, step: FloatArray
) -> tuple[float, FloatArray]:
    """Largest magnitude of sum values exp(2j pi (axes[0] p[0] + axes[1] p[1])), and p (2,) near `start`."""
    best, place = -1.0, start
    for _ in range(ROUNDS):
        tried = place[:, None] + step[:, None] * np.arange(-REACH, REACH + 1)
        along, across = (np.exp(2j * np.pi * axis[:, None] * at) for axis, at in zip(axes, tried, strict=True))
        found = np.abs(np.einsum("ri,rj->ij", along, np.einsum("rc,cj->rj", values, across)))
        row, column = _peak(found)
        if found[row, column] > best:
            best, place = float(found[row, column]), np.array([tried[0, row], tried[1, column]])
        step = step / 4
    return best, place


class ChipComparison(NamedTuple):
    """Comparison of an image chip a with a reference chip b over the pixels present in both.

    coherence = <a, b> / (|a| |b|), complex; gain = |<a, b>| / <b, b>; phase of a relative to b, rad; number of
    pixels used; power = <b, b> / pixels.
    """

    coherence: complex
    gain: float
    phase: float
    pixels: int
    power: float


def coherence(a: ComplexArray, b: ComplexArray) -> ChipComparison:
    """Compare a chip with a reference of the same shape; all NaN if they share no pixel or one is all zero.

    <a, b> = sum a conj(b), over pixels finite in both, in float64.

    Raises
    ------
    ValueError
        If the shapes differ.
    """
    if a.shape != b.shape:
        raise ValueError(f"chips must have one shape, got {a.shape} and {b.shape}")
    both = np.isfinite(a) & np.isfinite(b)
    first, second = a[both].astype(np.complex128), b[both].astype(np.complex128)
    inner = complex(np.vdot(second, first))
    energy_a, energy_b = float(np.vdot(first, first).real), float(np.vdot(second, second).real)
    if energy_a == 0 or energy_b == 0:
        nan = float("nan")
        return ChipComparison(complex(nan, nan), nan, nan, int(both.sum()), energy_b / max(int(both.sum()), 1))
    normalised = inner / float(np.sqrt(energy_a) * np.sqrt(energy_b))
    pixels = int(both.sum())
    return ChipComparison(normalised, abs(inner) / energy_b, float(np.angle(inner)), pixels, energy_b / pixels)


def joint_coherence(chips: Iterable[ChipComparison]) -> float:
    """|<a, b>| / (|a| |b|) of several chips as one: each counts by its power; NaN without any."""
    inner, energy_a, energy_b = 0j, 0.0, 0.0
    for chip in chips:
        if math.isnan(chip.gain):
            continue
        energy = chip.power * chip.pixels
        inner += cmath.rect(chip.gain * energy, chip.phase)
        energy_a += energy * (chip.gain / abs(chip.coherence)) ** 2
        energy_b += energy
    return abs(inner) / math.sqrt(energy_a * energy_b) if energy_b else math.nan
