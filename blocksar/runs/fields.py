"""Reading JSON field by field: each value knows its name, so that an error can name the wrong one."""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from math import nan
from typing import Any, TypeVar

from blocksar.errors import FolderError

T = TypeVar("T")
LARGEST = 1 << 63  # magnitude of a valid number


@dataclass(frozen=True)
class Field:
    """A value of a JSON file.

    All conversions raise FolderError where the value is missing or of another type; see `optional`.

    Attributes
    ----------
    value : any JSON value
        None where the file has null, or no such field.
    name : str
        Path of the field within the file, such as `plan.predicted[3].yaw`; empty for the whole.
    file : str
        The file, for messages.
    present : bool
        Whether the file has the field.
    """

    value: Any
    name: str
    file: str
    present: bool = True

    def fail(self, expected: str) -> FolderError:
        """Return the error that names the field, its value and the remedy."""
        actual = "missing" if not self.present else "null" if self.value is None else reprlib.repr(self.value)
        return FolderError(
            f"{self.file} is damaged: {self.name or 'the record'} is {actual}, not {expected}; "
            "focus again with --overwrite",
            replaceable=True,
        )

    def __getitem__(self, key: str) -> Field:
        """Return a member of an object."""
        if not isinstance(self.value, Mapping):
            raise self.fail("an object")
        return Field(self.value.get(key), f"{self.name}.{key}".lstrip("."), self.file, key in self.value)

    def __bool__(self) -> bool:
        """Tell whether there is a value: neither missing nor null."""
        return self.value is not None

    def __iter__(self) -> Iterator[Field]:
        """Iterate over the members of a list; a missing list is empty."""
        if not isinstance(self.value, list | tuple | None):
            raise self.fail("a list")
        for index, value in enumerate(self.value or ()):
            yield Field(value, f"{self.name}[{index}]", self.file)

    def optional(self, convert: Callable[[Field], T]) -> T | None:
        """Convert a value; None where it is missing or null."""
        return convert(self) if self else None

    def mapping(self) -> dict[str, Any]:
        """Return an object as it is, empty if missing."""
        if not isinstance(self.value, Mapping | None):
            raise self.fail("an object")
        return dict(self.value or {})

    def items(self) -> Iterator[tuple[str, Field]]:
        """Iterate over the members of an object, with their keys; none if it is missing."""
        return ((key, self[key]) for key in self.mapping())

    def text(self, default: str | None = None) -> str:
        if self.value is None and default is not None:
            return default
        if not isinstance(self.value, str):
            raise self.fail("a text")
        return self.value

    def path(self) -> str:
        """Return a path below the folder of the file."""
        parts = self.text().split("/")
        if not all(parts) or {".", ".."} & set(parts) or "\0" in self.text():
            raise self.fail("a path within the run")
        return self.text()

    def number(self) -> float:
        """Return a finite number; integers stay integers."""
        value = self.value
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < LARGEST:
            raise self.fail("a number")
        return value

    def number_or_nan(self) -> float:
        """Return a finite number, or NaN for null, which stands for it in JSON."""
        return nan if self.present and self.value is None else float(self.number())

    def integer(self) -> int:
        if (value := self.number()) != int(value):
            raise self.fail("a whole number")
        return int(value)

    def count(self) -> int:
        """Return a whole number that is at least 1."""
        if (value := self.integer()) < 1:
            raise self.fail("at least 1")
        return value

    def flag(self) -> bool:
        """Return true or false; false if missing."""
        if not isinstance(self.value, bool | None):
            raise self.fail("true or false")
        return bool(self.value)

    def pair(self) -> tuple[float, float]:
        numbers = [member.number() for member in self]
        if len(numbers) != 2:
            raise self.fail("a pair of numbers")
        return numbers[0], numbers[1]

    def integers(self) -> tuple[int, int]:
        numbers = [member.integer() for member in self]
        if len(numbers) != 2:
            raise self.fail("a pair of whole numbers")
        return numbers[0], numbers[1]
