"""check: compare the samples of a phase history with its metadata."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from blocksar import stores
from blocksar.application.arguments import history_of, on_ground
from blocksar.application.ground import read_ground
from blocksar.application.parsing import GridLike, grid_of
from blocksar.application.pulses import imaging_parts, pulse_reader
from blocksar.application.reports import CHECK_COLUMNS, Report, Table
from blocksar.arrays import ComplexArray
from blocksar.chunks import TILE
from blocksar.collection.empty_pulses import find_real
from blocksar.collection.geometry import over_terrain
from blocksar.collection.grid import Grid
from blocksar.collection.region import grid_extent, plan_region
from blocksar.collection.sampling import refuse_departures
from blocksar.collection.surface import Surface
from blocksar.collection.terrain import Terrain
from blocksar.errors import InputError
from blocksar.graph.machine import resources
from blocksar.inspection import check as samples_check
from blocksar.inspection.verdict import Findings
from blocksar.places import Location
from blocksar.readers.heights import Ground

if TYPE_CHECKING:
    import xarray as xr


def check(
    source: Location | xr.Dataset,
    *,
    grid: GridLike | None = None,
    terrain: Location | None = None,
    surface: Surface | None = None,
    vertical: str | None = None,
    ground_height: float | None = None,
    threads: int | None = None,
) -> Report:
    """Compare the contrast of echoes under the given metadata with that under one changed assumption at a time.

    Tried are a conjugated signal, a reversed range axis, pulses or track in the opposite order, axes of the scene that
    are swapped or have the other sign, of a raw echo the other sign of the chirp and delays that count from its start,
    a beam that is reversed, negated, in degrees, off by an angle or by whole PRFs or narrower than it is said to be,
    and errors of the track. Reads a part of the samples and writes nothing.

    Parameters
    ----------
    source : path or xarray.Dataset
        Phase-history store, or a dataset of its contract.
    grid : Grid, ((x0, x1, dx), (y0, y1, dy)) or str, optional
        Ground to look at, m in the scene frame; as a text "x0:x1:dx,y0:y1:dy". Default: what the beam lights.
        Needed if the beam is not steered.
    terrain : path, optional
        Heights of the ground, as in `focus`. Mountains that are taken for the plane look like an error of the track.
        Default: the plane z = ground_height.
    surface : {"plane", "ellipsoid"}, optional
        The ground without a terrain, as in `focus`. Default: that of the phase history, or "plane".
    vertical : str, optional
        What the terrain's heights are measured from, as in `focus`. Needed where the file does not say so.
    ground_height : float, optional
        Height z of the imaged plane in the scene frame, m. Ground that lies off it is displaced, at 30 m by up to as
        much. Default: that of the phase history.
    threads : int, optional
        Default: the number of cores.

    Returns
    -------
    Report
        `tables` has one row for everything that was tried but for errors of the beam that were not found; `result` is
        a dict of its figures and of the warning, which is None if nothing seems wrong. In it `tested` says whether the
        echoes tell anything, `beam_places` is the number of points that judged the beam, and `beam_tried` the largest
        error of its angle that was tried, rad; None if they are too few. Each trial has the number of its echoes, their
        mean gain of contrast against as given (dB), that over its standard deviation, and the verdict.

    Raises
    ------
    InputError
        If the source is no phase history, its samples are real, a grid is missing or lies outside the swath, or the
        terrain cannot be taken.
    """
    ground = Ground(terrain=terrain, surface=surface, vertical=vertical)
    count = resources(1, threads, None).threads
    points = grid_of(grid)
    (history,) = imaging_parts(on_ground([history_of(source)], ground_height, terrain=terrain), points)
    collection, ground = history.collection.centred(), ground.under(history.attrs)
    refuse_real(history)
    heights = read_ground(ground, collection, points, source)
    findings = check_samples(history, points, threads=count, thorough=True, terrain=heights)
    if points is not None and findings.warning() is None:
        geometry = over_terrain(collection, heights)
        grid_extent(geometry, plan_region(geometry, points), points)  # refuses a grid outside the swath
    pointing = findings.pointing
    result = {
        "warning": findings.warning(),
        "tested": findings.speaks,
        "sharpness": findings.sharpness if findings.speaks else None,
        "track_phase": findings.track_phase,
        "beam_places": pointing.places if pointing else 0,
        "beam_tried": pointing.reach if pointing and pointing.told else None,
        "trials": [
            {
                "name": trial.name,
                "echoes": trial.echoes,
                "gain": trial.gain,
                "deviations": trial.deviations,
                "verdict": trial.verdict,
            }
            for trial in findings.trials[1:]
        ],
    }
    return Report(
        tables=[_table(findings)],
        definitions=CHECK_COLUMNS,
        summary=[*(heights.remarks if heights is not None else ()), findings.sentence()],
        result=result,
    )


def refuse_real(history: stores.PhaseHistory) -> None:
    """Refuse real samples; reads only up to the first chunk that shows whether they are complex.

    Raises
    ------
    InputError
        If they are real.
    """
    sides = zip(history.shape, TILE, strict=True)
    spans = ([slice(first, min(first + step, n)) for first in range(0, n, step)] for n, step in sides)
    parts = ((region, history.read(*region)) for region in product(*spans))
    if (reason := find_real(history.variable, history.collection, parts)) is not None:
        raise InputError(f"{history.label}: {reason}")


def check_samples(
    history: stores.PhaseHistory, grid: Grid | None, *, threads: int, thorough: bool, terrain: Terrain | None = None
) -> Findings:
    """Check samples from the middle of the band of a phase history against its metadata.

    Raises
    ------
    InputError
        If the collection is bistatic, or as `inspection.check.check`.
    """
    collection = history.collection.centred()
    refuse_departures("check", collection.two_antennas, "focus it, and look at known points")
    pulses, columns = samples_check.part_to_read(collection)
    signal = history.read(pulses, columns) if history.raw is None else _compressed(history, pulses, columns)
    part = samples_check.part_of(collection, pulses, columns)
    return samples_check.check(
        signal, part, grid=grid, threads=threads, thorough=thorough, terrain=terrain, raw=history.raw
    )


def _compressed(history: stores.PhaseHistory, pulses: slice, columns: slice) -> ComplexArray:
    """Compress a raw echo, a few pulses at a time, and return some of its range frequencies."""
    read = pulse_reader(history)
    signal = np.empty((pulses.stop - pulses.start, columns.stop - columns.start), np.complex64)
    for first in range(pulses.start, pulses.stop, TILE[0]):
        part = slice(first, min(first + TILE[0], pulses.stop))
        signal[part.start - pulses.start : part.stop - pulses.start] = read(part)[:, columns]
    return signal


def _table(findings: Findings) -> Table:
    header = ("if", "echoes", "contrast against as given (dB)", "standard deviations", "verdict")
    rows = [
        [trial.name, str(trial.echoes), f"{trial.gain:+.2f}", f"{trial.deviations:+.1f}", trial.verdict]
        for trial in findings.trials[1:]
    ]
    return header, rows
