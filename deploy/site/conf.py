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
        Your data, CPHD, Gotcha <blocksar/readers/README>
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
        Scene files <blocksar/simulation/README>
        Stores <blocksar/stores/README>""",
    "Background": """
        Method and architecture <blocksar/README>
        Processors and calibration <blocksar/processors/README>
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
