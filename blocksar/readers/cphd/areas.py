"""The image area of a CPHD file, which locates the scene.

ImageArea gives it in image-area coordinates, m along uIAX and uIAY from the scene's reference point (IARP), and
ImageAreaCornerPoints in latitude and longitude. Some files have numbers of samples in ImageArea, its axes swapped, or
axes that are left-handed against the corner points. So both are compared. Where they disagree, the one is taken whose
ranges are those of the saved delays TOA1 .. TOA2, and the corner points if that is said of both or of neither.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.readers.cphd.files import CphdFile, child_of, library, numbers_of
from blocksar.texts import count

ACROSS = 33  # points along either side of the image area
AS_IT_IS, SWAPPED = np.eye(2), np.eye(2)[::-1]  # turns of image-area coordinates
TURNS = [
    turn * signs
    for turn in (AS_IT_IS, SWAPPED)
    for signs in ([[1.0], [1.0]], [[-1.0], [1.0]], [[1.0], [-1.0]], [[-1.0], [-1.0]])
]
AGREE = 0.1  # of the area's diagonal, by which corners may lie apart
BEYOND = 0.25  # of the saved delays, by which a scene's ranges may exceed them


class ImageArea(NamedTuple):
    """The scene's rectangle, m in image-area coordinates, and the fault that was corrected in it.

    Attributes
    ----------
    low, high : (2,) float
        x and y.
    message : str or None
        What was wrong, in words; None if nothing.
    turn : (2, 2) float
        From image-area coordinates to those that the file's ImageArea is in: one of `TURNS`.
    """

    low: FloatArray
    high: FloatArray
    message: str | None = None
    turn: FloatArray = AS_IT_IS

    @property
    def corners(self) -> FloatArray:
        """(4, 2) m."""
        return np.array([[x, y] for x in (self.low[0], self.high[0]) for y in (self.low[1], self.high[1])])


def read_area(file: CphdFile) -> ImageArea:
    """Read the scene's rectangle.

    Raises
    ------
    InputError
        If ImageArea is missing or not made of numbers.
    """
    node = child_of(file.root, "{*}SceneCoordinates/{*}ImageArea", "SceneCoordinates/ImageArea")
    edges = np.stack([numbers_of(node, corner, "XY") for corner in ("X1Y1", "X2Y2")])
    given = ImageArea(edges.min(axis=0), edges.max(axis=0))
    corners = _corner_points(file)
    if corners is None:
        return given
    by_corners = ImageArea(corners.min(axis=0), corners.max(axis=0))
    size = float(np.linalg.norm(by_corners.high - by_corners.low))
    apart = _apart(given.corners, corners)
    if apart <= AGREE * size or not size > 0:
        return given
    turn = next((turn for turn in TURNS if _apart(given.corners, corners @ turn.T) <= AGREE * size), None)
    why = f"corners lie up to {apart:.4g} m apart"
    if turn is not None:
        why = f"as if {describe_turn(turn)}"
    given_fits, told_fits = _fits(file, given), _fits(file, by_corners)
    taken, which = (given, "ImageArea is") if given_fits and not told_fits else (by_corners, "the corner points are")
    message = (
        f"ImageArea of {_size(given)} disagrees with its corner points, {_size(by_corners)} ({why}): {which} taken"
        f"{', as the saved delays have it' if given_fits != told_fits else ''}"
    )
    return taken._replace(message=message, turn=AS_IT_IS if turn is None or taken is given else turn)


def area_points(file: CphdFile, area: ImageArea) -> tuple[FloatArray, FloatArray]:
    """x and y of points spread over the channel's image area, or else the scene's, m.

    Of an area that is not as the file has it, the rectangle alone: outlines are in the same coordinates.
    """
    own = None
    if area.message is None:
        own = file.root.find(f"{{*}}Channel/{{*}}Parameters[{{*}}Identifier='{file.channel}']/{{*}}ImageArea")
    scene = child_of(file.root, "{*}SceneCoordinates/{*}ImageArea", "ImageArea")
    node: Any = scene if own is None else own
    low, high = area.low, area.high
    if own is not None:
        low, high = (numbers_of(own, corner, "XY") for corner in ("X1Y1", "X2Y2"))
    x, y = (axis.ravel() for axis in np.meshgrid(*np.linspace(low, high, ACROSS).T))
    outline = node.find("{*}Polygon") if area.message is None else None
    if outline is None:
        return x, y
    corners = sorted(outline.findall("{*}Vertex"), key=lambda vertex: int(vertex.get("index")))
    if not 3 <= len(corners) <= 10_000:
        raise InputError(f"the image area's polygon has {count(len(corners), 'corner')}")
    polygon = np.array([[float(corner.findtext(f"{{*}}{axis}")) for axis in "XY"] for corner in corners])
    inside = np.zeros(x.size, bool)
    for (ax, ay), (bx, by) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if ay != by:
            inside ^= ((ay > y) != (by > y)) & (x < (bx - ax) * (y - ay) / (by - ay) + ax)
    return np.concatenate([x[inside], polygon[:, 0]]), np.concatenate([y[inside], polygon[:, 1]])


def ecef_of(file: CphdFile, points: FloatArray) -> FloatArray:
    """Convert points (n, 2), m in image-area coordinates, to Earth-centred ones, (n, 3) m."""
    return np.asarray(library().iac_to_ecf(file.tree, points))


def area_delays(file: CphdFile, area: ImageArea, vector: int) -> tuple[float, float]:
    """Least and largest delay of the area's corners relative to the SRP at a vector, s."""
    antenna, srp = ((file.parameter(f"{name}Pos")[vector]) for name in ("Tx", "SRP"))
    ranges = np.linalg.norm(ecef_of(file, area.corners) - antenna, axis=1) - np.linalg.norm(srp - antenna)
    return float(ranges.min()) * 2 / SPEED_OF_LIGHT, float(ranges.max()) * 2 / SPEED_OF_LIGHT


