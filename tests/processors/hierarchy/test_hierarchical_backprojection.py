"""Hierarchical back-projection against the exact one, on noise: samples that hold echoes of everything."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from axis_beams import axis_collection, boom, spotlight, with_patterns
from slow_twins import back_projection
from turning_beam import around, collection

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.terrain import Terrain
from blocksar.collection.weighting import UNIFORM, Weighting
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.planning import tiling
from blocksar.planning.memory import PROCESS_MEMORY
from blocksar.planning.tiling import units_of
from blocksar.processors.exact.sums import form_image
from blocksar.processors.hierarchy import division as hierarchical_division
from blocksar.processors.hierarchy import memory
from blocksar.processors.hierarchy import parts as hierarchical_backprojection
from blocksar.processors.hierarchy.derivation import Levels
from blocksar.processors.hierarchy.division import divide, planned_error
from blocksar.processors.hierarchy.parts import MOST_WINDOWS, form_windows

LEVELS = Levels(sides=(32.0, 8.0), attenuation=70.0, edge=0.38, upsampling=6)


def noise(c: Collection, *, missing: bool = True) -> ComplexArray:
    generator = np.random.default_rng(7)
    shape = c.n_pulse, c.n_range_frequency
    samples = (generator.standard_normal(shape) + 1j * generator.standard_normal(shape)).astype(np.complex64)
    if missing:
        samples[c.n_pulse // 3 : c.n_pulse // 3 + 5] = np.nan
        samples[c.n_pulse // 2, 10:40] = np.nan
    return samples


def error(found: ComplexArray, exact: ComplexArray) -> float:
    """Error power over that of the exact image, after one complex gain, dB; both are NaN at the same places."""
    assert (np.isnan(found) == np.isnan(exact)).all()
    a, b = (image[np.isfinite(exact)].astype(np.complex128) for image in (found, exact))
    gain = np.vdot(b, a) / np.vdot(b, b)
    assert abs(gain - 1) < 1e-3
    return float(10 * np.log10((np.abs(a - gain * b) ** 2).sum() / (np.abs(b) ** 2).sum()))


def both(c: Collection, x: FloatArray, y: FloatArray, *, levels: Levels = LEVELS, terrain: Terrain | None = None,
         weighting: str = "uniform", threads: int = 1,
         samples: ComplexArray | None = None) -> tuple[ComplexArray, ComplexArray]:  # fmt: skip
    samples, geometry = noise(c) if samples is None else samples, Geometry(collection=c, terrain=terrain)
    options: dict[str, Any] = {"threads": threads, "weighting": Weighting.parse(weighting)}

    def read(pulses: slice) -> ComplexArray:
        return samples[pulses]

    image = np.zeros((y.size, x.size), np.complex64)
    row, column = y.size // 3, x.size // 2
    windows = [
        (slice(0, row), slice(0, column)),
        (slice(row, y.size), slice(0, column)),
        (slice(0, y.size), slice(column, x.size)),
    ]
    for window, found in form_windows(read, geometry, x, y, windows, levels=levels, **options):
        image[window] = found
    return image, form_image(read, geometry, x, y, **options)


def grid_about(c: Collection, n: int = 44, spacing: float = 1.0, **away: float) -> tuple[FloatArray, FloatArray]:
    """Columns and rows about a ground point in the beam, some off it by `along` and `across` m."""
    x, y = around(c, away.get("along", 0.0), away.get("across", 0.0))
    steps = spacing * (np.arange(n) - n // 2)
    return float(x) + steps, float(y) + steps[: n - 7]


@pytest.mark.slow
def test_memory_is_that_of_the_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of arrays, where samples outweigh all else: 48 windows are formed from halves of halves of what is left."""
    c = collection(steered=False, n_pulse=3000, n_frequency=1024, reference="tracked")
    x, y = grid_about(c, n=512, spacing=1.0)
    grid = Grid(x[0], x[-1], 1.0, y[0], y[-1], 1.0)
    x, y = grid.x, grid.y
    geometry, samples = Geometry(collection=c), noise(c, missing=False)
    for module in (hierarchical_backprojection, memory):
        monkeypatch.setattr(module, "PULSE_BLOCK_BYTES", 1 << 20)
    for module in (tiling, hierarchical_division):
        monkeypatch.setattr(module, "image_chunk", lambda grid: (64, 64))
    monkeypatch.setattr(hierarchical_division, "DIVISIONS", (1,))
    plan = divide(geometry, grid, fidelity=0.999, weighting=UNIFORM, workers=1, memory_limit=1e12)
    (windows,) = units_of(grid, plan.chunks)

    def form() -> None:
        for _ in form_windows(lambda some: samples[some], geometry, x, y, windows, levels=plan.levels, threads=1):
            pass

    form()  # which loads compiled loops
    tracemalloc.start()
    form()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert 0.5 < peak / (plan.memory - PROCESS_MEMORY) < 1


