"""Two images aligned by a shift and a ramp of the phase."""

from __future__ import annotations

import numpy as np
import pytest

from blocksar.arrays import ComplexArray
from blocksar.measurement.coherence import align

SIZE = (48, 64)


def scene(shift: tuple[float, float], ramp: tuple[float, float], carrier: float = 2.9, seed: int = 2) -> ComplexArray:
    """Points on a carrier near the end of the band, all moved, with a ramp of the phase."""
    random = np.random.default_rng(seed)
    row, column = np.arange(SIZE[0])[:, None], np.arange(SIZE[1])
    out = np.zeros(SIZE, complex)
    for _ in range(12):
        y, x = random.uniform(8, SIZE[0] - 8) + shift[0], random.uniform(8, SIZE[1] - 8) + shift[1]
        phase = np.exp(1j * (random.uniform(0, 6) + carrier * (column - x)))
        out += np.sinc((row - y) / 1.5) * np.sinc((column - x) / 2) * phase
    return (out * np.exp(1j * (ramp[0] * row + ramp[1] * column))).astype(np.complex64)


@pytest.mark.parametrize(
    ("shift", "ramp"), [((0.37, -2.6), (0.0, 0.0)), ((-1.2, 0.3), (0.03, -0.11)), ((0, 0), (0, 0))]
)
def test_shift_and_ramp_are_found(shift: tuple[float, float], ramp: tuple[float, float]) -> None:
    found = align(scene(shift, ramp), scene((0, 0), (0, 0)))
    assert found.ramped > 0.995 and found.as_is <= found.shifted + 1e-9 <= found.ramped + 2e-9
    assert found.shift == pytest.approx(shift, abs=0.02)
    assert found.ramp == pytest.approx(ramp, abs=2e-3)
    if any(ramp):
        assert found.shifted < 0.9
    else:
        assert found.shifted == pytest.approx(found.ramped, abs=1e-3)
    if any(shift):
        assert found.as_is < 0.9


def test_images_of_other_scenes_stay_unlike() -> None:
    assert align(scene((0, 0), (0, 0)), scene((0, 0), (0, 0), seed=3)).ramped < 0.5


def test_missing_pixels_do_not_count() -> None:
    a = scene((0, 0), (0, 0))
    hole = a.copy()
    hole[:5, :7] = np.nan
    assert align(hole, a).as_is == pytest.approx(1.0, abs=1e-9)
    assert np.isnan(align(hole, np.zeros_like(a)).ramped)
    with pytest.raises(ValueError, match="one shape"):
        align(a, a[1:])
