"""Numbers and figures in words, for the report page."""

from __future__ import annotations

import re

import numpy as np

from blocksar.constants import MIB
from blocksar.measurement.figures import PointResponse

DASH, MINUS, TIMES = "\N{EN DASH}", "\N{MINUS SIGN}", "\N{MULTIPLICATION SIGN}"
SPACE = "\N{NARROW NO-BREAK SPACE}"

# ---------------------------------------------------------------- numbers for people


def number(value: float | None, digits: int = 2) -> str:
    """With a typographic minus sign; a dash where there is none.

    Examples
    --------
    >>> number(-13.264), number(float("nan")), number(16413.1468, 1)
    ('−13.26', '–', '16\u202f413.1')
    """
    if value is None or not np.isfinite(value):
        return DASH
    text = f"{value:,.{digits}f}"
    if not float(text.replace(",", "")):
        text = text.lstrip("-")  # minus nothing
    return text.replace("-", MINUS).replace(",", SPACE)


def memory(value: float | None) -> str:
    """Bytes, in MiB."""
    return DASH if value is None else f"{number(value / MIB, 0)} MiB"


def together(text: str) -> str:
    """A sentence whose numbers are not parted from their units at the end of a line.

    Examples
    --------
    >>> together("within 1 % of 5 mm")
    'within 1\u202f% of 5\u202fmm'
    """
    return re.sub(r"(?<=\d) (?=(%|dB|mm|MiB|rad)\b|%)", SPACE, text)


def count(n: int, what: str) -> str:
    """
    Examples
    --------
    >>> count(1, "target"), count(0, "warning"), count(73, "target")
    ('1 target', 'no warnings', '73 targets')
    """
    return f"{n or 'no'} {what}{'' if n == 1 else 's'}"


def spoken(r: PointResponse) -> str:
    """A response in words, for who cannot see its pictures."""
    parts = [
        f"{axis} side lobes {number(getattr(r, f'{axis}_pslr'))} dB, width {number(getattr(r, f'{axis}_irw'), 3)} m "
        f"where theory has {number(getattr(r, f'{axis}_irw_theory'), 3)} m"
        for axis in ("range", "azimuth")
    ]
    return "; ".join(parts)
