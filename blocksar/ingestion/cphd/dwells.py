"""The polynomials of centre of dwell and dwell time over the image area."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.polynomial import polynomial

from blocksar.arrays import FloatArray
from blocksar.collection.georeference import Georeference
from blocksar.errors import InputError
from blocksar.ingestion.cphd.areas import ImageArea, area_points, ecef_of
from blocksar.ingestion.cphd.files import CphdFile, child_of, polynomial_of, text_of


class Dwells(NamedTuple):
    """Points (n, 3) all over the image area, scene frame, m, with their centre of dwell and dwell time (n,), s."""

    ground: FloatArray
    centre: FloatArray
    length: FloatArray


def read_dwells(file: CphdFile, frame: Georeference, area: ImageArea, turn: FloatArray) -> Dwells:
    """Evaluate the channel's polynomials, in image-area coordinates turned by (2, 2) `turn`.

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
    x, y = area_points(file, area)
    along, across = turn @ np.stack([x, y])
    cod, dwell = (polynomial.polyval2d(along, across, table) for table in tables)
    if not (np.isfinite(cod).all() and np.isfinite(dwell).all() and dwell.min() > 0):
        raise InputError("they are not finite and above 0 over the image area")
    return Dwells(frame.from_ecef(ecef_of(file, np.stack([x, y], axis=1))), np.asarray(cod), np.asarray(dwell))
