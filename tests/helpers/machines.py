"""Two machines on one: network namespaces that a pair of virtual Ethernet devices joins.

Each namespace is held by a process that waits on a pipe of ours: however this process ends, so do they, and with the
last process in it the kernel removes a namespace and its devices. Nothing has a name that could be left behind.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import pytest

HOLD = ["sh", "-c", "echo ready && exec cat"]


@dataclass(frozen=True)
class Machine:
    """A network of its own, and the file system of all.

    Attributes
    ----------
    address : str
        By which the other machine reaches it.
    holder : int
        Process that keeps it alive.
    enter : sequence of str
        What stands before a command that is to run there.
    """

    address: str
    holder: int
    enter: Sequence[str]

    def start(self, *command: str, **more: Any) -> subprocess.Popen[str]:
        return subprocess.Popen([*self.enter, *command], text=True, **more)

    def run(self, *command: str) -> None:
        """Run a command there to its good end."""
        done = subprocess.run([*self.enter, *command], capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{' '.join(command)}: {done.stderr}"


@contextmanager
def two_machines() -> Iterator[tuple[Machine, Machine]]:
    """Two machines that reach each other, and nothing else; skips the test where they may not be made."""
    with ExitStack() as stack:
        try:
            first = stack.enter_context(_machine("10.77.0.1", user=os.geteuid() != 0))
            second = stack.enter_context(_machine("10.77.0.2", beside=first))
            first.run(*f"ip link add cable type veth peer name cable netns {second.holder}".split())
        except (OSError, AssertionError) as error:
            pytest.skip(f"no network namespaces here: {error}")
        for machine in (first, second):
            machine.run("ip", "link", "set", "lo", "up")
            machine.run("ip", "address", "add", f"{machine.address}/24", "dev", "cable")
            machine.run("ip", "link", "set", "cable", "up")
        yield first, second


@contextmanager
def _machine(address: str, *, user: bool = False, beside: Machine | None = None) -> Iterator[Machine]:
    """One machine: as root of a user namespace of its own for `user` who is not root, or in that of another."""
    prefix = [] if beside is None else [word for word in beside.enter if word != "--net"]
    unshare = [*prefix, "unshare", "--net", *(["--user", "--map-root-user"] if user else [])]
    with subprocess.Popen(
        [*unshare, *HOLD], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdin is not None and holder.stdout is not None and holder.stderr is not None
        try:
            ready = holder.stdout.readline()
            assert ready, holder.stderr.read().strip()
            inside = user or (beside is not None and "--user" in beside.enter)
            options = ["--user", "--preserve-credentials"] if inside else []
            enter = ["nsenter", "--target", str(holder.pid), "--net", *options, "--"]
            yield Machine(address, holder.pid, enter)
        finally:
            holder.stdin.close()
            holder.wait(30)
