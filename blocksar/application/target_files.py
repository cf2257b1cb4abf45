"""Files of targets: JSON, CSV or GeoJSON; errors name the record and the remedy."""

from __future__ import annotations

import csv
import difflib
import json
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from blocksar import stores
from blocksar.collection.georeference import Georeference
from blocksar.errors import InputError
from blocksar.measurement.figures import PointResponse
from blocksar.measurement.reflectors import KINDS, Reflector
from blocksar.measurement.targets import Target
from blocksar.places import Location, place
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place
from blocksar.texts import count

CSV_FORM = "a first line with name, x, y, and maybe z and reflectivity (such as 1 or 0.5+0.2j)"
GROUND_STEPS = 4  # to the height above the ellipsoid at which a place lies on the ground's plane
FORM = '[{"name": "A1", "x": 120.5, "y": -40.0}, ...], x and y in m in the scene frame'
REFLECTORS = (
    '[{"name": "R1", "x": 120.5, "y": -40.0, "kind": "trihedral", "side": 1.5}, ...], or GeoJSON of such points'
)
MOST_SIDE = 1e3  # m, of a reflector
# Of quality.json, too, which has the targets and more; what is measured is not read.
KNOWN = {*Target._fields, *PointResponse._fields}


class HasFrame(Protocol):
    """Owner of a scene frame: a finished run, or a `TargetFrame`."""

    @property
    def georeference(self) -> Georeference | None: ...

    @property
    def ground_height(self) -> float: ...


class TargetFrame(NamedTuple):
    """A scene frame: its place on the Earth, if that is known, and the height of its ground, m."""

    georeference: Georeference | None
    ground_height: float


def targets_of(
    targets: Location | Sequence[Target | Mapping[str, Any]] | None,
    attrs: Mapping[str, Any],
    frame: HasFrame | None = None,
) -> list[Target]:
    """Read targets from a file; by default, from the attributes of a collection. GeoJSON needs the scene's frame.

    Raises
    ------
    InputError
        If the file or the attribute holds no targets.
    """
    if targets is None:
        return [Target.from_record(record) for record in attrs.get("targets") or []]
    if not isinstance(targets, str | os.PathLike | Place):
        if not isinstance(targets, Sequence):
            raise InputError(f"targets is a {type(targets).__name__}; give a file, or a list of targets")
        listed: Sequence[Any] = targets
        return [target if isinstance(target, Target) else Target.from_record(target) for target in listed]
    path = place(targets)
    if path.name.endswith(".toml"):
        from blocksar.simulation.scene import Scene  # slow to load

        return [Target(*t) for t in Scene.read(str(path)).point_targets()]
    return read_targets(path, frame)


def read_targets(path: Place, frame: HasFrame | None = None) -> list[Target]:
    """Read the targets of a JSON file: a list of records, or a dict with that list as `targets`.

    A CSV file has the names of the fields in its first line. A GeoJSON file (FeatureCollection) has points in degrees,
    which a georeference takes to the scene frame, and their names in `properties` or `id`.

    Raises
    ------
    InputError
        If the file is not JSON, has no targets, or a record has an unknown key, lacks one, or repeats a name.
    """
    return [_target(*each) for each in _listed(path, frame, "target", FORM, ("reflectivity",))]


def _records(path: Place) -> Any:
    if isinstance(path, LocalPlace) and path.exists() and not path.path.is_file():
        raise InputError(f"{path} is no regular file; give {FORM}")
    try:
        return stores.read_json(path)
    except InputError as error:
        cause = error.__cause__
        odd = isinstance(cause, InputError)  # too large for a list of targets
        if odd or not isinstance(cause, ValueError | RecursionError):
            raise
        text = path.read_bytes()[:4096].decode("utf-8", errors="replace")
        if _like_csv(text):
            return _of_csv(path)
        line = f" at line {cause.lineno}" if isinstance(cause, json.JSONDecodeError) else ""
        raise InputError(f"{path} is not JSON{line}; give {FORM}") from None


def _of_csv(path: Place) -> list[dict[str, Any]]:
    """The records of a CSV file, separated by commas, semicolons or tabs.

    Raises
    ------
    InputError
        If its first line has no names, a line has more or fewer values, or a reflectivity is no number.
    """
    lines = [line for line in path.read_bytes().decode("utf-8-sig", errors="replace").splitlines() if line.strip()]
    separator = max(",;\t", key=lines[0].count)
    names, *rows = csv.reader(lines, delimiter=separator, skipinitialspace=True)
    names = [name.strip() for name in names]
    if not {"name", "x", "y"} <= {name.lower() for name in names}:
        raise InputError(f"{path} looks like CSV, but its first line is {lines[0][:60]!r}; give {CSV_FORM}")
    records = []
    for number, row in enumerate(rows, 1):
        if len(row) != len(names):
            raise InputError(
                f"{path}: target {number} has {count(len(row), 'value')} for {count(len(names), 'column')}; correct "
                "the line"
            )
        record: dict[str, Any] = {name: text.strip() for name, text in zip(names, row, strict=True) if text.strip()}
        if "reflectivity" in record:
            try:
                record["reflectivity"] = complex(record["reflectivity"].replace(" ", ""))
            except ValueError:
                raise InputError(
                    f"{path}: target {number} has the reflectivity {record['reflectivity'][:60]!r}; give {CSV_FORM}"
                ) from None
        records.append(record)
    return records


