"""Range steps: residual range walk, keystone, RCMC with SRC. Each can be applied and traced.

Between recovery and range compression the samples are S(f, t), one row a range frequency, with the phase
exp(-4j pi (fc + f) / c rho(t)), rho the target's range less the origin and less the unified walk.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from blocksar import fourier, phase
from blocksar.fourier import Axis
from blocksar.lines import Line
from blocksar.parameters import SPEED_OF_LIGHT, ComplexArray, FloatArray


class Step(Protocol):
    """One step of a chain: samples to samples, lines to lines, constants bound while planning."""

    name: str

    def apply(self, block: ComplexArray, *, threads: int) -> ComplexArray: ...

    def trace(self, line: Line) -> Line: ...


@dataclass(frozen=True, kw_only=True, eq=False)
class ResidualRangeWalk:
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

    def apply(self, block: ComplexArray, *, threads: int) -> ComplexArray:
        """(n_range_frequency, slab.size) in Doppler to (n_range_frequency, time.size) in time."""
        moved = round(self.walk / self.slab.step) * self.slab.step
        source = Axis(self.slab.start - moved, self.slab.step, self.slab.size)
        factor = self.walk * (1 + self.range_frequency.values / self.carrier) - moved
        minus_time = -self.time.values

        def walk(rows: ComplexArray, which: slice) -> None:
            phase.rotate_outer(rows, factor[which], minus_time)

        return fourier.transform(block, source, self.time, inverse=True, threads=threads, after=walk)

    def trace(self, line: Line) -> Line:
        turned = line.multiply_time(-self.walk * line.time, np.array(-self.walk), np.array(0.0))
        return turned.shift_range(SPEED_OF_LIGHT / (2 * self.carrier) * self.walk * line.time)


@dataclass(frozen=True, kw_only=True, eq=False)
class Keystone:
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

    def apply(self, block: ComplexArray, *, threads: int) -> ComplexArray:
        """(n_range_frequency, time.size); zero where the input has no data."""
        scale = self.carrier / (self.carrier + self.range_frequency.values)
        middle = float(self.time.position(np.array(0.0)))
        table = phase.interpolation_taps(self.taps, occupancy=self.occupancy)
        out = np.empty_like(block)

        def stretch(rows: slice) -> None:
            phase.stretch_rows(block[rows], out[rows], scale[rows], middle, table)

        fourier.run_groups(stretch, fourier.row_groups(*block.shape), threads)
        return out

    def trace(self, line: Line) -> Line:
        return line.shift_range(SPEED_OF_LIGHT / (2 * self.carrier) * line.doppler * line.time)


@dataclass(frozen=True, kw_only=True, eq=False)
class RangeCompression:
    """RCMC and SRC by one reference, then the transform to range (paper A (18)-(23), errata applied).

    Multiplies by exp{4j pi fc / c sum_n ((1 + f / fc)^(1-n) - 1) k_n t^n}, n >= 2: exact in f, where (22)
    expands to second order in f / fc. The carrier's phase stays as it is.

    Attributes
    ----------
    reference : (n,) float
        k_0 .. k_(n-1) of the reference target's range about the epoch, m/s^n.
    rows : Axis
        Ranges less the origin that are kept, m.
    period : int
        Length of the range transform.
    """

    name = "rcmc-src"
    time: Axis
    carrier: float
    range_frequency: Axis
    reference: FloatArray
    rows: Axis
    period: int

    def apply(self, block: ComplexArray, *, threads: int) -> ComplexArray:
        """(n_range_frequency, time.size) to (rows.size, time.size)."""
        f = self.range_frequency.values / self.carrier
        order = np.arange(self.reference.size)
        half = self.time.extent / 2
        scaled = self.reference * half**order * (2 * self.carrier / SPEED_OF_LIGHT)
        coefficients = np.where(order >= 2, ((1 + f[:, None]) ** (1 - order) - 1) * scaled, 0.0)
        z = self.time.values / half

        def correct(columns: ComplexArray, which: slice) -> None:
            phase.rotate_polynomial(columns, coefficients, z[which])

        # Two-way delay is the dual of range frequency; rows are delays in units of range.
        delay = Axis(self.rows.start * 2 / SPEED_OF_LIGHT, self.rows.step * 2 / SPEED_OF_LIGHT, self.rows.size)
        return fourier.transform_columns(
            block, self.range_frequency, delay, self.period, inverse=True, threads=threads, before=correct
        )

    def trace(self, line: Line) -> Line:
        migration = np.zeros_like(line.time)
        for n in range(self.reference.size - 1, 1, -1):
            migration = (migration + (1 - n) * self.reference[n]) * line.time
        return line.shift_range(-migration * line.time)
