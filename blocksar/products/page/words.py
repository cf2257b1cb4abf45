"""Numbers, counts and figures as text for the report page."""

from __future__ import annotations

import re

import numpy as np

from blocksar.constants import MIB
from blocksar.measurement.figures import PointResponse

DASH, MINUS, TIMES = "\N{EN DASH}", "\N{MINUS SIGN}", "\N{MULTIPLICATION SIGN}"
SPACE = "\N{NARROW NO-BREAK SPACE}"


def number(value: float | None, digits: int = 2) -> str:
    """Format a number with a typographic minus sign; a dash if it is None or not finite.

    Examples
    --------
    >>> number(-13.264), number(float("nan")), number(16413.1468, 1)
    ('−13.26', '–', '16\u202f413.1')
    """
    if value is None or not np.isfinite(value):
        return DASH
    text = f"{value:,.{digits}f}"
    if not float(text.replace(",", "")):
        text = text.lstrip("-")  # no minus zero
    return text.replace("-", MINUS).replace(",", SPACE)


def memory(value: float | None) -> str:
    """Format bytes in MiB; a dash if None."""
    return DASH if value is None else f"{number(value / MIB, 0)} MiB"


def keep_units(text: str) -> str:
    """Replace the spaces between numbers and units, so that no line breaks there.

    Examples
    --------
    >>> keep_units("within 1 % of 5 mm")
    'within 1\u202f% of 5\u202fmm'
    """
    return re.sub(r"(?<=\d) (?=(%|dB|mm|MiB|rad)\b|%)", SPACE, text)


def count(n: int, noun: str) -> str:
    """A number of things, with the noun in singular or plural.

    Examples
    --------
    >>> count(1, "target"), count(0, "warning"), count(73, "target")
    ('1 target', 'no warnings', '73 targets')
    """
    return f"{n or 'no'} {noun}{'' if n == 1 else 's'}"


def describe(response: PointResponse) -> str:
    """Alternative text for a response's pictures."""
    parts = [
        f"{axis} side lobes {number(getattr(response, f'{axis}_pslr'))} dB, "
        f"width {number(getattr(response, f'{axis}_irw'), 3)} m, "
        f"in theory {number(getattr(response, f'{axis}_irw_theory'), 3)} m"
        for axis in ("range", "azimuth")
    ]
    return "; ".join(parts)
