"""The track as flown, beside a simulated phase history whose own track has an error."""

from __future__ import annotations

from blocksar.arrays import FloatArray
from blocksar.errors import InputError
from blocksar.places import Location
from blocksar.stores.creation import create
from blocksar.stores.phase_history import open_dataset
from blocksar.stores.schema import CONVENTIONS, TRUTH

TITLE = "track as flown; the phase history beside it has the track as known"


def write_truth(path: Location, time: FloatArray, positions: FloatArray) -> None:
    """Write slow times (n,), s, and positions (n, 3), m, in the frame of the phase history; replaces an earlier one."""
    create(
        path,
        TRUTH,
        sizes={},
        coords={"time": time},
        variables={"antenna_position": positions},
        attrs={"Conventions": CONVENTIONS, "title": TITLE},
        chunks={},
        overwrite=True,
    )


def is_truth(path: Location) -> bool:
    """Tell whether a store is one that `write_truth` wrote."""
    try:
        return open_dataset(path).attrs.get("title") == TITLE
    except InputError:
        return False
