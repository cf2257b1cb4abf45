"""Sums of the antenna's pattern over lit pulses, against the pattern and the taper by their definitions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from axis_beams import axis_collection, with_patterns

from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import Taper
from blocksar.imaging.pattern_sums import LEAST_ELEVATION, add_gains, mean_elevations
from blocksar.kernels.projection import LitPixels


@pytest.mark.slow
@pytest.mark.parametrize("text", ["uniform", "taylor:4:-35", "kaiser:4"])
@pytest.mark.parametrize("angles", ["even", "uneven"])
@pytest.mark.parametrize("width", [0.01, 0.3, 1.8])  # rad
def test_sums_are_those_of_the_definitions(width: float, angles: str, text: str) -> None:
    collection = with_patterns(axis_collection("tops", n_pulse=60, beam_width=width))
    assert collection.beam_offset is not None and collection.elevation is not None
    if angles == "uneven":
        bent = np.linspace(-1, 1, 65) ** 3
        collection = replace(collection, beam_offset=0.52 * width * bent, elevation=0.45 + 0.1 * bent[::4])
    geometry, taper = Geometry(collection=collection), Taper.parse(text)
    rng = np.random.default_rng(2)
    x, y = np.meshgrid(9000 + 30.0 * np.arange(40), np.linspace(-120, 120, 5))
    over = rng.uniform(0, 300, x.shape)
    z = collection.ground_height + over
    valid = rng.uniform(0.5, 1.0, collection.n_pulse)
    pulses, expected, lit = slice(7, 55), np.zeros(x.shape), geometry.beam.is_lit(x, y, z=z)
    for p in range(pulses.start, pulses.stop):
        weight = geometry.beam.weights(x, y, p, taper, z) * geometry.beam.gain(x, y, p, z)
        expected += lit[..., p] * weight * valid[p]
    assert (expected > 0).any()
    total = np.ones(x.shape)
    for first, last in zip(*geometry.beam.passes(x, y, z), strict=True):
        add_gains(total, geometry, LitPixels(x, y, z, first, last), pulses=pulses, valid=valid[pulses], taper=taper)
    np.testing.assert_allclose(total - 1, expected, rtol=0, atol=1e-8 * expected.max())


@pytest.mark.parametrize("text", ["uniform", "taylor:4:-35"])
@pytest.mark.parametrize("kind", ["tops", "turning back", "by yaw", "not steered"])
def test_means_of_a_pattern_in_elevation_are_those_of_the_definition(kind: str, text: str) -> None:
    """Of a pattern with a zero, at heights of up to 300 m, with pulses that are missing in part."""
    changes = {"beam_steering": 0.012 * np.cos(np.linspace(0, 5 * np.pi, 400))} if kind == "turning back" else {}
    bent, middle = np.array([-0.15, -0.02, 0.0, 0.01, 0.15]), np.arctan2(3850.0, 9000.0)
    changes |= {"elevation": middle + bent, "elevation_pattern": np.array([0.4, 1.0, 0.0, 2.0, 1.5])}
    collection = with_patterns(axis_collection("tops" if kind == "tops" else "stripmap"))
    if kind in ("by yaw", "not steered"):
        none = dict.fromkeys(("beam_axis", "beam_steering", "beam_offset", "beam_pattern", "beam_width"))
        scan = {"beam_azimuth": 0.02 * collection.time, "beam_width": 0.012} if kind == "by yaw" else {}
        changes |= none | scan
    collection = replace(collection, **changes)
    geometry, taper, rng = Geometry(collection=collection), Taper.parse(text), np.random.default_rng(2)
    x, y = np.meshgrid(9000 + 20.0 * np.arange(40), np.linspace(-60, 60, 5))
    over, valid = rng.uniform(0, 300, x.shape), np.linspace(0.7, 1.0, collection.n_pulse)
    z, everything = collection.ground_height + over, slice(None)
    lit = geometry.beam.is_lit(x, y, z=z)
    weight = valid * lit * geometry.beam.weights(x[..., None], y[..., None], everything, taper, z[..., None])
    both = weight * geometry.beam.gain(x[..., None], y[..., None], everything, z[..., None])
    alone = geometry.lit_by(collection.without_elevation)
    weight = weight * alone.beam.gain(x[..., None], y[..., None], everything, z[..., None])
    place = (2 * np.cumsum(lit, axis=-1) - 1) / np.maximum(lit.sum(axis=-1), 1)[..., None] - 1
    seen = lit.sum(axis=-1) > 60

    means = mean_elevations(geometry, x, y, z, passes=geometry.beam.passes(x, y, z), valid=valid, taper=taper)
    assert seen.mean() > 0.2
    total, level = both.sum(axis=-1)[seen], weight.sum(axis=-1)[seen]
    np.testing.assert_allclose(means.weighed[seen], total / level, atol=0.004)
    bright = means.weighed[seen] > 0.05
    tilt = (both * place).sum(axis=-1)[seen] / total - (weight * place).sum(axis=-1)[seen] / level
    np.testing.assert_allclose(means.tilt[seen][bright], tilt[bright], atol=0.02)
    bare = replace(collection, beam_offset=None, beam_pattern=None)
    gain = geometry.lit_by(bare).beam.gain(x[..., None], y[..., None], everything, z[..., None])
    plain = (lit * gain).sum(axis=-1) / np.maximum(lit.sum(axis=-1), 1)
    np.testing.assert_allclose(means.plain[seen], plain[seen], atol=0.004)
    assert (means.plain[~lit.any(axis=-1)] == 0).all()
    np.testing.assert_array_equal(means.dark(geometry), means.plain < 2.0 * LEAST_ELEVATION)


def test_a_mean_over_a_few_pulses_and_over_all_pulses() -> None:
    pattern = {"elevation": np.array([0.2, 0.6]), "elevation_pattern": np.array([1.0, 1.0])}
    collection = axis_collection(n_pulse=60, **pattern)
    geometry, none = Geometry(collection=collection), np.zeros((1, 1, 3), np.int64)
    x, y, few = np.full((1, 3), 9000.0), np.zeros((1, 3)), none + np.array([0, 1, 5])
    means = mean_elevations(geometry, x, y, 0 * y, passes=(none, few))
    np.testing.assert_allclose(means.plain, [[0.0, 1.0, 1.0]])
    assert means.dark(geometry).tolist() == [[True, False, False]]
    every = mean_elevations(geometry, x, y, 0 * y)
    np.testing.assert_allclose([every.plain, every.weighed], 1.0)
