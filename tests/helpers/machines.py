"""Two simulated machines: network namespaces joined by a pair of virtual Ethernet devices.

A process that waits on a pipe of this process holds each namespace. When this process ends, in whatever way, the
holders end too, and the kernel removes a namespace and its devices with its last process. Nothing is named, so nothing
can be left behind.
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
    """A machine with its own network and the shared file system.

    Attributes
    ----------
    address : str
        Address at which the other machine reaches it.
    holder : int
        Process that keeps the namespace alive.
    enter : sequence of str
        Command prefix that runs a command in the namespace.
    """

    address: str
    holder: int
    enter: Sequence[str]

    def start(self, *command: str, **more: Any) -> subprocess.Popen[str]:
        return subprocess.Popen([*self.enter, *command], text=True, **more)

    def run(self, *command: str) -> None:
        """Run a command on the machine and check that it succeeds."""
        done = subprocess.run([*self.enter, *command], capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{' '.join(command)}: {done.stderr}"


@contextmanager
def two_machines() -> Iterator[tuple[Machine, Machine]]:
    """Yield two machines that reach only each other; skip the test where namespaces are not permitted."""
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
    """Yield one machine: in a new user namespace if `user`, or in the user namespace of the machine `beside`."""
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
            holder.wait()
