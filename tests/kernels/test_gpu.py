"""The loops of back-projection on a GPU against those of the CPU: in numba's simulator, and on a GPU where one is."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from turning_beam import around, collection

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.terrain import Terrain
from blocksar.collection.weighting import Weighting
from blocksar.kernels.decimation import Decimation, padded
from blocksar.kernels.device import CPU, device, has_gpu
from blocksar.processors.exact.sums import form_points
from blocksar.processors.hierarchy.derivation import Levels
from blocksar.processors.hierarchy.parts import form_windows

HERE = os.environ.get("NUMBA_ENABLE_CUDASIM") == "1" or has_gpu()
on_gpu = pytest.mark.skipif(not HERE, reason="no GPU: these run in numba's simulator, by the first test")


@pytest.mark.slow
@pytest.mark.skipif(HERE, reason="they run here")
def test_all_of_these_in_the_simulator() -> None:
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", __file__],
        env=os.environ | {"NUMBA_ENABLE_CUDASIM": "1"},
        capture_output=True,
        check=False,
        text=True,
    )
    assert run.returncode == 0, run.stdout
    assert "failed" not in run.stdout and "passed" in run.stdout


def noise(shape: tuple[int, int], seed: int = 0) -> ComplexArray:
    return np.random.default_rng(seed).standard_normal((shape[0], 2 * shape[1]), np.float32).view(np.complex64)


def apart(found: ComplexArray, exact: ComplexArray) -> float:
    """Error power over that of the exact values, dB; both are NaN at the same places."""
    assert (np.isnan(found) == np.isnan(exact)).all()
    valid = np.isfinite(exact)
    assert valid.any()
    power = (np.abs(found - exact)[valid] ** 2).sum() / (np.abs(exact)[valid] ** 2).sum()
    return float(10 * np.log10(max(power, 1e-30)))


@on_gpu
@pytest.mark.parametrize("factor", [1, 3])
def test_turns_and_filters(factor: int) -> None:
    gpu, values = device("gpu"), noise((5, 41))
    generator = np.random.default_rng(1)
    first, step = 1e5 * generator.standard_normal(7), 20 * generator.standard_normal(7)
    filters = Decimation(factor, 0.3 if factor > 1 else 0.0, 60.0)
    source, target = np.array([0, 3, 3, 1, 4, 2, 0]), np.array([-1, 2, -1, 0, -1, -1, 1])
    runs = np.array([[0, 1, 1, 2, 4], [2, 1, 5, 0, 3], [4, 2, 8, -4, 6]])
    found = []
    for each in (CPU, gpu):
        out, others, sums = (each.put(noise((n, padded(filters.span(41)[0])), seed=n)) for n in (3, 7, 14))
        each.turn_and_decimate(each.put(values), source, first, step, filters, target, out, others)
        each.add_decimated(others, runs, filters, sums)
        size = filters.span(41)[0]  # what stands beyond are zeros on the CPU
        rows = [each.take(out)[:, :size], each.take(others)[target < 0, :size], each.take(sums)[:, :size]]
        found.append(np.concatenate(rows))
    assert apart(found[1], found[0]) < -110


SCENES: dict[str, dict[str, Any]] = {
    "weighted": {"weighting": "taylor:4:-35"},
    "on hills, weighted": {"weighting": "hamming", "hills": True},
    "unsteered": {"steered": False},
    "far between": {"spacing": 40.0},  # pixels of a thread are too far apart for float32
    "so close that a window ends": {"spacing": 700.0},
    "where the window ends": {"spacing": 0.4, "along": 71.3},
    "from 700 km": {"height": 500e3, "ground": 490e3, "reference": "tracked"},
}


def scene(
    weighting: str = "uniform", hills: bool = False, spacing: float = 0.7, along: float = 0.0, **options: Any
) -> dict[str, Any]:
    """What forms a few pixels, from noise."""
    c = collection(**{"n_pulse": 41, "n_frequency": 48, "reference": "tracked", **options})
    x, y = around(c, along, 0.0)
    columns, rows = float(x) + spacing * np.arange(5), float(y) + spacing * np.arange(3)
    terrain = None
    if hills:
        heights = 9 * np.sin(np.arange(12))[:, None] * np.cos(np.arange(12))
        terrain = Terrain(x0=columns[0] - 10, dx=2.0, y0=rows[0] - 10, dy=2.0, heights=heights)
    samples = noise((c.n_pulse, c.n_range_frequency))
    samples[20:22], samples[30, 5:9] = np.nan, np.nan
    return {
        "read": lambda pulses: samples[pulses],
        "geometry": Geometry(collection=c, terrain=terrain),
        "x": columns,
        "y": rows,
        "weighting": Weighting.parse(weighting),
    }


@on_gpu
@pytest.mark.parametrize("name", SCENES)
def test_exact_back_projection(name: str) -> None:
    made = scene(**SCENES[name])
    made["x"], made["y"] = np.meshgrid(made["x"], made["y"])
    fine = type("Fine", (type(CPU),), {"upsampling": device("gpu").upsampling})()
    exact = form_points(**made, threads=1, device=fine, pulse_block=41)
    found = form_points(**made, threads=1, device=device("gpu"), pulse_block=24)
    assert apart(found, exact) < -85


@on_gpu
@pytest.mark.parametrize("name", ["on hills, weighted"])
def test_hierarchical_back_projection(name: str) -> None:
    made = scene(**SCENES[name])
    x: FloatArray = made["x"]
    windows = [(slice(0, 3), slice(0, 3)), (slice(0, 3), slice(3, x.size))]
    levels = Levels(sides=(3.0, 2.0), attenuation=60.0, edge=0.38, upsampling=4)
    images = []
    for each in (CPU, device("gpu")):
        image = np.empty((3, x.size), np.complex64)
        for window, part in form_windows(windows=windows, levels=levels, threads=1, device=each, **made):
            image[window] = part
        images.append(image)
    assert apart(images[1], images[0]) < -85
