"""Sub-aperture looks: the parts into which each target's dwell is divided, and the collections that see one part only.

A look of a steered beam is what a beam of 1 / n of its width would have seen, which points as far off the beam's centre
as the part of the dwell lies: parts of equal angle, since w and g of the image's definition are functions of it.
Without a steered beam all targets have one dwell, and a look is a part of the pulses. Everything else follows from the
collection: dwells, gates, prediction, weighting. The sum of the looks, each times its sum of weights, is the image.
"""

from __future__ import annotations

from dataclasses import replace
from numbers import Integral

import numpy as np

from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.errors import InputError

MOST = 32
LEAST_PULSES = 16  # of a look


def pulses_of(collection: Collection, number: int, count: int) -> slice:
    """Pulses of a look, as a slice; all of them if the beam is steered."""
    n = collection.n_pulse
    if collection.steered:
        return slice(0, n)
    return slice(round(number * n / count), round((number + 1) * n / count))


def narrowed(collection: Collection, number: int, count: int, sign: float) -> Collection:
    """Copy of a collection with its steered beam narrowed to one look of the dwells.

    Parameters
    ----------
    number, count : int
        0 is the first in time, of `count`.
    sign : float
        1 where targets enter the beam at positive offsets, -1 where at negative ones; see `entering_side`.
    """
    assert collection.beam_width is not None
    centre = _centre(number, count, sign) * collection.beam_width
    moved = collection.pointing
    changes = {
        moved: getattr(collection, moved) + centre, "beam_width": collection.beam_width / count,
        "lit_width": collection.beam_width,
    }  # fmt: skip
    if collection.beam_offset is not None:
        changes["beam_offset"] = collection.beam_offset - centre
    return replace(collection, **changes)


def whole_beam(collection: Collection, look: tuple[int, int, float] | None) -> Collection:
    """Recover the collection under the whole beam from a look (number, count, sign) made by `narrowed`.

    A collection of no look, or of some pulses, is that itself.
    """
    if look is None or collection.lit_width is None:
        return collection
    width, moved = collection.lit_width, collection.pointing
    centre = _centre(*look) * width
    changes = {moved: getattr(collection, moved) - centre, "beam_width": width, "lit_width": None}
    if collection.beam_offset is not None:
        changes["beam_offset"] = collection.beam_offset + centre
    return replace(collection, **changes)


def _centre(number: int, count: int, sign: float) -> float:
    """Centre of a look relative to the beam's centre, in beam widths."""
    return sign * (0.5 - (number + 0.5) / count)


def look_of(collection: Collection, number: int, count: int, sign: float) -> Collection:
    """Copy of a collection as look `number` of `count` sees it; 0 is the first in time, `sign` as for `narrowed`."""
    if collection.steered:
        return narrowed(collection, number, count, sign)
    pulses = pulses_of(collection, number, count)
    return collection.segment(pulses.start, pulses.stop)


def entering_side(geometry: Geometry, x: float, y: float) -> float:
    """Sign of the offset from the beam's centre with which a ground point, m, enters the beam."""
    offset = np.asarray(geometry.beam.offset(np.array(x), np.array(y), slice(None)), np.float64)
    middle = int(np.clip(np.argmin(np.abs(offset)), 1, offset.size - 2))
    return 1.0 if offset[middle + 1] < offset[middle - 1] else -1.0


def checked_count(count: int, collection: Collection) -> int:
    """Check a number of looks, and return it as int.

    Raises
    ------
    InputError
        If it is none, or leaves too few pulses.
    """
    if not isinstance(count, Integral) or isinstance(count, bool) or not 2 <= count <= MOST:
        raise InputError(f"looks = {count!r}: give 2 to {MOST} looks, or leave it out")
    if collection.n_pulse < count * LEAST_PULSES:
        raise InputError(
            f"looks = {count}: {collection.n_pulse} pulses leave fewer than {LEAST_PULSES} for each; take fewer looks"
        )
    return int(count)
