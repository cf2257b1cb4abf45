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

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from blocksar import stores
from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.chunks import TILE
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import TRACK_ACCURACY, Geometry, Track, fit_track
from blocksar.constants import SPEED_OF_LIGHT, TURN
from blocksar.errors import InputError
from blocksar.ingestion.gotcha.files import ROUNDING, read_headers
from blocksar.ingestion.gotcha.joining import Joined, band_text, check_company, join
from blocksar.ingestion.reading import Ingested
from blocksar.ingestion.resampling import OCCUPIED, Resampling, plan_resampling
from blocksar.places import Location, place
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place
from blocksar.progress.listening import Callback

PULSE_INTERVAL = 0.01  # s, nominal: pulses a metre apart then come from an aircraft at 100 m/s
UNEVEN = 0.02  # steps that a pulse may lie off the line through its neighbours: 0.06 rad at half the PRF


def ingest(
    source: Location | Sequence[Location],
    out: Location,
    *,
    overwrite: bool = False,
    progress: Callback | None = None,
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
    files = [read_headers(place(path)) for path in sources]
    check_company(files)
    made = _lay_out(join(files))
    target = place(out)
    attributes = {**made.attributes, "history": stores.history_line(f"ingested by blocksar from {len(files)} files")}
    stores.create_phase_history(
        target, made.collection, attrs=attributes, overwrite=overwrite, fill=_writer(made, progress)
    )
    return Ingested(
        path=target.path if isinstance(target, LocalPlace) else target, collection=made.collection, said=made.said
    )


# ---------------------------------------------------------------- slow time, track and what there is to say


@dataclass(frozen=True, kw_only=True, eq=False)
class _Layout:
    """The store to be: its collection, and which joined pulse is which row, or how rows are made of them."""

    joined: Joined
    collection: Collection
    rows: IntArray  # of the joined pulses, where these are not resampled
    resampling: Resampling | None
    attributes: dict[str, Any]
    said: list[str]


def _lay_out(joined: Joined) -> _Layout:
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
        f"{len(joined.files)} files, {joined.azimuth.size} pulses; {collection.title}; {band_text(frequency)}",
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


def _title(joined: Joined) -> str:
    first, last = np.degrees(joined.azimuth[[0, -1]])
    parts = ["AFRL Gotcha"]
    parts += [f"pass {p}" for p in sorted({f.pass_ for f in joined.files if f.pass_})]
    parts += sorted({f.polarisation for f in joined.files if f.polarisation})
    return ", ".join([*parts, f"azimuth {first:.2f} to {last:.2f} degrees"])


def _polarization(joined: Joined) -> dict[str, Any]:
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
    joined: Joined, time: FloatArray, uniform: FloatArray, position: FloatArray
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


def _writer(made: _Layout, progress: Callback | None) -> Callable[[Place], None]:
    """What fills the store, chunk of pulses by chunk; of the files, only those of a chunk are in memory."""
    n, columns = made.collection.n_pulse, made.collection.n_range_frequency

    def write(store: Place) -> None:
        loaded: dict[int, ComplexArray] = {}
        for first in range(0, n, TILE[0]):
            rows = slice(first, min(first + TILE[0], n))
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


def _gather(joined: Joined, pulses: slice, loaded: dict[int, ComplexArray]) -> ComplexArray:
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
