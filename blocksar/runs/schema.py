"""Records in JSON: frozen dataclasses whose fields pydantic reads and checks.

pydantic is imported only to read records: a new run writes records, and reads none.
"""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, fields
from functools import cache
from math import nan
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self, TypeVar

from blocksar.errors import FolderError, InputError

if TYPE_CHECKING:
    from pydantic import GetCoreSchemaHandler, TypeAdapter

T = TypeVar("T")
LARGEST = 1 << 63  # magnitude of a valid number
_SCALARS = (str, int, float)
_KINDS = {"string_type": "a text", "tuple_type": "a list", "dict_type": "an object", "dataclass_type": "an object"}


@dataclass(frozen=True)
class _As:
    """Conversion of a JSON value: a function that raises ValueError with a text on what the value should be."""

    convert: Callable[[Any], Any]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> Any:
        from pydantic import PlainValidator

        return PlainValidator(self.convert).__get_pydantic_core_schema__(source, handler)


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < LARGEST:
        raise ValueError("a number")
    return value


def _figure(value: Any) -> float:
    return nan if value is None else float(_number(value))


def _whole(value: Any) -> int:
    if (number := _number(value)) != int(number):
        raise ValueError("a whole number")
    return int(number)


def _count(value: Any) -> int:
    if (number := _whole(value)) < 1:
        raise ValueError("at least 1")
    return number


def _flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError("true or false")
    return value


def _inside(value: Any) -> str:
    parts = value.split("/") if isinstance(value, str) else [""]
    if not all(parts) or {".", ".."} & set(parts) or "\0" in value:
        raise ValueError("a path within the run")
    return "/".join(parts)


Number = Annotated[float, _As(_number)]  # finite; integers stay integers
Figure = Annotated[float, _As(_figure)]  # NaN where the file has null, which stands for it in JSON
Whole = Annotated[int, _As(_whole)]
Count = Annotated[int, _As(_count)]  # at least 1
Flag = Annotated[bool, _As(_flag)]
Inside = Annotated[str, _As(_inside)]  # a path below the folder of the file


class Record:
    """A frozen dataclass with a layout in JSON: its fields in their order.

    In a file, null or nothing stands for the default of a field that has one; keys that are not fields are ignored.
    """

    if_any: ClassVar[tuple[str, ...]] = ()  # fields that are written unless they are empty

    @classmethod
    def from_json(cls, value: Any, file: str) -> Self:
        """Convert from JSON; `file` is for messages.

        Raises
        ------
        FolderError
            If a field is missing or of another type.
        """
        try:
            return read(cls, value, file, "focus again with --overwrite")
        except InputError as error:
            raise FolderError(str(error), replaceable=True) from None

    def as_json(self) -> dict[str, Any]:
        """Convert to JSON."""
        # Thousands are written at the end of a run: `asdict`, which copies every number, takes several times as long.
        values = {name: _plain(value) for name, value in vars(self).items()}
        for name in self.if_any:
            if _empty(values[name]):
                del values[name]
        return values

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> Any:
        from pydantic import BeforeValidator

        given = {
            each.name
            for each in fields(cls)  # type: ignore[arg-type]
            if each.default is not MISSING or each.default_factory is not MISSING
        }

        def without_null(value: Any) -> Any:
            if not isinstance(value, Mapping):
                return value
            return {name: item for name, item in value.items() if item is not None or name not in given}

        return BeforeValidator(without_null).__get_pydantic_core_schema__(source, handler)


def read(kind: type[T], value: Any, file: str, remedy: str) -> T:
    """Read a record.

    Parameters
    ----------
    kind : type
        A dataclass of the types of this module.
    value : any JSON value
    file, remedy : str
        For messages.

    Raises
    ------
    InputError
        If a field is missing or of another type: names the first one, its value and the remedy.
    """
    from pydantic import ValidationError

    try:
        return _adapter(kind).validate_python(value)  # type: ignore[arg-type]
    except ValidationError as error:
        wrong = error.errors(include_url=False)[0]
    path = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in wrong["loc"] if part != "[key]")
    match wrong["type"]:
        case "missing":
            problem = "missing"
        case "too_long":
            problem = f"{reprlib.repr(wrong['input'])}, not a list of {wrong['ctx']['max_length']}"
        case kind_of_error:
            actual = "null" if wrong["input"] is None else reprlib.repr(wrong["input"])
            text = wrong["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
            problem = f"{actual}, not {_KINDS.get(kind_of_error, text)}"
    raise InputError(f"{file} is damaged: {path.lstrip('.') or 'the record'} is {problem}; {remedy}")


@cache
def _adapter(kind: type[T]) -> TypeAdapter[T]:
    from pydantic import TypeAdapter

    return TypeAdapter(kind)


def _plain(value: Any) -> Any:
    if isinstance(value, _SCALARS):
        return value
    if isinstance(value, Record):
        return value.as_json()
    if isinstance(value, tuple):
        return [_plain(each) for each in value]
    return dict(value) if isinstance(value, Mapping) else value


def _empty(value: Any) -> bool:
    return value is None or value is False or (isinstance(value, str | list | dict) and not value)
