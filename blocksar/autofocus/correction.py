"""The correction of a track: a cubic spline for each axis, with what the loops found on the way."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from blocksar.arrays import FloatArray, IntArray
from blocksar.autofocus.work import Work
from blocksar.collection.spline import basis, solve_normal

SAMPLES_PER_INTERVAL = 4  # of a chip, at least


@dataclass(frozen=True, kw_only=True, eq=False)
class Correction:
    """What is added to the stated positions, after some loops.

    Attributes
    ----------
    coefficients : (n_interval + 3, 3) float
        m; of cubic splines with knots from the first to the last pulse.
    weights : (n_point,) float
        Of the points in the next loop.
    history : tuple of dict
        Figures of each loop.
    finished : bool
        The last loop changed the phases by less than `Settings.step`, or was the last one allowed.
    previous : (n_interval + 3, 3) float
        Coefficients with which the chips of the last loop were taken.
    """

    coefficients: FloatArray
    weights: FloatArray
    history: tuple[dict[str, Any], ...] = ()
    finished: bool = False
    previous: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))

    @classmethod
    def none(cls, work: Work) -> Correction:
        """Nothing corrected so far."""
        return cls(coefficients=np.zeros((intervals(work) + 3, 3)), weights=np.ones(0))

    @property
    def before(self) -> Correction:
        """The correction with which the chips of the last loop were taken."""
        return Correction(coefficients=self.previous, weights=self.weights)

    def at(self, work: Work, time: FloatArray) -> FloatArray:
        """Displacement (n, 3) of the antenna at slow times (n,), m."""
        return Knots(work=work, n_interval=self.coefficients.shape[0] - 3, time=time).values(self.coefficients)


def intervals(work: Work) -> int:
    """Intervals of the finest spline that the samples of chips support, a power of two."""
    fine = int(np.clip(work.n_sample // SAMPLES_PER_INTERVAL, 4, work.settings.intervals))
    return 1 << (fine.bit_length() - 1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Knots:
    """The basis of splines with knots from the first to the last pulse, at some slow times.

    Attributes
    ----------
    work : Work
    n_interval : int
    time : (n,) float
        s.
    """

    work: Work
    n_interval: int
    time: FloatArray

    @property
    def start(self) -> float:
        return float(self.work.geometry.collection.time[0])

    @cached_property
    def step(self) -> float:
        """Spacing of the knots, s."""
        time = self.work.geometry.collection.time
        return float(time[-1] - time[0]) / self.n_interval

    @property
    def size(self) -> int:
        return self.n_interval + 3

    @cached_property
    def basis(self) -> tuple[IntArray, FloatArray]:
        """First of the four splines that are not 0 at each time (n,), and their values (n, 4)."""
        return basis(self.time, self.start, self.step, self.n_interval, 0)

    def values(self, coefficients: FloatArray) -> FloatArray:
        """Splines (n, n_axis) of coefficients (size, n_axis)."""
        first, weights = self.basis
        return np.asarray(sum(weights[:, k, None] * coefficients[first + k] for k in range(4)))

    def adjoint(self, values: FloatArray) -> FloatArray:
        """The transpose of `values`: (size, n_axis) of (n, n_axis)."""
        first, weights = self.basis
        total = np.zeros((self.size, values.shape[1]))
        for k in range(4):
            for axis in range(values.shape[1]):
                total[:, axis] += np.bincount(first + k, weights[:, k] * values[:, axis], minlength=self.size)
        return total

    def fit(self, values: FloatArray) -> FloatArray:
        """Coefficients (size, n_axis) of the least-squares splines through values (n, n_axis)."""
        first, weights = self.basis
        return solve_normal(first, weights, values, self.size)
