"""The image of a run as a SICD file (Sensor Independent Complex Data, NGA.STND.0024, version 1.3.0), through sarkit.

One file holds the whole image, on its ground plane: Grid.Type PLANE, ImagePlane GROUND, ImageFormAlgo OTHER. The
standard could also be given one file a block in its own range-Doppler grid, but not truthfully: its range-Doppler grids
(RGAZIM, RGZERO, INCA) say by the formulas of polar format, range migration or plain azimuth compression which range and
Doppler a pixel has, and a block's grid, after keystone, fitted perturbation and deramp, follows none of these. A PLANE
grid asks for no more than what is true of a calibrated ground image: pixels are uniform points of a plane, known in
ECEF, and each has a centre of aperture, which for a steered beam depends on its yaw (TimeCOAPoly). Everything else
follows from plane, time and track, so range and Doppler contours, layover and height sensitivity come out right,
exactly where the track is. The seams between blocks are no seams here: every pixel was focused with its own full dwell,
whichever block it lies in.

Rows of the file run along that axis of the scene, +x, +y, -x or -y, which points away from the radar most, so that
shadows fall downwards; columns follow, right-handed about z. Pixels are those of the image, to the last bit; those that
are not covered are zero, and outside ValidData, which bounds the covered ones.

Spatial frequencies. A target at p0 is imaged as mean exp(+4j pi (fc + f)/c (R(p) - R(p0))), with no carrier taken off:
about p0 that is exp(+2j pi K . (p - p0)), K = 2 (fc + f)/c times the line of sight along row and column. So Sgn is -1,
and K is not near zero but folded into the band that the spacing SS can hold. KCtr is the multiple of 1/SS next to K at
the scene centre point, which is frequency zero of the samples, and DeltaKCOAPoly gives K - KCtr at the centre of
aperture all over the image; where it leaves +-1/(2 SS) the spectrum wraps, and DeltaK1, DeltaK2 are the whole band, as
the standard wants it. ImpRespBW is the extent of K along row and column at the scene centre point, ImpRespWid the -3 dB
width of the cut through a target there. The aperture is not weighted, but its support is not aligned with the axes
either, so no WgtType is given: with one, widths would be 0.886 / ImpRespBW.
"""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial
from numpy.polynomial import polynomial as power

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection.beam import dwell
from blocksar.collection.geometry import Geometry
from blocksar.collection.georeference import Georeference
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.places import Location
from blocksar.products.writing import replacing
from blocksar.progress.listening import Callback
from blocksar.runs.finished import Coverage, FinishedRun
from blocksar.version import __version__

if TYPE_CHECKING:
    from lxml.etree import _ElementTree as ElementTree


NAMESPACE = "urn:SICD:1.3.0"
MAX_BYTES = 10**10 - 2  # of one NITF image segment
MAX_VERTICES = 100  # of ValidData
FIT_POINTS = 41  # a side, where polynomials over the image are fitted
MAX_ORDER = 7
TIME_ACCURACY = 1e-3  # of a dwell, that TimeCOAPoly may be off
BAND_ACCURACY = 1e-2  # of the bandwidth, that DeltaKCOAPoly may be off
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
MARKS = {"TOP SECRET": "T", "SECRET": "S", "CONFIDENTIAL": "C", "RESTRICTED": "R", "UNCLASSIFIED": "U"}  # NITF's letter
POLARIZATIONS = ("V", "H", "X", "Y", "S", "E", "RHC", "LHC")
TURNS = ((1, 0), (0, 1), (-1, 0), (0, -1))  # directions that rows of the file may run in


class Layout(NamedTuple):
    """How the file's rows and columns lie in the scene: unit vectors (2,) in x and y, and where pixel (0, 0) is.

    `first` (3,) is the scene point of row 0, column 0; `spacing` and `shape` are those of rows and columns.
    """

    row: FloatArray
    column: FloatArray
    first: FloatArray
    spacing: tuple[float, float]
    shape: tuple[int, int]

    @property
    def row_axis(self) -> int:
        """Axis of the image's array that rows of the file run along: 0 is y, 1 is x."""
        return 1 if self.row[0] else 0

    def point(self, row: FloatArray, column: FloatArray) -> FloatArray:
        """Scene points (..., 3) of fractional rows and columns."""
        offset = np.multiply.outer(row * self.spacing[0], self.row) + np.multiply.outer(
            column * self.spacing[1], self.column
        )
        return self.first + np.concatenate([offset, np.zeros((*offset.shape[:-1], 1))], axis=-1)

    def turned(self, values: ComplexArray) -> ComplexArray:
        """A part (y, x) of the image in the order of the file."""
        values = values.T if self.row_axis == 1 else values
        return values[:: int(self.row.sum()), :: int(self.column.sum())]


