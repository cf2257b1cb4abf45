"""Bursts to phase histories: raw echoes in one frame on the ellipsoid, a collection for each.

*Time.* A packet has the time of the PRI in which its echo is received; the pulse was sent `rank` PRIs before. While it
travels the antenna moves on. A sample received s after the beginning of the transmission, at the delay tau of a target,
has the phase of an antenna that stands still at the middle of its way, at s - tau / 2: its pulse's centre that of
(tau + T) / 2 after the beginning, T the pulse's length. Positions are those for tau of the swath's middle; ground at
another range lies off by v (R - R_middle) / c along the track, which is told.

*Doppler within a pulse.* Meanwhile the range changes: the chirp has the frequency f_d of the beam's centre on top, which
moves its compressed peak by -f_d / K in delay (0.4 m for IW1 at 0.6 degrees). Echoes are put later by f_d / K, an even
shift of a pulse's samples, so that positions stay right all over a burst.

*Delays* count from the beginning of the pulse in packets, and to its centre in the store.

*Beam.* About the antenna's own axis by the attitude, ahead of broadside by the electronic law (`steering`); the pattern
along the track is that of an evenly lit aperture as long as the antenna, sinc^2 both ways, out to half of its nulls.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import cached_property
from typing import Any

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.georeference import Georeference
from blocksar.collection.raw_echo import RawEcho
from blocksar.collection.scene_centre import find_scene_centre
from blocksar.constants import MIB, SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.ingestion.reading import reading
from blocksar.ingestion.readers import Piece, Reading
from blocksar.ingestion.sentinel1.ancillary import TILTED, Attitude, read_attitude, read_orbit
from blocksar.ingestion.sentinel1.bursts import Burst, Steering
from blocksar.ingestion.sentinel1.files import DAMAGED, REMEDY, File, chosen, open_files
from blocksar.ingestion.sentinel1.options import Sentinel1Options
from blocksar.ingestion.sentinel1.orbit_files import GPS, read_orbit_file
from blocksar.ingestion.sentinel1.packets import CARRIER, Packets
from blocksar.ingestion.sentinel1.propagation import reaching
from blocksar.ingestion.sentinel1.samples import COMPRESSIONS, read_samples
from blocksar.ingestion.strips.orbit import Orbit
from blocksar.kernels.fourier import fast_length, fft_rows, unit_phasor
from blocksar.places import Location

APERTURE = 12.3  # m, length of the antenna
PATTERN_SAMPLES = 65
SIDE = "right"
PARTS = "--swath, --bursts"
AT_ONCE = 32 * MIB  # bytes of samples
UNMOVED = 1e-3  # of a sample
# Seconds that GPS time is ahead of UTC, from a GPS second on.
LEAPS = ((0, 16), (1119744017, 17), (1167264018, 18))


@dataclass(frozen=True, kw_only=True, eq=False)
class Data:
    """What the bursts of a data take have in common."""

    options: Sentinel1Options
    zero: int
    orbit: Orbit
    attitude: Attitude | None
    steering: Mapping[str, Steering]

    def moment(self, burst: Burst) -> FloatArray:
        """When the antenna is where the pulses' ways have their middle (n_slot,), s after `zero` (see the module)."""
        sent = burst.sent + burst.interval * np.arange(burst.n_slot)
        received = sent + burst.interval * float(burst.packets.rank[0])
        if self.options.time_tags == "middle":
            return received
        later = (burst.middle_delay + burst.radar.length) / 2
        return (sent if self.options.time_tags is None else received) + later

    def track(self, burst: Burst) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Positions, velocities and antenna's axis (n_slot, 3), Earth-centred."""
        moment = self.moment(burst)
        position, velocity = self.orbit.at(moment)
        if self.attitude is None:
            return position, velocity, velocity / np.linalg.norm(velocity, axis=1, keepdims=True)
        return position, velocity, self.attitude.axis(moment, position, velocity)

    def later(self, burst: Burst, velocity: FloatArray, angle: FloatArray) -> FloatArray:
        """By how much echoes are put later for frequencies on top of the chirp about the carrier (n_slot,), s.

        That of the Doppler effect within the pulse, and the middle of the chirp, which codes round.
        """
        frequency = np.full(burst.n_slot, burst.radar.middle)
        if self.options.time_tags != "middle":
            frequency += 2 * CARRIER / SPEED_OF_LIGHT * np.linalg.norm(velocity, axis=1) * np.sin(angle)
        return np.asarray(frequency / burst.radar.ramp)


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
    def raw(self) -> RawEcho:
        radar, (first, count) = self.burst.radar, self.burst.samples
        return RawEcho(
            fast_time=first + np.arange(count) / radar.rate - radar.length / 2, chirp_rate=radar.ramp,
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
            time=burst.interval * (np.arange(n) - n // 2),
            range_frequency=self.raw.range_frequency,
            reference_range=np.full(n, burst.middle_range),
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
            "collection_start": utc(self.data.zero, start), "time_zero": burst.interval * (burst.n_slot // 2),
        }  # fmt: skip
        sent, received = burst.polarization
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
        burst, count = self.burst, self.raw.fast_time.size
        later = self.data.later(burst, self.track[1], self.angle)[burst.slots]
        # In samples, by which a pulse's first one comes after the first that all have.
        shift = (burst.delay - burst.samples[0] + later) * burst.radar.rate
        rows = max(AT_ONCE // (16 * int(burst.packets.quads.max())), 1)
        with reading(self.file.where, damaged=DAMAGED, remedy=REMEDY), self.file.where.open() as file:
            for first in range(0, burst.n_slot, rows):
                pulses = slice(first, min(first + rows, burst.n_slot))
                samples = np.full((pulses.stop - first, count), np.nan, np.complex64)
                low, high = np.searchsorted(burst.slots, [pulses.start, pulses.stop])
                for some in _alike(burst.packets, low, high):
                    read = read_samples(file, burst.packets[some])
                    samples[burst.slots[some] - first] = shifted(read, shift[some], count)
                yield Piece(0, pulses, samples)


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


def utc(zero: int, seconds: float) -> str:
    """UTC of so many seconds after a GPS second, ISO 8601."""
    ahead = next(leap for since, leap in reversed(LEAPS) if zero >= since)
    moment: datetime = GPS + timedelta(seconds=zero - ahead) + timedelta(seconds=seconds)
    return f"{moment.replace(tzinfo=None).isoformat(timespec='microseconds')}Z"


def begin(sources: Sequence[Location], options: Sentinel1Options) -> dict[str, Reading]:
    """Read all but the samples: the bursts' phase histories by name.

    Raises
    ------
    InputError
        If a file is of another kind, cut or damaged, no burst is left, or the orbit is not known.
    """
    found, zero, notes = chosen(open_files(sources), options)
    bursts = [burst for _, kept in found for burst in kept]
    times = [time for burst in bursts for time in (burst.sent, burst.sent + (burst.n_slot + 64) * burst.interval)]
    first_file = found[0][0]
    with reading(first_file.where, damaged=DAMAGED, remedy=REMEDY):
        if options.orbit is not None:
            orbit = read_orbit_file(options.orbit, min(times), max(times), zero)
        else:
            orbit = reaching(read_orbit(first_file.packets, zero), min(times), max(times))
        attitude = read_attitude(first_file.packets, zero, orbit)
    whole = {burst.swath: [each for each in bursts if each.swath == burst.swath] for burst in bursts}
    steering = {swath: Steering.of(own) for swath, own in whole.items()}
    data = Data(options=options, zero=zero, orbit=orbit, attitude=attitude, steering=steering)
    frame = frame_of(bursts[len(bursts) // 2], data)
    histories = [
        BurstHistory(file=file, burst=burst, data=data, frame=frame) for file, kept in found for burst in kept
    ]
    said = [*notes, *remarks(histories)]
    return {
        history.burst.name: history.reading(said if not number else ())
        for number, history in enumerate(histories)
    }  # fmt: skip


def frame_of(burst: Burst, data: Data) -> Georeference:
    """x east, y north about the ground at the middle of a burst."""
    position, _, axis = (each[burst.n_slot // 2] for each in data.track(burst))
    return find_scene_centre(position, axis, slant_range=burst.middle_range, side=SIDE, height=0.0, squint=0.0)


def remarks(histories: Sequence[BurstHistory]) -> list[str]:
    """What was found, and what was assumed, a sentence each."""
    first, data = histories[0], histories[0].data
    swaths: dict[str, list[BurstHistory]] = {}
    for each in histories:
        swaths.setdefault(each.burst.swath, []).append(each)
    lines = []
    for swath, own in swaths.items():
        burst = own[0].burst
        lost = sum(each.burst.n_slot - len(each.burst.packets) for each in own)
        windows = sum(bool(np.ptp(each.burst.delay) > UNMOVED / burst.radar.rate) for each in own)
        modes = sorted({COMPRESSIONS.get(int(code), "?") for each in own for code in each.burst.packets.compression})
        lines.append(
            f"{swath} {burst.polarization}: {len(own)} burst{'s' if len(own) > 1 else ''} of up to "
            f"{max(each.burst.n_slot for each in own)} pulses at {1 / burst.interval:.6g} Hz, {own[0].raw.fast_time.size} "
            f"samples at {burst.radar.rate / 1e6:.6g} MHz ({', '.join(modes)}), {int(burst.packets.rank[0])} pulses in "
            f"the air{f'; {lost} lost pulses are missing' if lost else ''}; {data.steering[swath].describe()}"
        )
        if windows:
            lines.append(f"receive windows change within {windows} of {swath}'s bursts; what all pulses have is taken")
    speed = float(np.linalg.norm(first.track[1], axis=1).mean())
    off = speed * max(np.ptp(each.raw.fast_time) for each in histories) / 4
    orbit = "the file" if data.options.orbit is not None else "the packets, whose accuracy is some metres"
    attitude = (
        f"no attitude within {np.degrees(TILTED):g} degree of zero Doppler is in the packets, and the antenna is taken to "
        "lie along the velocity over the Earth"
        if data.attitude is None
        else f"attitude from the packets, its quaternions read {data.attitude.reading}: the antenna lies up to "
        f"{np.degrees(data.attitude.off):.2g} degrees off the velocity over the Earth"
    )
    tags = {
        None: "the packets' times are those of the PRI that receives, and positions those at the middle of the way",
        "transmit": "the packets' times are taken for those of transmission",
        "middle": "the packets' times are taken for those of an antenna that stands still meanwhile",
    }[data.options.time_tags]
    where = f"{first.frame.latitude:.6f}, longitude {first.frame.longitude:.6f}"
    return [
        *lines,
        f"orbit from {orbit}; {attitude}",
        "assumed: the nominal chirp of the headers as replica (calibration pulses are not used); a beam pattern of an "
        f"evenly lit aperture of {APERTURE} m along the track, and none in elevation",
        tags + ("" if data.options.time_tags == "middle" else
                f"; at the swath's edges places lie up to {off:.2g} m off along the track"),
        f"scene frame: x east, y north, z up at latitude {where} on the ellipsoid",
    ]  # fmt: skip
