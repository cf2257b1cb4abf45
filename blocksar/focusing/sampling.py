"""The sampling of a block: the axes of its samples along the chain."""

from __future__ import annotations

from dataclasses import dataclass

from blocksar.constants import SPEED_OF_LIGHT
from blocksar.focusing.dwell_gate import DwellGate
from blocksar.kernels import fourier
from blocksar.kernels.fourier import Axis


@dataclass(frozen=True, kw_only=True, eq=False)
class Sampling:
    """The axes of a block's samples from slab to focused block, and their occupancy.

    Attributes
    ----------
    slab : Axis
        Doppler of the block's part of the recovered spectrum, Hz.
    range_frequency : Axis
        Hz.
    time : Axis
        Slow time from the epoch in which the block's targets are lit, s.
    time_occupancy : float
        Fraction of the sampling rate of `time` that the block's Doppler fills.
    doppler : Axis
        Absolute Doppler of the steps between the transforms, Hz.
    long_time : Axis
        Slow time, extended for the delays of the steps in Doppler, s.
    doppler_occupancy : float
        Fraction of the extended time that samples fill, and so of the sampling of `doppler`.
    rows : Axis
        Ranges less the range origin, m.
    range_occupancy : float
        Fraction of the sampling rate of `rows` that responses fill.
    focused_doppler : Axis
        Doppler of the final transform, Hz.
    gate : DwellGate or None
        None where all targets are lit at the same time.
    summed : (float, float) or None
        First and last slow time that the final transform sums, s; None: all of `long_time`.
    """

    slab: Axis
    range_frequency: Axis
    time: Axis
    time_occupancy: float
    doppler: Axis
    long_time: Axis
    doppler_occupancy: float
    rows: Axis
    range_occupancy: float
    focused_doppler: Axis
    gate: DwellGate | None
    summed: tuple[float, float] | None = None

    @property
    def range_period(self) -> int:
        """Length of the range transform."""
        return round(SPEED_OF_LIGHT / (2 * self.range_frequency.step * self.rows.step))

    @property
    def image_doppler(self) -> Axis:
        """Doppler of the focused block, Hz: coarser than that of the final transform where there is a gate."""
        if self.gate is None:
            return self.focused_doppler
        return fourier.dual(self.long_time, size=self.gate.time.size, centre=self.focused_doppler.centre)

    @property
    def n_buffer_row(self) -> int:
        """Rows of a buffer that holds the block at every stage after its slab."""
        return max(self.range_frequency.size, self.rows.size)
