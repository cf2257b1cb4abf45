"""Metadata shared by SICD, SIDD and STAC: facts of the collection, placement of a file in the scene, valid pixels."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any, NamedTuple, Protocol

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.sampling import refuse_departures
from blocksar.collection.weighting import UNIFORM, Weighting
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.runs.finished import Coverage, FinishedRun
from blocksar.stores import POLARIZATIONS

# ---------------------------------------------------------------- facts of the collection

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
STILL = 0.1  # of its width, by which the beam of a strip map may turn
# The letter in NITF headers by the first words of a classification.
MARKS = {"TOP SECRET": "T", "SECRET": "S", "CONFIDENTIAL": "C", "RESTRICTED": "R", "UNCLASSIFIED": "U"}


def collect_start(source: FinishedRun) -> tuple[datetime, bool]:
    """UTC of the first pulse, and whether it is known; EPOCH if not."""
    start = date_of(source.attrs.get("source"), float(source.collection.time[0]))
    return (EPOCH, False) if start is None else (start, True)


def date_of(told: Any, time: float) -> datetime | None:
    """Convert a slow time, s, to UTC; None if the collection's time is unknown.

    The attribute `source` of ingested data holds `collection_start`, UTC in ISO 8601, and `time_zero`, s from there to
    slow time 0.
    """
    match told:
        case {"collection_start": str(text), "time_zero": int() | float() as zero}:
            try:
                start = datetime.fromisoformat(text)
                start = start if start.tzinfo else start.replace(tzinfo=UTC)
                return start.astimezone(UTC) + timedelta(seconds=zero + time)
            except (ValueError, OverflowError):
                pass  # the date is optional, so a damaged one does not stop the export
    return None


def radar_mode(collection: Collection, *, one_aperture: bool) -> str:
    """Radar mode: spotlight if all pixels have one centre of aperture, dynamic if the beam is steered otherwise."""
    if one_aperture:
        return "SPOTLIGHT"
    angle = collection.beam_azimuth if collection.beam_steering is None else collection.beam_steering
    return "STRIPMAP" if np.ptp(angle) < STILL * (collection.beam_width or 0.0) else "DYNAMIC STRIPMAP"


def classification(source: FinishedRun) -> str:
    """Classification of the collection as ASCII text; UNCLASSIFIED if it states none."""
    return ascii_text(str(source.attrs.get("classification") or "UNCLASSIFIED"), 200)


def polarization(source: FinishedRun) -> tuple[str, str]:
    """Polarization of the transmitter, and of transmitter and receiver, as SICD names them.

    That of the attribute; else that which a channel's name states, such as HV.
    """
    match source.attrs.get("polarization"):
        case {"transmit": str(transmit), "receive": str(receive)} if {transmit, receive} <= set(POLARIZATIONS):
            return transmit, f"{transmit}:{receive}"
    match tuple(str(source.attrs.get("channel") or "").upper()):
        case ("H" | "V" as transmit, "H" | "V" as receive):
            return transmit, f"{transmit}:{receive}"
    return "UNKNOWN", "UNKNOWN"


def security_mark(source: FinishedRun) -> str:
    """Letter of the classification in NITF headers.

    Raises
    ------
    InputError
        If NITF has none.
    """
    text = classification(source)
    for word, letter in MARKS.items():
        if text.upper().startswith(word):
            return letter
    raise InputError(
        f"the classification of {source.image} is {text!r}, and NITF knows only those that begin with "
        f"{', '.join(MARKS)}; correct the phase history's attribute classification, and focus it again"
    )


def ascii_text(text: str, length: int) -> str:
    """Restrict text to what NITF headers may hold: printable ASCII, at most `length` characters."""
    return "".join(c if " " <= c <= "~" else "?" for c in text)[:length]


def about_segments(source: FinishedRun, product: str, what: str) -> list[str]:
    """State that the metadata describe one of several segments, and which share of the image they do not."""
    if not source.segments:
        return []
    counts = np.zeros(len(source.segments), np.int64)
    for rows in source.strips(0):
        blocks, number = np.unique(source.read_block(rows, slice(None)), return_counts=True)
        for block, pixels in zip(blocks.tolist(), number, strict=True):
            if block >= 0:
                counts[source.segment_of(block)] += pixels
    own = source.segments.index(source.geometry)
    if counts[own] == (total := counts.sum()):
        return []
    of, share = source.record.segments[own], 100 * (1 - counts[own] / total)
    pulses = "" if of.pulses is None else f", pulses {of.pulses[0]} .. {of.pulses[1] - 1}"
    return [
        f"note: {what} are those of {of.path}{pulses}, and not those of "
        f"{share:.3g} % of the covered pixels, which come from others; {product} has one track"
    ]


# ---------------------------------------------------------------- layout of a file


def lit_times(geometry: Geometry, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """First and last lit slow time, s, of points (..., 3)."""
    first, last = geometry.beam.dwell(points[..., 0], points[..., 1])
    return first, last


def centre_time(geometry: Geometry, point: FloatArray) -> float:
    """Slow time, s, of a point's (3,) centre of aperture, clipped to the collection; the epoch if it is never lit."""
    first, last = (float(t) for t in lit_times(geometry, point))
    time = geometry.collection.time
    return float(np.clip((first + last) / 2, time[0], time[-1])) if first < last else geometry.epoch


