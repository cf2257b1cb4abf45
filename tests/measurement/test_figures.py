"""Quality figures, against exact back-projection of single targets, whose response is known exactly."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from axis_beams import axis_collection, with_patterns
from scipy.integrate import quad
from scipy.optimize import brentq, minimize_scalar
from scipy.special import diric
from summed_response import summed_response

from blocksar.arrays import Complex128Array, ComplexArray, FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry, over_terrain
from blocksar.collection.terrain import Terrain
from blocksar.collection.weighting import Weighting
from blocksar.constants import SINC_ISLR, SINC_PSLR, SINC_WIDTH, SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.measurement.axes import response_axes
from blocksar.measurement.coherence import coherence
from blocksar.measurement.figures import (
    DEFINITIONS,
    PointResponse,
    as_json,
    cuts,
    measure,
    measure_target,
    profile_quality,
    summary,
)
from blocksar.measurement.response import ReadChip, carrier_phase, read_response
from blocksar.measurement.targets import Target
from blocksar.processors.exact.sums import form_points
from blocksar.simulation.scatterers import simulate_pulses

PULSE_RATE = 4000.0  # half of Table 1's, for speed: 648 pulses light a target
STEERING = np.deg2rad(57.87 - 42.13) / 0.6
GROUND_RANGE = np.sqrt(30e3**2 - 16.5e3**2)
SPACING = 0.95  # m, about half the resolution


def collection(*, steered: bool, duration: float = 0.6) -> Collection:
    """Table 1 with 200 range frequencies; unsteered and 0.162 s long, every pulse lights every pixel."""
    n = round(duration * PULSE_RATE)
    time = (np.arange(n) - n // 2) / PULSE_RATE
    velocity, acceleration = np.array([-40.0, 1300.0, -600.0]), np.array([-15.0, -30.0, -35.0])
    yaw = np.deg2rad(50) + STEERING * time
    return Collection(
        carrier=15e9,
        time=time,
        range_frequency=(np.arange(200) - 100) * 50e6 / 200,
        reference_range=np.full(n, 30e3),
        antenna_position=np.array([0, 0, 16.5e3]) + velocity * time[:, None] + acceleration * time[:, None] ** 2 / 2,
        beam_azimuth=yaw if steered else np.full(n, np.nan),
        beam_width=0.162 * STEERING if steered else None,
    )


STEERED = Geometry(collection=collection(steered=True))
UNSTEERED = Geometry(collection=collection(steered=False, duration=0.162))


def target_at(yaw_degrees: float = 50.0, *, name: str = "T", reflectivity: complex = 1.0) -> Target:
    yaw = np.deg2rad(yaw_degrees)
    return Target(
        name, float(GROUND_RANGE * np.cos(yaw)) + 0.37, float(GROUND_RANGE * np.sin(yaw)) - 0.21, reflectivity
    )


def grid_about(target: Target, *, n: int = 112, spacing: float = SPACING) -> tuple[FloatArray, FloatArray]:
    offset = (np.arange(n, dtype=np.float64) - n // 2) * spacing
    return offset + round(target.x), offset + round(target.y)


def back_project(
    geometry: Geometry, target: Target, x: FloatArray, y: FloatArray, *, pulse_phase: FloatArray | None = None
) -> Complex128Array:
    """Mean over a target's lit pulses and all frequencies, pulse by pulse; `pulse_phase` (rad) defocuses it."""
    c = geometry.collection
    start, end = geometry.beam.dwell(np.array(target.x), np.array(target.y))
    lit = np.flatnonzero((c.time > start) & (c.time < end))
    phase = np.zeros(lit.size) if pulse_phase is None else pulse_phase
    middle = c.carrier + (c.range_frequency[0] + c.range_frequency[-1]) / 2
    total = np.zeros(x.shape, dtype=np.complex128)
    for pulse, error in zip(lit, phase, strict=True):
        px, py, pz = c.antenna_position[pulse]
        delay = 2 / SPEED_OF_LIGHT * (np.sqrt((x - px) ** 2 + (y - py) ** 2 + pz**2) - np.sqrt(
            (target.x - px) ** 2 + (target.y - py) ** 2 + pz**2
        ))  # fmt: skip
        comb = diric(2 * np.pi * c.range_frequency_step * delay, c.n_range_frequency)
        total += comb * np.exp(1j * (2 * np.pi * middle * delay + error))
    return np.asarray(target.reflectivity * total / lit.size)


