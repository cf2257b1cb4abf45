"""The scheduled workflow: each good collection is processed exactly once despite failures, without resource leaks."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import psutil
import pytest
import typer
import zarr
from distributed import Client, LocalCluster
from faults import digests, until
from repository import WORKFLOWS
from scenes import scene, write_store

import blocksar
from blocksar import stores
from blocksar.application import joint
from blocksar.errors import InputError
from blocksar.graph import cluster
from blocksar.places import place
from blocksar.processors.chain.tasks import stages
from blocksar.runs import folder

SCRIPT = WORKFLOWS / "process_inbox.py"
SCENE: dict[str, Any] = {  # 150 pulses of 91 range frequencies
    "swath": [29900.0, 30100.0],
    "prf": 3000.0,
    "duration": 0.05,
    "steering": (49.5, 50.5),
    "dwell": 0.02,
    "more": '[[targets]]\nname = "P"\nrange = 30000.0\nyaw_deg = 50.0\n',
}
SETTINGS: dict[str, Any] = {  # fast to plan
    "processor": "angular-division",
    "blocks": 1,
    "coefficients": "closed-form",
    "grid": [[15900.0, 16300.0, 4.0], [19000.0, 19400.0, 4.0]],
    "workers": 1,
    "threads": 1,
    "memory_limit": 2 * 2**30,
    "wait_workers": 0,
}
WORDS = (
    "--blocks", "1", "--coefficients", "closed-form", "--grid", "15900:16300:4,19000:19400:4", "--workers", "1",
    "--threads", "1", "--memory-limit", "2GiB",
)  # fmt: skip
YEAR = 365 * 86400  # s


@pytest.fixture(scope="module")
def inbox_module() -> Iterator[Any]:
    """The script as a module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(SCRIPT.parent))
        import process_inbox
        from inbox import hooks, statuses, sweeping

        yield SimpleNamespace(
            main=process_inbox.main, sweep=process_inbox.sweep, parse_group=process_inbox.parse_group,
            Hook=hooks.Hook, hooks=hooks,
            is_external=sweeping.is_external, DONE=statuses.DONE, FAILED=statuses.FAILED, USAGE=statuses.USAGE,
            QUARANTINED=statuses.QUARANTINED, BUSY=statuses.BUSY,
        )  # fmt: skip


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_store(tmp_path_factory.mktemp("tiny"), **SCENE)


