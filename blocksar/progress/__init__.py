"""How far a command has come: what is told of it, how long it will go on, and what is shown.

Whoever does the work tells a `Listener`; `Estimate` makes time left of it; `Progress` shows it to people, as a live
display on a terminal and as a few plain lines elsewhere, and to programs, as a log of JSON lines.
"""

from __future__ import annotations

from blocksar.progress.display import PLAIN_STEPS, Progress, abandon
from blocksar.progress.estimate import Estimate
from blocksar.progress.listening import NOBODY, Callback, Listener, Updated, Work, Workers, listener
from blocksar.progress.log import Log

__all__ = [
    "NOBODY",
    "PLAIN_STEPS",
    "Callback",
    "Estimate",
    "Listener",
    "Log",
    "Progress",
    "Updated",
    "Work",
    "Workers",
    "abandon",
    "listener",
]
