"""Calibration by reflectors of known radar cross-section."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from axis_beams import axis_scene
from small_run import DAYTON, TARGETS, Made, make

import blocksar
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.measurement.reflectors import cross_section

K, PHASE = 4000.0, 0.7  # m2, rad
CORNERS = {"R1": (8532.0, -31.0, 0.8), "R2": (8583.0, 22.0, 1.0), "R3": (8641.0, -22.0, 1.2), "R4": (8697.0, 34.0, 1.5)}
CLUTTER = """
[clutter]
scatterers = 20000
seed = 4
power = 1e-4
x = [8450.0, 8800.0]
y = [-100.0, 100.0]
"""


@pytest.fixture
def made(tmp_path: Path) -> Made:
    return make(tmp_path / "run", hole=False)


def geojson(*features: tuple[str, float, float, dict[str, Any]]) -> str:
    listed = []
    for name, x, y, properties in features:
        latitude, longitude, _ = DAYTON.to_geodetic(np.array([x, y, 0.0]))
        shape = {"type": "Point", "coordinates": [longitude, latitude]}
        listed.append({"type": "Feature", "geometry": shape, "properties": {"name": name, **properties}})
    return json.dumps({"type": "FeatureCollection", "features": listed})


def test_cross_sections_are_those_of_the_handbook() -> None:
    """Of a trihedral of 1 m at 3 cm: 36.7 dB m2."""
    assert 10 * np.log10(cross_section("trihedral", 1.0, 0.03)) == pytest.approx(36.68, abs=0.01)
    assert cross_section("dihedral", 1.0, 0.03) == pytest.approx(6 * cross_section("trihedral", 1.0, 0.03))
    assert cross_section("sphere", 0.2, 0.03) == pytest.approx(np.pi * 0.01)


@pytest.mark.slow
def test_four_trihedrals_in_clutter_calibrate_an_image(tmp_path: Path) -> None:
    """Clutter is 36 dB below the middle ones, and changes these by 0.1 dB; without it all are right to 0.001 dB."""
    wavelength, rows = SPEED_OF_LIGHT / 9.6e9, ""
    for name, (x, y, side) in CORNERS.items():
        amplitude = np.sqrt(cross_section("trihedral", side, wavelength) / K)
        rows += f'[[targets]]\nname = "{name}"\nx = {x}\ny = {y}\namplitude = {amplitude}\n'
        rows += f"phase_deg = {np.degrees(PHASE)}\n"
    beam = 'mode = "tops"\nwidth_deg = 1.2\nrate_deg = 1.0'
    settings: dict[str, Any] = {"bandwidth": 50e6, "range_sampling": 60e6, "prf": 600, "height": 5000.0}
    settings |= {"time": "duration = 2", "swath": [9800.0, 10200.0]}
    (tmp_path / "scene.toml").write_text(axis_scene(beam, more=CLUTTER + rows, **settings))
    blocksar.simulate(tmp_path / "scene.toml", tmp_path / "ph.zarr")
    blocksar.focus(
        tmp_path / "ph.zarr", tmp_path / "run", grid=((8480, 8750, 1.5), (-85, 85, 1.0)), workers=0,
        processor="backprojection", weighting="hamming",
    )  # fmt: skip
    records = [{"name": n, "x": x, "y": y, "kind": "trihedral", "side": side} for n, (x, y, side) in CORNERS.items()]
    (tmp_path / "corners.json").write_text(json.dumps(records))
    report = blocksar.calibrate(tmp_path / "run", tmp_path / "corners.json", out=tmp_path / "calibration.json")
    result = json.loads((tmp_path / "calibration.json").read_text())
    assert 10 * np.log10(result["calibration_factor"] / K) == pytest.approx(0, abs=0.2)
    assert result["phase"] == pytest.approx(PHASE, abs=0.1)
    assert [each["name"] for each in result["reflectors"]] == list(CORNERS)
    for each in result["reflectors"]:
        assert 10 * np.log10(each["factor"] / K) == pytest.approx(0, abs=0.2)
        assert each["phase"] == pytest.approx(PHASE, abs=0.1)
    assert result["reflectors"][1]["over_clutter"] == pytest.approx(1.07 / (20000 / 7e4 * 1e-4 * 8.7), rel=0.4)
    assert "4 reflectors scatter by" in report.summary[0]
    with blocksar.open(tmp_path / "run") as dataset:
        found = dataset.sar.backscatter(calibration=tmp_path / "calibration.json")
    assert found.attrs["calibration_factor"] == result["calibration_factor"]


def test_reflectors_of_geojson_calibrate_what_is_exported(made: Made, tmp_path: Path) -> None:
    """Targets of reflectivity 1 are spheres of one size here: that is the factor."""
    sphere = {"kind": "sphere", "side": 3.0}
    listed = [(target.name, target.x, target.y, sphere) for target in TARGETS] + [("far", 900.0, 0.0, sphere)]
    (tmp_path / "spheres.geojson").write_text(geojson(*listed))
    report = blocksar.calibrate(made.folder, tmp_path / "spheres.geojson")
    assert 10 * np.log10(report.result["calibration_factor"] / (np.pi * 2.25)) == pytest.approx(0, abs=0.05)
    assert report.result["scatter_db"] < 0.1 and abs(report.result["phase"]) < 0.03
    assert any("not measured" in line and "far" in line for line in report.summary)
    file = made.folder / "calibration.json"
    said = blocksar.export("geotiff", made.folder, tmp_path / "a.tif", quantity="sigma0", calibration=str(file)).summary
    assert f"{report.result['calibration_factor']:.6g} m2" in " ".join(said)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ('[{"name": "A", "x": 0, "y": 0, "kind": "cube", "side": 1}]', "give one of trihedral, dihedral, sphere"),
        ('[{"name": "A", "x": 0, "y": 0, "kind": "sphere"}]', "has the side None; give it in m"),
        ('[{"name": "A", "x": 0, "y": 0, "kind": "sphere", "side": -1}]', "above 0 and below"),
        ('[{"name": "A", "x": 900, "y": 0, "kind": "sphere", "side": 1}]', "shows none of the 1 reflectors"),
        ("[]", "holds no list of reflectors"),
        ("[3]", "is 3, not a record"),
        ('[{"name": "A", "y": 0, "kind": "sphere", "side": 1}]', "has no x"),
        ("name,x,y,kind,side\nA,0,0,sphere,wide", "has the side 'wide'"),
    ],
)
def test_wrong_reflectors_are_refused(content: str, said: str, made: Made, tmp_path: Path) -> None:
    (tmp_path / "reflectors.json").write_text(content)
    with pytest.raises(InputError, match=said):
        blocksar.calibrate(made.folder, tmp_path / "reflectors.json")
    assert not (made.folder / "calibration.json").exists()


def test_a_file_that_is_no_calibration_is_refused(made: Made, tmp_path: Path) -> None:
    (tmp_path / "no.json").write_text('{"calibration_factor": -2}')
    (tmp_path / "none.json").write_text("{}")
    with blocksar.open(made.folder) as opened:
        for file, said in (("no.json", "must be positive"), ("none.json", "a file that"), ("gone.json", "a file that")):
            with pytest.raises(InputError, match=said):
                opened.sar.backscatter(calibration=tmp_path / file)
