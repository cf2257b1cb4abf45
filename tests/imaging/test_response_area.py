"""The area of the point response, against what exact back-projection makes of clutter."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from axis_beams import axis_collection, with_patterns
from summed_response import band_response

from blocksar.arrays import FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.raw_echo import RecordedRanges
from blocksar.collection.terrain import Terrain
from blocksar.collection.weighting import UNIFORM, Weighting
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.imaging.recorded_pulses import recorded_means
from blocksar.imaging.response_area import AreaMap
from blocksar.imaging.terrain_layers import Sight, slope_factors
from blocksar.measurement.axes import response_axes

CELLS = 24  # of the nominal response to either side: sin(x)^2 / x^2 has 0.5 % of its energy beyond
PER_CELL = 1.6


def clutter_power(geometry: Geometry, x: float, y: float, weighting: Weighting, valid: FloatArray) -> float:
    """Mean power that clutter of 1 / m^2 leaves in the pixel at a place, m^2: the sum over scatterers about it."""
    axes = response_axes(geometry, x, y, weighting)
    assert axes is not None
    steps = np.arange(-int(CELLS * PER_CELL), int(CELLS * PER_CELL) + 1) / PER_CELL
    dx, dy = axes.ground_offset(steps[:, None] * axes.range_width, steps * axes.azimuth_width)
    (rx, ry), (ax, ay) = axes.range_direction, axes.azimuth_direction
    cell = abs(rx * ay - ry * ax) * axes.range_width * axes.azimuth_width / PER_CELL**2
    collection, beam, at = geometry.collection, geometry.beam, (np.array([x]), np.array([y]))
    weights = valid * beam.is_lit(*at) * beam.weights(*at, slice(None), weighting.azimuth)
    weights = weights * (1.0 if collection.pulses.shares is None else collection.pulses.shares)
    gain = weights * beam.gain(*at, slice(None))
    pixel = geometry.range_history(geometry.on_ground(*at), collection.time)[0]
    total, middle = 0.0, collection.carrier + float(collection.range_frequency.mean())
    for px, py in zip(x + dx, y + dy, strict=True):
        places = geometry.on_ground(px, py)[:, None]
        delay = (pixel - geometry.range_history(places, collection.time)[0]) * 2 / SPEED_OF_LIGHT
        echo = beam.is_lit(px, py) * beam.gain(px[:, None], py[:, None], slice(None))
        comb = band_response(delay * collection.range_frequency_step, collection.n_range_frequency, weighting.range)
        value = (weights * echo * comb * np.exp(2j * np.pi * middle * delay)).sum(axis=1) / gain.sum()
        total += float((np.abs(value) ** 2).sum()) * cell
    return total


TENTH = 0.1  # dB


@pytest.mark.parametrize(
    ("mode", "changes", "place", "weighting"),
    [
        ("stripmap", {}, (9000.0, 0.0), "uniform"),
        ("stripmap", {}, (9000.0, 90.0), "hann"),  # 95 of 254 pulses
        ("squinted", {}, (9000.0, 2400.0), "taylor:4:-35"),
        ("tops", {"n_pulse": 800}, (9000.0, 0.0), "uniform"),
        ("sliding spotlight", {"missing": slice(150, 190)}, (9000.0, 5.0), "hamming"),
        ("stripmap", {"patterns": True}, (9000.0, 80.0), "taylor:4:-35"),
        ("stripmap", {"still": True}, (8500.0, 118.0), "uniform"),
        ("stripmap", {"uneven": True}, (9000.0, 0.0), "taylor:4:-35"),
    ],
)
def test_clutter_has_the_power_of_its_area(
    mode: str, changes: dict[str, Any], place: tuple[float, float], weighting: str
) -> None:
    """Sums over all scatterers, and so without speckle; no nodes between pixels."""
    collection = axis_collection(mode, n_pulse=changes.get("n_pulse", 400))
    collection = with_patterns(collection) if "patterns" in changes else collection
    collection = collection.unsteered() if "still" in changes else collection
    collection = staggered(collection) if "uneven" in changes else collection
    geometry, tapers, valid = Geometry(collection=collection), Weighting.parse(weighting), np.ones(collection.n_pulse)
    valid[changes.get("missing", slice(0, 0))] = 0
    area = AreaMap.of(geometry, tapers, valid).at(np.array(place[0]), np.array(place[1]))
    assert 10 * np.log10(area / clutter_power(geometry, *place, tapers, valid)) == pytest.approx(0, abs=TENTH)


def staggered(collection: Collection) -> Collection:
    """Every pulse but a random fifth, at random times within 15 % of a step, each with the antenna where it is then."""
    rng, fields = np.random.default_rng(2), collection.as_dict()
    kept = np.flatnonzero(rng.random(collection.n_pulse) > 0.2)
    time = collection.time[kept] + 0.15 * collection.pulse_interval * rng.uniform(-1, 1, kept.size)
    moved = {"antenna_position": Geometry(collection=collection).track.position(time), "time": time}
    own = {name: value[kept] for name, value in fields.items() if np.shape(value)[:1] == (collection.n_pulse,)}
    made = Collection(**{**fields, **own, **moved})
    assert made.pulses.shares is not None and np.std(made.pulses.shares) > 0.2
    return made


def test_frequencies_count_by_their_shares_in_the_area() -> None:
    """Twice as many frequencies in the upper half of the band add nothing to what the band resolves."""
    even = axis_collection()
    x, y, f = np.array(9000.0), np.array(0.0), even.range_frequency
    between = (f[:-1] + f[1:])[f.size // 2 :] / 2
    crowded = Collection(**{**even.as_dict(), "range_frequency": np.sort(np.append(f, between))})
    assert crowded.band.shares is not None
    areas = [AreaMap.of(Geometry(collection=each), UNIFORM).at(x, y) for each in (even, crowded)]
    assert areas[1] / areas[0] == pytest.approx(1, abs=0.01)


def test_the_area_of_a_short_broadside_dwell_is_that_of_the_textbook() -> None:
    collection = axis_collection(n_pulse=41, antenna_position=_straight(41), beam_width=0.4)
    x, y = np.array(9000.0), np.array(0.0)
    found = AreaMap.of(Geometry(collection=collection), UNIFORM).at(x, y)
    distance, dwell = np.hypot(9000, 4000), collection.n_pulse * collection.pulse_interval
    in_range = SPEED_OF_LIGHT / (2 * collection.bandwidth) / (9000 / distance)
    in_azimuth = collection.wavelength * distance / (2 * 200 * dwell)
    assert found == pytest.approx(in_range * in_azimuth, rel=2e-3)


def _straight(n: int) -> FloatArray:
    time = (np.arange(n) - n // 2) / (n / 1.25)
    return np.stack([0 * time, 200 * time, np.full(n, 4000.0)], axis=1)


def test_areas_between_nodes_are_those_at_the_places() -> None:
    collection = with_patterns(axis_collection(n_pulse=800))
    areas = AreaMap.of(Geometry(collection=collection), Weighting.parse("taylor:4:-35"))
    x, y = 9000 + 1.5 * np.arange(70.0), np.arange(-20.0, 100.0)[::-1]
    raised = np.full((y.size, x.size), 40.0)
    raised[30:50, 10:40] = np.nan
    for z in (None, np.full_like(raised, 40.0)):
        columns, rows = np.meshgrid(x, y)
        exact = areas.at(columns, rows, z)
        np.testing.assert_allclose(areas.over(x, y, z), exact, rtol=3e-3)
    assert np.isfinite(areas.over(x, y, raised)).all()
    assert np.isnan(areas.over(x, 400 + y)).all()


def test_slopes_change_the_area_by_their_factor() -> None:
    """Clutter of 1 / m^2 of a plane that climbs along range and along the track, by its own surface."""
    collection, along_x, along_y = axis_collection(), 0.2, 0.1
    x, y = np.meshgrid(np.arange(8800.0, 9201, 10), np.arange(-200.0, 201, 10))
    terrain = Terrain(x0=8800.0, dx=10.0, y0=-200.0, dy=10.0, heights=along_x * (x - 9000) + along_y * y)
    geometry, place, box = Geometry(collection=collection), (9000.0, 0.0), ((8900.0, 9100.0), (-100.0, 100.0))
    power = clutter_power(geometry.over(terrain), *place, UNIFORM, np.ones(collection.n_pulse))
    power *= np.sqrt(1 + along_x**2 + along_y**2)
    sight = Sight.of(geometry, box, terrain.limits)
    slopes = slope_factors(terrain, sight, np.array([9000.0]), np.array([0.0]))
    area = AreaMap.of(geometry, UNIFORM).at(np.array([9000.0]), np.array([0.0])) / slopes.area
    assert 10 * np.log10(float(area[0, 0]) / power) == pytest.approx(0, abs=TENTH)
    assert 10 * np.log10(float(slopes.area[0, 0])) < -0.4


def test_ground_with_half_of_its_pulses_has_twice_the_area() -> None:
    """A part of a chirp is a part of the band: responses are broader by its inverse."""
    collection = axis_collection()
    x, y = np.array([9000.0]), np.array([0.0])
    distance, pulse = float(np.hypot(9000.0, 4000.0)), 600.0
    recorded = RecordedRanges(near=distance, far=distance + 5000, pulse=pulse, partial=True)
    cut = Collection(**{**collection.as_dict(), "recorded": recorded})
    share = recorded_means(Geometry(collection=cut), x, y)
    assert share.amplitude == pytest.approx(0.5, abs=0.01)
    whole, part = (AreaMap.of(Geometry(collection=each), UNIFORM).at(x, y) for each in (collection, cut))
    assert part / whole == pytest.approx(2.0, rel=0.02)