def lines_of_sight(geometry: Geometry, points: FloatArray, time: FloatArray) -> FloatArray:
    """Unit vectors (..., 3) from the antenna at slow times (...) to points (..., 3)."""
    sight = points - geometry.track.position(time)
    return np.asarray(sight / np.linalg.norm(sight, axis=-1, keepdims=True))


class Support(NamedTuple):
    """Spatial frequencies of a target that the aperture measures, with weights.

    Attributes
    ----------
    frequencies : (n, 2) float
        K in x and y, cycles/m, at samples of range frequency and slow time.
    weights : (n,) float
        Those with which the image sums them: the weighting, and the antenna's pattern, which is in the samples.
    dwell : float
        Lit time of the target, s.
    """

    frequencies: FloatArray
    weights: FloatArray
    dwell: float


def refuse_bistatic(source: FinishedRun, product: str) -> None:
    """Refuse an image of two antennas, which a product has no fields for as they are written here.

    Raises
    ------
    InputError
        If the collection is bistatic.
    """
    refuse_departures(product, source.collection.two_antennas, "export geotiff or png")


def find_support(geometry: Geometry, scp: FloatArray, weighting: Weighting = UNIFORM) -> Support:
    """Find the support of a target at the scene centre point (3,); the whole collection's if it is never lit."""
    first, last = (float(t) for t in lit_times(geometry, scp))
    collection = geometry.collection
    if not first < last:
        first, last = float(collection.time[0]), float(collection.time[-1])
    time = np.linspace(first, last, 129)
    sight = lines_of_sight(geometry, scp, time)
    half = collection.range_frequency[-1] + (collection.range_frequency[1] - collection.range_frequency[0]) / 2
    frequency = collection.carrier + np.linspace(-half, half, 65)
    over_dwell = np.broadcast_to(geometry.beam.dwell_weight(scp[0], scp[1], time, weighting.azimuth), time.shape)
    if not over_dwell.any():  # at a zero of the antenna's pattern
        over_dwell = np.ones(time.shape)
    weights = np.multiply.outer(weighting.range(np.linspace(-1, 1, 65)), over_dwell)
    return Support(
        2 / SPEED_OF_LIGHT * np.multiply.outer(frequency, sight[:, :2]).reshape(-1, 2), weights.ravel(), last - first
    )


