"""A run in its folder: the paths of its stores, and the signing and checking of receipts."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache

from blocksar import stores
from blocksar.errors import InputError, ProcessingError
from blocksar.places.place import Place
from blocksar.runs.record import RECORD, Receipt, Written
from blocksar.stores import Array


@dataclass(frozen=True, kw_only=True)
class Run:
    """A run in its folder: the paths of its stores, and its receipts.

    Attributes
    ----------
    folder : Place
    identity : str
        Hash of settings, input, format and division into blocks; all receipts carry it.
    threads : int
        Threads that a task may use.
    pyramid : bool
        Whether the image has one.
    on_terrain : bool
        Whether the ground has heights of its own, which are in `terrain`.
    collection, segment : int or None
        Numbers of what is focused of it, which set apart stores and names of units; None where there is one only.
    """

    folder: Place
    identity: str
    threads: int
    collection: int | None = None
    segment: int | None = None
    pyramid: bool = False
    on_terrain: bool = False

    @property
    def token(self) -> str:
        """Part of the keys of tasks, different for every run on the cluster."""
        return stores.checksum_bytes(f"{self.identity} {self.folder!s}".encode("utf-8", "surrogateescape"))[:8]

    @property
    def _own(self) -> Place:
        """Folder of the files of one segment."""
        return self.folder if self.segment is None else self.folder / "segments" / str(self.segment)

    def unit_of_segment(self, unit: str) -> str:
        """Name a unit of work of this segment."""
        return unit if self.segment is None else f"{unit}-of-segment-{self.segment}"

    def unit_of_collection(self, unit: str) -> str:
        """Name a unit of work of this collection."""
        return unit if self.collection is None else f"{unit}-of-collection-{self.collection}"

    @property
    def described(self) -> Place:
        """Store of the collection's metadata, without samples."""
        return self._own / "collection.zarr"

    @property
    def spectrum(self) -> Place:
        return self._own / "spectrum.zarr"

    @property
    def compressed(self) -> Place:
        whole = self.folder / "compressed.zarr"
        return whole if self.collection is None else whole / f"{self.collection}.zarr"

    @property
    def image(self) -> Place:
        return self.folder / "image.zarr"

    @property
    def terrain(self) -> Place:
        """Store of the ground's heights; missing if the ground is a plane."""
        return self.folder / "terrain.zarr"

    @property
    def surroundings(self) -> Place:
        """Store of the heights that shadow or overlay pixels from outside; missing if the terrain suffices."""
        return self.folder / "surroundings.zarr"

    def gated(self, block: str) -> Place:
        return self.folder / "gated" / f"spectrum-{block}.zarr"

    def patch(self, block: str) -> Place:
        return self.folder / "patches" / block

    def _receipt(self, unit: str) -> Place:
        return self.folder / "receipts" / f"{unit}.json"

    def receipt(self, unit: str) -> Receipt | None:
        """Read the receipt of a unit of this run, without checking its data; None if there is no valid one."""
        path = self._receipt(unit)
        with suppress(InputError):
            value = stores.read_json(path)
            if isinstance(value, dict) and value.get("run") == self.identity:
                seal = value.pop("seal", None)
                return Receipt.from_json(value, f"{path}") if seal == stores.json_checksum(value) else None
        return None

    def sign(self, receipt: Receipt, started: float) -> Receipt:
        """Add run and duration to a unit's receipt, and write it. The unit's data must have been written before.

        Parameters
        ----------
        started : float
            Start of the unit by time.perf_counter, s.
        """
        receipt = replace(receipt, run=self.identity, seconds=time.perf_counter() - started)
        value = receipt.as_json()
        stores.write_json(self._receipt(receipt.unit), value | {"seal": stores.json_checksum(value)})
        return receipt

    def intact(self, receipt: Receipt) -> bool:
        """Read everything that a unit wrote, and compare it with the checksums of the receipt."""
        try:
            same = stores.same_files(self.folder, receipt.files)
            return same and all(part.intact(self.folder) for part in receipt.written)
        except (InputError, OSError, ValueError, IndexError):
            return False

    def file_checksums(self, store: Place, *, volatile: Sequence[str] = ()) -> dict[str, str]:
        """Return the checksums of a new store's files (metadata and coordinates) by path relative to the run folder.

        Parameters
        ----------
        store : Place
            Must not hold samples yet.
        volatile : sequence of str
            Variables to leave out.
        """
        prefix, left_out = self.name_of(store), tuple(f"{name}/c/" for name in volatile)
        return {
            f"{prefix}/{name}": stores.file_checksum(store / name)
            for name, _, _ in store.files()
            if not name.startswith(left_out)
        }

    def name_of(self, store: Place) -> str:
        """Return the path of a store, relative to the run folder."""
        return str(store)[len(str(self.folder)) :].strip("/")

    def establish(self, store: Place, create: Callable[[], None], *, volatile: Sequence[str] = ()) -> None:
        """Create a store that tasks will write to, unless it exists and is intact.

        Parameters
        ----------
        store : Place
        create : function
            Replaces the store, with everything that tasks have written to it; their receipts become invalid.
        volatile : sequence of str
            Variables that the calling process writes later.

        Raises
        ------
        ProcessingError
            If it cannot be written.
        """
        unit = self._unit_of(store)
        receipt = self.receipt(unit)
        if receipt is None or not self.intact(receipt):
            try:
                if store.exists() and not (store / "zarr.json").exists():  # killed while it was removed
                    store.remove()
                create()
            except InputError as error:  # about the run's own store, not about the input
                raise ProcessingError(str(error)) from error
            except OSError as error:
                raise ProcessingError(f"{store} cannot be written ({error.strerror or error})") from error
            files = self.file_checksums(store, volatile=volatile)
            self.sign(Receipt(unit=unit, stage="create", files=files), time.perf_counter())

    def discard(self, store: Place, receipts: Sequence[Receipt]) -> None:
        """Remove a store that the run no longer needs, after the receipts of what was written to it.

        If the run is resumed, the store is written again.
        """
        name = self.name_of(store)
        writers = [receipt.unit for receipt in receipts if any(part.store == name for part in receipt.written)]
        for unit in (self._unit_of(store), *writers):
            self._receipt(unit).remove()
        store.remove()

    def _unit_of(self, store: Place) -> str:
        """Name of the unit of work that creates a store."""
        folder, *inner = self.name_of(store).removesuffix(".zarr").split("/")
        return "-".join(["store", *([] if inner and folder in ("patches", "gated") else [folder]), *inner])


def refuse_replaced(run: Run) -> None:
    """Raise a ProcessingError if another run has taken the folder.

    A shared cluster may still run tasks of a process that was killed, whose run has been overwritten since.
    """
    if not _has(record := run.folder / RECORD, record.version(), run.identity):
        raise ProcessingError(f"{run.folder} has been taken by another run")


@lru_cache(maxsize=64)
def _has(record: Place, version: str, identity: str) -> bool:
    """Tell whether this version of a run's record has an identity."""
    return identity.encode() in record.read_bytes()


def write(
    run: Run, store: Place, variable: str, region: tuple[slice, ...], values: Array, *, cached: bool = False
) -> Written:
    """Write a region of whole chunks, through the page cache if `cached`; return its entry for the receipt.

    Raises
    ------
    ProcessingError
        If it cannot be written, or another run has taken the folder.
    """
    refuse_replaced(run)
    stores.write_region(store, variable, region, values, cached=cached)
    span = tuple((part.start, part.stop) for part in region)
    return Written(run.name_of(store), variable, span, stores.checksum(values))
