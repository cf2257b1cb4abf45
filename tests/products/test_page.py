"""The report page: its content agrees with the records of the run, and only its own script can run in it."""

from __future__ import annotations

import base64
import errno
import hashlib
import io
import json
import os
import re
import shlex
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import s3
from matplotlib.image import imread
from passes import fly, focus, points
from report_page import HOSTILE, borrowed, changed, read, source_of
from typer.testing import CliRunner

import blocksar
from blocksar import api, stores
from blocksar.cli import commands
from blocksar.errors import InputError, ProcessingError
from blocksar.imaging import method
from blocksar.measurement.targets import Target
from blocksar.places import place
from blocksar.products.page import facts, page, picture, tables
from blocksar.products.pictures.overview import overview
from blocksar.runs import demonstration
from blocksar.runs.finished import FinishedRun
from blocksar.runs.record import RunRecord

# ---------------------------------------------------------------- structure and pictures


def test_the_page_is_self_contained(whole: Path) -> None:
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


def test_the_content_policy_allows_only_the_pages_own_script_and_style(whole: Path) -> None:
    found = read(whole)
    policy = found.all("meta")[1]["content"]
    assert policy.startswith("default-src 'none'; img-src data:;") and "unsafe" not in policy
    assert len(found.all("script")) == len(found.all("style")) == 1
    for kind in ("script", "style"):
        inside = next(text for tag, text in found.texts if tag == kind)
        assert base64.b64encode(hashlib.sha256(inside.encode()).digest()).decode() in policy
    assert not [attrs for _, attrs in found.elements if any(name == "style" or name.startswith("on") for name in attrs)]


def test_text_from_files_is_escaped(whole: Path) -> None:
    found = read(whole)
    heading = found.text("h1")
    assert heading == HOSTILE.replace("\u202e", "\\u202e")  # the right-to-left override is shown as an escape
    assert found.text("title").startswith(heading)
    assert not [attrs for attrs in found.all("img") if not attrs["src"].startswith("data:image/png")]
    assert not found.all("i") and "<i>D" in found.text("a")
    assert "49" not in heading


@pytest.mark.slow
def test_reports_are_reproducible_and_missing_measurements_are_computed(
    run: Path, runs: dict[str, Path], quick: None
) -> None:
    first = Path(str(blocksar.report(run).result)).read_bytes()
    (run / "quality.json").unlink()
    report = blocksar.report(run)
    assert report.result.path.read_bytes() == first
    assert not (run / "quality.json").exists()  # a report does not change the run
    assert report.summary[-1] == f"wrote {run / 'report.html'}"


