"""Comparison of the same echoes as given and under an alternative.

It measures the sharpness of prominent places over the whole dwell, and the gain by a refocus.

Concentration is the power at the peak of a deramped line's spectrum over the power of the line: 1 for a lone point in
focus, about 1 / n where n samples add up by chance. A phase error of the track that all lines share is estimated by
phase gradients: the phase steps from pulse to pulse of each line's main lobe, weighted by its concentration and
averaged as phasors (Eichel, Ghiglia and Jakowatz 1989; here over lines whose dwells overlap in part).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from blocksar.arrays import Complex128Array, FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry, over_terrain
from blocksar.collection.grid import Grid
from blocksar.collection.region import Region, plan_region
from blocksar.collection.terrain import Terrain
from blocksar.errors import InputError, OutsideSwath
from blocksar.inspection.alternatives import Alternative
from blocksar.inspection.prominent import (
    SIGNIFICANT,
    UNLIT,
    Contrast,
    Echo,
    Lines,
    PointLine,
    ProfiledSamples,
    ProminentPoint,
    Seeds,
    deviations,
)
from blocksar.inspection.verdict import Trial
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
    """Concentration of each line, refocused by the phase error of others, and the share of its dwell they cover."""

    concentration: FloatArray
    covered: FloatArray


def concentration(values: Complex128Array) -> float:
    """Power at the peak of a line's spectrum over the power of the line, 0 .. 1."""
    power = float(np.sum(np.abs(values) ** 2))
    if power == 0.0:
        return 0.0
    padded = np.concatenate([values, np.zeros(values.size)])
    return float(np.max(np.abs(fft_rows(padded[None], inverse=False)) ** 2) / (values.size * power))


def refocus(lines: Sequence[PointLine], n_pulse: int) -> Refocus:
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


def judged_by_others(lines: Sequence[PointLine], n_pulse: int) -> Judged:
    """Refocus every second line by the phase error of those in between, ordered by their dwells.

    An error of the track is common to all lines, so that others show it as well. What a refocus gains by fitting a
    line's own phase, which clutter's is, they do not.
    """
    order = sorted(range(len(lines)), key=lambda i: lines[i].pulses.start)
    found, covered = np.zeros(len(lines)), np.zeros(len(lines))
    for others, tested in ((order[0::2], order[1::2]), (order[1::2], order[0::2])):
        if not tested or not others:
            continue
        phase, seen = refocus([lines[i] for i in others], n_pulse).phase, np.zeros(n_pulse, np.bool_)
        for i in others:
            seen[lines[i].pulses] = True
        for i in tested:
            found[i] = concentration(lines[i].values * np.exp(-1j * phase[lines[i].pulses]))
            covered[i] = seen[lines[i].pulses].mean()
    return Judged(found, covered)


def _main_lobe(values: Complex128Array, width: float) -> Complex128Array:
    """Shift the peak of a line to zero Doppler, and set everything beyond `width` of the bins about it to zero."""
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


