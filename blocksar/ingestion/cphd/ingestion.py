"""Convert a CPHD file to a phase-history store: the sequence of steps, the scene frame, and messages for the user."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, BinaryIO

import numpy as np

from blocksar import stores
from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.chunks import TILE
from blocksar.collection.collection import Collection
from blocksar.collection.georeference import Georeference
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError, printable
from blocksar.ingestion.area import Cut, plan_cut
from blocksar.ingestion.cphd.beams import fit_beam
from blocksar.ingestion.cphd.channels import check_same_geometry, names_of, open_channels
from blocksar.ingestion.cphd.files import CphdFile, library, numbers_of, opened, reading_file
from blocksar.ingestion.cphd.samples import (
    Delays,
    Interpolated,
    Resampler,
    Transformed,
    choose_resampler,
    find_delays,
    phasor,
)
from blocksar.ingestion.cphd.vectors import Pulses, VectorResampling, assign_pulses, resample_vectors
from blocksar.ingestion.reading import WHOLE, Ingested, Part
from blocksar.places import Location, place, readable
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place
from blocksar.progress.listening import Callback

ROWS = TILE[0]  # pulses written at a time
PART = 64  # vectors resampled in frequency at a time
MAX_BISTATIC = 1 / 16  # wavelengths, largest difference between bistatic and monostatic range
FARTHEST_SRP = 1e6  # m, largest distance of the SRP from the IARP
PARTS = "--area, --pulses, --frequencies"
SAME_PLACE = 10.0  # m, largest distance between the two descriptions of the IARP


def ingest(
    source: Location,
    out: Location,
    *,
    channel: str | None = None,
    times: Mapping[str, Any] | None = None,
    part: Part = WHOLE,
    overwrite: bool = False,
    progress: Callback | None = None,
) -> Ingested:
    """Turn one channel of a CPHD file, or all of them, into a phase-history store, one block of vectors at a time.

    Parameters
    ----------
    source : path
        A file of CPHD 1.0 or 1.1, monostatic, FX or TOA domain.
    out : path, URL or Place
        Of the new store.
    channel : str, optional
        Identifier; optional if the file has only one. "all" makes a store with a channel for each of the file's, which
        must have one geometry.
    times : mapping, optional
        What `stated_times` gives, instead of the file's own.
    part : Part
        What of it is read.
    overwrite : bool
        Replace an existing store.
    progress : callable (done, total)
        Called after each block, with numbers of pulses.

    Raises
    ------
    InputError
        If the file is damaged, not supported or contradicts itself, or `out` exists and overwrite is False.
    """
    where, target = readable(source), place(out)
    library()
    # Damaged numbers may cause floating-point warnings; the checks report them.
    with reading_file(where), opened(where) as stream, np.errstate(all="ignore"):
        files = [file.part(part.pulses, part.frequencies) for file in open_channels(stream, where, channel)]
        prepared = [prepare(file, part) for file in files]
        names, attributes, messages = _combined(files, prepared)
    stores.refuse_full(target, prepared[0].collection, max(len(names), 1), f"read a part ({PARTS})")
    write = _writer(files, prepared, names, progress)
    attributes = {
        **attributes,
        "source": {**attributes["source"], **(times or {})},
        "history": stores.history_line(f"ingested by blocksar from {where.name}"),
    }
    collection = prepared[0].collection
    stores.create_phase_history(target, collection, channels=names, attrs=attributes, overwrite=overwrite, fill=write)
    return Ingested(
        path=target.path if isinstance(target, LocalPlace) else target, collection=collection, messages=messages
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Prepared:
    """The new store without its samples, and how to compute them."""

    collection: Collection
    pulses: Pulses
    slow_time: VectorResampling | None  # None if times are uniform
    resampler: Resampler
    delays: Delays
    cut: Cut | None  # None: not of an area
    attributes: dict[str, Any]
    messages: list[str]


def _combined(
    files: Sequence[CphdFile], prepared: Sequence[_Prepared]
) -> tuple[tuple[str, ...], dict[str, Any], list[str]]:
    """Names of the store's channels, none of a single one; its attributes; and messages about it.

    Raises
    ------
    InputError
        If the channels do not have one geometry.
    """
    first, *others = prepared
    if not others:
        return (), first.attributes, first.messages
    identifiers = [file.channel for file in files]
    notes = check_same_geometry(identifiers, [(each.collection, each.pulses) for each in prepared])
    polarizations = [each.attributes.get("polarization") for each in prepared]
    names = names_of(identifiers, polarizations)
    sources = [each.attributes["source"] for each in prepared]
    worst = {name: max(source[name] for source in sources) for name in first.attributes["source"] if "error" in name}
    attributes = {
        **{name: value for name, value in first.attributes.items() if name != "polarization"},
        "polarizations": {name: known for name, known in zip(names, polarizations, strict=True) if known},
        "source": {**sources[0], **worst, "channel": ", ".join(identifiers)},
    }
    listed = ", ".join(
        name if name == identifier else f"{name} ({printable(identifier)[:40]})"
        for name, identifier in zip(names, identifiers, strict=True)
    )
    more = [line for each in others for line in each.messages if line not in first.messages]
    return names, attributes, [f"channels {listed} have one geometry", *first.messages, *dict.fromkeys(more), *notes]


def prepare(file: CphdFile, part: Part = WHOLE) -> _Prepared:
    """Determine everything but the samples."""
    frame = _frame(file)
    pulses = assign_pulses(file)
    lit = pulses.vector >= 0
    used = pulses.vector[lit]
    if used.size < 8:
        raise InputError(f"only {used.size} vectors hold a normal signal; at least 8 are needed")
    delays = find_delays(file, used)
    resampler = choose_resampler(file, used, delays)
    srp_distance = np.linalg.norm(pulses.reference_point - frame.origin, axis=1)
    if srp_distance.max() > FARTHEST_SRP:
        raise InputError(
            f"PVP SRPPos lies up to {srp_distance.max():.6g} m from the scene's reference point; it must be "
            "Earth-centred, in m"
        )
    middle = np.zeros(pulses.vector.size)
    middle[lit] = delays.middle[used]
    middle[~lit] = np.interp(np.flatnonzero(~lit), np.flatnonzero(lit), middle[lit])
    reference = np.linalg.norm(pulses.position - pulses.reference_point, axis=1) + SPEED_OF_LIGHT / 2 * middle
    slow_time = None
    if not pulses.even:
        highest = float(resampler.frequency[-1])
        pulses, reference, slow_time = resample_vectors(pulses, reference, _corners(file), highest)
    position = frame.from_ecef(pulses.position)
    carrier = float(resampler.frequency[0] + resampler.frequency[-1]) / 2
    beam = fit_beam(file, pulses, frame, position, carrier)
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
            ground_height=part.ground_height,
            title=printable(name)[:200],
            **beam.antenna,
        )
    except InputError as error:
        raise InputError(f"PVP TxPos, RcvPos, SRPPos, TOA1 and TOA2 make no phase history: {error}") from None
    bistatic = _bistatic_error(file, pulses, collection.wavelength)
    attributes = {
        **_collected(file),
        "georeference": frame.as_attribute(),
        "source": _source(file, pulses, resampler, slow_time, bistatic),
    }
    messages = _describe(file, pulses, resampler, delays, bistatic, collection.wavelength)
    messages += [*([slow_time.message] if slow_time else []), *beam.messages, _describe_frame(frame)]
    cut = None if part.area is None else plan_cut(collection, part.area, pulses.vector >= 0)
    if cut is not None:
        attributes["source"] |= {"area": part.area, "time_zero": attributes["source"]["time_zero"] + cut.later}
        messages.append(cut.message)
    return _Prepared(
        collection=collection if cut is None else cut.collection, pulses=pulses, slow_time=slow_time,
        resampler=resampler, delays=delays, cut=cut, attributes=attributes, messages=messages,
    )  # fmt: skip


def _source(
    file: CphdFile, pulses: Pulses, resampler: Resampler, slow_time: VectorResampling | None, bistatic: float
) -> dict[str, Any]:
    """The attribute `source`: the origin of the data, and the errors of the conversion."""
    start = (file.root.findtext("{*}Global/{*}Timeline/{*}CollectionStart") or "").strip()
    return {
        "format": f"CPHD/{file.version}",
        "channel": file.channel,
        "domain": file.domain,
        "sgn": file.sign,
        "collection_start": printable(start)[:40],
        "time_zero": float(pulses.time[pulses.time.size // 2]),
        "transmit_receive_separation": pulses.separation,
        "bistatic_range_error": bistatic,
        "frequency_resampling_error": resampler.error,
        "slow_time_resampling_error": slow_time.error if slow_time else 0.0,
    }


def _collected(file: CphdFile) -> dict[str, Any]:
    """Attributes that products repeat: collector, classification and polarization, if known."""
    parameters = f"{{*}}Channel/{{*}}Parameters[{{*}}Identifier='{file.channel}']/{{*}}Polarization"
    paths = {
        "collector": "{*}CollectionID/{*}CollectorName",
        "classification": "{*}CollectionID/{*}Classification",
        "transmit": f"{parameters}/{{*}}TxPol",
        "receive": f"{parameters}/{{*}}RcvPol",
    }
    texts = {name: printable((file.root.findtext(path) or "").strip())[:200] for name, path in paths.items()}
    polarization = {name: texts.pop(name) for name in ("transmit", "receive")}
    known = {name: text for name, text in texts.items() if text}
    if {"", "UNSPECIFIED"} & set(polarization.values()):
        return known
    return known | {"polarization": polarization}


def _frame(file: CphdFile) -> Georeference:
    """The scene frame, at the IARP; its two descriptions in the file must agree."""
    ecef = numbers_of(file.root, "SceneCoordinates/IARP/ECF", "XYZ")
    latitude, longitude, height = numbers_of(file.root, "SceneCoordinates/IARP/LLH", ("Lat", "Lon", "HAE"))
    geodetic = Georeference(latitude=latitude, longitude=longitude, height=height)
    distance = float(np.linalg.norm(geodetic.origin - ecef))
    if not distance < SAME_PLACE:
        raise InputError(
            f"SceneCoordinates/IARP has an ECF and an LLH that lie {distance:.6g} m apart; correct one of them"
        )
    return Georeference.at(ecef)


def _corners(file: CphdFile) -> FloatArray:
    """Corners of the image area, (4, 3) m, Earth-centred."""
    (x1, y1), (x2, y2) = (
        numbers_of(file.root, f"SceneCoordinates/ImageArea/{name}", "XY") for name in ("X1Y1", "X2Y2")
    )
    return np.asarray(library().iac_to_ecf(file.tree, np.array([[x, y] for x in (x1, x2) for y in (y1, y2)])))


def _bistatic_error(file: CphdFile, pulses: Pulses, wavelength: float) -> float:
    """Largest difference of bistatic and monostatic range at the image area's corners, relative to the SRP, m."""
    ground = _corners(file)
    worst = 0.0
    for vector in pulses.vector[pulses.vector >= 0][[0, -1]]:
        transmitter, receiver, srp = (file.parameter(name)[vector] for name in ("TxPos", "RcvPos", "SRPPos"))
        points = np.concatenate([ground, srp[None]])
        bistatic = (np.linalg.norm(points - transmitter, axis=1) + np.linalg.norm(points - receiver, axis=1)) / 2
        error = bistatic - np.linalg.norm(points - (transmitter + receiver) / 2, axis=1)
        worst = max(worst, float(np.abs(error[:-1] - error[-1]).max()))
    if not worst <= MAX_BISTATIC * wavelength:
        raise InputError(
            f"PVP TxPos and RcvPos are up to {pulses.separation:.6g} m apart, which changes ranges over the image area "
            f"by {worst / wavelength:.3g} wavelengths: that is bistatic, and only monostatic collections are supported"
        )
    return worst


