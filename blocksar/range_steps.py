"""Range steps: range gate, residual range walk, keystone, RCMC with SRC. Each can be applied and traced.

Between recovery and range compression the samples are S(f, t), one row a range frequency, with the phase
exp(-4j pi (fc + f) / c rho(t)), rho the target's range less the origin and less the unified walk.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev

from blocksar import phase
from blocksar.fourier import Axis
from blocksar.lines import Line
from blocksar.parameters import SPEED_OF_LIGHT, FloatArray
from blocksar.phase import Phase
from blocksar.rows import Operation, Stretch, Transform, Turn, Window
from blocksar.steps import Step


class _FrequencyStep(Step):
    """Its rows lie along azimuth, one a range frequency."""

    range_frequency: Axis

    @property
    def n_row(self) -> int:
        return self.range_frequency.size


@dataclass(frozen=True, kw_only=True, eq=False)
class RangeGate(Step):
    """Keep some ranges of a block's slab, on as many fewer range frequencies: a block in range sub-blocks.

    At each Doppler bin the targets of a sub-block lie in an interval of range, whose centre moves along Doppler with
    their range walk. Range frequency goes to delay, about that centre; what lies beyond the gate is dropped, and what
    is left goes back to range frequency, over the same band in coarser steps.

    Attributes
    ----------
    slab : Axis
        Doppler bins, Hz.
    centre : (slab.size,) float
        Of the gate at each bin, m from the range origin.
    gate : Axis
        Delays from the centre that are kept, s.
    window : (gate.size,) float
        1, and falling to 0 at the ends.
    full, range_frequency : Axis
        Before and after, Hz.
    """

    name = "range-gate"
    layout = "columns"
    slab: Axis
    centre: FloatArray
    gate: Axis
    window: FloatArray
    full: Axis
    range_frequency: Axis

    @property
    def source(self) -> Axis:
        return self.full

    @property
    def n_row(self) -> int:
        return self.slab.size

    def operations(self) -> list[Operation]:
        """Rows of full.size to rows of range_frequency.size range frequencies, one a Doppler bin."""
        delay = 2 / SPEED_OF_LIGHT * self.centre
        shift = np.stack([np.zeros_like(delay), delay], axis=1)
        return [
            Turn(Phase(shift, 0.0, 1.0)),
            Transform(self.full, self.gate, inverse=True),
            Window(self.window[None].astype(np.complex64), np.zeros(self.n_row, np.intp)),
            Transform(self.gate, self.range_frequency, inverse=False),
            Turn(Phase(-shift, 0.0, 1.0)),
        ]

    def trace(self, line: Line) -> Line:
        return line


@dataclass(frozen=True, kw_only=True, eq=False)
class ResidualRangeWalk(_FrequencyStep):
    """Return a block's slab of Doppler to time, less the walk of the block's centre (paper A (16)).

    Multiplies by exp(-2j pi walk (fc + f) / fc t), which is (16) with
    walk = -2 / lambda (k_10,i - k_10). The slab's bins are read as if centred on zero: that is the walk on
    the carrier but for a fraction of a bin, and the phase left for each row is tiny.

    Attributes
    ----------
    slab : Axis
        Doppler of the block's part of the recovered spectrum, Hz.
    time : Axis
        Slow time from the epoch; as long as the recovered signal, sampled for the block's band.
    walk : float
        Hz on the carrier.
    """

    name = "residual-walk"
    slab: Axis
    time: Axis
    walk: float
    carrier: float
    range_frequency: Axis

    @property
    def source(self) -> Axis:
        return self.slab

    def operations(self) -> list[Operation]:
        """Rows of slab.size Doppler bins to rows of time.size samples, one a range frequency."""
        moved = round(self.walk / self.slab.step) * self.slab.step
        source = Axis(self.slab.start - moved, self.slab.step, self.slab.size)
        factor = self.walk * (1 + self.range_frequency.values / self.carrier) - moved
        walk = np.stack([np.zeros_like(factor), -factor], axis=1)
        return [Transform(source, self.time, inverse=True), Turn(Phase(walk, 0.0, 1.0))]

    def trace(self, line: Line) -> Line:
        turned = line.multiply_time(-self.walk * line.time, np.array(-self.walk), np.array(0.0))
        return turned.shift_range(SPEED_OF_LIGHT / (2 * self.carrier) * self.walk * line.time)


@dataclass(frozen=True, kw_only=True, eq=False)
class Keystone(_FrequencyStep):
    """Rescale slow time at each range frequency so that any linear range walk cancels (paper A (17)).

    S_out(f, t) = S(f, t fc / (fc + f)). On the carrier nothing moves; a target's apparent range becomes
    rho - t rho', without the walk.
    """

    name = "keystone"
    time: Axis
    carrier: float
    range_frequency: Axis
    occupancy: float
    taps: int

    @property
    def source(self) -> Axis:
        return self.time

    def operations(self) -> list[Operation]:
        """Rows of time.size samples, one a range frequency; zero where the input has no data."""
        scale = self.carrier / (self.carrier + self.range_frequency.values)
        middle = float(self.time.position(np.array(0.0)))
        return [Stretch(scale, middle, phase.tap_polynomials(self.taps, occupancy=self.occupancy))]

    def trace(self, line: Line) -> Line:
        return line.shift_range(SPEED_OF_LIGHT / (2 * self.carrier) * line.doppler * line.time)


@dataclass(frozen=True, kw_only=True, eq=False)
class RangeCompression(Step):
    """RCMC and SRC by one reference, then the transform to range (paper A (18)-(23), errata applied).

    Multiplies by exp{4j pi fc / c sum_n ((1 + f / fc)^(1-n) - 1) k_n t^n}, n >= 2: exact in f, where (22)
    expands to second order in f / fc. The carrier's phase stays as it is.

    Attributes
    ----------
    reference : (n,) float
        k_0 .. k_(n-1) of the reference target's range about the epoch, m/s^n.
    rows : Axis
        Ranges less the origin that are kept, m.
    """

    name = "rcmc-src"
    layout = "columns"
    time: Axis
    carrier: float
    range_frequency: Axis
    reference: FloatArray
    rows: Axis

    @property
    def source(self) -> Axis:
        return self.range_frequency

    @property
    def n_row(self) -> int:
        return self.time.size

    def operations(self) -> list[Operation]:
        """Rows of range_frequency.size samples to rows.size ranges, one a time: along the block's columns."""
        return [Turn(self._migration()), self._transform]

    @property
    def _transform(self) -> Transform:
        # Two-way delay is the dual of range frequency; rows are delays in units of range.
        delay = Axis(self.rows.start * 2 / SPEED_OF_LIGHT, self.rows.step * 2 / SPEED_OF_LIGHT, self.rows.size)
        return Transform(self.range_frequency, delay, inverse=True)

    @property
    def period(self) -> int:
        """Length of the range transform."""
        return self._transform.period

    def _migration(self) -> Phase:
        """At each time a polynomial in range frequency: interpolated at Chebyshev's nodes, exact to its order."""
        f = self.range_frequency
        centre, scale = f.centre, f.step * f.size / 2
        nodes = chebyshev.chebpts1(phase.MAX_ORDER + 1)
        ratio = 1 + (centre + scale * nodes) / self.carrier
        order = np.arange(2, self.reference.size)
        in_f = np.linalg.solve(np.vander(nodes, increasing=True), ratio[:, None] ** (1 - order) - 1)
        half = self.time.extent / 2
        in_t = self.reference[2:] * half**order * (2 * self.carrier / SPEED_OF_LIGHT)
        z = self.time.values[:, None] / half
        coefficients = (in_t * z**order) @ in_f.T
        return Phase(_trimmed(coefficients), centre, scale)

    def trace(self, line: Line) -> Line:
        migration = np.zeros_like(line.time)
        for n in range(self.reference.size - 1, 1, -1):
            migration = (migration + (1 - n) * self.reference[n]) * line.time
        return line.shift_range(-migration * line.time)


def _trimmed(coefficients: FloatArray) -> FloatArray:
    """Without the highest orders that stay below a ten millionth of a cycle."""
    size = np.abs(coefficients).max(axis=0)
    tail = np.cumsum(size[::-1])[::-1]
    return coefficients[:, : max(int(np.count_nonzero(tail > 1e-7)), 1)]
