"""Weights of targets over their dwells: the weighting, and the antenna's pattern that echoes contain."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from blocksar import solvers
from blocksar.arrays import FloatArray
from blocksar.collection.beam import STILL
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import FLAT, AxisTaper, Taper, Weighting
from blocksar.imaging.pattern_sums import LEAST_ELEVATION
from blocksar.processors.chain.dwells.steadiness import scans_evenly
from blocksar.processors.chain.steps.lines import LEAST_STRETCH, Line


def level_aperture(line: Line, taper: AxisTaper) -> AxisTaper:
    """Taper over the pulses that also compensates the amplitude changes of steps in Doppler.

    A step in Doppler that stretches time by s weakens a signal by sqrt(s). Where all targets are lit all the time, s is
    nearly the same function of time for all of them, and the taper is divided by that of its mean. The sum of weights
    stays that of the taper.

    Parameters
    ----------
    line : Line
        (n_range, n_yaw, n), whose nodes span the pulses.
    taper : AxisTaper
    """
    stretch = np.maximum(line.stretch, LEAST_STRETCH).reshape(-1, line.stretch.shape[-1])
    nodes, weights = solvers.gauss_legendre(stretch.shape[-1])
    shares = weights * taper.taper(nodes)
    mean = (stretch / stretch.mean(axis=1, keepdims=True)).mean(axis=0)
    level = 1 / np.sqrt(mean)
    series = solvers.product(solvers.legendre_series(nodes.size, nodes.size - 1), level[:, None])[:, 0]
    share = float((shares * level).sum() / shares.sum())
    return replace(taper, level=tuple((series / share).tolist()))


def levelled(line: Line, taper: AxisTaper) -> Line:
    """Lines after all steps under a taper of `level_aperture`: the stretch of each target relative to the mean."""
    if not taper.level:
        return line
    level = np.polynomial.legendre.legval(solvers.gauss_legendre(line.stretch.shape[-1])[0], np.array(taper.level))
    return replace(line, stretch=line.stretch * level**2)


@dataclass(frozen=True, kw_only=True, eq=False)
class DwellWeights:
    """Weights of the pulses of dwells in the sum to an image.

    Attributes
    ----------
    taper : Taper
        The weighting over the dwells.
    nodes : (..., n) float
        At the nodes of lines: the weighting w times the antenna's pattern g.
    edge : (...) float
        The same at the ends of the dwells.
    patterned : bool
        Whether dwells have other weights than the whole taper: an antenna's pattern.
    alone : (..., n) float
        The weighting w without the pattern.
    change : (..., n) float
        Of these weights per relative range frequency f / fc, which moves echoes in time.
    pattern : (..., n) float or None
        The antenna's pattern over the beam at the nodes of lines.
    elevation : (..., n) float or None
        That in elevation, no smaller than `pattern_sums.LEAST_ELEVATION`.
    lit_band : (...) float
        Band of Doppler that is lit at a time where the target is, Hz.
    """

    taper: Taper
    nodes: FloatArray
    edge: FloatArray | float
    patterned: bool
    alone: FloatArray | float = 1.0
    change: FloatArray | float = 0.0
    pattern: FloatArray | None = None
    elevation: FloatArray | None = None
    lit_band: FloatArray | float = 1.0

    @property
    def uniform(self) -> bool:
        return self.taper.uniform and not self.patterned

    @property
    def end(self) -> float:
        """The weighting w at the ends of whole dwells, without the pattern."""
        return float(self.taper(np.array(1.0)))

    def gains(self, side: int) -> FloatArray | None:
        """Legendre series (..., n) over the dwell of the squared `pattern`, from its beginning (side -1) or its end.

        None without one. The beam passes a target as all that is lit at one of its ends lies in it.
        """
        if self.pattern is None:
            return None
        n = self.pattern.shape[-1]
        return solvers.product(self.pattern[..., ::-side] ** 2, solvers.legendre_series(n, n - 1).T)

    def level(self, side: int) -> FloatArray | float:
        """Squared pattern in elevation at the beginning (side -1) or the end of dwells; 1 without one.

        All that is lit there at a target's range has about the same.
        """
        return 1.0 if self.elevation is None else self.elevation[..., 0 if side < 0 else -1] ** 2

    def weigh(self, line: Line) -> Line:
        """Apply these weights to lines; unchanged if all weights are 1."""
        return line if self.uniform else line.weighed(self.nodes)

    def weigh_chain(self, line: Line) -> Line:
        """Apply to lines the weights that calibrate a chain: without a pattern in elevation.

        By it, places, phases and gains would bend near zeros as no series over the ground does.
        """
        return self.weigh(line) if self.elevation is None else line.weighed(self.nodes / self.elevation)


def dwell_weights(
    geometry: Geometry,
    taper: Taper,
    lit: Line,
    *,
    uncut: tuple[FloatArray, FloatArray],
    epoch_range: FloatArray,
    yaw: FloatArray,
    moves: FloatArray | None = None,
    lit_band: FloatArray | float = 1.0,
) -> DwellWeights:
    """The weights of targets at epoch ranges (n_range,), m, and yaws (n_yaw,), rad.

    Parameters
    ----------
    lit : Line
        (n_range, n_yaw, n), before all steps.
    uncut : pair of (n_yaw,) or (n_range, n_yaw) float
        Slow time, s from the epoch, at which the dwells would begin and end if the collection did not cut them. The
        place in a beam that scans evenly, or is not steered, is taken as linear in between.
    moves : (n_range, n_yaw, n) float, optional
        Time, s, by which relative range frequency moves the echoes at the nodes of the lines.
    lit_band : (n_range, n_yaw) float
        Band of Doppler that is lit at a time where the targets are, Hz.
    """
    collection = geometry.collection
    at = epoch_range[:, None], yaw
    x, y, z = (np.asarray(axis)[..., None] for axis in (*geometry.ground_axes(*at), geometry.level(*at)))
    time, edge = lit.time + geometry.epoch, float(taper(np.array(1.0)))
    change: FloatArray | float = 0.0
    nodes = np.ones(lit.time.shape)
    if not taper.uniform:
        dwell = (uncut[1] - uncut[0])[..., None]
        if collection.beam_width is not None and not scans_evenly(collection):
            beam = geometry.beam
            place = beam.at_times(time, lambda pulses: beam.offset(x, y, pulses, z)) / beam.half
        else:
            place = (2 * lit.time - (uncut[0] + uncut[1])[..., None]) / dwell
        nodes = taper(place)
        if collection.steered and moves is not None:
            # A beam that turns back before a target gives it a dwell of 0 s: its weights do not move.
            change = taper.slope(place) * 2 / np.where(dwell > 0, dwell, np.inf) * moves
    weights = DwellWeights(
        taper=taper, nodes=nodes, edge=edge, patterned=False, alone=nodes, change=change, lit_band=lit_band,
    )  # fmt: skip
    if not collection.has_pattern:
        return weights
    gain = np.ones(nodes.shape)
    if collection.beam_pattern is not None:
        across = geometry.lit_by(collection.without_elevation).beam
        gain = across.at_times(time, lambda pulses: across.gain(x, y, pulses, z))
        weights = replace(weights, pattern=gain)
    if collection.elevation_pattern is not None:
        down = _elevation_alone(geometry).beam
        elevation = down.at_times(time, lambda pulses: down.gain(x, y, pulses, z))
        gain, weights = gain * elevation, replace(weights, elevation=elevation)
    # The outer nodes lie close to the ends: by half a hundredth of the dwell.
    at_ends = np.sqrt((gain[..., 0] ** 2 + gain[..., -1] ** 2) / 2)
    return replace(weights, nodes=nodes * gain, edge=edge * at_ends, patterned=True, change=change * gain)


def _elevation_alone(geometry: Geometry) -> Geometry:
    """Copy of the geometry with only the pattern in elevation, nowhere smaller than images require.

    Targets that have no weight have no focus.
    """
    pattern = geometry.collection.elevation_pattern
    assert pattern is not None
    least = LEAST_ELEVATION * float(pattern.max())
    changes: Any = {"beam_offset": None, "beam_pattern": None, "elevation_pattern": np.maximum(pattern, least)}
    return geometry.lit_by(replace(geometry.collection, **changes))


def taper_over_dwells(collection: Collection, weighting: Weighting) -> Taper:
    """The weighting over dwells; under a beam that stands still each target has one weight, which cancels."""
    return FLAT if collection.steered and not beam_moves(collection) else weighting.azimuth


def beam_moves(collection: Collection) -> bool:
    """Tell whether the beam passes over the ground, so that targets are lit one after the other."""
    return collection.steered and not abs(collection.beam_azimuth[-1] - collection.beam_azimuth[0]) < STILL
