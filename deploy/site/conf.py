"""Settings of the documentation site: pages beside the code, notebooks as stored, the API reference from docstrings.

    sphinx-build -W -E -d build/doctrees -c deploy/site . build/site

The sources are those of the repository in their places, so that links between pages work on the site as they do there.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined
from sphinx.application import Sphinx

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))  # the package is that of this repository, whatever is installed

FOLDERS = ("blocksar", "workflows", "deploy", "tests")
GALLERY = "workflows/gallery/"
PAGES = "deploy/site/pages/"  # of what has no place beside code

# The order of the pages, stated here and nowhere else. A page that it lacks fails the build.
ORDER = {
    "Use": """
        Command line <blocksar/cli/README>
        Python <blocksar/api/README>
        Your data, CPHD, Gotcha <blocksar/ingestion/README>
        Planning <blocksar/planning/README>
        Runs <blocksar/runs/README>
        Products <blocksar/products/README>
        Progress <blocksar/progress/README>
        Motion from the data <blocksar/autofocusing/README>
        Clusters <blocksar/graph/README>
        Workflows <workflows/README>""",
    "Gallery": """
        Overview <workflows/gallery/README>
        From arrays to an image <workflows/gallery/first_notebook>
        Squint TOPS <workflows/gallery/squint_tops>
        Spotlight from orbit <workflows/gallery/spotlight_from_orbit>
        ALOS from raw <workflows/gallery/alos_from_raw>
        Autofocus <workflows/gallery/autofocus>
        Two passes compared <workflows/gallery/two_passes>""",
    "Reference": """
        Python <deploy/site/pages/reference>
        Scene files <deploy/site/pages/scene-files>
        Stores <blocksar/stores/README>""",
    "Background": """
        Method and architecture <blocksar/README>
        Processors and calibration <blocksar/focusing/README>
        Cost against error <workflows/benchmarks/README>""",
    "Deployment": """
        Overview <deploy/README>
        systemd <deploy/systemd/README>
        cron <deploy/cron/README>
        Containers <deploy/container/README>
        Kubernetes <deploy/kubernetes/README>
        Slurm <deploy/slurm/README>""",
    "Project": """
        Extend blocksar <tests/helpers/extension/README>
        Contributing <tests/README>
        This site <deploy/site/README>
        Changelog <CHANGELOG>""",
}

project = "blocksar"
root_doc = "README"
extensions = ["myst_parser", "numpydoc", "sphinx.ext.autodoc"]
autosummary_generate = False
source_suffix = dict.fromkeys((".md", ".ipynb"), "markdown")
include_patterns = ["README.md", "CHANGELOG.md", f"{GALLERY}*.ipynb", f"{PAGES}*.md"]
include_patterns += [f"{folder}/**README.md" for folder in FOLDERS]
exclude_patterns = [path.name for path in ROOT.iterdir() if path.is_dir() and path.name not in FOLDERS]
nitpicky = True
smartquotes = False  # which would change quotes and dashes of options in text

myst_heading_anchors = 6
default_role = "code"  # docstrings have code in single backticks
autodoc_typehints = "none"  # docstrings say them in words
autodoc_member_order = "bysource"
numpydoc_show_class_members = False
numpydoc_validation_checks = {"PR02", "PR04", "PR07"}  # parameters: unknown, without a type, without a meaning
toc_object_entries_show_parents = "hide"

html_theme = "pydata_sphinx_theme"
html_title = project
html_static_path = ["pages/site.css", "pages/copy.js"]
html_css_files = ["site.css"]
html_js_files = ["copy.js"]
html_extra_path = ["pages/index.html"]
templates_path = ["pages"]
html_sidebars = {"**": ["order.html"]}
html_theme_options = {
    "navbar_center": [],
    "footer_start": [],
    "footer_end": [],
    "secondary_sidebar_items": ["page-toc"],
    "show_toc_level": 2,
}
html_copy_source = False


def setup(app: Sphinx) -> None:
    """Connect what completes pages as they are read."""
    app.connect("source-read", complete)


def complete(_: Sphinx, page: str, source: list[str]) -> None:
    """Turn a notebook into Markdown, and add what pages leave to the site: order, tables, pictures of notebooks."""
    if page == root_doc:
        for part, pages in ORDER.items():
            source[0] += f"\n```{{toctree}}\n:hidden:\n:caption: {part}\n{pages}\n```\n"
    elif page == f"{PAGES}scene-files":
        source[0] += scene_tables()
    elif page == f"{GALLERY}README":
        source[0] = re.sub(r"^## .*\]\((\w+\.ipynb)\)$", with_picture, source[0], flags=re.M)
    elif page.startswith(GALLERY):
        source[0] = "\n\n".join(cells(source[0]))


def with_picture(heading: re.Match[str]) -> str:
    """A heading that links to a notebook, and its last picture."""
    notebook = (ROOT / GALLERY / heading[1]).read_text(encoding="utf-8")
    return "\n\n".join([heading[0], *[part for part in cells(notebook) if part.startswith("![")][-1:]])


def cells(notebook: str) -> Iterator[str]:
    """Yield the cells of a notebook and their stored outputs as Markdown."""
    for cell in json.loads(notebook)["cells"]:
        text = "".join(cell["source"])
        yield text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```"
        for output in cell.get("outputs", []):
            shown = output.get("data", {"text/plain": output.get("text", [])})
            if "image/png" in shown:
                picture = "".join("".join(shown["image/png"]).split())
                yield f"![what the cell draws](data:image/png;base64,{picture})"
            elif "text/html" in shown:
                yield f"````{{raw}} html\n{''.join(shown['text/html'])}\n````"
            else:
                yield f"```text\n{''.join(shown['text/plain'])}\n```"


def scene_tables() -> str:
    """The shipped scenes, and the tables and keys of a scene file from the model that checks them."""
    from blocksar.simulation import shipped_scenes
    from blocksar.simulation.scene import Scene

    tables = list(tables_of(Scene))
    parts = ["", f"Shipped scenes: {', '.join(f'`{name}`' for name in shipped_scenes())}. The tables:", ""]
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
