"""Receipts: what a unit of work has written, with checksums."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from blocksar import stores
from blocksar.errors import InputError, ProcessingError
from blocksar.places.place import Place
from blocksar.stores import Array

Receipt = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Run:
    """Where a run keeps its things, and the hash that its keys and receipts carry.

    Attributes
    ----------
    folder : Place
    identity : str
        Of settings, input, format and division into blocks.
    threads : int
        That a task may use.
    """

    folder: Place
    identity: str
    threads: int

    @property
    def token(self) -> str:
        """For the keys of tasks: no other run, here or elsewhere on the cluster, has it."""
        return stores.checksum_bytes(f"{self.identity} {self.folder!s}".encode("utf-8", "surrogateescape"))[:8]

    @property
    def spectrum(self) -> Place:
        return self.folder / "spectrum.zarr"

    @property
    def compressed(self) -> Place:
        return self.folder / "compressed.zarr"

    @property
    def image(self) -> Place:
        return self.folder / "image.zarr"

    def patch(self, block: str) -> Place:
        return self.folder / "patches" / block

    def _receipt(self, unit: str) -> Place:
        return self.folder / "receipts" / f"{unit}.json"

    def receipt(self, unit: str) -> Receipt | None:
        """The receipt of a unit of this very run; whether its data are intact is another question."""
        with suppress(InputError):
            receipt = stores.read_json(self._receipt(unit))
            if isinstance(receipt, dict) and receipt.get("run") == self.identity:
                seal = receipt.pop("seal", None)
                return receipt if seal == stores.json_checksum(receipt) else None
        return None

    def sign(self, unit: str, started: float, written: Iterable[Written] = (), **facts: Any) -> Receipt:
        """Write a unit's receipt, after its data. `started` is of time.perf_counter."""
        receipt = {
            "run": self.identity,
            "unit": unit,
            "seconds": time.perf_counter() - started,
            "written": [part.record() for part in written],
            **facts,
        }
        stores.write_json(self._receipt(unit), receipt | {"seal": stores.json_checksum(receipt)})
        return receipt

    def intact(self, receipt: Receipt) -> bool:
        """Whether all that a unit wrote is on the disk as it was written: reads it."""
        try:
            return self._same_files(receipt.get("files", {})) and all(
                Written.of(record).intact(self.folder) for record in receipt["written"]
            )
        except (InputError, OSError, AttributeError, KeyError, TypeError, ValueError, IndexError):
            return False

    def _same_files(self, wanted: Mapping[str, str]) -> bool:
        return all(stores.checksum_bytes((self.folder / name).read_bytes()) == value for name, value in wanted.items())

    def file_checksums(self, store: Place, *, volatile: Sequence[str] = ()) -> dict[str, str]:
        """Of the small files of a store that has no chunks of samples yet, metadata and coordinates, by name."""
        prefix, left_out = self.name_of(store), tuple(f"{name}/c/" for name in volatile)
        return {
            f"{prefix}/{name}": stores.checksum_bytes((store / name).read_bytes())
            for name, _, _ in store.files()
            if not name.startswith(left_out)
        }

    def name_of(self, store: Place) -> str:
        """Of a store in this run, below its folder."""
        return str(store)[len(str(self.folder)) :].strip("/")

    def establish(self, store: Place, create: Callable[[], None], *, volatile: Sequence[str] = ()) -> None:
        """Create a store for tasks to write into, unless it stands there as it was created.

        Parameters
        ----------
        store : Place
        create : function
            Replaces what is there: also all that tasks have written, whose receipts then are not trusted.
        volatile : sequence of str
            Variables that are filled in later, by the process that calls this.

        Raises
        ------
        ProcessingError
            If it cannot be written.
        """
        unit = f"store-{store.name.removesuffix('.zarr')}"
        found = self.receipt(unit)
        if found is None or not self.intact(found):
            try:
                create()
            except InputError as error:  # of the run's own stores: it is not the input that is wrong
                raise ProcessingError(str(error)) from error
            self.sign(unit, time.perf_counter(), files=self.file_checksums(store, volatile=volatile))


@dataclass(frozen=True)
class Written:
    """A region of a variable that a task has written, with its checksum.

    Attributes
    ----------
    store : str
        Below the run's folder.
    variable : str
    region : tuple of (first, end)
        One a dimension.
    checksum : str
        Of the values.
    """

    store: str
    variable: str
    region: tuple[tuple[int, int], ...]
    checksum: str

    @classmethod
    def of(cls, record: Any) -> Written:
        region = tuple((first, end) for first, end in record["region"])
        return cls(record["store"], record["variable"], region, record["checksum"])

    def record(self) -> dict[str, Any]:
        """As JSON holds it."""
        return vars(self).copy()

    def intact(self, folder: Place) -> bool:
        """Whether the values on disk have the checksum.

        Raises
        ------
        InputError
            If they cannot be read.
        """
        region = tuple(slice(*span) for span in self.region)
        values = stores.read_region(folder / self.store, self.variable, region)
        return stores.checksum(values) == self.checksum


def write(run: Run, store: Place, variable: str, region: tuple[slice, ...], values: Array) -> Written:
    """Write a region of whole chunks, and say what was written.

    Raises
    ------
    ProcessingError
        If it cannot be written, or another run has taken the folder.
    """
    # A given cluster may still be at work for a process that was killed, and whose run was then overwritten.
    if run.identity.encode() not in (run.folder / "run.json").read_bytes():
        raise ProcessingError(f"{run.folder} has been taken by another run")
    stores.write_region(store, variable, region, values)
    return written(run, store, variable, region, values)


def written(run: Run, store: Place, variable: str, region: tuple[slice, ...], values: Array) -> Written:
    """What was written, for a receipt."""
    span = tuple((part.start, part.stop) for part in region)
    return Written(run.name_of(store), variable, span, stores.checksum(values))
