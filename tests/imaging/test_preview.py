"""Previews: bright points stand at their places, wherever they lie between pixels, for every kind of collection."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from axis_beams import axis_scene
from matplotlib.image import imread
from scenes import scene, write_store
from typer.testing import CliRunner

import blocksar
from blocksar import stores
from blocksar.cli import commands
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.imaging.preview import form_preview, plan_preview
from blocksar.processors.exact.sums import form_image

POINTS = [(29_800.3, 48.2), (29_951.7, 50.13), (30_102.9, 51.9)]  # range in m, yaw in degrees
TARGETS = "".join(f'[[targets]]\nname = "P{rng:.0f}"\nrange = {rng}\nyaw_deg = {yaw}\n' for rng, yaw in POINTS)
CLUTTER = "[clutter]\nscatterers = 1500\npower = 1e-3\nseed = 4\n"


def places_of(store: Path) -> Any:
    return np.array([(target["x"], target["y"]) for target in stores.open_phase_history(store).attrs["targets"]])


def check_places(power: Any, places: Any) -> None:
    """The brightest pixel near each place is one of its neighbours, and stands out."""
    step = float(power.x[1] - power.x[0])
    for place in places:
        near = power.sel({name: slice(at - 6 * step, at + 6 * step) for name, at in zip("xy", place, strict=True)})
        row, column = np.unravel_index(int(np.nanargmax(near.values)), near.shape)
        assert abs(near.x.values[column] - place[0]) < step, place
        assert abs(near.y.values[row] - place[1]) < step, place
        assert near.values[row, column] > 10 * np.nanmedian(power.values)
        assert 0.25 < near.values[row, column] < 1.3  # of 1, between four pixels at the worst


@pytest.mark.slow
@pytest.mark.parametrize("raw", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_points_of_a_steered_collection_stand_at_their_places(raw: bool, tmp_path: Path) -> None:
    store = write_store(tmp_path, raw=raw, swath=[29_600.0, 30_300.0], more=TARGETS + CLUTTER)
    check_places(blocksar.preview(store, size=300).result, places_of(store))


@pytest.mark.slow
def test_points_of_a_beam_about_its_axis_stand_at_their_places(tmp_path: Path) -> None:
    targets = "".join(
        f'[[targets]]\nname = "P{x:.0f}"\nx = {x}\ny = {y}\n' for x, y in ((9051.3, -20.7), (8952.1, 31.9))
    )
    (tmp_path / "scene.toml").write_text(axis_scene('mode = "stripmap"\nwidth_deg = 0.6\n', more=targets + CLUTTER))
    store = Path(blocksar.simulate(tmp_path / "scene.toml", tmp_path / "phase_history.zarr"))
    pixel = blocksar.preview(store, grid=((9000.0, 9000.5, 1.0), (0.0, 0.5, 1.0)), out=tmp_path / "pixel.png")
    assert pixel.result.shape == (1, 1) and imread(tmp_path / "pixel.png").ndim == 3
    found = blocksar.preview(store, grid=((8900.0, 9100.0, 1.0), (-70.0, 70.0, 1.0)), size=100)
    check_places(found.result, places_of(store))


def unsteered(offset: float = 0.0) -> tuple[Collection, Any]:
    """A spotlight collection about the origin, with two points, and pulses of noise-free samples."""
    time = (np.arange(300) - 150) / 200.0
    track = np.stack([-6000 + 0 * time, 150 * time, 4000 - 3 * time**2], axis=1)
    frequency = (np.arange(128) - 64) * 1e6
    reference = np.linalg.norm(track, axis=1) + offset
    collection = Collection(
        carrier=9.6e9, time=time, range_frequency=frequency, reference_range=reference, antenna_position=track,
        beam_azimuth=np.full(time.size, np.nan),
    ).centred()  # fmt: skip
    signal = np.zeros((time.size, frequency.size), np.complex128)
    for x, y in ((3.3, -11.2), (-20.1, 14.7)):
        distance = np.linalg.norm([x, y, 0.0] - track, axis=1) - collection.reference_range
        signal += np.exp(-4j * np.pi / 299792458.0 * np.outer(distance, collection.carrier + frequency))
    return collection, signal.astype(np.complex64)


def test_an_unsteered_collection_shows_the_ground_that_it_was_held_on(tmp_path: Path) -> None:
    collection, signal = unsteered()
    made: dict[str, Any] = dict(
        signal=signal, time=collection.time, range_frequency=collection.range_frequency,
        reference_range=collection.reference_range, antenna_position=collection.antenna_position,
        carrier_frequency=collection.carrier,
    )  # fmt: skip
    found = blocksar.preview(blocksar.collection(**made), size=200)
    check_places(found.result, [(3.3, -11.2), (-20.1, 14.7)])
    moved, signal = unsteered(offset=60.0)
    elsewhere = blocksar.collection(**{**made, "signal": signal, "reference_range": moved.reference_range})
    with pytest.raises(blocksar.InputError, match="grid is missing"):
        blocksar.preview(elsewhere)


def test_full_resolution_in_one_look_is_back_projection() -> None:
    """A preview finer than the resolution reads everything in one aperture, apart from weighting."""
    collection, signal = unsteered()
    geometry = Geometry(collection=collection)
    planned = plan_preview(geometry, Grid(-30.0, 30.0, 0.4, -30.0, 30.0, 0.4), size=1000)
    assert planned.columns == slice(0, 128) and planned.apertures == [slice(0, 300)]
    power = form_preview(lambda pulses, columns: signal[pulses, columns], planned, threads=2)
    from blocksar.collection.weighting import Weighting

    weighting = Weighting.parse(range="taylor:4:-35", azimuth="taylor:4:-35")
    image = form_image(
        lambda pulses: signal[pulses], geometry, planned.grid.x, planned.grid.y, threads=2, weighting=weighting
    )
    np.testing.assert_allclose(power, np.abs(image) ** 2, atol=2e-5)


def test_lost_pulses_are_left_out_of_the_mean() -> None:
    collection, signal = unsteered()
    geometry = Geometry(collection=collection)
    planned = plan_preview(geometry, Grid(-30.0, 30.0, 1.0, -30.0, 30.0, 1.0), size=60)
    whole = form_preview(lambda pulses, columns: signal[pulses, columns], planned, threads=1)
    signal[::7] = np.nan
    holed = form_preview(lambda pulses, columns: signal[pulses, columns], planned, threads=1)
    peak = np.unravel_index(int(whole.argmax()), whole.shape)
    assert holed[peak] == pytest.approx(whole[peak], rel=0.05)
    signal[:] = np.nan
    assert np.isnan(form_preview(lambda pulses, columns: signal[pulses, columns], planned, threads=1)).all()


@pytest.mark.slow
def test_the_command_writes_a_picture_and_proposes_a_grid(tmp_path: Path) -> None:
    short: Any = {"swath": [29700.0, 30300.0], "prf": 4000.0, "duration": 0.2, "steering": (48.0, 52.0), "dwell": 0.05}
    (tmp_path / "scene.toml").write_text(scene(**short, more=TARGETS + CLUTTER))
    store = Path(blocksar.simulate(tmp_path / "scene.toml", tmp_path / "ph.zarr"))
    done = CliRunner().invoke(
        commands.app, ["preview", str(store), "--out", str(tmp_path / "a.png"), "--size", "300", "--range=-40:0"]
    )
    assert done.exit_code == 0, done.stderr
    assert "a run takes --grid 1" in done.stdout and "of 800 pulses" in done.stdout
    assert f"next: blocksar plan {store}" in " ".join(done.stderr.split())
    assert imread(tmp_path / "a.png")[..., :3].std() > 0.05
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "ph.zarr", "scene.toml"]