class Poly2D(NamedTuple):
    """Coefficients (n, m) of x^i y^j in metres from the scene centre point, and the largest error of the fit."""

    coefficients: FloatArray
    error: float


def write(
    source: FinishedRun, out: Location, *, overwrite: bool = False, progress: Callback | None = None
) -> list[str]:
    """Write the image as one SICD file; of its pixels a strip is held at a time.

    Returns
    -------
    list of str
        What a person should know: orientation, and how well the polynomials fit.

    Raises
    ------
    InputError
        If the run has no georeference, its pixels are too far apart for its band, it is larger than one NITF image
        segment, its classification is none of NITF's, sarkit is not installed, or `out` cannot be written.
    ProcessingError
        If writing fails.
    """
    try:
        from sarkit import sicd as sksicd
    except ModuleNotFoundError as error:
        raise InputError(f"{error.name} is not installed, which SICD needs; install blocksar[formats]") from None
    frame = source.placed("a SICD")
    n_byte = 8 * source.x.size * source.y.size
    if n_byte > MAX_BYTES:
        raise InputError(
            f"the image has {n_byte / 1e9:.3g} GB, and one SICD is written up to 10 GB; focus a smaller --grid"
        )
    made = metadata(source, frame)
    security = sksicd.NitfSecurityFields(clas=_mark(source))
    nitf = sksicd.NitfMetadata(
        xmltree=made.tree,
        file_header_part=sksicd.NitfFileHeaderPart(
            ostaid="blocksar", ftitle=_ascii(source.title, 80), security=security
        ),
        im_subheader_part=sksicd.NitfImSubheaderPart(isorce=_ascii(source.title, 42), security=security),
        de_subheader_part=sksicd.NitfDeSubheaderPart(security=security),
    )
    jbp = sksicd.jbp_from_nitf_metadata(nitf)
    with replacing(out, overwrite=overwrite) as part, open(part, "wb") as file, sksicd.NitfWriter(file, nitf, jbp):
        file.seek(jbp["ImageSegments"][0]["Data"].get_offset())
        _write_pixels(source, made.layout, file, progress or (lambda done, total: None))
    return made.notes


def _write_pixels(source: FinishedRun, layout: Layout, file: BinaryIO, progress: Callback) -> None:
    """All rows in the file's order, big-endian, real and imaginary part in turn; not covered is zero."""
    axis = layout.row_axis
    strips = list(source.strips(axis))[:: int(layout.row.sum())]
    for done, strip in enumerate(strips, 1):
        values = source.read(*((strip, slice(None)) if axis == 0 else (slice(None), strip)))
        values = layout.turned(values)
        file.write(np.nan_to_num(values, nan=0.0, copy=True).astype(">c8", order="C").data)
        progress(done, len(strips))


class Made(NamedTuple):
    """SICD metadata, the layout of the pixels that they describe, and what there is to say of them."""

    tree: ElementTree
    layout: Layout
    notes: list[str]


