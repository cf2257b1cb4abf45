"""Likely mistakes behind a grid outside the swath: degrees, beam widths, feet, kilometres, side of the track.

Each candidate changes one thing: a unit, or the side of the track. It is reported if the middle of the grid then lies
in the range window while it is lit, which it does not as given. `collection.frames` has recognised positions in another
frame before.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.errors import InputError

FOOT = 0.3048  # m
WIDE = 0.35  # rad, 20 degrees: a beam that is wider is doubted where its steering looks like degrees
DEGREES = "degrees"
BAND = 4.0  # times the PRF, from which on a band of Doppler is no matter of the PRF alone


def find_meant(collection: Collection, grid: Grid, *, on_terrain: bool) -> str | None:
    """Suggest a remedy for a grid outside the swath if a wrong unit explains it; None otherwise.

    On a terrain units of heights and ranges are not tried: its own heights are as likely to be wrong.
    """
    x, y = (grid.x0 + grid.x1) / 2, (grid.y0 + grid.y1) / 2
    if _holds(collection, 1000 * x, 1000 * y):
        return "it looks like km: give metres"
    side = collection.side_of_track
    if side is not None and _would_hold(collection, {"side_of_track": None}, x, y):
        return (
            f"it lies {'right' if side == 'left' else 'left'} of the flight, but side_of_track is '{side}': correct "
            "one of them, or leave out side_of_track if the antenna lights both sides"
        )
    if units := [unit for unit, changes in _of_steering(collection) if _would_hold(collection, changes, x, y)]:
        wide = collection.beam_width is not None and collection.beam_width > WIDE
        looks = "and beam_width look" if wide and units[0] == DEGREES else "looks"
        return f"beam_steering {looks} like {' or '.join(units)}: give radians"
    candidates = [] if on_terrain else _candidates(collection)
    return next((text for text, changes in candidates if _would_hold(collection, changes, x, y)), None)


def _of_steering(collection: Collection) -> Iterator[tuple[str, dict[str, Any]]]:
    """Units that beam_steering may be in, each with the field converted from it."""
    steering, width = collection.beam_steering, collection.beam_width
    if steering is not None and width is not None:
        yield DEGREES, {"beam_steering": np.radians(steering)}
        yield "beam widths", {"beam_steering": steering * width}


def _candidates(collection: Collection) -> Iterator[tuple[str, dict[str, Any]]]:
    """Possible mistakes of unit, each with the remedy and the converted fields."""
    if collection.steered and not collection.has_axis:
        azimuth = np.radians(collection.beam_azimuth)
        yield "beam_azimuth looks like degrees: give radians", {"beam_azimuth": azimuth}
    position, reference = collection.antenna_position, collection.reference_range
    for unit, metres in (("feet", FOOT), ("km", 1000.0)):
        fields = ("antenna_position",), ("reference_range",), ("antenna_position", "reference_range")
        for names in fields[1:2] if collection.bistatic else fields:
            given = {"antenna_position": position, "reference_range": reference}
            verb = "looks" if len(names) == 1 else "look"
            yield f"{' and '.join(names)} {verb} like {unit}: give metres", {n: metres * given[n] for n in names}
    if collection.ground_height:
        yield "ground_height looks like feet: give metres", {"ground_height": FOOT * collection.ground_height}


def _would_hold(collection: Collection, changes: dict[str, Any], x: float, y: float) -> bool:
    """Tell whether `_holds` is true with some fields changed."""
    with suppress(InputError):  # no collection at all
        return _holds(replace(collection, **changes), x, y)
    return False


def _holds(collection: Collection, x: float, y: float) -> bool:
    """Tell whether a pulse lights a point x, y, m, while its range lies in the range window."""
    point = np.array([x, y, collection.ground_height])
    away = collection.distances(point) - collection.reference_range
    lit = Geometry(collection=collection).beam.is_lit(np.asarray(x), np.asarray(y))
    return bool((lit & (np.abs(away) <= collection.range_window / 2)).any())


def describe_pointing(geometry: Geometry, grid: Grid) -> str:
    """Describe the middle of a grid and a beam about its axis, in degrees off the plane normal to the axis."""
    collection = geometry.collection
    assert collection.beam_steering is not None and collection.beam_width is not None
    x, y = ((np.asarray(low + high) / 2) for low, high in ((grid.x0, grid.x1), (grid.y0, grid.y1)))
    offset = geometry.beam.offset(x, y, slice(None)) + collection.beam_steering
    half = collection.beam_width / 2
    beam = collection.beam_steering.min() - half, collection.beam_steering.max() + half
    return (
        f"its middle lies {_degrees(offset.min(), offset.max())} degrees off the plane normal to beam_axis, and the "
        f"beam (beam_steering, beam_width) lights {_degrees(*beam)}"
    )


def _degrees(*ends: float) -> str:
    return " .. ".join(f"{np.degrees(end):.4g}" for end in ends)


def doubt_width(width: float | None, prf: float, band: float) -> str | None:
    """Suggest that a beam's width (rad) is in degrees if a Doppler band (Hz) exceeds the PRF; None if it is not."""
    if width is None or width <= WIDE or band < BAND * prf or np.radians(band) > prf:
        return None
    return (
        f"beam_width is {width:.4g} rad, or {np.degrees(width):.3g} degrees, over which Doppler changes by {band:.4g} "
        f"Hz at a PRF of {prf:.4g} Hz; it looks like degrees: give radians, {np.radians(width):.3g}"
    )
