"""Progress of a run with a simulated clock, and a reader of its log."""

from __future__ import annotations

import json
from typing import Any

from blocksar.progress import Progress, Work, Workers

GIB = 2**30
HIDDEN, SHOWN = b"\x1b[?25l", b"\x1b[?25h"  # control sequences that hide and show the cursor


class Clock:
    """A clock that advances only when a test sets it."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


WORK: Work = {"recover": [0.5] * 8, "focus": [3.0, 2.0, 4.0, 2.5, 2.5, 3.0], "mosaic": [0.1] * 20, "finish": [1.0]}


def under_way(clock: Clock, **options: Any) -> Progress:
    """Return the progress of a run in the middle of its blocks, with work for sixty workers."""
    told = Progress(clock=clock, **options)
    told.update("plan", 0, 1)
    told.update("plan", 1, 1)
    told.expect({"recover": [1.0] * 4, "focus": [100.0] * 120, "mosaic": [1.0] * 3, "finish": [1.0]}, 60)
    told.begin("recover", 4)
    told.update("recover", 4, 4)
    told.begin("focus")
    told.update("focus", 0, 120)
    clock.now += 4000.0
    told.update("focus", 60, 120)
    told.watch([f"block-{n}" for n in range(60, 120)], Workers(60, 3 * GIB // 2, 4 * GIB))
    return told


def strictly(text: str) -> list[dict[str, Any]]:
    """Parse lines of JSON strictly: every line is complete, and NaN and Infinity are refused."""

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    assert text.endswith("\n")
    return [json.loads(line, parse_constant=refuse) for line in text.splitlines()]
