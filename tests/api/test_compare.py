"""Two passes compared: phase, coherence and change against what was simulated."""

from __future__ import annotations

import itertools
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from bursts import CENTRE, SLANT, STEP, ground, write_bursts
from passes import CARRIER, GRID, N, Points, clutter, flight, fly, focus, points, together

import blocksar
from blocksar import stores
from blocksar.collection.geometry import Geometry
from blocksar.collection.terrain import Terrain
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.measurement.interferometry import LinesOfSight, over_window, vertical_wavenumber
from blocksar.places import place
from blocksar.products.pair import Pair
from blocksar.runs.finished import FinishedRun
from blocksar.stores.terrain_store import write_terrain

UP = (2.0, 1.5, 5.0)  # m, by which the second pass lies apart: 4.6 m of it across the line of sight
WAVELENGTH = SPEED_OF_LIGHT / CARRIER


@pytest.fixture(scope="module")
def passes(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Focus a scene once for each of several passes."""
    folder = tmp_path_factory.mktemp("passes")
    made: dict[str, Path] = {}

    def focused(name: str, scene: Points, offset: tuple[float, float, float] = (0.0, 0.0, 0.0), **more: Any) -> Path:
        if name not in made:
            made[name] = focus(fly(scene, offset, **more), folder / name)
        return made[name]

    return focused


@pytest.fixture(autouse=True)
def _without_pictures(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw nothing but where pictures are asked for: that takes longer than all else."""
    if "pictures" not in request.node.name:
        monkeypatch.setattr("blocksar.products.pictures.pair_layers.draw_pair", lambda *_, **__: [])


def mixed(coherence: float) -> Points:
    """Clutter whose correlation with `clutter(1)` is a coherence."""
    first, other = clutter(1), clutter(2)
    return first._replace(reflectivity=coherence * first.reflectivity + np.sqrt(1 - coherence**2) * other.reflectivity)


def sight(offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Any:
    """The line of sight to the origin in the middle of a pass."""
    return LinesOfSight.of(Geometry(collection=flight(offset)), np.array(0.0), np.array(0.0), 0.0).unit


def peak(image: Any, x: float, y: float) -> tuple[int, int]:
    """Row and column of the brightest pixel near a place."""
    row, column = (int(np.abs(axis - at).argmin()) for axis, at in ((image.y.values, y), (image.x.values, x)))
    near = np.abs(image.values[row - 8 : row + 9, column - 8 : column + 9])
    away = np.unravel_index(int(near.argmax()), near.shape)
    return row - 8 + int(away[0]), column - 8 + int(away[1])


@pytest.mark.slow
def test_height_turns_the_phase_by_the_vertical_wavenumber(passes: Any, tmp_path: Path) -> None:
    heights = {(-20.0, -15.0): 0.0, (15.0, -12.0): 1.5, (-14.0, 16.0): 3.0, (18.0, 17.0): -2.0}
    scene = points(*((x, y, h) for (x, y), h in heights.items()))
    a, b = passes("raised-a", scene), passes("raised-b", scene, UP)
    report = blocksar.compare(a, b, tmp_path / "pair", window="3x3", progress=False)
    pair, image = xr.open_zarr(tmp_path / "pair" / "pair.zarr"), blocksar.open(a).image
    for (x, y), height in heights.items():
        at = peak(image, x, y)
        phase = float(np.angle(pair.interferogram.values[at]))
        expected = height * float(pair.vertical_wavenumber.values[at])
        assert np.angle(np.exp(1j * (phase - expected))) == pytest.approx(0.0, abs=0.05)
        assert abs(expected) > 0.3 or height == 0
    assert report.result["vertical_wavenumber"] == pytest.approx(float(pair.vertical_wavenumber[60, 67]), rel=1e-2)


def turned(
    point: tuple[float, float, float], pixel: tuple[float, float, float], antennas: Sequence[Any], wavelength: float
) -> float:
    """Phase of a conj(b) in the pixel of a ground point that shows a point: 4 pi / wavelength times the ranges."""
    a, b = (np.linalg.norm(np.subtract(point, at)) - np.linalg.norm(np.subtract(pixel, at)) for at in antennas)
    return float(4 * np.pi / wavelength * (b - a))


@pytest.mark.slow
def test_on_terrain_only_height_over_it_turns_the_phase(tmp_path: Path) -> None:
    """On a plane at the hill's foot the points at its top would turn by several rad."""
    axis, hill = np.arange(-64.0, 65.0, 2.0), tmp_path / "hill.zarr"

    def height(x: Any, y: Any) -> Any:
        return 20 * np.exp(-(x**2 + y**2) / 2 / 40**2)

    write_terrain(place(hill), Terrain(x0=-64.0, dx=2.0, y0=-64.0, dy=2.0, heights=height(axis, axis[:, None])))
    over = {(-18.0, -12.0): 0.0, (4.0, 3.0): 0.0, (20.0, -14.0): 0.0, (-10.0, 18.0): 1.5}
    scene = points(*((x, y, height(x, y) + h) for (x, y), h in over.items()))
    a, b = (focus(fly(scene, up), tmp_path / f"{up[2]}", terrain=hill) for up in ((0.0, 0.0, 0.0), UP))
    blocksar.compare(a, b, tmp_path / "pair", window="3x3", progress=False)
    pair, image = xr.open_zarr(tmp_path / "pair" / "pair.zarr"), blocksar.open(a)
    antennas = [flight(up).antenna_position[N // 2] for up in ((0.0, 0.0, 0.0), UP)]
    for (x, y), h in over.items():
        row, column = peak(image.image, x, y)
        pixel = float(image.x[column]), float(image.y[row]), float(image.height[row, column])
        expected = turned((x, y, height(x, y) + h), pixel, antennas, WAVELENGTH)
        phase = float(np.angle(pair.interferogram.values[row, column]))
        assert np.angle(np.exp(1j * (phase - expected))) == pytest.approx(0.0, abs=0.05)
        assert abs(expected) < 0.1 if h == 0 else abs(expected) > 0.5


@pytest.mark.slow
def test_mosaics_of_bursts_are_compared_with_the_track_of_each(tmp_path: Path) -> None:
    """A wrong burst's antenna would be off by hundreds of metres; raised targets turn, those on the ground do not."""
    offset = (6.0, 5.0, 15.0)
    raised = {"P1": 4.0, "P3": -3.0}
    yaws = [CENTRE - STEP, CENTRE - 0.75 * STEP, CENTRE, CENTRE - 0.25 * STEP]
    places = [ground(SLANT + 40 * (-1) ** i, yaw) for i, yaw in enumerate(yaws)]
    grid = tuple((min(axis) - 60, max(axis) + 60, 3.0) for axis in zip(*places, strict=True))
    runs, flown = [], []
    for name, away in (("a", (0.0, 0.0, 0.0)), ("b", offset)):
        (tmp_path / name).mkdir()
        bursts = write_bursts(tmp_path / name, places, count=2, offset=away, heights=raised)
        blocksar.focus(bursts, tmp_path / name / "run", grid=grid, blocks=1, workers=0, progress=False)
        runs.append(tmp_path / name / "run")
        flown.append([Geometry(collection=stores.open_phase_history(burst).collection) for burst in bursts])
    blocksar.compare(*runs, tmp_path / "pair", window="3x3", progress=False)
    pair, images = xr.open_zarr(tmp_path / "pair" / "pair.zarr"), [blocksar.open(run).load() for run in runs]
    owners = set()
    for i, (x, y) in enumerate(places):
        row, column = peak(images[0].image, x, y)
        owner = int(images[0].collection[row, column])
        antennas = []
        for geometries in flown:
            first, last = geometries[owner].beam.longest_pass(np.array([x]), np.array([y]))
            antennas.append(geometries[owner].collection.antenna_position[(int(first[0]) + int(last[0])) // 2])
        total = 0j  # over the window, whose pixels of 3 m lie beside the point
        for r, c in itertools.product(range(row - 1, row + 2), range(column - 1, column + 2)):
            pixel = float(images[0].x[c]), float(images[0].y[r]), 0.0
            turn = turned((x, y, raised.get(f"P{i}", 0.0)), pixel, antennas, SPEED_OF_LIGHT / 15e9)
            total += np.prod([abs(complex(image.image[r, c])) for image in images]) * np.exp(1j * turn)
        expected = float(np.angle(total))
        phase = float(np.angle(pair.interferogram.values[row, column]))
        assert np.angle(np.exp(1j * (phase - expected))) == pytest.approx(0.0, abs=0.05)
        assert (abs(expected) > 0.5) == (f"P{i}" in raised)
        owners.add(owner)
    assert owners == {0, 1}


@pytest.mark.slow
def test_motion_along_the_line_of_sight_turns_the_phase(passes: Any, tmp_path: Path) -> None:
    moved = 0.15 * WAVELENGTH * sight(UP)
    a = passes("still", points((3.0, -2.0, 0.0)))
    b = passes("moved", points((3.0 + moved[0], -2.0 + moved[1], moved[2])), UP)
    report = blocksar.compare(a, b, tmp_path / "pair", window="3x3", progress=False)
    pair = xr.open_zarr(tmp_path / "pair" / "pair.zarr")
    phase = float(np.angle(pair.interferogram.values[peak(blocksar.open(a).image, 3.0, -2.0)]))
    assert phase == pytest.approx(4 * np.pi * 0.15, abs=0.05)  # away from the antenna
    assert phase * report.result["displacement_of_a_radian"] == pytest.approx(0.15 * WAVELENGTH, rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize(("coherence", "offset"), [(0.8, (0.0, 0.0, 0.0)), (0.9, UP), (0.5, (0.0, 0.0, 0.0))])
def test_coherence_is_that_of_the_clutter(
    passes: Any, tmp_path: Path, coherence: float, offset: tuple[float, float, float]
) -> None:
    a, b = passes("clutter", clutter(1)), passes(f"mixed-{coherence}-{offset[2]}", mixed(coherence), offset)
    result = blocksar.compare(a, b, tmp_path / "pair", progress=False).result
    # About 3000 independent pixels tell it to 0.01.
    assert result["coherence"] == pytest.approx(coherence * result["surface_coherence"], abs=0.02)
    assert (result["surface_coherence"] < 0.97) == (offset == UP)
    assert result["median_coherence"] > result["coherence"]  # the bias of the estimate
    pair = xr.open_zarr(tmp_path / "pair" / "pair.zarr")
    phase = float(np.angle(pair.interferogram.values.sum()))
    assert phase == pytest.approx(0.0, abs=0.05)  # on the ground nothing remains, whatever the baseline


def test_what_moved_is_found_and_little_else(passes: Any, tmp_path: Path) -> None:
    strong = 6.0
    there, gone = (-12.0, 8.0), (9.0, -10.0)
    a = passes("parked", together(clutter(1), points((*there, 0.0), reflectivity=strong)))
    b = passes("driven", together(mixed(0.95), points((*gone, 0.0), reflectivity=strong)))
    report = blocksar.compare(a, b, tmp_path / "pair", window="5x5", false_alarms=1e-3, progress=False)
    pair = xr.open_zarr(tmp_path / "pair" / "pair.zarr")
    far = np.ones(pair.change.shape, bool)
    for x, y in (there, gone):
        near = pair.change.sel(x=slice(x - 1.5, x + 1.5), y=slice(y - 1.5, y + 1.5))
        assert (near == 1).mean() > 0.8
        far &= (np.abs(pair.y.values[:, None] - y) > 8) & (np.abs(pair.x.values - x) > 8)
    # Neighbouring estimates are not independent: some 100 of them, so that chance may well double the rate.
    assert (pair.change.values[far] == 1).mean() < 0.005
    ratio = pair.amplitude_ratio.sel(x=[there[0], gone[0]], y=[there[1], gone[1]], method="nearest").values
    assert ratio[0, 0] < 0.5 and ratio[1, 1] > 2
    assert report.result["changed"] == int((pair.change.values == 1).sum())


@pytest.mark.parametrize("ground", [0.0, 1.0])
def test_side_lobes_of_still_points_are_not_called_changed(passes: Any, tmp_path: Path, ground: float) -> None:
    still = points((-12.0, 8.0, 0.0), (14.0, 12.0, 0.0), (5.0, -15.0, 0.0), (-20.0, -18.0, 0.0), reflectivity=300.0)
    first, other = (each._replace(reflectivity=ground * each.reflectivity) for each in (clutter(1), mixed(0.95)))
    there, gone = (-3.0, 22.0, 0.0), (22.0, -2.0, 0.0)
    a = passes(f"still-{ground}", together(first, still, points(there, reflectivity=60.0)))
    b = passes(f"still-after-{ground}", together(other, still, points(gone, reflectivity=60.0)), UP)
    report = blocksar.compare(a, b, tmp_path / "pair", window="5x5", progress=False)
    pair = xr.open_zarr(tmp_path / "pair" / "pair.zarr")
    far = np.ones(pair.change.shape, bool)
    for x, y, _ in (there, gone):
        assert int(pair.change.sel(x=x, y=y, method="nearest")) == 1
        far &= (np.abs(pair.y.values[:, None] - y) > 8) | (np.abs(pair.x.values - x) > 8)
    assert (pair.change.values[far] == 1).mean() < 0.003
    assert (pair.change.values[far] == 2).mean() > 0.2
    for x, y in zip(still.x, still.y, strict=True):
        assert int(pair.change.sel(x=x, y=y, method="nearest")) == 0
    assert "not judged" in " ".join(report.summary)


@pytest.mark.slow
def test_what_lies_below_the_noise_is_not_called_changed(passes: Any, tmp_path: Path) -> None:
    dark = clutter(1)
    dark = dark._replace(reflectivity=np.where(dark.x > 5, 0.003, 1.0) * dark.reflectivity)
    runs = [passes(f"noisy-{seed}", dark, noise=400.0, seed=seed) for seed in (1, 2)]
    blocksar.compare(*runs, tmp_path / "pair", progress=False)
    pair = xr.open_zarr(tmp_path / "pair" / "pair.zarr")
    shadow, light = pair.sel(x=slice(9, None)), pair.sel(x=slice(None, 0))
    assert float(shadow.coherence.mean()) < 0.4
    assert float(light.coherence.mean()) > 0.9
    assert float((shadow.change == 1).mean()) < 0.02 and float((shadow.change == 2).mean()) > 0.8
    assert float((light.change == 1).mean()) < 0.01


@pytest.mark.slow
def test_the_store_opens_and_its_pictures_are_there(passes: Any, tmp_path: Path) -> None:
    a, b = passes("clutter", clutter(1)), passes("mixed-0.9-5.0", mixed(0.9), UP)
    out = tmp_path / "pair"
    blocksar.compare(a, b, out, crop="-20:20,-30:10", progress=False)
    assert {each.name for each in out.iterdir()} == {
        "pair.zarr", "phase.png", "coherence.png", "ratio.png", "change.png",
    }  # fmt: skip
    pair = xr.open_zarr(out / "pair.zarr")
    assert float(pair.x[0]) >= -20 and float(pair.y[-1]) <= 10
    assert all(each.read_bytes()[:4] == b"\x89PNG" for each in out.glob("*.png"))


@pytest.mark.slow
def test_a_pair_is_replaced_only_if_that_is_asked_for(passes: Any, tmp_path: Path) -> None:
    a, b, out = passes("clutter", clutter(1)), passes("mixed-0.9-5.0", mixed(0.9), UP), tmp_path / "pair"
    blocksar.compare(a, b, out, crop="-20:20,-30:10", progress=False)
    with pytest.raises(blocksar.InputError, match=r"pair\.zarr exists.*overwrite"):
        blocksar.compare(a, b, out, progress=False)
    blocksar.compare(a, b, out, overwrite=True, progress=False)
    assert xr.open_zarr(out / "pair.zarr").sizes["x"] == len(np.arange(*GRID[0]))


def test_parts_are_those_of_the_whole(passes: Any) -> None:
    runs = [FinishedRun.open(place(passes(*each))) for each in (
        ("clutter", clutter(1)), ("mixed-0.9-5.0", mixed(0.9), UP),
    )]  # fmt: skip
    pair = Pair(a=runs[0], b=runs[1], window=(9, 5), false_alarms=1e-3)
    everything = slice(0, pair.a.y.size), slice(0, pair.a.x.size)
    whole = over_window(pair.a.read(*everything), pair.b.read(*everything), (9, 5))
    part = slice(17, 60), slice(80, pair.a.x.size)
    np.testing.assert_allclose(pair.over_window(*part).inner, whole.inner[part], rtol=1e-9, atol=1e-12)
    x, y = np.meshgrid(pair.a.x[part[1]], pair.a.y[part[0]])
    exact = vertical_wavenumber(pair.a.geometry, pair.b.geometry, x, y)
    np.testing.assert_allclose(pair.wavenumbers(*part), exact, rtol=1e-4)


@pytest.mark.slow
def test_other_grids_are_refused_with_a_command_that_works(passes: Any, tmp_path: Path) -> None:
    a = passes("still", points((3.0, -2.0, 0.0)))
    history = tmp_path / "second.zarr"
    blocksar.write(fly(points((3.0, -2.0, 0.0)), UP), history)
    b = focus(history, tmp_path / "b", grid=((-40.0, 40.0, 0.7), (-36.0, 36.0, 0.6)))
    with pytest.raises(blocksar.InputError, match="the grids differ: x") as refused:
        blocksar.compare(a, b, tmp_path / "pair", progress=False)
    assert not (tmp_path / "pair").exists()
    words = shlex.split(str(refused.value).split("`")[1])
    command = [sys.executable, "-m", "blocksar", *words[1:], "--processor", "backprojection", "--workers", "0", "-q"]
    subprocess.run(command, check=True, capture_output=True)
    blocksar.compare(a, words[words.index("--out") + 1], tmp_path / "pair", progress=False)
