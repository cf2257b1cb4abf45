"""Planning of the waves by which a block is weighed whose beam stays on its ground (`focusing.aperture_waves`)."""

from __future__ import annotations

import numpy as np

from blocksar import solvers
from blocksar.arrays import FloatArray
from blocksar.collection.beam import at_times, beam_offset
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import Taper
from blocksar.focusing.ground_map import ApertureWaves
from blocksar.focusing.lines import Line
from blocksar.focusing.surfaces import GroundRange, fit_surface

MOST_WAVES = 3
WAVE_ERROR = 5e-4  # of the weights, root mean square, that too few waves may leave
TURN_SHARE = 0.25  # of a turn, over which the first wave goes in the time of the aperture


def plan_waves(
    geometry: Geometry, taper: Taper, lit: Line, line: Line, *, along: GroundRange, epoch_range: FloatArray,
    yaw: FloatArray,
) -> ApertureWaves:  # fmt: skip
    """The fewest waves that make the weights of targets at the nodes `along` the ground and at yaws (n_yaw,), rad.

    Those that are never lit may have others.

    Parameters
    ----------
    geometry : Geometry
        With the beam.
    lit, line : Line
        (n_range, n_yaw, n), over all pulses, before and after all steps.
    """
    collection = geometry.collection
    at = epoch_range[:, None], yaw
    x, y, z = (np.asarray(axis)[..., None] for axis in (*geometry.ground_axes(*at), geometry.level(*at)))
    v = 2 * at_times(geometry, x, y, lit.time + geometry.epoch, beam_offset, z) / (collection.beam_width or np.inf)
    weights, seen = taper(v), (np.abs(v) <= 1).any(axis=-1)
    first, last = float(line.time.min()), float(line.time.max())
    step, middle = TURN_SHARE / (last - first), (first + last) / 2
    counts = np.sqrt(np.broadcast_to(lit.weight, weights.shape))
    for n in range(1, MOST_WAVES + 1):
        turns = 2 * np.pi * step * np.arange(1, n + 1)[:, None] * (line.time - middle)[..., None, :]
        terms = np.concatenate([np.ones_like(turns[..., :1, :]), np.cos(turns), np.sin(turns)], axis=-2)
        fitted, left = np.empty(terms.shape[:-1]), np.empty(weights.shape)
        for at in np.ndindex(weights.shape[:-1]):
            fitted[at] = solvers.least_squares(terms[at] * counts[at], weights[at] * counts[at])
            left[at] = (fitted[at][:, None] * terms[at]).sum(axis=0) - weights[at]
        error = np.sqrt((left**2 * lit.weight).sum(axis=-1) / (weights**2 * lit.weight).sum(axis=-1))
        worst = float(error[seen].max(initial=0.0))
        if worst <= WAVE_ERROR:
            break
    surfaces = [fit_surface(fitted[..., k], along=along, yaw=yaw, degree=(9, 16)) for k in range(2 * n + 1)]
    return ApertureWaves(
        step=step, middle=middle, constant=surfaces[0],
        pairs=tuple(zip(surfaces[1 : n + 1], surfaces[n + 1 :], strict=True)), error=worst,
    )  # fmt: skip
