"""Faults in real runs: killed and stopped processes, full and read-only disks, signals, damaged results.

After every fault the same command is given again, and the image must equal that of an undisturbed run bit for bit.
The times of faults are drawn from seeds: twenty with `-m "slow or not slow"`.
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
from blocksar.processors.chain import processor as chain
from blocksar.runs import stored_plan

OWN, ALONE = ("--workers", "1", "--memory-limit", "2GiB"), ("--workers", "0")  # the smallest local cluster, and none
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
def undisturbed(store: Path, tmp_path_factory: pytest.TempPathFactory) -> Undisturbed:
    run = tmp_path_factory.mktemp("undisturbed") / "run"
    blocksar.focus(store, run, **HERE, **SETTINGS)
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
def again(launcher: Launcher, store: Path, undisturbed: Undisturbed) -> Callable[[Path], set[str]]:
    """Ask for the same run again, and check that it leaves exactly what an undisturbed run leaves.

    The function returns the units that were computed although they had a receipt.
    """

    def resume(run: Path) -> set[str]:
        run = launcher.view(run)
        before = {} if _status(run) == "finished" else receipts(run)
        blocksar.focus(store, run, **HERE, **SETTINGS)
        assert left(run) == undisturbed.left
        assert litter(run) == []
        return computed_again(run, before)

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

    def __init__(self, ours: Any) -> None:
        assert isinstance(ours, LocalCluster) and ours.scheduler is not None
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


@pytest.fixture
def assassin(client: Client) -> Iterator[Assassin]:
    """What kills workers of the local cluster of all tests."""
    found = Assassin(client.cluster)
    client.cluster.scheduler.add_plugin(found)
    yield found
    client.cluster.scheduler.remove_plugin(found.name)
    until(lambda: len(client.nthreads()) == 2, "both workers")


@pytest.mark.parametrize(
    ("stage", "seeds"),
    [("focus", 1), *(pytest.param(stage, 20, marks=pytest.mark.slow) for stage in (*STAGES, "range-compress", "gate"))],
)
def test_a_killed_worker_does_not_change_the_result(
    stage: str,
    seeds: int,
    store: Path,
    undisturbed: Undisturbed,
    client: Client,
    assassin: Assassin,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Every other worker is killed as soon as it has the task, and certainly at work; the others some time later."""
    source, expected = store, undisturbed.left
    if stage == "gate":  # only blocks that are divided in range are gated on their own
        whole = chain.plan_collection
        monkeypatch.setattr(chain, "plan_collection", lambda *given, **more: whole(*given, **more | {"parts": 2}))
    raw = stage == "range-compress"
    if raw:
        source = make_store(tmp_path / "raw", raw=True)
    if stage in ("range-compress", "gate"):
        blocksar.focus(source, tmp_path / "whole", client=client, **SETTINGS)
        expected = left(tmp_path / "whole")
    for seed in range(seeds):
        rng = random.Random(f"{stage} {seed}")
        until(lambda: len(client.nthreads()) == 2, "both workers")
        others = rng.randrange(2 if stage == "gate" else 3)  # two units are gated
        assassin.arm(stage, others, 0.3 * rng.random() if seed % 2 else 0.0)
        blocksar.focus(source, tmp_path / f"{seed}", client=client, **SETTINGS)
        until(lambda: not any(isinstance(t, threading.Timer) for t in threading.enumerate()), "the murder")
        assert assassin.hit or seed % 2, seed
        assert assassin.times >= 1 + assassin.hit, seed
        assert left(tmp_path / f"{seed}") == expected, seed
        assert litter(tmp_path / f"{seed}") == [], seed


# ---------------------------------------------------------------- killed runs


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 20))])
def test_a_killed_run_is_resumed(
    seed: int,
    launcher: Launcher,
    store: Path,
    undisturbed: Undisturbed,
    again: Callable[[Path], set[str]],
    tmp_path: Path,
) -> None:
    """Runs are killed as soon as they have one to twenty twentieths of their files; every other has a cluster.

    Some go on where they are, some after they were moved, some in a copy.
    """
    moment = (seed + random.Random(seed).random()) / 20
    wanted, run = moment * n_file(undisturbed.run), tmp_path / "run"
    while True:
        process = launcher.start("blocksar", *words(store, run, *(OWN if seed % 2 else ALONE)))
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


@pytest.mark.slow
def test_a_run_resumes_after_its_scheduler_was_killed(
    launcher: Launcher, store: Path, again: Callable[[Path], set[str]], tmp_path: Path
) -> None:
    with cluster(launcher, tmp_path / "dask") as made:
        process = launcher.start("blocksar", *words(store, tmp_path / "run", "--scheduler", made.address))
        process.await_line("recover: ")
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


@pytest.mark.parametrize("stage", OFTEN)
def test_a_run_resumes_after_the_disk_was_full(
    stage: str, launcher: Launcher, store: Path, disk: Disk, undisturbed: Undisturbed, again: Callable[[Path], set[str]]
) -> None:
    disk.resize(sizes(store, undisturbed.run)[stage])
    # As if others filled it in the meantime: a run that does not fit is refused.
    process = launcher.start("blocksar", *words(store, disk.folder / "run", *ALONE), FREE=64 << 20)
    assert process.wait() == 1, process.stderr
    assert "No space left on device" in one_sentence(process)
    ended = re.findall(r"^([\w-]+): (?:done|\d+ of \d+); in all", process.stderr, re.M)[-1]
    assert ended == {"recover": "plan", "focus": "recover", "mosaic": "focus"}[stage], process.stderr
    assert _status(disk.view / "run") == "unfinished"
    disk.resize(64 << 20)
    assert again(disk.folder / "run") == set()


