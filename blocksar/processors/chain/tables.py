"""The tables of a plan: its blocks, the contributions to their coherence, and processors side by side."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from blocksar.constants import MIB, unit_of_lengths
from blocksar.processors.chain.ground.relief_correction import bend_scale
from blocksar.processors.chain.planning.block import BlockPlan
from blocksar.processors.chain.planning.plan import Plan
from blocksar.processors.chain.planning.prediction import Prediction
from blocksar.table import Table
from blocksar.texts import FINE, digits

FEW_BLOCKS, WORST = 12, 10  # most blocks that are all shown, and how many are of more
RANGE = "range"  # whose unit the ranges decide
BLOCK_HEADER = (
    "block", "yaw (deg)", RANGE, "Doppler bins", "padded", "bias (m/s2)", "residual phase (rad)",
    "quadratic (rad)", "PSLR (dB)", "width / limit", "azimuth width (m)", "migration (cells)", "memory (MiB)",
)  # fmt: skip


def block_table(plans: Sequence[Plan]) -> Table:
    """Table of the main figures of all blocks, or of the ten with the largest predicted loss."""
    blocks = [block for plan in plans for block in plan.blocks]
    few, divided = len(blocks) <= FEW_BLOCKS, any(plan.parts > 1 for plan in plans)
    worst = sorted(blocks, key=lambda block: block.prediction.coherence)[:WORST]
    header = [
        "block" if few else f"worst {WORST} of {len(blocks)}", "yaw (deg)", *([RANGE] if divided else []),
        "coherence", *([] if divided else ["residual phase (rad)", "PSLR (dB)"]), "width / limit", "memory (MiB)",
    ]  # fmt: skip
    rows, unit = [], _unit(plans)
    for block in blocks:
        if few or block in worst:
            own, p = dict(zip(BLOCK_HEADER, _block_row(block, unit[1]), strict=True)), block.prediction
            rows.append([block.name, *(own.get(name, digits(p.coherence)) for name in header[1:])])
    return _with_unit(header, unit), rows


def _unit(plans: Sequence[Plan]) -> tuple[str, float]:
    """Return the unit for all ranges of the plans, and its metres."""
    return unit_of_lengths(max(block.ground.far for plan in plans for block in plan.blocks))


def _with_unit(header: Sequence[str], unit: tuple[str, float]) -> list[str]:
    return [f"{RANGE} ({unit[0]})" if name == RANGE else name for name in header]


def plan_details(plans: Sequence[Plan]) -> list[Table]:
    """Tables of all figures of all blocks, and of the contributions to their coherence."""
    relief = [] if plans[0].geometry.terrain is None else [_relief_table(plans)]
    return [_all_blocks(plans), _coherence_table(plans), *relief]


def _relief_table(plans: Sequence[Plan]) -> Table:
    """Table of each block's terrain, and the phase errors of targets far above or below its smooth part."""
    header = ("block", "z (m)", "over the smooth ground (m)", "bend taken out (rad)", "predicted coherence")
    rows = []
    for block, relief in ((b, b.ground.relief) for plan in plans for b in plan.blocks if b.ground.relief is not None):
        (lowest, highest), bend = block.ground.levels, 2 * np.pi * relief.most_bend * bend_scale(block.ground)
        heights = f"{lowest:.1f} .. {highest:.1f}", f"{relief.low:.1f} .. {relief.high:.1f}"
        rows.append([block.name, *heights, f"{bend:.2f}", digits(block.prediction.coherence)])
    return header, rows


def _all_blocks(plans: Sequence[Plan]) -> Table:
    unit = _unit(plans)
    return _with_unit(BLOCK_HEADER, unit), [_block_row(block, unit[1]) for plan in plans for block in plan.blocks]


def _coherence_table(plans: Sequence[Plan]) -> Table:
    header = (
        "block", "predicted coherence", "lost by residual phase", "by range migration", "at the ends of the dwell",
        "by noise of the track",
    )  # fmt: skip
    return header, [_coherence_row(block.name, block.prediction) for plan in plans for block in plan.blocks]


def _coherence_row(name: str, p: Prediction) -> list[str]:
    losses = (p.phase_loss, p.range_loss, p.dispersion_loss, p.track_loss)
    places = 4 if p.coherence < FINE else 6
    return [name, digits(p.coherence), *(f"{loss:.{places}f}" for loss in losses)]


def _block_row(block: BlockPlan, metres: float) -> list[str]:
    low, high = np.degrees([block.low, block.high])
    p = block.prediction
    return [
        block.name,
        f"{low:.3f} .. {high:.3f}",
        f"{block.ground.near / metres:.3f} .. {block.ground.far / metres:.3f}",
        f"{block.first_bin} .. {block.first_bin + block.n_bin}",
        str(block.ground.doppler.size),
        f"{block.choice.candidate.bias:.1f}",
        f"{p.residual_phase:.4f}",
        f"{p.quadratic_phase:.4f}",
        f"{p.pslr:.2f}",
        f"{p.width:.3f}",
        f"{p.resolution:.3f}",
        f"{p.migration:.3f}",
        f"{block.memory / MIB:.0f}",
    ]
