"""The notebooks of the gallery run from top to bottom, as a kernel would run them, and what they show is right."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import pytest
from repository import WORKFLOWS

NOTEBOOKS = sorted(path.stem for path in (WORKFLOWS / "gallery").glob("*.ipynb"))


class Executed(NamedTuple):
    """What the code cells show, as notebooks store it, and the namespace that they leave."""

    outputs: list[list[dict[str, Any]]]
    names: dict[str, Any]

    def text(self, kind: str = "text/html") -> str:
        """All that is shown of a kind; of printed text for "stdout"."""
        shown = [each for cell in self.outputs for each in cell]
        return "".join(line for each in shown for line in (
            each.get("text", []) if kind == "stdout" else each.get("data", {}).get(kind, [])
        ))  # fmt: skip

    @property
    def figures(self) -> int:
        return sum("image/png" in each.get("data", {}) for cell in self.outputs for each in cell)


@pytest.fixture(scope="module")
def runner() -> Iterator[ModuleType]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(WORKFLOWS))
        import run_notebooks

        yield run_notebooks


@pytest.fixture
def run(runner: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[str], Executed]:
    """Execute a notebook of the gallery, below a folder of the test's."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))

    def executed(name: str) -> Executed:
        try:
            return Executed(*runner.execute(runner.read(runner.GALLERY / f"{name}.ipynb")))
        except runner.NoData as missing:
            pytest.skip(f"{name} {missing}")

    return executed


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_is_stored_with_the_outputs_of_its_cells(name: str, runner: ModuleType) -> None:
    """By `run_notebooks.py`, which numbers the cells; a figure of each is there for the site."""
    notebook = runner.read(runner.GALLERY / f"{name}.ipynb")
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    assert notebook["nbformat"] == 4 and len({cell["id"] for cell in notebook["cells"]}) == len(notebook["cells"])
    stored = Executed([cell["outputs"] for cell in code], {})
    assert stored.figures >= 1
    assert "/tmp" not in stored.text("stdout")
    assert (runner.GALLERY / f"{name}.ipynb").stat().st_size < 200_000


@pytest.mark.slow
def test_the_first_notebook_leads_to_a_calibrated_image(run: Callable[[str], Executed]) -> None:
    executed = run("first_notebook")
    html = executed.text()
    for text in (
        "phase history",
        "predicted coherence at least",
        "memory (MiB)",
        "is finished in",
        "range PSLR",
        "image",
    ):
        assert text in html
    assert executed.figures == 3  # plan, image, cut
    assert "signal has shape (96, 600)" in executed.text("stdout")
    names = executed.names
    plan, folder = names["plan"], names["folder"]
    assert plan.refusal is None and plan.result.faithful
    assert plan.result.n_blocks == names["run"].result["plan"]["blocks"]
    assert (Path(folder) / "run" / "input.zarr").is_dir()
    measured = names["quality"].result["targets"]
    assert [target["name"] for target in measured] == ["A", "B", "C"]
    for target in measured:
        assert target["covered"] and target["value"][0] == pytest.approx(1, abs=0.02)
        assert target["azimuth_irw"] == pytest.approx(target["azimuth_irw_theory"], rel=0.02)


@pytest.mark.slow
def test_squint_tops_is_sharp_over_the_scan(run: Callable[[str], Executed]) -> None:
    names = run("squint_tops").names
    assert np.ptp(names["sweep"]) > 2 * 2.5  # PRFs, kHz
    assert len(names["targets"]) == 35 and names["plan"].result.n_blocks == 5
    assert names["width"] < 0.02 and names["place"] < 0.05 and names["phase"] < 0.05  # in clutter


@pytest.mark.slow
def test_the_spotlight_from_orbit_meets_the_quality_bar(run: Callable[[str], Executed]) -> None:
    names = run("spotlight_from_orbit").names
    assert len(names["targets"]) == 9
    assert names["place"] < 0.05 and names["phase"] < 0.05
    for each in names["targets"]:
        assert each["azimuth_irw"] == pytest.approx(each["azimuth_irw_theory"], rel=0.01)


@pytest.mark.slow
def test_alos_is_what_its_definition_says(run: Callable[[str], Executed]) -> None:
    names = run("alos_from_raw").names
    assert names["measured"] == pytest.approx(names["stated"], abs=30)  # Hz, of a beam 3 kHz wide
    assert names["reference"]["least_coherence"]["measured"] > 0.9999


@pytest.mark.slow
def test_autofocus_leaves_what_it_predicts(run: Callable[[str], Executed]) -> None:
    names = run("autofocus").names
    assert names["left"] > 5 and names["found"] < 0.05
    assert 0.4 < names["found"] / names["expected"] < 2.5


@pytest.mark.slow
def test_two_passes_differ_by_what_was_done(run: Callable[[str], Executed]) -> None:
    names = run("two_passes").names
    for measured, theory in names["phases"].values():
        assert measured == pytest.approx(theory, abs=0.05) and abs(theory) > 1
    assert names["coherence"] == pytest.approx(names["theory"], abs=0.02)
    change = names["pair"].change.values == 1
    away = np.abs(names["pair"].y.values[:, None] - 20 - 0.3 * names["pair"].x.values)  # m, from the strip's middle
    assert change[away < 4].mean() > 0.5 and change[away > 8].mean() < 0.03
