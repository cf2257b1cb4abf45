"""Files of targets that a user names: JSON, each fault said with its record and its remedy."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Mapping
from typing import Any

from blocksar import stores
from blocksar.errors import InputError
from blocksar.measurement.figures import PointResponse
from blocksar.measurement.targets import Target
from blocksar.places.place import Place

FORM = '[{"name": "A1", "x": 120.5, "y": -40.0}, ...], x and y in m in the scene frame'
# Of quality.json, too, which has the targets and more; what is measured is not read.
KNOWN = {*Target._fields, *PointResponse._fields}


def read_targets(path: Place) -> list[Target]:
    """Read the targets of a JSON file: a list of records, or a dict with that list as `targets`.

    Raises
    ------
    InputError
        If the file is not JSON, has no targets, or a record has an unknown key, lacks one, or repeats a name.
    """
    records = _records(path)
    if isinstance(records, dict):
        records = records.get("targets")
    if not isinstance(records, list) or not records:
        raise InputError(f"{path} holds no list of targets; give {FORM}")
    targets = []
    for number, record in enumerate(records, 1):
        where = f"{path}: target {number}"
        if not isinstance(record, Mapping):
            raise InputError(f"{where} is {json.dumps(record)[:60]}, not a record; give {FORM}")
        _check_keys(record, where)
        try:
            targets.append(Target.from_record(record))
        except InputError as error:
            raise InputError(f"{where}: {error}") from None
    return targets


def _records(path: Place) -> Any:
    try:
        return stores.read_json(path)
    except InputError as error:
        cause = error.__cause__
        odd = isinstance(cause, InputError)  # no regular file: reading it could never end
        if odd or not isinstance(cause, ValueError | RecursionError):
            raise
        text = path.read_bytes()[:4096].decode("utf-8", errors="replace")
        if _like_csv(text):
            raise InputError(f"{path} looks like CSV, but targets are given in JSON: {FORM}") from None
        line = f" at line {cause.lineno}" if isinstance(cause, json.JSONDecodeError) else ""
        raise InputError(f"{path} is not JSON{line}; give {FORM}") from None


def _like_csv(text: str) -> bool:
    """Whether all lines have the same number of separators, at least two columns, and nothing of JSON."""
    lines = [line for line in text.splitlines()[:20] if line.strip()]
    counts = {len(re.findall(r"[,;\t]", line)) for line in lines[:-1] or lines}
    return len(counts) == 1 and min(counts) >= 1 and not re.match(r"\s*[\[{]", text)


def _check_keys(record: Mapping[str, Any], where: str) -> None:
    for key in record:
        if key in KNOWN:
            continue
        close = difflib.get_close_matches(str(key).lower(), Target._fields, n=1)
        hint = f"did you mean {close[0]}?" if close else f"known are {', '.join(Target._fields)}"
        raise InputError(f"{where} has the unknown key {str(key)[:60]!r}; {hint}")
    if missing := [name for name in ("name", "x", "y") if name not in record]:
        raise InputError(f"{where} has no {' and no '.join(missing)}; give {FORM}")
