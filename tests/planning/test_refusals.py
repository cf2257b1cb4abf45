"""What is said where no chain forms an image: the reason once, the processor that does it, and its time; soon."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from near_range import near_range

import blocksar
from blocksar.planning import planner

GRID = "-2:2:0.05,-2:2:0.05"
END = r"; exact back-projection has no such limit: --processor backprojection, about \d+ s on this machine$"


@pytest.fixture
def close() -> Any:
    """3 to 5 GHz at 5 m over 4 m: an aperture of 80 degrees."""
    along = np.linspace(-2, 2, 400)
    made = near_range(n_frequency=128, track=np.stack([0 * along - 5.0, along, 0 * along + 1.5], axis=1))
    return blocksar.collection(**{**made, "carrier_frequency": 4e9})


def test_what_no_chain_forms_ends_with_who_does_it_and_its_time(close: Any) -> None:
    few = blocksar.plan(close, grid=GRID, workers=0, blocks=4)
    assert few.refusal is not None and re.search(END, few.refusal)
    assert few.refusal.count("backprojection") == 1
    assert not few.tables and not few.details and not few.summary


@pytest.mark.slow  # test_fidelity.py has another collection of which no division keeps the fidelity
def test_the_best_division_of_what_keeps_no_fidelity_is_found_soon(close: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Up to 64 x 8 parts were tried, 256 plans of blocks, to advise still more."""
    planned = []
    once = planner.plan_block
    monkeypatch.setattr(planner, "plan_block", lambda *args, **kw: planned.append(1) or once(*args, **kw))
    said = "\n".join(blocksar.plan(close, grid=GRID, workers=0).summary)
    assert "fidelity 0.999 is not kept by any division" in said and "more blocks" not in said
    assert re.search(r"exact back-projection of this grid takes less, about \d+ s: --processor backprojection", said)
    assert len(planned) <= 250, len(planned)


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
