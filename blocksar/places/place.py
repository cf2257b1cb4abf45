"""What every place can do."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from blocksar.errors import printable

if TYPE_CHECKING:
    from zarr.storage import StorePath


class Held(Exception):
    """A lock has a living owner, who is described."""

    def __init__(self, owner: str) -> None:
        super().__init__(owner)


class Place(ABC):
    """A store, a run or a file in either. All methods raise OSError where reading or writing fails."""

    def __format__(self, spec: str) -> str:
        """In messages, as one line."""
        return printable(str(self)).replace("\n", "\\n")

    @property
    @abstractmethod
    def name(self) -> str:
        """The last part."""

    @abstractmethod
    def __truediv__(self, name: str) -> Place:
        """What lies below under a name, or under names with '/' between."""

    @abstractmethod
    def exists(self) -> bool:
        """Whether a file or a folder is there; an object store has a folder where something lies below."""

    @abstractmethod
    def names(self) -> list[str]:
        """What lies right below, files and folders, sorted; nothing where there is no folder."""

    @abstractmethod
    def files(self) -> Iterator[tuple[str, int, str]]:
        """All files below: name relative to here, bytes, and a version that changes when the file is written."""

    @abstractmethod
    def read_bytes(self) -> bytes:
        """Of a file."""

    @abstractmethod
    def write_bytes(self, data: bytes) -> None:
        """Put a file here, on the disk when this returns: whoever reads it finds the old one or the new one."""

    @abstractmethod
    def remove(self) -> None:
        """Remove the file or folder; nothing happens where there is none."""

    @abstractmethod
    def sweep(self) -> None:
        """Remove what killed processes left behind below: temporary names."""

    @abstractmethod
    def settle(self) -> None:
        """Return once all that was written below is on the disk, whatever happens to the power."""

    @abstractmethod
    def zarr_path(self) -> StorePath:
        """The same for zarr: a store of its, and a path in it."""

    @abstractmethod
    @contextmanager
    def lock(self) -> Iterator[None]:
        """Hold this file as a lock; it is gone afterwards. The lock of a dead process is no lock.

        Raises
        ------
        Held
            If a living process has it.
        """
