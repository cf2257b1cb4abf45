"""The pyramid of an image: its levels, and metadata by the GeoZarr conventions for zarr browsers.

Level k has cells of 2^k pixels a side, with the mean power of those of level k - 1 that are covered. They lie in
image.zarr/pyramid/k, as `power` (y, x) over x and y. The attributes follow these conventions, each in version 0.1:

- multiscales, https://github.com/zarr-conventions/multiscales/blob/v0.1/README.md
- spatial, https://github.com/zarr-conventions/spatial/blob/v0.1/README.md
- proj, https://github.com/zarr-conventions/proj/blob/v0.1/README.md, where the frame points east and north

There each level has a CF grid mapping, `spatial_ref`, too, for programs that do not know these conventions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.chunks import IMAGE_CHUNK
from blocksar.places.place import Place
from blocksar.stores.channels import with_channels
from blocksar.stores.contract import LEVEL, SPATIAL_REF, Variable
from blocksar.stores.creation import Group

PYRAMID = "pyramid"
METHOD = "mean power of covered pixels"
GRID_MAPPING = "spatial_ref"  # the name that programs look up first
_CONVENTIONS = {
    "multiscales": ("d35379db-88df-4056-af3a-620245f8e347", "Multiscale layout of zarr datasets"),
    "spatial": ("689b58e2-cf7b-45e0-9fff-9cfc0883d6b4", "Spatial coordinate information"),
    "proj": (
        "f17cb550-5864-4468-aeb7-f3180cfb622f", "Coordinate reference system information for geospatial data"
    ),
}  # fmt: skip
_HOME = "zarr-conventions"


def level_name(level: int) -> str:
    """Path of the power of a level, from 1 on, in an image's store."""
    return f"{PYRAMID}/{level}/power"


def level_shapes(shape: tuple[int, int]) -> list[tuple[int, int]]:
    """Shapes of the levels of an image's pyramid, the finest first, down to one that is a single chunk.

    Examples
    --------
    >>> level_shapes((5000, 700)), level_shapes((512, 100))
    ([(2500, 350), (1250, 175), (625, 88), (313, 44)], [])
    """
    shapes: list[tuple[int, int]] = []
    while max(shape) > IMAGE_CHUNK:
        shape = -(-shape[0] // 2), -(-shape[1] // 2)
        shapes.append(shape)
    return shapes


def levels_of(image: Place) -> int:
    """Number of levels of the pyramid that an image's store has; 0 without one."""
    level = 0
    while (image / PYRAMID / str(level + 1) / "power" / "zarr.json").exists():
        level += 1
    return level


class Pyramid(NamedTuple):
    """Layout of a pyramid in a store: its groups, and attributes of the store itself."""

    groups: dict[str, Group]
    attrs: dict[str, Any]


def pyramid_of(
    x: FloatArray, y: FloatArray, projection: Mapping[str, Any] | None, *, members: Sequence[str] = (),
    dimension: str = "channel",
) -> Pyramid:  # fmt: skip
    """The pyramid of an image over x and y, m; `projection` is its CF grid mapping, if it has one.

    Of several channels or looks, the `members`, levels have that leading dimension, as their image has.
    """
    schema = _schema(projection)
    if members:
        schema = with_channels(schema, "power", dimension=dimension)
    wkt = (projection or {}).get("crs_wkt")
    variables = {GRID_MAPPING: np.zeros((), np.int16)} if projection else {}
    named, lead = ({dimension: np.asarray(members, "T")}, {dimension: 1}) if members else ({}, {})
    shapes = level_shapes((y.size, x.size))
    names = ["multiscales", "spatial", *(["proj"] if wkt else [])]
    shared = {"spatial:dimensions": ["y", "x"], **({"proj:wkt2": wkt} if wkt else {})}
    places = [_place(x, y, level, shape) for level, shape in enumerate([(y.size, x.size), *shapes])]
    whole = [
        {"asset": "image" if level == 0 else level_name(level), **_derived(level, "image", level_name), **place}
        for level, place in enumerate(places)
    ]
    inner = [{"asset": f"{level}", **_derived(level - 1, "1", lambda n: f"{n + 1}"), **places[level]}
             for level in range(1, len(places))]  # fmt: skip
    groups = {PYRAMID: Group({}, {}, {**_declared(names), **shared, "multiscales": _multiscales(inner)}, {})}
    for level, (n_y, n_x) in enumerate(shapes, 1):
        attrs = {**_declared(names[1:]), **shared, **places[level], "spatial:registration": "pixel"}
        axes = {name: _middles(axis, level, n) for name, axis, n in (("x", x, n_x), ("y", y, n_y))}
        # One chunk of the first level covers one chunk of the image.
        sides = [min(n, IMAGE_CHUNK) for n in ((y.size, x.size) if level == 1 else (n_y, n_x))]
        chunks = dict(zip("yx", [-(-n // 2) for n in sides] if level == 1 else sides, strict=True))
        groups[f"{PYRAMID}/{level}"] = Group(schema, axes | named, attrs, lead | chunks, variables)
    return Pyramid(groups, {**_declared(names), **shared, "multiscales": _multiscales(whole)})


def _schema(projection: Mapping[str, Any] | None) -> dict[str, Variable]:
    """Variables of a level, with its grid mapping if there is one."""
    if not projection:
        return LEVEL
    power = replace(LEVEL["power"], attrs={"grid_mapping": GRID_MAPPING})
    return {**LEVEL, "power": power, GRID_MAPPING: replace(SPATIAL_REF, attrs=projection)}


def _declared(names: Sequence[str]) -> dict[str, Any]:
    """Attribute that declares the conventions of a group."""
    return {
        "zarr_conventions": [
            {
                "uuid": _CONVENTIONS[name][0],
                "name": name,
                "schema_url": f"https://raw.githubusercontent.com/{_HOME}/{name}/refs/tags/v0.1/schema.json",
                "spec_url": f"https://github.com/{_HOME}/{name}/blob/v0.1/README.md",
                "description": _CONVENTIONS[name][1],
            }
            for name in names
        ]
    }


def _multiscales(layout: list[dict[str, Any]]) -> dict[str, Any]:
    return {"layout": layout, "resampling_method": METHOD}


def _derived(level: int, first: str, name: Any) -> dict[str, Any]:
    """Attributes on the level that a level is computed from; empty for the first."""
    if level == 0:
        return {}
    source = first if level == 1 else name(level - 1)
    return {"derived_from": source, "transform": {"scale": [2.0, 2.0], "translation": [0.0, 0.0]}}


def _place(x: FloatArray, y: FloatArray, level: int, shape: tuple[int, int]) -> dict[str, Any]:
    """Attributes on a level's place: its shape, and the affine transform from cell corners to m."""
    dx, dy = _step(x), _step(y)
    side = 2.0**level
    transform = [dx * side, 0.0, float(x[0]) - dx / 2, 0.0, dy * side, float(y[0]) - dy / 2]
    return {"spatial:shape": list(shape), "spatial:transform": transform}


def _middles(axis: FloatArray, level: int, n: int) -> FloatArray:
    """Centres of n cells of 2^level pixels, m; the last may reach beyond the image."""
    step = _step(axis)
    return np.asarray(axis[0] + step * ((2**level - 1) / 2 + 2**level * np.arange(n)))


def _step(axis: FloatArray) -> float:
    return float(axis[-1] - axis[0]) / (axis.size - 1) if axis.size > 1 else 1.0
