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


@pytest.mark.parametrize("settings", [{}, {"blocks": 4}, {"processor": "auto"}], ids=str)
def test_a_refusal_says_who_does_it_and_soon(
    settings: dict[str, Any], close: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No division into up to 64 x 8 parts does; 256 were planned to say so, then more blocks were advised."""
    planned = []
    once = planner.plan_block
    monkeypatch.setattr(planner, "plan_block", lambda *args, **kw: planned.append(1) or once(*args, **kw))
    report = blocksar.plan(close, grid=GRID, workers=0, **settings)
    assert report.refusal is not None and re.search(END, report.refusal)
    assert report.refusal.count("backprojection") == 1
    assert not re.search(r"more --?blocks|--processor auto|blocks auto", report.refusal)
    assert not report.tables and not report.details and not report.summary
    assert len(planned) <= 40 * (3 if "processor" in settings else 1)


def test_more_blocks_are_advised_where_they_help() -> None:
    """With what is found then."""
    along = np.linspace(-60, 60, 400)
    made = near_range(n_frequency=64, track=np.stack([0 * along - 800.0, along, 0 * along + 300.0], axis=1))
    dataset = blocksar.collection(**{**made, "range_frequency": made["range_frequency"] / 40, "reference_range": 854.0})
    settings: dict[str, Any] = {"grid": "-60:60:1,-100:100:0.5", "workers": 0}
    refused = blocksar.plan(dataset, blocks=1, **settings)
    assert refused.refusal is not None
    assert re.search(r"would keep .*; ask for more --blocks, or for --blocks auto; exact back-proj", refused.refusal)
    assert blocksar.plan(dataset, **settings).refusal is None


def test_ranges_below_a_kilometre_are_told_in_metres(close: Any) -> None:
    small = blocksar.plan(close, grid="-0.1:0.1:0.02,-0.1:0.1:0.02", workers=0)
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
