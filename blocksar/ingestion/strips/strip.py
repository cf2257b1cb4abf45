"""A satellite's raw echo, as formats state it, to a phase history in a frame on the ellipsoid.

*Time.* While a pulse travels the antenna moves on, by v 2 R / c, some 40 m. Its echo is that of a still antenna at the
middle of this way: the sum of both distances exceeds twice that from there by (v R / c)^2 / R, half a millimetre. A
pulse sent at t belongs to the position at t + R / c (`Strip.moment`), with R that of the swath's middle; ground at
another range lies off by v (R - R_middle) / c along the track, which is told.

*Delays* in files count from the beginning of the transmission, as the samples do: the pulse's centre comes half its
length later, so that this is taken off. An atmosphere's delay d of one way makes all echoes come from d farther away,

    echo = chirp(t - 2 (R + d) / c) exp(-4j pi fc / c (R + d - reference)) ,

so that delays and reference are those of d less.

*Beam.* About the antenna's own axis, as wide as an antenna's of that length at half its power of one way, 0.886
wavelengths over length; where the length is not known, the Doppler band that 0.8 of the PRF holds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from functools import cached_property, partial
from typing import Any

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.collection.collection import Collection
from blocksar.collection.georeference import Georeference, find_scene_centre
from blocksar.collection.raw_echo import RawEcho
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError, printable
from blocksar.ingestion.atmosphere import delay_words, slant_delay
from blocksar.ingestion.readers import Piece, Reading
from blocksar.ingestion.strips.options import PartOptions, TimeTags
from blocksar.ingestion.strips.orbit import Antenna, Orbit, Track
from blocksar.ingestion.strips.pulses import Even
from blocksar.stores import blocks_of
from blocksar.texts import frequency_text

PARTS = "--pulses, --polarization"
HALF_POWER = 0.886  # wavelengths over length: width of an evenly lit antenna's beam
BAND_OF_PRF = 0.8  # of the PRF, that the Doppler band of a beam of unknown width fills
TILTED = np.radians(10.0)  # an antenna's axis that lies farther off the track is none
SATELLITE = 1e5  # m: what flies higher
TOLD = 0.05  # m along the track that are worth a note

Rows = Callable[[int, IntArray], ComplexArray]  # samples of a channel at some pulses of the file


@dataclass(frozen=True, kw_only=True, eq=False)
class Strip:
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
    orbit: Orbit | Track
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

    def taking(self, tags: TimeTags | None) -> Strip:
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
        if isinstance(self.orbit, Track):
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
        """Find what a user should know, a sentence each."""
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
        """Find what is still to be read."""
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


def _pieces(strip: Strip) -> Iterator[Piece]:
    for channel in range(len(strip.polarizations)):
        for pulses in blocks_of(strip.even.time.size, strip.delay.size):
            yield Piece(channel, pulses, partial(_read, strip, channel, pulses))


def _read(strip: Strip, channel: int, pulses: slice) -> ComplexArray:
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
