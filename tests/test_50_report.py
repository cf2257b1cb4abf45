"""The report page: what it says is what is known of the run, nothing in it can run but its own script, and the controls
do in a real browser what they say.

The browser is whatever Chromium BLOCKSAR_CHROMIUM or the path names; without one the tests that need it are skipped.
"""

from __future__ import annotations

import base64
import errno
import hashlib
import io
import json
import os
import re
import shlex
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import s3
from matplotlib.image import imread
from scenes import scene
from typer.testing import CliRunner

import blocksar
from blocksar import api, constants, stores
from blocksar.api import focusing
from blocksar.cli import commands, endings
from blocksar.collection.geometry import Geometry
from blocksar.errors import InputError, ProcessingError
from blocksar.focusing import method
from blocksar.graph.cluster import open_client
from blocksar.measurement.targets import Target
from blocksar.places import place
from blocksar.planning.plan import plan_collection
from blocksar.products.page import facts, page, picture, provenance, tables, words
from blocksar.runs.finished import Source, open_run

HOSTILE = "</title></script><script>window.pwned = 1</script><img src=x onerror=window.pwned=1> & \u202e{{ 7 * 7 }}"
TARGETS = {"A": (29900.0, 48.5), "B": (30100.0, 51.5), "seam": (30000.0, 50.2), "<i>D": (29950.0, 50.0)}
EDGE = {"edge": (30000.0, 43.5)}  # lit by a part of the beam's sweep only, and outside the image
VOID = ["area", "base", "br", "col", "embed", "hr", "img", "input", "link", "meta", "source", "track", "wbr"]


def write_scene(folder: Path) -> Path:
    """A part of Table 1's scene, with a title that is markup."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = [f"[[targets]]\nname = '{n}'\nrange = {r}\nyaw_deg = {y}\n" for n, (r, y) in (TARGETS | EDGE).items()]
    text = scene(swath=[29850.0, 30150.0], more="\n".join(rows))
    (folder / "scene.toml").write_text(text.replace('title = "test"', f"title = {json.dumps(HOSTILE)}"))
    return Path(blocksar.simulate(folder / "scene.toml", folder / "ph.zarr", threads=1))


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Path]]:
    """A run of two blocks of two range sub-blocks each, and one of exact back-projection, too coarse to measure in."""
    folder = tmp_path_factory.mktemp("report")
    store = write_scene(folder)
    with pytest.MonkeyPatch.context() as patch, open_client(workers=1, threads=1, memory_limit=3 * 2**30) as client:
        patch.setattr(focusing, "plan_collection", lambda *a, **k: plan_collection(*a, **{**k, "parts": 2}))
        wide = ((15000.0, 17200.0, 1.2), (18000.0, 20400.0, 1.2))
        blocksar.focus(store, folder / "run", blocks=2, grid=wide, client=client)
        coarse = ((16000.0, 16400.0, 4.0), (19100.0, 19500.0, 4.0))
        blocksar.focus(store, folder / "exact", processor="backprojection", grid=coarse, client=client)
    blocksar.quality(folder / "run")
    yield {"run": folder / "run", "exact": folder / "exact"}


@pytest.fixture(scope="module")
def whole(runs: dict[str, Path]) -> Path:
    """The page of the first, as anybody gets it."""
    return Path(str(blocksar.report(runs["run"]).result))


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """No pictures of responses: most of a page's time."""
    monkeypatch.setattr(page, "draw_responses", lambda *_: [])


@pytest.fixture
def run(runs: dict[str, Path], tmp_path: Path) -> Path:
    """A run whose records may be changed; its image is not copied."""
    return borrowed(runs["run"], tmp_path / "run")


def borrowed(run: Path, folder: Path) -> Path:
    folder.mkdir()
    for name in ("run.json", "quality.json"):
        if (run / name).exists():
            shutil.copy(run / name, folder / name)
    shutil.copytree(run / "collection.zarr", folder / "collection.zarr")
    (folder / "image.zarr").symlink_to(run / "image.zarr")
    return folder


def changed(path: Path, change: Callable[[Any], None]) -> None:
    record = json.loads(path.read_text())
    change(record)
    path.write_text(json.dumps(record))


def source_of(run: Path) -> Source:
    image, collection, attrs, record = open_run(place(run))
    return Source(image.path, image.x, image.y, Geometry(collection=collection), attrs, record)


