"""Faults in real runs: killed and stopped processes, full and read-only disks, signals, damaged results.

After every fault the same command is given again, and the image must equal that of an undisturbed run bit for bit.
The times of faults are drawn from seeds: of at most five, the first that kills a worker at its stage ends a case;
twenty with `-m "slow or not slow"`.
"""

from __future__ import annotations

import itertools
import json
import os
import random
import re
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from distributed import Client, LocalCluster, SchedulerPlugin
from faults import (
    PAGE,
    SETTINGS,
    STAGES,
    Cluster,
    Disk,
    Launcher,
    Left,
    Process,
    cluster,
    computed_again,
    digests,
    left,
    litter,
    make_store,
    read_only,
    receipts,
    until,
    words,
    workers_of,
)

import blocksar
from blocksar.graph.cluster import open_client
from blocksar.planning import planner
from blocksar.runs import stored_plan

OWN = ("--workers", "1", "--memory-limit", "2GiB")  # the smallest local cluster
HERE: dict[str, Any] = {"workers": 0, "threads": 1}
PROMPT = "give the same command again"


@dataclass(frozen=True)
class Undisturbed:
    """A run, and the expected results of every other."""

    left: Left
    spectrum: dict[str, str]
    run: Path


@pytest.fixture(scope="module")
def launcher(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Launcher]:
    with Launcher(tmp_path_factory.mktemp("said")) as started:
        yield started


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_store(tmp_path_factory.mktemp("input") / "small")


