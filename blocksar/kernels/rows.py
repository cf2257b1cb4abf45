"""What can be done to rows of samples, and how it is done while a few rows are in the cache.

A step says what it does as a list of operations along rows: transforms, phases, windows, resampling. A `Program`
lowers them: every phase, the linear ones that a transform between two axes asks for included, waits until the samples
are next copied, and then all that have gathered are multiplied in one pass. Rows are worked on in fixed groups,
one thread a group. Fixed, because the FFT library's SIMD path depends on how many rows it is given: a grouping by the
number of threads would change the last bit of an image with it. Groups may be read from the columns of an array, and
written to those of another, which is how a transform along the first axis is done.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.kernels import interpolation, phase
from blocksar.kernels.fourier import Axis, fft_rows
from blocksar.kernels.groups import row_groups, run_groups
from blocksar.kernels.operations import Operation, Resample, ScaledTurn, Stretch, Transform, Turn, Window
from blocksar.kernels.phase import Phase

Layout = Literal["rows", "columns"]


class Program:
    """Operations along rows, lowered.

    Parameters
    ----------
    operations : sequence of Operation
    source : Axis
        Of the rows that come in.
    n_row : int

    Attributes
    ----------
    target : Axis
        Of the rows that come out.
    transforms : list of int
        Lengths of the FFTs that each row goes through.
    """

    def __init__(self, operations: Sequence[Operation], *, source: Axis, n_row: int) -> None:
        self.source, self.target, self.n_row = source, source, n_row
        self.transforms: list[int] = []
        self._works: list[_Work] = []
        self._waiting = np.zeros((n_row, 2))
        self._scaled: ScaledTurn | None = None
        for operation in operations:
            match operation:
                case Turn():
                    self._turn(operation.phase)
                case ScaledTurn():
                    if self._scaled is not None:
                        raise ValueError("two scaled phases without a transform between them")
                    self._scaled = operation
                case Transform():
                    self._transform(operation)
                case Window():
                    if not self._works:  # never on the samples that came in
                        self._works.append(self._settle())
                    self._works.append(_Windowed(operation))
                case Stretch() | Resample():
                    self._works += [self._settle(), _Resampled(operation)]
        if self._waiting.any() or not (self._works and isinstance(self._works[-1], _Resampled)):
            self._works.append(self._settle())  # the last one writes to where the result belongs

    def _turn(self, given: Phase) -> None:
        added = given.along(self.target)
        waiting = np.zeros((self.n_row, max(added.shape[1], self._waiting.shape[1])))
        waiting[:, : self._waiting.shape[1]] = self._waiting
        waiting[:, : added.shape[1]] += added
        self._waiting = waiting

    def _settle(self, size: int | None = None) -> _Copy:
        """Copy to rows of `size` samples, multiplied by all phases that wait, with zeros behind."""
        kept = self.target.size
        if self._scaled and self._waiting.shape[1] > 2:
            raise ValueError("a scaled phase goes with linear ones only")
        coefficients = self._waiting if self._scaled else phase.as_coefficients(self._waiting)
        copy = _Copy(coefficients=coefficients, scaled=self._scaled, kept=kept, size=size or kept)
        self._waiting, self._scaled = np.zeros((self.n_row, 2)), None
        return copy

    def _transform(self, operation: Transform) -> None:
        if operation.source.size != self.target.size:
            raise ValueError(f"rows of {self.target.size} samples do not go into {operation}")
        before, after = operation.phases()
        self.target = operation.source  # a step may give its samples another axis
        self._turn(before)
        self._works += [self._settle(operation.period), _Fft(operation.inverse)]
        self.target = operation.target
        self.transforms.append(operation.period)
        self._turn(after)

    def groups(self, first: int, last: int, *, columns: bool) -> list[slice]:
        """The rows first .. last - 1 in groups that depend on nothing but the program."""
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
        """Run on all rows of `x`, which are rows first .. of those that the program was made for.

        Parameters
        ----------
        x : (n, source.size) complex64, or (source.size, n) if load is "columns"
            Not changed.
        out : complex64 array, optional
            For the result of all rows of the program, of which these are written; rows may be longer than the result's.
            If load is as store, the memory may be that of x.

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
        written = first  # where in `out` the first row goes
        if out is None:
            shape = (n, self.target.size) if store == "rows" else (self.target.size, n)
            out, written = np.empty(shape, np.complex64), 0

        def work(rows: slice) -> None:
            place = slice(rows.start - first + written, rows.stop - first + written)
            if load == "rows":
                group = x[rows.start - first : rows.stop - first]
            else:
                group = np.empty((rows.stop - rows.start, size), np.complex64)
                phase.gather_columns(x, rows.start - first, group)
            for step in self._works[:-1]:
                group = step(group, rows)
            if store == "rows":
                self._works[-1](group, rows, out[place])
            else:
                phase.scatter_columns(self._works[-1](group, rows), self.target.size, place.start, out)

        run_groups(work, self.groups(first, first + n, columns="columns" in (load, store)), threads)
        return out


class _Work(Protocol):
    """What is done to a group of rows: in place, or into another array."""

    def __call__(self, group: ComplexArray, rows: slice, out: ComplexArray | None = None) -> ComplexArray: ...


@dataclass(frozen=True, kw_only=True, eq=False)
class _Copy:
    """A copy of rows, multiplied by the phases that waited, zeros behind."""

    coefficients: FloatArray
    scaled: ScaledTurn | None
    kept: int
    size: int

    def __call__(self, group: ComplexArray, rows: slice, out: ComplexArray | None = None) -> ComplexArray:
        if out is None:
            out = np.empty((group.shape[0], self.size), np.complex64)
        out[:, self.kept : self.size] = 0
        coefficients = self.coefficients[rows]
        if self.scaled is None:
            phase.rotate(group, self.kept, coefficients, out)
        else:
            factor, cycles = self.scaled.factor[rows], self.scaled.cycles
            phase.rotate_scaled(group, out, phase.unit(self.kept), coefficients, factor, cycles)
        return out


@dataclass(frozen=True)
class _Fft:
    inverse: bool

    def __call__(self, group: ComplexArray, rows: slice, out: ComplexArray | None = None) -> ComplexArray:
        return fft_rows(group, inverse=self.inverse)


@dataclass(frozen=True, eq=False)
class _Windowed:
    operation: Window

    def __call__(self, group: ComplexArray, rows: slice, out: ComplexArray | None = None) -> ComplexArray:
        phase.multiply_windows(group, self.operation.windows, self.operation.which[rows])
        return group


@dataclass(frozen=True, eq=False)
class _Resampled:
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
    """The rows of x (n_row, source.size) from one axis to another: (n_row, target.size) complex64.

    Raises
    ------
    ValueError
        If the axes are no transform pair, or x is not sampled on the source.
    """
    program = Program([Transform(source, target, inverse)], source=source, n_row=x.shape[0])
    return program.run(x, threads=threads)


def to_doppler(x: ComplexArray, time: Axis, doppler: Axis, *, threads: int = 1) -> ComplexArray:
    """Slow time to Doppler along the last axis."""
    return transform(x, time, doppler, inverse=False, threads=threads)


def to_time(x: ComplexArray, doppler: Axis, time: Axis, *, threads: int = 1) -> ComplexArray:
    """Doppler to slow time along the last axis."""
    return transform(x, doppler, time, inverse=True, threads=threads)
