"""check: compare the samples of a phase history with its metadata."""

from __future__ import annotations

from typing import TYPE_CHECKING

from blocksar.application.arguments import history_of, on_ground
from blocksar.application.checks import check_samples, refuse_real
from blocksar.application.ground import read_ground
from blocksar.application.parsing import GridLike, grid_of
from blocksar.application.pulses import imaging_parts
from blocksar.application.reports import CHECK_COLUMNS, Report, Table
from blocksar.collection.geometry import over_terrain
from blocksar.collection.region import grid_extent, plan_region
from blocksar.collection.surface import Surface
from blocksar.graph.machine import resources
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


def _table(findings: Findings) -> Table:
    header = ("if", "echoes", "contrast against as given (dB)", "standard deviations", "verdict")
    rows = [
        [trial.name, str(trial.echoes), f"{trial.gain:+.2f}", f"{trial.deviations:+.1f}", trial.verdict]
        for trial in findings.trials[1:]
    ]
    return header, rows
