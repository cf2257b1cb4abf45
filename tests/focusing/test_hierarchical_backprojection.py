"""Hierarchical back-projection against the exact one, on noise: samples that hold echoes of everything."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from axis_beams import axis_collection, spotlight, with_patterns
from slow_twins import back_projection
from test_backprojection import around, collection

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.terrain import Terrain
from blocksar.collection.weighting import Weighting
from blocksar.focusing.backprojection import form_image
from blocksar.focusing.hierarchical_backprojection import form_part
from blocksar.focusing.hierarchy import Levels

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
         weighting: str = "uniform", threads: int = 1) -> tuple[ComplexArray, ComplexArray]:  # fmt: skip
    samples, geometry = noise(c), Geometry(collection=c, terrain=terrain)
    options: dict[str, Any] = {"threads": threads, "weighting": Weighting.parse(weighting)}

    def read(pulses: slice) -> ComplexArray:
        return samples[pulses]

    return form_part(read, geometry, x, y, levels=levels, **options), form_image(read, geometry, x, y, **options)
