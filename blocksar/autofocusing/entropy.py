"""Entropy of chips: small where they are sharp. With its gradient over the phase of each sample."""

from __future__ import annotations

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.kernels.fourier import fast_length, fft_rows
from blocksar.kernels.groups import run_groups

TINY = 1e-30
PADDING = 2.0  # Doppler cells for each sample: with |Y|^2 sampled so finely, to move a chip costs nothing


def entropies(values: ComplexArray, phase: FloatArray, threads: int = 1) -> tuple[FloatArray, FloatArray]:
    """Entropy of each chip, and its gradient.

    E = -sum p ln p over range lines and Doppler, p = |Y|^2 / sum |Y|^2, Y the transform of values exp(j phase).
    dE / dphase_t = 2 Im(x_t conj(sum_k (ln p_k + 1) Y_k exp(+2j pi k t / N))) / sum |Y|^2, summed over lines.

    Parameters
    ----------
    values : (n_point, n_line, n) complex64
    phase : (n_point, n) float
        rad.
    threads : int
        The result does not depend on it.

    Returns
    -------
    (n_point,) float, (n_point, n) float
        Nats, and nats per rad.
    """
    n_point, n_line, n = values.shape
    length = fast_length(PADDING * n)
    entropy, gradient = np.zeros(n_point), np.zeros((n_point, n))

    def one(i: int) -> None:
        turned = np.zeros((n_line, length), np.complex64)
        np.multiply(values[i], np.exp(1j * phase[i]).astype(np.complex64), out=turned[:, :n])
        image = fft_rows(turned.copy(), inverse=False)
        power = image.real**2 + image.imag**2
        total = float(power.sum(dtype=np.float64))
        if total <= 0:
            return
        share = power * np.float32(1 / total)
        logarithm = np.log(share + np.float32(TINY))
        entropy[i] = -float((share * logarithm).sum(dtype=np.float64))
        image *= logarithm + 1
        back = fft_rows(image, inverse=True)[:, :n]
        gradient[i] = (turned[:, :n] * np.conj(back)).imag.sum(axis=0, dtype=np.float64) * (2 * length / total)

    run_groups(one, range(n_point), threads)
    return entropy, gradient
