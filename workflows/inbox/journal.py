"""Log and status file of sweeps."""

from __future__ import annotations

import json
import os
import sys
import time
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from blocksar import stores
from blocksar.errors import ProcessingError
from inbox.outbox import Outbox
from inbox.records import FORMAT, Event

STATUS_SECONDS = 1.0  # least time between two updates of a run's progress


@dataclass
class Journal:
    """Writes the log and the status file, and a line on stderr for every event."""

    outbox: Outbox
    quiet: bool = False
    status: dict[str, Any] = field(default_factory=dict)
    _sweep: str = field(default_factory=lambda: f"{datetime.now(UTC):%Y%m%dT%H%M%S}-{os.getpid()}")
    _updated: float = 0.0

    def write(self, event: Event) -> None:
        """Append one line to the log; a line that a power loss has cut short is ended first."""
        if not self.quiet:
            words = [event.get(key, "") for key in ("event", "name", "run", "reason")]
            self._say(" ".join(word if word.isprintable() else repr(word) for word in words if word))
        line = json.dumps({"time": timestamp(), "sweep": self._sweep, **event})
        try:
            with open(self.outbox.folder / "log.jsonl", "ab+") as file:
                file.seek(-1, os.SEEK_END) if file.tell() else None
                cut_short = file.read(1) not in (b"", b"\n")
                file.write(b"\n" * cut_short + line.encode() + b"\n")
        except OSError as error:
            self._say(str(error))

    def note(self, **changes: Any) -> None:
        """Change the status and write it."""
        self.status |= changes | {"format": FORMAT, "sweep": self._sweep, "pid": os.getpid(), "updated": timestamp()}
        self._updated = time.monotonic()
        try:
            stores.write_json(self.outbox.folder / "status.json", self.status)
        except ProcessingError as error:
            self._say(str(error))

    def update(self, stage: str, done: int, total: int) -> None:
        """Note the progress of a run; called by `focus`."""
        if time.monotonic() - self._updated > STATUS_SECONDS:
            self.note(current=self.status["current"] | {"stage": stage, "done": done, "total": total})

    def _say(self, text: str) -> None:
        with suppress(OSError):  # nobody reads it any more: the log and the records have it
            print("inbox:", text, file=sys.stderr, flush=True)


def timestamp() -> str:
    """UTC now, ISO 8601 with milliseconds."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")
