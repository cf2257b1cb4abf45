"""A bistatic pair with 40 degrees between from its arrays to the measured image, and what others say of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

import blocksar
from blocksar import stores
from blocksar.collection.georeference import Georeference
from blocksar.constants import SPEED_OF_LIGHT

N, CARRIER, GRID, WRONG = 200, 10e9, "-45:75:0.75,-75:45:0.75", blocksar.InputError
TIME, BAND = (np.arange(N) - N / 2) / 250.0, (np.arange(128) - 64) * 0.7e6
TARGETS = {"A": (30.0, -24.0, 1.0), "B": (-15.0, 12.0, 0.5j)}


def flown(distance: float, bearing: float, height: float, speed: float) -> np.ndarray:
    u = np.array([np.cos(np.radians(bearing)), np.sin(np.radians(bearing))])
    ground = -distance * u + np.outer(speed * TIME, [-u[1], u[0]])
    return np.column_stack([ground, np.full(N, height)])


def history(**changes: Any) -> Any:
    t, r = flown(8000.0, -20.0, 5000.0, 150.0), flown(7000.0, 20.0, 4000.0, 120.0)
    reference = (np.linalg.norm(t, axis=1) + np.linalg.norm(r, axis=1)) / 2
    signal = np.zeros((N, BAND.size), complex)
    for x, y, sigma in TARGETS.values():
        way = np.linalg.norm(t - [x, y, 0.0], axis=1) + np.linalg.norm(r - [x, y, 0.0], axis=1)
        signal += sigma * np.exp(-4j * np.pi / SPEED_OF_LIGHT * np.outer(way / 2 - reference, CARRIER + BAND))
    given = {
        "signal": signal.astype(np.complex64), "time": TIME, "range_frequency": BAND, "transmitter_position": t,
        "receiver_position": r, "reference_range": reference, "carrier_frequency": CARRIER,
        "georeference": {"kind": "ENU", "latitude": 40.0, "longitude": 9.0, "height": 100.0},
        "targets": [{"name": n, "x": x, "y": y, "reflectivity": s} for n, (x, y, s) in TARGETS.items()],
    }  # fmt: skip
    return blocksar.collection(**{**given, **changes})


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    path = tmp_path_factory.mktemp("bistatic")
    blocksar.write(history(), path / "ph.zarr")
    blocksar.focus(path / "ph.zarr", path / "run", grid=GRID, workers=0, progress=False)
    return path / "ph.zarr", path / "run"


def test_the_store_has_two_antennas_and_no_middle(made: tuple[Path, Path]) -> None:
    with xr.open_zarr(made[0], consolidated=False) as opened:
        assert "antenna_position" not in opened.variables
        assert opened["receiver_position"].attrs["units"] == "m"
    read = stores.open_phase_history(made[0]).collection
    assert read.bistatic and read.transmitter_position is not None
    np.testing.assert_array_equal(read.transmitter_position, flown(8000.0, -20.0, 5000.0, 150.0))
    facts = {row[0]: row[1] for row in blocksar.info(made[0]).tables[0][1]}
    assert facts["receiver"].startswith("95.52 m at 120 m/s, at x = -6577.85")


def test_the_image_and_its_figures_are_those_of_the_pair(made: tuple[Path, Path]) -> None:
    plan = blocksar.plan(made[0], grid=GRID, workers=0)
    assert "hierarchical-backprojection cannot: transmitter and receiver are two antennas" in plan.summary[0]
    for found in blocksar.quality(made[1]).result["targets"]:
        assert complex(*found["value"]) == pytest.approx(1, abs=0.01)
        assert abs(found["error_x"]) < 0.05 and abs(found["error_y"]) < 0.05
        for cut in ("range", "azimuth"):
            assert found[f"{cut}_irw"] == pytest.approx(found[f"{cut}_irw_theory"], rel=0.01)
            assert found[f"{cut}_pslr"] == pytest.approx(-13.26, abs=0.3)


ELSEWHERE: dict[str, Callable[[Path, Path, Path], Any]] = {
    "check": lambda ph, run, out: blocksar.check(ph, grid=GRID),
    "autofocus": lambda ph, run, out: blocksar.autofocus(ph, out / "a.zarr", grid=GRID, workers=0, progress=False),
    "keystone-resampling": lambda ph, run, out: blocksar.focus(
        ph, out / "run", grid=GRID, processor="keystone-resampling", workers=0, progress=False
    ),
    "a terrain": lambda ph, run, out: blocksar.plan(ph, grid=GRID, terrain=hills(out), workers=0),
    "a SICD": lambda ph, run, out: blocksar.export("sicd", run, out / "a.nitf"),
    "a SIDD": lambda ph, run, out: blocksar.export("sidd", run, out / "a.nitf"),
    "backscatter": lambda ph, run, out: blocksar.export("png", run, out / "a.png", quantity="sigma0"),
    "a STAC item": lambda ph, run, out: blocksar.export("stac", run, out / "a.json"),
}


def hills(out: Path) -> Path:
    axis = np.linspace(-200.0, 200.0, 41)
    path = out.with_name(f"{out.name}-hills.zarr")
    height = xr.Dataset({"height": (("y", "x"), np.outer(axis, axis) / 1e4)}, {"x": axis, "y": axis})
    height.to_zarr(path, consolidated=False)
    return path


@pytest.mark.parametrize("who", ELSEWHERE)
def test_who_needs_one_antenna_says_so(who: str, made: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(WRONG, match=f"{who} needs one antenna, but transmitter and receiver are two antennas; "):
        ELSEWHERE[who](*made, tmp_path)
    assert not list(tmp_path.iterdir())


def test_geotiff_preview_and_looks_are_made(made: tuple[Path, Path], tmp_path: Path) -> None:
    blocksar.export("geotiff", made[1], tmp_path / "a.tif")
    blocksar.preview(made[0], grid=GRID, out=tmp_path / "a.png")
    assert blocksar.plan(made[0], grid=GRID, looks=2, workers=0).refusal is None


def test_a_pair_is_given_whole() -> None:
    with pytest.raises(WRONG, match="transmitter_position is given without receiver_position"):
        history(receiver_position=None)
    with pytest.raises(WRONG, match="transmitter_position and antenna_position are both given"):
        history(antenna_position=flown(8000.0, 0.0, 5000.0, 150.0))
    with pytest.raises(WRONG, match=r"antenna_position .* is missing"):
        history(transmitter_position=None, receiver_position=None)


def test_earth_centred_antennas_are_carried_into_the_frame(made: tuple[Path, Path]) -> None:
    read = stores.open_phase_history(made[0])
    frame = Georeference.among(read.attrs)
    assert frame is not None
    places = {name: frame.to_ecef(getattr(read.collection, name)) for name in read.collection.antennas}
    again = stores.history_in_memory(history(**places, earth_centred=True)).collection
    for name in read.collection.antennas:
        np.testing.assert_allclose(getattr(again, name), getattr(read.collection, name), atol=1e-6)
