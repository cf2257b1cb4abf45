"""The outbox: runs, records of settled collections, lock."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from enum import Enum
from hashlib import blake2b
from itertools import count
from pathlib import Path
from typing import Literal

from blocksar import stores
from blocksar.errors import InputError
from blocksar.places import place
from blocksar.places.place import Place
from blocksar.runs.folder import foreign_names
from blocksar.runs.record import RunRecord
from inbox.arrivals import Arrival
from inbox.records import FORMAT, Record, Settings

FOLDERS = ("runs", "done", "quarantine")  # of an outbox
INGESTED = "ingested"  # another, made when it is needed
NAME_BYTES = 200  # of a record: file systems end at 255, and temporary names are longer than the name


class Standing(Enum):
    """State of the folder where a run is to go; the value is the event that is logged."""

    NOTHING = "started"
    UNFINISHED = "resumed"
    FINISHED = "found finished"


@dataclass(frozen=True)
class Outbox:
    """The folder of runs, records, status and log."""

    folder: Path

    @property
    def scratch(self) -> Path:
        """Temporary files of the workers. Everything in it is removed."""
        return self.folder / "scratch"

    def check_apart(self, inbox: Path) -> None:
        """Refuse an inbox that a sweep would write to or remove.

        Raises
        ------
        InputError
            If the outbox lies in the inbox, or the inbox in a folder that the sweep writes.
        """
        source, own = Path(os.path.realpath(inbox)), Path(os.path.realpath(self.folder))
        if own.is_relative_to(source):
            raise InputError(f"OUTBOX {self.folder} lies in INBOX {inbox}, which is only read; give another")
        if any(source.is_relative_to(own / name) for name in (*FOLDERS, INGESTED, self.scratch.name)):
            raise InputError(
                f"INBOX {inbox} lies in a folder that a sweep writes in OUTBOX {self.folder}; give another OUTBOX"
            )

    def prepare(self) -> None:
        """Create the folders.

        Raises
        ------
        InputError
            If they cannot be created, or a folder `scratch` exists that no sweep has created.
        """
        folders = [self.folder / name for name in FOLDERS]
        if self.scratch.exists() and not all(folder.is_dir() for folder in folders):
            raise InputError(f"OUTBOX {self.folder} holds a folder scratch of other origin; give another")
        try:
            for folder in folders:
                folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"OUTBOX {self.folder} cannot be written ({error.strerror}); give another") from None

    def lock(self) -> AbstractContextManager[None]:
        """Exclude other sweeps. The system releases the lock however the process ends."""
        return place(self.folder / "lock").lock()

    def record(self, kind: Literal["done", "quarantine"], name: str) -> Path:
        """Path of a collection's record."""
        return self.folder / kind / f"{_short(name)}.json"

    def ingested(self, name: str) -> Place:
        """Where the phase history of measured data lies."""
        return place(self.folder / INGESTED / _short(name))

    def is_settled(self, arrival: Arrival, fingerprint: str) -> bool:
        """Whether measured data are as an earlier sweep saw them, so that nobody still writes them.

        If not, this is noted for the next sweep, and what was ingested of them before is removed.
        """
        seen = self.folder / INGESTED / f"{_short(arrival.name)}.json"
        record = _read_record(seen)
        if record is not None and record.get("fingerprint") == fingerprint:
            return True
        for part in arrival.measured:
            part.store.remove()
        stores.write_json(seen, {"format": FORMAT, "name": arrival.name, "fingerprint": fingerprint})
        return False

    def settled(self, name: str, fingerprint: str, settings: Settings) -> Record | None:
        """The record of a collection that is done, or that cannot be focused with these settings; else None."""
        record = _read_record(self.record("done", name))
        if record is not None and record.get("fingerprint") == fingerprint:
            return record
        record = _read_record(self.record("quarantine", name))
        if record is not None and (record.get("fingerprint"), record.get("settings")) == (fingerprint, settings):
            return record
        return None

    def settle(self, record: Record) -> None:
        """Write a record; a collection that is done leaves quarantine."""
        done, quarantine = (self.record(kind, record["name"]) for kind in ("done", "quarantine"))
        if record["event"] == "done":
            stores.write_json(done, record)
            quarantine.unlink(missing_ok=True)
        else:
            stores.write_json(quarantine, record)

    def run_of(self, name: str, source: Place, fingerprint: str) -> tuple[Path, Standing]:
        """The run folder of a collection: NAME, or the first of NAME.2, ... not taken by another collection.

        Parameters
        ----------
        name : str
            Of the collection, or of an acquisition of several.
        source : Place
            The collection, or the first of several.
        fingerprint : str
            Of the phase history, as in run.json.
        """
        stem = name.removesuffix(".zarr")
        for number in count(1):
            run = self.folder / "runs" / (stem if number == 1 else f"{stem}.{number}")
            if not os.path.lexists(run) or (run.is_dir() and not foreign_names(place(run), os.listdir(run))):
                return run, Standing.NOTHING
            record = _read_run_record(run)
            if record is None:
                continue
            same = record.input.fingerprint == fingerprint
            if same and record.finished:
                return run, Standing.FINISHED
            # An unfinished run of the same name is replaced: the collection has changed since.
            if not record.finished and (same or os.path.basename(record.input.path) == source.name):
                return run, Standing.UNFINISHED
        raise AssertionError


def _short(name: str) -> str:
    """A name, or its hash if it is longer than a file system takes."""
    long = len(os.fsencode(name)) > NAME_BYTES
    return blake2b(os.fsencode(name), digest_size=16).hexdigest() if long else name


def _read_record(path: Path) -> Record | None:
    """A record, or None where none can be read."""
    with suppress(InputError):
        record = stores.read_json(path)
        if isinstance(record, dict):
            return record
    return None


def _read_run_record(run: Path) -> RunRecord | None:
    """The record of a run, or None where none can be read."""
    with suppress(InputError):
        return RunRecord.read(place(run))
    return None
