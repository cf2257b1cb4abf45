"""Compilation of the tasks' loops: once for each installation, by as many processes as there are cores.

A loop is named by its module, or by its module and its own name, `processors.chain.ground.surfaces:sum_series`.
Processes divide the loops among them as they go: each compiles those that no other is compiling
(`kernels.loops.compile_as`).
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from importlib import import_module
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Literal

from blocksar.garbage import uncollected
from blocksar.graph.machine import machine, pace
from blocksar.loop_cache import note_compilation
from blocksar.texts import time_text

if TYPE_CHECKING:
    from blocksar.kernels.loops import Loop, Tally
    from blocksar.progress import Listener

By = Literal["this", "all", "others"]  # the processes that compile loops

# Those that take longest come first, so that processes end together.
READ = ("kernels.phase", "inspection.scan")  # of what reads, compresses and inspects samples, for any processor
TASKS = (
    "kernels.levelling", "processors.chain.ground.correction", *READ, "kernels.interpolation:stretch_rows",
    "processors.chain.ground.surfaces:sum_series",
)  # fmt: skip
RESAMPLING = ("kernels.interpolation:resample_rows",)
TERRAIN = (
    "processors.chain.ground.relief_correction", "kernels.occlusion", "kernels.terrain_rows",
    "processors.chain.ground.surfaces:sum_layers",
)  # fmt: skip
PULSES = ("kernels.pulse_sums", "imaging.pattern_sums")
WEIGHTS = ("kernels.blending",)
PYRAMID = ("kernels.halving",)
HIERARCHY = ("kernels.decimation", "kernels.parts")
TRACKS = ("autofocusing.range_lines", "autofocusing.information", "autofocusing.chips", "autofocusing.phase_gradient")
LOOPS = (
    *TERRAIN[:1], *TASKS, *RESAMPLING, *PULSES, "kernels.beam_passes", *TERRAIN[1:], "simulation.scatterers", *WEIGHTS,
    *HIERARCHY, *PYRAMID, *TRACKS, "kernels.posts", "kernels.quantised_packets",
)  # fmt: skip
DEMO = *TASKS, "kernels.pulse_sums", "simulation.scatterers", *PYRAMID
SECONDS = {
    "processors.chain.ground.relief_correction": 7.0,
    "kernels.levelling": 5.0,
    "imaging.pattern_sums": 4.5,
    "kernels.beam_passes": 4.0,
    "simulation.scatterers": 4.0,
    "processors.chain.ground.correction": 3.0,
    "kernels.occlusion": 3.0,
    "kernels.phase": 3.0,
    "kernels.pulse_sums": 2.5,
    "inspection.scan": 2.0,
}  # of one core, to compile those of a name where `machine.pace` is 1
OTHERS = 1.5  # the same of each other name
HELP = "import sys; from blocksar.graph import compiling; print(compiling.help_to_compile(sys.argv[1:]))"


def missing(names: Iterable[str]) -> list[str]:
    """List the loops that are missing in numba's cache: none of their cached files is newer than the source."""
    return [
        name for name, changed, indices in _indices(names) if not any(_is_younger(file, changed) for file in indices)
    ]


def _indices(names: Iterable[str]) -> Iterator[tuple[str, float, list[Path]]]:
    """Iterate over loops: name, time at which the source was changed, and index files in numba's cache."""
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    found: dict[Path, list[Path]] = {}
    for name in names:
        module, _, loop = name.partition(":")
        if (spec := _found(module)) is None or spec.origin is None:
            continue
        source = Path(spec.origin)
        folder = Path(chosen) if chosen else source.parent / "__pycache__"
        if folder not in found:
            found[folder] = list(folder.rglob("*.nbi"))
        begin = f"{source.stem}.{loop}"
        yield name, source.stat().st_mtime, [file for file in found[folder] if file.name.startswith(begin)]


def _found(module: str) -> ModuleSpec | None:
    """Find a module without loading it; there is none of a processor whose folder is taken away."""
    with suppress(ModuleNotFoundError):
        return find_spec(f"blocksar.{module}")
    return None


