"""Complex coherence, gain and phase between two images of the same pixels."""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from blocksar.arrays import ComplexArray


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
