"""Bursts in packet files: consecutive pulses of one swath, PRF and chirp, with continuous steering."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np

from blocksar import texts
from blocksar.arrays import FloatArray, IntArray
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError, quoted
from blocksar.options import Option
from blocksar.places import Location, readable
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place
from blocksar.places.ranges import Readable
from blocksar.readers.reading import reading
from blocksar.readers.registry import refuse_few, refuse_others
from blocksar.readers.sentinel1.packets import KIND, REFERENCE, SUPPRESSED, SWATHS, Packets, Radar, read_headers
from blocksar.readers.strips import RawOptions
from blocksar.spans import parse_pulses

# ---------------------------------------------------------------- bursts

LEAST = 16  # pulses that are worth an image
LONGEST_GAP = 256  # pulses that are lost within a burst; more divide it
WANDER = 0.25  # of a PRI, by which the times of packets may depart from their numbers of PRIs
# Rates of the steering in degrees/s, as annotated in level 1 products (azimuthSteeringRate).
RATES = {
    "IW1": 1.590368784, "IW2": 0.979863325, "IW3": 1.397440818, "EW1": 2.390895448, "EW2": 2.811502724,
    "EW3": 2.366195855, "EW4": 2.512694636, "EW5": 2.122855427,
}  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Burst:
    """Burst: echoes of one receiver.

    Attributes
    ----------
    packets : Packets
        In the order of their transmission.
    number : int
        In its swath, from 0.
    zero : int
        GPS second from which times count.
    first, n_slot : int
        Number of the PRI in which the burst's first pulse was sent, and PRIs from there to that of the last.
    internal : float
        Delay of the instrument itself, which is taken off, s.
    options : RawOptions
        What is said of its echoes.
    """

    packets: Packets
    number: int
    zero: int
    first: int
    n_slot: int
    internal: float = 0.0
    options: RawOptions = RawOptions()  # noqa: RUF009

    @property
    def swath(self) -> str:
        return swath_name(int(self.packets.swath[0]))

    @property
    def polarization(self) -> str:
        return polarizations(self.packets[:1])[0]

    @property
    def name(self) -> str:
        return f"{self.swath}-{self.polarization}-{self.number:03d}"

    @cached_property
    def radar(self) -> Radar:
        sign = {"up": 1.0, "down": -1.0, None: None}[self.options.chirp_sign]
        return self.packets.radar if sign is None else self.packets.radar.signed(sign)

    @property
    def interval(self) -> float:
        """Pulse repetition interval, s."""
        return float(self.packets.interval[0]) / REFERENCE

    @cached_property
    def slots(self) -> IntArray:
        """Slot of each pulse, from 0: that of the PRI in which it was transmitted."""
        return np.asarray(self.packets.pulse - self.packets.rank - self.first)

    @cached_property
    def sent(self) -> float:
        """Transmission time of the first pulse, s after `zero`; packets state that of the PRI that receives the echo.

        Raises
        ------
        InputError
            If times and numbers of PRIs contradict each other.
        """
        packets = self.packets
        late = packets.times(self.zero) - self.interval * (packets.pulse - packets.pulse[0])
        if np.ptp(late) > WANDER * self.interval:
            raise InputError(
                f"times of packets in burst {self.name} wander by {1e6 * np.ptp(late):.3g} us off their numbers of "
                "PRIs; leave it out with --bursts"
            )
        return float(late.mean() - self.interval * (packets.rank[0] + self.slots[0]))

    @cached_property
    def delay(self) -> FloatArray:
        """Delay of each pulse's first sample after the beginning of transmission at the antenna, s."""
        window = self.packets.window / REFERENCE + SUPPRESSED - self.internal - self.options.range_delay
        return np.asarray(self.packets.rank * self.interval + window)

    @cached_property
    def samples(self) -> tuple[float, int]:
        """First delay (s) and number of the samples common to all pulses; see `shared_samples`."""
        return shared_samples([self])

    @property
    def middle_delay(self) -> float:
        """Delay, s, from the beginning of a pulse to that of an echo from mid-swath."""
        first, count = self.samples
        return first + (count - 1) / (2 * self.radar.rate) - self.radar.length / 2

    @property
    def middle_range(self) -> float:
        return SPEED_OF_LIGHT / 2 * self.middle_delay


