"""Compiled loops: what one of them calls becomes part of its code, so that every process runs the same code."""

from __future__ import annotations

import importlib
import os
import pickle
import pkgutil
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numba import config, types
from numba.core.caching import NullCache
from numba.core.dispatcher import Dispatcher

import blocksar
from blocksar import loop_cache
from blocksar.errors import InputError
from blocksar.graph import compiling
from blocksar.kernels import loops as kernel_loops
from blocksar.kernels import phase
from blocksar.kernels.loops import Loop, dispatchers
from blocksar.places.locks import locked


def loops() -> Iterator[tuple[str, Dispatcher]]:
    """Return the package's compiled functions with their names."""
    for module in pkgutil.walk_packages(blocksar.__path__, "blocksar."):
        if not module.name.endswith(("__main__", "kernels.gpu")):  # the latter's are no loops of the CPU, and need CuPy
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


@pytest.mark.slow
def test_the_second_compilation_finds_all_loops_in_the_cache() -> None:
    """In a process of its own, since this one may have compiled some."""
    first = blocksar.compile().result
    code = "import blocksar; r = blocksar.compile(); print(r.result['compiled'], r.result['loops'], *r.summary)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    compiled, loops, summary = run.stdout.split(maxsplit=2)
    assert int(compiled) == 0 and int(loops) == first["loops"] > 15
    assert summary.startswith(f"all {loops} loops are compiled already, in ")


@pytest.mark.slow
@pytest.mark.parametrize("damage", ["torn index", "torn loop", "a class that is gone"])
def test_files_of_the_cache_that_cannot_be_read_are_made_anew(
    damage: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))

    def product() -> tuple[float, int]:
        made = Loop(times, (types.float64, types.float64), {"cache": True})
        return made(3.0, 2.0), sum(made.dispatcher.stats.cache_misses.values())

    assert product() == (6.0, 1)
    (index,), (loop,) = tmp_path.rglob("*.nbi"), tmp_path.rglob("*.nbc")
    version = pickle.loads(index.read_bytes())
    torn = {"torn index": index, "torn loop": loop}.get(damage)
    if torn is not None:
        torn.write_bytes(torn.read_bytes()[:-20])
    else:  # protocol 0: the global "Gone" of this module
        index.write_bytes(pickle.dumps(version) + b"c" + __name__.encode() + b"\nGone\n.")
    assert product() == (6.0, 1)
    assert product() == (6.0, 0)


