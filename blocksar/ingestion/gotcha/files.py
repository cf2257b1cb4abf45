"""One file of the Gotcha set: read its fields and check them."""

from __future__ import annotations

import os
import re
import stat
from contextlib import AbstractContextManager
from dataclasses import dataclass

import numpy as np

from blocksar import stores
from blocksar.arrays import UNIFORM_TOLERANCE, ComplexArray, FloatArray
from blocksar.collection.beam import wrapped
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.ingestion.found import refuse_others
from blocksar.ingestion.gotcha.matfile import Value, read_struct
from blocksar.ingestion.kinds import Kind
from blocksar.ingestion.reading import reading
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place

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
class File:
    """A file that has been read and checked, without its samples; their checksums are kept, one per pulse."""

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


def read_headers(path: Place) -> File:
    """Read and check a file; keep all but its samples.

    Raises
    ------
    InputError
        If the file is damaged or not one of the set.
    """
    with _reading(path):
        contents = read_file(path)
        checksums = _checksums(contents.samples)
    return File(
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
    """All bytes of a file that is not too large."""
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
    """The fields of the struct `data`, none of the required ones missing."""
    fields = read_struct(data, "data")
    missing = [name for name in ("fp", "freq", *VECTORS) if name not in fields]
    if missing:
        raise InputError(f"data has no field {', '.join(missing)}; give one of the set's own files")
    return fields


def _numbers(fields: dict[str, Value], name: str, count: int | None = None) -> FloatArray:
    """A field that must be a vector of finite real numbers, `count` of them."""
    values = fields[name]
    if isinstance(values, str) or values.dtype.kind not in "iuf":
        raise InputError(f"{name} is {_describe(values)}; it must be real numbers")
    if values.size != max(values.shape, default=0) or values.size == 0:
        raise InputError(f"{name} has shape {values.shape}; it must be a vector")
    if count is not None and values.size != count:
        raise InputError(f"{name} has {values.size} values, but fp has {count} pulses; make them agree")
    vector = values.astype(np.float64).ravel()
    if not np.isfinite(vector).all():
        where = int(np.argmin(np.isfinite(vector)))
        raise InputError(f"{name} is {vector[where]} at index {where}; it must be finite")
    return vector


def _describe(values: Value) -> str:
    """Find what a field holds, in words."""
    if isinstance(values, str):
        return values
    return "complex" if values.dtype.kind == "c" else f"of type {values.dtype}"


def _frequency(values: FloatArray) -> FloatArray:
    """The uniform grid that the values are, up to rounding."""
    if values.size < 8:
        raise InputError(f"freq has {values.size} values; at least 8 are needed")
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
