"""A sweep of the inbox: what is done with each collection, and the exit status."""

from __future__ import annotations

import re
import time
import traceback
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import blocksar
from blocksar import stores
from blocksar.application.ground import check_ground
from blocksar.application.track_places import input_fingerprint
from blocksar.cli import endings
from blocksar.errors import FolderError, InputError, ProcessingError
from blocksar.places.place import Place
from inbox.arrivals import Arrival, list_inbox
from inbox.cluster import Cluster, NoClusterError
from inbox.hooks import Hook
from inbox.journal import Journal, timestamp
from inbox.outbox import Outbox, Standing
from inbox.records import FORMAT, Event, Record, Settings
from inbox.statuses import DONE, FAILED, QUARANTINED

UNSETTLED = "it is new, or has changed; the next sweep takes it if it is then as it is now"


@dataclass
class Sweep:
    """One pass over all collections of an inbox."""

    inbox: Place
    outbox: Outbox
    settings: Settings
    cluster: Cluster
    hook: Hook
    journal: Journal
    group: re.Pattern[str] | None = None  # of names of collections of one acquisition
    done: list[str] = field(default_factory=list)
    failed: list[Event] = field(default_factory=list)
    quarantined: list[str] = field(default_factory=list)  # by this sweep
    quarantine: list[Event] = field(default_factory=list)  # by this one or an earlier one
    unreported: list[Record] = field(default_factory=list)  # quarantined, and no sweep has exited with 3 since
    hook_failures: int = 0
    remaining: int = 0
    waiting: list[str] = field(default_factory=list)  # what is not complete so far

    def run(self) -> int:
        """Process all collections and return the exit status.

        Raises
        ------
        InputError
            If the inbox cannot be listed.
        """
        arrivals, self.waiting, ignored = list_inbox(self.inbox, self.outbox.ingested, self.group)
        self.journal.write({"event": "sweep", "inbox": str(self.inbox), "arrivals": len(arrivals)})
        for name, reason in ignored.items():
            self.journal.write({"event": "ignored", "name": name, "reason": reason})
        self.remaining = len(arrivals)
        self._note(
            state="running", current=None, exit_status=None, started=timestamp(), inbox=str(self.inbox),
            ignored=ignored,
        )  # fmt: skip
        try:
            status = self._process_all(arrivals)
        except BaseException as error:
            signals = {KeyboardInterrupt: endings.INTERRUPTED, endings.Terminated: endings.TERMINATED}
            self._note(state="interrupted", exit_status=signals.get(type(error), FAILED))
            self.journal.write({"event": "interrupted", "reason": type(error).__name__})
            raise
        self._note(state="ended", exit_status=status)
        self.journal.write({"event": "end", "exit_status": status})
        if status == QUARANTINED:
            with suppress(ProcessingError):  # no room to write: the next sweep exits with 3 again
                for record in self.unreported:
                    self.outbox.settle(record | {"said": True})
        return status

    def _process_all(self, arrivals: list[Arrival]) -> int:
        try:
            for arrival in arrivals:
                try:
                    self._settle(arrival)
                except (OSError, ProcessingError) as error:  # its record could not be read or written
                    self._fail({"name": arrival.name, "source": arrival.source, "reason": str(error)})
                self.remaining -= 1
        except NoClusterError as error:
            self.journal.write({"event": "no cluster", "reason": str(error)})
            return FAILED
        if self.failed or self.hook_failures:
            return FAILED
        return QUARANTINED if self.unreported else DONE

    def _note(self, **changes: Any) -> None:
        self.journal.note(
            done=self.done, failed=self.failed, quarantined=self.quarantined, quarantine=self.quarantine,
            untold=self.hook_failures, left=self.remaining, waiting=self.waiting, **changes,
        )  # fmt: skip

    def _settle(self, arrival: Arrival) -> None:
        """Process one collection unless it is settled, record the result and call the hook."""
        fingerprint = arrival.fingerprint()
        record = self.outbox.settled(arrival.name, fingerprint, self.settings)
        if record is None:
            if arrival.measured and not self.outbox.is_settled(arrival, fingerprint):
                self.waiting.append(arrival.name)
                self.journal.write({"event": "waiting", "name": arrival.name, "reason": UNSETTLED})
                return
            event = self._process(arrival)
            if event is None:
                return
            if event["event"] == "failed":
                self._fail(event)
                return
            record = self._record(event, fingerprint)
        if not record.get("told") and self._notify(record):
            record = record | {"told": True}
            self.outbox.settle(record)
        if record.get("event") == "quarantined":
            self.quarantine.append({"name": arrival.name, "reason": record.get("reason")})
            if not record.get("said", True):
                self.unreported.append(record)

    def _record(self, event: Event, fingerprint: str) -> Record:
        """Write the record of a collection that is done or quarantined."""
        (self.done if event["event"] == "done" else self.quarantined).append(event["name"])
        record = {"format": FORMAT, **event, "fingerprint": fingerprint, "settings": self.settings}
        record["told"] = not self.hook.command
        if event["event"] == "quarantined":
            record["said"] = False
        self.outbox.settle(record)
        return record

    def _fail(self, event: Event) -> None:
        event = event | {"event": "failed"}
        self.failed.append(event)
        self._notify(event)

    def _notify(self, event: Event) -> bool:
        """Call the hook; whether it succeeded."""
        error = self.hook.send(event)
        if error is not None:
            self.hook_failures += 1
            self.journal.write({"event": "untold", "name": event["name"], "reason": error})
        return error is None

    def _process(self, arrival: Arrival) -> Event | None:
        """Focus a collection; the event is done, quarantined or failed, or None if the collection was removed."""
        started = time.perf_counter()
        event: Event = {"name": arrival.name, "source": arrival.source}
        try:
            run, standing = self._find_run(arrival)
            self.journal.write({"event": standing.value, "name": arrival.name, "run": str(run)})
            self._note(current={"name": arrival.name, "run": str(run)})
            summary = [] if standing is Standing.FINISHED else self._focus(arrival, run, standing)
            event |= {"event": "done", "run": str(run), "summary": summary}
        except NoClusterError:
            raise
        except InputError as error:
            if arrival.gone:
                self.journal.write({"event": "gone", "name": arrival.name})
                return None
            event |= {"event": "failed" if is_external(error) else "quarantined", "reason": str(error)}
        except Exception as error:  # of any kind: the collections behind this one must still be processed
            expected = isinstance(error, ProcessingError | OSError)
            event |= {"event": "failed", "reason": str(error) if expected else f"{type(error).__name__}: {error}"}
            if not expected:
                event["traceback"] = traceback.format_exc()
            self.cluster.discard(error)
        self.journal.write(event | {"seconds": round(time.perf_counter() - started, 3)})
        self._note(current=None)
        return event

    def _find_run(self, arrival: Arrival) -> tuple[Path, Standing]:
        self._ingest(arrival)
        members = [member for store in arrival.stores for member in stores.collections_in(store) or [store]]
        histories = [stores.open_phase_history(member) for member in members]
        if self.settings["grid"] is None:  # a missing one is found before a cluster starts
            check_ground([history.collection.centred() for history in histories], None, any_grid=True)
        return self.outbox.run_of(arrival.name, members[0], input_fingerprint(histories))

    def _ingest(self, arrival: Arrival) -> None:
        """Make the phase histories of measured data, of those that have none so far."""
        for source, store in arrival.measured:
            if not store.exists():
                self.journal.write({"event": "ingesting", "name": arrival.name, "source": str(source)})
                blocksar.ingest(None, source, store, progress=False)

    def _focus(self, arrival: Arrival, run: Path, standing: Standing) -> list[str]:
        """Focus into a run and return its summary; an unfinished run of other options or bytes is replaced."""
        arguments: dict[str, Any] = {**self.settings, "client": self.cluster.client(), "progress": self.journal}
        sources = [str(store) for store in arrival.stores]
        source = sources[0] if len(sources) == 1 else sources
        try:
            report = blocksar.focus(source, run, **arguments)
        except FolderError as error:
            if standing is not Standing.UNFINISHED or not error.replaceable:
                raise
            self.journal.write({"event": "restarted", "name": arrival.name, "reason": str(error)})
            report = blocksar.focus(source, run, **arguments, overwrite=True)
        return list(report.summary)


def is_external(error: InputError) -> bool:
    """Whether the cause lies outside the collection: in the run's folder, or in the machine."""
    if isinstance(error, FolderError):
        return True
    cause = error.__cause__
    while cause is not None:
        absent = isinstance(cause, FileNotFoundError | NotADirectoryError | IsADirectoryError)
        if isinstance(cause, OSError) and cause.errno is not None and not absent:  # some codecs raise it without errno
            return True
        cause = cause.__cause__
    return False
