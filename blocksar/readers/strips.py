"""Raw echoes of satellite strips: the common part of their formats.

The module has the options, the time axis of pulses, the conversion of a strip to a phase history in a frame on the
ellipsoid, and the reader of such a format.

*Time.* While a pulse travels the antenna moves on, by v 2 R / c, some 40 m. Its echo is that of a still antenna at the
middle of this way: the sum of both distances exceeds twice that from there by (v R / c)^2 / R, half a millimetre. A
pulse sent at t belongs to the position at t + R / c (`RawStrip.moment`), with R that of the swath's middle; ground at
another range lies off by v (R - R_middle) / c along the track, which is told.

*Delays* in files count from the beginning of the transmission, as the samples do: the pulse's centre comes half its
length later, so that this is taken off. An atmosphere's delay d of one way makes all echoes come from d farther away,

    echo = chirp(t - 2 (R + d) / c) exp(-4j pi fc / c (R + d - reference)) ,

so that delays and reference are those of d less. A delay of the instrument, which its maker measures on calibrated
targets, does the same with c / 2 times it in the place of d.

*Uneven pulses.* Where intervals are not whole multiples of one (a dithered or staggered PRF, or one that changes),
samples are resampled in slow time. The beam lights Doppler frequencies nu about its centre nu_c, |nu - nu_c| <= B / 2;
with Phi the phase of the centre, 2 pi times the integral of nu_c, samples times exp(-j Phi) fill |nu| <= B / 2 and are
determined by uneven ones as long as these are B a second or more (`resampling`):

    y(t) = exp(j Phi(t)) sum_m w_m(t) exp(-j Phi(t_m)) x(t_m) .

B is the beam's band at the highest frequency, 4 v / lambda sin(width / 2), and what nu_c changes over the swath and
over the frequencies of the chirp; or BAND_OF_PRF of the mean PRF if that is more, since a beam does not end at its
width.

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

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.collection.collection import Collection
from blocksar.collection.georeference import Georeference, find_scene_centre
from blocksar.collection.raw_echo import RawEcho
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError, printable, quoted
from blocksar.kernels.fourier import unit_phasor
from blocksar.options import Option
from blocksar.places import Location, readable
from blocksar.places.ranges import Readable
from blocksar.readers.atmosphere import delay_words, slant_delay
from blocksar.readers.chirps import DECIDED, PULSES, contrasts
from blocksar.readers.kinds import Kind
from blocksar.readers.orbit import Antenna, Orbit, OrbitTrack
from blocksar.readers.registry import Described, Piece, ReaderOptions, Reading, refuse_few
from blocksar.readers.resampling import OCCUPIED, Resampling, plan_resampling
from blocksar.spans import parse_pulses
from blocksar.stores import blocks_of
from blocksar.texts import count, frequency_text

# ---------------------------------------------------------------- options

TimeTags = Literal["transmit", "receive", "middle"]
TIME_TAGS = ("transmit", "receive", "middle")
ChirpSign = Literal["up", "down"]
CHIRP_SIGNS = ("up", "down")
MOST_DELAY = 1e-3  # s, of an instrument
POLARIZATIONS = tuple(transmit + receive for transmit in "HVLR" for receive in "HVLR")


def _read_polarization(value: Any) -> str | None:
    if value is None:
        return None
    if (text := str(value).upper()) not in POLARIZATIONS:
        raise InputError(f"--polarization is {quoted(value)}; give those of transmitter and receiver, such as HV")
    return text


def read_range_delay(value: Any) -> float:
    """Parse the range delay of samples, s.

    Raises
    ------
    InputError
        If it is no number, or more than MOST_DELAY.
    """
    try:
        delay = float(value)
    except (TypeError, ValueError):
        delay = np.nan
    if not abs(delay) <= MOST_DELAY:
        raise InputError(
            f"--range-delay is {quoted(value)}; give the seconds, there and back, by which echoes are late, at most "
            f"{MOST_DELAY:g}: 2 / c times a delay in m"
        )
    return delay


def check_choices(options: Any, **choices: tuple[str, ...]) -> None:
    """Raise an InputError if an option is neither None nor one of its texts."""
    for option, values in choices.items():
        if (value := getattr(options, option)) not in (None, *values):
            raise InputError(f"--{option.replace('_', '-')} is {value!r}; it must be {' or '.join(values)}")


@dataclass(frozen=True, kw_only=True)
class RawOptions(ReaderOptions):
    """Options of readers of raw echoes; see `ReaderOptions`.

    Attributes
    ----------
    ground_height : float
        Height of the imaged ground above the ellipsoid, m, the z of its plane in the scene frame. Default: 0.
    range_delay : float
        Seconds, there and back, by which echoes come late in the instrument, taken out besides what the reader takes
        out: places come closer to the track by c / 2 times it in range. Default: 0.
    chirp_sign : {"up", "down"}, optional
        Whether the pulse's frequency rises or falls. Default: by the file; of PALSAR "down".

    Raises
    ------
    InputError
        If the last has another value.
    """

    range_delay: Annotated[
        float,
        Option("Delay of echoes in the instrument, there and back, that is taken out.", metavar="SECONDS",
               read=read_range_delay),
    ] = 0.0  # fmt: skip
    chirp_sign: Annotated[
        ChirpSign | None,
        Option("Whether the pulse's frequency rises or falls.", metavar="|".join(CHIRP_SIGNS), default="by the file",
               read=str),
    ] = None  # fmt: skip

    def __post_init__(self) -> None:
        check_choices(self, chirp_sign=CHIRP_SIGNS)

    @property
    def said(self) -> dict[str, Any]:
        """Options that the store's attribute `source` records."""
        delay = {"range_delay_removed": self.range_delay} if self.range_delay else {}
        return {**delay, **({"chirp_sign": self.chirp_sign} if self.chirp_sign else {})}

    @property
    def notes(self) -> list[str]:
        """Notes for the user about these options."""
        away = SPEED_OF_LIGHT / 2 * self.range_delay
        delay = [f"a delay of {self.range_delay:.6g} s, {away:.4g} m of range, is taken out (--range-delay)"]
        return delay if self.range_delay else []


