"""Processes that tests can kill, disks that fill up, and a scene small enough to be focused a hundred times.

Run as a program, this module is a launcher: it imports everything once, then forks a process for each order that it
reads from standard input. Such a process behaves exactly like the command line, but starts at once. It runs in the
launcher's mount namespace: its mounts are invisible to the rest of the machine and end with the launcher.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scenes import write_store

GRID = ((15620.0, 16600.0, 0.1), (18680.0, 19720.0, 390.0))  # m: chunks in one row, three tasks of the mosaic
SETTINGS: dict[str, Any] = {"blocks": 3, "coefficients": "closed-form", "grid": GRID}  # planning takes almost no time
STAGES = ("recover", "focus", "mosaic")
SCENE: dict[str, Any] = {  # 400 pulses of 1777 range frequencies: four column groups, three blocks
    "carrier": 10e9,
    "bandwidth": 800e6,
    "range_sampling": 900e6,
    "prf": 4e3,
    "duration": 0.1,
    "steering": (49.0, 51.0),
    "dwell": 0.03,
    "swath": [29900.0, 30100.0],
    "more": '[[targets]]\nname = "P"\nrange = 30000.0\nyaw_deg = 50.0\n',
}
RAW_SCENE = SCENE | {"prf": 16e3, "bandwidth": 100e6, "range_sampling": 120e6}  # 1600 pulses: four range-compress tasks
NAMES = {"run.json", "collection.zarr", "spectrum.zarr", "patches", "image.zarr"}  # in a finished run, by README.md
LOOPBACK = ("--host", "127.0.0.1", "--no-dashboard")
PAGE = 4096  # bytes, the allocation unit of a tmpfs
TICK = 0.01  # s between two polls


def make_store(folder: Path, *, raw: bool = False) -> Path:
    """Simulate the small scene's phase history, or the raw scene's echo."""
    folder.mkdir(parents=True)
    return write_store(folder, raw=raw, **(RAW_SCENE if raw else SCENE))


def words(store: Path, run: Path, *more: str) -> list[str]:
    """Return the arguments that focus the small scene."""
    axes = ",".join(":".join(str(number) for number in axis) for axis in GRID)
    return [
        "focus", str(store), "--out", str(run), "--blocks", "3", "--coefficients", "closed-form", "--grid", axes,
        "--threads", "1", *more,
    ]  # fmt: skip


# Contents of a run


@dataclass(frozen=True)
class Left:
    """What two runs must share to the last bit: the plan, all checksums, and the chunk files of the image."""

    plan: dict[str, Any]
    checksums: dict[str, Any]
    chunks: dict[str, str]


def left(run: Path) -> Left:
    """Return the results of a finished run."""
    record = json.loads((run / "run.json").read_text())
    assert record["status"] == "finished"
    names = ("written", "found", "origin")
    checksums = {r["unit"]: [r.get(name) for name in names] for r in record["receipts"]}
    return Left(record["plan"], checksums, digests(run / "image.zarr"))


def digests(store: Path) -> dict[str, str]:
    """Return every chunk file of a store with a hash of its bytes."""
    files = sorted(p for p in store.rglob("*") if p.is_file() and "c" in p.relative_to(store).parts)
    return {str(p.relative_to(store)): hashlib.blake2b(p.read_bytes(), digest_size=16).hexdigest() for p in files}


def receipts(run: Path) -> dict[str, Any]:
    """Return the receipts of an unfinished run's units of work, by unit; each must be complete JSON."""
    found = [json.loads(path.read_text()) for path in sorted((run / "receipts").glob("[!.]*.json"))]
    return {receipt["unit"]: receipt for receipt in found if not receipt["unit"].startswith("store-")}


def computed_again(run: Path, before: dict[str, Any]) -> set[str]:
    """Return the units whose receipts differ in the finished run: a unit that is computed again signs a new receipt."""
    after = {r["unit"]: r for r in json.loads((run / "run.json").read_text())["receipts"]}
    return {
        unit
        for unit, receipt in before.items()
        if any(after[unit].get(k) != v for k, v in receipt.items() if k != "seal")
    }


def litter(run: Path) -> list[str]:
    """Return the files in a finished run that do not belong there."""
    strange = [p.name for p in run.iterdir() if p.name not in NAMES]
    return strange + [str(p) for p in run.rglob("*") if p.name.startswith(".") or p.suffix in (".part", ".old")]


# Processes


def until(met: Callable[[], Any], what: str) -> Any:
    """Poll until `met` returns a true value, and return it; `what` stands in the traceback of a test that hangs."""
    while not (found := met()):
        time.sleep(TICK)
    return found