@pytest.mark.parametrize("weighting", ["uniform", "taylor:4:-35", "kaiser:4"])
@pytest.mark.parametrize("steered", [True, False])
def test_beams_that_turn_and_such_that_do_not(steered: bool, weighting: str) -> None:
    c = collection(steered=steered, n_pulse=1200, n_frequency=256, reference="constant" if steered else "tracked")
    found, exact = both(c, *grid_about(c), weighting=weighting)
    assert error(found, exact) < -62


def test_ends_of_the_scan_and_unlit_ground() -> None:
    c = collection(n_pulse=1200, n_frequency=256)
    x, y = grid_about(c, n=60, spacing=90.0)
    found, exact = both(c, x, y, levels=replace(LEVELS, sides=(1500.0, 500.0)))
    assert 0.05 < np.isnan(exact).mean() < 0.95
    assert error(found, exact) < -62


@pytest.mark.parametrize("mode", ["stripmap", "squinted", "sliding spotlight", "tops", "scanned backwards"])
def test_beams_about_an_axis(mode: str) -> None:
    c = with_patterns(axis_collection(mode, n_pulse=800))
    ahead = np.tan({"squinted": 0.25}.get(mode, 0.0)) * np.hypot(9000, 4000)
    x, y = 9000 + np.arange(-30.0, 30.0), ahead + np.arange(-25.0, 25.0)
    found, exact = both(c, x, y, weighting="taylor:4:-35")
    assert error(found, exact) < -62


def test_a_beam_that_turns_back_passes_places_several_times() -> None:
    c = spotlight(n_pulse=800, beam_width=0.0012)
    x, y = 9000 + np.arange(-30.0, 30.0), np.arange(-25.0, 25.0)
    found, exact = both(c, x, y)
    assert error(found, exact) < -62


