"""Structure of a CPHD file: header, XML and per-vector parameters, checked before any sample is read."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.errors import InputError, library_for
from blocksar.places.ranges import Readable
from blocksar.readers.kinds import Kind, matches
from blocksar.readers.reading import reading
from blocksar.readers.registry import refuse_others

if TYPE_CHECKING:
    from types import ModuleType

KIND = Kind(
    "a CPHD file", matches(rb"CPHD/1\.[01](\.\d+)?\n"),
    "turn it into a phase history first: `blocksar ingest cphd {path} --out {store}`",
)  # fmt: skip
KNOWN = ("1.0.1", "1.1.0")  # versions that sarkit knows
NAMESPACE = "http://api.nsgreg.nga.mil/schema/cphd/"
END_OF_SECTION = b"\f\n"
MAX_HEADER = 1 << 16  # bytes
MAX_XML = 1 << 26  # bytes; some kilobytes are usual
MAX_VECTORS, MAX_SAMPLES = 1 << 24, 1 << 20
FORMATS = ("CI2", "CI4", "CF8")  # all signal formats of the standard
NEEDED = {  # per-vector parameters and their numbers of values
    **{"TxTime": 1, "TxPos": 3, "RcvTime": 1, "RcvPos": 3, "SRPPos": 3},
    **{"FX1": 1, "FX2": 1, "TOA1": 1, "TOA2": 1, "SC0": 1, "SCSS": 1},
}


def library() -> ModuleType:
    """Import sarkit.cphd.

    Raises
    ------
    InputError
        If it is not installed.
    """
    with library_for("CPHD files need", "formats"):
        import sarkit.cphd
    return sarkit.cphd


@dataclass(frozen=True, kw_only=True, eq=False)
class CphdFile:
    """One channel of a CPHD file, its structure checked."""

    path: Readable
    version: str
    tree: Any  # of the XML
    channel: str
    domain: str
    sign: int
    dtype: np.dtype[Any]  # of a sample, big endian
    shape: tuple[int, int]  # vectors, samples
    first_byte: int  # of the channel's signal array
    unnamed: int  # bytes of the signal block behind the last signal array of all channels
    same_samples: tuple[str, ...]  # other channels with the same signal array
    vectors: NDArray[Any]  # per-vector parameters
    first_vector: int = 0  # of the file, that is taken
    band: tuple[float, float] = (-np.inf, np.inf)  # of the frequencies that are wanted, Hz

    @cached_property
    def root(self) -> Any:
        return self.tree.getroot()

    @property
    def scaled(self) -> bool:
        """Tell whether samples have an amplitude factor by vector."""
        return "AmpSF" in (self.vectors.dtype.names or ())

    def parameter(self, name: str, rows: IntArray | slice = slice(None)) -> FloatArray:
        """Read a per-vector parameter of some vectors."""
        return np.asarray(self.vectors[name][rows], dtype=np.float64)

    def part(self, pulses: tuple[int, int | None], band: tuple[float, float]) -> CphdFile:
        """Copy with vectors first .. stop - 1, and with the frequencies of a band, Hz.

        Raises
        ------
        InputError
            If fewer than 8 vectors are left.
        """
        first, stop, _ = slice(*pulses).indices(self.shape[0])
        if stop - first < 8:
            raise InputError(
                f"--pulses {pulses[0]}:{'' if pulses[1] is None else pulses[1]} leaves {max(stop - first, 0)} of "
                f"{self.shape[0]} vectors; at least 8 are needed"
            )
        return replace(
            self, vectors=self.vectors[first:stop], shape=(stop - first, self.shape[1]), band=band,
            first_vector=self.first_vector + first,
            first_byte=self.first_byte + first * self.shape[1] * self.dtype.itemsize,
        )  # fmt: skip

    def read(self, file: BinaryIO, first: int, stop: int, samples: slice) -> ComplexArray:
        """Read samples of the vectors first .. stop - 1, (n_vector, n_sample) complex64, not scaled.

        Raises
        ------
        InputError
            If the file is too short.
        """
        width, size = self.shape[1], self.dtype.itemsize
        count = samples.stop - samples.start
        if 2 * count >= width:
            raw = self.take(file, self.first_byte + first * width * size, (stop - first) * width)
            return _complex(raw.reshape(-1, width)[:, samples])
        rows = np.empty((stop - first, count), np.complex64)
        for row, vector in enumerate(range(first, stop)):
            start = self.first_byte + (vector * width + samples.start) * size
            rows[row] = _complex(self.take(file, start, count))
        return rows

    def take(self, file: BinaryIO, start: int, count: int) -> NDArray[Any]:
        """Read `count` samples from byte `start` on, in the file's format."""
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


