"""Numbers that stand for "no data" in files of heights, where no tag says so."""

from __future__ import annotations

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.errors import InputError
from blocksar.places.place import Place

# What programs write by custom, and what no ground has: -11 km to 9 km on the Earth, and less by its bend.
CUSTOMARY = (-9999.0, 9999.0, -32767.0, -32768.0, 32767.0, 65535.0, -99999.0, 99999.0)
HIGHEST = 1e5  # m


def refuse_untagged(heights: FloatArray, path: Place) -> None:
    """Check that no height is a number that stands for none: interpolation would spread it over its neighbours.

    Raises
    ------
    InputError
        If one is.
    """
    odd = np.isin(heights, CUSTOMARY) | (np.abs(heights) > HIGHEST)
    if odd.any():
        value, count = float(heights[odd][0]), int(odd.sum())
        raise InputError(
            f"{path} has a height of {value:.6g} m ({count} of the kind), which no ground has: tag the number that "
            "stands for no data (_FillValue, or nodata of a GeoTIFF), or write NaN there"
        )
