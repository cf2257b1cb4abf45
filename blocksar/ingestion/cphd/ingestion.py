"""A CPHD file to a phase-history store: the order of it all, the frame, and what there is to say."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np

from blocksar import stores
from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.chunks import TILE
from blocksar.collection.collection import Collection
from blocksar.collection.georeference import Georeference
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError, printable
from blocksar.ingestion.cphd.beams import beam_of
from blocksar.ingestion.cphd.files import CphdFile, library, numbers_of, open_file, reading_file
from blocksar.ingestion.cphd.samples import Delays, Interpolated, Resampler, Transformed, delays_of, resampler_of, turn
from blocksar.ingestion.cphd.vectors import Evening, Pulses, evened, pulses_of
from blocksar.ingestion.reading import Ingested
from blocksar.places import Location, place
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place
from blocksar.progress.listening import Callback

ROWS = TILE[0]  # pulses that are written at a time
PART = 64  # vectors that are brought to the grid at a time
MAX_BISTATIC = 1 / 16  # wavelengths between the bistatic and the monostatic range
FARTHEST_SRP = 1e6  # m from the IARP
SAME_PLACE = 10.0  # m between the two descriptions of the IARP


def ingest(
    source: Location,
    out: Location,
    *,
    channel: str | None = None,
    overwrite: bool = False,
    progress: Callback | None = None,
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
    with reading_file(where):
        if where.exists() and not where.path.is_file():
            raise InputError("it is no regular file; give the path of a CPHD file")
        # What a damaged number does to arithmetic, the checks find.
        with open(where.path, "rb") as stream, np.errstate(all="ignore"):
            file = open_file(stream, where.path, channel)
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
    pulses: Pulses
    evening: Evening | None
    resampler: Resampler
    delays: Delays
    attributes: dict[str, Any]
    said: list[str]


def _prepare(file: CphdFile) -> _Prepared:
    """All but the samples."""
    frame = _frame(file)
    pulses = pulses_of(file)
    lit = pulses.vector >= 0
    used = pulses.vector[lit]
    if used.size < 8:
        raise InputError(f"only {used.size} vectors hold a normal signal; at least 8 are needed")
    delays = delays_of(file, used)
    resampler = resampler_of(file, used, delays)
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
        pulses, reference, evening = evened(file, pulses, reference, _corners(file), float(resampler.frequency[-1]))
    position = frame.from_ecef(pulses.position)
    carrier = float(resampler.frequency[0] + resampler.frequency[-1]) / 2
    beam = beam_of(file, pulses, frame, position)
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


def _collected(file: CphdFile) -> dict[str, Any]:
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


def _frame(file: CphdFile) -> Georeference:
    """At the IARP, which the file describes twice."""
    ecef = numbers_of(file.root, "SceneCoordinates/IARP/ECF", "XYZ")
    latitude, longitude, height = numbers_of(file.root, "SceneCoordinates/IARP/LLH", ("Lat", "Lon", "HAE"))
    told = Georeference(latitude=latitude, longitude=longitude, height=height)
    apart = float(np.linalg.norm(told.origin - ecef))
    if not apart < SAME_PLACE:
        raise InputError(
            f"SceneCoordinates/IARP has an ECF and an LLH that lie {apart:.6g} m apart; correct one of them"
        )
    return Georeference.at(ecef)


def _corners(file: CphdFile) -> FloatArray:
    """Of the image area, (4, 3) m, Earth-centred."""
    (x1, y1), (x2, y2) = (
        numbers_of(file.root, f"SceneCoordinates/ImageArea/{name}", "XY") for name in ("X1Y1", "X2Y2")
    )
    return np.asarray(library().iac_to_ecf(file.tree, np.array([[x, y] for x in (x1, x2) for y in (y1, y2)])))


def _bistatic(file: CphdFile, pulses: Pulses, frame: Georeference, wavelength: float) -> float:
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
    file: CphdFile, pulses: Pulses, resampler: Resampler, delays: Delays, bistatic: float, wavelength: float
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
        case Interpolated():
            lines.append(
                f"SC0 and SCSS differ from vector to vector: resampled to one grid, error below {resampler.error:.2g} "
                f"of the reflectivity, {2 * resampler.margin} samples of the band's ends left out"
            )
        case Transformed():
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


def _writer(file: CphdFile, made: _Prepared, progress: Callback | None) -> Callable[[Place], None]:
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
        return (out * turn(made.resampler.frequency * middle[:, None])).astype(np.complex64)

    def gathered(stream: BinaryIO, rows: IntArray) -> ComplexArray:
        out = np.empty((rows.size, columns.stop), np.complex64)
        for start in range(0, rows.size, PART):
            out[start : start + PART] = samples(stream, rows[start : start + PART])
        return out

    def write(store: Place) -> None:
        with reading_file(LocalPlace(file.path)), open(file.path, "rb") as stream:
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
                    block = made.evening.resampling.apply((rows * turn(moved)).astype(np.complex64), pulses)
                stores.write_region(store, "signal", (pulses, columns), block)
                if progress is not None:
                    progress(pulses.stop, total)

    return write
