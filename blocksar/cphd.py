"""CPHD files (NGA.STND.0068, versions 1.0.1 and 1.1.0) to a phase history.

The standard's signal, for a target whose echo comes dTOA seconds after that of the vector's stabilisation reference
point (SRP), and for the absolute radio frequency fx, is

    S(fx) = sigma exp(2j pi SGN fx dTOA),   dTOA = 2 (R - R_SRP) / c,   R_SRP = |ARP - SRP|.

With SGN = -1 that is the store's own signal, sigma exp(-4j pi (fc + f)/c (R - reference_range)), for fc + f = fx and
reference_range = R_SRP, one for each vector: where the SRP moves, so does reference_range. With SGN = +1 it is the
complex conjugate. In the TOA domain the mainlobe of the target has the phase 2 pi SGN fx_C dTOA,
fx_C = (FX1 + FX2) / 2, so that, conjugated where SGN = +1,

    S(fx) = SCSS (FX2 - FX1) sum over samples s of S_TOA(t_s) exp(-2j pi (fx - fx_C) t_s),   t_s = SC0 + s SCSS:

a target that peaks at 1 has |S(fx)| = 1. That sum is evaluated on the store's frequencies by a chirp z-transform,
without interpolation, whatever SC0, SCSS and fx_C are from vector to vector.

FX vectors whose SC0 and SCSS differ are brought to one grid by local interpolation. What is sampled holds delays from
TOA1 to TOA2 only, less than the 1 / SCSS that the samples tell apart; of all interpolators of `TAPS` samples the one
used here is the best for delays spread evenly over that (least squares, so that one-sided ones at the ends of the band
serve as well). The largest error over those delays is computed, held below `ACCURACY`, and reported; a few samples at
either end of FX1 .. FX2, where it would not hold, are left out. Samples beyond FX1 and FX2, which a vector may have and
which mean nothing there, are not used. Nothing is interpolated where the grids agree.

Delays of troposphere and ionosphere up to the SRP are in the file's own reference and gone with it; what they differ
by over the scene is left in. With SGN = +1 reflectivity comes out conjugate, too: that of time running backwards.

If the saved delays are not centred at the SRP, reference_range moves to their middle: the range window of the store
is centred at reference_range.

Positions go from Earth-centred coordinates to x east, y north, z up (the ellipsoid's normal) at the scene's reference
point (IARP), which becomes the origin; the attribute `georeference` keeps it. Transmitter and receiver of a monostatic
collection are at two places of one track, as the platform moves while the pulse is under way: their middle is taken,
which is exact at the SRP; the difference elsewhere is computed at the corners of the image area, reported, and refused
beyond `MAX_BISTATIC` wavelengths. Slow time is the time of transmission, counted from the middle vector; vectors that
are missing from their uniform times, and those whose SIGNAL is not 1, are missing pulses. Where times are not uniform,
signals are referenced to one fixed point and resampled (`resampling`) within the Doppler band of the image area, and
the error is reported.

A file is read by blocks of vectors, of which only the samples in the common band, where that is less than half of them.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import NDArray

from blocksar import stores
from blocksar.foreign import Ingested, reading
from blocksar.georeference import Georeference
from blocksar.parameters import (
    SPEED_OF_LIGHT,
    UNIFORM_TOLERANCE,
    BoolArray,
    Collection,
    ComplexArray,
    FloatArray,
    InputError,
    IntArray,
    printable,
)
from blocksar.places import LocalPlace, Location, Place, place
from blocksar.resampling import OCCUPIED, Resampling, plan_resampling

if TYPE_CHECKING:
    from types import ModuleType

Progress = Callable[[int, int], None]

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
ROWS = stores.TILE[0]  # pulses that are written at a time
PART = 64  # vectors that are brought to the grid at a time
TAPS = 64  # samples that one interpolated sample is made of
STEPS = 512  # of the table of interpolators, for one sample's width
ACCURACY = 1e-3  # of interpolation, over the reflectivity: -60 dB
NOISE_GAIN = 1.5  # that interpolation may have
LEAST_BAND = 0.5  # share of a vector's band that must be common to all
MAX_BISTATIC = 1 / 16  # wavelengths between the bistatic and the monostatic range
MAX_FOLD = 2.0  # saved delays over those that samples tell apart; no file is sampled so sparsely, units are wrong then
MAX_GAPS = 1.0  # missing vectors over those that are there
FARTHEST_SRP = 1e6  # m from the IARP
SMALLEST_ORBIT, LARGEST_ORBIT = 6.3e6, 1e9  # m from the Earth's centre
SAME_PLACE = 10.0  # m between the two descriptions of the IARP
FULL_DWELL = 0.95  # share of the collection from which a target counts as always lit
BEAM_TOLERANCE = 0.03  # of a dwell, within which dwell is a matter of yaw alone


def library() -> ModuleType:
    """sarkit.cphd."""
    try:
        import sarkit.cphd
    except ModuleNotFoundError as error:
        raise InputError(f"{error.name} is not installed, which CPHD files need; install blocksar[formats]") from None
    return sarkit.cphd


# ---------------------------------------------------------------- the file


@dataclass(frozen=True, kw_only=True, eq=False)
class _File:
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


def _reading(path: Place) -> AbstractContextManager[None]:
    return reading(path, damaged="damaged, or no CPHD file", remedy="get it again")


def _open(file: BinaryIO, path: Path, channel: str | None) -> _File:
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
    data = _child(root, f"{{*}}Data/{{*}}Channel[{{*}}Identifier='{wanted}']", "Data/Channel")
    n_vector = _integer(data, "NumVectors", 8, MAX_VECTORS)
    n_sample = _integer(data, "NumSamples", 8, MAX_SAMPLES)
    text = _text(root, "Data/SignalArrayFormat")
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
    return _File(
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
    kind = _text(root, "CollectionID/CollectType")
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


def _child(node: Any, path: str, name: str) -> Any:
    found = node.findall(path)
    if len(found) != 1:
        raise InputError(f"{name} is {len(found)} times in the XML instead of once; correct the XML")
    return found[0]


def _text(node: Any, path: str) -> str:
    text = _child(node, "/".join(f"{{*}}{part}" for part in path.split("/")), path).text
    if not (text or "").strip():
        raise InputError(f"{path} is empty in the XML; correct the XML")
    return str(text).strip()


def _one_of(node: Any, path: str, choices: Sequence[str]) -> str:
    text = _text(node, path)
    if text not in choices:
        raise InputError(f"{path} is {text[:60]!r}; it must be {' or '.join(choices[:2])}")
    return text


def _integer(node: Any, path: str, least: int, most: int) -> int:
    text = _text(node, path)
    if not (text.isascii() and text.isdigit() and len(text) < 19 and least <= int(text) <= most):
        raise InputError(f"{path} is {text[:60]!r}; it must be a whole number from {least} to {most}")
    return int(text)


def _numbers(node: Any, path: str, names: Sequence[str]) -> FloatArray:
    values = []
    for name in names:
        text = _text(node, f"{path}/{name}")
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


# ---------------------------------------------------------------- vectors to pulses


@dataclass(frozen=True, kw_only=True, eq=False)
class _Pulses:
    """Which vector is which pulse. A pulse that no vector fills, or whose vector is not normal, is missing.

    Attributes
    ----------
    vector : (n_pulse,) int
        -1 where missing.
    time, reference_time : (n_pulse,) float
        Of transmission, and of the standard's reference time, s.
    even : bool
        Whether time is uniform; if it is not, every pulse is a vector with a normal signal.
    position, reference_point : (n_pulse, 3) float
        ARP and SRP, Earth-centred, m.
    """

    vector: IntArray
    time: FloatArray
    reference_time: FloatArray
    position: FloatArray
    reference_point: FloatArray
    separation: float  # largest |TxPos - RcvPos|, m
    even: bool = True


def _pulses(file: _File) -> _Pulses:
    normal = _normal(file)
    placed = np.ones(file.shape[0], bool)
    for name in NEEDED:
        values = file.parameter(name).reshape(file.shape[0], -1)
        finite: BoolArray = np.asarray(np.isfinite(values).all(axis=1))
        if not finite[normal].all():
            first = int(np.argmin(finite | ~normal))
            raise InputError(
                f"PVP {name} is not finite in {np.count_nonzero(~finite & normal)} vectors whose signal is normal "
                f"(first: vector {first}); correct it, or mark them with SIGNAL = 0"
            )
        if name in ("TxTime", "TxPos", "RcvTime", "RcvPos", "SRPPos"):
            placed &= finite
    _check_vectors(file, normal)
    try:
        return _placed(file, normal, placed)
    except InputError:
        if normal.all():
            raise
        # Vectors without a signal need no place: many files have zeros there.
        return _placed(file, normal, normal)


def _placed(file: _File, normal: BoolArray, placed: BoolArray) -> _Pulses:
    """Pulses of some vectors, which all have a time and positions; those that are not normal are missing."""
    vector = np.asarray(np.flatnonzero(placed), dtype=np.int64)
    time = file.parameter("TxTime", vector)
    index, step, off = _slots(time)
    if off > UNIFORM_TOLERANCE:
        vector = vector[normal[vector]]
        time = file.parameter("TxTime", vector)
        index = np.arange(vector.size)
    transmitter, receiver, srp = (file.parameter(name, vector) for name in ("TxPos", "RcvPos", "SRPPos"))
    for name, positions in (("TxPos", transmitter), ("RcvPos", receiver)):
        radius = np.linalg.norm(positions, axis=1)
        if not ((radius > SMALLEST_ORBIT) & (radius < LARGEST_ORBIT)).all():
            raise InputError(
                f"PVP {name} lies {radius.min():.6g} .. {radius.max():.6g} m from the Earth's centre, which no antenna "
                "does; it must be Earth-centred, in m"
            )
    out, back = np.linalg.norm(transmitter - srp, axis=1), np.linalg.norm(receiver - srp, axis=1)
    moment = time + out / (out + back) * (file.parameter("RcvTime", vector) - time)
    separation = float(np.linalg.norm(transmitter - receiver, axis=1).max())
    if off > UNIFORM_TOLERANCE:
        return _Pulses(
            vector=vector, time=time, reference_time=moment, position=(transmitter + receiver) / 2,
            reference_point=srp, separation=separation, even=False,
        )  # fmt: skip
    where = np.full(index[-1] + 1, -1, dtype=np.int64)
    where[index] = np.where(normal[vector], vector, -1)
    slots = np.arange(where.size)
    return _Pulses(
        vector=where,
        time=time if slots.size == time.size else time[0] + step * slots,
        reference_time=np.interp(slots, index, moment),
        position=_filled(slots, index, (transmitter + receiver) / 2),
        reference_point=np.stack([np.interp(slots, index, column) for column in srp.T], axis=1),
        separation=separation,
    )


def _normal(file: _File) -> BoolArray:
    """Vectors that hold a normal signal."""
    if "SIGNAL" not in (file.vectors.dtype.names or ()):
        return np.ones(file.shape[0], bool)
    normal = np.asarray(file.vectors["SIGNAL"] == 1)
    if np.count_nonzero(normal) < 8:
        raise InputError(
            f"PVP SIGNAL is 1 in {np.count_nonzero(normal)} of {normal.size} vectors; at least 8 are needed"
        )
    return normal


def _check_vectors(file: _File, normal: BoolArray) -> None:
    """Refuse parameters that cannot be meant."""
    for name in ("SCSS", "FX1", *(("SC0",) if file.domain == "FX" else ())):
        values = file.parameter(name)[normal]
        if not (values > 0).all():
            raise InputError(f"PVP {name} falls to {values.min():.6g}; it must be above 0")
    for low, high in (("FX1", "FX2"), ("TOA1", "TOA2")):
        if not (file.parameter(low)[normal] < file.parameter(high)[normal]).all():
            raise InputError(f"PVP {low} is not below {high} in every vector; correct them")
    later = file.parameter("RcvTime") - file.parameter("TxTime")
    if not (later[normal] >= 0).all():
        raise InputError("PVP RcvTime is before TxTime in some vectors; correct them")
    if "AmpSF" in (file.vectors.dtype.names or ()):
        scale = file.parameter("AmpSF")[normal]
        with np.errstate(over="ignore"):
            if not (np.isfinite(scale.astype(np.float32)) & (scale > 0)).all():
                raise InputError("PVP AmpSF is not a finite number above 0 in every vector; correct it")


def _slots(time: FloatArray) -> tuple[IntArray, float, float]:
    """Index of every vector's pulse on the uniform axis of slow time, its step, s, and how many steps it lies off.

    Raises
    ------
    InputError
        If times do not ascend, or leave most of the axis empty.
    """
    if time.size < 8:
        raise InputError(f"only {time.size} vectors have a time and positions; at least 8 are needed")
    steps = np.diff(time)
    if not (steps > 0).all():
        raise InputError(f"PVP TxTime does not ascend at vector {int(np.argmin(steps > 0)) + 1}; sort the vectors")
    step = float(np.median(steps))
    for _ in range(3):
        index = np.rint((time - time[0]) / step)
        step = float((time[-1] - time[0]) / index[-1]) if index[-1] > 0 else step
    off = float(np.abs((time - time[0]) / step - index).max())
    if not (np.diff(index) > 0).all():
        off = 1.0
    if index[-1] + 1 > (1 + MAX_GAPS) * time.size:
        raise InputError(
            f"PVP TxTime has {time.size} vectors on an axis of {index[-1] + 1:.0f} pulses {step:.6g} s apart: most are "
            "missing; cut the collection at its gaps"
        )
    return index.astype(np.int64), step, off


@dataclass(frozen=True, kw_only=True, eq=False)
class _Evening:
    """From vectors at uneven times to pulses at even ones, once their signals have one reference.

    Attributes
    ----------
    vector : (n_vector,) int
        Those that are summed.
    moved : (n_vector,) float
        What is to be added to their reference range for that, m.
    """

    vector: IntArray
    moved: FloatArray
    resampling: Resampling
    said: str


def _evened(
    file: _File, pulses: _Pulses, reference: FloatArray, ground: FloatArray, highest: float
) -> tuple[_Pulses, FloatArray, _Evening]:
    """Pulses at uniform times, their reference range, and how they come of the vectors.

    Parameters
    ----------
    reference : (n_vector,) float
        Reference range of the vectors, m.
    ground : (n, 3) float
        Points all over the image area, Earth-centred, m.
    highest : float
        Frequency, Hz.

    Raises
    ------
    InputError
        If the image area has more Doppler than the vectors sample, or they leave more than half of the pulses open.
    """
    from scipy.interpolate import CubicSpline

    time, steps = pulses.time, np.diff(pulses.time)
    n = round((time[-1] - time[0]) / float(np.mean(steps))) + 1
    uniform = np.linspace(time[0], time[-1], n)
    interval = float(uniform[1] - uniform[0])
    point = pulses.reference_point.mean(axis=0)
    offset = float(np.mean(reference - np.linalg.norm(pulses.position - pulses.reference_point, axis=1)))
    common = np.linalg.norm(pulses.position - point, axis=1) + offset
    rate = 0.0
    for place_ in ground:
        apart = np.linalg.norm(pulses.position - place_, axis=1) - common
        rate = max(rate, float(np.abs(np.diff(apart) / steps).max()))
    band, prf = 4 * highest / SPEED_OF_LIGHT * rate, 1 / interval
    uneven = f"PVP TxTime is not uniform: steps run from {steps.min():.6g} to {steps.max():.6g} s"
    if not band <= OCCUPIED * prf:
        raise InputError(
            f"{uneven}, and the image area's Doppler of {band:.6g} Hz is too wide to resample at {prf:.6g} Hz "
            "on average; resample the vectors to uniform times"
        )
    made = plan_resampling(time, uniform, band=band)
    good = np.flatnonzero(made.good)
    if good.size < max(8, n // 2):
        raise InputError(
            f"{uneven}, so that {n - good.size} of {n} uniform pulses cannot be made of them; "
            "cut the collection at its gaps"
        )
    kept = slice(int(good[0]), int(good[-1]) + 1)
    made, uniform = made.part(kept), uniform[kept]
    position, moment = (
        np.asarray(CubicSpline(time, values, axis=0)(uniform)) for values in (pulses.position, pulses.reference_time)
    )
    nearest = np.rint(np.interp(uniform, time, np.arange(time.size))).astype(np.int64)
    even = _Pulses(
        vector=np.where(made.good, pulses.vector[nearest], -1), time=uniform, reference_time=moment, position=position,
        reference_point=np.tile(point, (uniform.size, 1)), separation=pulses.separation,
    )  # fmt: skip
    bound, spread = (20 * np.log10(error[made.good].max()) for error in (made.bound, made.spread))
    said = (
        f"vectors are {steps.min():.6g} to {steps.max():.6g} s apart: resampled to {uniform.size} pulses, one every "
        f"{interval:.6g} s, with an error of at most {bound:.0f} dB on any echo of the image area, {spread:.0f} dB "
        f"r.m.s. over all of them ({band:.4g} Hz of Doppler)"
    )
    evening = _Evening(vector=pulses.vector, moved=common - reference, resampling=made, said=said)
    return even, np.linalg.norm(position - point, axis=1) + offset, evening


def _filled(slots: IntArray, index: IntArray, values: FloatArray) -> FloatArray:
    """Positions of all pulses, smoothly through those that are known."""
    if slots.size == index.size:
        return values
    from scipy.interpolate import CubicSpline

    return np.asarray(CubicSpline(index, values, axis=0)(slots))


# ---------------------------------------------------------------- samples to one frequency grid


class _Delays(NamedTuple):
    """What of the echo the vectors hold: middle of the saved delays, by vector, and their largest extent, s."""

    middle: FloatArray
    extent: float


def _delays(file: _File, used: IntArray) -> _Delays:
    early, late = file.parameter("TOA1"), file.parameter("TOA2")
    first, last = early[used].min(), late[used].max()
    middle, extent = (first + last) / 2, last - first
    if abs(middle) < 1e-3 * extent:
        middle = 0.0
    unambiguous = 1 / file.parameter("SCSS")[used].max() if file.domain == "FX" else np.inf
    own = late - early
    if not own[used].max() <= MAX_FOLD * unambiguous:
        where = int(used[own[used].argmax()])
        raise InputError(
            f"PVP TOA1 .. TOA2 is {own[where]:.6g} s long in vector {where}, but samples SCSS = "
            f"{file.parameter('SCSS')[where]:.6g} Hz apart tell only {unambiguous:.6g} s of delays from one another; "
            "correct them"
        )
    if extent * 1.05 <= unambiguous or np.ptp(early[used]) + np.ptp(late[used]) == 0:
        return _Delays(np.full(early.size, middle), float(2 * max(last - middle, middle - first)))
    # The saved delays move too far to have one middle.
    return _Delays((early + late) / 2, float((late - early)[used].max()))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Picked:
    """FX vectors on one grid: some of their samples are the answer."""

    frequency: FloatArray  # Hz, absolute
    first: IntArray  # by vector: the sample of the first frequency
    used: IntArray  # vectors that matter
    error: float = 0.0

    @cached_property
    def samples(self) -> slice:
        first = self.first[self.used]
        return slice(int(first.min()), int(first.max()) + self.frequency.size)

    def apply(self, rows: ComplexArray, vectors: IntArray) -> ComplexArray:
        first = self.first[vectors] - self.samples.start
        if (first == first[0]).all():
            return rows[:, first[0] : first[0] + self.frequency.size]
        return np.take_along_axis(rows, first[:, None] + np.arange(self.frequency.size), axis=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Interpolated:
    """FX vectors on grids of their own: local interpolation. `table` (offset steps, TAPS) begins at `margin`."""

    frequency: FloatArray
    start: FloatArray  # by vector: SC0
    step: FloatArray  # by vector: SCSS
    first: IntArray  # by vector: the first sample within FX1 .. FX2; beyond them samples mean nothing
    last: IntArray  # and the last
    samples: slice
    table: FloatArray
    margin: int
    middle: FloatArray  # by vector: delay, s, about which the table is made
    error: float

    def apply(self, rows: ComplexArray, vectors: IntArray) -> ComplexArray:
        taps = self.table.shape[1]
        sample = np.arange(self.samples.start, self.samples.stop)
        fx = self.start[vectors, None] + self.step[vectors, None] * sample
        centred = (rows * _turn(fx * self.middle[vectors, None])).astype(np.complex64)
        place = (self.frequency - self.start[vectors, None]) / self.step[vectors, None] - self.samples.start
        base = np.clip(
            np.floor(place).astype(np.int64) - taps // 2 + 1,
            self.first[vectors, None] - self.samples.start,
            self.last[vectors, None] - self.samples.start - taps + 1,
        )
        step = (place - base - self.margin) * STEPS
        low = np.clip(step.astype(np.int64), 0, len(self.table) - 2)
        share = (step - low).astype(np.float32)
        out = np.zeros(place.shape, np.complex64)
        for tap in range(taps):
            weights = self.table[:, tap].astype(np.float32)
            weight = weights[low] * (1 - share) + weights[low + 1] * share
            out += weight * np.take_along_axis(centred, base + tap, axis=1)
        return (out * _turn(-self.frequency * self.middle[vectors, None])).astype(np.complex64)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Transformed:
    """TOA vectors: their Fourier sum at the grid's frequencies."""

    frequency: FloatArray
    start: FloatArray  # by vector: SC0
    step: FloatArray  # by vector: SCSS
    centre: FloatArray  # by vector: fx_C
    band: FloatArray  # by vector: FX2 - FX1
    samples: slice
    error: float = 0.0

    def apply(self, rows: ComplexArray, vectors: IntArray) -> ComplexArray:
        from scipy.signal import CZT

        n, count = self.frequency.size, rows.shape[1]
        df = (self.frequency[-1] - self.frequency[0]) / (n - 1)
        sample = np.arange(count)
        out = np.empty((rows.shape[0], n), np.complex64)
        transforms: dict[float, Any] = {}
        for row, v in enumerate(vectors):
            step = float(self.step[v])
            if step not in transforms:
                if len(transforms) > 64:
                    transforms.clear()
                transforms[step] = CZT(count, n, np.exp(-2j * np.pi * df * step))
            away = self.centre[v] - self.frequency[0]
            turned = rows[row].astype(np.complex128) * _turn(away * step * sample)
            ramp = _turn((self.centre[v] - self.frequency) * self.start[v])
            out[row] = transforms[step](turned) * ramp * (step * self.band[v])
        return out