def members(session: int) -> list[int]:
    """Return the living processes of a session."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            state, _, _, of = (entry / "stat").read_text().rpartition(")")[2].split()[:4]
        except OSError:
            continue  # the process has ended in the meantime
        if int(of) == session and state not in "ZX":
            found.append(int(entry.name))
    return found


def workers_of(session: int) -> list[int]:
    """Return the dask workers of a session: forks of the fork server that its main process has started."""
    parents = {}
    for pid in members(session):
        with suppress(OSError):
            if b"forkserver" in Path(f"/proc/{pid}/cmdline").read_bytes():
                parents[pid] = int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
    return [pid for pid, parent in parents.items() if parent in parents]


@dataclass(frozen=True)
class Process:
    """A process started by a launcher: leader of a session and of a process group of its own."""

    launcher: Launcher
    pid: int
    folder: Path

    def poll(self) -> int | None:
        """Return the exit status, negative for a signal, or None while the process runs."""
        if self.pid not in self.launcher.ended:
            status = self.launcher.ask(poll=self.pid)
            if status is None:
                return None
            self.launcher.ended[self.pid] = status
        return self.launcher.ended[self.pid]

    def wait(self) -> int:
        if self.poll() is None:
            ended = os.pidfd_open(self.pid)
            select.select([ended], [], [])
            os.close(ended)
        until(lambda: self.poll() is not None, "the exit status")
        return self.launcher.ended[self.pid]

    @property
    def stdout(self) -> str:
        return (self.folder / f"{self.pid}.out").read_text()

    @property
    def stderr(self) -> str:
        return (self.folder / f"{self.pid}.err").read_text()

    @property
    def scratch(self) -> list[str]:
        """Return what the process has left in its folder of temporary files."""
        return os.listdir(self.folder / f"{self.pid}.tmp")

    @property
    def message(self) -> str:
        """Return stderr without the progress."""
        return "".join(
            line
            for line in self.stderr.splitlines(keepends=True)
            if not re.search(r"^[\w -]+: (done|\d+ of \d+); in all |^dashboard: ", line)
        )

    def await_line(self, text: str) -> None:
        """Wait until the process prints a text or ends."""
        until(lambda: text in self.stderr or self.poll() is not None, repr(text))
        assert text in self.stderr, f"ended with {self.poll()} before {text!r}: {self.stderr}"

    def send(self, number: int) -> None:
        """Send a signal to this process alone."""
        os.kill(self.pid, number)

    def send_all(self, number: int) -> None:
        """Send a signal to the process group, as a terminal does."""
        os.killpg(self.pid, number)

    def gone(self) -> None:
        """Wait until all processes of the session have ended."""
        until(lambda: not members(self.pid), f"processes of {self.pid} to end")


@dataclass
class Launcher:
    """Starts processes in a mount namespace of its own, where the machine permits one.

    Attributes
    ----------
    folder : Path
        Holds the output of the processes.
    mounts : bool
        Whether the launcher may mount file systems.
    """

    folder: Path
    mounts: bool = False
    ended: dict[int, int] = field(default_factory=dict)
    started: list[Process] = field(default_factory=list)

    def __enter__(self) -> Launcher:
        namespace = next((option for option in ("-m", "-Urm") if _may_mount(option)), None)
        self.mounts = namespace is not None
        unshare = ["unshare", namespace] if namespace else []
        self._process = subprocess.Popen(
            [*unshare, sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        return self

    def __exit__(self, *_: object) -> None:
        for process in self.started:
            for pid in members(process.pid):
                os.kill(pid, signal.SIGKILL)
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()

    def ask(self, **order: Any) -> Any:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(order) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())

    def start(self, program: str, *typed: str, **values: float) -> Process:
        """Start `blocksar`, a dask `scheduler` or `worker`, with other values of `blocksar.graph.cluster` or dask."""
        pid = self.ask(start=program, words=typed, values=values, folder=str(self.folder))
        process = Process(self, pid, self.folder)
        self.started.append(process)
        until((self.folder / f"{pid}.err").exists, "a process to begin")
        return process

    def call(self, *typed: str) -> str:
        """Run a program to its end in the namespace; return its error message, empty on success."""
        return str(self.ask(call=typed))

    def view(self, path: Path) -> Path:
        """Return a path of the namespace as this process can open it."""
        return Path(f"/proc/{self._process.pid}/root{path}")


def _may_mount(option: str) -> bool:
    try:
        return not subprocess.run(
            ["unshare", option, "mount", "-t", "tmpfs", "none", "/mnt"], capture_output=True, check=False
        ).returncode
    except OSError:
        return False


@dataclass(frozen=True)
class Cluster:
    """A dask scheduler and workers, each a process of its own, without nannies."""

    launcher: Launcher
    folder: Path
    scheduler: Process
    workers: list[Process] = field(default_factory=list)

    @property
    def file(self) -> Path:
        return self.folder / "scheduler.json"

    @property
    def address(self) -> str:
        return str(json.loads(self.file.read_text())["address"])

    def add_worker(self) -> Process:
        place = ("--scheduler-file", str(self.file), "--local-directory", str(self.folder), *LOOPBACK)
        worker = self.launcher.start("worker", *place, "--nthreads", "1", "--memory-limit", "2GiB", "--no-nanny")
        self.workers.append(worker)
        return worker

    def kill(self) -> None:
        for process in (self.scheduler, *self.workers):
            if process.poll() is None:
                process.send(signal.SIGKILL)


@contextmanager
def cluster(launcher: Launcher, folder: Path, *, workers: int = 1, **values: float) -> Iterator[Cluster]:
    """Run a cluster for the block; `values` configure dask in the scheduler."""
    folder.mkdir(parents=True)
    file = str(folder / "scheduler.json")
    scheduler = launcher.start("scheduler", *LOOPBACK, "--port", "0", "--scheduler-file", file, **values)
    made = Cluster(launcher, folder, scheduler)
    try:
        until(lambda: made.file.exists() and made.file.read_text().endswith("}"), "the scheduler")
        for worker in [made.add_worker() for _ in range(workers)]:
            worker.await_line("Registered to")
        yield made
    finally:
        made.kill()


@dataclass(frozen=True)
class Disk:
    """A small file system in a launcher's namespace."""

    launcher: Launcher
    folder: Path

    @classmethod
    def mount(cls, launcher: Launcher, folder: Path, size: int) -> Disk:
        folder.mkdir(parents=True)
        assert not launcher.call("mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(folder))
        return cls(launcher, folder)

    @property
    def view(self) -> Path:
        return self.launcher.view(self.folder)

    @property
    def used(self) -> int:
        """Return the space used, bytes in whole pages."""
        found = os.statvfs(self.view)
        return (found.f_blocks - found.f_bfree) * found.f_frsize

    def resize(self, size: int) -> None:
        assert not self.launcher.call("mount", "-o", f"remount,size={size}", str(self.folder))

    def unmount(self) -> None:
        assert not self.launcher.call("umount", "-l", str(self.folder))


@contextmanager
def read_only(launcher: Launcher, folder: Path) -> Iterator[None]:
    """Make a folder read-only: no new files can be opened in it; open files may still be written."""
    assert not launcher.call("mount", "--bind", str(folder), str(folder))
    until(lambda: not launcher.call("mount", "-o", "remount,bind,ro", str(folder)), f"{folder} to be read-only")
    try:
        yield
    finally:
        assert not launcher.call("umount", "-l", str(folder))


# The launcher itself


def serve() -> dict[str, Any] | None:
    """Carry out the orders on standard input until it ends; in a forked process, return its order."""
    for line in sys.stdin:
        order: dict[str, Any] = json.loads(line)
        answer: Any = None
        match order:
            case {"start": _}:
                answer = os.fork()
                if not answer:
                    return order
            case {"poll": pid}:
                found, status = os.waitpid(pid, os.WNOHANG)
                answer = os.waitstatus_to_exitcode(status) if found else None
            case {"call": typed}:
                done = subprocess.run(typed, capture_output=True, text=True, check=False)
                answer = (done.stderr or f"status {done.returncode}") if done.returncode else ""
        print(json.dumps(answer), flush=True)
    return None


def become(order: dict[str, Any], programs: dict[str, Callable[[], Any]]) -> None:
    """Run the ordered program with a session, streams, signals and temporary files of its own."""
    import dask

    from blocksar.graph import cluster, units
    from blocksar.places.local import LocalPlace

    os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job of a shell ignores SIGINT
    here = Path(order["folder"]) / str(os.getpid())
    tempfile.tempdir = os.environ["TMPDIR"] = f"{here}.tmp"
    os.mkdir(tempfile.tempdir)
    new = os.O_WRONLY | os.O_CREAT | os.O_APPEND
    for number, (path, mode) in enumerate(((os.devnull, os.O_RDONLY), (f"{here}.out", new), (f"{here}.err", new))):
        os.dup2(os.open(path, mode), number)
    for name, value in order["values"].items():
        if name == "FREE":  # bytes that are free on any disk, it is said
            LocalPlace.free = lambda _, size=int(value): size  # type: ignore[method-assign, misc]
        elif "." in name:
            dask.config.set({name: value})
        else:
            homes = [module for module in (cluster, units) if name in vars(module)]
            assert homes, name
            for module in homes:
                setattr(module, name, value)
    sys.argv = [order["start"], *order["words"]]
    programs[order["start"]]()


def main() -> None:
    from distributed.cli import dask_scheduler, dask_worker

    from blocksar import api, cli  # noqa: F401  (importing the api takes long)
    from blocksar.graph.compiling import TASKS, compile_modules

    compile_modules(TASKS)
    order = serve()
    if order is not None:
        become(order, {"blocksar": cli.main, "scheduler": dask_scheduler.main, "worker": dask_worker.main})


if __name__ == "__main__":
    main()
