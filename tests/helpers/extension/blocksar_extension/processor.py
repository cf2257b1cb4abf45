"""Polar format: a spotlight's image by plane waves about the centre of each chunk (Jakowatz et al., 1996, chapter 3).

About a centre the range of a place r is R0 - u . r, u the horizontal part of the unit vector towards the antenna. So a
sample of frequency f is one of the ground's spectrum, at K = 2 f / c u. The polar raster of samples is resampled to a
Cartesian one, whose Fourier transform is the image, read at the r' that fits R0 - u . r' to the ranges of r best.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import numpy as np

from blocksar.collection.collection import Collection
from blocksar.collection.grid import outline
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError, Unfocusable
from blocksar.options import Option
from blocksar.planning.memory import PROCESS_MEMORY, checked_memory
from blocksar.planning.tiling import chunks_of
from blocksar.processors.base import ChunkPlan, Problem

NODES = 8  # pulses at which ranges are fitted
PER_POINT = 400, 2e-6  # bytes and s at most, of a sample or pixel: transforms, and splines in double precision


def read_order(value: Any) -> int:
    if str(value) not in ("3", "4", "5"):
        raise InputError(f"order = {value!r}: give 3, 4 or 5")
    return int(value)


@dataclass(frozen=True, kw_only=True)
class PolarOptions:
    order: Annotated[int, Option("Order of the splines that resample, 3 to 5.", metavar="N", read=read_order)] = 5


def waves(collection: Collection, x: Any, y: Any) -> tuple[Any, ...]:
    """R0 (n_pulse,), m; u (n_pulse, 2), its first axis that of the middle pulse; 2 f / c and Cartesian axes, 1/m."""
    sight = collection.antenna_position - (x.mean(), y.mean(), collection.ground_height)
    distance = np.linalg.norm(sight, axis=1)
    u = sight[:, :2] / distance[:, None]
    c, s = u[len(u) // 2] / np.linalg.norm(u[len(u) // 2])
    u = np.stack([c * u[:, 0] + s * u[:, 1], c * u[:, 1] - s * u[:, 0]], axis=1)
    k = 2 * (collection.carrier + collection.range_frequency) / SPEED_OF_LIGHT
    least, ends = u[:, 0].min(), np.multiply.outer(k[[0, -1]], u)
    steps = (k[1] - k[0]) * least, k[0] * least * np.ptp(u[:, 1] / u[:, 0]) / (len(u) - 1)  # as samples lie
    spans = zip(ends.min(axis=(0, 1)), ends.max(axis=(0, 1)), steps, strict=True)
    return distance, u, k, *(a + step * np.arange(np.ceil((b - a) / step) + 1) for a, b, step in spans)


def apparent(collection: Collection, distance: Any, u: Any, x: Any, y: Any) -> tuple[Any, Any, Any]:
    """r' (2, n_y, n_x), m; what it leaves of ranges (NODES, n_y, n_x), m; whether these lie in the window."""
    nodes = np.linspace(0, collection.n_pulse - 1, NODES).astype(int)
    antenna = collection.antenna_position[nodes] - (0, 0, collection.ground_height)
    px, py, pz, reference, centre = (
        each[:, None, None] for each in (*antenna.T, collection.reference_range[nodes], distance[nodes])
    )
    ranges = np.sqrt((px - x) ** 2 + (py - y[:, None]) ** 2 + pz**2)
    within = (np.abs(ranges - reference) <= collection.range_window / 2).all(axis=0)
    place = np.einsum("an,nyx->ayx", np.linalg.pinv(u[nodes]), centre - ranges)  # BLAS's sums depend on its threads
    return place, ranges - centre + np.einsum("na,ayx->nyx", u[nodes], place), within


