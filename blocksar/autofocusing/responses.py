"""Responses in the chip of a control point: of the point, and of its neighbours.

A chip reaches far beyond a point: over some range cells, and along azimuth over all of its band of Doppler, often 100 m
to either side. The brightest response in it may be a neighbour's. So all that stand out are measured, and what agrees
with the other points and with the navigation decides which is the point's (`anchoring.py`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.autofocusing.chips import vertex
from blocksar.autofocusing.work import Work
from blocksar.errors import InputError
from blocksar.kernels.fourier import fast_length, fft_rows

BENDS = np.linspace(-6.0, 6.0, 121)  # rad: that are looked for
STANDS_OUT = 20.0  # times the median power of its chip: of a response that is found
FAINTEST = 1e-3  # times the power of the brightest: below it are sidelobes
MOST_RESPONSES = 16  # of a chip, the brightest
PADDING = 8  # of the dwell, so that the Doppler of a peak is read between cells
APART = 2 * PADDING  # samples of Doppler: half the main lobe of a Hann window


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """Where a response is seen, relative to the known place of a control point along the corrected track.

    Attributes
    ----------
    range : float
        m, away from the antenna.
    rate : float
        Of its phase over s, rad.
    phase : float
        In the middle of its dwell, rad.
    bend : float
        Of its phase: from the middle of the dwell to its ends, rad.
    noise : float
        Amplitude of its surroundings over its own.
    sight : (3, 3) float
        Unit vectors to the point where its dwell begins, in its middle, and where it ends.
    at : (3,) float
        s there.
    doubt : float
        Standard deviation of the phase that is said of the point, rad; infinite if none is said.
    """

    range: float
    rate: float
    phase: float
    bend: float
    noise: float
    sight: FloatArray
    at: FloatArray
    doubt: float = 0.0

    @property
    def terms(self) -> FloatArray:
        """Factors (3, 6) of a and b in u . e where the dwell begins, in its middle, and where it ends."""
        return np.concatenate([self.sight, self.sight * self.at[:, None]], axis=1)


def find_responses(work: Work, name: str, values: ComplexArray, s: FloatArray, sight: FloatArray) -> list[Seen]:
    """Measure what stands out in the chip (n_line, n) of a control point, the brightest first.

    Parameters
    ----------
    name : str
        Of the point, for messages.
    s : (n,) float
        Times of the samples, from -1 at the first pulse of the collection to 1 at the last.
    sight : (at least n, 3) float
        Unit vectors to the point.

    Raises
    ------
    InputError
        If nothing stands out.
    """
    n = values.shape[1]
    padded = np.zeros((values.shape[0], fast_length(PADDING * n)), np.complex64)
    values = values * np.hanning(n + 2)[1:-1]  # a neighbour's sidelobes are not to hide or to move the point
    padded[:, :n] = values
    power = np.abs(fft_rows(padded, inverse=False)).astype(np.float64) ** 2
    above = float(power.max() / max(float(np.median(power)), 1e-300))
    if not above > STANDS_OUT:
        raise InputError(
            f"control point {name} is not seen: its surroundings have {above:.2g} times their median power at most, "
            f"and {STANDS_OUT:g} times are needed; leave it out, or correct its place"
        )
    floor = max(STANDS_OUT * float(np.median(power)), FAINTEST * float(power.max()))
    curves = np.exp(-1j * BENDS[:, None] * np.linspace(-1, 1, n) ** 2)
    return [_measure(work, values, s, sight, *peak, power, curves) for peak in _peaks(power, floor)]


def _peaks(power: FloatArray, floor: float) -> list[tuple[int, int]]:
    """Line and column of the largest samples of power (n_line, n) that lie `APART` along Doppler, at least `floor`."""
    best: FloatArray = power.max(axis=0)
    order: IntArray = np.argsort(-best, kind="stable")
    free, found = best >= floor, []
    for column in order[: int(free.sum())]:
        if free[column]:
            near = np.arange(column - APART, column + APART + 1) % best.size
            if best[column] >= best[near].max():
                found.append((int(power[:, column].argmax()), int(column)))
            free[near] = False
        if len(found) == MOST_RESPONSES:
            break
    return found


def _measure(
    work: Work,
    values: ComplexArray,
    s: FloatArray,
    sight: FloatArray,
    line: int,
    column: int,
    power: FloatArray,
    curves: ComplexArray,
) -> Seen:
    """Measure the response whose power (n_line, n_column) has its peak at `line` and `column`.

    `curves` (n_bend, n) are phasors that straighten each of `BENDS`.
    """
    n_line, n = values.shape
    near = power[line, [column - 1, column, (column + 1) % power.shape[1]]]
    cycles = ((column + vertex(near)) / power.shape[1] + 0.5) % 1 - 0.5  # a sample
    samples = (n - 1) / float(s[-1] - s[0])  # for each unit of s
    rate, centre = 2 * np.pi * cycles * samples, float(s[0] + s[-1]) / 2
    level = (values * np.exp(-1j * rate * (s - centre))).astype(np.complex128)
    bend = _at_vertex(BENDS, np.abs((level[line] * curves).sum(axis=1)))
    lines = (level * np.exp(-1j * bend * np.linspace(-1, 1, n) ** 2)).sum(axis=1)
    offset = (np.arange(n_line) - (n_line - 1) / 2) * work.settings.line_spacing  # range cells
    low, high = max(line - 1, 0), min(line + 1, n_line - 1)
    tried = np.linspace(offset[low], offset[high], 100 * (high - low) + 1)
    sums = (np.sinc(offset - tried[:, None]) * lines).sum(axis=1)
    around = float(np.median(power)) / math.log(2)  # the mean of noise, whose power is exponential
    return Seen(
        noise=math.sqrt(around / float(power[line, column])),
        range=_at_vertex(tried, np.abs(sums)) * work.cell, rate=float(rate), bend=bend,
        phase=float(np.angle(sums[int(np.abs(sums).argmax())])),
        sight=sight[[0, n // 2, n - 1]], at=np.array([s[0], s[n // 2], s[-1]]),
    )  # fmt: skip


def _at_vertex(at: FloatArray, values: FloatArray) -> float:
    """Where the largest of values (n,) at even steps `at` (n,) lies, between samples where it has neighbours."""
    best = int(values.argmax())
    if not 0 < best < values.size - 1:
        return float(at[best])
    return float(at[best] + (at[1] - at[0]) * vertex(values[best - 1 : best + 2]))
