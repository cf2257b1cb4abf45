"""Reports as text and as HTML, for sessions of Python."""

from __future__ import annotations

import re
from collections.abc import Sequence
from html import escape

from blocksar.tables import Table

__all__ = ["Table", "html_report", "text_table"]

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
    """A report as HTML: what comes first is in sight, full tables and definitions unfold."""
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
