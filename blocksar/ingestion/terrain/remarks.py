"""Remarks on a file of heights: zeros that may stand for no data, and feet without their unit."""

from __future__ import annotations

import shlex

import numpy as np

from blocksar.arrays import BoolArray, FloatArray
from blocksar.places.place import Place

FAR = 50.0  # m: heights that differ by less from the scene's plane, or from zeros beside them, are not doubted
LIKELY = 0.1  # of the distance from the plane, within which heights are if they are taken for feet
FOOT = 0.3048  # m
FEET = {
    **dict.fromkeys(("ft", "foot", "feet", "international foot"), FOOT),
    **dict.fromkeys(("us-ft", "ftus", "us survey foot", "us survey feet"), 1200 / 3937),
}  # m, by a unit's name


def remarks_on(heights: FloatArray, plane: float, path: Place, *, feet: bool) -> tuple[str, ...]:
    """Sentences about heights (n_row, n_column), m, NaN where unknown, that are taken as they are.

    Parameters
    ----------
    plane : float
        Height of the scene's plane over the file's datum, m.
    feet : bool
        Whether the file says that they are feet.
    """
    known = np.isfinite(heights)
    zero = heights == 0
    if not known.any():
        return ()
    if (zero | ~known).all():
        if abs(plane) <= FAR:
            return ()
        return (
            f"{path} is exactly 0 m all over the grid, {abs(plane):.0f} m {_side(-plane)} the scene's plane: if "
            "0 stands for no data, give a file that has the heights, or leave --terrain out",
        )
    if (beside := _beside(heights, zero)) > FAR:
        return (
            f"{path} is exactly 0 m at {100 * zero.sum() / known.sum():.2g} % of its heights about the grid, beside "
            f"heights of {beside:.0f} m: if 0 stands for no data, tag it (`rio edit-info --nodata 0 "
            f"{shlex.quote(str(path))}`)",
        )
    middle = float(np.median(heights[known]))
    off, as_feet = middle - plane, middle * FOOT - plane
    if not feet and abs(off) > FAR and abs(as_feet) < LIKELY * abs(off):
        return (
            f"{path} lies {abs(off):.0f} m {_side(off)} the scene's plane, but {abs(as_feet):.0f} m "
            f"{_side(as_feet)} it if its heights are feet: if they are, tag them (`rio edit-info "
            f"--bidx 1 --units ft {shlex.quote(str(path))}`)",
        )
    return ()


def _side(height: float) -> str:
    return "above" if height > 0 else "below"


def _beside(heights: FloatArray, zero: BoolArray) -> float:
    """The largest |height| next to one that is zero, m."""
    most = 0.0
    for first, second in ((np.s_[1:, :], np.s_[:-1, :]), (np.s_[:, 1:], np.s_[:, :-1])):
        edge = zero[first] != zero[second]
        if edge.any():
            most = max(most, float(np.nanmax(np.abs(heights[first][edge] + heights[second][edge]), initial=0.0)))
    return most
