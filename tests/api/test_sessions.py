"""What a session of Python shows: reprs, HTML, pictures, and progress below a notebook's cell."""

from __future__ import annotations

import sys
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
import xarray as xr
from arrays import arrays
from matplotlib import pyplot
from matplotlib.patches import Polygon

import blocksar
from blocksar.application.reports import html_report, text_table
from blocksar.application.shown import PlanReport, RunReport
from blocksar.errors import InputError, in_python
from blocksar.progress import Listener, as_listener
from blocksar.texts import digits

GRID = ((-45.0, 45.0, 0.5), (-25.0, 25.0, 0.5))


@pytest.fixture(autouse=True)
def _no_windows(monkeypatch: pytest.MonkeyPatch) -> Any:
    mpl.use("agg")
    yield
    pyplot.close("all")


@pytest.fixture(scope="module")
def dataset() -> xr.Dataset:
    return blocksar.collection(**arrays())


@pytest.fixture(scope="module")
def plan(dataset: xr.Dataset) -> PlanReport:
    return blocksar.plan(dataset, processor="angular-division")


@pytest.fixture(scope="module")
def run(dataset: xr.Dataset, tmp_path_factory: pytest.TempPathFactory) -> RunReport:
    folder = tmp_path_factory.mktemp("run") / "run"
    return blocksar.focus(dataset, folder, grid=GRID, workers=0, processor="angular-division")


