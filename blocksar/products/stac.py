"""The STAC item of a run (SpatioTemporal Asset Catalog 1.1.0), with the extensions sar, projection, processing and sat.

Ranges and azimuths of the extension sar are directions across and along the track, level, at the middle of the image:
resolutions are the -3 dB widths there of a target's response along them. The frequency band is that of the table of
that extension. The extension sat is given where the antenna is in orbit, from its height on.

Times are those of the first and of the last pulse of all collections. The footprint bounds the covered pixels, at the
ground that they show; across the antimeridian it is cut in two, as GeoJSON demands.
"""

from __future__ import annotations

import json
import mimetypes
import os
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from blocksar import stores
from blocksar.arrays import FloatArray
from blocksar.collection.georeference import Georeference
from blocksar.errors import InputError, library_for
from blocksar.places import Location, place
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place
from blocksar.products.geotiff import place_pixels
from blocksar.products.pixels import Pixels
from blocksar.products.shared_metadata import (
    EPOCH,
    Layout,
    centre_time,
    cut_width,
    date_of,
    find_support,
    lay_out,
    lines_of_sight,
    lit_times,
    polarization,
    radar_mode,
    refuse_bistatic,
    sample_pixels,
    valid_data,
)
from blocksar.products.writing import replacing
from blocksar.runs.finished import FinishedRun, finished_record, folder_of
from blocksar.texts import count
from blocksar.version import __version__

if TYPE_CHECKING:
    from pyproj import CRS

VERSION = "1.1.0"
EXTENSIONS = {
    "sar": "v1.3.2", "projection": "v2.0.0", "processing": "v1.1.0", "sat": "v1.0.0",
    "xarray-assets": "v1.0.0",
}  # fmt: skip
# Lower ends of the frequency bands, GHz, by the table of the extension sar.
BANDS = ((0.25, "P"), (1, "L"), (2, "S"), (4, "C"), (8, "X"), (12.5, "Ku"), (18, "K"), (26.5, "Ka"), (40, ""))
POLARIZATIONS = ("HH", "VV", "HV", "VH")  # those of the extension that a pair of linear ones can be
ORBIT = 100e3  # m above the ellipsoid, from which on a platform is a satellite
ONE_APERTURE = 1e-3  # of a dwell, within which the centres of aperture of all pixels are one
TYPES = {
    ".tif": "image/tiff; application=geotiff; profile=cloud-optimized", ".nitf": "application/vnd.nitf",
    ".ntf": "application/vnd.nitf", ".nsf": "application/vnd.nitf", ".kml": "application/vnd.google-earth.kml+xml",
}  # fmt: skip
TYPES[".tiff"] = TYPES[".tif"]
ZARR = "application/vnd.zarr; version=3"
OPEN_KWARGS = {"engine": "zarr", "consolidated": False, "chunks": {}}  # of xarray.open_dataset, for the image
BESIDE = {"run.json": "settings and receipts", "quality.json": "measured targets", "report.html": "report"}