def _fits(file: CphdFile, area: ImageArea) -> bool:
    """Tell whether the area's ranges lie within the saved delays at the middle vector."""
    early, late = file.parameter("TOA1"), file.parameter("TOA2")
    known = np.flatnonzero(np.isfinite(early + late + file.parameter("TxPos").sum(axis=1)) & (early < late))
    if not known.size:
        return False
    vector = int(known[known.size // 2])
    first, last = area_delays(file, area, vector)
    slack = BEYOND * float(late[vector] - early[vector])
    return bool(early[vector] - slack <= first and last <= late[vector] + slack)


def _corner_points(file: CphdFile) -> FloatArray | None:
    """Corner points in image-area coordinates, (4, 2) m; None if the file has no usable ones."""
    import sarkit.wgs84

    points = file.root.findall("{*}SceneCoordinates/{*}ImageAreaCornerPoints/{*}IACP")
    try:
        height = float(numbers_of(file.root, "SceneCoordinates/IARP/LLH", ("HAE",))[0])
        places = np.array([[float(p.findtext("{*}Lat")), float(p.findtext("{*}Lon")), height] for p in points])
    except (TypeError, ValueError):
        return None
    if places.shape != (4, 3) or not np.isfinite(places).all():
        return None
    origin, x, y = ecef_of(file, np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    away = np.asarray(sarkit.wgs84.geodetic_to_cartesian(places)) - origin
    return np.stack([away @ (x - origin), away @ (y - origin)], axis=1)


def describe_turn(turn: FloatArray) -> str:
    """Describe the fault of rotated or mirrored coordinates."""
    wrong = ["x and y were swapped"] if turn[0, 0] == 0 else []
    return " and ".join([*wrong, *(["an axis were reversed"] if turn.sum() < 2 else [])])


def _apart(first: FloatArray, second: FloatArray) -> float:
    """Largest distance, m, of corners (4, 2) from the nearest of others, in any order."""
    distance = np.linalg.norm(first[:, None] - second, axis=2)
    return float(max(distance.min(axis=0).max(), distance.min(axis=1).max()))


def _size(area: ImageArea) -> str:
    x, y = area.high - area.low
    return f"{x:.5g} x {y:.5g} m"
