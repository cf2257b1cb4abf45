"""Standard products of a small run, read back by the formats' own libraries, and what `blocksar.open` gives.

The runs are made here by exact back-projection, so what a product says is compared with what is known of the scene.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
import rasterio.warp
import sarkit.sicd as sksicd
import sarkit.verification as skver
import shapely
import xarray as xr
import zarr
from lxml import etree
from matplotlib.image import imread
from pyproj import Transformer
from rio_cogeo import cog_validate
from typer.testing import CliRunner

import blocksar
from blocksar import stores
from blocksar.cli import commands
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.georeference import Georeference
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.focusing.backprojection import form_image
from blocksar.measurement.targets import Target
from blocksar.products import geotiff, writing
from blocksar.products.pictures import quicklook
from blocksar.products.sicd.layout import Layout, lay_out, valid_data
from blocksar.runs import finished

matplotlib.use("Agg")

pytestmark = pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")  # by rioxarray, of affine

DAYTON = Georeference(latitude=39.78, longitude=-84.09, height=250.0)
TARGETS = [Target("A", 0.3, -0.2), Target("B", 20.1, 11.3), Target("C", -17.7, 13.9), Target("D", -12.2, -15.9)]
LOOKS = [0.1, 0.9, 2.6, -1.9, -0.2]  # rad: rows of the file run along each of the four directions


@dataclass(frozen=True)
class Made:
    """A run, and what is known of it."""

    folder: Path
    collection: Collection
    image: Any
    x: Any
    y: Any

    @property
    def source(self) -> finished.Source:
        _, attrs = stores.read_collection(self.folder / "collection.zarr")
        geometry = Geometry(collection=self.collection)
        place = blocksar.places.place(self.folder / "image.zarr")  # type: ignore[attr-defined]
        return finished.Source(place, self.x, self.y, geometry, attrs, {})

    def peak(self, target: Target) -> Any:
        """Fractional (row of y, column of x) of the target's peak: its chip, transformed, padded 16 times and back."""
        at = [round((v - axis[0]) / (axis[1] - axis[0])) for v, axis in ((target.y, self.y), (target.x, self.x))]
        chip = self.image[at[0] - 12 : at[0] + 12, at[1] - 12 : at[1] + 12]
        return np.array(at) - 12 + upsampled_peak(chip)


def upsampled_peak(chip: Any, factor: int = 16) -> Any:
    steps = [np.angle((chip[1:] * chip[:-1].conj()).sum()), np.angle((chip[:, 1:] * chip[:, :-1].conj()).sum())]
    for axis, step in enumerate(steps):
        ramp = np.exp(-1j * step * np.arange(chip.shape[axis]))
        chip = chip * (ramp[:, None] if axis == 0 else ramp)
    n = chip.shape[0]
    spectrum = np.zeros((n * factor, n * factor), np.complex128)
    half = n // 2
    spectrum[:n, :n] = np.roll(np.fft.fft2(chip), (half, half), (0, 1))
    fine = np.abs(np.fft.ifft2(spectrum))
    return np.array(np.unravel_index(fine.argmax(), fine.shape)) / factor


