"""MATLAB files of the AFRL Gotcha set to a phase history.

Each file holds one degree of a circular pass. `blocksar/ingestion/README.md` lists its fields and gives the reasons for
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
from typing import Any

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.chunks import TILE
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import TRACK_ACCURACY, Geometry, Track, fit_track
from blocksar.constants import SPEED_OF_LIGHT, TURN
from blocksar.errors import InputError
from blocksar.ingestion.gotcha.files import ROUNDING, File, read_headers
from blocksar.ingestion.gotcha.joining import (
    Joined,
    by_polarisation,
    check_same_collection,
    check_same_geometry,
    describe_band,
    join,
)
from blocksar.ingestion.readers import Piece, ReaderOptions, Reading
from blocksar.ingestion.resampling import OCCUPIED, Resampling, plan_resampling
from blocksar.places import Location, place

PULSE_INTERVAL = 0.01  # s, nominal: pulses a metre apart then mean an aircraft at 100 m/s
UNEVEN = 0.02  # steps by which a pulse may lie off the line through its neighbours: 0.06 rad at half the PRF


def begin(sources: Sequence[Location], options: ReaderOptions) -> Reading:
    """Read all but the samples of files that adjoin in azimuth, in any order, up to the full circle.

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
    """The new store: its collection, and the row of each joined pulse, or how rows are resampled from them.

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
    """Determine slow time, track and reference range of the store, and how its rows follow from the pulses.

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
    if even:
        slow_time = f"azimuth is even to {unevenness:.1g} steps, so that the pulse's number serves as slow time"
        missing = n - rows.size
    else:
        resampling, usable, within = _plan_resampling(time, uniform, position, radius, float(frequency[-1]))
        slow_time = _describe_resampling(resampling, unevenness, within)
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
        f"{len(files)} files, {joined.azimuth.size} pulses{each}; {collection.title}; {describe_band(frequency)}",
        f"slow time: {slow_time}; its interval, {PULSE_INTERVAL:g} s, is nominal, as the files have no times",
        *([f"{missing} of {n} pulses are missing"] if missing else []),
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


def _title(files: Sequence[File], azimuth: FloatArray) -> str:
    """The store's title: passes, polarisations and azimuths."""
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
    """The largest distance of a pulse from the line through its two neighbours, in steps of azimuth."""
    before, after = np.diff(rows)[:-1], np.diff(rows)[1:]
    return float(np.abs((after * steps[:-1] - before * steps[1:]) / (before + after)).max())


def _interpolate_track(track: Track, time: FloatArray, uniform: FloatArray) -> FloatArray:
    """Positions (n, 3) at uniform times: those of the smooth track plus its linearly interpolated misfit."""
    misfit = np.stack([np.interp(uniform, time, column) for column in track.misfit.T], axis=1)
    return track.position(uniform) + misfit


def _reference_range(
    joined: Joined, time: FloatArray, uniform: FloatArray, position: FloatArray
) -> tuple[FloatArray, str]:
    """The range whose phase was removed, for the uniform pulses, and a message about it."""
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
    """Radius of the disc on the ground that the range window holds, m."""
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
    """Weights of the usable uniform pulses, which those are, and the largest radius of echoes, m."""
    distance = np.linalg.norm(position, axis=1)
    ranges = np.stack([np.linalg.norm(position - point, axis=1) - distance for point in _disc(radius)])
    extent = 2 * highest / SPEED_OF_LIGHT * 2 * float(np.abs(np.diff(ranges)).max()) / PULSE_INTERVAL
    band = min(extent, OCCUPIED / PULSE_INTERVAL)
    resampling = plan_resampling(time, uniform, band=band)
    good = np.flatnonzero(resampling.good)
    if good.size < max(8, resampling.good.size // 2):
        raise InputError(
            f"x and y place pulses so unevenly in azimuth that {resampling.good.size - good.size} of "
            f"{resampling.good.size} uniform ones cannot be computed from them; ingest the part where they are denser"
        )
    usable = slice(int(good[0]), int(good[-1]) + 1)  # without the pulses at the ends that cannot be computed
    return resampling.part(usable), usable, radius * band / extent


def _describe_resampling(resampling: Resampling, unevenness: float, within: float) -> str:
    """The resampling and its errors in words."""
    bound, spread = (20 * np.log10(error[resampling.good].max()) for error in (resampling.bound, resampling.spread))
    return (
        f"azimuth is uneven by up to {unevenness:.2g} steps; pulses were resampled to {resampling.good.size} uniform "
        f"ones, with an error of at most {bound:.0f} dB on any echo within {within:.0f} m of the centre, {spread:.0f} "
        "dB r.m.s. over all of them"
    )


def _describe_track(track: Track, collection: Collection, radius: float) -> str:
    """The smooth track and its misfit in words, and the misfit that remains once it is corrected at the centre."""
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
    """Samples by channels and chunks of pulses; only the files of one chunk are in memory."""
    n = layout.collection.n_pulse
    for number, joined in enumerate(layout.channels):
        loaded: dict[int, ComplexArray] = {}
        for first in range(0, n, TILE[0]):
            pulses = slice(first, min(first + TILE[0], n))
            yield Piece(number, pulses, _rows(layout, joined, pulses, loaded))


def _rows(layout: _Layout, joined: Joined, rows: slice, loaded: dict[int, ComplexArray]) -> ComplexArray:
    """Some rows of a channel of the store, (n, n_frequency); those of missing pulses are NaN."""
    if layout.resampling is not None:
        return layout.resampling.apply(_gather(joined, layout.resampling.inputs(rows), loaded), rows)
    start, stop = np.searchsorted(layout.rows, [rows.start, rows.stop])
    shape = (rows.stop - rows.start, layout.collection.n_range_frequency)
    samples = np.full(shape, complex(np.nan, np.nan), np.complex64)
    samples[layout.rows[start:stop] - rows.start] = _gather(joined, slice(start, stop), loaded)
    return samples


def _gather(joined: Joined, pulses: slice, loaded: dict[int, ComplexArray]) -> ComplexArray:
    """Samples (n, n_frequency) of some joined pulses; `loaded` is reduced to the files that hold them."""
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