def form_chunk(read: Any, geometry: Any, x: Any, y: Any, *, threads: int, order: int) -> Any:
    """A chunk of the image (n_y, n_x) complex64, from all samples."""
    from scipy.fft import fft2, fftshift, next_fast_len  # slow to load
    from scipy.ndimage import map_coordinates

    collection = geometry.collection
    distance, u, k, first, second = waves(collection, x, y)
    samples = read(slice(0, collection.n_pulse))
    valid = np.isfinite(samples)
    samples = np.where(valid, samples, 0) * np.exp(2j * np.pi * np.outer(distance - collection.reference_range, k))

    # Where points of the Cartesian raster lie among the samples, and how many samples each stands for.
    numbers, tangent = np.arange(len(u)), u[:, 1] / u[:, 0]
    sign = np.sign(tangent[-1] - tangent[0])
    pulse = np.interp(sign * second[:, None] / first, sign * tangent, numbers, left=-1, right=-1)
    frequency = first / np.interp(pulse, numbers, u[:, 0])
    column = (frequency - k[0]) / (k[1] - k[0])
    turn = np.abs(u[:, 0] * np.gradient(u[:, 1]) - u[:, 1] * np.gradient(u[:, 0]))
    weight = 1 / (frequency * np.interp(pulse, numbers, turn))  # 1 / |dK / d(pulse, f)|: each sample counts once
    weight[(pulse < 0) | (column < 0) | (column > k.size - 1)] = 0
    total = weight.sum() * valid.mean()

    # Twice as many points as the spectrum has, about its middle, so that splines follow the image.
    spectrum = np.zeros((next_fast_len(2 * second.size), next_fast_len(2 * first.size)), np.complex64)
    spectrum[: second.size, : first.size] = map_coordinates(samples, (pulse, column), np.complex64, order) * weight
    spectrum = np.roll(spectrum, (-(second.size // 2), -(first.size // 2)), (0, 1))
    image = fftshift(fft2(spectrum, workers=threads))
    (along, across), _, within = apparent(collection, distance, u, x, y)
    sides = zip((across, along), (second, first), image.shape, strict=True)
    at = [place * (axis[1] - axis[0]) * n + n // 2 for place, axis, n in sides]
    wave = np.exp(-2j * np.pi * (first[first.size // 2] * along + second[second.size // 2] * across))
    pixels = map_coordinates(image, at, np.complex64, order) * wave / (total or np.nan)
    return np.where(within, pixels, np.nan).astype(np.complex64)


@dataclass(frozen=True, kw_only=True, eq=False)
class PolarPlan(ChunkPlan):
    order: int

    def seconds(self, geometry: Any, x: Any, y: Any) -> float:
        *_, first, second = waves(geometry.collection, x, y)
        return float(PER_POINT[1] * (first.size * second.size + x.size * y.size))

    def forming(self, weighting: Any) -> Any:
        return partial(form_chunk, order=self.order)

    def notes(self) -> list[str]:
        return [f"curved waves leave a coherence with exact back-projection of at least {self.coherence:.5f}"]


class PolarFormat:
    name = "polar-format"
    summary = "a spotlight by plane waves about each chunk of its image"
    options = PolarOptions
    universal = False
    on_gpu = False
    compared = False

    def check(self, options: PolarOptions) -> None: ...

    def plan(self, problem: Problem) -> PolarPlan:
        grid, least, needed = problem.points, 1.0, 0
        for piece in problem.pieces:
            collection, lit = piece.geometry.collection, piece.geometry.beam.passes(*outline(problem.points))
            if np.any(lit[0]) or np.any(lit[1] < collection.n_pulse):
                raise Unfocusable("polar-format needs a beam on all of the grid all the time; take a smaller one")
            if problem.terrain or collection.has_pattern or collection.recorded or not problem.weighting.uniform:
                raise Unfocusable("polar-format has no terrain, weighting, antenna pattern or parts of pulses")
            for x, y in chunks_of(grid):
                distance, u, _, first, second = waves(collection, x, y)
                if u[:, 0].min() <= 0 or np.ptp(np.sign(np.diff(u[:, 1] / u[:, 0]))):
                    raise Unfocusable("the line of sight turns back, or by a right angle, before polar-format's grid")
                left = apparent(collection, distance, u, x[[0, -1]], y[[0, -1]])[1]
                seen = np.exp(4j * np.pi / collection.wavelength * left).mean(axis=0)
                least = min(least, float(np.abs(seen).min()))
                needed = max(needed, first.size * second.size + x.size * y.size)
        memory = checked_memory("a chunk", PROCESS_MEMORY + PER_POINT[0] * needed, problem.machine.memory_limit)
        refusal = None if least > 0.9 else "waves are too curved for polar-format; take a smaller grid or step"
        return PolarPlan(
            processor=self.name, grid=grid, pieces=problem.pieces, refusal=refusal, coherence=least,
            order=problem.options.order, needed=memory,
        )  # fmt: skip


POLAR_FORMAT = PolarFormat()
