"""Images of collections drawn at random beside exact back-projection of the samples, and beside their own plans."""

from __future__ import annotations

import numpy as np
import pytest
from random_collections import draw, judge

SEEDS, QUICK = 30, (10, 26)
# What a plan predicts is measured in every chip, or better, within this of coherence; of losses above 0.008, which a
# plan says are too large, within an eighth.
WITHIN = 1e-3


@pytest.mark.parametrize("seed", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in range(SEEDS)])
def test_an_image_is_as_its_plan_says(seed: int) -> None:
    drawn, plan, refused = draw(seed)
    found = judge(drawn, plan)
    print(f"\n{drawn.title}, {len(plan.blocks)} blocks, {len(refused)} refused: {found}")
    measured = np.array(found[1:])
    assert np.nanmin(measured) > found.predicted - max(WITHIN, (1 - found.predicted) / 8), (drawn.title, found)
    assert np.nanmin(measured) > 0.999 or not plan.faithful, (drawn.title, found)
