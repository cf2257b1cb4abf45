"""The start of a command that needs workers: their imports begin before those of the command."""

from __future__ import annotations

import os
from collections.abc import Sequence

from blocksar.graph.compiling import kernels_cached
from blocksar.graph.forking import start_fork_server
from blocksar.graph.machine import resources


def start_early(sources: Sequence[str], out: str, *, workers: int | None, threads: int | None) -> None:
    """Start the process that workers are forked from, if `focus` with these arguments will probably need it.

    It will not if one of the sources does not exist, or if the run folder may hold a finished run; nor before loops
    are compiled.
    """
    there = all(os.path.exists(source) for source in sources)
    if workers != 0 and there and not os.path.exists(out) and kernels_cached():
        start_fork_server(resources(workers, threads, None).threads)