def write(
    source: FinishedRun, run: Place, out: Location, files: Sequence[str], *, overwrite: bool = False
) -> list[str]:
    """Write the item of a run.

    Parameters
    ----------
    source : FinishedRun
        The run, or its channel that the item describes, or is the first of those.
    run : Place
        The folder with the assets.
    files : sequence of str
        Exported files.

    Returns
    -------
    list of str
        Lines for the user.

    Raises
    ------
    InputError
        If the run has no georeference or no covered pixel, a file is missing or of another run, a library is not
        installed, or `out` cannot be written.
    """
    refuse_bistatic(source, "a STAC item")
    frame = source.placed("a STAC item")
    with library_for("STAC needs", "formats"):
        import shapely  # noqa: F401 - which outlines need
    item, notes = build(source, run, frame, out, files)
    text = json.dumps(item, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    with replacing(out, overwrite=overwrite) as part:
        Path(part).write_text(text, encoding="utf-8")
    return notes


def build(
    source: FinishedRun, run: Place, frame: Georeference, out: Location, files: Sequence[str]
) -> tuple[dict[str, Any], list[str]]:
    """Build the item, with notes for the user."""
    start, end, known = _times(source)
    coverage, layout = source.coverage(), lay_out(source)
    notes = [] if known else ["the phase history has no date, so datetime is 1970-01-01"]
    assets = _assets(source, run, frame, out, files)
    satellite = _orbit(source, frame)
    properties = {
        "title": source.scene_title,
        "datetime": _text(start + (end - start) / 2),
        "start_datetime": _text(start),
        "end_datetime": _text(end),
        "created": _text(datetime.now(UTC)),
        "gsd": max(source.spacing),
        **({"platform": str(source.attrs["collector"])} if source.attrs.get("collector") else {}),
        **_radar(source, run, layout, sample_pixels(coverage, layout)),
        **_processing(source),
        **satellite,
    }
    geometry, bbox = _footprint(source, frame, layout.point(*valid_data(coverage, layout).T.astype(np.float64)))
    used = [name for name in EXTENSIONS if name != "sat" or satellite]
    notes.append(f"item of {count(len(assets), 'asset')}, with the extensions {', '.join(used)}")
    return {
        "type": "Feature",
        "stac_version": VERSION,
        "stac_extensions": [
            f"https://stac-extensions.github.io/{name}/{EXTENSIONS[name]}/schema.json" for name in used
        ],
        "id": f"{run.name}-{source.record.identity[:12]}".strip("-"),
        "geometry": geometry,
        "bbox": bbox,
        "properties": properties,
        "links": [],
        "assets": assets,
    }, notes


def _times(source: FinishedRun) -> tuple[datetime, datetime, bool]:
    """UTC of the first and the last pulse of all segments, and whether they are known."""
    sources = [(source.attrs.get("source"), source.collection)]
    for number in range(len(source.segments)):
        collection, attrs = stores.read_collection(source.folder / "segments" / str(number) / "collection.zarr")
        sources.append((attrs.get("source"), collection))
    dates = [date_of(of, float(collection.time[end])) for of, collection in sources for end in (0, -1)]
    if known := [date for date in dates if date is not None]:
        return min(known), max(known), True
    first, last = source.collection.time[[0, -1]]
    return EPOCH, EPOCH + timedelta(seconds=float(last - first)), False


def _text(moment: datetime) -> str:
    return f"{moment:%Y-%m-%dT%H:%M:%S.%f}Z"


def _footprint(source: FinishedRun, frame: Georeference, vertices: FloatArray) -> tuple[dict[str, Any], list[float]]:
    """GeoJSON geometry of vertices (n, 3), m, counter-clockwise, and its limits: west, south, east, north."""
    from shapely import Polygon, affinity, box
    from shapely.geometry import mapping
    from shapely.geometry.polygon import orient

    outline = Polygon(_to_the_pole(_degrees(source, frame, vertices[:, 0], vertices[:, 1])))
    if not outline.is_valid:
        outline = outline.convex_hull
    west, south, east, north = outline.bounds
    parts = [outline]
    if east - west >= 360:
        west, east = -180.0, 180.0
    elif east > 180 or west < -180:
        west, east = ((at + 180) % 360 - 180 for at in (west, east))
    if outline.bounds[2] > 180 or outline.bounds[0] < -180:
        worlds = ((box(k * 360 - 180, -90, k * 360 + 180, 90), -360 * k) for k in (-1, 0, 1))
        pieces = (affinity.translate(outline.intersection(world), shift) for world, shift in worlds)
        parts = [part for piece in pieces for part in getattr(piece, "geoms", [piece]) if part.area > 0]
    rings = [mapping(orient(part))["coordinates"] for part in parts]
    kind = {"type": "Polygon", "coordinates": rings[0]} if len(rings) == 1 else {
        "type": "MultiPolygon", "coordinates": rings,
    }  # fmt: skip
    return kind, [west, south, east, north]


def _to_the_pole(places: FloatArray) -> FloatArray:
    """Longitudes and latitudes (n, 2), degrees, of an outline; around a pole, it is extended to the pole and back."""
    after = places[-1, 0] + (places[0, 0] - places[-1, 0] + 180) % 360 - 180
    if abs(after - places[0, 0]) < 180:
        return places
    pole = np.copysign(90.0, places[:, 1].mean())
    (first, latitude), last = places[0], places[0, 0] + np.copysign(360.0, after - places[0, 0])
    return np.concatenate([places, [[last, latitude], [last, pole], [first, pole]]])


def _degrees(source: FinishedRun, frame: Georeference, x: FloatArray, y: FloatArray) -> FloatArray:
    """Longitude and latitude (n, 2), degrees, of the ground at places (n,), m; longitudes are continuous."""
    ground = source.geometry.on_ground(x, y)
    ground[..., 2] = np.where(np.isfinite(ground[..., 2]), ground[..., 2], source.ground_height)
    latitude, longitude, _ = np.moveaxis(frame.to_geodetic(ground), -1, 0)
    return np.stack([np.degrees(np.unwrap(np.radians(longitude))), latitude], axis=-1)


def _radar(source: FinishedRun, run: Place, layout: Layout, pixels: FloatArray) -> dict[str, Any]:
    """Fields of the extension sar, from some covered pixels (n, 2) of a layout."""
    collection, geometry = source.collection, source.geometry
    first, last = lit_times(geometry, layout.point(*pixels.T))
    middle, lit = (first + last) / 2, first < last
    one = bool(not lit.any() or np.ptp(middle[lit]) < ONE_APERTURE * (last - first)[lit].mean())
    scp = layout.point(*pixels[len(pixels) // 2].astype(np.float64))
    time = np.array(centre_time(geometry, scp))
    along = geometry.track.velocity(time)[:2]
    along = along / np.linalg.norm(along)
    across = np.array([along[1], -along[0]])  # to the right
    side = float(lines_of_sight(geometry, scp, time)[:2] @ across)
    support = find_support(geometry, scp, source.weighting)
    widths = (cut_width(support.frequencies @ direction, support.weights) for direction in (across, along))
    band = next((name for (low, name), (high, _) in pairwise(BANDS)
                 if low <= collection.carrier / 1e9 < high), "")  # fmt: skip
    even = abs(np.subtract(*source.spacing)) < 1e-6 * max(source.spacing)
    spacing = dict.fromkeys(("sar:pixel_spacing_range", "sar:pixel_spacing_azimuth"), source.spacing[0])
    polarizations = _polarizations(source, run)
    return {
        "sar:instrument_mode": radar_mode(collection, one_aperture=one),
        **({"sar:frequency_band": band} if band else {}),
        "sar:center_frequency": collection.carrier / 1e9,
        "sar:bandwidth": collection.bandwidth / 1e9,
        **({"sar:polarizations": polarizations} if polarizations else {}),
        "sar:product_type": "SGC",  # complex, of one look, projected to the ground
        **dict(zip(("sar:resolution_range", "sar:resolution_azimuth"), widths, strict=True)),
        **(spacing if even else {}),
        "sar:looks_range": 1,
        "sar:looks_azimuth": 1,
        "sar:observation_direction": "right" if side > 0 else "left",
    }


def _polarizations(source: FinishedRun, run: Place) -> list[str]:
    """Known polarisations of all channels, each once."""
    record = finished_record(run)
    channels = record.channels if record.dimension == "channel" else ()
    of = [FinishedRun.open(folder_of(run, name)) for name in channels] or [source]
    pairs = (polarization(each)[1].replace(":", "") for each in of)
    return [pair for pair in dict.fromkeys(pairs) if pair in POLARIZATIONS]


def _processing(source: FinishedRun) -> dict[str, Any]:
    """Fields of the extension processing."""
    record = source.record
    surface = "the plane" if source.geometry.terrain is None else "a terrain"
    lineage = f"focused by {record.processor or 'a processor'} of blocksar on {surface}, calibrated"
    tapers = "" if source.weighting.uniform else (
        f"; weighted by {source.weighting.range.text} in range, {source.weighting.azimuth.text} in azimuth"
    )  # fmt: skip
    return {
        "processing:level": "L1",
        "processing:lineage": lineage + tapers,
        "processing:software": {"blocksar": str(record.versions.get("blocksar") or __version__)},
    }


def _orbit(source: FinishedRun, frame: Georeference) -> dict[str, Any]:
    """Fields of the extension sat; empty for an aircraft."""
    collection = source.collection
    ends = frame.to_geodetic(collection.antenna_position[[0, -1]])
    if ends[:, 2].min() < ORBIT:
        return {}
    return {"sat:orbit_state": "ascending" if ends[1, 0] > ends[0, 0] else "descending"}


def _assets(
    source: FinishedRun, run: Place, frame: Georeference, out: Location, files: Iterable[str]
) -> dict[str, Any]:
    """Assets by name: the image, other files in the folder, and exported files."""
    assets: dict[str, Any] = {
        "image": {
            "href": _href(run / "image.zarr", out), "type": ZARR, "roles": ["data"], "data_type": "cfloat32",
            "title": "calibrated complex image", "nodata": "nan", "xarray:open_kwargs": OPEN_KWARGS,
            **_grid(source, frame),
        }
    }  # fmt: skip
    for name, title in BESIDE.items():
        if (run / name).exists():
            role = "overview" if name.endswith(".html") else "metadata"
            assets[name.partition(".")[0]] = {
                "href": _href(run / name, out), "type": mimetypes.guess_type(name)[0], "roles": [role], "title": title,
            }  # fmt: skip
    for file in files:
        path = Path(file)
        if not path.is_file():
            raise InputError(f"assets: {file} is no file; export it first, or leave it out")
        assets[path.name] = {"href": _href(place(file), out), **_described(path, source)}
    return assets


def _described(path: Path, source: FinishedRun) -> dict[str, Any]:
    """Describe an exported file; of a GeoTIFF its grid."""
    ending = path.suffix.lower()
    kind = TYPES.get(ending) or mimetypes.guess_type(path.name)[0] or "application/octet-stream"
    picture = kind in ("image/png", "text/html")
    asset: dict[str, Any] = {"type": kind, "roles": ["overview" if picture else "data"], "title": path.name}
    if ending not in (".tif", ".tiff"):
        return asset
    with library_for("a GeoTIFF as an asset needs", "geotiff"):
        import rasterio
        from pyproj import CRS
    with rasterio.open(path) as file:
        if (of := file.tags().get("run")) != source.record.identity:
            whose = "another run" if of else "no run of blocksar"
            raise InputError(f"assets: {path} is of {whose}; export this one's, or leave it out")
        types = {"complex64": "cfloat32"}
        nodata = "nan" if np.isnan(file.nodata) else file.nodata
        return {
            **asset, "data_type": types.get(file.dtypes[0], file.dtypes[0]), "nodata": nodata,
            **_projection(CRS.from_wkt(file.crs.to_wkt()), (file.height, file.width), list(file.transform)[:6]),
        }  # fmt: skip


def _grid(source: FinishedRun, frame: Georeference) -> dict[str, Any]:
    """Grid of the image, with rows running north, in the projection of its GeoTIFF."""
    placement = place_pixels(Pixels(source, "complex"), frame)
    (dx, dy), matrix = source.spacing, placement.matrix
    corner = placement.offset + matrix @ [source.x[0] - dx / 2, source.y[0] - dy / 2]
    rows = np.stack([matrix[:, 0] * dx, matrix[:, 1] * dy, corner], axis=1)
    return _projection(placement.crs, (source.y.size, source.x.size), rows.ravel().tolist())


def _projection(crs: CRS, shape: tuple[int, int], transform: list[float]) -> dict[str, Any]:
    """Fields of the extension projection."""
    matrix = np.reshape(transform, (2, 3))
    ends = np.array([[0, 0, 1], [shape[1], 0, 1], [0, shape[0], 1], [shape[1], shape[0], 1]], np.float64) @ matrix.T
    authority = crs.to_authority()
    named = {"proj:code": ":".join(authority)} if authority else {"proj:code": None, "proj:wkt2": crs.to_wkt()}
    return {
        **named,
        "proj:shape": list(shape),
        "proj:transform": [float(value) for value in transform],
        "proj:bbox": [*ends.min(axis=0).tolist(), *ends.max(axis=0).tolist()],
    }


def _href(path: Place, out: Location) -> str:
    """Path of a file, relative to the item if both are local."""
    item = place(out)
    if not (isinstance(path, LocalPlace) and isinstance(item, LocalPlace)):
        return str(path)
    relative = os.path.relpath(path.path.absolute(), item.path.absolute().parent)
    return relative if relative.startswith("..") else f"./{relative}"
