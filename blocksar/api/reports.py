"""Reports of commands: tables and sentences for people, and the result itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from blocksar.api.rendering import Table, html_report, text_table
from blocksar.errors import in_python
from blocksar.progress import Wanted as Progress
from blocksar.progress import as_listener

__all__ = ["Report", "Table", "finite", "only_stage", "rounded"]


def only_stage(progress: Progress | None, stage: str) -> Callable[[int, int], None]:
    """Begin a command's single stage; return the callback that reports its progress."""
    listener = as_listener(progress)
    listener.begin(stage)
    return partial(listener.update, stage)


def finite(value: float) -> float | None:
    """A number for a result; None unless it is finite."""
    return float(value) if math.isfinite(value) else None


def rounded(value: float | None, places: int) -> str:
    """A number for a table."""
    return "-" if value is None else f"{value:.{places}f}"


LONGEST = 300  # characters of a report's repr


@dataclass(frozen=True, repr=False)
class Report:
    """Report of a function: tables and sentences for people, and the result itself.

    Its repr is one line; `print` shows tables and sentences, and a notebook shows them as HTML.

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

    def headline(self) -> str:
        """The report in one line."""
        if self.refusal is not None:
            return f"refused: {self.refusal}"
        if self.summary:
            return self.summary[0]
        return " ".join(self.tables[0][0]) if self.tables else "nothing to say"

    def __repr__(self) -> str:
        text = in_python(f"{type(self).__name__}: {self.headline()}")
        return f"<{text if len(text) <= LONGEST else text[: LONGEST - 3] + '...'}>"

    def __str__(self) -> str:
        text = "\n\n".join([*map(text_table, self.tables), "\n".join(self.summary)]).strip()
        return in_python(text) or repr(self)

    def _repr_html_(self) -> str:
        headline = self.headline()
        rest = [line for line in self.summary if line != headline]
        return in_python(html_report(headline, self.tables, rest, self.details, self.definitions))