def shared_samples(bursts: Sequence[Burst]) -> tuple[float, int]:
    """First delay (s) and number of the samples common to all pulses of a burst's receivers.

    Raises
    ------
    InputError
        If these are less than half of what a pulse has.
    """
    rate, name = bursts[0].radar.rate, bursts[0].name
    delay = np.concatenate([burst.delay for burst in bursts])
    count = np.concatenate([2 * burst.packets.quads for burst in bursts])
    first = float(delay.max())
    last = float((delay + (count - 1) / rate).min())
    shared = int(np.floor((last - first) * rate + 1e-3)) + 1
    if shared < np.median(count) / 2:
        raise InputError(
            f"receive windows in burst {name} have {max(shared, 0)} samples in common, of {int(np.median(count))}; "
            "take parts of it alone, or leave it out with --bursts"
        )
    return first, shared


def swath_name(number: int) -> str:
    return SWATHS.get(number, f"SWATH{number}")


def polarizations(packets: Packets) -> list[str]:
    """Transmitted and received polarisation of each packet, such as VH."""
    return [
        ("H" if sent < 4 else "V") + ("H" if received else "V")
        for sent, received in zip(packets.polarization, packets.receiver, strict=True)
    ]


CONSTANT = ("take", "interval", "ramp", "start", "length", "decimation", "polarization")  # within a burst


def find_bursts(packets: Packets, zero: int) -> tuple[list[Burst], list[str]]:
    """Divide the echoes of a file into bursts; also return notes on what was left out."""
    echoes = packets[packets.echo]
    bursts: list[Burst] = []
    small = 0
    for swath in np.unique(echoes.swath):
        own = echoes[echoes.swath == swath]
        sent = own.pulse - own.rank
        changed = np.zeros(len(own) - 1, bool)
        for name in (*CONSTANT, "receiver"):
            changed |= np.diff(getattr(own, name)) != 0
        changed |= (np.diff(sent) < 1) | (np.diff(sent) > LONGEST_GAP) | (np.diff(own.azimuth) < 0)
        number = 0
        for rows in np.split(np.arange(len(own)), np.flatnonzero(changed) + 1):
            if rows.size < LEAST:
                small += rows.size
                continue
            first, last = int(sent[rows[0]]), int(sent[rows[-1]])
            bursts.append(Burst(packets=own[rows], number=number, zero=zero, first=first, n_slot=last - first + 1))
            number += 1
    bursts.sort(key=lambda burst: (burst.packets.seconds[0], burst.packets.fine[0]))
    refuse_few(len(echoes) - small, len(echoes), f"most echoes lie in parts of less than {LEAST} pulses",
               "give a longer part of the data")  # fmt: skip
    notes = [f"{small} of {len(echoes)} echoes in parts of less than {LEAST} pulses: left out"] if small else []
    return bursts, notes


def as_received(burst: Burst, files: Sequence[PacketFile]) -> Channel | None:
    """Find a burst's pulses from another receiver, in the file with most of them; None if fewer than LEAST."""
    found: list[Channel] = []
    for file in files:
        packets = file.packets
        sent = packets.pulse - packets.rank
        of_it = packets.echo & (sent >= burst.first) & (sent < burst.first + burst.n_slot)
        for name in (*CONSTANT, "swath"):
            of_it &= getattr(packets, name) == getattr(burst.packets, name)[0]
        rows = np.flatnonzero(of_it)
        _, once = np.unique(sent[rows], return_index=True)
        if once.size >= LEAST:
            found.append((file, replace(burst, packets=packets[rows[once]])))
    return max(found, key=lambda each: len(each[1].packets), default=None)


@dataclass(frozen=True, kw_only=True, eq=False)
class Steering:
    """Electronic steering of a swath's beam: the angle ahead of broadside rises linearly with time.

    Headers have a beam address that rises through a burst. The address at the middle of whole bursts is taken for
    broadside, so that a burst which the data cut has its own part of the law; the rate is that of level 1 products.

    Attributes
    ----------
    rate : float
        rad/s; 0: not steered.
    broadside : float or None
        The address of the beam at broadside; None where addresses do not rise, and the middle of a burst is taken.
    """

    rate: float
    broadside: float | None

    @classmethod
    def of(cls, bursts: Sequence[Burst]) -> Steering:
        """Derive the steering of a swath from its bursts."""
        rate = np.radians(RATES.get(bursts[0].swath, 0.0))
        if not rate:
            return cls(rate=0.0, broadside=None)
        longest = max(burst.n_slot for burst in bursts)
        lines = [_line(burst) for burst in bursts if burst.n_slot >= 0.95 * longest]
        middles = [middle for slope, middle in lines if slope > 0]
        return cls(rate=rate, broadside=float(np.median(middles)) if middles else None)

    def angle(self, burst: Burst, time: FloatArray) -> FloatArray:
        """Beam angle (n,), rad, at times (n,), s, after `zero`."""
        middle = burst.sent + burst.interval * ((burst.n_slot - 1) / 2 + float(burst.packets.rank[0]))
        slope, address = _line(burst)
        if self.broadside is not None and slope > 0:
            middle += (self.broadside - address) / slope
        return np.asarray(self.rate * (time - middle))

    def describe(self) -> str:
        if not self.rate:
            return "the beam is not steered along the track"
        where = "the middle of each burst" if self.broadside is None else f"beam address {self.broadside:.4g}"
        known = "beam addresses do not rise, and " if self.broadside is None else ""
        return f"{known}the beam is steered by {np.degrees(self.rate):.6g} degrees/s, with broadside at {where}"


