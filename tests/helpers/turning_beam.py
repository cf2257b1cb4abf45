"""A small collection of a diving, turning platform whose beam turns in yaw, or is not steered."""

from __future__ import annotations

from typing import Any

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry


def collection(
    *,
    bandwidth: float = 60e6,
    n_frequency: int = 384,
    n_pulse: int = 240,
    duration: float = 0.6,
    middle: float = 0.0,
    yaw: float = np.deg2rad(50.0),
    steering: float = np.deg2rad(26.23),
    steered: bool = True,
    reference: str = "constant",
    carrier: float = 15e9,
    height: float = 16500.0,
    ground: float = 25055.0,
    frequency_offset: float = 0.0,
    ground_height: float = 0.0,
) -> Collection:
    """Table 1's diving, turning platform at a low PRF; the beam lights the scene centre at the aperture's middle."""
    time = middle + duration * (np.arange(n_pulse) - n_pulse // 2) / n_pulse
    position = np.array([0.0, 0.0, height]) + time[:, None] * [-40.0, 1300.0, -600.0]
    position = position + time[:, None] ** 2 / 2 * [-15.0, -30.0, -35.0]
    centre = np.array([ground * np.cos(yaw), ground * np.sin(yaw), ground_height])
    distance = np.linalg.norm(centre - position, axis=1)
    beam = yaw + steering * (time - middle) if steered else np.full(n_pulse, np.nan)
    step = bandwidth / n_frequency
    return Collection(
        carrier=carrier,
        time=time,
        range_frequency=frequency_offset + (np.arange(n_frequency) - n_frequency / 2 + 0.5) * step,
        reference_range=distance if reference == "tracked" else np.full(n_pulse, distance[n_pulse // 2]),
        antenna_position=position,
        beam_azimuth=beam,
        beam_width=abs(steering) * 0.162 if steered else None,
        ground_height=ground_height,
    )


def around(collection: Collection, along: Any, across: Any) -> tuple[FloatArray, FloatArray]:
    """Ground points at offsets (m) from the point at the beam centre or the reference range at the middle pulse."""
    geometry, p = Geometry(collection=collection), collection.n_pulse // 2
    yaw = collection.beam_azimuth[p] if collection.steered else np.deg2rad(50.0)
    x, y = geometry.ground_point(np.array(collection.reference_range[p]), np.array(yaw))[:2]
    along, across = np.asarray(along, np.float64), np.asarray(across, np.float64)
    return x + along * np.cos(yaw) - across * np.sin(yaw), y + along * np.sin(yaw) + across * np.cos(yaw)
