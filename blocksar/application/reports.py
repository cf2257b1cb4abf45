"""Reports of commands: tables and sentences for people, as text and as HTML, and the result itself."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from html import escape
from typing import Any

from blocksar.errors import in_python
from blocksar.progress import Wanted as Progress
from blocksar.progress import as_listener
from blocksar.table import Table

__all__ = ["Report", "Table", "finite", "html_report", "only_stage", "rounded", "text_table"]

# ---------------------------------------------------------------- definitions of columns, printed by `--explain`

PLAN_COLUMNS = (
    "block: number of the angular block; 0.0, 0.1, ... are its range sub-blocks.",
    "yaw, range: what the block owns: an interval of yaw, and of range at t = 0. Each pixel has one owner.",
    "coherence: of the image with exact back-projection, predicted for the target with full dwell that is worst; 1 "
    "less what is lost by residual phase, by range migration, at the ends of the dwell, and by noise of the track.",
    "residual phase: largest phase error of any target over its dwell after the deramp; below 0.1 rad it is in focus. "
    "Quadratic: the quadratic part of it at the edge of the dwell; pi/4 is the usual limit.",
    "PSLR: azimuth side lobes that this residual gives the worst target; the ideal is -13.26 dB unweighted.",
    "width / limit: azimuth width over the one that the dwell allows; 1 is ideal. Azimuth width: amid the block.",
    "migration: range cells that a target still moves through over its dwell; below a quarter it does not matter.",
    "memory: peak of a worker that focuses the block, with interpreter and libraries.",
    "Doppler bins, padded: the block's part of the recovered spectrum, and the Doppler samples of the focused block.",
    "bias: range acceleration that the time perturbation adds; 0 is the chain as the papers print it.",
)
CHECK_COLUMNS = (
    "if: what was changed, one thing at a time.",
    "echoes: of prominent places, which stand out in short apertures that hardly depend on what is wrong; without "
    "any, of patches of clutter. The same echoes are compared with what is given; no more where the first decide.",
    "contrast: N sum(I^2) / (sum I)^2 over the N cells of a small image about an echo, formed over its whole dwell: "
    "3 dB for speckle, 20 dB and more for a point in focus. More than 0 dB against as given speaks for the change.",
    "standard deviations: the gain over what speckle and side lobes give it by chance.",
    "verdict: sharper above 5 of these, ruled out below -5, otherwise not told: then the image is as sharp, as is a "
    "mirrored one.",
)


def quality_columns() -> tuple[str, ...]:
    """The definitions of measured figures, one a line.

    Examples
    --------
    >>> [line.partition(":")[0] for line in quality_columns()][:7]
    ['Range cut', 'Azimuth cut', 'Nominal width', 'IRW', 'PSLR', 'ISLR', 'Theory']
    """
    from blocksar.measurement.figures import DEFINITIONS  # slow to load, and a plan needs none of it

    return tuple(re.split(r"(?<=\.) (?=[A-Z][A-Za-z ]*: )", DEFINITIONS.replace("\n", " ")))


# ---------------------------------------------------------------- text and HTML

NUMBER = re.compile(r"[-+\u2212]?[\d.,]+(e[-+]?\d+)?|nan|-|yes|no")  # cells that are aligned on the right


def text_table(table: Table) -> str:
    """A table with columns as wide as their longest cells.

    Examples
    --------
    >>> print(text_table((("block", "coherence"), [("0", "0.9991")])))
    block  coherence
        0     0.9991
    """
    header, rows = table
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    right = [_is_numeric([row[i] for row in rows]) for i in range(len(header))]

    def line(cells: Sequence[str]) -> str:
        padded = (
            cell.rjust(width) if number else cell.ljust(width)
            for cell, width, number in zip(cells, widths, right, strict=True)
        )
        return "  ".join(padded).rstrip()

    return "\n".join(map(line, [header, *rows]))


def html_report(
    headline: str,
    tables: Sequence[Table],
    summary: Sequence[str],
    details: Sequence[Table] = (),
    definitions: Sequence[str] = (),
) -> str:
    """Format a report as HTML: headline, tables and summary in sight; full tables and definitions unfold."""
    parts = [f"<div><strong>{escape(headline)}</strong></div>"]
    parts += map(html_table, tables)
    if summary:
        parts.append(_list(summary))
    if details:
        parts.append(_unfolding("all figures", "".join(map(html_table, details))))
    if definitions:
        parts.append(_unfolding("definitions", _list(definitions)))
    return f"<div>{''.join(parts)}</div>"


def html_table(table: Table) -> str:
    """A table as HTML that scrolls within its place where it is wide."""
    header, rows = table
    aligned = ["right" if _is_numeric([row[i] for row in rows]) else "left" for i in range(len(header))]
    head = "".join(
        f'<th style="text-align:{side}">{escape(name)}</th>' for name, side in zip(header, aligned, strict=True)
    )
    body = "".join(
        "<tr>"
        + "".join(f'<td style="text-align:{side}">{escape(c)}</td>' for c, side in zip(row, aligned, strict=True))
        + "</tr>"
        for row in rows
    )
    return f'<div style="overflow-x:auto"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _is_numeric(cells: Sequence[str]) -> bool:
    return bool(cells) and all(NUMBER.fullmatch(cell) for cell in cells)


def _unfolding(name: str, content: str) -> str:
    return f"<details><summary>{name}</summary>{content}</details>"


def _list(sentences: Sequence[str]) -> str:
    return f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in sentences)}</ul>"


# ---------------------------------------------------------------- reports


def only_stage(progress: Progress | None, stage: str) -> Callable[[int, int], None]:
    """Begin a command's single stage; return the callback that reports its progress."""
    listener = as_listener(progress)
    listener.begin(stage)
    return partial(listener.update, stage)


def finite(value: float) -> float | None:
    """Return a number for a result; None if it is not finite."""
    return float(value) if math.isfinite(value) else None


def rounded(value: float | None, places: int) -> str:
    """Round a number for a table; None stays None."""
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
