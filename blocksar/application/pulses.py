"""Pulses as they are imaged: raw echoes are compressed in range, with or without partly recorded pulses."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from blocksar import stores
from blocksar.application.arguments import Source, history_of, on_ground, sources_of
from blocksar.arrays import ComplexArray, FloatArray
from blocksar.chunks import TILE
from blocksar.collection.collection import Collection
from blocksar.collection.empty_pulses import missing_pulses
from blocksar.collection.geometry import Geometry, over_terrain
from blocksar.collection.grid import Grid
from blocksar.collection.sublooks import whole_beam
from blocksar.collection.terrain import Terrain
from blocksar.imaging.compression import RawCompression
from blocksar.imaging.recorded_pulses import ROUNDING, recorded_means


def pulse_reader(history: stores.PhaseHistory) -> Callable[[slice], ComplexArray]:
    """Return a function that reads a slice of pulses, (pulses, range frequencies); a raw echo is compressed."""
    if history.raw is None:
        return lambda pulses: history.read(pulses, slice(None))
    compression = RawCompression.of_echo(history.raw, history.collection)
    return lambda pulses: compression.apply(history.read(pulses, slice(None)), pulses=pulses)


def lit_pulse_reader(history: stores.PhaseHistory) -> Callable[[slice], ComplexArray]:
    """Return a reader, as runs have it, with NaN in lost pulses that hold zeros (`collection.empty_pulses`)."""
    read = pulse_reader(history)
    first = history.read(slice(None), slice(0, 1))[:, 0]
    with np.errstate(invalid="ignore"):  # garbage may have signalling NaN
        empty = first == 0
    known = ~np.isnan(first)
    for start in range(0, empty.size, TILE[0]):
        part = slice(start, min(start + TILE[0], empty.size))
        if empty[part].any():
            empty[part] &= ~history.read(part, slice(None)).any(axis=1)
        if history.raw is not None and not known[part].all():  # of an echo it may be a gap
            known[part] = np.isfinite(history.read(part, slice(None))).any(axis=1)
    beam = whole_beam(history.collection, history.look)
    lost = missing_pulses(empty, known, beam, lambda pulse: read(slice(pulse, pulse + 1))[0])

    def read_lit(pulses: slice) -> ComplexArray:
        signal = read(pulses)
        signal[lost[pulses]] = np.nan
        return signal

    return read_lit if lost.any() else read


# ---------------------------------------------------------------- pulses of which parts were recorded

WHOLE, PARTS = "whole", "parts"
LOOKED_AT = 64  # points along a side of a grid whose recorded pulses are examined


def imaging_parts(
    histories: Sequence[stores.PhaseHistory],
    grid: Grid | None,
    terrain: Terrain | None = None,
    *,
    whole_pulses: bool = False,
) -> tuple[stores.PhaseHistory, ...]:
    """Return phase histories as imaged on a grid: raw echoes with partial pulses where the grid reaches into these.

    Not without a grid, nor where only whole pulses are wanted. Elsewhere whole pulses do with a shorter transform.
    """
    if whole_pulses or grid is None:
        return tuple(histories)
    extended = tuple(history.with_partial_pulses() for history in histories)
    seen = any(_has_parts(history.collection, grid, terrain) for history in extended)
    return extended if seen else tuple(histories)


def imaged_collections(
    source: Source,
    collections: list[Collection],
    grid: Grid | None,
    terrain: Terrain | None,
    *,
    ground_height: float | None,
    whole_pulses: bool,
) -> list[Collection]:
    """Return the centred collections of a source as `imaging_parts` has them; those of scenes unchanged."""
    if all(collection.recorded is None for collection in collections):
        return collections
    histories = on_ground([history_of(each) for each in sources_of(source)], ground_height, terrain=terrain)
    imaged = imaging_parts(histories, grid, terrain, whole_pulses=whole_pulses)
    return [history.collection.centred() for history in imaged]


def pulses_of(histories: Sequence[stores.PhaseHistory]) -> str | None:
    """Name the pulses that are imaged, for the settings of a run: WHOLE, or PARTS as well; None without a raw echo."""
    recorded = [each for history in histories if (each := history.collection.recorded) is not None]
    return None if not recorded else PARTS if any(each.partial for each in recorded) else WHOLE


def _has_parts(collection: Collection, grid: Grid, terrain: Terrain | None) -> bool:
    if collection.recorded is None:
        return False
    share = _shares(over_terrain(collection, terrain), grid)
    return bool((share < 1 - ROUNDING).any())


def _shares(geometry: Geometry, grid: Grid) -> FloatArray:
    """Mean recorded share of the pulse at lit points spread over a grid, edges included: (n,), NaN where not imaged."""
    axes = (axis[np.unique(np.linspace(0, axis.size - 1, LOOKED_AT).round().astype(int))] for axis in (grid.x, grid.y))
    x, y = np.meshgrid(*axes)
    first, last = geometry.beam.dwell(x, y)
    return recorded_means(geometry, x, y).amplitude[last > first]


def recorded_text(geometry: Geometry) -> str | None:
    """Describe the ranges whose pulses a raw echo holds whole, and those with parts: slant and ground range, m."""
    recorded = geometry.collection.recorded
    if recorded is None:
        return None
    first, last = recorded.whole
    parts = f"parts of pulses from {recorded.pulse:.5g} m farther on either side"
    if first >= last:
        return f"from no range: the window of {recorded.far - recorded.near:.5g} m is shorter than the pulse; {parts}"
    height = float(geometry.epoch_position[2] - geometry.collection.ground_height)
    near, far = (math.sqrt(max(end**2 - height**2, 0.0)) for end in (first, last))
    whole = f"{last - first:.5g} m of slant range ({first:.7g} .. {last:.7g} m), {far - near:.5g} m on the ground"
    return f"from {whole}; {parts}"


def recorded_lines(geometries: Sequence[Geometry], grid: Grid, *, swath: bool = True) -> list[str]:
    """Describe the swath of whole pulses of raw echoes, and how much of a grid lies outside; none without these."""
    geometries = [geometry for geometry in geometries if geometry.collection.recorded is not None]
    lines = [f"whole pulses {recorded_text(geometry)}" for geometry in geometries] if swath else []
    shares = np.concatenate([_shares(geometry, grid) for geometry in geometries] or [np.ones(0)])
    parts = shares[shares < 1 - ROUNDING]
    if not parts.size:
        return lines
    least = float(parts.min())
    return [
        *lines,
        f"{100 * parts.size / shares.size:.2g} % of the grid's lit pixels have parts of pulses, {least:.2g} at least, "
        "and are divided by the part: targets peak at 1, but are broader in range by its inverse, and clutter and "
        f"noise rise with that by up to {-10 * math.log10(least):.2g} dB; --whole-pulses leaves them NaN",
    ]