@dataclass(frozen=True, kw_only=True)
class PartOptions(RawOptions):
    """Selected part of a file, and corrections to its samples; see `RawOptions`.

    Attributes
    ----------
    polarization : str, optional
        Transmitter and receiver, such as "HV". Default: all of the first transmitter, as channels of the store.
    pulses : str or (int, int), optional
        Pulses "a:b" of the file that are read, from a to the one before b; either may be left out. Default: all.
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
        super().__post_init__()
        check_choices(self, troposphere=("standard",))


@dataclass(frozen=True, kw_only=True)
class StripOptions(PartOptions):
    """Options of formats that give times of pulses and an orbit.

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
SKIPPED = 2.5  # intervals, in which a pulse of a dithered PRF is lost
WANDER = 0.1  # of the interval, by which a pulse may lie off an even axis; positions are taken where it is


class Even(NamedTuple):
    """Pulses of a file on an even time axis.

    Attributes
    ----------
    pulses : (n,) int
        Their numbers in the file.
    sent : (n,) float
        Their times, s.
    slots : (n,) int, optional
        Their places on the axis, from 0; what lies between is lost. None: they lie between its places, and are
        resampled.
    time : (n_slot,) float
        Of all slots, s: that of the pulse, or in between.
    interval : float
        s.
    run : (int, int)
        The longest part of them with one interval, from a pulse of the file to before another.
    """

    pulses: IntArray
    sent: FloatArray
    slots: IntArray | None
    time: FloatArray
    interval: float
    run: tuple[int, int]

    def without(self, some: IntArray) -> Even:
        """Copy in which some pulses, by index, are lost; the axis stays."""
        slots = None if self.slots is None else np.delete(self.slots, some)
        return self._replace(pulses=np.delete(self.pulses, some), sent=np.delete(self.sent, some), slots=slots)

    def of_file(self, numbers: IntArray) -> Even:
        """Copy with pulse numbers replaced by those of the file."""
        first, stop = self.run
        return self._replace(pulses=numbers[self.pulses], run=(int(numbers[first]), int(numbers[stop - 1]) + 1))


