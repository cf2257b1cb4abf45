"""Texts of intervals, such as `0:4096`: of pulses, frequencies and parts of the ground."""

from __future__ import annotations

import math
from typing import Any

from blocksar.errors import InputError, quoted


def parse_span(span: Any, option: str, example: str) -> tuple[float, float]:
    """Read `a:b`, of which either may be left out, or a pair of numbers or None.

    Returns
    -------
    (low, high), infinite where left out

    Raises
    ------
    InputError
        If it is none, or empty.

    Examples
    --------
    >>> parse_span("9.5e9:9.7e9", "--frequencies", ""), parse_span((5, None), "--frequencies", "")
    ((9500000000.0, 9700000000.0), (5.0, inf))
    """
    try:
        first, last = span.split(":") if isinstance(span, str) else span
        low = -math.inf if first in ("", None) else float(first)
        high = math.inf if last in ("", None) else float(last)
    except (TypeError, ValueError):
        low = high = math.nan
    if not low < high:
        raise InputError(f"{option} {quoted(span)} is not two numbers, the lower first; give them as {example}")
    return low, high


def parse_pulses(span: Any, option: str = "--pulses", example: str = "--pulses 0:4096") -> tuple[int, int | None]:
    """Read the pulses (or what the option names) a:b, from a to the one before b, from 0; either may be left out.

    Raises
    ------
    InputError
        As `parse_span`, and if they are no whole numbers from 0.
    """
    low, high = parse_span(span, option, example)
    low = 0.0 if low == -math.inf else low
    if low < 0 or not low.is_integer() or not (high == math.inf or high.is_integer()):
        raise InputError(f"{option} {quoted(span)} is not two whole numbers from 0; give them as {example}")
    return int(low), None if high == math.inf else int(high)


def parse_crop(crop: Any, name: str = "crop") -> tuple[tuple[float, float], tuple[float, float]]:
    """Read a part of the ground, such as `0:500,18000:18500` or ((0, 500), (18000, 18500)), m; `name` is its option's.

    Raises
    ------
    InputError
        If it is none, or an axis is empty.

    Examples
    --------
    >>> parse_crop("0:500,18e3:18500")
    ((0.0, 500.0), (18000.0, 18500.0))
    """
    given = [numbers_of(axis) for axis in crop.split(",")] if isinstance(crop, str) else crop
    try:
        (x0, x1), (y0, y1) = ((float(low), float(high)) for low, high in given)
    except (TypeError, ValueError):
        x0 = x1 = y0 = y1 = math.nan
    if not (x0 < x1 and y0 < y1 and all(map(math.isfinite, (x0, x1, y0, y1)))):
        raise InputError(
            f"{name} = {str(crop)[:80]!r}: give the ends of x and of y in metres, the lower first, such as "
            "0:500,18000:18500"
        )
    return (x0, x1), (y0, y1)


def numbers_of(text: str) -> tuple[float, ...]:
    """Numbers between colons; none where the text has anything else."""
    try:
        return tuple(float(number) for number in text.split(":"))
    except ValueError:
        return ()
