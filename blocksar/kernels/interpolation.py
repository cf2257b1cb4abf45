"""Band-limited interpolation along rows: least-squares taps, and resampling at linear or polynomial positions."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit, types

from blocksar import solvers
from blocksar.arrays import ComplexArray, FloatArray
from blocksar.kernels.lanes import LANES, count_lanes, horner, load, load_imag, load_real, spread, store, store_complex
from blocksar.kernels.loops import COMPILED, PART, REAL_ROW, REAL_ROWS, SAMPLES_IN, SAMPLES_OUT, loop
from blocksar.kernels.phase import Float32Array

PIECE = LANES * LANES  # samples of a row interpolated from one buffer that fits the first-level cache
BENT_NODES = 96  # of the integrals over the band for taps that remove a phase
TAP_PHASES = 32  # fractions of a sample about which interpolation weights are expanded
TAP_ORDER = 4
OCCUPANCIES = 1024  # steps in which occupancies are told apart when taps are counted
TAPS = types.Array(types.float32, 3, "C", readonly=True)
TAP_REACH = 0.2  # samples: largest distance from a fraction at which its expansion is used; it errs by 1e-5


def interpolation_taps(n_tap: int, *, occupancy: float, n_phase: int = 256) -> Float32Array:
    """Least-squares taps for band-limited interpolation at any fraction of a sample.

    For each fraction p / n_phase the taps minimise the mean square error over frequencies
    |f| <= occupancy / 2 (cycles per sample): a small normal system of sinc values. At the same cost their error
    is smaller than that of a Kaiser-windowed sinc, the more so the lower the occupancy.

    Parameters
    ----------
    n_tap : int
        Even.
    occupancy : float
        Share of the sampling rate that the signal fills, below 1.

    Returns
    -------
    (n_phase + 1, n_tap) float32
        Row p interpolates at position p / n_phase between samples n_tap / 2 - 1 and n_tap / 2 of its window.
    """
    k = np.arange(n_tap) - (n_tap // 2 - 1)
    gram = np.sinc(occupancy * (k[:, None] - k[None, :])) + 1e-9 * np.eye(n_tap)
    fraction = np.arange(n_phase + 1) / n_phase
    right = np.sinc(occupancy * (fraction[None, :] - k[:, None]))
    return np.ascontiguousarray(solvers.least_squares(gram, right.T).T, dtype=np.float32)


def bent_taps(n_tap: int, bends: FloatArray, *, occupancy: float, n_phase: int) -> tuple[Float32Array, Float32Array]:
    """Least-squares taps that also remove a phase of q (2 f / occupancy)^2 cycles over |f| <= occupancy / 2.

    With f in cycles per sample, sum_k taps_k exp(-2j pi f (k - p / n_phase)) is exp(-2j pi q (2 f / occupancy)^2). For
    q = 0 these are `interpolation_taps`.

    Parameters
    ----------
    bends : (n,) float
        q, cycles.

    Returns
    -------
    real, imag : (n, n_phase + 1, n_tap) float32
    """
    k = np.arange(n_tap) - (n_tap // 2 - 1)
    gram = np.sinc(occupancy * (k[:, None] - k[None, :])) + 1e-9 * np.eye(n_tap)
    away = (k - np.arange(n_phase + 1)[:, None] / n_phase).ravel()
    nodes, weights = solvers.gauss_legendre(BENT_NODES)
    turns = 2 * np.pi * occupancy / 2 * nodes * away[:, None]
    bent = 2 * np.pi * np.asarray(bends)[:, None] * nodes**2
    # Of exp(1j turns) exp(-1j bent), whose part that is odd over the band cancels.
    parts = [solvers.product(np.cos(turns) * weights / 2, part.T).T for part in (np.cos(bent), -np.sin(bent))]
    shape = len(bends), n_phase + 1, n_tap
    rights = [part.reshape(-1, n_tap) for part in parts]
    solved = [solvers.least_squares(gram, right).T.reshape(shape) for right in rights]
    return tuple(np.ascontiguousarray(part, dtype=np.float32) for part in solved)  # type: ignore[return-value]


def bent_errors(n_tap: int, bends: FloatArray, *, occupancy: float) -> FloatArray:
    """Root mean square errors (n,) of `bent_taps` over the occupied band, at the worst fraction, 1/2."""
    real, imag = (part[:, 1].astype(np.float64) for part in bent_taps(n_tap, bends, occupancy=occupancy, n_phase=2))
    k = np.arange(n_tap) - (n_tap // 2 - 1)
    f = np.linspace(-occupancy / 2, occupancy / 2, 129)
    turns = np.exp(-2j * np.pi * f[:, None] * (k - 0.5))
    responses = (turns * (real + 1j * imag)[:, None, :]).sum(axis=2)
    wanted = np.exp(-2j * np.pi * np.asarray(bends)[:, None] * (2 * f / occupancy) ** 2)
    return np.asarray(np.sqrt(np.mean(np.abs(responses - wanted) ** 2, axis=1)))


def interpolation_error(n_tap: int, occupancy: float) -> float:
    """Root mean square relative error of `interpolation_taps` over the occupied band, at the worst fraction, 1/2."""
    taps = interpolation_taps(n_tap, occupancy=occupancy, n_phase=2)[1].astype(np.float64)
    k = np.arange(n_tap) - (n_tap // 2 - 1)
    f = np.linspace(-occupancy / 2, occupancy / 2, 129)
    error = (np.exp(2j * np.pi * f[:, None] * k) * taps).sum(axis=1) - np.exp(1j * np.pi * f)
    return float(np.sqrt(np.mean(np.abs(error) ** 2)))


def taps_needed(occupancy: float, *, error: float, at_most: int = 32) -> int:
    """Smallest even number of taps whose error is at most `error`; `at_most` if none suffices.

    The occupancy is rounded up to the next 1 / OCCUPANCIES: blocks of a plan ask for nearly the same.
    """
    return _taps_needed(math.ceil(min(occupancy, 1.0) * OCCUPANCIES - 1e-9), error, at_most)


@lru_cache(maxsize=256)
def _taps_needed(occupancy: int, error: float, at_most: int) -> int:
    """Compute `taps_needed` for an occupancy in units of 1 / OCCUPANCIES; the error falls with the number of taps."""
    low, high = 2, at_most // 2
    while low < high:
        middle = (low + high) // 2
        if interpolation_error(2 * middle, occupancy / OCCUPANCIES) <= error:
            high = middle
        else:
            low = middle + 1
    return 2 * low


def tap_polynomials(n_tap: int, *, occupancy: float) -> Float32Array:
    """Expand taps about TAP_PHASES fractions: weight_k(q / TAP_PHASES + mu) = sum_p table[q, k, p] mu^p.

    Valid for |mu| <= TAP_REACH, so that a strip over which the fraction drifts needs one table look-up, not one per
    sample.

    Returns
    -------
    (TAP_PHASES + 1, n_tap, TAP_ORDER + 1) float32
    """
    k = np.arange(n_tap) - (n_tap // 2 - 1)
    gram = np.sinc(occupancy * (k[:, None] - k[None, :])) + 1e-9 * np.eye(n_tap)
    nodes = np.cos(np.pi * (np.arange(TAP_ORDER + 1) + 0.5) / (TAP_ORDER + 1))
    fraction = np.arange(TAP_PHASES + 1)[:, None] / TAP_PHASES + TAP_REACH * nodes
    weights = solvers.least_squares(gram, np.sinc(occupancy * (fraction.reshape(-1, 1) - k)))
    weights = weights.reshape(n_tap, TAP_PHASES + 1, TAP_ORDER + 1)
    to_power = solvers.least_squares(np.vander(TAP_REACH * nodes, increasing=True).T, np.eye(nodes.size))
    return np.ascontiguousarray(np.einsum("kqn,pn->qkp", weights, to_power), dtype=np.float32)


@njit(**PART, **COMPILED)
def _fetch(row: Any, first: Any, count: Any, real: Any, imag: Any) -> None:
    """Copy the real and imaginary parts of row[first : first + count]; zero beyond the row's ends.

    Two arrays, because interleaved parts would have to be shuffled at every tap.
    """
    begin = min(max(-first, 0), count)
    end = max(min(row.size - first, count), begin)
    for j in range(begin):
        real[j], imag[j] = 0, 0
    for j in range(end, count):
        real[j], imag[j] = 0, 0
    whole = end - (end - begin) % LANES
    for j in range(begin, whole, LANES):
        store(real, j, load_real(row, first + j))
        store(imag, j, load_imag(row, first + j))
    for j in range(whole, end):
        real[j], imag[j] = row[first + j].real, row[first + j].imag


@njit(**PART, **COMPILED)
def _strip_length(drift: Any) -> Any:
    """Number of samples over which the fraction stays within TAP_REACH at a drift of at most `drift` per sample."""
    length = LANES
    while length > 1 and (length - 1) / 2 * drift > TAP_REACH - 0.5 / TAP_PHASES:
        length //= 2
    return length


@njit(**PART, **COMPILED)
def _weigh(real: Any, imag: Any, first: Any, weights: Any, mu: Any) -> Any:
    """Sum over taps for LANES samples with windows from first, first + 1, ...; weights are polynomials in mu."""
    re, im = spread(np.float32(0.0)), spread(np.float32(0.0))
    for k in range(weights.shape[0]):
        weight = horner(weights[k], TAP_ORDER, mu)
        re = re + weight * load(real, first + k)
        im = im + weight * load(imag, first + k)
    return re, im


@njit(**PART, **COMPILED)
def _window(i: Any, length: Any, n_tap: Any, middle: Any, s: Any) -> Any:
    """First tap and fraction of a sample for the strip of output samples i .. i + length - 1."""
    half = (length - 1) / 2
    position = middle + (i + half - middle) * s - half
    whole = np.floor(position)
    return int(min(max(whole, -1e9), 1e9)) - (n_tap // 2 - 1), position - whole


@loop(SAMPLES_IN, SAMPLES_OUT, REAL_ROW, types.float64, TAPS, **COMPILED)
def stretch_rows(values: ComplexArray, out: ComplexArray, scale: FloatArray, middle: float, taps: Float32Array) -> None:
    """Stretch rows: out[r, i] = scale[r] times values[r] at middle + (i - middle) scale[r]; zero beyond the ends.

    The factor preserves the sum along a row. Positions advance by almost one sample per output sample, so over a short
    strip the window slides evenly and only the fraction of a sample drifts: the weights are polynomials in it, and all
    loops run over contiguous samples.

    Parameters
    ----------
    values, out : (n_row, n) complex64
        Two different arrays.
    scale : (n_row,) float64
        Near 1.
    middle : float
        The position that maps to itself.
    taps : (TAP_PHASES + 1, n_tap, TAP_ORDER + 1) float32
        From `tap_polynomials`.

    Raises
    ------
    ValueError
        If a scale is not between 1/2 and 2.
    """
    n = values.shape[1]
    n_tap = taps.shape[1]
    room = 2 * PIECE + n_tap + 2 * LANES
    real, imag = np.empty(room, np.float32), np.empty(room, np.float32)
    strip = np.empty(LANES, np.complex64)
    for r in range(values.shape[0]):
        row, result, s = values[r], out[r], scale[r]
        if not 0.5 <= s <= 2.0:
            raise ValueError("scale is not near 1")
        length = _strip_length(abs(s - 1.0))
        for i in range(0, n, length):
            if i % PIECE == 0:
                last = i + (min(PIECE, n - i) - 1) // length * length
                origin = _window(i, length, n_tap, middle, s)[0]
                end = _window(last, length, n_tap, middle, s)[0] + n_tap + LANES
                _fetch(row, origin, end - origin, real, imag)
            first, fraction = _window(i, length, n_tap, middle, s)
            q = int(fraction * TAP_PHASES + 0.5)
            start = fraction - q / TAP_PHASES - (length - 1) / 2 * (s - 1.0)
            mu = np.float32(start) + np.float32(s - 1.0) * count_lanes()
            re, im = _weigh(real, imag, first - origin, taps[q], mu)
            re, im = re * np.float32(s), im * np.float32(s)
            if i + LANES <= n:  # a full vector, even if the strip is shorter: the next strip overwrites the rest
                store_complex(result, i, re, im)
            else:
                store_complex(strip, 0, re, im)
                for j in range(i, n):
                    result[j] = strip[j - i]


@njit(**PART, **COMPILED)
def _expand(c: Any, n: Any, terms: Any) -> Any:
    """Taylor terms of a polynomial in steps of half a vector: c(u + x LANES / n) = sum_k terms[k](u) x^k.

    Returns the order of the last term above 1e-7 samples, at least 1.
    """
    for m in range(c.size):
        terms[0, m] = c[m]
    last = 1
    for k in range(1, c.size):
        size = 0.0
        for m in range(c.size):
            terms[k, m] = 0.0
        for m in range(c.size - k):
            terms[k, m] = terms[k - 1, m + 1] * ((m + 1) / k * LANES / n)
            size += abs(terms[k, m])
        if size > 1e-7:
            last = k
    return last


@njit(**PART, **COMPILED)
def _root(values: Any, middle: Any, share: Any) -> Any:
    """Square roots of LANES values within middle (1 +- share), share at most 0.6, starting from that of `middle`."""
    inverse = spread(np.float32(1.0 / np.sqrt(middle)))
    error = 1.0 - np.sqrt(1.0 - share)
    while error > 1e-7:  # Newton's iteration needs no division
        inverse = inverse * (np.float32(1.5) - np.float32(0.5) * values * inverse * inverse)
        error *= (1.5 + 0.5 * error) * error
    return inverse * values


@loop(SAMPLES_IN, SAMPLES_OUT, REAL_ROWS, TAPS, **COMPILED)
def resample_rows(values: ComplexArray, out: ComplexArray, positions: FloatArray, taps: Float32Array) -> None:
    """Resample rows: out[r, i] = sqrt(dp / di) values[r] at p = sum_k positions[r, k] u_i^k, u normalised.

    u_i = (i - n // 2) / (n / 2). Energy is preserved; samples beyond the ends count as zero. As in `stretch_rows` the
    window slides evenly over a short strip, but the fraction drifts along a curve: the position's polynomial, expanded
    about the middle of every LANES samples to as many terms as matter in this row.

    Parameters
    ----------
    values, out : (n_row, n) complex64
        Two different arrays.
    positions : (n_row, order + 1) float64
        In samples; order at least 1.
    taps : (TAP_PHASES + 1, n_tap, TAP_ORDER + 1) float32
        From `tap_polynomials`.

    Raises
    ------
    ValueError
        If there is not one polynomial per row, or positions may advance by less than 1/2 or more than 2 samples per
        sample. The check bounds the slope over every LANES samples; the bound is sharp unless the slope changes
        within them.
    """
    n, n_tap, order = values.shape[1], taps.shape[1], positions.shape[1] - 1
    if positions.shape[0] != values.shape[0] or order < 1:
        raise ValueError("positions are not one polynomial per row")
    room = 2 * PIECE + n_tap + 3 * LANES
    real, imag = np.empty(room, np.float32), np.empty(room, np.float32)
    terms, about = np.empty((order + 1, order + 1)), np.empty((order + 1, LANES))
    drift, slope = np.empty(order + 1, np.float32), np.empty(order, np.float32)
    gain, strip, origin = np.empty(2 * LANES, np.float32), np.empty(LANES, np.complex64), 0
    store(gain, LANES, spread(np.float32(0.0)))
    middles = np.empty(n // LANES + 1 + LANES)  # u in the middle of every LANES samples; zeros fill up
    for i in range(0, middles.size * LANES, LANES):  # `np.zeros` takes longer to compile
        middles[i // LANES] = (i + (min(LANES, n - i) - 1) / 2 - n // 2) * (2.0 / n) if i < n else 0.0
    for r in range(values.shape[0]):
        row, result = values[r], out[r]
        extent = 0.0
        for k in range(order + 1):
            extent += abs(positions[r, k])
        if not extent < 1e9:
            raise ValueError("positions are not near the row")
        last = _expand(positions[r], n, terms)
        for i in range(0, n, LANES):
            block, count = i % PIECE // LANES, min(LANES, n - i)
            if block == 0:
                for k in range(last + 1):
                    store(about[k], 0, horner(terms[k], order, load(middles, i // LANES)))
                origin = int(np.floor(about[0, 0])) - LANES - n_tap // 2
                end = int(about[0, (min(PIECE, n - i) - 1) // LANES]) + 2 * LANES + n_tap
                _fetch(row, origin, min(max(end - origin, 0), room), real, imag)
            pace, bend, reach = about[1, block] * (2 / LANES), 0.0, 1.0
            slope[0], drift[1] = pace, about[1, block] - LANES / 2
            for k in range(2, last + 1):
                drift[k] = about[k, block]
                slope[k - 1] = k * about[k, block] * (2 / LANES)
                reach *= count / LANES
                bend += abs(slope[k - 1]) * reach
            if not (pace - bend > 0.4999 and pace + bend < 2.0001):  # 1/2 and 2 are allowed, up to rounding
                raise ValueError("positions do not advance by 1/2 to 2 samples per sample")
            half = (count - 1) / 2
            along = (count_lanes() - np.float32(half)) * np.float32(2 / LANES)
            store(gain, 0, _root(horner(slope, last - 1, along), pace, bend / pace))
            length = _strip_length(abs(pace - 1.0) + bend)
            for j in range(0, count, length):
                size = min(length, count - j)
                middle = (j + (size - 1) / 2 - half) * (2 / LANES)
                position = about[last, block]
                for k in range(last):
                    position = about[last - 1 - k, block] + middle * position
                position -= (size - 1) / 2
                whole = np.floor(position)
                q = int((position - whole) * TAP_PHASES + 0.5)
                drift[0] = about[0, block] - half + j - whole - q / TAP_PHASES
                mu = horner(drift, last, along + np.float32(j * 2 / LANES))
                re, im = _weigh(real, imag, int(whole) - (n_tap // 2 - 1) - origin, taps[q], mu)
                re, im = re * load(gain, j), im * load(gain, j)
                if i + j + LANES <= n:  # the next strip overwrites the rest, as in `stretch_rows`
                    store_complex(result, i + j, re, im)
                else:
                    store_complex(strip, 0, re, im)
                    for k in range(i + j, n):
                        result[k] = strip[k - i - j]
