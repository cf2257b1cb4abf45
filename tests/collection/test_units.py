"""Mistakes of unit in a collection: refused with the figure, and with the unit that would explain it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from blocksar.collection.collection import Collection
from blocksar.errors import InputError

MISTAKES: dict[str, tuple[Callable[[Collection], dict[str, Any]], str]] = {
    "absolute range frequency": (
        lambda c: {"range_frequency": c.carrier + c.range_frequency},
        r"range_frequency is 9\.57.*e\+09 \.\. .* looks absolute; subtract the carrier",
    ),
    "yaw in degrees": (
        lambda c: {"beam_azimuth": np.degrees(c.beam_azimuth)},
        r"beam_azimuth is 48\..* \.\. 51\..* rad, more than two turns throughout; it looks like degrees",
    ),
    "yaw in degrees, through zero": (
        lambda c: {"beam_azimuth": np.linspace(0.0, 150.0, c.n_pulse)},
        r"beam_azimuth reaches 150 rad, beyond the 100 rad that can be meant",
    ),
    "width in degrees": (lambda c: {"beam_width": 4.25}, r"beam_width .* got 4\.25; it looks like degrees"),
    "time in us": (
        lambda c: {"time": c.time / 1e3},
        r"moves at 200272 m/s, but platforms move at up to 20000 m/s: .* or of time",
    ),
    "track in mm": (lambda c: {"antenna_position": c.antenna_position * 1e3}, r"moves at 200272 m/s"),
    "time in us instead of s": (lambda c: {"time": c.time * 1e6}, r"moves at 0\.000.* m/s, .* or of time"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_of_unit_is_refused_with_its_figure(mistake: str, small_collection: Collection) -> None:
    change, sentence = MISTAKES[mistake]
    with pytest.raises(InputError, match=sentence):
        replace(small_collection, **change(small_collection))


def test_a_scan_through_a_full_turn_is_accepted(small_collection: Collection) -> None:
    scan = np.linspace(6.2, 6.4, small_collection.n_pulse)
    assert replace(small_collection, beam_azimuth=scan).beam_azimuth[-1] == pytest.approx(6.4)
