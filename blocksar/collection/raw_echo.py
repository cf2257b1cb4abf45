"""Fast-time axis and chirp of a raw echo.

From each range, a raw echo records the whole pulse or a part of it.

A target at range R answers during the two-way delays 2 R / c +- T / 2, of which the fast-time window holds a part p(R):
all of it between whole ranges, and outwards from these, over one pulse length c T / 2, less and less. A linear chirp
has the frequency K tau at its time tau: a part of the pulse is the same part of the band, from one of its ends. The
echo is divided by the spectrum of the whole chirp, so that the signal of such a target has modulus 1 over that part of
the band and next to nothing over the rest. Under weights W over the band, which are even, its image peaks at

    share(R) = integral of W over the part / integral of W.

Divided by it the target peaks at 1; it stays broader, by 1 / p. The part's edge is rounded over sqrt(K) of frequency:
the share errs by up to 0.005 where B T is 378, and by 0.01 where it is 100. Noise reaches a pixel through the same part
of the matched filter, so that its power falls with the share under W^2.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from math import isfinite
from typing import Any, Self

import numpy as np

from blocksar.arrays import UNIFORM_TOLERANCE, FloatArray, check_axis
from blocksar.collection.weighting import Taper
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.kernels.fourier import fast_length

ATTRIBUTE = "recorded"  # of stores whose signal was a raw echo
NODES = 4096  # of the integral over the band


@dataclass(frozen=True, kw_only=True)
class RecordedRanges:
    """The fast-time window of a raw echo and its pulse, as ranges.

    Attributes
    ----------
    near, far : float
        c / 2 times the delays at which the window begins and ends, m: half a sample before the first, after the last.
    pulse : float
        Length of the pulse, c T / 2, m.
    partial : bool
        Whether ground is imaged of whose pulses only parts were recorded.

    Raises
    ------
    InputError
        If they are no such ranges.
    """

    near: float
    far: float
    pulse: float
    partial: bool = False

    def __post_init__(self) -> None:
        if not (all(map(isfinite, (self.near, self.far, self.pulse))) and self.pulse > 0 and self.near < self.far):
            raise InputError(
                f"{ATTRIBUTE} is {self.near!r} .. {self.far!r} m with a pulse of {self.pulse!r} m; give finite ranges, "
                "near below far, and a pulse above 0"
            )

    @classmethod
    def among(cls, attrs: Mapping[str, Any]) -> Self | None:
        """Read the recorded ranges that the attributes of a store state; None if they state none.

        Raises
        ------
        InputError
            If they are not as `as_attribute` writes them.
        """
        match attrs.get(ATTRIBUTE):
            case None:
                return None
            case {"near": int() | float() as near, "far": int() | float() as far, "pulse": int() | float() as pulse,
                  "partial": bool() as partial}:  # fmt: skip
                return cls(near=near, far=far, pulse=pulse, partial=partial)
            case other:
                raise InputError(f"{ATTRIBUTE} is {other!r}; it must have near, far and pulse in m, and partial")

    def as_attribute(self) -> dict[str, Any]:
        return asdict(self)

    @property
    def whole(self) -> tuple[float, float]:
        """First and last range of which whole pulses were recorded, m; first > last if there are none."""
        return self.near + self.pulse / 2, self.far - self.pulse / 2

    @property
    def reached(self) -> tuple[float, float]:
        """First and last range of which any part of a pulse was recorded, m."""
        return self.near - self.pulse / 2, self.far + self.pulse / 2

    def part(self, distance: FloatArray) -> FloatArray:
        """The recorded part p of the pulses from ranges of any shape, m."""
        inside = np.minimum(distance + self.pulse / 2, self.far) - np.maximum(distance - self.pulse / 2, self.near)
        return np.clip(inside / self.pulse, 0.0, 1.0)

    def share(self, distance: FloatArray, taper: Taper, power: int = 1) -> FloatArray:
        """The share of the integral of W^power that falls on the recorded part, for ranges of any shape, m."""
        part = self.part(distance)
        if taper.uniform:
            return part
        sums = np.concatenate([[0.0], np.cumsum(taper.samples(NODES) ** power)])
        return np.asarray(np.interp(part, np.linspace(0, 1, NODES + 1), sums / sums[-1]))


@dataclass(frozen=True, kw_only=True, eq=False)
class RawEcho:
    """Fast-time metadata of a raw echo, in addition to its `Collection`.

    The pulse is rect(tau / T) exp(j pi K tau^2), centred on the delay 2 R / c.

    Attributes
    ----------
    fast_time : (n_fast_time,) float
        Two-way delay, s; uniform, ascending.
    chirp_rate : float
        K, Hz/s; negative for a down-chirp.
    pulse_width : float
        T, s.
    sampling_rate : float
        Hz.

    Raises
    ------
    InputError
        If fast_time is not uniform, is shorter than the pulse, or sampled more slowly than the chirp is wide.
    """

    fast_time: FloatArray
    chirp_rate: float
    pulse_width: float
    sampling_rate: float

    def __post_init__(self) -> None:
        time = np.array(self.fast_time, dtype=np.float64)
        time.flags.writeable = False
        object.__setattr__(self, "fast_time", time)
        check_axis(time, "fast_time", "s")
        if not (isfinite(self.chirp_rate) and self.chirp_rate):
            raise InputError(f"chirp_rate must be a finite number of Hz/s other than 0, got {self.chirp_rate!r}")
        span = float(time[-1] - time[0])
        if not 0 < self.pulse_width <= span:
            raise InputError(
                f"pulse_width is {self.pulse_width:.6g} s, but must be above 0 and within the {span:.6g} s of fast_time"
            )
        # An error of half a step over the whole axis would already shift the frequencies below.
        if not abs(self.sampling_rate * span - (time.size - 1)) < 0.5:
            raise InputError(
                f"sampling_rate is {self.sampling_rate:.9g} Hz, but fast_time is sampled at "
                f"{(time.size - 1) / span:.9g} Hz; make them agree"
            )
        if self.bandwidth > self.sampling_rate * (1 + UNIFORM_TOLERANCE):
            raise InputError(
                f"chirp_rate times pulse_width is {self.bandwidth:.6g} Hz, but fast_time is sampled at only "
                f"{self.sampling_rate:.6g} Hz; sample faster, or correct chirp_rate or pulse_width"
            )

    @property
    def bandwidth(self) -> float:
        """Bandwidth of the chirp, |K| T, Hz."""
        return abs(self.chirp_rate) * self.pulse_width

    @property
    def range_frequency(self) -> FloatArray:
        """Frequencies of the transform over fast time, centred at 0 and limited to the band of the chirp, Hz.

        A transform of the n samples is periodic in delay over n dt, and they hold echoes from n dt + T of delay. Those
        beyond the window fold to its other end, at most T / 2 deep: onto delays of which whole pulses were not recorded
        either. Ground with whole pulses has only the side lobes of what folds, below 1 / (pi B T) of a target.
        """
        n = self.fast_time.size
        grid = (np.arange(n) - n // 2) * (self.sampling_rate / n)
        # A grid point may lie on the band's edge: the margin keeps rounding from deciding whether it is in.
        return grid[np.abs(grid) <= self.bandwidth / 2 * (1 + 1e-9)]

    @property
    def padded_range_frequency(self) -> FloatArray:
        """Range frequencies, Hz, of a transform of n + 2 T rate samples, for ground with parts of pulses as well.

        No two echoes may share a delay there, which takes n dt + T. Padded by a pulse more, what folds stays as far
        from all ground as a pulse is long, and ground that is divided by a small part does not show its side lobes. A
        part of a pulse is a part of the band: there are as many frequencies as the band has steps, about its middle, so
        that they fill it to half of a step.
        """
        step = self.sampling_rate / fast_length(self.fast_time.size + 2 * self.pulse_width * self.sampling_rate)
        count = round(self.bandwidth / step)
        return np.asarray((np.arange(count) - (count - 1) / 2) * step)

    def recorded(self, *, partial: bool = False) -> RecordedRanges:
        """The ranges that the echo recorded."""
        half, step = SPEED_OF_LIGHT / 2, 1 / self.sampling_rate
        return RecordedRanges(
            near=half * (float(self.fast_time[0]) - step / 2), far=half * (float(self.fast_time[-1]) + step / 2),
            pulse=half * self.pulse_width, partial=partial,
        )  # fmt: skip
