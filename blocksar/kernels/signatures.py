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
FLOATS_IN = types.Array(types.float32, 2, "C", readonly=True)
TILES = types.Array(types.int64, 2, "C", readonly=True)
POWERS = types.Array(types.float64, 3, "C", readonly=True)  # of the polynomials of tiles
TUPLE: Any = types.Tuple  # carries no types
PAIR = TUPLE((types.int64,) * 2)
COMPILED: dict[str, Any] = {"nogil": True, "fastmath": {"contract", "nsz"}}
# No operations are contracted. Said of every such function: numba hands the options of a caller to what it calls, and
# keeps what it compiled so for other callers.
UNCONTRACTED: dict[str, Any] = {"nogil": True, "fastmath": False}
# Of a function that compiled loops call, and Python does not: no entry points for Python and C, each of which would be
# compiled with a copy of the function.
PART: dict[str, Any] = {"forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
UNCHECKED: dict[str, Any] = {"error_model": "numpy"}  # divisions by zero give infinity, without a test of each
