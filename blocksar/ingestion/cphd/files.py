"""A CPHD file as bytes: header, XML and per-vector parameters, checked before a sample is read."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.errors import InputError
from blocksar.ingestion.reading import reading
from blocksar.places.place import Place

if TYPE_CHECKING:
    from types import ModuleType


VERSIONS = ("1.0.1", "1.1.0")
NAMESPACE = "http://api.nsgreg.nga.mil/schema/cphd/"
END_OF_SECTION = b"\f\n"
MAX_HEADER = 1 << 16  # bytes
MAX_XML = 1 << 26  # bytes: some kilobytes are usual
MAX_VECTORS, MAX_SAMPLES = 1 << 24, 1 << 20
FORMATS = ("CI2", "CI4", "CF8")  # all that the standard has
NEEDED = {  # per-vector parameters, and how many numbers they are
    **{"TxTime": 1, "TxPos": 3, "RcvTime": 1, "RcvPos": 3, "SRPPos": 3},
    **{"FX1": 1, "FX2": 1, "TOA1": 1, "TOA2": 1, "SC0": 1, "SCSS": 1},
}


def library() -> ModuleType:
    """sarkit.cphd."""
    try:
        import sarkit.cphd
    except ModuleNotFoundError as error:
        raise InputError(f"{error.name} is not installed, which CPHD files need; install blocksar[formats]") from None
    return sarkit.cphd


@dataclass(frozen=True, kw_only=True, eq=False)
class CphdFile:
    """One channel of a CPHD file whose structure has been checked."""

    path: Path
    version: str
    tree: Any  # of the XML
    channel: str
    domain: str
    sign: int
    dtype: np.dtype[Any]  # of a sample, big endian
    shape: tuple[int, int]  # vectors, samples
    first_byte: int  # of the channel's signal array
    vectors: NDArray[Any]  # per-vector parameters

    @cached_property
    def root(self) -> Any:
        return self.tree.getroot()

    def parameter(self, name: str, rows: IntArray | slice = slice(None)) -> FloatArray:
        return np.asarray(self.vectors[name][rows], dtype=np.float64)

    def read(self, file: BinaryIO, first: int, stop: int, samples: slice) -> ComplexArray:
        """Vectors first .. stop - 1, of each these samples, as they are in the file but complex64.

        Raises
        ------
        InputError
            If the file ends before.
        """
        width, size = self.shape[1], self.dtype.itemsize
        wanted = samples.stop - samples.start
        if 2 * wanted >= width:
            raw = self._take(file, self.first_byte + first * width * size, (stop - first) * width)
            return _complex(raw.reshape(-1, width)[:, samples])
        rows = np.empty((stop - first, wanted), np.complex64)
        for row, vector in enumerate(range(first, stop)):
            start = self.first_byte + (vector * width + samples.start) * size
            rows[row] = _complex(self._take(file, start, wanted))
        return rows

    def _take(self, file: BinaryIO, start: int, count: int) -> NDArray[Any]:
        file.seek(start)
        data = file.read(count * self.dtype.itemsize)
        if len(data) != count * self.dtype.itemsize:
            raise InputError(f"signal array ends at byte {start + len(data)}: the file became shorter; copy it again")
        return np.frombuffer(data, self.dtype)


def _complex(raw: NDArray[Any]) -> ComplexArray:
    if raw.dtype.names is None:
        return raw.astype(np.complex64)
    out = np.empty(raw.shape, np.complex64)
    out.real, out.imag = raw["real"], raw["imag"]
    return out


def reading_file(path: Place) -> AbstractContextManager[None]:
    return reading(path, damaged="damaged, or no CPHD file", remedy="get it again")


def open_file(file: BinaryIO, path: Path, channel: str | None) -> CphdFile:
    """Check header, XML and per-vector parameters, and nothing of the samples but that they are there."""
    sarkit = library()
    length = file.seek(0, os.SEEK_END)
    version, header = _header(file)
    blocks = {name: _block(header, name, length) for name in ("XML", "PVP", "SIGNAL")}
    if blocks["XML"].stop - blocks["XML"].start > MAX_XML:
        raise InputError(f"XML_BLOCK_SIZE is {len(blocks['XML'])}, which no XML block has; the header is damaged")
    file.seek(0)
    reader = sarkit.Reader(file)
    tree = reader.metadata.xmltree
    root = tree.getroot()
    if root.tag != f"{{{NAMESPACE}{version}}}CPHD":
        raise InputError(f"the XML's root is {root.tag!r}, but the header says CPHD/{version}; make them agree")
    _refuse(root)
    wanted = _choose(root, channel)
    data = child_of(root, f"{{*}}Data/{{*}}Channel[{{*}}Identifier='{wanted}']", "Data/Channel")
    n_vector = _integer(data, "NumVectors", 8, MAX_VECTORS)
    n_sample = _integer(data, "NumSamples", 8, MAX_SAMPLES)
    text = text_of(root, "Data/SignalArrayFormat")
    if text not in FORMATS:
        raise InputError(f"Data/SignalArrayFormat is {text!r}; it must be one of {', '.join(FORMATS)}")
    dtype = sarkit.binary_format_string_to_dtype(text).newbyteorder(">")
    first = blocks["SIGNAL"].start + _integer(data, "SignalArrayByteOffset", 0, length)
    _fits("signal array", first, n_vector * n_sample * dtype.itemsize, blocks["SIGNAL"])
    size = _integer(root, "Data/NumBytesPVP", 8, 1 << 20)
    start = blocks["PVP"].start + _integer(data, "PVPArrayByteOffset", 0, length)
    _fits("PVP array", start, n_vector * size, blocks["PVP"])
    _check_fields(sarkit.get_pvp_dtype(tree), size)
    vectors = reader.read_pvps(wanted)
    return CphdFile(
        path=path, version=version, tree=tree, channel=wanted, dtype=dtype, shape=(n_vector, n_sample),
        domain=_one_of(root, "Global/DomainType", ("FX", "TOA")),
        sign=int(_one_of(root, "Global/SGN", ("+1", "-1", "1"))), first_byte=first,
        vectors=vectors.astype(vectors.dtype.newbyteorder("=")),
    )  # fmt: skip


def _header(file: BinaryIO) -> tuple[str, dict[str, str]]:
    """Version, and keys and values, of the header; looked at here first, as it says how long everything is."""
    file.seek(0)
    start = file.read(MAX_HEADER)
    line = start.split(b"\n", 1)[0][:40].decode("ascii", errors="backslashreplace")
    if not line.startswith("CPHD/"):
        raise InputError(f"it begins with {line[:12]!r} instead of 'CPHD/', so it is no CPHD file; check the path")
    if line.removeprefix("CPHD/") not in VERSIONS:
        raise InputError(f"it is of version {line!r}; supported are {' and '.join(VERSIONS)}")
    if END_OF_SECTION not in start:
        raise InputError(f"its header does not end within {MAX_HEADER} bytes; get the file again")
    pairs = {}
    for text in start.split(END_OF_SECTION, 1)[0].decode("utf-8").split("\n")[1:]:
        if text:
            key, separator, value = text.partition(" := ")
            if not separator or key in pairs:
                raise InputError(f"header line {text[:60]!r} is no new 'key := value'; the header is damaged")
            pairs[key] = value
    return line.removeprefix("CPHD/"), pairs


def _block(header: dict[str, str], name: str, length: int) -> range:
    """Bytes of a block, which must lie in the file."""
    numbers = []
    for key in (f"{name}_BLOCK_BYTE_OFFSET", f"{name}_BLOCK_SIZE"):
        value = header.get(key)
        if value is None:
            raise InputError(f"header key {key} is missing; the header is damaged")
        if not (value.isascii() and value.isdigit() and len(value) < 19 and int(value)):
            raise InputError(f"header key {key} is {value[:40]!r}, which is no number of bytes; the header is damaged")
        numbers.append(int(value))
    offset, size = numbers
    if offset + size > length:
        raise InputError(
            f"{name} block reaches to byte {offset + size}, but the file has {length}: it was cut short; copy it again"
        )
    return range(offset, offset + size)


def _fits(what: str, start: int, size: int, block: range) -> None:
    if start + size > block.stop:
        raise InputError(
            f"{what} needs bytes {start} .. {start + size - 1}, but its block ends at {block.stop - 1}; "
            "header and XML disagree: get the file again"
        )


def _refuse(root: Any) -> None:
    """Say by name what is not supported."""
    kind = text_of(root, "CollectionID/CollectType")
    if kind != "MONOSTATIC":
        raise InputError(f"CollectionID/CollectType is {kind!r}; only MONOSTATIC collections are supported")
    compression = root.findtext("{*}Data/{*}SignalCompressionID")
    if compression is not None:
        raise InputError(f"signal arrays are compressed ({compression!r}), which is not supported; write them plainly")


def _choose(root: Any, wanted: str | None) -> str:
    """Identifier of the channel."""
    names = [node.text or "" for node in root.findall("{*}Data/{*}Channel/{*}Identifier")]
    if len(set(names)) != len(names) or not all(names) or any("'" in name for name in names):
        raise InputError(
            f"Data/Channel has the identifiers {names[:8]}, which must be there once each; correct the XML"
        )
    shown = ", ".join(repr(name) for name in names[:20])
    if wanted is not None:
        if wanted not in names:
            raise InputError(f"channel {wanted!r} is not in it; it has {shown}")
        return wanted
    if len(names) != 1:
        raise InputError(f"it has {len(names)} channels, and one is ingested at a time; give --channel, one of {shown}")
    return names[0]


def child_of(node: Any, path: str, name: str) -> Any:
    found = node.findall(path)
    if len(found) != 1:
        raise InputError(f"{name} is {len(found)} times in the XML instead of once; correct the XML")
    return found[0]


def text_of(node: Any, path: str) -> str:
    text = child_of(node, "/".join(f"{{*}}{part}" for part in path.split("/")), path).text
    if not (text or "").strip():
        raise InputError(f"{path} is empty in the XML; correct the XML")
    return str(text).strip()


def _one_of(node: Any, path: str, choices: Sequence[str]) -> str:
    text = text_of(node, path)
    if text not in choices:
        raise InputError(f"{path} is {text[:60]!r}; it must be {' or '.join(choices[:2])}")
    return text


def _integer(node: Any, path: str, least: int, most: int) -> int:
    text = text_of(node, path)
    if not (text.isascii() and text.isdigit() and len(text) < 19 and least <= int(text) <= most):
        raise InputError(f"{path} is {text[:60]!r}; it must be a whole number from {least} to {most}")
    return int(text)


def numbers_of(node: Any, path: str, names: Sequence[str]) -> FloatArray:
    values = []
    for name in names:
        text = text_of(node, f"{path}/{name}")
        try:
            values.append(float(text))
        except ValueError:
            raise InputError(f"{path}/{name} is {text[:60]!r}; it must be a number") from None
    if not np.isfinite(values).all():
        raise InputError(f"{path} is {values}; its numbers must be finite")
    return np.array(values)


def _check_fields(dtype: np.dtype[Any], size: int) -> None:
    """Names, types and places of the per-vector parameters that are used."""
    taken: list[tuple[int, int, str]] = []
    fields: Mapping[str, Any] = dtype.fields or {}
    for name, count in {**NEEDED, "AmpSF": 1, "SIGNAL": 1}.items():
        if name not in fields:
            if name in NEEDED:
                raise InputError(f"PVP/{name} is missing in the XML; without it vectors cannot be placed")
            continue
        kind, offset = fields[name][:2]
        right = np.dtype("i8") if name == "SIGNAL" else np.dtype(("f8", (count,)) if count > 1 else "f8")
        if kind != right:
            raise InputError(f"PVP/{name} has a format of {kind}, but must be {right}; correct the XML")
        taken.append((offset, offset + kind.itemsize, name))
    taken.sort()
    for (_, stop, name), (start, _, other) in zip(taken, [*taken[1:], (size, size, "the end")], strict=True):
        if start < stop:
            raise InputError(f"PVP/{name} reaches to byte {stop} of a vector, into {other} at {start}; correct the XML")