def _keep_young(names: Iterable[str]) -> None:
    """Update the time of index files whose source was written again unchanged, by an installation or a checkout.

    Numba goes by the contents of a source: such loops are loaded, but `missing` would list them for ever.
    """
    for _, _, indices in _indices(names):
        for file in indices:
            with suppress(OSError):
                file.touch()


def _is_younger(file: Path, changed: float) -> bool:
    with suppress(OSError):
        return file.stat().st_mtime > changed
    return False


def kernels_cached(names: Iterable[str] = TASKS) -> bool:
    """Tell whether numba's cache has these loops: by default those that planning and tasks of all chains run."""
    return not missing(names)


def seconds_to_compile(names: Collection[str]) -> float:
    """Predict how long all cores take to compile loops, s."""
    seconds = [SECONDS.get(name, OTHERS) for name in names]
    return pace() * max([sum(seconds) / machine()[0], *seconds])


def compile_missing(names: Iterable[str], by: By = "all", listener: Listener | None = None) -> None:
    """Compile the loops that the cache of numba does not have: by a process a core, or each worker would have to."""
    if lacking := missing(names):
        if listener is not None:
            listener.note(f"compiling once for this installation, about {time_text(seconds_to_compile(lacking))}")
        compile_modules(lacking, by)


def load_cached(names: Sequence[str]) -> None:
    """Load those of the loops that numba's cache has."""
    lacking = set(missing(names))
    compile_modules([name for name in names if name not in lacking])


def compile_modules(names: Sequence[str], by: By = "this") -> Tally:
    """Compile these loops, or load them from numba's cache.

    `by` this process, by all (this one and its helpers, a process a core), or by others: one that is to run tasks has
    no memory for a compiler.

    Returns the loops of this process, and how many of them it and its helpers had to compile.
    """
    from blocksar.kernels.loops import tally

    started, lacking = perf_counter(), [] if by == "this" else missing(names)
    # What is little to compile is not worth the start of another process, unless this one must not.
    helpers = _start_helpers(lacking, machine()[0] - (by == "all")) if len(lacking) > (by == "all") else []
    try:
        for helper in helpers if by == "others" else ():
            helper.wait()  # it prints a number only
        with uncollected():
            for loop in _compile_free(names):
                loop.compile()
        printed = [helper.communicate()[0].strip() for helper in helpers]
        _keep_young(lacking)
    finally:
        for helper in helpers:
            helper.kill()
        if lacking:
            note_compilation(perf_counter() - started)
    loaded = tally("blocksar")
    return loaded._replace(compiled=loaded.compiled + sum(int(count) for count in printed if count.isdigit()))


def help_to_compile(names: Iterable[str]) -> int:
    """Compile those loops that no other process is compiling; return the number of loops compiled here."""
    from blocksar.kernels.loops import tally

    with uncollected():
        _compile_free(names)
    return tally("blocksar").compiled


def _compile_free(names: Iterable[str]) -> list[Loop]:
    """Compile or load those loops that no other process is compiling; return the others."""
    return [loop for name in names for loop in loops_named(name) if not loop.compile(wait=False)]


def loops_named(name: str) -> list[Loop]:
    """Return the loops named `module`, or one as `module:loop`."""
    from blocksar.kernels.loops import loops_of

    module, _, only = name.partition(":")
    if _found(module) is None:
        return []
    return [loop for loop in loops_of(import_module(f"blocksar.{module}")) if only in ("", loop.__name__)]


def _start_helpers(names: Sequence[str], most: int) -> list[subprocess.Popen[str]]:
    """Start up to `most` processes that compile loops; this process compiles what they do not."""
    paths = [str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])]
    start = partial(
        subprocess.Popen, [sys.executable, "-P", "-c", HELP, *names],  # not what lies in the working directory
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
    )  # fmt: skip
    return [start() for _ in range(min(most, len(names)))]