def reading_file(path: Readable) -> AbstractContextManager[None]:
    """Turn errors of reading a CPHD file into an InputError that names it."""
    return reading(path, damaged="damaged, or no CPHD file", remedy="get it again")


def opened(path: Readable) -> BinaryIO:
    """Open a CPHD file.

    Raises
    ------
    InputError
        If it is of another kind, or none.
    OSError
        If it cannot be opened.
    """
    refuse_others(path, KIND)
    return path.open()


def open_file(file: BinaryIO, path: Readable, channel: str | None, *, any_channel: bool = False) -> CphdFile:
    """Check header, XML and per-vector parameters, and that the samples are present.

    Without `channel` the file must have one only, or its first is taken if `any_channel`.

    Raises
    ------
    InputError
        If the file is damaged, contradicts itself or is not supported.
    """
    sarkit = library()
    length = file.seek(0, os.SEEK_END)
    version, header = _header(file)
    blocks = {name: _block(header, name, length) for name in ("XML", "PVP", "SIGNAL")}
    if blocks["XML"].stop - blocks["XML"].start > MAX_XML:
        raise InputError(f"XML_BLOCK_SIZE is {len(blocks['XML'])}, too large for an XML block; the header is damaged")
    file.seek(0)
    reader = sarkit.Reader(file)
    tree = reader.metadata.xmltree
    root = tree.getroot()
    if root.tag != f"{{{NAMESPACE}{version}}}CPHD":
        raise InputError(f"the XML's root is {root.tag!r}, but the header says CPHD/{version}; make them agree")
    _name_known_version(tree, version)
    _check_supported(root)
    identifier = _choose_channel(root, channel, any_channel=any_channel)
    data = child_of(root, f"{{*}}Data/{{*}}Channel[{{*}}Identifier='{identifier}']", "Data/Channel")
    n_vector = _integer(data, "NumVectors", 8, MAX_VECTORS)
    n_sample = _integer(data, "NumSamples", 8, MAX_SAMPLES)
    name = text_of(root, "Data/SignalArrayFormat")
    if name not in FORMATS:
        raise InputError(f"Data/SignalArrayFormat is {name!r}; it must be one of {', '.join(FORMATS)}")
    dtype = sarkit.binary_format_string_to_dtype(name).newbyteorder(">")
    first = blocks["SIGNAL"].start + _integer(data, "SignalArrayByteOffset", 0, length)
    _check_inside("signal array", first, n_vector * n_sample * dtype.itemsize, blocks["SIGNAL"])
    size = _integer(root, "Data/NumBytesPVP", 8, 1 << 20)
    start = blocks["PVP"].start + _integer(data, "PVPArrayByteOffset", 0, length)
    _check_inside("PVP array", start, n_vector * size, blocks["PVP"])
    _check_fields(sarkit.get_pvp_dtype(tree), size)
    arrays = _arrays(root, dtype.itemsize, size, length)
    for what in ("signal", "PVP"):
        _check_apart(what, {name: spans[what] for name, spans in arrays.items()})
    same = [name for name, spans in arrays.items() if spans["signal"] == arrays[identifier]["signal"]]
    vectors = reader.read_pvps(identifier)
    return CphdFile(
        path=path, version=version, tree=tree, channel=identifier, dtype=dtype, shape=(n_vector, n_sample),
        domain=_one_of(root, "Global/DomainType", ("FX", "TOA")),
        sign=int(_one_of(root, "Global/SGN", ("+1", "-1", "1"))), first_byte=first,
        unnamed=len(blocks["SIGNAL"]) - max(spans["signal"].stop for spans in arrays.values()),
        same_samples=tuple(name for name in same if name != identifier),
        vectors=vectors.astype(vectors.dtype.newbyteorder("=")),
    )  # fmt: skip


