"""Compilation of the loops that tasks run: once for each installation, in one process."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from blocksar.garbage import uncollected
from blocksar.graph.machine import machine
from blocksar.places.posix import fcntl

if TYPE_CHECKING:
    from blocksar.kernels.loops import Tally

LAST = "blocksar.focusing.correction"  # its loops are compiled last
SECONDS = {  # that a core takes to compile the loops of a module, to divide them among processes
    "kernels.phase": 2.1,
    "kernels.interpolation": 2.8,
    "kernels.levelling": 3.7,
    "kernels.occlusion": 1.5,
    "kernels.terrain_rows": 1.5,
    "inspection.scan": 2.5,
    "autofocusing.range_lines": 1.2,
    "autofocusing.forms": 0.5,
    "autofocusing.sights": 0.9,
    "autofocusing.phase_gradient": 0.5,
    "focusing.relief_correction": 4.5,
    "focusing.correction": 4.1,
    "focusing.backprojection": 0.8,
    "simulation.scatterers": 1.5,
}
TRACKS = ("autofocusing.range_lines", "autofocusing.forms", "autofocusing.sights", "autofocusing.phase_gradient")
TASKS = ("kernels.phase", "kernels.interpolation", "kernels.levelling", "inspection.scan", "focusing.correction")
TERRAIN = ("kernels.occlusion", "kernels.terrain_rows", "focusing.relief_correction")
COMPILE = "import sys; from blocksar.graph import compiling; print(compiling.compile_here(sys.argv[1:]))"


def cache_folder() -> Path:
    """The folder that holds numba's cache of the loops: that of NUMBA_CACHE_DIR, or one beside the last module's."""
    folder = os.environ.get("NUMBA_CACHE_DIR")
    return Path(folder) if folder else _source(LAST).parent / "__pycache__"


def _source(module: str) -> Path:
    spec = find_spec(module)  # does not load it
    assert spec is not None and spec.origin is not None
    return Path(spec.origin)


def kernels_cached(module: str = LAST) -> bool:
    """Tell whether numba's cache has the loops of a module, by default the last to be compiled.

    That is, files younger than its source.
    """
    source = _source(module)
    folder = cache_folder() if os.environ.get("NUMBA_CACHE_DIR") else source.parent / "__pycache__"
    with suppress(OSError):
        changed = source.stat().st_mtime
        return any(file.stat().st_mtime > changed for file in folder.rglob(f"{source.stem}.*.nbi"))
    return False


def compile_kernels(*, apart: bool = True) -> None:
    """Compile the loops that planning and the tasks of all chains of steps run, or load them from numba's cache.

    Of several processes of one machine that begin at the same time one compiles, and the others load what it compiled.
    `apart`: it has other processes compile them, one for each core.
    """
    compile_modules(TASKS, apart=apart and not kernels_cached())


def compile_missing(names: Iterable[str]) -> None:
    """Compile the loops of those modules that the cache of numba does not have: here, or each worker would."""
    if missing := [name for name in names if not kernels_cached(f"blocksar.{name}")]:
        compile_modules(missing, apart=False)


def compile_modules(names: Iterable[str], *, apart: bool) -> Tally:
    """Compile the loops of modules of this package, or load them from numba's cache; `apart`: by a process a core.

    Returns the loops of this process, and how many of them it and the others had to compile.
    """
    from blocksar.kernels.loops import tally

    with alone(), uncollected():
        compiled = _compile_apart(names) if apart else 0
        for name in names:
            _compile(name)
    loaded = tally("blocksar")
    return loaded._replace(compiled=loaded.compiled + compiled)


def compile_here(names: Iterable[str]) -> int:
    """Compile modules without a lock, which the process that started this one holds; the number of compiled loops."""
    from blocksar.kernels.loops import tally

    with uncollected():
        for name in names:
            _compile(name)
    return tally("blocksar").compiled


def _compile(name: str) -> None:
    from blocksar.kernels.loops import compile_all

    module = import_module(f"blocksar.{name}")
    compile_all(module)
    if hasattr(module, "compile_kernels"):
        module.compile_kernels()


def _compile_apart(names: Iterable[str]) -> int:
    """Let as many processes as there are cores compile, this one included, which also does what another fails to do.

    Returns the number of loops that the others compiled.
    """
    groups: list[list[str]] = [[] for _ in range(max(machine()[0], 1))]
    for name in sorted(names, key=SECONDS.__getitem__, reverse=True):
        min(groups, key=lambda group: sum(SECONDS[other] for other in group)).append(name)
    paths = [str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", COMPILE, *group], env=environment,
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        )
        for group in filter(None, groups[1:])
    ]  # fmt: skip
    try:
        for name in groups[0]:
            _compile(name)
        printed = [process.communicate()[0].strip() for process in processes]
        return sum(int(count) for count in printed if count.isdigit())
    finally:
        for process in processes:
            process.kill()


@contextmanager
def alone() -> Iterator[None]:
    """Keep other processes of this machine from compiling into the same cache; where files cannot be locked, do not."""
    with ExitStack() as stack:
        with suppress(OSError):
            folder = cache_folder()
            folder.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(folder / "blocksar.lock", os.O_CREAT | os.O_RDWR, 0o644)
            stack.callback(os.close, descriptor)
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
