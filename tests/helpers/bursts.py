"""Bursts that are flown one after another over Table 1's ground, each as a collection of its own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

import blocksar

DURATION, DWELL, RATE = 0.2, 0.05, 26.23  # s, s; degrees/s, Table 1's
STEP = 3.6  # degrees of yaw between the middles of two scans, on the ground
CENTRE, SLANT = 50.0, 30000.0
SCENE = """
title = "burst {number}"
[radar]
carrier = 15e9
bandwidth = 25e6
range_sampling = 30e6
prf = 8e3
[track]
position = {position}
velocity = {velocity}
acceleration = [-15.0, -30.0, -35.0]
[time]
duration = {duration}
[beam]
start_deg = {start}
stop_deg = {stop}
width_deg = {beam}
[scene]
swath = {swath}
centre_yaw_deg = {centre}
frame = "{frame}"
{more}
"""


def nadir_at(time: float) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity of the platform when a burst's own t = 0 comes, m and m/s."""
    v, a = np.array([-40.0, 1300.0, -600.0]), np.array([-15.0, -30.0, -35.0])
    return np.array([0.0, 0.0, 16500.0]) + v * time + a * time**2 / 2, v + a * time


def ground(slant: float, yaw_deg: float) -> tuple[float, float]:
    """Ground point by range and yaw at the middle burst's t = 0, m."""
    distance = np.sqrt(slant**2 - 16500.0**2)
    return float(distance * np.cos(np.radians(yaw_deg))), float(distance * np.sin(np.radians(yaw_deg)))


def write_bursts(
    folder: Path,
    targets: list[tuple[float, float]],
    *,
    more: str = "",
    frame: str = "strip",
    duration: float = DURATION,
    step: float = STEP,
    half_swath: float = 150.0,
    count: int = 3,
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
    heights: Mapping[str, float] | None = None,
) -> list[Path]:
    """Simulate bursts, whose scans meet on the ground with an overlap of more than a dwell."""
    over = {} if heights is None else heights  # of targets by name, m; others lie on the ground
    names = [f"P{i}" for i in range(len(targets))]
    points = "\n".join(
        f'[[targets]]\nname = "{name}"\nx = {x!r}\ny = {y!r}' + (f"\nz = {over[name]!r}" if name in over else "")
        for name, (x, y) in zip(names, targets, strict=True)
    )
    stores = []
    for number in range(count):
        position, velocity = nadir_at((number - 1) * duration)
        position = position + offset
        x, y = ground(SLANT, CENTRE + (number - 1) * step)
        yaw = float(np.degrees(np.arctan2(y - position[1], x - position[0])))
        slant = float(np.linalg.norm([x - position[0], y - position[1], position[2]]))
        text = SCENE.format(
            number=number, position=position.tolist(), velocity=velocity.tolist(), duration=duration,
            start=yaw - RATE * duration / 2, stop=yaw + RATE * duration / 2, beam=RATE * DWELL,
            swath=[slant - half_swath, slant + half_swath], centre=yaw, frame=frame, more=f"{points}\n{more}",
        )  # fmt: skip
        (folder / f"burst{number}.toml").write_text(text)
        stores.append(Path(blocksar.simulate(folder / f"burst{number}.toml", folder / f"burst{number}.zarr")))
    return stores
