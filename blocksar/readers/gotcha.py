"""MATLAB files of the AFRL Gotcha volumetric SAR data set: reader and conversion to a phase history.

Each file holds one degree of a circular pass. `blocksar/readers/README.md` lists its fields and gives the reasons for
the four decisions below, with figures from the measured scene.

- Sign: `fp` has the store's own sign; it is not conjugated.
- Reference range: the distance of the recorded position from the scene centre, where it agrees with `r0` to rounding.
- Autofocus: `af` is not applied.
- Slow time: pulses are numbered in the order of their azimuth; slow time is the number times PULSE_INTERVAL. Where a
  pulse lies more than UNEVEN steps off the line through its neighbours, all pulses are resampled to uniform azimuth.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from blocksar.arrays import UNIFORM_TOLERANCE, BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.chunks import TILE
from blocksar.collection.beam import NOT_STEERED
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import TRACK_ACCURACY, Geometry, Track, fit_track
from blocksar.constants import SPEED_OF_LIGHT, TURN
from blocksar.errors import InputError
from blocksar.places import Location, place
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place
from blocksar.places.ranges import Readable
from blocksar.readers.gotcha_files import KIND, ROUNDING, GotchaFile, read_headers
from blocksar.readers.kinds import Kind
from blocksar.readers.registry import Described, Piece, ReaderOptions, Reading, refuse_few
from blocksar.readers.resampling import OCCUPIED, Resampling, plan_resampling
from blocksar.texts import count, frequency_text, size_text

MAX_GAP = 32  # pulses that may be missing in one place; an omitted file leaves a larger gap
MAX_JUMP = 5.0  # largest distance between two pulses over the usual one; a single pass stays below it

SAME_PLACE = 1 / 32  # wavelengths: two polarisations' positions; those of float32 are rounded to half of that


@dataclass(frozen=True, kw_only=True, eq=False)
class Joined:
    """Pulses of all files in order of azimuth (rad, unwrapped): file, index in the file, position, r0."""

    files: list[GotchaFile]
    file: IntArray
    index: IntArray
    azimuth: FloatArray
    position: FloatArray
    r0: FloatArray

    @property
    def notes(self) -> list[str]:
        """Describe how many pulses were left out."""
        held = sum(len(file.checksums) for file in self.files)
        repeated = held - self.azimuth.size
        return [f"{repeated} of {held} pulses that repeat another: left out"] if repeated else []

    @property
    def step(self) -> float:
        """Azimuth step between pulses, rad, between which none is missing."""
        return float(np.median(np.diff(self.azimuth)))


def check_same_collection(files: Sequence[GotchaFile]) -> None:
    """Refuse files that differ in pass or frequency grid, with an InputError."""
    first = files[0]
    step = first.frequency[1] - first.frequency[0]
    for other in files[1:]:
        if first.pass_ and other.pass_ and first.pass_ != other.pass_:
            raise InputError(
                f"{other.path} is of pass {other.pass_}, but {first.path} of pass {first.pass_}; ingest each pass by "
                "itself"
            )
        same = other.frequency.size == first.frequency.size
        if not same or np.abs(other.frequency - first.frequency).max() > UNIFORM_TOLERANCE * step:
            raise InputError(
                f"{other.path} has {describe_band(other.frequency)}, but {first.path} "
                f"{describe_band(first.frequency)}; ingest files of one grid"
            )


def by_polarisation(files: Sequence[GotchaFile]) -> dict[str, list[GotchaFile]]:
    """Group files by polarisation, in alphabetical order; under one name if there is only one.

    Raises
    ------
    InputError
        If there are several, and the name of a file has none.
    """
    names = sorted({file.polarisation for file in files if file.polarisation})
    if len(names) < 2:
        return {names[0] if names else "": list(files)}
    for file in files:
        if not file.polarisation:
            raise InputError(
                f"{file.path} has no polarisation in its name, but others are of {' and '.join(names)}; rename it, "
                f"such as {names[0]}.mat, or ingest each polarisation by itself"
            )
    return {name: [file for file in files if file.polarisation == name] for name in names}


def check_same_geometry(channels: Mapping[str, Joined]) -> None:
    """Refuse polarisations whose pulses were taken at different places.

    Raises
    ------
    InputError
        If numbers of pulses differ, or a position or r0 by more than `SAME_PLACE` wavelengths.
    """
    (name, first), *others = channels.items()
    most = SAME_PLACE * SPEED_OF_LIGHT / float(first.files[0].frequency[-1])
    alone = "ingest each polarisation by itself"
    for other, joined in others:
        if joined.azimuth.size != first.azimuth.size:
            raise InputError(
                f"polarisation {other} has {joined.azimuth.size} pulses, but {name} {first.azimuth.size}; give the "
                f"same files of both, or {alone}"
            )
        for what, apart in (
            ("x, y and z", np.linalg.norm(joined.position - first.position, axis=1)),
            ("r0", np.abs(joined.r0 - first.r0)),
        ):
            where = int(apart.argmax())
            if apart[where] > most:
                raise InputError(
                    f"{what} of {other} and {name} differ by {apart[where]:.4g} m at azimuth "
                    f"{np.degrees(first.azimuth[where]):.4f} degrees, more than {1e3 * most:.2g} mm, so that they make "
                    f"no single image; {alone}"
                )


def describe_band(frequency: FloatArray) -> str:
    """Describe the frequency grid."""
    return f"freq from {frequency[0]:.9g} to {frequency[-1]:.9g} Hz in {frequency.size} samples"


def join(files: list[GotchaFile]) -> Joined:
    """Order all pulses by azimuth, starting after the largest gap of the circle, and drop duplicate pulses.

    Raises
    ------
    InputError
        If there are fewer than 8 pulses, files overlap, or a gap or jump between pulses is too large.
    """
    file = np.repeat(np.arange(len(files)), [len(f.checksums) for f in files])
    index = np.concatenate([np.arange(len(f.checksums)) for f in files])
    position, r0 = np.concatenate([f.position for f in files]), np.concatenate([f.r0 for f in files])
    azimuth = np.mod(np.arctan2(position[:, 1], position[:, 0]), TURN)
    if azimuth.size < 8:
        raise InputError(f"source holds {count(azimuth.size, 'pulse')} altogether; at least 8 are needed")
    order = np.lexsort((file, azimuth))
    ahead = np.append(np.diff(azimuth[order]), azimuth[order[0]] + TURN - azimuth[order[-1]])
    order = np.roll(order, -1 - int(ahead.argmax()))
    azimuth = np.unwrap(azimuth[order])
    file, index, position, r0 = file[order], index[order], position[order], r0[order]
    unique = _unique_pulses(files, file, index, position)
    joined = Joined(
        files=files,
        file=file[unique],
        index=index[unique],
        azimuth=azimuth[unique],
        position=position[unique],
        r0=r0[unique],
    )
    _check_sequence(joined)
    return joined


def _unique_pulses(files: Sequence[GotchaFile], file: IntArray, index: IntArray, position: FloatArray) -> BoolArray:
    """Mask of pulses that do not repeat the previous one: same position, same samples."""
    sums = [files[f].checksums[i] for f, i in zip(file, index, strict=True)]
    same = np.array([a == b for a, b in pairwise(sums)])
    return np.append(True, ~(same & (np.diff(position, axis=0) == 0).all(axis=1)))


def _check_sequence(joined: Joined) -> None:
    """Refuse overlapping files, two pulses at one azimuth, gaps as a missing file leaves them, and jumps."""
    degrees = np.degrees(joined.azimuth)

    def file_of(k: int) -> str:
        return f"{joined.files[joined.file[k]].path}"

    changes = np.flatnonzero(np.diff(joined.file)) + 1
    seen = {int(joined.file[0])}
    for k in changes.tolist():
        if int(joined.file[k]) in seen:
            raise InputError(
                f"{file_of(k)} and {file_of(k - 1)} overlap at azimuth {degrees[k]:.4f} degrees but hold different "
                "pulses there; leave out one, or ingest each by itself"
            )
        seen.add(int(joined.file[k]))
    steps = np.diff(joined.azimuth)
    if joined.azimuth.size < 8 or not steps.min() > 1e-6 * joined.step:
        where = int(steps.argmin()) if steps.size else 0
        raise InputError(
            f"{file_of(where)} has two different pulses at azimuth {degrees[where]:.4f} degrees, or fewer than 8 "
            "altogether; keep one of them in all fields"
        )
    gap = int(steps.argmax())
    if steps[gap] > (MAX_GAP + 1) * joined.step:
        raise InputError(
            f"{file_of(gap)} ends at azimuth {degrees[gap]:.3f} degrees and {file_of(gap + 1)} goes on at "
            f"{degrees[gap + 1]:.3f}: some {steps[gap] / joined.step:.0f} pulses are missing between; add the file "
            "that holds them, or ingest each side by itself"
        )
    distance = np.linalg.norm(np.diff(joined.position, axis=0), axis=1)
    usual = float(np.median(distance / np.maximum(np.rint(steps / joined.step), 1)))
    ratio = distance / (np.maximum(steps / joined.step, 1) * usual)
    jump = int(ratio.argmax())
    if ratio[jump] > MAX_JUMP:
        apart = (
            f"{distance[jump]:.4g} m apart at azimuth {degrees[jump]:.3f} degrees, where pulses are {usual:.3g} m "
            "from one another"
        )
        if joined.file[jump] == joined.file[jump + 1]:
            raise InputError(f"{file_of(jump)} has x, y and z {apart}; correct them, or split it there")
        raise InputError(
            f"{file_of(jump)} and {file_of(jump + 1)} lie {apart}, as files of two passes do; ingest each pass by "
            "itself"
        )


MOST_READ = 16  # files that are read; of more, the first and the last


def describe(files: Sequence[Readable], given: str) -> Described:
    """Read the headers of files of one pass.

    Raises
    ------
    InputError
        As `GotchaReader.read`.
    """
    places = [file for file in files if isinstance(file, Place)]
    if len(places) < len(files):
        raise InputError(f"{given} is a file of a web server; copy files of the Gotcha set to a local folder first")
    read = [read_headers(path) for path in (places if len(places) <= MOST_READ else [places[0], places[-1]])]
    azimuths = [np.degrees(np.arctan2(file.position[:, 1], file.position[:, 0])) for file in read]
    frequency = read[0].frequency
    position = np.concatenate([file.position for file in read])
    polarisations = sorted({file.polarisation for file in read if file.polarisation})
    passes = sorted({file.pass_ for file in read if file.pass_})
    size = sum(path.taken() for path in places if isinstance(path, LocalPlace))
    some = "" if len(read) == len(files) else "; the first and the last were read"
    rows = [("files", f"{len(files)}, {size_text(size)}{some}")]
    rows += [("pass", ", ".join(passes))] if passes else []
    rows += [("polarization", ", ".join(polarisations))] if polarisations else []
    rows += [
        ("azimuth", f"{azimuths[0].min():.2f} .. {azimuths[-1].max():.2f} degrees"),
        ("pulses", f"{sum(len(file.checksums) for file in read)} in the files that were read"),
        ("band", f"{frequency_text((frequency[0] + frequency[-1]) / 2)}; "
                 f"{frequency_text(frequency[-1] - frequency[0])} in {frequency.size} frequencies"),
        ("track", f"{np.linalg.norm(position, axis=1).mean():.5g} m from the scene's centre, "
                  f"{position[:, 2].mean():.5g} m above it"),
        ("beam", NOT_STEERED),
    ]  # fmt: skip
    what = "file" if len(files) == 1 else "folder"
    return Described(
        kind=f"{what} of the AFRL Gotcha set", rows=rows, command=["ingest", "gotcha", given, "--out", "gotcha.zarr"]
    )


PULSE_INTERVAL = 0.01  # s, nominal: pulses a metre apart then mean an aircraft at 100 m/s
UNEVEN = 0.02  # steps by which a pulse may lie off the line through its neighbours: 0.06 rad at half the PRF


def begin(sources: Sequence[Location], options: ReaderOptions) -> Reading:
    """Read everything but the samples of files that adjoin in azimuth, in any order, up to the full circle.

    Several polarisations become the channels of the store, if their pulses are at the same places.

    Raises
    ------
    InputError
        If a file is damaged or not a Gotcha file, or if files do not belong together.
    """
    if not sources:
        raise InputError("source is empty; give at least one MATLAB file")
    files = [read_headers(place(path)) for path in sources]
    check_same_collection(files)
    channels = {name: join(some) for name, some in by_polarisation(files).items()}
    check_same_geometry(channels)
    layout = lay_out(channels)
    return Reading(
        collection=replace(layout.collection, ground_height=options.ground_height),
        pieces=lambda: _pieces(layout),
        attributes={
            **layout.attributes, "source": {"format": "AFRL Gotcha", "files": [file.path.name for file in files]}
        },
        messages=lambda: layout.messages,
        channels=layout.names,
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class _Layout:
    """Layout of the new store: its collection, and the joined pulse of each row, or the rows' resampling.

    `names` are those of the channels; empty if there is one polarisation.
    """

    channels: tuple[Joined, ...]
    names: tuple[str, ...]
    collection: Collection
    rows: IntArray  # of the joined pulses, if they are not resampled
    resampling: Resampling | None
    attributes: dict[str, Any]
    messages: list[str]


def lay_out(channels: Mapping[str, Joined]) -> _Layout:
    """Determine slow time, track and reference range of the store, and how its rows are made from the pulses.

    They are those of the first channel.
    """
    joined, *_ = channels.values()
    names = tuple(channels) if len(channels) > 1 else ()
    files = [file for channel in channels.values() for file in channel.files]
    frequency = joined.files[0].frequency
    carrier = float(frequency[0] + frequency[-1]) / 2
    steps = np.diff(joined.azimuth) / joined.step
    rows = np.concatenate([[0], np.cumsum(np.maximum(np.rint(steps), 1))]).astype(np.int64)
    unevenness = _unevenness(rows, steps)
    even = unevenness <= UNEVEN
    number = rows.astype(np.float64) if even else (joined.azimuth - joined.azimuth[0]) / joined.step
    n = round(number[-1]) + 1
    number *= (n - 1) / number[-1]
    time, uniform = ((p - n // 2) * PULSE_INTERVAL for p in (number, np.arange(n)))
    track = fit_track(time, joined.position, accuracy=TRACK_ACCURACY * SPEED_OF_LIGHT / carrier)
    position = _interpolate_track(track, time, uniform)
    reference, reference_message = _reference_range(joined, time, uniform, position)
    radius = _window_radius(frequency, position)
    resampling, usable = None, slice(None)
    refuse_few(
        joined.azimuth.size, n, "most pulses are missing, by the steps in azimuth", "ingest files without the gaps"
    )
    if even:
        slow_time = f"azimuth is even to {unevenness:.1g} steps, so that the pulse's number serves as slow time"
        missing = n - rows.size
    else:
        resampling, usable, within = _plan_resampling(time, uniform, position, radius, float(frequency[-1]))
        slow_time = _describe_resampling(resampling, n, unevenness, within)
        missing = int(np.count_nonzero(~resampling.good))
    n = uniform[usable].size
    collection = Collection(
        carrier=carrier,
        time=uniform[usable],
        range_frequency=frequency - carrier,
        reference_range=reference[usable],
        antenna_position=position[usable],
        beam_azimuth=np.full(n, np.nan),
        title=_title(files, joined.azimuth),
    )
    each = f" in each of the channels {', '.join(names)}" if names else ""
    messages = [
        f"{count(len(files), 'file')}, {joined.azimuth.size} pulses{each}; {collection.title}; "
        f"{describe_band(frequency)}",
        *joined.notes,
        f"slow time: {slow_time}; its interval, {PULSE_INTERVAL:g} s, is nominal, as the files have no times",
        *([f"missing pulses: {missing} of {n}"] if missing else []),
        reference_message,
        _describe_track(Geometry(collection=collection).track, collection, radius),
    ]
    if any(file.autofocus for file in files):
        messages.append("autofocus: the files' solution (af) is not applied, as it follows one target")
    return _Layout(
        channels=tuple(channels.values()),
        names=names,
        collection=collection,
        rows=rows,
        resampling=resampling,
        attributes={"ingested": messages, **_polarization(list(channels))},
        messages=messages,
    )


def _title(files: Sequence[GotchaFile], azimuth: FloatArray) -> str:
    """Compose the store's title: passes, polarisations and azimuths."""
    first, last = np.degrees(azimuth[[0, -1]])
    parts = ["AFRL Gotcha"]
    parts += [f"pass {p}" for p in sorted({f.pass_ for f in files if f.pass_})]
    parts += sorted({f.polarisation for f in files if f.polarisation})
    return ", ".join([*parts, f"azimuth {first:.2f} to {last:.2f} degrees"])


