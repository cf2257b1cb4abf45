"""Argument types and compiler options of the compiled loops over rows of samples."""

from __future__ import annotations

from typing import Any

from numba import types

SAMPLES_IN = types.Array(types.complex64, 2, "C", readonly=True)
SAMPLES_OUT = types.complex64[:, ::1]
REAL_ROW = types.Array(types.float64, 1, "C", readonly=True)
REAL_ROWS = types.Array(types.float64, 2, "C", readonly=True)
COMPILED: dict[str, Any] = {"cache": True, "nogil": True, "fastmath": {"contract", "nsz"}}
