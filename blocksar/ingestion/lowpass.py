"""Low-pass filters that keep every n-th sample: what they keep comes out as it is, and nothing folds onto it.

Samples x(t_m) hold echoes exp(2j pi nu t_m): those wanted, |nu| <= band / 2, and others. Every n-th is kept,
y(t_k) = sum_m w_m x(t_m), so that frequencies which differ by rate = 1 / (n dt) become one: whatever lies beyond
rate - band / 2 falls onto what is wanted and has to be stopped. What lies between may come through, since it falls
beside it. Of all weights those have the least square error

    integral over |nu| <= band/2 of |H - 1|^2 + integral over rate - band/2 <= |nu| <= 1/(2 dt) of |H|^2,
    H(nu) = sum_m w_m exp(2j pi nu (t_m - t_k)),

which solve (P + S + SOFTNESS I) w = p with P_mn = band sinc(band (t_m - t_n)), p_m = band sinc(band (t_m - t_k)) and
S_mn = 2 s sinc(2 s (t_m - t_n)) at s = 1/(2 dt) less the same at s = rate - band/2. Near the ends of the samples, and
where some are missing, the same equations use those that there are. The largest |H - 1| and |H| over both bands are
computed, and bound the error of every echo; where they exceed MOST_ERROR nothing is kept, nor where echoes between the
two bands would grow by more than MOST_GROWTH, or noise by more than MOST_GAIN.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.ingestion.resampling import MOST_ERROR, MOST_GAIN

SPARE = 1.5  # rate kept over the band wanted: the share between them is where the filter falls off
TAPS = 16  # samples in a sum, for each that is left out: -77 dB over both bands
MOST_GROWTH = 8.0  # of echoes between the bands, which do not fold onto what is wanted, in sums at the ends
SOFTNESS = 1e-8  # keeps weights small where nothing determines them
TOGETHER = 16  # sums that are computed at once: more would multiply more zeros


def steps_of(band: float, rate: float) -> int:
    """Every how many samples, of which there are `rate` a unit, suffice for a band."""
    return max(int(rate / (SPARE * band)), 1) if band > 0 else 1


@dataclass(frozen=True, kw_only=True, eq=False)
class LowPass:
    """Sums of consecutive samples.

    Attributes
    ----------
    places : (n_out,) int
        The sample whose place each sum takes.
    first : (n_out,) int
        First sample that is summed.
    weights : (n_kind, n_tap) float
        Of the different sums.
    kind : (n_out,) int
        Which of them each is.
    good : (n_out,) bool
        False where the samples that there are do not determine it.
    error : float
        Largest error of an echo in a sum that is good, relative to the echo.
    """

    places: IntArray
    first: IntArray
    weights: FloatArray
    kind: IntArray
    good: BoolArray
    error: float

    def part(self, some: slice) -> LowPass:
        """Some of the sums."""
        return LowPass(
            places=self.places[some], first=self.first[some], weights=self.weights, kind=self.kind[some],
            good=self.good[some], error=self.error,
        )  # fmt: skip

    def inputs(self, some: slice) -> slice:
        """The samples from which some of the sums are computed."""
        return slice(int(self.first[some].min()), int(self.first[some].max()) + self.weights.shape[1])

    def matrix(self, some: slice) -> ComplexArray:
        """The weights of some of the sums over `inputs`, (n_out, n_in) complex64."""
        inputs = self.inputs(some)
        out = np.zeros((self.first[some].size, inputs.stop - inputs.start), np.complex64)
        for row, (first, kind) in enumerate(zip(self.first[some] - inputs.start, self.kind[some], strict=True)):
            out[row, first : first + self.weights.shape[1]] = self.weights[kind]
        return out

    def along_rows(self, samples: ComplexArray) -> ComplexArray:
        """Filter the last axis of (n_row, n_in) samples, all of them: (n_row, n_out).

        Groups of sums with the same weights are one product of matrices: many small ones keep waiting for each other's
        threads.
        """
        out = np.empty((samples.shape[0], self.places.size), np.complex64)
        usual = self.kind[self.places.size // 2]
        every = groups(self.places.size)
        alike = [some for some in every if some.stop - some.start == TOGETHER and (self.kind[some] == usual).all()]
        if len(alike) < 2 or alike[-1].stop - alike[0].start > TOGETHER * len(alike):
            alike = []
        for some in [each for each in every if each not in alike]:
            out[:, some] = samples[:, self.inputs(some)] @ self.matrix(some).T
        if alike:
            first, second = (self.inputs(some) for some in alike[:2])
            windows = sliding_window_view(samples[:, first.start :], first.stop - first.start, axis=1)
            windows = windows[:, :: second.start - first.start][:, : len(alike)]
            sums = windows.reshape(-1, first.stop - first.start) @ self.matrix(alike[0]).T
            out[:, alike[0].start : alike[-1].stop] = sums.reshape(samples.shape[0], -1)
        return out

    def over_rows(self, read: Callable[[slice], ComplexArray], some: slice) -> ComplexArray:
        """Filter rows that `read` gives, each once and in order: some of the sums, NaN where they are not good.

        Rows that are missing are NaN.
        """
        rows = np.empty((0, 0), np.complex64)
        start = stop = self.inputs(some).start
        parts = []
        for own in groups(self.places[some].size):
            sums = slice(some.start + own.start, some.start + own.stop)
            inputs = self.inputs(sums)
            rows, start = rows[inputs.start - start :], inputs.start
            if inputs.stop > stop:
                fresh = np.nan_to_num(read(slice(max(stop, start), inputs.stop)), copy=False)
                rows, stop = np.concatenate([rows, fresh]) if rows.size else fresh, inputs.stop
            parts.append(self.matrix(sums) @ rows)
        out = np.concatenate(parts)
        out[~self.good[some]] = complex(np.nan, np.nan)
        return out


def groups(count: int) -> list[slice]:
    """Slices of at most TOGETHER of so many."""
    return [slice(first, min(first + TOGETHER, count)) for first in range(0, count, TOGETHER)]


def plan_lowpass(size: int, steps: int, band: float, present: BoolArray | None = None) -> LowPass:
    """Weights and errors of sums at every `steps`-th of `size` samples, about the middle.

    Parameters
    ----------
    size : int
    steps : int
    band : float
        Width of what is wanted about zero, cycles a sample.
    present : (size,) bool, optional
        Which samples there are; default: all.
    """
    there = np.ones(size, bool) if present is None else present
    places = np.arange((size - 1) % steps // 2, size, steps)
    taps = min(TAPS * steps | 1, size)
    first = np.clip(places - taps // 2, 0, size - taps)
    of_offset: dict[int, _Equations] = {}
    known: dict[bytes, int] = {}
    kind = np.empty(places.size, np.int64)
    weights: list[FloatArray] = []
    errors: list[float] = []
    growths: list[float] = []
    for k, offset in enumerate((places - first).tolist()):
        use = there[first[k] : first[k] + taps]
        key = bytes(np.packbits(use)) + offset.to_bytes(8)
        if key not in known:
            if offset not in of_offset:
                of_offset[offset] = _Equations(np.arange(taps) - offset, steps, band)
            known[key] = len(weights)
            row, worst, growth = of_offset[offset].solve(use)
            weights.append(row)
            errors.append(worst)
            growths.append(growth)
        kind[k] = known[key]
    error = np.asarray(errors)[kind]
    good = (error <= MOST_ERROR) & (np.asarray(growths)[kind] <= MOST_GROWTH)
    good &= np.linalg.norm(weights, axis=1)[kind] <= MOST_GAIN
    return LowPass(
        places=places, first=first, weights=np.asarray(weights), kind=kind, good=good,
        error=float(error[good].max(initial=0.0)),
    )  # fmt: skip


class _Equations:
    """Equations for the weights of samples at some lags, and the responses by which their errors are found."""

    def __init__(self, lag: IntArray, steps: int, band: float) -> None:
        def ideal(width: float, lag: IntArray) -> FloatArray:
            return np.asarray(width * np.sinc(width * lag))

        apart, stop = lag[:, None] - lag, 1 / steps - band / 2
        self.wanted = ideal(band, lag)
        self.normal = ideal(band, apart) + ideal(1.0, apart) - ideal(2 * stop, apart) + SOFTNESS * np.eye(lag.size)
        bands = [(0, band / 2, lag.size), (stop, 0.5, 2 * lag.size), (band / 2, stop, lag.size)]
        frequency = np.concatenate([np.linspace(*each) for each in bands])
        self.response = np.exp(2j * np.pi * frequency[:, None] * lag)
        self.between = slice(3 * lag.size, None)
        self.ideal = np.repeat([1.0, 0.0], [lag.size, 2 * lag.size])
        self.alone = lag == 0 if steps == 1 else None  # then nothing folds

    def solve(self, use: BoolArray) -> tuple[FloatArray, float, float]:
        """The weights, zero for samples that are not to be used, the largest error, and |H| between the bands."""
        weights = np.zeros(use.size)
        if self.alone is not None:
            weights[self.alone] = 1.0
            return weights, 0.0 if use[self.alone].all() else np.inf, 1.0
        weights[use] = np.linalg.solve(self.normal[np.ix_(use, use)], self.wanted[use])
        response = self.response @ weights
        error = np.abs(response[: self.ideal.size] - self.ideal)
        return weights, float(error.max()), float(np.abs(response[self.between]).max())