_Resampler = _Picked | _Interpolated | _Transformed


def _turn(cycles: FloatArray) -> NDArray[np.complex128]:
    """exp(2j pi cycles), of any number of cycles."""
    return np.asarray(np.exp(2j * np.pi * (cycles - np.rint(cycles))))


def _resampler(file: _File, used: IntArray, delays: _Delays) -> _Resampler:
    """How samples come to one grid; `used` are the vectors that matter."""
    start, step = file.parameter("SC0"), file.parameter("SCSS")
    low, high = file.parameter("FX1"), file.parameter("FX2")
    n = file.shape[1]
    if file.domain == "TOA":
        first, last = _common(low[used], high[used])
        span = float((step[used] * n).max())
        early, late = (start - delays.middle)[used], (start + (n - 1) * step - delays.middle)[used]
        window = max(span, 2 * float(np.abs(early).max()), 2 * float(np.abs(late).max()))
        count = int(np.floor((last - first) * window + 1e-6))
        if not 8 <= count <= MAX_SAMPLES:
            raise InputError(
                f"PVP FX1, FX2, SC0 and SCSS give {count} frequencies over a band of {last - first:.6g} Hz and delays "
                f"of {window:.6g} s; correct them"
            )
        frequency = np.asarray((first + last) / 2 + (np.arange(count) - (count - 1) / 2) / window, np.float64)
        return _Transformed(
            frequency=frequency, start=start, step=step, centre=(low + high) / 2, band=high - low, samples=slice(0, n)
        )
    slack = 1e-3 * step
    low, high = np.maximum(low - slack, start), np.minimum(high + slack, start + (n - 1) * step)
    if not (low[used] < high[used]).all():
        raise InputError(
            "PVP FX1 .. FX2 does not meet the samples that SC0 and SCSS give in every vector; correct them"
        )
    df = float(step[used].min())
    first, last = _common(low[used], high[used])
    reference = used[0]
    places = (start - start[reference]) / df
    off = np.abs(places - np.rint(places))[used]
    if np.ptp(step[used]) * n < 1e-4 * df and off.max() < 1e-4:
        begin = int(np.ceil((first - start[reference]) / df - 1e-3))
        stop = int(np.floor((last - start[reference]) / df + 1e-3)) + 1
        _enough(stop - begin)
        shift = np.full(start.size, begin, dtype=np.int64)
        shift[used] -= np.rint(places[used]).astype(np.int64)
        return _Picked(frequency=start[reference] + df * np.arange(begin, stop), first=shift, used=used)
    inner, outer = np.zeros(start.size, np.int64), np.zeros(start.size, np.int64)
    inner[used] = np.ceil(((low - start) / step)[used] - 1e-9)
    outer[used] = np.floor(((high - start) / step)[used] + 1e-9)
    table, margin, error = _interpolators(float(step[used].max()) * delays.extent, int((outer - inner)[used].min()) + 1)
    first = max(first, float((start + (inner + margin) * step)[used].max()))
    last = min(last, float((start + (outer - margin) * step)[used].min()))
    count = int(np.floor((last - first) / df)) + 1
    _enough(count)
    return _Interpolated(
        frequency=np.asarray(first + df * np.arange(count), np.float64), start=start, step=step,
        first=inner, last=outer, samples=slice(int(inner[used].min()), int(outer[used].max()) + 1),
        table=table, margin=margin, middle=delays.middle, error=error,
    )  # fmt: skip