def image_of(
    geometry: Geometry,
    target: Target,
    image_x: FloatArray,
    image_y: FloatArray,
    *,
    pulse_phase: FloatArray | None = None,
) -> ComplexArray:
    x, y = np.meshgrid(image_x, image_y)
    image = back_project(geometry, target, x, y, pulse_phase=pulse_phase).astype(np.complex64)
    image.flags.writeable = False
    return image


def reader(image: ComplexArray) -> ReadChip:
    return lambda rows, columns: image[rows, columns]


Scene = tuple[Target, FloatArray, FloatArray, ComplexArray]


@pytest.fixture(scope="module")
def scene() -> Scene:
    """One target between pixels; every pulse lights every pixel."""
    target = target_at(reflectivity=1.2 - 0.5j)
    image_x, image_y = grid_about(target)
    return target, image_x, image_y, image_of(UNSTEERED, target, image_x, image_y)


def measured(geometry: Geometry, scene: Scene) -> PointResponse:
    target, image_x, image_y, image = scene
    return measure_target(reader(image), image_x, image_y, geometry, target)


# ---- Definitions and theory


def test_the_ideal_figures_are_those_of_the_sinc() -> None:
    def power(u: float) -> float:
        return float(np.sinc(u) ** 2)

    width = 2 * brentq(lambda u: power(u) - 0.5, 0.1, 0.9)
    lobe = -minimize_scalar(lambda u: -power(u), bounds=(1, 2), method="bounded", options={"xatol": 1e-10}).fun
    edges = [*range(1, 9), 10 * width]
    side = 2 * sum(quad(power, a, b)[0] for a, b in pairwise(edges))
    islr = 10 * np.log10(side / (2 * quad(power, 0, 1)[0]))
    stated = (SINC_WIDTH, SINC_PSLR, SINC_ISLR)
    assert stated == pytest.approx((width, 10 * np.log10(lobe), islr), abs=5e-4)
    u = np.arange(-700, 701) / 64
    found = profile_quality(u, np.sinc(u * SINC_WIDTH).astype(complex), width=1.0)
    # 64 samples per width miss the lobe's top by at most 0.001 dB.
    assert found == pytest.approx((1, SINC_PSLR, SINC_ISLR), abs=1e-3)


def test_theory_agrees_with_table_1() -> None:
    axes = response_axes(
        STEERED, float(GROUND_RANGE * np.cos(np.deg2rad(50))), float(GROUND_RANGE * np.sin(np.deg2rad(50)))
    )
    assert axes is not None
    assert axes.azimuth_width == pytest.approx(1.89, abs=0.005)  # as printed in Table 3
    assert axes.range_width == pytest.approx(2.656, abs=0.001)  # 0.8859 c / (2 * 50 MHz)


@pytest.mark.parametrize("yaw", [50.0, -50.0, 130.0])
def test_axes_are_iso_range_and_iso_doppler(yaw: float) -> None:
    target = target_at(yaw)
    axes = response_axes(UNSTEERED, target.x, target.y)
    assert axes is not None

    def at(offset: FloatArray) -> tuple[float, float]:
        point = np.array([target.x + offset[0], target.y + offset[1], 0.0])
        distance, rate = UNSTEERED.range_history(point, np.array(axes.time))
        return float(distance), float(rate)

    (here, rate), step = at(np.zeros(2)), 1.0  # m
    along_range, along_azimuth = at(step * axes.range_direction), at(step * axes.azimuth_direction)
    # A metre on a curved surface at 30 km: the second-order term is 1 / 30 000 of it.
    assert along_range[0] - here == pytest.approx(step, abs=1e-4)
    assert along_azimuth[0] - here == pytest.approx(0, abs=1e-4)
    # Compare with the 0.04 m/s by which a metre along range would otherwise change the rate.
    assert along_range[1] - rate == pytest.approx(0, abs=2e-5)
    dx, dy = axes.ground_offset(np.array(3.0), np.array(-2.0))
    assert axes.own_offset(dx, dy) == pytest.approx((3.0, -2.0))