class Reading(HTMLParser):
    """Elements with their attributes, and the text of each, in order; refuses tags that do not match."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.texts: list[tuple[str, str]] = []
        self._open: list[str] = []
        self.feed(text)
        self.close()
        assert not self._open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append((self._open[-1] if self._open else "", data))

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attrs for name, attrs in self.elements if name == tag]

    def text(self, tag: str = "") -> str:
        words = (
            text for inside, text in self.texts if inside == tag or (not tag and inside not in ("script", "style"))
        )
        return " ".join(" ".join(words).split())


def read(path: Any) -> Reading:
    return Reading(Path(str(path)).read_text(encoding="utf-8"))


# ---------------------------------------------------------------- what the page is


def test_the_page_stands_by_itself(whole: Path) -> None:
    text = whole.read_text(encoding="utf-8")
    found = read(whole)
    assert len(text) < 5e6
    links = [value for _, attrs in found.elements for name, value in attrs.items() if name in ("src", "href")]
    assert links and all(link.startswith(("data:image/", "#")) for link in links)
    assert "@import" not in text and "@font-face" not in text and not re.search(r"url\((?!#)", text)
    anchors = {attrs.get("id") for _, attrs in found.elements}
    assert {link[1:] for link in links if link.startswith("#")} <= anchors
    ids = [attrs["id"] for _, attrs in found.elements if "id" in attrs]
    assert len(ids) == len(set(ids))


def test_only_its_own_script_and_style_may_run(whole: Path) -> None:
    found = read(whole)
    policy = found.all("meta")[1]["content"]
    assert policy.startswith("default-src 'none'; img-src data:;") and "unsafe" not in policy
    assert len(found.all("script")) == len(found.all("style")) == 1
    for kind in ("script", "style"):
        inside = next(text for tag, text in found.texts if tag == kind)
        assert base64.b64encode(hashlib.sha256(inside.encode()).digest()).decode() in policy
    assert not [attrs for _, attrs in found.elements if any(name == "style" or name.startswith("on") for name in attrs)]


def test_what_comes_from_files_is_text(whole: Path) -> None:
    found = read(whole)
    heading = found.text("h1")
    assert heading == HOSTILE.replace("\u202e", "\\u202e")  # what would turn the text around is shown as an escape
    assert found.text("title").startswith(heading)
    assert not [attrs for attrs in found.all("img") if not attrs["src"].startswith("data:image/png")]
    assert not found.all("i") and "<i>D" in found.text("a")
    assert "49" not in heading


def test_twice_is_the_same_and_missing_measurements_are_made(run: Path, runs: dict[str, Path], quick: None) -> None:
    first = Path(str(blocksar.report(run).result)).read_bytes()
    (run / "quality.json").unlink()
    report = blocksar.report(run)
    assert report.result.path.read_bytes() == first
    assert not (run / "quality.json").exists()  # a report looks, and changes nothing
    assert report.summary[-1] == f"wrote {run / 'report.html'}"


def test_the_picture_is_the_image(runs: dict[str, Path]) -> None:
    source = source_of(runs["run"])
    made = picture.draw(source, looks="max")
    decoded = imread(io.BytesIO(base64.b64decode(made.data.partition(",")[2])), format="webp")
    factor = -(-max(source.x.size, source.y.size) // picture.PIXELS)
    assert factor > 1  # else nothing is decimated here
    whole = (slice(0, source.y.size), slice(0, source.x.size))
    power = np.abs(source.read(*whole)).astype(np.float64) ** 2
    rng = np.random.default_rng(0)
    covered = np.argwhere(np.isfinite(power))[:: power.size // 1000]
    for row, column in [*covered, *rng.integers(0, power.shape, (200, 2))]:
        i, j = row // factor, column // factor
        cell = power[i * factor : (i + 1) * factor, j * factor : (j + 1) * factor]
        level, _, _, there = decoded[decoded.shape[0] - 1 - i, j]
        assert (there == 255) == bool(np.isfinite(cell).any())
        if there:
            said = made.bottom + level / 255 * (made.top - made.bottom)
            true = max(10 * np.log10(max(np.nanmax(cell), 1e-30)), made.bottom)
            assert said == pytest.approx(true, abs=0.51 * (made.top - made.bottom) / 255)
    x, y = made.place(source.x[0], source.y[-1])  # upper left pixel of a picture whose rows go down
    assert float(x) == pytest.approx(-made.width / 2 + source.spacing[0] / 2, abs=1e-3)
    assert float(y) >= -made.height / 2


class Wide(Source):
    """A scene of 80 million pixels that is nowhere; keeps what was read at once."""

    sizes: list[int] = []  # noqa: RUF012  (one test uses it)

    def read(self, rows: slice, columns: slice) -> Any:
        self.sizes.append((rows.stop - rows.start) * (columns.stop - columns.start))
        return np.full((rows.stop - rows.start, columns.stop - columns.start), 0.5 + 0j, np.complex64)


def test_the_image_is_read_by_strips(runs: dict[str, Path]) -> None:
    real = source_of(runs["run"])
    made = Wide(real.path, np.arange(20000.0), np.arange(4000.0), real.geometry, {}, {})
    told: list[tuple[int, int]] = []
    drawn = picture.draw(made, looks="mean", progress=lambda *at: told.append(at))
    assert max(made.sizes) <= 2**22 and sum(made.sizes) == 80_000_000
    assert told[-1] == (4000, 4000)
    assert len(drawn.data) < 100_000


def test_pixels_about_targets_lie_where_they_are(runs: dict[str, Path]) -> None:
    source = source_of(runs["run"])
    drawn = picture.draw(source, looks="max")
    dx, dy = source.spacing
    middle = Target("middle", *(float(axis[axis.size // 2]) for axis in (source.x, source.y)))
    corner = Target("corner", float(source.x[-1]), float(source.y[0]))
    outside = Target("outside", float(source.x[0]) - 100.0, 0.0)
    first, last = picture.chips(source, [middle, corner, outside], drawn)
    assert (float(first.width), float(first.height)) == pytest.approx((64 * dx, 64 * dy))
    assert (float(last.width), float(last.height)) == pytest.approx((33 * dx, 32 * dy), abs=1.01 * dx)
    right, low = float(last.x) + float(last.width), float(last.y) + float(last.height)
    at = drawn.place(corner.x + dx / 2, corner.y - dy / 2)
    assert (right, low) == pytest.approx((float(at[0]), float(at[1])), abs=0.01)
    pixels = imread(io.BytesIO(base64.b64decode(first.data.partition(",")[2])), format="webp")
    row, column = source.y.size // 2, source.x.size // 2
    true = source.read(slice(row - 32, row + 32), slice(column - 32, column + 32))
    said = drawn.bottom + pixels[::-1, :, 0] / 255 * (drawn.top - drawn.bottom)
    expected = np.maximum(20 * np.log10(np.abs(true)), drawn.bottom)
    assert np.abs(said - expected)[np.isfinite(true)].max() < 0.51 * (drawn.top - drawn.bottom) / 255


def test_the_worst_picture_leaves_a_page_below_five_megabytes() -> None:
    rng = np.random.default_rng(1)
    noise = rng.uniform(-100, 0, (picture.PIXELS, picture.PIXELS))
    assert len(picture.data_uri("webp", picture._grey(noise, -100.0, 0.0))) < 3.6e6
    chips = [len(picture.data_uri("webp", picture._grey(noise[:64, i : i + 64], -100.0, 0.0))) for i in range(3)]
    assert max(chips) * picture.MOST_CHIPS < 0.7e6


def test_blocks_own_what_the_image_says(runs: dict[str, Path]) -> None:
    source = source_of(runs["run"])
    predicted = source.record["plan"]["predicted"]
    assert [facts.block_name(b) for b in predicted] == ["0.0", "0.1", "1.0", "1.1"]
    block = stores.read_region(source.path, "block", (slice(0, source.y.size), slice(0, source.x.size)))
    rng = np.random.default_rng(2)
    found = set()
    for row, column in rng.permutation(np.argwhere(block >= 0))[:400]:
        name = facts.block_of(source, predicted, float(source.x[column]), float(source.y[row]))
        assert name.partition(".")[0] == str(block[row, column])
        found.add(name)
    assert found == {"0.0", "0.1", "1.0", "1.1"}


def test_outlines_bound_the_blocks(runs: dict[str, Path]) -> None:
    source = source_of(runs["run"])
    predicted, geometry = facts.Facts(source, None).predicted, source.geometry
    drawn = picture.draw(source, looks="max")
    for outline, block in zip(picture.outlines(source, predicted, drawn), predicted, strict=True):
        numbers = np.array(re.findall(r"-?\d+\.\d+", outline.path), float).reshape(-1, 2)
        x, y = numbers[:, 0] + drawn.centre[0], drawn.centre[1] - numbers[:, 1]
        ranges, yaws = geometry.epoch_range(x, y), geometry.yaw(x, y)
        assert (ranges.min(), ranges.max()) == pytest.approx(block["range"], abs=0.01)
        assert (yaws.min(), yaws.max()) == pytest.approx(block["yaw"], abs=1e-6)
        assert outline.label is not None


# ---------------------------------------------------------------- what it says


def test_a_good_run_says_so(whole: Path) -> None:
    said = read(whole).text()
    assert "4 of 4 fully lit targets within the bar" in said
    assert "no warnings" in said and "% of the plan" in said
    assert "5 targets, 4 of them lit over their full dwell" in said
    assert "Warnings" not in said
    assert 'class="off"' not in whole.read_text()


def test_what_is_beyond_the_bar_is_said_and_marked(run: Path, quick: None) -> None:
    def spoil(record: Any) -> None:
        found = {t["name"]: t for t in record["targets"]}
        found["A"]["azimuth_pslr"] = -12.9
        found["B"]["error_x"] = None
        found["edge"]["azimuth_pslr"] = -5.0  # not judged: lit in part

    changed(run / "quality.json", spoil)
    report = blocksar.report(run)
    text = report.result.path.read_text(encoding="utf-8")
    assert "2 of 4 fully lit targets within the bar" in report.summary[0]
    assert 'class="verdict attention"' in text
    off = re.findall(r'data-sort="([^"]*)" class="off"', text)
    assert "-5.0" not in off
    assert off.count("-12.9") == 2 and "" in off  # in the plan's table too; what could not be measured is marked
    share = words.number(100 * abs(-12.9 - constants.SINC_PSLR) / 0.2, 0)
    assert f"! {share}" in re.sub(r"<[^>]*>", "", text)


def test_targets_beyond_the_grid_are_no_reproach(run: Path, quick: None) -> None:
    """As the bar is told: what the image does not cover is not judged; but a hole in the image is no good news."""

    def lost(target: Any, **place: float) -> None:
        target |= {name: None for name in target if name.endswith(("lr", "irw")) or name.startswith("error")}
        target |= {"covered": False, "value": [None, None], **place}

    changed(run / "quality.json", lambda record: lost(record["targets"][0], x=90e3))
    assert record_names(run)[0] != "edge"
    report = blocksar.report(run)
    assert "3 of 3 fully lit targets within the bar" in report.summary[0]
    assert 'class="verdict good"' in report.result.path.read_text(encoding="utf-8")
    changed(run / "quality.json", lambda record: lost(record["targets"][0], x=16100.0, y=19200.0))
    assert "3 of 4 fully lit targets within the bar" in blocksar.report(run).summary[0]
    changed(run / "quality.json", lambda record: [lost(target, x=90e3) for target in record["targets"]])
    assert "no fully lit target to judge in this image" in blocksar.report(run).summary[0]


def record_names(run: Path) -> list[str]:
    return [target["name"] for target in json.loads((run / "quality.json").read_text())["targets"]]


def test_warnings_come_first(run: Path, quick: None) -> None:
    changed(run / "run.json", lambda r: r.update(warnings=["3 pulses are missing <b>", "saturated"]))
    report = blocksar.report(run)
    found = read(report.result)
    assert 'class="verdict attention"' in report.result.path.read_text(encoding="utf-8")
    headings = [text for tag, text in found.texts if tag == "h2"]
    assert headings[:2] == ["Warnings", "Image"]
    assert "3 pulses are missing <b>" in found.text("li")
    assert "2 warnings" in found.text()


def test_more_memory_than_planned_is_no_good_news(run: Path, quick: None) -> None:
    changed(run / "run.json", lambda r: r.update(peak_memory=2 * r["plan"]["memory"]))
    report = blocksar.report(run)
    assert "200 % of the plan" in report.summary[0]
    assert 'class="verdict attention"' in report.result.path.read_text(encoding="utf-8")


def test_the_plan_stands_beside_what_was_measured(whole: Path, runs: dict[str, Path]) -> None:
    record = json.loads((runs["run"] / "run.json").read_text())
    quality = {t["name"]: t for t in json.loads((runs["run"] / "quality.json").read_text())["targets"]}
    text = whole.read_text(encoding="utf-8")
    rows = text[text.index('<table id="plan"') :].partition("</table>")[0].split("<tr>")[2:]
    assert len(rows) == 4
    measured: list[int] = []
    for row, block in zip(rows, record["plan"]["predicted"], strict=True):
        cells = [re.sub(r"<[^>]*>", "", cell).strip() for cell in re.findall(r"<t[hd].*?</t[hd]>", row, re.DOTALL)]
        receipt = next(r for r in record["receipts"] if r["unit"] == f"block-{cells[0]}")
        assert cells[0] == facts.block_name(block)
        assert cells[1] == words.number(block["residual_phase"], 4)
        assert cells[2] == words.number(block["pslr"], 2)
        assert cells[7] == words.number(block["memory"] / 2**20, 0)
        assert cells[8] == words.number(receipt["peak_memory"] / 2**20, 0)
        measured.append(int(cells[6]))
        if cells[6] != "0":
            assert cells[3] in {words.number(t["azimuth_pslr"], 2) for t in quality.values()}
    assert sum(measured) == 4


def test_times_are_those_of_the_receipts(whole: Path, runs: dict[str, Path]) -> None:
    record = json.loads((runs["run"] / "run.json").read_text())
    cells = read(whole).text("td")
    for name in ("recover", "focus", "mosaic", "total"):
        assert tables._seconds(record["timings"][name]) in cells
    block = next(r for r in record["receipts"] if r["unit"] == "block-0.0")
    assert tables._seconds(sum(block["steps"].values())) in cells
    bars = [float(a["width"]) for a in read(whole).all("rect") if a.get("height") == "8"]
    assert max(bars) == 100 and min(bars) >= 0


@pytest.mark.parametrize(
    "settings",
    [
        {"blocks": 3},
        {"processor": "keystone-resampling", "coefficients": "closed-form", "perturbation": "none"},
        {"keystone": False, "derotation": "linear", "grid": ((-10.0, 10.5, 0.25), (1e4, 1.2e4, 1.0))},
        {"range_model": "conventional", "coefficients": "closed-form", "blocks": 1},
    ],
)
def test_the_command_repeats_the_run(settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    usual = method.Method().as_settings() | {"processor": "angular-division", "blocks": "auto", "grid": None}
    record = usual | settings
    if record["grid"]:
        record["grid"] = [*record["grid"][0], *record["grid"][1]]
    seen: dict[str, Any] = {}

    def focus(source: str, out: str, **options: Any) -> api.Report:
        seen.update(options, source=source, out=out)
        return api.Report()

    monkeypatch.setattr(api, "focus", focus)
    words = shlex.split(provenance.repeat_command(record, "/in put/ph.zarr", "/out $1"))
    assert words[0] == "blocksar" and CliRunner().invoke(commands.app, words[1:]).exit_code == 0
    assert (seen["source"], seen["out"]) == ("/in put/ph.zarr", "/out $1")
    assert {name: seen[name] for name in usual} == usual | settings


def test_many_targets_are_the_worst_of_them(run: Path, quick: None) -> None:
    def copy(record: Any) -> None:
        one = record["targets"][0]
        record["targets"] = [one | {"name": f"N{i}", "error_x": 1e-5 * i} for i in range(3000)]

    changed(run / "quality.json", copy)
    path = blocksar.report(run).result.path
    text = path.read_text(encoding="utf-8")
    rows = text[text.index('<table id="targets"') :].partition("</table>")[0].count("<tr>") - 1
    assert rows == facts.MOST_ROWS
    assert ">N2999</a>" in text and ">N100</a>" not in text
    assert f"The {facts.MOST_ROWS} worst; 2\u202f700 more are in quality.json." in text
    assert path.stat().st_size < 5e6


# ---------------------------------------------------------------- other runs


def test_back_projection_and_an_image_too_coarse(runs: dict[str, Path], tmp_path: Path, quick: None) -> None:
    report = blocksar.report(runs["exact"], out=tmp_path / "new" / "exact.html")
    found = read(report.result)
    said = found.text()
    assert "Exact back-projection makes no approximation" in said
    assert "targets could not be measured" in said and "too coarse for the response" in said
    marks = [a["data-name"] for a in found.all("g") if "mark" in a.get("class", "")]
    assert marks == ["seam", "<i>D"]  # where they should be; the others lie outside this image
    assert not any(a.get("id") in ("borders", "toggle-borders") for _, a in found.elements)


def test_no_targets_and_a_place_on_the_earth(run: Path, tmp_path: Path) -> None:
    where = {"kind": "ENU", "latitude": 39.78, "longitude": -84.09, "height": 250.0, "rotation_deg": 30.0}

    def place_it(metadata: Any) -> None:
        metadata["attributes"]["targets"] = []
        metadata["attributes"]["georeference"] = where

    changed(run / "collection.zarr" / "zarr.json", place_it)
    (run / "quality.json").unlink()
    found = read(blocksar.report(run).result)
    said = found.text()
    assert "no targets to measure" in said and "names no targets" in said
    assert "latitude 39.78°, longitude -84.09°, height 250.0 m, x rotated 30.0° from east" in said
    turns = [a["transform"] for a in found.all("g") if a.get("transform", "").startswith("rotate")]
    assert turns[1] == "rotate(-60.0)"  # x points 30 degrees from east towards north, so north is 60 degrees up from it
    assert "mean power" in said


def test_a_run_that_says_little(run: Path, quick: None) -> None:
    (run / "run.json").write_text(json.dumps({"status": "finished"}))
    said = read(blocksar.report(run).result).text()
    assert "Provenance" in said and "Command that repeats the run" not in said


def test_a_run_in_an_object_store(runs: dict[str, Path], tmp_path: Path, quick: None) -> None:
    run = borrowed(runs["exact"], tmp_path / "run")
    with s3.server():
        there = place(f"s3://{s3.make_bucket()}/run")
        for parent, _, names in os.walk(run, followlinks=True):
            for name in names:
                file = Path(parent, name)
                (there / file.relative_to(run).as_posix()).write_bytes(file.read_bytes())
        blocksar.report(str(there))
        page_there = (there / "report.html").read_bytes()
        blocksar.report(str(there), out=tmp_path / "local.html")
        with pytest.raises(InputError, match=r"report.html exists; choose another name"):
            blocksar.report(str(there), out=f"{there}/report.html")
    assert page_there == (tmp_path / "local.html").read_bytes()
    assert page_there.replace(str(there).encode(), b"") == blocksar.report(run).result.read_bytes().replace(
        str(run).encode(), b""
    )


# ---------------------------------------------------------------- wrong input, and failures


def test_all_that_takes_time_is_told(run: Path) -> None:
    """Drawing responses takes longer than reading the image: a display that stood at 100 % meanwhile would mislead."""
    told: list[tuple[str, int, int]] = []
    blocksar.report(run, progress=SimpleNamespace(update=lambda *update: told.append(update)))
    drawn = [update for update in told if update[0] == "responses"]
    number = drawn[-1][2]
    assert number and drawn == [("responses", i, number) for i in range(number + 1)]
    assert told[-number - 2][0] == "report" and told[-number - 2][1] == told[-number - 2][2]


def test_what_stands_there_is_kept_unless_asked(run: Path, tmp_path: Path, quick: None) -> None:
    target = tmp_path / "page.html"
    target.write_text("mine")
    told = CliRunner().invoke(commands.app, ["report", str(run), "--out", str(target), "--quiet"])
    assert told.exit_code == endings.WRONG_INPUT and "page.html exists" in told.stderr
    assert target.read_text() == "mine"
    told = CliRunner().invoke(commands.app, ["report", str(run), "--out", str(target), "--overwrite"])
    assert told.exit_code == 0 and f"wrote {target}" in told.stdout and "report: " in told.stderr
    assert target.read_text(encoding="utf-8").startswith("\n<!DOCTYPE html>".strip())


def test_help_has_an_example() -> None:
    assert "Example: blocksar report run" in CliRunner().invoke(commands.app, ["report", "--help"]).stdout


@pytest.mark.parametrize("what", ["folder", "file above"])
def test_bad_destinations(what: str, run: Path, tmp_path: Path, quick: None) -> None:
    if what == "folder":
        (tmp_path / "out").mkdir()
        with pytest.raises(InputError, match="out exists"):
            blocksar.report(run, out=tmp_path / "out")
        with pytest.raises(InputError, match="out is a folder"):
            blocksar.report(run, out=tmp_path / "out", overwrite=True)
    else:
        (tmp_path / "out").write_text("")
        with pytest.raises(InputError, match="cannot be written"):
            blocksar.report(run, out=tmp_path / "out" / "page.html")


def test_a_full_disk_leaves_what_was_there(run: Path, quick: None, monkeypatch: pytest.MonkeyPatch) -> None:
    (run / "report.html").write_text("earlier")

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ProcessingError, match=r"report.html cannot be written \(No space left"):
        blocksar.report(run)
    assert (run / "report.html").read_text() == "earlier"
    assert not [path for path in run.iterdir() if path.name.endswith(".part")]


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("quality.json", "{", "quality.json is damaged"),
        ("quality.json", "[1]", "quality.json or the attributes of .* are damaged"),
        ("quality.json", '{"targets": [{"name": "A"}]}', "are damaged"),
        ("run.json", '{"status": "finished", "plan": {"predicted": [3]}}', "are damaged"),
        ("run.json", '{"status": "finished", "timings": {"focus": "x"}}', "are damaged"),
        ("run.json", '{"status": "unfinished"}', "not finished"),
    ],
)
def test_damaged_records_are_named(name: str, text: str, message: str, run: Path, quick: None) -> None:
    (run / name).write_text(text)
    with pytest.raises(InputError, match=message):
        blocksar.report(run)
    assert not (run / "report.html").exists()


def test_a_damaged_place_on_the_earth_is_named(run: Path, quick: None) -> None:
    where = {"kind": "ENU", "rotation_deg": "east"}
    changed(run / "collection.zarr" / "zarr.json", lambda metadata: metadata["attributes"].update(georeference=where))
    with pytest.raises(InputError, match=r"the attributes of .* are damaged \(could not convert"):
        blocksar.report(run)


@pytest.mark.parametrize("library", ["jinja2", "matplotlib"])
def test_a_missing_library_is_named_with_its_extra(library: str, run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in list(sys.modules):
        if name.split(".")[0] == library or name.startswith("blocksar.products.p"):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.delattr(blocksar.products.page, "page", raising=False)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(InputError, match=rf"{library} is not installed.*install blocksar\[plots\]$"):
        blocksar.report(run)


# ---------------------------------------------------------------- in a browser

CHROMIUM = os.environ.get("BLOCKSAR_CHROMIUM") or next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
in_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: BLOCKSAR_CHROMIUM may name one")


NARROWER = "(width) => document.getElementById('scene').viewBox.baseVal.width < width"


class Browser:
    """Opens the page, and holds whatever the page complained of or asked for."""

    def __init__(self, chromium: Any, path: Path) -> None:
        self._chromium, self.path = chromium, path

    @contextmanager
    def open(self, *, width: int = 1440, height: int = 900, **context: Any) -> Iterator[Any]:
        made = self._chromium.new_context(viewport={"width": width, "height": height}, **context)
        complaints: list[str] = []
        try:
            shown = made.new_page()
            shown.set_default_timeout(15_000)
            shown.on("console", lambda message: complaints.append(f"{message.type}: {message.text}"))
            shown.on("pageerror", lambda error: complaints.append(str(error)))
            shown.on("request", lambda request: complaints.append(request.url) if wanted(request.url) else None)
            made.set_offline(True)
            shown.goto(self.path.as_uri())
            yield shown
        finally:
            made.close()
        assert complaints == [self.path.as_uri()]  # itself, and nothing else


def wanted(url: str) -> bool:
    return not url.startswith("data:")


@pytest.fixture(scope="module")
def browser(whole: Path) -> Iterator[Browser]:
    from playwright.sync_api import sync_playwright

    # As root Chromium has no sandbox; it opens nothing but a file that was made here.
    arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=arguments)
        try:
            yield Browser(chromium, whole)
        finally:
            chromium.close()


def view(shown: Any) -> Any:
    """x, y, width and height of what is shown of the picture, m."""
    return np.array(shown.get_attribute("#scene", "viewBox").split(), float)


def middle(shown: Any) -> Any:
    box = view(shown)
    return box[:2] + box[2:] / 2


def pressed(shown: Any, button: str) -> str:
    return str(shown.get_attribute(button, "aria-pressed"))


@in_browser
def test_it_opens_without_a_word(browser: Browser) -> None:
    with browser.open() as shown:
        assert shown.inner_text("h1") == HOSTILE.replace("\u202e", "\\u202e")
        assert shown.evaluate("window.pwned") is None
        shown.wait_for_function("() => document.getElementById('readout').textContent.includes('dB')")
        assert shown.evaluate("[...document.images].every((i) => i.complete && i.naturalWidth > 0)")
        assert shown.locator(".card").count() == 4


@in_browser
def test_buttons_zoom_move_and_reset(browser: Browser) -> None:
    with browser.open() as shown:
        first = view(shown)
        assert shown.is_disabled("#zoom-out") and shown.is_disabled("#reset")
        for _ in range(3):
            shown.click("#zoom-in")
        assert view(shown)[2:] == pytest.approx(first[2:] / 1.5**3)
        assert middle(shown) == pytest.approx([0, 0], abs=1e-6)
        for button, direction in (("right", (1, 0)), ("down", (0, 1)), ("left", (-1, 0)), ("up", (0, -1))):
            before = view(shown)
            shown.click(f"#{button}")
            assert view(shown)[:2] == pytest.approx(before[:2] + np.array(direction) * before[2:] / 4)
        shown.click("#zoom-out")
        assert view(shown)[2:] == pytest.approx(first[2:] / 1.5**2)
        assert "Zoom 2.3" in shown.inner_text("#announcement")  # 1.5 * 1.5
        shown.click("#reset")
        assert view(shown) == pytest.approx(first)


@in_browser
def test_the_image_cannot_be_lost(browser: Browser) -> None:
    with browser.open() as shown:
        width, height = (float(shown.get_attribute("#scene", f"data-{name}")) for name in ("width", "height"))
        for _ in range(4):
            shown.click("#zoom-in")
        shown.evaluate("() => { for (let i = 0; i < 30; i++) { right.click(); down.click(); } }")
        box = view(shown)
        assert box[:2] + box[2:] == pytest.approx([width / 2, height / 2], rel=1e-6)
        shown.evaluate("() => { for (let i = 0; i < 60; i++) document.getElementById('zoom-in').click(); }")
        assert shown.is_disabled("#zoom-in") and view(shown)[2] > 0


@in_browser
def test_the_mouse_drags_and_zooms(browser: Browser) -> None:
    with browser.open() as shown:
        shown.click("#zoom-in")
        shown.click("#zoom-in")
        frame = shown.locator("#viewer").bounding_box()
        scale = view(shown)[2] / frame["width"]
        before = view(shown)
        x, y = frame["x"] + 300, frame["y"] + 200
        shown.mouse.move(x, y)
        shown.mouse.down()
        shown.mouse.move(x - 60, y + 25, steps=4)
        shown.mouse.up()
        assert view(shown)[:2] == pytest.approx(before[:2] + scale * np.array([60, -25]), abs=1e-6 * before[2])
        dropped = view(shown)
        shown.mouse.move(x, y)  # the button is up: nothing is dragged
        assert view(shown) == pytest.approx(dropped)
        under = view(shown)[:2] + scale * np.array([300, 200])
        shown.mouse.wheel(0, -300)  # the viewer has been clicked, so the wheel is its own
        shown.wait_for_function(NARROWER, arg=before[2])
        zoomed = view(shown)[2] / frame["width"]
        assert view(shown)[:2] + zoomed * np.array([300, 200]) == pytest.approx(under, abs=scale)  # a pixel
        assert shown.evaluate("scrollY") == 0
        shown.mouse.dblclick(x, y)
        assert view(shown)[2] == pytest.approx(zoomed * frame["width"] / 2)


@in_browser
def test_the_wheel_scrolls_the_page_until_the_image_is_asked(browser: Browser) -> None:
    with browser.open() as shown:
        before = view(shown)
        frame = shown.locator("#viewer").bounding_box()
        shown.mouse.move(frame["x"] + 300, frame["y"] + 200)
        shown.mouse.wheel(0, 200)
        shown.wait_for_function("() => scrollY > 100")
        assert view(shown) == pytest.approx(before)
        assert shown.get_attribute("#hint", "class") == "shown"
        shown.keyboard.down("Control")
        shown.mouse.wheel(0, -200)
        shown.wait_for_function(NARROWER, arg=before[2])


@in_browser
def test_fingers_pinch_and_drag(browser: Browser) -> None:
    with browser.open(width=375, height=667, has_touch=True, is_mobile=True) as shown:
        shown.locator("#viewer").scroll_into_view_if_needed()
        frame = shown.locator("#viewer").bounding_box()
        x, y = frame["x"] + frame["width"] / 2, frame["y"] + frame["height"] / 2
        touch = shown.context.new_cdp_session(shown)

        def fingers(kind: str, *points: tuple[float, float]) -> None:
            named = [{"x": px, "y": py, "id": i} for i, (px, py) in enumerate(points)]
            touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": named})

        assert shown.evaluate("getComputedStyle(viewer).touchAction") == "pan-y"  # one finger scrolls the page
        before = view(shown)
        fingers("touchStart", (x - 30, y), (x + 30, y))
        for apart in (40, 50, 60, 75, 90):
            fingers("touchMove", (x - apart, y), (x + apart, y))
        fingers("touchEnd")
        assert view(shown)[2] == pytest.approx(before[2] / 3, rel=0.02)
        assert middle(shown) == pytest.approx([0, 0], abs=0.02 * before[2])
        assert shown.evaluate("getComputedStyle(viewer).touchAction") == "none"
        before = view(shown)
        fingers("touchStart", (x, y))
        for moved in (10, 20, 40):
            fingers("touchMove", (x - moved, y))
        fingers("touchEnd")
        assert view(shown)[0] - before[0] == pytest.approx(40 * before[2] / frame["width"], rel=0.02)
        assert shown.evaluate("visualViewport.scale") == 1


@in_browser
def test_what_lies_over_the_image_can_be_switched_off(browser: Browser) -> None:
    with browser.open() as shown:
        for name, what in (("borders", "#borders path"), ("marks", ".mark circle")):
            assert pressed(shown, f"#toggle-{name}") == "true" and shown.locator(what).first.is_visible()
            shown.click(f"#toggle-{name}")
            assert pressed(shown, f"#toggle-{name}") == "false" and not shown.locator(what).first.is_visible()
            shown.click(f"#toggle-{name}")
            assert pressed(shown, f"#toggle-{name}") == "true" and shown.locator(what).first.is_visible()
        assert shown.locator(".mark text:visible").count() > 0
        shown.click("#toggle-names")
        assert shown.locator(".mark text:visible").count() == 0
        assert shown.locator(".mark circle").first.is_visible()
        assert shown.locator("#borders path").count() == 4


@in_browser
def test_a_row_leads_to_its_target_in_the_picture(browser: Browser) -> None:
    """The whole way from ground coordinates to pixels: the cell under the mark has the target's power."""
    with browser.open() as shown:
        shown.wait_for_function("() => document.getElementById('readout').textContent.includes('dB')")
        bottom, top = (float(shown.get_attribute("#scene", f"data-{name}")) for name in ("bottom", "top"))
        rows = json.loads((browser.path.parent / "quality.json").read_text())["targets"]
        for target in (t for t in rows if t["covered"]):
            link = shown.locator("#targets a.goto", has_text=target["name"]).first
            link.click()
            at = [float(link.get_attribute(f"data-{axis}")) for axis in "xy"]
            assert middle(shown) == pytest.approx(at, abs=1e-3)
            assert shown.locator(".mark.chosen").get_attribute("data-name") == target["name"]
            assert target["name"] in shown.inner_text("#announcement")
            shown.mouse.move(5, 5)
            said = shown.inner_text("#readout").replace("\u202f", "").replace("\N{MINUS SIGN}", "-")
            x, y, power = map(float, re.findall(r"-?\d+\.\d+", said))
            assert (x, y) == pytest.approx((target["x"], target["y"]), abs=0.1)
            # The strongest pixel of a cell of 4 or 5; the peak lies between pixels, or just across a cell's edge.
            assert -3.5 < power < 0.1 + (top - bottom) / 255
            assert shown.locator("#chips").is_visible()


