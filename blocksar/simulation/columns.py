"""Scatterers as columns of arrays, and the compiling of loops over them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from blocksar.arrays import BoolArray, FloatArray, IntArray
from blocksar.kernels.loops import Loop, loop
from blocksar.kernels.signatures import COMPILED, REAL_ROW

_FIELD = (
    *(REAL_ROW, REAL_ROW, REAL_ROW, types.Array(types.complex128, 1, "C", readonly=True)),
    types.none,
    types.Array(types.float64, 1, "A", readonly=True),
)  # types of a field's x, y, yaw, reflectivity and z, and of the antenna's position
_RAISED = (*_FIELD[:4], REAL_ROW, _FIELD[5])  # of a field with heights


def compiled(function: Callable[..., None], *arguments: Any) -> tuple[Loop, Loop]:
    """A loop over scatterers, compiled for those on the ground plane, and for those with heights."""
    plain, raised = (loop(*field, *arguments, **COMPILED) for field in (_FIELD, _RAISED))
    return plain(function), raised(function)


class Scatterers(NamedTuple):
    """Places (n,), m, yaw, rad, and reflectivity of scatterers; heights z, or None on the ground plane."""

    x: FloatArray
    y: FloatArray
    yaw: FloatArray
    reflectivity: NDArray[np.complex128]
    z: FloatArray | None = None

    def at(self, which: slice | BoolArray | IntArray) -> Scatterers:
        """Some of them."""
        return Scatterers(*(None if column is None else column[which] for column in self))  # type: ignore[arg-type]
