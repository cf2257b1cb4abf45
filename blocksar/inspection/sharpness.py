"""How sharp prominent places are over the whole dwell, and how much sharper a refocus makes them.

Concentration is the power at the peak of a deramped line's spectrum over the power of the line: 1 for a lone point in
focus, about 1 / n where n samples add up by chance. A phase error of the track that all lines share is estimated by
phase gradients: the phase steps from pulse to pulse of each line's main lobe, weighted by its concentration and
averaged as phasors (Eichel, Ghiglia and Jakowatz 1989; here over lines whose dwells overlap in part).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from blocksar.arrays import Complex128Array, FloatArray
from blocksar.collection.collection import Collection
from blocksar.inspection.prominent import Line
from blocksar.kernels.fourier import fft_rows
from blocksar.solvers import least_squares

ROUNDS = 5  # of the refocus
WIDEST, NARROWEST = 0.25, 0.02  # of the Doppler bins: the window about a peak, from the first round to the last
IMPLAUSIBLE = 0.1  # of the velocity, or of the range: larger errors of the track are no explanation
KNOTS = 16.0  # of the phase error over a dwell: no faster change is estimated


class Refocus(NamedTuple):
    """Concentration of each line after a refocus, and the phase error that it removed, (n_pulse,) rad."""

    concentration: FloatArray
    phase: FloatArray


class Judged(NamedTuple):
    """Concentration of each line under the phase error of others, and the share of its dwell that they cover."""

    concentration: FloatArray
    covered: FloatArray


def concentration(values: Complex128Array) -> float:
    """Power at the peak of a line's spectrum over the power of the line, 0 .. 1."""
    power = float(np.sum(np.abs(values) ** 2))
    if power == 0.0:
        return 0.0
    padded = np.concatenate([values, np.zeros(values.size)])
    return float(np.max(np.abs(fft_rows(padded[None], inverse=False)) ** 2) / (values.size * power))


def refocus(lines: Sequence[Line], n_pulse: int) -> Refocus:
    """Estimate the phase error that all lines share, and measure what is left without it."""
    phase = np.zeros(n_pulse)
    longest = max(line.values.size for line in lines)
    best = Refocus(np.array([concentration(line.values) for line in lines]), phase)
    for width in np.geomspace(WIDEST, NARROWEST, ROUNDS):
        steps, weight = np.zeros(n_pulse - 1, np.complex128), 1e-30
        for line in lines:
            lobe = _main_lobe(line.values * np.exp(-1j * phase[line.pulses]), width)
            level = float(np.mean(np.abs(lobe) ** 2))
            if level > 0:
                gradient = np.conj(lobe[:-1]) * lobe[1:] / level
                steps[line.pulses.start : line.pulses.stop - 1] += concentration(lobe) * gradient
                weight += 1.0
        phase = phase + _level(np.concatenate([[0.0], np.cumsum(np.angle(_averaged(steps, longest)))]))
        left = np.array([concentration(line.values * np.exp(-1j * phase[line.pulses])) for line in lines])
        if np.median(left) > np.median(best.concentration):
            best = Refocus(left, phase)
    return best


def judged_by_others(lines: Sequence[Line], n_pulse: int) -> Judged:
    """Refocus every second line by the phase error of those in between, ordered by their dwells.

    An error of the track is common to all lines, so that others show it as well. What a refocus gains by fitting a
    line's own phase, which clutter's is, they do not.
    """
    order = sorted(range(len(lines)), key=lambda i: lines[i].pulses.start)
    found, covered = np.zeros(len(lines)), np.zeros(len(lines))
    for others, judged in ((order[0::2], order[1::2]), (order[1::2], order[0::2])):
        if not judged or not others:
            continue
        phase, seen = refocus([lines[i] for i in others], n_pulse).phase, np.zeros(n_pulse, np.bool_)
        for i in others:
            seen[lines[i].pulses] = True
        for i in judged:
            found[i] = concentration(lines[i].values * np.exp(-1j * phase[lines[i].pulses]))
            covered[i] = seen[lines[i].pulses].mean()
    return Judged(found, covered)


