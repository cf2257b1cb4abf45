"""Printed and measured numbers side by side: claims, rows and tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

QUARTER = 0.25  # in units of pi: the usual limit of phase errors


class Claim(NamedTuple):
    """What a paper states about a number that it does not print."""

    text: str
    holds: Callable[[float], bool]


def below(limit: float, text: str) -> Claim:
    return Claim(text, lambda value: value < limit)


def above(limit: float, text: str) -> Claim:
    return Claim(text, lambda value: value > limit)


BELOW_QUARTER, ABOVE_QUARTER = below(QUARTER, "below π/4"), above(QUARTER, "above π/4")


class Cell(NamedTuple):
    text: str
    off: bool = False  # differs from the paper


class Row(NamedTuple):
    """One of our numbers, and what is printed: a number, a claim, a text that cannot be compared, or nothing.

    They agree if ours is within `tolerance` of the number, or the claim holds; otherwise `why` explains the difference.
    """

    what: str
    ours: float
    unit: str = ""
    printed: float | Claim | str | None = None
    tolerance: float = 0.0
    why: str = ""
    digits: int = 2

    @property
    def compared(self) -> bool:
        return isinstance(self.printed, Claim | float | int)

    @property
    def agrees(self) -> bool:
        if isinstance(self.printed, Claim):
            return self.printed.holds(self.ours)
        return not isinstance(self.printed, float | int) or abs(self.ours - self.printed) <= self.tolerance

    @property
    def cells(self) -> list[Cell]:
        """Cells of a table: ours, printed, difference."""
        off = not self.agrees
        ours = Cell(self._text(self.ours), off)
        if self.printed is None or isinstance(self.printed, str):
            return [ours, Cell(self.printed or "not printed"), Cell("")]
        if isinstance(self.printed, Claim):
            return [ours, Cell(self.printed.text), Cell("does not hold" if off else "holds", off)]
        return [ours, Cell(self._text(self.printed)), Cell(self._text(self.ours - self.printed, "+"), off)]

    def _text(self, value: float, sign: str = "") -> str:
        return minus(f"{value:{sign}z.{self.digits}f}") if np.isfinite(value) else "not measured"


def minus(text: str) -> str:
    """Replace hyphens by minus signs."""
    return text.replace("-", "\N{MINUS SIGN}")


class Table(NamedTuple):
    header: list[str]
    lines: list[list[Cell]]


def listed(rows: Sequence[Row]) -> Table:
    """A table with one line per row."""
    lines = [[Cell(row.what), Cell(row.unit.replace(" ", "\N{NO-BREAK SPACE}")), *row.cells] for row in rows]
    return Table(["", "unit", "ours", "printed", "difference"], lines)


def crossed(rows: Sequence[Row], corner: str = "target") -> Table:
    """A table of rows named "target: quantity", with one line per target and three columns per quantity."""
    header, lines = [corner], dict[str, list[Cell]]()
    for row in rows:
        target, quantity = row.what.split(": ")
        name = f"{quantity} ({row.unit})" if row.unit else quantity
        header += [] if name in header else [name, f"{quantity}, printed", "difference"]
        lines.setdefault(target, [Cell(target)]).extend(row.cells)
    return Table(header, list(lines.values()))


@dataclass(kw_only=True)
class Exhibit:
    """One figure or table on the page."""

    title: str
    text: str
    pictures: list[Path] = field(default_factory=list)
    rows: list[Row] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)  # default: one table of all rows
    notes: list[str] = field(default_factory=list)
    key: str = ""
    seconds: float = 0.0
    failed: bool = False

    def __post_init__(self) -> None:
        if self.rows and not self.tables:
            self.tables = [listed(self.rows)]
        differing = [row.why or f"{row.what}: the difference is not explained." for row in self.rows if not row.agrees]
        self.notes = list(dict.fromkeys([*self.notes, *differing]))

    @property
    def verdict(self) -> str:
        """Summary for the list at the top of the page: how many numbers agree."""
        compared = [row for row in self.rows if row.compared]
        if self.failed:
            return "failed"
        return f"{sum(row.agrees for row in compared)} of {len(compared)}" if compared else "not compared"
