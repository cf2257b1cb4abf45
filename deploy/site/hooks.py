"""Gather the pages of the site: README.md pages beside the code, notebooks as stored, and scene files from their model.

MkDocs calls `on_files` and `on_page_markdown`. Pages keep their paths in the repository, so that their links work on
the site as they do there.
"""

from __future__ import annotations

import base64
import json
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))  # scene files are those of this repository, whatever is installed

FOLDERS = ("blocksar", "workflows", "deploy", "tests")
ALSO = ("README.md", "CHANGELOG.md", "LICENSE")
GALLERY = "workflows/gallery"
PAGES = ("README.md", ".png")  # ends of the names of files that are gathered


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages of the repository to those in `pages/`."""
    for path in gathered():
        name = path.relative_to(ROOT).as_posix()
        files.append(File.generated(config, name, abs_src_path=str(path)))
    for path in sorted((ROOT / GALLERY).glob("*.ipynb")):
        text, pictures = notebook(path)
        files.append(File.generated(config, f"{GALLERY}/{path.stem}.md", content=text))
        for name, picture in pictures.items():
            files.append(File.generated(config, f"{GALLERY}/{name}", content=picture))
    files.append(File.generated(config, "scene-files.md", content=scene_files()))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    r"""Write for this site what GitHub needs otherwise.

    `a\|b` in code, for tables, which Python-Markdown would show with its backslash; links to notebooks, each of which
    is a page here, and whose last picture follows a heading that links to it.
    """
    markdown = re.sub(
        r"^(## .*\]\((\w+)\.ipynb\))$", r"\1\n\n![last picture of the notebook](\2.png)", markdown, flags=re.M
    )
    markdown = re.sub(r"\]\(([\w/.]+)\.ipynb\)", r"](\1.md)", markdown)
    return re.sub(r"`[^`\n]*`", lambda span: span[0].replace(r"\|", "|"), markdown)


def gathered() -> Iterator[Path]:
    """Pages and pictures of the repository."""
    yield from (ROOT / name for name in ALSO)
    for folder in FOLDERS:
        for root, folders, names in os.walk(ROOT / folder):
            folders[:] = sorted(name for name in folders if not name.startswith((".", "__")))
            yield from (Path(root, name) for name in sorted(names) if name.endswith(PAGES))


def notebook(path: Path) -> tuple[str, dict[str, bytes]]:
    """A notebook as a page with its stored outputs, and the pictures by their names; the last has the notebook's."""
    parts: list[str] = []
    drawn: list[bytes] = []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        text = "".join(cell["source"])
        parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
        for output in cell.get("outputs", []):
            shown = output.get("data", {"text/plain": output.get("text", [])})
            if "image/png" in shown:
                drawn.append(base64.b64decode(shown["image/png"]))
                parts.append(f"![what the cell draws]({path.stem}-{len(drawn)}.png)")
            elif "text/html" in shown:
                parts.append("".join(shown["text/html"]))
            else:
                parts.append(f"```text\n{''.join(shown['text/plain'])}\n```")
    pictures = {f"{path.stem}-{number}.png": picture for number, picture in enumerate(drawn, 1)}
    return "\n\n".join(parts) + "\n", pictures | {f"{path.stem}.png": picture for picture in drawn}


def scene_files() -> str:
    """The page of the scene file's tables and keys, from the model that checks them."""
    from blocksar.simulation import shipped_scenes
    from blocksar.simulation.scene import Scene

    parts = [INTRODUCTION.format(shipped=", ".join(f"`{name}`" for name in shipped_scenes()))]
    tables = list(tables_of(Scene))
    parts += ["| table | contents | needed |", "|---|---|---|"]
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


INTRODUCTION = """\
# Scene files

A scene file (TOML) describes the radar, the track, the beam, the targets and disturbances of a simulated collection.
`blocksar simulate` and `blocksar plan` read it. Keys that end in `_deg` are in degrees; everything else is in SI units.
Unknown keys are refused. Shipped scenes: {shipped}.

`title` is one line about the scene. The tables:
"""


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
