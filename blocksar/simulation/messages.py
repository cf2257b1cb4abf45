"""Messages about errors in a scene file: the field, the value, the remedy, and the nearest known key."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterator
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from blocksar.simulation.tables import LARGEST, SMALLEST
from blocksar.texts import count


def message_of(label: str, problems: list[str]) -> str:
    """Join problems into one message; `label` names the scene file."""
    return f"{label} has {count(len(problems), 'wrong field')}:" + "".join(f"\n  {problem}" for problem in problems)


def describe_error(error: ValidationError, data: dict[str, Any], label: str, root: type[BaseModel]) -> str:
    """List every wrong field as `field = value: remedy`; alternative remedies are joined by 'or'."""
    remedies: dict[str, list[str]] = {}  # by wrong field
    hints: dict[str, str] = {}
    for item in error.errors(include_url=False):
        place, model = _locate(item["loc"], data, root)
        field, value = _dotted(place), _short(item["input"])
        text = item["msg"].replace("Input should be", "must be").removeprefix("Value error, ")
        match item["type"]:
            case "missing" if isinstance(item["loc"][-1], str):
                remedies[f"{field} is missing"] = [f"add {_hint(model, place)}"]
            case "extra_forbidden":
                remedies[f"{field} = {value}"] = [f"unknown key; {_nearest(model, place)}"]
            case "value_error":
                # Messages about a whole table begin with the wrong field, if there is one.
                known = _fields(_table_at(place, root))
                first_word = re.split(r"[^a-z_0-9]", text)[0]
                remedies[f"{field}.{text}" if first_word in known else f"{field}: {text}"] = []
            case kind:
                text = "has too few elements" if kind == "missing" else text.replace("valid tuple", "list")
                remedies.setdefault(f"{field} = {value}", []).append(text[0].lower() + text[1:])
                hints[f"{field} = {value}"] = _hint(model, place)
    problems = []
    for head, alternatives in remedies.items():
        remedy = " or ".join(dict.fromkeys(alternatives))
        problems.append(": ".join(filter(None, (head, remedy))) + (f" ({hints[head]})" if head in hints else ""))
    return message_of(label, problems)


def _locate(
    loc: tuple[int | str, ...], data: Any, root: type[BaseModel]
) -> tuple[list[int | str], type[BaseModel] | None]:
    """Return the part of pydantic's location that exists in the file, and the table that contains it."""
    place: list[int | str] = []
    model: type[BaseModel] | None = root
    here: Any = data
    for i, part in enumerate(loc):
        last = i == len(loc) - 1
        inside = part in here if isinstance(here, dict) else isinstance(here, list) and part in range(len(here))
        if inside:
            here = here[part]
        elif not (last and isinstance(here, dict)) or "[" in str(part):
            continue  # the name of an alternative in a union
        place.append(part)
        if not last and isinstance(part, str) and model is not None:
            # In a table inside a table, its own keys; a table of any keys (names of targets) stays its parent's.
            inner = _tables(model).get(part)
            model = inner if model is root or inner is not None else model
    return place, model


def _table_at(place: list[int | str], root: type[BaseModel]) -> type[BaseModel] | None:
    """Return the table that a place names."""
    model: type[BaseModel] | None = root
    for part in place:
        if isinstance(part, str) and model is not None:
            model = _tables(model).get(part)
    return model


def _tables(root: type[BaseModel]) -> dict[str, type[BaseModel]]:
    """Return the tables of a scene file by key."""
    tables = {(field.alias or name): _models_in(field.annotation) for name, field in root.model_fields.items()}
    return {key: models[0] for key, models in tables.items() if models}


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    """List the tables in an annotation, which may be optional or a list of tables."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models_in(part)]


def _fields(model: type[BaseModel] | None) -> dict[str, str]:
    """Return the keys of a table and their descriptions."""
    if model is None:
        return {}
    return {field.alias or name: field.description or "" for name, field in model.model_fields.items()}


def _hint(model: type[BaseModel] | None, place: list[int | str]) -> str:
    fields = _fields(model)
    return next((fields[part] for part in reversed(place) if isinstance(part, str) and part in fields), "it")


def _nearest(model: type[BaseModel] | None, place: list[int | str]) -> str:
    known = list(_fields(model))
    close = difflib.get_close_matches(str(place[-1]), known, n=1)
    return f"did you mean {close[0]}?" if close else f"known here are {', '.join(known)}"


def impossible_values(value: Any, place: tuple[int | str, ...] = ()) -> Iterator[str]:
    """Report numbers that are too large or too small for any unit."""
    match value:
        case dict():
            for key, item in value.items():
                yield from impossible_values(item, (*place, key))
        case list():
            for index, item in enumerate(value):
                yield from impossible_values(item, (*place, index))
        case int() | float() if value and not SMALLEST <= abs(value) <= LARGEST and math.isfinite(value):
            yield f"{_dotted([*place])} = {_short(value)}: must lie between {SMALLEST:g} and {LARGEST:g} in size"


def _dotted(place: list[int | str]) -> str:
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place)
    return text.removeprefix(".")


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