def _common(low: FloatArray, high: FloatArray) -> tuple[float, float]:
    """The band that all vectors have."""
    first, last, own = float(low.max()), float(high.min()), float(np.median(high - low))
    if last - first < LEAST_BAND * own:
        raise InputError(
            f"PVP FX1 and FX2 (within SC0 and SCSS) leave only {max(last - first, 0.0):.6g} Hz in common to all "
            f"vectors, of {own:.6g} Hz that one has; cut the collection into parts of like bands"
        )
    return first, last


def _enough(count: int) -> None:
    if count < 8:
        raise InputError(f"only {count} frequencies are common to all vectors; at least 8 are needed")


def _interpolators(occupancy: float, n: int) -> tuple[FloatArray, int, float]:
    """Least-squares interpolators of samples whose delays fill a share `occupancy` of the unambiguous ones.

    Returns
    -------
    table : (n_offset, taps) float
        For offsets of margin, margin + 1 / STEPS, ... samples from the first tap.
    margin : int
        Samples at either end within which no interpolator is good enough.
    error : float
        Largest over offsets and delays, for one target of reflectivity 1; between two offsets of the table, too.
    """
    taps = min(TAPS, n)
    i = np.arange(taps)
    gram = np.sinc(occupancy * (i[:, None] - i)) + 1e-8 * np.eye(taps)
    offset = np.arange((taps - 1) * STEPS + 1) / STEPS
    table = np.linalg.solve(gram, np.sinc(occupancy * (i[:, None] - offset))).T
    coarse = slice(None, None, STEPS // 16)
    cycles = occupancy / 2 * np.linspace(-1, 1, 129)
    got = table[coarse] @ _turn(i[:, None] * cycles)
    error = np.abs(_turn(offset[coarse, None] * cycles) - got).max(axis=1)
    good = (error <= ACCURACY) & (np.linalg.norm(table[coarse], axis=1) <= NOISE_GAIN)
    half = error.size // 2
    bad = np.flatnonzero(~good[: half + 1])
    margin = 0 if not bad.size else int(np.ceil((bad[-1] + 1) / 16))
    if margin >= taps // 2 - 1 or n < 2 * taps:
        raise InputError(
            f"PVP SC0 and SCSS differ from vector to vector, and the saved delays TOA1 .. TOA2 fill {occupancy:.3g} of "
            f"what {n} samples tell apart: too much to resample within {ACCURACY:g}; resample the vectors to one grid"
        )
    kept = slice(margin * STEPS, (taps - 1 - margin) * STEPS + 1)
    worst = float(error[margin * 16 : error.size - margin * 16].max())
    between = (np.pi * occupancy / STEPS) ** 2 / 8  # of linear interpolation in the table
    return table[kept], margin, worst + between


# ---------------------------------------------------------------- the beam


class _Beam(NamedTuple):
    azimuth: FloatArray  # (n_pulse,) rad; NaN: not steered
    width: float | None
    said: str


def _beam(file: _File, pulses: _Pulses, frame: Georeference, position: FloatArray) -> _Beam:
    """Beam-centre yaw from the polynomials of centre of dwell and dwell time, where they say one.

    The store's beam lights a target while |yaw - beam_azimuth| <= beam_width / 2, so that its centre of
    dwell is a matter of its yaw about the nadir at t = 0, and of nothing else. Where that holds over the image area,
    the yaw as a polynomial of the centre of dwell is beam_azimuth, continued to the ends of the collection.
    """
    nothing = np.full(pulses.time.size, np.nan)
    try:
        area, cod, dwell = _dwells(file)
    except InputError as error:
        return _Beam(nothing, None, f"beam not steered: dwell polynomials cannot be used ({error})")
    moment = pulses.reference_time
    whole = moment[-1] - moment[0]
    if dwell.min() >= FULL_DWELL * whole:
        return _Beam(nothing, None, "beam not steered: the whole image area is lit all the time")
    ground = frame.from_ecef(area)
    nadir = position[position.shape[0] // 2, :2]
    yaw = np.arctan2(ground[:, 1] - nadir[1], ground[:, 0] - nadir[0])
    turn = yaw[0] + np.mod(yaw - yaw[0] + np.pi, 2 * np.pi) - np.pi
    unsaid = "beam not steered, although targets dwell for a part of the time only: "
    if np.ptp(cod) < 0.05 * dwell.mean():
        return _Beam(nothing, None, f"{unsaid}the image area's centre of dwell hardly changes")
    scale = 2 / np.ptp(cod)
    u, ends = (cod - cod.mean()) * scale, (moment - cod.mean()) * scale
    fit, away = _yaw_of_time(u, turn)
    rate = abs(float(np.ptp(polynomial.polyval(u, fit)) / np.ptp(cod)))
    late = away / max(rate, 1e-30)
    half = dwell / 2 * scale
    widths = np.abs(polynomial.polyval(u + half, fit) - polynomial.polyval(u - half, fit))
    azimuth = polynomial.polyval(ends, fit)
    steps = np.diff(azimuth)
    if late > BEAM_TOLERANCE * dwell.mean() or np.ptp(widths) > 4 * BEAM_TOLERANCE * widths.mean():
        return _Beam(
            nothing, None,
            f"{unsaid}centre of dwell and dwell are no matter of yaw alone (they leave it by {late:.3g} s of "
            f"{dwell.mean():.3g} s, width by {np.ptp(widths) / widths.mean():.2g} of itself): amplitudes are low",
        )  # fmt: skip
    if not ((steps >= 0).all() or (steps <= 0).all()) or not np.abs(steps).max() <= widths.mean() < np.pi:
        return _Beam(nothing, None, f"{unsaid}the beam's yaw would turn back within the collection")
    degrees = np.degrees([azimuth[0], azimuth[-1], widths.mean()])
    return _Beam(
        np.asarray(azimuth), float(widths.mean()),
        f"beam steered from yaw {degrees[0]:.2f} to {degrees[1]:.2f} degrees, {degrees[2]:.2f} degrees wide, from the "
        f"dwell polynomials (good to {late:.2g} s)",
    )  # fmt: skip


def _yaw_of_time(u: FloatArray, yaw: FloatArray) -> tuple[FloatArray, float]:
    """Polynomial of the lowest order that serves, and the largest misfit, rad."""
    fits: list[tuple[FloatArray, float]] = []
    for order in range(1, 6):
        fit = polynomial.polyfit(u, yaw, order)
        fits.append((np.asarray(fit, np.float64), float(np.abs(polynomial.polyval(u, fit) - yaw).max())))
        if len(fits) > 1 and fits[-1][1] > fits[-2][1] / 4:
            return fits[-2]
    return fits[-1]


def _dwells(file: _File) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points of the image area, (n, 3) m Earth-centred, and their centre of dwell and dwell, (n,) s."""
    sarkit, root = library(), file.root
    parameters = _child(root, f"{{*}}Channel/{{*}}Parameters[{{*}}Identifier='{file.channel}']", "Channel/Parameters")
    if (parameters.findtext("{*}DwellTimes/{*}UseDTA") or "").strip() in ("true", "1"):
        raise InputError("the channel's dwell times are an array, not polynomials")
    tables = []
    for kind in ("COD", "Dwell"):
        name = _text(parameters, f"DwellTimes/{kind}Id")
        if "'" in name:
            raise InputError(f"DwellTimes/{kind}Id is {name!r}")
        node = _child(root, f"{{*}}Dwell/{{*}}{kind}Time[{{*}}Identifier='{name}']", f"Dwell/{kind}Time")
        tables.append(_polynomial(_child(node, f"{{*}}{kind}TimePoly", f"{kind}TimePoly")))
    own = parameters.find("{*}ImageArea")
    x, y = _area_points(own if own is not None else _child(root, "{*}SceneCoordinates/{*}ImageArea", "ImageArea"))
    cod, dwell = (polynomial.polyval2d(x, y, table) for table in tables)
    if not (np.isfinite(cod).all() and np.isfinite(dwell).all() and dwell.min() > 0):
        raise InputError("they are not finite and above 0 over the image area")
    ecef = np.asarray(sarkit.iac_to_ecf(file.tree, np.stack([x, y], axis=1)))
    return ecef, np.asarray(cod), np.asarray(dwell)


def _polynomial(node: Any) -> FloatArray:
    """Coefficients, (order + 1, order + 1)."""
    orders = [node.get(f"order{axis}", "") for axis in (1, 2)]
    if not all(text.isascii() and text.isdigit() and int(text) <= 32 for text in orders):
        raise InputError(f"a polynomial has the orders {orders}, but 0 to 32 are possible")
    table = np.zeros([int(text) + 1 for text in orders])
    for coefficient in node.findall("{*}Coef"):
        table[int(coefficient.get("exponent1")), int(coefficient.get("exponent2"))] = float(coefficient.text)
    return table


def _area_points(node: Any) -> tuple[FloatArray, FloatArray]:
    """x and y of points of the image area, m."""
    (x1, y1), (x2, y2) = (_numbers(node, corner, "XY") for corner in ("X1Y1", "X2Y2"))
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(x1, x2, 33), np.linspace(y1, y2, 33)))
    outline = node.find("{*}Polygon")
    if outline is None:
        return x, y
    corners = sorted(outline.findall("{*}Vertex"), key=lambda vertex: int(vertex.get("index")))
    if not 3 <= len(corners) <= 10_000:
        raise InputError(f"the image area's polygon has {len(corners)} corners")
    polygon = np.array([[float(corner.findtext(f"{{*}}{axis}")) for axis in "XY"] for corner in corners])
    inside = np.zeros(x.size, bool)
    for (ax, ay), (bx, by) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if ay != by:
            inside ^= ((ay > y) != (by > y)) & (x < (bx - ax) * (y - ay) / (by - ay) + ax)
    return np.concatenate([x[inside], polygon[:, 0]]), np.concatenate([y[inside], polygon[:, 1]])


# ---------------------------------------------------------------- ingest


def ingest(
    source: Location,
    out: Location,
    *,
    channel: str | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Ingested:
    """Turn one channel of a CPHD file into a phase-history store, block of vectors by block.

    Parameters
    ----------
    source : path
        A file of CPHD 1.0.1 or 1.1.0, monostatic, FX or TOA domain.
    out : path, URL or Place
        Of the store to make.
    channel : str, optional
        Identifier; may be left out where there is one only.
    overwrite : bool
        Replace a store that is there.
    progress : callable (done, total)
        Told after each block, in pulses.

    Raises
    ------
    InputError
        If the file is damaged, not supported or contradicts itself, or `out` exists and overwrite is False.
    """
    where = place(source)
    if not isinstance(where, LocalPlace):
        raise InputError(f"{where} is in an object store, from which CPHD files are not read; copy it to a file first")
    library()
    target = place(out)
    with _reading(where):
        if where.exists() and not where.path.is_file():
            raise InputError("it is no regular file; give the path of a CPHD file")
        # What a damaged number does to arithmetic, the checks find.
        with open(where.path, "rb") as stream, np.errstate(all="ignore"):
            file = _open(stream, where.path, channel)
            made = _prepare(file)
    write = _writer(file, made, progress)
    attributes = {**made.attributes, "history": stores.history_line(f"ingested by blocksar from {where.name}")}
    stores.create_phase_history(target, made.collection, attrs=attributes, overwrite=overwrite, fill=write)
    return Ingested(
        path=target.path if isinstance(target, LocalPlace) else target, collection=made.collection, said=made.said
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Prepared:
    collection: Collection
    pulses: _Pulses
    evening: _Evening | None
    resampler: _Resampler
    delays: _Delays
    attributes: dict[str, Any]
    said: list[str]


def _prepare(file: _File) -> _Prepared:
    """All but the samples."""
    frame = _frame(file)
    pulses = _pulses(file)
    lit = pulses.vector >= 0
    used = pulses.vector[lit]
    if used.size < 8:
        raise InputError(f"only {used.size} vectors hold a normal signal; at least 8 are needed")
    delays = _delays(file, used)
    resampler = _resampler(file, used, delays)
    away = np.linalg.norm(pulses.reference_point - frame.origin, axis=1)
    if away.max() > FARTHEST_SRP:
        raise InputError(
            f"PVP SRPPos lies up to {away.max():.6g} m from the scene's reference point; it must be Earth-centred, in m"
        )
    middle = np.zeros(pulses.vector.size)
    middle[lit] = delays.middle[used]
    middle[~lit] = np.interp(np.flatnonzero(~lit), np.flatnonzero(lit), middle[lit])
    reference = np.linalg.norm(pulses.position - pulses.reference_point, axis=1) + SPEED_OF_LIGHT / 2 * middle
    evening = None
    if not pulses.even:
        pulses, reference, evening = _evened(file, pulses, reference, _corners(file), float(resampler.frequency[-1]))
    position = frame.from_ecef(pulses.position)
    carrier = float(resampler.frequency[0] + resampler.frequency[-1]) / 2
    beam = _beam(file, pulses, frame, position)
    name = " ".join(
        filter(None, (file.root.findtext(f"{{*}}CollectionID/{{*}}{k}") for k in ("CollectorName", "CoreName")))
    )
    try:
        collection = Collection(
            carrier=carrier,
            time=pulses.time - pulses.time[pulses.time.size // 2],
            range_frequency=resampler.frequency - carrier,
            reference_range=reference,
            antenna_position=position,
            beam_azimuth=beam.azimuth,
            beam_width=beam.width,
            ground_height=0.0,
            title=printable(name)[:200],
        )
    except InputError as wrong:
        raise InputError(f"PVP TxPos, RcvPos, SRPPos, TOA1 and TOA2 make no phase history: {wrong}") from None
    bistatic = _bistatic(file, pulses, frame, collection.wavelength)
    start = (file.root.findtext("{*}Global/{*}Timeline/{*}CollectionStart") or "").strip()
    error = 0.0 if evening is None else float(evening.resampling.bound[evening.resampling.good].max())
    attributes = {
        **_collected(file),
        "georeference": frame.as_attribute(),
        "source": {
            "format": f"CPHD/{file.version}", "channel": file.channel, "domain": file.domain, "sgn": file.sign,
            "collection_start": printable(start)[:40],
            "time_zero": float(pulses.time[pulses.time.size // 2]),
            "transmit_receive_separation": pulses.separation, "bistatic_range_error": bistatic,
            "frequency_resampling_error": resampler.error,
            "slow_time_resampling_error": error,
        },
    }  # fmt: skip
    said = _lines(file, pulses, resampler, delays, bistatic, collection.wavelength)
    return _Prepared(
        collection=collection, pulses=pulses, evening=evening, resampler=resampler, delays=delays,
        attributes=attributes,
        said=[*said, *([evening.said] if evening else []), beam.said, _place_line(frame)],
    )  # fmt: skip


def _collected(file: _File) -> dict[str, Any]:
    """What products say of the collection: who collected it, how it is classified, and its polarization, if known."""
    parameters = f"{{*}}Channel/{{*}}Parameters[{{*}}Identifier='{file.channel}']/{{*}}Polarization"
    paths = {
        "collector": "{*}CollectionID/{*}CollectorName",
        "classification": "{*}CollectionID/{*}Classification",
        "transmit": f"{parameters}/{{*}}TxPol",
        "receive": f"{parameters}/{{*}}RcvPol",
    }
    found = {name: printable((file.root.findtext(path) or "").strip())[:200] for name, path in paths.items()}
    ends = {name: found.pop(name) for name in ("transmit", "receive")}
    known = {name: text for name, text in found.items() if text}
    return known | ({} if {"", "UNSPECIFIED"} & set(ends.values()) else {"polarization": ends})


def _frame(file: _File) -> Georeference:
    """At the IARP, which the file describes twice."""
    ecef = _numbers(file.root, "SceneCoordinates/IARP/ECF", "XYZ")
    latitude, longitude, height = _numbers(file.root, "SceneCoordinates/IARP/LLH", ("Lat", "Lon", "HAE"))
    told = Georeference(latitude=latitude, longitude=longitude, height=height)
    apart = float(np.linalg.norm(told.origin - ecef))
    if not apart < SAME_PLACE:
        raise InputError(
            f"SceneCoordinates/IARP has an ECF and an LLH that lie {apart:.6g} m apart; correct one of them"
        )
    return Georeference.at(ecef)


def _corners(file: _File) -> FloatArray:
    """Of the image area, (4, 3) m, Earth-centred."""
    (x1, y1), (x2, y2) = (_numbers(file.root, f"SceneCoordinates/ImageArea/{name}", "XY") for name in ("X1Y1", "X2Y2"))
    return np.asarray(library().iac_to_ecf(file.tree, np.array([[x, y] for x in (x1, x2) for y in (y1, y2)])))


def _bistatic(file: _File, pulses: _Pulses, frame: Georeference, wavelength: float) -> float:
    """Largest difference of bistatic and monostatic range at the image area's corners, m, less that at the SRP."""
    ground = _corners(file)
    worst = 0.0
    for vector in pulses.vector[pulses.vector >= 0][[0, -1]]:
        out, back, srp = (file.parameter(name)[vector] for name in ("TxPos", "RcvPos", "SRPPos"))
        all_points = np.concatenate([ground, srp[None]])
        two = (np.linalg.norm(all_points - out, axis=1) + np.linalg.norm(all_points - back, axis=1)) / 2
        error = two - np.linalg.norm(all_points - (out + back) / 2, axis=1)
        worst = max(worst, float(np.abs(error[:-1] - error[-1]).max()))
    if not worst <= MAX_BISTATIC * wavelength:
        raise InputError(
            f"PVP TxPos and RcvPos are up to {pulses.separation:.6g} m apart, which changes ranges over the image area "
            f"by {worst / wavelength:.3g} wavelengths: that is bistatic, and only monostatic collections are supported"
        )
    return worst


def _lines(
    file: _File, pulses: _Pulses, resampler: _Resampler, delays: _Delays, bistatic: float, wavelength: float
) -> list[str]:
    """What is to be said, in sentences."""
    frequency, n = resampler.frequency, pulses.vector.size
    missing = int(np.count_nonzero(pulses.vector < 0))
    own = float(np.median((file.parameter("FX2") - file.parameter("FX1"))[pulses.vector[pulses.vector >= 0]]))
    step = (frequency[-1] - frequency[0]) / (frequency.size - 1)
    lines = [
        f"CPHD {file.version}, channel {file.channel}: {file.shape[0]} vectors of {file.shape[1]} samples, "
        f"{file.domain} domain, SGN {file.sign:+d}",
        f"{n} pulses, {missing} of them missing; {frequency.size} frequencies, {frequency[0] / 1e9:.6g} .. "
        f"{frequency[-1] / 1e9:.6g} GHz ({step * frequency.size / 1e6:.6g} of {own / 1e6:.6g} MHz that a vector has)",
        f"transmitter and receiver up to {pulses.separation:.3g} m apart: their middle is taken, ranges over the image "
        f"area change by {bistatic / wavelength:.2g} wavelengths",
    ]
    match resampler:
        case _Interpolated():
            lines.append(
                f"SC0 and SCSS differ from vector to vector: resampled to one grid, error below {resampler.error:.2g} "
                f"of the reflectivity, {2 * resampler.margin} samples of the band's ends left out"
            )
        case _Transformed():
            lines.append("delays transformed to frequencies by an exact Fourier sum")
        case _:
            lines.append("samples are taken as they are")
    if np.ptp(pulses.reference_point, axis=0).max() > 0:
        moved = np.linalg.norm(np.ptp(pulses.reference_point, axis=0))
        lines.append(f"the SRP moves by {moved:.6g} m: reference_range follows it from pulse to pulse")
    if np.any(delays.middle):
        lines.append("the saved delays are not centred at the SRP: reference_range is at their middle")
    return lines


def _place_line(frame: Georeference) -> str:
    return (
        f"frame: x east, y north, z up at latitude {frame.latitude:.7f}, longitude {frame.longitude:.7f}, "
        f"height {frame.height:.2f} m"
    )


def _writer(file: _File, made: _Prepared, progress: Progress | None) -> Callable[[Place], None]:
    """What fills the store with samples."""
    vector, total = made.pulses.vector, made.pulses.vector.size
    columns = slice(0, made.resampler.frequency.size)
    scaled = "AmpSF" in (file.vectors.dtype.names or ())

    def samples(stream: BinaryIO, rows: IntArray) -> ComplexArray:
        """Of some vectors, ascending."""
        read = file.read(stream, int(rows[0]), int(rows[-1]) + 1, made.resampler.samples)[rows - rows[0]]
        if scaled:
            read *= file.parameter("AmpSF", rows).astype(np.float32)[:, None]
        if file.sign > 0:
            np.conjugate(read, out=read)
        out = made.resampler.apply(read, rows)
        middle = made.delays.middle[rows]
        if not middle.any():
            return out
        return (out * _turn(made.resampler.frequency * middle[:, None])).astype(np.complex64)

    def gathered(stream: BinaryIO, rows: IntArray) -> ComplexArray:
        out = np.empty((rows.size, columns.stop), np.complex64)
        for start in range(0, rows.size, PART):
            out[start : start + PART] = samples(stream, rows[start : start + PART])
        return out

    def write(store: Place) -> None:
        with _reading(LocalPlace(file.path)), open(file.path, "rb") as stream:
            for first in range(0, total, ROWS):
                pulses = slice(first, min(first + ROWS, total))
                if made.evening is None:
                    block = np.full((pulses.stop - first, columns.stop), complex(np.nan, np.nan), np.complex64)
                    lit = np.flatnonzero(vector[pulses] >= 0)
                    block[lit] = gathered(stream, vector[pulses][lit])
                else:
                    needed = made.evening.resampling.needs(pulses)
                    moved = 2 / SPEED_OF_LIGHT * made.resampler.frequency * made.evening.moved[needed, None]
                    rows = gathered(stream, made.evening.vector[needed])
                    block = made.evening.resampling.apply((rows * _turn(moved)).astype(np.complex64), pulses)
                stores.write_region(store, "signal", (pulses, columns), block)
                if progress is not None:
                    progress(pulses.stop, total)

    return write
