"""A burst as a phase history: a raw echo in a frame on the ellipsoid.

*Time.* A packet has the time of the PRI in which its echo is received; the pulse was sent `rank` PRIs before. While it
travels the antenna moves on. A sample received s after the beginning of the transmission has, at a target's delay tau,
the phase of an antenna that stands still in the middle of its way, at s - tau / 2. Positions are those of the middle of
swath and pulse, s0 and u0 = T / 2 with the pulse's length T; the sample is of a moment

    (s - s0) / 2 + (u - u0) / 2 ,    u = s - tau ,

later. The first part is a delay in slow time, another for each column of samples: they are resampled to the moment of
the position (`resampling`), without which ground at the edges of IW1 would lie 0.7 m off along the track. The second
one is a Doppler frequency of half of the target's on the chirp, whose compressed peak it moves by -f / 2 K in delay:
echoes are put later by as much for the beam's centre, an even shift of a pulse's samples.

*Delays* count from the beginning of the pulse in packets, and to its centre in the store.

*Beam.* About the antenna's own axis by the attitude, ahead of broadside by the electronic law (`bursts`); the pattern
along the track is that of an evenly lit aperture as long as the antenna, sinc^2 both ways, out to half of its nulls.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, BinaryIO

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.georeference import Georeference, find_scene_centre
from blocksar.collection.raw_echo import RawEcho
from blocksar.constants import MIB, SPEED_OF_LIGHT
from blocksar.ingestion.atmosphere import slant_delay
from blocksar.ingestion.readers import Piece, Reading
from blocksar.ingestion.reading import reading
from blocksar.ingestion.sentinel1.ancillary import Attitude
from blocksar.ingestion.sentinel1.bursts import Burst, Steering
from blocksar.ingestion.sentinel1.files import DAMAGED, REMEDY, File
from blocksar.ingestion.sentinel1.gps import utc
from blocksar.ingestion.sentinel1.options import Sentinel1Options
from blocksar.ingestion.sentinel1.packets import CARRIER, Packets
from blocksar.ingestion.sentinel1.resampling import Resampling
from blocksar.ingestion.sentinel1.samples import read_samples
from blocksar.ingestion.strips.orbit import Orbit
from blocksar.kernels.fourier import fast_length, fft_rows, unit_phasor

APERTURE = 12.3  # m, length of the antenna
PATTERN_SAMPLES = 65
SIDE = "right"
PARTS = "--swath, --bursts"
AT_ONCE = 16 * MIB  # bytes of samples
UNMOVED = 1e-3  # of a sample


@dataclass(frozen=True, kw_only=True, eq=False)
class Data:
    """Facts that the bursts of a data take have in common."""

    options: Sentinel1Options
    zero: int
    orbit: Orbit
    attitude: Attitude | None
    steering: Mapping[str, Steering]

    def moment(self, burst: Burst) -> FloatArray:
        """When the antenna is where the pulses' ways have their middle (n_slot,), s after `zero` (see the module)."""
        sent: FloatArray = np.asarray(burst.sent + burst.interval * np.arange(burst.n_slot), np.float64)
        received: FloatArray = np.asarray(sent + burst.interval * float(burst.packets.rank[0]), np.float64)
        if self.options.time_tags == "middle":
            return received
        later = (burst.middle_delay + burst.radar.length) / 2
        return np.asarray((sent if self.options.time_tags is None else received) + later, np.float64)

    def track(self, burst: Burst) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Positions, velocities and antenna's axis (n_slot, 3), Earth-centred."""
        moment = self.moment(burst)
        position, velocity = self.orbit.at(moment)
        if self.attitude is None:
            return position, velocity, velocity / np.linalg.norm(velocity, axis=1, keepdims=True)
        return position, velocity, self.attitude.axis(moment, position, velocity)


