"""How an axis of a collection is sampled: its step, and the share of it that each sample stands for.

Images are means over pulses and range frequencies. Where these are unevenly spaced, an equal mean counts ground and
band twice where samples crowd: a sample's share is half the way to either neighbour, in units of the step, which is the
trapezoidal rule of the integrals that even samples stand for. Across a gap nothing is known: no half is longer than
half of `LONGEST_GAP` usual steps.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from blocksar.arrays import UNIFORM_TOLERANCE, FloatArray, misplacement
from blocksar.errors import InputError
from blocksar.texts import count

LONGEST_GAP = 2.0  # usual steps, beyond which no sample stands for what lies between it and its neighbour
USUAL = 0.75  # quantile of the steps that is the usual one: of pairs of samples close together, the step between pairs
ON_GRID = 1e-2  # of a step, by which samples of an even axis that lacks some may lie off their places


class Sampling(NamedTuple):
    """Sampling of an axis of n samples.

    Attributes
    ----------
    step : float
        Of a uniform axis, and of one that lacks samples; else the mean of steps that are no gaps.
    shares : (n,) float or None
        Share of each sample, 1 for a step; None where all are 1, as the axis is uniform.
    lacking : int
        Samples that a uniform axis lacks; 0 where it lacks none, or could not be made uniform.
    longest : float
        Way between neighbours beyond which lies a gap.
    """

    step: float
    shares: FloatArray | None = None
    lacking: int = 0
    longest: float = np.inf

    @property
    def even(self) -> bool:
        return self.shares is None

    def halves(self, axis: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Parts of the axis (n,) that each sample stands for before and after itself, (n,) each."""
        halves = np.minimum(np.diff(axis), self.longest) / 2
        return np.append(halves[0], halves), np.append(halves, halves[-1])


def sampling_of(axis: FloatArray) -> Sampling:
    """The sampling of an ascending axis (n,)."""
    extent = float(axis[-1] - axis[0])
    if misplacement(axis).max() <= UNIFORM_TOLERANCE:
        return Sampling(extent / (axis.size - 1))
    steps = np.diff(axis)
    longest = LONGEST_GAP * float(np.quantile(steps, USUAL))
    numbers = np.rint(steps / steps.min())
    places = extent / float(numbers.sum()) * np.concatenate([[0.0], np.cumsum(numbers)])
    lacking = 0
    if np.abs(axis - axis[0] - places).max() <= ON_GRID * steps.min():
        step, lacking = extent / float(numbers.sum()), int(numbers.sum()) - steps.size
    else:
        step = float(steps[steps <= longest].mean())
    found = Sampling(step, None, lacking, longest)
    before, after = found.halves(axis)
    shares = (before + after) / step
    shares.flags.writeable = False
    return found._replace(shares=shares)


def places_of(values: FloatArray, axis: FloatArray) -> FloatArray:
    """Indices (...), with fractions, of values on an ascending axis (n,); beyond its ends its outermost steps go on."""
    within = np.interp(values, axis, np.arange(axis.size))
    before = np.minimum(values - axis[0], 0.0) / (axis[1] - axis[0])
    return np.asarray(within + before + np.maximum(values - axis[-1], 0.0) / (axis[-1] - axis[-2]))


class Departure(NamedTuple):
    """A departure from what most processors need: what that is, the fact, and a remedy besides other processors."""

    needs: str
    fact: str
    remedy: str = ""


UNIFORM_AXES = "uniform pulses and range frequencies"
TWO_ANTENNAS = Departure("one antenna", "transmitter and receiver are two antennas")


def departure_of(name: str, axis: FloatArray, sampling: Sampling) -> Departure:
    """Say how slow time or range frequencies (n,), by the `name` of the axis, depart from a uniform one."""
    if sampling.lacking:
        first = int(np.argmax(np.diff(axis) > 1.5 * sampling.step))
        lines = "rows" if name == "time" else "columns"
        fact = f"{name} lacks {count(sampling.lacking, 'value')} of a uniform axis, first after index {first}"
        return Departure(UNIFORM_AXES, fact, f"write {lines} of NaN there")
    off = misplacement(axis)
    fact = f"{name} is not uniform: index {int(off.argmax())} lies {off.max():.3g} steps from its place"
    return Departure(UNIFORM_AXES, fact)


def refuse_departures(who: str, departures: Iterable[Departure], remedy: str) -> None:
    """Refuse what departs from what one needs.

    Raises
    ------
    InputError
        If there is any; it names missing samples first where these would do, and the remedy.
    """
    for each in departures:
        also = f"{each.remedy}, or " if each.remedy else ""
        raise InputError(f"{who} needs {each.needs}, but {each.fact}; {also}{remedy}")
