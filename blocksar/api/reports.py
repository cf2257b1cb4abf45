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
    """Begin a command's single stage; return the callback that reports its progress."""
    listener = as_listener(progress)
    listener.begin(stage)
    return partial(listener.update, stage)


@dataclass(frozen=True)
class Report:
    """What a function returns: tables and sentences for people, and the result itself.

    Attributes
    ----------
    tables : list of (header, rows)
        Header: sequence of str. Rows: sequences of str, as long as the header.
    summary : list of str
        Sentences.
    details : list of (header, rows)
        All tables in full, where `tables` has a selection of rows and columns.
    definitions : sequence of str
        What the columns mean, one sentence each.
    refusal : str or None
        Why a plan cannot be carried out; None if it can.
    result : object
        As each function describes.
    """

    tables: list[Table] = field(default_factory=list)
    summary: list[str] = field(default_factory=list)
    refusal: str | None = None
    details: list[Table] = field(default_factory=list)
    definitions: Sequence[str] = ()
    result: Any = None

    def table(self) -> list[Table]:
        return self.tables