def _main_lobe(values: Complex128Array, width: float) -> Complex128Array:
    """The line with its peak moved to zero Doppler, and nothing beyond `width` of the bins about it."""
    spectrum = fft_rows(values[None].copy(), inverse=False)[0]
    spectrum = np.roll(spectrum, -int(np.argmax(np.abs(spectrum))))
    half = max(round(width * values.size / 2), 3)
    spectrum[half + 1 : values.size - half] = 0.0
    return np.asarray(fft_rows(spectrum[None], inverse=True)[0])


def _averaged(steps: Complex128Array, longest: int) -> Complex128Array:
    """Running mean of phasors over a KNOTS-th of the longest dwell."""
    size = min(max(round(longest / KNOTS), 1), steps.size)
    return np.convolve(steps, np.ones(size), mode="same")


class TrackError(NamedTuple):
    """A simple error of the track, and the share of a phase error that it explains."""

    text: str
    remedy: str
    explained: float


def explain(lines: Sequence[Line], phase: FloatArray, collection: Collection) -> list[TrackError]:
    """How well simple errors explain a phase error: of the velocity, of the carrier, or an offset along an axis.

    The phase of a line is 4 pi / lambda (d - e) . u, with the track's error e: a place is found where range and Doppler
    fit, displaced by d on the ground, so that constant and line vanish over its dwell. What is left blurs. A carrier
    that is too high by a share has the same share of R - reference_range for (d - e) . u. Errors that would have to be
    implausibly large are left out.
    """
    position, time = collection.antenna_position, collection.time - collection.time.mean()
    velocity = (position[-1] - position[0]) / (collection.time[-1] - collection.time[0])
    kinds: list[tuple[str, FloatArray | None]] = [("velocity", np.outer(time, velocity)), ("carrier", None)]
    kinds += [(axis, np.tile(unit, (time.size, 1))) for axis, unit in zip("xyz", np.eye(3), strict=True)]
    errors, furthest = [], IMPLAUSIBLE * float(collection.reference_range.mean())
    for kind, error in kinds:
        above, below, total = 0.0, 0.0, 1e-30
        for line in lines:
            sight = np.array([line.place.x, line.place.y, collection.ground_height]) - position[line.pulses]
            distance = np.linalg.norm(sight, axis=1)
            sight /= distance[:, None]
            if error is None:
                away = distance - collection.reference_range[line.pulses]
            else:
                away = -(error[line.pulses] * sight).sum(axis=1)
            model = 4 * np.pi / collection.wavelength * _blur(away, sight[:, :2])
            wanted = _level(phase[line.pulses])
            above += float(model @ wanted)
            below += float(model @ model)
            total += float(wanted @ wanted)
        size = above / max(below, 1e-30)
        if abs(size) <= (furthest if kind in "xyz" else IMPLAUSIBLE):
            errors.append(_track_error(kind, size, size * above / total))
    return errors


def _track_error(kind: str, size: float, explained: float) -> TrackError:
    """An error of a kind and size, a share or m, as a statement and its remedy."""
    much = f"about {abs(100 * size):.2g} % too {'high' if size > 0 else 'low'}"
    if kind == "velocity":
        return TrackError(f"a velocity that is {much}", "check the velocity and the time between pulses", explained)
    if kind == "carrier":
        return TrackError(f"a carrier that is {much}", "check carrier_frequency", explained)
    text = f"an offset of about {abs(size):.2g} m towards {'+' if size > 0 else '-'}{kind}"
    return TrackError(text, "check antenna_position", explained)


def _blur(distance: FloatArray, ground: FloatArray) -> FloatArray:
    """An error of range (n,) plus the displacement along the directions `ground` (n, 2) that takes out most of it."""
    left = [_level(values) for values in (distance, *ground.T)]
    lines = [values - level for values, level in zip((distance, *ground.T), left, strict=True)]
    a, b = least_squares(np.stack(lines[1:]), -lines[0], damping=1e-12 * distance.size)
    return left[0] + a * left[1] + b * left[2]


def _level(phase: FloatArray) -> FloatArray:
    """The phase without its mean and its line, which displace and do not blur."""
    time = np.linspace(-1.0, 1.0, phase.size)
    terms = np.stack([np.ones_like(time), time])
    return np.asarray(phase - least_squares(terms, phase) @ terms)


def blurring_phase(lines: Sequence[Line], phase: FloatArray) -> float:
    """Root mean square over the dwells of a phase error without its line, rad."""
    return float(np.sqrt(np.mean([np.mean(_level(phase[line.pulses]) ** 2) for line in lines])))