def metadata(source: FinishedRun, frame: Georeference) -> Made:
    """All of the XML."""
    from lxml import etree
    from sarkit import sicd as sksicd

    coverage = source.coverage()
    layout = lay_out(source)
    vertices = valid_data(coverage, layout)
    scp_pixel = _centre(vertices)
    scp = layout.point(*scp_pixel.astype(np.float64))
    support = _support(source.geometry, scp)
    grid, notes = _grid(source, frame, layout, coverage, vertices, scp_pixel, support)

    root = etree.Element(f"{{{NAMESPACE}}}SICD", nsmap={None: NAMESPACE})
    sicd: Any = sksicd.ElementWrapper(root)
    start, known = _collect_start(source)
    if not known:
        notes.append("the phase history names no date, so CollectStart says 1970-01-01")
    sicd["CollectionInfo"] = _collection_info(source)
    sicd["ImageCreation"] = {"Application": f"blocksar {__version__}", "DateTime": datetime.now(UTC)}
    rows, columns = layout.shape
    sicd["ImageData"] = {
        "PixelType": "RE32F_IM32F", "NumRows": rows, "NumCols": columns, "FirstRow": 0, "FirstCol": 0,
        "FullImage": {"NumRows": rows, "NumCols": columns}, "SCPPixel": scp_pixel, "ValidData": vertices,
    }  # fmt: skip
    corners = np.array([[0, 0], [0, columns - 1], [rows - 1, columns - 1], [rows - 1, 0]], np.float64)
    sicd["GeoData"] = {
        "EarthModel": "WGS_84",
        "SCP": {"ECF": frame.to_ecef(scp), "LLH": frame.to_geodetic(scp)},
        "ImageCorners": frame.to_geodetic(layout.point(*corners.T))[:, :2],
        "ValidData": frame.to_geodetic(layout.point(*vertices.T.astype(np.float64)))[:, :2],
    }
    sicd["Grid"] = grid
    sicd["Timeline"] = _timeline(source.geometry, start)
    track, misfit = arp_polynomial(source.geometry, frame)
    notes.append(f"ARPPoly is of order {len(track) - 1} and at most {misfit:.2g} m off the track")
    sicd["Position"] = {"ARPPoly": track}
    _radar(sicd, source)
    root.append(etree.Element(f"{{{NAMESPACE}}}SCPCOA"))
    root.replace(root[-1], sksicd.compute_scp_coa(root.getroottree()))
    return Made(root.getroottree(), layout, notes)


# ---------------------------------------------------------------- pixels


def lay_out(source: FinishedRun) -> Layout:
    """Rows along the axis that points away from the radar most, at the middle of the image."""
    middle = np.array([source.x.mean(), source.y.mean(), source.ground_height])
    sight = middle - source.geometry.track.position(np.array(_centre_time(source.geometry, middle)))
    row = np.array(max(TURNS, key=lambda turn: float(np.dot(turn, sight[:2]))), np.float64)
    column = np.array([-row[1], row[0]])  # about z, a quarter turn
    towards = row + column
    x, y = source.x[0 if towards[0] > 0 else -1], source.y[0 if towards[1] > 0 else -1]
    dx, dy = source.spacing
    along_x = row[0] != 0
    return Layout(
        row=row,
        column=column,
        first=np.array([x, y, source.ground_height]),
        spacing=(dx, dy) if along_x else (dy, dx),
        shape=(source.x.size, source.y.size) if along_x else (source.y.size, source.x.size),
    )


def _spans(coverage: Coverage, layout: Layout) -> tuple[FloatArray, FloatArray]:
    """First and last covered row of every column of the file; first > last where none is."""
    if layout.row_axis == 1:
        first, last, n = coverage.row_first, coverage.row_last, layout.shape[0]
    else:
        first, last, n = coverage.column_first, coverage.column_last, layout.shape[0]
    if layout.row.sum() < 0:
        first, last = n - 1 - last, n - 1 - first
    turn = slice(None, None, int(layout.column.sum()))
    return first[turn].astype(np.float64), last[turn].astype(np.float64)


def valid_data(coverage: Coverage, layout: Layout) -> Any:
    """Vertices (n, 2), row and column, of a polygon around the covered pixels, as SICD orders them.

    A sector seen along the line of sight has one first and one last row in every column, so the polygon is it, to a
    pixel or two; of other shapes it is what lies between. Clockwise with rows to the right and columns up, from the
    first column of the first row on.
    """
    from shapely import Polygon
    from shapely.geometry.polygon import orient

    first, last = _spans(coverage, layout)
    columns = np.flatnonzero(last >= first)
    there = np.concatenate([
        np.stack([first[columns], columns], axis=1), np.stack([last[columns], columns], axis=1)[::-1]
    ])  # fmt: skip
    vertices = _box(there, layout.shape)
    outline = Polygon(there) if columns.size > 1 else Polygon(vertices)
    if not outline.is_valid:  # a part of it is one pixel wide
        hull = outline.convex_hull
        outline = hull if hull.area > 0 else Polygon(vertices)
    for tolerance in (0.0, *2.0 ** np.arange(-1, 12)):
        found = np.rint(outline.simplify(tolerance).exterior.coords[:-1])
        if 3 <= len(found) <= MAX_VERTICES and (made := Polygon(found)).is_valid and made.area > 0:
            vertices = np.array(orient(made, -1.0).exterior.coords[:-1])
            break
    start = np.lexsort((vertices[:, 1], vertices[:, 0]))[0]
    return np.roll(vertices, -start, axis=0).astype(int)