@pytest.mark.parametrize("geometry", [STEERED, UNSTEERED], ids=["steered", "unsteered"])
def test_the_ideal_response_equals_the_direct_double_sum(geometry: Geometry) -> None:
    target, rng = target_at(reflectivity=0.3 + 2j), np.random.default_rng(60)
    x, y = target.x + rng.uniform(-20, 20, 6), target.y + rng.uniform(-20, 20, 6)
    c = geometry.collection
    slow = []
    for px, py in zip(x, y, strict=True):
        sight = np.array([px, py, 0]) - c.antenna_position
        of_target = np.array([target.x, target.y, 0]) - c.antenna_position
        difference = np.linalg.norm(sight, axis=1) - np.linalg.norm(of_target, axis=1)
        signal = np.exp(4j * np.pi / SPEED_OF_LIGHT * (c.carrier + c.range_frequency) * difference[:, None]).mean(
            axis=1
        )
        lit = [np.ones(c.n_pulse, dtype=bool)] * 2
        if c.beam_width is not None:
            lit = [np.abs(np.arctan2(b, a) - c.beam_azimuth) <= c.beam_width / 2 for a, b in ((px, py), target[1:3])]
        slow.append(target.reflectivity * (signal * lit[0] * lit[1]).sum() / lit[0].sum())
    # Geometry allows a track misfit of 1e-5 wavelengths: 4 pi 1e-5 rad.
    assert summed_response(geometry, target, x, y) == pytest.approx(np.array(slow), abs=2e-4)


# ---- A single response


@pytest.mark.slow
def test_interpolation_is_exact_to_1e_4(scene: Scene) -> None:
    target, image_x, image_y, image = scene
    response = read_response(reader(image), image_x, image_y, UNSTEERED, target)
    assert response is not None
    rng = np.random.default_rng(61)
    x, y = target.x + rng.uniform(-25, 25, 200), target.y + rng.uniform(-25, 25, 200)
    phase = carrier_phase(UNSTEERED, response.axes.time, target.x, target.y, at_x=x, at_y=y)
    exact = back_project(UNSTEERED, target, x, y) / target.reflectivity * np.exp(-1j * phase)
    assert np.abs(response.at(x, y) - exact).max() < 1e-5


def test_an_ideal_target_has_ideal_figures(scene: Scene) -> None:
    found = measured(UNSTEERED, scene)
    assert found.range_pslr == pytest.approx(SINC_PSLR, abs=0.01)
    assert found.azimuth_pslr == pytest.approx(SINC_PSLR, abs=0.01)
    assert found.range_islr == pytest.approx(SINC_ISLR, abs=0.02)
    assert found.azimuth_islr == pytest.approx(SINC_ISLR, abs=0.02)
    assert found.range_irw == pytest.approx(found.range_irw_theory, rel=1e-3)
    assert found.azimuth_irw == pytest.approx(found.azimuth_irw_theory, rel=1e-3)
    assert np.hypot(found.error_x, found.error_y) < 1e-4
    assert found.value == pytest.approx(1, abs=1e-5)
    assert found.covered and found.full_dwell


@pytest.mark.slow
def test_beam_steered_target_with_each_pixel_s_own_lit_pulses() -> None:
    """By definition each pixel is the mean over its own lit pulses, not over those of the target."""
    target = target_at(52.0)
    image_x, image_y = grid_about(target)
    x, y = np.meshgrid(image_x, image_y)
    image = summed_response(STEERED, target, x.ravel(), y.ravel()).reshape(x.shape).astype(np.complex64)
    found = measure_target(reader(image), image_x, image_y, STEERED, target)
    # Pulses enter and leave one by one from pixel to pixel: real steps of 1 / 648 = 0.0015.
    assert found.range_pslr == pytest.approx(SINC_PSLR, abs=0.1)
    assert found.azimuth_pslr == pytest.approx(SINC_PSLR, abs=0.1)
    assert found.range_irw == pytest.approx(found.range_irw_theory, rel=5e-3)
    assert found.azimuth_irw == pytest.approx(found.azimuth_irw_theory, rel=5e-3)
    assert np.hypot(found.error_x, found.error_y) < 5e-3
    assert found.value == pytest.approx(1, abs=1e-3)
    assert found.full_dwell


