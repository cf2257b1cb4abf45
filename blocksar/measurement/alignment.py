"""Coherence of two images of a scene that differ by what no sample tells of a track: a shift, and a ramp of the phase.

A constant error along the line of sight moves the image; a line over time turns it about the antenna, which moves it
and ramps its phase along azimuth. Neither blurs. What is left after both are taken out is what images really differ by.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from blocksar.arrays import Complex128Array, ComplexArray, FloatArray
from blocksar.kernels.fourier import fast_length, fft_rows

PADDING = 2  # of chips, so that they are not moved into each other's other end
COARSE = 0.5  # pixels, and cells of a spectrum: first step of the search of shift and ramp
ROUNDS = 6  # of a search, each with a quarter of the step of the one before
REACH = 3  # steps to either side in each
TURNS = 3  # of ramp and shift


class Alignment(NamedTuple):
    """How alike two chips are, as they are, with the best shift, and with the best shift and ramp of the phase.

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
    """Phasors that move the mean frequency of a chip to 0."""
    power, turn = np.abs(_spectrum(chip)) ** 2, np.zeros(2)
    for axis in (0, 1):
        n = chip.shape[axis]
        turn[axis] = np.angle((power.sum(axis=1 - axis) * np.exp(2j * np.pi * np.arange(n) / n)).sum())
    return _ramp(-turn, chip.shape)


def _moved(chip: Complex128Array, shift: FloatArray) -> Complex128Array:
    """A chip whose features lie back by `shift` (2,), pixels."""
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
    """By how much a product of chips turns along rows and columns, (2,), rad per pixel."""
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
