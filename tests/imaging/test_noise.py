"""The noise of an image, against the definition summed pulse by pulse."""

from __future__ import annotations

import numpy as np
import pytest
from axis_beams import axis_collection, with_patterns

from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.terrain import Terrain
from blocksar.collection.weighting import Weighting
from blocksar.imaging.noise import SPARED_BITS, NoiseMap

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


def hills(x: np.ndarray, y: np.ndarray, size: float) -> Terrain:
    """Hills and hollows of a tenth of their size, m, on a plateau that is 60 m high."""
    along_x, along_y = (np.arange(axis[0] - size, axis[-1] + size, size / 40) for axis in (x, y))
    heights = 60 + size / 10 * np.sin(2 * np.pi * along_x / size) * np.cos(2 * np.pi * along_y[:, None] / size)
    return Terrain(x0=float(along_x[0]), dx=size / 40, y0=float(along_y[0]), dy=size / 40, heights=heights)


def definition(geometry: Geometry, weighting: Weighting, valid: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The double sum over pulses and range frequencies; and the number of lit pulses."""
    everything = slice(None)
    w = geometry.beam.is_lit(x, y) * geometry.beam.weights(x[:, None], y[:, None], everything, weighting.azimuth)
    g = geometry.beam.gain(x[:, None], y[:, None], everything)
    over = weighting.range.samples(geometry.collection.n_range_frequency)
    squares = sum((valid * (w * weight) ** 2).sum(axis=1) for weight in over)
    total = sum((valid * w * weight * g).sum(axis=1) for weight in over)
    return np.array([POWER * squares / total**2, geometry.beam.is_lit(x, y).sum(axis=1)])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "relief", "text"),
    [
        ("by yaw", None, "taylor:4:-35"), ("not steered", None, "uniform"), ("about an axis", None, "uniform"),
        ("with patterns", None, "uniform"), ("about an axis", 300.0, "taylor:4:-35"),
        ("with patterns", 300.0, "taylor:4:-35"),
    ],
)  # fmt: skip
def test_noise_is_that_of_the_definition(
    name: str, relief: float | None, text: str, small_collection: Collection
) -> None:
    """But for the pulse at each end of a dwell, which ends between pulses here, and for rounding to 1.2e-4."""
    collection, centre, half = collections(small_collection)[name]
    geometry, weighting = Geometry(collection=collection), Weighting.parse(text)
    valid = np.ones(collection.n_pulse)
    valid[collection.n_pulse // 2 + np.arange(-3, 4)] = [1, 0.5, 0, 0, 0, 1, 0.25]
    x, y = (c + np.linspace(-h, h, n) for c, h, n in zip(centre, half, (700, 900), strict=True))
    noise = NoiseMap.of(geometry, weighting, valid)
    assert noise is not None
    ground = None if relief is None else hills(x, y, relief)
    found = noise.over(x, y, None if ground is None else ground.on_grid(x, y))
    assert found.shape == (y.size, x.size) and found.dtype == np.float32
    assert not (found.view(np.int32) & ((1 << SPARED_BITS) - 1))[np.isfinite(found)].any()
    row, column = (part.ravel()[::1201] for part in np.indices(found.shape))
    with np.errstate(divide="ignore", invalid="ignore"):
        wanted, lit = definition(geometry.over(ground), weighting, valid, x[column], y[row])
    some = lit >= 8
    assert some.mean() > 0.3
    error = np.abs(found[row, column] / wanted - 1)[some]
    assert (error < 2e-4 + (0 if collection.beam_width is None else 2.5 / lit[some])).all()
    assert np.isnan(found[row, column][lit == 0]).mean() > 0.8 if (lit == 0).any() else True


def test_noise_on_hills_is_another_than_on_the_plane() -> None:
    """By some 2 % where the pattern falls over elevation; pixels beside unknown heights keep theirs."""
    collection = Collection(**{**with_patterns(axis_collection(n_pulse=800)).as_dict(), "noise_power": POWER})
    geometry, x, y = Geometry(collection=collection), 9000 + np.arange(64.0), np.arange(48.0)
    noise = NoiseMap.of(geometry, Weighting(), np.ones(collection.n_pulse))
    assert noise is not None
    height = np.full((y.size, x.size), 60.0)
    raised, flat = noise.over(x, y, height), noise.over(x, y)
    assert (np.abs(raised / flat - 1) > 0.01).all()
    for holes in (np.s_[:, 30:50], np.s_[20:40], np.s_[::16]):
        some = height.copy()
        some[holes] = np.nan
        np.testing.assert_array_equal(noise.over(x, y, some), raised)
    np.testing.assert_array_equal(noise.over(x, y, np.full_like(height, np.nan)), flat)


def test_noise_that_is_not_known_or_absent_has_no_map(small_collection: Collection) -> None:
    for power in (None, 0.0):
        collection = Collection(**{**small_collection.as_dict(), "noise_power": power})
        assert NoiseMap.of(Geometry(collection=collection), Weighting(), np.ones(collection.n_pulse)) is None


def test_noise_across_a_zero_of_a_pattern_in_elevation_is_that_of_the_definition() -> None:
    """Over a few pixels it rises by 40 dB, which no values at every sixteenth pixel follow."""
    x, y = 8990 + np.arange(40.0), np.arange(20.0)
    middle = np.arctan2(4000.0, 9010.0)
    pattern = {
        "elevation": middle + np.array([-0.1, -0.004, 0.0, 0.004, 0.1]),
        "elevation_pattern": np.array([1, 1, 0.0, 1, 1]),
    }
    collection = Collection(**{**axis_collection(n_pulse=800).as_dict(), **pattern, "noise_power": POWER})
    geometry, weighting, valid = Geometry(collection=collection), Weighting(), np.ones(collection.n_pulse)
    noise = NoiseMap.of(geometry, weighting, valid)
    assert noise is not None
    found = noise.over(x, y)
    wanted, _ = definition(geometry, weighting, valid, *(axis.ravel() for axis in np.meshgrid(x, y)))
    dark = np.isnan(found)
    assert 0.01 < dark.mean() < 0.3 and np.ptp(np.log10(found[~dark])) > 2
    np.testing.assert_allclose(found[~dark], wanted.reshape(found.shape)[~dark], rtol=0.03)
