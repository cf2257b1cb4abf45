"""Operations along rows, as data: phase rotation, transform, window, scaling, resampling."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.kernels.fourier import Axis
from blocksar.kernels.phase import Float32Array, Phase

BLEND_BEYOND = (-0.5, 1.5)  # shares of a blend: beyond the lines that it was fitted to, a polynomial runs away


@dataclass(frozen=True, eq=False)
class Turn:
    """Multiply by exp(2j pi phase).

    Attributes
    ----------
    phases : Phase, or callable that returns it
        With a callable it is computed when the operation is first run: a plan that only counts operations does
        without.
    """

    phases: Phase | Callable[[], Phase]

    @cached_property
    def phase(self) -> Phase:
        return self.phases() if callable(self.phases) else self.phases


@dataclass(frozen=True, eq=False)
class ScaledTurn:
    """Multiply by exp(2j pi factor[row] cycles[i]): an arbitrary phase, scaled per row, for example with frequency."""

    factor: FloatArray
    cycles: FloatArray


@dataclass(frozen=True)
class Transform:
    """Transform as in `fourier`, zero-padded to its period; the target's samples are fewer, or periodic."""

    source: Axis
    target: Axis
    inverse: bool

    @property
    def period(self) -> int:
        return round(1 / (self.source.step * self.target.step))

    def __post_init__(self) -> None:
        source, target = self.source, self.target
        whole = abs(source.step * target.step * self.period - 1) < 1e-9 if self.period else False
        if not whole or source.size > self.period:
            raise ValueError(f"axes are no transform pair: {source=} {target=}")

    def phases(self) -> tuple[Phase, Phase]:
        """Phases before and after an FFT that make it the sum between these axes."""
        source, target = self.source, self.target
        sign = 1.0 if self.inverse else -1.0
        before = np.array([[0.0, sign * target.start]])
        after = np.array([[-sign * target.start * source.start, sign * source.start]])
        return Phase(before, 0.0, 1.0), Phase(after, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class Window:
    """Multiply row r by values[which[r]].

    Attributes
    ----------
    windows : (n_window, n) complex64, or callable that returns them
        With a callable they are computed when the operation is first run: a plan that only counts operations does
        without.
    which : (n_row,) int
    """

    windows: ComplexArray | Callable[[], ComplexArray]
    which: IntArray

    @cached_property
    def values(self) -> ComplexArray:
        return self.windows() if callable(self.windows) else self.windows


@dataclass(frozen=True, eq=False)
class Cut:
    """Keep the samples first[r] .. first[r] + target.size - 1 of row r, counted modulo its length.

    Attributes
    ----------
    first : (n_row,) int
    target : Axis
        Of the samples that are kept.
    """

    first: IntArray
    target: Axis


@dataclass(frozen=True, eq=False)
class Blend:
    """Transform each row under several windows, and blend the results along the target axis.

    y[r, i] = sum_k L_k(s[r, i]) F{windows[which[r], k] x[r]}[i], with L_k Lagrange's polynomials through the nodes
    0, 1 / (K - 1), .. 1 for s (a single window has L = 1), and s a polynomial along the target axis. The rows of a
    group in the cache take that of their mean where it hardly changes from row to row.

    Attributes
    ----------
    transform : Transform
        Without padding: the period is the size of the source.
    windows : callable
        Returns (n_window, K, n) complex64; called when the operation is first run.
    count : int
        K.
    which : (n_row,) int
    share : (n_row, order + 1) float
        Coefficients of s in powers of (value - centre) / scale.
    centre, scale : float
        In the unit of the target axis.
    """

    transform: Transform
    windows: Callable[[], ComplexArray]
    count: int
    which: IntArray
    share: FloatArray
    centre: float
    scale: float

    @cached_property
    def values(self) -> ComplexArray:
        return self.windows()


@dataclass(frozen=True, eq=False)
class Stretch:
    """Resample row r at position middle + (i - middle) scale[r], preserving its sum; zero where there is no input."""

    scale: FloatArray
    middle: float
    taps: Float32Array


@dataclass(frozen=True, eq=False)
class Resample:
    """Resample row r at polynomial positions along it, preserving its energy; zero where the input has no data.

    Sample i becomes sqrt(dp / di) times the row at position p = sum_k positions[r, k] u^k, in samples, with
    u = `phase.unit`: (i - n // 2) / (n / 2). Its slope dp / di is between 1/2 and 2.

    Attributes
    ----------
    positions : (n_row, order + 1) float64
        Order at least 1.
    taps : (TAP_PHASES + 1, n_tap, TAP_ORDER + 1) float32
        From `interpolation.tap_polynomials`.
    """

    positions: FloatArray
    taps: Float32Array


Operation = Turn | ScaledTurn | Transform | Window | Blend | Cut | Stretch | Resample