def test_cuts_equal_those_of_exact_back_projection() -> None:
    target = target_at(130.0)
    axes = response_axes(UNSTEERED, target.x, target.y)
    assert axes is not None
    reach = 14 * max(axes.range_width * np.abs(axes.range_direction).max(), axes.azimuth_width)
    spacing = float(0.25 / axes.band.max())  # oversampled by two
    image_x, image_y = grid_about(target, n=2 * int(reach / spacing) + 26, spacing=spacing)
    image = image_of(UNSTEERED, target, image_x, image_y)
    response = read_response(reader(image), image_x, image_y, UNSTEERED, target)
    assert response is not None
    sampled, found = cuts(response), measure(response)
    dx, dy = axes.ground_offset(sampled.range_offset, np.zeros(1))
    exact = profile_quality(
        sampled.range_offset, back_project(UNSTEERED, target, target.x + dx, target.y + dy), width=axes.range_width
    )
    assert (found.range_irw, found.range_pslr, found.range_islr) == pytest.approx(exact, abs=1e-3)
    dx, dy = axes.ground_offset(np.zeros(1), sampled.azimuth_offset)
    exact = profile_quality(
        sampled.azimuth_offset, back_project(UNSTEERED, target, target.x + dx, target.y + dy), width=axes.azimuth_width
    )
    assert (found.azimuth_irw, found.azimuth_pslr, found.azimuth_islr) == pytest.approx(exact, abs=1e-3)


def test_a_known_shift_and_phase_are_measured(scene: Scene) -> None:
    target, image_x, image_y, image = scene
    shift = np.array([0.31, -0.24])
    believed = target._replace(x=target.x - shift[0], y=target.y - shift[1])
    found = measure_target(reader(image), image_x, image_y, UNSTEERED, believed)
    assert (found.error_x, found.error_y) == pytest.approx(shift, abs=1e-3)
    turned = (image * 0.9 * np.exp(0.3j)).astype(np.complex64)
    found = measure_target(reader(turned), image_x, image_y, UNSTEERED, target)
    assert found.value == pytest.approx(0.9 * np.exp(0.3j), abs=1e-4)


@pytest.mark.slow
def test_quadratic_phase_broadens_the_response(scene: Scene) -> None:
    target, image_x, image_y, _ = scene
    u = np.linspace(-1, 1, UNSTEERED.collection.n_pulse)
    image = image_of(UNSTEERED, target, image_x, image_y, pulse_phase=np.pi / 2 * u**2)
    found = measure_target(reader(image), image_x, image_y, UNSTEERED, target)
    # Textbook: pi/2 of quadratic phase at the edge broadens the unweighted response by about a tenth,
    # rotates its value and does not affect range.
    fine = np.arange(-1000, 1001) / 64
    spoiled = np.exp(1j * (np.pi / 2 * u**2)) @ np.exp(1j * np.pi * SINC_WIDTH * np.outer(u, fine)) / u.size
    expected = profile_quality(fine, spoiled, width=1.0)
    assert expected.irw > 1.04
    assert found.azimuth_irw / found.azimuth_irw_theory == pytest.approx(expected.irw, rel=2e-3)
    assert found.azimuth_pslr == pytest.approx(expected.pslr, abs=0.1)
    assert found.range_irw == pytest.approx(found.range_irw_theory, rel=2e-3)
    assert found.value == pytest.approx(np.exp(0.5j * np.pi * u**2).mean(), abs=2e-3)


# ---- Coverage, reading, refusals


def test_figures_that_missing_pixels_affect_are_nan(scene: Scene) -> None:
    target, image_x, image_y, image = scene
    torn = image.copy()
    axes = response_axes(UNSTEERED, target.x, target.y)
    assert axes is not None
    along_range, _ = axes.own_offset(image_x[None, :] - target.x, image_y[:, None] - target.y)
    torn[along_range > 7 * axes.range_width] = np.nan
    found = measure_target(reader(torn), image_x, image_y, UNSTEERED, target)
    whole = measured(UNSTEERED, scene)
    assert not found.covered
    assert np.isnan([found.range_pslr, found.range_islr]).all()
    # Figures that do not involve the gap are measured as without it.
    assert found.azimuth_pslr == whole.azimuth_pslr
    assert found.range_irw == whole.range_irw
    assert found.value == whole.value
    dark = np.full_like(image, np.nan)
    found = measure_target(reader(dark), image_x, image_y, UNSTEERED, target)
    assert not found.covered
    assert np.isnan([found.value, found.error_x, found.azimuth_irw]).all()


