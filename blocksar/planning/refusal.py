"""Why a plan cannot be carried out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.beam import dwell_at
from blocksar.focusing.method import Method
from blocksar.planning.block import BlockPlan


def refusal_of(blocks: Sequence[BlockPlan], method: Method) -> str | None:
    """Why a plan cannot be carried out, if so. A rival's blur is what one wants to see of it."""
    return folded(blocks) or (None if method.rival else _blurred(blocks))


def folded(blocks: Sequence[BlockPlan]) -> str | None:
    """Why yaws of a block share their Doppler, so that no transform tells them apart, if so.

    Looking along the velocity they share it in the echo itself. Where the platform's acceleration cancels the Doppler
    rate, as on a circle, they do after a deramp that no bias chirp comes before.
    """
    for block in blocks:
        slope = block.ground.doppler_slope() * np.pi / 180
        if slope.min() * slope.max() > 0:
            continue
        said = f"Doppler changes by {slope.min():.3g} .. {slope.max():.3g} Hz a degree of yaw, through zero"
        echo = _echo_slope(block)
        if echo.min() * echo.max() <= 0:
            return (
                f"{_called(block)} looks along the velocity: {said}, so yaws cannot be told apart; image ground away "
                "from the direction of flight, or use --processor backprojection"
            )
        return (
            f"{_called(block)}: {said}, once its steps are through, as acceleration cancels the Doppler rate; use "
            "--processor angular-division, which may add a bias chirp, or backprojection"
        )
    return None


def _echo_slope(block: BlockPlan) -> FloatArray:
    """Of the range rate in the middle of the dwell per yaw, m/s per rad, over a block's ranges and yaws (9, 33)."""
    geometry = block.ground.geometry
    yaw = np.linspace(block.low, block.high, 33)
    rng, yaws = np.meshgrid(np.linspace(block.ground.near, block.ground.far, 9), yaw, indexing="ij")
    start, end = dwell_at(geometry, yaws)
    _, rate = geometry.range_history(geometry.ground_point(rng, yaws), (start + end) / 2)
    return np.gradient(rate, yaw, axis=1)


def _blurred(blocks: Sequence[BlockPlan]) -> str | None:
    for block in blocks:
        phase, migration = block.prediction.residual_phase, block.prediction.migration
        kept = None
        if not phase < np.pi / 2:
            kept = f"a phase error of {phase:.3g} rad"
        elif not migration < 1.0:
            kept = f"a range migration of {migration:.3g} resolution cells"
        if kept is not None:
            return (
                f"{_called(block)} would keep {kept} over the dwell; ask for more --blocks, or see what "
                "`blocksar plan --processor auto` proposes"
            )
    return None


def _called(block: BlockPlan) -> str:
    return f"block {block.name} (yaw {np.degrees(block.low):.2f} .. {np.degrees(block.high):.2f} degrees)"
