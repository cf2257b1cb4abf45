"""One file of the Gotcha set: reading and checks of its fields.

The files are MATLAB files of version 5 (MAT-File Format, The MathWorks), plain or compressed, with a struct of numbers.

Only this part of the format is supported: a file is a header of 128 bytes and then elements, each a type, a length and
that many bytes. The element of an array holds elements: flags and class, dimensions, name, and its numbers or, for a
struct with one row, the length of the field names, the names, and an array for each.

Files are untrusted input, but scipy's reader trusts them: of 360 files with one bit flipped in the tag of an element,
12 ended the process with a segmentation fault (scipy 1.17). This reader checks every length against the bytes present.
"""

from __future__ import annotations

import os
import re
import stat
import struct
import zlib
from contextlib import AbstractContextManager
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from blocksar import stores, texts
from blocksar.arrays import UNIFORM_TOLERANCE, ComplexArray, FloatArray
from blocksar.collection.beam import wrapped
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place
from blocksar.readers.kinds import ARRAYS, Kind
from blocksar.readers.reading import reading
from blocksar.readers.registry import refuse_others

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
    """Read the fields of a struct variable of one row; a field that is not numeric is described.

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
            return _members(parts, name, endian)
    raise InputError(f"it has no variable `{name}`, {FOREIGN}")


def _elements(data: memoryview, endian: str) -> list[_Element]:
    """Divide bytes into consecutive elements."""
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


def _members(parts: list[_Element], name: str, endian: str) -> dict[str, Value]:
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
    """The numbers of an array, or a description of another element's contents."""
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


KIND = Kind(
    "a MATLAB 5 file",
    lambda start: start.data.startswith(b"MATLAB 5") or start.data[124:128] in (b"\0\1IM", b"\1\0MI"),
    "if it is of the Gotcha set, turn it into a phase history first: `blocksar ingest gotcha {path} --out {store}`",
)  # fmt: skip
ROUNDING = 2 * float(np.finfo(np.float32).eps)  # relative error of a range when it and three coordinates are float32
ANGLE_TOLERANCE = 0.01  # degrees between th, phi and the position
LARGEST = 1e30  # modulus of a sample: beyond it is no echo, and its power would overflow
MAX_FILE = 1 << 28  # bytes; a file of one degree has 400 kB
VECTORS = ("x", "y", "z", "r0")
OPTIONAL = ("th", "phi")
PASS = re.compile(r"pass(\d+)", re.IGNORECASE)  # pass and polarisation appear in a file's name only
POLARISATION = re.compile(r"(?<![A-Z])(HH|HV|VH|VV)(?![A-Z])", re.IGNORECASE)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Contents:
    """The contents of a file: samples (n_pulse, n_frequency), frequency (Hz), position (n_pulse, 3) and r0 (m)."""

    samples: ComplexArray
    frequency: FloatArray
    position: FloatArray
    r0: FloatArray
    autofocus: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class GotchaFile:
    """A file that was read and checked, without its samples; their checksums are kept, one per pulse."""

    path: Place
    pass_: str
    polarisation: str
    frequency: FloatArray
    position: FloatArray
    r0: FloatArray
    autofocus: bool
    checksums: list[str]

    def samples(self) -> ComplexArray:
        """Read the samples (n_pulse, n_frequency) again.

        Raises
        ------
        InputError
            If the file has changed since it was first read.
        """
        with _reading(self.path):
            samples = read_file(self.path).samples
            if _checksums(samples) != self.checksums:
                raise InputError("it changed while it was read; start again when no program writes to it")
        return samples


def _reading(path: Place) -> AbstractContextManager[None]:
    return reading(path, damaged="damaged", remedy="fetch it again")


def read_headers(path: Place) -> GotchaFile:
    """Read and check a file; keep everything but its samples.

    Raises
    ------
    InputError
        If the file is damaged or not one of the set.
    """
    with _reading(path):
        contents = read_file(path)
        checksums = _checksums(contents.samples)
    return GotchaFile(
        path=path,
        pass_="".join(PASS.findall(path.name)[:1]),
        polarisation="".join(POLARISATION.findall(path.name)[-1:]).upper(),
        frequency=contents.frequency,
        position=contents.position,
        r0=contents.r0,
        autofocus=contents.autofocus,
        checksums=checksums,
    )


def _checksums(samples: ComplexArray) -> list[str]:
    return [stores.checksum(pulse) for pulse in samples]


def read_file(path: Place) -> _Contents:
    """Read a file and check that its fields agree with each other."""
    fields = _fields(_read_bytes(path))
    frequency = _frequency(_numbers(fields, "freq"))
    samples = _samples(fields["fp"], frequency.size)
    n = samples.shape[0]
    vectors = {name: _numbers(fields, name, n) for name in VECTORS}
    position = np.stack([vectors[name] for name in "xyz"], axis=1)
    distance = np.linalg.norm(position, axis=1)
    if not distance.min() > 0:
        raise InputError(f"x, y and z are 0 at pulse {int(distance.argmin())}; they must be the antenna's, in m")
    if not position[:, 2].min() > 0:
        raise InputError(f"z is {position[:, 2].min():.6g} m; it must be the antenna's height above the scene's centre")
    _check_angles(fields, position, distance)
    window = SPEED_OF_LIGHT / (2 * (frequency[1] - frequency[0]))
    difference = np.abs(vectors["r0"] - distance)
    if not difference.max() <= window / 2:
        where = int(difference.argmax())
        raise InputError(
            f"r0 is {vectors['r0'][where]:.8g} m at pulse {where}, but x, y and z lie {distance[where]:.8g} m from the "
            f"scene's centre, more than half the range window of {window:.4g} m away; correct r0, or the position"
        )
    return _Contents(
        samples=samples, frequency=frequency, position=position, r0=vectors["r0"], autofocus="af" in fields
    )


