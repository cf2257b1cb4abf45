"""Scenes on the Earth: tracks in Earth-centred coordinates, and ground that follows the ellipsoid."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from cphd_files import failures
from pyproj import Transformer
from satellite_burst import earth_centred, scene_frame

import blocksar
from blocksar import stores
from blocksar.collection.georeference import Georeference
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.simulation.scene import Scene

RANGE = 838027.07  # m, from the satellite to the frame's origin
SCENE = """
title = "burst"
[radar]
carrier = 5.405e9
bandwidth = 56e6
range_sampling = 64e6
prf = 1750
[georeference]
{georeference}
[track]
{track}
[time]
duration = 0.4
[beam]
mode = "tops"
width_deg = 0.28
rate_deg = 1.6
[scene]
swath = [837600.0, 838500.0]
{scene}
{more}
"""


def states(step: float = 10.0, count: int = 3) -> np.ndarray:
    """Rows t, x, y, z, vx, vy, vz of the orbit."""
    time, late = step * np.arange(-count, count + 1), 1e-3
    velocity = (earth_centred(time + late) - earth_centred(time - late)) / (2 * late)
    return np.column_stack([time, earth_centred(time), velocity])


def orbit_scene(**changes: Any) -> str:
    """The text of a scene file with some of its parts replaced."""
    frame = scene_frame()
    place = f"latitude = {frame.latitude!r}\nlongitude = {frame.longitude!r}\nrotation_deg = {frame.rotation!r}"
    track = f"earth_centred = true\nstates = {states().tolist()}"
    return SCENE.format(**{"georeference": place, "track": track, "scene": "", "more": "", **changes})


def test_a_track_of_earth_centred_states_is_carried_into_the_frame(tmp_path: Path) -> None:
    """By states, samples, a file of either, and a polynomial; against PROJ's own topocentric frame."""
    frame, rows = scene_frame(), states()
    np.savetxt(tmp_path / "orbit.csv", rows, delimiter=",", header="t,x,y,z,vx,vy,vz", comments="")
    fits = [np.polynomial.Polynomial.fit(rows[:, 0], column, 6).convert().coef for column in rows[:, 1:4].T]
    tracks = {
        "states": f"states = {rows.tolist()}",
        "samples": f"samples = {rows[:, :4].tolist()}",
        "file": 'file = "orbit.csv"',
        "coefficients": f"coefficients = {np.stack(fits, axis=1).tolist()}",
    }
    to_enu = Transformer.from_pipeline(
        f"+proj=topocentric +ellps=WGS84 +lat_0={frame.latitude!r} +lon_0={frame.longitude!r} +h_0=0"
    )
    turn = np.radians(frame.rotation)
    for name, track in tracks.items():
        scene = Scene.parse(orbit_scene(track=f"earth_centred = true\n{track}"), folder=tmp_path)
        collection = scene.collection()
        east, north, up = to_enu.transform(*earth_centred(collection.time).T)
        x, y = np.cos(turn) * east + np.sin(turn) * north, np.cos(turn) * north - np.sin(turn) * east
        found = collection.antenna_position
        assert np.abs(found - np.stack([x, y, up], axis=1)).max() < (2e-3 if name == "samples" else 1e-4), name
        assert scene.centre.tolist() == [0.0, 0.0, 0.0]
        assert collection.reference_range[0] == pytest.approx(RANGE, abs=0.01)


