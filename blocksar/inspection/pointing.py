"""Check of a steered beam: measured against predicted lit times of prominent places.

The angle of a place about the antenna's axis, or its yaw, follows from its range and Doppler at any pulse, whatever is
said of the beam. So places are looked for in all the angle that the PRF tells apart, and their lines are taken over
several dwells. A hypothesis says from which pulses to which a place is lit; for echoes of constant amplitude in white
noise the likeliest is the one with the largest |sum|^2 / n of the line over its n pulses, which falls by (1 - e)^2 for
an error of e beam widths. The places, each over its own largest, judge together: what is wrong with a beam is common to
them, and what is wrong with a place is not.

The same echoes seen a PRF higher or lower lie at another angle, where range and Doppler drift a little otherwise. Each
hypothesis is given the best of three.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.beam import wrapped
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.region import Region
from blocksar.errors import InputError
from blocksar.inspection.alternatives import Alternative, doppler_period
from blocksar.inspection.prominent import EDGE, FEW_ROWS, SHORT, Lines, PointLine, ProfiledSamples, ProminentPoint

CANDIDATES = 16  # places that are looked at
FEWEST, ENOUGH = 3, 5  # places in focus: fewest for a verdict, and enough for a check during a run
APART = 4.0  # range cells between places: less is the same one, seen in two apertures
FURTHEST = 4.0  # beam widths: larger errors are not tried
STEP = 0.02  # beam widths between errors that are tried
NARROWER = (0.5, 0.42, 0.35, 0.3, 0.25)  # of the stated width, that are tried
SPAN = 4.0  # dwells to either side of where a place was found, over which its line is taken
FOCUSED = 0.5  # concentration of points
OFF = 0.2  # beam widths: smaller errors cost little
GAIN = 1.0  # dB over the stated beam, median of the places: 1.9 dB for an error of OFF
EMPTY = (
    0.8  # of the gain, dB, if what a narrower beam leaves out were dark, in the median: a pattern's nulls come to 0.65
)
SHARE = 0.75  # of the places, that gain
AGREED = 0.7  # of its own best, that the median place has
TOLD_APART = 0.4  # median dB that distinguishes an angle from that a PRF away


class Pointing(NamedTuple):
    """Error of the beam's pointing, as prominent places show it.

    Attributes
    ----------
    places : int
        Number that judged, all in focus; nothing is told of the beam by fewer than FEWEST.
    reach : float
        Largest error of the beam's angle that was tried, rad.
    found : Alternative or None
        The beam with the error undone; None where it fits.
    gain : float
        By which places are brighter with it, dB in the median.
    rival : str
        Another error that these places do not tell from it, as one a PRF away; empty if there is none.
    narrower : bool
        Whether a narrower beam fits better, though by less than a pattern's nulls or cut dwells may give.
    """

    places: int
    reach: float
    found: Alternative | None = None
    gain: float = 0.0
    rival: str = ""
    narrower: bool = False

    @property
    def told(self) -> bool:
        """Tell whether enough places were found to judge the beam."""
        return self.places >= FEWEST


class _Hypotheses(NamedTuple):
    """Beams to try, the stated one first. `law` (n,): index of the beam's angles; error, width (n,), rad."""

    laws: list[FloatArray]
    law: FloatArray
    error: FloatArray
    width: FloatArray