@pytest.mark.slow
def test_the_picture_matches_the_image(runs: dict[str, Path]) -> None:
    source = source_of(runs["run"])
    made = picture.draw(source, looks="max")
    decoded = imread(io.BytesIO(base64.b64decode(made.data.partition(",")[2])), format="webp")
    factor = -(-max(source.x.size, source.y.size) // picture.PIXELS)
    assert factor > 1  # otherwise the test decimates nothing
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
    x, y = made.place(source.x[0], source.y[-1])  # upper left pixel; the rows of the picture run downwards
    assert float(x) == pytest.approx(-made.width / 2 + source.spacing[0] / 2, abs=1e-3)
    assert float(y) >= -made.height / 2


def test_the_picture_of_a_run_with_a_pyramid_has_its_means(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = focus(
        fly(points((-20.0, 5.0, 0.0))), tmp_path / "run", grid=((-40.0, 40.0, 0.1), (-20.0, 20.0, 0.2)), pyramid=True
    )
    source = source_of(run)
    monkeypatch.setattr(picture, "PIXELS", 270)  # cells of 3 x 2 pixels, or of 2 x 1 of the first level
    plain = overview(source.read, source.x, source.y, max_pixels=200, looks="mean")
    monkeypatch.setattr(FinishedRun, "read", None)  # which would read the image
    made = picture.draw(source, looks="max")
    assert made.looks == "mean" and made.cell == pytest.approx(0.4)
    assert made.centre == pytest.approx(
        (float(np.mean(plain.x_edges[[0, -1]])), float(np.mean(plain.y_edges[[0, -1]])))
    )
    decoded = imread(io.BytesIO(base64.b64decode(made.data.partition(",")[2])), format="webp")[::-1]
    said = made.bottom + decoded[..., 0] / 255 * (made.top - made.bottom)
    with np.errstate(divide="ignore"):
        expected = np.maximum(10 * np.log10(plain.power), made.bottom)
    covered = np.isfinite(plain.power)
    assert np.abs(said - expected)[covered].max() < 0.52 * (made.top - made.bottom) / 255
    assert made.top >= expected[covered].max() + 10 * np.log10(8) - 0.01  # of one pixel of the 8 of a cell


class Wide(FinishedRun):
    """A simulated image of 80 million pixels that records the size of each read."""

    sizes: list[int] = []  # noqa: RUF012  (used by one test only)

    def read(self, rows: slice, columns: slice) -> Any:
        self.sizes.append((rows.stop - rows.start) * (columns.stop - columns.start))
        return np.full((rows.stop - rows.start, columns.stop - columns.start), 0.5 + 0j, np.complex64)


@pytest.mark.slow
def test_the_image_is_read_in_strips(runs: dict[str, Path]) -> None:
    real = source_of(runs["run"])
    made = Wide(real.folder, np.arange(20000.0), np.arange(4000.0), real.geometry, {}, RunRecord(status="finished"))
    told: list[tuple[int, int]] = []
    drawn = picture.draw(made, looks="mean", progress=lambda *at: told.append(at))
    assert max(made.sizes) <= 2**22 and sum(made.sizes) == 80_000_000
    assert told[-1] == (4000, 4000)
    assert len(drawn.data) < 100_000


@pytest.mark.slow
def test_chips_lie_at_their_targets(runs: dict[str, Path]) -> None:
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


@pytest.mark.slow
def test_a_picture_of_noise_keeps_the_page_below_five_megabytes() -> None:
    rng = np.random.default_rng(1)
    noise = rng.uniform(-100, 0, (picture.PIXELS, picture.PIXELS))
    assert len(picture.data_uri("webp", picture.lossless(noise, -100.0, 0.0))) < 3.6e6
    chips = [len(picture.data_uri("webp", picture.lossless(noise[:64, i : i + 64], -100.0, 0.0))) for i in range(3)]
    assert max(chips) * picture.MOST_CHIPS < 0.7e6


@pytest.mark.slow
def test_block_names_agree_with_the_block_map_of_the_image(runs: dict[str, Path]) -> None:
    source = source_of(runs["run"])
    predicted = source.record.plan.predicted
    assert [block.name for block in predicted] == ["0.0", "0.1", "1.0", "1.1"]
    block = stores.read_region(source.image, "block", (slice(0, source.y.size), slice(0, source.x.size)))
    rng = np.random.default_rng(2)
    found = set()
    for row, column in rng.permutation(np.argwhere(block >= 0))[:400]:
        name = facts.block_of(source, predicted, float(source.x[column]), float(source.y[row]))
        assert name.partition(".")[0] == str(block[row, column])
        found.add(name)
    assert found == {"0.0", "0.1", "1.0", "1.1"}


@pytest.mark.slow
def test_outlines_follow_the_block_limits(runs: dict[str, Path]) -> None:
    source = source_of(runs["run"])
    predicted, geometry = facts.Facts(source, None).predicted, source.geometry
    drawn = picture.draw(source, looks="max")
    for outline, block in zip(picture.outlines(source, predicted, drawn), predicted, strict=True):
        numbers = np.array(re.findall(r"-?\d+\.\d+", outline.path), float).reshape(-1, 2)
        x, y = numbers[:, 0] + drawn.centre[0], drawn.centre[1] - numbers[:, 1]
        ranges, yaws = geometry.epoch_range(x, y), geometry.yaw(x, y)
        assert (ranges.min(), ranges.max()) == pytest.approx(block.range, abs=0.01)
        assert (yaws.min(), yaws.max()) == pytest.approx(block.yaw, abs=1e-6)
        assert outline.label is not None


# ---------------------------------------------------------------- reported values


@pytest.mark.slow
def test_figures_beyond_the_quality_bar_are_reported_and_marked(run: Path, quick: None) -> None:
    def spoil(record: Any) -> None:
        found = {t["name"]: t for t in record["targets"]}
        found["A"]["azimuth_pslr"] = -12.9
        found["B"]["error_x"] = None
        found["edge"]["azimuth_pslr"] = -5.0  # not judged: partly illuminated

    changed(run / "quality.json", spoil)
    report = blocksar.report(run)
    text = report.result.path.read_text(encoding="utf-8")
    assert "2 of 4 fully lit targets within the limits" in report.summary[0]
    assert 'class="verdict attention"' in text
    off = re.findall(r'data-sort="([^"]*)" class="off"', text)
    assert "-5.0" not in off
    assert off.count("-12.9") == 2 and "" in off  # also in the plan table; values that could not be measured are marked
    theory = {t["name"]: t["azimuth_pslr_theory"] for t in json.loads((run / "quality.json").read_text())["targets"]}
    share = facts.number(100 * abs(-12.9 - theory["A"]) / 0.2, 0)
    assert f"! {share}" in re.sub(r"<[^>]*>", "", text)


@pytest.mark.slow
def test_targets_outside_the_grid_are_not_judged(run: Path, quick: None) -> None:
    """The quality bar ignores targets outside the image, but a hole in the image counts as a failure."""

    def lost(target: Any, **place: float) -> None:
        target |= {name: None for name in target if name.endswith(("lr", "irw")) or name.startswith("error")}
        target |= {"covered": False, "value": [None, None], **place}

    changed(run / "quality.json", lambda record: lost(record["targets"][0], x=90e3))
    assert record_names(run)[0] != "edge"
    report = blocksar.report(run)
    assert "3 of 3 fully lit targets within the limits" in report.summary[0]
    assert 'class="verdict good"' in report.result.path.read_text(encoding="utf-8")
    changed(run / "quality.json", lambda record: lost(record["targets"][0], x=16100.0, y=19200.0))
    assert "3 of 4 fully lit targets within the limits" in blocksar.report(run).summary[0]
    changed(run / "quality.json", lambda record: [lost(target, x=90e3) for target in record["targets"]])
    assert "no fully lit target to judge in this image" in blocksar.report(run).summary[0]


def record_names(run: Path) -> list[str]:
    return [target["name"] for target in json.loads((run / "quality.json").read_text())["targets"]]


@pytest.mark.slow
def test_warnings_come_first(run: Path, quick: None) -> None:
    changed(run / "run.json", lambda r: r.update(warnings=["3 pulses are missing <b>", "saturated"]))
    report = blocksar.report(run)
    found = read(report.result)
    assert 'class="verdict attention"' in report.result.path.read_text(encoding="utf-8")
    headings = [text for tag, text in found.texts if tag == "h2"]
    assert headings[:2] == ["Warnings", "Image"]
    assert "3 pulses are missing <b>" in found.text("li")
    assert "2 warnings" in found.text()


@pytest.mark.slow
def test_more_memory_than_planned_needs_attention(run: Path, quick: None) -> None:
    changed(run / "run.json", lambda r: r.update(peak_memory=2 * r["plan"]["memory"]))
    report = blocksar.report(run)
    assert "200 % of the plan" in report.summary[0]
    assert 'class="verdict attention"' in report.result.path.read_text(encoding="utf-8")


def test_the_plan_table_shows_predicted_and_measured_values(whole: Path, runs: dict[str, Path]) -> None:
    record = json.loads((runs["run"] / "run.json").read_text())
    quality = {t["name"]: t for t in json.loads((runs["run"] / "quality.json").read_text())["targets"]}
    text = whole.read_text(encoding="utf-8")
    rows = text[text.index('<table id="plan"') :].partition("</table>")[0].split("<tr>")[2:]
    assert len(rows) == 4
    measured: list[int] = []
    for row, block in zip(rows, record["plan"]["predicted"], strict=True):
        cells = [re.sub(r"<[^>]*>", "", cell).strip() for cell in re.findall(r"<t[hd].*?</t[hd]>", row, re.DOTALL)]
        receipt = next(r for r in record["receipts"] if r["unit"] == f"block-{cells[0]}")
        assert cells[0] == f"{block['block']}.{block['part']}"
        assert cells[1] == facts.number(block["coherence"], 4)
        assert cells[2] == facts.number(block["residual_phase"], 4)
        assert cells[3] == facts.number(block["pslr"], 2)
        assert cells[8] == facts.number(block["memory"] / 2**20, 0)
        assert cells[9] == facts.number(receipt["peak_memory"] / 2**20, 0)
        measured.append(int(cells[7]))
        if cells[7] != "0":
            assert cells[4] in {facts.number(t["azimuth_pslr"], 2) for t in quality.values()}
    assert sum(measured) == 4


def test_times_match_the_timings_and_receipts(whole: Path, runs: dict[str, Path]) -> None:
    record = json.loads((runs["run"] / "run.json").read_text())
    cells = read(whole).text("td")
    for name in ("recover", "check", "focus", "mosaic", "total"):
        assert tables.seconds_text(record["timings"][name]) in cells
    block = next(r for r in record["receipts"] if r["unit"] == "block-0.0")
    seconds = [block["seconds"], *block["steps"].values()]
    assert {tables.seconds_text(value) for value in seconds} <= set(cells.split())
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

    def focus(source: str, out: str, **options: Any) -> api.RunReport:
        seen.update(options, source=source, out=out)
        return api.RunReport()

    monkeypatch.setattr(api, "focus", focus)
    facts = shlex.split(page.repeat_command(record, ["/in put/ph.zarr"], "/out $1"))
    assert facts[0] == "blocksar" and CliRunner().invoke(commands.app, facts[1:]).exit_code == 0
    assert (seen["source"], seen["out"]) == ("/in put/ph.zarr", "/out $1")
    assert {name: seen[name] for name in usual} == usual | settings


DEMO = [*demonstration.GRID[0], *demonstration.GRID[1]]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "source", "blocks", "grid", "command"),
    [
        ("table1", "phase_history.zarr", 3, DEMO, "demo"),
        ("table1", "phase_history.zarr", 4, DEMO, "focus"),
        ("paper_b", "phase_history.zarr", 3, DEMO, "focus"),
        ("table1", "phase_history.zarr", 3, None, "focus"),
    ],
)
def test_a_demonstration_is_repeated_as_one(
    scene: str, source: str, blocks: int, grid: list[float] | None, command: str
) -> None:
    record = SimpleNamespace(
        settings={"blocks": blocks, "grid": grid}, record=SimpleNamespace(inputs=[f"/runs/a b/{source}"])
    )
    record.source = SimpleNamespace(attrs={"scene": scene}, folder=place("/runs/a b"))
    facts = shlex.split(page.repeat_run(record, "/runs/a b"))
    assert facts[:2] == ["blocksar", command] and facts[facts.index("--out") + 1] == "/runs/a b"
    assert CliRunner().invoke(commands.app, [*facts[1:], "--help"]).exit_code == 0


