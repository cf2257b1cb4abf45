"""Backscatter of a run's image: by xarray and in files, against its definition."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import xarray as xr
from small_run import Made, make, ridge

import blocksar
from blocksar.arrays import FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import Weighting
from blocksar.errors import InputError
from blocksar.imaging.response_area import AreaMap
from blocksar.inspection.samples import Inspection
from blocksar.products.backscatter import GroundFactors, valid_pulses
from blocksar.runs.record import Receipt, RunRecord, RunSegment

pytestmark = pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")  # by affine, in rioxarray


def definition(made: Made) -> dict[str, FloatArray]:
    """sigma0, beta0 and gamma0 of an image on the plane z = 0, without calibration."""
    geometry = Geometry(collection=made.collection)
    x, y = np.meshgrid(made.x, made.y)
    sigma = np.abs(made.image.astype(np.complex128)) ** 2 / AreaMap.of(geometry, Weighting()).at(x, y)
    antenna = geometry.track.position(np.array((made.collection.time[0] + made.collection.time[-1]) / 2))
    angle = np.arctan2(np.hypot(antenna[0] - x, antenna[1] - y), antenna[2])
    return {"sigma0": sigma, "beta0": sigma / np.sin(angle), "gamma0": sigma / np.cos(angle)}


def test_backscatter_is_that_of_its_definition(made: Made) -> None:
    with blocksar.open(made.folder) as opened:
        for quantity, wanted in definition(made).items():
            found = opened.sar.backscatter(quantity, calibration=25.0)
            np.testing.assert_allclose(found, 25 * wanted, rtol=1e-4)
            assert found.attrs["calibration_factor"] == 25 and found.attrs["units"] == "1"
            decibel = opened.sar.backscatter(quantity, db=True)
            np.testing.assert_allclose(decibel, 10 * np.log10(wanted), atol=1e-3)
            assert decibel.attrs["units"] == "dB" and "uncalibrated" in decibel.attrs["calibration"]
        name = "surface_backwards_scattering_coefficient_of_radar_wave"
        assert opened.sar.backscatter().attrs["standard_name"] == name


def test_backscatter_of_parts_is_that_of_the_whole_and_computed_when_asked(made: Made) -> None:
    with blocksar.open(made.folder) as opened:
        whole = opened.sar.backscatter("gamma0")
        part = opened.chunk(y=50).isel(y=slice(None, None, -1)).sar.crop(x=(-10, 20)).sar.backscatter("gamma0")
        assert part.chunks is not None and part.dtype == np.float32
        np.testing.assert_allclose(part.sortby("y"), whole.sel(x=part.x), rtol=1e-4)
    tree = xr.open_datatree(made.folder, engine="blocksar")
    np.testing.assert_array_equal(tree.sar.backscatter("gamma0"), whole)


def test_noise_as_backscatter(tmp_path: Path) -> None:
    made = make(tmp_path, size=(60, 50), noise_power=0.5, more={"calibration_factor": 4.0})
    with blocksar.open(made.folder) as opened:
        noise = opened.sar.noise_db("sigma0")
        wanted = definition(made)["sigma0"] / np.abs(made.image) ** 2 * opened.noise_equivalent.values
        np.testing.assert_allclose(noise, 10 * np.log10(4 * wanted), atol=1e-3)
        left = opened.sar.backscatter(subtract_noise=True, calibration=1)
        np.testing.assert_allclose(left, definition(made)["sigma0"] - wanted, rtol=1e-3, atol=1e-7)
        with pytest.raises(InputError, match="no quantity is given"):
            opened.sar.noise_db(calibration=2.0)


def test_each_channel_has_its_backscatter(polarised: Path) -> None:
    names = ["HH", "HV", "VV"]
    members = [blocksar.open(polarised / "channels" / name) for name in names]
    ways: Any = {"data_vars": ["image"], "compat": "override", "coords": "minimal", "join": "override"}
    joint = xr.concat(members, xr.Variable("channel", names), **ways)
    joint.encoding["source"] = str(polarised)
    found = joint.chunk(channel=1).sel(channel=["VV", "HH"]).sar.backscatter()
    for number, name in ((0, "HH"), (2, "VV")):
        one = members[number].sar.backscatter()
        np.testing.assert_array_equal(found.sel(channel=name), one)
        np.testing.assert_array_equal(joint.sel(channel=name).sar.backscatter(), one)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"quantity": "sigma"}, "give one of sigma0, beta0, gamma0"),
        ({"calibration": -1}, "a positive number of m2"),
        ({"subtract_noise": True}, "has no noise_equivalent"),
    ],
)
def test_wrong_arguments_are_refused(arguments: dict[str, Any], said: str, made: Made) -> None:
    with blocksar.open(made.folder) as opened, pytest.raises(InputError, match=said):
        opened.sar.backscatter(**arguments)


def test_a_dataset_without_its_run_is_refused(made: Made) -> None:
    with blocksar.open(made.folder) as opened, pytest.raises(InputError, match=r"open the run with blocksar\.open"):
        xr.Dataset({"image": opened.image}).sar.backscatter()


def test_files_hold_backscatter(made: Made, tmp_path: Path) -> None:
    out, wanted = tmp_path / "sigma0.tif", definition(made)["sigma0"]
    report = blocksar.export("geotiff", made.folder, out, quantity="sigma0", calibration="25")
    assert "sigma0: a target that peaks at 1 has a radar cross-section of 25 m2" in report.summary
    with rasterio.open(out) as file:
        np.testing.assert_allclose(file.read(1)[::-1], 25 * wanted, rtol=1e-4)
        assert file.descriptions == ("sigma0",) and file.tags()["calibration_factor_m2"] == "25.0"
    cells, looks = tmp_path / "cells.tif", (5, 3)
    blocksar.export("geotiff", made.folder, cells, quantity="gamma0", db=True, looks=looks)
    with rasterio.open(cells) as file:
        gamma = definition(made)["gamma0"][: 130 // 5 * 5, : 150 // 3 * 3].reshape(26, 5, 50, 3).mean(axis=(1, 3))
        np.testing.assert_allclose(file.read(1)[::-1], 10 * np.log10(gamma), atol=1e-3)
        assert file.units == ("dB",) and "uncalibrated" in file.tags()["calibration"]
    for options, said in (
        ({"quantity": "sigma0", "content": "power"}, "leave content out"),
        ({"db": True}, "is of a quantity"),
        ({"calibration": 2.0}, "is of a quantity of backscatter"),
        ({"quantity": "sigma0", "calibration": "-3"}, "a positive number of m2"),
        ({"quantity": "nought"}, "give one of sigma0, beta0, gamma0"),
    ):
        with pytest.raises(InputError, match=said):
            blocksar.export("geotiff", made.folder, tmp_path / "no.tif", **options)
        assert not (tmp_path / "no.tif").exists()
    said = blocksar.export("png", made.folder, tmp_path / "beta0.png", quantity="beta0", range="-60:0").summary
    assert "from -60.0 to 0.0 dB" in " ".join(said) and (tmp_path / "beta0.png").exists()
    with pytest.raises(InputError, match="composite"):
        blocksar.export("png", made.folder, tmp_path / "no.png", quantity="beta0", composite="pauli")


def test_on_hills_it_is_that_of_slopes(tmp_path: Path) -> None:
    """gamma0 over that of level ground is what the content gamma is over the power."""
    made = make(tmp_path / "run", terrain=ridge(base=-5.0))
    for name, options in {
        "gamma0": {"quantity": "gamma0"}, "sigma0": {"quantity": "sigma0"}, "gamma": {"content": "gamma"},
    }.items():  # fmt: skip
        blocksar.export("geotiff", made.folder, tmp_path / f"{name}.tif", **options)
    values = {}
    for name in ("gamma0", "sigma0", "gamma"):
        with rasterio.open(tmp_path / f"{name}.tif") as file:
            values[name] = file.read(1)[::-1].astype(np.float64)
    with blocksar.open(made.folder) as opened:
        height, local = opened.height.values, opened.incidence_angle.values
        np.testing.assert_allclose(opened.sar.backscatter("gamma0"), values["gamma0"], rtol=1e-4)
    geometry = Geometry(collection=made.collection)
    x, y = np.meshgrid(made.x, made.y)
    antenna = geometry.track.position(np.array((made.collection.time[0] + made.collection.time[-1]) / 2))
    level = np.cos(np.arctan2(np.hypot(antenna[0] - x, antenna[1] - y), antenna[2] - height))
    area = AreaMap.of(geometry, Weighting()).at(x, y, height)
    np.testing.assert_array_equal(np.isfinite(values["gamma0"]), np.isfinite(values["gamma"]))
    assert 0.2 < np.isfinite(values["gamma"]).mean() < 0.9
    np.testing.assert_allclose(values["gamma0"], values["gamma"] / area / level, rtol=2e-3)
    np.testing.assert_allclose(values["sigma0"], values["gamma0"] * np.cos(local), rtol=1e-3)


def test_pixels_of_several_segments_have_the_areas_of_theirs(made: Made) -> None:
    run = made.source
    half = run.geometry.lit_by(Collection(**{**made.collection.as_dict(), "carrier": 2 * made.collection.carrier}))
    several = (RunSegment(collection=0, path="a", fingerprint="", first_block=0),
               RunSegment(collection=1, path="b", fingerprint="", first_block=3))  # fmt: skip
    both = replace(run, segments=(run.geometry, half), record=replace(run.record, segments=several))
    owner = np.where(made.x < 0, 2, 4) + np.zeros((made.y.size, 1), np.int16)
    owner[:5] = -1
    factors = [
        GroundFactors(replace(run, geometry=geometry), "sigma0").over(made.x, made.y) for geometry in both.segments
    ]
    found = GroundFactors(both, "sigma0").over(made.x, made.y, owner)
    assert np.isnan(found[:5]).all()
    np.testing.assert_array_equal(found[5:], np.where(owner < 3, *factors)[5:])
    assert (factors[1] > 1.9 * factors[0]).all()  # half the wavelength, half the area


def test_pulses_that_were_lost_count_by_the_receipts() -> None:
    lost = Inspection(n_pulse=6, n_column=4, missing={2: 4, 3: 2})
    other = Inspection(n_pulse=6, n_column=4, outliers={3: [1, 2]})
    receipts = [
        Receipt(unit=f"columns-{4 * i}-of-segment-1", stage="recover", found=each.as_dict())
        for i, each in enumerate((lost, other))
    ]
    record = RunRecord(
        status="finished", receipts=(*receipts, Receipt(unit="columns-0-of-segment-11", stage="recover"))
    )
    assert valid_pulses(record, 1) == pytest.approx([1, 1, 0.5, 0.5, 1, 1])
    assert valid_pulses(record, None) is None and valid_pulses(record, 0) is None