def point(
    samples: ProfiledSamples,
    collection: Collection,
    geometry_of: Callable[[Collection], Geometry],
    region_of: Callable[[Geometry], Region],
    *,
    thorough: bool,
) -> Pointing | None:
    """Compare the measured lit times of places with those that the stated beam predicts.

    Parameters
    ----------
    samples : Samples
        Of this collection.
    collection : Collection
    geometry_of, region_of : callable
        The geometry of a collection, and the ground to look at.
    thorough : bool
        Look at all places, which takes longer.

    Returns
    -------
    Pointing or None
        None if the beam is not steered, holds a part of what the samples hold (a look), or nothing is lit.
    """
    if collection.beam_width is None or collection.lit_width is not None or collection.n_pulse < SHORT:
        return None
    try:
        geometry = geometry_of(collection)
        period = doppler_period(geometry, region_of(geometry))
        furthest = min(period / 2, FURTHEST * collection.beam_width)
        wide = replace(collection, beam_width=furthest / EDGE, beam_offset=None, beam_pattern=None)
        source = Lines(samples, geometry_of(wide))
        places = source.places(region_of(source.geometry), CANDIDATES)
    except InputError:  # beams wider than the PRF, or than a half turn
        return None
    reach = min(1.5 * period, FURTHEST * collection.beam_width)
    hypotheses = _hypotheses(collection, reach)
    turns = [0] if period - furthest > reach else [0, -1, 1]
    scores: list[FloatArray] = []
    counts: list[FloatArray] = []
    seen: list[ProminentPoint] = []
    for place in places:
        if len(scores) == ENOUGH and not thorough:
            break
        lines = [line for k in turns if (line := _line(source, place, k, collection)) is not None]
        if not lines or any(_apart(lines[0].place, other) < APART * source.cell for other in seen):
            continue
        seen.append(lines[0].place)
        energy, focus, count = np.stack([_captured(source, line, collection, hypotheses) for line in lines]).max(axis=0)
        if focus[energy.argmax()] >= FOCUSED:
            scores.append(energy / energy.max())
            counts.append(count)
    if len(scores) < FEWEST:
        return Pointing(len(scores), reach)
    return _judged(collection, hypotheses, np.stack(scores), np.stack(counts), period, reach)


def _apart(one: ProminentPoint, other: ProminentPoint) -> float:
    return float(np.hypot(one.x - other.x, one.y - other.y))


def beam_angle(collection: Collection) -> FloatArray:
    """Angle of the beam's centre, (n_pulse,) rad."""
    return collection.beam_azimuth if collection.beam_steering is None else collection.beam_steering


def _hypotheses(collection: Collection, reach: float) -> _Hypotheses:
    beam, width = beam_angle(collection), collection.beam_width or 0.0
    count = round(reach / (STEP * width))
    errors = np.arange(-count, count + 1) * STEP * width
    errors = errors[np.argsort(np.abs(errors), kind="stable")]  # the stated beam first
    narrower = [] if collection.has_pattern else NARROWER
    return _Hypotheses(
        laws=[beam, beam[::-1], -beam],
        law=np.concatenate([np.zeros(errors.size + len(narrower)), [1, 2]]),
        error=np.concatenate([errors, np.zeros(len(narrower) + 2)]),
        width=width * np.concatenate([np.ones(errors.size), narrower, [1, 1]]),
    )


