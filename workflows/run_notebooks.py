"""Run the notebooks of the gallery from top to bottom, and store what their cells show.

    python workflows/run_notebooks.py
    python workflows/run_notebooks.py workflows/gallery/autofocus.ipynb

Each is executed as Jupyter would do it, in a namespace of its own, but without Jupyter: printed text, the table of a
last expression and every figure become outputs of its cell, and the notebook is written in place. Figures have few
colours, which keeps a notebook below 150 kB. A notebook whose measured data are not there, because the environment
variable BLOCKSAR_DATA does not name their folder, stays as it is.

The site shows the notebooks with these outputs. Run this after a change of a notebook.
"""

from __future__ import annotations

import ast
import base64
import contextlib
import io
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

GALLERY = Path(__file__).resolve().parent / "gallery"
COLOURS = 64  # of a stored picture
DPI = 72
Notebook = dict[str, Any]  # as JSON has it
Outputs = list[dict[str, Any]]


class NoData(Exception):
    """A notebook reads measured data that are not here; the sentence says what it needs."""


def notebooks() -> list[Path]:
    """The notebooks of the gallery, by name."""
    return sorted(GALLERY.glob("*.ipynb"))


def read(path: Path) -> Notebook:
    found: Notebook = json.loads(path.read_text(encoding="utf-8"))
    return found


def execute(notebook: Notebook) -> tuple[list[Outputs], dict[str, Any]]:
    """Run the code cells in one namespace; what each shows, as a notebook stores it, and the namespace.

    Raises
    ------
    NoData
        If the notebook needs measured data and BLOCKSAR_DATA does not name a folder that holds them.
    """
    import matplotlib as mpl

    mpl.use("agg")
    if (data := notebook["metadata"].get("blocksar_data")) and not Path(
        os.environ.get("BLOCKSAR_DATA", ""), data
    ).exists():
        raise NoData(f"needs the environment variable BLOCKSAR_DATA: a folder with {data}")
    names: dict[str, Any] = {"__name__": "__main__"}
    with _interactive():
        shown = [_run(source(cell), names) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    return shown, names


def source(cell: dict[str, Any]) -> str:
    return "".join(cell["source"])


@contextlib.contextmanager
def _interactive() -> Iterator[None]:
    """Set `sys.ps1` as in every kernel: it is how libraries know one."""
    before = getattr(sys, "ps1", None)
    sys.ps1 = "In : "
    try:
        yield
    finally:
        if before is None:
            del sys.ps1
        else:
            sys.ps1 = before


def _run(text: str, names: dict[str, Any]) -> Outputs:
    """Run all statements of a cell, of which a last expression is shown unless a semicolon ends it."""
    from matplotlib import pyplot

    tree, printed, value = ast.parse(text), io.StringIO(), None
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) and not text.rstrip().endswith(";") else None
    with contextlib.redirect_stdout(printed):
        exec(compile(tree, "cell", "exec"), names)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), "cell", "eval"), names)
    outputs: Outputs = []
    if printed.getvalue():
        outputs.append(
            {"output_type": "stream", "name": "stdout", "text": printed.getvalue().splitlines(keepends=True)}
        )
    if value is not None:
        data = {"text/plain": repr(value).splitlines(keepends=True)}
        if hasattr(value, "_repr_html_"):
            data["text/html"] = value._repr_html_().splitlines(keepends=True)
        outputs.append({"output_type": "display_data", "data": data, "metadata": {}})
    for number in pyplot.get_fignums():
        picture = base64.b64encode(_drawn(pyplot.figure(number))).decode()
        drawn: dict[str, Any] = {"image/png": picture, "text/plain": ["<Figure>"]}
        outputs.append({"output_type": "display_data", "data": drawn, "metadata": {}})
    pyplot.close("all")
    return outputs


def _drawn(figure: Any) -> bytes:
    """The figure as a PNG of few colours."""
    from PIL import Image

    full, small = io.BytesIO(), io.BytesIO()
    figure.savefig(full, format="png", dpi=DPI, bbox_inches="tight")
    Image.open(full).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(small, "png", optimize=True)
    return small.getvalue()


def stored(notebook: Notebook, shown: list[Outputs]) -> str:
    """The notebook's file with these outputs."""
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    for number, (cell, outputs) in enumerate(zip(code, shown, strict=True), 1):
        cell["execution_count"], cell["outputs"] = number, outputs
    return json.dumps(notebook, indent=1, ensure_ascii=False) + "\n"


def main(
    paths: Annotated[
        list[Path] | None, typer.Argument(metavar="[NOTEBOOK]...", help="Default: all of the gallery.")
    ] = None,
) -> None:
    """Run the notebooks of the gallery, and store what their cells show.

    Example: python workflows/run_notebooks.py workflows/gallery/autofocus.ipynb
    """
    for path in paths or notebooks():
        notebook = read(path)
        try:
            shown, _ = execute(notebook)
        except NoData as missing:
            print(f"{path.name}: skipped, it {missing}")
            continue
        path.write_text(stored(notebook, shown), encoding="utf-8")
        print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    typer.run(main)
