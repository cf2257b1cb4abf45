"""The image of a run as a cloud-optimised GeoTIFF, through GDAL (rasterio).

Complex pixels equal those of the image bit for bit, and others follow from them, or from means over whole cells of
them. Rows run from large y to small, so north is up where the frame is not turned, and nothing is resampled, unless a
coordinate reference system is asked for (`pixels`). A GIS also needs a map projection in which the pixels form a grid.
Transverse Mercator about the scene frame's origin, with a scale of 1 + height / radius of curvature, comes very
close: its easting and northing equal x and y of the frame's
horizontal plane but for d^3 / (3 R^2) at the distance d (8 mm at 10 km). A height h over that plane adds h d / R. UTM
would need resampling, or a grid that is rotated and sheared.

Where the error exceeds a twentieth of a pixel, because the origin is far away (as a platform's nadir is) or the frame
is rotated from north, the projection is centred on the image instead, and the best affine map places the pixels,
rotated if need be. The largest error of a pixel's place against exact conversion through ECEF is reported and stored in
the file.

Each level of overviews has half as many rows and columns, with the means of the product's quantity.

Means are of what was measured, before it is coded: power for amplitude and decibels, whose own means say nothing. A
cell of level k is the mean of all covered pixels among the 2^k x 2^k that it stands for; not that of the means of the
level above, which at the edge of what is covered would count some pixels more than others. Complex pixels, whose mean
is no image, and flags have those of the north-western corner of each cell.

GDAL knows no such mean of decibels. So each level is a file of its own, which a VRT names as the overview of the
pixels, and GDAL copies them all into one.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import FloatArray
from blocksar.collection.georeference import Georeference
from blocksar.errors import library_for, printable
from blocksar.places import Location
from blocksar.places.local import temporary_name
from blocksar.products.backscatter import MEANINGS, BackscatterRun, describe_factor
from blocksar.products.pixels import MapPixels, Pixels, parse_crs
from blocksar.products.writing import replacing
from blocksar.progress.listening import Callback
from blocksar.version import __version__

if TYPE_CHECKING:
    from pyproj import CRS

NEAREST = ("complex", "visibility")  # contents without a mean
AT_ONCE = 1 << 18  # pixels of the full image

State = NDArray[Any]  # (1, rows, columns): pixels; (2, rows, columns): sums and numbers of covered pixels


def sizes_of(width: int, height: int, tile: int) -> list[tuple[int, int]]:
    """Columns and rows of the overview levels, down to one that fits a single tile.

    Examples
    --------
    >>> sizes_of(1300, 600, 512)
    [(650, 300), (325, 150)]
    """
    sizes = []
    while max(width, height) > tile:
        width, height = -(-width // 2), -(-height // 2)
        sizes.append((width, height))
    return sizes


class OverviewLevel:
    """A level of overviews, written from north to south as rows of the level above arrive."""

    def __init__(self, write: Callable[[int, NDArray[Any]], None], below: OverviewLevel | None) -> None:
        """Take `write`, a function of the number of a row and of measured rows."""
        self._write, self._below, self._row = write, below, 0
        self._held: State | None = None

    def take(self, rows: State) -> None:
        """Take rows of the level above; an odd row is held until the next arrives."""
        rows = rows if self._held is None else np.concatenate([self._held, rows], axis=1)
        whole = rows.shape[1] // 2 * 2
        self._held = rows[:, whole:]
        self._put(rows[:, :whole])

    def end(self) -> None:
        """Write the held row, and end the levels below."""
        if self._held is not None:
            self._put(self._held)
        if self._below is not None:
            self._below.end()

    def _put(self, rows: State) -> None:
        if not rows.shape[1]:
            return
        halved = _halved(rows)
        self._write(self._row, _values(halved))
        self._row += halved.shape[1]
        if self._below is not None:
            self._below.take(halved)


def feed(first: OverviewLevel, measured: NDArray[Any], *, nearest: bool) -> None:
    """Feed measured rows (rows, columns), from north to south, to the first level; NaN where not covered."""
    step = max(AT_ONCE // measured.shape[1], 1)
    for start in range(0, len(measured), step):
        rows = measured[start : start + step]
        if nearest:
            first.take(rows[None])
        else:
            covered = ~np.isnan(rows)
            first.take(np.stack([np.where(covered, rows, 0), covered]).astype(np.float64))


def _halved(rows: State) -> State:
    """Sum over cells of 2 x 2, smaller at an odd end; for flags take the first pixel of each cell."""
    if len(rows) == 1:
        return rows[:, ::2, ::2]
    pairs = np.add.reduceat(rows, np.arange(0, rows.shape[1], 2), axis=1)
    return np.asarray(np.add.reduceat(pairs, np.arange(0, rows.shape[2], 2), axis=2))


def _values(rows: State) -> NDArray[Any]:
    if len(rows) == 1:
        return np.asarray(rows[0])
    total, count = rows
    return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0).astype(np.float32)


UNITS = {"height": "m", "incidence": "rad"}
GAMMA = "power times cos psi / cos theta over that of level ground, psi: slant plane to slope, theta: local incidence"
FLAGS = "0 visible, 1 layover, 2 shadow, 255 not covered"
MAX_ERROR = 0.05  # pixels that a pixel may lie off its exact place
NOTED = 0.5  # pixels, from which on the remedy is stated
POINTS = 17, 65  # along a side, at which places are compared: on the plane, on a terrain
TILE = 512  # pixels a side
TRAILER = 4  # bytes after each tile of GDAL's COG, which repeat its last four
CACHE = 64 * 2**20  # bytes, GDAL's cache of blocks to write


class Placement(NamedTuple):
    """A projection and the pixels' places in it: easting and northing = offset + matrix @ (x, y) of the scene frame.

    Attributes
    ----------
    crs : CRS
    offset, matrix : (2,), (2, 2) float
        m; of the affine map.
    error, pixels : float
        Largest distance of a pixel from its exact place, in m and in pixels.
    """

    crs: CRS
    offset: FloatArray
    matrix: FloatArray
    error: float
    pixels: float


def write(
    pixels: Pixels,
    out: Location,
    *,
    crs: str | None = None,
    overwrite: bool = False,
    progress: Callback | None = None,
) -> list[str]:
    """Write pixels as one cloud-optimised GeoTIFF, holding one strip of them at a time.

    Parameters
    ----------
    pixels : Pixels
        Overviews hold means, of power for amplitude and decibels, and nearest neighbours of complex pixels and
        visibility (`overviews`). NaN means no data; 255 in visibility; 0 in whole numbers of dB, whose scale and offset
        the band tells.
    crs : str, optional
        The map to orthorectify to, such as EPSG:32616. Default: the pixels as they are, in the frame's projection.

    Returns
    -------
    list of str
        Notes for the user: projection, and how well it fits.

    Raises
    ------
    InputError
        If the run has no georeference or no covered pixel, the CRS is none or does not suit the place, rasterio is not
        installed, or `out` cannot be written.
    ProcessingError
        If writing fails.
    """
    with library_for("GeoTIFF needs", "geotiff"):
        import rasterio
        from rasterio._err import CPLE_BaseError  # GDAL's own errors, which rasterio passes on unconverted in places
        from rasterio.errors import RasterioError
    source = pixels.source
    raster, placement = _placed(pixels, source.placed("a GeoTIFF"), crs)
    listener = progress or (lambda done, total: None)
    source.coverage()  # raises if no pixel is covered
    room = raster.x.size * raster.y.size * np.dtype(pixels.dtype).itemsize  # of the plain file
    with replacing(out, overwrite=overwrite, room=room) as part, rasterio.Env(GDAL_CACHEMAX=CACHE, GDAL_NUM_THREADS=1):
        sizes = sizes_of(raster.x.size, raster.y.size, TILE)
        plain, *levels, whole = (temporary_name(part, "part") for _ in range(len(sizes) + 2))
        try:
            _write_plain(raster, plain, dict(zip(levels, sizes, strict=True)), placement, listener)
            _optimise(plain, levels, whole, part)
        except (RasterioError, CPLE_BaseError) as error:
            message = printable(" ".join(str(error).split()).replace(f"{os.path.dirname(plain)}/", ""))[:200]
            raise OSError(None, f"GDAL says: {message}; is there room on the disk?", plain) from error
        finally:
            for path in (plain, *levels, whole):
                if os.path.exists(path):
                    os.unlink(path)
    lines = [_describe(pixels, raster, placement)]
    if pixels.scale is not None:
        low, high = pixels.limits
        lines.append(f"{pixels.scale}: 1 is {low:g} dB, {np.iinfo(pixels.scale).max} is {high:g} dB, 0 is not covered")
    return lines


def _placed(pixels: Pixels, frame: Georeference, crs: str | None) -> tuple[Pixels | MapPixels, Placement]:
    """Choose the pixels to write and their placement: those of the image, or those of a map."""
    if crs is None:
        return pixels, place_pixels(pixels, frame)
    mapped = MapPixels.over(pixels, parse_crs(crs), frame)
    error = mapped.error
    return mapped, Placement(mapped.crs, np.zeros(2), np.eye(2), error, error / min(pixels.spacing))


def _describe(pixels: Pixels, raster: Pixels | MapPixels, placement: Placement) -> str:
    """One line about what was written."""
    what = f"{_name(pixels)} of {raster.x.size} x {raster.y.size} pixels"
    if isinstance(raster, MapPixels):
        name, (step, _) = placement.crs.axis_info[0].unit_name, raster.spacing
        unit = {"metre": "m", "degree": "degrees"}.get(name, name)
        on = "the ground plane" if pixels.source.geometry.terrain is None else "the terrain"
        what = f"{what}, {step:.4g} {unit} wide, orthorectified on {on}"
    line = (
        f"{what}, {placement.crs.name}; pixels lie at most {placement.error:.2g} m, {placement.pixels:.2g} pixels, off "
        "their exact places"
    )
    if isinstance(raster, MapPixels) and (tied := raster.datum_tie)[0] != 0:
        how = "to an unknown precision" if math.isnan(tied[0]) else f"to {tied[0]:g} m"
        better = f", better with the grid {tied[1]}, which is not installed" if tied[1] else ""
        line += f"; PROJ ties its datum to WGS 84 {how}{better}"
    if placement.pixels > NOTED:
        line += "; --crs EPSG:n makes a map without that error"
    return line


def _write_plain(
    raster: Pixels | MapPixels,
    path: str,
    levels: dict[str, tuple[int, int]],
    placement: Placement,
    progress: Callback,
) -> None:
    """Write a tiled GeoTIFF without overviews, and each overview level as a file of its own."""
    import rasterio

    pixels = raster.of if isinstance(raster, MapPixels) else raster
    profile = {
        "driver": "GTiff",
        "width": raster.x.size,
        "height": raster.y.size,
        "count": 1,
        "dtype": pixels.dtype,
        "nodata": pixels.nodata,
        "crs": rasterio.CRS.from_wkt(placement.crs.to_wkt()),
        "transform": rasterio.Affine(*_transform(raster, placement)),
        "tiled": True,
        "blockxsize": TILE,
        "blockysize": TILE,
        "bigtiff": "if_safer",
    }
    with ExitStack() as stack:
        file = stack.enter_context(rasterio.open(path, "w", **profile))
        reduced = {name: profile[name] for name in profile if name not in ("crs", "transform")}
        files = []
        for level, (width, height) in levels.items():
            with warnings.catch_warnings():  # that levels have no georeference: they have that of the whole
                warnings.simplefilter("ignore")
                files.append(rasterio.open(level, "w", **{**reduced, "width": width, "height": height}))
            stack.enter_context(files[-1])
        _write_pixels(raster, file, files, progress)
        file.set_band_description(1, _name(pixels))
        if pixels.scale is not None:
            file.scales, file.offsets, file.units = (pixels.step,), (pixels.offset,), ("dB",)
        elif pixels.content in UNITS:
            file.units = (UNITS[pixels.content],)
        elif isinstance(pixels.source, BackscatterRun):
            file.units = ("dB" if pixels.content == "db" else "1",)
        file.update_tags(**_tags(pixels, placement))


def _optimise(plain: str, levels: list[str], whole: str, path: str) -> None:
    """Combine a GeoTIFF and its overviews into a cloud-optimised one, through a VRT that has both.

    Raises
    ------
    OSError
        If the end of the file was lost.
    """
    from rasterio.shutil import copy

    copy(plain, whole, driver="VRT")
    with open(whole, encoding="utf-8") as file:
        before, end, after = file.read().rpartition("</VRTRasterBand>")
    named = (f"<SourceFilename>{escape(level)}</SourceFilename><SourceBand>1</SourceBand>" for level in levels)
    with open(whole, "w", encoding="utf-8") as file:
        file.write(before + "".join(f"<Overview>{each}</Overview>" for each in named) + end + after)
    copy(
        whole,
        path,
        driver="COG",
        blocksize=TILE,
        compress="DEFLATE",
        level=1,
        bigtiff="if_safer",
        overviews="FORCE_USE_EXISTING",
    )
    # GDAL does not report a failure to write the end of the file.
    if (lacking := _end(path) - os.path.getsize(path)) > 0:
        raise OSError(None, f"its last {lacking} bytes were lost; is there room on the disk?", path)


def _write_pixels(pixels: Pixels | MapPixels, file: Any, levels: list[Any], progress: Callback) -> None:
    """Write rows from north to south, and their overviews, the largest first."""

    def write(file: Any, row: int, measured: NDArray[Any]) -> None:
        values = np.ascontiguousarray(pixels.coded(measured))
        file.write(values, 1, window=Window(0, row, file.width, len(values)))

    from rasterio.windows import Window

    first = None
    for level in reversed(levels):
        first = OverviewLevel(partial(write, level), first)
    strips = list(pixels.strips())[::-1]
    for done, rows in enumerate(strips, 1):
        measured = pixels.measured(rows)[::-1]
        write(file, pixels.y.size - rows.stop, measured)
        if first is not None:
            feed(first, measured, nearest=pixels.content in NEAREST)
        progress(done, len(strips))
    if first is not None:
        first.end()


def _end(path: str) -> int:
    """End of the last tile of a cloud-optimised GeoTIFF, bytes, according to the file's own directories."""
    import rasterio

    ends = [0]
    with rasterio.open(path) as file:
        for level, factor in enumerate((1, *file.overviews(1))):
            tiles = (-(-size // (factor * TILE)) for size in (file.width, file.height))
            for column, row in np.ndindex(*tiles):
                offset, size = (
                    file.get_tag_item(f"BLOCK_{name}_{column}_{row}", "TIFF", bidx=1, ovr=level - 1 if level else None)
                    for name in ("OFFSET", "SIZE")
                )
                if offset is not None and size is not None:
                    ends.append(int(offset) + int(size) + TRAILER)
    return max(ends)


def _name(pixels: Pixels) -> str:
    """Name of what pixels hold."""
    if not isinstance(pixels.source, BackscatterRun):
        return pixels.content
    return pixels.source.quantity + (" (dB)" if pixels.content == "db" else "")


def _tags(pixels: Pixels, placement: Placement) -> dict[str, str]:
    """Tags of the file."""
    source = pixels.source
    looks = {} if pixels.looks == (1, 1) else {"looks": f"{pixels.looks[0]} x {pixels.looks[1]} pixels (y x x)"}
    meaning = {"gamma": GAMMA, "visibility": FLAGS}.get(pixels.content)
    calibration = {"calibration": "a target of reflectivity 1 peaks at 1 + 0j"}
    if isinstance(source, BackscatterRun):
        meaning = f"{source.quantity}, backscatter {MEANINGS[source.quantity]}"
        calibration = {"calibration": describe_factor(source.factor)}
        calibration |= {} if source.factor is None else {"calibration_factor_m2": repr(source.factor)}
    return (
        looks
        | calibration
        | ({} if meaning is None else {"content": meaning})
        | {
            "TIFFTAG_IMAGEDESCRIPTION": source.title,
            "TIFFTAG_SOFTWARE": f"blocksar {__version__}",
            "AREA_OR_POINT": "Area",
            "run": source.record.identity,
            "carrier_frequency_hz": repr(source.collection.carrier),
            "location_error_m": f"{placement.error:.3g}",
        }
    )


def place_pixels(pixels: Pixels, frame: Georeference) -> Placement:
    """Place pixels in the projection about the frame's origin, or about the image if the error exceeds MAX_ERROR."""
    height, spacing, geometry = pixels.source.ground_height, min(pixels.spacing), pixels.source.geometry
    count = POINTS[geometry.terrain is not None]
    x, y = (axis[np.unique(np.linspace(0, axis.size - 1, count).astype(int))] for axis in (pixels.x, pixels.y))
    xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    points = geometry.on_ground(xy[:, 0], xy[:, 1])
    points[~np.isfinite(points[:, 2]), 2] = height

    def evaluate(crs: CRS, offset: FloatArray, matrix: FloatArray) -> Placement:
        error = float(np.linalg.norm(offset + xy @ matrix.T - frame.project(crs, points), axis=1).max())
        return Placement(crs, offset, matrix, error, error / spacing)

    own = evaluate(frame.projection(0.0, 0.0, height), np.zeros(2), np.eye(2))
    if own.pixels <= MAX_ERROR:
        return own
    crs = frame.projection(float(x.mean()), float(y.mean()), height)
    projected = frame.project(crs, points)
    middle = xy.mean(axis=0)
    fit = np.linalg.lstsq(np.concatenate([np.ones((len(xy), 1)), xy - middle], axis=1), projected)[0]
    return evaluate(crs, fit[0] - fit[1:].T @ middle, fit[1:].T)


def _transform(pixels: Pixels | MapPixels, placement: Placement) -> tuple[float, ...]:
    """GDAL's affine map from column and row of a pixel's north-western corner to easting and northing, m."""
    dx, dy = pixels.spacing
    along, down = placement.matrix[:, 0] * dx, -placement.matrix[:, 1] * dy
    corner = placement.offset + placement.matrix @ [pixels.x[0], pixels.y[-1]] - (along + down) / 2
    return (along[0], down[0], corner[0], along[1], down[1], corner[1])
