"""CPHD files as a reader: options, and the conversion of a file to a phase history, with messages for the user.

*Sign.* With the wrong SGN an echo of the delay dTOA appears at -dTOA. Echoes lie in TOA1 .. TOA2; where that interval
is not centred at the SRP, a part of it is outside of its mirror image, and only one sign puts energy there (`echoes`).
A scene about the SRP is mirrored through its centre and says nothing, nor does the domain TOA, whose delays do not
depend on the sign.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.georeference import Georeference
from blocksar.collection.region import area_grid
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError, printable
from blocksar.options import Option
from blocksar.places import Location, readable
from blocksar.places.ranges import Readable
from blocksar.readers.cphd.areas import ImageArea, ecef_of, read_area
from blocksar.readers.cphd.beams import fit_beam
from blocksar.readers.cphd.channel_parts import check_same_geometry, names_of, open_channels
from blocksar.readers.cphd.echoes import ChannelEchoes, ChannelFindings, WindowEnergy, notes_of, read_samples
from blocksar.readers.cphd.files import KIND, CphdFile, library, numbers_of, open_file, opened, reading_file
from blocksar.readers.cphd.frequency_grid import (
    Delays,
    Interpolated,
    RangeWindow,
    Resampler,
    Selected,
    Transformed,
    Troposphere,
    choose_resampler,
    find_delays,
    find_troposphere,
)
from blocksar.readers.cphd.vectors import Pulses, VectorResampling, assign_pulses, describe_lost, resample_vectors
from blocksar.readers.kinds import Kind
from blocksar.readers.registry import Described, ReaderOptions, Reading
from blocksar.spans import parse_crop, parse_pulses, parse_span
from blocksar.texts import count, frequency_text, size_text

# ---------------------------------------------------------------- options


def _read_band(span: Any) -> tuple[float, float]:
    return parse_span(span, "--frequencies", "--frequencies 9.5e9:9.7e9")


def _read_area(crop: Any) -> tuple[tuple[float, float], tuple[float, float]]:
    return parse_crop(crop, "area")


@dataclass(frozen=True, kw_only=True)
class Choices(ReaderOptions):
    """Selected part of the file and corrections to its statements; see `ReaderOptions`.

    Attributes
    ----------
    channel : str, optional
        Identifier of the channel. Needed if the file has several. "all" makes a store with a channel for each of the
        file's, which must have the same geometry.
    pulses : str or (int, int), optional
        Vectors "a:b" of the file that are read, from a to the one before b; either may be left out. Default: all.
    frequencies : str or (float, float), optional
        Band "f1:f2" that is read, Hz; either may be left out. Default: all.
    area : str or ((float, float), (float, float)), optional
        Ground "x0:x1,y0:y1", m in the scene frame, that images will show: of pulses and frequencies only what it needs
        is kept, after low-passes that stop the echoes of all else. Default: all.
    ground_height : float
        Height z of the imaged plane in the scene frame, m. Default: 0, that of the file's reference point.
    sgn : {-1, 1}, optional
        Sign of the phase that the samples follow. Default: as declared.
    range_window : {"saved", "reference"}, optional
        The delays that are taken: those of TOA1 .. TOA2, or those about the reference point that the samples tell
        apart. Default: "saved", and refused if none of them is of the image area.
    troposphere : {"file", "standard"}, optional
        The troposphere's delay that the samples still hold, and that is taken out: that of TDTropoSRP, or that of a
        standard atmosphere. Default: none, as the standard has it.

    Raises
    ------
    InputError
        If one of the last three has another value.
    """

    channel: Annotated[
        str | None, Option("Channel to read, if the file has several; all: one store of all of them.", metavar="NAME")
    ] = None
    pulses: Annotated[
        tuple[int, int | None],
        Option("Vectors that are read: A to the one before B.", metavar="A:B", default="all", read=parse_pulses),
    ] = (0, None)
    frequencies: Annotated[
        tuple[float, float],
        Option("Band that is read, Hz.", metavar="F1:F2", default="all",
               read=_read_band),
    ] = (-math.inf, math.inf)  # fmt: skip
    area: Annotated[
        tuple[tuple[float, float], tuple[float, float]] | None,
        Option("Ground of the image, m: no more samples are kept than it needs.", metavar="x0:x1,y0:y1", default="all",
               read=_read_area),
    ] = None  # fmt: skip
    sgn: Annotated[int | None, Option("Sign SGN that the samples follow.", metavar="-1|+1", default="as declared")] = (
        None
    )
    range_window: Annotated[
        RangeWindow | None,
        Option("Delays to take: TOA1 .. TOA2, or those about the reference point that the samples tell apart.",
               metavar="saved|reference", default="saved, if the image area has any",
               read=str),
    ] = None  # fmt: skip
    troposphere: Annotated[
        Troposphere | None,
        Option("Delay to take out of samples that hold it: TDTropoSRP, or that of a standard atmosphere.",
               metavar="file|standard", default="none", read=str),
    ] = None  # fmt: skip

    def __post_init__(self) -> None:
        if self.sgn not in (None, -1, 1) or isinstance(self.sgn, bool):
            raise InputError(f"--sgn is {self.sgn!r}; it must be -1 or +1")
        for option, values in (("range_window", ("saved", "reference")), ("troposphere", ("file", "standard"))):
            if (value := getattr(self, option)) not in (None, *values):
                raise InputError(f"--{option.replace('_', '-')} is {value!r}; it must be {' or '.join(values)}")


# ---------------------------------------------------------------- from a file to a phase history

# Makers whose files were reported to declare +1 with samples that follow -1.
DOUBTED = ("capella",)


def describe_sign(energy: WindowEnergy | None, sign: int, collector: str, *, given: bool) -> str | None:
    """Describe a contradiction between samples and `sign`, or a known error of a collector's files; None if neither.

    Parameters
    ----------
    energy : WindowEnergy or None
        In TOA1 .. TOA2 with `sign`; None if delays do not depend on it.
    sign : int
        As taken: `given` by the user, or declared by the file.
    """
    conjugated = energy.conjugated if energy is not None else None
    if energy is not None and conjugated:
        return (
            f"SGN {sign:+d} contradicts the samples: in the part of TOA1 .. TOA2 that only one sign fills, their power "
            f"is {-energy.gain:.3g} dB lower with SGN {sign:+d} than with SGN {-sign:+d}; ingest again with --sgn "
            f"{-sign:+d}"
        )
    if conjugated is None and not given and sign > 0 and any(maker in collector.lower() for maker in DOUBTED):
        return (
            f"SGN +1 is doubtful: files of {collector} were seen to declare it with samples that follow -1, which "
            "mirrors the scene through its centre; compare places, and ingest again with --sgn -1 if so"
        )
    return None


MAX_BISTATIC = 1 / 16  # wavelengths, largest difference between bistatic and monostatic range
PARTS = "--area, --pulses, --frequencies"
SAME_PLACE = 10.0  # m, largest distance between the two descriptions of the IARP


def begin(source: Location, choices: Choices) -> Reading:
    """Read everything but the samples of a CPHD file: one channel, or all of them.

    Raises
    ------
    InputError
        If the file is damaged, not supported or contradicts itself.
    """
    where = readable(source)
    library()
    # Damaged numbers may cause floating-point warnings; the checks report them.
    with reading_file(where), opened(where) as stream, np.errstate(all="ignore"):
        prepared = [prepare(file, choices) for file in open_channels(stream, where, choices.channel)]
        names, attributes, notes = _combined(prepared)
    found: list[ChannelFindings] = []
    echoes = [each.echoes for each in prepared]
    noted = [notes_of(each) for each in echoes]

    def messages() -> list[str]:
        by_channel = [each.messages(some, choices) for each, some in zip(prepared, found, strict=True)]
        first, *others = by_channel
        more = dict.fromkeys(line for some in others for line in some if line not in first)
        return [*notes[:1], *first, *more, *notes[1:]]

    return Reading(
        collection=prepared[0].collection, pieces=lambda: read_samples(echoes, noted, found), attributes=attributes,
        messages=messages, channels=names, parts=PARTS, notes={str(k): notes for k, notes in enumerate(noted)},
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Prepared:
    """A new store without its samples, and how to compute these."""

    echoes: ChannelEchoes
    frame: Georeference
    bistatic: float  # m, see `_bistatic_error`
    attributes: dict[str, Any]
    notes: list[str]  # on delays, places and arrays
    beam: list[str]  # on the beam

    @property
    def collection(self) -> Collection:
        return self.echoes.stored

    def sign(self, energy: WindowEnergy | None, choices: Choices) -> str | None:
        """Describe a wrong or doubtful sign, see `describe_sign`; without `energy` by the collector alone."""
        collector = str(self.attributes.get("collector", "this maker"))
        return describe_sign(energy, self.echoes.file.sign, collector, given=choices.sgn is not None)

    def messages(self, found: ChannelFindings, choices: Choices) -> list[str]:
        """Describe the file and what was done to it, one sentence each."""
        file, pulses = self.echoes.file, self.echoes.pulses
        lost = describe_lost([*pulses.lost, *found.lost], file.first_vector)
        sign = self.sign(found.sign, choices)
        return [
            *_describe(self.echoes, found.missing, self.bistatic),
            *([f"lost vectors: {lost}; they are missing pulses, or left out at the ends"] if lost else []),
            *([sign] if sign else []),
            *self.notes,
            *self.beam,
            _describe_frame(self.frame),
        ]


def _combined(prepared: Sequence[Prepared]) -> tuple[tuple[str, ...], dict[str, Any], list[str]]:
    """Combine channels: their names (empty for one channel), attributes of the store, and notes.

    Raises
    ------
    InputError
        If the channels do not have one geometry.
    """
    first, *others = prepared
    if not others:
        return (), first.attributes, []
    identifiers = [each.echoes.file.channel for each in prepared]
    notes = check_same_geometry(identifiers, [(each.collection, each.echoes.pulses) for each in prepared])
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
    return names, attributes, [f"channels {listed} have one geometry", *notes]


def prepare(file: CphdFile, choices: Choices) -> Prepared:
    """Determine everything but the samples."""
    declared = file.sign
    file = replace(file.part(choices.pulses, choices.frequencies), sign=choices.sgn or declared)
    frame, area = _frame(file), read_area(file)
    pulses = assign_pulses(file, frame.origin)
    used = pulses.vector[pulses.vector >= 0]
    if used.size < 8:
        raise InputError(f"{count(used.size, 'vector')} with a normal signal; at least 8 are needed")
    delays = find_delays(file, used, area, choices.range_window)
    resampler = choose_resampler(file, used, delays)
    cell = SPEED_OF_LIGHT / 2 / float(resampler.frequency[-1] - resampler.frequency[0])
    troposphere = find_troposphere(file, used, frame, choices.troposphere, cell)
    reference = _reference_range(pulses, SPEED_OF_LIGHT / 2 * delays.middle - troposphere.removed)
    slow_time = None
    if not pulses.even:
        highest = float(resampler.frequency[-1])
        corners = ecef_of(file, area.corners)
        pulses, reference, slow_time = resample_vectors(pulses, reference, corners, highest)
    position = frame.from_ecef(pulses.position)
    carrier = float(resampler.frequency[0] + resampler.frequency[-1]) / 2
    beam = fit_beam(file, pulses, frame, position, carrier, area)
    try:
        collection = Collection(
            carrier=carrier,
            time=pulses.time - pulses.time[pulses.time.size // 2],
            range_frequency=resampler.frequency - carrier,
            reference_range=reference,
            antenna_position=position,
            beam_azimuth=beam.azimuth,
            beam_width=beam.width,
            ground_height=choices.ground_height,
            title=_title(file),
            **beam.antenna,
        )
    except InputError as error:
        raise InputError(f"PVP TxPos, RcvPos, SRPPos, TOA1 and TOA2 make no phase history: {error}") from None
    bistatic = _bistatic_error(file, pulses, area, collection.wavelength)
    echoes = ChannelEchoes(file=file, collection=collection, pulses=pulses, slow_time=slow_time, resampler=resampler,
                           delays=delays, area=choices.area)  # fmt: skip
    cut = echoes.cut
    removed = float(troposphere.removed[used].mean()) if choices.troposphere else None
    attributes = {
        **_collected(file),
        "georeference": frame.as_attribute(),
        "source": {
            **_source(file, pulses, resampler, slow_time, bistatic),
            **({"sgn_declared": declared} if file.sign != declared else {}),
            **({"range_window": choices.range_window} if choices.range_window else {}),
            **({"troposphere_removed": removed} if removed is not None else {}),
        },
    }
    if cut is not None:
        attributes["source"] |= {"area": choices.area, "time_zero": attributes["source"]["time_zero"] + cut.later}
    slow = [slow_time.message] if slow_time else []
    found_notes = [troposphere.message, area.message, _same_samples(file), cut.message if cut else None]
    corners = frame.from_ecef(ecef_of(file, area.corners))
    seen = [] if collection.steered else [_describe_area(Geometry(collection=echoes.stored.centred()), corners)]
    notes = [*delays.messages, *slow, *(text for text in found_notes if text), *seen]
    return Prepared(
        echoes=echoes, frame=frame, bistatic=bistatic, attributes=attributes, notes=notes, beam=beam.messages
    )


def _reference_range(pulses: Pulses, later: FloatArray) -> FloatArray:
    """Reference range of all pulses, m: the SRP's, plus `later` (n_vector,), m."""
    lit = np.flatnonzero(pulses.vector >= 0)
    after = np.interp(np.arange(pulses.vector.size), lit, later[pulses.vector[lit]])
    return np.asarray(np.linalg.norm(pulses.position - pulses.reference_point, axis=1) + after)


