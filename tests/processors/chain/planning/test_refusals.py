"""What is said where no chain forms an image: the reason once, and the processor that does it."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from near_range import near_range

import blocksar

GRID = "-2:2:0.05,-2:2:0.05"
END = "; hierarchical back-projection has no such limit: --processor hierarchical-backprojection"


@pytest.fixture
def close() -> Any:
    """3 to 5 GHz at 5 m over 4 m: an aperture of 80 degrees."""
    along = np.linspace(-2, 2, 400)
    made = near_range(n_frequency=128, track=np.stack([0 * along - 5.0, along, 0 * along + 1.5], axis=1))
    return blocksar.collection(**{**made, "carrier_frequency": 4e9})


@pytest.mark.slow
def test_what_no_chain_forms_ends_with_who_does_it(close: Any) -> None:
    few = blocksar.plan(close, grid=GRID, workers=0, blocks=4)
    assert few.refusal is not None and few.refusal.endswith(END)
    assert not few.tables and not few.details and not few.summary


def test_ranges_below_a_kilometre_are_told_in_metres(close: Any) -> None:
    small = blocksar.plan(close, grid="-0.1:0.1:0.02,-0.1:0.1:0.02", workers=0, processor="angular-division")
    header, rows = small.details[0]
    column = header.index("range (m)")
    near, far = (float(end) for end in rows[0][column].split(" .. "))
    assert 2 < near < 5.2 < far < 12
    outside = None
    try:
        blocksar.plan(close, grid="30:32:0.1,-1:1:0.1", workers=0)
    except blocksar.InputError as error:
        outside = str(error)
    assert outside is not None and re.search(r"3[0-9]\.\d+ \.\. 3[0-9]\.\d+ m at the epoch", outside)
