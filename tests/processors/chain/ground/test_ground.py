"""Geometric correction: against signals known between samples, and seams that leave no pixel out."""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from steps import Planned, collection, line_of, planned, signal_of, slab_of, target_at

import blocksar
from blocksar import solvers
from blocksar.arrays import ComplexArray, FloatArray
from blocksar.budget import IMAGE_TAP_ERROR
from blocksar.collection.beam import lit_pulses
from blocksar.kernels import interpolation
from blocksar.processors.chain.ground.correction import N_CARRIER, N_PHASE, correct, touched
from blocksar.processors.chain.ground.ground_map import GroundMap
from blocksar.processors.chain.ground.surfaces import GroundRange, Surface, fit_surface
from blocksar.processors.chain.steps.lines import focus

LEVEL = 1300.0  # about as many pulses light a target: images are scaled to about 1 before they are compared


@lru_cache(maxsize=4)
def case_of(
    *, blocks: int = 3, yaw_deg: float = 50.0, steering_deg: float | None = 26.23, swath: str = "narrow"
) -> Planned:
    """A swath 200 m wide, or 2.5 km at a tenth of the bandwidth: only the geometry matters here."""
    options = {} if swath == "narrow" else {"bandwidth": 5e6, "n_frequency": 100}
    prf = 8e3 if steering_deg else 12e3
    beam_deg = 2.5 if yaw_deg == 180.0 else 4.25  # at broadside, a beam as wide as Table 1's would need a higher PRF
    scene = collection(yaw_deg=yaw_deg, steering_deg=steering_deg, beam_deg=beam_deg, prf=prf, **options)
    return planned(scene, blocks=blocks)