def _line(burst: Burst) -> tuple[float, float]:
    """Rate of the beam's address, 1/s, and its value at mid-burst, by a straight-line fit."""
    pulse = burst.packets.pulse - burst.packets.pulse[0]
    own = pulse - pulse.mean()
    slope = float((own * burst.packets.azimuth).sum() / (own**2).sum())
    middle = (burst.n_slot - 1) / 2 - float(pulse.mean())
    return slope / burst.interval, float(burst.packets.azimuth.mean()) + slope * middle


# ---------------------------------------------------------------- files of packets

TimeTags = Literal["transmit", "middle"]
TIME_TAGS = ("transmit", "middle")
POLARIZATIONS = tuple(sent + received for sent in "HV" for received in "HV")


def _one_of(option: str, values: tuple[str, ...], value: Any) -> str | None:
    if value is None:
        return None
    found = {each.lower(): each for each in values}.get(str(value).lower())
    if found is None:
        raise InputError(f"{option} is {quoted(value)}; it must be {' or '.join(values)}")
    return found


def _path(value: Any) -> Any:
    if value is not None and not isinstance(value, str | os.PathLike | Place):
        raise InputError(f"--orbit is {quoted(value)}; give the path of an EOF file")
    return value


@dataclass(frozen=True, kw_only=True)
class Sentinel1Options(RawOptions):
    """Selected part of the data, and corrections to it; see `RawOptions`.

    Attributes
    ----------
    swath : str, optional
        The one swath that is read, such as "IW1". Default: all.
    polarization : str, optional
        Of transmitter and receiver. Default: all of one transmitter, as channels of the store.
    bursts : str or (int, int), optional
        Bursts "a:b" of each swath that are read, from a to the one before b, counted from 0. Default: all.
    orbit : path, optional
        Precise orbit (EOF). Default: the states in the packets.
    time_tags : {"transmit", "middle"}, optional
        What the packets' times are those of: the pulse's transmission, or the positions of an antenna that stands still
        while a pulse is out, as in simulations. Default: the PRI in which the echo is received.
    troposphere : {"standard"}, optional
        The delay that the samples hold, and that is taken out: a standard atmosphere's. Default: none.
    """

    swath: Annotated[
        str | None,
        Option("The one swath that is read.", metavar="IW1", default="all",
               read=partial(_one_of, "--swath", tuple(SWATHS.values()))),
    ] = None  # fmt: skip
    polarization: Annotated[
        str | None,
        Option("Of transmitter and receiver.", metavar="VV", default="all of one transmitter, as channels",
               read=partial(_one_of, "--polarization", POLARIZATIONS)),
    ] = None  # fmt: skip
    bursts: Annotated[
        tuple[int, int | None],
        Option("Bursts of each swath that are read: A to the one before B.", metavar="A:B", default="all",
               read=partial(parse_pulses, option="--bursts", example="--bursts 0:3")),
    ] = (0, None)  # fmt: skip
    orbit: Annotated[
        Location | None,
        Option("Precise orbit.", metavar="FILE.EOF", default="the states in the packets", read=_path),
    ] = None
    time_tags: Annotated[
        TimeTags | None,
        Option("What times of packets are those of.", metavar="|".join(TIME_TAGS), default="the PRI that receives",
               read=partial(_one_of, "--time-tags", TIME_TAGS)),
    ] = None  # fmt: skip
    troposphere: Annotated[
        Literal["standard"] | None,
        Option("Delay to take out of the samples: that of a standard atmosphere.", metavar="standard", default="none",
               read=partial(_one_of, "--troposphere", ("standard",))),
    ] = None  # fmt: skip


DAMAGED, REMEDY = "damaged", "get it again"
BESIDE = re.compile(r"-(annot|index)\.dat$")  # files next to the packets in a SAFE folder


class PacketFile(NamedTuple):
    """Packets of one receiver in one file."""

    where: Readable
    packets: Packets

    @property
    def polarization(self) -> str | None:
        """Polarisation of the file's echoes; None if it has only noise and calibration."""
        echoes = self.packets[self.packets.echo]
        return polarizations(echoes[:1])[0] if len(echoes) else None


