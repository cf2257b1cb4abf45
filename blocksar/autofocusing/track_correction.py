"""The correction of a track during the estimate, its log of loops, and its splines."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from blocksar.arrays import FloatArray, IntArray
from blocksar.autofocusing.work import FILTER_BAND, Work
from blocksar.collection.spline import basis, solve_normal

SAMPLES_PER_INTERVAL = 4  # of a chip, at least


@dataclass(frozen=True, kw_only=True, eq=False)
class Correction:
    """Displacement that is added to the stated positions, after some loops.

    Attributes
    ----------
    displacement : (n_sample, 3) float
        m, at `Work.sample_times`.
    previous : (n_sample, 3) float
        With this the chips of the last loop were taken.
    weights : (n_point,) float
        Of the points in the next loop; empty before the first.
    fine_error : float
        Error expected of what is too fine for the splines, rad rms.
    rough : bool
        In some loop the phase gradient alone was sharper by far than from the drift of spectra. If not, later loops
        start from what is corrected, and halves of the points from the drift.
    history : tuple of dict
        Figures of each loop.
    finished : bool
        The last loop changed the phases by less than `EstimatorSettings.step`, or was the last one allowed.
    """

    displacement: FloatArray
    previous: FloatArray
    weights: FloatArray
    fine_error: float = 0.0
    rough: bool = False
    history: tuple[dict[str, Any], ...] = field(default=())
    finished: bool = False

    @classmethod
    def none(cls, work: Work) -> Correction:
        """Return an empty correction: nothing is displaced yet."""
        nothing = np.zeros((work.n_sample, 3))
        return cls(displacement=nothing, previous=nothing, weights=np.ones(0))


def between_samples(work: Work, displacement: FloatArray, time: FloatArray) -> FloatArray:
    """Displacement (n, 3) at slow times (n,) from that at `work.sample_times`, by cubic convolution.

    References
    ----------
    Keys, "Cubic convolution interpolation for digital image processing", IEEE Trans. ASSP 29(6), 1981.
    """
    n = displacement.shape[0]
    at = np.interp(time, work.sample_times, np.arange(float(n)))
    before = np.clip(np.floor(at), 0, n - 2).astype(np.int64)
    s = (at - before)[:, None]
    # Extrapolate linearly beyond the ends.
    padded = np.concatenate(
        [2 * displacement[:1] - displacement[1:2], displacement, 2 * displacement[-1:] - displacement[-2:-1]]
    )
    a, b, c, d = (padded[before + k] for k in range(4))
    return np.asarray(b + s / 2 * (c - a + s * (2 * a - 5 * b + 4 * c - d + s * (3 * (b - c) + d - a))))


def intervals(work: Work) -> int:
    """Number of intervals of the finest spline that the samples of chips support, a power of two."""
    fine = int(np.clip(work.n_sample // SAMPLES_PER_INTERVAL, 4, work.settings.intervals))
    return 1 << (fine.bit_length() - 1)


def narrowing(work: Work, n_interval: int) -> int:
    """Factor by which chips are decimated for splines of `n_interval` intervals."""
    rate = work.settings.narrow_speed * work.wavenumber / np.pi / FILTER_BAND  # Hz
    by_speed = int(work.geometry.collection.prf / work.decimation / rate)
    return max(min(by_speed, work.n_sample // (2 * n_interval)), 1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Knots:
    """The basis of cubic splines with knots from the first to the last pulse, at some slow times.

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
        """Index of the first of the four splines that are not 0 at each time (n,), and their values (n, 4)."""
        return basis(self.time, float(self.work.geometry.collection.time[0]), self.step, self.n_interval, 0)

    def values(self, coefficients: FloatArray) -> FloatArray:
        """Splines (n, n_axis) of coefficients (size, n_axis)."""
        first, weights = self.basis
        return np.asarray(sum(weights[:, k, None] * coefficients[first + k] for k in range(4)))

    def adjoint(self, values: FloatArray) -> FloatArray:
        """Apply the transpose of `values`: (size, n_axis) from (n, n_axis)."""
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

    def smooth(self, values: FloatArray) -> FloatArray:
        """Smooth values (n, n_axis) by least-squares splines, at the same times."""
        return self.values(self.fit(values))
