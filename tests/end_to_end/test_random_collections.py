"""Images of collections drawn at random, by a chain or `auto`, beside exact back-projection and their own plans.

Seeds follow from the day, so that every day sees collections that nobody has seen. A failure prints its seed and the
command that repeats it.
"""

from __future__ import annotations

import os
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from random_collections import draw, judge, platform_of

SEEDS, QUICK = 30, 3  # a day, and how many of them are not slow: of platforms for which few blocks are planned
# Least difference by which the measured coherence may lie below the predicted one; of losses above 0.008, which a plan
# says are too large, an eighth.
WITHIN = 1e-3
FIRST = date.fromisoformat(os.environ["BLOCKSAR_TESTS_DAY"]).toordinal() * SEEDS
DRAWN = [int(seed) for seed in os.environ.get("BLOCKSAR_TESTS_SEEDS", "").split()] or range(FIRST, FIRST + SEEDS)
ORDER = sorted(DRAWN, key=lambda seed: platform_of(seed) not in ("maneuvering", "satellite"))


@pytest.mark.parametrize(
    "seed", [*ORDER[:QUICK], *(pytest.param(seed, marks=pytest.mark.slow) for seed in ORDER[QUICK:])]
)
def test_an_image_is_as_its_plan_says(seed: int, tmp_path: Path) -> None:
    print(f"\nrepeat: BLOCKSAR_TESTS_SEEDS={seed} .venv/bin/pytest tests/end_to_end/test_random_collections.py")
    drawn = draw(seed)
    found = judge(drawn, tmp_path)
    print(f"{drawn.title}, by {found.processor}: {found}")
    measured = np.array([found.least, found.ends])
    assert np.nanmin(measured) > found.predicted - max(WITHIN, (1 - found.predicted) / 8), (drawn.title, found)
    assert np.nanmin(measured) > 0.999 or not found.faithful, (drawn.title, found)
    assert found.missing == 0, (drawn.title, found)
