"""The AFRL Gotcha set's MATLAB files to a phase history.

Each file holds a struct `data`, one degree of a circular pass:

| field | shape | meaning |
|---|---|---|
| `fp` | (n_frequency, n_pulse) complex | phase history |
| `freq` | (n_frequency,) | absolute frequency, Hz |
| `x`, `y`, `z` | (n_pulse,) | antenna position about the scene's centre, m, z up |
| `r0` | (n_pulse,) | range to the scene's centre, m |
| `th`, `phi` | (n_pulse,) | azimuth and elevation of the antenna, degrees; checked against the position |
| `af` | struct | autofocus solution: range and phase a pulse |

Sign. fp is the sum over targets of sigma exp(-4j pi freq / c (R - r0)): the store's own convention. Back-projected as
exp(+4j pi freq / c (R - r0)) the measured scene stands as it was published. The conjugate gives its image in a point,
and over a few degrees just as sharp a one: it is the place of known objects that tells, not the focus.

Reference range. Positions and r0 come as float32, rounded to about half a millimetre each, and apart: r0 less the
distance of the recorded position from the centre is off by up to 0.7 mm, 0.3 rad of X-band phase. That distance
itself is taken instead, wherever the two differ by no more than rounding: then the centre has no phase at all, as
motion compensation left it, and what rounding does to positions cancels. The brightest points of the measured scene
gain 1.6 % in power by it.

Autofocus. `af` is not applied. Range and phase go together, r0 + r_correct with fp exp(j ph_correct) (either alone
destroys the image); of the 14 brightest points of the measured four degrees they make the brightest one 1 % brighter
in power and all others 5 to 9 % darker. The opposite signs make all darker. It follows one target, not the antenna.

Slow time. The files have no times. Pulses are numbered in the order of their azimuth, and the number times
PULSE_INTERVAL is the slow time: an image does not depend on that interval, which makes the speed of the aircraft a
plausible one. This asks only that the azimuth is a smooth function of the number. Where a pulse lies more than UNEVEN
steps off its neighbours' line, all pulses are resampled to uniform azimuth (`resampling`), after range compensation
to the centre, for echoes from as far out as the range window, or OCCUPIED of the mean PRF, lets in. Positions there
are those of the fitted track with what it lacks interpolated. A few pulses that are not there are missing pulses.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from blocksar import stores
from blocksar.foreign import Ingested, reading
from blocksar.geometry import TRACK_ACCURACY, Geometry, Track, fit_track
from blocksar.matfile import Value, read_struct
from blocksar.parameters import (
    SPEED_OF_LIGHT,
    UNIFORM_TOLERANCE,
    BoolArray,
    Collection,
    ComplexArray,
    FloatArray,
    InputError,
    IntArray,
)
from blocksar.places import LocalPlace, Location, Place, place
from blocksar.resampling import OCCUPIED, Resampling, plan_resampling

Progress = Callable[[int, int], None]

PULSE_INTERVAL = 0.01  # s, nominal: pulses a metre apart then come from an aircraft at 100 m/s
UNEVEN = 0.02  # steps that a pulse may lie off the line through its neighbours: 0.06 rad at half the PRF
MAX_GAP = 32  # pulses that may be missing in one place: a forgotten file leaves more
MAX_JUMP = 5.0  # times the usual way between two pulses that one may lie from the last: one pass has no more
ROUNDING = 2 * float(np.finfo(np.float32).eps)  # of a range: what float32 does to it and to three coordinates
ANGLE_TOLERANCE = 0.01  # degrees between th, phi and the position
LARGEST = 1e30  # of a sample: no echo, and its power would overflow
MAX_FILE = 1 << 28  # bytes: a degree has 400 kB
VECTORS = ("x", "y", "z", "r0")
OPTIONAL = ("th", "phi")
PASS = re.compile(r"pass(\d+)", re.IGNORECASE)  # in a file's name, which alone tells these two
POLARISATION = re.compile(r"(?<![A-Z])(HH|HV|VH|VV)(?![A-Z])", re.IGNORECASE)
TURN = 2 * np.pi


def ingest(
    source: Location | Sequence[Location],
    out: Location,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Ingested:
    """Join files in azimuth, in any order, into a phase-history store, some pulses at a time.

    Parameters
    ----------
    source : path, or sequence of paths
        MATLAB files of one pass and polarisation, whose azimuths meet, the full circle included.
    out : path, URL or Place
        Of the store to make.
    overwrite : bool
        Replace a store that is there.
    progress : callable (done, total)
        Told after each chunk, in pulses.

    Raises
    ------
    InputError
        If a file is damaged or no Gotcha file, files do not belong together, or `out` exists and overwrite is False.
    """
    sources = [source] if isinstance(source, str | os.PathLike | Place) else list(source)
    if not sources:
        raise InputError("source is empty; give at least one MATLAB file")
    files = [_look(place(path)) for path in sources]
    _check_company(files)
    made = _lay_out(_join(files))
    target = place(out)
    attributes = {**made.attributes, "history": stores.history_line(f"ingested by blocksar from {len(files)} files")}
    stores.create_phase_history(
        target, made.collection, attrs=attributes, overwrite=overwrite, fill=_writer(made, progress)
    )
    return Ingested(
        path=target.path if isinstance(target, LocalPlace) else target, collection=made.collection, said=made.said
    )


# ---------------------------------------------------------------- one file


@dataclass(frozen=True, kw_only=True, eq=False)
class _Contents:
    """What a file holds: samples (n_pulse, n_frequency), frequency (Hz), position (n_pulse, 3) and r0 (m)."""

    samples: ComplexArray
    frequency: FloatArray
    position: FloatArray
    r0: FloatArray
    autofocus: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class _File:
    """A file that was looked through: all but its samples, of which checksums are kept, one a pulse."""

    path: Place
    pass_: str
    polarisation: str
    frequency: FloatArray
    position: FloatArray
    r0: FloatArray
    autofocus: bool
    checksums: list[str]

    def samples(self) -> ComplexArray:
        """(n_pulse, n_frequency), read again.

        Raises
        ------
        InputError
            If the file has changed since.
        """
        with _reading(self.path):
            samples = _read(self.path).samples
            if _checksums(samples) != self.checksums:
                raise InputError("it changed while it was read; start again when nobody writes it")
        return samples


def _reading(path: Place) -> AbstractContextManager[None]:
    return reading(path, damaged="damaged", remedy="fetch it again")


def _look(path: Place) -> _File:
    with _reading(path):
        found = _read(path)
        checksums = _checksums(found.samples)
    return _File(
        path=path,
        pass_="".join(PASS.findall(path.name)[:1]),
        polarisation="".join(POLARISATION.findall(path.name)[-1:]).upper(),
        frequency=found.frequency,
        position=found.position,
        r0=found.r0,
        autofocus=found.autofocus,
        checksums=checksums,
    )


def _checksums(samples: ComplexArray) -> list[str]:
    return [stores.checksum(pulse) for pulse in samples]


def _read(path: Place) -> _Contents:
    """Read a file, and check it by itself."""
    fields = _fields(_bytes(path))
    frequency = _frequency(_numbers(fields, "freq"))
    samples = _samples(fields["fp"], frequency.size)
    n = samples.shape[0]
    vectors = {name: _numbers(fields, name, n) for name in VECTORS}
    position = np.stack([vectors[name] for name in "xyz"], axis=1)
    away = np.linalg.norm(position, axis=1)
    if not away.min() > 0:
        raise InputError(f"x, y and z are 0 at pulse {int(away.argmin())}; they must be the antenna's, in m")
    if not position[:, 2].min() > 0:
        raise InputError(f"z is {position[:, 2].min():.6g} m; it must be the antenna's height above the scene's centre")
    _check_angles(fields, position, away)
    window = SPEED_OF_LIGHT / (2 * (frequency[1] - frequency[0]))
    apart = np.abs(vectors["r0"] - away)
    if not apart.max() <= window / 2:
        where = int(apart.argmax())
        raise InputError(
            f"r0 is {vectors['r0'][where]:.8g} m at pulse {where}, but x, y and z lie {away[where]:.8g} m from the "
            f"scene's centre, more than half the range window of {window:.4g} m away; correct r0, or the position"
        )
    return _Contents(
        samples=samples, frequency=frequency, position=position, r0=vectors["r0"], autofocus="af" in fields
    )


def _bytes(path: Place) -> bytes:
    if isinstance(path, LocalPlace):
        status = os.stat(path.path)
        if not stat.S_ISREG(status.st_mode):
            raise InputError("it is no regular file; give the path of a MATLAB file")
        if status.st_size > MAX_FILE:
            raise InputError(f"it has {status.st_size} bytes, which no file of the set has; give one of those")
    return path.read_bytes()


def _fields(data: bytes) -> dict[str, Value]:
    """Fields of the struct `data`."""
    fields = read_struct(data, "data")
    missing = [name for name in ("fp", "freq", *VECTORS) if name not in fields]
    if missing:
        raise InputError(f"data has no field {', '.join(missing)}; give one of the set's own files")
    return fields


def _numbers(fields: dict[str, Value], name: str, count: int | None = None) -> FloatArray:
    """A vector of finite real numbers, one a pulse."""
    values = fields[name]
    if isinstance(values, str) or values.dtype.kind not in "iuf":
        raise InputError(f"{name} is {_called(values)}; it must be real numbers")
    if values.size != max(values.shape, default=0) or values.size == 0:
        raise InputError(f"{name} has shape {values.shape}; it must be a vector")
    if count is not None and values.size != count:
        raise InputError(f"{name} has {values.size} values, but fp has {count} pulses; make them agree")
    vector = values.astype(np.float64).ravel()
    if not np.isfinite(vector).all():
        where = int(np.argmin(np.isfinite(vector)))
        raise InputError(f"{name} is {vector[where]} at index {where}; it must be finite")
    return vector


def _called(values: Value) -> str:
    if isinstance(values, str):
        return values
    return "complex" if values.dtype.kind == "c" else f"of type {values.dtype}"


def _frequency(values: FloatArray) -> FloatArray:
    """The uniform grid of which the values are roundings."""
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
    """(n_pulse, n_frequency), finite."""
    if isinstance(values, str) or values.dtype.kind != "c":
        raise InputError(f"fp is {_called(values)}; it must be complex numbers")
    if values.ndim != 2 or values.shape[0] != n_frequency or values.shape[1] < 1:
        turned = " turned on its side" if values.shape[::-1][:1] == (n_frequency,) else ""
        raise InputError(
            f"fp has shape {values.shape}{turned}, but freq has {n_frequency} values; it must be frequency by pulse"
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


def _check_angles(fields: dict[str, Value], position: FloatArray, away: FloatArray) -> None:
    """Azimuth and elevation tell whether x, y and z are what their names say."""
    angles = {
        "th": np.degrees(np.arctan2(position[:, 1], position[:, 0])),
        "phi": np.degrees(np.arcsin(np.clip(position[:, 2] / away, -1, 1))),
    }
    for name in OPTIONAL:
        if name not in fields:
            continue
        told = _numbers(fields, name, away.size)
        apart = np.abs(np.mod(told - angles[name] + 180, 360) - 180)
        if apart.max() > ANGLE_TOLERANCE:
            where = int(apart.argmax())
            raise InputError(
                f"{name} is {told[where]:.6g} degrees at pulse {where}, but x, y and z say {angles[name][where]:.6g}; "
                "make them agree"
            )


# ---------------------------------------------------------------- files together


@dataclass(frozen=True, kw_only=True, eq=False)
class _Joined:
    """Pulses of all files in the order of their azimuth (rad, unwrapped): file and index in it, position, r0."""

    files: list[_File]
    file: IntArray
    index: IntArray
    azimuth: FloatArray
    position: FloatArray
    r0: FloatArray

    @property
    def step(self) -> float:
        """Of the azimuth, rad, where no pulse is missing."""
        return float(np.median(np.diff(self.azimuth)))


def _check_company(files: Sequence[_File]) -> None:
    """Refuse files of different collections."""
    first = files[0]
    step = first.frequency[1] - first.frequency[0]
    for other in files[1:]:
        for what, remedy in (("polarisation", "polarisation"), ("pass_", "pass")):
            ours, theirs = getattr(first, what), getattr(other, what)
            if ours and theirs and ours != theirs:
                raise InputError(
                    f"{other.path} is of {remedy} {theirs}, but {first.path} of {remedy} {ours}; ingest each {remedy} "
                    "by itself"
                )
        same = other.frequency.size == first.frequency.size
        if not same or np.abs(other.frequency - first.frequency).max() > UNIFORM_TOLERANCE * step:
            raise InputError(
                f"{other.path} has {_band(other.frequency)}, but {first.path} {_band(first.frequency)}; ingest files "
                "of one grid"
            )


def _band(frequency: FloatArray) -> str:
    return f"freq from {frequency[0]:.9g} to {frequency[-1]:.9g} Hz in {frequency.size} samples"


def _join(files: list[_File]) -> _Joined:
    """Order all pulses by azimuth, beginning after the largest gap of the circle; what is there twice goes once."""
    file = np.repeat(np.arange(len(files)), [len(f.checksums) for f in files])
    index = np.concatenate([np.arange(len(f.checksums)) for f in files])
    position, r0 = np.concatenate([f.position for f in files]), np.concatenate([f.r0 for f in files])
    azimuth = np.mod(np.arctan2(position[:, 1], position[:, 0]), TURN)
    if azimuth.size < 8:
        raise InputError(f"source holds {azimuth.size} pulses altogether; at least 8 are needed")
    order = np.lexsort((file, azimuth))
    ahead = np.append(np.diff(azimuth[order]), azimuth[order[0]] + TURN - azimuth[order[-1]])
    order = np.roll(order, -1 - int(ahead.argmax()))
    azimuth = np.unwrap(azimuth[order])
    file, index, position, r0 = file[order], index[order], position[order], r0[order]
    kept = _once(files, file, index, position)
    joined = _Joined(
        files=files, file=file[kept], index=index[kept], azimuth=azimuth[kept], position=position[kept], r0=r0[kept]
    )
    _check_runs(joined)
    return joined


def _once(files: Sequence[_File], file: IntArray, index: IntArray, position: FloatArray) -> BoolArray:
    """False for pulses that are there already: of the same place and with the same samples."""
    sums = [files[f].checksums[i] for f, i in zip(file, index, strict=True)]
    same = np.array([a == b for a, b in pairwise(sums)])
    return np.append(True, ~(same & (np.diff(position, axis=0) == 0).all(axis=1)))


def _check_runs(joined: _Joined) -> None:
    """Refuse files that lie over one another, two pulses in one place, gaps that a missing file leaves, and jumps."""
    degrees = np.degrees(joined.azimuth)

    def called(k: int) -> str:
        return f"{joined.files[joined.file[k]].path}"

    changes = np.flatnonzero(np.diff(joined.file)) + 1
    seen = {int(joined.file[0])}
    for k in changes.tolist():
        if int(joined.file[k]) in seen:
            raise InputError(
                f"{called(k)} and {called(k - 1)} overlap at azimuth {degrees[k]:.4f} degrees but hold different "
                "pulses there; leave out one, or ingest each by itself"
            )
        seen.add(int(joined.file[k]))
    steps = np.diff(joined.azimuth)
    if joined.azimuth.size < 8 or not steps.min() > 1e-6 * joined.step:
        where = int(steps.argmin()) if steps.size else 0
        raise InputError(
            f"{called(where)} has two different pulses at azimuth {degrees[where]:.4f} degrees, or fewer than 8 "
            "altogether; keep one of them in all fields"
        )
    gap = int(steps.argmax())
    if steps[gap] > (MAX_GAP + 1) * joined.step:
        raise InputError(
            f"{called(gap)} ends at azimuth {degrees[gap]:.3f} degrees and {called(gap + 1)} goes on at "
            f"{degrees[gap + 1]:.3f}: some {steps[gap] / joined.step:.0f} pulses are missing between; add the file "
            "that holds them, or ingest each side by itself"
        )
    way = np.linalg.norm(np.diff(joined.position, axis=0), axis=1)
    usual = float(np.median(way / np.maximum(np.rint(steps / joined.step), 1)))
    beyond = way / (np.maximum(steps / joined.step, 1) * usual)
    jump = int(beyond.argmax())
    if beyond[jump] > MAX_JUMP:
        apart = (
            f"{way[jump]:.4g} m apart at azimuth {degrees[jump]:.3f} degrees, where pulses are {usual:.3g} m from one "
            "another"
        )
        if joined.file[jump] == joined.file[jump + 1]:
            raise InputError(f"{called(jump)} has x, y and z {apart}; correct them, or split it there")
        raise InputError(
            f"{called(jump)} and {called(jump + 1)} lie {apart}, as files of two passes do; ingest each pass by itself"
        )


# ---------------------------------------------------------------- slow time, track and what there is to say


@dataclass(frozen=True, kw_only=True, eq=False)
class _Layout:
    """The store to be: its collection, and which joined pulse is which row, or how rows are made of them."""

    joined: _Joined
    collection: Collection
    rows: IntArray  # of the joined pulses, where these are not resampled
    resampling: Resampling | None
    attributes: dict[str, Any]
    said: list[str]


def _lay_out(joined: _Joined) -> _Layout:
    """Slow time, track and reference range of the store, and how its rows are made."""
    frequency = joined.files[0].frequency
    carrier = float(frequency[0] + frequency[-1]) / 2
    steps = np.diff(joined.azimuth) / joined.step
    rows = np.concatenate([[0], np.cumsum(np.maximum(np.rint(steps), 1))]).astype(np.int64)
    off = _unevenness(rows, steps)
    even = off <= UNEVEN
    place_ = rows.astype(np.float64) if even else (joined.azimuth - joined.azimuth[0]) / joined.step
    n = round(place_[-1]) + 1
    place_ *= (n - 1) / place_[-1]
    time, uniform = ((p - n // 2) * PULSE_INTERVAL for p in (place_, np.arange(n)))
    track = fit_track(time, joined.position, accuracy=TRACK_ACCURACY * SPEED_OF_LIGHT / carrier)
    position = _between(track, time, uniform)
    reference, reference_told = _reference_range(joined, time, uniform, position)
    radius = _window_radius(frequency, position)
    resampling, kept = None, slice(None)
    if even:
        told = f"azimuth is even to {off:.1g} steps, so that the pulse's number serves as slow time"
        missing = n - rows.size
    else:
        resampling, kept, within = _resampling(time, uniform, position, radius, float(frequency[-1]))
        told = _resampling_told(resampling, off, within)
        missing = int(np.count_nonzero(~resampling.good))
    n = uniform[kept].size
    collection = Collection(
        carrier=carrier,
        time=uniform[kept],
        range_frequency=frequency - carrier,
        reference_range=reference[kept],
        antenna_position=position[kept],
        beam_azimuth=np.full(n, np.nan),
        title=_title(joined),
    )
    said = [
        f"{len(joined.files)} files, {joined.azimuth.size} pulses; {collection.title}; {_band(frequency)}",
        f"slow time: {told}; its interval, {PULSE_INTERVAL:g} s, is nominal, as the files have no times",
        *([f"{missing} of {n} pulses are missing"] if missing else []),
        reference_told,
        _track_told(Geometry(collection=collection).track, collection, radius),
    ]
    if any(file.autofocus for file in joined.files):
        said.append("autofocus: the files' solution (af) is not applied, as it follows one target")
    return _Layout(
        joined=joined,
        collection=collection,
        rows=rows,
        resampling=resampling,
        attributes={"source": [file.path.name for file in joined.files], "ingested": said, **_polarization(joined)},
        said=said,
    )


def _title(joined: _Joined) -> str:
    first, last = np.degrees(joined.azimuth[[0, -1]])
    parts = ["AFRL Gotcha"]
    parts += [f"pass {p}" for p in sorted({f.pass_ for f in joined.files if f.pass_})]
    parts += sorted({f.polarisation for f in joined.files if f.polarisation})
    return ", ".join([*parts, f"azimuth {first:.2f} to {last:.2f} degrees"])


def _polarization(joined: _Joined) -> dict[str, Any]:
    """The attribute `polarization`, where the files' names tell it."""
    match sorted({f.polarisation for f in joined.files if f.polarisation}):
        case [both]:
            return {"polarization": {"transmit": both[0], "receive": both[1]}}
    return {}


