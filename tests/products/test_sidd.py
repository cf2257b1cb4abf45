"""SIDD files of a small run, read back by sarkit and verified with its checker."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import sarkit.sidd as sksidd
import shapely
from numpy.polynomial import polynomial
from sidd_files import Sidd, read_sidd
from small_run import DAYTON, TARGETS, Made, hilly, make, ridge

import blocksar
from blocksar.collection.georeference import Georeference
from blocksar.products.shared_metadata import MARKS


def assert_sound(found: Sidd) -> None:
    assert not found.checked.failures() and len(found.checked.passes()) >= 18


TURNED = Georeference(latitude=-33.1, longitude=151.2, height=40.0, rotation=200.0)
FAR_EAST = Georeference(latitude=-16.0, longitude=179.99999, height=5.0)  # and west of 180 degrees


@pytest.mark.slow
@pytest.mark.parametrize(
    ("look", "looks", "frame"),
    [(0.0, "1x1", DAYTON), (0.9, "2x3", FAR_EAST), (2.6, "1x1", TURNED), (-1.9, "3x2", DAYTON)],
)
def test_pixels_are_decibels_at_their_places_on_the_plane(
    look: float, looks: str, frame: Georeference, tmp_path: Path
) -> None:
    run = make(tmp_path, look=look, frame=frame, steered=True)
    said = blocksar.export("sidd", run.folder, tmp_path / "a.nitf", looks=looks, range="-50:0").summary
    found = read_sidd(tmp_path / "a.nitf")
    assert_sound(found)
    assert any(line == "8 bits: 1 is -50 dB, 255 is 0 dB, 0 is not covered" for line in said)
    along_y, along_x = map(int, looks.split("x"))
    n_y, n_x = run.y.size // along_y, run.x.size // along_x
    power = np.abs(run.image[: n_y * along_y, : n_x * along_x].astype(np.complex128)) ** 2
    mean = power.reshape(n_y, along_y, n_x, along_x).mean(axis=(1, 3))
    with np.errstate(divide="ignore"):
        level = np.clip(np.rint(1 + (10 * np.log10(mean) + 50) / 50 * 254), 1, 255)
    wanted = np.where(np.isnan(mean), 0, level)
    # Each value, found by the place on the Earth of the middle of its cell.
    x, y = (axis[: n * side].reshape(n, side).mean(axis=1) for axis, n, side in
            ((run.x, n_x, along_x), (run.y, n_y, along_y)))  # fmt: skip
    points = np.stack([*np.meshgrid(x, y), np.zeros((n_y, n_x))], axis=-1)
    at = found.row_and_column(frame.to_ecef(points))
    row, column = np.moveaxis(np.rint(at).astype(int), -1, 0)
    assert np.abs(at - np.rint(at)).max() < 1e-6 and sorted(found.pixels.shape) == sorted(wanted.shape)
    # A rounding of float32 can fall on the other side of a half.
    difference = np.abs(found.pixels[row, column].astype(int) - wanted)
    assert difference.max() <= 1 and (difference == 0).mean() > 0.999
    assert (found.pixels == 0).any() and (found.pixels > 200).any()


@pytest.mark.slow
def test_targets_and_shadows_lie_as_the_metadata_say(tmp_path: Path) -> None:
    run = make(tmp_path, look=0.9, steered=True, hole=False)
    blocksar.export("sidd", run.folder, tmp_path / "a.nitf")
    found = read_sidd(tmp_path / "a.nitf")
    assert_sound(found)
    table = found.load("Display/NonInteractiveProcessing/ProductGenerationOptions/DataRemapping/Custom/LUTInfo")[0]
    assert table[0] == 0 and table[-1] == 65535 and (np.diff(table[1:]) >= 0).all()
    reference, coefficients = (found.load(f"Measurement/PlaneProjection/{name}")
                               for name in ("ReferencePoint/Point", "TimeCOAPoly"))  # fmt: skip
    for target in TARGETS:
        at = found.row_and_column(DAYTON.to_ecef(np.array([target.x, target.y, 0.0])))
        row, column = np.rint(at).astype(int)
        chip = found.pixels[row - 3 : row + 4, column - 3 : column + 4]
        assert np.abs(np.array(np.unravel_index(chip.argmax(), chip.shape)) - 3).max() <= 1
        first, last = run.source.geometry.beam.dwell(np.array(target.x), np.array(target.y))
        time = polynomial.polyval2d(*(at - reference), coefficients) + run.collection.time[0]
        assert time == pytest.approx((first + last) / 2, abs=0.005 * (last - first))
    # Rows run away from the radar, by 45 degrees at most: shadows fall down, 90 degrees in the way of the standard.
    assert abs(found.load("ExploitationFeatures/Collection/Phenomenology/Shadow")[0] - 90) < 45
    assert found.text("Display/InteractiveProcessing/GeometricTransform/Orientation/ShadowDirection") == "DOWN"
    assert found.text("ExploitationFeatures/Collection/Information/RadarMode/ModeType") == "DYNAMIC STRIPMAP"


def test_amplitudes_of_the_table_are_those_of_the_pixels(made: Made, tmp_path: Path) -> None:
    blocksar.export("sidd", made.folder, tmp_path / "a.nitf", range="-40:0")
    found = read_sidd(tmp_path / "a.nitf")
    table = found.load("Display/NonInteractiveProcessing/ProductGenerationOptions/DataRemapping/Custom/LUTInfo")[0]
    amplitude = np.abs(made.image)
    inside = (amplitude > 10 ** (-39 / 20)) & (amplitude < 1)
    points = np.stack([*np.meshgrid(made.x, made.y), np.zeros(made.image.shape)], axis=-1)
    row, column = np.moveaxis(np.rint(found.row_and_column(DAYTON.to_ecef(points))).astype(int), -1, 0)
    told = table[found.pixels[row, column]] / 65535
    np.testing.assert_allclose(told[inside], amplitude[inside], rtol=0.011)  # half a step is 0.08 dB; whole numbers


@pytest.mark.slow
@pytest.mark.parametrize("frame", [DAYTON, FAR_EAST], ids=["Dayton", "far east"])
def test_an_image_on_a_terrain_is_orthorectified_at_its_heights(frame: Georeference, tmp_path: Path) -> None:
    terrain = hilly((0.0, 0.0))
    run = make(tmp_path, frame=frame, steered=True, terrain=terrain, formed_on_it=True, hole=False)
    blocksar.export("sidd", run.folder, tmp_path / "a.nitf", range="-40:0")
    found = read_sidd(tmp_path / "a.nitf")
    assert_sound(found)
    spacing = found.load("Measurement/GeographicProjection/SampleSpacing")
    for target in TARGETS:
        x, y = np.array(target.x), np.array(target.y)
        at = found.row_and_column(frame.to_ecef(np.array([x, y, terrain(x, y)])))
        row, column = np.rint(at % (360 * 3600 / spacing)).astype(int)  # sarkit counts whole turns of longitude
        chip = found.pixels[row - 3 : row + 4, column - 3 : column + 4]
        assert chip.max() > 240 and np.abs(np.array(np.unravel_index(chip.argmax(), chip.shape)) - 3).max() <= 1


def test_valid_data_are_the_outline_of_what_is_covered(made: Made, tmp_path: Path) -> None:
    blocksar.export("sidd", made.folder, tmp_path / "a.nitf")
    found = read_sidd(tmp_path / "a.nitf")
    outline = shapely.Polygon(found.load("Measurement/ValidData"))
    covered = np.argwhere(found.pixels > 0)
    assert shapely.contains_xy(outline.buffer(1e-6), *covered.T).all()
    hull = shapely.MultiPoint(covered).convex_hull
    assert outline.symmetric_difference(hull).area < 0.01 * hull.area
    degrees = found.load("GeoData/ValidData")
    ecef = sksidd.pixel_to_ecef(found.tree, found.load("Measurement/ValidData").astype(float))
    np.testing.assert_allclose(DAYTON.to_geodetic(DAYTON.from_ecef(ecef))[:, :2], degrees, atol=1e-9)


@pytest.mark.slow
def test_parts_and_ends_of_the_image(tmp_path: Path) -> None:
    """A crop; an image with layover and shadow; a classification, a polarization and a sensor of a long name."""
    run = make(tmp_path / "plane", hole=False)
    blocksar.export("sidd", run.folder, tmp_path / "crop.nitf", crop="-10:12,-8:9")
    found = read_sidd(tmp_path / "crop.nitf")
    assert_sound(found)
    assert sorted(found.pixels.shape) == sorted((sum(abs(run.y - 0.5) <= 8.5), sum(abs(run.x - 1) <= 11)))
    steep = make(tmp_path / "ridge", terrain=ridge(base=30.0), formed_on_it=True)
    blocksar.export("sidd", steep.folder, tmp_path / "ridge.nitf", looks="2x2")
    assert_sound(read_sidd(tmp_path / "ridge.nitf"))
    marked = make(tmp_path / "secret", more={"classification": "SECRET", "channel": "HV", "collector": "Ü" * 60})
    blocksar.export("sidd", marked.folder, tmp_path / "secret.nitf")
    secret = read_sidd(tmp_path / "secret.nitf")
    assert_sound(secret)
    assert secret.tree.find("{*}ProductCreation/{*}Classification").get("{urn:us:gov:ic:ism:13}classification") == "S"
    assert secret.text("ExploitationFeatures/Product/Polarization/RcvPolarizationProc") == "V"
    assert "SECRET" in MARKS