@pytest.mark.parametrize(("kind", "side"), [("circle", "right"), ("circle", "left"), ("arc", "right"), ("arc", "left")])
def test_an_antenna_that_turns_round_images_one_side(kind: str, side: str) -> None:
    """Targets have their amplitudes, and all else that of the exact image, which is that of the double loop."""
    c, towards = boom(kind, side, backwards=side == "left")
    targets = [(30.0, 0.0, 1.0), (-20.0, 15.0, 0.7), (0.0, -25.0, 0.5)][: 1 if kind == "arc" and side == "right" else 3]
    samples = np.zeros((c.n_pulse, c.n_range_frequency), np.complex128)
    for tx, ty, amplitude in targets:
        sight = np.array([tx, ty, 0.0]) - c.antenna_position
        distance = np.linalg.norm(sight, axis=1)
        within = np.abs((sight * c.beam_axis).sum(axis=1) / distance) <= 0.5
        seen = within & ((sight[:, :2] * towards).sum(axis=1) > 0)
        phase = np.outer(distance - c.reference_range, 4 * np.pi / SPEED_OF_LIGHT * (c.carrier + c.range_frequency))
        samples += amplitude * seen[:, None] * np.exp(-1j * phase)
    at = 0 if side == "right" or kind == "circle" else 1
    x, y = targets[at][0] + 0.25 * np.arange(-20, 20), targets[at][1] + 0.25 * np.arange(-15, 15)
    found, exact = both(c, x, y, levels=replace(LEVELS, sides=(4.0, 1.0)), samples=samples.astype(np.complex64))
    assert error(found, exact) < -62
    assert abs(found[15, 20]) == pytest.approx(targets[at][2], abs=0.01)
    some = np.meshgrid(x[::13], y[::13])
    np.testing.assert_allclose(exact[::13, ::13], back_projection(c, samples, *some), atol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("unknown", [slice(0), slice(5, 6)])  # rows without heights
def test_terrain(unknown: slice) -> None:
    c = collection(n_pulse=900, n_frequency=256)
    x, y = grid_about(c)
    east, north = (np.arange(0.0, 145.0, 10.0) for _ in "xy")
    heights = 20 * np.sin(east / 15) * np.cos(north / 20)[:, None]
    heights[unknown] = np.nan
    terrain = Terrain(x0=x[0] - 50, dx=10.0, y0=y[0] - 50, dy=10.0, heights=heights)
    found, exact = both(c, x, y, terrain=terrain, weighting="hamming")
    assert error(found, exact) < -62


def near(*, radius: float, bandwidth: float, carrier: float, n_pulse: int) -> Collection:
    """A rail beside a room: ultra-wide band at a few metres, where nothing can be expanded."""
    time = (np.arange(n_pulse) - n_pulse // 2) / 100.0
    track = np.stack([0 * time - radius, 0.4 * time, 1.5 + 0.02 * np.sin(3 * time)], axis=1)
    f = (np.arange(384) - 192) * bandwidth / 384
    return Collection(
        carrier=carrier, time=time, range_frequency=f, reference_range=np.linalg.norm(track, axis=1),
        antenna_position=track, beam_azimuth=np.full(n_pulse, np.nan),
    )  # fmt: skip


def test_ultra_wide_band_a_few_metres_away() -> None:
    c = near(radius=5.0, bandwidth=2e9, carrier=4e9, n_pulse=600)
    x, y = np.arange(-1.0, 1.0, 0.03), np.arange(-0.8, 0.8, 0.03)
    found, exact = both(c, x, y, levels=replace(LEVELS, sides=(1.0, 0.4)))
    assert error(found, exact) < -62


def test_beyond_the_unambiguous_window_there_is_no_image() -> None:
    c = near(radius=5.0, bandwidth=8e9, carrier=10e9, n_pulse=300)  # a window of 7.2 m
    x, y = np.arange(-2.0, 5.0, 0.1), np.arange(-1.0, 1.0, 0.1)
    found, exact = both(c, x, y, levels=replace(LEVELS, sides=(1.0, 0.4)))
    assert 0.05 < np.isnan(exact).mean() < 0.95
    assert error(found, exact) < -62


def test_many_windows_are_formed_from_halves_of_them() -> None:
    c = collection(n_pulse=900, n_frequency=256)
    x, y = grid_about(c, n=50, spacing=8.0)
    cells = [(slice(i, min(i + 10, y.size)), slice(j, j + 10)) for i in range(0, y.size, 10) for j in range(0, 50, 10)]
    samples, geometry, image = noise(c), Geometry(collection=c), np.zeros((y.size, 50), np.complex64)
    levels = replace(LEVELS, sides=(100.0, 40.0))
    for window, found in form_windows(lambda p: samples[p], geometry, x, y, cells, levels=levels, threads=1):
        image[window] = found
    assert len(cells) > MOST_WINDOWS
    assert error(image, form_image(lambda p: samples[p], geometry, x, y, threads=1)) < -62


def test_threads_give_the_same_bits() -> None:
    c = collection(n_pulse=900, n_frequency=256)
    x, y = grid_about(c)
    one, three = (both(c, x, y, threads=threads)[0] for threads in (1, 3))
    np.testing.assert_array_equal(one, three)


def test_the_double_loop_says_the_same() -> None:
    c = collection(n_pulse=900, n_frequency=128, reference="tracked")
    x, y = grid_about(c, n=20)
    found, _ = both(c, x, y)
    mesh = np.meshgrid(x[4:7], y[4:7])
    exact = back_projection(c, noise(c), *mesh)
    assert np.abs(found[4:7, 4:7] - exact).max() < 1e-3 * np.abs(exact).max()


@pytest.mark.parametrize(("attenuation", "upsampling"), [(40.0, 3), (55.0, 5), (80.0, 12)])
def test_the_error_follows_filters_and_interpolation(attenuation: float, upsampling: int) -> None:
    c = collection(n_pulse=900, n_frequency=128, reference="tracked")
    x, y = grid_about(c)
    levels = Levels(sides=(32.0, 8.0), attenuation=attenuation, edge=0.38, upsampling=upsampling)
    samples = noise(c)
    window = slice(0, y.size), slice(0, x.size)
    ((_, found),) = form_windows(lambda p: samples[p], Geometry(collection=c), x, y, [window], levels=levels, threads=1)
    exact = back_projection(c, samples, *np.meshgrid(x[::5], y[::5]))
    away = np.abs(found[::5, ::5] - exact)
    assert (away**2).sum() / (np.abs(exact) ** 2).sum() < 1.25 * planned_error(levels, stages=3)


@pytest.mark.slow
@pytest.mark.parametrize("beam_width", [0.0012, 0.0003])
def test_windows_share_one_reading_also_where_no_pulse_lights_all_of_one(beam_width: float) -> None:
    c = replace(axis_collection("tops", n_pulse=800), beam_width=beam_width)
    samples, geometry = noise(c), Geometry(collection=c)
    x, y = 9000 + np.arange(-40.0, 40.0), np.arange(-40.0, 40.0)
    windows = [(slice(i, i + 40), slice(j, j + 40)) for i in (0, 40) for j in (0, 40)]
    pulses: list[int] = []

    def read(some: slice) -> ComplexArray:
        pulses.extend(range(some.start, some.stop))
        return samples[some]

    formed = [image for _, image in form_windows(read, geometry, x, y, windows, levels=LEVELS, threads=1)]
    assert all(np.isfinite(image).any() for image in formed)
    assert len(pulses) == len(set(pulses))
