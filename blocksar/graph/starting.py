"""The start of a command that needs workers: their imports begin before those of the command."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from blocksar.graph.compiling import kernels_cached
from blocksar.graph.forking import start_fork_server
from blocksar.graph.machine import resources

# With one of these no workers are started here, or the command line alone does not say how many threads they have.
OTHERWISE = ("-h", "--help", "--scheduler", "--dry-run", "--print-config", "--config")


def start_at_once(words: Sequence[str]) -> None:
    """Start the process that workers are forked from, if the words after a command say that it will probably need it.

    They are looked at before anything is imported that could read them. In doubt nothing is started: the command does
    that once it has read them.
    """
    if None in (sys.stdin, sys.stdout, sys.stderr):  # pipes would take the numbers of closed streams
        return
    out, workers, threads = (_value_of(words, name) for name in ("--out", "--workers", "--threads"))
    if any(word.split("=")[0] in OTHERWISE for word in words) or not any(os.path.exists(word) for word in words):
        return
    if out is not None and _is_number(workers, least=0) and _is_number(threads, least=1):
        start_early(
            (),
            out,
            workers=None if workers is None else int(workers),
            threads=None if threads is None else int(threads),
        )


def _value_of(words: Sequence[str], name: str) -> str | None:
    """The value of an option: the word after its name, or the rest of its own; the last one if there are several."""
    found = None
    for word, following in zip(words, [*words[1:], None], strict=True):
        if word == name:
            found = following
        elif word.startswith(f"{name}="):
            found = word.removeprefix(f"{name}=")
    return found


def _is_number(text: str | None, *, least: int) -> bool:
    return text is None or (text.isdecimal() and int(text) >= least)


def start_early(sources: Sequence[str], out: str, *, workers: int | None, threads: int | None) -> None:
    """Start the process that workers are forked from, if `focus` with these arguments will probably need it.

    It will not if one of the sources does not exist, or if the run folder may hold a finished run; nor before loops
    are compiled.
    """
    there = all(os.path.exists(source) for source in sources)
    if workers != 0 and there and not os.path.exists(out) and kernels_cached():
        start_fork_server(resources(workers, threads, None).threads)