@pytest.fixture(scope="module")
def image(store: Path, client: Client, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Digests of the image expected from every good collection."""
    run = tmp_path_factory.mktemp("straight") / "run"
    settings = {name: SETTINGS[name] for name in ("blocks", "coefficients", "grid")}
    blocksar.focus(store, run, client=client, **settings)
    return digests(run / "image.zarr")


@dataclass
class Post:
    """An inbox and an outbox, with methods to deliver collections, run sweeps and read the results."""

    module: Any
    store: Path
    client: Client
    folder: Path
    told: list[dict[str, Any]] = field(default_factory=list)

    @property
    def inbox(self) -> Path:
        return self.folder / "inbox"

    @property
    def outbox(self) -> Path:
        return self.folder / "outbox"

    def deliver(self, *names: str, written: float | None = None) -> None:
        """Put copies of the store into the inbox, each one second newer than the previous one."""
        self.inbox.mkdir(exist_ok=True)
        for number, name in enumerate(names):
            part = self.inbox / ".part"
            shutil.copytree(self.store, part)
            age = (written if written is not None else 1e9) + number
            os.utime(part / "zarr.json", (age, age))
            part.rename(self.inbox / f"{name}.zarr")

    def sweep(self, hook: Any = None, **changes: Any) -> int:
        """Run one sweep in this process on the existing workers; return its exit status."""
        return self.module.sweep(
            str(self.inbox), str(self.outbox), SETTINGS | changes, hook or self.module.Hook([]), quiet=True,
            scheduler=self.client.scheduler.address,
        )  # fmt: skip

    def start(self, *more: str) -> subprocess.Popen[str]:
        """Start the script as a timer would."""
        return subprocess.Popen(
            [sys.executable, str(SCRIPT), str(self.inbox), str(self.outbox), *WORDS, *more],
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True,
            # Background jobs of a shell ignore SIGINT, and the script would inherit that.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),  # noqa: PLW1509 (calls nothing else)
        )  # fmt: skip

    def log(self) -> list[dict[str, Any]]:
        log = self.outbox / "log.jsonl"
        text = log.read_text() if log.exists() else ""
        return [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]

    def names(self, event: str) -> list[str]:
        """Names of the collections with this event in the log, in log order."""
        return [entry["name"].removesuffix(".zarr") for entry in self.log() if entry["event"] == event]

    def status(self) -> dict[str, Any]:
        return dict(json.loads((self.outbox / "status.json").read_text()))

    def records(self, kind: str) -> dict[str, dict[str, Any]]:
        found = (json.loads(path.read_text()) for path in (self.outbox / kind).iterdir())
        return {record["name"].removesuffix(".zarr"): record for record in found}

    def images(self) -> dict[str, dict[str, str]]:
        return {run.name: digests(run / "image.zarr") for run in (self.outbox / "runs").iterdir()}

    def damage(self, name: str) -> None:
        """Truncate the samples of a collection."""
        chunk = samples_of(self.inbox / f"{name}.zarr")
        chunk.write_bytes(chunk.read_bytes()[:1000])


def samples_of(store: Path) -> Path:
    return next(path for path in sorted((store / "signal" / "c").rglob("*")) if path.is_file())


@pytest.fixture
def post(inbox_module: Any, store: Path, client: Client, tmp_path: Path) -> Post:
    return Post(inbox_module, store, client, tmp_path)


def everything(folder: Path) -> dict[str, tuple[int, int]]:
    return {str(p): (p.stat().st_size, p.stat().st_mtime_ns) for p in folder.rglob("*")}


# ---------------------------------------------------------------- sweeps


def test_good_collections_are_processed_once_and_bad_ones_quarantined(post: Post, image: dict[str, str]) -> None:
    post.deliver("c", "cut", "a", "foreign", "b")
    post.damage("cut")
    (post.inbox / "foreign.zarr" / "time" / "zarr.json").write_text("{}")
    (post.inbox / "arriving.zarr" / "signal").mkdir(parents=True)
    (post.inbox / ".hidden.zarr").mkdir()
    (post.inbox / "packed.zarr").write_text("not a folder")
    (post.inbox / "notes.txt").write_text("not a collection")
    before = everything(post.inbox)

    assert post.sweep() == post.module.QUARANTINED
    assert post.names("done") == ["c", "a", "b"]  # oldest first
    assert post.images() == {"a": image, "b": image, "c": image}
    assert post.records("done")["a"]["run"] == str(post.outbox / "runs" / "a")
    bad = post.records("quarantine")
    assert set(bad) == {"cut", "foreign"}
    assert "signal" in bad["cut"]["reason"] and "time" in bad["foreign"]["reason"]
    assert all(record["fingerprint"] and "\n" not in record["reason"] for record in bad.values())
    status = post.status()
    assert (status["state"], status["exit_status"], status["left"]) == ("ended", post.module.QUARANTINED, 0)
    assert status["waiting"] == ["arriving.zarr", "packed.zarr"]
    assert status["done"] == ["c.zarr", "a.zarr", "b.zarr"]
    assert [entry["name"] for entry in status["quarantine"]] == ["cut.zarr", "foreign.zarr"]

    shown = everything(post.outbox / "runs")
    assert post.sweep() == post.module.DONE
    assert everything(post.outbox / "runs") == shown
    assert post.names("done") == ["c", "a", "b"] and post.names("started").count("cut") == 1
    assert [entry["name"] for entry in post.status()["quarantine"]] == ["cut.zarr", "foreign.zarr"]
    assert everything(post.inbox) == before
    assert sorted(p.name for p in post.outbox.iterdir()) == ["done", "log.jsonl", "quarantine", "runs", "status.json"]


@pytest.mark.slow
def test_quarantine_is_reported_once_even_after_a_failed_or_interrupted_sweep(
    post: Post, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exit status 3 reports a quarantine, and a stopped or failed sweep must not suppress it."""
    post.deliver("bad", "good")
    post.damage("bad")
    stopped = (blocksar.ProcessingError("no room"), post.module.FAILED), (KeyboardInterrupt(), None)
    whole = blocksar.focus
    for trouble, status in stopped:
        monkeypatch.setattr(blocksar, "focus", lambda *a, trouble=trouble, **k: _raise_at("good", trouble, whole, a, k))
        if status is None:
            with pytest.raises(KeyboardInterrupt):
                post.sweep()
        else:
            assert post.sweep() == status
    monkeypatch.undo()
    assert post.names("quarantined") == ["bad"]
    assert post.sweep() == post.module.QUARANTINED
    assert post.sweep() == post.module.DONE
    assert post.names("quarantined") == ["bad"] and post.names("done") == ["good"]


def _raise_at(name: str, trouble: BaseException, call: Callable[..., Any], args: Any, kwargs: Any) -> Any:
    if Path(args[0]).stem == name:
        raise trouble
    return call(*args, **kwargs)


@pytest.mark.slow
def test_changed_collections_are_processed_again(post: Post, store: Path, image: dict[str, str]) -> None:
    post.deliver("a", "b")
    post.damage("a")
    assert post.sweep() == post.module.QUARANTINED
    shutil.copy2(samples_of(store), samples_of(post.inbox / "a.zarr"))
    assert post.sweep() == post.module.DONE
    assert post.records("quarantine") == {}
    assert post.images() == {"a": image, "b": image}
    # Changed bytes under a finished name give a new image; the first image is kept.
    chunk = samples_of(post.inbox / "b.zarr")
    chunk.write_bytes(bytes(chunk.stat().st_size // 2) + chunk.read_bytes()[chunk.stat().st_size // 2 :])
    assert post.sweep() == post.module.DONE
    images = post.images()
    assert set(images) == {"a", "b", "b.2"} and images["b"] == image != images["b.2"]
    assert post.records("done")["b"]["run"].endswith("b.2")
    # The original bytes return: their image exists already.
    shutil.rmtree(post.inbox / "b.zarr")
    post.deliver("b", written=1e9 + 1)
    assert post.sweep() == post.module.DONE
    assert post.names("found finished") == ["b"] and set(post.images()) == {"a", "b", "b.2"}
    assert post.sweep() == post.module.DONE
    assert len(post.names("done")) == 4


@pytest.mark.slow
def test_changed_options_do_not_reprocess_finished_collections(post: Post) -> None:
    post.deliver("good", "bad")
    post.damage("bad")
    assert post.sweep() == post.module.QUARANTINED
    assert post.sweep(blocks=2) == post.module.QUARANTINED
    assert post.names("started") == ["good", "bad", "bad"]


@pytest.mark.slow
def test_an_interrupted_collection_is_resumed(
    post: Post, image: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: Any, **__: Any) -> Any:
        raise KeyboardInterrupt

    post.deliver("a", "b")
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(stages, "mosaic", interrupted)
        post.sweep()
    status = post.status()
    assert (status["state"], status["exit_status"], status["left"]) == ("interrupted", 130, 2)
    assert status["current"]["name"] == "a.zarr"
    assert post.sweep() == post.module.DONE
    assert (post.names("resumed"), post.names("done")) == (["a"], ["a", "b"])
    assert post.images() == {"a": image, "b": image}
    receipts = json.loads((post.outbox / "runs" / "a" / "run.json").read_text())["receipts"]
    assert [r["unit"] for r in receipts if r.get("reused")] == ["columns-0", "block-0"]


@pytest.mark.slow
def test_an_interrupted_collection_of_several_channels_is_resumed(
    post: Post, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: Any, **__: Any) -> Any:
        raise KeyboardInterrupt

    (tmp_path / "scene.toml").write_text(f'channels = ["HH", "HV"]\n{scene(**SCENE)}')
    blocksar.simulate(tmp_path / "scene.toml", post.inbox / "a.zarr")
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(joint, "share_chunk", interrupted)
        post.sweep()
    assert post.sweep() == post.module.DONE
    assert post.names("resumed") == ["a"]
    assert [path.name for path in (post.outbox / "runs").iterdir()] == ["a"]


@pytest.mark.slow
@pytest.mark.parametrize("change", ["bytes", "version"])
def test_an_outdated_unfinished_run_is_restarted(
    change: str, post: Post, image: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: Any, **__: Any) -> Any:
        raise KeyboardInterrupt

    post.deliver("a")
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(stages, "mosaic", interrupted)
        post.sweep()
    if change == "bytes":
        os.utime(samples_of(post.inbox / "a.zarr"))
    if change == "version":
        path = post.outbox / "runs" / "a" / "run.json"
        stores.write_json(path, stores.read_json(path) | {"format": -1})
    assert post.sweep() == post.module.DONE
    assert post.names("restarted") == ["a"] and post.images() == {"a": image}


@pytest.mark.slow
def test_sweeps_do_not_depend_on_the_clock(post: Post, image: dict[str, str]) -> None:
    """With arbitrary dates each collection is processed once, in the order of the dates."""
    post.deliver("from-2100", written=130 * YEAR)
    post.deliver("from-1970", written=0)
    assert post.sweep() == post.module.DONE
    for path in post.outbox.rglob("*"):  # the clock is set backwards
        os.utime(path, (path.stat().st_atime, path.stat().st_mtime - 20 * YEAR))
    assert post.sweep() == post.module.DONE
    post.deliver("late", written=50 * YEAR)
    assert post.sweep() == post.module.DONE
    assert post.names("done") == ["from-1970", "from-2100", "late"]
    assert set(map(str, post.images().values())) == {str(image)}


@pytest.mark.slow
def test_foreign_folders_in_the_outbox_are_kept(post: Post) -> None:
    post.deliver("a")
    thesis = post.outbox / "runs" / "a" / "thesis.tex"
    thesis.parent.mkdir(parents=True)
    thesis.write_text("years of work")
    (post.outbox / "runs" / "a.2").write_text("a file")
    assert post.sweep() == post.module.DONE
    assert thesis.read_text() == "years of work"
    assert post.records("done")["a"]["run"] == str(post.outbox / "runs" / "a.3")


# ---------------------------------------------------------------- hooks


def taking(folder: Path, *, status: int = 0) -> list[str]:
    """A command that records its standard input and exits with a status."""
    code = f"import sys; open({str(folder / 'told')!r}, 'a').write(sys.stdin.read() + '\\n'); sys.exit({status})"
    return [sys.executable, "-S", "-c", code]


def told(folder: Path) -> list[tuple[str, str]]:
    entries = [json.loads(line) for line in (folder / "told").read_text().splitlines()]
    return [(entry["event"], entry["name"]) for entry in entries]


@pytest.mark.slow
def test_every_settled_collection_is_reported_to_the_hook(post: Post, tmp_path: Path) -> None:
    post.deliver("a", "bad", "b")
    post.damage("bad")
    settled = [("done", "a.zarr"), ("quarantined", "bad.zarr"), ("done", "b.zarr")]
    assert post.sweep(post.module.Hook(taking(tmp_path, status=5))) == post.module.FAILED
    assert told(tmp_path) == settled and post.status()["untold"] == 3
    reasons = [entry["reason"] for entry in post.log() if entry["event"] == "untold"]
    assert reasons == ["the hook exited with status 5"] * 3
    assert post.sweep(post.module.Hook(taking(tmp_path))) == post.module.QUARANTINED  # reported, not processed
    assert told(tmp_path) == settled * 2
    assert post.sweep(post.module.Hook(taking(tmp_path))) == post.module.DONE
    assert told(tmp_path) == settled * 2
    assert len(post.names("done")) == 2


def test_a_hook_that_hangs_is_terminated(post: Post, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(post.module.hooks, "HOOK_SECONDS", 0.2)
    trouble = post.module.Hook(["sleep", "1000"]).send({"event": "done"})
    assert "timed out" in trouble
    assert not [child for child in psutil.Process().children() if "1000" in child.cmdline()]


def test_hooks_are_not_run_by_a_shell(post: Post, tmp_path: Path) -> None:
    hook = post.module.Hook.parse(f"touch {tmp_path}/a ';' '$(touch {tmp_path}/b)'")
    assert hook.command == ["touch", f"{tmp_path}/a", ";", f"$(touch {tmp_path}/b)"]
    for wrong, why in (("'", "quotes"), ("", "no executable"), ("/no/such/command", "no executable")):
        with pytest.raises(InputError, match=why):
            post.module.Hook.parse(wrong)


# ---------------------------------------------------------------- failures


@pytest.mark.slow
def test_a_collection_that_fails_for_external_reasons_is_retried(
    post: Post, image: dict[str, str], tmp_path: Path
) -> None:
    post.deliver("a", "b")
    with ExitStack() as held:
        held.enter_context(folder.claim(place(post.outbox / "runs" / "a")))  # another process focuses this collection
        assert post.sweep(post.module.Hook(taking(tmp_path))) == post.module.FAILED
        assert told(tmp_path) == [("failed", "a.zarr"), ("done", "b.zarr")]
        assert [entry["name"] for entry in post.status()["failed"]] == ["a.zarr"]
    assert post.records("quarantine") == {}
    assert post.sweep() == post.module.DONE
    assert post.images() == {"a": image, "b": image}


@pytest.mark.slow
def test_a_defect_does_not_stop_the_other_collections(post: Post, monkeypatch: pytest.MonkeyPatch) -> None:
    real = blocksar.focus

    def defective(source: str, *args: Any, **settings: Any) -> Any:
        if "bad" in source:
            raise ZeroDivisionError("of a defect")
        return real(source, *args, **settings)

    post.deliver("bad", "good")
    monkeypatch.setattr(blocksar, "focus", defective, raising=False)
    assert post.sweep() == post.module.FAILED
    assert post.names("done") == ["good"]
    (failure,) = (entry for entry in post.log() if entry["event"] == "failed")
    assert failure["reason"] == "ZeroDivisionError: of a defect" and "in defective" in failure["traceback"]


@pytest.mark.parametrize(
    ("cause", "passing"),
    [(PermissionError(13, "x"), True), (OSError(5, "x"), True), (FileNotFoundError(2, "x"), False), (None, False),
     (OSError("of a codec"), False), (ValueError("x"), False)],
)  # fmt: skip
def test_system_errors_count_as_external(cause: Exception | None, passing: bool, post: Post) -> None:
    error = InputError("it cannot be read")
    error.__cause__ = cause
    assert post.module.is_external(error) == passing
    error.__cause__ = between = ValueError("of a library")
    between.__cause__ = cause
    assert post.module.is_external(error) == passing


@pytest.mark.slow
@pytest.mark.parametrize("there", [False, True])
def test_without_a_cluster_no_collection_is_quarantined(
    there: bool, post: Post, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither where no scheduler is there, nor where one has no workers."""
    monkeypatch.setattr(cluster, "CONNECT", 0.5)
    post.deliver("a", "b")
    with ExitStack() as stack:
        address = "tcp://127.0.0.1:9"
        if there:
            settings: dict[str, Any] = {"processes": False, "dashboard_address": "127.0.0.1:0"}
            address = stack.enter_context(LocalCluster(n_workers=0, **settings)).scheduler_address
        arguments = (str(post.inbox), str(post.outbox), SETTINGS, post.module.Hook([]))
        assert post.module.sweep(*arguments, scheduler=address, quiet=True) == post.module.FAILED
    assert post.status()["left"] == 2
    assert [entry["event"] for entry in post.log()] == ["sweep", "started", "no cluster", "end"]
    assert post.records("quarantine") == {} and post.records("done") == {}


@pytest.mark.slow
def test_a_removed_collection_is_not_a_failure(post: Post) -> None:
    class Thief(post.module.Hook):  # type: ignore[name-defined, misc]
        def send(self, event: dict[str, Any]) -> None:
            shutil.rmtree(post.inbox / "b.zarr", ignore_errors=True)

    post.deliver("a", "b", "c")
    assert post.sweep(Thief(["x"])) == post.module.DONE
    assert (post.names("done"), post.names("gone")) == (["a", "c"], ["b"])
    assert post.records("quarantine") == {}


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A CPHD file."""
    folder = tmp_path_factory.mktemp("cphd")
    (folder / "scene.toml").write_text(scene(**SCENE))
    return Path(blocksar.simulate(folder / "scene.toml", folder / "a.cphd", cphd=True))


ABOUT = [[-200.0, 200.0, 4.0], [-200.0, 200.0, 4.0]]  # the origin of the file's frame


def test_measured_data_are_ingested_once_and_processed_as_a_collection(post: Post, measured: Path) -> None:
    post.inbox.mkdir()
    arriving = post.inbox / "a.cphd"
    arriving.write_bytes(measured.read_bytes()[:-5000])  # still being copied
    (post.inbox / "notes.txt").write_text("not a collection")
    (post.inbox / "folder").mkdir()
    shutil.copy(measured, post.inbox / "folder")
    (post.inbox / "twice.cphd").write_bytes(measured.read_bytes())
    blocksar.ingest(None, measured, post.inbox / "twice.cphd.zarr", progress=False)
    assert post.sweep(grid=ABOUT) == post.module.DONE
    status = post.status()
    assert status["waiting"] == ["a.cphd.zarr"] and post.names("waiting") == ["a.cphd"]
    assert "notes.txt is a text file; give the data that it describes" in status["ignored"]["notes.txt"]
    assert "a.cphd is a CPHD file; turn it into a phase history first" in status["ignored"]["folder"]
    assert "twice.cphd.zarr lies beside it and is taken" in status["ignored"]["twice.cphd"]
    arriving.write_bytes(measured.read_bytes())
    assert post.sweep(grid=ABOUT) == post.module.DONE and post.status()["waiting"] == ["a.cphd.zarr"]
    before = everything(post.inbox)
    for _ in range(2):
        assert post.sweep(grid=ABOUT) == post.module.DONE
        assert post.status()["waiting"] == []
    assert post.names("ingesting") == ["a.cphd"] and post.names("done") == ["twice.cphd", "a.cphd"]
    images = post.images()
    assert set(images) == {"a.cphd", "twice.cphd"} and images["a.cphd"] == images["twice.cphd"]
    assert everything(post.inbox) == before
    arriving.write_bytes(measured.read_bytes()[:-5000])  # and stays so
    assert post.sweep(grid=ABOUT) == post.module.DONE
    assert post.sweep(grid=ABOUT) == post.module.QUARANTINED
    assert "a.cphd" in post.records("quarantine")["a.cphd"]["reason"]


def test_a_missing_grid_is_found_before_a_cluster_starts(post: Post, monkeypatch: pytest.MonkeyPatch) -> None:
    post.deliver("a")
    beam = zarr.open_array(post.inbox / "a.zarr" / "beam_azimuth", mode="r+")
    beam[...] = np.full(beam.shape, np.nan)
    monkeypatch.setattr(cluster, "open_client", lambda **_: pytest.fail("a cluster was started"))
    assert post.sweep(grid=None) == post.module.QUARANTINED
    assert "grid" in post.records("quarantine")["a"]["reason"]


def test_a_truncated_log_line_leaves_the_others_intact(post: Post) -> None:
    post.deliver("a")
    assert post.sweep() == post.module.DONE
    with open(post.outbox / "log.jsonl", "a") as file:
        file.write('{"time": "20')
    assert post.sweep() == post.module.DONE
    lines = (post.outbox / "log.jsonl").read_text().splitlines()
    assert lines.count('{"time": "20') == 1
    lines.remove('{"time": "20')
    assert [json.loads(line)["event"] for line in lines] == ["sweep", "started", "done", "end", "sweep", "end"]


@pytest.mark.slow
def test_a_sweep_goes_on_when_nobody_reads_what_it_says(post: Post) -> None:
    post.deliver("a", "b")
    for name in ("a", "b"):
        shutil.rmtree(post.inbox / f"{name}.zarr" / "time")
    with post.start() as process:
        assert process.stderr is not None
        process.stderr.close()
        assert process.wait() == post.module.QUARANTINED
    assert set(post.records("quarantine")) == {"a", "b"}


WRONG: dict[str, tuple[Callable[[Path], dict[str, Any]], str]] = {
    "no inbox": (lambda folder: {"inbox": str(folder / "nowhere")}, "nowhere cannot be listed"),
    "inbox a file": (lambda folder: {"inbox": str(folder / "file")}, "file cannot be listed"),
    "outbox a file": (lambda folder: {"outbox": str(folder / "file")}, "file cannot be written"),
    "outbox a bucket": (lambda folder: {"outbox": "s3://bucket/x"}, "not a local folder"),
    "outbox the inbox": (lambda folder: {"outbox": str(folder / "inbox")}, "lies in INBOX"),
    "outbox in the inbox": (lambda folder: {"outbox": str(folder / "inbox" / "out")}, "lies in INBOX"),
    "blocks": (lambda folder: {"blocks": "many"}, "--blocks 'many'"),
    "grid": (lambda folder: {"grid": "1:2"}, "--grid"),
    "hook": (lambda folder: {"notify": "/no/such/command"}, "--notify"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_usage_is_refused_and_writes_nothing(
    case: str, post: Post, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    change, message = WRONG[case]
    post.inbox.mkdir()
    (post.folder / "file").write_text("x")
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    monkeypatch.chdir(post.folder)
    with pytest.raises(typer.Exit) as ended:
        post.module.main(**{"inbox": str(post.inbox), "outbox": str(post.outbox)} | change(post.folder))
    assert ended.value.exit_code == post.module.USAGE
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1
    assert sorted(p.name for p in post.folder.iterdir()) == ["file", "inbox"]


@pytest.mark.parametrize("inbox", ["scratch", "elsewhere"])
def test_a_foreign_scratch_folder_is_not_removed(inbox: str, post: Post) -> None:
    """The given outbox may already contain a user's folder named scratch, with collections or other files."""
    kept = post.outbox / "scratch" / "kept"
    kept.mkdir(parents=True)
    shutil.copytree(post.store, post.outbox / inbox / "a.zarr")
    before = everything(post.folder)
    with pytest.raises(InputError, match=r"scratch|that a sweep writes"):
        post.module.sweep(str(post.outbox / inbox), str(post.outbox), SETTINGS, post.module.Hook([]))
    assert everything(post.folder) == before


# ---------------------------------------------------------------- processes


@pytest.mark.slow
def test_concurrent_sweeps_and_a_kill_process_each_collection_once(post: Post, image: dict[str, str]) -> None:
    """Two sweeps at once, a bad collection, a SIGKILL, then two more sweeps: each good collection runs once."""
    post.deliver("a", "bad", "b", "c", "d", "e")
    post.damage("bad")
    address = ("--scheduler", post.client.scheduler.address, "--quiet")
    with post.start(*address) as first:
        until(lambda: "b" in post.names("started") or first.poll() is not None, "the third collection")
        first.send_signal(signal.SIGSTOP)  # otherwise it could finish before the second starts
        with post.start(*address) as second:
            _, said = second.communicate()
        assert second.returncode == post.module.BUSY
        assert f"process {first.pid} " in said
        first.kill()
    settled = {*post.records("done"), *post.records("quarantine")}
    assert settled, "killed too early to say anything"
    assert post.status()["state"] == "running"  # the killed sweep could not update its status
    with post.start(*address) as third, post.start(*address) as fourth:
        statuses = {third.wait(), fourth.wait()}
    # If one starts after the other has ended, it finds nothing to do.
    assert statuses <= {post.module.DONE, post.module.QUARANTINED, post.module.BUSY}
    assert post.module.QUARANTINED in statuses  # the killed sweep could not report it
    assert post.images() == dict.fromkeys("abcde", image)
    assert set(post.records("done")) == set("abcde") and set(post.records("quarantine")) == {"bad"}
    started = post.names("started") + post.names("resumed")
    assert all(started.count(name) == 1 for name in settled)
    assert sorted(post.names("done")) == list("abcde")


# ---------------------------------------------------------------- inbox in a bucket


@pytest.mark.slow
def test_the_inbox_may_be_a_bucket(post: Post, image: dict[str, str]) -> None:
    """The same rules hold, in the order of names; the runs are written to the local outbox."""
    for library in ("obstore", "moto", "boto3"):
        pytest.importorskip(library)
    import obstore
    import s3

    post.deliver("b", "a", "bad", "arriving")
    post.damage("bad")
    (post.inbox / "arriving.zarr" / "zarr.json").unlink()
    with s3.server():
        bucket = s3.make_bucket()
        store = obstore.store.S3Store(bucket, client_options={"allow_http": True})
        for path in sorted(path for path in post.inbox.rglob("*") if path.is_file()):
            obstore.put(store, f"in/{path.relative_to(post.inbox)}", path)
        sweep = (f"s3://{bucket}/in", str(post.outbox), SETTINGS | {"workers": 0}, post.module.Hook([]))
        assert post.module.sweep(*sweep, quiet=True) == post.module.QUARANTINED
        assert post.names("done") == ["a", "b"] and set(post.records("quarantine")) == {"bad"}
        assert post.images() == {"a": image, "b": image}
        assert post.status()["waiting"] == ["arriving.zarr"]
        assert post.module.sweep(*sweep, quiet=True) == post.module.DONE
        assert post.names("done") == ["a", "b"]


# ---------------------------------------------------------------- soak test

MANY, SETTLED = 20, 8  # collections; number of them after which everything is loaded
GROWTH = 4 * 2**20  # bytes per process over the twelve after that: 0.3 MiB each, less than the arrays of a plan
FEW = 6  # additional files or threads: a leak in every second collection reaches it; connections come and go


# The hook logs the sizes of its parent and of the parent's other descendants, one line per collection.
SCALES = """
import json, os, sys
import psutil

def size(process):
    with process.oneshot():
        shared = sum(part.path.startswith("/dev/shm/") for part in process.memory_maps())
        return process.memory_full_info().uss, process.num_fds(), process.num_threads(), shared

sweep = psutil.Process(os.getppid())
family = [process for process in (sweep, *sweep.children(recursive=True)) if process.pid != os.getpid()]
with open(sys.argv[1], "a") as log:
    log.write(json.dumps({process.pid: size(process) for process in family}) + "\\n")
"""


@pytest.mark.slow
def test_twenty_collections_do_not_leak_resources(post: Post, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory, open files, threads, shared memory and temporary files of a sweep do not grow.

    The sweep runs in a process of its own, because the tests themselves make the test process grow.
    """
    scratch, log = tmp_path / "tmp", tmp_path / "sizes.jsonl"
    scratch.mkdir()
    (tmp_path / "scales.py").write_text(SCALES)
    monkeypatch.setenv("TMPDIR", str(scratch))
    post.deliver(*(f"{number:02}" for number in range(MANY)))
    running = post.start("--notify", shlex.join([sys.executable, str(tmp_path / "scales.py"), str(log)]))
    said = running.communicate()[1]
    assert running.returncode == post.module.DONE, said
    sizes = [json.loads(line) for line in log.read_text().splitlines()]
    assert len(sizes) == MANY == len(post.images())
    early, late = sizes[SETTLED - 1], sizes[MANY - 1]
    assert set(late) == set(early), "processes came and went"
    for pid in early:
        memory, files, threads, shared = zip(*(size[pid] for size in sizes), strict=True)
        assert memory[-1] - memory[SETTLED - 1] < GROWTH, (pid, memory)
        assert files[-1] <= files[SETTLED - 1] + FEW, (pid, files)
        assert threads[-1] <= threads[SETTLED - 1] + FEW, (pid, threads)
        assert shared[-1] <= shared[SETTLED - 1], (pid, shared)
    assert os.listdir(scratch) == []
    assert not (post.outbox / "scratch").exists()


# ---------------------------------------------------------------- acquisitions of several collections


@pytest.mark.slow
def test_collections_of_one_acquisition_become_one_mosaic(post: Post) -> None:
    names = ("pass_b0", "pass_b1", "pass_b2")

    def deliver(*names: str) -> None:
        post.deliver(*names)
        for name in names:
            zarr.open_group(post.inbox / f"{name}.zarr", mode="r+").attrs["frame"] = "site"

    def sweep(group: str | None = None) -> dict[str, Any]:
        assert post.module.sweep(
            str(post.inbox), str(post.outbox), SETTINGS, post.module.Hook([]), quiet=True,
            scheduler=post.client.scheduler.address, group=group and re.compile(group),
        ) == post.module.DONE  # fmt: skip
        return json.loads((post.outbox / "status.json").read_text())

    deliver(*names[:2])
    manifest = {"collections": [f"{name}.zarr" for name in names]}
    (post.inbox / "pass.acquisition.json").write_text(json.dumps(manifest))
    status = sweep()
    assert status["waiting"] == ["pass.zarr"] and not status["done"]
    deliver(names[2])
    assert sweep()["done"] == ["pass.zarr"]
    record = json.loads((post.outbox / "runs" / "pass" / "run.json").read_text())
    assert [Path(segment["path"]).stem for segment in record["segments"]] == list(names)
    assert not sweep()["done"]
    (post.inbox / "pass.acquisition.json").unlink()
    (post.outbox / "done" / "pass.zarr.json").unlink()
    assert sweep(r"(.+)_b[0-9]")["done"] == ["pass.zarr"]  # and its run is found finished
    assert [path.name for path in (post.outbox / "runs").iterdir()] == ["pass"]


@pytest.mark.slow
def test_a_store_of_several_collections_is_processed(post: Post) -> None:
    post.deliver("a")
    several = zarr.open_group(post.inbox / ".bursts", mode="w")
    several.attrs["collections"] = ["b0", "b1"]
    for name in ("b0", "b1"):
        shutil.copytree(post.store, post.inbox / ".bursts" / name)
        zarr.open_group(post.inbox / ".bursts" / name, mode="r+").attrs["frame"] = "site"
    (post.inbox / ".bursts").rename(post.inbox / "bursts.zarr")
    assert post.sweep() == post.module.DONE
    assert set(post.names("done")) == {"a", "bursts"}
    assert post.sweep() == post.module.DONE and len(post.names("started")) == 2


def test_what_names_an_acquisition_is_checked(post: Post) -> None:
    post.deliver("a")
    (post.inbox / "a.acquisition.json").write_text('{"collections": "a.zarr"}')
    with pytest.raises(InputError, match="lists no collections; write"):
        post.sweep()
    with pytest.raises(InputError, match=r"'\(' is no regular expression"):
        post.module.parse_group("(")
