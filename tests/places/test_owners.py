"""Whether the owner of a lock is alive, as its record tells."""

from __future__ import annotations

import json
import subprocess
import sys

import psutil
import pytest

from blocksar.places.locks import is_alive, this_process


@pytest.mark.skipif(sys.platform != "linux", reason="Linux counts the start of processes from the boot")
def test_an_owner_is_alive_after_the_clock_was_set(monkeypatch: pytest.MonkeyPatch) -> None:
    """The boot's time of day moves with the clock, and with it that of every process."""
    owner = json.dumps(this_process()).encode()
    create_time, boot_time = psutil.Process.create_time, psutil.boot_time
    monkeypatch.setattr(psutil.Process, "create_time", lambda process: create_time(process) + 3600.0)
    monkeypatch.setattr(psutil, "boot_time", lambda: boot_time() + 3600.0)
    assert is_alive(owner)


def test_another_process_of_the_same_number_and_one_that_has_ended_are_not_the_owner() -> None:
    record = this_process()
    assert is_alive(json.dumps(record).encode())
    assert not is_alive(json.dumps(record | {"process_started": record["process_started"] - 5.0}).encode())
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        ended.wait()
    assert not is_alive(json.dumps(record | {"pid": ended.pid}).encode())
