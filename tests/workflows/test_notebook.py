"""The notebook runs from top to bottom, as a kernel would run it, and shows what it promises."""

from __future__ import annotations

import ast
import contextlib
import io
import json
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import pytest
from matplotlib import pyplot
from repository import WORKFLOWS

NOTEBOOK = json.loads((WORKFLOWS / "first_notebook.ipynb").read_text(encoding="utf-8"))


class Shown(NamedTuple):
    """What a cell shows: printed text, the HTML of its last expression, and the number of new figures."""

    printed: str
    html: str
    figures: int


def execute(source: str, names: dict[str, Any]) -> Shown:
    """Run a cell as a kernel does: all statements, of which a last expression is shown unless a semicolon ends it."""
    tree, printed, value = ast.parse(source), io.StringIO(), None
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) and not source.rstrip().endswith(";") else None
    with contextlib.redirect_stdout(printed):
        exec(compile(tree, "cell", "exec"), names)
        if last is not None:
            value = eval(compile(ast.Expression(last.value), "cell", "eval"), names)  # type: ignore[attr-defined]
    html = value._repr_html_() if hasattr(value, "_repr_html_") else ""
    figures = len(pyplot.get_fignums())
    pyplot.close("all")
    return Shown(printed.getvalue(), html, figures)


@pytest.fixture(scope="module")
def executed(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Shown], dict[str, Any]]:
    names: dict[str, Any] = {"__name__": "__main__"}
    with pytest.MonkeyPatch.context() as patch:
        mpl.use("agg")
        patch.setattr("sys.ps1", "In : ", raising=False)  # as in every kernel
        patch.setattr("tempfile.tempdir", str(tmp_path_factory.mktemp("notebook")))
        shown = [execute("".join(cell["source"]), names) for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code"]
    return shown, names


def test_the_notebook_is_committed_without_outputs() -> None:
    code = [cell for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code"]
    assert code and not any(cell["outputs"] or cell["execution_count"] for cell in code)
    assert NOTEBOOK["nbformat"] == 4 and len({cell["id"] for cell in NOTEBOOK["cells"]}) == len(NOTEBOOK["cells"])


def test_the_notebook_shows_plan_image_and_quality(executed: tuple[list[Shown], dict[str, Any]]) -> None:
    shown, _ = executed
    html = " ".join(cell.html for cell in shown)
    for text in (
        "phase history",
        "predicted coherence at least",
        "memory (MiB)",
        "is finished in",
        "range PSLR",
        "image",
    ):
        assert text in html
    assert sum(cell.figures for cell in shown) == 3  # plan, image, cut
    assert any(cell.printed.startswith("signal has shape (96, 600)") for cell in shown)


def test_the_notebook_leads_to_a_calibrated_image(executed: tuple[list[Shown], dict[str, Any]]) -> None:
    _, names = executed
    plan, folder = names["plan"], names["folder"]
    assert plan.refusal is None and plan.result.faithful
    assert plan.result.n_blocks == names["run"].result["plan"]["blocks"]
    assert (Path(folder) / "run" / "input.zarr").is_dir()
    measured = names["quality"].result["targets"]
    assert [target["name"] for target in measured] == ["A", "B", "C"]
    for target in measured:
        assert target["covered"] and target["value"][0] == pytest.approx(1, abs=0.02)
        assert target["azimuth_irw"] == pytest.approx(target["azimuth_irw_theory"], rel=0.02)