def test_sources_that_are_written_again_as_they_were_are_compiled_at_most_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Numba finds their loops, by the contents; what looks at the age of files must not say for ever that they lack."""
    monkeypatch.setenv(loop_cache.VARIABLE, str(tmp_path))
    index = tmp_path / "blending.blend-1.py311.nbi"
    index.touch()
    os.utime(index, (0, 0))
    assert compiling.missing(["kernels.blending"]) == ["kernels.blending"]
    compiling.compile_modules(["kernels.blending"], by="all")
    assert compiling.missing(["kernels.blending"]) == []


def times(a: float, b: float) -> float:
    return a * b


def test_all_loops_are_compiled_ahead() -> None:
    """In a container whose cache cannot be written, every process would compile one that is not named."""
    named = [loop.dispatcher for name in compiling.LOOPS for loop in compiling.loops_named(name)]
    assert {name for name, loop in loops() if not _is_part(loop) and loop not in named} == set()


@pytest.mark.slow
def test_loops_are_loaded_without_all_that_numba_can_compile() -> None:
    """Its import takes longer than a plan; `numba.np.linalg` stands for it."""
    blocksar.compile()
    load = "from blocksar.graph import compiling as c; t = c.compile_modules(c.LOOPS)"
    code = f"import sys; {load}; print(t.loaded, t.compiled, 'numba.np.linalg' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded, compiled, imported = run.stdout.split()
    assert int(loaded) > 15 and (compiled, imported) == ("0", "False")


@pytest.mark.slow
def test_two_processes_compile_no_loop_twice(tmp_path: Path) -> None:
    """Both begin with an empty cache: whichever is first, the other loads what it finds or waits for it."""
    names = ["autofocusing.information"]
    code = f"from blocksar.graph.compiling import compile_modules as c; t = c({names}); print(t.loaded, t.compiled)"
    started = [
        subprocess.Popen(
            [sys.executable, "-c", code],
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)},
        )
        for _ in range(2)
    ]
    printed = [process.communicate()[0].split() for process in started]
    (first, compiled), (second, others) = ((int(a), int(b)) for a, b in printed)
    assert first == second == compiled + others > 1


def test_a_loop_that_another_process_compiles_is_passed_over(tmp_path: Path) -> None:
    """Locks belong to processes, so another one holds it."""
    hold = (
        "from blocksar.places.locks import locked\n"
        f"with locked({str(tmp_path)!r}, 'taken', wait=True): print('held', flush=True); input()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", hold], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None and other.stdout.readline() == "held\n"
        with (
            pytest.raises(BlockingIOError, match="another process does taken"),
            locked(str(tmp_path), "taken", wait=False),
        ):
            pass
        with locked(str(tmp_path), "free", wait=False):
            pass
        other.communicate("\n")
    with locked(str(tmp_path), "taken", wait=False):
        pass


@pytest.fixture
def read_only(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """An installation whose modules cannot be written, and a folder for temporary files; HOME is a file."""
    (tmp_path / "home").touch()
    monkeypatch.setattr(loop_cache, "MODULES", "/dev/null/kernels")
    for name, value in {"HOME": tmp_path / "home", "TMPDIR": tmp_path}.items():
        monkeypatch.setenv(name, str(value))
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")  # so that it is put back afterwards
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(config, "CACHE_DIR", config.CACHE_DIR)
    return tmp_path


def _link(folder: Path, other: Path) -> None:
    folder.rename(other)
    other.chmod(0o700)
    folder.symlink_to(other)


def chosen() -> str:
    loop_cache.choose_cache()
    assert os.environ["NUMBA_CACHE_DIR"] == config.CACHE_DIR
    return os.environ["NUMBA_CACHE_DIR"]


def test_loops_of_a_read_only_installation_are_kept_for_the_user(
    read_only: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(read_only / "caches"))
    assert chosen() == str(read_only / "caches" / "blocksar") and os.path.isdir(chosen())


def test_without_a_home_loops_are_kept_among_temporary_files(read_only: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usual = read_only / f"blocksar-{os.getuid()}"
    assert chosen() == str(usual) and stat.S_IMODE(usual.stat().st_mode) == 0o700
    # What others can write to is not taken: what lies in it is run.
    for spoil in (lambda: usual.chmod(0o777), lambda: _link(usual, read_only / "other")):
        spoil()
        monkeypatch.setenv("NUMBA_CACHE_DIR", "")
        own = Path(chosen())
        assert own.parent == read_only and own != usual and stat.S_IMODE(own.stat().st_mode) == 0o700


def test_without_any_folder_for_them_loops_are_refused(read_only: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def define(_: object) -> None:
        raise RuntimeError("cannot cache function '_rotate': no locator available")

    monkeypatch.setattr(kernel_loops, "njit", lambda **_: define)
    with pytest.raises(InputError, match="set NUMBA_CACHE_DIR to one"):
        kernel_loops.loop()(np.add)


def test_a_loop_takes_writable_and_read_only_arrays_by_one_compilation() -> None:
    values = np.ones((2, 40), np.complex64)
    for given in (values, values[:1], np.frombuffer(values.tobytes(), np.complex64).reshape(2, 40)):
        phase.rotate(given, 40, np.zeros((len(given), 2)), np.empty_like(given))
    (rotate,) = (found for name, found in dispatchers("blocksar").items() if name.endswith("phase._rotate"))
    assert len(rotate.signatures) == 1