def _describe(
    file: CphdFile, pulses: Pulses, resampler: Resampler, delays: Delays, bistatic: float, wavelength: float
) -> list[str]:
    """Describe the file and what was done to it, one sentence each."""
    frequency, n = resampler.frequency, pulses.vector.size
    missing = int(np.count_nonzero(pulses.vector < 0))
    own = float(np.median((file.parameter("FX2") - file.parameter("FX1"))[pulses.vector[pulses.vector >= 0]]))
    step = (frequency[-1] - frequency[0]) / (frequency.size - 1)
    messages = [
        f"CPHD {file.version}, channel {file.channel}: {file.shape[0]} vectors of {file.shape[1]} samples, "
        f"{file.domain} domain, SGN {file.sign:+d}",
        f"{n} pulses, {missing} of them missing; {frequency.size} frequencies, {frequency[0] / 1e9:.6g} .. "
        f"{frequency[-1] / 1e9:.6g} GHz ({step * frequency.size / 1e6:.6g} of {own / 1e6:.6g} MHz that a vector has)",
        f"transmitter and receiver up to {pulses.separation:.3g} m apart: the point midway is used, which changes "
        f"ranges over the image area by {bistatic / wavelength:.2g} wavelengths",
    ]
    match resampler:
        case Interpolated():
            messages.append(
                f"SC0 and SCSS differ from vector to vector: resampled to one grid, error below {resampler.error:.2g} "
                f"of the reflectivity, {2 * resampler.margin} samples at the band's ends left out"
            )
        case Transformed():
            messages.append("delays transformed to frequencies by an exact Fourier sum")
        case _:
            messages.append("samples are taken as they are")
    if (more := file.unnamed // (file.shape[1] * file.dtype.itemsize)) > 0:
        messages.append(
            f"the signal block has room for {more} more such vectors behind its last array: if it is not padding, "
            "NumVectors in the XML is too small, and they are left out"
        )
    if np.ptp(pulses.reference_point, axis=0).max() > 0:
        moved = np.linalg.norm(np.ptp(pulses.reference_point, axis=0))
        messages.append(f"the SRP moves by {moved:.6g} m: reference_range follows it from pulse to pulse")
    if np.any(delays.middle):
        messages.append("the saved delays are not centred at the SRP: reference_range is at their middle")
    return messages


def _describe_frame(frame: Georeference) -> str:
    """The scene frame in words."""
    return (
        f"frame: x east, y north, z up at latitude {frame.latitude:.7f}, longitude {frame.longitude:.7f}, "
        f"height {frame.height:.2f} m"
    )


def _writer(
    files: Sequence[CphdFile], prepared: Sequence[_Prepared], names: Sequence[str], progress: Callback | None
) -> Callable[[Place], None]:
    """Make the function that fills the store with samples, channel by channel."""
    collection = prepared[0].collection
    total, columns = collection.n_pulse, slice(0, collection.n_range_frequency)

    def write(store: Place) -> None:
        for number, (file, each) in enumerate(zip(files, prepared, strict=True)):
            lead = (slice(number, number + 1),) if names else ()
            with reading_file(file.path), file.path.open() as stream:
                read: Callable[[slice], ComplexArray] = partial(_reader(file, each), stream)
                if each.cut is not None:
                    read = each.cut.reader(read, each.resampler.frequency)
                for first in range(0, total, ROWS):
                    pulses = slice(first, min(first + ROWS, total))
                    block = read(pulses)
                    stores.write_region(store, "signal", (*lead, pulses, columns), block[None] if lead else block)
                    if progress is not None:
                        progress(number * total + pulses.stop, len(files) * total)

    return write


def _reader(file: CphdFile, prepared: _Prepared) -> Callable[[BinaryIO, slice], ComplexArray]:
    """Make the function that reads samples of some pulses of a channel, on the store's frequencies."""
    vector, width = prepared.pulses.vector, prepared.resampler.frequency.size
    scaled = "AmpSF" in (file.vectors.dtype.names or ())

    def read_vectors(stream: BinaryIO, rows: IntArray) -> ComplexArray:
        """Samples of some vectors, ascending: (rows.size, width), scaled and of the store's sign and reference."""
        read = file.read(stream, int(rows[0]), int(rows[-1]) + 1, prepared.resampler.samples)[rows - rows[0]]
        if scaled:
            read *= file.parameter("AmpSF", rows).astype(np.float32)[:, None]
        if file.sign > 0:
            np.conjugate(read, out=read)
        out = prepared.resampler.apply(read, rows)
        middle = prepared.delays.middle[rows]
        if not middle.any():
            return out
        return (out * phasor(prepared.resampler.frequency * middle[:, None])).astype(np.complex64)

    def read_in_parts(stream: BinaryIO, rows: IntArray) -> ComplexArray:
        out = np.empty((rows.size, width), np.complex64)
        for start in range(0, rows.size, PART):
            out[start : start + PART] = read_vectors(stream, rows[start : start + PART])
        return out

    def read_pulses(stream: BinaryIO, pulses: slice) -> ComplexArray:
        if prepared.slow_time is None:
            block = np.full((pulses.stop - pulses.start, width), complex(np.nan, np.nan), np.complex64)
            lit = np.flatnonzero(vector[pulses] >= 0)
            block[lit] = read_in_parts(stream, vector[pulses][lit])
            return block
        slow_time = prepared.slow_time
        inputs = slow_time.resampling.inputs(pulses)
        cycles = 2 / SPEED_OF_LIGHT * prepared.resampler.frequency * slow_time.range_shift[inputs, None]
        rows = read_in_parts(stream, slow_time.vector[inputs])
        return slow_time.resampling.apply((rows * phasor(cycles)).astype(np.complex64), pulses)

    return read_pulses
