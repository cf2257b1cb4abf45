"""Progress of a command: listeners, the estimate of the time left, the display and the log.

The code that does the work calls the methods of a `Listener`. `Progress` is the listener of the commands: it shows
progress to people, as a live display on a terminal and as a few plain lines elsewhere, and writes a log of JSON lines
(`Log`) for programs. In a notebook it is drawn below the cell (`CellProgress`). `Estimate` derives the time left.
"""

from __future__ import annotations

from blocksar.progress.display import Log, Progress, Wanted, abandon, as_listener
from blocksar.progress.estimate import Estimate
from blocksar.progress.listening import NOBODY, Callback, Listener, Updated, Work, Workers

__all__ = [
    "NOBODY",
    "Callback",
    "Estimate",
    "Listener",
    "Log",
    "Progress",
    "Updated",
    "Wanted",
    "Work",
    "Workers",
    "abandon",
    "as_listener",
]
