"""Limited-memory BFGS without BLAS: the same bytes in every process, see `blocksar.solvers`."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from blocksar.arrays import FloatArray

MEMORY = 12  # steps whose curvature is kept
ARMIJO = 1e-4
CURVATURE = 0.9  # of the slope may be left after a step
TRIES = 20  # of a step's length


class Minimum(NamedTuple):
    """Where a function is smallest, its value there, and the number of evaluations."""

    at: FloatArray
    value: float
    evaluations: int


def minimise(
    function: Callable[[FloatArray], tuple[float, FloatArray]],
    start: FloatArray,
    *,
    iterations: int,
    gain: float,
    first_step: float,
) -> Minimum:
    """Minimise a smooth function of (n,) that returns its value and gradient.

    Parameters
    ----------
    iterations : int
        At most.
    gain : float
        Stop when two steps together lower the value by less.
    first_step : float
        Length of the first step, in units of the argument.

    References
    ----------
    Nocedal, Wright, "Numerical Optimization", 2nd edition, algorithms 7.4 and 3.5 (bisection in place of zoom).
    """
    x = start.copy()
    value, slope = function(x)
    count, gains = 1, [np.inf, np.inf]
    pairs: list[tuple[FloatArray, FloatArray]] = []
    for _ in range(iterations):
        way = -_product(slope, pairs)
        down = float((way * slope).sum())
        if not down < 0:
            pairs, way = [], -slope
            down = float((way * slope).sum())
        if down == 0:
            break
        length = 1.0 if pairs else first_step / float(np.sqrt((way * way).sum()))
        low, high = 0.0, np.inf
        for _ in range(TRIES):
            new = x + length * way
            new_value, new_slope = function(new)
            count += 1
            if new_value > value + ARMIJO * length * down:
                high = length
            elif float((new_slope * way).sum()) < CURVATURE * down:
                low = length
            else:
                break
            length = (low + high) / 2 if np.isfinite(high) else 2 * low
        if new_value >= value:
            break
        step, change = new - x, new_slope - slope
        if float((step * change).sum()) > 0:
            pairs = [*pairs[-MEMORY + 1 :], (step, change)]
        gains = [gains[1], value - new_value]
        x, value, slope = new, new_value, new_slope
        if sum(gains) < gain:
            break
    return Minimum(x, value, count)


def _product(slope: FloatArray, pairs: list[tuple[FloatArray, FloatArray]]) -> FloatArray:
    """The approximate inverse Hessian times a slope, from pairs of steps and changes of the slope."""
    q, factors = slope.copy(), []
    for step, change in reversed(pairs):
        factor = float((step * q).sum() / (step * change).sum())
        q -= factor * change
        factors.append(factor)
    if pairs:
        step, change = pairs[-1]
        q *= float((step * change).sum() / (change * change).sum())
    for (step, change), factor in zip(pairs, reversed(factors), strict=True):
        q += (factor - float((change * q).sum() / (step * change).sum())) * step
    return q
