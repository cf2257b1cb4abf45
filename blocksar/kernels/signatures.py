"""Argument types and compiler options of the compiled loops over rows of samples.

A compiled function that is called by others is compiled with `inline="always"`, or with `forceinline=True` where it has
compiler options of its own. A call left standing is resolved differently in the process that compiles (to the callee's
own machine code) and in those that load the caller from numba's cache (to a copy that was optimised with the caller):
they would round differently, and images would differ from process to process.
"""

from __future__ import annotations

from typing import Any

from numba import types

SAMPLES_IN = types.Array(types.complex64, 2, "C", readonly=True)
SAMPLES_OUT = types.complex64[:, ::1]
REAL_ROW = types.Array(types.float64, 1, "C", readonly=True)
REAL_ROWS = types.Array(types.float64, 2, "C", readonly=True)
COMPILED: dict[str, Any] = {"cache": True, "nogil": True, "fastmath": {"contract", "nsz"}}
