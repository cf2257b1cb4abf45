"""Options of exports: which product takes which, what their texts mean, and the endings of files."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable
from typing import Any

from blocksar.errors import InputError, printable

OPTIONS: dict[str, tuple[str, ...]] = {
    "sicd": (),
    "geotiff": ("content", "looks", "scale", "range", "crop", "crs"),
    "png": ("looks", "range", "crop", "colour_map", "size", "composite"),
}
ENDINGS = {
    "sicd": (".nitf", ".ntf", ".nsf"),
    "geotiff": (".tif", ".tiff"),
    "png": (".png",),
    "report": (".html", ".htm"),
}
OTHERS = (".jpg", ".jpeg", ".gif", ".webp", ".svg", ".pdf", ".json", ".csv", ".zarr", ".nc", ".h5", ".toml")


def check_ending(kind: str, name: str) -> None:
    """Refuse a file's name with the ending of something else; unknown endings may stand for anything.

    Raises
    ------
    InputError
        If the ending is that of another kind of file.
    """
    ending = os.path.splitext(name)[1].lower()
    other = {ending: kind for kind, endings in ENDINGS.items() for ending in endings}.get(ending)
    if ending in OTHERS or other not in (None, kind):
        owner = f"which is that of {other}" if other else "which is that of another kind of file"
        raise InputError(
            f"{printable(name)} ends in {ending}, {owner}; give {kind} a name that ends in {' or '.join(ENDINGS[kind])}"
        )


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


def parse_range(limits: Any) -> Any:
    """Read a range in dB, such as `-40:0`; what is no text is handed on.

    Raises
    ------
    InputError
        If it is a text of another form.

    Examples
    --------
    >>> parse_range("-40:0")
    (-40.0, 0.0)
    """
    if not isinstance(limits, str):
        return limits
    ends = _numbers(limits)
    if len(ends) != 2:
        raise InputError(f"range = {limits[:80]!r}: give two ends in dB, the lower first, such as -40:0")
    return ends


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
