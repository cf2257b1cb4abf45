"""Reasons to refuse a plan: targets that share their Doppler, or that stay blurred.

Exact back-projection has none of them; who shows a reason adds that, with its time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.beam import aperture, dwell_at
from blocksar.focusing.method import DEFAULT, Method
from blocksar.planning.block import BlockPlan
from blocksar.planning.staying import MOST_DWELL, longest_stay


def find_refusal(blocks: Sequence[BlockPlan], method: Method) -> str | None:
    """The reason why a plan cannot be carried out, or None. Variants may blur: they are built to show it."""
    blur = None if method.variant else find_blur(blocks)
    return _find_lingering(blocks) or find_folding(blocks, method) or _find_uneven(blocks) or blur


def _find_lingering(blocks: Sequence[BlockPlan]) -> str | None:
    """The reason why a beam about its axis stays too long on some of a block's ground for a dwell gate, or None."""
    for block in blocks:
        geometry = block.ground.geometry
        if not geometry.collection.has_axis:
            return None
        ranges = np.linspace(block.ground.near, block.ground.far, 9)[:, None]
        longest = longest_stay(geometry, ranges, np.linspace(block.low, block.high, 33))
        start, stop = aperture(geometry.collection)
        if longest > MOST_DWELL * (stop - start):
            stays = "for ever" if longest == np.inf else f"for {longest:.3g} s"
            return (
                f"{_describe_block(block)}: beam_steering turns with the line of sight of some ground, so that the "
                f"beam would stay on it {stays}, beyond the {stop - start:.3g} s of the collection, and passes over "
                "more; cut the collection, or image a smaller grid"
            )
    return None


def find_folding(blocks: Sequence[BlockPlan], method: Method = DEFAULT) -> str | None:
    """The reason why yaws of a block share their Doppler, so that no transform separates them, or None.

    Yaws along the velocity share it in the echo itself. Where the platform's acceleration cancels the Doppler rate, as
    on a circle, yaws share it after a deramp without a bias chirp before it.
    """
    for block in blocks:
        slope = block.ground.doppler_slope() * np.pi / 180
        if slope.min() * slope.max() > 0:
            continue
        change = f"Doppler changes by {slope.min():.3g} .. {slope.max():.3g} Hz a degree of yaw, through zero"
        echo = _echo_slope(block)
        if echo.min() * echo.max() <= 0:
            return (
                f"{_describe_block(block)} looks along the velocity: {change}, so yaws cannot be told apart; image "
                "ground away from the direction of flight"
            )
        cause = f"{change}, after its last step, as acceleration cancels the Doppler rate"
        biased = method.processor == DEFAULT.processor
        remedy = "" if biased else f"; --processor {DEFAULT.processor} may add a bias chirp"
        return f"{_describe_block(block)}: {cause}{remedy}"
    return None


def _find_uneven(blocks: Sequence[BlockPlan]) -> str | None:
    """The reason why a Doppler resampling cannot be applied, or None: that of a closed form has all of its orders."""
    for block in blocks:
        if not block.even:
            return (
                f"{_describe_block(block)} would resample Doppler by more than a factor of two, or too unevenly, "
                "beyond its targets; use --coefficients fitted, or --processor angular-division"
            )
    return None


def _echo_slope(block: BlockPlan) -> FloatArray:
    """Range rate at the middle of the dwell per yaw, m/s per rad, over a block's ranges and yaws (9, 33)."""
    geometry = block.ground.geometry
    yaw = np.linspace(block.low, block.high, 33)
    rng, yaws = np.meshgrid(np.linspace(block.ground.near, block.ground.far, 9), yaw, indexing="ij")
    start, end = dwell_at(geometry, yaws, rng)
    _, rate = geometry.range_history(geometry.ground_point(rng, yaws), (start + end) / 2)
    return np.gradient(rate, yaw, axis=1)


def find_blur(blocks: Sequence[BlockPlan]) -> str | None:
    """The reason why a block cannot be in focus, or None."""
    for block in blocks:
        phase, migration = block.prediction.residual_phase, block.prediction.migration
        error = None
        if not phase < np.pi / 2:
            error = f"a phase error of {phase:.3g} rad"
        elif not migration < 1.0:
            error = f"a range migration of {migration:.3g} resolution cells"
        if error is not None:
            return f"{_describe_block(block)} would keep {error} over the dwell"
    return None


def _describe_block(block: BlockPlan) -> str:
    return f"block {block.name} (yaw {np.degrees(block.low):.2f} .. {np.degrees(block.high):.2f} degrees)"
