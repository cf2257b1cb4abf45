"""Coherence of several chips as one."""

from __future__ import annotations

import numpy as np
import pytest
from samples import noise

from blocksar.measurement.coherence import coherence, joint_coherence


def test_chips_are_joined_as_if_they_were_one() -> None:
    reference = [noise(8, 8, seed=1), 0.1 * noise(8, 8, seed=2), noise(8, 8, seed=3) * np.nan]
    image = [0.9j * reference[0] + 0.2 * noise(8, 8, seed=4), reference[1] + 0.1 * noise(8, 8, seed=5), reference[2]]
    chips = [coherence(a, b) for a, b in zip(image, reference, strict=True)]
    both = coherence(np.concatenate(image[:2]), np.concatenate(reference[:2]))
    assert joint_coherence(chips) == pytest.approx(abs(both.coherence), rel=1e-12)
    assert abs(chips[1].coherence) < joint_coherence(chips) < abs(chips[0].coherence)
    assert np.isnan(joint_coherence(chips[2:]))
