"""SICD files of a small run, read back by sarkit and verified with its checker."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
import sarkit.sicd as sksicd
import shapely
from axis_beams import axis_collection, with_patterns
from numpy.polynomial import polynomial
from sicd_files import Sicd, errors, read_sicd
from small_run import DAYTON, TARGETS, Made, hilly, make, upsampled_peak
from summed_response import summed_response

import blocksar
from blocksar import stores
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import Weighting
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.measurement.targets import Target
from blocksar.places import place
from blocksar.products.shared_metadata import Layout, cut_width, find_support, lay_out, valid_data
from blocksar.runs import finished

LOOKS = [(0.1, False), (0.9, False), (2.6, False), (-1.9, True)]  # rad, with a beam; rows run along each direction


@pytest.fixture(scope="module", params=LOOKS, ids=str)
def exported(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Made, Sicd]:
    look, steered = request.param
    run = make(tmp_path_factory.mktemp("sicd"), look=look, steered=steered, hole=not steered)
    blocksar.export("sicd", run.folder, run.folder / "image.nitf")
    return run, read_sicd(run.folder / "image.nitf")


def test_sicd_passes_the_checker_without_errors(exported: tuple[Made, Sicd]) -> None:
    assert errors(exported[1].checked) == []
    assert len(exported[1].checked.passes()) > 40


@pytest.mark.slow
def test_a_weighted_image_has_its_weights(tmp_path: Path) -> None:
    """The -3 dB width of a cut follows from the weights along its band, and is larger than without a weighting."""
    plain, weighted = (make(tmp_path / name, hole=False, weighting=name) for name in ("uniform", "hamming"))
    files = []
    for run in (plain, weighted):
        blocksar.export("sicd", run.folder, run.folder / "image.nitf")
        files.append(read_sicd(run.folder / "image.nitf"))
        assert errors(files[-1].checked) == []
    for direction in ("Row", "Col"):
        assert files[0].load(f"Grid/{direction}/WgtFunct") is None
        weights = np.asarray(files[1].load(f"Grid/{direction}/WgtFunct"))
        assert files[1].tree.findtext(f"{{*}}Grid/{{*}}{direction}/{{*}}WgtType/{{*}}WindowName") == "UNKNOWN"
        assert weights.size == 65 and weights.max() == 1 and weights[[0, -1]].max() < 0.1
        band = files[1].load(f"Grid/{direction}/ImpRespBW")
        k = ((np.arange(65) + 0.5) / 65 - 0.5) * band
        width = files[1].load(f"Grid/{direction}/ImpRespWid")
        power = np.abs((weights * np.exp(1j * np.pi * k * width)).sum() / weights.sum()) ** 2
        assert power == pytest.approx(0.5, abs=0.005)
        assert width > 1.2 * files[0].load(f"Grid/{direction}/ImpRespWid")


def test_widths_under_a_pattern_are_those_of_the_response() -> None:
    """Half the power of the exact response lies half of ImpRespWid away from its peak, along x and along y."""
    geometry = Geometry(collection=with_patterns(axis_collection(n_pulse=800, beam_width=0.012)))
    target, weighting = Target("P", 9000.0, 12.0), Weighting.parse("taylor:4:-35")
    support = find_support(geometry, np.array([target.x, target.y, 0.0]), weighting)
    for direction in np.eye(2):
        width = cut_width(support.frequencies @ direction, support.weights)
        x, y = np.array([[target.x], [target.y]]) + np.outer(direction, np.array([-0.5, 0.5]) * width)
        power = np.abs(summed_response(geometry, target, x, y, weighting)) ** 2
        np.testing.assert_allclose(power, 0.5, atol=0.01)
    plain = find_support(Geometry(collection=axis_collection(n_pulse=800, beam_width=0.012)), np.array([9000.0, 12, 0]))
    assert support.weights.min() < 0.2 * support.weights.max() and (plain.weights == 1).all()


@pytest.mark.slow
def test_the_noise_of_the_image_is_that_of_the_file(tmp_path: Path) -> None:
    run = make(tmp_path, noise_power=0.7, steered=True, hole=False)
    report = blocksar.export("sicd", run.folder, run.folder / "image.nitf")
    found = read_sicd(run.folder / "image.nitf")
    assert errors(found.checked) == []
    assert found.tree.findtext("{*}Radiometric/{*}NoiseLevel/{*}NoiseLevelType") == "ABSOLUTE"
    assert any("NoisePoly is of order" in line for line in report.summary)
    noise = stores.read_region(run.folder / "image.zarr", "noise_equivalent", (slice(None), slice(None)))
    layout, scp = lay_out(run.source), found.load("ImageData/SCPPixel")
    poly = found.load("Radiometric/NoiseLevel/NoisePoly")
    for row, column in ([20, 30], [60, 70], [100, 110], [125, 15]):
        x, y, _ = layout.point(np.array(float(row)), np.array(float(column)))
        i, j = round((y - run.y[0]) / 0.4), round((x - run.x[0]) / 0.4)
        offset = (np.array([row, column]) - scp) * layout.spacing
        assert polynomial.polyval2d(*offset, poly) == pytest.approx(10 * np.log10(noise[i, j]), abs=0.15)


def test_scale_factors_are_those_of_backscatter(tmp_path: Path) -> None:
    run = make(tmp_path, steered=True, hole=False, more={"calibration_factor": 3.0})
    report = blocksar.export("sicd", run.folder, run.folder / "image.nitf", calibration=40.0)
    found = read_sicd(run.folder / "image.nitf")
    assert errors(found.checked) == []
    assert any("scale factors to backscatter are at most 0.0" in line for line in report.summary)
    assert found.load("Radiometric/RCSSFPoly") == 40
    layout, scp = lay_out(run.source), found.load("ImageData/SCPPixel")
    with blocksar.open(run.folder) as opened:
        scale = opened.sar.backscatter(calibration=40.0) / np.abs(opened.image) ** 2
        gamma = opened.sar.backscatter("gamma0", calibration=40.0) / np.abs(opened.image) ** 2
    slope = np.radians(float(found.tree.findtext("{*}SCPCOA/{*}SlopeAng")))
    for row, column in ([20, 30], [60, 70], [100, 110], scp):
        x, y, _ = layout.point(np.array(float(row)), np.array(float(column)))
        offset, at = (np.array([row, column]) - scp) * layout.spacing, {"x": x, "y": y, "method": "nearest"}
        sigma = polynomial.polyval2d(*offset, found.load("Radiometric/SigmaZeroSFPoly"))
        assert sigma == pytest.approx(float(scale.sel(**at)), rel=0.02)
        assert polynomial.polyval2d(*offset, found.load("Radiometric/GammaZeroSFPoly")) == pytest.approx(
            float(gamma.sel(**at)), rel=0.02
        )
    assert sigma / found.load("Radiometric/BetaZeroSFPoly")[0, 0] == pytest.approx(np.cos(slope), rel=0.01)


def test_sicd_metadata_project_targets_onto_their_peaks(exported: tuple[Made, Sicd]) -> None:
    run, found = exported
    layout = lay_out(run.source)
    for target in TARGETS:
        ecef = DAYTON.to_ecef(np.array([target.x, target.y, 0.0]))
        place, _, success = sksicd.scene_to_image(found.tree, ecef)
        assert success
        row, column = sksicd.xrowycol_to_rowcol(found.tree, place)
        middle = np.rint([row, column]).astype(int)
        chip = found.pixels[middle[0] - 12 : middle[0] + 12, middle[1] - 12 : middle[1] + 12]
        assert np.abs(middle - 12 + upsampled_peak(chip) - [row, column]).max() < 0.1
        assert layout.point(row, column)[:2] == pytest.approx([target.x, target.y], abs=0.01)
        # Inverse projection: the range-Doppler contour of the pixel intersects the ground plane at the target.
        ground, _, success = sksicd.image_to_ground_plane(found.tree, place, ecef, DAYTON.axes[2])
        assert success
        assert ground == pytest.approx(ecef, abs=0.01)


@pytest.mark.slow
def test_an_image_on_a_terrain_projects_to_its_heights(tmp_path: Path) -> None:
    """Targets stand where the standard's projection has them, and their pixels project to their x and y."""
    terrain = hilly((0.0, 0.0))
    run = make(tmp_path, look=-1.9, terrain=terrain, formed_on_it=True, hole=False, about_axis=True)
    report = blocksar.export("sicd", run.folder, tmp_path / "image.nitf")
    assert "laid on the plane z = " in report.summary[0]
    found = read_sicd(tmp_path / "image.nitf")
    assert errors(found.checked) == []
    assert "equal range and Doppler" in found.tree.findtext("{*}ImageFormation/{*}Processing/{*}Type")
    random = np.random.default_rng(3)
    points = [(target.x, target.y) for target in TARGETS] + [tuple(p) for p in random.uniform(-15, 15, (4, 2))]
    for number, (x, y) in enumerate(points):
        z = float(terrain(np.array(x), np.array(y)))
        at, _, success = sksicd.scene_to_image(found.tree, DAYTON.to_ecef(np.array([x, y, z])))
        assert success
        row, column = sksicd.xrowycol_to_rowcol(found.tree, at)
        pixel = np.rint([row, column]).astype(int)
        if number < len(TARGETS):
            chip = found.pixels[pixel[0] - 12 : pixel[0] + 12, pixel[1] - 12 : pixel[1] + 12]
            assert np.abs(chip).max() > 0.9
            peak = pixel - 12 + upsampled_peak(chip)
            assert np.abs(peak - [row, column]).max() < 0.1
            at = sksicd.rowcol_to_xrowycol(found.tree, peak)
        height = DAYTON.to_geodetic(np.array([x, y, z]))[2]
        back, _, success = sksicd.image_to_constant_hae_surface(found.tree, at, height)
        assert success and np.abs(DAYTON.from_ecef(back)[:2] - [x, y]).max() < 0.04  # a tenth of a pixel
        # The pixel has the value of the ground that it projects to, with the carrier's phase of their common range.
        ground = np.array([x, y, z])
        if number % 4:
            continue
        for _ in range(12):
            height = DAYTON.to_geodetic(ground)[2]
            place_there = sksicd.rowcol_to_xrowycol(found.tree, pixel.astype(float))
            ground = DAYTON.from_ecef(sksicd.image_to_constant_hae_surface(found.tree, place_there, height)[0])
            ground[2] = terrain(ground[0], ground[1])
        assert abs(found.pixels[*pixel] - run.exact_value(terrain, ground)) < 1e-2


