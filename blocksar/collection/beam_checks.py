"""Checks of a beam about the antenna's own axis, and of antenna patterns."""

from __future__ import annotations

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.errors import InputError

MOST_ANGLE = 3.15  # rad: patterns may be known all round
MOST_GAIN = 1e12  # of a pattern's peak, and one over the least

UNIT = 1e-6  # by which the length of a unit vector may be off
COVERED = 1e-9  # rad by which a pattern may fall short of the beam's edge


def check_axis_beam(axis: FloatArray, steering: FloatArray, width: float | None) -> None:
    """Check the antenna's azimuth axis (n, 3), the steering (n,), rad, and the beam's width, rad.

    Raises
    ------
    InputError
        If values are not finite, the axis is no unit vector, the beam reaches the axis, or anything jumps.
    """
    for name, values in (("beam_axis", axis), ("beam_steering", steering)):
        bad = np.flatnonzero(~np.isfinite(values.reshape(steering.size, -1)).all(axis=1))
        if bad.size:
            raise InputError(
                f"{name} is not finite at {bad.size} of {steering.size} pulses (first: pulse {bad[0]}); every pulse "
                "needs it, also a missing one"
            )
    length = np.sqrt((axis * axis).sum(axis=1))
    worst = int(np.abs(length - 1).argmax())
    if abs(length[worst] - 1) > UNIT:
        raise InputError(
            f"beam_axis has a length of {length[worst]:.9g} at pulse {worst}, but must be a unit vector; divide it by "
            "its length"
        )
    if width is None or not 0 < width < np.pi:
        degrees = width is not None and np.pi <= width <= 180
        raise InputError(
            f"beam_width must lie between 0 and pi rad where beam_axis is given, got {width!r}"
            + ("; it looks like degrees" if degrees else "")
        )
    worst = int(np.abs(steering).argmax())
    if abs(steering[worst]) + width / 2 >= np.pi / 2:
        raise InputError(
            f"beam_steering is {steering[worst]:.6g} rad at pulse {worst}: with half of beam_width, {width / 2:.6g} "
            "rad, it must stay below pi / 2 off the plane normal to beam_axis; correct it, or its unit"
        )
    _refuse_jump("beam_axis", np.sqrt((np.diff(axis, axis=0) ** 2).sum(axis=1)), width)
    _refuse_jump("beam_steering", np.abs(np.diff(steering)), width)


def _refuse_jump(name: str, steps: FloatArray, width: float) -> None:
    where = int(steps.argmax())
    if steps[where] > width:
        raise InputError(
            f"{name} jumps by {steps[where]:.6g} rad at pulse {where + 1}, more than beam_width = {width:.6g} rad: "
            "ground between is never lit; cut the collection there"
        )


def check_pattern(name: str, coordinate: str, angle: FloatArray, amplitude: FloatArray) -> None:
    """Check a two-way amplitude over its angles, both (n,).

    Raises
    ------
    InputError
        If shapes disagree, values are not finite, angles do not ascend, or amplitudes are negative, zero throughout or
        of an absurd size.
    """
    if angle.ndim != 1 or angle.size < 2 or amplitude.shape != angle.shape:
        raise InputError(
            f"{name} has shape {amplitude.shape} and {coordinate} has {angle.shape}; give both one value for each of "
            "at least two angles"
        )
    for which, values in ((coordinate, angle), (name, amplitude)):
        if not np.isfinite(values).all():
            raise InputError(f"{which} has {np.count_nonzero(~np.isfinite(values))} values that are not finite")
    if np.abs(angle).max() > MOST_ANGLE:
        raise InputError(
            f"{coordinate} runs from {angle.min():.6g} to {angle.max():.6g} rad, more than half a turn away; "
            "correct its unit (it looks like degrees)"
        )
    if not (np.diff(angle) > 0).all():
        raise InputError(f"{coordinate} does not ascend at index {int(np.argmin(np.diff(angle) > 0)) + 1}; sort it")
    if amplitude.min() < 0 or not amplitude.any():
        raise InputError(
            f"{name} runs from {amplitude.min():.6g} to {amplitude.max():.6g}, but is an amplitude: at least 0, and "
            "above 0 somewhere; put the phase into the samples"
        )
    if not 1 / MOST_GAIN <= amplitude.max() <= MOST_GAIN:
        raise InputError(
            f"{name} is {amplitude.max():.6g} at most, which no antenna's amplitude is; give it relative to its "
            "largest value, and divide the samples by that"
        )


def check_cover(name: str, coordinate: str, angle: FloatArray, low: float, high: float, what: str) -> None:
    """Refuse a pattern whose angles (n,) do not cover low .. high, rad."""
    if angle[0] > low + COVERED or angle[-1] < high - COVERED:
        raise InputError(
            f"{name} covers {coordinate} = {angle[0]:.6g} .. {angle[-1]:.6g} rad, but {what} needs {low:.6g} .. "
            f"{high:.6g} rad; give it for all of that"
        )
