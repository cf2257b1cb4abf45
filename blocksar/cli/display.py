"""Tables and sentences on a terminal or in a pipe."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Protocol

import typer

if TYPE_CHECKING:
    from rich.table import Table


PIPE_WIDTH = 240  # columns of a table that goes to no terminal: nothing may be folded there


class Report(Protocol):
    """What a function of the api has to tell a person."""

    @property
    def summary(self) -> Sequence[str]:
        """Sentences that follow the tables."""

    def table(self) -> Sequence[tuple[Sequence[str], Sequence[Sequence[str]]]]:
        """Tables as (header, rows), every cell as it is to be printed."""


# ---------------------------------------------------------------- what the user sees


def show(report: Report) -> None:
    """Print a report's tables and summary on stdout."""
    from rich.console import Console

    terminal = sys.stdout.isatty()
    console = Console(width=None if terminal else PIPE_WIDTH)
    for header, rows in report.table():
        for part in tables(header, rows, console.width):
            console.print(part)
    for line in report.summary:
        typer.echo(_wrapped(line, console.width) if terminal else line)


def tables(header: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> Iterator[Table]:
    """A table for so many columns of a terminal: where it is too wide, several below each other.

    Each begins with the first column. A title may be folded between its words; no figure is ever cut or folded.
    """
    from rich import box
    from rich.cells import cell_len
    from rich.table import Table
    from rich.text import Text

    sides, between = 4, 3  # columns of the terminal beside a table, and from one of its columns to the next
    columns = list(zip(header, *rows, strict=True))
    least = [max(map(cell_len, [*(column[0].split() or [""]), *column[1:]])) for column in columns]

    def total(part: Sequence[int]) -> int:
        return sides + sum(least[i] + between for i in part) - between

    parts: list[list[int]] = []
    for i in range(len(columns)):
        if not parts or (len(parts[-1]) > 1 and total([*parts[-1], i]) > width):
            parts.append([0, i] if i else [0])
        else:
            parts[-1].append(i)
    for part in parts:
        spare = max(width - total(part), 0)
        # Text, not str: rich would take a unit in square brackets for markup.
        table = Table(box=box.SIMPLE_HEAD)
        for i in part:
            wider = min(max(cell_len(header[i]) - least[i], 0), spare)
            spare -= wider
            table.add_column(Text(header[i]), width=least[i] + wider)
        for row in rows:
            table.add_row(*(Text(row[i]) for i in part))
        yield table


def _wrapped(line: str, width: int) -> str:
    """Folded between words, as terminals do not; a word that is too long, a path for instance, stays whole."""
    fold = textwrap.TextWrapper(max(width, 20), break_long_words=False, break_on_hyphens=False)
    folded = []
    for each in line.splitlines():
        fold.subsequent_indent = each[: len(each) - len(each.lstrip())]
        folded.append(fold.fill(each))
    return "\n".join(folded)
