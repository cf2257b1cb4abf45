"""Entropy of chips: small where they are sharp. With its gradient over the phase of each sample."""

from __future__ import annotations

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.kernels.fourier import fast_length, fft_rows
from blocksar.kernels.groups import GROUP_BYTES, run_groups

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

    def some(rows: slice) -> None:
        turned = values[rows] * np.exp(1j * phase[rows]).astype(np.complex64)[:, None]
        image = np.zeros((turned.shape[0], n_line, length), np.complex64)
        image[..., :n] = turned
        image = fft_rows(image.reshape(-1, length), inverse=False).reshape(image.shape)
        share = image.real**2
        share += image.imag**2
        total = share.sum(axis=(1, 2), dtype=np.float64)
        told = total > 0
        scale = np.where(told, 1 / np.where(told, total, 1.0), 0.0)
        share *= scale.astype(np.float32)[:, None, None]
        logarithm = share + np.float32(TINY)
        np.log(logarithm, out=logarithm)
        entropy[rows] = -(share * logarithm).sum(axis=(1, 2), dtype=np.float64)
        logarithm += 1
        image *= logarithm
        back = fft_rows(image.reshape(-1, length), inverse=True).reshape(image.shape)[..., :n]
        imaginary = turned.imag * back.real - turned.real * back.imag
        gradient[rows] = imaginary.sum(axis=1, dtype=np.float64) * (2 * length * scale)[:, None]

    many = max(GROUP_BYTES // (8 * n_line * length), 1)
    run_groups(some, [slice(i, min(i + many, n_point)) for i in range(0, n_point, many)], threads)
    return entropy, gradient