@dataclass(frozen=True, kw_only=True, eq=False)
class BurstHistory:
    """A burst as a phase history in a frame."""

    file: File
    burst: Burst
    data: Data
    frame: Georeference

    @cached_property
    def track(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        return self.data.track(self.burst)

    @cached_property
    def angle(self) -> FloatArray:
        """Of the beam ahead of broadside (n_slot,), rad."""
        return self.data.steering[self.burst.swath].angle(self.burst, self.data.moment(self.burst))

    @cached_property
    def doppler(self) -> FloatArray:
        """Of the beam's centre (n_slot,), Hz; none where antennas stand still."""
        if self.data.options.time_tags == "middle":
            return np.zeros(self.burst.n_slot)
        speed = np.linalg.norm(self.track[1], axis=1)
        return np.asarray(2 * CARRIER / SPEED_OF_LIGHT * speed * np.sin(self.angle))

    @cached_property
    def late(self) -> FloatArray:
        """By how much later samples are received than the moment of the position takes them for (n_sample,), s."""
        if self.data.options.time_tags == "middle":
            return np.zeros(self.raw.fast_time.size)
        return np.asarray((self.raw.fast_time - (self.raw.fast_time[0] + self.raw.fast_time[-1]) / 2) / 2)

    @cached_property
    def atmosphere(self) -> float:
        """Delay of a standard atmosphere in the middle of swath and burst, m of one way."""
        middle = self.burst.n_slot // 2
        position, _, axis = (each[middle] for each in self.track)
        ground = find_scene_centre(
            position, axis, slant_range=self.burst.middle_range, side=SIDE, height=0.0, squint=float(self.angle[middle])
        )
        return float(slant_delay(position, ground.origin, ground))

    @property
    def removed(self) -> float:
        """Of that, what is taken out, m."""
        return self.atmosphere if self.data.options.troposphere else 0.0

    @cached_property
    def raw(self) -> RawEcho:
        radar, (first, count) = self.burst.radar, self.burst.samples
        first -= radar.length / 2 + 2 * self.removed / SPEED_OF_LIGHT
        return RawEcho(
            fast_time=first + np.arange(count) / radar.rate, chirp_rate=radar.ramp,
            pulse_width=radar.length, sampling_rate=radar.rate,
        )  # fmt: skip

    @cached_property
    def collection(self) -> Collection:
        burst, n = self.burst, self.burst.n_slot
        position, _, axis = self.track
        width = SPEED_OF_LIGHT / CARRIER / APERTURE
        offset = np.linspace(-width / 2, width / 2, PATTERN_SAMPLES)
        return Collection(
            carrier=CARRIER,
            time=np.asarray(burst.interval * (np.arange(n) - n // 2), np.float64),
            range_frequency=self.raw.range_frequency,
            reference_range=np.full(n, burst.middle_range - self.removed),
            antenna_position=self.frame.from_ecef(position),
            beam_azimuth=np.full(n, np.nan),
            beam_width=width,
            beam_axis=axis @ self.frame.axes.T,
            beam_steering=self.angle,
            beam_offset=offset,
            beam_pattern=np.sinc(np.sin(offset) * APERTURE * CARRIER / SPEED_OF_LIGHT) ** 2,
            side_of_track=SIDE,
            ground_height=self.data.options.ground_height,
            title=f"Sentinel-1 {burst.swath} {burst.polarization}, burst {burst.number}",
        )

    @property
    def attributes(self) -> dict[str, Any]:
        burst = self.burst
        start = float(self.data.moment(burst)[0])
        source = {
            "format": "Sentinel-1 level 0", "file": self.file.where.name, "swath": burst.swath, "burst": burst.number,
            "data_take": int(burst.packets.take[0]), "replica": "nominal chirp of the headers",
            "time_tags": self.data.options.time_tags or "receive",
            **({"troposphere_removed": self.removed} if self.removed else {}),
            "collection_start": utc(self.data.zero, start), "time_zero": burst.interval * (burst.n_slot // 2),
        }  # fmt: skip
        sent, received = tuple(burst.polarization)
        return {
            "georeference": self.frame.as_attribute(), "surface": "ellipsoid", "source": source,
            "collector": "Sentinel-1", "polarization": {"transmit": sent, "receive": received},
        }  # fmt: skip

    def reading(self, said: Sequence[str]) -> Reading:
        return Reading(
            collection=self.collection, raw=self.raw, pieces=self.pieces, attributes=self.attributes,
            messages=lambda: said, parts=PARTS,
        )  # fmt: skip

    def pieces(self) -> Iterator[Piece]:
        burst = self.burst
        # In samples, by which a pulse's first one comes after the first that all have. Codes round the chirp's middle.
        frequency = burst.radar.middle + self.doppler[burst.slots] / 2
        shift = (burst.delay - burst.samples[0] + frequency / burst.radar.ramp) * burst.radar.rate
        resampling = Resampling.of(self.doppler, self.late, burst.interval)
        rows = max(AT_ONCE // (16 * int(burst.packets.quads.max())), 1)
        with self.file.where.open() as file:
            read = partial(self._read, file, shift)
            for first in range(0, burst.n_slot, rows):
                pulses = slice(first, min(first + rows, burst.n_slot))
                yield Piece(0, pulses, partial(self._resampled, resampling, read, pulses))

    def _resampled(self, resampling: Resampling, read: Callable[[slice], ComplexArray], pulses: slice) -> ComplexArray:
        with reading(self.file.where, damaged=DAMAGED, remedy=REMEDY):
            return resampling.apply(read, pulses)

    def _read(self, file: BinaryIO, shift: FloatArray, pulses: slice) -> ComplexArray:
        """Samples of some slots, NaN where one is lost."""
        burst, count = self.burst, self.raw.fast_time.size
        samples = np.full((pulses.stop - pulses.start, count), np.nan, np.complex64)
        low, high = np.searchsorted(burst.slots, [pulses.start, pulses.stop])
        for some in _alike(burst.packets, low, high):
            read = read_samples(file, burst.packets[some])
            samples[burst.slots[some] - pulses.start] = shifted(read, shift[some], count)
        return samples


def _alike(packets: Packets, low: int, high: int) -> Iterator[slice]:
    """Slices of packets from low to before high that have as many samples."""
    if high > low:
        cuts = low + 1 + np.flatnonzero(np.diff(packets.quads[low:high]))
        for first, last in zip([low, *cuts], [*cuts, high], strict=True):
            yield slice(int(first), int(last))


def shifted(samples: ComplexArray, shift: FloatArray, count: int) -> ComplexArray:
    """Rows (n, m) later by so many samples each (n,), of which the first `count` are returned; zeros come from beyond.

    By whole samples and, where the rest is more than UNMOVED, by an even phase over frequency.
    """
    n, m = samples.shape
    whole = np.rint(shift).astype(int)
    rest = shift - whole
    if np.abs(rest).max(initial=0.0) > UNMOVED:
        size = fast_length(m + 64)
        padded = np.zeros((n, size), np.complex64)
        padded[:, :m] = samples
        spectrum = fft_rows(padded, inverse=False)
        cycles = np.arange(size) / size
        cycles -= cycles >= 0.5
        spectrum *= unit_phasor(-np.multiply.outer(rest, cycles)).astype(np.complex64)
        samples = fft_rows(spectrum, inverse=True)[:, :m]
    out = np.zeros((n, count), np.complex64)
    for row, first in enumerate(whole):
        own = samples[row, max(-first, 0) : max(count - first, 0)]
        out[row, max(first, 0) : max(first, 0) + own.size] = own
    return out


def frame_of(burst: Burst, data: Data) -> Georeference:
    """About the ground at the middle of a burst, x away from the track, so that a box along the axes fits a swath."""
    position, _, axis = (each[burst.n_slot // 2] for each in data.track(burst))
    frame = find_scene_centre(position, axis, slant_range=burst.middle_range, side=SIDE, height=0.0, squint=0.0)
    east, north, _ = frame.east_north_up @ (frame.origin - position)
    return replace(frame, rotation=float(np.degrees(np.arctan2(north, east))))
