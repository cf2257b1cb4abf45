"""Which pulses light a point, against an explicit double loop."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numba import njit

from blocksar.arrays import FloatArray
from blocksar.collection.beam import (
    aperture,
    beam_at,
    full_dwell_yaw,
    in_beam,
    lit_pulses,
    lit_yaw,
    turned_near,
    wrapped,
)
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.errors import InputError

TURN = 2 * math.pi
WIDTH = 0.02  # rad, of the beam of `small_collection`, which turns by 0.064 rad

# Beam azimuth at the middle pulse, rad: ahead, near +-pi on either side, and one turn further.
CENTRES = pytest.mark.parametrize("centre", [0.87, math.pi, -math.pi + 0.01, 3 * math.pi - 0.01])
SWEEPS = pytest.mark.parametrize("sweep", [1.0, -1.0, 0.0])  # rad/s


def steered(collection: Collection, centre: float, sweep: float, **changes: Any) -> Geometry:
    beam = centre + sweep * collection.time
    return Geometry(collection=Collection(**{**collection.as_dict(), "beam_azimuth": beam, **changes}))


def unsteered(collection: Collection) -> Geometry:
    nothing = {"beam_azimuth": np.full(collection.n_pulse, np.nan), "beam_width": None}
    return Geometry(collection=Collection(**{**collection.as_dict(), **nothing}))


def points_about(geometry: Geometry, centre: float) -> tuple[FloatArray, FloatArray]:
    """Coordinates x, y (m) of points within and near the lit sector, and in all directions."""
    rng = np.random.default_rng(7)
    yaw = np.concatenate([centre + rng.uniform(-0.06, 0.06, 60), rng.uniform(-math.pi, math.pi, 20)])
    return geometry.nadir[0] + 9e3 * np.cos(yaw), geometry.nadir[1] + 9e3 * np.sin(yaw)


def slow_mask(geometry: Geometry, yaw: FloatArray) -> Any:
    """Evaluate the definition point by point and pulse by pulse."""
    collection = geometry.collection
    mask = np.zeros((yaw.size, collection.n_pulse), bool)
    for i in range(yaw.size):
        for p in range(collection.n_pulse):
            if collection.beam_width is None:
                mask[i, p] = True
            else:
                away = math.remainder(float(yaw[i]) - float(collection.beam_azimuth[p]), TURN)
                mask[i, p] = abs(away) <= collection.beam_width / 2
    return mask


def test_wrapped_is_the_same_angle_within_half_a_turn() -> None:
    angle = np.linspace(-40, 40, 1001)
    assert np.abs(wrapped(angle)).max() <= math.pi
    np.testing.assert_allclose(wrapped(angle), [math.remainder(a, TURN) for a in angle], atol=1e-14)
    inside = np.linspace(-math.pi, math.pi, 1001)
    np.testing.assert_array_equal(wrapped(inside), inside)  # exactly equal


def test_turned_near_is_the_same_angle_near_the_centre() -> None:
    angle = np.linspace(-40, 40, 1001)
    for centre in (0.0, math.pi, -7.0):
        near = turned_near(angle, centre)
        assert np.abs(near - centre).max() <= math.pi + 1e-14
        np.testing.assert_allclose(np.exp(1j * near), np.exp(1j * angle), atol=1e-13)


def test_the_edge_is_in_the_beam_and_the_next_float_is_not() -> None:
    azimuth, half = 0.875, 2.0**-7  # binary fractions: their sum is exact
    assert in_beam(azimuth + half, azimuth, half)
    assert in_beam(azimuth - half, azimuth, half)
    assert not in_beam(np.nextafter(azimuth + half, 2.0), azimuth, half)
    assert not in_beam(np.nextafter(azimuth - half, 0.0), azimuth, half)


def test_the_beam_rule_wraps_as_wrapped_does_and_gives_the_same_compiled() -> None:
    compiled = njit(in_beam)
    rng = np.random.default_rng(1)
    yaw, azimuth = rng.uniform(-10, 10, 2000), rng.uniform(-10, 10, 2000)
    lit = in_beam(yaw, azimuth, 1.0)
    np.testing.assert_array_equal(lit, np.abs(wrapped(yaw - azimuth)) <= 1.0)
    assert [bool(compiled(a, b, 1.0)) for a, b in zip(yaw, azimuth, strict=True)] == lit.tolist()
    assert 0.1 < lit.mean() < 0.9


@CENTRES
@SWEEPS
def test_lit_pulses_are_those_of_the_double_loop(small_collection: Collection, centre: float, sweep: float) -> None:
    geometry = steered(small_collection, centre, sweep)
    collection = geometry.collection
    x, y = points_about(geometry, centre)
    yaw = np.asarray(geometry.yaw(x, y))
    expected = slow_mask(geometry, yaw)
    assert expected.any() and not expected.any(axis=1).all()
    np.testing.assert_array_equal(geometry.beam.is_lit(x, y), expected)
    np.testing.assert_array_equal(geometry.beam.is_lit(x, y, slice(50, 70)), expected[:, 50:70])

    first, last = geometry.beam.longest_pass(x, y)
    pulse = np.arange(collection.n_pulse)
    np.testing.assert_array_equal((pulse >= first[:, None]) & (pulse < last[:, None]), expected)
    assert (last[~expected.any(axis=1)] == 0).all()

    valid = np.random.default_rng(3).choice([0.0, 0.5, 1.0], collection.n_pulse)  # missing, partial and complete pulses
    for turns in (0.0, -TURN, TURN):
        np.testing.assert_array_equal(lit_pulses(collection, yaw + turns, valid), (expected * valid).sum(axis=1))


@CENTRES
@SWEEPS
def test_a_dwell_covers_its_lit_pulses(small_collection: Collection, centre: float, sweep: float) -> None:
    geometry = steered(small_collection, centre, sweep)
    x, y = points_about(geometry, centre)
    count = slow_mask(geometry, np.asarray(geometry.yaw(x, y))).sum(axis=1)
    start, end = geometry.beam.dwell(x, y)
    begin, stop = aperture(geometry.collection)
    lit = count > 0
    assert (start[lit] >= begin).all() and (end[lit] <= stop).all()
    assert np.abs((end - start) * geometry.collection.prf - count)[lit].max() <= 1
    assert ((end - start)[~lit] * geometry.collection.prf < 1).all()
    np.testing.assert_array_equal(geometry.beam.dwell_at(geometry.yaw(x, y), np.zeros(1)), (start, end))


@CENTRES
@SWEEPS
def test_a_full_dwell_has_the_most_pulses(small_collection: Collection, centre: float, sweep: float) -> None:
    geometry = steered(small_collection, centre, sweep)
    x, y = points_about(geometry, centre)
    count = slow_mask(geometry, np.asarray(geometry.yaw(x, y))).sum(axis=1)
    full = np.array([geometry.beam.has_full_dwell(*point) for point in zip(x, y, strict=True)])
    most = geometry.beam.most_lit_pulses(x, y)
    assert full.any() and not full.all()
    assert (count[full] >= most - 2).all()  # one pulse by definition, one because of where pulses fall in the beam
    assert count.max() in (most - 1, most)
    low, high = full_dwell_yaw(geometry.collection)
    assert (high - low) == pytest.approx(abs(sweep) * np.ptp(geometry.collection.time) - WIDTH)


@CENTRES
def test_the_edges_of_a_beam_at_rest_are_lit(small_collection: Collection, centre: float) -> None:
    geometry = steered(small_collection, centre, 0.0)
    low, high = lit_yaw(geometry.collection)
    inside = np.linspace(low, high, 65)
    start, end = geometry.beam.dwell_at(np.concatenate([inside, inside + TURN, inside - TURN]), np.zeros(1))
    assert (start == aperture(geometry.collection)[0]).all() and (end == aperture(geometry.collection)[1]).all()
    start, end = geometry.beam.dwell_at(np.array([low - 1e-9, high + 1e-9]), np.zeros(1))
    assert (start > end).all()


@CENTRES
@SWEEPS
def test_the_ends_of_the_lit_sector_have_a_pulse(small_collection: Collection, centre: float, sweep: float) -> None:
    collection = steered(small_collection, centre, sweep).collection
    least = 1 if sweep else collection.n_pulse
    ends = np.array(lit_yaw(collection))  # rounded: the exact comparison may miss them
    assert (lit_pulses(collection, ends, np.ones(collection.n_pulse)) == least).all()
    assert not lit_pulses(collection, ends + np.array([-1e-9, 1e-9]), np.ones(collection.n_pulse)).any()


def test_pulses_at_the_same_azimuth_are_lit_together(small_collection: Collection) -> None:
    azimuth = np.repeat(np.linspace(0.75, 1.0, 9), 29)[: small_collection.n_pulse]
    geometry = steered(small_collection, 0.0, 0.0, beam_azimuth=azimuth, beam_width=2.0**-4)
    yaw = np.concatenate([np.linspace(0.7, 1.05, 57), azimuth[::29] + 2.0**-5, azimuth[::29] - 2.0**-5])
    expected = slow_mask(geometry, yaw).sum(axis=1)
    np.testing.assert_array_equal(lit_pulses(geometry.collection, yaw, np.ones(azimuth.size)), expected)


def test_without_steering_everything_is_lit(small_collection: Collection) -> None:
    geometry = unsteered(small_collection)
    collection = geometry.collection
    n = collection.n_pulse
    x, y = points_about(geometry, 0.87)
    yaw = np.asarray(geometry.yaw(x, y))
    assert geometry.beam.is_lit(x, y).shape == (x.size, n)
    assert geometry.beam.is_lit(x, y).all()
    assert in_beam(3.0, *(np.max(value) for value in beam_at(collection, slice(0, 1))))
    first, last = geometry.beam.longest_pass(x.reshape(8, 10), y.reshape(8, 10))
    assert (first == 0).all() and (last == n).all() and first.shape == (8, 10)
    valid = np.ones(n)
    valid[::7] = 0
    assert (lit_pulses(collection, yaw, valid) == valid.sum()).all()
    assert geometry.beam.most_lit_pulses(x, y) == n
    start, end = geometry.beam.dwell(x, y)
    assert (start == aperture(collection)[0]).all() and (end == aperture(collection)[1]).all()
    assert geometry.beam.has_full_dwell(float(x[0]), float(y[0]))


def test_a_beam_wider_than_a_full_turn_is_refused(small_collection: Collection) -> None:
    n = small_collection.n_pulse
    geometry = steered(small_collection, 0.0, 0.0, beam_azimuth=np.linspace(0, 6.28, n), beam_width=0.05)
    with pytest.raises(InputError, match=r"beam_azimuth scans 6\.28 rad .* cut the collection"):
        geometry.beam.longest_pass(np.zeros(1), np.ones(1))


def test_a_scan_through_a_full_turn_is_accepted(small_collection: Collection) -> None:
    scan = np.linspace(6.2, 6.4, small_collection.n_pulse)
    assert replace(small_collection, beam_azimuth=scan).beam_azimuth[-1] == pytest.approx(6.4)
