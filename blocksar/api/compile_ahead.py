"""compile: compile all loops ahead of time, into numba's cache."""

from __future__ import annotations

import os
import time

from blocksar.application.reports import Report, only_stage
from blocksar.graph.compiling import LOOPS, compile_modules
from blocksar.progress import Wanted as Progress


def compile(*, progress: Progress | None = None) -> Report:
    """Compile all loops into numba's cache, for images of containers and for machines whose workers share a cache.

    Without it the first command that needs a loop compiles it. The cache is the folder NUMBA_CACHE_DIR, by default
    `__pycache__` beside each module, or `blocksar` among the user's caches where that cannot be written. It holds for
    one version of blocksar and numba and one type of processor.

    Parameters
    ----------
    progress : object with a method update(stage, done, total), or False, optional
        As in `focus`. Default: bars in a notebook, silence elsewhere.

    Returns
    -------
    Report
        `summary` is a sentence. `result` is a dict: numbers of `loops` and of those `compiled`, `seconds`, `folder`.

    Raises
    ------
    InputError
        If there is no folder to keep compiled loops in.
    """
    update, started = only_stage(progress, "compile"), time.perf_counter()
    update(0, 1)
    count, compiled, folder = compile_modules(LOOPS, by="all")
    update(1, 1)
    chosen = os.environ.get("NUMBA_CACHE_DIR", "")
    folder = chosen if chosen and folder.startswith(chosen) else folder
    seconds = time.perf_counter() - started
    if compiled == 0:
        sentence = f"all {count} loops are compiled already, in {folder}"
    else:
        sentence = f"compiled {compiled} of {count} loops in {seconds:.0f} s, into {folder}"
    result = {"loops": count, "compiled": compiled, "seconds": seconds, "folder": folder}
    return Report(summary=[sentence], result=result)
