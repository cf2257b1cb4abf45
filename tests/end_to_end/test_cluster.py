"""Communication and safety of runs: two machines, TLS, loopback, leftover files and evaluation of input."""

from __future__ import annotations

import ast
import contextlib
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from distributed import Client, Future, LocalCluster
from faults import digests, litter, until
from machines import two_machines
from repository import ROOT
from scenes import write_store

import blocksar
from blocksar.errors import InputError, ProcessingError
from blocksar.graph import cluster, units
from blocksar.places import place
from blocksar.progress import Listener
from blocksar.runs.receipts import Run

SCENE: dict[str, Any] = {
    "swath": [29900.0, 30100.0],
    "prf": 4000.0,
    "duration": 0.1,
    "steering": (49.0, 51.0),
    "dwell": 0.03,
    "more": '[[targets]]\nname = "P"\nrange = 30000.0\nyaw_deg = 50.0\n',
}
SETTINGS: dict[str, Any] = {
    "blocks": 3,
    "coefficients": "closed-form",
    "grid": ((15600.0, 16600.0, 4.0), (18600.0, 19750.0, 4.0)),
}
WORDS = ("--blocks", "3", "--coefficients", "closed-form", "--grid", "15600:16600:4,18600:19750:4", "--threads", "1")
BLOCKSAR = (sys.executable, "-m", "blocksar")
SCHEDULER = (sys.executable, "-m", "distributed.cli.dask_scheduler", "--no-dashboard")
WORKER = (sys.executable, "-m", "distributed.cli.dask_worker", "--no-dashboard", "--nthreads", "1")
LOOPBACK = {"127.0.0.1", "::1"}