def _arrays(root: Any, item: int, size: int, length: int) -> dict[str, dict[str, range]]:
    """Byte ranges of each channel's signal and PVP array in their blocks; `item` bytes a sample, `size` a vector."""
    arrays = {}
    for channel in root.findall("{*}Data/{*}Channel"):
        n_vector, n_sample = (
            _integer(channel, "NumVectors", 0, MAX_VECTORS),
            _integer(channel, "NumSamples", 0, MAX_SAMPLES),
        )
        signal, pvp = (_integer(channel, f"{what}ArrayByteOffset", 0, length) for what in ("Signal", "PVP"))
        arrays[text_of(channel, "Identifier")] = {
            "signal": range(signal, signal + n_vector * n_sample * item), "PVP": range(pvp, pvp + n_vector * size),
        }  # fmt: skip
    return arrays


def _check_apart(what: str, arrays: Mapping[str, range]) -> None:
    """Refuse channels whose arrays overlap without being the same."""
    ordered = sorted(arrays.items(), key=lambda pair: (pair[1].start, pair[1].stop))
    for (name, one), (other, two) in pairwise(ordered):
        if one != two and two.start < one.stop:
            raise InputError(
                f"the {what} arrays of channels {name!r} and {other!r} overlap: bytes {one.start} .. {one.stop - 1} "
                f"and {two.start} .. {two.stop - 1} of their block; the XML is wrong: correct "
                f"{'Signal' if what == 'signal' else what}ArrayByteOffset, NumVectors or NumSamples"
            )


def _header(file: BinaryIO) -> tuple[str, dict[str, str]]:
    """Read version, keys and values of the header; checked first, since it gives the sizes of all blocks.

    Versions 1.0 and 1.1 are laid out alike; `kinds` tells them from others.
    """
    file.seek(0)
    start = file.read(MAX_HEADER)
    line = start.split(b"\n", 1)[0][:40].decode("ascii", errors="backslashreplace")
    if END_OF_SECTION not in start:
        raise InputError(f"its header does not end within {MAX_HEADER} bytes; get the file again")
    pairs = {}
    for text in start.split(END_OF_SECTION, 1)[0].decode("utf-8").split("\n")[1:]:
        if text:
            key, separator, value = text.partition(" := ")
            if not separator or key in pairs:
                raise InputError(f"header line {text[:60]!r} is not a new 'key := value'; the header is damaged")
            pairs[key] = value
    return line.removeprefix("CPHD/"), pairs


def _block(header: dict[str, str], name: str, length: int) -> range:
    """Byte range of a block, which must lie within the file."""
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


def _check_inside(what: str, start: int, size: int, block: range) -> None:
    """Refuse an array that reaches beyond its block."""
    if start + size > block.stop:
        raise InputError(
            f"{what} needs bytes {start} .. {start + size - 1}, but its block ends at {block.stop - 1}; "
            "header and XML disagree: get the file again"
        )


def _name_known_version(tree: Any, version: str) -> None:
    """Put all elements into the namespace of the version that sarkit knows; 1.0.0 and 1.0.1 are laid out alike."""
    known = next((each for each in KNOWN if each[:4] == version[:4]), KNOWN[-1])
    if version != known:
        for node in tree.iter("{*}*"):
            node.tag = f"{{{NAMESPACE}{known}}}{node.tag.rpartition('}')[2]}"


def _check_supported(root: Any) -> None:
    """Refuse files with content that is not supported, by name."""
    kind = text_of(root, "CollectionID/CollectType")
    if kind != "MONOSTATIC":
        raise InputError(f"CollectionID/CollectType is {kind!r}; only MONOSTATIC collections are supported")
    compression = root.findtext("{*}Data/{*}SignalCompressionID")
    if compression is not None:
        raise InputError(
            f"signal arrays are compressed ({compression!r}), which is not supported; write them uncompressed"
        )