@pytest.mark.slow
def test_only_the_worst_of_many_targets_are_listed(run: Path, quick: None) -> None:
    def copy(record: Any) -> None:
        one = record["targets"][0]
        record["targets"] = [one | {"name": f"N{i}", "error_x": 1.0 + 1e-3 * i} for i in range(facts.MOST_ROWS + 20)]

    changed(run / "quality.json", copy)
    path = blocksar.report(run).result.path
    text = path.read_text(encoding="utf-8")
    rows = text[text.index('<table id="targets"') :].partition("</table>")[0].count("<tr>") - 1
    assert rows == facts.MOST_ROWS
    assert f">N{facts.MOST_ROWS + 19}</a>" in text and ">N10</a>" not in text
    assert f"The {facts.MOST_ROWS} worst; 20 more in quality.json." in text
    assert path.stat().st_size < 5e6


# ---------------------------------------------------------------- special runs


def test_report_of_a_back_projection_image_too_coarse_to_measure(
    runs: dict[str, Path], tmp_path: Path, quick: None
) -> None:
    report = blocksar.report(runs["exact"], out=tmp_path / "new" / "exact.html")
    found = read(report.result)
    said = found.text()
    assert "Exact back-projection makes no approximation" in said
    assert "targets could not be measured" in said and "too coarse for the response" in said
    marks = [a["data-name"] for a in found.all("g") if "mark" in a.get("class", "")]
    assert marks == ["seam", "<i>D"]  # at their nominal positions; the other targets lie outside this image
    assert not any(a.get("id") in ("borders", "toggle-borders") for _, a in found.elements)


