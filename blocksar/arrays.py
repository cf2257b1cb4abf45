"""Array types, a check for uniform axes, and repeated axes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blocksar.errors import InputError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
ComplexArray = NDArray[np.complex64]
Complex128Array = NDArray[np.complex128]

FINEST, WIDEST = 1e-15, 1e15  # in SI units, the step and the extent of an axis that can be meant
UNIFORM_TOLERANCE = 1e-3  # of one step: a deviation this small has no relevant effect on the phase


def check_axis(axis: FloatArray, name: str, unit: str, *, uneven: bool = False) -> None:
    """Check that an axis is finite, ascending and uniform to UNIFORM_TOLERANCE; if it may be `uneven`, without a leap.

    Raises
    ------
    InputError
        If it is not, or has fewer than 8 samples.
    """
    if axis.ndim != 1 or axis.size < 8:
        raise InputError(f"{name} has shape {axis.shape}, but an axis of at least 8 samples is needed")
    if not np.isfinite(axis).all():
        raise InputError(f"{name} is not finite at {np.count_nonzero(~np.isfinite(axis))} of {axis.size} values")
    if np.abs(axis).max() > WIDEST:
        raise InputError(f"{name} reaches {np.abs(axis).max():.3g} {unit}, which cannot be meant; correct its values")
    steps = np.diff(axis)
    if not (steps > 0).all():
        where = int(np.argmin(steps > 0))
        raise InputError(f"{name} does not ascend at index {where + 1}: sort it, or cut it there")
    step = (axis[-1] - axis[0]) / (axis.size - 1)
    if step < FINEST:
        raise InputError(f"{name} has steps of {step:.3g} {unit}, which cannot be meant; correct its values, or unit")
    widest = int(steps.argmax())
    if uneven and steps[widest] > (axis[-1] - axis[0]) / 2:
        raise InputError(
            f"{name} leaps by {steps[widest]:.6g} {unit} from index {widest} to {widest + 1}, more than half of its "
            "extent; correct it there, or give each part as a collection of its own"
        )
    if not uneven and (error := misplacement(axis)).max() > UNIFORM_TOLERANCE:
        raise InputError(
            f"{name} is not uniform: index {int(error.argmax())} lies {error.max():.3g} steps of "
            f"{step:.6g} {unit} from its place; resample it to a uniform axis"
        )


def misplacement(axis: FloatArray) -> FloatArray:
    """How far each sample of an ascending axis (n,) lies from its place on the uniform one of its ends, steps."""
    step = (axis[-1] - axis[0]) / (axis.size - 1)
    return np.asarray(np.abs(axis - (axis[0] + step * np.arange(axis.size))) / step)


def unrepeated(values: FloatArray) -> FloatArray:
    """A view of an array without the repetitions of `np.broadcast_to`: axes of stride 0 get length 1."""
    return values[tuple(slice(1) if stride == 0 else slice(None) for stride in values.strides)]
