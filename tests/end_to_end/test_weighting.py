"""Weighted images: targets against the ideal response, clutter against exact back-projection with the same weights."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from quality_bar import planned
from scenes import SMALL_SCAN, scene

import blocksar
from blocksar import stores
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import Taper, Weighting
from blocksar.errors import FolderError
from blocksar.focusing.backprojection import form_image

pytestmark = pytest.mark.slow

TAYLOR = Taper.parse("taylor:4:-35")
SCENES: dict[str, Any] = {
    "steered": (SMALL_SCAN, None),
    "wide band": (SMALL_SCAN | {"carrier": 10e9, "bandwidth": 150e6, "range_sampling": 180e6}, 40.0),
    "a patch that the beam lights all at once": (SMALL_SCAN, 12.0),
}


def write(folder: Path, name: str, *, targets: bool) -> tuple[Path, Any]:
    """The phase history of a target, or of clutter, and the grid of its image."""
    changes, width = SCENES[name]
    text = scene(**changes)
    (folder / "empty.toml").write_text(text)
    plan = planned(folder / "empty.toml", blocks=2)
    half = width or 70.0
    x, y, _ = plan.geometry.ground_point(np.array(30e3), np.array(plan.blocks[0].high))  # of a seam
    grid = ((x - half, x + half, 0.5), (y - half, y + half, 0.5))
    (x0, x1, _), (y0, y1, _) = grid
    if targets:
        # One only: the side lobes of another would be as high as those to be measured.
        text += f'\n[[targets]]\nname = "T"\nx = {(x0 + x1) / 2 + 1.3}\ny = {(y0 + y1) / 2 - 0.7}\n'
    else:
        text += f"\n[clutter]\nscatterers = 4000\nseed = 3\nx = [{x0 - 60}, {x1 + 60}]\ny = [{y0 - 60}, {y1 + 60}]\n"
    (folder / "scene.toml").write_text(text)
    return Path(blocksar.simulate(folder / "scene.toml", folder / "ph.zarr")), grid


def test_weighted_targets_have_the_ideal_response(tmp_path: Path) -> None:
    store, grid = write(tmp_path, "steered", targets=True)
    blocksar.focus(store, tmp_path / "run", blocks=2, grid=grid, weighting=TAYLOR.text, workers=0)
    report = blocksar.quality(tmp_path / "run")
    assert len(report.result["targets"]) == 1
    assert report.result["weighting"] == {"range": TAYLOR.text, "azimuth": TAYLOR.text}
    for target in report.result["targets"]:
        assert target["full_dwell"] and target["covered"]
        for axis in ("range", "azimuth"):
            assert target[f"{axis}_pslr"] == pytest.approx(-35.17, abs=0.5), target
            assert target[f"{axis}_irw"] == pytest.approx(target[f"{axis}_irw_theory"], rel=0.01), target
        assert max(abs(target["error_x"]), abs(target["error_y"])) <= 0.02
        assert abs(complex(*target["value"])) == pytest.approx(1.0, abs=0.005)
    with pytest.raises(FolderError, match="weighting_range 'taylor:4:-35'"):
        blocksar.focus(store, tmp_path / "run", blocks=2, grid=grid, workers=0)
    blocksar.report(tmp_path / "run")
    page = " ".join((tmp_path / "run" / "report.html").read_text().split())
    assert "weighting-azimuth" in page and "side lobes within 0.5 dB of" in page


@pytest.mark.parametrize(("name", "azimuth", "least"), [
    pytest.param("steered", "hann", 51.0, marks=pytest.mark.slow),  # the others cover it
    ("a patch that the beam lights all at once", "taylor:4:-35", 50.0),
    ("wide band", "taylor:4:-35", 46.0),
])  # fmt: skip
def test_weighted_clutter_is_that_of_back_projection(name: str, azimuth: str, least: float, tmp_path: Path) -> None:
    """Error power after one complex gain."""
    store, grid = write(tmp_path, name, targets=False)
    weighting = Weighting.parse("taylor:4:-35", azimuth=azimuth)
    chosen = {"weighting": "taylor:4:-35", "weighting_azimuth": azimuth}
    grid = tuple((a, b, 2.0 if b - a > 50 else 0.5) for a, b, _ in grid)
    blocks = 6 if name == "wide band" else 2
    blocksar.focus(store, tmp_path / "run", blocks=blocks, fidelity=0.999995, grid=grid, workers=0, **chosen)
    image = blocksar.open(tmp_path / "run").image
    history = stores.open_phase_history(store)
    geometry = Geometry(collection=history.collection.centred())
    x, y = image.x.values, image.y.values
    exact = form_image(lambda p: history.read(p, slice(None)), geometry, x, y, threads=2, weighting=weighting)
    both = np.isfinite(exact) & np.isfinite(image.values) & geometry.beam.has_full_dwell(x, y[:, None])
    assert both.mean() > 0.9
    found, wanted = image.values[both], exact[both]
    gain = np.vdot(wanted, found) / np.vdot(wanted, wanted)
    error = np.mean(np.abs(found / gain - wanted) ** 2) / np.mean(np.abs(wanted) ** 2)
    assert -10 * np.log10(error) > least
    assert abs(gain - 1) < 2e-3


RIM = """
[radar]
carrier = 9.6e9
bandwidth = 50e6
range_sampling = 60e6
prf = 600
[track]
position = [0.0, 0.0, 5000.0]
velocity = [0.0, 200.0, 0.0]
[time]
duration = 2.0
[beam]
mode = "spotlight"
width_deg = 1.5
pattern = "gaussian"
[scene]
swath = [9700.0, 10300.0]
centre_yaw_deg = 0.0
reference_range = "constant"
[[targets]]
name = "T"
x = 8400.0
y = 100.0
"""


def test_the_rim_of_a_staring_beam(tmp_path: Path) -> None:
    """Weights there tilt over the aperture: a target lost its first 30 of 1200 pulses, and was 42 dB from the exact."""
    (tmp_path / "scene.toml").write_text(RIM)
    blocksar.simulate(tmp_path / "scene.toml", tmp_path / "ph.zarr")
    asked: dict[str, Any] = {"grid": ((8390.0, 8410.0, 1.0), (97.0, 103.0, 0.25)), "weighting": TAYLOR.text}
    images = []
    for name, how in (("chosen", {"fidelity": 0.999999}), ("exact", {"processor": "backprojection"})):
        blocksar.focus(tmp_path / "ph.zarr", tmp_path / name, workers=0, threads=1, **asked, **how)  # type: ignore[arg-type]
        images.append(blocksar.open(tmp_path / name).image.values)
    error = np.linalg.norm(images[0] - images[1]) / np.linalg.norm(images[1])
    assert error < 10 ** (-55 / 20)
