"""Compiled loops: what one of them calls becomes part of its code, so that every process runs the same code."""

from __future__ import annotations

import importlib
import pkgutil
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from numba.core.caching import NullCache
from numba.core.dispatcher import Dispatcher

import blocksar
from blocksar.api import compiling
from blocksar.errors import InputError
from blocksar.kernels import phase
from blocksar.kernels.loops import Loop, dispatchers


def loops() -> Iterator[tuple[str, Dispatcher]]:
    """Return the package's compiled functions with their names."""
    for module in pkgutil.walk_packages(blocksar.__path__, "blocksar."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    yield from dispatchers("blocksar").items()


def _is_part(loop: Dispatcher) -> bool:
    return loop.targetoptions.get("inline") == "always" or bool(loop.targetoptions.get("forceinline"))


def test_called_loops_are_part_of_their_callers() -> None:
    """A call that remained would run other machine code in the process that compiles than in those that load."""
    called = {
        f"{loop.__module__}.{name}"
        for _, loop in loops()
        for name in loop.py_func.__code__.co_names
        if isinstance(callee := loop.py_func.__globals__.get(name), Loop)
        or (isinstance(callee, Dispatcher) and not _is_part(callee))
    }
    assert called == set()


def test_loops_that_python_calls_are_cached() -> None:
    """Else every worker would compile them again."""
    found = dict(loops())
    assert len(found) > 20
    assert {name for name, loop in found.items() if not _is_part(loop) and isinstance(loop._cache, NullCache)} == set()


def test_the_second_compilation_finds_all_loops_in_the_cache() -> None:
    """In a process of its own, since this one may have compiled some."""
    code = "import blocksar; r = blocksar.compile(); print(r.result['compiled'], r.result['loops'], *r.summary)"
    first, second = (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split(
            maxsplit=2
        )
        for _ in range(2)
    )
    assert int(second[0]) == 0 and int(first[1]) == int(second[1]) > 15
    assert second[2].startswith(f"all {second[1]} loops are compiled already, in ")


def test_loops_are_loaded_without_all_that_numba_can_compile() -> None:
    """Its import takes longer than a plan; `numba.np.linalg` stands for it."""
    blocksar.compile()
    load = "from blocksar.graph import compiling as c; t = c.compile_modules(c.SECONDS, apart=False)"
    code = f"import sys; {load}; print(t.loaded, t.compiled, 'numba.np.linalg' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded, compiled, imported = run.stdout.split()
    assert int(loaded) > 15 and (compiled, imported) == ("0", "False")


def test_a_cache_that_cannot_be_written_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(names: object, *, apart: bool) -> None:
        raise RuntimeError("cannot cache function '_rotate': no locator available")

    monkeypatch.setattr(compiling, "compile_modules", fail)
    with pytest.raises(InputError, match="set NUMBA_CACHE_DIR"):
        blocksar.compile()


def test_a_loop_takes_writable_and_read_only_arrays_by_one_compilation() -> None:
    values = np.ones((2, 40), np.complex64)
    for given in (values, values[:1], np.frombuffer(values.tobytes(), np.complex64).reshape(2, 40)):
        phase.rotate(given, 40, np.zeros((len(given), 2)), np.empty_like(given))
    (rotate,) = (found for name, found in dispatchers("blocksar").items() if name.endswith("phase._rotate"))
    assert len(rotate.signatures) == 1
