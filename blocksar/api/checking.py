"""check: whether the samples of a phase history are what is said of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from blocksar import stores
from blocksar.api import definitions
from blocksar.api.arguments import GridLike, grid_of, history_of
from blocksar.api.ground import geometry_over, read_ground
from blocksar.api.partial_pulses import imaging_parts
from blocksar.api.pulses import pulse_reader
from blocksar.api.reports import Report, Table
from blocksar.arrays import ComplexArray
from blocksar.chunks import TILE
from blocksar.collection.grid import Grid
from blocksar.collection.region import grid_extent, plan_region
from blocksar.collection.surface import Surface
from blocksar.collection.terrain import Terrain
from blocksar.graph.machine import resources
from blocksar.ingestion.terrain.reading import Ground
from blocksar.inspection import check as samples_check
from blocksar.inspection.check import Findings
from blocksar.places import Location

if TYPE_CHECKING:
    import xarray as xr


def check(
    source: Location | xr.Dataset,
    *,
    grid: GridLike | None = None,
    terrain: Location | None = None,
    surface: Surface = "plane",
    vertical: str | None = None,
    threads: int | None = None,
) -> Report:
    """Compare the sharpness of prominent places as given with what it would be if something were said wrongly.

    Tried are a conjugated signal, a reversed range axis, pulses or track in the opposite order, x and y swapped, a beam
    that is reversed, negated, offset or narrower than it is said to be, and errors of the track. Reads a part of the
    samples and writes nothing.

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
    surface : {"plane", "ellipsoid"}
        The ground without a terrain, as in `focus`. Default: "plane".
    vertical : str, optional
        What the terrain's heights are measured from, as in `focus`. Needed where the file does not say so.
    threads : int, optional
        Default: the number of cores.

    Returns
    -------
    Report
        `tables` has one row for everything that was tried but for errors of the beam that were not found; `result` is
        a dict of its figures and of the warning, which is None if the samples fit. In it `beam_places` is the number of
        points that judged the beam, and `beam_tried` the largest error of its angle that was tried, rad; None if they
        are too few.

    Raises
    ------
    InputError
        If the source is no phase history, a grid is missing or lies outside the swath, or the terrain cannot be taken.
    """
    ground = Ground(terrain=terrain, surface=surface, vertical=vertical)
    count = resources(1, threads, None).threads
    history, points = history_of(source), grid_of(grid)
    (history,) = imaging_parts([history], points)
    collection = history.collection.centred()
    heights = read_ground(ground, collection, points, source)
    if points is not None:
        geometry = geometry_over(collection, heights)
        grid_extent(geometry, plan_region(geometry, points), points)  # refuses a grid outside the swath
    findings = check_samples(history, points, threads=count, thorough=True, terrain=heights)
    pointing = findings.pointing
    result = {
        "warning": findings.warning(),
        "sharpness": findings.sharpness if findings.speaks else None,
        "track_phase": findings.track_phase,
        "beam_places": pointing.places if pointing else 0,
        "beam_tried": pointing.reach if pointing and pointing.told else None,
        "trials": [
            {"name": trial.name, "places": trial.places, "concentration": trial.sharpness} for trial in findings.trials
        ],
    }
    return Report(
        tables=[_table(findings)], definitions=definitions.CHECK, summary=[findings.sentence()], result=result
    )


def check_samples(
    history: stores.PhaseHistory, grid: Grid | None, *, threads: int, thorough: bool, terrain: Terrain | None = None
) -> Findings:
    """Check the samples of a phase history in the middle of its band.

    Raises
    ------
    InputError
        As `inspection.check.check`.
    """
    collection = history.collection.centred()
    pulses, columns = samples_check.part_to_read(collection)
    signal = history.read(pulses, columns) if history.raw is None else _compressed(history, pulses, columns)
    part = samples_check.part_of(collection, pulses, columns)
    return samples_check.check(signal, part, grid=grid, threads=threads, thorough=thorough, terrain=terrain)


def _compressed(history: stores.PhaseHistory, pulses: slice, columns: slice) -> ComplexArray:
    """Some range frequencies of a raw echo, which is compressed a few pulses at a time."""
    read = pulse_reader(history)
    signal = np.empty((pulses.stop - pulses.start, columns.stop - columns.start), np.complex64)
    for first in range(pulses.start, pulses.stop, TILE[0]):
        part = slice(first, min(first + TILE[0], pulses.stop))
        signal[part.start - pulses.start : part.stop - pulses.start] = read(part)[:, columns]
    return signal


def _table(findings: Findings) -> Table:
    header = ("if", "prominent places", "concentration over the dwell", "against as given (dB)")
    rows = []
    for trial in findings.trials:
        known = findings.given.sharpness and trial.sharpness
        gain = f"{10 * np.log10(trial.sharpness / findings.given.sharpness):+.1f}" if known else "-"
        rows.append([trial.name, str(trial.places), f"{trial.sharpness:.3f}", gain])
    return header, rows