def _polarization(names: Sequence[str]) -> dict[str, Any]:
    """The attribute `polarization`, or `polarizations` of several channels, if the files' names contain it."""
    known = {both: {"transmit": both[0], "receive": both[1]} for both in names if both}
    if len(known) > 1:
        return {"polarizations": known}
    return {"polarization": next(iter(known.values()))} if known else {}


def _unevenness(rows: IntArray, steps: FloatArray) -> float:
    """Largest distance of a pulse from the line through its neighbours, in azimuth steps."""
    before, after = np.diff(rows)[:-1], np.diff(rows)[1:]
    return float(np.abs((after * steps[:-1] - before * steps[1:]) / (before + after)).max())


def _interpolate_track(track: Track, time: FloatArray, uniform: FloatArray) -> FloatArray:
    """Interpolate positions (n, 3) at uniform times: the smooth track, plus its misfit linearly interpolated."""
    misfit = np.stack([np.interp(uniform, time, column) for column in track.misfit.T], axis=1)
    return track.position(uniform) + misfit


def _reference_range(
    joined: Joined, time: FloatArray, uniform: FloatArray, position: FloatArray
) -> tuple[FloatArray, str]:
    """Range of the removed phase at the uniform pulses, and a message about it."""
    distance = np.linalg.norm(joined.position, axis=1)
    difference = joined.r0 - distance
    largest = float(np.abs(difference).max())
    if largest <= ROUNDING * distance.max():
        message = (
            f"reference range: the position's distance from the scene's centre; r0 differs by {1e3 * largest:.2g} mm "
            "at most, which is its rounding"
        )
        return np.linalg.norm(position, axis=1), message
    message = (
        f"reference range: r0, which differs by up to {largest:.3g} m from the position's distance from the centre"
    )
    return np.linalg.norm(position, axis=1) + np.interp(uniform, time, difference), message


