"""The polynomials of centre of dwell and dwell time over the image area."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import polynomial

from blocksar.arrays import FloatArray
from blocksar.collection.georeference import Georeference
from blocksar.errors import InputError
from blocksar.ingestion.cphd.files import CphdFile, child_of, library, numbers_of, polynomial_of, text_of

ACROSS = 33  # points along either side of the image area


class Dwells(NamedTuple):
    """Points (n, 3) all over the image area, scene frame, m, with their centre of dwell and dwell time (n,), s."""

    ground: FloatArray
    centre: FloatArray
    length: FloatArray


def read_dwells(file: CphdFile, frame: Georeference) -> Dwells:
    """Evaluate the channel's polynomials.

    Raises
    ------
    InputError
        If the channel has an array instead, or the polynomials are missing, or not finite and above 0.
    """
    root = file.root
    parameters = child_of(root, f"{{*}}Channel/{{*}}Parameters[{{*}}Identifier='{file.channel}']", "Channel/Parameters")
    if (parameters.findtext("{*}DwellTimes/{*}UseDTA") or "").strip() in ("true", "1"):
        raise InputError("the channel's dwell times are an array, not polynomials")
    tables = []
    for kind in ("COD", "Dwell"):
        name = text_of(parameters, f"DwellTimes/{kind}Id")
        if "'" in name:
            raise InputError(f"DwellTimes/{kind}Id is {name!r}")
        node = child_of(root, f"{{*}}Dwell/{{*}}{kind}Time[{{*}}Identifier='{name}']", f"Dwell/{kind}Time")
        tables.append(polynomial_of(child_of(node, f"{{*}}{kind}TimePoly", f"{kind}TimePoly"), 2))
    x, y = area_points(file)
    cod, dwell = (polynomial.polyval2d(x, y, table) for table in tables)
    if not (np.isfinite(cod).all() and np.isfinite(dwell).all() and dwell.min() > 0):
        raise InputError("they are not finite and above 0 over the image area")
    return Dwells(ground_of(file, frame, x, y), np.asarray(cod), np.asarray(dwell))


def ground_of(file: CphdFile, frame: Georeference, x: FloatArray, y: FloatArray) -> FloatArray:
    """Points at image-area coordinates x, y (n,), m: (n, 3) in the scene frame, m."""
    return frame.from_ecef(np.asarray(library().iac_to_ecf(file.tree, np.stack([x, y], axis=1))))


def area_points(file: CphdFile) -> tuple[FloatArray, FloatArray]:
    """x and y of points all over the channel's image area, or else the scene's, m."""
    own = file.root.find(f"{{*}}Channel/{{*}}Parameters[{{*}}Identifier='{file.channel}']/{{*}}ImageArea")
    node: Any = own if own is not None else child_of(file.root, "{*}SceneCoordinates/{*}ImageArea", "ImageArea")
    (x1, y1), (x2, y2) = (numbers_of(node, corner, "XY") for corner in ("X1Y1", "X2Y2"))
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(x1, x2, ACROSS), np.linspace(y1, y2, ACROSS)))
    outline = node.find("{*}Polygon")
    if outline is None:
        return x, y
    corners = sorted(outline.findall("{*}Vertex"), key=lambda vertex: int(vertex.get("index")))
    if not 3 <= len(corners) <= 10_000:
        raise InputError(f"the image area's polygon has {len(corners)} corners")
    polygon = np.array([[float(corner.findtext(f"{{*}}{axis}")) for axis in "XY"] for corner in corners])
    inside = np.zeros(x.size, bool)
    for (ax, ay), (bx, by) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if ay != by:
            inside ^= ((ay > y) != (by > y)) & (x < (bx - ax) * (y - ay) / (by - ay) + ax)
    return np.concatenate([x[inside], polygon[:, 0]]), np.concatenate([y[inside], polygon[:, 1]])
