"""Equal weights along the aperture of a beam that is not steered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from blocksar import solvers
from blocksar.collection.weighting import AxisTaper
from blocksar.focusing.lines import LEAST_STRETCH, Line

LEVEL_DEGREE = 8


def level_aperture(line: Line, taper: AxisTaper) -> tuple[AxisTaper, Line]:
    """The taper over the pulses that also levels what the steps in Doppler do to amplitudes, and the lines under it.

    A step in Doppler that stretches time by s weakens a signal by sqrt(s). Where all targets are lit all the time, s is
    nearly the same function of time for all of them, and the taper is divided by that of its mean. In what follows the
    stretch of `line`, after all steps, is then that of each target over the mean. The sum of weights stays that of the
    taper.

    Parameters
    ----------
    line : Line
        (n_range, n_yaw, n), whose nodes span the pulses.
    taper : AxisTaper
    """
    stretch = np.maximum(line.stretch, LEAST_STRETCH).reshape(-1, line.stretch.shape[-1])
    nodes, weights = solvers.gauss_legendre(stretch.shape[-1])
    shares = weights * taper.taper(nodes)
    degree = min(LEVEL_DEGREE, nodes.size - 1)
    mean = (stretch / stretch.mean(axis=1, keepdims=True)).mean(axis=0)
    series = solvers.product(solvers.legendre_series(nodes.size, degree), (1 / np.sqrt(mean))[:, None])[:, 0]
    level = np.polynomial.legendre.legval(nodes, series)
    share = float((shares * level).sum() / shares.sum())
    under = replace(taper, level=tuple((series / share).tolist()))
    return under, replace(line, stretch=line.stretch * (level / share) ** 2)


def levelled(line: Line, taper: AxisTaper) -> Line:
    """Other lines under a taper that `level_aperture` has made."""
    level = np.polynomial.legendre.legval(solvers.gauss_legendre(line.stretch.shape[-1])[0], np.array(taper.level))
    return replace(line, stretch=line.stretch * level**2)
