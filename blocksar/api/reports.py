"""What a command returns: tables and sentences for people, and the result itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from blocksar.progress import Updated as Progress
from blocksar.progress import as_listener

Table = tuple[Sequence[str], Sequence[Sequence[str]]]


def only_stage(progress: Progress | None, stage: str) -> Callable[[int, int], None]:
    """A command's only stage begins: what its parts are told to."""
    told = as_listener(progress)
    told.begin(stage)
    return partial(told.update, stage)


@dataclass(frozen=True)
class Report:
    """What a command tells a person: tables, then sentences. `refusal` says why a plan cannot be carried out."""

    tables: list[Table] = field(default_factory=list)
    summary: list[str] = field(default_factory=list)
    refusal: str | None = None
    result: Any = None

    def table(self) -> list[Table]:
        return self.tables