def test_a_target_near_the_image_edge_or_outside_is_not_covered(scene: Scene) -> None:
    target, image_x, image_y, image = scene
    near = slice(int(np.searchsorted(image_x, target.x)) - 20, None)
    found = measure_target(reader(image[:, near]), image_x[near], image_y, UNSTEERED, target)
    assert not found.covered
    assert found.value == pytest.approx(1, abs=1e-5)
    outside = measure_target(reader(image), image_x + 500, image_y, UNSTEERED, target)
    assert not outside.covered
    assert outside.full_dwell
    assert np.isfinite(outside.azimuth_irw_theory)


@pytest.mark.slow
@pytest.mark.parametrize("off", [0.0, 0.3])
def test_the_value_of_a_target_on_a_pixel_needs_no_other_pixel(off: float) -> None:
    target, cut = target_at(), 3
    image_x, image_y = grid_about(target)
    column, row = (int(np.argmin(np.abs(axis - at))) for axis, at in ((image_x, target.x), (image_y, target.y)))
    image_x, image_y = image_x + (target.x - image_x[column]), image_y + (target.y - image_y[row])
    image_x = image_x + off * (image_x[1] - image_x[0])
    image = image_of(UNSTEERED, target, image_x, image_y)
    near = slice(column - cut, None)
    found = measure_target(reader(image[:, near]), image_x[near], image_y, UNSTEERED, target)
    assert not found.covered and np.isnan(found.range_pslr)
    assert np.isnan(found.value) if off else found.value == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize("beyond", [2.0, 100.0])
def test_a_target_outside_near_the_end_of_the_terrain_has_no_figures(beyond: float) -> None:
    target, step, heights = target_at(), 20.0, np.zeros((101, 101))
    heights[:, 51:] = np.nan
    terrain = Terrain(x0=target.x - 50 * step, dx=step, y0=target.y - 50 * step, dy=step, heights=heights)
    along = np.linspace(target.x - 3 * step, target.x + 3 * step, 601)
    end = along[np.isfinite(terrain(along, np.full(along.size, target.y)))].max()
    geometry = over_terrain(UNSTEERED.collection, replace(terrain, x0=terrain.x0 + target.x + beyond - end))
    image_x, image_y = grid_about(target)
    found = measure_target(reader(np.ones((112, 112), np.complex64)), image_x - 500, image_y, geometry, target)
    assert not found.covered
    assert np.isnan(found.range_pslr)
    assert np.isnan(found.range_pslr_theory) == (beyond < 10)


def test_only_the_chip_needed_is_read() -> None:
    target, asked = target_at(), list[tuple[int, int]]()
    image_x, image_y = grid_about(target, n=6000)

    def read(rows: slice, columns: slice) -> ComplexArray:
        asked.append((rows.stop - rows.start, columns.stop - columns.start))
        return np.ones(asked[-1], dtype=np.complex64)

    measure_target(read, image_x, image_y, UNSTEERED, target)
    assert len(asked) == 1
    assert max(asked[0]) < 120  # +-16 widths


def test_a_target_that_is_never_lit_is_reported_but_not_measured() -> None:
    target = target_at(10.0)
    image_x, image_y = grid_about(target)
    found = measure_target(reader(np.ones((112, 112), np.complex64)), image_x, image_y, STEERED, target)
    assert not found.covered
    assert not found.full_dwell
    assert np.isnan(found.azimuth_irw_theory)


def test_a_target_at_a_zero_of_the_antenna_s_pattern_has_no_axes() -> None:
    pattern = {"elevation": np.array([0.2, 0.4, 0.45, 0.6]), "elevation_pattern": np.array([1.0, 0.0, 0.0, 1.0])}
    geometry = Geometry(collection=axis_collection(**pattern))
    assert response_axes(geometry, 9000.0, 0.0) is None
    assert response_axes(geometry, 7000.0, 0.0) is not None


def test_a_grid_too_coarse_is_refused_with_the_spacing_needed() -> None:
    target = target_at()
    image_x, image_y = grid_about(target, spacing=2.0)
    with pytest.raises(InputError, match=r"spacing is 2 m in x and 2 m in y.*T; focus on a grid of at most 1\.5"):
        measure_target(reader(np.ones((112, 112), np.complex64)), image_x, image_y, UNSTEERED, target)


