"""Real samples where complex ones belong.

Samples x over range frequency that are real are half the sum of those of the scene, s, and of their conjugate. As

    s = sum sigma exp(-4j pi (carrier + f) (R - reference) / c),

the conjugate is a scene of targets at ranges 2 reference - R: each target has half its amplitude, and a mirror image.
Where no phase was removed (reference = 0) all ranges are positive, and s has negative delays over f only. Up to half
the range window, c / (4 step), the conjugate of the analytic signal of x along f is therefore s.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from blocksar.arrays import ComplexArray
from blocksar.collection.collection import Collection
from blocksar.constants import SPEED_OF_LIGHT

ROUNDED = 1e-3  # of the samples, that their imaginary part is where it is rounding; of complex ones it is some 0.7
MIRRORED = "each target would have half its amplitude, and a mirror image"
ANALYTIC = {
    "signal": "np.conj(scipy.signal.hilbert(recorded, axis=-1)), which holds ranges up to c / (4 step of "
    "range_frequency), times exp(4j pi (carrier_frequency + range_frequency) reference_range / c)",
    "echo": "scipy.signal.hilbert(recorded, axis=-1), times exp(-2j pi f fast_time) if it was recorded at an "
    "intermediate frequency f",
}


def real_numbers(name: str, kind: str, least: float) -> str:
    """What is wrong with samples of a real type, and what to do.

    Parameters
    ----------
    name : {"signal", "echo"}
    kind : str
        Their type.
    least : float
        The least of them.
    """
    if least >= 0:
        return (
            f"{name} is {kind} and nowhere negative, but must be complex64; give complex samples: magnitudes have lost "
            "the phase that an image is formed of, and of a converter's counts the middle level has to be subtracted"
        )
    return f"{name} is {kind}, but must be complex64: {_of_real(name)}"


def _of_real(name: str) -> str:
    return f"of real samples {MIRRORED}; give the analytic signal of what was recorded, {ANALYTIC[name]}"


def find_real(name: str, collection: Collection, parts: Iterable[tuple[tuple[slice, ...], ComplexArray]]) -> str | None:
    """What is wrong with complex samples that are real, with what to do; None if they are not.

    As they are, or but for the phase of the reference range. Samples of one sign may be those of a single target at
    that range.

    Parameters
    ----------
    name : {"signal", "echo"}
    collection : Collection
        For the reference phase of a signal.
    parts : iterable of ((..., slice, slice), array)
        Pulses and columns, and samples (..., n_pulse, n_column) of these. Not read beyond the first that tells.
    """
    plain, turned = True, name == "signal"
    signs: set[float] = set()
    frequency = collection.carrier + collection.range_frequency
    for (*_, pulses, columns), samples in parts:
        some = np.where(np.isfinite(samples), samples, 0)
        plain = plain and not some.imag.any()
        if not plain and turned:
            cycles = 2 / SPEED_OF_LIGHT * frequency[columns] * collection.reference_range[pulses, None]
            some = some * np.exp(-2j * np.pi * np.mod(cycles, 1.0))
            turned = bool(np.linalg.norm(some.imag) <= ROUNDED * np.linalg.norm(some))
        if not (plain or turned):
            return None
        level = ROUNDED * np.abs(some.real).max(initial=0.0)
        signs.update(np.unique(np.sign(some.real[np.abs(some.real) > level])).tolist())
    if len(signs) < 2:
        return None
    if plain:
        return f"{name} has no imaginary part: {_of_real(name)}"
    return f"{name} is real but for the phase of reference_range: {_of_real(name)}"
