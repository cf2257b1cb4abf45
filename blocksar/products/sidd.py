"""The image of a run as a SIDD file (Sensor Independent Derived Data, NGA.STND.0025, version 3.0), through sarkit.

Pixels are detected, averaged over looks if asked for, and remapped: 8 bits, in which 1 .. 255 are dB over a range, and
0 is not covered (`pixels`, as of a GeoTIFF of whole numbers). DataRemapping has the amplitude that each stands for, of
which 65535 is the upper end of the range.

On the plane the grid of the file is that of the image (PlaneProjection), and nothing is resampled; rows run along the
axis of the scene that points most directly away from the radar, so that shadows fall downwards. On a terrain, where a
plane would put the ground beside its place by its height, the file is orthorectified to longitude and latitude at the
height of each pixel's ground (GeographicProjection, `pixels`), north up.

TimeCOAPoly gives the middle of the lit time of a pixel's ground, over rows and columns from the reference point, as the
points of the standard are given; its first coefficient is that of the reference point.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import FloatArray
from blocksar.collection.georeference import Georeference
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError, library_for
from blocksar.places import Location
from blocksar.places.local import temporary_name
from blocksar.products.pixels import MapPixels, Pixels, parse_crs
from blocksar.products.plane_image import Poly2D, arp_polynomial, fit_poly2d
from blocksar.products.shared_metadata import (
    Layout,
    Support,
    about_segments,
    ascii_text,
    centre_time,
    collect_start,
    cut_width,
    find_support,
    lay_out,
    lines_of_sight,
    lit_times,
    polarization,
    radar_mode,
    sample_pixels,
    security_mark,
    valid_data,
)
from blocksar.products.sicd import NEAR_ZERO, TIME_ACCURACY
from blocksar.products.writing import replacing
from blocksar.progress.listening import Callback
from blocksar.runs.finished import FinishedRun
from blocksar.version import __version__

if TYPE_CHECKING:
    from lxml.etree import _ElementTree as ElementTree

# ---------------------------------------------------------------- metadata

ARCSECONDS = 3600.0  # in a degree
Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class SIDDGrid(ABC):
    """Grid of a file: its rows and columns.

    Attributes
    ----------
    pixels : Pixels
        What they show.
    frame : Georeference
    """

    pixels: Pixels
    frame: Georeference

    @property
    @abstractmethod
    def raster(self) -> Pixels | MapPixels:
        """Source of the values, with rows from south to north."""

    @property
    @abstractmethod
    def shape(self) -> tuple[int, int]: ...

    @property
    def reference(self) -> FloatArray:
        """Row and column of the reference point, a pixel in the middle."""
        return np.array(self.shape, np.float64) // 2

    @abstractmethod
    def upright(self, file: Bytes) -> Bytes:
        """View of the file's array with rows in the order of `raster`."""

    @abstractmethod
    def at(self, points: FloatArray) -> FloatArray:
        """Rows and columns (n, 2) of the ground at scene points (n, 3), m."""

    @abstractmethod
    def place(self, pixels: FloatArray) -> FloatArray:
        """Scene points (n, 3), m, that the standard assigns to rows and columns (n, 2)."""

    @abstractmethod
    def projection(self) -> tuple[str, dict[str, Any]]:
        """Name and content of the projection in Measurement, without TimeCOAPoly."""

    def steps(self) -> FloatArray:
        """Steps (2, 2), m in x and y, between rows and between columns at the reference point."""
        points = self.place(self.reference + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
        return (points[1:] - points[0])[:, :2]


@dataclass(frozen=True)
class PlaneGrid(SIDDGrid):
    """The image's own pixels, on the plane."""

    @property
    def raster(self) -> Pixels:
        return self.pixels

    @cached_property
    def layout(self) -> Layout:
        return lay_out(self.pixels.source, self.pixels)

    @property
    def shape(self) -> tuple[int, int]:
        return self.layout.shape

    def upright(self, file: Bytes) -> Bytes:
        turned = file[:: int(self.layout.row.sum()), :: int(self.layout.column.sum())]
        return turned.T if self.layout.row_axis == 1 else turned

    def at(self, points: FloatArray) -> FloatArray:
        offset = (points - self.layout.first)[:, :2]
        return np.stack([offset @ self.layout.row, offset @ self.layout.column], axis=1) / self.layout.spacing

    def place(self, pixels: FloatArray) -> FloatArray:
        return self.layout.point(*pixels.T)

    def projection(self) -> tuple[str, dict[str, Any]]:
        row, column = (np.array([*along, 0.0]) @ self.frame.axes for along in (self.layout.row, self.layout.column))
        return "PlaneProjection", {
            "ReferencePoint": {
                "ECEF": self.frame.to_ecef(self.place(self.reference[None])[0]),
                "Point": self.reference,
            },
            "SampleSpacing": np.array(self.layout.spacing),
            "ProductPlane": {"RowUnitVector": row, "ColUnitVector": column},
        }


@dataclass(frozen=True)
class GeographicGrid(SIDDGrid):
    """Grid of longitude and latitude, at the height of each pixel's ground; rows run south."""

    @cached_property
    def raster(self) -> MapPixels:
        # Longitudes start half a turn before the origin's, outside the image, so that none jumps within it.
        crs = parse_crs(f"+proj=longlat +datum=WGS84 +lon_wrap={self.frame.longitude!r} +type=crs")
        return MapPixels.over(self.pixels, crs, self.frame)

    @property
    def shape(self) -> tuple[int, int]:
        return self.raster.y.size, self.raster.x.size

    def upright(self, file: Bytes) -> Bytes:
        return file[::-1]

    def at(self, points: FloatArray) -> FloatArray:
        latitude, longitude, _ = self.frame.to_geodetic(points).T
        dx, dy = self.raster.spacing
        longitude = longitude + 360 * np.rint((self.raster.x.mean() - longitude) / 360)
        return np.stack([(self.raster.y[-1] - latitude) / dy, (longitude - self.raster.x[0]) / dx], axis=1)

    def place(self, pixels: FloatArray) -> FloatArray:
        (dx, dy), height = self.raster.spacing, self.frame.height + self.pixels.source.ground_height
        latitude, longitude = self.raster.y[-1] - pixels[:, 0] * dy, self.raster.x[0] + pixels[:, 1] * dx
        return self.frame.from_geodetic(np.stack([latitude, longitude, np.full(latitude.shape, height)], axis=1))

    def projection(self) -> tuple[str, dict[str, Any]]:
        dx, dy = self.raster.spacing
        return "GeographicProjection", {
            "ReferencePoint": {
                "ECEF": self.frame.to_ecef(self.place(self.reference[None])[0]),
                "Point": self.reference,
            },
            "SampleSpacing": np.array([dy, dx]) * ARCSECONDS,
        }


def grid_of(pixels: Pixels, frame: Georeference) -> SIDDGrid:
    """Choose the grid of the file: the image's on the plane, longitude and latitude on a terrain."""
    return (PlaneGrid if pixels.source.geometry.terrain is None else GeographicGrid)(pixels, frame)


NAMESPACE, ISM = "urn:SIDD:3.0.0", "urn:us:gov:ic:ism:13"
LEVELS = 256  # of a pixel
FULL = 65535  # amplitude that DataRemapping gives to the upper end of the range
WIDTH = 0.886  # of the -3 dB width of an unweighted response, times bandwidth
DISPLAY = "blocksar dB"


class SIDDMetadata(NamedTuple):
    """The XML tree, and notes for the user."""

    tree: ElementTree
    notes: list[str]


def build_metadata(grid: SIDDGrid) -> SIDDMetadata:
    """Build the XML tree of the pixels of a grid.

    Raises
    ------
    InputError
        If the image has no covered or no lit pixel.
    """
    from lxml import etree
    from sarkit import sidd as sksidd

    source, frame = grid.pixels.source, grid.frame
    coverage, layout = source.coverage(), lay_out(source)
    vertices = _valid_data(grid, _on_ground(source, layout.point(*valid_data(coverage, layout).T.astype(np.float64))))
    coa, dwell = _centres_of_aperture(grid, _on_ground(source, layout.point(*sample_pixels(coverage, layout).T)))
    root = etree.Element(f"{{{NAMESPACE}}}SIDD", nsmap={None: NAMESPACE, "sicommon": "urn:SICommon:1.0", "ism": ISM})
    sidd: Any = sksidd.ElementWrapper(root)
    start, known = collect_start(source)
    notes = [] if known else ["the phase history has no date, so CollectionDateTime is 1970-01-01"]
    sidd["ProductCreation"] = {
        "ProcessorInformation": {
            "Application": f"blocksar {__version__}", "ProcessingDateTime": datetime.now(UTC), "Site": "unknown",
        },
        "ProductName": ascii_text(f"{source.title} {source.record.identity[:8]}".strip(), 80),
        "ProductClass": "Detected Image",
    }  # fmt: skip
    information = root.find("{*}ProductCreation/{*}ProcessorInformation")
    information.addnext(_classification(source))
    sidd["Display"] = _display(grid)
    ends = np.array(grid.shape) - 0.5
    corners = _geodetic(grid, np.array([[-0.5, -0.5], [-0.5, ends[1]], ends, [ends[0], -0.5]]))
    sidd["GeoData"] = {
        "EarthModel": "WGS_84",
        "ImageCorners": np.where(corners == 0, NEAR_ZERO, corners),
        "ValidData": _geodetic(grid, vertices.astype(np.float64)),
    }
    name, projection = grid.projection()
    track, misfit = arp_polynomial(source.geometry, frame)
    sidd["Measurement"] = {
        name: {
            **{key: projection[key] for key in ("ReferencePoint", "SampleSpacing")}, "TimeCOAPoly": coa.coefficients,
            **{key: projection[key] for key in projection if key == "ProductPlane"},
        },
        "PixelFootprint": np.array(grid.shape), "ARPPoly": track, "ValidData": vertices,
    }  # fmt: skip
    sidd["ExploitationFeatures"] = _features(grid, coa, start)
    tree = root.getroottree()
    notes += [
        f"{'plane' if isinstance(grid, PlaneGrid) else 'longitude and latitude, orthorectified'}: {grid.shape[0]} rows "
        f"of {grid.shape[1]} pixels",
        f"TimeCOAPoly is of order {len(coa.coefficients) - 1} and at most {coa.error:.2g} s, "
        f"{100 * coa.error / dwell:.2g} % of the dwell, off the middle of a pixel's lit time",
        f"ARPPoly is of order {len(track) - 1} and at most {misfit:.2g} m off the track",
    ]
    return SIDDMetadata(tree, notes)


def _on_ground(source: FinishedRun, points: FloatArray) -> FloatArray:
    """Ground points (n, 3) below or above points (n, 3), m; at the mean height where the ground's is unknown."""
    ground = source.geometry.on_ground(points[:, 0], points[:, 1])
    ground[:, 2] = np.where(np.isfinite(ground[:, 2]), ground[:, 2], source.ground_height)
    return np.asarray(ground)


def _geodetic(grid: SIDDGrid, pixels: FloatArray) -> FloatArray:
    """Latitude and longitude (n, 2), degrees, of rows and columns (n, 2)."""
    return grid.frame.to_geodetic(grid.place(pixels))[:, :2]


def _valid_data(grid: SIDDGrid, points: FloatArray) -> Any:
    """Vertices (n, 2), row and column, of the convex hull of ground points (n, 3), m, ordered as the standard requires.

    Clockwise with rows to the right and columns up, beginning with the first column of the first row.
    """
    from shapely import MultiPoint
    from shapely.geometry.polygon import orient

    pixels = np.clip(np.rint(grid.at(points)), 0, np.array(grid.shape) - 1)
    hull = MultiPoint(pixels).convex_hull
    if not hull.area > 0:
        steps = np.array([[0, 0], [0, 1], [1, 0]])
        hull = MultiPoint((pixels[:, None] + steps).reshape(-1, 2)).convex_hull
    vertices = np.array(orient(hull, -1.0).exterior.coords[:-1])
    start = np.lexsort((vertices[:, 1], vertices[:, 0]))[0]
    return np.roll(vertices, -start, axis=0).astype(int)


def _centres_of_aperture(grid: SIDDGrid, points: FloatArray) -> tuple[Poly2D, float]:
    """Fit TimeCOAPoly over rows and columns from the reference point, at ground points (n, 3), m; and mean dwell, s.

    Raises
    ------
    InputError
        If none is lit.
    """
    geometry = grid.pixels.source.geometry
    first, last = lit_times(geometry, points)
    lit = first < last
    if not lit.any():
        raise InputError(f"the beam of the collection never lights {grid.pixels.source.image}; check collection.zarr")
    offset = (grid.at(points) - grid.reference)[lit]
    dwell = float((last - first)[lit].mean())
    middle = ((first + last) / 2)[lit] - geometry.collection.time[0]
    return fit_poly2d(offset[:, 0], offset[:, 1], middle, TIME_ACCURACY * dwell), dwell


def _classification(source: FinishedRun) -> Any:
    """Build the element Classification, whose attributes sarkit does not write."""
    from lxml import etree

    mark = security_mark(source)
    element = etree.Element(f"{{{NAMESPACE}}}Classification")
    attributes = {
        "DESVersion": "13", "resourceElement": "true", "createDate": f"{datetime.now(UTC):%Y-%m-%d}",
        "compliesWith": "USGov", "ISMCATCESVersion": "201903", "classification": {"T": "TS"}.get(mark, mark),
        "ownerProducer": "USA",
    }  # fmt: skip
    for name, value in attributes.items():
        element.set(f"{{{ISM}}}{name}", value)
    return element


def _display(grid: SIDDGrid) -> dict[str, Any]:
    """Build the Display branch: the map from pixels to amplitudes, without further processing."""

    def nearest(name: str, operation: str) -> dict[str, Any]:
        kernel = {"Predefined": {"DatabaseName": "NEAREST NEIGHBOR"}}
        return {"FilterName": name, "FilterKernel": kernel, "Operation": operation}

    one = {"Custom": {"FilterCoefficients": np.ones((1, 1))}}
    down = isinstance(grid, PlaneGrid)
    return {
        "PixelType": "MONO8I",
        "NumBands": 1,
        "DefaultBandDisplay": 1,
        "NonInteractiveProcessing": [{
            "@band": 1,
            "ProductGenerationOptions": {
                "DataRemapping": {"LUTName": DISPLAY, "Custom": {"LUTInfo": amplitudes(grid.pixels)[None]}},
            },
            "RRDS": {"DownsamplingMethod": "AVERAGE"},
        }],
        "InteractiveProcessing": [{
            "@band": 1,
            "GeometricTransform": {
                "Scaling": {
                    "AntiAlias": nearest("none", "CONVOLUTION"), "Interpolation": nearest("nearest", "CORRELATION"),
                },
                "Orientation": {"ShadowDirection": "DOWN" if down else "ARBITRARY"},
            },
            "SharpnessEnhancement": {
                "ModularTransferFunctionCompensation": {
                    "FilterName": "none", "FilterKernel": one, "Operation": "CONVOLUTION",
                },
            },
            "DynamicRangeAdjustment": {"AlgorithmType": "NONE", "BandStatsSource": 1},
        }],
        "DisplayExtension": [
            ("dB of 1", f"{grid.pixels.limits[0]:.6g}"), ("dB of 255", f"{grid.pixels.limits[1]:.6g}"),
            ("0", "not covered"), ("reference of dB", "a target of reflectivity 1"),
        ],
    }  # fmt: skip


def amplitudes(pixels: Pixels) -> Any:
    """Amplitude of each pixel value, (256,), in units of 1 / 65535 of the upper limit's; 0 for 0."""
    level = np.arange(LEVELS) * pixels.step + pixels.offset - pixels.limits[1]
    table = np.maximum(np.rint(FULL * 10 ** (level / 20)), 1)
    table[0] = 0
    return table.astype(int)


def _features(grid: SIDDGrid, coa: Poly2D, start: datetime) -> dict[str, Any]:
    """Build the ExploitationFeatures branch for the reference point at its centre of aperture."""
    from sarkit import sidd as sksidd

    def turn(angle: float) -> float:  # the schema has angles below 360 degrees
        return float(np.round(angle, 9) % 360)

    source, frame, geometry = grid.pixels.source, grid.frame, grid.pixels.source.geometry
    collection = geometry.collection
    point = grid.place(grid.reference[None])[0]
    time = np.array(float(coa.coefficients[0, 0]) + collection.time[0])
    steps = grid.steps()
    towards = [np.array([*step, 0.0]) / np.linalg.norm(step) for step in steps]
    position = frame.to_ecef(geometry.track.position(time))
    ecef, velocity = frame.to_ecef(point), geometry.track.velocity(time) @ frame.axes
    angles = sksidd.compute_angles(ecef, position, velocity, *(along @ frame.axes for along in towards))
    support = find_support(geometry, point)
    transmit, pair = polarization(source)
    receive = pair.rpartition(":")[2]
    axes = np.sqrt(np.linalg.eigvalsh(np.cov(support.frequencies.T)))
    return {
        "Collection": [{
            "@identifier": ascii_text(source.record.identity or "unknown", 80),
            "Information": {
                "SensorName": ascii_text(str(source.attrs.get("collector") or "unknown"), 42),
                "RadarMode": {"ModeType": radar_mode(collection, one_aperture=coa.coefficients.size == 1)},
                "CollectionDateTime": start,
                "CollectionDuration": collection.duration,
                "Resolution": np.array(_slant_resolution(source, point, support)),
                "Polarization": [{"TxPolarization": transmit, "RcvPolarization": receive}],
            },
            "Geometry": {
                "Azimuth": turn(angles.Azimuth), "Slope": angles.Slope, "Squint": angles.Squint, "Graze": angles.Graze,
                "Tilt": angles.Tilt, "DopplerConeAngle": angles.DopplerCone,
            },
            "Phenomenology": {
                "Shadow": np.array([turn(angles.Shadow), angles.ShadowMagnitude]),
                "Layover": np.array([turn(angles.Layover), angles.LayoverMagnitude]),
                "MultiPath": angles.MultiPath, "GroundTrack": angles.GroundTrack,
            },
        }],
        "Product": [{
            "Resolution": np.array([_width(support, along[:2]) for along in towards]),
            "Ellipticity": float(axes[1] / axes[0]),
            "Polarization": [{"TxPolarizationProc": transmit, "RcvPolarizationProc": receive}],
            "North": turn(angles.North),
        }],
    }  # fmt: skip


def _width(support: Support, along: FloatArray) -> float:
    """-3 dB width, m, of the cut along a direction (2,), without a weighting."""
    return cut_width(support.frequencies @ along, np.ones(len(support.frequencies)))


def _slant_resolution(source: FinishedRun, point: FloatArray, support: Support) -> tuple[float, float]:
    """Unweighted -3 dB widths in the slant plane, m: in range by the band, in azimuth by the change of aspect."""
    geometry, middle = source.geometry, centre_time(source.geometry, point)
    ends = middle + np.array([-0.5, 0.5]) * support.dwell
    sight = lines_of_sight(geometry, np.broadcast_to(point, (2, 3)), np.clip(ends, *geometry.collection.time[[0, -1]]))
    turn = float(np.linalg.norm(sight[1] - sight[0]))
    wavelength = SPEED_OF_LIGHT / geometry.collection.carrier
    return WIDTH * SPEED_OF_LIGHT / (2 * geometry.collection.bandwidth), WIDTH * wavelength / (2 * turn)


# ---------------------------------------------------------------- file


def write(
    pixels: Pixels, frame: Georeference, out: Location, *, overwrite: bool = False, progress: Callback | None = None
) -> list[str]:
    """Write pixels, whole numbers of dB in 8 bits, as one SIDD file, holding one strip of them at a time.

    Returns
    -------
    list of str
        Notes for the user: grid, range, and how well the polynomials fit.

    Raises
    ------
    InputError
        If the image has no covered pixel, its ground lies where no map is, NITF does not know its classification,
        sarkit is not installed, or `out` cannot be written.
    ProcessingError
        If writing fails.
    """
    with library_for("SIDD needs", "formats"):
        from sarkit import sidd as sksidd
    grid, source = grid_of(pixels, frame), pixels.source
    metadata = build_metadata(grid)
    security = sksidd.NitfSecurityFields(clas=security_mark(source))
    nitf = sksidd.NitfMetadata(
        file_header_part=sksidd.NitfFileHeaderPart(
            ostaid="blocksar", ftitle=ascii_text(source.title, 80), security=security
        ),
        images=[
            sksidd.NitfProductImageMetadata(
                xmltree=metadata.tree,
                im_subheader_part=sksidd.NitfImSubheaderPart(security=security),
                de_subheader_part=sksidd.NitfDeSubheaderPart(security=security),
            )
        ],
    )
    size = grid.shape[0] * grid.shape[1]
    with replacing(out, overwrite=overwrite, room=2 * size) as part:
        plain = temporary_name(part, "part")
        try:
            # Rows of the file may be columns of the image, which is read by rows.
            file = np.memmap(plain, np.uint8, "w+", shape=grid.shape)
            _fill(grid, file, progress or (lambda done, total: None))
            with open(part, "wb") as nitf_file, sksidd.NitfWriter(nitf_file, nitf) as writer:
                writer.write_image(0, file)
            del file
        finally:
            if os.path.exists(plain):
                os.unlink(plain)
    low, high = pixels.limits
    scale = f"8 bits: 1 is {low:g} dB, 255 is {high:g} dB, 0 is not covered"
    return [*about_segments(source, "a SIDD", "track and centre of aperture"), *metadata.notes, scale]


def _fill(grid: SIDDGrid, file: np.memmap[tuple[int, int], np.dtype[np.uint8]], progress: Callback) -> None:
    """Fill the file's array."""
    upright, raster = grid.upright(file), grid.raster
    strips = list(raster.strips())
    for done, rows in enumerate(strips, 1):
        upright[rows] = raster.coded(raster.measured(rows))
        progress(done, len(strips))
