"""Units of work that begin before their stage, in places that no other unit takes."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from distributed import Client

from blocksar.graph.units import Here, Spare, Unit, run_units
from blocksar.places import place
from blocksar.progress import Listener
from blocksar.runs.receipts import Run
from blocksar.runs.record import Receipt


def _done(unit: str) -> Receipt:
    return Receipt(unit=unit, stage="focus")


def _leave(unit: str, path: Path) -> Receipt:
    path.touch()
    return _done(unit)


def _await(unit: str, path: Path) -> Receipt:
    while not path.exists():
        time.sleep(0.01)
    return _done(unit)


def _run(client: Any, folder: Path, last: Callable[..., Receipt]) -> tuple[list[str], list[str]]:
    """Units a and b, where `last` is the task of b, and one that can follow each; the names of those that were run."""
    mark = folder / "mark"

    def unit(name: str, task: Callable[..., Receipt], *arguments: Any) -> Unit:
        key = f"{name}-{folder.name}"
        return name, partial(client.submit, task, name, *arguments, key=key, pure=False)

    spare = Spare(lambda name, _: [unit(f"after-{name}", _leave, mark)])
    run = Run(folder=place(folder), identity="0", threads=1)
    both = [unit("a", _done), unit("b", last, mark)]
    receipts = run_units(client, "focus", both, run, Listener(), spare=spare)
    return [receipt.unit for receipt in receipts], list(spare.receipts)


def test_a_free_worker_begins_with_the_next_stage(client: Client, tmp_path: Path) -> None:
    """Unit b ends only once what follows a is done; what follows b is left to the next stage."""
    assert _run(client, tmp_path, _await) == (["a", "b"], ["after-a"])


def test_nothing_is_free_in_one_process(tmp_path: Path) -> None:
    assert _run(Here(), tmp_path, _leave) == (["a", "b"], [])