def _read_bytes(path: Place) -> bytes:
    """Read all bytes of a file, unless it is too large."""
    refuse_others(path, KIND)
    if isinstance(path, LocalPlace):
        status = os.stat(path.path)
        if not stat.S_ISREG(status.st_mode):
            raise InputError("it is no regular file; give the path of a MATLAB file")
        if status.st_size > MAX_FILE:
            raise InputError(
                f"it has {status.st_size} bytes, more than any file of the set; give one of the set's own files"
            )
    return path.read_bytes()


def _fields(data: bytes) -> dict[str, Value]:
    """Read the fields of the struct `data`, which must include the required ones."""
    fields = read_struct(data, "data")
    missing = [name for name in ("fp", "freq", *VECTORS) if name not in fields]
    if missing:
        raise InputError(f"data has no field {', '.join(missing)}; give one of the set's own files")
    return fields


def _numbers(fields: dict[str, Value], name: str, count: int | None = None) -> FloatArray:
    """Return a field that must be a vector of `count` finite real numbers."""
    values = fields[name]
    if isinstance(values, str) or values.dtype.kind not in "iuf":
        raise InputError(f"{name} is {_describe(values)}; it must be real numbers")
    if values.size != max(values.shape, default=0) or values.size == 0:
        raise InputError(f"{name} has shape {values.shape}; it must be a vector")
    if count is not None and values.size != count:
        raise InputError(
            f"{name} has {texts.count(values.size, 'value')}, but fp has {texts.count(count, 'pulse')}; make them agree"
        )
    vector = values.astype(np.float64).ravel()
    if not np.isfinite(vector).all():
        where = int(np.argmin(np.isfinite(vector)))
        raise InputError(f"{name} is {vector[where]} at index {where}; it must be finite")
    return vector


def _describe(values: Value) -> str:
    """Describe the contents of a field."""
    if isinstance(values, str):
        return values
    return "complex" if values.dtype.kind == "c" else f"of type {values.dtype}"


def _frequency(values: FloatArray) -> FloatArray:
    """Return the uniform grid that the values match up to rounding."""
    if values.size < 8:
        raise InputError(f"freq has {texts.count(values.size, 'value')}; at least 8 are needed")
    step = (values[-1] - values[0]) / (values.size - 1)
    if not step > 0 or not values[0] > 0:
        raise InputError(f"freq runs from {values[0]:.6g} to {values[-1]:.6g} Hz; it must ascend, above 0 Hz")
    grid = values[0] + step * np.arange(values.size)
    off = np.abs(values - grid)
    if off.max() > UNIFORM_TOLERANCE * step + ROUNDING / 2 * values[-1]:
        where = int(off.argmax())
        raise InputError(
            f"freq is {values[where]:.10g} Hz at index {where}, {off[where] / step:.3g} steps from its place on a "
            "uniform grid; resample fp to one"
        )
    return grid


def _samples(values: Value, n_frequency: int) -> ComplexArray:
    """Check the samples and transpose them to (n_pulse, n_frequency)."""
    if isinstance(values, str) or values.dtype.kind != "c":
        raise InputError(f"fp is {_describe(values)}; it must be complex numbers")
    if values.ndim != 2 or values.shape[0] != n_frequency or values.shape[1] < 1:
        transposed = ", transposed" if values.shape[::-1][:1] == (n_frequency,) else ""
        raise InputError(
            f"fp has shape {values.shape}{transposed}, but freq has {n_frequency} values; it must be frequency by pulse"
        )
    with np.errstate(invalid="ignore"):
        bad = ~(np.maximum(np.abs(values.real), np.abs(values.imag)) <= LARGEST)
    if bad.any():
        frequency, pulse = (int(i) for i in np.argwhere(bad)[0])
        raise InputError(
            f"fp is {values[frequency, pulse]} at frequency {frequency} of pulse {pulse}, which is no echo; fetch the "
            "file again, or take the pulse out of all fields"
        )
    return np.ascontiguousarray(values.T, np.complex64)


def _check_angles(fields: dict[str, Value], position: FloatArray, distance: FloatArray) -> None:
    """Check x, y and z against the azimuth and elevation in the file."""
    angles = {
        "th": np.degrees(np.arctan2(position[:, 1], position[:, 0])),
        "phi": np.degrees(np.arcsin(np.clip(position[:, 2] / distance, -1, 1))),
    }
    for name in OPTIONAL:
        if name not in fields:
            continue
        recorded = _numbers(fields, name, distance.size)
        difference = np.abs(np.degrees(wrapped(np.radians(recorded - angles[name]))))
        if difference.max() > ANGLE_TOLERANCE:
            where = int(difference.argmax())
            raise InputError(
                f"{name} is {recorded[where]:.6g} degrees at pulse {where}, but x, y and z say "
                f"{angles[name][where]:.6g}; make them agree"
            )
