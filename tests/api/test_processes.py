"""Odd processes and sessions: each does the work, with a note if done otherwise, or says at once what to do."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cloudpickle
import pytest
from arrays import arrays
from distributed import Client, LocalCluster

import blocksar
from blocksar.application.workforce import choose_workforce
from blocksar.errors import InputError

CALL = "blocksar.focus({store!r}, {out!r}, grid='-9:9:1,-9:9:1', {more})"
SCRIPT = f"import blocksar; print(*{CALL}.summary, sep='\\n')"
DELETED = f"""
import os, tempfile
import blocksar
with tempfile.TemporaryDirectory() as folder:
    os.chdir(folder)
try:
    blocksar.focus({{store!r}}, {{out!r}}, grid='-9:9:1,-9:9:1', workers=1)
except blocksar.InputError as error:
    print(error, os.path.exists({{out!r}}))
print({CALL}.summary)
"""
HERE = "note: this process does the work: no workers can start, since "
REFUSED = "no workers can start: {}; leave workers out, or give 0: this process does the work"
FOLDER, DAEMON = "the working folder was deleted", "this process is a daemon, as workers of a multiprocessing.Pool, "


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("processes") / "ph.zarr"
    blocksar.write(blocksar.collection(**arrays()), path)
    return str(path)


@pytest.mark.parametrize(
    ("way", "script", "more", "said"),
    [
        ("stdin", SCRIPT, "workers=1", ["peak memory of a worker"]),
        ("-c without HOME", SCRIPT, "workers=1", ["peak memory of a worker"]),
        ("stdin in a deleted folder", DELETED, "", [REFUSED.format(FOLDER) + " False", HERE + FOLDER]),
    ],
)
def test_a_script_is_run_in_any_way(
    way: str, script: str, more: str, said: list[str], store: str, tmp_path: Path
) -> None:
    text = script.format(store=store, out=str(tmp_path / "run"), more=more)
    given = ["-"] if "stdin" in way else ["-c", text]
    environment = {name: value for name, value in os.environ.items() if name != "HOME" or "HOME" not in way}
    done = subprocess.run(
        [sys.executable, *given], input=text, capture_output=True, text=True, check=False, env=environment, timeout=100
    )
    assert done.returncode == 0 and not done.stderr, done.stderr
    assert all(line in done.stdout for line in said)


def _focus(store: str, out: str, **more: Any) -> str:
    try:
        return "\n".join(blocksar.focus(store, out, grid="-9:9:1,-9:9:1", **more).summary)
    except InputError as error:
        return f"InputError: {error}"


def test_a_daemon_does_the_work_itself(store: str, tmp_path: Path) -> None:
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert (HERE + DAEMON) in pool.apply(_focus, (store, str(tmp_path / "run")))
        assert "no workers can start: " + DAEMON in pool.apply(_focus, (store, str(tmp_path / "b")), {"workers": 1})
        assert not (tmp_path / "b").exists()
        again = pool.apply(blocksar.focus, (store, tmp_path / "run"), {"grid": "-9:9:1,-9:9:1"})
    assert "nothing to do" in again.summary[-1]


def test_a_thread_with_an_event_loop_starts_workers(store: str, tmp_path: Path) -> None:
    async def focus() -> str:
        return _focus(store, str(tmp_path / "run"), workers=1)

    with ThreadPoolExecutor(1) as threads:
        assert "peak memory of a worker" in threads.submit(asyncio.run, focus()).result(60)


def test_the_active_client_does_the_work(client: Client, store: str, tmp_path: Path) -> None:
    address = client.scheduler_info()["address"]
    with client.as_current():
        active = blocksar.focus(store, tmp_path / "active", grid="-9:9:1,-9:9:1")
        own = choose_workforce(client=None, scheduler=None, workers=1, wait_workers=0)
        plan = blocksar.plan(store, grid="-9:9:1,-9:9:1")
    note = f"note: work goes to dask's active client ({address}); give workers for a cluster of its own"
    assert note in active.summary and note in plan.summary and own == (None, None, 1, [])
    scheduler: Any = client
    given = blocksar.focus(store, tmp_path / "given", grid="-9:9:1,-9:9:1", scheduler=scheduler)
    assert not any("active client" in line for line in given.summary)


def test_a_client_that_cannot_do_the_work_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    settings: dict[str, Any] = {"n_workers": 1, "threads_per_worker": 1, "processes": False, "dashboard_address": None}
    with LocalCluster(**settings) as threads, Client(threads, set_as_default=False) as other:
        with other.as_current():
            chosen = choose_workforce(client=None, scheduler=None, workers=None, wait_workers=0, device="gpu")
            assert chosen.client is None and "no worker of the cluster has a GPU" in chosen.notes[0]
            monkeypatch.setattr(Client, "asynchronous", True)
            chosen = choose_workforce(client=None, scheduler=None, workers=None, wait_workers=0)
            assert chosen.notes == ["note: dask's active client is not used: it is asynchronous"]
            monkeypatch.undo()

        def choose() -> Any:
            return tuple(choose_workforce(client=None, scheduler=None, workers=None, wait_workers=0))

        assert other.submit(choose).result(30) == (None, None, None, [])  # a task that waits for tasks


def test_functions_that_name_the_package_are_sent_to_workers() -> None:
    def version() -> Any:
        return blocksar, blocksar.__version__, blocksar.collection

    assert cloudpickle.loads(cloudpickle.dumps(version))() == (blocksar, blocksar.__version__, blocksar.collection)
    for name in set(blocksar.__all__) - {"__version__"}:
        each = getattr(blocksar, name)
        assert pickle.loads(pickle.dumps(each)) is each, name
    assert dir(blocksar) == sorted(blocksar.__all__)