@in_browser
def test_the_keyboard_does_all(browser: Browser) -> None:
    with browser.open() as shown:
        for _ in range(20):
            shown.keyboard.press("Tab")
            if shown.evaluate("document.activeElement.id") == "viewer":
                break
        assert shown.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"
        first = view(shown)
        for _ in range(4):
            shown.keyboard.press("+")
        zoomed = view(shown)
        assert zoomed[2:] == pytest.approx(first[2:] / 1.5**4)
        shown.keyboard.press("ArrowRight")
        assert view(shown)[0] == pytest.approx(zoomed[0] + zoomed[2] / 4)
        assert "centre at x" in shown.inner_text("#announcement")
        shown.keyboard.press("-")
        shown.keyboard.press("0")
        assert view(shown) == pytest.approx(first)
        seen = []
        for _ in range(40):
            shown.keyboard.press("Tab")
            seen.append(shown.evaluate("document.activeElement.id || document.activeElement.className"))
            if seen[-1].startswith("toggle-"):
                before = pressed(shown, f"#{seen[-1]}")
                shown.keyboard.press("Space")
                assert pressed(shown, f"#{seen[-1]}") != before
                shown.keyboard.press("Enter")
            if seen[-1] == "goto":
                break
        buttons = ["zoom-in", "left", "up", "down", "right", "toggle-borders", "toggle-marks", "toggle-names"]
        assert [name for name in seen if name in buttons] == buttons
        assert {"black", "white", "grey-reset", "scroll"} <= set(seen)
        link = shown.evaluate_handle("document.activeElement")
        shown.keyboard.press("Enter")
        assert shown.evaluate("document.activeElement.id") == "viewer"
        assert middle(shown) == pytest.approx([float(link.get_attribute(f"data-{axis}")) for axis in "xy"], abs=1e-3)
        shown.keyboard.press("Escape")
        assert shown.evaluate("(link) => document.activeElement === link", link)