def test_workers_are_counted_while_the_client_asks_for_something_else(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    forget = property(lambda _: {"workers": {}}, lambda _, answer: None)  # a later answer came
    monkeypatch.setattr(Client, "_scheduler_identity", forget, raising=False)
    assert not client.scheduler_info(n_workers=-1)["workers"]
    assert units.workers_of(client).keys() == client.nthreads().keys()
    assert cluster.cluster_size(client) == (2, 3 * 2**30)
    assert cluster.cluster_size(client, workers=1, memory_limit=2**30) == (1, 2**30)
    assert cluster.cluster_size(client, workers=8, memory_limit=2**40) == (2, 3 * 2**30)


def test_units_lost_by_the_scheduler_are_started_again(
    client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker may die with a result that has not been fetched yet."""
    started, submit, run = [], client.submit, Run(folder=place(tmp_path), identity="x", threads=1)

    def start(task: Any, unit: units.Unit, **how: Any) -> Future[Any]:
        started.append(unit.name)
        future = submit(task, unit, **how)
        if started.count(unit.name) < 3 and unit.name in "bc":
            client.cancel([future], force=True)
        return future

    monkeypatch.setattr(client, "submit", start)
    todo = [units.Unit("forgotten", run, name, lambda _, name: time.sleep(0.2) or name) for name in "abcd"]
    outcomes = dict(units.OnCluster(client, Listener()).execute("focus", todo, per_worker=2))
    assert outcomes == {unit: unit for unit in "abcd"}
    assert [started.count(unit) for unit in "ad"] == [1, 1] and min(started.count(unit) for unit in "bc") >= 3


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_store(tmp_path_factory.mktemp("tiny"), **SCENE)


@pytest.fixture(scope="module")
def image(store: Path, client: Client, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Digests of the image expected from every cluster."""
    run = tmp_path_factory.mktemp("here") / "run"
    blocksar.focus(store, run, client=client, **SETTINGS)
    found = digests(run / "image.zarr")
    assert len(found) > 3
    return found


class Said:
    """Programs that run beside a test, and their output."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.stack = contextlib.ExitStack()

    def __enter__(self) -> Said:
        return self

    def __exit__(self, *_: object) -> None:
        self.stack.close()

    def start(self, start: Any, name: str, *command: str, **more: Any) -> subprocess.Popen[str]:
        """Start a program through `start`, on this or another machine; it is killed at the end of the block."""
        with open(self.folder / name, "w") as output:
            process = start(*command, stdout=output, stderr=output, **more)
        self.stack.callback(process.wait)
        self.stack.callback(process.kill)
        return process

    def text(self, name: str) -> str:
        return (self.folder / name).read_text()

    def await_line(self, name: str, text: str) -> None:
        until(lambda: text in self.text(name), f"{text!r} from {name}")


def here(*command: str, **more: Any) -> subprocess.Popen[str]:
    return subprocess.Popen(command, text=True, **more)


# ---------------------------------------------------------------- workers that come late, and that go

FOREVER = 1e6  # s


class Foreman(Listener):
    """Calls for a worker when it is noted that there is none, and sends all home once, when a unit is done."""

    def __init__(self, client: Client, *, goes: bool = False) -> None:
        self.client, self.goes = client, goes
        self.notes: list[str] = []

    def update(self, stage: str, done: int, total: int) -> None:
        if self.goes and stage == "recover" and done:
            self.goes = False
            self.client.cluster.scale(0)
            until(lambda: not units.workers_of(self.client), "the end of the worker")

    def note(self, text: str, *, again: bool = False) -> None:
        self.notes.append(text)
        self.client.cluster.scale(1)


@pytest.fixture
def nobody() -> Iterator[Client]:
    """A cluster in this process that has no worker yet."""
    settings: dict[str, Any] = {"n_workers": 0, "threads_per_worker": 1, "processes": False, "memory_limit": 2**31}
    with LocalCluster(**settings, dashboard_address="127.0.0.1:0") as threads, Client(threads) as connected:
        yield connected


@pytest.mark.slow
def test_a_run_waits_for_its_first_worker_and_when_its_last_one_goes(
    store: Path, image: dict[str, str], nobody: Client, tmp_path: Path
) -> None:
    foreman = Foreman(nobody, goes=True)
    blocksar.focus(store, tmp_path / "run", client=nobody, wait_workers=FOREVER, progress=foreman, **SETTINGS)
    assert foreman.notes == [
        "the dask scheduler has no worker: waiting for one, at most 1e+06 s",
        "no worker is left: waiting for one, at most 1e+06 s",
    ]
    assert digests(tmp_path / "run" / "image.zarr") == image


def test_a_run_that_is_not_to_wait_fails_at_once(store: Path, nobody: Client, tmp_path: Path) -> None:
    settings: dict[str, Any] = {"client": nobody, "wait_workers": 0, **SETTINGS}
    for start in (blocksar.focus, blocksar.autofocus):
        more = SETTINGS if start is blocksar.focus else {}
        with pytest.raises(
            InputError, match=r"scheduler has no worker; start some, or wait longer for them \(wait_workers\)"
        ):
            start(store, tmp_path / "run", client=nobody, wait_workers=0, **more)
    assert not (tmp_path / "run").exists()
    nobody.cluster.scale(1)
    nobody.wait_for_workers(1)
    with pytest.raises(ProcessingError, match=r"no worker for 0 s; start .*the same command goes on from there"):
        blocksar.focus(store, tmp_path / "run", progress=Foreman(nobody, goes=True), **settings)


# ---------------------------------------------------------------- two machines


@pytest.mark.slow
def test_two_machines_compute_the_same_bytes(store: Path, image: dict[str, str], tmp_path: Path) -> None:
    """Scheduler and main process on one, workers on the other; input and run lie in a shared folder."""
    address = "tcp://10.77.0.1:8786"
    with two_machines() as (first, second), Said(tmp_path) as said:
        said.start(first.start, "scheduler", *SCHEDULER, "--host", first.address, "--port", "8786")
        worker = (*WORKER, address, "--host", second.address, "--local-directory", str(tmp_path), "--memory-limit")
        said.start(second.start, "worker", *worker, "2GiB", "--nworkers", "1")
        until(lambda: said.text("worker").count("Registered to") == 1, "the worker")
        command = (*BLOCKSAR, "focus", str(store), "--out", str(tmp_path / "run"), *WORDS, "--scheduler", address)
        run = said.start(first.start, "main", *command)
        assert run.wait() == 0, said.text("main")
        assert said.text("scheduler").count(f"tcp://{second.address}:"), "the worker was elsewhere"
    assert digests(tmp_path / "run" / "image.zarr") == image


# ---------------------------------------------------------------- TLS


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Environment variables of dask's configuration for a certificate authority and a certificate of this machine."""
    trustme = pytest.importorskip("trustme")
    folder = tmp_path_factory.mktemp("certificates")
    authority = trustme.CA()
    authority.cert_pem.write_to_path(str(folder / "authority.pem"))
    authority.issue_cert("127.0.0.1").private_key_and_cert_chain_pem.write_to_path(str(folder / "machine.pem"))
    tls, roles = "DASK_DISTRIBUTED__COMM__TLS__", ("SCHEDULER", "WORKER", "CLIENT")
    parts = {f"{tls}{role}__{kind}": str(folder / "machine.pem") for role in roles for kind in ("CERT", "KEY")}
    return {
        f"{tls}CA_FILE": str(folder / "authority.pem"),
        "DASK_DISTRIBUTED__COMM__REQUIRE_ENCRYPTION": "true",
    } | parts


@pytest.mark.slow
def test_tls_is_configured_through_dask(
    store: Path, image: dict[str, str], certificates: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run with certificates succeeds; without certificates or encryption it is refused with a one-line message."""
    secure = os.environ | certificates
    with Said(tmp_path) as said:
        loopback = ("--host", "127.0.0.1", "--protocol", "tls")
        file = tmp_path / "scheduler.json"
        said.start(here, "scheduler", *SCHEDULER, *loopback, "--port", "0", "--scheduler-file", str(file), env=secure)
        until(lambda: file.exists() and file.read_text().endswith("}"), "the scheduler")
        port = said.text("scheduler").partition("tls://127.0.0.1:")[2].split()[0]
        local = ("--local-directory", str(tmp_path), "--memory-limit", "2GiB", "--no-nanny")
        said.start(here, "worker", *WORKER, f"tls://127.0.0.1:{port}", *loopback, *local, env=secure)
        said.await_line("worker", "Registered to")

        monkeypatch.setattr(cluster, "CONNECT", 2.0)
        for scheme in ("tls", "tcp"):
            with pytest.raises(InputError, match="no dask scheduler answers at") as refused:
                blocksar.focus(store, tmp_path / "run", **SETTINGS, scheduler=f"{scheme}://127.0.0.1:{port}")
            assert "\n" not in str(refused.value)
            assert not (tmp_path / "run").exists()

        command = (*BLOCKSAR, "focus", str(store), "--out", str(tmp_path / "run"), *WORDS)
        run = said.start(here, "main", *command, "--scheduler", f"tls://127.0.0.1:{port}", env=secure)
        assert run.wait() == 0, said.text("main")
    assert digests(tmp_path / "run" / "image.zarr") == image


# ---------------------------------------------------------------- local cluster


@pytest.mark.slow
def test_a_local_cluster_listens_on_loopback_only_and_leaves_no_files(
    store: Path, image: dict[str, str], tmp_path: Path
) -> None:
    """Observe the sockets of all processes of a run, and its temporary files during and after the run."""
    temporary, out = tmp_path / "tmp", tmp_path / "run"
    temporary.mkdir()
    sockets: dict[tuple[str, int], str] = {}
    scratch: set[str] = set()
    strays: set[str] = set()
    with Said(tmp_path) as said:
        run = said.start(
            here, "main", *BLOCKSAR, "focus", str(store), "--out", str(out), *WORDS, "--workers", "1",
            env=os.environ | {"TMPDIR": str(temporary)},
        )  # fmt: skip
        main = psutil.Process(run.pid)
        while run.poll() is None:
            sockets |= listening(main)
            scratch |= {path.name for path in out.glob("scratch/*/*")}
            strays |= set(os.listdir(temporary))
            time.sleep(0.2)
        assert run.returncode == 0, said.text("main")
    assert {ip for ip, _ in sockets} <= LOOPBACK, sockets
    # The scheduler and a nanny in the main process, and the worker, were all observed.
    assert len(sockets) >= 3 and len(set(sockets.values())) == 2, sockets
    assert any(name.startswith("worker-") for name in scratch), scratch
    # Only the socket of the process that workers are forked from, which a folder's long name would not permit in it,
    # and the files of eight random characters by which Python's tempfile finds out whether it can write there.
    assert {name.partition("-")[0] for name in strays if not re.fullmatch("[a-z0-9_]{8}", name)} <= {"pymp"}
    assert os.listdir(temporary) == []
    assert litter(out) == []
    assert digests(out / "image.zarr") == image


def listening(main: psutil.Process) -> dict[tuple[str, int], str]:
    """TCP and UDP addresses and ports on which a process and its children listen, with the process id."""
    found = {}
    with contextlib.suppress(psutil.NoSuchProcess):
        for process in (main, *main.children(recursive=True)):
            with contextlib.suppress(psutil.NoSuchProcess, psutil.AccessDenied):
                for socket in process.net_connections(kind="inet"):
                    if socket.laddr and not socket.raddr:
                        found[socket.laddr.ip, socket.laddr.port] = str(process.pid)
    return found


# ---------------------------------------------------------------- no evaluation of input

UNSAFE_MODULES = {"pickle", "cPickle", "_pickle", "cloudpickle", "dill", "joblib", "marshal", "shelve", "yaml", "code"}
UNSAFE_CALLS = {"eval", "exec", "compile", "__import__", "execfile"}
UNSAFE_METHODS = {"os.system", "os.popen", "builtins.eval", "builtins.exec"}


def unsafe(text: str) -> Iterator[str]:
    """Constructs in a module that could unpickle or evaluate input, or pass it to a shell."""
    for node in ast.walk(ast.parse(text)):
        match node:
            case ast.Import(names=names):
                yield from (f"import {name.name}" for name in names if name.name.split(".")[0] in UNSAFE_MODULES)
            case ast.ImportFrom(module=str(module)) if module.split(".")[0] in UNSAFE_MODULES:
                yield f"from {module}"
            case ast.Call(func=ast.Name(id=name)) if name in UNSAFE_CALLS:
                yield name
            case ast.Call(func=ast.Attribute(attr="system" | "popen" | "eval" | "exec") as function) if (
                ast.unparse(function) in UNSAFE_METHODS
            ):
                yield ast.unparse(function)
            case ast.keyword(arg="allow_pickle" | "shell", value=value) if ast.unparse(value) != "False":
                yield f"{node.arg}={ast.unparse(value)}"


def test_nothing_is_unpickled_or_evaluated() -> None:
    """But the plan of a run, of which nothing but data is made (runs/test_stored_plan.py), and cells of the gallery."""
    modules = [*(ROOT / "blocksar").rglob("*.py"), *(ROOT / "workflows").rglob("*.py")]
    found = {path.name: list(unsafe(path.read_text(encoding="utf-8"))) for path in modules}
    assert {name: what for name, what in found.items() if what} == {
        "stored_plan.py": ["import pickle"],
        "run_notebooks.py": ["exec", "compile", "eval", "compile"],
    }


@pytest.mark.parametrize(
    "text",
    ["import pickle", "from yaml import load", "def f(x):\n    return eval(x)", "np.load(x, allow_pickle=y)",
     "subprocess.run(x, shell=True)", "import cloudpickle.x as y", "exec('x')", "os.system(x)", "__import__(x)"],
)  # fmt: skip
def test_the_search_detects_unsafe_code(text: str) -> None:
    assert list(unsafe(text))
    assert not list(
        unsafe("import ast, json\nre.compile(x)\nnp.load(x, allow_pickle=False)\nsubprocess.run(x, shell=False)")
    )


@pytest.mark.slow
def test_a_temporary_folder_with_a_long_name_serves(tmp_path: Path) -> None:
    """Workers are forked by a process with a socket, whose path may have 107 characters."""
    folder = tmp_path / ("x" * 100)
    folder.mkdir()
    code = (
        "from blocksar.graph.cluster import prepare_workers; from blocksar.progress import Listener; "
        "prepare_workers(1, Listener())"
    )
    subprocess.run([sys.executable, "-c", code], env=os.environ | {"TMPDIR": str(folder)}, check=True)