def cut_width(frequency: FloatArray, weights: FloatArray) -> float:
    """-3 dB width, m, of |mean exp(2j pi K d)| over the offset d, for frequencies K (n,), cycles/m, with weights."""
    frequency = frequency - frequency.mean()
    share = weights / weights.sum()
    half = 0.5 / np.ptp(frequency)

    def power_at(offset: float) -> float:
        return float(np.abs((share * np.exp(2j * np.pi * frequency * offset)).sum()) ** 2)

    low, high = 0.0, half
    while power_at(high) > 0.5:
        low, high = high, 1.5 * high
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if power_at(middle) > 0.5 else (low, middle)
    return 2 * low


def cut_weights(frequency: FloatArray, weights: FloatArray, count: int) -> FloatArray:
    """Weighting of a cut, (count,), at most 1: weights of frequencies (n,) summed over equal parts of the band.

    Each frequency is spread over the width of a part, so that the samples do not show as ripple.
    """
    low, high = float(frequency.min()), float(frequency.max())
    edges = np.linspace(low, high, count + 1)
    part = (high - low) / count
    order = np.argsort(frequency)
    along, running = frequency[order], np.cumsum(weights[order])
    # The running sum, smoothed over a part by its integral, has the weights as differences.
    integral = np.concatenate([[0.0], np.cumsum(running[:-1] * np.diff(along))])

    def below(at: FloatArray) -> FloatArray:
        inside = np.interp(at, along, integral)
        return np.asarray(inside + np.maximum(at - high, 0.0) * running[-1])

    smooth = (below(edges + part / 2) - below(edges - part / 2)) / part
    summed = np.diff(smooth)
    return np.asarray(np.clip(summed / summed.max(), 0.0, 1.0))


MAX_VERTICES = 100  # of ValidData
FIT_POINTS = 41  # a side, where polynomials over the image are fitted
DIRECTIONS = ((1, 0), (0, 1), (-1, 0), (0, -1))  # in x and y, that rows of the file may run in


class Layout(NamedTuple):
    """Placement of the file's rows and columns in the scene.

    Attributes
    ----------
    row, column : (2,) float
        Unit vectors in x and y along which the row and the column index grow.
    first : (3,) float
        Scene point of row 0, column 0, m.
    spacing : tuple of float
        Distance between rows and between columns, m.
    shape : tuple of int
        Number of rows and of columns.
    """

    row: FloatArray
    column: FloatArray
    first: FloatArray
    spacing: tuple[float, float]
    shape: tuple[int, int]

    @property
    def row_axis(self) -> int:
        """Axis of the image's array along which the file's row index grows: 0 is y, 1 is x."""
        return 1 if self.row[0] else 0

    def point(self, row: FloatArray, column: FloatArray) -> FloatArray:
        """Scene points (..., 3), m, of fractional rows and columns (...)."""
        offset = np.multiply.outer(row * self.spacing[0], self.row) + np.multiply.outer(
            column * self.spacing[1], self.column
        )
        return self.first + np.concatenate([offset, np.zeros((*offset.shape[:-1], 1))], axis=-1)

    def reorder(self, values: ComplexArray) -> ComplexArray:
        """Reorder a part (y, x) of the image to the order of the file."""
        values = values.T if self.row_axis == 1 else values
        return values[:: int(self.row.sum()), :: int(self.column.sum())]


class Axes(Protocol):
    """Interface of image axes, m."""

    @property
    def x(self) -> FloatArray: ...
    @property
    def y(self) -> FloatArray: ...
    @property
    def spacing(self) -> tuple[float, float]: ...


def lay_out(source: FinishedRun, pixels: Axes | None = None) -> Layout:
    """Lay rows along the axis that points most directly away from the radar at the middle of the image.

    The pixels are those of the image, or cells of them.
    """
    grid = source if pixels is None else pixels
    middle = np.array([source.x.mean(), source.y.mean(), source.ground_height])
    sight = middle - source.geometry.track.position(np.array(centre_time(source.geometry, middle)))
    row = np.array(max(DIRECTIONS, key=lambda direction: float(np.dot(direction, sight[:2]))), np.float64)
    column = np.array([-row[1], row[0]])  # about z, a quarter turn
    towards = row + column
    x, y = grid.x[0 if towards[0] > 0 else -1], grid.y[0 if towards[1] > 0 else -1]
    dx, dy = grid.spacing
    along_x = row[0] != 0
    return Layout(
        row=row,
        column=column,
        first=np.array([x, y, source.ground_height]),
        spacing=(dx, dy) if along_x else (dy, dx),
        shape=(grid.x.size, grid.y.size) if along_x else (grid.y.size, grid.x.size),
    )


