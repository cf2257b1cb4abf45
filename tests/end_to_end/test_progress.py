"""Progress of real runs in a terminal, a listener and a log, including their endings."""

from __future__ import annotations

import importlib.util
import os
import pty
import signal
import subprocess
import sys
import termios
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from distributed import Client
from fake_clock import HIDDEN, SHOWN, strictly
from faults import make_store, until

import blocksar
from blocksar.errors import InputError
from blocksar.graph import recording
from blocksar.progress import Listener, Work

needs_bokeh = pytest.mark.skipif(importlib.util.find_spec("bokeh") is None, reason="bokeh is not installed")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_store(tmp_path_factory.mktemp("progress") / "store")


@contextmanager
def in_terminal(*command: str) -> Iterator[tuple[subprocess.Popen[bytes], Callable[[], bytes]]]:
    """Run a program whose stderr is a terminal of 80 columns; yield it with a function that reads its output."""
    ours, theirs = pty.openpty()
    termios.tcsetwinsize(theirs, (24, 80))
    environment = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "NO_COLOR")}
    seen = bytearray()

    def read() -> bytes:
        with suppress(OSError):  # Linux raises this when the other end is closed
            while True:
                data = os.read(ours, 65536)
                seen.extend(data)
        return bytes(seen)

    os.set_blocking(ours, False)
    with subprocess.Popen(
        command, stderr=theirs, stdout=subprocess.DEVNULL, env=environment | {"TERM": "xterm"}, start_new_session=True
    ) as process:
        os.close(theirs)
        try:
            yield process, read
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            os.close(ours)


HANGING = """
import time
from blocksar import api
def focus(source, out, progress, **settings):
    progress.update("recover", 1, 4)
    try:
        time.sleep(1e6)
    finally:
        time.sleep(1e6)
api.focus = focus
from blocksar import cli
from blocksar.cli import endings
endings.GRACE = 0.2
cli.main()
"""


def test_a_run_that_hangs_while_ending_restores_the_terminal(tmp_path: Path) -> None:
    log = tmp_path / "log.jsonl"
    typed = ("focus", "ph.zarr", "--out", "run", "--json-log", str(log))
    with in_terminal(sys.executable, "-c", HANGING, *typed) as (process, read):
        until(lambda: log.exists() and "recover" in log.read_text(), "the run to begin")
        process.send_signal(signal.SIGTERM)
        until(lambda: (read(), process.poll() is not None)[1], "the run to end")
        written = read()
    assert process.returncode == 143
    assert written.rfind(SHOWN) > written.rfind(HIDDEN) >= 0
    last = strictly(log.read_text())[-1]
    assert (last["event"], last["status"]) == ("end", 143)


class Heard(Listener):
    """Record what is expected, and how many units there are."""

    def __init__(self) -> None:
        self.work: Work = {}
        self.totals: dict[str, int] = {}

    def expect(self, work: Work, workers: int) -> None:
        self.work = work

    def update(self, stage: str, done: int, total: int) -> None:
        self.totals[stage] = total


@pytest.mark.slow
@pytest.mark.parametrize(
    ("processor", "more", "stages"),
    [
        ("angular-division", {"blocks": 3, "coefficients": "closed-form"}, ["recover", "focus", "mosaic"]),
        ("backprojection", {}, ["inspect", "backprojection"]),
    ],
)
def test_units_of_raw_echo_and_back_projection_are_predicted(
    processor: Any, more: dict[str, Any], stages: list[str], client: Client, tmp_path: Path
) -> None:
    raw = make_store(tmp_path / "raw", raw=True)
    heard = Heard()
    grid = ((15900.0, 16300.0, 8.0), (19000.0, 19400.0, 8.0))
    blocksar.focus(raw, tmp_path / "run", progress=heard, processor=processor, client=client, grid=grid, **more)
    stages = ["range-compress", *stages, "finish"]
    assert list(heard.work) == stages
    assert {stage: len(heard.work[stage]) for stage in stages} == {stage: heard.totals[stage] for stage in stages}


@pytest.mark.slow
def test_without_bokeh_there_is_no_dashboard_or_performance_report(
    store: Path, client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "bokeh" else found(name))
    assert recording.dashboard(client) is None
    with pytest.raises(InputError, match=r"bokeh is not installed.*install blocksar\[dashboard\]"):
        blocksar.focus(store, tmp_path / "run", client=client, performance_report=tmp_path / "page.html")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@needs_bokeh
def test_the_dashboard_is_made_when_somebody_looks_at_it(client: Client) -> None:
    address = recording.dashboard(client)
    assert address is not None
    for page in ("status", "", "workers"):
        with urllib.request.urlopen(address.replace("status", page)) as answer:
            assert b"bokeh" in answer.read().lower()


@needs_bokeh
@pytest.mark.parametrize("name", [".", "no/such/folder/page.html"])
def test_an_unwritable_performance_report_is_refused_before_the_run(
    name: str, store: Path, client: Client, tmp_path: Path
) -> None:
    address = recording.dashboard(client)
    assert address is not None and address.startswith("http://127.0.0.1:")
    for call in (
        lambda: blocksar.focus(store, tmp_path / "run", client=client, performance_report=tmp_path / name),
        lambda: blocksar.api.demo(tmp_path / "run", performance_report=tmp_path / name),
    ):
        with pytest.raises(InputError, match=r"cannot be written.*give another file"):
            call()
    assert not list(tmp_path.iterdir())
