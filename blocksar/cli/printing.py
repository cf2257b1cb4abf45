"""Printing of reports, as tables and sentences, on a terminal or into a pipe."""

from __future__ import annotations

import shlex
import sys
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol

import typer

from blocksar.cli.endings import ending, say
from blocksar.progress import Progress
from blocksar.version import __version__

if TYPE_CHECKING:
    from rich.table import Table


@contextmanager
def listening(context: typer.Context) -> Iterator[Progress]:
    """Show the progress of a command; log its settings and how it ends."""
    settings = dict(context.params)
    if isinstance(source := settings.get("source"), list | tuple) and len(source) == 1:
        settings["source"] = source[0]  # programs that read the log know it as a text
    with Progress(quiet=settings["quiet"], log=settings["json_log"]) as progress:
        progress.start(" ".join(context.command_path.split()[1:]), settings, __version__)
        try:
            yield progress
        except BaseException as error:
            progress.end(*ending(error))
            raise
        progress.end(0)


PIPE_WIDTH = 240  # columns of a table that does not go to a terminal: wide enough to fold nothing
LEAST_WIDTH = 40  # columns of a table on a terminal that has fewer, or says so: some say 0
MIN_TEXT = 20  # columns to which a text may be folded
TABLE_SIDES, COLUMN_GAP = 4, 3  # columns of the terminal that a table takes at its sides, and between its columns


class Printed(Protocol):
    """The result of a function in `blocksar.api`, as people read it."""

    @property
    def summary(self) -> Sequence[str]:
        """Sentences printed below the tables."""

    @property
    def details(self) -> Sequence[tuple[Sequence[str], Sequence[Sequence[str]]]]:
        """All tables in full, where `table` has a selection; empty otherwise."""

    @property
    def definitions(self) -> Sequence[str]:
        """Definitions of the columns."""

    def table(self) -> Sequence[tuple[Sequence[str], Sequence[Sequence[str]]]]:
        """Return the tables as (header, rows), with cells as text."""


def show(report: Printed, context: typer.Context | None = None) -> None:
    """Print a report's tables and summary on stdout, according to the command's options --all and --explain.

    Where the command has these options and they are not given, a line on stderr says what they would add.
    """
    from rich.console import Console

    options = {} if context is None else context.params
    terminal = sys.stdout.isatty()
    console = Console(width=None if terminal else PIPE_WIDTH)
    console.width = max(console.width, LEAST_WIDTH)
    for header, rows in (options.get("everything") and report.details) or report.table():
        for part in tables(header, rows, console.width):
            console.print(part)
    for line in [*(report.definitions if options.get("explain") else ()), *report.summary]:
        typer.echo(wrap_line(line, console.width) if terminal else line)
    more = [
        *(["--all shows every row and column"] if options.get("everything") is False and report.details else []),
        *(["--explain says what the columns mean"] if options.get("explain") is False and report.definitions else []),
    ]
    if more and not options.get("quiet"):
        say(f"more: {'; '.join(more)}")


def hint(context: typer.Context, *command: str) -> None:
    """Print the next command on stderr unless the command is quiet; file patterns stay as they are."""
    if not context.params.get("quiet"):
        words = [word if "*" in word and " " not in word else shlex.quote(word) for word in ("blocksar", *command)]
        say(f"next: {' '.join(words)}")


def tables(header: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> Iterator[Table]:
    """Divide a table into tables that fit into `width` columns of a terminal, to be printed below each other.

    Each begins with the first column. Titles may be folded between words; figures are never cut or folded. Of a table
    of two columns, names and texts, the texts are folded.
    """
    from rich import box
    from rich.cells import cell_len
    from rich.table import Table
    from rich.text import Text

    columns = list(zip(header, *rows, strict=True))
    least = [max(map(cell_len, [*(column[0].split() or [""]), *column[1:]])) for column in columns]
    if len(columns) == 2:
        least[0] = max(map(cell_len, columns[0]))
        least[1] = min(max(width - _total_width(least, [0]) - COLUMN_GAP, MIN_TEXT), max(map(cell_len, columns[1])))
    for part in _divide(least, width):
        widths = _widen([header[i] for i in part], [least[i] for i in part], width - _total_width(least, part))
        # Text, not str: rich would take a unit in square brackets for markup.
        table = Table(box=box.SIMPLE_HEAD)
        for i, column_width in zip(part, widths, strict=True):
            table.add_column(Text(header[i]), width=column_width)
        for row in rows:
            table.add_row(*(Text(row[i]) for i in part))
        yield table


def _widen(titles: Sequence[str], least: Sequence[int], spare: int) -> list[int]:
    """Widen columns while there is room, always the one whose title is folded into the most lines."""
    widths = list(least)

    def height(i: int, width: int) -> int:
        return len(textwrap.wrap(titles[i], width, break_long_words=False)) or 1

    while True:
        heights = [height(i, width) for i, width in enumerate(widths)]
        tallest = max(range(len(widths)), key=lambda i: heights[i])
        better = next((w for w in range(widths[tallest], len(titles[tallest]) + 1)
                       if height(tallest, w) < heights[tallest]), None)  # fmt: skip
        if better is None or better - widths[tallest] > spare:
            return widths
        spare -= better - widths[tallest]
        widths[tallest] = better


def _divide(least: Sequence[int], width: int) -> list[list[int]]:
    """Divide columns of these least widths into as few tables as fit, about equally wide: lists of column indices.

    Each has the first column.
    """
    count = len(_fill(least, width))
    narrower = [_fill(least, narrow) for narrow in range(width, 0, -1)]
    return [parts for parts in narrower if len(parts) == count][-1]


def _fill(least: Sequence[int], width: int) -> list[list[int]]:
    """Divide columns into tables, each filled as far as `width` goes."""
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
