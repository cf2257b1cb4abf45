"""The tables of the page about scene files, made from the models that check them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from blocksar.simulation.scene import Scene


def scene_tables() -> str:
    """The tables and keys of a scene file, from the model that checks them, in Markdown."""
    tables = list(tables_of(Scene))
    parts = ["| table | contents | needed |", "|---|---|---|"]
    parts += [f"| `{key}` | {field.description} | {'yes' if field.is_required() else ''} |" for key, field, _ in tables]
    for key, field, model in tables:
        parts += ["", f"## {key.strip('[]')}", "", f"`{key}`: {field.description}.", ""]
        parts += ["| key | type | default | meaning |", "|---|---|---|---|"]
        own = {name: key_field for name, key_field in model.model_fields.items() if not model_of(key_field.annotation)}
        parts += [key_row(name, key_field) for name, key_field in own.items()]
    return "\n".join(parts) + "\n"


def tables_of(model: type[BaseModel], within: str = "") -> Iterator[tuple[str, FieldInfo, type[BaseModel]]]:
    """Tables of a model with their keys in brackets, each before those that it contains."""
    for name, field in model.model_fields.items():
        if (inner := model_of(field.annotation)) is not None:
            key = f"{within}{field.alias or name}"
            yield f"[[{key}]]" if "tuple" in str(field.annotation) else f"[{key}]", field, inner
            yield from tables_of(inner, f"{key}.")


def model_of(annotation: Any) -> type[BaseModel] | None:
    """The table of a field: a model, an optional one, or a tuple of them."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((model for part in get_args(annotation) if (model := model_of(part)) is not None), None)


def key_row(name: str, field: FieldInfo) -> str:
    """One row of a table of keys."""
    default = "needed" if field.default is PydanticUndefined else "" if field.default is None else f"`{field.default}`"
    description = (field.description or "").replace("|", r"\|")
    return f"| `{name}` | {kind(field.annotation)} | {default} | {description} |"


def kind(annotation: Any) -> str:
    """A type in words of TOML."""
    words = {float: "number", int: "integer", str: "text", bool: "true or false", type(None): ""}
    if annotation in words:
        return words[annotation]
    if getattr(annotation, "__name__", "") == "tuple":
        parts = [kind(part) for part in get_args(annotation) if part is not Ellipsis]
        if len(parts) > 1:
            return f"list of {len(parts)} {parts[0]}s"
        return f"list of {parts[0].replace('list', 'lists', 1)}"
    if getattr(annotation, "__name__", "") == "dict":
        return "table"
    parts = [kind(part) if not isinstance(part, str) else f'"{part}"' for part in get_args(annotation)]
    return " or ".join(dict.fromkeys(part for part in parts if part))