def even_pulses(time: FloatArray) -> tuple[Even, list[str]]:
    """Find an even axis for pulses at times (n,), s, with notes on pulses left out or lost.

    Pulses at whole multiples of one interval have places on it; others get an axis of their mean PRF, between whose
    places they lie.

    Raises
    ------
    InputError
        If there are too few, or their times do not ascend, or gaps leave less than half of them.
    """
    if time.size < LEAST or not np.isfinite(time).all():
        raise InputError(f"{count(time.size, 'pulse')} with finite times left; at least {LEAST} are needed")
    steps = np.diff(time)
    if (steps <= 0).any():
        raise InputError(f"times of pulses do not ascend at pulse {int(np.argmax(steps <= 0)) + 1}; give the file anew")
    usual = float(np.median(steps))
    notes = []
    part = _longest(steps <= LONGEST_GAP * usual)
    if part[1] - part[0] < time.size:
        taken = f"pulses {part[0]} .. {part[1] - 1}, {part[1] - part[0]} of {time.size}"
        refuse_few(
            part[1] - part[0], time.size, f"there are gaps of more than {LONGEST_GAP} pulses",
            "take the part between two with --pulses",
        )  # fmt: skip
        notes.append(f"there are gaps of more than {LONGEST_GAP} pulses; {taken}, are taken: others with --pulses")
    pulses = np.arange(*part)
    time, steps = time[pulses], steps[pulses[:-1]]
    whole = np.rint(steps / usual)
    fits = (whole >= 1) & (np.abs(steps - whole * usual) <= UNEVEN * usual)
    run = _longest(fits)
    placed = _placed(time, whole, usual) if fits.all() else None
    if placed is not None:
        slots, at, step = placed
        if lost := int(slots[-1] + 1 - slots.size):
            notes.append(f"{lost} of {slots[-1] + 1} pulses lost: missing in the store")
    else:
        slots = None
        step = float(steps[steps < SKIPPED * usual].mean())
        at = np.linspace(time[0], time[-1], round(float(time[-1] - time[0]) / step) + 1)
        step = float(at[1] - at[0])
        notes.append(
            f"intervals between pulses are {1e6 * steps.min():.6g} .. {1e6 * steps.max():.6g} us: all {time.size} "
            f"pulses are resampled to {at.size} even ones at {1 / step:.6g} Hz"
        )
    return Even(pulses, time, slots, at, step, (part[0] + run[0], part[0] + run[1])), notes


def _longest(joined: BoolArray) -> tuple[int, int]:
    """Longest run of pulses, first and stop, each joined (n - 1,) with the next."""
    ends = np.flatnonzero(np.diff(np.concatenate([[0], joined, [0]]))).reshape(-1, 2)
    first, last = ends[np.argmax(np.diff(ends, axis=1))] if ends.size else (0, 0)
    return int(first), int(last) + 1


def _placed(time: FloatArray, whole: FloatArray, usual: float) -> tuple[IntArray, FloatArray, float] | None:
    """Fit an axis to pulses at whole multiples of an interval: slots of pulses, times of slots, and the interval.

    By least squares; None if pulses wander off such an axis.
    """
    slots = np.concatenate([[0], np.cumsum(whole)]).astype(np.int64)
    step, start = np.polyfit(slots - slots[-1] / 2, time - time[0], 1)
    even = time[0] + start + step * (np.arange(slots[-1] + 1) - slots[-1] / 2)
    if np.abs(even[slots] - time).max() > WANDER * step:
        return None
    at = np.interp(np.arange(even.size), slots, time - even[slots]) + even
    return slots, np.asarray(at), float(step)