def make(
    folder: Path,
    *,
    look: float = 0.9,
    steered: bool = False,
    frame: Georeference | None = DAYTON,
    centre: tuple[float, float] = (0.0, 0.0),
    size: tuple[int, int] = (150, 130),
    step: float = 0.4,
    hole: bool = True,
    more: dict[str, Any] | None = None,
) -> Made:
    """A finished run over targets about `centre`; a corner in the south-west and rows in the north are not covered."""
    n = 160
    time = (np.arange(n) - n // 2) / 60.0 + 0.5
    cos, sin = np.cos(look), np.sin(look)
    t = time[:, None]
    track = np.array([-6000 * cos, -6000 * sin, 4000.0]) + t * np.array([-sin, cos, 0.0]) * 60 + t * [30 * cos, 9, -4]
    track = track + t**2 * np.array([1.0, 0.5, 0.2]) + np.array([*centre, 0.0])
    frequency = (np.arange(96) - 48) * 1.5e6
    nadir = track[0] + (track[-1] - track[0]) * (0.0 - time[0]) / (time[-1] - time[0])
    middle = np.arctan2(centre[1] - nadir[1], centre[0] - nadir[0])
    collection = Collection(
        carrier=9.6e9,
        time=time,
        range_frequency=frequency,
        reference_range=np.linalg.norm(track - [*centre, 0.0], axis=1),
        antenna_position=track,
        beam_azimuth=middle + 0.012 * (time - 0.5) if steered else np.full(n, np.nan),
        beam_width=0.02 if steered else None,
        title="small scene, é",
    ).centred()
    geometry = Geometry(collection=collection)
    targets = [Target(t.name, t.x + centre[0], t.y + centre[1]) for t in TARGETS]
    signal = np.zeros((n, frequency.size), np.complex128)
    for target in targets:
        distance = np.linalg.norm([target.x, target.y, 0.0] - track, axis=1) - collection.reference_range
        phase = np.outer(distance, collection.carrier + collection.range_frequency) * 4 * np.pi / SPEED_OF_LIGHT
        signal += np.exp(-1j * phase)
    x, y = (c + (np.arange(k) - k // 2) * step for c, k in zip(centre, size, strict=True))
    image = form_image(lambda pulses: signal[pulses].astype(np.complex64), geometry, x, y, threads=1)
    if hole:
        image[:20, :30] = np.nan
        image[-9:] = np.nan
    attrs: dict[str, Any] = {"targets": [t._asdict() | {"reflectivity": [1.0, 0.0]} for t in targets], **(more or {})}
    if frame is not None:
        attrs["georeference"] = frame.as_attribute()
    stores.write_collection(folder / "collection.zarr", collection, attrs)
    whole = (slice(0, y.size), slice(0, x.size))
    told = {name: attrs[name] for name in ("georeference",) if name in attrs}
    image_attrs = {"title": collection.title, "Conventions": stores.CONVENTIONS, "ground_height": 0.0, **told}

    def fill(place: Any) -> None:
        for name, values in (("image", image), ("block", np.where(np.isfinite(image), 0, -1).astype(np.int16))):
            for first in range(0, y.size, 64):
                rows = slice(first, min(first + 64, y.size))
                stores.write_region(place, name, (rows, whole[1]), values[rows])

    stores.create(
        folder / "image.zarr",
        stores.IMAGE,
        sizes={},
        coords={"x": x, "y": y},
        attrs=image_attrs,
        chunks={"y": 64, "x": x.size},
        fill=fill,
    )
    stores.write_json(folder / "run.json", {"status": "finished", "identity": "0123456789abcdef"})
    return Made(folder, collection, image, x, y)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return make(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def unplaced(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return make(tmp_path_factory.mktemp("unplaced"), frame=None, size=(60, 50))


def index(axis: Any, value: float) -> float:
    return float((value - axis[0]) / (axis[1] - axis[0]))


# ---------------------------------------------------------------- SICD


@dataclass(frozen=True)
class Sicd:
    tree: Any
    pixels: Any
    checked: Any

    def load(self, path: str) -> Any:
        return sksicd.XmlHelper(self.tree).load("/".join(f"{{*}}{part}" for part in path.split("/")))


def errors(checked: Any) -> list[Any]:
    """Warnings there are: of pixels more than 2.2 times as close as the band asks."""
    details = [detail for failure in checked.failures().values() for detail in failure["details"]]
    assert {detail["severity"] for detail in details} <= {"Error", "Warning"}
    return [detail for detail in details if detail["severity"] == "Error" and not detail["passed"]]


def read_sicd(path: Path) -> Sicd:
    with open(path, "rb") as file:
        checked = skver.SicdConsistency.from_file(file)
        checked.check()
        file.seek(0)
        with sksicd.NitfReader(file) as reader:
            return Sicd(reader.metadata.xmltree, reader.read_image().astype(np.complex64), checked)


@pytest.fixture(scope="module", params=[*((look, False) for look in LOOKS), (0.9, True)], ids=str)
def exported(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Made, Sicd]:
    look, steered = request.param
    run = make(tmp_path_factory.mktemp("sicd"), look=look, steered=steered, hole=not steered)
    blocksar.export("sicd", run.folder, run.folder / "image.nitf")
    return run, read_sicd(run.folder / "image.nitf")


def test_sicd_passes_the_checker_with_no_error(exported: tuple[Made, Sicd]) -> None:
    assert errors(exported[1].checked) == []
    assert len(exported[1].checked.passes()) > 40


def test_the_checker_finds_what_is_wrong(exported: tuple[Made, Sicd]) -> None:
    spoiled = etree.fromstring(etree.tostring(exported[1].tree)).getroottree()
    spoiled.find("{*}Grid/{*}Row/{*}SS").text = "3.0"
    checked = skver.SicdConsistency.from_parts(spoiled)
    checked.check()
    assert errors(checked)


def test_sicd_metadata_project_targets_to_their_peaks(exported: tuple[Made, Sicd]) -> None:
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
        # Back to the ground: range and Doppler contour through the pixel meet the plane where the target is.
        ground, _, success = sksicd.image_to_ground_plane(found.tree, place, ecef, DAYTON.axes[2])
        assert success
        assert ground == pytest.approx(ecef, abs=0.01)


def test_sicd_pixels_are_those_of_the_image(exported: tuple[Made, Sicd]) -> None:
    run, found = exported
    layout = lay_out(run.source)
    rows, columns = (v.astype(float).ravel() for v in np.indices(found.pixels.shape))
    points = layout.point(rows, columns)
    j, i = np.rint([(points[:, 0] - run.x[0]) / 0.4, (points[:, 1] - run.y[0]) / 0.4]).astype(int)
    np.testing.assert_array_equal(found.pixels.ravel(), np.nan_to_num(run.image[i, j], nan=0.0))


def test_sicd_valid_data_bound_what_is_covered(exported: tuple[Made, Sicd]) -> None:
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
def test_valid_data_are_a_polygon_around_any_shape(shape: str, look: float) -> None:
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


def test_sicd_spatial_frequencies_are_those_of_targets(exported: tuple[Made, Sicd]) -> None:
    """The mean step of phase from pixel to pixel about a target is DeltaKCOAPoly there, but for whole turns.

    And KCtr with it is 2 fc / c times the line of sight.
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
        # The cut through the target, upsampled along the axis.
        cut = np.abs(np.fft.ifft(np.pad(np.roll(np.fft.fft(_line(found.pixels, row, column, axis)), 32), (0, 64 * 31))))
        width = (cut > cut.max() / np.sqrt(2)).sum() / 32 * spacing
        assert found.load(f"Grid/{name}/ImpRespWid") == pytest.approx(width, rel=0.1)


def _line(pixels: Any, row: int, column: int, axis: int) -> Any:
    line = pixels[row - 32 : row + 32, column] if axis == 0 else pixels[row, column - 32 : column + 32]
    step = np.angle((line[1:] * line[:-1].conj()).sum())
    return line * np.exp(-1j * step * np.arange(line.size))


def test_sicd_track_and_times(exported: tuple[Made, Sicd]) -> None:
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


def test_sicd_date_is_that_of_the_source(tmp_path: Path) -> None:
    date = {"collection_start": "2024-05-06T07:08:09.5Z", "time_zero": 1.25}
    run = make(tmp_path, size=(60, 50), more={"source": date})
    blocksar.export("sicd", run.folder, tmp_path / "a.nitf")
    start = read_sicd(tmp_path / "a.nitf").load("Timeline/CollectStart")
    first = 7 * 3600 + 8 * 60 + 9.5 + 1.25 + run.collection.time[0]
    assert start.hour * 3600 + start.minute * 60 + start.second + start.microsecond / 1e6 == pytest.approx(
        first, abs=1e-5
    )


def test_sicd_tells_of_the_collection_what_is_known(tmp_path: Path) -> None:
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
    run = make(tmp_path / "own", size=(60, 50), more={"classification": "ours", "polarization": "HV"})
    with pytest.raises(InputError, match=r"classification of .* is 'ours', and NITF knows"):
        blocksar.export("sicd", run.folder, tmp_path / "b.nitf")
    assert not (tmp_path / "b.nitf").exists()


def test_a_coarse_image_is_no_sicd(tmp_path: Path) -> None:
    run = make(tmp_path, size=(40, 40), step=2.0)
    with pytest.raises(InputError, match=r"spacing is 2 m in [xy], too coarse .* --grid of at most [\d.]+ m$"):
        blocksar.export("sicd", run.folder, tmp_path / "a.nitf")
    assert not (tmp_path / "a.nitf").exists()


@pytest.mark.parametrize("kind", ["sicd", "geotiff", "png"])
def test_no_product_depends_on_strips(kind: Any, made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor is more read at once than a strip."""
    blocksar.export(kind, made.folder, tmp_path / "whole")
    largest, read = 0, finished.Source.read

    def watched(self: finished.Source, rows: slice, columns: slice) -> Any:
        nonlocal largest
        values = read(self, rows, columns)
        largest = max(largest, values.size)
        return values

    monkeypatch.setattr(finished, "STRIP", 1000)
    monkeypatch.setattr(finished.Source, "read", watched)
    blocksar.export(kind, made.folder, tmp_path / "strips")
    if kind != "png":  # whose picture is as small as the image here
        assert 0 < largest <= 1000
    if kind == "sicd":
        np.testing.assert_array_equal(read_sicd(tmp_path / "whole").pixels, read_sicd(tmp_path / "strips").pixels)
    else:
        assert (tmp_path / "whole").read_bytes() == (tmp_path / "strips").read_bytes()


def test_coverage_is_that_of_the_pixels(made: Made) -> None:
    found, covered = made.source.coverage(), np.isfinite(made.image)
    for first, last, along in ((*found[:2], covered), (*found[2:], covered.T)):
        for i, line in enumerate(along):
            there = np.flatnonzero(line)
            assert (first[i], last[i]) == ((there[0], there[-1]) if there.size else (line.size, -1))


# ---------------------------------------------------------------- GeoTIFF


@pytest.mark.parametrize("content", ["amplitude", "complex"])
def test_geotiff_is_a_valid_cog_with_the_pixels_of_the_image(content: Any, tmp_path: Path) -> None:
    run = make(tmp_path, size=(700, 600), step=0.15)
    out = tmp_path / "image.tif"
    blocksar.export("geotiff", run.folder, out, content=content)
    assert cog_validate(out, strict=True, quiet=True) == (True, [], [])
    with rasterio.open(out) as file:
        pixels = file.read(1)[::-1]
        assert file.overviews(1) == [2]
        assert np.isnan(file.nodata)
    wanted = np.abs(run.image) if content == "amplitude" else run.image
    assert pixels.dtype == wanted.dtype
    np.testing.assert_array_equal(pixels, wanted)


@pytest.mark.parametrize(
    ("frame", "centre"),
    [
        (DAYTON, (0.0, 0.0)),
        (DAYTON, (24000.0, -18000.0)),  # the projection about the origin is off by a third of a pixel here
        (Georeference(latitude=-33.1, longitude=151.2, height=40.0, rotation=200.0), (0.0, 0.0)),
        (Georeference(latitude=78.2, longitude=179.9995, height=-5.0), (300.0, 50.0)),
    ],
)
def test_geotiff_lands_targets_at_their_latitude_and_longitude(
    frame: Georeference, centre: tuple[float, float], tmp_path: Path
) -> None:
    run = make(tmp_path, frame=frame, centre=centre)
    blocksar.export("geotiff", run.folder, tmp_path / "image.tif")
    with rasterio.open(tmp_path / "image.tif") as file:
        for named in TARGETS:
            target = Target(named.name, named.x + centre[0], named.y + centre[1])
            latitude, longitude, _ = frame.to_geodetic(np.array([target.x, target.y, 0.0]))
            (east,), (north,) = rasterio.warp.transform("EPSG:4326", file.crs, [longitude], [latitude])
            column, row = ~file.transform @ (east, north)
            peak = run.peak(target)
            assert column - 0.5 == pytest.approx(peak[1], abs=0.1)
            assert row - 0.5 == pytest.approx(run.y.size - 1 - peak[0], abs=0.1)
        assert float(file.tags()["location_error_m"]) < 0.04
        assert (file.transform.b == 0) == ((frame == DAYTON and centre == (0.0, 0.0)) or frame.latitude > 70)


@pytest.mark.parametrize("lacking", [0.5, 0.0])
@pytest.mark.parametrize("kind", ["sicd", "geotiff", "png"])
def test_a_full_disk_leaves_nothing(kind: Any, lacking: float, tmp_path: Path) -> None:
    """GDAL tells nobody when the last that it writes is lost, and has errors of its own for the rest."""
    run = make(tmp_path / "run", size=(700, 600), step=0.1)
    content: Any = "complex" if kind == "geotiff" else None
    blocksar.export(kind, run.folder, tmp_path / "whole", content=content)
    room = int((tmp_path / "whole").stat().st_size * (1 - lacking)) - 2
    (tmp_path / "out").mkdir()
    program = (
        "import resource, sys, blocksar, blocksar.products.pictures.quicklook, rasterio, sarkit.sicd\n"
        "from blocksar import ProcessingError\n"
        f"resource.setrlimit(resource.RLIMIT_FSIZE, ({room}, {room}))\n"
        f"try: blocksar.export({kind!r}, {str(run.folder)!r}, {str(tmp_path / 'out' / 'file')!r}, {content=})\n"
        "except ProcessingError as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert "cannot be written" in done.stdout, done.stderr
    assert list((tmp_path / "out").iterdir()) == []


# ---------------------------------------------------------------- PNG


def test_png_is_a_picture(made: Made, tmp_path: Path) -> None:
    said = blocksar.export("png", made.folder, tmp_path / "image.png").summary
    picture = imread(tmp_path / "image.png")
    assert picture.shape[0] > 800
    assert picture[..., :3].std() > 0.1
    assert "cells of 0.4 m x 0.4 m" in said[0]


@pytest.mark.parametrize("degrees", [0, 45, 90, 135, 180, 225, 270, 315])
def test_words_of_arrows_stay_within_the_picture_and_apart(degrees: int) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 6), dpi=100)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    turn = np.radians(degrees)
    for place, word in enumerate(("look", "N")):
        direction = np.array([np.cos(turn), np.sin(turn)]) * (1 - 2 * place)  # towards one another at 180
        quicklook._draw_arrow(axes, quicklook.Arrow(word, direction, "white"), place)
    canvas.draw()
    boxes = [text.get_window_extent(canvas.get_renderer()) for text in axes.texts if text.get_text()]
    assert len(boxes) == 2
    assert all(axes.bbox.x0 < b.x0 and b.x1 < axes.bbox.x1 and b.y1 < axes.bbox.y1 for b in boxes)
    assert not boxes[0].overlaps(boxes[1])


def test_north_turns_with_the_frame() -> None:
    frame = Georeference(latitude=10.0, longitude=20.0, height=0.0, rotation=30.0)
    arrow = quicklook.north_arrow(30.0).direction
    tip = frame.to_geodetic(np.array([100 * arrow[0], 100 * arrow[1], 0.0]))
    assert tip[0] > 10.0
    assert tip[1] == pytest.approx(20.0, abs=1e-9)


# ---------------------------------------------------------------- what is refused


@pytest.mark.parametrize("kind", ["sicd", "geotiff"])
def test_without_a_georeference_nothing_is_placed(kind: Any, unplaced: Made, tmp_path: Path) -> None:
    out = tmp_path / "new" / "file"
    done = CliRunner().invoke(commands.app, ["export", kind, str(unplaced.folder), "--out", str(out)])
    assert done.exit_code == 2
    assert "has no georeference" in done.stderr
    assert done.stderr.count("\n") == 1
    assert not out.parent.exists()


def test_a_picture_needs_no_georeference(unplaced: Made, tmp_path: Path) -> None:
    done = CliRunner().invoke(
        commands.app, ["export", "png", str(unplaced.folder), "--out", str(tmp_path / "a.png"), "-q"]
    )
    assert done.exit_code == 0, done.stderr
    assert f"wrote {tmp_path / 'a.png'}" in done.stdout
    assert imread(tmp_path / "a.png").std() > 0.1


@pytest.mark.parametrize("kind", ["sicd", "geotiff", "png"])
def test_what_stands_there_is_kept_unless_asked(kind: Any, made: Made, tmp_path: Path) -> None:
    out = tmp_path / "file"
    out.write_text("mine")
    arguments = ["export", kind, str(made.folder), "--out", str(out), "--quiet"]
    done = CliRunner().invoke(commands.app, arguments)
    assert (done.exit_code, out.read_text()) == (2, "mine")
    assert "exists; choose another name" in done.stderr
    assert CliRunner().invoke(commands.app, [*arguments, "--overwrite"]).exit_code == 0
    assert out.stat().st_size > 1000
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("kind", ["sicd", "geotiff", "png"])
def test_a_damaged_chunk_leaves_what_was_there(kind: Any, tmp_path: Path) -> None:
    run = make(tmp_path / "run", size=(60, 140))
    chunk = run.folder / "image.zarr" / "image" / "c" / "1" / "0"
    chunk.write_bytes(chunk.read_bytes()[:-8])
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "file").write_text("mine")
    with pytest.raises(InputError, match="damaged"):
        blocksar.export(kind, run.folder, tmp_path / "out" / "file", overwrite=True)
    assert [(p.name, p.read_text()) for p in (tmp_path / "out").iterdir()] == [("file", "mine")]


def test_bad_destinations(made: Made, tmp_path: Path) -> None:
    for out, said in ((tmp_path, "is a folder"), ("s3://bucket/image.png", "is no local path")):
        with pytest.raises(InputError, match=said):
            blocksar.export("png", made.folder, out)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        blocksar.export("png", made.folder, tmp_path / "file" / "image.png")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="is no regular file, and is not replaced"):
        blocksar.export("png", made.folder, tmp_path / "pipe", overwrite=True)
    assert (tmp_path / "pipe").is_fifo()


@pytest.mark.parametrize("kind", ["sicd", "geotiff", "png"])
def test_a_folder_that_is_not_ours_is_wrong_input_for_all_alike(
    kind: Any, made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """GDAL would say so in an error of its own; root may write everywhere, so the system's answer is made here."""

    def refused(*_: Any, **__: Any) -> Any:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(writing, "open", refused, raising=False)
    with pytest.raises(InputError, match=r"cannot be written \(Permission denied\)"):
        blocksar.export(kind, made.folder, tmp_path / "file")
    assert list(tmp_path.iterdir()) == []


def test_an_image_of_one_row_says_so(tmp_path: Path) -> None:
    run = make(tmp_path, size=(40, 30))
    stores.create(
        run.folder / "image.zarr", stores.IMAGE, sizes={}, coords={"x": run.x, "y": run.y[:1]}, attrs={},
        chunks={"y": 1, "x": 40}, overwrite=True,
    )  # fmt: skip
    with pytest.raises(InputError, match=r"has 1 x 40 pixels \(y, x\).*larger --grid$"):
        blocksar.export("png", run.folder, tmp_path / "a.png")


def test_bad_sources(made: Made, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"holds no run\.json"):
        blocksar.export("png", tmp_path, tmp_path / "a.png")
    with pytest.raises(InputError, match="kind is 'jpeg'"):
        blocksar.export("jpeg", made.folder, tmp_path / "a.jpeg")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="only a geotiff"):
        blocksar.export("png", made.folder, tmp_path / "a.png", content="complex")
    empty = make(tmp_path / "empty", size=(40, 40))
    whole = (slice(0, 40), slice(0, 40))
    stores.write_region(empty.folder / "image.zarr", "block", whole, np.full((40, 40), -1, np.int16))
    with pytest.raises(InputError, match="has no covered pixel"):
        blocksar.export("sicd", empty.folder, tmp_path / "a.nitf")


@pytest.mark.parametrize(
    ("kind", "library", "extra"),
    [("sicd", "sarkit", "formats"), ("geotiff", "rasterio", "geotiff"), ("png", "matplotlib", "plots")],
)
def test_a_missing_library_is_named_with_its_extra(
    kind: Any, library: str, extra: str, made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in list(sys.modules):
        if name.split(".")[0] == library or name.startswith("blocksar.products.pictures"):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.delattr(blocksar.products.pictures, "quicklook", raising=False)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(InputError, match=rf"{library} is not installed.*install blocksar\[{extra}\]$"):
        blocksar.export(kind, made.folder, tmp_path / "file")
    assert not (tmp_path / "file").exists()


# ---------------------------------------------------------------- georeference


def test_the_frame_is_projs_topocentric_one() -> None:
    frame = Georeference(latitude=47.5, longitude=-122.3, height=120.0)
    points = np.random.default_rng(4).uniform(-2e4, 2e4, (50, 3))
    where = "+lat_0=47.5 +lon_0=-122.3 +h_0=120"
    pipeline = Transformer.from_pipeline(f"+proj=topocentric +ellps=WGS84 {where}")
    ecef = frame.to_ecef(points)
    assert np.stack(pipeline.transform(*ecef.T), axis=1) == pytest.approx(points, abs=1e-6)
    assert frame.from_ecef(ecef) == pytest.approx(points, abs=1e-6)
    turned = Georeference(latitude=47.5, longitude=-122.3, height=120.0, rotation=90.0)
    assert turned.to_ecef(np.array([5.0, 0.0, 0.0])) == pytest.approx(frame.to_ecef(np.array([0.0, 5.0, 0.0])))


def test_a_georeference_survives_json() -> None:
    frame = Georeference(latitude=-12.25, longitude=130.125, height=33.0, rotation=-7.0)
    assert Georeference.from_attribute(json.loads(json.dumps(frame.as_attribute()))) == frame
    at = Georeference.at(frame.origin, rotation=-7.0)
    assert (at.latitude, at.longitude, at.height) == pytest.approx((-12.25, 130.125, 33.0), abs=1e-6)


GOOD = {"kind": "ENU", "latitude": 1.0, "longitude": 2.0, "height": 3.0}


@pytest.mark.parametrize(
    ("found", "said"),
    [
        ("here", "is str instead of a mapping"),
        ({**GOOD, "kind": "NED"}, "of kind 'NED'"),
        ({"kind": "ENU", "latitude": 1.0, "longitude": 2.0}, "height is None"),
        ({**GOOD, "latitude": "1 N"}, "latitude is '1 N'"),
        ({**GOOD, "latitude": True}, "latitude is True"),
        ({**GOOD, "latitude": 10**400}, "latitude is 1000"),
        ({**GOOD, "latitude": 91.0}, "latitude is 91.0, which is not in -90 .. 90"),
        ({**GOOD, "longitude": float("nan")}, "longitude is nan"),
        ({**GOOD, "height": 1e6}, "height is 1000000.0"),
        ({**GOOD, "rotation_deg": None}, "rotation_deg is None"),
        ({**GOOD, "up": [0, 0, 1]}, "up is not that of its latitude"),
        ({**GOOD, "east": [0, 1]}, "east is .* instead of three numbers"),
        ({**GOOD, "ecef": [6378137.0, 0, 0]}, "ecef lies 2.* m from its latitude"),
    ],
)
def test_a_wrong_georeference_is_one_sentence(found: Any, said: str) -> None:
    with pytest.raises(InputError, match=said) as error:
        Georeference.from_attribute(found)
    assert "\n" not in str(error.value) and len(str(error.value)) < 300


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (39.78, -84.1, 300.0), (-89.9, 179.0, -50.0), (90.0, 0.0, 5e3)])
def test_the_origin_is_where_proj_puts_it(place: tuple[float, float, float]) -> None:
    latitude, longitude, height = place
    exact = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True).transform(longitude, latitude, height)
    origin = Georeference(latitude=latitude, longitude=longitude, height=height).origin
    assert np.abs(origin - exact).max() < 1e-6


