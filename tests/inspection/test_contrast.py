"""The contrast of images and its variance by chance, against speckle that is drawn many times."""

from __future__ import annotations

import numpy as np
import pytest

from blocksar.inspection.prominent import SIGNIFICANT, SPECKLE, UNLIT, contrast, deviations

SHAPE = 40, 40


def speckle(rng: np.random.Generator, *, texture: float = 0.0, oversampling: int = 1) -> np.ndarray:
    """Power of speckle, (40, 40) independent cells; a texture of this relative variance is the same in each draw."""
    field = rng.standard_normal((2, *SHAPE))
    image = field[0] + 1j * field[1]
    if texture:
        image *= np.sqrt(np.random.default_rng(7).gamma(1 / texture, texture, SHAPE))
    if oversampling > 1:
        image = np.fft.ifft(np.fft.fft(image, axis=0), n=oversampling * SHAPE[0], axis=0) * oversampling
    return np.asarray(np.abs(image) ** 2)


@pytest.mark.parametrize(("texture", "oversampling"), [(0.0, 1), (0.5, 1), (2.0, 1), (0.0, 3)])
def test_the_variance_is_that_of_draws(texture: float, oversampling: int) -> None:
    rng = np.random.default_rng(1)
    drawn = [contrast(speckle(rng, texture=texture, oversampling=oversampling), oversampling=oversampling)
             for _ in range(300)]  # fmt: skip
    spread = np.std([each.decibels for each in drawn])
    said = np.sqrt(np.mean([each.variance for each in drawn]))
    # Side lobes are counted beside speckle, by 25 % where it is homogeneous, and the power of samples between cells is
    # less alike than their number says. 300 draws know a deviation to 4 %.
    assert 0.93 * spread < said < 1.6 * spread
    if texture == 0.0:
        assert np.mean([each.decibels for each in drawn]) == pytest.approx(SPECKLE, abs=0.02)


@pytest.mark.slow
def test_chance_does_not_reach_what_is_significant() -> None:
    """Images of the same ground with speckle drawn anew: the gains of a few echoes, 3000 times."""
    rng = np.random.default_rng(2)
    drawn = [contrast(speckle(rng, texture=1.0), oversampling=1.0) for _ in range(2000)]
    for count in (1, 3, 12):
        z = [deviations([drawn[i] for i in given], [drawn[i] for i in other])
             for given, other in (rng.integers(0, 2000, (2, count)) for _ in range(1000))]  # fmt: skip
        assert 0.6 < np.std(z) < 1.1  # below 1, as side lobes are counted too
        assert np.abs(z).max() < 0.9 * SIGNIFICANT


def test_a_point_gains_much_over_what_it_is_smeared_to_and_nothing_over_itself() -> None:
    x = np.arange(-20, 20) / 1.5
    point = np.sinc(x[:, None]) ** 2 * np.sinc(x) ** 2
    sharp = contrast(point, oversampling=1.5**2)
    assert sharp.decibels > 20
    assert 1.4 < np.sqrt(sharp.variance) < 2.2  # dB: what the first side lobe of another does to it
    blurred = contrast(speckle(np.random.default_rng(3)), oversampling=1.0)
    assert deviations([blurred], [sharp]) > SIGNIFICANT
    assert deviations([sharp] * 12, [sharp] * 12) == 0.0
    wider = contrast(np.sinc(x[:, None]) ** 2 * np.sinc(x / 1.5) ** 2, oversampling=1.5**2)
    assert 0 < deviations([wider] * 4, [sharp] * 4) < SIGNIFICANT  # 1.7 dB, as side lobes do


def test_nothing_is_no_contrast() -> None:
    assert contrast(np.zeros(SHAPE), oversampling=1.0) == UNLIT