@in_browser
def test_columns_sort(browser: Browser) -> None:
    with browser.open() as shown:
        heads = shown.locator("#targets thead th")
        titles = heads.all_inner_texts()
        column = next(i for i, title in enumerate(titles) if title.startswith("worst figure"))

        def values() -> list[str]:
            found = shown.locator(f"#targets tbody tr > :nth-child({column + 1})")
            return [str(value) for value in found.evaluate_all("(cells) => cells.map((cell) => cell.dataset.sort)")]

        before = values()
        for direction in ("ascending", "descending"):
            heads.nth(column).locator("button").click()
            assert heads.nth(column).get_attribute("aria-sort") == direction
            known = sorted((float(v) for v in before if v), reverse=direction == "descending")
            assert [float(v) for v in values()[:-1]] == known
            assert values()[-1] == ""  # the target that is not judged
        heads.nth(0).locator("button").click()
        assert shown.locator("#targets [aria-sort]").count() == 1


@in_browser
def test_the_grey_scale_can_be_set(browser: Browser) -> None:
    def slope() -> float:
        return float(shown.get_attribute("#stretch feFuncG", "slope"))

    with browser.open() as shown:
        bottom, top = (float(shown.get_attribute("#scene", f"data-{name}")) for name in ("bottom", "top"))
        first = slope()
        shown.locator("#black").fill(str(round(bottom) + 1))
        white = float(shown.get_attribute("#scene", "data-white"))
        assert slope() == pytest.approx((top - bottom) / (white - round(bottom) - 1), rel=1e-6)
        shown.locator("#black").fill(str(round(top)))  # beyond white
        assert slope() == pytest.approx(top - bottom, rel=1e-6)
        assert "dB" in shown.inner_text("#black-value")
        shown.click("#grey-reset")
        assert slope() == pytest.approx(first)


