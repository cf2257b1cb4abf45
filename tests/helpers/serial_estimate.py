"""All stages of an estimate of the track in one process, a slow twin of `tasks.track_stages`."""

from __future__ import annotations

from collections.abc import Callable

from blocksar.arrays import ComplexArray
from blocksar.autofocusing.chips import take_chips
from blocksar.autofocusing.estimation import estimate
from blocksar.autofocusing.finishing import Result, estimate_half, finish
from blocksar.autofocusing.selection import find_candidates, select_points
from blocksar.autofocusing.track_correction import Correction
from blocksar.autofocusing.work import EstimatorSettings, begin
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid


def find_track_error(
    read: Callable[[slice], ComplexArray],
    geometry: Geometry,
    grid: Grid | None = None,
    settings: EstimatorSettings | None = None,
    *,
    threads: int = 1,
) -> Result:
    """Estimate the error of a collection's track from its samples.

    Parameters
    ----------
    read : callable
        Returns the samples (n, n_range_frequency) complex64 of a slice of pulses; NaN where missing.
    geometry : Geometry
        With the track as stated.
    grid : Grid, optional
        Ground in which points are looked for; needed where the beam is not steered, or has an axis.
    settings : EstimatorSettings, optional
    threads : int
        The result does not depend on it.

    Returns
    -------
    Result

    Raises
    ------
    InputError
        If the collection or the grid cannot serve.
    Refused
        If the samples do not tell the track's error; the message has the figures.
    """
    work = begin(geometry, grid, settings)
    points = select_points([[find_candidates(read(part), work, part, threads) for part in work.apertures]], work).points
    correction = Correction.none(work)
    while not correction.finished:
        displacement = correction.displacement
        parts = [take_chips(read(block), work, points, displacement, block, threads) for block in work.blocks]
        correction = estimate(work, points, parts, correction, threads)
    found = [estimate_half(work, points, parts, correction, number, threads) for number in (0, 1)]
    return finish(work, points, parts, correction, found)
