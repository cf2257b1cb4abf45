"""What is paid before the samples: planning, cold starts from a shell, and compilation."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from benchmarks.folders import empty_folder
from benchmarks.scenes import Case, Scale, plan_case
from blocksar.errors import InputError
from blocksar.processors.chain.planning.planner import plan_collection

COMMAND = (sys.executable, "-m", "blocksar")
PLAIN = "from blocksar.graph.compiling import TASKS, compile_modules; compile_modules(TASKS)"  # as `focus` does
BLOCKS = (200, 1000)  # of the plans that are timed beside `auto`
SCALED = Scale(4, 4)


def planning_seconds(source: str, case: Case, *, workers: int, memory_limit: int) -> dict[str, float]:
    """Seconds of this process's processors for plans of the case's collection, and of the scene at 4x4."""
    collection = case.plan.geometry.collection
    seconds = {}
    for blocks in ("auto", *BLOCKS):
        with suppress(InputError):  # a scene may be too small for so many
            started = time.process_time()
            plan_collection(collection, blocks=blocks, workers=workers, memory_limit=memory_limit)
            seconds[f"{blocks} blocks" if isinstance(blocks, int) else blocks] = time.process_time() - started
    with suppress(InputError):
        larger = plan_case(source, SCALED, blocks="auto", workers=workers, memory_limit=memory_limit)
        started = time.process_time()
        plan_collection(
            larger.plan.geometry.collection, blocks="auto", workers=workers, memory_limit=memory_limit
        )  # fmt: skip
        seconds[f"{SCALED}, auto"] = time.process_time() - started
    return seconds


def shell_seconds(store: Path, folder: Path, case: Case, *, workers: int, repeats: int) -> dict[str, list[float]]:
    """Seconds of commands from their start to their end, with bytecode of all modules, as an installation has it."""
    run = folder / "from-a-shell"
    focus = ("focus", str(store), "--out", str(run), "--blocks", str(case.plan.n_blocks), "--workers", str(workers))
    commands = {"blocksar --help": ("--help",), "blocksar plan": ("plan", str(store)), "blocksar focus": focus}
    seconds: dict[str, list[float]] = {name: [] for name in commands}
    bytecode = str(folder / "bytecode")
    for number in range(repeats + 1):
        for name, arguments in commands.items():
            if name == "blocksar focus":
                empty_folder(run)
            taken = _timed((*COMMAND, *arguments), PYTHONDONTWRITEBYTECODE="", PYTHONPYCACHEPREFIX=bytecode)
            if number:  # the first one of each writes the bytecode
                seconds[name].append(taken)
    shutil.rmtree(bytecode)
    return seconds


def compilation() -> dict[str, float]:
    """Seconds to compile what a plain run needs, and of `blocksar compile` with an empty cache and with a full one."""
    seconds = {}
    with tempfile.TemporaryDirectory() as cache:
        seconds["plain run"] = _timed((sys.executable, "-c", PLAIN), NUMBA_CACHE_DIR=cache)
    with tempfile.TemporaryDirectory() as cache:
        for name in ("empty cache", "full cache"):
            seconds[name] = _timed((*COMMAND, "compile"), NUMBA_CACHE_DIR=cache)
    return seconds


def _timed(command: Sequence[str], **environment: str) -> float:
    started = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True, env=os.environ | environment)
    return time.perf_counter() - started


def describe(planning: dict[str, float], shell: dict[str, list[float]], compiling: dict[str, float]) -> dict[str, Any]:
    """The JSON object of these figures, s."""
    return {"planning_processor_seconds": planning, "commands": shell, "compile": compiling}
