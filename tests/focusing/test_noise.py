"""The noise of an image, against the definition summed pulse by pulse."""

from __future__ import annotations

import numpy as np
import pytest
from axis_beams import axis_collection, with_patterns

from blocksar.collection.beam import is_lit, pattern_gain, pulse_weights
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import Weighting
from blocksar.focusing.noise import SPARED_BITS, NoiseMap

POWER = 0.3


def collections(small: Collection) -> dict[str, tuple[Collection, tuple[float, float], tuple[float, float]]]:
    """Collections with noise; centre (m) and half extents (m) of the pixels."""
    still = Collection(**{**small.as_dict(), "beam_azimuth": np.full(small.n_pulse, np.nan), "beam_width": None})
    of_axis = axis_collection("tops", n_pulse=800)
    found = {
        "by yaw": (small, (7000.0, 8350.0), (500.0, 700.0)),
        "not steered": (still, (7000.0, 8350.0), (20.0, 20.0)),
        "about an axis": (of_axis, (9000.0, 0.0), (200.0, 150.0)),
        "with patterns": (with_patterns(of_axis), (9000.0, 0.0), (200.0, 150.0)),
    }
    return {
        name: (Collection(**{**collection.as_dict(), "noise_power": POWER}), *place)
        for name, (collection, *place) in found.items()
    }  # type: ignore[misc]


def definition(geometry: Geometry, weighting: Weighting, valid: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The double sum over pulses and range frequencies; and the number of lit pulses."""
    everything = slice(None)
    w = is_lit(geometry, x, y) * pulse_weights(geometry, x[:, None], y[:, None], everything, weighting.azimuth)
    g = pattern_gain(geometry, x[:, None], y[:, None], everything)
    over = weighting.range.samples(geometry.collection.n_range_frequency)
    squares = sum((valid * (w * weight) ** 2).sum(axis=1) for weight in over)
    total = sum((valid * w * weight * g).sum(axis=1) for weight in over)
    return np.array([POWER * squares / total**2, is_lit(geometry, x, y).sum(axis=1)])


@pytest.mark.parametrize("text", ["uniform", "taylor:4:-35"])
@pytest.mark.parametrize("name", ["by yaw", "not steered", "about an axis", "with patterns"])
def test_noise_is_that_of_the_definition(name: str, text: str, small_collection: Collection) -> None:
    """But for the pulse at each end of a dwell, which ends between pulses here, and for rounding to 1.2e-4."""
    collection, centre, half = collections(small_collection)[name]
    geometry, weighting = Geometry(collection=collection), Weighting.parse(text)
    valid = np.ones(collection.n_pulse)
    valid[collection.n_pulse // 2 + np.arange(-3, 4)] = [1, 0.5, 0, 0, 0, 1, 0.25]
    x, y = (c + np.linspace(-h, h, n) for c, h, n in zip(centre, half, (1500, 2000), strict=True))
    noise = NoiseMap.of(geometry, weighting, valid)
    assert noise is not None
    found = noise.over(x, y)
    assert found.shape == (y.size, x.size) and found.dtype == np.float32
    assert not (found.view(np.int32) & ((1 << SPARED_BITS) - 1))[np.isfinite(found)].any()
    row, column = (part.ravel()[::6001] for part in np.indices(found.shape))
    with np.errstate(divide="ignore", invalid="ignore"):
        wanted, lit = definition(geometry, weighting, valid, x[column], y[row])
    some = lit >= 8
    assert some.mean() > 0.3
    error = np.abs(found[row, column] / wanted - 1)[some]
    assert (error < 2e-4 + (0 if collection.beam_width is None else 2.5 / lit[some])).all()
    assert np.isnan(found[row, column][lit == 0]).mean() > 0.8 if (lit == 0).any() else True


def test_noise_that_is_not_known_or_absent_has_no_map(small_collection: Collection) -> None:
    for power in (None, 0.0):
        collection = Collection(**{**small_collection.as_dict(), "noise_power": power})
        assert NoiseMap.of(Geometry(collection=collection), Weighting(), np.ones(collection.n_pulse)) is None
