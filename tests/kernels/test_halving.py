"""Mean powers of 2 x 2 pixels, against the obvious loop."""

from __future__ import annotations

import numpy as np
import pytest

from blocksar.kernels.halving import halve


@pytest.mark.parametrize("shape", [(6, 8), (5, 7), (1, 3), (2, 1)])
@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_means_are_those_of_the_covered(shape: tuple[int, int], share: float) -> None:
    random = np.random.default_rng(3)
    pixels = (random.normal(size=(*shape, 2)) @ [1, 1j]).astype(np.complex64)
    pixels[random.random(shape) < share] = np.nan
    power = np.abs(pixels.astype(np.complex128)) ** 2
    expected = np.full([-(-n // 2) for n in shape], np.nan)
    for y, x in np.ndindex(expected.shape):
        cells = power[2 * y : 2 * y + 2, 2 * x : 2 * x + 2]
        if np.isfinite(cells).any():
            expected[y, x] = cells[np.isfinite(cells)].mean()
    np.testing.assert_allclose(halve(pixels), expected, rtol=1e-6)
    np.testing.assert_allclose(halve(power.astype(np.float32)), expected, rtol=1e-6)


def test_inputs_are_read_only() -> None:
    pixels = np.ones((4, 4), np.complex64)
    pixels.flags.writeable = False
    assert (halve(pixels[:, ::2]) == 1).all()