# ---------------------------------------------------------------- strips

PARTS = "--pulses, --polarization"
HALF_POWER = 0.886  # wavelengths over length: width of an evenly lit antenna's beam
BAND_OF_PRF = 0.8  # of the PRF, that the Doppler band of a beam of unknown width fills
MOMENTS = 9  # at which the Doppler frequency of the beam's centre is computed
TILTED = np.radians(10.0)  # an antenna's axis that lies farther off the track is none
SATELLITE = 1e5  # m: platforms above it are satellites
TOLD = 0.05  # m along the track that are worth a note

Rows = Callable[[int, IntArray], ComplexArray]  # samples of a channel at some pulses of the file


@dataclass(frozen=True, kw_only=True, eq=False)
class RawStrip:
    """A strip as its format states it: raw echo, orbit, attitude and radar.

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
    centre : float or None
        Of the pulse, from its beginning, s; None: half its width.
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
    centre: float | None = None
    steering: FloatArray | None = None
    origin: Georeference | None = None

    def taking(self, options: PartOptions) -> RawStrip:
        """Copy with the user's delay, chirp sign and time tags."""
        rate = {None: self.chirp_rate, "up": abs(self.chirp_rate), "down": -abs(self.chirp_rate)}[options.chirp_sign]
        tags = getattr(options, "time_tags", None) or self.tags
        return replace(self, delay=self.delay - options.range_delay, chirp_rate=rate, tags=tags)

    @property
    def to_centre(self) -> float:
        """Time from the beginning of the pulse to its centre, s."""
        return self.pulse_width / 2 if self.centre is None else self.centre

    @property
    def middle_range(self) -> float:
        """Slant range, m, of mid-swath by the pulse's centre."""
        return SPEED_OF_LIGHT / 2 * (float(self.delay[0] + self.delay[-1]) / 2 - self.to_centre)

    @property
    def moment(self) -> FloatArray:
        """Times (n_slot,), s, at which the antenna is midway between transmission and reception (see the module)."""
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
        """Antenna axis along the flight (n_slot, 3), Earth-centred, with a note if it does not come from the file."""
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
        """Full width of the beam, rad, and its origin in words."""
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
    def doppler(self) -> tuple[FloatArray, float]:
        """Doppler of the beam's centre at mid-swath (n_slot,), Hz, and the lit band, Hz.

        See the module.
        """
        n, slots = self.even.time.size, np.unique(np.linspace(0, self.even.time.size - 1, MOMENTS).astype(int))
        wavelength = SPEED_OF_LIGHT / self.carrier
        ends = SPEED_OF_LIGHT / 2 * (self.delay[[0, -1]] - self.to_centre)
        centres = []
        for slot in slots:
            place, velocity, axis = self.track[0][slot], self.track[1][slot], self.axis[0][slot]
            squint = 0.0 if self.steering is None else float(self.steering[slot])
            for away in (*ends, self.middle_range):
                try:
                    ground = find_scene_centre(
                        place, axis, slant_range=float(away), side=self.side, height=0.0, squint=squint
                    ).origin
                except InputError:  # the window begins before the ground does
                    centres.append(np.nan)
                    continue
                centres.append(2 / wavelength * float(velocity @ (ground - place)) / float(away))
        near, far, middle = np.array(centres).reshape(-1, 3).T
        speed = float(np.linalg.norm(self.track[1], axis=1).max())
        over_range = 2 * float(np.nanmax(np.abs([near - middle, far - middle]), initial=0.0))
        over_chirp = abs(self.chirp_rate) * self.pulse_width / (2 * self.carrier)
        beam = 4 * speed / wavelength * float(np.sin(self.beam[0] / 2)) * (1 + over_chirp)
        band = beam + over_range + 2 * float(np.nanmax(np.abs(middle))) * over_chirp
        return np.interp(np.arange(n), slots, middle), band

    @cached_property
    def resampling(self) -> Resampling | None:
        """Resampling of uneven pulses to the even axis; None if they are even.

        Raises
        ------
        InputError
            If they are fewer than the beam's Doppler band needs, or most cannot be computed.
        """
        even = self.even
        if even.slots is not None:
            return None
        steps, prf, band = np.diff(even.sent), 1 / even.interval, self.doppler[1]
        uneven = f"intervals between pulses are {1e6 * steps.min():.6g} .. {1e6 * steps.max():.6g} us"
        first, stop = even.run
        remedy = f"pulses {first}:{stop} are even: take them with --pulses" if stop - first >= LEAST else (
            "no part of them is even, and no phase history holds others"
        )  # fmt: skip
        if not band <= OCCUPIED * prf:
            raise InputError(
                f"{uneven}, and the beam lights {band:.5g} Hz of Doppler, too much to resample at {prf:.5g} Hz on "
                f"average ({OCCUPIED * prf:.5g} Hz at most); {remedy}"
            )
        resampling = plan_resampling(even.sent, even.time, band=max(band, BAND_OF_PRF * prf))
        refuse_few(int(np.count_nonzero(resampling.good)), even.time.size, uneven, remedy)
        return resampling

    @cached_property
    def cycles(self) -> FloatArray:
        """Phase of the beam's centre, integrated Doppler, cycles (n_slot,)."""
        centre = self.doppler[0]
        return np.concatenate([[0.0], np.cumsum(np.diff(self.even.time) * (centre[1:] + centre[:-1]) / 2)])

    def samples(self, channel: int, pulses: slice) -> ComplexArray:
        """Read samples of some slots, NaN for lost ones and those that cannot be computed."""
        even, resampling = self.even, self.resampling
        if resampling is not None:
            around = resampling.inputs(pulses)
            uneven = self.read(channel, even.pulses[around])
            uneven = uneven * unit_phasor(-np.interp(even.sent[around], even.time, self.cycles))[:, None]
            return resampling.apply(uneven, pulses) * unit_phasor(self.cycles[pulses])[:, None]
        assert even.slots is not None
        samples = np.full((pulses.stop - pulses.start, self.delay.size), np.nan, np.complex64)
        low, high = np.searchsorted(even.slots, [pulses.start, pulses.stop])
        if high > low:
            samples[even.slots[low:high] - pulses.start] = self.read(channel, even.pulses[low:high])
        return samples

    def _resampled(self, resampling: Resampling) -> str:
        """Describe the errors of the resampling."""
        good, band = resampling.good, max(self.doppler[1], BAND_OF_PRF / self.even.interval)
        return (
            f"{np.count_nonzero(~good)} of {good.size} even pulses with too few neighbours to be computed: missing "
            f"in the store; the error of others is at most {20 * np.log10(resampling.bound[good].max()):.0f} dB of an "
            f"echo within {band:.5g} Hz of Doppler about the beam's centre"
        )

    def told_sign(self) -> list[str]:
        """Note if echoes of the middle pulses have far more contrast with a chirp of the other sign."""
        middle = self.even.pulses.size // 2
        echo = self.read(0, self.even.pulses[max(middle - PULSES // 2, 0) : middle + PULSES // 2])
        own, other = contrasts(
            echo, chirp_rate=self.chirp_rate, pulse_width=self.pulse_width, sampling_rate=self.sampling_rate
        )
        if not other > DECIDED * own:
            return []
        sign = CHIRP_SIGNS[self.chirp_rate > 0]
        return [
            f"the chirp has the other sign by the samples, whose contrast over range is {other:.3g} with it and "
            f"{own:.3g} without: ingest again with --chirp-sign {sign}"
        ]

    @cached_property
    def frame(self) -> Georeference:
        """Make the frame about the ground at the middle of beam, swath and pulses, x pointing away from the track."""
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
        """Default ground: the ellipsoid at the frame's height for satellites, else the plane."""
        return "ellipsoid" if float(self.frame.from_ecef(self.track[0][0])[2]) > SATELLITE else "plane"

    @cached_property
    def atmosphere(self) -> FloatArray:
        """Delay, one way in m, of a standard atmosphere at mid-swath, for the first, middle and last slot."""
        n = self.even.time.size
        return slant_delay(self.track[0][[0, n // 2, -1]], self.frame.origin, self.frame)

    def collection(self, options: PartOptions) -> tuple[Collection, RawEcho]:
        """Make collection and raw echo, without samples."""
        removed = float(self.atmosphere.mean()) if options.troposphere else 0.0
        fast_time = self.delay - self.to_centre - 2 * removed / SPEED_OF_LIGHT
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
        """Make the attributes of the store."""
        start = self.epoch + timedelta(seconds=float(self.moment[0]))
        source = {
            "format": self.format,
            "collection_start": f"{start.replace(tzinfo=None).isoformat(timespec='microseconds')}Z",
            "time_zero": self.even.interval * (self.even.time.size // 2),
            "time_tags": self.tags,
            **options.said,
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
        """Describe the time tags that positions are taken at, and the alternatives."""
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
        """Collect warnings for the user, a sentence each."""
        interval, n = self.even.interval, self.even.time.size
        taken = "taken out" if options.troposphere else "in the samples; --troposphere standard takes it out"
        note = self.axis[1]
        turned = f"x away from the track, {self.frame.rotation:.2f} degrees from east"
        turned = turned if self.origin is None else "x east, y north"
        return [
            f"{n} pulses at {1 / interval:.6g} Hz, {self.delay.size} samples at {frequency_text(self.sampling_rate)}; "
            f"delays of the file count from the pulse's start, those of the store from its centre",
            *self.notes,
            *options.notes,
            *([note] if note else []),
            f"beam: {self.beam[1]}",
            self._tagged(),
            f"the delay of a standard atmosphere, {delay_words(self.atmosphere)}, is {taken}",
            f"scene frame: {turned}, z up at latitude {self.frame.latitude:.6f}, longitude "
            f"{self.frame.longitude:.6f}, height {self.frame.height:.1f} m; the ground is "
            f"the {self.surface} by default",
        ]  # fmt: skip

    def reading(self, options: PartOptions) -> Reading:
        """Make the reading of the strip: its pieces are still to be read."""
        collection, raw = self.collection(options)
        resampled = [] if self.resampling is None else [self._resampled(self.resampling)]  # refused before anything
        several = len(self.polarizations) > 1
        return Reading(
            collection=collection, raw=raw, pieces=lambda: _pieces(self), attributes=self.attributes(options),
            messages=lambda: [*self.remarks(options), *resampled, *self.told_sign()],
            channels=self.polarizations if several else (), parts=PARTS,
        )  # fmt: skip


def _polarization(text: str) -> dict[str, str]:
    """Attribute `polarization` from a text such as HV; L and R are circular."""
    transmit, receive = ({"L": "LHC", "R": "RHC"}.get(each, each) for each in text)
    return {"transmit": transmit, "receive": receive}


def _pieces(strip: RawStrip) -> Iterator[Piece]:
    for channel in range(len(strip.polarizations)):
        for pulses in blocks_of(strip.even.time.size, strip.delay.size):
            yield Piece(channel, pulses, partial(strip.samples, channel, pulses))


def common_window(first: IntArray, stop: IntArray, most: int) -> tuple[slice, str | None]:
    """Samples common to all pulses, which have first .. stop - 1 of `most`; and a note if some have more.

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
    """Reader of strips; see `Reader`.

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
        """Describe a strip by what would be stored of it."""
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