def _unevenness(rows: IntArray, steps: FloatArray) -> float:
    """Largest distance of a pulse from the line through its two neighbours, in steps of azimuth."""
    before, after = np.diff(rows)[:-1], np.diff(rows)[1:]
    return float(np.abs((after * steps[:-1] - before * steps[1:]) / (before + after)).max())


def _between(track: Track, time: FloatArray, wanted: FloatArray) -> FloatArray:
    """Positions (n, 3) at other times: the polynomial's, and what it lacks by linear interpolation."""
    misfit = np.stack([np.interp(wanted, time, column) for column in track.misfit.T], axis=1)
    return track.position(wanted) + misfit


def _reference_range(
    joined: _Joined, time: FloatArray, uniform: FloatArray, position: FloatArray
) -> tuple[FloatArray, str]:
    """Range whose phase was removed, of the uniform pulses, and what there is to say of it."""
    away = np.linalg.norm(joined.position, axis=1)
    apart = joined.r0 - away
    largest = float(np.abs(apart).max())
    if largest <= ROUNDING * away.max():
        said = (
            f"reference range: the position's distance from the scene's centre; r0 differs by {1e3 * largest:.2g} mm "
            "at most, which is its rounding"
        )
        return np.linalg.norm(position, axis=1), said
    said = f"reference range: r0, which differs by up to {largest:.3g} m from the position's distance from the centre"
    return np.linalg.norm(position, axis=1) + np.interp(uniform, time, apart), said


