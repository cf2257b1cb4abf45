"""Printing of reports, as tables and sentences, on a terminal or into a pipe."""

from __future__ import annotations

import shlex
import sys
import textwrap
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Protocol

import typer

if TYPE_CHECKING:
    from rich.table import Table


PIPE_WIDTH = 240  # columns of a table that does not go to a terminal: wide enough to fold nothing
MIN_TEXT = 20  # columns to which a text may be folded
TABLE_SIDES, COLUMN_GAP = 4, 3  # columns of the terminal that a table takes at its sides, and between its columns


class Report(Protocol):
    """The result of a function in `blocksar.api`, as people read it."""

    @property
    def summary(self) -> Sequence[str]:
        """Sentences printed below the tables."""

    def table(self) -> Sequence[tuple[Sequence[str], Sequence[Sequence[str]]]]:
        """Return the tables as (header, rows), with cells as text."""


def show(report: Report) -> None:
    """Print a report's tables and summary on stdout."""
    from rich.console import Console

    terminal = sys.stdout.isatty()
    console = Console(width=None if terminal else PIPE_WIDTH)
    for header, rows in report.table():
        for part in tables(header, rows, console.width):
            console.print(part)
    for line in report.summary:
        typer.echo(wrap_line(line, console.width) if terminal else line)


def hint(context: typer.Context, *command: str) -> None:
    """Say on stderr which command comes next, unless the command is quiet; patterns of files stay as they are."""
    if not context.params.get("quiet"):
        words = [word if "*" in word and " " not in word else shlex.quote(word) for word in ("blocksar", *command)]
        typer.echo(f"next: {' '.join(words)}", err=True)


def tables(header: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> Iterator[Table]:
    """Divide a table into tables that fit into `width` columns of a terminal, to be printed below each other.

    Each begins with the first column. Titles may be folded between words; figures are never cut or folded.
    """
    from rich import box
    from rich.cells import cell_len
    from rich.table import Table
    from rich.text import Text

    columns = list(zip(header, *rows, strict=True))
    least = [max(map(cell_len, [*(column[0].split() or [""]), *column[1:]])) for column in columns]
    if len(columns) == 2:  # names and texts: the texts are folded
        least[1] = min(max(width - _total_width(least, [0]) - COLUMN_GAP, MIN_TEXT), least[1])
    for part in _divide(least, width):
        spare = max(width - _total_width(least, part), 0)
        # Text, not str: rich would take a unit in square brackets for markup.
        table = Table(box=box.SIMPLE_HEAD)
        for i in part:
            extra = min(max(cell_len(header[i]) - least[i], 0), spare)
            spare -= extra
            table.add_column(Text(header[i]), width=least[i] + extra)
        for row in rows:
            table.add_row(*(Text(row[i]) for i in part))
        yield table


def _divide(least: Sequence[int], width: int) -> list[list[int]]:
    """Divide columns of these least widths into tables, each with the first column, as lists of indices."""
    parts: list[list[int]] = []
    for i in range(len(least)):
        if not parts or (len(parts[-1]) > 1 and _total_width(least, [*parts[-1], i]) > width):
            parts.append([0, i] if i else [0])
        else:
            parts[-1].append(i)
    return parts


def _total_width(least: Sequence[int], part: Sequence[int]) -> int:
    return TABLE_SIDES + sum(least[i] + COLUMN_GAP for i in part) - COLUMN_GAP


def wrap_line(line: str, width: int) -> str:
    """Wrap a text between words, as terminals do not; a word that is too long, such as a path, stays whole."""
    wrapper = textwrap.TextWrapper(max(width, 20), break_long_words=False, break_on_hyphens=False)
    wrapped = []
    for paragraph in line.splitlines():
        wrapper.subsequent_indent = paragraph[: len(paragraph) - len(paragraph.lstrip())]
        wrapped.append(wrapper.fill(paragraph))
    return "\n".join(wrapped)
