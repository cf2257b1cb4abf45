"""The interface of places: local folders and object stores."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from blocksar.errors import NoRoom
from blocksar.places.ranges import Readable
from blocksar.texts import size_text

if TYPE_CHECKING:
    from zarr.storage import StorePath


class Held(Exception):
    """A lock has a living owner; the message describes it."""

    def __init__(self, owner: str) -> None:
        super().__init__(owner)


class Place(Readable):
    """The location of a store, a run, or a file in either. All methods raise OSError if reading or writing fails."""

    @abstractmethod
    def __truediv__(self, name: str) -> Place:
        """Return the place of that name below this one; the name may have several parts, separated by '/'."""

    @abstractmethod
    def exists(self) -> bool:
        """Tell whether there is a file or folder; in an object store, a folder exists if anything lies below it."""

    @abstractmethod
    def names(self) -> list[str]:
        """List the names directly below, files and folders, sorted; empty if there is no folder."""

    @abstractmethod
    def files(self) -> Iterator[tuple[str, int, str]]:
        """Iterate over all files below: relative name, size in bytes, and a version that changes when it is written."""

    def written_after(self, file: Place) -> Iterator[str]:
        """Iterate over the names of files below that were written after another one; none where this is not known."""
        return iter(())

    @abstractmethod
    def read_bytes(self) -> bytes:
        """Read a file."""

    @abstractmethod
    def write_bytes(self, data: bytes) -> None:
        """Write a file atomically: readers see the old content or the new, which is on the disk before it is seen."""

    @abstractmethod
    def remove(self) -> None:
        """Remove the file or folder, if there is one."""

    @abstractmethod
    def sweep(self) -> None:
        """Remove temporary files and folders that killed processes left below this place."""

    def free(self) -> int | None:
        """Return the bytes that are free on the disk of this place; None where there is no such limit."""
        return None

    def taken(self) -> int:
        """Return the bytes that all files below take, each once, whatever number of names it has; 0 if not known."""
        return 0

    @abstractmethod
    def settle(self) -> None:
        """Flush everything written below to disk, so that it survives a loss of power."""

    @abstractmethod
    def zarr_path(self) -> StorePath:
        """Return the place as zarr names it: a zarr store, and a path in it."""

    @abstractmethod
    @contextmanager
    def lock(self) -> Iterator[None]:
        """Hold this file as a lock and remove it afterwards. The lock of a dead process does not count.

        Raises
        ------
        Held
            If a living process holds it.
        """


REMEDY = "make room, or choose another place"


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
    """Make the error about a place whose disk has less free than is needed, bytes."""
    return NoRoom(f"{place} needs {size_text(needed)} of disk, and {size_text(free)} are free there; {remedy}")
