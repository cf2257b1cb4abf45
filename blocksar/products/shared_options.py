"""Options that products share: their meaning, and their parsers."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable
from typing import Annotated, Any, Literal

from blocksar.errors import InputError
from blocksar.options import Option
from blocksar.spans import numbers_of, parse_crop

Content = Literal["amplitude", "power", "db", "complex", "height", "incidence", "visibility", "gamma"]
Quantity = Literal["sigma0", "beta0", "gamma0"]
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
        low, high = numbers_of(limits) if isinstance(limits, str) else (float(end) for end in limits)
    except (TypeError, ValueError):
        low = high = math.nan
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        given = limits[:80] if isinstance(limits, str) else limits
        raise InputError(f"range = {given!r}: give two ends in dB, the lower first, such as -40:0")
    return low, high


def parse_calibration(calibration: Any) -> float:
    """Read a calibration: the radar cross-section of a target that peaks at 1, m^2; or a file of `calibrate`.

    Raises
    ------
    InputError
        If it is no positive number, nor a file that has one.

    Examples
    --------
    >>> parse_calibration("2.5e3")
    2500.0
    """
    try:
        factor = math.nan if isinstance(calibration, bool) else float(calibration)
    except (TypeError, ValueError):
        factor = math.nan
    if isinstance(calibration, str | os.PathLike) and not math.isfinite(factor):
        from blocksar import stores  # loads numpy, which help does without
        from blocksar.places import place

        where = place(calibration)
        content = stores.read_json(where) if where.exists() else None
        try:
            found = stores.calibration_of(content if isinstance(content, dict) else {})
        except InputError as error:
            raise InputError(f"{where}: {error}") from None
        factor = math.nan if found is None else found
    if not (math.isfinite(factor) and factor > 0):
        raise InputError(
            f"calibration = {calibration!r:.80}: give the radar cross-section of a target that peaks at 1, a "
            "positive number of m2, such as 2.5e3, or a file that `blocksar calibrate` wrote"
        )
    return factor


def decibels(of: str) -> Option:
    """Make the option `range`: the range in dB of a quantity."""
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
OfBackscatter = Annotated[
    Quantity | None,
    Option(
        "Backscatter: sigma0, beta0 or gamma0, per area of the ground, of the slant plane or across the sight.",
        metavar="NAME",
        default="reflectivity",
    ),
]
Calibration = Annotated[
    float | None,
    Option(
        "Radar cross-section of a target that peaks at 1, m2; or a file of calibrate.",
        metavar="M2|FILE",
        default="the attribute calibration_factor; else values are relative",
        read=parse_calibration,
    ),
]
