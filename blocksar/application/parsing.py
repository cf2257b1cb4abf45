"""Parsing of values as people write them: grids, memory sizes, origins, numbers of blocks; for Python and commands."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from contextlib import suppress
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from blocksar.budget import FIDELITY, LEAST_FIDELITY, MOST_BLOCKS
from blocksar.errors import InputError, quoted

if TYPE_CHECKING:
    from blocksar.collection.grid import Grid

EXAMPLE = "give --grid x0:x1:dx,y0:y1:dy in metres, such as --grid -2500:2500:1,18000:23000:1"
LEAST_MEMORY = 1 << 20  # bytes of a worker; fewer are a number whose unit was forgotten
Axis = tuple[float, float, float]  # first point, end (exclusive) and spacing
GridLike: TypeAlias = "Grid | str | tuple[tuple[float, float, float], tuple[float, float, float]]"


def parse_grid(text: str) -> tuple[Axis, Axis]:
    """Read `x0:x1:dx,y0:y1:dy`: points x0, x0 + dx, ... < x1 in m, likewise y.

    Returns
    -------
    ((x0, x1, dx), (y0, y1, dy)) in m

    Raises
    ------
    InputError
        If the text has a different form, a number is not finite, or an axis would be empty.

    Examples
    --------
    >>> parse_grid("-100:100:0.5,18e3:20e3:1")
    ((-100.0, 100.0, 0.5), (18000.0, 20000.0, 1.0))
    """
    axes = text.split(",")
    if len(axes) != 2:
        raise InputError(
            f"--grid {quoted(text)} has {len(axes)} {'axis' if len(axes) == 1 else 'axes'} instead of two; {EXAMPLE}"
        )
    x, y = (_parse_axis(name, axis.split(":"), axis) for name, axis in zip("xy", axes, strict=True))
    return x, y


def read_grid(grid: Any) -> tuple[Axis, Axis]:
    """Check a grid given as ((x0, x1, dx), (y0, y1, dy)) in m.

    Raises
    ------
    InputError
        As `parse_grid`.

    Examples
    --------
    >>> read_grid([[-100, 100, 0.5], [18e3, 20e3, 1]])
    ((-100.0, 100.0, 0.5), (18000.0, 20000.0, 1.0))
    """
    try:
        first, second = grid
        axes = {"x": list(first), "y": list(second)}
    except (TypeError, ValueError):
        raise InputError(
            f"--grid {quoted(grid)} is not two axes of three numbers; give ((x0, x1, dx), (y0, y1, dy)) in metres, or "
            "a text such as -2500:2500:1,18000:23000:1"
        ) from None
    x, y = (_parse_axis(name, axis, axis) for name, axis in axes.items())
    return x, y


def _parse_axis(name: str, numbers: Sequence[Any], shown: object) -> Axis:
    try:
        first, end, step = (float(number) for number in numbers)
    except (TypeError, ValueError):
        raise InputError(f"--grid has {quoted(shown)} for {name}, which is not three numbers; {EXAMPLE}") from None
    if not all(map(math.isfinite, (first, end, step))):
        raise InputError(f"--grid has {quoted(shown)} for {name}, which is not finite; {EXAMPLE}")
    if step <= 0:
        raise InputError(f"--grid has a spacing of {step:g} m for {name}; give one above zero")
    if end <= first:
        raise InputError(f"--grid is empty: {name} runs from {first:g} to {end:g} m; give an end above the start")
    return first, end, step


def parse_memory(text: str) -> int:
    """Read the memory of a worker, such as `2GiB`, `500 MB` or `1e9`, as bytes.

    Raises
    ------
    InputError
        If the text is not a positive number with a unit of bytes, or below 1 MiB: the unit was forgotten.

    Examples
    --------
    >>> parse_memory("1.5GiB"), parse_memory("500 MB")
    (1610612736, 500000000)
    """
    match = re.fullmatch(r"\s*(\d+\.?\d*(?:e\d+)?|\.\d+)\s*([kmgt]i?)?b?\s*", text, re.IGNORECASE)
    if match is None or not float(match[1]):
        raise InputError(
            f"--memory-limit {quoted(text)} is no amount of memory; give a number with a unit, such as 2GiB"
        )
    unit = (match[2] or "").lower()
    base = 1024 if unit.endswith("i") else 1000
    size = float(match[1]) * base ** ("", "k", "m", "g", "t").index(unit.removesuffix("i"))
    if not 1 <= size < 2**60:
        raise InputError(
            f"--memory-limit {quoted(text)} is not an amount of memory that a machine has; give one such as 2GiB"
        )
    if size < LEAST_MEMORY:
        raise InputError(f"--memory-limit {quoted(text)} is {int(size)} bytes; give it with a unit, such as 2GiB")
    return int(size)


def parse_origin(text: str) -> tuple[float, float, float]:
    """Read `latitude,longitude,height`, in degrees and m.

    Raises
    ------
    InputError
        If the text is not three finite numbers.

    Examples
    --------
    >>> parse_origin("39.78,-84.1,300")
    (39.78, -84.1, 300.0)
    """
    try:
        latitude, longitude, height = (float(number) for number in text.split(","))
    except ValueError:
        latitude = longitude = height = math.nan
    if not all(map(math.isfinite, (latitude, longitude, height))):
        raise InputError(
            f"--origin {quoted(text)} is not three numbers; give latitude,longitude,height in degrees and "
            "metres, such as --origin 39.78,-84.1,300"
        )
    return latitude, longitude, height


def parse_blocks(text: str) -> int | Literal["auto"]:
    """Read `auto` or a number of blocks.

    Raises
    ------
    InputError
        If the text is neither.
    """
    if text == "auto":
        return "auto"
    if not re.fullmatch(r"0*[1-9]\d{0,8}", text, re.ASCII) or int(text) > MOST_BLOCKS:
        raise InputError(
            f"--blocks {quoted(text)} is neither 'auto' nor a whole number from 1 to {MOST_BLOCKS}; try --blocks auto"
        )
    return int(text)


def with_axes(grid: GridLike | None) -> GridLike | None:
    """Return a grid with its text read, if it is one; for `grid_of`."""
    return parse_grid(grid) if isinstance(grid, str) else grid


def grid_of(grid: GridLike | None) -> Grid | None:
    """Return a Grid; two triples, or a text, stand for start, end and step (m) in x and in y.

    Raises
    ------
    InputError
        If the grid cannot be read, or is empty or too large.
    """
    axes = with_axes(grid)
    if axes is None:
        return None
    from blocksar.collection.grid import Grid  # with NumPy, slow to load

    if isinstance(axes, Grid):
        return axes
    x, y = read_grid(axes)
    return Grid(*x, *y)


def memory_of(limit: Any) -> int | None:
    """Return an amount of memory in bytes, given as that or as a text such as "2GiB".

    Raises
    ------
    InputError
        If it is neither, or below 1 MiB.
    """
    if isinstance(limit, str):
        return parse_memory(limit)
    if limit is None:
        return None
    whole = None
    with suppress(TypeError, ValueError, OverflowError):
        whole = int(limit)
    if whole is None or whole != limit:
        raise InputError(f'memory_limit is {quoted(limit)}; give a whole number of bytes, or a text such as "2GiB"')
    if whole < LEAST_MEMORY:
        raise InputError(f"memory_limit is {whole} bytes; give what a worker may use, such as {2 << 30}")
    return whole


def fidelity_of(fidelity: Any) -> float:
    """Return a fidelity as a number.

    Raises
    ------
    InputError
        If it is none, or cannot be asked for.
    """
    if isinstance(fidelity, bool) or not isinstance(fidelity, Real):
        raise InputError(f"fidelity is {quoted(fidelity)}; give a number below 1, such as {FIDELITY:g}")
    value = float(fidelity)
    if not LEAST_FIDELITY <= value < 1:
        raise InputError(
            f"fidelity = {value:g}: ask for a coherence from {LEAST_FIDELITY:g} to below 1, such as {FIDELITY:g}"
        )
    return value


def blocks_of(blocks: int | str) -> int | Literal["auto"]:
    """Return a number of blocks, or "auto".

    Raises
    ------
    InputError
        If it is neither.
    """
    if isinstance(blocks, str):
        return parse_blocks(blocks)
    if isinstance(blocks, bool) or not isinstance(blocks, Integral):
        raise InputError(f"--blocks {quoted(blocks)} is neither 'auto' nor a whole number; try --blocks auto")
    return int(blocks)
