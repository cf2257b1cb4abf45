"""Names of dimensions and coordinates in other conventions, and the order that they state."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from blocksar.arrays import IntArray
from blocksar.errors import InputError, quoted

DIMENSIONS = {  # names by which a dimension is known
    "pulse": ("pulse", "time", "pulses", "slow_time", "azimuth", "azimuth_time", "line"),
    "range_frequency": ("range_frequency", "frequency", "frequencies", "freq"),
    "fast_time": ("fast_time", "range_time", "delay", "range", "sample", "samples"),
    "axis": ("axis", "xyz", "component", "components", "coordinate", "coord", "space"),
    "channel": ("channel", "channels", "polarization", "polarisation", "pol"),
    "beam_offset": ("beam_offset",),
    "elevation": ("elevation",),
}
COORDINATES = {  # other names of the variables along dimensions
    "slow_time": "time", "azimuth_time": "time", "frequency": "range_frequency", "frequencies": "range_frequency",
    "freq": "range_frequency", "range_time": "fast_time", "pol": "channel", "polarization": "channel",
    "polarisation": "channel", "channels": "channel",
}  # fmt: skip
NUMERIC = "fiu"  # kinds of dtypes
COMPONENTS = (("x", "y", "z"), ("east", "north", "up"), ("e", "n", "u"), ("0", "1", "2"))  # each right-handed, z up
BY_ITSELF = re.compile(r"dim_\d+")  # as xarray names dimensions that nobody names
SAME = 1e-3  # steps of an axis by which labels may differ from its values
SHIFTED = ("time", "range_frequency")  # labels count from elsewhere: from a date, or from zero Hz


def canonical_dims(name: str, stated: Sequence[str], wanted: Sequence[str]) -> tuple[str, ...] | None:
    """Translate names of dimensions to the contract's, in their order; None if they have no meaning.

    One that is not known is the one that is left.

    Raises
    ------
    InputError
        If they are those of something else, or cannot be told.
    """
    if all(map(BY_ITSELF.fullmatch, stated)):
        return None
    known = {alias: dim for dim, aliases in DIMENSIONS.items() for alias in aliases}
    meant = [each if each in wanted else known.get(each.lower()) for each in stated]
    left = [dim for dim in wanted if dim not in meant]
    if meant.count(None) == len(left) == 1:
        meant[meant.index(None)] = left[0]
    if sorted(map(str, meant)) != sorted(wanted):
        raise InputError(
            f"{name} has dimensions ({', '.join(stated)}), but must have ({', '.join(wanted)}); rename them, or give "
            f"{name}.values if they lie in this order"
        )
    return tuple(map(str, meant))


def axis_order(name: str, label: str, values: Any) -> IntArray:
    """Indices of x, y and z along a labelled axis of length three.

    East, north and up count as x, y and z.

    Raises
    ------
    InputError
        If they are others.
    """
    texts = [_text(value).casefold() for value in np.atleast_1d(values)]
    for names in COMPONENTS:
        if sorted(texts) == sorted(names):
            return np.array([texts.index(each) for each in names])
    remedy = "give x, y and z, with z up"
    if any("down" in each or each == "d" for each in texts):
        remedy = "give x = east, y = north and z = -down"
    elif any(each.startswith(("lat", "lon")) for each in texts):
        remedy = (
            "give Earth-centred x, y and z, such as "
            "np.stack(pyproj.Transformer.from_crs(4979, 4978).transform(latitude, longitude, height), axis=-1), with "
            "earth_centred=True"
        )
    raise InputError(f"{name} has {label} = {', '.join(map(str, texts))} along its axis; {remedy}")


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def order_by(name: str, label: str, values: Any, other: str, reference: Any) -> IntArray | None:
    """Permutation of samples with labels (n,) to the order of a reference (n,); None if they are in order.

    Raises
    ------
    InputError
        If the labels are not those of the reference.
    """
    mine, yours = _numbers(label, values), _numbers(label, reference)
    if mine.shape == yours.shape and (mine.dtype.kind in NUMERIC) == (yours.dtype.kind in NUMERIC):
        if _agree(mine, yours):
            return None
        first, second = np.argsort(mine, kind="stable"), np.argsort(yours, kind="stable")
        if np.unique(mine).size == mine.size and _agree(mine[first], yours[second]):
            order = np.empty(mine.size, np.int64)
            order[second] = first
            return order
    raise InputError(
        f"{name} has the coordinate {label} = {_ends(values)}, but {other} is {_ends(reference)}; make them agree, or "
        f"give {name}.values if it is in that order"
    )


def _numbers(label: str, values: Any) -> Any:
    """Convert labels to comparable numbers: dates to seconds, times and frequencies relative to their first."""
    array = np.asarray(values)
    if array.dtype.kind == "M":
        array = (array - array.min()) / np.timedelta64(1, "s")
    elif array.dtype.kind == "m":
        array = array / np.timedelta64(1, "s")
    elif array.dtype.kind == "O":
        array = np.array([_text(each) for each in array.ravel()])
    elif array.dtype.kind == "S":
        array = np.char.decode(array)
    if array.dtype.kind in NUMERIC and array.size and COORDINATES.get(label, label) in SHIFTED:
        return array - array.min()
    return array


def _agree(mine: Any, yours: Any) -> bool:
    if mine.shape != yours.shape:
        return False
    if mine.dtype.kind in NUMERIC:
        step = float(np.abs(np.diff(yours)).min()) if yours.size > 1 else 0.0
        return bool(np.abs(mine - yours).max(initial=0.0) <= SAME * step)
    return bool((mine == yours).all())


def check_relation(name: str, label: str, values: Any, argument: Any) -> None:
    """Refuse a coordinate that differs from the argument of its name."""
    mine, yours = np.asarray(values), np.asarray(argument)
    if mine.dtype.kind in NUMERIC and yours.dtype.kind in NUMERIC:
        same = mine.shape == yours.shape and np.allclose(mine, yours, rtol=1e-6, atol=0)
        if mine.shape[::-1] == yours.shape:
            same = same or np.allclose(mine.T, yours, rtol=1e-6, atol=0)
        if not same:
            raise InputError(
                f"{name} has the coordinate {label} = {_ends(mine)}, but argument {label} is {_ends(yours)}; make them "
                "agree, or drop the coordinate"
            )


def _ends(values: Any) -> str:
    array = np.asarray(values).ravel()
    texts = [f"{each:.6g}" if array.dtype.kind in NUMERIC else quoted(_text(each)) for each in array[[0, -1]]]
    return texts[0] if array.size == 1 else f"{texts[0]} .. {texts[1]} ({array.size})"
