"""Programs of operations along rows, run on groups of rows that fit into the cache.

A step describes itself as a list of operations along rows: transforms, phases, windows, resampling. A `Program`
lowers them: every phase, including the linear ones that a transform between two axes requires, is held back until the
samples are next copied, and all pending phases are then applied in one pass. Rows are processed in fixed groups, one
thread per group. The groups are fixed because the FFT library's SIMD path depends on the number of rows in a call: if
the number of threads decided the grouping, it would change the last bit of an image. Groups may be read from the
columns of an array and written to the columns of another, which is how a transform along the first axis is done.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Literal, Protocol

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.kernels import blending, interpolation, phase
from blocksar.kernels.fourier import Axis, fft_rows
from blocksar.kernels.groups import row_groups, run_groups
from blocksar.kernels.operations import Blend, Cut, Operation, Resample, ScaledTurn, Stretch, Transform, Turn, Window
from blocksar.kernels.phase import Float32Array, Phase

Layout = Literal["rows", "columns"]
ALIKE = 0.005  # shares of a blend in the rows of a group: the image errs by -60 dB where windows differ by a sixth


class Program:
    """Operations along rows, compiled to passes over groups of rows.

    Parameters
    ----------
    operations : sequence of Operation
    source : Axis
        Axis of an input row.
    n_row : int
        Number of rows.

    Attributes
    ----------
    target : Axis
        Axis of an output row.
    transforms : list of int
        Lengths of the FFTs that each row passes through.

    Raises
    ------
    ValueError
        If the operations do not fit together.
    """

    def __init__(self, operations: Sequence[Operation], *, source: Axis, n_row: int) -> None:
        self.source, self.target, self.n_row = source, source, n_row
        self.transforms: list[int] = []
        self._passes: list[_Pass] = []
        self._windowed = [each for each in operations if isinstance(each, Window | Blend)]
        self._pending = np.zeros((n_row, 2))
        self._scaled: ScaledTurn | None = None
        for operation in operations:
            match operation:
                case Turn():
                    self._add_phase(operation.phase)
                case ScaledTurn():
                    if self._scaled is not None or self._pending.shape[1] > 2:
                        self._passes.append(self._flush())  # one pass applies one scaled phase and linear ones
                    self._scaled = operation
                case Transform():
                    self._transform(operation)
                case Blend():
                    self._transform(operation.transform, operation)
                case Window():
                    if not self._passes:  # windows work in place, and the input must not change
                        self._passes.append(self._flush())
                    self._passes.append(_WindowPass(operation))
                case Cut():
                    self._cut(operation)
                case Stretch() | Resample():
                    self._passes += [self._flush(), _ResamplingPass(operation)]
        if self._pending.any() or not (self._passes and isinstance(self._passes[-1], _ResamplingPass)):
            self._passes.append(self._flush())  # the last pass must be one that can write into the result array

    def _add_phase(self, added: Phase) -> None:
        """Add a phase to those pending."""
        coefficients = added.along(self.target)
        if self._scaled is not None and coefficients.shape[1] > 2:
            self._passes.append(self._flush())
        pending = np.zeros((self.n_row, max(coefficients.shape[1], self._pending.shape[1])))
        pending[:, : self._pending.shape[1]] = self._pending
        pending[:, : coefficients.shape[1]] += coefficients
        self._pending = pending

    def _flush(self, size: int | None = None) -> _CopyPass:
        """Make a pass that copies to rows of `size` samples, applies all pending phases and appends zeros."""
        filled = self.target.size
        coefficients = self._pending if self._scaled else phase.as_coefficients(self._pending)
        copy = _CopyPass(coefficients=coefficients, scaled=self._scaled, filled=filled, size=size or filled)
        self._pending, self._scaled = np.zeros((self.n_row, 2)), None
        return copy

    def _transform(self, operation: Transform, blend: Blend | None = None) -> None:
        if operation.source.size != self.target.size:
            raise ValueError(f"rows of {self.target.size} samples do not fit {operation}")
        before, after = operation.phases()
        self.target = operation.source  # a step may assign another axis to its samples
        self._add_phase(before)
        if blend is not None and operation.source.size != operation.period:
            raise ValueError(f"windows of {operation.source.size} samples are blended without padding only")
        fft = _FftPass(operation.inverse, operation.target.size) if blend is None else _BlendPass(blend)
        self._passes += [self._flush(operation.period), fft]
        self.target = operation.target
        self.transforms += [operation.period] * (1 if blend is None else blend.count)
        self._add_phase(after)

    def _cut(self, operation: Cut) -> None:
        if self._scaled is not None or self._pending.any():
            self._passes.append(self._flush())
        self._passes.append(_CutPass(operation.first, operation.target.size))
        self.target = operation.target

    def groups(self, first: int, last: int, *, columns: bool) -> list[slice]:
        """Divide the rows first .. last - 1 into groups that depend only on the program."""
        return row_groups(first, last, max([self.source.size, *self.transforms]), columns=columns)

    def run(
        self,
        x: ComplexArray,
        *,
        out: ComplexArray | None = None,
        first: int = 0,
        load: Layout = "rows",
        store: Layout = "rows",
        threads: int = 1,
    ) -> ComplexArray:
        """Run on all rows of `x`, which are rows first, first + 1, ... of the program.

        Parameters
        ----------
        x : (n, source.size) complex64, or (source.size, n) if load is "columns"
            Not changed.
        out : complex64 array, optional
            Holds the result of all rows of the program, of which only these are written; its rows may be longer than
            those of the result. May share memory with x if `load` equals `store`.

        Returns
        -------
        (n, target.size) complex64, or (target.size, n) if store is "columns"

        Raises
        ------
        ValueError
            If x does not have that shape.
        """
        n, size = x.shape if load == "rows" else x.shape[::-1]
        if size != self.source.size or first + n > self.n_row:
            raise ValueError(f"{x.shape=}, but the program takes {self.n_row} rows of {self.source.size} as {load}")
        destination = first  # row of `out` that receives the first row
        if out is None:
            shape = (n, self.target.size) if store == "rows" else (self.target.size, n)
            out, destination = np.empty(shape, np.complex64), 0

        def work(rows: slice) -> None:
            target = slice(rows.start - first + destination, rows.stop - first + destination)
            if load == "rows":
                group = x[rows.start - first : rows.stop - first]
            else:
                group = np.empty((rows.stop - rows.start, size), np.complex64)
                phase.gather_columns(x, rows.start - first, group)
            for apply in self._passes[:-1]:
                group = apply(group, rows)
            if store == "rows":
                self._passes[-1](group, rows, out[target])
            else:
                phase.scatter_columns(self._passes[-1](group, rows), self.target.size, target.start, out)

        # Before all groups: newer Pythons do not lock a cached property, and each thread would compute the windows.
        run_groups(attrgetter("values"), self._windowed, threads)
        run_groups(work, self.groups(first, first + n, columns="columns" in (load, store)), threads)
        return out


class _Pass(Protocol):
    """Interface of a pass over a group of rows: in place, or into another array."""

    def __call__(self, group: ComplexArray, rows: slice, out: ComplexArray | None = None) -> ComplexArray: ...


@dataclass(frozen=True, kw_only=True, eq=False)
class _CopyPass:
    """Copy rows, multiply them by the pending phases and append zeros."""

    coefficients: FloatArray
    scaled: ScaledTurn | None
    filled: int  # samples of a row
    size: int  # samples with the zeros behind them

    def __call__(self, group: ComplexArray, rows: slice, out: ComplexArray | None = None) -> ComplexArray:
        if out is None:
            out = np.empty((group.shape[0], self.size), np.complex64)
        out[:, self.filled : self.size] = 0
        coefficients = self.coefficients[rows]
        if self.scaled is None:
            phase.rotate(group, self.filled, coefficients, out)
        else:
            factor, cycles = self.scaled.factor[rows], self.scaled.cycles
            phase.rotate_scaled(group, out, phase.unit(self.filled), coefficients, factor, cycles)
        return out


@dataclass(frozen=True)
class _FftPass:
    inverse: bool
    size: int  # samples of the result that are needed

    def __call__(self, group: ComplexArray, rows: slice, out: ComplexArray | None = None) -> ComplexArray:
        found = fft_rows(group, inverse=self.inverse)
        beyond = self.size - found.shape[1]
        return found if beyond <= 0 else np.pad(found, ((0, 0), (0, beyond)), mode="wrap")


@dataclass(frozen=True, eq=False)
class _BlendPass:
    operation: Blend

    def __call__(self, group: ComplexArray, rows: slice, out: ComplexArray | None = None) -> ComplexArray:
        blend, which = self.operation, self.operation.which[rows]
        target = blend.transform.target
        z = (target.values - blend.centre) / blend.scale
        share = _shares(blend.share[rows], z)
        total = group
        for k in range(blend.count):
            part = group if k == blend.count - 1 else np.empty_like(group)
            blending.window_rows(group, blend.values, which, k, part)
            part = fft_rows(part, inverse=blend.transform.inverse)
            total = part if k == 0 else total
            if blend.count > 1:
                blending.blend_rows(part, share, k, blend.count, total)
        return total[:, : target.size]


def _shares(coefficients: FloatArray, z: FloatArray) -> Float32Array:
    """Polynomials of rows at z (n,): (n_row, n), or that of their mean, (1, n), if they are nearly equal."""
    out = np.empty((2, z.size), np.float32)
    blending.evaluate_shares(np.ascontiguousarray(coefficients[[0, -1]]), z, out)
    if np.abs(out[1] - out[0]).max() <= ALIKE:
        coefficients = coefficients.mean(axis=0, keepdims=True)
    out = np.empty((coefficients.shape[0], z.size), np.float32)
    blending.evaluate_shares(np.ascontiguousarray(coefficients), z, out)
    return out


@dataclass(frozen=True, eq=False)
class _WindowPass:
    operation: Window

    def __call__(self, group: ComplexArray, rows: slice, out: ComplexArray | None = None) -> ComplexArray:
        phase.multiply_windows(group, self.operation.values, self.operation.which[rows])
        return group


@dataclass(frozen=True, eq=False)
class _CutPass:
    first: IntArray
    size: int

    def __call__(self, group: ComplexArray, rows: slice, out: ComplexArray | None = None) -> ComplexArray:
        if out is None:
            out = np.empty((group.shape[0], self.size), np.complex64)
        for row, target, first in zip(group, out, (self.first[rows] % group.shape[1]).tolist(), strict=True):
            ahead = row[first : first + self.size]
            target[: ahead.size] = ahead
            target[ahead.size : self.size] = row[: self.size - ahead.size]
        return out


@dataclass(frozen=True, eq=False)
class _ResamplingPass:
    operation: Stretch | Resample

    def __call__(self, group: ComplexArray, rows: slice, out: ComplexArray | None = None) -> ComplexArray:
        if out is None:
            out = np.empty_like(group)
        match self.operation:
            case Stretch(scale, middle, taps):
                interpolation.stretch_rows(group, out, scale[rows], middle, taps)
            case Resample(positions, taps):
                interpolation.resample_rows(group, out, np.ascontiguousarray(positions[rows]), taps)
        return out


def transform(x: ComplexArray, source: Axis, target: Axis, *, inverse: bool, threads: int = 1) -> ComplexArray:
    """Transform the rows of x (n_row, source.size) from one axis to another: (n_row, target.size) complex64.

    Raises
    ------
    ValueError
        If the axes are no transform pair, or the rows of x do not have the size of `source`.
    """
    program = Program([Transform(source, target, inverse)], source=source, n_row=x.shape[0])
    return program.run(x, threads=threads)


def to_doppler(x: ComplexArray, time: Axis, doppler: Axis, *, threads: int = 1) -> ComplexArray:
    """Transform slow time to Doppler along the last axis."""
    return transform(x, time, doppler, inverse=False, threads=threads)


def to_time(x: ComplexArray, doppler: Axis, time: Axis, *, threads: int = 1) -> ComplexArray:
    """Transform Doppler to slow time along the last axis."""
    return transform(x, doppler, time, inverse=True, threads=threads)
