"""Phase gradient: the line-of-sight displacement that all chips share, from the phase between successive samples.

Each range line of a chip is centred on its strongest scatterer and cut to a band of Doppler about it. The products of
successive samples, conj(z_t) z_(t+1), then turn by the gradient of the error plus a slope of the line's own, since the
scatterer may lie anywhere in the chip. Gradients are averaged as phasors, not as angles, over lines; slopes likewise
over time, in turns. The lines' slopes stitch the dwells of a beam that turns: no sample has to be lit for all lines.

References
----------
Wahl, Eichel, Ghiglia, Jakowatz, "Phase gradient autofocus", IEEE Trans. AES 30(3), 1994.
"""

from __future__ import annotations

import numpy as np
from numba import types

from blocksar.arrays import Complex128Array, ComplexArray, FloatArray, IntArray
from blocksar.autofocusing.chips import INDICES, Chips
from blocksar.kernels.fourier import fft_rows
from blocksar.kernels.groups import row_groups
from blocksar.kernels.loops import loop

TURNS = 100  # of slopes and gradients, at most
SETTLED = 1e-4  # rad per sample: slopes that change by less are final
WEIGHED = 20  # turns, after which weights stay
LINES = 3  # of each chip, the strongest
BLUR = 0.125  # of the band: a point that is blurred is not one bright cell
NARROWING = 0.6  # of the band of Doppler, from one iteration to the next
LEAST_BAND = 12  # Doppler cells
MOST_WEIGHT = 10.0  # of a line whose scatterer stands alone
PRODUCTS = types.Array(types.complex128, 2, "C", readonly=True)
FACTORS = types.Array(types.complex128, 1, "C", readonly=True)


