"""A burst as a phase history: a raw echo in a frame on the ellipsoid, with remarks for the user.

*Resampling.* Columns of samples that come earlier or later than their pulse's position are moved in slow time. The
Doppler frequency of the beam's centre passes through many PRFs. Without it, samples fill less than a PRF, and are
interpolated by a sinc under Kaiser's window. With x[n] the sample at t_n + d, and Phi the phase of the beam's centre,

    y[n] = exp(j Phi(t_n)) sum_k h(k + d / PRI) x[n + k] exp(-j Phi(t_n+k + d)) .

*Time.* A packet has the time of the PRI in which its echo is received; the pulse was sent `rank` PRIs before. While it
travels the antenna moves on. A sample received s after the beginning of the transmission has, at a target's delay tau,
the phase of an antenna that stands still in the middle of its way, at s - tau / 2. Positions are those of the middle of
swath and pulse, s0 and u0 = T / 2 with the pulse's length T; the sample is of a moment

    (s - s0) / 2 + (u - u0) / 2 ,    u = s - tau ,

later. The first part is a delay in slow time, another for each column of samples: they are resampled to the moment of
the position (above), without which ground at the edges of IW1 would lie 0.7 m off along the track. The second
one is a Doppler frequency of half of the target's on the chirp, whose compressed peak it moves by -f / 2 K in delay:
echoes are put later by as much for the beam's centre, an even shift of a pulse's samples.

*Delays* count from the beginning of the pulse in packets, and to its centre in the store. The instrument's own
(`calibration`) is taken off, of each receiver by itself. On the carrier packets have the phase of the whole way, of
which the store lacks that of the reference range R0: samples are turned by exp(4j pi fc / c R0), and so bursts and
swaths whose receive windows differ agree in phase.

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
from blocksar.kernels.fourier import fast_length, fft_rows, unit_phasor
from blocksar.readers.atmosphere import slant_delay
from blocksar.readers.orbit import Orbit
from blocksar.readers.reading import reading
from blocksar.readers.registry import Piece, Reading
from blocksar.readers.sentinel1.ancillary import TILTED, Attitude, utc
from blocksar.readers.sentinel1.bursts import (
    DAMAGED,
    REMEDY,
    Burst,
    Channel,
    PacketFile,
    Sentinel1Options,
    Steering,
    shared_samples,
)
from blocksar.readers.sentinel1.calibration import USUAL, InternalDelay
from blocksar.readers.sentinel1.packets import CARRIER, COMPRESSIONS, Packets, read_samples
from blocksar.texts import count, frequency_text

# ---------------------------------------------------------------- resampling

HALF = 8  # pulses on either side that a sum takes
WINDOW = 6.0  # Kaiser's beta: errors of -60 dB up to 0.4 PRF
UNMOVED_PULSE = 1e-4  # of a PRI


@dataclass(frozen=True, kw_only=True, eq=False)
class ColumnResampling:
    """Resampling of a burst's pulses to common times, column by column.

    Attributes
    ----------
    cycles, doppler : (n_pulse,) float
        Phase of the beam's centre over 2 pi, and its Doppler frequency, Hz.
    late : (n_sample,) float
        d of each column, s.
    interval : float
        PRI, s.
    """

    cycles: FloatArray
    doppler: FloatArray
    late: FloatArray
    interval: float

    @classmethod
    def of(cls, doppler: FloatArray, late: FloatArray, interval: float) -> ColumnResampling:
        steps = interval * (doppler[1:] + doppler[:-1]) / 2
        cycles = np.concatenate([[0.0], np.cumsum(steps)])
        return cls(cycles=cycles, doppler=doppler, late=late, interval=interval)

    def apply(self, read: Callable[[slice], ComplexArray], pulses: slice) -> ComplexArray:
        """Read pulses through `read` and resample them; lost ones stay NaN."""
        shift = self.late / self.interval
        if np.abs(shift).max() < UNMOVED_PULSE:
            return read(pulses)
        around = slice(max(pulses.start - HALF, 0), min(pulses.stop + HALF, self.cycles.size))
        samples = read(around)
        lost = np.isnan(samples[:, 0].real)
        samples[lost] = 0
        phase = self.cycles[around, None] + np.multiply.outer(self.doppler[around], self.late)
        samples *= unit_phasor(-phase).astype(np.complex64)
        n = pulses.stop - pulses.start
        out = np.zeros((n, samples.shape[1]), np.complex64)
        for k in range(-HALF, HALF + 1):
            low, high = max(pulses.start + k, around.start), min(pulses.stop + k, around.stop)
            if low < high:
                rows = slice(low - k - pulses.start, high - k - pulses.start)
                out[rows] += _weight(k + shift).astype(np.float32) * samples[low - around.start : high - around.start]
        out *= unit_phasor(self.cycles[pulses])[:, None].astype(np.complex64)
        out[lost[pulses.start - around.start :][:n]] = np.nan
        return out


def _weight(place: FloatArray) -> FloatArray:
    """Interpolation kernel h at distances in pulses."""
    within = np.clip(1 - (place / (HALF + 1)) ** 2, 0, None)
    return np.asarray(np.sinc(place) * np.i0(WINDOW * np.sqrt(within)) / np.i0(WINDOW))


# ---------------------------------------------------------------- phase histories

APERTURE = 12.3  # m, length of the antenna
PATTERN_SAMPLES = 65
SIDE = "right"
PARTS = "--swath, --bursts"
AT_ONCE = 16 * MIB  # bytes of samples
UNMOVED_SAMPLE = 1e-3  # of a sample


@dataclass(frozen=True, kw_only=True, eq=False)
class Data:
    """Common facts of a data take's bursts."""

    options: Sentinel1Options
    zero: int
    orbit: Orbit
    attitude: Attitude | None
    steering: Mapping[str, Steering]

    def moment(self, burst: Burst) -> FloatArray:
        """Times (n_slot,), s after `zero`, at which the antenna is midway between transmission and reception."""
        sent: FloatArray = np.asarray(burst.sent + burst.interval * np.arange(burst.n_slot), np.float64)
        received: FloatArray = np.asarray(sent + burst.interval * float(burst.packets.rank[0]), np.float64)
        if self.options.time_tags == "middle":
            return received
        later = (burst.middle_delay + burst.radar.length) / 2
        return np.asarray((sent if self.options.time_tags is None else received) + later, np.float64)

    def track(self, burst: Burst) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Positions, velocities and antenna axes (n_slot, 3), Earth-centred."""
        moment = self.moment(burst)
        position, velocity = self.orbit.at(moment)
        if self.attitude is None:
            return position, velocity, velocity / np.linalg.norm(velocity, axis=1, keepdims=True)
        return position, velocity, self.attitude.axis(moment, position, velocity)


@dataclass(frozen=True, kw_only=True, eq=False)
class BurstHistory:
    """A burst as a phase history in a frame; receivers are channels with the geometry of the first.

    Attributes
    ----------
    channels : tuple of (PacketFile, Burst)
    delays : tuple of InternalDelay or None
        Of each channel, as the bursts have it.
    """

    channels: tuple[Channel, ...]
    delays: tuple[InternalDelay | None, ...]
    data: Data
    frame: Georeference

    @property
    def burst(self) -> Burst:
        return self.channels[0][1]

    @property
    def polarizations(self) -> tuple[str, ...]:
        return tuple(burst.polarization for _, burst in self.channels)

    @property
    def name(self) -> str:
        return f"{self.burst.swath}-{'-'.join(self.polarizations)}-{self.burst.number:03d}"

    @cached_property
    def track(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        return self.data.track(self.burst)

    @cached_property
    def angle(self) -> FloatArray:
        """Angle of the beam ahead of broadside (n_slot,), rad."""
        return self.data.steering[self.burst.swath].angle(self.burst, self.data.moment(self.burst))

    @cached_property
    def doppler(self) -> FloatArray:
        """Doppler of the beam's centre (n_slot,), Hz; zero for antennas treated as still."""
        if self.data.options.time_tags == "middle":
            return np.zeros(self.burst.n_slot)
        speed = np.linalg.norm(self.track[1], axis=1)
        return np.asarray(2 * CARRIER / SPEED_OF_LIGHT * speed * np.sin(self.angle))

    @cached_property
    def late(self) -> FloatArray:
        """Offset (n_sample,), s, of the antenna's true mid-time of samples from that of its stated position."""
        if self.data.options.time_tags == "middle":
            return np.zeros(self.raw.fast_time.size)
        middle = self.burst.middle_delay - 2 * self.removed / SPEED_OF_LIGHT
        return np.asarray((self.raw.fast_time - middle) / 2)

    @cached_property
    def atmosphere(self) -> float:
        """Delay, one way in m, of a standard atmosphere in the middle of swath and burst."""
        middle = self.burst.n_slot // 2
        position, _, axis = (each[middle] for each in self.track)
        ground = find_scene_centre(
            position, axis, slant_range=self.burst.middle_range, side=SIDE, height=0.0, squint=float(self.angle[middle])
        )
        return float(slant_delay(position, ground.origin, ground))

    @property
    def removed(self) -> float:
        """Part of the atmosphere's delay that is removed, m."""
        return self.atmosphere if self.data.options.troposphere else 0.0

    @cached_property
    def samples(self) -> tuple[float, int]:
        """First delay (s) and number of the samples common to all pulses of all channels."""
        return shared_samples([burst for _, burst in self.channels])

    @cached_property
    def raw(self) -> RawEcho:
        radar, (first, count) = self.burst.radar, self.samples
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
            title=f"Sentinel-1 {burst.swath} {', '.join(self.polarizations)}, burst {burst.number}",
        )

    @property
    def attributes(self) -> dict[str, Any]:
        burst = self.burst
        start = float(self.data.moment(burst)[0])
        source = {
            "format": "Sentinel-1 level 0", "file": ", ".join(file.where.name for file, _ in self.channels),
            "swath": burst.swath, "burst": burst.number,
            "data_take": int(burst.packets.take[0]), "replica": "nominal chirp of the headers",
            "time_tags": self.data.options.time_tags or "receive",
            **self.data.options.said,
            **({"troposphere_removed": self.removed} if self.removed else {}),
            **({"internal_delay": burst.internal} if burst.internal else {}),
            "collection_start": utc(self.data.zero, start), "time_zero": burst.interval * (burst.n_slot // 2),
        }  # fmt: skip
        known = {each: {"transmit": each[0], "receive": each[1]} for each in self.polarizations}
        polarized = {"polarizations": known} if len(known) > 1 else {"polarization": known[burst.polarization]}
        return {
            "georeference": self.frame.as_attribute(), "surface": "ellipsoid", "source": source,
            "collector": "Sentinel-1", **polarized,
        }  # fmt: skip

    def reading(self, said: Sequence[str]) -> Reading:
        return Reading(
            collection=self.collection, raw=self.raw, pieces=self.pieces, attributes=self.attributes,
            messages=lambda: said, parts=PARTS, channels=self.polarizations if len(self.channels) > 1 else (),
        )  # fmt: skip

    def pieces(self) -> Iterator[Piece]:
        resampling = ColumnResampling.of(self.doppler, self.late, self.burst.interval)
        for channel, (source, burst) in enumerate(self.channels):
            # Offset of each pulse's first sample from the first common one, in samples. Codes round the chirp's middle.
            frequency = burst.radar.middle + self.doppler[burst.slots] / 2
            shift = (burst.delay - self.samples[0] + frequency / burst.radar.ramp) * burst.radar.rate
            rows = max(AT_ONCE // (16 * int(burst.packets.quads.max())), 1)
            with source.where.open() as file:
                read = partial(self._read, file, burst, shift)
                for first in range(0, burst.n_slot, rows):
                    pulses = slice(first, min(first + rows, burst.n_slot))
                    yield Piece(channel, pulses, partial(self._resampled, source, resampling, read, pulses))

    def _resampled(
        self,
        source: PacketFile,
        resampling: ColumnResampling,
        read: Callable[[slice], ComplexArray],
        pulses: slice,
    ) -> ComplexArray:
        with reading(source.where, damaged=DAMAGED, remedy=REMEDY):
            return resampling.apply(read, pulses)

    def _read(self, file: BinaryIO, burst: Burst, shift: FloatArray, pulses: slice) -> ComplexArray:
        """Read samples of some slots, NaN for lost ones."""
        count = self.raw.fast_time.size
        samples = np.full((pulses.stop - pulses.start, count), np.nan, np.complex64)
        low, high = np.searchsorted(burst.slots, [pulses.start, pulses.stop])
        for some in _alike(burst.packets, low, high):
            read = read_samples(file, burst.packets[some])
            samples[burst.slots[some] - pulses.start] = shifted(read, shift[some], count)
        cycles = 2 * CARRIER / SPEED_OF_LIGHT * (self.burst.middle_range + self.removed)
        return np.asarray(samples * np.complex64(np.exp(2j * np.pi * (cycles % 1.0))))


def _alike(packets: Packets, low: int, high: int) -> Iterator[slice]:
    """Iterate over runs of packets, from low to before high, with equal numbers of samples."""
    if high > low:
        cuts = low + 1 + np.flatnonzero(np.diff(packets.quads[low:high]))
        for first, last in zip([low, *cuts], [*cuts, high], strict=True):
            yield slice(int(first), int(last))


def shifted(samples: ComplexArray, shift: FloatArray, count: int) -> ComplexArray:
    """Delay rows (n, m) by fractional samples (n,), and return the first `count` columns; zeros are shifted in.

    By whole samples and, where the rest is more than UNMOVED, by an even phase over frequency.
    """
    n, m = samples.shape
    whole = np.rint(shift).astype(int)
    rest = shift - whole
    if np.abs(rest).max(initial=0.0) > UNMOVED_SAMPLE:
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
    """Make the frame about the ground at mid-burst, x pointing away from the track."""
    position, _, axis = (each[burst.n_slot // 2] for each in data.track(burst))
    frame = find_scene_centre(position, axis, slant_range=burst.middle_range, side=SIDE, height=0.0, squint=0.0)
    east, north, _ = frame.east_north_up @ (frame.origin - position)
    return replace(frame, rotation=float(np.degrees(np.arctan2(north, east))))


# ---------------------------------------------------------------- remarks

UNTOLD = 1e-9  # s, by which receive windows may differ


def remarks(histories: Sequence[BurstHistory]) -> list[str]:
    """Collect the remarks on all bursts, a sentence each."""
    swaths: dict[str, list[BurstHistory]] = {}
    for each in histories:
        swaths.setdefault(each.burst.swath, []).append(each)
    first, frame = histories[0], histories[0].frame
    taken = "taken out" if first.removed else "in the samples; --troposphere standard takes it out"
    return [
        *(line for swath, own in swaths.items() for line in _swath(swath, own)),
        *dict.fromkeys(line for own in swaths.values() for line in _internal(own[0])),
        f"orbit from {_orbit(first)}; {_attitude(first)}",
        "assumed: the nominal chirp of the headers as replica; a beam pattern of an evenly lit aperture along the "
        "track, and none in elevation",
        _times(histories),
        *first.data.options.notes,
        f"the delay of a standard atmosphere, {first.atmosphere:.3g} m of range, is {taken}",
        f"scene frame: x away from the track, {frame.rotation:.2f} degrees from east, z up at latitude "
        f"{frame.latitude:.6f}, longitude {frame.longitude:.6f} on the ellipsoid, which is the ground by default",
    ]


def _swath(swath: str, own: Sequence[BurstHistory]) -> list[str]:
    burst = own[0].burst
    lost = sum(burst.n_slot - len(burst.packets) for each in own for _, burst in each.channels)
    windows = sum(bool(np.ptp(each.burst.delay) > UNTOLD) for each in own)
    modes = {COMPRESSIONS.get(int(code), "?") for each in own for code in each.burst.packets.compression}
    missing = f"; {count(lost, 'lost pulse')} missing" if lost else ""
    return [
        f"{swath} {', '.join(own[0].polarizations)}: {count(len(own), 'burst')} of up to "
        f"{max(each.burst.n_slot for each in own)} pulses at {1 / burst.interval:.6g} Hz, "
        f"{own[0].raw.fast_time.size} samples at {frequency_text(burst.radar.rate)} ({', '.join(sorted(modes))}), "
        f"{int(burst.packets.rank[0])} pulses in the air{missing}; {own[0].data.steering[swath].describe()}",
        *([f"receive windows change within {windows} of {swath}'s bursts; what all pulses have is taken"]
          if windows else []),
    ]  # fmt: skip


def _internal(history: BurstHistory) -> list[str]:
    """Describe how much of each channel's internal delay is removed, or left."""
    burst = history.burst
    sight = history.frame.from_ecef(history.track[0][burst.n_slot // 2])
    level = float(np.hypot(sight[0], sight[1]) / np.linalg.norm(sight))

    def extent(seconds: float) -> str:
        """Format a delay as slant range and ground range, m."""
        slant = SPEED_OF_LIGHT / 2 * seconds
        return f"{1e9 * seconds:.4g} ns ({slant:.3g} m of range, {slant / level:.3g} m on the ground)"

    lines: list[str] = []
    for (_, own), delay in zip(history.channels, history.delays, strict=True):
        name = f"{own.swath} {own.polarization}"
        if delay is None:
            lines.append(
                f"{name}: no calibration pulse in the packets tells the instrument's internal delay; it stays in the "
                f"samples, some {extent(USUAL)} too far; give files of the data take's calibration packets (RAW__0C) "
                "as well"
            )
            continue
        other = "" if delay.same_chirp else ", of another chirp"
        alone = "" if delay.types != "tx" else "; the receive chain's own share is not known and stays"
        lines.append(
            f"{name}: the instrument's internal delay of {extent(delay.seconds)} is taken out, by "
            f"{count(delay.pulses, 'calibration pulse')} ({delay.types}{other}){alone}"
        )
    return lines


def _orbit(history: BurstHistory) -> str:
    given = history.data.options.orbit is not None
    return "the file" if given else "the packets, whose accuracy is some metres (--orbit takes a precise one)"


def _attitude(history: BurstHistory) -> str:
    attitude = history.data.attitude
    if attitude is None:
        return (
            f"no attitude within {np.degrees(TILTED):g} degree of zero Doppler is in the packets, and the antenna is "
            "taken to lie along the velocity over the Earth"
        )
    return (
        f"attitude from the packets, its quaternions read {attitude.reading}: the antenna lies up to "
        f"{np.degrees(attitude.off):.2g} degrees off the velocity over the Earth"
    )


def _times(histories: Sequence[BurstHistory]) -> str:
    tags = histories[0].data.options.time_tags
    if tags == "middle":
        return "the packets' times are taken for those of an antenna that stands still while a pulse is out"
    of = "the PRI that receives the echo" if tags is None else "transmission"
    speed = float(np.linalg.norm(histories[0].track[1], axis=1).mean())
    off = speed * max(np.ptp(each.raw.fast_time) for each in histories) / 4
    return (
        f"the packets' times are taken for those of {of}, and positions at the middle of a pulse's way; samples are "
        f"resampled to its moment, without which places at the swath's edges lie {off:.2g} m off along the track"
    )
