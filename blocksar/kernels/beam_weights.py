"""Weights of pulses over a tile of pixels, under a taper over a steered beam.

The place v in the beam is a quadratic polynomial over a tile, through 3 x 3 places; tiles are divided until it errs by
less than PLACE_ERROR.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.solvers import least_squares, product

PLACE_ERROR = 1e-5  # of a place in the beam, whose half width is 1


@dataclass(frozen=True, kw_only=True, eq=False)
class BeamTaper:
    """Weights of pulses that change from pixel to pixel: sum_k terms_k cos(pi frequency k v).

    Attributes
    ----------
    terms : (n,) float
    frequency : float
    valid : (n,) float
        Fraction of each pulse's samples that are there.
    place : callable
        v (n_point, n) of points x, y (n_point,), m, for some pulses of the block: -1 .. 1 where they light them. Last
        their heights (n_point,) over the ground, m; None: they lie on it.
    """

    terms: FloatArray
    frequency: float
    valid: FloatArray
    place: Callable[[FloatArray, FloatArray, slice, FloatArray | None], FloatArray]


def place_tables(
    taper: BeamTaper | None,
    pulses: slice,
    low: FloatArray,
    high: FloatArray,
    relief: tuple[float, float] | None = None,
) -> tuple[FloatArray, bool]:
    """For each pulse the polynomial of the place in the beam over a tile from `low` to `high` (2,), m.

    `relief` is the middle of the heights over it, and how far they reach from there, m.

    Returns
    -------
    places : (n, 7) or (n, 11) float
        Coefficients of 1, dx, dy, dx^2, dx dy and dy^2, from the tile's centre, and the fraction of valid samples; with
        relief those of dz, dx dz, dy dz and dz^2 besides; without a taper none.
    precise : bool
        Whether it errs by less than PLACE_ERROR, where the pulse lights any of the tile.
    """
    if taper is None:
        return np.empty((0, 7)), True
    if relief is not None:
        return _places_on_relief(taper, pulses, low, high, relief)
    at = np.linspace(-1, 1, 5)
    half = np.maximum((high - low) / 2, 1e-6)
    u, w = (axis.ravel() for axis in np.meshgrid(at, at))
    exact = taper.place((low + high)[0] / 2 + half[0] * u, (low + high)[1] / 2 + half[1] * w, pulses, None)
    grid = exact.reshape(5, 5, -1)[::2, ::2]  # rows along y
    middle, (left, right), (below, above) = grid[1, 1], grid[1, ::2], grid[::2, 1]
    mixed = (grid[2, 2] - grid[2, 0] - grid[0, 2] + grid[0, 0]) / 4
    right, left, above, below = right - middle, middle - left, above - middle, middle - below
    bends = (right - left) / 2, mixed, (above - below) / 2
    places = np.stack([middle, (right + left) / 2, (above + below) / 2, *bends], axis=1)
    fitted = product(places, np.stack([np.ones_like(u), u, w, u * u, u * w, w * w]))
    near = (np.abs(exact) <= 1).any(axis=0)
    precise = bool((np.abs(fitted.T - exact)[:, near] < PLACE_ERROR).all())
    scale = np.array([1.0, half[0], half[1], half[0] ** 2, half[0] * half[1], half[1] ** 2])
    return np.column_stack([places / scale, taper.valid[pulses]]), precise


def _places_on_relief(
    taper: BeamTaper, pulses: slice, low: FloatArray, high: FloatArray, relief: tuple[float, float]
) -> tuple[FloatArray, bool]:
    """`place_tables` with the height as third coordinate: the quadratic polynomial closest to 3 x 3 x 3 places."""
    half = np.maximum(np.array([*(high - low) / 2, relief[1]]), 1e-6)
    centre = [*(low + high) / 2, relief[0]]
    nodes = np.array([axis.ravel() for axis in np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3)])
    x, y, z = (c + h * u for c, h, u in zip(centre, half, nodes, strict=True))
    exact = taper.place(x, y, pulses, z)
    exponents = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (2, 0, 0), (1, 1, 0), (0, 2, 0), (0, 0, 1), (1, 0, 1),
                          (0, 1, 1), (0, 0, 2)])  # fmt: skip
    terms = np.prod(nodes.T[:, None, :] ** exponents, axis=-1)
    places = least_squares(terms.T, exact.T).T
    near = (np.abs(exact) <= 1).any(axis=0)
    precise = bool((np.abs(product(terms, places.T) - exact)[:, near] < PLACE_ERROR).all())
    places = places / np.prod(half**exponents, axis=-1)
    table = np.column_stack([places[:, :6], taper.valid[pulses], places[:, 6:]])
    return np.ascontiguousarray(table), precise