def _same_samples(file: CphdFile) -> str | None:
    """Note channels that hold the same samples."""
    if not file.same_samples:
        return None
    others = ", ".join(repr(name) for name in file.same_samples[:8])
    return (
        f"channel {file.channel!r} has the signal array of {others} as well, by SignalArrayByteOffset: these channels "
        "hold the same samples"
    )


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


def _title(file: CphdFile) -> str:
    names = (file.root.findtext(f"{{*}}CollectionID/{{*}}{name}") for name in ("CollectorName", "CoreName"))
    return printable(" ".join(filter(None, names)))[:200]


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


def _bistatic_error(file: CphdFile, pulses: Pulses, area: ImageArea, wavelength: float) -> float:
    """Largest difference, m, of bistatic and monostatic range at the area's corners, relative to the SRP."""
    ground = ecef_of(file, area.corners)
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


def _describe(echoes: ChannelEchoes, lost: int, bistatic: float) -> list[str]:
    """Describe the file and its samples, `lost` pulses of which are missing, one sentence each."""
    file, pulses, resampler = echoes.file, echoes.pulses, echoes.resampler
    frequency, n = resampler.frequency, pulses.vector.size
    missing = int(np.count_nonzero(pulses.vector < 0)) + lost
    own = float(np.median((file.parameter("FX2") - file.parameter("FX1"))[pulses.vector[pulses.vector >= 0]]))
    step = (frequency[-1] - frequency[0]) / (frequency.size - 1)
    messages = [
        f"CPHD {file.version}, channel {file.channel}: {file.shape[0]} vectors of {file.shape[1]} samples, "
        f"{file.domain} domain, SGN {file.sign:+d}",
        f"{n} pulses, {missing} of them missing; {frequency.size} frequencies, {frequency_text(frequency[0])} .. "
        f"{frequency_text(frequency[-1])} ({step * frequency.size / 1e6:.6g} of {own / 1e6:.6g} MHz that a vector has)",
        f"transmitter and receiver up to {pulses.separation:.3g} m apart: the point midway is used, which changes "
        f"ranges over the image area by {bistatic / echoes.collection.wavelength:.2g} wavelengths",
        _describe_resampling(resampler, echoes.delays),
    ]
    if (more := file.unnamed // (file.shape[1] * file.dtype.itemsize)) > 0:
        messages.append(
            f"the signal block has room for {more} more such vectors behind its last array: if it is not padding, "
            "NumVectors in the XML is too small, and they are left out"
        )
    if np.ptp(pulses.reference_point, axis=0).max() > 0:
        moved = np.linalg.norm(np.ptp(pulses.reference_point, axis=0))
        messages.append(f"the SRP moves by {moved:.6g} m: reference_range follows it from pulse to pulse")
    return messages


def _describe_resampling(resampler: Resampler, delays: Delays) -> str:
    """Describe how samples are converted to the store's frequencies."""
    match resampler:
        case Interpolated():
            message = (
                f"SC0 and SCSS differ from vector to vector: resampled to one grid, error below {resampler.error:.2g} "
                f"of the reflectivity, {2 * resampler.margin} samples at the band's ends left out"
            )
            if resampler.exact == 1:
                return message
            edge = SPEED_OF_LIGHT / 4 * delays.extent * (1 - resampler.exact)
            return f"{message}; but for the {edge:.4g} m of range at either end of the saved delays, where it is larger"
        case Transformed():
            return "delays transformed to frequencies by an exact Fourier sum"
        case Selected(off=off, error=error) if off:
            return (
                f"SC0 and SCSS differ from vector to vector by up to {off:.2g} of a sample: samples are taken as they "
                f"are, with an error of up to {error:.2g} rad at the ends of the saved delays, and none at their middle"
            )
    return "samples are taken as they are"


def _describe_area(geometry: Geometry, corners: FloatArray) -> str:
    """Describe the image area as a grid, from its corners (4, 3) in the scene frame, m."""
    (x0, y0), (x1, y1) = (end(corners[:, :2], axis=0).tolist() for end in (np.min, np.max))
    grid = area_grid(geometry, (x0, x1), (y0, y1))
    return f"the beam is not steered, so a run needs a grid: the image area is --grid='{grid.as_option}'"


def _describe_frame(frame: Georeference) -> str:
    """Describe the scene frame."""
    return (
        f"frame: x east, y north, z up at latitude {frame.latitude:.7f}, longitude {frame.longitude:.7f}, "
        f"height {frame.height:.2f} m"
    )


def describe(path: Readable, given: str) -> Described:
    """Read header, XML and per-vector parameters; several channels are described by the first.

    Raises
    ------
    InputError
        As `CphdReader.read`.
    """
    library()
    with reading_file(path), opened(path) as stream, np.errstate(all="ignore"):
        file = open_file(stream, path, None, any_channel=True)
        prepared = prepare(file, Choices())
        sign = prepared.sign(None, Choices())
        nodes = file.root.findall("{*}Data/{*}Channel")
        channels = [
            (node.findtext("{*}Identifier"), int(node.findtext("{*}NumVectors")), int(node.findtext("{*}NumSamples")))
            for node in nodes
        ]
        size = stream.seek(0, os.SEEK_END)
    first, several = channels[0][0], len(channels) > 1
    chosen = ["--channel", first] if several else []
    return Described(
        kind="CPHD file",
        rows=[
            ("title", prepared.collection.title),
            ("format", f"CPHD {file.version}, {file.domain} domain, {size_text(size)}"),
            ("channels", ", ".join(f"{name} ({n} vectors x {m} samples)" for name, n, m in channels)),
        ],
        command=["ingest", "cphd", given, *chosen, "--out", f"{path.name.partition('.')[0]}.zarr"],
        attributes=prepared.attributes,
        collection=prepared.collection,
        notes=[
            *([sign] if sign else []), *prepared.notes,
            *([f"what follows the channels is that of {first}"] if several else []),
        ],
    )  # fmt: skip


# ---------------------------------------------------------------- the reader


class CphdReader:
    """Reader of CPHD 1.0 and 1.1 (NGA.STND.0068)."""

    summary = "Convert a CPHD file to a phase history, in the tangent frame at its scene's reference point."
    example = "collect.cphd --out collect.zarr"
    source = "SOURCE.cphd", "CPHD file, version 1.0 or 1.1; or its URL."
    several = False
    kind: Kind = KIND
    options = Choices

    def read(self, sources: Sequence[Location], options: Choices) -> Reading:
        return begin(sources[0], options)

    def describe(self, files: Sequence[Readable], given: str) -> Described:
        return describe(files[0], given)


CPHD = CphdReader()