@pytest.fixture(scope="module")
def dask_cluster(launcher: Launcher, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """An external cluster shared by the runs, so that it starts only once."""
    with cluster(launcher, tmp_path_factory.mktemp("cluster") / "dask", workers=2) as started:
        yield started


@pytest.fixture(scope="module")
def undisturbed(
    launcher: Launcher, store: Path, dask_cluster: Cluster, tmp_path_factory: pytest.TempPathFactory
) -> Undisturbed:
    run = tmp_path_factory.mktemp("undisturbed") / "run"
    process = launcher.start("blocksar", *words(store, run, "--scheduler", dask_cluster.address))
    assert process.wait() == 0, process.stderr
    found = left(run)
    assert len(found.chunks) >= 20 and len(found.checksums) >= 10
    assert litter(run) == []
    return Undisturbed(found, digests(run / "spectrum.zarr"), run)


def _status(run: Path) -> str | None:
    try:
        return str(json.loads((run / "run.json").read_text())["status"])
    except (OSError, ValueError):
        return None


@pytest.fixture
def again(
    launcher: Launcher, store: Path, dask_cluster: Cluster, undisturbed: Undisturbed
) -> Callable[[Path], set[str]]:
    """Give the same command again, and check that it leaves exactly what an undisturbed run leaves.

    The function returns the units that were computed although they had a receipt.
    """

    def resume(run: Path) -> set[str]:
        before = {} if _status(launcher.view(run)) == "finished" else receipts(launcher.view(run))
        process = launcher.start("blocksar", *words(store, run, "--scheduler", dask_cluster.address))
        assert process.wait() == 0, process.stderr
        assert left(launcher.view(run)) == undisturbed.left
        assert litter(launcher.view(run)) == []
        assert process.scratch == []
        return computed_again(launcher.view(run), before)

    return resume


def one_sentence(process: Process) -> str:
    """The message of a failed run, checked to be a single line."""
    assert process.message.startswith("blocksar: "), process.stderr
    assert process.message.count("\n") == 1, process.stderr
    assert "Traceback" not in process.stderr
    return process.message


# ---------------------------------------------------------------- lost workers


# Stages of a run at which something happens to it; all resume in the same way, and one is enough most of the time.
OFTEN = [pytest.param(stage, marks=() if stage == "focus" else pytest.mark.slow) for stage in STAGES]


class Assassin(SchedulerPlugin):
    """Kills the worker that begins a chosen task."""

    name = "assassin"

    def __init__(self, ours: LocalCluster) -> None:
        assert ours.scheduler is not None
        self._workers = ours.workers
        self._tasks = ours.scheduler.tasks
        self.arm("", 0, 0.0)

    def arm(self, stage: str, number: int, delay: float) -> None:
        """Choose the task of a stage that begins after a `number` of others, and so many seconds until the murder."""
        self._stage, self._others, self._delay = stage, number, delay
        self._victim = ""  # once it has begun
        self.times = 0  # number of starts of the victim's task
        self.hit = False  # whether the worker was killed during the task

    def transition(self, key: Any, start: str, finish: str, *_: Any, **__: Any) -> None:
        name = re.sub(r"-[0-9a-f]{8}-", " ", str(key))
        if finish != "processing" or stage_of(name) != self._stage or "verify" in name:
            return
        if not self._victim:
            self._others -= 1
            if self._others >= 0:
                return
            self._victim, address = name, self._tasks[key].processing_on.address
            if self._delay:
                threading.Timer(self._delay, self._kill, [key, address]).start()
            else:
                self._kill(key, address)
        self.times += name == self._victim

    def _kill(self, key: Any, address: str) -> None:
        task = self._tasks.get(key)
        self.hit = task is not None and task.state == "processing" and task.processing_on.address == address
        for nanny in self._workers.values():
            if nanny.worker_address == address:
                os.kill(nanny.pid, signal.SIGKILL)


def stage_of(task: str) -> str:
    step = task.split(" ", maxsplit=1)[0]
    names = {"recover": "recover", "gate": "gate", "mosaic": "mosaic", "compress": "range-compress"}
    return names.get(step, "focus")


@pytest.fixture(scope="module")
def guarded() -> Iterator[tuple[Client, Assassin]]:
    """A local cluster of two workers, and what kills them."""
    with open_client(workers=2, threads=1, memory_limit=2 * 2**30) as client:
        assert isinstance(client.cluster, LocalCluster) and client.cluster.scheduler
        assassin = Assassin(client.cluster)
        client.cluster.scheduler.add_plugin(assassin)
        yield client, assassin


@pytest.mark.parametrize(
    ("stage", "seeds"),
    [
        ("focus", 1),
        *(pytest.param(stage, 20, marks=pytest.mark.slow) for stage in (*STAGES, "range-compress", "gate")),
    ],
)
def test_a_killed_worker_does_not_change_the_result(
    stage: str,
    seeds: int,
    store: Path,
    undisturbed: Undisturbed,
    guarded: tuple[Client, Assassin],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Every other worker is killed as soon as it has the task, and certainly at work; the others some time later."""
    client, assassin = guarded
    source, expected = store, undisturbed.left
    if stage == "gate":  # only blocks that are divided in range are gated on their own
        whole = planner.plan_collection
        monkeypatch.setattr(planner, "plan_collection", lambda *given, **more: whole(*given, **more | {"parts": 2}))
    raw = stage == "range-compress"
    if raw:
        source = make_store(tmp_path / "raw", raw=True)
    if stage in ("range-compress", "gate"):
        blocksar.focus(source, tmp_path / "whole", client=client, **SETTINGS)
        expected = left(tmp_path / "whole")
    for seed in range(seeds):
        rng = random.Random(f"{stage} {seed}")
        until(lambda: len(client.nthreads()) == 2, "both workers")
        assassin.arm(stage, rng.randrange(3), 0.3 * rng.random() if seed % 2 else 0.0)
        blocksar.focus(source, tmp_path / f"{seed}", client=client, **SETTINGS)
        until(lambda: not any(isinstance(t, threading.Timer) for t in threading.enumerate()), "the murder")
        assert assassin.hit or seed % 2, seed
        assert assassin.times >= 1 + assassin.hit, seed
        assert left(tmp_path / f"{seed}") == expected, seed
        assert litter(tmp_path / f"{seed}") == [], seed


# ---------------------------------------------------------------- killed runs


FEW = (0,)


@pytest.mark.parametrize(
    "seed", [seed if seed in FEW else pytest.param(seed, marks=pytest.mark.slow) for seed in range(20)]
)
def test_a_killed_run_is_resumed(
    seed: int,
    launcher: Launcher,
    store: Path,
    dask_cluster: Cluster,
    undisturbed: Undisturbed,
    again: Callable[[Path], set[str]],
    tmp_path: Path,
) -> None:
    """Runs are killed as soon as they have one to twenty twentieths of their files; every fourth has its own cluster.

    Some go on where they are, some after they were moved, some in a copy.
    """
    moment = (seed + random.Random(seed).random()) / 20
    own = seed % 4 == 3
    where = OWN if own else ("--scheduler", dask_cluster.address)
    wanted, run = moment * n_file(undisturbed.run), tmp_path / "run"
    while True:
        process = launcher.start("blocksar", *words(store, run, *where))
        kill_once_it_has(wanted, process, run)
        if _status(run) != "finished" or moment > 0.7:
            break
        wanted *= 0.7  # it had all of its files before anybody looked
        shutil.rmtree(run)
    process.gone()
    if seed % 3:
        other = tmp_path / "other"
        shutil.copytree(run, other) if seed % 3 == 2 else run.rename(other)
        run = other
    assert again(run) == set()


def n_file(run: Path) -> int:
    return sum(len(names) for _, _, names in os.walk(run))


def kill_once_it_has(wanted: float, process: Process, run: Path) -> None:
    """Kill the process of a run that has more files than wanted, unless it ends before."""
    until(lambda: n_file(run) > wanted or process.poll() is not None, f"{wanted} files")
    if process.poll() is None:
        process.send(signal.SIGKILL)
    assert process.wait() in (-signal.SIGKILL, 0)


@pytest.mark.parametrize("stage", OFTEN)
@pytest.mark.slow
def test_a_run_resumes_after_its_scheduler_was_killed(
    stage: str, launcher: Launcher, store: Path, again: Callable[[Path], set[str]], tmp_path: Path
) -> None:
    with cluster(launcher, tmp_path / "dask") as made:
        process = launcher.start("blocksar", *words(store, tmp_path / "run", "--scheduler", made.address))
        process.await_line(f"{stage}: 0")
        made.scheduler.send(signal.SIGKILL)
        assert process.wait() == 1, process.stderr
        assert "scheduler" in one_sentence(process)
    assert again(tmp_path / "run") == set()


# ---------------------------------------------------------------- full disks


def pages(*paths: Path) -> int:
    """Bytes that files occupy on a tmpfs; each hard-linked file counts once."""
    files = {p.stat().st_ino: p.stat().st_size for path in paths for p in [path, *path.rglob("*")] if p.is_file()}
    return sum(-(-size // PAGE) * PAGE for size in files.values())


@pytest.fixture
def disk(launcher: Launcher, tmp_path: Path) -> Iterator[Disk]:
    if not launcher.mounts:
        pytest.skip("mounts nothing: this needs root, or namespaces for everybody")
    mounted = Disk.mount(launcher, tmp_path / "disk", 64 << 20)
    yield mounted
    mounted.unmount()


def sizes(store: Path, run: Path) -> dict[str, int]:
    """Disk sizes at which the disk fills up in each stage, bytes; the plan lies there until the run is finished."""
    spectrum, patches, image = (run / name for name in ("spectrum.zarr", "patches", "image.zarr"))
    plan = len(stored_plan.pack(blocksar.plan(store, **SETTINGS).plan))
    beginning = pages(run) - pages(spectrum, patches, image) + plan + 128 * PAGE
    return {
        "recover": beginning + pages(spectrum) // 2,
        "focus": beginning + pages(spectrum) + pages(patches) // 2,
        "mosaic": pages(run) + plan - pages(image / "block") // 2,
    }


def most_used(disk: Disk, process: Process) -> int:
    """Largest disk usage while a process runs, bytes."""
    most = 0
    while process.poll() is None:
        for _ in range(100):
            most = max(most, disk.used)
    return most


@pytest.mark.parametrize("stage", [*OFTEN, pytest.param("run.json", marks=pytest.mark.slow)])
def test_a_run_resumes_after_the_disk_was_full(
    stage: str,
    launcher: Launcher,
    store: Path,
    disk: Disk,
    dask_cluster: Cluster,
    undisturbed: Undisturbed,
    again: Callable[[Path], set[str]],
) -> None:
    given = ("--scheduler", dask_cluster.address)
    if stage == "run.json":
        process = launcher.start("blocksar", *words(store, disk.folder / "whole", *given))
        size = most_used(disk, process) - PAGE
        assert process.wait() == 0
        assert not launcher.call("rm", "-r", str(disk.folder / "whole"))
    else:
        size = sizes(store, undisturbed.run)[stage]
    disk.resize(size)
    # As if others filled it in the meantime: a run that does not fit is refused.
    process = launcher.start("blocksar", *words(store, disk.folder / "run", *given), FREE=64 << 20)
    assert process.wait() == 1, process.stderr
    assert "No space left on device" in one_sentence(process)
    reached = [line.split(":")[0] for line in process.stderr.splitlines() if " of " in line][:-1][-1]
    assert reached == ("mosaic" if stage == "run.json" else stage), process.stderr
    assert _status(disk.view / "run") == "unfinished"
    disk.resize(64 << 20)
    assert again(disk.folder / "run") == set()


def test_a_run_that_does_not_fit_the_disk_is_refused(launcher: Launcher, store: Path, disk: Disk) -> None:
    disk.resize(1 << 20)
    process = launcher.start("blocksar", *words(store, disk.folder / "run", "--workers", "0"))
    assert process.wait() == 2, process.stderr
    assert re.search(r"run needs .* MiB of disk, and 1\.0 MiB are free there; ", one_sentence(process))
    assert not list(disk.view.iterdir())


# ---------------------------------------------------------------- read-only disks


def test_a_read_only_output_is_refused(launcher: Launcher, store: Path, disk: Disk) -> None:
    with read_only(launcher, disk.folder):
        process = launcher.start("blocksar", *words(store, disk.folder / "deep" / "run", *OWN))
        assert process.wait() == 2, process.stderr
        assert "Read-only file system" in one_sentence(process)
    assert list(disk.view.iterdir()) == []


# ---------------------------------------------------------------- hung workers


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stage", "workers"),
    [("focus", 1), *((stage, 2) for stage in ("recover", "focus", "mosaic"))],
)
def test_a_hung_worker_is_replaced(
    stage: str, workers: int, launcher: Launcher, store: Path, again: Callable[[Path], set[str]], tmp_path: Path
) -> None:
    """Also the only one."""
    own = ("--workers", str(workers), "--memory-limit", "2GiB")
    process = launcher.start("blocksar", *words(store, tmp_path / "run", *own), WORKER_TTL=4, HUNG=1)
    process.await_line(f"{stage}: 0")
    hung = workers_of(process.pid)[0]
    os.kill(hung, signal.SIGSTOP)
    assert process.wait() == 0, process.stderr
    process.gone()
    assert again(tmp_path / "run") == set()


# ---------------------------------------------------------------- signals


def signal_at(
    stage: str, seed: int, send: Callable[[Process], None], launcher: Launcher, store: Path, run: Path
) -> Process:
    """Start a run and call `send` in a stage; return the process once it has ended."""
    process = launcher.start("blocksar", *words(store, run, *OWN))
    until(run.exists, "the first write")
    if stage != "start":
        process.await_line(f"{stage}: 0")
    time.sleep(random.Random(seed).random() * {"start": 1.0, "mosaic": 0.005}.get(stage, 0.3))
    if process.poll() is None:
        send(process)
    process.wait()
    return process


INTERRUPTED, TERMINATED = (signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "terminated")


@pytest.mark.parametrize(
    ("number", "status", "word", "stage"),
    [
        (*INTERRUPTED, "focus"),
        pytest.param(*INTERRUPTED, "start", marks=pytest.mark.slow),
        pytest.param(*TERMINATED, "focus", marks=pytest.mark.slow),
        pytest.param(*INTERRUPTED, "mosaic", marks=pytest.mark.slow),
        pytest.param(*TERMINATED, "recover", marks=pytest.mark.slow),
    ],
)
def test_a_signal_stops_a_run_cleanly(
    stage: str,
    number: signal.Signals,
    status: int,
    word: str,
    launcher: Launcher,
    store: Path,
    again: Callable[[Path], set[str]],
    tmp_path: Path,
) -> None:
    """SIGINT goes to the whole process group, as from a terminal; SIGTERM to the process, as from a batch system."""

    def send(process: Process) -> None:
        if number == signal.SIGINT:
            process.send_all(number)
        else:
            process.send(number)

    for attempt in itertools.count():
        run = tmp_path / f"run{attempt}"
        process = signal_at(stage, attempt, send, launcher, store, run)
        if process.wait():
            break  # otherwise the run finished before the signal
    assert process.wait() == status, process.stderr
    process.gone()
    message = one_sentence(process)
    assert word in message and PROMPT in message
    assert process.scratch == []
    assert again(run) == set()


@pytest.mark.slow
def test_repeated_interrupts_stop_a_run_cleanly(
    launcher: Launcher, store: Path, again: Callable[[Path], set[str]], tmp_path: Path
) -> None:
    """The user presses Ctrl-C five times."""

    def send(process: Process) -> None:
        for _ in range(5):
            if process.poll() is None:
                process.send_all(signal.SIGINT)
                time.sleep(0.1)

    process = signal_at("focus", 0, send, launcher, store, tmp_path / "run")
    # A signal during the exit of the interpreter ends the process directly, which a shell also reports as 130.
    assert process.wait() in (130, -signal.SIGINT), process.stderr
    process.gone()
    assert process.message.startswith("blocksar: interrupted"), process.stderr
    assert "Traceback" not in process.stderr
    assert again(tmp_path / "run") == set()


# ---------------------------------------------------------------- concurrent runs


def test_a_second_writer_is_refused(
    launcher: Launcher,
    store: Path,
    dask_cluster: Cluster,
    undisturbed: Undisturbed,
    again: Callable[[Path], set[str]],
    tmp_path: Path,
) -> None:
    typed = words(store, tmp_path / "run", "--scheduler", dask_cluster.address)
    first = launcher.start("blocksar", *typed)
    first.await_line("recover: 0")
    first.send(signal.SIGSTOP)
    for more in ((), ("--overwrite",)):
        second = launcher.start("blocksar", *typed, *more)
        assert second.wait() == 2, second.stderr
        assert str(first.pid) in one_sentence(second)
    first.send(signal.SIGCONT)
    assert first.wait() == 0, first.stderr
    assert left(tmp_path / "run") == undisturbed.left
    assert litter(tmp_path / "run") == []


# ---------------------------------------------------------------- damaged results


class Interrupted(Exception):
    pass


class UntilMerged:
    """Interrupt a run when its work is complete but it is not yet marked as finished."""

    def update(self, stage: str, done: int, total: int) -> None:
        if stage == "mosaic" and done == total:
            raise Interrupted


@pytest.fixture(scope="module")
def unfinished(store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An unfinished run with all its receipts."""
    run = tmp_path_factory.mktemp("unfinished") / "run"
    with pytest.raises(Interrupted):
        blocksar.focus(store, run, **HERE, progress=UntilMerged(), **SETTINGS)
    assert _status(run) == "unfinished"
    assert len(receipts(run)) == 10
    return run


def flip(path: Path) -> None:
    """Flip one bit of a file in place, so that all its hard links change."""
    with open(path, "r+b") as file:
        file.seek(path.stat().st_size // 3)
        byte = file.read(1)[0]
        file.seek(-1, os.SEEK_CUR)
        file.write(bytes([byte ^ 1]))


def truncate(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def garble(path: Path) -> None:
    path.write_text('{"zarr_format": 3, "node_type": "arr')


COLUMNS = {"columns-0", "columns-508", "columns-1016", "columns-1524"}
BLOCKS = {"block-0", "block-1", "block-2"}
CHUNKS = {"chunk-0-4", "chunk-0-8", "chunk-0-12"}
IMAGE = CHUNKS | {"block-0", "block-2"}  # these blocks touch chunks that no other does
DAMAGES: dict[str, tuple[Callable[[Path], Any], str, set[str]]] = {  # damage, its target, units computed again
    "bit of a spectrum chunk": (flip, "spectrum.zarr/spectrum/c/0/2", {"columns-508"}),
    "half of a spectrum chunk": (truncate, "spectrum.zarr/spectrum/c/1/6", {"columns-1524"}),
    "spectrum chunk gone": (os.unlink, "spectrum.zarr/spectrum/c/0/0", {"columns-0"}),
    "bit of a patch chunk that the image shares": (flip, "patches/0/image/c/0/6", {"block-0", "chunk-0-12"}),
    "bit of a patch chunk that the image shares from the start": (flip, "patches/0/image/c/0/8", {"block-0"}),
    "bit of a patch chunk that two blocks share": (flip, "patches/1/image/c/0/4", {"block-1"}),
    "half of a patch chunk": (truncate, "patches/1/image/c/0/4", {"block-1"}),
    "patch chunk gone": (os.unlink, "patches/1/image/c/0/4", {"block-1"}),
    "patch gone": (shutil.rmtree, "patches/2", {"block-2"}),
    "all patches gone": (shutil.rmtree, "patches", BLOCKS),
    "patch's metadata": (garble, "patches/1/image/zarr.json", {"block-1"}),
    "patch's group": (garble, "patches/1/zarr.json", {"block-1"}),
    "patch's axis": (flip, "patches/1/x/c/0", {"block-1"}),
    "bit of a chunk of owners": (flip, "image.zarr/block/c/0/4", {"chunk-0-4"}),
    "half of a chunk of owners": (truncate, "image.zarr/block/c/0/9", {"chunk-0-8"}),
    "image chunk gone": (os.unlink, "image.zarr/image/c/0/4", {"chunk-0-4"}),
    "image chunk of one block gone": (os.unlink, "image.zarr/image/c/0/16", {"block-0"}),
    "owners of one block gone": (os.unlink, "image.zarr/block/c/0/0", {"block-2"}),
    "half a receipt of columns": (truncate, "receipts/columns-508.json", {"columns-508"}),
    "half a receipt of a block": (truncate, "receipts/block-1.json", {"block-1"}),
    "half a receipt of the mosaic": (truncate, "receipts/chunk-0-4.json", {"chunk-0-4"}),
    "empty receipt": (lambda path: os.truncate(path, 0), "receipts/block-2.json", {"block-2"}),
    "receipt of nothing": (lambda path: path.write_text("[1, {}]"), "receipts/block-2.json", {"block-2"}),
    "receipts gone": (shutil.rmtree, "receipts", COLUMNS | BLOCKS | CHUNKS),
    "spectrum's metadata": (garble, "spectrum.zarr/zarr.json", COLUMNS),
    "spectrum's array": (garble, "spectrum.zarr/spectrum/zarr.json", COLUMNS),
    "spectrum gone": (shutil.rmtree, "spectrum.zarr", COLUMNS),
    "image's metadata": (garble, "image.zarr/zarr.json", IMAGE),
    "image's array": (garble, "image.zarr/image/zarr.json", IMAGE),
    "image's axis": (flip, "image.zarr/x/c/0", IMAGE),
    "image gone": (shutil.rmtree, "image.zarr", IMAGE),
    "collection's axis": (flip, "collection.zarr/time/c/0", set()),
    "collection gone": (shutil.rmtree, "collection.zarr", set()),
    "nothing": (lambda path: None, ".", set()),
}


# Others damage the same kind of file in another way, or another of its kind.
LIKE_OTHERS = {
    "half of a spectrum chunk", "bit of a patch chunk that the image shares from the start", "half of a patch chunk",
    "patch's group", "patch's axis", "half of a chunk of owners", "owners of one block gone",
    "half a receipt of columns", "half a receipt of the mosaic", "empty receipt", "spectrum's array", "image's array",
    "image's axis", "collection's axis", "image gone", "patch gone", "half a receipt of a block", "receipts gone",
    "all patches gone", "bit of a patch chunk that two blocks share", "image chunk of one block gone",
    "spectrum's metadata", "patch's metadata", "spectrum gone", "bit of a chunk of owners", "image chunk gone",
}  # fmt: skip


@pytest.mark.parametrize(
    "damage", [pytest.param(name, marks=pytest.mark.slow) if name in LIKE_OTHERS else name for name in DAMAGES]
)
def test_damaged_results_are_computed_again_despite_their_receipts(
    damage: str,
    store: Path,
    unfinished: Path,
    undisturbed: Undisturbed,
    tmp_path: Path,
) -> None:
    """The result equals that of an undisturbed run, and only damaged units are computed again."""
    harm, name, lost = DAMAGES[damage]
    run = tmp_path / "run"
    subprocess.run(["cp", "-a", unfinished, run], check=True)  # keeps hard links
    assert (run / name).stat().st_nlink == 2 or "image shares" not in damage
    before = receipts(run)
    harm(run / name)
    blocksar.focus(store, run, **HERE, **SETTINGS)
    assert left(run) == undisturbed.left
    assert digests(run / "spectrum.zarr") == undisturbed.spectrum
    for part in ("collection.zarr", "patches"):
        assert digests(run / part) == digests(undisturbed.run / part)
    assert litter(run) == []
    assert computed_again(run, before) == lost
