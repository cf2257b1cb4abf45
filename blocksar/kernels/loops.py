"""Compilation of loops on their first call, for one fixed signature each, or loading from numba's cache.

A decorator with signatures compiles when the module is imported, also in a process that never calls the loop; one
without compiles again for each type of argument, read-only arrays and writable ones included.

A compiled function that is called by others is compiled with `inline="always"`, or with `forceinline=True` where it has
compiler options of its own. A call left standing is resolved differently in the process that compiles (to the callee's
own machine code) and in those that load the caller from numba's cache (to a copy that was optimised with the caller):
they would round differently, and images would differ from process to process.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from threading import Lock
from time import perf_counter
from types import ModuleType
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numba import njit, types
from numba.core.caching import NullCache
from numba.core.dispatcher import Dispatcher  # type: ignore[attr-defined, unused-ignore]
from numba.core.runtime.nrt import rtsys
from numpy.typing import NDArray

from blocksar.errors import InputError
from blocksar.loop_cache import note_compilation
from blocksar.places.locks import locked

T = TypeVar("T", bound=np.generic)

# Argument types and compiler options of loops over rows of samples.
SAMPLES_IN = types.Array(types.complex64, 2, "C", readonly=True)
SAMPLES_OUT = types.complex64[:, ::1]
REAL_ROW = types.Array(types.float64, 1, "C", readonly=True)
REAL_ROWS = types.Array(types.float64, 2, "C", readonly=True)
FLOATS_IN = types.Array(types.float32, 2, "C", readonly=True)
NUMBERS_OUT = types.float32[::1]  # samples seen as numbers: what Python can do, a loop would compile
TILES = types.Array(types.int64, 2, "C", readonly=True)
POWERS = types.Array(types.float64, 3, "C", readonly=True)  # of the polynomials of tiles
TUPLE: Any = types.Tuple  # carries no types
PAIR = TUPLE((types.int64,) * 2)
_BASE: Any = types.BaseTuple
COMPILED: dict[str, Any] = {"nogil": True, "fastmath": {"contract", "nsz"}}
# No operations are contracted. Stated for every such function, since numba passes the options of a caller on to its
# callees, and caches these for other callers too.
UNCONTRACTED: dict[str, Any] = {"nogil": True, "fastmath": False}
# A function that only compiled loops call: no entry points for Python and C, each of which would be compiled with a
# copy of the function.
PART: dict[str, Any] = {"forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
UNCHECKED: dict[str, Any] = {"error_model": "numpy"}  # divisions by zero give infinity, without a test of each


def record(kind: type[tuple[Any, ...]], *fields: Any) -> Any:
    """Numba type of a NamedTuple with fields of these types; arrays that are only read are `fixed`."""
    return _BASE.from_types(fields, kind)


def fixed(values: NDArray[T]) -> NDArray[T]:
    """A read-only view of an array: numba takes writable arrays for read-only ones, but not those of a record."""
    view = values.view()
    view.flags.writeable = False
    return view


class Loop:
    """A function that is compiled when it is first called.

    Parameters
    ----------
    function : callable
    arguments : sequence
        The numba types of its arguments. Writable arrays are taken for read-only ones.
    options : dict
        Of numba's `njit`.

    Raises
    ------
    InputError
        If it is to be kept in numba's cache, and no folder for that can be written.
    """

    def __init__(self, function: Callable[..., Any], arguments: Sequence[Any], options: dict[str, Any]) -> None:
        try:
            self.dispatcher = njit(**options)(function)
        except RuntimeError as error:
            if "cannot cache function" not in str(error):
                raise
            raise InputError("no folder can be written to keep compiled loops; set NUMBA_CACHE_DIR to one") from None
        self.__name__, self.__module__, self.__doc__ = function.__name__, function.__module__, function.__doc__
        self._arguments, self._ready, self._lock = tuple(arguments), False, Lock()

    def compile(self, *, wait: bool = True) -> bool:
        """Compile, or load from numba's cache, if not yet done.

        While another process compiles the loop, wait for it, or do not and return False.
        """
        with self._lock:
            if not self._ready and compile_as(self.dispatcher, self._arguments, wait=wait):
                self.dispatcher.disable_compile()
                self._ready = True
            return self._ready

    def __call__(self, *arguments: Any) -> Any:
        if not self._ready:
            started = perf_counter()
            self.compile()
            if self.dispatcher.stats.cache_misses:
                note_compilation(perf_counter() - started)
        return self.dispatcher(*arguments)


def compile_as(dispatcher: Any, arguments: Sequence[Any], *, wait: bool = True) -> bool:
    """Compile for arguments of these numba types, or load from numba's cache.

    Of all processes that share a cache one compiles, and the others wait for it and load; without `wait` they return
    False.

    Before numba looks into its cache, it imports all that it can compile, which takes longer than to load a loop. Only
    a compilation needs that; a loaded loop needs numba's runtime.
    """
    cache = dispatcher._cache
    rtsys.initialize(dispatcher.targetctx)
    with ExitStack() as held:
        cache.load_overload = partial(_load, cache, held, wait)
        try:
            dispatcher.compile(tuple(arguments))
        except BlockingIOError:
            return False
        finally:
            del cache.load_overload
    return True


def _load(cache: Any, held: ExitStack, wait: bool, signature: Any, context: Any) -> Any:
    """Load a loop from numba's cache; None if it is not there. The dispatcher that calls this holds numba's lock.

    Before None is returned, other processes are kept from compiling, until `held` ends. Then files of the cache that
    cannot be read are dropped: a disk that was full leaves torn ones, and those of another version of this package may
    name types that are gone.
    """
    context.refresh = lambda: None
    try:
        with suppress(Exception):  # a torn file, or one that names missing objects, may raise anything
            if (found := type(cache).load_overload(cache, signature, context)) is not None:
                return found
        if isinstance(cache, NullCache):
            return None
        # One index of the cache serves all signatures of a function.
        held.enter_context(locked(cache.cache_path, cache._py_func.__qualname__, wait=wait))
        try:
            return type(cache).load_overload(cache, signature, context)
        except Exception:
            cache.flush()
            return None
    finally:
        del context.refresh


def loop(*arguments: Any, **options: Any) -> Callable[[Callable[..., Any]], Loop]:
    """Decorate a function to be compiled when first called: the types of its arguments, and options of numba's `njit`.

    It is kept in numba's cache.
    """
    return lambda function: Loop(function, arguments, {"cache": True, "no_cfunc_wrapper": True, **options})


def loops_of(module: ModuleType) -> list[Loop]:
    """List the loops of a module in the order of their definition."""
    return [found for found in vars(module).values() if isinstance(found, Loop) and found.__module__ == module.__name__]


class Tally(NamedTuple):
    """Counts of the loops that this process has loaded and compiled, and the folder of numba's cache."""

    loaded: int
    compiled: int
    folder: str


def tally(package: str) -> Tally:
    """Count the loops of a package's loaded modules that numba's cache stores."""
    loaded, compiled, folder = 0, 0, ""
    for dispatcher in dispatchers(package).values():
        stats = dispatcher.stats
        if stats.cache_path is not None:  # None: part of others
            missed = sum(stats.cache_misses.values())
            loaded, compiled = loaded + sum(stats.cache_hits.values()) + missed, compiled + missed
            folder = folder or stats.cache_path
    return Tally(loaded, compiled, folder)


def dispatchers(package: str) -> dict[str, Any]:
    """Numba's dispatchers of the compiled functions in a package's loaded modules, by name."""
    found = {}
    for home, module in sorted(sys.modules.items()):
        if home == package or home.startswith(f"{package}."):
            for name, value in vars(module).items():
                if isinstance(value, Loop | Dispatcher) and value.__module__ == home:
                    found[f"{home}.{name}"] = value.dispatcher if isinstance(value, Loop) else value
    return found