class Tags(HTMLParser):
    """Checks that tags are closed in order, and collects the text."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: list[str] = []
        self.text = ""
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.open.append(tag)
        self.seen.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data + " "


# ---------------------------------------------------------------- reprs


def test_a_printed_report_is_its_table_and_its_sentences(plan: PlanReport) -> None:
    lines = str(plan).splitlines()
    header, rows = plan.tables[0]
    assert lines[0].split() == " ".join(header).split()
    assert [line.split()[0] for line in lines[1 : len(rows) + 1]] == [row[0] for row in rows]
    assert str(plan).endswith(in_python("\n".join(plan.summary)))


def test_a_plan_shows_coherence_memory_and_disk(plan: PlanReport) -> None:
    page = Tags(plan._repr_html_())
    assert f"predicted coherence at least {plan.result.coherence:.6f}" in page.text
    for block in plan.result.blocks:
        assert f" {digits(block.prediction.coherence)} " in page.text  # with more digits the closer it is to 1
    assert "memory (MiB)" in page.text and "MiB on the disk" in page.text
    assert page.seen.count("details") == 2  # all figures, definitions


def test_a_refused_plan_says_so_first(dataset: xr.Dataset) -> None:
    refused = PlanReport(refusal="the PRF is too low", summary=["5 blocks"])
    assert repr(refused) == "<PlanReport: refused: the PRF is too low>"
    with pytest.raises(InputError, match=r"there is no plan to draw \(refused: the PRF is too low\); plan with other"):
        refused.plot()


def test_html_is_escaped() -> None:
    html = html_report("a < b", [(("<i>",), [("<script>",)])], ["x & y"], [(("d",), [("1",)])], ["<b>"])
    page = Tags(html)
    assert not {"i", "script", "b"} & set(page.seen)
    assert "<script>" in page.text and "x & y" in page.text


def test_figures_are_aligned_on_the_right() -> None:
    table = (("target", "PSLR"), [("A", "-13.26"), ("long name", "-9.1")])
    assert text_table(table).splitlines() == ["target       PSLR", "A          -13.26", "long name    -9.1"]


# ---------------------------------------------------------------- pictures


def test_the_picture_of_a_plan_shows_every_block_where_it_lies(plan: PlanReport) -> None:
    axes = plan.plot()
    outlines = [patch.get_xy() for patch in axes.patches if isinstance(patch, Polygon)]
    assert len(outlines) == len(plan.result.blocks)
    geometry = plan.geometry
    assert geometry is not None
    for outline, block in zip(outlines, plan.result.blocks, strict=True):
        yaw = geometry.yaw(outline[:, 0], outline[:, 1])
        assert yaw.min() == pytest.approx(block.low) and yaw.max() == pytest.approx(block.high)
        distance = geometry.epoch_range(outline[:, 0], outline[:, 1])
        assert block.ground.near - 1e-6 <= distance.min() and distance.max() <= block.ground.far + 1e-6
    names = [text.get_text().split("\n")[0] for text in axes.texts]
    assert names == [block.name for block in plan.result.blocks]
    assert len(axes.figure.axes) == 2  # the track from above, too


def test_a_picture_of_a_plan_goes_where_it_is_told(plan: PlanReport) -> None:
    axes = pyplot.figure().add_subplot()
    assert plan.plot(axes) is axes and len(axes.figure.axes) == 1


def test_back_projection_has_a_picture_too(dataset: xr.Dataset) -> None:
    axes = blocksar.plan(dataset, processor="backprojection", grid=GRID).plot()
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["image, 180 x 100 pixels"]


def test_the_picture_of_a_run_is_its_image(run: RunReport) -> None:
    assert run.plot().get_title() == "three targets"
    drawn = run.plot().images[0].get_array()
    assert drawn.shape == (100, 180)
    image = run.open()["image"].values
    np.testing.assert_allclose(drawn.compressed(), 20 * np.log10(abs(image[np.isfinite(image)])), atol=0.01)


def test_a_rehearsal_has_no_image(dataset: xr.Dataset, tmp_path: Path) -> None:
    report = blocksar.focus(dataset, tmp_path / "run", grid=GRID, workers=0, dry_run=True)
    assert not (tmp_path / "run").exists()
    with pytest.raises(InputError, match=r"nothing was focused in this call"):
        report.plot()


# ---------------------------------------------------------------- progress in a notebook


class Cell:
    """Stands for IPython in a kernel: it keeps what was displayed, and how often it was drawn again."""

    def __init__(self) -> None:
        self.shown: list[str] = []
        self.display = SimpleNamespace(HTML=str, display=self.show)

    def get_ipython(self) -> Any:
        return SimpleNamespace(kernel=object())

    def show(self, content: str, display_id: bool) -> Any:
        assert display_id and not self.shown  # later ones are drawn in its place
        self.shown.append(content)
        return SimpleNamespace(update=self.shown.append)


@pytest.fixture
def cell(monkeypatch: pytest.MonkeyPatch) -> Cell:
    cell = Cell()
    monkeypatch.setitem(sys.modules, "IPython", cell)
    monkeypatch.setitem(sys.modules, "IPython.display", cell.display)
    return cell


def test_a_notebook_shows_bars(cell: Cell, dataset: xr.Dataset, tmp_path: Path) -> None:
    blocksar.focus(dataset, tmp_path / "run", grid=GRID, workers=0)
    last = Tags(cell.shown[-1])
    assert all(f"{stage} " in last.text for stage in ("plan", "inspect", "hierarchical-backprojection", "finish"))
    assert last.seen.count("progress") >= 4 and "elapsed" in last.text
    assert 5 <= len(cell.shown) < 60


@pytest.mark.slow
def test_a_notebook_is_silent_on_request(cell: Cell, dataset: xr.Dataset, tmp_path: Path) -> None:
    blocksar.focus(dataset, tmp_path / "run", grid=GRID, workers=0, progress=False)
    assert cell.shown == []


def test_notes_are_shown_once(cell: Cell) -> None:
    listener = as_listener(None)
    listener.note("the disk is <slow>")
    listener.note("it is repeated", again=True)
    listener.update("focus", 1, 2)
    assert "note: the disk is &lt;slow&gt;" in cell.shown[-1] and "repeated" not in cell.shown[-1]


def test_elsewhere_nothing_is_shown() -> None:
    assert type(as_listener(None)) is Listener and type(as_listener(False)) is Listener