@in_browser
@pytest.mark.parametrize(("width", "scheme"), [(375, "light"), (1440, "dark")])
def test_readable_by_everybody(width: int, scheme: Any, browser: Browser) -> None:
    from axe_playwright_python.sync_playwright import Axe

    with browser.open(width=width, color_scheme=scheme) as shown:
        assert shown.evaluate("document.documentElement.scrollWidth") <= width
        for summary in shown.locator("summary").all():
            summary.click()
        assert shown.evaluate("document.documentElement.scrollWidth") <= width
        assert shown.locator(".scroll:not([tabindex='0'])").count() == 0
        rules = {"runOnly": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]}
        found = Axe().run(shown, options=rules).response
        assert len(found["passes"]) > 20
        assert [(v["id"], v["nodes"][0]["html"]) for v in found["violations"]] == []


@in_browser
def test_on_paper_and_without_motion(browser: Browser) -> None:
    with browser.open(width=794, height=1123, reduced_motion="reduce", color_scheme="dark") as shown:
        assert shown.evaluate("getComputedStyle(document.documentElement).scrollBehavior") == "auto"
        shown.emulate_media(media="print", color_scheme="light", reduced_motion="reduce")
        assert not shown.locator(".controls").is_visible() and not shown.locator("nav").is_visible()
        assert shown.evaluate("document.documentElement.scrollWidth") <= 794
        inner = "(box) => [box.scrollHeight - box.clientHeight, box.scrollWidth - box.clientWidth]"
        assert shown.locator(".scroll").first.evaluate(inner) == [0, 0]


@in_browser
def test_without_script_it_can_still_be_read(browser: Browser) -> None:
    with browser.open(java_script_enabled=False) as shown:
        assert not shown.locator(".controls").is_visible()
        assert shown.locator("#pixels").is_visible() and shown.locator("#borders path").first.is_visible()
        assert shown.locator("noscript").is_visible()
        assert shown.locator("#targets tbody tr").count() == 5