Channel = tuple[PacketFile, Burst]


def expand(sources: Sequence[Location]) -> list[Readable]:
    """List the packet files among these paths, and in folders among them.

    Raises
    ------
    InputError
        If there are none.
    """
    found: list[Readable] = []
    for source in sources:
        where = readable(source)
        if isinstance(where, LocalPlace) and where.path.is_dir():
            inside = [where / name for name in sorted(where.names()) if name.endswith(".dat")]
            found += (inside := [each for each in inside if not BESIDE.search(each.name)])
            if not inside:
                refuse_others(where, KIND)
                raise InputError(f"{where} holds no .dat file of packets; give a SAFE folder of level 0")
        elif not BESIDE.search(where.name):
            found.append(where)
    if not found:
        raise InputError("no file of packets is given; give the .dat file, not its annotation or index")
    return found


def open_files(sources: Sequence[Location]) -> list[PacketFile]:
    """Read the headers of all files.

    Raises
    ------
    InputError
        If one is of another kind, cut or damaged.
    """
    files = []
    for where in expand(sources):
        with reading(where, damaged=DAMAGED, remedy=REMEDY):
            refuse_others(where, KIND)
            with where.open() as file:
                packets = read_headers(file)
            own = [packets[packets.receiver == each] for each in np.unique(packets.receiver)]
            files += [PacketFile(where, each) for each in own]
    return files


class BurstChoice(NamedTuple):
    """Bursts in order of time, with their files, and the selected ones with the channels of all receivers.

    `packets` are those of the first receiver, which also has all bursts.
    """

    bursts: list[Channel]
    wanted: list[tuple[Channel, ...]]
    packets: Packets
    zero: int
    notes: list[str]


def choose(files: Sequence[PacketFile], options: Sentinel1Options) -> BurstChoice:
    """Select the requested bursts of one transmitter, with notes.

    Raises
    ------
    InputError
        If none is left.
    """
    have = list(dict.fromkeys(file.polarization for file in files if file.polarization is not None))
    if not have:
        n = sum(len(file.packets) for file in files)
        raise InputError(
            f"{files[0].where} holds {texts.count(n, 'packet')} of noise or calibration and no echo; give those of "
            "echoes"
        )
    like = [each for each in have if each[0] == each[1]]
    main = options.polarization or (like or have)[0]
    if main not in have:
        raise InputError(f"--polarization is {main}, but the packets have {', '.join(have)}; give one of these")
    others = [] if options.polarization else [each for each in have if each[0] == main[0] and each != main]
    notes = []
    if (left := [each for each in have if each not in (main, *others)]) and options.polarization is None:
        notes.append(f"of polarisations {', '.join(have)}, {', '.join(left)} is left out; take it with --polarization")
    of_it = [file for file in files if file.polarization == main]
    zero = min(int(file.packets.seconds.min()) for file in of_it)
    found: list[Channel] = []
    for file in of_it:
        bursts, burst_notes = find_bursts(file.packets, zero)
        found += [(file, burst) for burst in bursts]
        notes += burst_notes
    found.sort(key=lambda each: each[1].sent)
    counts: dict[str, int] = {}
    numbered: list[Channel] = []
    for file, burst in found:
        number = counts.get(burst.swath, 0)
        counts[burst.swath] = number + 1
        numbered.append((file, replace(burst, number=number, options=options)))
    first, last = options.bursts
    wanted: list[tuple[Channel, ...]] = []
    without: list[str] = []
    for file, burst in numbered:
        if options.swath in (None, burst.swath) and first <= burst.number and (last is None or burst.number < last):
            received = [as_received(burst, [each for each in files if each.polarization == other]) for other in others]
            if None in received:
                without.append(burst.name)
            else:
                wanted.append(((file, burst), *(each for each in received if each is not None)))
    if not counts:
        raise InputError(f"the packets hold no burst of {LEAST} pulses or more; give a longer part of the data")
    if without and not wanted:
        raise InputError(
            f"no burst has its pulses in all of {', '.join((main, *others))}; take one with --polarization {main}"
        )
    if without:
        notes.append(
            f"{', '.join(without)}: left out, since not all of {', '.join((main, *others))} have its pulses; "
            f"--polarization {main} takes it alone"
        )
    if not wanted:
        held = ", ".join(f"{number} of {swath}" for swath, number in counts.items())
        raise InputError(f"no burst is left by --swath and --bursts; the packets have {held}, counted from 0")
    return BurstChoice(numbered, wanted, Packets.joined([file.packets for file in of_it]), zero, notes)