def valid_data(coverage: Coverage, layout: Layout) -> Any:
    """Vertices (n, 2), row and column, of a polygon around the covered pixels, as SICD orders them.

    The polygon joins the first and last covered row of every column. A sector seen along the line of sight has one run
    of covered rows in every column, so the polygon matches it to a pixel or two; for other shapes it also holds the
    gaps between runs. Clockwise with rows to the right and columns up, starting at the first column of the first row.
    """
    from shapely import Polygon
    from shapely.geometry.polygon import orient

    first, last = _spans(coverage, layout)
    columns = np.flatnonzero(last >= first)
    border = np.concatenate([
        np.stack([first[columns], columns], axis=1), np.stack([last[columns], columns], axis=1)[::-1]
    ])  # fmt: skip
    vertices = _box(border, layout.shape)
    outline = Polygon(border) if columns.size > 1 else Polygon(vertices)
    if not outline.is_valid:  # parts that are one pixel wide make it touch itself
        hull = outline.convex_hull
        outline = hull if hull.area > 0 else Polygon(vertices)
    for tolerance in (0.0, *2.0 ** np.arange(-1, 12)):
        rounded = np.rint(outline.simplify(tolerance).exterior.coords[:-1])
        if 3 <= len(rounded) <= MAX_VERTICES and (polygon := Polygon(rounded)).is_valid and polygon.area > 0:
            vertices = np.array(orient(polygon, -1.0).exterior.coords[:-1])
            break
    start = np.lexsort((vertices[:, 1], vertices[:, 0]))[0]
    return np.roll(vertices, -start, axis=0).astype(int)


def _box(points: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Corners (4, 2), clockwise, of the bounding box of pixels (n, 2), at least one pixel wide, within the image."""
    low, high = points.min(axis=0), points.max(axis=0)
    high = np.minimum(np.maximum(high, low + 1), np.array(shape) - 1)
    low = np.minimum(low, high - 1)
    return np.array([low, [low[0], high[1]], high, [high[0], low[1]]])


def central_pixel(vertices: Any) -> Any:
    """Row and column of a pixel inside the polygon: its centroid, if that lies inside."""
    from shapely import Polygon

    outline = Polygon(vertices)
    inside = outline.centroid if outline.contains(outline.centroid) else outline.representative_point()
    return np.rint([inside.x, inside.y]).astype(int)


def sample_pixels(coverage: Coverage, layout: Layout) -> FloatArray:
    """Rows and columns of covered pixels (n, 2) spread over the image, for fitting polynomials."""
    first, last = _spans(coverage, layout)
    columns = np.flatnonzero(last >= first)
    columns = columns[np.unique(np.linspace(0, columns.size - 1, FIT_POINTS).astype(int))]
    share = np.linspace(0, 1, FIT_POINTS)
    rows = first[columns] + np.multiply.outer(share, last[columns] - first[columns])
    return np.stack([rows.ravel(), np.broadcast_to(columns, rows.shape).ravel()], axis=1)


def _spans(coverage: Coverage, layout: Layout) -> tuple[FloatArray, FloatArray]:
    """First and last covered row of every column of the file; first > last where no row is covered."""
    if layout.row_axis == 1:
        first, last, n = coverage.row_first, coverage.row_last, layout.shape[0]
    else:
        first, last, n = coverage.column_first, coverage.column_last, layout.shape[0]
    if layout.row.sum() < 0:
        first, last = n - 1 - last, n - 1 - first
    order = slice(None, None, int(layout.column.sum()))
    return first[order].astype(np.float64), last[order].astype(np.float64)
