"""Compiled loops: what one of them calls becomes part of its code, so that every process runs the same code."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator

from numba.core.caching import NullCache
from numba.core.dispatcher import Dispatcher

import blocksar


def loops() -> Iterator[tuple[str, Dispatcher]]:
    """Return the package's compiled functions with their names."""
    for module in pkgutil.walk_packages(blocksar.__path__, "blocksar."):
        if not module.name.endswith("__main__"):
            for name, found in vars(importlib.import_module(module.name)).items():
                if isinstance(found, Dispatcher) and found.py_func.__module__ == module.name:
                    yield f"{module.name}.{name}", found


def _is_part(loop: Dispatcher) -> bool:
    return loop.targetoptions.get("inline") == "always" or bool(loop.targetoptions.get("forceinline"))


def test_called_loops_are_part_of_their_callers() -> None:
    """A call that remained would run other machine code in the process that compiles than in those that load."""
    called = {
        f"{loop.__module__}.{name}"
        for _, loop in loops()
        for name in loop.py_func.__code__.co_names
        if isinstance(callee := loop.py_func.__globals__.get(name), Dispatcher) and not _is_part(callee)
    }
    assert called == set()


def test_loops_that_python_calls_are_cached() -> None:
    """Else every worker would compile them again."""
    found = dict(loops())
    assert len(found) > 20
    assert {name for name, loop in found.items() if not _is_part(loop) and isinstance(loop._cache, NullCache)} == set()
