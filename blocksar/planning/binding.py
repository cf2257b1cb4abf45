"""A block's chain while it is being planned: kinds of steps, and the constants that they get as these become known."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.focusing.azimuth_steps import (
    AzimuthTransform,
    Deramp,
    DopplerResampling,
    DopplerTransform,
    FrequencyPerturbation,
    TimePerturbation,
)
from blocksar.focusing.chains import steps_of
from blocksar.focusing.lines import Line, RowPolynomial
from blocksar.focusing.method import Method
from blocksar.focusing.range_steps import (
    Compression,
    DopplerCompression,
    Keystone,
    RangeCompression,
    RangeGate,
    ResidualRangeWalk,
    TimeDomainCompression,
)
from blocksar.focusing.step import Step
from blocksar.kernels.fourier import Axis
from blocksar.kernels.interpolation import taps_needed
from blocksar.kernels.solvers import least_squares
from blocksar.planning.fitting import AzimuthPolynomials, Freedom

TAP_ERROR = 1e-4  # of the interpolation along azimuth: keystone and Doppler resampling
PACE_ORDER = 4  # of the pace along Doppler of the lines whose range curvature is corrected there
RATE_FLOOR = 1e-3  # of the largest Doppler rate
PACE_FLOOR = 0.05  # of the largest Doppler: at zero Doppler nothing walks, and any pace would do


class Slab(NamedTuple):
    """A block's part of the recovered spectrum."""

    first_bin: int
    doppler: Axis
    walk: float  # Hz on the carrier: the middle of the block's Doppler
    margin: float  # Hz
    band_edge: float  # of the range frequencies, over the carrier


class Axes(NamedTuple):
    """Sampling of a block's azimuth: as it comes out of the slab, and lengthened for deramping."""

    time: Axis
    occupancy: float  # part of that sampling rate which the slab fills
    doppler: Axis
    long_time: Axis
    filled: float  # part of the lengthened time that the samples fill


class Binding:
    """A block's chain while it is being planned: constants are put in as they become known.

    Lines do not ask how time, Doppler and rows are sampled, so they can go through steps whose axes are not known yet.
    """

    def __init__(
        self, method: Method, gate: RangeGate | None, *, slab: Slab, carrier: float, range_frequency: Axis
    ) -> None:
        self.method, self.kinds, self.gate, self.slab = method, steps_of(method), gate, slab
        self.carrier, self.range_frequency = carrier, range_frequency
        unknown = Axis(0.0, 1.0, 1)
        self.axes = Axes(time=unknown, occupancy=0.5, doppler=unknown, long_time=unknown, filled=0.5)
        self.rows = unknown
        self.reference: FloatArray = np.zeros(3)
        self.pace: FloatArray = np.zeros(1)
        self.half = 1.0
        none = RowPolynomial(series=np.zeros((1, 1)), near=-1.0, far=1.0, centre=0.0, scale=1.0)
        self.polynomials = AzimuthPolynomials(none, none, none, none, 0.0)

    @property
    def freedom(self) -> Freedom:
        kinds = self.kinds
        return Freedom(TimePerturbation in kinds, FrequencyPerturbation in kinds, DopplerResampling in kinds)

    @property
    def in_doppler(self) -> bool:
        """Whether ranges are compressed at each Doppler, not at each time."""
        return DopplerCompression in self.kinds

    @property
    def n_column(self) -> int:
        """Samples of a row when ranges are compressed."""
        return self.axes.doppler.size if self.in_doppler else self.axes.time.size

    def follow(self, line: Line) -> None:
        """Take the range curvature that DopplerCompression corrects from lines whose walk is out.

        Their pace dt/df along Doppler, by least squares over all lines, weighed by the range walk that an error makes.
        """
        if not self.in_doppler:
            return
        self.half = float(np.abs(line.doppler).max())
        z = (line.doppler / self.half).ravel()
        weight = np.abs(z) + PACE_FLOOR
        # Where acceleration cancels the Doppler rate there is no pace to follow: the plan will say what that costs.
        pace = (line.rate / np.maximum(line.rate**2, (RATE_FLOOR * np.abs(line.rate).max()) ** 2)).ravel()
        self.pace = least_squares(weight * z ** np.arange(PACE_ORDER + 1)[:, None], weight * pace)

    def _step(self, kind: type[Step]) -> Step:
        fc, f, axes, p = self.carrier, self.range_frequency, self.axes, self.polynomials
        if kind is ResidualRangeWalk:
            return ResidualRangeWalk(
                slab=self.slab.doppler, time=axes.time, walk=self.slab.walk, carrier=fc, range_frequency=f
            )
        if kind is Keystone:
            taps = taps_needed(axes.occupancy, error=TAP_ERROR)
            return Keystone(time=axes.time, occupancy=axes.occupancy, taps=taps, carrier=fc, range_frequency=f)
        if kind in (RangeCompression, TimeDomainCompression):
            return kind(time=axes.time, reference=self.reference, rows=self.rows, carrier=fc, range_frequency=f)
        if kind is DopplerCompression:
            return DopplerCompression(
                doppler=axes.doppler, pace=self.pace, half=self.half, rows=self.rows, carrier=fc, range_frequency=f
            )
        if kind is AzimuthTransform:
            return AzimuthTransform(time=axes.time, doppler=axes.doppler, rows=f if self.in_doppler else self.rows)
        if kind is TimePerturbation:
            return TimePerturbation(time=axes.time, rows=self.rows, phases=p.time)
        if kind is FrequencyPerturbation:
            return FrequencyPerturbation(doppler=axes.doppler, rows=self.rows, phases=p.doppler)
        if kind is DopplerResampling:
            taps = taps_needed(axes.filled, error=TAP_ERROR)
            return DopplerResampling(
                doppler=axes.doppler, rows=self.rows, shift=p.resampling, middle=p.middle, taps=taps,
                occupancy=axes.filled,
            )  # fmt: skip
        if kind is Deramp:
            return Deramp(doppler=axes.doppler, time=axes.long_time, rows=self.rows, phases=p.deramp)
        raise ValueError(f"{kind.__name__} is not a step that is bound here")

    def steps(self) -> list[Step]:
        """All but the final transform, which moves no line."""
        return [self._step(kind) for kind in self.kinds if kind is not DopplerTransform]

    def bound(self, final: DopplerTransform) -> tuple[Step, ...]:
        """The chain as it will be applied."""
        return (*(() if self.gate is None else (self.gate,)), *self.steps(), final)

    def trace_walk(self, line: Line) -> Line:
        return self._step(ResidualRangeWalk).trace(line)

    def trace_range(self, line: Line) -> Line:
        """Up to range compression."""
        for step in self.steps()[: self._compressed]:
            line = step.trace(line)
        return line

    def perturbed(self, line: Line) -> Line:
        """After range compression and the time perturbation: what goes into Doppler."""
        return line.multiply_time(*self.polynomials.time.evaluate(line.range.mean(axis=-1), line.time))

    def trace_azimuth(self, line: Line) -> Line:
        """After range compression."""
        for step in self.steps()[self._compressed :]:
            line = step.trace(line)
        return line

    @property
    def _compressed(self) -> int:
        return 1 + next(i for i, kind in enumerate(self.kinds) if issubclass(kind, Compression))