def explain(lines: Sequence[PointLine], phase: FloatArray, collection: Collection) -> list[TrackError]:
    """Measure how well simple errors explain a phase error: of velocity, of carrier, or an offset along an axis.

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
    """Make a track error of a kind and size (share, or m): a statement and its remedy."""
    much = f"about {abs(100 * size):.2g} % too {'high' if size > 0 else 'low'}"
    if kind == "velocity":
        return TrackError(f"a velocity that is {much}", "check the velocity and the time between pulses", explained)
    if kind == "carrier":
        return TrackError(f"a carrier that is {much}", "check carrier_frequency", explained)
    text = f"an offset of about {abs(size):.2g} m towards {'+' if size > 0 else '-'}{kind}"
    return TrackError(text, "check antenna_position", explained)


def _blur(distance: FloatArray, ground: FloatArray) -> FloatArray:
    """Subtract from a range error (n,) its best fit by a displacement along the directions `ground` (n, 2)."""
    left = [_level(values) for values in (distance, *ground.T)]
    lines = [values - level for values, level in zip((distance, *ground.T), left, strict=True)]
    a, b = least_squares(np.stack(lines[1:]), -lines[0], damping=1e-12 * distance.size)
    return left[0] + a * left[1] + b * left[2]


def _level(phase: FloatArray) -> FloatArray:
    """Subtract mean and linear trend of a phase, which displace and do not blur."""
    time = np.linspace(-1.0, 1.0, phase.size)
    terms = np.stack([np.ones_like(time), time])
    return np.asarray(phase - least_squares(terms, phase) @ terms)


def blurring_phase(lines: Sequence[PointLine], phase: FloatArray) -> float:
    """Root mean square over the dwells of a phase error without its line, rad."""
    return float(np.sqrt(np.mean([np.mean(_level(phase[line.pulses]) ** 2) for line in lines])))


PLACES, CANDIDATES = 12, 24  # prominent ones that are compared, and that are looked at
PATCHES, FEW_PATCHES = (4, 6), (3, 4)  # yaws and ranges at which clutter is compared; beside a run
SETTLED = 3  # echoes that rule an alternative out, if they do beyond chance: no more are looked at


@dataclass(frozen=True)
class ClutterGround:
    """Ground of the echoes, and the yaws and ranges at which clutter is compared."""

    grid: Grid | None
    terrain: Terrain | None
    patches: tuple[int, int] = PATCHES

    def geometry(self, collection: Collection) -> Geometry:
        return over_terrain(collection, self.terrain)

    def region(self, geometry: Geometry) -> Region:
        return plan_region(geometry, self.grid)


@dataclass(frozen=True, eq=False)
class View:
    """Samples and their ground, seen under an alternative."""

    alternative: Alternative
    samples: ProfiledSamples
    ground: ClutterGround

    def under(self, other: Alternative) -> View:
        """The view under an alternative to this one; if only samples differ, with the same ground."""
        samples = self.samples
        if other.samples is not None:
            signal = np.ascontiguousarray(other.samples(samples.signal))
            samples = ProfiledSamples(signal, samples.collection, threads=samples.threads)
        view = View(other, samples, self.ground)
        if other.collection is self.alternative.collection:
            vars(view)["lines"] = Lines(samples, self.lines.geometry)
            vars(view)["_looked_at"], vars(view)["_seeds"] = self._looked_at, self._seeds
        return view

    @cached_property
    def lines(self) -> Lines:
        return Lines(self.samples, self.ground.geometry(self.alternative.collection))

    @property
    def region(self) -> Region | None:
        """The ground to examine; all that is lit if the grid lies outside it; None if nothing is lit."""
        return self._looked_at[0]

    @property
    def outside(self) -> OutsideSwath | None:
        """The error that explains why nothing of the grid is seen; None if some is."""
        return self._looked_at[1]

    @cached_property
    def _looked_at(self) -> tuple[Region | None, OutsideSwath | None]:
        geometry = self.lines.geometry
        try:
            return self.ground.region(geometry), None
        except OutsideSwath as error:
            if self.ground.grid is None or not geometry.collection.steered:
                return None, error
            try:
                return plan_region(geometry, None), error
            except InputError:
                return None, error

    @cached_property
    def prominent(self) -> list[tuple[Echo, PointLine]]:
        """The most prominent lit echoes, one for each place, and their lines."""
        found: list[tuple[Echo, PointLine]] = []
        if self.region is None or self.outside is not None:
            return found
        for place in self.lines.places(self.region, CANDIDATES):
            line = self.lines.line(place)
            if line is not None and not self.lines.known(line, [other for _, other in found]):
                found.append((self.lines.echo(place), line))
            if len(found) == PLACES:
                break
        return found

    def line(self, echo: Echo) -> PointLine | None:
        """The line of an echo; None if no lit ground has its range and Doppler."""
        place = self._place(echo)
        return None if place is None else self.lines.line(place)

    def surroundings(self, echo: Echo) -> Contrast:
        """The contrast of the clutter about an echo."""
        place = self._place(echo)
        return (None if place is None else self.lines.surroundings(place)) or UNLIT

    def _place(self, echo: Echo) -> ProminentPoint | None:
        return None if self._seeds is None else self.lines.place(echo, self._seeds)

    @cached_property
    def _seeds(self) -> Seeds | None:
        return None if self.region is None else self.lines.seeds(self.region)

    @cached_property
    def lit(self) -> bool:
        """Tell whether the beam lights any place long enough to compare; also true if the grid is outside the beam."""
        if self.outside is not None or self.region is None or self.prominent:
            return True
        return any(self.lines.lit(place) for place in self._cover(self.region))

    @cached_property
    def patches(self) -> list[tuple[Echo, Contrast]]:
        """Echoes amid clutter spread over the region, and their contrast; dark places are skipped."""
        places = [] if self.region is None or self.outside is not None else self._cover(self.region)
        seen = [(place, self.lines.surroundings(place)) for place in places]
        return [(self.lines.echo(place), contrast) for place, contrast in seen if contrast is not None]

    def _cover(self, region: Region) -> list[ProminentPoint]:
        """Places spread over the region in random order, each with the pulse in the middle of its dwell."""
        geometry = self.lines.geometry
        yaws, shares = ((np.arange(n) + 0.5) / n for n in self.ground.patches)
        yaw = region.yaw[0] + (region.yaw[-1] - region.yaw[0]) * yaws
        near, far = region.at(yaw)
        point = geometry.ground_point(near + (far - near) * shares[:, None], yaw).reshape(-1, 3)
        x, y = point[np.random.default_rng(0).permutation(len(point)), :2].T
        first, last = geometry.beam.longest_pass(x, y)
        return [
            ProminentPoint(float(a), float(b), 0.0, int(p)) for a, b, p in zip(x, y, (first + last) // 2, strict=True)
        ]


@dataclass
class _Pairs:
    """Contrasts of the same echoes as given and under an alternative, with the lines under it."""

    given: list[Contrast] = field(default_factory=list)
    other: list[Contrast] = field(default_factory=list)
    lines: list[PointLine] = field(default_factory=list)

    def append(self, given: Contrast, other: Contrast, line: PointLine | None = None) -> None:
        self.given.append(given)
        self.other.append(other)
        self.lines += [] if line is None else [line]

    @property
    def settled(self) -> bool:
        """Tell whether these echoes rule the alternative out."""
        return len(self.given) >= SETTLED and deviations(self.given, self.other) < -SIGNIFICANT

    def trial(self, of: Alternative) -> Trial:
        return Trial(
            of.name, of.remedy, tuple(self.given), tuple(self.other), tuple(line.focus for line in self.lines),
            tuple(concentration(line.values) for line in self.lines), changes=of.changes, of_beam=of.of_beam,
        )  # fmt: skip


def as_given(view: View) -> Trial:
    """Measure the prominent echoes as given, or the clutter if there are none."""
    pairs = _Pairs()
    for _, line in view.prominent:
        pairs.append(line.contrast, line.contrast, line)
    for _, contrast in () if view.prominent else view.patches:
        pairs.append(contrast, contrast)
    return pairs.trial(view.alternative)


def after_refocus(view: View, phase: FloatArray) -> Trial:
    """Measure the prominent echoes as given and with a phase error (n_pulse,), rad, removed."""
    pairs = _Pairs()
    for _, line in view.prominent:
        mended = view.lines.line(line.place, phase=phase)
        if mended is not None:
            pairs.append(line.contrast, mended.contrast, mended)
    return pairs.trial(view.alternative)


def compare(given: View, other: Alternative) -> Trial:
    """Compare the same echoes as given and under an alternative.

    Those are the prominent ones of either; if the alternative moves them in range, as the chirp's sign does, all that
    short apertures see; and patches of clutter if nothing is prominent.
    """
    pairs, view = _Pairs(), given.under(other)
    try:
        if view.outside is None:
            _compare(given, view, pairs)
    except InputError:  # its track does not see the grid, for example
        pass
    return pairs.trial(other)


def _compare(given: View, view: View, pairs: _Pairs) -> None:
    other = view.alternative
    if other.moves_in_range and (given.prominent or view.prominent):
        for here, there in zip(given.samples.overview(), view.samples.overview(), strict=True):
            pairs.append(here, there)
        pairs.lines += [line for _, line in view.prominent]
        return
    for echo, mine in given.prominent:
        line = view.line(other.echo(echo))
        if line is None or not view.lines.known(line, pairs.lines):
            pairs.append(mine.contrast, UNLIT if line is None else line.contrast, line)
        if pairs.settled:
            return
    for echo, contrast in () if given.prominent else given.patches:
        pairs.append(contrast, view.surroundings(other.echo(echo)))
        if pairs.settled:
            return
    if view.prominent and not given.prominent:
        pairs.given.clear()
        pairs.other.clear()
    for echo, line in view.prominent:
        if not view.lines.known(line, pairs.lines):
            before = given.line(other.echo(echo))
            pairs.append(UNLIT if before is None else before.contrast, line.contrast, line)
