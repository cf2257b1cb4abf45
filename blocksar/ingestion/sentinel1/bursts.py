"""Bursts: pulses of one swath, PRF and chirp that follow each other while the beam is steered one way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from blocksar.arrays import FloatArray, IntArray
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.ingestion.sentinel1.packets import REFERENCE, SUPPRESSED, SWATHS, Packets, Radar

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
    """Echoes of a burst.

    Attributes
    ----------
    packets : Packets
        In the order of their transmission.
    number : int
        In its swath, from 0.
    zero : int
        GPS second from which times count.
    """

    packets: Packets
    number: int
    zero: int

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
        return self.packets.radar

    @property
    def interval(self) -> float:
        """PRI, s."""
        return float(self.packets.interval[0]) / REFERENCE

    @cached_property
    def slots(self) -> IntArray:
        """Numbers of the pulses on an even axis, from 0: that of the PRI in which they were sent."""
        sent = self.packets.pulse - self.packets.rank
        return np.asarray(sent - sent[0])

    @property
    def n_slot(self) -> int:
        return int(self.slots[-1]) + 1

    @cached_property
    def sent(self) -> float:
        """When the first pulse was sent, s after `zero`: packets have the time of the PRI that receives the echo.

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
        return float(late.mean() - self.interval * packets.rank[0])

    @cached_property
    def delay(self) -> FloatArray:
        """Of the first sample of each pulse, from the beginning of its transmission, s."""
        return np.asarray(self.packets.rank * self.interval + self.packets.window / REFERENCE + SUPPRESSED)

    @cached_property
    def samples(self) -> tuple[float, int]:
        """First delay (s) and number of the samples that all pulses have.

        Raises
        ------
        InputError
            If these are less than half of what a pulse has.
        """
        count = 2 * self.packets.quads
        first = float(self.delay.max())
        last = float((self.delay + (count - 1) / self.radar.rate).min())
        shared = int(np.floor((last - first) * self.radar.rate + 1e-3)) + 1
        if shared < np.median(count) / 2:
            raise InputError(
                f"receive windows in burst {self.name} have {max(shared, 0)} samples in common, of "
                f"{int(np.median(count))}; take parts of it alone, or leave it out with --bursts"
            )
        return first, shared

    @property
    def middle_delay(self) -> float:
        """Of an echo in the middle of the swath, to its pulse's beginning, s."""
        first, count = self.samples
        return first + (count - 1) / (2 * self.radar.rate) - self.radar.length / 2

    @property
    def middle_range(self) -> float:
        return SPEED_OF_LIGHT / 2 * self.middle_delay


def swath_name(number: int) -> str:
    return SWATHS.get(number, f"SWATH{number}")


def polarizations(packets: Packets) -> list[str]:
    """Transmitted and received polarisation of each packet, such as VH."""
    return [
        ("H" if sent < 4 else "V") + ("H" if received else "V")
        for sent, received in zip(packets.polarization, packets.receiver, strict=True)
    ]


def find_bursts(packets: Packets, zero: int) -> tuple[list[Burst], list[str]]:
    """Divide the echoes of a file, and say what was left out."""
    echoes = packets[packets.echo]
    bursts: list[Burst] = []
    small = 0
    for swath in np.unique(echoes.swath):
        own = echoes[echoes.swath == swath]
        sent = own.pulse - own.rank
        changed = np.zeros(len(own) - 1, bool)
        for name in ("take", "interval", "ramp", "start", "length", "decimation", "polarization", "receiver"):
            changed |= np.diff(getattr(own, name)) != 0
        changed |= (np.diff(sent) < 1) | (np.diff(sent) > LONGEST_GAP) | (np.diff(own.azimuth) < 0)
        number = 0
        for rows in np.split(np.arange(len(own)), np.flatnonzero(changed) + 1):
            if rows.size < LEAST:
                small += rows.size
                continue
            bursts.append(Burst(packets=own[rows], number=number, zero=zero))
            number += 1
    bursts.sort(key=lambda burst: (burst.packets.seconds[0], burst.packets.fine[0]))
    notes = [f"{small} echoes in parts of less than {LEAST} pulses are left out"] if small else []
    return bursts, notes


@dataclass(frozen=True, kw_only=True, eq=False)
class Steering:
    """The electronic law of a swath's beam: its angle ahead of broadside rises evenly with time.

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
        """Steering of a swath's bursts."""
        rate = np.radians(RATES.get(bursts[0].swath, 0.0))
        if not rate:
            return cls(rate=0.0, broadside=None)
        longest = max(burst.n_slot for burst in bursts)
        lines = [_line(burst) for burst in bursts if burst.n_slot >= 0.95 * longest]
        middles = [middle for slope, middle in lines if slope > 0]
        return cls(rate=rate, broadside=float(np.median(middles)) if middles else None)

    def angle(self, burst: Burst, time: FloatArray) -> FloatArray:
        """Angle of the beam (n,), rad, at times (n,) after `zero`."""
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
    """How fast the beam's address rises, 1/s, and its value at the middle of the burst, by a line through all."""
    pulse = burst.packets.pulse - burst.packets.pulse[0]
    own = pulse - pulse.mean()
    slope = float((own * burst.packets.azimuth).sum() / (own**2).sum())
    middle = (burst.n_slot - 1) / 2 - float(pulse.mean())
    return slope / burst.interval, float(burst.packets.azimuth.mean()) + slope * middle