def _line(source: Lines, place: ProminentPoint, turns: int, collection: Collection) -> PointLine | None:
    """Form the line of a place, or of its ambiguity `turns` PRFs away, over several dwells about its pulse."""
    geometry, n = source.geometry, collection.n_pulse
    if turns:
        place = source.ambiguous(place, turns)
    pulses = np.array([max(place.pulse - SHORT // 2, 0), min(place.pulse + SHORT // 2, n - 1)])
    ends = geometry.beam.offset(np.array(place.x), np.array(place.y), pulses)
    if not np.isfinite(ends).all():
        return None
    slope = abs(float(wrapped(ends[1] - ends[0]))) / (pulses[1] - pulses[0])
    half = max(SPAN * (collection.beam_width or 0.0) / max(slope, 1e-12), 4 * SHORT)
    first, last = max(place.pulse - half, 0), min(place.pulse + half, n)
    if last - first < SHORT:
        return None
    return source.line_about(place, int(first), int(last), place.pulse, later=FEW_ROWS)


def _captured(source: Lines, line: PointLine, collection: Collection, hypotheses: _Hypotheses) -> FloatArray:
    """|sum|^2 / n of a line under each hypothesis, its concentration there, and n, (3, n_hypothesis)."""
    geometry, angle = source.geometry, beam_angle(collection)[line.pulses]
    offset = geometry.beam.offset(np.array(line.place.x), np.array(line.place.y), line.pulses)
    energy, focus, n = np.zeros((3, hypotheses.law.size))
    for number, law in enumerate(hypotheses.laws):
        which: BoolArray = hypotheses.law == number
        away = wrapped(offset + angle - law[line.pulses])
        order = np.argsort(away)
        away, values = away[order], line.values[order]
        sums, powers = (np.concatenate([[0], np.cumsum(part)]) for part in (values, np.abs(values) ** 2))
        centre, half = hypotheses.error[which], hypotheses.width[which] / 2
        first, last = np.searchsorted(away, centre - half), np.searchsorted(away, centre + half, side="right")
        squared = np.abs(sums[last] - sums[first]) ** 2
        count = np.maximum(last - first, 1)
        energy[which], n[which] = squared / np.maximum(count, SHORT), np.maximum(count, SHORT)
        focus[which] = squared / (count * np.maximum(powers[last] - powers[first], 1e-30))
    return np.stack([energy, focus, n])


def _judged(
    collection: Collection, hypotheses: _Hypotheses, scores: FloatArray, counts: FloatArray, period: float, reach: float
) -> Pointing:
    """Judge the beam from all places: `scores` (n_place, n_hypothesis) relative to their best, `counts` of pulses."""
    width, decibels = collection.beam_width or 0.0, 10 * np.log10(np.maximum(scores, 1e-6))
    together = scores.mean(axis=0)
    best = int(together.argmax())
    gain = decibels[:, best] - decibels[:, 0]
    narrower = bool(hypotheses.width[best] < width)
    emptied = 10 * np.log10(counts[:, 0] / counts[:, best])  # dB, which pulses that hold nothing take
    plain = hypotheses.law[best] == 0 and hypotheses.width[best] == width
    if (
        (plain and abs(hypotheses.error[best]) < OFF * width)
        or np.median(gain) < GAIN
        or (narrower and np.median(gain - EMPTY * emptied) < 0)
        or np.mean(gain > 0) < SHARE
        or np.median(scores[:, best]) < AGREED
    ):
        return Pointing(len(scores), reach, narrower=narrower)
    try:
        found = _alternative(collection, hypotheses, best)
    except InputError:  # it would be refused
        return Pointing(len(scores), reach)
    if plain:
        apart = np.abs(np.abs(hypotheses.error - hypotheses.error[best]) - period)
        rivals = (hypotheses.law == 0) & (hypotheses.width == width) & (apart < OFF * width)
    else:
        rivals = (hypotheses.law > 0) & (hypotheses.law != hypotheses.law[best]) & (hypotheses.law[best] > 0)
    rival = ""
    if rivals.any():
        other = int(np.where(rivals, together, -1.0).argmax())
        lead = decibels[:, best] - decibels[:, other]
        if np.median(lead) < TOLD_APART or np.mean(lead > 0) < SHARE:
            rival = _names(collection, hypotheses, other)[0]
    return Pointing(len(scores), reach, found, float(np.median(gain)), rival)


def _names(collection: Collection, hypotheses: _Hypotheses, which: int) -> tuple[str, str]:
    """Describe what is wrong under a hypothesis, and what to change."""
    field = "beam_azimuth" if collection.beam_steering is None else "beam_steering"
    error, width, stated = hypotheses.error[which], hypotheses.width[which], collection.beam_width or 1.0
    if hypotheses.law[which] == 1:
        return "the beam turns the other way", f"reverse {field} along pulse"
    if hypotheses.law[which] == 2:
        return "the beam looks to the other side", f"negate {field}"
    if width < stated:
        name = f"the beam has about {width / stated:.2g} of the {np.degrees(stated):.3g} degrees of beam_width"
        return name, f"give beam_width as {width:.3g} rad"
    degrees = np.degrees(error)
    return f"the beam is off by {-degrees:+.3g} degrees", f"add {degrees:+.3g} degrees to {field}"


def _alternative(collection: Collection, hypotheses: _Hypotheses, which: int) -> Alternative:
    """Make the alternative with the collection as a hypothesis describes it."""
    field = "beam_azimuth" if collection.beam_steering is None else "beam_steering"
    beam = hypotheses.laws[int(hypotheses.law[which])] + hypotheses.error[which]
    changes: dict[str, Any] = {field: beam, "beam_width": float(hypotheses.width[which])}
    return Alternative(*_names(collection, hypotheses, which), replace(collection, **changes), None, of_beam=True)