def test_hills_and_targets_stand_on_the_ellipsoid() -> None:
    more = """
[terrain]
surface = "ellipsoid"
hills = [{x = 300.0, y = 100.0, height = 200.0, width = 900.0}]
[[targets]]
name = "top"
x = 300.0
y = 100.0
[[targets]]
name = "far"
x = -300.0
y = 19000.0
"""
    scene = Scene.parse(orbit_scene(more=more, scene="ground_height = 40.0"))
    top, far = scene.point_targets()
    assert scene.georeference is not None
    for target, over in ((top, 240.0), (far, 40.0)):
        height = scene.georeference.to_geodetic(np.array([target.x, target.y, target.z]))[2]
        assert height == pytest.approx(over, abs=0.01)
    assert far.z == pytest.approx(40 - 19000**2 / 2 / 6.37e6, abs=0.2)
    bare = Scene.parse(orbit_scene(more=more[more.index("[[targets]]") :] + '[terrain]\nsurface = "ellipsoid"'))
    assert bare.terrain is not None
    assert float(bare.terrain(np.array(-300.0), np.array(19000.0))) == pytest.approx((far.z or 0) - 40, abs=0.01)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"georeference": "latitude = 45.5"}, "georeference.longitude is missing"),
        ({"georeference": "latitude = 95.0\nlongitude = 0.0"}, "georeference.latitude is 95.0, which is not in -90"),
        ({"georeference": "latitude = -45.5\nlongitude = -14.0"}, "antenna_position falls to z = -6.6"),
        ({"georeference": "latitude = 45.0\nlongitude = -14.0"}, "scene.swath = [837600, 838500]: must contain"),
        ({"track": f"earth_centred = true\nstates = {(states() * [1, 1, 1, 1, 1e-3, 1e-3, 1e-3]).tolist()}"},
         "track.states[5]: the velocity differs by 75"),
        ({"track": f"earth_centred = true\nstates = {states()[::-1].tolist()}"}, "track.states: t must ascend"),
        ({"track": f"earth_centred = true\nstates = {states()[:, :6].tolist()}"}, "track.states[0] = "),
        ({"track": f"earth_centred = true\nstates = {(states() + np.eye(7)[0] * 20)[3:].tolist()}"},
         "track.states run from t = 20"),
        ({"more": '[terrain]\nvertical = "egm96"\nhills = [{x = 1.0, y = 1.0, height = 1.0, width = 90.0}]'},
         "terrain.vertical = 'egm96', but there is no terrain; leave vertical out"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_with_its_value(changes: dict[str, str], expected: str) -> None:
    with pytest.raises(InputError) as caught:
        Scene.parse(orbit_scene(**changes))
    assert str(caught.value).split("\n  ")[1].startswith(expected), caught.value


def test_what_needs_the_earth_asks_for_a_georeference() -> None:
    text = orbit_scene(more='[terrain]\nsurface = "ellipsoid"').replace("[georeference]", "").splitlines()
    text = [line for line in text if not line.startswith(("latitude", "longitude", "rotation_deg"))]
    with pytest.raises(InputError) as caught:
        Scene.parse("\n".join(text))
    assert str(caught.value).count("georeference is missing: ") == 2
    assert "track.earth_centred = true needs it" in str(caught.value)


TARGET = '[[targets]]\nname = "T"\nx = 60.0\ny = -30.0\n[terrain]\nsurface = "ellipsoid"\n'


@pytest.mark.slow
def test_an_image_of_a_scene_on_the_ellipsoid_has_its_target_in_place(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(orbit_scene(more=TARGET))
    box = ((-80.0, 200.0, 2.0), (-230.0, 170.0, 5.0))
    foreseen = blocksar.plan(tmp_path / "scene.toml", blocks=1, surface="ellipsoid", grid=box)
    assert any(line.startswith("terrain: z = -0.0") for line in foreseen.summary)
    blocksar.simulate(tmp_path / "scene.toml", tmp_path / "ph.zarr")
    history = stores.open_phase_history(tmp_path / "ph.zarr")
    assert Georeference.from_attribute(history.attrs["georeference"]) == scene_frame()
    blocksar.focus(tmp_path / "ph.zarr", tmp_path / "run", grid=box, blocks=1, surface="ellipsoid", workers=0)
    (target,) = blocksar.quality(tmp_path / "run").result["targets"]
    assert np.hypot(target["error_x"], target["error_y"]) < 0.05
    assert complex(*target["value"]) == pytest.approx(1.0, abs=0.01)


@pytest.mark.slow
def test_a_cphd_file_lies_where_the_georeference_says(tmp_path: Path) -> None:
    """The ingested frame points east and north; its track is the orbit, and its target where the scene has it."""
    error = "earth_centred = true\nstates = " + str(states().tolist()) + "\nerror = {offset = [0.5, 0.0, 0.0]}"
    longitude = scene_frame().longitude
    text = orbit_scene(more=TARGET, track=error).replace(f"longitude = {longitude!r}", f"longitude = {longitude % 360}")
    scene = Scene.parse(text)
    blocksar.simulate(scene, tmp_path / "orbit.cphd", cphd=True)
    assert failures(tmp_path / "orbit.cphd") == []
    blocksar.ingest("cphd", tmp_path / "orbit.cphd", tmp_path / "ph.zarr")
    history = stores.open_phase_history(tmp_path / "ph.zarr")
    frame, collection = Georeference.from_attribute(history.attrs["georeference"]), history.collection
    wanted = scene_frame()
    assert (frame.latitude, frame.longitude) == pytest.approx((wanted.latitude, wanted.longitude), abs=1e-9)
    assert frame.rotation == 0.0 and frame.height == pytest.approx(0.0, abs=1e-4)
    track = frame.to_ecef(collection.antenna_position)
    assert np.abs(track - earth_centred(collection.time)).max() < 1e-4
    truth = xr.open_zarr(tmp_path / "orbit.truth.zarr").antenna_position.values
    flown = frame.to_ecef(truth) - earth_centred(scene.pulse_times)
    np.testing.assert_allclose(flown, np.tile(0.5 * wanted.axes[0], (len(flown), 1)), atol=1e-4)
    # The range of the target that the stored phase has is that of its place on the Earth.
    (target,) = scene.point_targets()
    place = frame.from_ecef(wanted.to_ecef(np.array([target.x, target.y, target.z])))
    middle = collection.n_pulse // 2
    away = np.linalg.norm(place - collection.antenna_position, axis=1)[middle] - collection.reference_range[middle]
    signal = history.read(slice(middle, middle + 1), slice(None))[0]
    step = np.angle((signal[1:] * signal[:-1].conj()).sum())
    assert -step * SPEED_OF_LIGHT / (4 * np.pi * collection.range_frequency_step) == pytest.approx(away, abs=1.0)
