"""Options of exports: which product takes which, what their texts mean, and the endings of files."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from typing import Any

from blocksar.errors import InputError, printable
from blocksar.spans import numbers_of

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
    ends = numbers_of(limits)
    if len(ends) != 2:
        raise InputError(f"range = {limits[:80]!r}: give two ends in dB, the lower first, such as -40:0")
    return ends