def _choose_channel(root: Any, channel: str | None, *, any_channel: bool) -> str:
    """The identifier of the requested channel, or of the only one; of the first if `any_channel`."""
    names = identifiers_of(root)
    if len(set(names)) != len(names) or not all(names) or any("'" in name for name in names):
        raise InputError(
            f"Data/Channel has the identifiers {names[:8]}, which must be present, once each; correct the XML"
        )
    known = ", ".join(repr(name) for name in names[:20])
    if channel is not None:
        if channel not in names:
            raise InputError(f"channel {channel!r} is not in it; it has {known}")
        return channel
    if not names:
        raise InputError("its XML has no Data/Channel, so that no signal array is known; get the file again")
    if len(names) != 1 and not any_channel:
        raise InputError(f"it has {len(names)} channels; give --channel, one of {known}, or all")
    return names[0]


def identifiers_of(root: Any) -> list[str]:
    """The identifiers of a file's channels, in the order of the XML."""
    return [node.text or "" for node in root.findall("{*}Data/{*}Channel/{*}Identifier")]


def child_of(node: Any, path: str, name: str) -> Any:
    """Return the only element at a path; an InputError calls it by `name`."""
    matches = node.findall(path)
    if len(matches) != 1:
        raise InputError(f"{name} is {len(matches)} times in the XML instead of once; correct the XML")
    return matches[0]


def text_of(node: Any, path: str) -> str:
    """Return the text of the only element at a path, which must not be empty."""
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
    """Return the finite numbers of an element's children, in the order of `names`."""
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


def polynomial_of(node: Any, variables: int) -> FloatArray:
    """Coefficients of a polynomial in one or two variables, (order1 + 1,) or (order1 + 1, order2 + 1).

    Raises
    ------
    InputError
        If an order is not from 0 to 32, or a coefficient has an exponent above its order or is no finite number.
    """
    orders = [node.get(f"order{axis + 1}", "") for axis in range(variables)]
    if not all(text.isascii() and text.isdigit() and int(text) <= 32 for text in orders):
        raise InputError(f"a polynomial has the orders {orders}, but 0 to 32 are possible")
    table = np.zeros([int(text) + 1 for text in orders])
    for coefficient in node.findall("{*}Coef"):
        exponents = tuple(int(coefficient.get(f"exponent{axis + 1}")) for axis in range(variables))
        value = float(coefficient.text)
        if not all(0 <= e < size for e, size in zip(exponents, table.shape, strict=True)) or not np.isfinite(value):
            raise InputError(
                f"a polynomial of the orders {orders} has the coefficient {value:.6g} of exponents {list(exponents)}; "
                "correct it"
            )
        table[exponents] = value
    return table


def _check_fields(dtype: np.dtype[Any], size: int) -> None:
    """Check names, types and offsets of the per-vector parameters that are used."""
    extents: list[tuple[int, int, str]] = []
    fields: Mapping[str, Any] = dtype.fields or {}
    for name, count in {**NEEDED, "AmpSF": 1, "SIGNAL": 1}.items():
        if name not in fields:
            if name in NEEDED:
                raise InputError(f"PVP/{name} is missing in the XML; without it vectors cannot be placed")
            continue
        kind, offset = fields[name][:2]
        expected = np.dtype("i8") if name == "SIGNAL" else np.dtype(("f8", (count,)) if count > 1 else "f8")
        if kind != expected:
            raise InputError(f"PVP/{name} has a format of {kind}, but must be {expected}; correct the XML")
        extents.append((offset, offset + kind.itemsize, name))
    extents.sort()
    for (_, stop, name), (start, _, other) in zip(extents, [*extents[1:], (size, size, "the end")], strict=True):
        if start < stop:
            raise InputError(f"PVP/{name} reaches to byte {stop} of a vector, into {other} at {start}; correct the XML")
