"""Raw echoes of satellites' strips: what their formats have in common.

Options, times of pulses, the strip that a format states as a phase history in a frame on the ellipsoid, and the reader
of such a format.

*Time.* While a pulse travels the antenna moves on, by v 2 R / c, some 40 m. Its echo is that of a still antenna at the
middle of this way: the sum of both distances exceeds twice that from there by (v R / c)^2 / R, half a millimetre. A
pulse sent at t belongs to the position at t + R / c (`RawStrip.moment`), with R that of the swath's middle; ground at
another range lies off by v (R - R_middle) / c along the track, which is told.

*Delays* in files count from the beginning of the transmission, as the samples do: the pulse's centre comes half its
length later, so that this is taken off. An atmosphere's delay d of one way makes all echoes come from d farther away,

    echo = chirp(t - 2 (R + d) / c) exp(-4j pi fc / c (R + d - reference)) ,

so that delays and reference are those of d less.

*Beam.* About the antenna's own axis, as wide as an antenna's of that length at half its power of one way, 0.886
wavelengths over length; where the length is not known, the Doppler band that 0.8 of the PRF holds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from functools import cached_property, partial
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.collection.collection import Collection
from blocksar.collection.georeference import Georeference, find_scene_centre
from blocksar.collection.raw_echo import RawEcho
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError, printable, quoted
from blocksar.ingestion.atmosphere import delay_words, slant_delay
from blocksar.ingestion.kinds import Kind
from blocksar.ingestion.orbit import Antenna, Orbit, OrbitTrack
from blocksar.ingestion.readers import Described, Piece, ReaderOptions, Reading
from blocksar.options import Option
from blocksar.places import Location, readable
from blocksar.places.ranges import Readable
from blocksar.spans import parse_pulses
from blocksar.stores import blocks_of
from blocksar.texts import count, frequency_text

# ---------------------------------------------------------------- options

TimeTags = Literal["transmit", "receive", "middle"]
TIME_TAGS = ("transmit", "receive", "middle")
POLARIZATIONS = tuple(transmit + receive for transmit in "HVLR" for receive in "HVLR")


def _read_polarization(value: Any) -> str | None:
    if value is None:
        return None
    if (text := str(value).upper()) not in POLARIZATIONS:
        raise InputError(f"--polarization is {quoted(value)}; give those of transmitter and receiver, such as HV")
    return text


def check_choices(options: Any, **choices: tuple[str, ...]) -> None:
    """Raise an InputError if an option is neither None nor one of its texts."""
    for option, values in choices.items():
        if (value := getattr(options, option)) not in (None, *values):
            raise InputError(f"--{option.replace('_', '-')} is {value!r}; it must be {' or '.join(values)}")


@dataclass(frozen=True, kw_only=True)
class PartOptions(ReaderOptions):
    """The part of a file that is wanted, and what its samples hold; see `ReaderOptions`.

    Attributes
    ----------
    polarization : str, optional
        Transmitter and receiver, such as "HV". Default: all of the first transmitter, as channels of the store.
    pulses : str or (int, int), optional
        Pulses "a:b" of the file that are read, from a to the one before b; either may be left out. Default: all.
    ground_height : float
        Height of the imaged ground above the ellipsoid, m, the z of its plane in the scene frame. Default: 0.
    troposphere : {"standard"}, optional
        Delay that the samples hold, and that is taken out: that of a standard atmosphere. Default: none.

    Raises
    ------
    InputError
        If the last has another value.
    """

    polarization: Annotated[
        str | None,
        Option("Transmitter and receiver.", metavar="HV", default="all of one transmitter, as channels",
               read=_read_polarization),
    ] = None  # fmt: skip
    pulses: Annotated[
        tuple[int, int | None],
        Option("Pulses that are read: A to the one before B.", metavar="A:B", default="all", read=parse_pulses),
    ] = (0, None)
    troposphere: Annotated[
        Literal["standard"] | None,
        Option("Delay to take out of the samples: that of a standard atmosphere.", metavar="standard", default="none",
               read=str),
    ] = None  # fmt: skip

    def __post_init__(self) -> None:
        check_choices(self, troposphere=("standard",))


@dataclass(frozen=True, kw_only=True)
class StripOptions(PartOptions):
    """Options where a format gives times of pulses and an orbit.

    Attributes
    ----------
    time_tags : {"transmit", "receive", "middle"}, optional
        What times of pulses are those of: the pulse's transmission, its first sample's reception, or the antenna at the
        middle of the echo's way. Default: of NISAR "transmit" if the file describes them so, else "middle"; of PALSAR
        "receive".

    Raises
    ------
    InputError
        If it has another value.
    """

    time_tags: Annotated[
        TimeTags | None,
        Option("What times of pulses are those of.", metavar="|".join(TIME_TAGS), default="by the file", read=str),
    ] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choices(self, time_tags=TIME_TAGS)


# ---------------------------------------------------------------- pulses

UNEVEN = 0.02  # of the interval, by which one may differ from a whole number of it
LONGEST_GAP = 4096  # pulses
LEAST = 16  # pulses of a constant PRF that are worth an image
WANDER = 0.1  # of the interval, by which a pulse may lie off an even axis; positions are taken where it is


class Even(NamedTuple):
    """Pulses at one PRF.

    Attributes
    ----------
    pulses : (n,) int
        Their numbers in the file.
    slots : (n,) int
        Their places on an even axis, from 0; what lies between is lost.
    time : (n_slot,) float
        Of all slots, s: that of the pulse, or in between.
    interval : float
        s.
    """

    pulses: IntArray
    slots: IntArray
    time: FloatArray
    interval: float

    def part(self, first: int, stop: int) -> tuple[IntArray, IntArray]:
        """The slots from one to before another that have a pulse, from the first on, and the pulses in the file."""
        low, high = np.searchsorted(self.slots, [first, stop])
        return self.slots[low:high] - first, self.pulses[low:high]

    def without(self, some: IntArray) -> Even:
        """Copy in which some pulses, by their place here, are lost; the axis stays."""
        return self._replace(pulses=np.delete(self.pulses, some), slots=np.delete(self.slots, some))


def even_pulses(time: FloatArray, interval: float | None = None) -> tuple[Even, list[str]]:
    """The longest part of pulses at times (n,), s, that has one PRF, and notes on what was left out or lost.

    Raises
    ------
    InputError
        If there is none, as where the PRF is dithered.
    """
    if time.size < LEAST or not np.isfinite(time).all():
        raise InputError(f"{time.size} pulses with finite times are left; at least {LEAST} are needed")
    steps = np.diff(time)
    usual = float(np.median(steps)) if interval is None else interval
    if not usual > 0 or (steps <= 0).any():
        raise InputError(f"times of pulses do not ascend at pulse {int(np.argmax(steps <= 0)) + 1}; give the file anew")
    whole = np.rint(steps / usual)
    fits = (whole >= 1) & (whole <= LONGEST_GAP) & (np.abs(steps - whole * usual) <= UNEVEN * usual)
    ends = np.flatnonzero(np.diff(np.concatenate([[0], fits, [0]])))
    first, last = ends.reshape(-1, 2)[np.argmax(np.diff(ends.reshape(-1, 2), axis=1))] if ends.size else (0, 0)
    if last - first + 1 < LEAST:
        raise InputError(
            f"intervals between pulses are {1e6 * steps.min():.6g} .. {1e6 * steps.max():.6g} us and change all the "
            "time (a dithered PRF), which no phase history holds; resample the echoes to even times first"
        )
    slots = np.concatenate([[0], np.cumsum(whole[first:last])]).astype(np.int64)
    kept = time[first : last + 1]
    step, start = np.polyfit(slots - slots[-1] / 2, kept - kept[0], 1) if slots[-1] else (usual, 0.0)
    even = kept[0] + start + step * (np.arange(slots[-1] + 1) - slots[-1] / 2)
    if np.abs(even[slots] - kept).max() > WANDER * step:
        raise InputError(
            f"times of pulses wander by {np.abs(even[slots] - kept).max() / step:.3g} intervals off an even axis; "
            "resample the echoes to even times first"
        )
    at = np.interp(np.arange(even.size), slots, kept - even[slots]) + even
    notes = []
    if kept.size < time.size:
        notes.append(
            f"the PRF changes: pulses {first} .. {last} of {time.size} have one of {1 / step:.6g} Hz and are taken; "
            "others with --pulses"
        )
    if lost := int(slots[-1] + 1 - slots.size):
        notes.append(f"{count(lost, 'pulse')} lost between these: missing in the store")
    return Even(np.arange(first, last + 1), slots, at, float(step)), notes


# ---------------------------------------------------------------- strips

PARTS = "--pulses, --polarization"
HALF_POWER = 0.886  # wavelengths over length: width of an evenly lit antenna's beam
BAND_OF_PRF = 0.8  # of the PRF, that the Doppler band of a beam of unknown width fills
TILTED = np.radians(10.0)  # an antenna's axis that lies farther off the track is none
SATELLITE = 1e5  # m: what flies higher
TOLD = 0.05  # m along the track that are worth a note

Rows = Callable[[int, IntArray], ComplexArray]  # samples of a channel at some pulses of the file


@dataclass(frozen=True, kw_only=True, eq=False)
class RawStrip:
    """Strip as a format states it: a raw echo with its orbit, attitude and radar.

    Attributes
    ----------
    title, format, collector : str
    epoch : datetime
        From which times count, UTC.
    even : Even
        The pulses that are taken, and their times, s.
    tags : TimeTags
        What the times are those of.
    orbit : Orbit or Track
    antenna : Antenna or None
    length : float or None
        Of the antenna, along the track, m.
    side : {"left", "right"}
    delay : (n_sample,) float
        Of the samples, from the beginning of the transmission, s.
    chirp_rate, pulse_width, carrier, sampling_rate : float
        Hz/s, s, Hz, Hz.
    polarizations : tuple of str
        One a channel, such as "HV".
    read : Rows
    notes : list of str
    steering : (n_slot,) float or None
        Of the beam's centre off the plane normal to the antenna's axis, rad; None: 0.
    origin : Georeference or None
        Of the scene frame; None: by the swath, on the ellipsoid.
    """

    title: str
    format: str
    collector: str
    epoch: datetime
    even: Even
    tags: TimeTags
    orbit: Orbit | OrbitTrack
    antenna: Antenna | None
    length: float | None
    side: str
    delay: FloatArray
    chirp_rate: float
    pulse_width: float
    carrier: float
    sampling_rate: float
    polarizations: tuple[str, ...]
    read: Rows
    notes: list[str] = field(default_factory=list)
    steering: FloatArray | None = None
    origin: Georeference | None = None

    def taking(self, tags: TimeTags | None) -> RawStrip:
        """Copy with what a user says of its times."""
        return self if tags is None else replace(self, tags=tags)

    @property
    def middle_range(self) -> float:
        """Of the swath, m: of the pulse's centre."""
        return SPEED_OF_LIGHT / 2 * (float(self.delay[0] + self.delay[-1]) / 2 - self.pulse_width / 2)

    @property
    def moment(self) -> FloatArray:
        """When the antenna is where an echo's way has its middle, of each slot, s (see the module)."""
        time = self.even.time
        if self.tags == "middle":
            return time
        later = self.middle_range / SPEED_OF_LIGHT
        return np.asarray(time + later - (float(self.delay[0]) if self.tags == "receive" else 0.0))

    @cached_property
    def track(self) -> tuple[FloatArray, FloatArray]:
        """Positions and velocities (n_slot, 3), Earth-centred, m and m/s."""
        return self.orbit.at(self.moment)

    @cached_property
    def axis(self) -> tuple[FloatArray, str | None]:
        """The antenna's axis along the flight (n_slot, 3), Earth-centred, and a note if it is not the file's."""
        _, velocity = self.track
        along = velocity / np.linalg.norm(velocity, axis=1, keepdims=True)
        if self.antenna is None:
            return along, "the file has no attitude; the beam is taken to look at right angles to the track"
        axis = self.antenna.at(self.moment)
        if axis is None:
            return along, "the attitude covers other times; the beam is taken to look at right angles to the track"
        cosine = float(np.mean((axis * along).sum(axis=1)))
        if abs(cosine) < np.cos(TILTED):
            return along, (
                f"by the attitude the antenna's axis lies {np.degrees(np.arccos(abs(cosine))):.3g} degrees off the "
                "track, which is not believed; the beam is taken to look at right angles to it"
            )
        return np.copysign(1.0, cosine) * axis, None

    @property
    def beam(self) -> tuple[float, str]:
        """Its full width, rad, and where that is from."""
        wavelength = SPEED_OF_LIGHT / self.carrier
        if self.length is not None:
            width = HALF_POWER * wavelength / self.length
            return width, f"half-power beam of an antenna {self.length:g} m long, {np.degrees(width):.3g} degrees"
        speed = float(np.linalg.norm(self.track[1], axis=1).mean())
        band = BAND_OF_PRF / self.even.interval
        width = 2 * float(np.arcsin(min(band * wavelength / (4 * speed), 1.0)))
        return width, (
            f"the length of the antenna is not known; a beam of {np.degrees(width):.3g} degrees is taken, whose "
            f"Doppler band fills {BAND_OF_PRF:g} of the PRF"
        )

    @cached_property
    def frame(self) -> Georeference:
        """About the ground at the middle of beam, swath and pulses, x away from the track: its default grid fits."""
        if self.origin is not None:
            return self.origin
        at = self.even.time.size // 2
        place = self.track[0][at]
        frame = find_scene_centre(
            place, self.axis[0][at], slant_range=self.middle_range, side=self.side, height=0.0, squint=0.0
        )
        east, north, _ = frame.east_north_up @ (frame.origin - place)
        return replace(frame, rotation=float(np.degrees(np.arctan2(north, east))))

    @property
    def surface(self) -> str:
        """The ground by default: under satellites the ellipsoid at the frame's height, else its plane."""
        return "ellipsoid" if float(self.frame.from_ecef(self.track[0][0])[2]) > SATELLITE else "plane"

    @cached_property
    def atmosphere(self) -> FloatArray:
        """Delay of a standard atmosphere at the swath's middle, of the first, middle and last slot, m of one way."""
        n = self.even.time.size
        return slant_delay(self.track[0][[0, n // 2, -1]], self.frame.origin, self.frame)

    def collection(self, options: PartOptions) -> tuple[Collection, RawEcho]:
        """The phase history without its samples."""
        removed = float(self.atmosphere.mean()) if options.troposphere else 0.0
        fast_time = self.delay - self.pulse_width / 2 - 2 * removed / SPEED_OF_LIGHT
        raw = RawEcho(
            fast_time=fast_time, chirp_rate=self.chirp_rate, pulse_width=self.pulse_width,
            sampling_rate=self.sampling_rate,
        )  # fmt: skip
        n, frame = self.even.time.size, self.frame
        collection = Collection(
            carrier=self.carrier,
            time=np.asarray(self.even.interval * (np.arange(n) - n // 2), np.float64),
            range_frequency=raw.range_frequency,
            reference_range=np.full(n, self.middle_range - removed),
            antenna_position=frame.from_ecef(self.track[0]),
            beam_azimuth=np.full(n, np.nan),
            beam_width=self.beam[0],
            beam_axis=self.axis[0] @ frame.axes.T,
            beam_steering=np.zeros(n) if self.steering is None else self.steering,
            side_of_track=self.side,
            ground_height=options.ground_height,
            title=self.title,
        )
        return collection, raw

    def attributes(self, options: PartOptions) -> dict[str, Any]:
        """Attributes of the store."""
        start = self.epoch + timedelta(seconds=float(self.moment[0]))
        source = {
            "format": self.format,
            "collection_start": f"{start.replace(tzinfo=None).isoformat(timespec='microseconds')}Z",
            "time_zero": self.even.interval * (self.even.time.size // 2),
            "time_tags": self.tags,
            **({"troposphere_removed": float(self.atmosphere.mean())} if options.troposphere else {}),
        }
        known = {each: _polarization(each) for each in self.polarizations if len(each) == 2}
        polarized: dict[str, Any] = {"polarizations": known} if known else {}
        if len(known) == 1:
            polarized = {"polarization": known[self.polarizations[0]]}
        return {
            "georeference": self.frame.as_attribute(), "source": source, "collector": printable(self.collector)[:200],
            "surface": self.surface, **polarized,
        }  # fmt: skip

    def _tagged(self) -> str:
        """At what times positions are taken, and what that leaves."""
        speed = float(np.linalg.norm(self.track[1], axis=1).mean())
        later, early = self.middle_range / SPEED_OF_LIGHT, float(self.delay[0]) - self.middle_range / SPEED_OF_LIGHT
        if isinstance(self.orbit, OrbitTrack):
            return "positions are midway between those of transmitter and receiver"
        if self.tags == "middle":
            return (
                "times are taken for those of the antenna's positions; if they are of transmission, say --time-tags "
                f"transmit, which moves the track by {speed * later:.3g} m"
            )
        what, way = "transmission", f"{later:.4g} s later"
        if self.tags == "receive":
            what, way = "the first sample's reception", f"{early:.4g} s earlier"
        off = speed * float(self.delay[-1] - self.delay[0]) / 4
        edges = f"; at the swath's edges places lie {off:.2g} m off along the track" if off > TOLD else ""
        return (
            f"times are those of {what}: positions are taken {way}, when the echo of the swath's middle has half its "
            f"way{edges}"
        )

    def remarks(self, options: PartOptions) -> list[str]:
        """Warnings for the user, a sentence each."""
        interval, n = self.even.interval, self.even.time.size
        taken = "taken out" if options.troposphere else "in the samples; --troposphere standard takes it out"
        note = self.axis[1]
        turned = f"x away from the track, {self.frame.rotation:.2f} degrees from east"
        turned = turned if self.origin is None else "x east, y north"
        return [
            f"{n} pulses at {1 / interval:.6g} Hz, {self.delay.size} samples at {frequency_text(self.sampling_rate)}; "
            f"delays of the file count from the pulse's start, those of the store from its centre",
            *self.notes,
            *([note] if note else []),
            f"beam: {self.beam[1]}",
            self._tagged(),
            f"the delay of a standard atmosphere, {delay_words(self.atmosphere)}, is {taken}",
            f"scene frame: {turned}, z up at latitude {self.frame.latitude:.6f}, longitude "
            f"{self.frame.longitude:.6f}, height {self.frame.height:.1f} m; the ground is "
            f"the {self.surface} by default",
        ]  # fmt: skip

    def reading(self, options: PartOptions) -> Reading:
        """Pieces that are still to be read."""
        collection, raw = self.collection(options)
        several = len(self.polarizations) > 1
        return Reading(
            collection=collection, raw=raw, pieces=lambda: _pieces(self), attributes=self.attributes(options),
            messages=lambda: self.remarks(options), channels=self.polarizations if several else (), parts=PARTS,
        )  # fmt: skip


def _polarization(text: str) -> dict[str, str]:
    """The attribute of a text such as HV; L and R are circular."""
    transmit, receive = ({"L": "LHC", "R": "RHC"}.get(each, each) for each in text)
    return {"transmit": transmit, "receive": receive}


def _pieces(strip: RawStrip) -> Iterator[Piece]:
    for channel in range(len(strip.polarizations)):
        for pulses in blocks_of(strip.even.time.size, strip.delay.size):
            yield Piece(channel, pulses, partial(_read, strip, channel, pulses))


def _read(strip: RawStrip, channel: int, pulses: slice) -> ComplexArray:
    """Samples of some slots, NaN where one is lost."""
    samples = np.full((pulses.stop - pulses.start, strip.delay.size), np.nan, np.complex64)
    slots, taken = strip.even.part(pulses.start, pulses.stop)
    if taken.size:
        samples[slots] = strip.read(channel, taken)
    return samples


def common_window(first: IntArray, stop: IntArray, most: int) -> tuple[slice, str | None]:
    """The samples that all pulses have, of those from first to before stop (n,) of most; and a note if some have more.

    Raises
    ------
    InputError
        If they are less than half of what a pulse has.
    """
    low, high = max(int(first.max()), 0), min(int(stop.min()), most)
    usual = int(np.median(stop - first))
    if high - low < usual / 2:
        raise InputError(
            f"receive windows of pulses have {max(high - low, 0)} samples in common, of {usual} that a pulse has; take "
            "pulses of one window with --pulses"
        )
    note = None
    if np.ptp(first) or np.ptp(stop):
        note = f"receive windows change; the {high - low} samples that all pulses have are taken"
    return slice(low, high), note


# ---------------------------------------------------------------- readers


@dataclass(frozen=True, kw_only=True)
class StripReader:
    """See `Reader`.

    Attributes
    ----------
    name : str
        Under which it is registered.
    title : str
        Of what `info` describes.
    begin : callable (files, options)
        Gives the strip that files state.
    """

    name: str
    title: str
    summary: str
    example: str
    source: tuple[str, str]
    kind: Kind
    options: type[PartOptions]
    begin: Callable[[Sequence[Readable], Any], RawStrip]
    several: bool = False

    def read(self, sources: Sequence[Location], options: PartOptions) -> Reading:
        return self.begin([readable(each) for each in sources], options).reading(options)

    def describe(self, files: Sequence[Readable], given: str) -> Described:
        """A strip, by what would be stored of it."""
        options = self.options()
        strip = self.begin(files if self.several else files[:1], options)
        stem = self.name if self.several else files[0].name.partition(".")[0]
        return Described(
            kind=self.title,
            rows=[
                ("title", strip.title),
                ("format", strip.format),
                ("channels", ", ".join(strip.polarizations)),
                ("samples", f"{strip.even.time.size} pulses x {strip.delay.size} samples"),
            ],
            command=["ingest", self.name, given, "--out", f"{stem}.zarr"],
            attributes=strip.attributes(options),
            collection=strip.collection(options)[0],
            notes=strip.remarks(options),
        )
