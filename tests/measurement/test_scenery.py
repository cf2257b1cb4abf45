"""What an image shows that nobody named, on images that are known."""

from __future__ import annotations

import numpy as np
import pytest
from axis_beams import axis_collection

from blocksar.arrays import ComplexArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.measurement.axes import response_axes
from blocksar.measurement.multilooking import multilook, power_of
from blocksar.measurement.response import ReadChip
from blocksar.measurement.scenery import ambiguity_place, measure_area, noise_floor, strongest_about

STRIPS = [slice(0, 100), slice(100, 256)]


def speckle(power: float = 1.0) -> ComplexArray:
    rng = np.random.default_rng(3)
    parts = rng.standard_normal((256, 256, 2)) * np.sqrt(power / 2)
    return (parts[..., 0] + 1j * parts[..., 1]).astype(np.complex64)


def reader(image: ComplexArray) -> ReadChip:
    return lambda rows, columns: image[rows, columns]


@pytest.mark.parametrize("looks", [1, 4])
def test_equivalent_looks_are_those_of_the_average(looks: int) -> None:
    """The power of speckle has the variance mean^2 / looks; 65536 / looks samples tell it to about a hundredth."""
    image = speckle(0.3)
    cells = np.sqrt(multilook(power_of(image), (looks, 1))).astype(np.complex64)
    cells[:5, :7] = np.nan
    half = cells.shape[0] // 2
    found = measure_area(reader(cells), [slice(0, half), slice(half, cells.shape[0])])
    assert found.pixels == cells.size - 35
    assert found.mean == pytest.approx(0.3, rel=0.02) and found.looks == pytest.approx(looks, rel=0.05)


def test_an_area_that_is_not_covered_has_no_looks() -> None:
    found = measure_area(reader(np.full((256, 256), np.nan + 0j, np.complex64)), STRIPS)
    assert found.pixels == 0 and np.isnan(found.looks)


def test_the_floor_is_that_of_the_darkest_part() -> None:
    image = speckle()
    image[:64] *= 0.1
    image[:8, :8] = np.nan  # a cell that is not covered as a whole counts not at all
    assert noise_floor(reader(image), STRIPS[:1]) == pytest.approx(0.01, rel=0.2)
    assert noise_floor(reader(speckle()), STRIPS) == pytest.approx(0.85, abs=0.1)


@pytest.mark.parametrize("order", [-1, 1])
@pytest.mark.parametrize("beam", ["by yaw", "stripmap"])
def test_an_ambiguity_turns_by_whole_cycles_from_pulse_to_pulse(
    beam: str, order: int, small_collection: Collection
) -> None:
    """So its samples are those of the target itself: at the same range, amid the dwell."""
    collection, place = (small_collection, (7000.0, 8350.0)) if beam == "by yaw" else (axis_collection(), (9000.0, 3.0))
    geometry = Geometry(collection=collection)
    ghost = ambiguity_place(geometry, *place, order)
    assert ghost is not None
    middle = float(sum(geometry.beam.dwell(*map(np.array, place)))) / 2
    times = middle + np.array([-0.5, 0.5]) * collection.pulse_interval
    track = geometry.track.position(times)
    target, other = (np.linalg.norm([*at, collection.ground_height] - track, axis=1) for at in (place, ghost))
    cycles = 2 * collection.carrier / SPEED_OF_LIGHT * (other - target)
    assert abs(np.diff(cycles)[0]) == pytest.approx(abs(order), abs=1e-3)
    assert other.mean() == pytest.approx(target.mean(), abs=2e-3)
    assert np.hypot(ghost[0] - place[0], ghost[1] - place[1]) > 10 * abs(order)


def test_the_strongest_power_is_that_about_a_place() -> None:
    geometry = Geometry(collection=axis_collection())
    axes = response_axes(geometry, 9000.0, 0.0)
    assert axes is not None
    image = np.full((256, 256), 0.1 + 0j, np.complex64)
    image[130, 120] = 2.0
    x, y = 9000.0 + np.arange(256) - 120.0, np.arange(256) - 130.0
    assert strongest_about(reader(image), x, y, (9001.0, -1.0), axes) == 4.0
    assert strongest_about(reader(image), x, y, (9060.0, 60.0), axes) == pytest.approx(0.01)
    assert strongest_about(reader(image), x, y, (9600.0, 0.0), axes) is None
