"""Options that products share: what they mean, and how their texts are read."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import Annotated, Any, Literal

from blocksar.errors import InputError
from blocksar.options import Option

Content = Literal["amplitude", "power", "db", "complex", "height", "incidence", "visibility", "gamma"]
Scale = Literal["uint8", "uint16"]
Decibels = tuple[float, float]  # lower and upper end
Box = tuple[tuple[float, float], tuple[float, float]]  # ends of x and of y, m


def parse_looks(looks: Any) -> tuple[int, int]:
    """Read looks, such as `4x2` or (4, 2): pixels along y and along x.

    Raises
    ------
    InputError
        If it is a text of another form.

    Examples
    --------
    >>> parse_looks("4x2")
    (4, 2)
    """
    if not isinstance(looks, str):
        return tuple(looks) if isinstance(looks, Iterable) else (looks,)
    match = re.fullmatch(r"\s*0*([1-9]\d{0,5})\s*[x,]\s*0*([1-9]\d{0,5})\s*", looks, re.IGNORECASE)
    if match is None:
        raise InputError(
            f"looks = {looks[:80]!r}: give pixels along y and along x, whole numbers above zero, such as 4x2"
        )
    return int(match[1]), int(match[2])


def parse_range(limits: Any) -> Decibels:
    """Read the ends of a range in dB, such as `-40:0` or (-40, 0).

    Raises
    ------
    InputError
        If they are no two finite numbers, the lower first.

    Examples
    --------
    >>> parse_range("-40:0")
    (-40.0, 0.0)
    """
    try:
        low, high = _numbers(limits) if isinstance(limits, str) else (float(end) for end in limits)
    except (TypeError, ValueError):
        low = high = math.nan
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        given = limits[:80] if isinstance(limits, str) else limits
        raise InputError(f"range = {given!r}: give two ends in dB, the lower first, such as -40:0")
    return low, high


def parse_crop(crop: Any, name: str = "crop") -> Box:
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
    given = [_numbers(axis) for axis in crop.split(",")] if isinstance(crop, str) else crop
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


def _numbers(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(number) for number in text.split(":"))
    except ValueError:
        return ()


def decibels(of: str) -> Option:
    """The option `range` of what decibels are mapped to."""
    return Option(f"dB at the ends of {of}.", metavar="LOW:HIGH", default="by the image", read=parse_range)


COLOUR_RANGE = decibels("the colours")
COLOUR_MAP = Option(
    "One of matplotlib's colour maps.", metavar="NAME", default="gray", flags=("--colour-map", "--color-map")
)
Crop = Annotated[
    Box | None,
    Option("Write only this part of the ground, m.", metavar="x0:x1,y0:y1", default="the whole image", read=parse_crop),
]
Looks = Annotated[
    tuple[int, int] | None,
    Option(
        "Average power over cells of A pixels along y and B along x.",
        metavar="AxB",
        default="by the product",
        read=parse_looks,
    ),
]