# ---------------------------------------------------------------- read-only disks


def test_a_read_only_output_is_refused(launcher: Launcher, store: Path, disk: Disk) -> None:
    with read_only(launcher, disk.folder):
        process = launcher.start("blocksar", *words(store, disk.folder / "deep" / "run", *OWN))
        assert process.wait() == 2, process.stderr
        assert "Read-only file system" in one_sentence(process)
    assert list(disk.view.iterdir()) == []


# ---------------------------------------------------------------- hung workers


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_a_hung_worker_is_replaced(
    workers: int, launcher: Launcher, store: Path, again: Callable[[Path], set[str]], tmp_path: Path
) -> None:
    """Also the only one."""
    own = ("--workers", str(workers), "--memory-limit", "2GiB")
    process = launcher.start("blocksar", *words(store, tmp_path / "run", *own), WORKER_TTL=4, HUNG=1)
    process.await_line("recover: ")
    hung = workers_of(process.pid)[0]
    os.kill(hung, signal.SIGSTOP)
    assert process.wait() == 0, process.stderr
    process.gone()
    assert again(tmp_path / "run") == set()


# ---------------------------------------------------------------- signals


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "status", "word"),
    [(signal.SIGINT, 130, "interrupted"), pytest.param(signal.SIGTERM, 143, "terminated", marks=pytest.mark.slow)],
)
def test_a_signal_stops_a_run_cleanly(
    number: signal.Signals,
    status: int,
    word: str,
    launcher: Launcher,
    store: Path,
    again: Callable[[Path], set[str]],
    tmp_path: Path,
) -> None:
    """SIGINT goes to the whole process group, as from a terminal; SIGTERM to the process, as from a batch system."""
    for attempt in itertools.count():
        run = tmp_path / f"run{attempt}"
        process = launcher.start("blocksar", *words(store, run, *OWN))
        process.await_line("recover: ")
        time.sleep(random.Random(attempt).random() * 0.3)
        if process.poll() is None:
            (process.send_all if number == signal.SIGINT else process.send)(number)
        if process.wait():
            break  # otherwise the run finished before the signal
    assert process.wait() == status, process.stderr
    process.gone()
    message = one_sentence(process)
    assert word in message and PROMPT in message
    assert process.scratch == []
    assert again(run) == set()


# ---------------------------------------------------------------- concurrent runs


@pytest.mark.slow
def test_a_second_writer_is_refused(launcher: Launcher, store: Path, undisturbed: Undisturbed, tmp_path: Path) -> None:
    typed = words(store, tmp_path / "run", *ALONE)
    first = launcher.start("blocksar", *typed)
    first.await_line("plan: ")
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


def empty(path: Path) -> None:
    path.write_text("[1, {}]")


COLUMNS = {"columns-0", "columns-508", "columns-1016", "columns-1524"}
CHUNKS = {"chunk-0-4", "chunk-0-8", "chunk-0-12"}
IMAGE = CHUNKS | {"block-0", "block-2"}  # these blocks touch chunks that no other does
Damage = tuple[Callable[[Path], Any], str, set[str]]  # its target, and units that are computed again
DAMAGES: dict[str, list[Damage]] = {  # of one run
    "spectrum and receipts": [
        (flip, "spectrum.zarr/spectrum/c/0/2", {"columns-508"}),
        (os.unlink, "spectrum.zarr/spectrum/c/0/0", {"columns-0"}),
        (empty, "receipts/block-2.json", {"block-2"}),
        (shutil.rmtree, "collection.zarr", set()),
    ],
    "patches": [
        (flip, "patches/0/image/c/0/6", {"block-0", "chunk-0-12"}),  # a chunk that the image shares
        (os.unlink, "patches/1/image/c/0/4", {"block-1"}),
        (truncate, "receipts/columns-508.json", {"columns-508"}),
    ],
    "image": [(garble, "image.zarr/zarr.json", IMAGE)],
    "parts of the image": [
        (flip, "image.zarr/block/c/0/4", {"chunk-0-4"}),
        (truncate, "image.zarr/block/c/0/9", {"chunk-0-8"}),
        (os.unlink, "image.zarr/block/c/0/0", {"block-2"}),  # of one block
        (garble, "patches/1/zarr.json", {"block-1"}),
    ],
    "all of the spectrum": [(shutil.rmtree, "spectrum.zarr", COLUMNS)],
    "all of the rest": [(shutil.rmtree, "image.zarr", IMAGE), (shutil.rmtree, "patches", {"block-1"})],
}
SLOW = ("parts of the image", "all of the spectrum", "all of the rest")  # damage of the same kinds


@pytest.mark.slow
@pytest.mark.parametrize(
    "damage", [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in DAMAGES]
)
def test_damaged_results_are_computed_again_despite_their_receipts(
    damage: str, store: Path, unfinished: Path, undisturbed: Undisturbed, tmp_path: Path
) -> None:
    """The result equals that of an undisturbed run, and only damaged units are computed again."""
    run = tmp_path / "run"
    subprocess.run(["cp", "-a", unfinished, run], check=True)  # keeps hard links
    assert (run / "patches/0/image/c/0/6").stat().st_nlink == 2
    before = receipts(run)
    for harm, name, _ in DAMAGES[damage]:
        harm(run / name)
    blocksar.focus(store, run, **HERE, **SETTINGS)
    assert left(run) == undisturbed.left
    assert digests(run / "spectrum.zarr") == undisturbed.spectrum
    for part in ("collection.zarr", "patches"):
        assert digests(run / part) == digests(undisturbed.run / part)
    assert litter(run) == []
    assert computed_again(run, before) == set().union(*(lost for _, _, lost in DAMAGES[damage]))