def _window_radius(frequency: FloatArray, position: FloatArray) -> float:
    """Radius of the disc on the ground that the range window holds, m."""
    window = SPEED_OF_LIGHT / (2 * (frequency[1] - frequency[0]))
    middle = position[len(position) // 2]
    return float(window / 2 * np.linalg.norm(middle) / max(np.hypot(middle[0], middle[1]), 1e-9))


def _disc(radius: float) -> FloatArray:
    """Points on its edge, (16, 3) m."""
    angle = TURN * np.arange(16) / 16
    return radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(16)], axis=1)


def _resampling(
    time: FloatArray, uniform: FloatArray, position: FloatArray, radius: float, highest: float
) -> tuple[Resampling, slice, float]:
    """Weights of the pulses that are kept, which those are, and how far out echoes may lie, m."""
    away = np.linalg.norm(position, axis=1)
    ranges = np.stack([np.linalg.norm(position - point, axis=1) - away for point in _disc(radius)])
    extent = 2 * highest / SPEED_OF_LIGHT * 2 * float(np.abs(np.diff(ranges)).max()) / PULSE_INTERVAL
    band = min(extent, OCCUPIED / PULSE_INTERVAL)
    made = plan_resampling(time, uniform, band=band)
    good = np.flatnonzero(made.good)
    if good.size < max(8, made.good.size // 2):
        raise InputError(
            f"x and y put pulses so unevenly in azimuth that {made.good.size - good.size} of {made.good.size} uniform "
            "ones cannot be made of them; ingest the part where they are denser"
        )
    kept = slice(int(good[0]), int(good[-1]) + 1)  # ends that cannot be had are left out
    return made.part(kept), kept, radius * band / extent


def _resampling_told(made: Resampling, off: float, within: float) -> str:
    bound, spread = (20 * np.log10(error[made.good].max()) for error in (made.bound, made.spread))
    return (
        f"azimuth is uneven by up to {off:.2g} steps; pulses were resampled to {made.good.size} uniform ones, with an "
        f"error of at most {bound:.0f} dB on any echo within {within:.0f} m of the centre, {spread:.0f} dB r.m.s. over "
        "all of them"
    )


def _track_told(track: Track, collection: Collection, radius: float) -> str:
    """Order and misfit of the polynomial, and what is left of the misfit once it is corrected at the centre."""
    sight = -collection.antenna_position / np.linalg.norm(collection.antenna_position, axis=1, keepdims=True)
    left = 0.0
    for point in _disc(radius):
        other = point - collection.antenna_position
        other /= np.linalg.norm(other, axis=1, keepdims=True)
        left = max(left, float(np.abs(np.einsum("ij,ij->i", other - sight, track.misfit)).max()))
    phase = 4 * np.pi * collection.carrier / SPEED_OF_LIGHT * left
    return (
        f"track: a polynomial of order {track.order} misses the positions by at most {1e3 * track.max_misfit:.3g} mm; "
        f"kept as a correction of each pulse, that leaves {1e3 * left:.2g} mm ({phase:.2g} rad) {radius:.0f} m from "
        "the centre"
    )


# ---------------------------------------------------------------- samples


def _writer(made: _Layout, progress: Progress | None) -> Callable[[Place], None]:
    """What fills the store, chunk of pulses by chunk; of the files, only those of a chunk are in memory."""
    n, columns = made.collection.n_pulse, made.collection.n_range_frequency

    def write(store: Place) -> None:
        loaded: dict[int, ComplexArray] = {}
        for first in range(0, n, stores.TILE[0]):
            rows = slice(first, min(first + stores.TILE[0], n))
            if made.resampling is None:
                start, stop = np.searchsorted(made.rows, [rows.start, rows.stop])
                samples = np.full((rows.stop - rows.start, columns), complex(np.nan, np.nan), np.complex64)
                samples[made.rows[start:stop] - first] = _gather(made.joined, slice(start, stop), loaded)
            else:
                samples = made.resampling.apply(_gather(made.joined, made.resampling.needs(rows), loaded), rows)
            stores.write_region(store, "signal", (rows, slice(0, columns)), samples)
            if progress is not None:
                progress(rows.stop, n)

    return write


def _gather(joined: _Joined, pulses: slice, loaded: dict[int, ComplexArray]) -> ComplexArray:
    """Samples (n, n_frequency) of some joined pulses; `loaded` keeps the files that they lie in, and no others."""
    file, index = joined.file[pulses], joined.index[pulses]
    wanted = {int(f) for f in file}
    for name in set(loaded) - wanted:
        del loaded[name]
    out = np.empty((file.size, joined.files[0].frequency.size), np.complex64)
    for name in sorted(wanted):
        if name not in loaded:
            loaded[name] = joined.files[name].samples()
        out[file == name] = loaded[name][index[file == name]]
    return out
