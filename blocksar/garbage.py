"""Garbage collection, paused or rare where many objects are created that stay."""

from __future__ import annotations

import atexit
import gc
from collections.abc import Iterator
from contextlib import contextmanager

SELDOM = 20_000  # new objects between two collections of the youngest; by default 700


def collect_seldom() -> None:
    """Let this process collect seldom, and not at its end: it creates many objects, which stay, and few cycles."""
    gc.freeze()
    gc.set_threshold(SELDOM, *gc.get_threshold()[1:])
    atexit.register(gc.freeze)


@contextmanager
def uncollected() -> Iterator[None]:
    """Pause garbage collection: imports and compilation create many objects and hardly any garbage."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()
