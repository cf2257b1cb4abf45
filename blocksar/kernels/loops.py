"""Compiled loops with one fixed signature, which are compiled, or loaded from numba's cache, when first called.

A decorator with signatures compiles when the module is imported, also in a process that never calls the loop; one
without compiles again for each type of argument, read-only arrays and writable ones included.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from functools import partial
from threading import Lock
from types import ModuleType
from typing import Any, NamedTuple

from numba import njit, typeof
from numba.core.dispatcher import Dispatcher  # type: ignore[attr-defined, unused-ignore]
from numba.core.runtime.nrt import rtsys

from blocksar.errors import InputError


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

    def compile(self) -> None:
        """Compile, or load from numba's cache, unless that is done."""
        with self._lock:
            if not self._ready:
                compile_as(self.dispatcher, self._arguments)
                self.dispatcher.disable_compile()
                self._ready = True

    def __call__(self, *arguments: Any) -> Any:
        if not self._ready:
            self.compile()
        return self.dispatcher(*arguments)


def compile_as(dispatcher: Any, arguments: Sequence[Any]) -> None:
    """Compile for arguments of these numba types, or load from numba's cache.

    Before numba looks into its cache, it imports all that it can compile, which takes longer than to load a loop. Only
    a compilation needs that; a loaded loop needs numba's runtime.
    """
    cache = dispatcher._cache
    rtsys.initialize(dispatcher.targetctx)
    cache.load_overload = partial(_load, cache)
    try:
        dispatcher.compile(tuple(arguments))
    finally:
        del cache.load_overload


def _load(cache: Any, signature: Any, context: Any) -> Any:
    """What numba's cache holds for a signature, else None. The dispatcher that calls this holds numba's lock."""
    context.refresh = lambda: None
    try:
        return type(cache).load_overload(cache, signature, context)
    finally:
        del context.refresh


def loop(*arguments: Any, **options: Any) -> Callable[[Callable[..., Any]], Loop]:
    """Decorate a function to be compiled when first called: the types of its arguments, and options of numba's `njit`.

    It is kept in numba's cache.
    """
    return lambda function: Loop(function, arguments, {"cache": True, "no_cfunc_wrapper": True, **options})


def compile_for(dispatcher: Any, *arguments: Any) -> None:
    """Compile for the types of these values, or load from numba's cache."""
    types = [typeof(argument) for argument in arguments]  # type: ignore[no-untyped-call, unused-ignore]
    compile_as(dispatcher, types)


def compile_all(module: ModuleType) -> None:
    """Compile the loops of a module, or load them from numba's cache."""
    for found in vars(module).values():
        if isinstance(found, Loop) and found.__module__ == module.__name__:
            found.compile()


class Tally(NamedTuple):
    """The loops that this process has loaded, those of them that it had to compile, and the folder of numba's cache."""

    loaded: int
    compiled: int
    folder: str


def tally(package: str) -> Tally:
    """Count the loops of a package's loaded modules that are kept in numba's cache."""
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