def _window_radius(frequency: FloatArray, position: FloatArray) -> float:
    """Radius, m, of the disc on the ground that fits into the range window."""
    window = SPEED_OF_LIGHT / (2 * (frequency[1] - frequency[0]))
    middle = position[len(position) // 2]
    return float(window / 2 * np.linalg.norm(middle) / max(np.hypot(middle[0], middle[1]), 1e-9))


def _disc(radius: float) -> FloatArray:
    """Points on the edge of a disc on the ground, (16, 3) m."""
    angle = TURN * np.arange(16) / 16
    return radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(16)], axis=1)


def _plan_resampling(
    time: FloatArray, uniform: FloatArray, position: FloatArray, radius: float, highest: float
) -> tuple[Resampling, slice, float]:
    """Plan weights of usable uniform pulses; return which these are, and the largest radius of echoes, m."""
    distance = np.linalg.norm(position, axis=1)
    ranges = np.stack([np.linalg.norm(position - point, axis=1) - distance for point in _disc(radius)])
    extent = 2 * highest / SPEED_OF_LIGHT * 2 * float(np.abs(np.diff(ranges)).max()) / PULSE_INTERVAL
    band = min(extent, OCCUPIED / PULSE_INTERVAL)
    resampling = plan_resampling(time, uniform, band=band)
    good = np.flatnonzero(resampling.good)
    refuse_few(
        good.size, resampling.good.size,
        "x and y place pulses so unevenly in azimuth that most uniform ones cannot be computed from them",
        "ingest the part where they are denser",
    )  # fmt: skip
    usable = slice(int(good[0]), int(good[-1]) + 1)  # without the pulses at the ends that cannot be computed
    return resampling.part(usable), usable, radius * band / extent


