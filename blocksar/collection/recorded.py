"""What part of its pulse a raw echo recorded from each range.

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

from blocksar.arrays import FloatArray
from blocksar.collection.weighting import Taper
from blocksar.errors import InputError

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
        """Those that the attributes of a store state; None if they state none.

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
        """First and last range of which whole pulses were recorded, m; first > last where of none."""
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