def centred_rows(
    values: ComplexArray, count: IntArray, band: int, blur: int | None = None
) -> tuple[ComplexArray, FloatArray]:
    """Centre each row on its brightest Doppler and cut it to a band about that.

    Parameters
    ----------
    values : (n_row, n) complex64
        Zero from count (n_row,) on.
    band : int
        Doppler cells to either side that are kept.
    blur : int, optional
        Doppler cells to either side over which power is summed to find the brightest; by default BLUR of the band.

    Returns
    -------
    (n_row, n) complex64, (n_row,) float
        The rows, and the turn by which each was centred, rad per sample.
    """
    n = values.shape[1]
    spectrum = fft_rows(values.copy(), inverse=False)
    power = spectrum.real**2 + spectrum.imag**2
    width = max(int(BLUR * band), 1) if blur is None else blur
    smooth = np.cumsum(np.concatenate([power[:, -width:], power, power[:, :width]], axis=1), axis=1, dtype=np.float64)
    smooth = smooth[:, 2 * width :] - smooth[:, : -2 * width]
    peak = smooth.argmax(axis=1)
    away = (np.arange(n) + n // 2) % n - n // 2
    window = np.exp(-(((away / band) ** 2 * 2) ** 4)).astype(np.float32)  # flat, with soft edges
    centred = np.take_along_axis(spectrum, (peak[:, None] + np.arange(n)) % n, axis=1) * window
    rows = fft_rows(centred, inverse=True)
    turn = 2 * np.pi * ((peak + n // 2) % n - n // 2) / n
    return np.where(np.arange(n) < count[:, None], rows, np.complex64(0)), turn


def shared_gradient(
    products: Complex128Array, first: IntArray, n_part: int, share: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Gradient that all rows share, rad per sample.

    Parameters
    ----------
    products : (n_row, n) complex
        conj(z_t) z_(t+1) of each row, over the sum of their magnitudes; 0 where there is none.
    first : (n_row,) int
        Part of the collection that the first product of each row belongs to; the others belong to those that follow.
    n_part : int
        Products beyond the last part do not count.
    share : (n_row,) float
        By which rows count, besides their coherence.

    Returns
    -------
    gradient : (n_part,) float
        0 where nothing is lit.
    slope : (n_row,) float
        Of each row.
    coherence : (n_row,) float
        How much of a row's power follows these, 0 .. 1.
    """
    n_row = products.shape[0]
    weight, slope, own = share.copy(), np.zeros(n_row), np.zeros(n_row, np.complex128)
    gradient, coherence = np.zeros(n_part), np.zeros(n_row)
    for turn in range(TURNS):
        shared = np.zeros(n_part, np.complex128)
        add_rows(products, first, weight * np.exp(-1j * slope), shared)
        gradient = np.where(shared == 0, 0.0, np.angle(shared))
        sum_along(products, first, np.exp(-1j * gradient), own)
        moved = np.abs(np.angle(own * np.exp(-1j * slope))).max()
        slope, coherence = np.angle(own), np.abs(own)
        if turn > WEIGHED and moved < SETTLED:
            break
        if turn % 5 == 4 and turn <= WEIGHED:
            weight = share * np.minimum(coherence**2 / np.maximum(1 - coherence**2, 1 / MOST_WEIGHT), MOST_WEIGHT)
    return gradient, slope, coherence


@loop(PRODUCTS, INDICES, FACTORS, types.complex128[::1], nogil=True)
def add_rows(values: Complex128Array, first: IntArray, factors: Complex128Array, out: Complex128Array) -> None:
    """Add row r times its factor to the common samples: out[first[r] + m] += factors[r] values[r, m]."""
    for r in range(values.shape[0]):
        factor, row, into = factors[r], values[r], out[first[r] :]
        for m in range(min(row.size, into.size)):
            into[m] += factor * row[m]


@loop(PRODUCTS, INDICES, FACTORS, types.complex128[::1], nogil=True)
def sum_along(values: Complex128Array, first: IntArray, factors: Complex128Array, out: Complex128Array) -> None:
    """Correlate rows with common samples: out[r] = sum_m factors[first[r] + m] values[r, m]."""
    for r in range(values.shape[0]):
        row, along = values[r], factors[first[r] :]
        n, even, odd = min(row.size, along.size), 0j, 0j
        for m in range(0, n - 1, 2):  # two sums, since one would wait for each addition
            even += along[m] * row[m]
            odd += along[m + 1] * row[m + 1]
        if n % 2:
            even += along[n - 1] * row[n - 1]
        out[r] = even + odd


def strongest_lines(chips: Chips) -> ComplexArray:
    """The range lines of each chip with the most power, (n_point, LINES, n); a copy."""
    power = (np.abs(chips.values) ** 2).sum(axis=2, dtype=np.float64)
    strongest = np.argsort(-power, axis=1, kind="stable")[:, :LINES]
    return np.take_along_axis(chips.values, strongest[..., None], axis=1)


def line_of_sight(chips: Chips, phase: FloatArray, band: int, weights: FloatArray) -> FloatArray:
    """Phase (n_sample,), rad, that the chips share, by one phase gradient; its mean line over time is arbitrary.

    Parameters
    ----------
    chips : Chips
        With their strongest lines.
    phase : (n_point, n) float
        Removed from the chips first, rad.
    band : int
        Doppler cells to either side of a line's brightest one.
    weights : (n_point,) float
    """
    n_point, n_line, n = chips.values.shape
    energy, products = np.zeros(n_point * n_line), np.zeros((n_point * n_line, n - 1), np.complex128)
    for some in row_groups(0, n_point, n_line * n):
        turned = chips.values[some] * np.exp(-1j * phase[some]).astype(np.complex64)[:, None]
        rows, _ = centred_rows(turned.reshape(-1, n), np.repeat(chips.count[some], n_line), band)
        into = slice(some.start * n_line, some.stop * n_line)
        energy[into] = (np.abs(rows) ** 2).sum(axis=1, dtype=np.float64)
        steps = np.conj(rows[:, :-1]).astype(np.complex128) * rows[:, 1:]
        products[into] = steps / np.maximum(np.abs(steps).sum(axis=1), 1e-300)[:, None]
    # Chips have equal weight, and their lines the weight of their power.
    energy = energy.reshape(n_point, n_line)
    share = np.sqrt(weights)[:, None] * energy / np.maximum(energy.sum(axis=1, keepdims=True), 1e-300)
    last = chips.time.size - 1
    gradient, _, _ = shared_gradient(products, np.repeat(chips.first, n_line), last, share.ravel())
    return np.concatenate([[0.0], np.cumsum(gradient)])


PARTS = 8  # of a dwell, in each of which a point has one phase
LEAST_PARTS = 3  # of them, not missing: a line goes through two
TOLERANCE = 2.5  # times the median of the points' own phase errors: there the weight is a half
LEAST_TOLERANCE = 0.1  # rad


def own_errors(chips: Chips) -> FloatArray:
    """Phase error (n_point,), rad rms, of each point alone that remains after the correction.

    From the phases of the strongest line in PARTS parts of the dwell, without their mean and line; those in a gap do
    not count.
    """
    energy = (np.abs(chips.values) ** 2).sum(axis=2, dtype=np.float64)
    strongest = energy.argmax(axis=1)
    values = np.ascontiguousarray(chips.values[np.arange(strongest.size), strongest])
    rows, _ = centred_rows(values, chips.count, LEAST_BAND)
    errors = np.full(strongest.size, np.pi)
    u, valid = np.linspace(-1, 1, PARTS), chips.told
    for i, row in enumerate(rows):
        n = int(chips.count[i])
        if n < PARTS or energy[i].max() <= 0:
            continue
        sums = np.array([part.sum(dtype=np.complex128) for part in np.array_split(row[:n], PARTS)])
        there = np.array([part.any() for part in np.array_split(valid[i, :n], PARTS)])  # those in a gap have no phase
        sums, at = sums[there], u[there]
        if at.size < LEAST_PARTS:
            continue
        steps = sums[1:] * np.conj(sums[:-1])
        if not there.all():  # a point may turn by more than half a turn over a gap
            apart = np.diff(np.flatnonzero(there))
            steps = steps * np.exp(-1j * apart * np.angle(steps[apart == 1].sum()))
        phase = np.concatenate([[0.0], np.cumsum(np.angle(steps))])
        share = np.abs(sums) ** 2
        share /= share.sum()
        flat = phase - (share * phase).sum()
        line = at - (share * at).sum()
        flat = flat - line * (share * line * flat).sum() / (share * line * line).sum()
        errors[i] = np.sqrt((share * flat * flat).sum())
    return errors


def point_weights(errors: FloatArray) -> FloatArray:
    """Weights (n_point,) of points from their own phase errors: 1 / (1 + (error / tolerance)^4)."""
    tolerance = max(TOLERANCE * float(np.median(errors)), LEAST_TOLERANCE)
    return np.asarray(1 / (1 + (errors / tolerance) ** 4))
