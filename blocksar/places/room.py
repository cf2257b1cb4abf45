"""Room on a disk: what is to be written is refused before it begins where it would not fit."""

from __future__ import annotations

from blocksar.constants import GIB, MIB
from blocksar.errors import NoRoom
from blocksar.places.place import Place

REMEDY = "make room, or choose another place"


def size_text(size: float) -> str:
    """A number of bytes in MiB or GiB.

    Examples
    --------
    >>> size_text(3 * 2**20), size_text(5.5 * 2**30)
    ('3.0 MiB', '5.5 GiB')
    """
    return f"{size / GIB:.1f} GiB" if size >= GIB else f"{size / MIB:.{0 if size >= 100 * MIB else 1}f} MiB"


def check_room(place: Place, needed: int, remedy: str = REMEDY) -> None:
    """Check that the disk of a place has so many bytes free.

    Raises
    ------
    NoRoom
        If it has less.
    """
    if (free := place.free()) is not None and needed > free:
        raise no_room_for(place, needed, free, remedy)


def no_room_for(place: Place, needed: int, free: int, remedy: str) -> NoRoom:
    """The error about a place whose disk has less free than is needed, bytes."""
    return NoRoom(f"{place} needs {size_text(needed)} of disk, and {size_text(free)} are free there; {remedy}")