@pytest.mark.slow
def test_report_of_a_georeferenced_run_without_targets(run: Path, tmp_path: Path) -> None:
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
    assert turns[1] == "rotate(-60.0)"  # x points 30 degrees north of east, so north is 60 degrees left of x
    assert "mean power" in said


@pytest.mark.slow
def test_report_of_a_run_with_a_minimal_record(run: Path, quick: None) -> None:
    (run / "run.json").write_text(json.dumps({"status": "finished"}))
    said = read(blocksar.report(run).result).text()
    assert "Provenance" in said and "Command that repeats the run" not in said


@pytest.mark.slow
def test_report_of_a_run_in_an_object_store(runs: dict[str, Path], tmp_path: Path, quick: None) -> None:
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


# ---------------------------------------------------------------- progress, wrong input and failures


@pytest.mark.slow
def test_a_full_disk_leaves_the_existing_page(run: Path, quick: None, monkeypatch: pytest.MonkeyPatch) -> None:
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
        (
            "run.json",
            '{"status": "finished", "plan": {"predicted": [3]}}',
            r"plan.predicted\[0\] is 3, not an object",
        ),
        ("run.json", '{"status": "finished", "timings": {"focus": "x"}}', "timings.focus is 'x', not a number"),
        ("run.json", '{"status": "unfinished"}', "not finished"),
    ],
)
def test_damaged_records_are_reported_by_name(name: str, text: str, message: str, run: Path, quick: None) -> None:
    (run / name).write_text(text)
    with pytest.raises(InputError, match=message):
        blocksar.report(run)
    assert not (run / "report.html").exists()