def _describe_resampling(resampling: Resampling, n: int, unevenness: float, within: float) -> str:
    """Describe the resampling to n pulses, except for those at the ends, and its errors."""
    bound, spread = (20 * np.log10(error[resampling.good].max()) for error in (resampling.bound, resampling.spread))
    return (
        f"azimuth is uneven by up to {unevenness:.2g} steps; pulses were resampled to {resampling.good.size} of {n} "
        f"uniform ones, with an error of at most {bound:.0f} dB on any echo within {within:.0f} m of the centre, "
        f"{spread:.0f} dB r.m.s. over all of them"
    )


def _describe_track(track: Track, collection: Collection, radius: float) -> str:
    """Describe the smooth track and its misfit, and the misfit that remains after correction at the centre."""
    sight = -collection.antenna_position / np.linalg.norm(collection.antenna_position, axis=1, keepdims=True)
    remaining = 0.0
    for point in _disc(radius):
        other = point - collection.antenna_position
        other /= np.linalg.norm(other, axis=1, keepdims=True)
        remaining = max(remaining, float(np.abs(np.einsum("ij,ij->i", other - sight, track.misfit)).max()))
    phase = 4 * np.pi * collection.carrier / SPEED_OF_LIGHT * remaining
    return (
        f"track: {track} misses the positions by at most {1e3 * track.max_misfit:.3g} mm; "
        f"kept as a correction of each pulse, that leaves {1e3 * remaining:.2g} mm ({phase:.2g} rad) {radius:.0f} m "
        "from the centre"
    )