def _box(points: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Corners (4, 2), clockwise, of a box around pixels, at least one pixel wide and within the image."""
    low, high = points.min(axis=0), points.max(axis=0)
    high = np.minimum(np.maximum(high, low + 1), np.array(shape) - 1)
    low = np.minimum(low, high - 1)
    return np.array([low, [low[0], high[1]], high, [high[0], low[1]]])


def _centre(vertices: Any) -> Any:
    """A pixel in the middle of the polygon, and within it."""
    from shapely import Polygon

    outline = Polygon(vertices)
    inside = outline.centroid if outline.contains(outline.centroid) else outline.representative_point()
    return np.rint([inside.x, inside.y]).astype(int)


# ---------------------------------------------------------------- times and frequencies


def _dwell(geometry: Geometry, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """First and last lit slow time of points (..., 3), s."""
    first, last = dwell(geometry, points[..., 0], points[..., 1])
    return first, last


def _centre_time(geometry: Geometry, point: FloatArray) -> float:
    """Centre of aperture of a point (3,), slow time, s; the nearest that there is where it is never lit."""
    first, last = (float(t) for t in _dwell(geometry, point))
    time = geometry.collection.time
    return float(np.clip((first + last) / 2, time[0], time[-1])) if first < last else geometry.epoch


class Support(NamedTuple):
    """K (n, 2) in x and y, cycles/m, of what is known of a target: every frequency and slow time with one weight."""

    frequencies: FloatArray
    dwell: float


def _support(geometry: Geometry, scp: FloatArray) -> Support:
    first, last = (float(t) for t in _dwell(geometry, scp))
    collection = geometry.collection
    if not first < last:
        first, last = float(collection.time[0]), float(collection.time[-1])
    time = np.linspace(first, last, 129)
    sight = _sight(geometry, scp, time)
    half = collection.range_frequency[-1] + (collection.range_frequency[1] - collection.range_frequency[0]) / 2
    frequency = collection.carrier + np.linspace(-half, half, 65)
    return Support(2 / SPEED_OF_LIGHT * np.multiply.outer(frequency, sight[:, :2]).reshape(-1, 2), last - first)


def _sight(geometry: Geometry, points: FloatArray, time: FloatArray) -> FloatArray:
    """Unit vectors (..., 3) from the antenna to points at slow times."""
    sight = points - geometry.track.position(time)
    return np.asarray(sight / np.linalg.norm(sight, axis=-1, keepdims=True))


def cut_width(frequency: FloatArray) -> float:
    """-3 dB width, m, of |mean exp(2j pi K d)| over the offset d, of frequencies K (n,), cycles/m."""
    frequency = frequency - frequency.mean()
    half = 0.5 / np.ptp(frequency)

    def power_at(offset: float) -> float:
        return float(np.abs(np.exp(2j * np.pi * frequency * offset).mean()) ** 2)

    low, high = 0.0, half
    while power_at(high) > 0.5:
        low, high = high, 1.5 * high
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if power_at(middle) > 0.5 else (low, middle)
    return 2 * low


def fit_poly2d(u: FloatArray, v: FloatArray, values: FloatArray, accuracy: float) -> Poly2D:
    """Least-squares polynomial of u and v, both (n,), of the lowest total order that meets `accuracy`."""
    scale_u, scale_v = max(float(np.abs(u).max()), 1e-9), max(float(np.abs(v).max()), 1e-9)
    for order in range(MAX_ORDER + 1):
        powers = [(i, j) for i in range(order + 1) for j in range(order + 1 - i)]
        basis = np.stack([(u / scale_u) ** i * (v / scale_v) ** j for i, j in powers], axis=1)
        found = np.linalg.lstsq(basis, values)[0]
        error = float(np.abs(basis @ found - values).max())
        if error <= accuracy or len(powers) * 2 > u.size:
            break
    coefficients = np.zeros((order + 1, order + 1))
    for (i, j), value in zip(powers, found, strict=True):
        coefficients[i, j] = value / scale_u**i / scale_v**j
    return Poly2D(coefficients, error)


def _sampled(coverage: Coverage, layout: Layout) -> FloatArray:
    """Covered pixels (n, 2), row and column, all over the image, where polynomials are fitted."""
    first, last = _spans(coverage, layout)
    columns = np.flatnonzero(last >= first)
    columns = columns[np.unique(np.linspace(0, columns.size - 1, FIT_POINTS).astype(int))]
    share = np.linspace(0, 1, FIT_POINTS)
    rows = first[columns] + np.multiply.outer(share, last[columns] - first[columns])
    return np.stack([rows.ravel(), np.broadcast_to(columns, rows.shape).ravel()], axis=1)


def _grid(
    source: FinishedRun,
    frame: Georeference,
    layout: Layout,
    coverage: Coverage,
    vertices: Any,
    scp_pixel: Any,
    support: Support,
) -> tuple[dict[str, Any], list[str]]:
    """The Grid branch, and how well its polynomials fit."""
    geometry, zero = source.geometry, source.collection.time[0]
    pixels = _sampled(coverage, layout)
    points = layout.point(*pixels.T)
    first, last = _dwell(geometry, points)
    lit = first < last
    if not lit.any():
        raise InputError(f"{source.image} lies where the beam of its collection never was; check collection.zarr")
    offset = (pixels[lit] - scp_pixel) * layout.spacing
    wanted = (first[lit] + last[lit]) / 2 - zero
    coa = fit_poly2d(offset[:, 0], offset[:, 1], wanted, TIME_ACCURACY * support.dwell)
    time = np.asarray(power.polyval2d(offset[:, 0], offset[:, 1], coa.coefficients))
    sight = _sight(geometry, points[lit], time + zero)
    notes = [f"rows run along {_axis_name(layout.row)}, columns along {_axis_name(layout.column)}"]
    notes.append(
        f"TimeCOAPoly is of order {len(coa.coefficients) - 1} and at most {coa.error:.2g} s, "
        f"{100 * coa.error / support.dwell:.2g} % of the dwell, off the middle of what lights a pixel"
    )
    branches: dict[str, Any] = {}
    for name, direction, spacing in zip(("Row", "Col"), (layout.row, layout.column), layout.spacing, strict=True):
        band = support.frequencies @ direction
        width = float(np.ptp(band))
        if width * spacing > 1:
            raise InputError(
                f"the image's spacing is {spacing:.4g} m in {_axis_name(direction)[-1]}, too coarse for the band of "
                f"its targets, and a SICD cannot say so; focus again on a --grid of at most {1 / width:.4g} m"
            )
        k = 2 * geometry.collection.carrier / SPEED_OF_LIGHT * (sight[:, :2] @ direction)
        centre = round(float(band.mean()) * spacing) / spacing
        delta = fit_poly2d(offset[:, 0], offset[:, 1], k - centre, BAND_ACCURACY * width)
        notes.append(
            f"{name}.DeltaKCOAPoly is of order {len(delta.coefficients) - 1} and at most "
            f"{100 * delta.error / width:.2g} % of the bandwidth off"
        )
        low, high = _extent(delta.coefficients, (vertices - scp_pixel) * layout.spacing, width, spacing)
        branches[name] = {
            "UVectECF": np.array([*direction, 0.0]) @ frame.axes,
            "SS": spacing,
            "ImpRespWid": cut_width(band),
            "Sgn": -1,
            "ImpRespBW": width,
            "KCtr": centre,
            "DeltaK1": low,
            "DeltaK2": high,
            "DeltaKCOAPoly": delta.coefficients,
        }
    return {"ImagePlane": "GROUND", "Type": "PLANE", "TimeCOAPoly": coa.coefficients, **branches}, notes


def _extent(delta: FloatArray, corners: FloatArray, width: float, spacing: float) -> tuple[float, float]:
    """DeltaK1 and DeltaK2, as the standard takes them: at the vertices of what is valid; the whole band if it wraps."""
    there = np.asarray(power.polyval2d(corners[:, 0], corners[:, 1], delta))
    low, high = float(there.min()) - width / 2, float(there.max()) + width / 2
    if low < -0.5 / spacing or high > 0.5 / spacing:
        return -0.5 / spacing, 0.5 / spacing
    return low, high


def _axis_name(direction: FloatArray) -> str:
    return ("+" if direction.sum() > 0 else "-") + ("x" if direction[0] else "y")


# ---------------------------------------------------------------- collection


def arp_polynomial(geometry: Geometry, frame: Georeference) -> tuple[FloatArray, float]:
    """The track in ECEF, (order + 1, 3) by powers of s since the first pulse, and the most it is off the antenna, m."""
    track, time = geometry.track, geometry.collection.time
    domain = [track.centre - track.half - time[0], track.centre + track.half - time[0]]
    scene = np.zeros_like(track.coefficients)
    for axis, column in enumerate(track.coefficients.T):
        found = Chebyshev(column, domain=domain).convert(kind=Polynomial, domain=[-1, 1], window=[-1, 1])
        scene[: found.coef.size, axis] = found.coef
    made = scene @ frame.axes
    made[0] += frame.origin
    there = power.polyval(time - time[0], made).T
    misfit = np.linalg.norm(there - frame.to_ecef(geometry.collection.antenna_position), axis=1)
    return made, float(misfit.max())


def _collect_start(source: FinishedRun) -> tuple[datetime, bool]:
    """UTC of the first pulse, and whether it is known.

    The attribute `source` of ingested data tells it: `collection_start`, UTC in ISO 8601, and `time_zero`, s from there
    to slow time 0.
    """
    match source.attrs.get("source"):
        case {"collection_start": str(text), "time_zero": int() | float() as zero}:
            try:
                start = datetime.fromisoformat(text)
                start = start if start.tzinfo else start.replace(tzinfo=UTC)
                return start.astimezone(UTC) + timedelta(seconds=zero + float(source.collection.time[0])), True
            except (ValueError, OverflowError):
                pass  # it was somebody else's word, and the image does not hang on it
    return EPOCH, False


def _collection_info(source: FinishedRun) -> dict[str, Any]:
    collection = source.collection
    return {
        "CollectorName": _ascii(str(source.attrs.get("collector") or "unknown"), 80),
        "CoreName": _ascii(f"{source.title} {source.record.identity[:8]}".strip(), 80),
        "CollectType": "MONOSTATIC",
        "RadarMode": {"ModeType": "DYNAMIC STRIPMAP" if collection.steered else "SPOTLIGHT"},
        "Classification": _classification(source),
    }


def _classification(source: FinishedRun) -> str:
    return _ascii(str(source.attrs.get("classification") or "UNCLASSIFIED"), 200)


def _mark(source: FinishedRun) -> str:
    """The letter that NITF headers have for the classification."""
    text = _classification(source)
    for word, letter in MARKS.items():
        if text.upper().startswith(word):
            return letter
    raise InputError(
        f"the classification of {source.image} is {text!r}, and NITF knows those that begin with "
        f"{', '.join(MARKS)}; correct the phase history's attribute classification, and focus it again"
    )


def _polarization(source: FinishedRun) -> tuple[str, str]:
    """Of the transmitter, and of both, as SICD names them."""
    match source.attrs.get("polarization"):
        case {"transmit": str(transmit), "receive": str(receive)} if {transmit, receive} <= set(POLARIZATIONS):
            return transmit, f"{transmit}:{receive}"
    return "UNKNOWN", "UNKNOWN"


def _timeline(geometry: Geometry, start: datetime) -> dict[str, Any]:
    collection = geometry.collection
    duration = collection.n_pulse / collection.prf
    pulses = {"TStart": 0.0, "TEnd": duration, "IPPStart": 0, "IPPEnd": collection.n_pulse - 1}
    return {
        "CollectStart": start,
        "CollectDuration": duration,
        "IPP": {"@size": 1, "Set": [{"@index": 1, **pulses, "IPPPoly": np.array([0.0, collection.prf])}]},
    }


def _radar(sicd: Any, source: FinishedRun) -> None:
    collection = source.collection
    transmit, both = _polarization(source)
    half = collection.range_frequency[-1] + (collection.range_frequency[1] - collection.range_frequency[0]) / 2
    low, high = float(collection.carrier - half), float(collection.carrier + half)
    sicd["RadarCollection"] = {
        "TxFrequency": {"Min": low, "Max": high},
        "TxPolarization": transmit,
        "RcvChannels": {"@size": 1, "ChanParameters": [{"@index": 1, "TxRcvPolarization": both}]},
    }
    sicd["ImageFormation"] = {
        "RcvChanProc": {"NumChanProc": 1, "ChanIndex": [1]},
        "TxRcvPolarizationProc": both,
        "TStartProc": 0.0,
        "TEndProc": collection.n_pulse / collection.prf,
        "TxFrequencyProc": {"MinProc": low, "MaxProc": high},
        "ImageFormAlgo": "OTHER",
        "STBeamComp": "NO",
        "ImageBeamComp": "NO",
        "AzAutofocus": "NO",
        "RgAutofocus": "NO",
    }


def _ascii(text: str, length: int) -> str:
    """What NITF headers may hold."""
    return "".join(c if " " <= c <= "~" else "?" for c in text)[:length]