# ---- Tables


def test_summary_and_json(scene: Scene) -> None:
    good = measured(UNSTEERED, scene)
    bad = good._replace(name="bad", azimuth_pslr=-11.0, error_x=-0.4, value=0.8 * np.exp(0.2j))
    partly = good._replace(name="partly", full_dwell=False, azimuth_pslr=-5.0)
    torn = good._replace(name="torn", covered=False, range_pslr=float("nan"))
    found = summary([good, bad, partly, torn])
    assert (found.targets, found.full_dwell, found.measured) == (4, 3, 2)
    assert found.worst["azimuth_pslr"][:2] == ("bad", -11.0)
    assert found.worst["error_x"][:2] == ("bad", -0.4)
    assert found.worst["amplitude"].value == pytest.approx(0.8)
    assert found.worst["phase"].value == pytest.approx(0.2)
    # A covered target without a width counts as the worst case, not as absent.
    assert (
        summary([good, good._replace(name="lost", range_irw=float("nan"))]).worst["range_irw_over_theory"].name
        == "lost"
    )
    record = json.loads(json.dumps(as_json([good, torn]), allow_nan=False))
    assert record["definitions"] == DEFINITIONS
    assert record["targets"][1]["range_pslr"] is None
    assert record["targets"][0]["value"] == pytest.approx([1, 0], abs=1e-5)
    assert summary([]).worst == {}


def test_coherence() -> None:
    rng = np.random.default_rng(62)
    shape = (64, 64)
    b = (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)
    other = (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)
    a = (0.7 * np.exp(0.4j) * b).astype(np.complex64)
    a[3, 5], a[:, 60:] = np.nan, np.nan
    same = coherence(a, b)
    assert abs(same.coherence) == pytest.approx(1, abs=1e-6)
    assert (same.gain, same.phase) == pytest.approx((0.7, 0.4), abs=1e-6)
    assert same.pixels == 64 * 60 - 1
    # Independent noise: about 1 / sqrt(4096) = 0.016.
    assert abs(coherence(other, b).coherence) < 0.06
    # Noise of a tenth of the power lowers it to 1 / sqrt(1.1).
    mixed = coherence((b + np.sqrt(0.1) * other).astype(np.complex64), b)
    assert abs(mixed.coherence) == pytest.approx(1 / np.sqrt(1.1), abs=0.01)
    assert np.isnan(coherence(np.full_like(b, np.nan), b).gain)
    with pytest.raises(ValueError, match="one shape"):
        coherence(a, b[:3])


# ---- Pictures


def test_the_overview_reads_in_parts_and_preserves_power() -> None:
    from blocksar.products.pictures.overview import overview

    rng = np.random.default_rng(63)
    image = (rng.standard_normal((203, 150)) + 1j * rng.standard_normal((203, 150))).astype(np.complex64)
    image[:40, :40] = np.nan
    image[41, 100] = 30
    largest = 0

    def read(rows: slice, columns: slice) -> ComplexArray:
        nonlocal largest
        largest = max(largest, image[rows, columns].size)
        return image[rows, columns]

    x, y = np.arange(150.0), np.arange(203.0)
    for strip in (1, 2000, 2**22):
        seen = overview(read, x, y, max_pixels=51, strip=strip)
        assert seen.power.shape == (51, 38)
        assert np.nanmax(seen.power) == pytest.approx(900)  # a point target is never lost
        assert np.isnan(seen.power[:10, :10]).all() and np.isfinite(seen.power[10:]).all()
    largest = 0
    seen = overview(read, x, y, max_pixels=51, strip=2000, looks="mean")
    assert largest <= 2000
    assert seen.power[20, 20] == pytest.approx(np.mean(np.abs(image[80:84, 80:84]) ** 2), rel=1e-6)
    assert seen.power[50, 37] == pytest.approx(np.mean(np.abs(image[200:, 148:]) ** 2), rel=1e-6)
    assert (seen.x_edges[0], seen.x_edges[1]) == (-0.5, 3.5)