def _pieces(layout: _Layout) -> Iterator[Piece]:
    """Iterate over samples by channel and chunk of pulses, with the files of one chunk in memory."""
    n = layout.collection.n_pulse
    for number, joined in enumerate(layout.channels):
        loaded: dict[int, ComplexArray] = {}
        for first in range(0, n, TILE[0]):
            pulses = slice(first, min(first + TILE[0], n))
            yield Piece(number, pulses, partial(_rows, layout, joined, pulses, loaded))


def _rows(layout: _Layout, joined: Joined, rows: slice, loaded: dict[int, ComplexArray]) -> ComplexArray:
    """Read rows of a channel of the store, (n, n_frequency); NaN for missing pulses."""
    if layout.resampling is not None:
        return layout.resampling.apply(_gather(joined, layout.resampling.inputs(rows), loaded), rows)
    start, stop = np.searchsorted(layout.rows, [rows.start, rows.stop])
    shape = (rows.stop - rows.start, layout.collection.n_range_frequency)
    samples = np.full(shape, complex(np.nan, np.nan), np.complex64)
    samples[layout.rows[start:stop] - rows.start] = _gather(joined, slice(start, stop), loaded)
    return samples


def _gather(joined: Joined, pulses: slice, loaded: dict[int, ComplexArray]) -> ComplexArray:
    """Read samples (n, n_frequency) of joined pulses; `loaded` keeps the files that hold them."""
    file, index = joined.file[pulses], joined.index[pulses]
    needed = {int(f) for f in file}
    for number in set(loaded) - needed:
        del loaded[number]
    out = np.empty((file.size, joined.files[0].frequency.size), np.complex64)
    for number in sorted(needed):
        if number not in loaded:
            loaded[number] = joined.files[number].samples()
        out[file == number] = loaded[number][index[file == number]]
    return out


class GotchaReader:
    """Reader of MATLAB files of the AFRL Gotcha volumetric SAR data set."""

    summary = (
        "Join MATLAB files of the AFRL Gotcha data set, in azimuth, into a phase history.\n\n"
        "The phase history keeps the scene-centred frame of the files."
    )
    example = "data_3dsar_pass1_az00*_HH.mat --out gotcha.zarr"
    source = "SOURCE.mat...", "MATLAB files of one pass, of one or more polarisations."
    several = True
    kind: Kind = KIND
    options = ReaderOptions

    def read(self, sources: Sequence[Location], options: ReaderOptions) -> Reading:
        return begin(sources, options)

    def describe(self, files: Sequence[Readable], given: str) -> Described:
        return describe(files, given)


GOTCHA = GotchaReader()
