"""Transforms of samples that are not uniform."""

from __future__ import annotations

import numpy as np

from blocksar.arrays import Complex128Array, FloatArray

ACCURACY = 1e-6  # of the result, over the sum of moduli


def sum_phasors(values: Complex128Array, turns: FloatArray, n: int) -> Complex128Array:
    """sum_j values[..., j] exp(2j pi k turns[j]) for n whole numbers k, from -(n // 2) on.

    In double precision, since single holds the turns of thousands of bins to a thousandth only.

    Parameters
    ----------
    values : (n_row, m) or (m,) complex
    turns : (m,) float
        |turns| <= 1/2.

    Returns
    -------
    (n_row, n) or (n,) complex128
    """
    import finufft  # which few collections need

    rows = np.ascontiguousarray(values, np.complex128)
    plan = finufft.Plan(
        1, (n,), n_trans=1 if rows.ndim == 1 else len(rows), eps=ACCURACY, isign=1, dtype="complex128", nthreads=1
    )
    plan.setpts(2 * np.pi * np.asarray(turns, np.float64))
    return np.asarray(plan.execute(rows)).reshape(*rows.shape[:-1], n)