def read_reflectors(path: Place, frame: HasFrame | None = None) -> list[Reflector]:
    """Read reflectors of a file as of `read_targets`, each with its kind and its side, m, also in `properties`.

    Raises
    ------
    InputError
        If there are none, a record is none of a target, or its kind or its side is wrong.
    """
    return [_reflector(*each) for each in _listed(path, frame, "reflector", REFLECTORS, ("kind", "side"))]


def _listed(
    path: Place, frame: HasFrame | None, kind: str, form: str, more: Sequence[str]
) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield the records of a file, with known keys and `more`, each after the words that name it in messages.

    They are a list, a dict with that list under the plural of `kind`, or GeoJSON with `more` in `properties`.

    Raises
    ------
    InputError
        If there are none, or one is no record, has an unknown key or lacks one.
    """
    records = _records(path)
    if isinstance(records, dict) and records.get("type") in ("FeatureCollection", "Feature"):
        records = _of_geojson(path, records, frame, more)
    if isinstance(records, dict):
        records = records.get(f"{kind}s")
    if not isinstance(records, list) or not records:
        raise InputError(f"{path} holds no list of {kind}s; give {form}")
    for number, record in enumerate(records, 1):
        where = f"{path}: {kind} {number}"
        if not isinstance(record, Mapping):
            raise InputError(f"{where} is {json.dumps(record)[:60]}, not a record; give {form}")
        _check_keys({key: value for key, value in record.items() if key not in more}, where, form)
        yield where, record


def _target(where: str, record: Mapping[str, Any]) -> Target:
    try:
        return Target.from_record(record)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _reflector(where: str, record: Mapping[str, Any]) -> Reflector:
    kind, side = record.get("kind"), record.get("side")
    if kind not in KINDS:
        raise InputError(f"{where} is of the kind {kind!r:.60}; give one of {', '.join(KINDS)}")
    try:
        metres = math.nan if isinstance(side, bool) else float(side)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        metres = math.nan
    if not 0 < metres < MOST_SIDE:
        raise InputError(f"{where} has the side {side!r:.60}; give it in m, above 0 and below {MOST_SIDE:g}")
    return Reflector(_target(where, record), kind, metres)


def _of_geojson(
    path: Place, content: Mapping[str, Any], frame: HasFrame | None, kept: Sequence[str]
) -> list[dict[str, Any]]:
    """The records of GeoJSON points: longitude and latitude in degrees, and height above the ellipsoid in m if given.

    Without a height a point lies on the plane of the ground.

    Raises
    ------
    InputError
        If a feature is no point, or there is no georeference.
    """
    if frame is None or frame.georeference is None:
        raise InputError(
            f"{path} is GeoJSON, whose points are in degrees, but there is no georeference; give x and y instead: "
            f"{FORM}"
        )
    features = content.get("features") if content.get("type") == "FeatureCollection" else [content]
    records = []
    for number, feature in enumerate(features if isinstance(features, list) else [], 1):
        try:
            shape, own = feature["geometry"], feature.get("properties") or {}
            longitude, latitude, *height = (float(value) for value in shape["coordinates"])
            if shape["type"] != "Point" or len(height) > 1:
                raise ValueError
            name = own.get("name", feature.get("id", f"point {number}"))
        except (KeyError, TypeError, ValueError, AttributeError):
            raise InputError(
                f"{path}: feature {number} is no point; give geometry of type Point with coordinates [longitude, "
                "latitude] in degrees"
            ) from None
        if not (abs(longitude) <= 360 and abs(latitude) <= 90):
            raise InputError(
                f"{path}: feature {number} lies at longitude {longitude:g}, latitude {latitude:g}; give longitude "
                "first, in degrees"
            )
        x, y, z = _in_scene(frame.georeference, frame.ground_height, latitude, longitude, height[0] if height else None)
        extra = {key: own[key] for key in kept if key in own}
        records.append({"name": str(name), "x": x, "y": y, **({"z": z} if height else {}), **extra})
    return records


def _in_scene(
    frame: Georeference, ground_height: float, latitude: float, longitude: float, height: float | None
) -> tuple[float, float, float]:
    """x, y, z (m) of a place in the scene frame; without a height, where it meets the plane of the ground."""
    above = frame.height + ground_height if height is None else height
    for _ in range(1 if height is not None else GROUND_STEPS):
        x, y, z = (float(value) for value in frame.from_geodetic(np.array([latitude, longitude, above])))
        above -= z - ground_height
    return x, y, z


def _like_csv(text: str) -> bool:
    """Tell whether a text looks like CSV: lines of equally many separators, at least two columns, and no JSON."""
    lines = [line for line in text.splitlines()[:20] if line.strip()]
    counts = {len(re.findall(r"[,;\t]", line)) for line in lines[:-1] or lines}
    return len(counts) == 1 and min(counts) >= 1 and not re.match(r"\s*[\[{]", text)


def _check_keys(record: Mapping[str, Any], where: str, form: str) -> None:
    for key in record:
        if key in KNOWN:
            continue
        close = difflib.get_close_matches(str(key).lower(), Target._fields, n=1)
        hint = f"did you mean {close[0]}?" if close else f"known are {', '.join(Target._fields)}"
        raise InputError(f"{where} has the unknown key {str(key)[:60]!r}; {hint}")
    if missing := [name for name in ("name", "x", "y") if name not in record]:
        raise InputError(f"{where} has no {' and no '.join(missing)}; give {form}")
