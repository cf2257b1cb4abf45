"""Small collections drawn at random, over platforms, modes of the beam and tracks, and what their images are like.

A draw begins with what decides the size of a collection: the pulses of a dwell, those beyond it, and by how much the
PRF exceeds the Doppler band that is lit at a time. Width and pace of the beam follow from these, so that an image has
some hundred cells of resolution along a side, from a drone as from a satellite.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

import blocksar
from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.measurement.coherence import coherence, power_within_reach, referred
from blocksar.processors.base import ImagePlan
from blocksar.processors.exact.sums import form_image
from blocksar.simulation.scatterers import simulate_pulses

CHIP = 40  # pixels along a side
SHOWN = 0.3  # of the pixels of a chip, and of a grid, that have full dwell, at least
CELL = 0.7  # of a cell of resolution: the spacing of pixels
DENSITY, MOST_SCATTERERS = 0.1, 10_000  # of clutter: in a cell of resolution, and in all
OVER = 1.2, 4.0  # PRF over the Doppler band that is lit at a time
DWELL, BEYOND_DWELL = (150, 300), (140, 260)  # pulses, times the root of that
WAVES = 1.0, 12.0  # of a track that wobbles, along the collection
MARGIN = 1.15  # of the ground with full dwell that the grid shows, and some where dwells are cut
BEYOND = 1.5  # of the grid's side, that clutter fills: the grid lies askew to the track
EARTH = 6371e3  # m, its radius
MOST_DRAWS = 30  # for one seed


class Platform(NamedTuple):
    """Limits between which a platform is drawn."""

    height: tuple[float, float]  # m
    speed: tuple[float, float]  # m/s
    away: tuple[float, float]  # slant range over height
    carrier: tuple[float, float]  # Hz
    band: float  # Hz, the widest
    squint: float  # rad, the largest
    acceleration: float  # m/s^2, the largest along an axis,
    turn: float  # and as a change of the velocity, of the speed
    wobble: float  # wavelengths, the largest of a wave
    aperture: tuple[float, float]  # rad, of a beam that stays


PLATFORMS = {
    "drone": Platform((60, 400), (8, 30), (1.5, 5), (5e9, 35e9), 1.2e9, 0.8, 1.0, 0.08, 0.5, (0.02, 0.12)),
    "aircraft": Platform((1e3, 1e4), (70, 250), (1.3, 4), (3e9, 18e9), 500e6, 0.9, 4.0, 0.1, 0.5, (0.01, 0.1)),
    "maneuvering": Platform(
        (8e3, 25e3), (400, 1500), (1.2, 2.5), (8e9, 18e9), 3e8, 0.9, 40.0, 0.15, 0.5, (0.01, 0.06)
    ),
    "satellite": Platform(
        (4.5e5, 7.5e5), (7400, 7700), (1.1, 1.7), (1.2e9, 1e10), 3e8, 0.05, 0.02, 1e-3, 0.0, (2e-3, 0.01)
    ),
}  # fmt: skip
MODES = ("stripmap", "yaw scan", "sliding", "unsteered", "tops")


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawn:
    """A collection, the grid to image, and clutter (x, y in m, and reflectivity)."""

    title: str
    collection: Collection
    grid: Grid
    clutter: tuple[FloatArray, FloatArray, ComplexArray]


class Figures(NamedTuple):
    """Predicted coherence, and the least measured one of chips, as `quality --reference` judges them.

    NaN where there is no chip: everywhere, and where the collection cuts some dwells.
    """

    processor: str
    faithful: bool
    predicted: float
    least: float
    ends: float
    missing: int  # pixels that the exact image has and this one lacks


def platform_of(seed: int) -> str:
    """Name the platform of a seed."""
    return list(PLATFORMS)[seed % len(PLATFORMS)]


def draw(seed: int) -> Drawn:
    """Draw the collection of a seed, of which the grid shows enough ground with full dwell."""
    rng = np.random.default_rng([1977, seed])
    platform, mode = platform_of(seed), MODES[seed // len(PLATFORMS) % len(MODES)]
    for _ in range(MOST_DRAWS):
        drawn = _draw(rng, platform, mode)
        beam = Geometry(collection=drawn.collection).beam
        if beam.has_full_dwell(*np.meshgrid(drawn.grid.x[::8], drawn.grid.y[::8])).mean() > SHOWN:
            return drawn
    raise AssertionError(f"{platform}, {mode}: none of {MOST_DRAWS} draws shows enough of full dwell")


def judge(drawn: Drawn, folder: Path) -> Figures:
    """Focus a drawn collection, and compare with exact back-projection of the same samples.

    By the main chain where that keeps the fidelity, which `auto` hardly takes of so small images; else under `auto`.
    """
    x, y, sigma = drawn.clutter
    c = drawn.collection
    signal = simulate_pulses(c, x, y, sigma, threads=2)
    beam = {"beam_azimuth": c.beam_azimuth, "beam_axis": c.beam_axis, "beam_steering": c.beam_steering}
    history = blocksar.collection(
        signal=signal, time=c.time, range_frequency=c.range_frequency, antenna_position=c.antenna_position,
        reference_range=c.reference_range, carrier_frequency=c.carrier, beam_width=c.beam_width,
        **{name: values for name, values in beam.items() if values is not None and np.isfinite(values).all()},
    )  # fmt: skip
    grid = ((drawn.grid.x0, drawn.grid.x1, drawn.grid.dx), (drawn.grid.y0, drawn.grid.y1, drawn.grid.dy))
    plan = blocksar.plan(history, grid=grid, workers=1).plan
    with suppress(blocksar.InputError):
        report = blocksar.plan(history, grid=grid, workers=1, processor="angular-division")
        plan = report.plan if report.refusal is None and report.plan.faithful else plan
    blocksar.focus(
        history, folder / "run", grid=grid, workers=0, threads=2, progress=False, pyramid=False,
        processor=plan.processor,
    )  # fmt: skip
    image = blocksar.open(folder / "run").image
    geometry = Geometry(collection=c)
    exact = form_image(lambda pulses: signal[pulses], geometry, image.x.values, image.y.values, threads=2)
    return compare(image.values, exact, geometry, image.x.values, image.y.values, plan)


def compare(
    image: ComplexArray, exact: ComplexArray, geometry: Geometry, x: FloatArray, y: FloatArray, plan: ImagePlan
) -> Figures:
    """Chips of an image (n_y, n_x) beside those of the exact one, where targets have full dwell."""
    full = geometry.beam.has_full_dwell(*np.meshgrid(x, y))
    chips, ends = [float("nan")], [float("nan")]
    for rows in _cuts(y.size):
        for columns in _cuts(x.size):
            chip = rows, columns
            shown = full[chip] & np.isfinite(exact[chip])
            if shown.mean() < SHOWN:
                continue
            # A pixel that should be there and is not counts as zero.
            filled = np.where(np.isfinite(image[chip]), image[chip], 0)
            found_here = coherence(np.where(shown, filled, np.nan), exact[chip])
            reach = power_within_reach(np.abs(exact) ** 2, rows, columns)
            chips.append(referred(abs(found_here.coherence), reach / found_here.power))
            if not full[chip].all():
                ends.append(chips[-1])
    missing = np.count_nonzero(full & np.isfinite(exact) & ~np.isfinite(image))
    return Figures(
        plan.processor, plan.faithful, plan.coherence, np.nanmin(chips), float(np.fmin.reduce(ends)), missing
    )


def _cuts(n: int) -> list[slice]:
    """A side of n pixels in chips."""
    return [slice(i, i + CHIP) for i in range(0, n - CHIP + 1, CHIP)]


class _Beam(NamedTuple):
    """What a mode makes of a draw."""

    n_pulse: int
    prf: float
    width: float | None  # rad
    pace: float  # rad/s: of steering, or of yaw
    resolution: float  # m, along the track
    extent: float  # m, with full dwell, along the track
    spill: float  # m, by which what is lit goes beyond that; below 0 where more would fold


def _draw(rng: np.random.Generator, platform: str, mode: str) -> Drawn:
    p = PLATFORMS[platform]

    def between(ends: tuple[float, float]) -> float:
        return float(np.exp(rng.uniform(*np.log(ends))))

    height, speed, carrier = between(p.height), between(p.speed), between(p.carrier)
    distance, wavelength = height * between(p.away), SPEED_OF_LIGHT / carrier
    ground = np.sqrt(1 - (height / distance) ** 2)  # of the range
    squint = float(np.clip(rng.uniform(-p.squint, p.squint), -np.arcsin(0.8 * ground), np.arcsin(0.8 * ground)))
    beam = _plan_beam(
        rng, p, mode, speed, distance, wavelength, squint, float(np.sqrt(ground**2 - np.sin(squint) ** 2))
    )
    time = (np.arange(beam.n_pulse) - beam.n_pulse // 2) / beam.prf

    # The track, along y before the frame is turned.
    duration = beam.n_pulse / beam.prf
    climb = 0.0 if platform == "satellite" else rng.uniform(-0.1, 0.1)
    velocity = speed * np.array([0.0, np.cos(climb), np.sin(climb)])
    bound = min(p.acceleration, p.turn * speed / duration)
    acceleration, jerk = rng.uniform(-bound, bound, 3), rng.uniform(-bound, bound, 3) / duration
    if platform == "satellite":
        acceleration[2] -= speed**2 / (EARTH + height)
    smooth = np.outer(time, velocity) + np.outer(time**2 / 2, acceleration) + np.outer(time**3 / 6, jerk)
    smooth[:, 2] += height
    wobbles = p.wobble > 0 and rng.random() < 0.6
    pace, size = 2 * np.pi * rng.uniform(*WAVES, 3) / duration, p.wobble * wavelength * rng.uniform(0.1, 1.0, 3)
    waves = size * np.sin(np.outer(time, pace) + rng.uniform(0, 2 * np.pi, 3))
    track = smooth + waves * wobbles
    side = rng.choice([-1.0, 1.0])
    ahead = (distance * np.sin(squint) + np.sin(climb) * height) / np.cos(climb)
    centre = np.array([side * np.sqrt(max((distance * ground) ** 2 - ahead**2, 1.0)), ahead, 0.0])

    # The band, and as many samples of it as hold the ranges of the grid, whose sides are parallel to the track's frame.
    cell = beam.resolution * float(rng.uniform(0.7, 1.4)) * ground
    band = min(SPEED_OF_LIGHT / (2 * cell), p.band, 0.1 * carrier)
    across = SPEED_OF_LIGHT / (2 * band) / ground  # m of ground
    size = MARGIN * beam.extent
    step = CELL * min(beam.resolution, across)
    window = (1.1 * BEYOND * size + 40 * across) * ground
    n_frequency = int(np.ceil(window * 2 * band / SPEED_OF_LIGHT))

    # The frame.
    angle = rng.uniform(-np.pi, np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    flown = np.gradient(smooth, time, axis=0) if rng.random() < 0.5 else np.tile(velocity, (time.size, 1))
    axis = flown / np.linalg.norm(flown, axis=1, keepdims=True)
    steering = squint + beam.pace * time
    sides = np.array([BEYOND * size, BEYOND * size + 2 * beam.spill])
    count = min(DENSITY * sides.prod() / (beam.resolution * across), MOST_SCATTERERS)
    points = rng.uniform(-0.5, 0.5, (int(count), 2)) * sides + centre[:2]
    x, y = turn[:2, :2] @ points.T
    place = turn @ centre
    how = {"beam_azimuth": np.full(time.size, np.nan)}
    if mode == "yaw scan":
        how["beam_azimuth"] = np.arctan2(place[1], place[0]) + beam.pace * time
    elif mode != "unsteered":
        how |= {"beam_axis": axis @ turn.T, "beam_steering": steering}
    collection = Collection(
        title=f"{platform}, {mode}",
        carrier=carrier,
        time=time,
        range_frequency=(np.arange(n_frequency) - n_frequency // 2) * band / n_frequency,
        reference_range=np.linalg.norm(centre - (track if rng.random() < 0.7 else smooth), axis=1),
        antenna_position=track @ turn.T,
        beam_width=beam.width,
        **how,
    ).centred()
    return Drawn(
        title=f"{platform}, {mode}{', wobble' if wobbles else ''}, squint {np.degrees(squint):.0f}",
        collection=collection,
        grid=Grid(place[0] - size / 2, place[0] + size / 2, step, place[1] - size / 2, place[1] + size / 2, step),
        clutter=(x, y, rng.standard_normal(x.size) + 1j * rng.standard_normal(x.size)),
    )  # fmt: skip


def _plan_beam(
    rng: np.random.Generator, p: Platform, mode: str, speed: float, distance: float, wavelength: float, squint: float,
    side: float,
) -> _Beam:  # fmt: skip
    """`side` is the part of the line of sight that is level and across the track."""
    over = float(np.exp(rng.uniform(*np.log(OVER))))
    n_dwell, more = (int(rng.uniform(*ends) * np.sqrt(over)) for ends in (DWELL, BEYOND_DWELL))
    passing = speed * np.cos(squint) / distance  # rad/s, of the line of sight
    if mode == "unsteered":
        n_pulse = n_dwell + more
        aperture = float(np.exp(rng.uniform(*np.log(p.aperture))))
        resolution = wavelength / (2 * aperture) / np.cos(squint)
        extent = n_pulse / over * wavelength / (2 * aperture) / np.cos(squint) / 2
        # Nothing limits what an unsteered antenna lights: clutter that folds onto the grid is none of the image's.
        spill = min(0.1, (over - BEYOND * MARGIN) / 2)
        return _Beam(n_pulse, n_pulse * passing / aperture, None, 0.0, resolution, extent, spill * extent)
    if mode == "yaw scan":
        # A dwell lasts until the line of sight has turned by an aperture.
        width = float(np.exp(rng.uniform(np.log(0.005), np.log(0.1))))
        width = max(width, n_dwell * wavelength / (2 * over * side * 0.06 * distance))
        prf = over * 2 * speed * side * width / wavelength
        pace = float(rng.choice([-1.0, 1.0])) * width * prf / n_dwell
        resolution = wavelength * distance / (2 * speed * side * n_dwell / prf)
        extent = distance * width * more / n_dwell
        return _Beam(n_dwell + more, prf, width, pace, resolution, extent, distance * width)
    relative = {"stripmap": 0.0, "sliding": -rng.uniform(0.3, 0.7), "tops": rng.uniform(0.5, 2.0)}[mode]
    width = float(np.sqrt(n_dwell * wavelength * (1 + relative) / (2 * over * distance)))
    prf = over * 2 * speed * np.cos(squint) * width / wavelength
    resolution = wavelength / (2 * passing * n_dwell / prf) / np.cos(squint)
    footprint = distance * width / np.cos(squint)
    extent = footprint * more / n_dwell
    return _Beam(n_dwell + more, float(prf), width, float(relative * passing), resolution, extent, footprint)