def test_sicd_pixels_equal_those_of_the_image(exported: tuple[Made, Sicd]) -> None:
    run, found = exported
    layout = lay_out(run.source)
    rows, columns = (v.astype(float).ravel() for v in np.indices(found.pixels.shape))
    points = layout.point(rows, columns)
    j, i = np.rint([(points[:, 0] - run.x[0]) / 0.4, (points[:, 1] - run.y[0]) / 0.4]).astype(int)
    np.testing.assert_array_equal(found.pixels.ravel(), np.nan_to_num(run.image[i, j], nan=0.0))


def test_sicd_valid_data_bound_the_covered_pixels(exported: tuple[Made, Sicd]) -> None:
    _, found = exported
    outline = matplotlib.path.Path(found.load("ImageData/ValidData"))
    covered = np.argwhere(found.pixels != 0)
    assert (
        outline.contains_points(covered, radius=1.5).mean() + outline.contains_points(covered, radius=-1.5).mean() > 1.9
    )
    inside = outline.contains_points(np.argwhere(np.ones(found.pixels.shape)), radius=0.0).sum()
    assert inside == pytest.approx(len(covered), rel=0.03)


SHAPES = {
    "one pixel": lambda i, j: (i == 7) & (j == 3),
    "last pixel": lambda i, j: (i == 29) & (j == 39),
    "one row": lambda i, j: i == 4,
    "one column": lambda i, j: j == 39,
    "slanted": lambda i, j: abs(i - j) < 4,
    "ring": lambda i, j: (np.hypot(i - 15, j - 20) < 14) & (np.hypot(i - 15, j - 20) > 6),
    "spike": lambda i, j: (j < 20) | (i == 9),
    "two": lambda i, j: (j < 10) | (j > 30),
    "all": lambda i, j: i >= 0,
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("look", [0.1, 1.6, 3.1, -1.5])
def test_valid_data_is_a_valid_polygon_around_any_shape(shape: str, look: float) -> None:
    covered = SHAPES[shape](*np.indices((30, 40)))
    some = covered.any(axis=1), covered.any(axis=0)
    spans = []
    for axis, n in ((1, 40), (0, 30)):
        turned = covered if axis == 1 else covered.T
        spans += [np.where(some[1 - axis], turned.argmax(axis=1), n)]
        spans += [np.where(some[1 - axis], n - 1 - turned[:, ::-1].argmax(axis=1), -1)]
    row = np.rint([np.cos(look), np.sin(look)])
    layout = Layout(
        row=row,
        column=np.array([-row[1], row[0]]),
        first=np.zeros(3),
        spacing=(1.0, 1.0),
        shape=(40, 30) if row[0] else (30, 40),
    )
    found = valid_data(finished.Coverage(*spans), layout)
    outline = shapely.Polygon(found)
    assert outline.is_valid
    assert outline.area > 0
    assert not outline.exterior.is_ccw
    assert (found >= 0).all()
    assert (found < layout.shape).all()
    assert tuple(found[0]) == min(tuple(vertex) for vertex in found)
    pixels = shapely.points(np.argwhere(layout.reorder(covered)))
    assert outline.buffer(1.01).contains(pixels).all()


def test_sicd_spatial_frequencies_match_the_targets(exported: tuple[Made, Sicd]) -> None:
    """The mean phase step between pixels near a target equals DeltaKCOAPoly there, modulo whole turns.

    KCtr plus DeltaKCOAPoly is 2 fc / c times the line of sight.
    """
    run, found = exported
    target = DAYTON.to_ecef(np.array([TARGETS[0].x, TARGETS[0].y, 0.0]))
    place, _, _ = sksicd.scene_to_image(found.tree, target)
    row, column = np.rint(sksicd.xrowycol_to_rowcol(found.tree, place)).astype(int)
    antenna = DAYTON.to_ecef(run.collection.antenna_position[run.collection.n_pulse // 2])
    sight = (target - antenna) / np.linalg.norm(target - antenna) * 2 * run.collection.carrier / SPEED_OF_LIGHT
    chip = found.pixels[row - 16 : row + 16, column - 16 : column + 16]
    for axis, name in enumerate(("Row", "Col")):
        spacing, band = found.load(f"Grid/{name}/SS"), found.load(f"Grid/{name}/ImpRespBW")
        along = np.moveaxis(chip, axis, 0)
        stepped = np.angle((along[1:] * along[:-1].conj()).sum()) / (2 * np.pi)
        said = np.polynomial.polynomial.polyval2d(*place, found.load(f"Grid/{name}/DeltaKCOAPoly")) * spacing
        stepped *= -found.load(f"Grid/{name}/Sgn")
        assert abs((stepped - said + 0.5) % 1 - 0.5) < 0.05 * band * spacing
        there = found.load(f"Grid/{name}/KCtr") * spacing + said
        assert there == pytest.approx(sight @ found.load(f"Grid/{name}/UVectECF") * spacing, abs=0.05 * band * spacing)
        assert found.load(f"Grid/{name}/KCtr") * spacing == pytest.approx(
            round(found.load(f"Grid/{name}/KCtr") * spacing)
        )
        # Cut through the target, upsampled along the axis.
        cut = np.abs(np.fft.ifft(np.pad(np.roll(np.fft.fft(_line(found.pixels, row, column, axis)), 32), (0, 64 * 31))))
        width = (cut > cut.max() / np.sqrt(2)).sum() / 32 * spacing
        assert found.load(f"Grid/{name}/ImpRespWid") == pytest.approx(width, rel=0.1)


def _line(pixels: Any, row: int, column: int, axis: int) -> Any:
    line = pixels[row - 32 : row + 32, column] if axis == 0 else pixels[row, column - 32 : column + 32]
    step = np.angle((line[1:] * line[:-1].conj()).sum())
    return line * np.exp(-1j * step * np.arange(line.size))


def test_sicd_track_and_times_match_the_collection(exported: tuple[Made, Sicd]) -> None:
    run, found = exported
    collection, time = run.collection, run.collection.time - run.collection.time[0]
    there = np.polynomial.polynomial.polyval(time, found.load("Position/ARPPoly")).T
    assert there == pytest.approx(DAYTON.to_ecef(collection.antenna_position), abs=1e-3)
    place, _, _ = sksicd.scene_to_image(found.tree, DAYTON.to_ecef(np.array([TARGETS[1].x, TARGETS[1].y, 0.0])))
    said = np.polynomial.polynomial.polyval2d(*place, found.load("Grid/TimeCOAPoly"))
    nadir = Geometry(collection=collection).nadir
    yaw = np.arctan2(TARGETS[1].y - nadir[1], TARGETS[1].x - nadir[0])
    lit = np.ones(time.size, bool)
    if collection.beam_width is not None:
        lit = np.abs(yaw - collection.beam_azimuth) <= collection.beam_width / 2
        assert lit.mean() < 0.8
    assert said == pytest.approx(time[lit].mean(), abs=1.5 / collection.prf)
    assert found.load("Timeline/CollectDuration") == pytest.approx(160 / 60)


def turning(run: Made, kind: str) -> Collection:
    """The collection of a run whose beam turns about an axis, as it would be in another mode."""
    collection = run.collection
    assert collection.beam_steering is not None
    steering = {"strip": np.full(collection.n_pulse, collection.beam_steering.mean()), "tops": collection.beam_steering}
    if kind == "spot":
        return replace(collection, beam_width=0.4)
    return with_patterns(replace(collection, beam_steering=steering[kind]))


@pytest.mark.slow
def test_sicd_tells_mode_and_what_was_compensated(tmp_path: Path) -> None:
    run = make(tmp_path, size=(60, 50), about_axis=True, beam=(0.02, 0.1), hole=False)
    attrs = {"georeference": DAYTON.as_attribute()}
    for kind, mode, beam, track in (
        ("spot", "SPOTLIGHT", "NO", {}),
        ("strip", "STRIPMAP", "SV", {}),
        ("tops", "DYNAMIC STRIPMAP", "SV", {"autofocus": {"points": 20}}),
    ):
        stores.write_collection(run.folder / "collection.zarr", turning(run, kind), {**attrs, **track})
        blocksar.export("sicd", run.folder, tmp_path / f"{kind}.nitf")
        found = read_sicd(tmp_path / f"{kind}.nitf")
        assert errors(found.checked) == []
        assert found.load("CollectionInfo/RadarMode/ModeType") == mode
        assert found.load("ImageFormation/ImageBeamComp") == beam
        assert found.load("ImageFormation/AzAutofocus") == ("SV" if track else "NO")


@pytest.mark.slow
def test_sicd_of_a_mosaic_says_what_its_metadata_describe(tmp_path: Path) -> None:
    """They are those of the collection in the middle, with its date; they cannot be those of the others."""
    date = {"collection_start": "2024-05-06T00:00:00Z", "time_zero": 100.0}
    run = make(tmp_path, size=(60, 50), hole=False)
    later = {**date, "collection_start": "2024-05-07T00:00:00Z"}
    for number, source in enumerate((date, later)):
        attrs = {"georeference": DAYTON.as_attribute(), "source": source}
        stores.write_collection(tmp_path / "segments" / str(number) / "collection.zarr", run.collection, attrs)
    block = (np.arange(60) >= 15).astype(np.int16) * np.ones((50, 1), np.int16)
    stores.write_region(place(tmp_path) / "image.zarr", "block", (slice(0, 50), slice(0, 60)), block)
    record = stores.read_json(place(tmp_path) / "run.json")
    segments = [{"collection": n, "path": f"{n}.zarr", "fingerprint": "", "pulses": None, "blocks": 1, "parts": 1,
                 "first_block": n} for n in range(2)]  # fmt: skip
    stores.write_json(tmp_path / "run.json", {**record, "segments": segments})
    report = blocksar.export("sicd", tmp_path, tmp_path / "a.nitf")
    assert "those of 1.zarr, and not those of 25 % of the covered pixels" in report.summary[0]
    report = blocksar.export("sidd", tmp_path, tmp_path / "detected.nitf")
    assert report.summary[0].startswith("note: track and centre of aperture are those of 1.zarr, and not those of 25 %")
    blocksar.export("stac", tmp_path, tmp_path / "item.json")
    told = stores.read_json(place(tmp_path) / "item.json")["properties"]
    for name, day, time in (("start", 6, run.collection.time[0]), ("end", 7, run.collection.time[-1])):
        moment = datetime(2024, 5, day, tzinfo=UTC) + timedelta(seconds=100 + float(time))
        assert abs(datetime.fromisoformat(told[f"{name}_datetime"]) - moment) < timedelta(microseconds=2)
    start = read_sicd(tmp_path / "a.nitf").load("Timeline/CollectStart")
    assert (start - datetime(2024, 5, 7, tzinfo=UTC)).total_seconds() == pytest.approx(100 + run.collection.time[0])


@pytest.mark.slow
def test_sicd_contains_the_known_collection_metadata(tmp_path: Path) -> None:
    known = {"collector": "C-1", "classification": "SECRET//X", "polarization": {"transmit": "H", "receive": "V"}}
    run = make(tmp_path, size=(60, 50), more=known)
    blocksar.export("sicd", run.folder, tmp_path / "a.nitf")
    found = read_sicd(tmp_path / "a.nitf")
    assert errors(found.checked) == []
    assert found.load("CollectionInfo/CollectorName") == "C-1"
    assert found.load("CollectionInfo/Classification") == "SECRET//X"
    assert found.load("RadarCollection/TxPolarization") == "H"
    assert found.load("ImageFormation/TxRcvPolarizationProc") == "H:V"
    with open(tmp_path / "a.nitf", "rb") as file, sksicd.NitfReader(file) as reader:
        assert reader.metadata.file_header_part.security.clas == "S"
        assert reader.metadata.im_subheader_part.security.clas == "S"


def test_export_of_a_coarse_image_as_sicd_is_refused(tmp_path: Path) -> None:
    run = make(tmp_path, size=(40, 40), step=2.0)
    with pytest.raises(InputError, match=r"spacing is 2 m in [xy], too coarse .* grid of at most [\d.]+ m$"):
        blocksar.export("sicd", run.folder, tmp_path / "a.nitf")
    assert not (tmp_path / "a.nitf").exists()
