"""PNG pictures of a small run."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from small_run import Made
from typer.testing import CliRunner

import blocksar
from blocksar.cli import commands
from blocksar.collection.georeference import Georeference
from blocksar.products.pictures import quicklook


@pytest.mark.parametrize("degrees", [45, 90, 180, 270])
def test_arrow_labels_stay_inside_the_picture_and_do_not_overlap(degrees: int) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 6), dpi=100)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    turn = np.radians(degrees)
    for place, word in enumerate(("look", "N")):
        direction = np.array([np.cos(turn), np.sin(turn)]) * (1 - 2 * place)  # opposed at 180 degrees
        quicklook.draw_arrow(axes, quicklook.Arrow(word, direction, "white"), place)
    canvas.draw()
    boxes = [text.get_window_extent(canvas.get_renderer()) for text in axes.texts if text.get_text()]
    assert len(boxes) == 2
    assert all(axes.bbox.x0 < b.x0 and b.x1 < axes.bbox.x1 and b.y1 < axes.bbox.y1 for b in boxes)
    assert not boxes[0].overlaps(boxes[1])


def test_the_north_arrow_follows_the_rotation_of_the_frame() -> None:
    frame = Georeference(latitude=10.0, longitude=20.0, height=0.0, rotation=30.0)
    arrow = quicklook.north_arrow(30.0).direction
    tip = frame.to_geodetic(np.array([100 * arrow[0], 100 * arrow[1], 0.0]))
    assert tip[0] > 10.0
    assert tip[1] == pytest.approx(20.0, abs=1e-9)


@pytest.mark.slow
def test_png_export_needs_no_georeference(unplaced: Made, tmp_path: Path) -> None:
    done = CliRunner().invoke(
        commands.app, ["export", "png", str(unplaced.folder), "--out", str(tmp_path / "a.png"), "-q"]
    )
    assert done.exit_code == 0, done.stderr
    assert f"wrote {tmp_path / 'a.png'}" in done.stdout
    assert imread(tmp_path / "a.png").std() > 0.1


def test_a_picture_is_shaped_by_its_options(made: Made, tmp_path: Path) -> None:
    options = ["--range=-30:5", "--color-map", "viridis", "--size", "900", "--crop=-20:20,-20:10"]
    done = CliRunner().invoke(
        commands.app, ["export", "png", str(made.folder), "--out", str(tmp_path / "a.png"), "-q", *options]
    )
    assert done.exit_code == 0, done.stderr
    assert "viridis from -30.0 to 5.0 dB" in done.stdout
    picture = imread(tmp_path / "a.png")
    assert max(picture.shape[:2]) == 900
    assert np.ptp(picture[..., :3], axis=-1).max() > 0.3  # not grey


def test_a_picture_needs_no_pyproj(made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyproj", None)
    said = blocksar.export("png", made.folder, tmp_path / "a.png").summary
    assert imread(tmp_path / "a.png").std() > 0.1 and "cells of 0.4 m x 0.4 m" in said[0]


def test_a_range_that_shows_nothing_is_remarked_on(made: Made, tmp_path: Path) -> None:
    for limits, side in (("20:40", "below"), ("-300:-200", "above")):
        said = blocksar.export("png", made.folder, tmp_path / f"{side}.png", range=limits, size=200).summary
        notes = [line for line in said if line.startswith("note: ")]
        assert len(notes) == 1 and f"lies {side} the range" in notes[0]
