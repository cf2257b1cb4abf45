"""Another blocksar, measured beside this one (--against)."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from blocksar.errors import InputError, ProcessingError

SCRIPT = Path(__file__).with_name("timed_focus.py")


class OtherVersion(NamedTuple):
    """A process of another Python that focuses on request, on a warm cluster of its own."""

    python: str
    process: subprocess.Popen[str]
    version: str

    def focus(self, store: Path, run: Path, *, blocks: int) -> float:
        """Focus into an empty folder; seconds from call to return.

        Raises
        ------
        ProcessingError
            If it fails; the process has printed the reason.
        """
        assert self.process.stdin is not None
        try:
            self.process.stdin.write(json.dumps({"store": str(store), "run": str(run), "blocks": blocks}) + "\n")
            self.process.stdin.flush()
        except BrokenPipeError:
            pass  # it has ended: there is no answer either
        if (seconds := _answer(self.process)) is None:
            raise ProcessingError(f"blocksar {self.version} of --against {self.python} failed; see its message above")
        return float(seconds)


@contextmanager
def other_version(python: str, *, workers: int, threads: int, memory_limit: int) -> Iterator[OtherVersion]:
    """Start a Python that has another blocksar installed, with a cluster like ours; memory limit in bytes a worker.

    Raises
    ------
    InputError
        If it cannot be started, or has no blocksar.
    """
    command = [python, "-P", str(SCRIPT), str(workers), str(threads), str(memory_limit)]
    # PYTHONPATH may name this blocksar.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    try:
        started = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )  # fmt: skip
    except OSError as error:
        raise InputError(f"--against {python} cannot be run ({error.strerror}); give the path of a Python") from None
    with started as process:  # closes its standard input, and waits
        if (version := _answer(process)) is None:
            raise InputError(f"--against {python} cannot start blocksar; install it there, or see its message above")
        yield OtherVersion(python, process, str(version))


def _answer(process: subprocess.Popen[str]) -> Any:
    """The next line of output, read as JSON; None at the end of the output."""
    assert process.stdout is not None
    line = process.stdout.readline()
    return json.loads(line) if line else None