def test_the_stretch_suits_clutter_and_isolated_targets() -> None:
    from blocksar.products.pictures.overview import stretch

    rng = np.random.default_rng(64)
    clutter = -23 + rng.standard_normal(10_000)
    low, high = stretch(clutter)
    assert 0.4 < (-23 - low) / (high - low) < 0.6  # uniform clutter is mid-grey
    targets = np.full(10_000, -90.0)
    targets[::2000] = 0.0
    assert stretch(targets) == (-60.0, 0.0)  # the background is black; only their peaks are white
    assert stretch(np.full(5, np.nan)) == (-60.0, 0.0)


@pytest.mark.slow
def test_pictures_of_nothing_are_written(scene: Scene, tmp_path: Path) -> None:
    from blocksar.products.pictures import blocks, responses

    target, image_x, image_y, image = scene
    dark = reader(np.full_like(image, np.nan))
    several = [
        read_response(read, image_x, image_y, UNSTEERED, target)  # of the other nothing is seen
        for read in (reader(image), dark)
    ]
    assert all(each is not None for each in several)
    blocks.plot_mosaic(dark, image_x, image_y, tmp_path / "dark.png")
    responses.plot_contours(several, tmp_path / "contours.png")  # type: ignore[arg-type]
    responses.plot_cuts(several, tmp_path / "cuts.png")  # type: ignore[arg-type]
    assert all(path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n" for path in tmp_path.iterdir())


def test_the_ideal_response_under_patterns_is_the_back_projection_of_the_target() -> None:
    collection = with_patterns(axis_collection())
    geometry, target = Geometry(collection=collection), Target("P", 9000.0, 12.0, 1.0 + 0.5j)
    signal = simulate_pulses(collection, np.array([target.x]), np.array([target.y]), np.array([target.reflectivity]))
    x, y = 9000.0 + np.linspace(-6, 6, 9), 12.0 + np.linspace(4, -4, 9)
    exact = form_points(lambda pulses: signal[pulses], geometry, x, y, threads=1)
    np.testing.assert_allclose(summed_response(geometry, target, x, y), exact, atol=2e-3)


@pytest.mark.slow
def test_a_target_under_patterns_has_the_figures_of_its_ideal_response() -> None:
    """Those of the taper alone would be off: the pattern falls by 5 dB to the edges of the beam."""
    collection = with_patterns(axis_collection(n_pulse=800, beam_width=0.012))
    geometry, target = Geometry(collection=collection), Target("P", 9000.0, 12.0, 1.0 + 0j)
    weighting = Weighting.parse("taylor:4:-35")
    axes = response_axes(geometry, target.x, target.y, weighting)
    assert axes is not None
    reach = 20 * np.array([axes.range_width * abs(axes.range_direction[0]), axes.azimuth_width])
    image_x, image_y = (
        centre + np.linspace(-1, 1, 2 * int(extent * 2.8 * band) + 1) * extent
        for centre, extent, band in zip((target.x, target.y), reach, axes.band, strict=True)
    )
    x, y = np.meshgrid(image_x, image_y)
    image = summed_response(geometry, target, x.ravel(), y.ravel(), weighting).reshape(x.shape).astype(np.complex64)
    found = measure_target(reader(image), image_x, image_y, geometry, target, weighting)
    assert found.covered and found.full_dwell
    assert found.azimuth_irw == pytest.approx(found.azimuth_irw_theory, rel=0.002)
    assert found.azimuth_pslr == pytest.approx(found.azimuth_pslr_theory, abs=0.1)
    assert found.range_irw == pytest.approx(found.range_irw_theory, rel=0.002)
    assert found.range_pslr == pytest.approx(found.range_pslr_theory, abs=0.1)
    assert found.azimuth_pslr_theory < weighting.azimuth.ideal.pslr - 2
    assert axes.azimuth_shape.ideal.width > 1.03 * weighting.azimuth.ideal.width
    along = np.linspace(-4, 4, 33) * axes.azimuth_width
    dx, dy = axes.ground_offset(np.zeros(33), along)
    cut = np.abs(summed_response(geometry, target, target.x + dx, target.y + dy, weighting))
    drawn = axes.azimuth_shape.response(along / axes.azimuth_width * axes.azimuth_shape.ideal.width)
    np.testing.assert_allclose(drawn, cut, atol=0.02)  # the curve in pictures; the beam moves on with the pixel
    energy = float((np.abs(image) ** 2).sum()) * (image_x[1] - image_x[0]) * (image_y[1] - image_y[0])
    assert energy == pytest.approx(axes.area, rel=0.02)
