"""Pulses that lie elsewhere than their neighbours, and tracks that bend between far-apart pulses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from blocksar.collection.collection import Collection
from blocksar.errors import InputError


def bent(collection: Collection, step: float) -> Collection:
    """A pulse every `step` s along a bend of 40 m/s^2: 40 step^2 m from pulse to pulse, at ends and where z turns."""
    time = step * (np.arange(64) - 20)
    track = np.stack([3000 * time, 7e3 * np.ones(64), 7e5 + 20 * time**2], axis=1)
    return replace(
        collection, time=time, antenna_position=track, reference_range=7.5e5 + 15 * (time - 2) ** 2,
        beam_azimuth=np.full(64, np.nan), beam_width=None,
    )  # fmt: skip


@pytest.mark.parametrize("step", [0.01, 0.5])
def test_a_bend_is_no_spike(small_collection: Collection, step: float) -> None:
    bent(small_collection, step)


@pytest.mark.parametrize("where", [0, 1, 31, 63])
@pytest.mark.parametrize("name", ["antenna_position", "reference_range"])
@pytest.mark.parametrize(("step", "away"), [(0.01, 9.0), (0.5, 600.0)])
def test_a_pulse_elsewhere_is_a_spike(
    small_collection: Collection, step: float, away: float, name: str, where: int
) -> None:
    right = bent(small_collection, step)
    values = getattr(right, name).copy()
    values[where] += away
    with pytest.raises(InputError, match=f"{name} leaves its neighbours by .* m at pulse "):
        replace(right, **{name: values})
