"""Process an inbox: focus every collection that lies there exactly once, oldest first.

    python workflows/process_inbox.py INBOX OUTBOX --workers 2 --notify "notify-operators --channel radar"

One sweep, then it ends: cron or a systemd timer starts it again, as often as it likes. A sweep takes the
complete collections of INBOX (`NAME.zarr` that has its group's zarr.json: whoever delivers one writes it under
another name, and renames it when it is whole) and focuses them one after the other, on one cluster. INBOX is only
read. OUTBOX is the workflow's own:

    runs/NAME/                   the run; a changed collection of that name gets NAME.2, and so on
    done/NAME.zarr.json          a collection that is finished: fingerprint, run
    quarantine/NAME.zarr.json    one that cannot be focused: fingerprint, reason
    status.json                  what the sweep did, and what it is at
    log.jsonl                    all sweeps, one event a line
    lock, scratch/               there while a sweep runs

What is to be done follows from runs/, done/ and quarantine/ alone; no clock is asked. An interrupted run goes on.
What lies in quarantine is tried again when its bytes or the options change, or its record is removed. What is
done is done again when its bytes change, or its record and its run are removed.

    exit status   meaning
    0             all that was there is done
    1             something failed that is worth another try: no room, no cluster, a hook that failed
    2             an option or a path is wrong: nothing was done
    3             something was put into quarantine, all else is done; said once, if need be by a later sweep
    75            another sweep has this outbox: nothing was done
    130, 143      interrupted, terminated: the next sweep goes on from there

The hook is started without a shell for every collection that is done, quarantined or failed, and reads the event
as JSON from its standard input. What it did not take (it must end with 0) is told again by the next sweep: it may
hear of something twice, and hears of everything that was settled.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
import time
import traceback
from contextlib import AbstractContextManager, ExitStack, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import Enum
from hashlib import blake2b
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn, Self

import typer

import blocksar
from blocksar import stores
from blocksar.cli import endings, options, parsing
from blocksar.errors import FolderError, InputError, ProcessingError
from blocksar.places import place
from blocksar.places.local import LocalPlace
from blocksar.places.place import Held, Place
from blocksar.runs.folder import ASIDE, LOCK
from blocksar.runs.record import RunRecord

if TYPE_CHECKING:
    from distributed import Client


DONE, FAILED, USAGE, QUARANTINED, BUSY = 0, 1, 2, 3, os.EX_TEMPFAIL

FORMAT = 1  # of records, status and log
HOOK_SECONDS = 60.0  # a hook that takes longer is ended
STATUS_SECONDS = 1.0  # at least, between two notes of how far a run has come
FOLDERS = ("runs", "done", "quarantine")  # of an outbox
NAME_BYTES = 200  # of a record: file systems end at 255, and temporary names are longer than the name

Event = dict[str, Any]
Record = dict[str, Any]
Settings = dict[str, Any]  # of `focus`, as JSON holds them


# ---------------------------------------------------------------- the inbox


@dataclass(frozen=True)
class Arrival:
    """A complete collection in the inbox. `written` (ns) puts arrivals in order, and decides nothing else."""

    store: Place
    written: int

    @property
    def name(self) -> str:
        return self.store.name

    def fingerprint(self) -> str:
        """Hash of every file's name, size and version (time or tag): a damaged store has one as well.

        Whoever changes what is hashed here makes every finished collection a new one.
        """
        digest = blake2b(digest_size=16)
        try:
            for file in sorted(self.store.files()):
                digest.update(os.fsencode(repr(file)))
        except OSError as error:  # a store that cannot be listed has this for its contents
            digest.update(os.fsencode(str(error)))
        return digest.hexdigest()


def look_into(inbox: Place) -> tuple[list[Arrival], list[str]]:
    """Complete collections, oldest first, and the names of what has no zarr.json so far.

    The one place that lists the inbox.

    Raises
    ------
    InputError
        If it cannot be listed.
    """
    arrivals, waiting = [], []
    try:
        if isinstance(inbox, LocalPlace):
            os.scandir(inbox).close()  # a bucket without objects is empty, a folder that is missing is a mistake
        names = [name for name in inbox.names() if name.endswith(".zarr") and not name.startswith(".")]
    except OSError as error:
        raise InputError(f"INBOX {inbox} cannot be listed ({error.strerror}); give a folder that can") from None
    for store in (inbox / name for name in names):
        try:
            arrivals.append(Arrival(store, _written(store / "zarr.json")))
        except (FileNotFoundError, NotADirectoryError):
            waiting.append(store.name)
        except OSError:  # `focus` says what is the matter with it
            arrivals.append(Arrival(store, 0))
    return sorted(arrivals, key=lambda arrival: (arrival.written, arrival.name)), waiting


def _written(file: Place) -> int:
    """When a file was written, ns."""
    if isinstance(file, LocalPlace):
        return os.stat(file).st_mtime_ns
    if not file.exists():
        raise FileNotFoundError(file)
    return 0  # a bucket is taken in the order of names


# ---------------------------------------------------------------- the outbox


class Standing(Enum):
    """What stands where a run is to go."""

    NOTHING = "started"
    UNFINISHED = "resumed"
    FINISHED = "found finished"


@dataclass(frozen=True)
class Outbox:
    """Where runs, records, status and log lie."""

    folder: Path

    @property
    def scratch(self) -> Path:
        """Temporary files of the workers. Whatever lies there is removed."""
        return self.folder / "scratch"

    def keep_apart(self, inbox: Path) -> None:
        """Nothing is written to an inbox, and none is removed."""
        source, own = Path(os.path.realpath(inbox)), Path(os.path.realpath(self.folder))
        if own.is_relative_to(source):
            raise InputError(f"OUTBOX {self.folder} lies in INBOX {inbox}, which is only read; give another")
        if any(source.is_relative_to(own / name) for name in (*FOLDERS, self.scratch.name)):
            raise InputError(
                f"INBOX {inbox} lies among what a sweep writes in OUTBOX {self.folder}; give another OUTBOX"
            )

    def prepare(self) -> None:
        folders = [self.folder / name for name in FOLDERS]
        if self.scratch.exists() and not all(folder.is_dir() for folder in folders):
            raise InputError(f"OUTBOX {self.folder} holds a folder scratch that is not the workflow's; give another")
        try:
            for folder in folders:
                folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"OUTBOX {self.folder} cannot be written ({error.strerror}); give another") from None

    def lock(self) -> AbstractContextManager[None]:
        """Keep other sweeps out. However the process ends, the system lifts it."""
        return place(self.folder / "lock").lock()

    def record(self, kind: Literal["done", "quarantine"], name: str) -> Path:
        if len(os.fsencode(name)) > NAME_BYTES:
            name = blake2b(os.fsencode(name), digest_size=16).hexdigest()
        return self.folder / kind / f"{name}.json"

    def settled(self, name: str, fingerprint: str, settings: Settings) -> Record | None:
        """The record of a collection that is done, or that cannot be focused with these settings."""
        record = _read_record(self.record("done", name))
        if record is not None and record.get("fingerprint") == fingerprint:
            return record
        record = _read_record(self.record("quarantine", name))
        if record is not None and (record.get("fingerprint"), record.get("settings")) == (fingerprint, settings):
            return record
        return None

    def settle(self, record: Record) -> None:
        """Write a record. What is done is in quarantine no more."""
        done, quarantine = (self.record(kind, record["name"]) for kind in ("done", "quarantine"))
        if record["event"] == "done":
            stores.write_json(done, record)
            quarantine.unlink(missing_ok=True)
        else:
            stores.write_json(quarantine, record)

    def run_of(self, source: Place, fingerprint: str) -> tuple[Path, Standing]:
        """The run folder of a collection: NAME, or the first of NAME.2, ... that holds nothing of another.

        Parameters
        ----------
        fingerprint : str
            Of the phase history, as run.json has it.
        """
        stem = source.name.removesuffix(".zarr")
        for number in count(1):
            run = self.folder / "runs" / (stem if number == 1 else f"{stem}.{number}")
            if not os.path.lexists(run) or (run.is_dir() and set(os.listdir(run)) <= {LOCK, ASIDE}):
                return run, Standing.NOTHING
            record = _run_record(run)
            if record is None:
                continue
            same = record.input.fingerprint == fingerprint
            if same and record.finished:
                return run, Standing.FINISHED
            # What a collection of that name left unfinished before it changed is of no more use.
            if not record.finished and (same or os.path.basename(record.input.path) == source.name):
                return run, Standing.UNFINISHED
        raise AssertionError


def _read_record(path: Path) -> Record | None:
    """A record, or None where none can be read."""
    with suppress(InputError):
        record = stores.read_json(path)
        if isinstance(record, dict):
            return record
    return None


def _run_record(run: Path) -> RunRecord | None:
    """The record of a run, or None where none can be read."""
    with suppress(InputError):
        return RunRecord.read(place(run))
    return None


# ---------------------------------------------------------------- those who are told


@dataclass(frozen=True)
class Hook:
    """A command that is told of events; nobody is told where there is none."""

    command: list[str]

    @classmethod
    def parse(cls, text: str | None) -> Self:
        """Read a command line as a shell would divide it.

        Raises
        ------
        InputError
            If it cannot be divided, or there is no such command.
        """
        if text is None:
            return cls([])
        try:
            command = shlex.split(text)
        except ValueError as error:
            raise InputError(f"--notify {text!r} is no command line ({error}); check its quotes") from None
        if not command or shutil.which(command[0]) is None:
            raise InputError(f"--notify {text!r} names no command that can be run; give its path")
        return cls(command)

    def tell(self, event: Event) -> str | None:
        """Hand over an event; what went wrong, or None."""
        if not self.command:
            return None
        try:
            done = subprocess.run(self.command, input=json.dumps(event).encode(), timeout=HOOK_SECONDS, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            return f"the hook failed: {error}"
        return f"the hook ended with {done.returncode}" if done.returncode else None


@dataclass
class Journal:
    """The log, the status file, and a line on stderr for people."""

    outbox: Outbox
    quiet: bool = False
    status: dict[str, Any] = field(default_factory=dict)
    _sweep: str = field(default_factory=lambda: f"{datetime.now(UTC):%Y%m%dT%H%M%S}-{os.getpid()}")
    _noted: float = 0.0

    def write(self, event: Event) -> None:
        """Append a line to the log, whole or not at all for whoever reads it line by line."""
        if not self.quiet:
            words = [event.get(key, "") for key in ("event", "name", "run", "reason")]
            print("inbox:", *(word if word.isprintable() else repr(word) for word in words if word), file=sys.stderr)
        line = json.dumps({"time": _now(), "sweep": self._sweep, **event})
        try:
            with open(self.outbox.folder / "log.jsonl", "ab+") as file:
                file.seek(-1, os.SEEK_END) if file.tell() else None
                broken = file.read(1) not in (b"", b"\n")  # by a loss of power
                file.write(b"\n" * broken + line.encode() + b"\n")
        except OSError as error:
            self._lost(error)

    def note(self, **changes: Any) -> None:
        """Change the status, and write it."""
        self.status |= changes | {"format": FORMAT, "sweep": self._sweep, "pid": os.getpid(), "updated": _now()}
        self._noted = time.monotonic()
        try:
            stores.write_json(self.outbox.folder / "status.json", self.status)
        except ProcessingError as error:
            self._lost(error)

    def update(self, stage: str, done: int, total: int) -> None:
        """How far a run has come: what `focus` calls."""
        if time.monotonic() - self._noted > STATUS_SECONDS:
            self.note(current=self.status["current"] | {"stage": stage, "done": done, "total": total})

    def _lost(self, error: Exception) -> None:
        print(f"inbox: {error}", file=sys.stderr)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")


# ---------------------------------------------------------------- the cluster


class Unserved(RuntimeError):
    """There is no cluster to work on."""


@dataclass
class Cluster:
    """One cluster for the whole sweep: started when the first collection needs it, and anew after a failure."""

    settings: Settings
    scheduler: str | None
    scratch: Path
    _stack: ExitStack = field(default_factory=ExitStack)
    _client: Client | None = None

    def __enter__(self) -> Self:
        self._clear()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._client = None
        try:
            self._stack.__exit__(kind, error, trace)
        finally:
            self._clear()

    def _clear(self) -> None:
        """Temporary files of the workers: of those as well that were killed with an earlier sweep."""
        shutil.rmtree(self.scratch, ignore_errors=True)

    def client(self) -> Client:
        """A client whose cluster has workers.

        Raises
        ------
        Unserved
            If there is none to be had.
        """
        from blocksar.graph.cluster import cluster_size, machine, open_client

        try:
            if self._client is None:
                cores, memory = machine()
                workers = self.settings["workers"] or min(cores, 4)
                opened = open_client(
                    scheduler=self.scheduler,
                    workers=workers,
                    threads=self.settings["threads"] or max(cores // workers, 1),
                    memory_limit=self.settings["memory_limit"] or memory // workers,
                    scratch=str(self.scratch),
                )
                self._client = self._stack.enter_context(opened)
            cluster_size(self._client)
        except (InputError, OSError) as error:
            raise Unserved(str(error)) from error
        return self._client

    def leave(self, error: Exception) -> None:
        """Give up a cluster that failed; the next collection gets another."""
        self._client = None
        with suppress(Exception):  # a lost one does not close well
            self._stack.__exit__(type(error), error, error.__traceback__)


# ---------------------------------------------------------------- a sweep


@dataclass
class Sweep:
    """All that is to be done in an inbox, once."""

    inbox: Place
    outbox: Outbox
    settings: Settings  # of `focus`
    cluster: Cluster
    hook: Hook
    journal: Journal
    done: list[str] = field(default_factory=list)
    failed: list[Event] = field(default_factory=list)
    quarantined: list[str] = field(default_factory=list)  # by this sweep
    quarantine: list[Event] = field(default_factory=list)  # by this one or by another
    unsaid: list[Record] = field(default_factory=list)  # quarantined, and no sweep has ended with 3 since
    untold: int = 0
    left: int = 0

    def run(self) -> int:
        """Sweep, and return the exit status.

        Raises
        ------
        InputError
            If the inbox cannot be listed.
        """
        arrivals, waiting = look_into(self.inbox)
        self.journal.write({"event": "sweep", "inbox": str(self.inbox), "arrivals": len(arrivals)})
        self.left = len(arrivals)
        self._note(
            state="running", current=None, exit_status=None, started=_now(), inbox=str(self.inbox), waiting=waiting
        )
        try:
            for arrival in arrivals:
                try:
                    self._take(arrival)
                except (OSError, ProcessingError) as error:  # what is known of it could not be read or written
                    self._fail({"name": arrival.name, "source": str(arrival.store), "reason": str(error)})
                self.left -= 1
            status = FAILED if self.failed or self.untold else QUARANTINED if self.unsaid else DONE
        except Unserved as error:
            self.journal.write({"event": "no cluster", "reason": str(error)})
            status = FAILED
        except BaseException as error:
            status = {KeyboardInterrupt: endings.INTERRUPTED, endings.Terminated: endings.TERMINATED}.get(
                type(error), FAILED
            )
            self._note(state="interrupted", exit_status=status)
            self.journal.write({"event": "interrupted", "reason": type(error).__name__})
            raise
        self._note(state="ended", exit_status=status)
        self.journal.write({"event": "end", "exit_status": status})
        if status == QUARANTINED:
            with suppress(ProcessingError):  # no room for it: then the next sweep says so again
                for record in self.unsaid:
                    self.outbox.settle(record | {"said": True})
        return status

    def _note(self, **changes: Any) -> None:
        self.journal.note(
            done=self.done, failed=self.failed, quarantined=self.quarantined, quarantine=self.quarantine,
            untold=self.untold, left=self.left, **changes,
        )  # fmt: skip

    def _take(self, arrival: Arrival) -> None:
        """Bring one collection to its end, unless that was done before."""
        fingerprint = arrival.fingerprint()
        record = self.outbox.settled(arrival.name, fingerprint, self.settings)
        if record is None:
            event = self._process(arrival)
            if event is None:
                return
            record = {"format": FORMAT, **event, "fingerprint": fingerprint, "settings": self.settings}
            if event["event"] == "failed":
                self._fail(event)
                return
            (self.done if event["event"] == "done" else self.quarantined).append(arrival.name)
            record["told"] = not self.hook.command
            if event["event"] == "quarantined":
                record["said"] = False
            self.outbox.settle(record)
        if not record.get("told") and self._tell(record):
            record = record | {"told": True}
            self.outbox.settle(record)
        if record.get("event") == "quarantined":
            self.quarantine.append({"name": arrival.name, "reason": record.get("reason")})
            if not record.get("said", True):
                self.unsaid.append(record)

    def _fail(self, event: Event) -> None:
        event = event | {"event": "failed"}
        self.failed.append(event)
        self._tell(event)

    def _tell(self, event: Event) -> bool:
        trouble = self.hook.tell(event)
        if trouble is not None:
            self.untold += 1
            self.journal.write({"event": "untold", "name": event["name"], "reason": trouble})
        return trouble is None

    def _process(self, arrival: Arrival) -> Event | None:
        """Focus a collection: done, quarantined or failed; None if it was taken away."""
        started = time.perf_counter()
        event: Event = {"name": arrival.name, "source": str(arrival.store)}
        try:
            run, standing = self._place(arrival)
            self.journal.write({"event": standing.value, "name": arrival.name, "run": str(run)})
            self._note(current={"name": arrival.name, "run": str(run)})
            summary = [] if standing is Standing.FINISHED else self._focus(arrival, run, standing)
            event |= {"event": "done", "run": str(run), "summary": summary}
        except Unserved:
            raise
        except InputError as error:
            if not arrival.store.exists():
                self.journal.write({"event": "gone", "name": arrival.name})
                return None
            event |= {"event": "failed" if _passing(error) else "quarantined", "reason": str(error)}
        except Exception as error:  # whatever it is, those that wait behind are none the worse for it
            known = isinstance(error, ProcessingError | OSError)
            event |= {"event": "failed", "reason": str(error) if known else f"{type(error).__name__}: {error}"}
            if not known:
                event["traceback"] = traceback.format_exc()
            self.cluster.leave(error)
        self.journal.write(event | {"seconds": round(time.perf_counter() - started, 3)})
        self._note(current=None)
        return event

    def _place(self, arrival: Arrival) -> tuple[Path, Standing]:
        return self.outbox.run_of(arrival.store, stores.open_phase_history(str(arrival.store)).fingerprint())

    def _focus(self, arrival: Arrival, run: Path, standing: Standing) -> list[str]:
        """Focus into a run; what there is to say of it. What is left of other options, bytes or versions goes."""
        arguments: dict[str, Any] = {**self.settings, "client": self.cluster.client(), "progress": self.journal}
        try:
            report = blocksar.focus(str(arrival.store), run, **arguments)
        except FolderError as error:
            if standing is not Standing.UNFINISHED or not error.replaceable:
                raise
            self.journal.write({"event": "restarted", "name": arrival.name, "reason": str(error)})
            report = blocksar.focus(str(arrival.store), run, **arguments, overwrite=True)
        return list(report.summary)


def _passing(error: InputError) -> bool:
    """Whether the outbox or the machine is at fault, not the collection: another sweep may succeed."""
    if isinstance(error, FolderError):
        return True
    cause = error.__cause__
    while cause is not None:
        absent = isinstance(cause, FileNotFoundError | NotADirectoryError | IsADirectoryError)
        if isinstance(cause, OSError) and cause.errno is not None and not absent:  # codecs raise some without a number
            return True
        cause = cause.__cause__
    return False


# ---------------------------------------------------------------- the command


def main(
    inbox: Annotated[str, typer.Argument(metavar="INBOX", help="Folder of phase-history stores; only read.")],
    outbox: Annotated[str, typer.Argument(metavar="OUTBOX", help="Folder of runs, records, status and log.")],
    processor: options.ProcessorOption = "angular-division",
    blocks: options.Blocks = "auto",
    coefficients: options.CoefficientsOption = "fitted",
    grid: options.GridOption = None,
    workers: options.Workers = None,
    threads: options.Threads = None,
    memory_limit: options.MemoryLimit = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="A running dask scheduler, instead of an own cluster.")
    ] = None,
    notify: Annotated[
        str | None, typer.Option(metavar="COMMAND", help="Called for each result, with the event as JSON on stdin.")
    ] = None,
    quiet: options.Quiet = False,
) -> None:
    """Focus every collection of an inbox exactly once, oldest first; then end, until a timer starts it again.

    Example: [bold]python workflows/process_inbox.py inbox outbox --workers 2 --notify notify-operators[/bold]
    """
    endings.catch_signals()
    try:
        settings: Settings = {
            "processor": processor,
            "blocks": parsing.parse_blocks(blocks),
            "coefficients": coefficients,
            "grid": None if grid is None else [list(axis) for axis in parsing.parse_grid(grid)],
            "workers": workers,
            "threads": threads,
            "memory_limit": None if memory_limit is None else parsing.parse_memory(memory_limit),
        }
        status = sweep(inbox, outbox, settings, Hook.parse(notify), scheduler=scheduler, quiet=quiet)
    except InputError as error:
        _end(str(error), USAGE)
    except Held as owner:
        _end(f"{outbox} is being swept by {owner}; nothing to do here", BUSY)
    except (OSError, ProcessingError) as error:
        _end(str(error), FAILED)
    except KeyboardInterrupt:
        _end("interrupted; the next sweep goes on from here", endings.INTERRUPTED)
    except endings.Terminated:
        _end("terminated; the next sweep goes on from here", endings.TERMINATED)
    raise typer.Exit(status)


def sweep(
    inbox: str, outbox: str, settings: Settings, hook: Hook, *, scheduler: str | None = None, quiet: bool = False
) -> int:
    """One sweep, if no other has the outbox; the exit status.

    Raises
    ------
    Held
        If another has it.
    InputError
        If the inbox cannot be listed, or the outbox not written.
    """
    if not isinstance(folder := place(outbox), LocalPlace):
        raise InputError(f"OUTBOX {folder} is no local folder; give one: lock and log need it")
    look_into(place(inbox))  # before anything is written
    box = Outbox(folder.path)
    if isinstance(source := place(inbox), LocalPlace):
        box.keep_apart(source.path)
    box.prepare()
    with box.lock(), Cluster(settings, scheduler, box.scratch) as cluster:
        return Sweep(place(inbox), box, settings, cluster, hook, Journal(box, quiet=quiet)).run()


def _end(message: str, status: int) -> NoReturn:
    print(f"inbox: {message}", file=sys.stderr)
    raise typer.Exit(status)


if __name__ == "__main__":
    typer.run(main)