def around(
    case: Planned, epoch_range: float, yaw: float, *, step: float, shape: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """A pixel grid (x, y) about a point."""
    middle = target_at(case.geometry, epoch_range, yaw)
    columns, rows = (np.arange(n) - n // 2 for n in (shape[1], shape[0]))
    return middle[0] + step * columns, middle[1] + step * rows


# -- A block whose values are known everywhere ---------------------------------------------------------------


def known_block(ground: GroundMap, x: float, y: float, seed: int = 0) -> tuple[ComplexArray, Callable[..., np.ndarray]]:
    """Tones in (row, Doppler) that fill the band of a focused block about a place: samples, and values anywhere.

    Along Doppler the band is centred on the dwell's carrier, exp(-2j pi t f).
    """
    rng = np.random.default_rng(seed)
    n = 40
    cycles = ground.locate(np.array(x), np.array(y))[5]
    strength = (rng.standard_normal(n) + 1j * rng.standard_normal(n)) / np.sqrt(2 * n)
    row_tone = rng.uniform(-0.48, 0.48, n) * ground.range_taps[1]
    doppler_tone = -cycles + rng.uniform(-0.35, 0.35, n) * ground.doppler_taps[1]

    def value(row: FloatArray, doppler: FloatArray) -> np.ndarray:
        turns = np.multiply.outer(row, row_tone) + np.multiply.outer(doppler, doppler_tone)
        return np.exp(2j * np.pi * turns) @ strength

    rows = np.exp(2j * np.pi * np.multiply.outer(np.arange(ground.rows.size), row_tone)) * strength
    columns = np.exp(2j * np.pi * np.multiply.outer(doppler_tone, np.arange(ground.doppler.size)))
    block = (rows @ columns).astype(np.complex64)
    block.flags.writeable = False
    return block, value


def slowly(ground: GroundMap, value: Callable[..., np.ndarray], x: FloatArray, y: FloatArray) -> np.ndarray:
    """Compute each pixel by itself: the value where it focuses, less its phase, over its gain and its pulses."""
    row, doppler, cycles, loss, turn, _ = ground.locate(*np.meshgrid(x, y))
    place = np.rint((ground.middle_yaw + turn - ground.yaw_axis[0]) / (ground.yaw_axis[1] - ground.yaw_axis[0]))
    lit = ground.lit[np.clip(place, 0, ground.lit.size - 1).astype(int)]
    return value(row, doppler) * np.exp(-2j * np.pi * (cycles - np.rint(cycles))) * loss / (lit * ground.scale)


@pytest.mark.parametrize(("options", "step", "shape"), [
    *(({"yaw_deg": yaw, "swath": "wide"}, step, (131, 137) if step < 3 else (11, 17))
      for yaw in (50.0, 180.0) for step in (0.4, 1.0, 2.3, 11.0, 60.0)),
    # As the last chunk of an image of 513 pixels has one: a pixel has no neighbour that tells its extent.
    *(({}, 0.2, shape) for shape in ((1, 1), (1, 40), (40, 1))),
    # Blocks of 180 and 90 m of ground, narrower than a tile: values beyond must not affect those inside.
    ({"blocks": 30}, 2.3, (80, 80)), ({"blocks": 60}, 2.3, (80, 80)),
])  # fmt: skip
def test_every_pixel_is_the_value_of_the_block_where_it_focuses(
    options: dict[str, Any], step: float, shape: tuple[int, int]
) -> None:
    case = case_of(**options)
    ground = case.plan.ground
    narrow = "blocks" in options
    x, y = around(case, 30e3, ground.high if narrow else ground.middle_yaw, step=step, shape=shape)
    block, value = known_block(ground, x[x.size // 2], y[y.size // 2])
    image = correct(block, ground, x=x, y=y)
    assert image.shape == shape and image.dtype == np.complex64
    held = np.isfinite(image)
    assert held.sum() > 500 if narrow else held.mean() > 0.9 or step == 60.0
    error = (image - slowly(ground, value, x, y))[held] * LEVEL
    # Taps are planned for this error in each of two directions, root mean square over the band.
    assert np.sqrt(np.mean(np.abs(error) ** 2)) < np.sqrt(2) * IMAGE_TAP_ERROR
    assert np.abs(error).max() < 4 * np.sqrt(2) * IMAGE_TAP_ERROR


def weigh(positions: FloatArray, taps: tuple[int, float], n: int) -> tuple[FloatArray, FloatArray]:
    """First sample and weights (n_position, n_tap) of each window; first is -1 where it leaves the n samples."""
    table = interpolation.interpolation_taps(taps[0], occupancy=taps[1], n_phase=N_PHASE).astype(np.float64)
    whole = np.floor(positions)
    fine = (positions - whole) * (table.shape[0] - 1)
    row = np.minimum(fine.astype(int), table.shape[0] - 2)
    first = whole.astype(int) - (taps[0] // 2 - 1)
    weights = table[row] + (fine - row)[:, None] * (table[row + 1] - table[row])
    return np.where((first >= 0) & (first + taps[0] <= n), first, -1), weights


def tap_by_tap(block: ComplexArray, ground: GroundMap, x: FloatArray, y: FloatArray) -> np.ndarray:
    """Compute what `correct` computes, pixel by pixel in float64: NaN only where the window leaves the block."""
    place = [v.ravel() for v in ground.locate(*np.meshgrid(x, y))]
    row, doppler, cycles, loss, turn, middle = place
    first_row, range_weights = weigh(row, ground.range_taps, block.shape[0])
    first_doppler, doppler_weights = weigh(doppler, ground.doppler_taps, block.shape[1])
    nearest = (ground.middle_yaw + turn - ground.yaw_axis[0]) / (ground.yaw_axis[1] - ground.yaw_axis[0])
    lit = ground.lit[np.clip(np.floor(nearest + 0.5).astype(int), 0, ground.lit.size - 1)]
    out = np.full(row.size, np.nan + 0j)
    for k in np.flatnonzero((first_row >= 0) & (first_doppler >= 0)):
        samples = first_doppler[k] + np.arange(ground.doppler_taps[0])
        window = block[first_row[k] : first_row[k] + ground.range_taps[0], samples].astype(np.complex128)
        nearby = np.rint(middle[k] * N_CARRIER) / N_CARRIER
        carrier = np.exp(2j * np.pi * nearby * (samples - doppler[k]))
        out[k] = range_weights[k] @ window @ (doppler_weights[k] * carrier) * np.exp(-2j * np.pi * cycles[k])
    return (out * loss / (lit * ground.scale)).reshape(y.size, x.size)


@pytest.mark.parametrize("doppler_taps", [4, 6, 8, 10, 16, 20, 32])
@pytest.mark.parametrize("range_taps", [4, 10, 12, 16, 18, 32])
def test_any_number_of_taps_agrees_with_a_tap_by_tap_sum(range_taps: int, doppler_taps: int) -> None:
    """Use noise, where every tap counts; windows also meet the block's ends."""
    case = case_of()
    ground = replace(case.plan.ground, range_taps=(range_taps, 0.7), doppler_taps=(doppler_taps, 0.6))
    x, y = around(case, 30e3, ground.middle_yaw, step=2.2, shape=(40, 50))
    row, doppler = ground.locate(*np.meshgrid(x, y))[:2]
    # The ends of the block lie within the image, in both directions.
    rows = ground.rows.part(int(row.min()) + 3, int(np.ptp(row)) - 2)
    columns = ground.doppler.part(int(doppler.min()) + 2, int(np.ptp(doppler)) - 3)
    ground = replace(ground, rows=rows, doppler=columns)
    rng = np.random.default_rng(range_taps)
    block = rng.standard_normal((rows.size, 2 * columns.size), np.float32).view(np.complex64)
    image, slow = correct(block, ground, x=x, y=y), tap_by_tap(block, ground, x, y)
    held = np.isfinite(slow)
    np.testing.assert_array_equal(np.isfinite(image), held)
    assert 0.3 < held.mean() < 0.99
    level = np.sqrt(np.mean(np.abs(slow[held]) ** 2))
    assert np.abs(image - slow)[held].max() < 3e-6 * level


def test_a_block_smaller_than_a_window_is_not_read_beyond_its_ends() -> None:
    case = case_of(swath="wide")
    ground = case.plan.ground
    x, y = around(case, 30e3, ground.middle_yaw, step=1.0, shape=(9, 9))
    row, doppler = (int(v[4, 4]) for v in ground.locate(*np.meshgrid(x, y))[:2])
    n_row, n_doppler = ground.range_taps[0], ground.doppler_taps[0]
    exact = replace(
        ground,
        rows=ground.rows.part(row - (n_row // 2 - 1), n_row),
        doppler=ground.doppler.part(doppler - (n_doppler // 2 - 1), n_doppler),
    )
    block = np.ones((n_row, n_doppler), np.complex64)
    image, slow = correct(block, exact, x=x, y=y), tap_by_tap(block, exact, x, y)
    np.testing.assert_array_equal(np.isfinite(image), np.isfinite(slow))
    assert np.isfinite(image[4, 4])
    np.testing.assert_allclose(image, slow, rtol=1e-4)


def test_a_block_in_a_larger_array_is_not_read_beyond_its_axes() -> None:
    case = case_of()
    ground = case.plan.ground
    rng = np.random.default_rng(4)
    shape = (ground.rows.size, ground.doppler.size)
    block = (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)
    larger = np.pad(block, ((0, 5), (0, 37)), constant_values=1e6)
    for x, y in (
        around(case, ground.near + 60, ground.middle_yaw, step=3.0, shape=(60, 60)),
        around(case, ground.far - 60, ground.low, step=3.0, shape=(60, 60)),
        around(case, ground.far - 60, ground.high, step=3.0, shape=(60, 60)),
    ):
        image = correct(block, ground, x=x, y=y)
        assert np.isfinite(image).any()
        np.testing.assert_array_equal(correct(larger, ground, x=x, y=y), image)


def test_pixels_do_not_depend_on_the_chunk() -> None:
    case = case_of(swath="wide")
    ground = case.plan.ground
    x, y = around(case, 30e3, ground.high - 0.001, step=0.9, shape=(170, 190))
    block, _ = known_block(ground, x[60], y[60])
    whole = correct(block, ground, x=x, y=y)
    assert 0.3 < np.isfinite(whole).mean() < 0.95  # the edge of the block crosses the image
    for rows, columns in (
        (slice(0, 64), slice(0, 190)),
        (slice(13, 170), slice(77, 151)),
        (slice(40, 41), slice(5, 99)),
    ):
        part = correct(block, ground, x=x[columns], y=y[rows])
        np.testing.assert_array_equal(np.isfinite(part), np.isfinite(whole[rows, columns]))
        error = np.abs(part - whole[rows, columns])[np.isfinite(part)] * LEVEL
        # Float32 positions between samples; and where rounding decides between two carriers, the taps' error differs.
        assert np.quantile(error, 0.99) < 3e-6
        assert error.max(initial=0.0) < 0.1 * IMAGE_TAP_ERROR
    single = correct(block, ground, x=x[60:61], y=y[60:61])
    assert abs(single[0, 0] - whole[60, 60]) * LEVEL < 3e-6


def test_threads_change_no_bit_and_the_block_is_not_modified() -> None:
    case = case_of(swath="wide")
    ground = case.plan.ground
    x, y = around(case, 30e3, ground.middle_yaw, step=0.5, shape=(401, 399))
    block, _ = known_block(ground, x[60], y[60])  # read-only
    one = correct(block, ground, x=x, y=y)
    for threads in (2, 3):
        np.testing.assert_array_equal(correct(block, ground, x=x, y=y, threads=threads), one)


# -- Positions of targets ------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("steering_deg", [26.23, -26.23, None])
def test_the_ground_map_agrees_with_traced_lines_everywhere(steering_deg: float | None) -> None:
    """Compare surfaces of (range, yaw), fitted once, with lines traced for the same targets."""
    if steering_deg is None:
        case = case_of(steering_deg=None, blocks=1)
    else:
        case = case_of(steering_deg=steering_deg, swath="wide")
    ground = case.plan.ground
    rng = np.random.default_rng(7)
    for _ in range(12):
        yaw = rng.uniform(ground.low, ground.high)
        near, far = case.region.at(np.array([yaw]))
        epoch_range = rng.uniform(near[0], far[0])
        line = line_of(case, epoch_range, yaw)
        for step in case.plan.chain:
            line = step.trace(line)
        spot = focus(line)
        point = target_at(case.geometry, epoch_range, yaw)
        row, doppler, cycles, loss, turn, carrier = (v.item() for v in ground.locate(point[:1], point[1:2]))
        assert abs(row - ground.rows.position(spot.range)) < 1e-3
        assert abs(doppler - ground.doppler.position(spot.doppler)) < 2e-3
        given, delay = 0.0, 0.0
        if ground.common is not None:
            given, delay, _ = (v.item() for v in ground.common.evaluate(spot.range, spot.doppler[None]))
        off = cycles - spot.phase - given
        assert abs(off - np.rint(off)) < 5e-4  # cycles: 3 mrad
        assert loss == pytest.approx(1 / float(spot.gain), rel=1e-3)
        assert ground.middle_yaw + turn == pytest.approx(yaw, abs=1e-12)
        assert carrier == pytest.approx(float((spot.time - delay) * ground.doppler.step), abs=5e-4)


@pytest.mark.parametrize("place", [(0.5, 0.5), (0.02, 0.1), (0.97, 0.9)])
@pytest.mark.parametrize("steering_deg", [26.23, None])
def test_a_unit_target_has_amplitude_one_at_its_place(steering_deg: float | None, place: tuple[float, float]) -> None:
    case = case_of(steering_deg=steering_deg, blocks=3 if steering_deg else 1)
    ground = case.plan.ground
    yaw = ground.low + (ground.high - ground.low) * place[0]
    near, far = case.region.at(np.array([yaw]))
    epoch_range = float(near[0] + (far[0] - near[0]) * place[1])
    block = slab_of(case, signal_of(case, epoch_range, yaw, tapered=False))
    for step in case.plan.chain:
        block = step.apply(block, threads=1)
    point = target_at(case.geometry, epoch_range, yaw)
    x, y = point[0] + 0.1 * np.arange(-6, 7), point[1] + 0.1 * np.arange(-6, 7)
    image = correct(block, ground, x=x, y=y)
    assert abs(image[6, 6] - 1) < 5e-3
    # The maximum is there as well; cells are 3 m in range and 1.9 m across, and 0.1 m is 3 per cent of a cell.
    i, j = np.unravel_index(np.nanargmax(np.abs(image)), image.shape)
    assert max(abs(i - 6), abs(j - 6)) <= 1


def test_a_surface_reproduces_polynomials_of_its_degree() -> None:
    rng = np.random.default_rng(3)
    along, yaw = GroundRange(near=27e3, far=33e3, height=26e3), 0.9 + 0.2 * solvers.end_nodes(20)
    near, far = np.sqrt(27e3**2 - 26e3**2), np.sqrt(33e3**2 - 26e3**2)

    def smooth(r: FloatArray, v: FloatArray) -> FloatArray:
        ground = np.sqrt(r**2 - 26e3**2)
        return np.polynomial.polynomial.polyval2d(
            (2 * ground - near - far) / (far - near), (v - 0.9) / 0.2, coefficients
        )

    coefficients = rng.normal(0, 1, (5, 7))
    values = smooth(*np.meshgrid(along.nodes(12), yaw, indexing="ij"))
    surface = fit_surface(values, along=along, yaw=yaw, degree=(4, 6))
    r, v = rng.uniform(27e3, 33e3, 50), rng.uniform(0.7, 1.1, 50)
    np.testing.assert_allclose(surface(r, v), smooth(r, v), atol=1e-10)


def test_a_series_in_ground_range_follows_the_ground_close_to_the_nadir() -> None:
    """Where a target lies is linear in ground range; in range, 20 m beyond the height, no series follows it."""
    along, yaw = GroundRange(near=3020.0, far=3300.0, height=3000.0), solvers.end_nodes(3)
    assert along.place(along.nodes(13)) == pytest.approx(solvers.end_nodes(13), abs=1e-12)
    ranges = np.linspace(3020.0, 3300.0, 200)

    def missed(along: GroundRange) -> float:
        known = np.sqrt(along.nodes(13) ** 2 - 3000.0**2)[:, None] + np.zeros(3)
        surface = fit_surface(known, along=along, yaw=yaw, degree=(9, 2))
        return float(np.abs(surface(ranges, np.zeros(200)) - np.sqrt(ranges**2 - 3000.0**2)).max())

    assert missed(along) < 1e-9
    assert missed(replace(along, height=0.0)) > 0.1
    # A mountain at the very nadir: no ground range is less than none.
    at_nadir = GroundRange(near=3000.0, far=3300.0, height=3000.0)
    assert at_nadir.place(np.array([2999.0, 3000.0])) == pytest.approx(-1.0)


def test_a_surface_equals_its_series() -> None:
    """Compare with numpy's evaluation, for any shape of points: none, one, and more than one pass of the loop takes."""
    rng = np.random.default_rng(4)
    for degree in ((0, 0), (1, 3), (9, 16)):
        series = np.asfortranarray(rng.normal(0, 1, (degree[0] + 1, degree[1] + 1)))
        series.flags.writeable = False
        surface = Surface(series=series, along=GroundRange(near=27e3, far=33e3, height=0.0), low=-0.2, high=0.3)
        for shape in ((), (0,), (1,), (64,), (7, 31)):
            r, v = rng.uniform(26.9e3, 33.1e3, shape), rng.uniform(-0.2, 0.3, shape)
            expected = np.polynomial.chebyshev.chebval2d((r - 30e3) / 3e3, (v - 0.05) / 0.25, series)
            np.testing.assert_allclose(surface(r, v), expected, atol=1e-11)
    assert surface(np.full((5, 1), 30e3), np.full(4, 0.1)).shape == (5, 4)


# -- Seams ---------------------------------------------------------------------------------------------------


def between(
    ground: GroundMap, low: float, high: float, *, near: float | None = None, far: float | None = None
) -> GroundMap:
    """The same map with other limits in yaw and range, as a neighbour would have."""
    yaw_axis = np.linspace(low, high, ground.yaw_axis.size)
    near_limit, far_limit = (np.interp(yaw_axis, ground.yaw_axis, v) for v in (ground.near_limit, ground.far_limit))
    return replace(
        ground,
        low=low,
        high=high,
        near=ground.near if near is None else near,
        far=ground.far if far is None else far,
        yaw_axis=yaw_axis,
        near_limit=near_limit,
        far_limit=far_limit,
    )


def owned(ground: GroundMap, x: FloatArray, y: FloatArray) -> np.ndarray:
    return np.isfinite(correct(np.ones((ground.rows.size, ground.doppler.size), np.complex64), ground, x=x, y=y))


@settings(max_examples=80, deadline=None)
@given(
    yaw_deg=st.sampled_from([50.0, 180.0]),
    seam=st.floats(-0.9, 0.9),
    step=st.floats(0.2, 3.0),
    shape=st.tuples(st.integers(1, 90), st.integers(1, 90)),
    on=st.tuples(st.integers(0, 89), st.integers(0, 89)),
    exact=st.booleans(),
)
def test_neighbours_own_every_pixel_exactly_once(
    yaw_deg: float, seam: float, step: float, shape: tuple[int, int], on: tuple[int, int], exact: bool
) -> None:
    """This includes pixels on the seam's ray, and a seam on the branch cut of atan2."""
    case = case_of(yaw_deg=yaw_deg, swath="wide")
    ground = case.plan.ground
    at = ground.middle_yaw + seam * 0.4 * (ground.high - ground.low)
    x, y = around(case, 30e3, at, step=step, shape=shape)
    if exact:  # the ray through one of the pixels
        i, j = on[0] % shape[0], on[1] % shape[1]
        at = ground.middle_yaw + float(ground.relative_yaw(x[j], y[i]))
    counted = owned(between(ground, ground.low, at), x, y).astype(int) + owned(between(ground, at, ground.high), x, y)
    np.testing.assert_array_equal(counted, 1)


def test_pixels_on_a_seam_ray_of_small_whole_numbers_have_one_owner() -> None:
    """(4k, 3k) from the nadir: products of the ray test cancel exactly, or almost."""
    case = case_of(swath="wide")
    ground = case.plan.ground
    for p, q in ((1, 1), (4, 5), (7, 9), (5, 6)):
        seam = float(np.arctan2(q, p))
        if not ground.low < seam < ground.high:
            continue
        k = np.round(25e3 / np.hypot(p, q))
        x = ground.geometry.nadir[0] + p * (k + np.arange(-20.0, 21.0))
        y = ground.geometry.nadir[1] + q * (k + np.arange(-20.0, 21.0))
        counted = owned(between(ground, ground.low, seam), x, y).astype(int)
        counted += owned(between(ground, seam, ground.high), x, y)
        np.testing.assert_array_equal(counted, 1)


@settings(max_examples=30, deadline=None)
@given(seam=st.floats(-400, 400), step=st.floats(0.3, 3.0), exact=st.booleans())
def test_range_neighbours_own_every_pixel_exactly_once(seam: float, step: float, exact: bool) -> None:
    case = case_of(swath="wide")
    ground = case.plan.ground
    at = 30e3 + seam
    x, y = around(case, at, ground.middle_yaw, step=step, shape=(50, 60))
    if exact:
        at = float(ground.geometry.epoch_range(x[11], y[22]))
    low, high = ground.low, ground.high
    counted = owned(between(ground, low, high, far=at), x, y).astype(int)
    counted += owned(between(ground, low, high, near=at), x, y)
    np.testing.assert_array_equal(counted, 1)


def test_pixels_outside_all_blocks_are_nan() -> None:
    case = case_of(swath="wide")
    ground = case.plan.ground
    for epoch_range, yaw in (
        (30e3, ground.high + 0.02),  # of the neighbour
        (30e3, ground.middle_yaw + np.pi),  # behind
        (float(ground.far_limit.max()) + 300, ground.middle_yaw),  # beyond the range window
        (float(ground.near_limit.min()) - 300, ground.middle_yaw),
    ):
        x, y = around(case, epoch_range, yaw, step=1.0, shape=(20, 30))
        assert not owned(ground, x, y).any()
    # The edge of the window: the block owns pixels up to the limit at each yaw, and none beyond.
    x, y = around(case, float(ground.far_limit[2048]), ground.middle_yaw, step=2.0, shape=(60, 60))
    far = np.interp(ground.middle_yaw + ground.relative_yaw(*np.meshgrid(x, y)), ground.yaw_axis, ground.far_limit)
    inside = far - ground.geometry.epoch_range(*np.meshgrid(x, y))
    held = owned(ground, x, y)
    assert held[inside > 1e-6].all() and not held[inside < -1e-6].any()


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    yaw=st.floats(-1.2, 1.2),
    epoch_range=st.floats(27e3, 33e3),
    step=st.floats(0.5, 8.0),
    shape=st.tuples(st.integers(1, 60), st.integers(1, 60)),
)
def test_a_tile_that_is_not_touched_has_no_owned_pixels(
    yaw: float, epoch_range: float, step: float, shape: tuple[int, int]
) -> None:
    case = case_of(swath="wide")
    ground = case.plan.ground
    at = ground.middle_yaw + yaw * (ground.high - ground.low)
    x, y = around(case, epoch_range, at, step=step, shape=shape)
    for side in ((60, 60), (7, 20)):
        tiles = [tuple(tile) for tile in touched(ground, x=x, y=y, side=side)]
        inside = owned(ground, x, y)
        for row in range(0, y.size, side[0]):
            for column in range(0, x.size, side[1]):
                part = inside[row : row + side[0], column : column + side[1]]
                assert (row, column) in tiles or not part.any()


def test_an_image_far_from_the_block_is_not_covered() -> None:
    case = case_of(swath="wide")
    ground = case.plan.ground
    places = ((30e3, ground.middle_yaw), (30e3, ground.high + 0.02), (30e3, ground.middle_yaw + np.pi))
    for (epoch_range, yaw), count in zip((*places, (34e3, ground.middle_yaw)), (1, 0, 0, 0), strict=True):
        x, y = around(case, epoch_range, yaw, step=1.0, shape=(20, 30))
        assert len(touched(ground, x=x, y=y, side=(20, 30))) == count


@pytest.mark.slow
def test_precompiled_kernels_serve_every_use() -> None:
    """`compile_modules` fills the cache for blocks, maps and pixels as workers receive them: read-only or writeable."""
    script = """
import pickle, sys
from blocksar.processors.chain.ground import correction
from blocksar.graph.compiling import TASKS, compile_modules
from blocksar.kernels.loops import dispatchers
compile_modules(TASKS)
compiled = {name: len(loop.signatures) for name, loop in dispatchers("blocksar").items()}
block, cases, x, y = pickle.load(sys.stdin.buffer)
for array in (block, x, y):
    array.flags.writeable = False
for case in cases:
    correction.correct(block, case, x=x, y=y)
loops = dispatchers("blocksar")
assert {name: len(loop.signatures) for name, loop in loops.items()} == compiled
assert not any(loop.stats.cache_misses for loop in loops.values() if loop.stats.cache_path)
"""
    case = case_of(swath="wide")
    ground = case.plan.ground
    x, y = around(case, 30e3, ground.middle_yaw, step=1.0, shape=(30, 40))
    taps = [(n, m) for n in (4, 14, 22, 32) for m in (4, 10, 14, 32)]
    cases = [replace(ground, range_taps=(n, 0.6), doppler_taps=(m, 0.5)) for n, m in taps]
    block = np.ones((ground.rows.size, ground.doppler.size), np.complex64)
    blocksar.compile()
    subprocess.run([sys.executable, "-c", script], input=pickle.dumps((block, cases, x, y)), check=True)


def test_lit_pulses_are_counted() -> None:
    case = case_of(swath="wide")
    scene = case.collection
    valid = np.ones(scene.n_pulse)
    valid[::7] = 0
    yaw = np.linspace(case.region.yaw[0] - 0.01, case.region.yaw[-1] + 0.01, 301)
    direct = [valid[np.abs(v - scene.beam_azimuth) <= scene.beam_width / 2].sum() for v in yaw]
    found = lit_pulses(scene, yaw, valid)
    # The count may differ by a pulse whose beam edge coincides with a yaw.
    assert np.abs(found - direct).max() <= 1
    assert np.mean(found == direct) > 0.98
    np.testing.assert_array_equal(lit_pulses(scene, yaw - 2 * np.pi, valid), found)