@pytest.mark.parametrize("height", [0.0, 2500.0])
def test_easting_and_northing_are_x_and_y(height: float) -> None:
    frame = Georeference(latitude=63.0, longitude=17.0, height=100.0)
    points = np.random.default_rng(4).uniform(-1e4, 1e4, (50, 3))
    points[:, 2] = height
    found = frame.project(frame.projection(0.0, 0.0, height), points)
    assert np.abs(found - points[:, :2]).max() < 0.03  # d^3 / (3 R^2), and the ellipsoid's two radii at this height


# ---------------------------------------------------------------- xarray


def test_db_is_that_of_the_pixels(made: Made) -> None:
    with blocksar.open(made.folder) as opened:
        power = opened.sar.db()
        assert power.attrs["units"] == "dB"
        np.testing.assert_allclose(power.values, 20 * np.log10(np.abs(made.image)), rtol=0, atol=1e-4)


def test_crop_is_by_ground_coordinates_and_lazy(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    with blocksar.open(made.folder) as opened:
        part = opened.sar.crop(x=(-4.1, 5.0), y=(None, 2.0))
        assert not part["image"].variable._in_memory
        inside = (made.x >= -4.1) & (made.x <= 5.0)
        np.testing.assert_array_equal(part.x, made.x[inside])
        np.testing.assert_array_equal(part["image"], made.image[made.y <= 2.0][:, inside])
        for wrong, said in (({"x": (3.0, 1.0)}, "lower end first"), ({"y": (1e3, None)}, "holds no pixel")):
            with pytest.raises(InputError, match=said):
                opened.sar.crop(**wrong)


@pytest.mark.parametrize("azimuth", [None, 37.0, 90.0])
def test_a_cut_is_the_response(azimuth: float | None, made: Made) -> None:
    """Against back-projection right at the points of the line."""
    target = TARGETS[0]
    with blocksar.open(made.folder) as opened:
        cut = opened.sar.cut(target.x, target.y, azimuth=azimuth, length=8.0, samples=41)
    signal = np.zeros((made.collection.n_pulse, made.collection.n_range_frequency), np.complex128)
    frequency = made.collection.carrier + made.collection.range_frequency
    for other in TARGETS:
        distance = np.linalg.norm([other.x, other.y, 0.0] - made.collection.antenna_position, axis=1)
        signal += np.exp(-4j * np.pi / SPEED_OF_LIGHT * np.outer(distance, frequency))
    for i in range(0, 41, 5):
        turn = np.radians(azimuth or 0.0)
        point = [target.x + cut.distance.values[i] * np.cos(turn), target.y + cut.distance.values[i] * np.sin(turn), 0]
        distance = np.linalg.norm(point - made.collection.antenna_position, axis=1)
        exact = np.abs((signal * np.exp(4j * np.pi / SPEED_OF_LIGHT * np.outer(distance, frequency))).mean())
        assert 10 ** (cut.values[i] / 20) == pytest.approx(exact, abs=3e-3)
    assert cut.values[20] == pytest.approx(0.0, abs=0.1)  # side lobes of the others included


def test_a_cut_outside_is_refused(made: Made) -> None:
    with blocksar.open(made.folder) as opened:
        with pytest.raises(InputError, match="lies outside the image"):
            opened.sar.cut(500.0, 0.0)
        with pytest.raises(InputError, match="is no line"):
            opened.sar.cut(0.0, 0.0, length=0.0)
        assert np.isnan(opened.sar.cut(made.x[0], 0.0, length=30.0).values[0])


def test_an_image_that_runs_the_other_way_is_the_same_image(made: Made) -> None:
    from matplotlib.figure import Figure

    with blocksar.open(made.folder) as opened:
        turned = opened.isel(y=slice(None, None, -1), x=slice(None, None, -1))
        part, whole = (ds.sar.crop(x=(-4.1, 5.0), y=(None, 2.0)) for ds in (turned, opened))
        assert not part["image"].variable._in_memory
        np.testing.assert_array_equal(part["image"].values[::-1, ::-1], whole["image"])
        assert turned.sar.cut(0.3, -0.2).equals(opened.sar.cut(0.3, -0.2))
        axes = [ds.sar.plot(Figure().add_subplot()) for ds in (turned, opened)]
        assert axes[0].get_ylim() == axes[1].get_ylim()
        np.testing.assert_array_equal(axes[0].images[0].get_array(), axes[1].images[0].get_array())
        for of in ("plot", "cut"):
            with pytest.raises(InputError, match="x of the image is not evenly spaced"):
                getattr(opened.isel(x=[0, 1, 5]).sar, of)(*((-31.0, 0.0) if of == "cut" else ()))


@pytest.mark.parametrize("span", [3.0, (1.0, 2.0, 3.0), ("west", 3.0)])
def test_a_span_is_two_numbers(span: Any, made: Made) -> None:
    with blocksar.open(made.folder) as opened, pytest.raises(InputError, match=r"give two ends in m, the lower first"):
        opened.sar.crop(x=span)
    with (
        blocksar.open(made.folder / "collection.zarr") as collection,
        pytest.raises(InputError, match="no coordinate x"),
    ):
        collection.sar.crop(x=(0.0, 1.0))


@pytest.mark.parametrize("wrong", [{"length": np.inf}, {"azimuth": np.nan}, {"azimuth": np.inf}])
def test_a_cut_of_no_numbers_is_refused(wrong: Any, made: Made) -> None:
    with blocksar.open(made.folder) as opened, pytest.raises(InputError, match=r"is no line|azimuth is"):
        opened.sar.cut(0.0, 0.0, **wrong)


@pytest.mark.filterwarnings("error")
def test_db_of_chunks_is_lazy_and_says_nothing(made: Made) -> None:
    with blocksar.open(made.folder) as opened:
        power = opened.chunk(y=64).sar.db()
        assert power.chunks
        assert power.dtype == np.float32
        np.testing.assert_array_equal(power.values, opened.sar.db().values)


def test_what_is_derived_can_be_saved_as_netcdf(tmp_path: Path) -> None:
    """netCDF knows no complex numbers, and attributes of numbers and text only; CF no fill value of coordinates."""
    told = {"settings": {"blocks": 3}, "predicted": [{"block": 0}], "warnings": []}
    run = make(tmp_path / "run", size=(40, 30))
    zarr.open_group(run.folder / "image.zarr").attrs.update(told)
    with blocksar.open(run.folder) as opened:
        assert opened.attrs["settings"] == told["settings"]
        opened.sar.netcdf().to_netcdf(tmp_path / "a.nc")
    with xr.open_dataset(tmp_path / "a.nc") as again:
        assert {name: json.loads(again.attrs[name]) for name in told} == told
        assert again.rio.crs == opened.rio.crs
        assert "_FillValue" not in again["x"].encoding
        np.testing.assert_array_equal(again["image_real"] + 1j * again["image_imag"], run.image)
        assert again["image_imag"].attrs["grid_mapping"] == "spatial_ref" and again["image_imag"].units == "1"
        with pytest.raises(InputError, match="no image"):
            again.sar.netcdf()
    opened.sar.crop(x=(0.0, 3.0)).to_zarr(tmp_path / "a.zarr", consolidated=False)
    with blocksar.open(tmp_path / "a.zarr") as again:
        assert again.sar.plot().texts[-1].get_text() == "N"
        assert again["image"].shape == (30, 8)
    matplotlib.pyplot.close("all")


def test_plot_draws_into_given_axes(made: Made) -> None:
    from matplotlib.figure import Figure

    axes = Figure().add_subplot()
    with blocksar.open(made.folder) as opened:
        assert opened.sar.plot(ax=axes) is axes
        assert opened.sar.crop(x=(0.0, 10.0)).sar.plot().get_xlim() == pytest.approx((-0.2, 10.2), abs=0.4)
    assert axes.get_title() == "small scene, é"
    assert axes.images[0].get_clim()[1] > axes.images[0].get_clim()[0] + 20
    matplotlib.pyplot.close("all")


def test_rioxarray_reads_the_grid_mapping(made: Made, unplaced: Made) -> None:
    with blocksar.open(made.folder) as opened:
        assert opened["image"].rio.crs is not None
        assert opened.x.attrs["standard_name"] == "projection_x_coordinate"
        target = TARGETS[1]
        latitude, longitude, _ = DAYTON.to_geodetic(np.array([target.x, target.y, 0.0]))
        (east,), (north,) = rasterio.warp.transform("EPSG:4326", opened.rio.crs, [longitude], [latitude])
        assert (east, north) == pytest.approx((target.x, target.y), abs=0.01)
        # What is derived keeps it.
        assert opened.sar.db().rio.crs == opened.rio.crs
        assert opened.sar.db().attrs["grid_mapping"] == "spatial_ref"
    with blocksar.open(unplaced.folder) as opened:
        assert "spatial_ref" not in opened.coords


def test_a_turned_frame_has_no_grid_mapping(tmp_path: Path) -> None:
    run = make(tmp_path, size=(40, 40), frame=Georeference(latitude=1.0, longitude=2.0, height=3.0, rotation=10.0))
    with blocksar.open(run.folder) as opened:
        assert "spatial_ref" not in opened.coords


def test_the_default_projection_is_kept_where_it_is_good(made: Made) -> None:
    assert geotiff.place_pixels(made.source, DAYTON).offset.tolist() == [0.0, 0.0]
