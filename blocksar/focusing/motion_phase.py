"""The phase that motion compensation removes: a series in range of functions of slow time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.polynomial import chebyshev

from blocksar.arrays import FloatArray, unrepeated


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """The phase psi of motion compensation: a Chebyshev series in range of functions of slow time.

    The second derivatives are linear between uniform times, so that value and slope follow exactly.

    Attributes
    ----------
    start, step : float
        Slow time from the epoch, s.
    value, slope, bend : (n, n_term) float
        psi_k (cycles), psi_k' (Hz) and psi_k'' (Hz/s) at those times.
    near, far : float
        Domain of range, m from the origin.
    """

    start: float
    step: float
    value: FloatArray
    slope: FloatArray
    bend: FloatArray
    near: float
    far: float

    @classmethod
    def integrate(
        cls, bend: FloatArray, like: FloatArray, *, start: float, step: float, near: float, far: float
    ) -> Self:
        """From second derivatives (n, n_term); constant and slope such that the values are `like` on average."""
        half_step = step / 2
        slope = np.zeros_like(bend)
        slope[1:] = np.cumsum(half_step * (bend[1:] + bend[:-1]), axis=0)
        value = np.zeros_like(bend)
        value[1:] = np.cumsum(step * slope[:-1] + step**2 / 6 * (2 * bend[:-1] + bend[1:]), axis=0)
        time = step * (np.arange(bend.shape[0]) - (bend.shape[0] - 1) / 2)
        apart = like - value
        mean = apart.mean(axis=0)
        tilt = (apart * time[:, None]).sum(axis=0) / (time * time).sum()
        return cls(
            start=start, step=step, value=value + mean + tilt * time[:, None], slope=slope + tilt, bend=bend,
            near=near, far=far,
        )  # fmt: skip

    @property
    def n_term(self) -> int:
        return self.value.shape[1]

    def terms(self, time: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """psi_k and its first two derivatives, (..., n_term), at slow times of any shape.

        Axes along which the times are repeated (`np.broadcast_to`) have length 1 in the result.
        """
        time = unrepeated(time)
        position = (time - self.start) / self.step
        i = np.clip(np.floor(position), 0, self.value.shape[0] - 2).astype(np.int64)
        t = ((position - i) * self.step)[..., None]
        value, slope, bend = self.value[i], self.slope[i], self.bend[i]
        twist = (self.bend[i + 1] - bend) / self.step
        return (
            value + t * (slope + t * (bend / 2 + t * twist / 6)),
            slope + t * (bend + t * twist / 2),
            bend + t * twist,
        )

    @cached_property
    def at_middle(self) -> Motion:
        """psi of the middle range alone: one term, with the factor 1."""
        sums = ((values * self.middle).sum(axis=1, keepdims=True) for values in (self.value, self.slope, self.bend))
        value, slope, bend = sums
        return replace(self, value=value, slope=slope, bend=bend)

    def factors(self, rng: FloatArray) -> FloatArray:
        """What multiplies each psi_k at ranges (...): (..., n_term)."""
        u = (2 * rng - self.near - self.far) / (self.far - self.near)
        return np.asarray(chebyshev.chebvander(u, self.n_term - 1), np.float64).reshape(*np.shape(rng), self.n_term)

    @property
    def middle(self) -> FloatArray:
        """The factors at the middle range, (n_term,)."""
        return self.factors(np.array((self.near + self.far) / 2))
