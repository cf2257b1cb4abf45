"""Whether the samples are what is said of them: prominent places over the whole dwell, as given and otherwise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from blocksar.arrays import ComplexArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry, over_terrain
from blocksar.collection.grid import Grid
from blocksar.collection.region import Region, plan_region
from blocksar.collection.terrain import Terrain
from blocksar.errors import InputError
from blocksar.inspection.alternatives import Alternative, alternatives, as_given
from blocksar.inspection.pointing import Pointing, point
from blocksar.inspection.prominent import Line, Lines, Samples
from blocksar.inspection.sharpness import Refocus, blurring_phase, concentration, explain, judged_by_others, refocus

PLACES = 12  # that are compared
FEWEST = 2  # places on which anything can be said
SIGNIFICANT = 30.0  # times 1 / n: concentration that chance does not give
# Times the concentration as given: an alternative that is believed. The true one gains 4 to 20 dB under a steered beam.
# A wrong velocity gains up to 2 dB by a reversed range axis, as both change Doppler rates by a few per cent; and flown
# backwards on a straight line an image is mirrored, and as sharp.
SURE, SHARPER = 2.0, 1.02  # steered, not steered
CLEARLY = 1.5  # times the same: an alternative that is named beside an error of the beam
DOUBTED = 0.95  # of the concentration after a refocus: with less, an alternative that gains too little is remarked
TIED = 0.75  # of the concentration of the sharpest alternative: simpler ones with more are not told from it
# Under a beam that is not steered, conjugated, reversed or swapped data give a mirrored image, nearly as sharp.
# Places with more than this share of the concentration after a refocus are blurred by nothing, and differ from others
# by chance.
SETTLED = 0.98
FOCUSED = 0.5  # median concentration of points: an alternative with less is believed only if its best places gain
BEST, BEST_SHARPER = 2, 1.25  # number of these, and times the concentration of the best as given
AS_REFOCUSED = 0.95  # of the concentration after a refocus, that it reaches as well
SEEN_TOO = 0.5  # of the places of an alternative, as many that are prominent as given
REFOCUSED = 0.15  # concentration that a refocus reaches where the track is doubted: what stays below is no point
CERTAIN = 0.65  # share of pairs of a place each of which its own is the sharper: by chance 0.5, with 12 of each +- 0.12
CLEAR = 0.65  # concentration that only points in focus have: below it, alternatives are tried
SHARP = 0.8  # of the concentration after a refocus: below it the track is doubted
COVERED = 0.5  # of a dwell: with less, other places do not judge a place, and it judges itself if it is CLEAR
POINTS = 1 / 3  # of the places: as many that become FOCUSED judge the track alone, without those that are clutter
LIKE_DWELL = 0.5  # of the pulses of a dwell, without which only points tell of an alternative
EXPLAINED = 0.8  # of a phase error: what is named as its cause
# To be read: a part of the band, and of very many pulses those in the middle. Under a beam that is not steered less
# depends on the sign and order of the samples.
MOST_SAMPLES, MOST_UNSTEERED = 1 << 20, 1 << 21
SPIKE = 1e4  # times the median modulus: samples that are left out
LEAST_BAND, MOST_PULSES = 128, 1 << 15


@dataclass(frozen=True)
class Trial:
    """An alternative, and how sharp its prominent places are.

    Attributes
    ----------
    name : str
    remedy : str
        What to change where it is right.
    concentration : tuple of float
        Of each place, the most prominent first.
    pulses : float
        Median number that light a place: chance concentrates few pulses more than many.
    significance : float
        Median of concentration over what chance gives.
    changes : int
        Number of changes to the samples that it makes: of those that tie, the fewest are believed.
    of_beam : bool
        Whether it changes what is lit.
    """

    name: str
    remedy: str
    concentration: tuple[float, ...] = ()
    significance: float = 0.0
    pulses: float = 0.0
    changes: int = 1
    of_beam: bool = False

    @property
    def places(self) -> int:
        """Number of prominent places."""
        return len(self.concentration)

    @property
    def sharpness(self) -> float:
        """Median concentration of the places."""
        return float(np.median(self.concentration)) if self.concentration else 0.0

    @property
    def best(self) -> float:
        """Mean concentration of the sharpest places."""
        return float(np.mean(sorted(self.concentration)[-BEST:])) if self.concentration else 0.0


class Points(NamedTuple):
    """Median concentrations of the places that judge the track, as points do and clutter does not.

    As given, after a refocus, and refocused by other places alone.
    """

    given: float
    refocused: float
    by_others: float


@dataclass(frozen=True)
class Findings:
    """The result of a check.

    Attributes
    ----------
    trials : tuple of Trial
        As given first, then the alternatives that were tried, the sharpest first.
    refocused : float
        Median concentration as given, after a refocus.
    track_phase : float
        Root mean square phase error that the refocus removed, rad.
    cause : str
        What explains that error, empty if nothing simple does.
    remedy : str
    points : Points or None
        What judges the track.
    steered : bool
        Whether the beam is.
    pointing : Pointing or None
        What tells of the beam. If it found an error, one of the trials has its name.
    """

    trials: tuple[Trial, ...]
    refocused: float
    track_phase: float
    cause: str
    remedy: str
    points: Points | None = None
    steered: bool = True
    pointing: Pointing | None = None

    @property
    def given(self) -> Trial:
        return self.trials[0]

    @property
    def judged(self) -> Points:
        """What judges the track: the points, or else the median of all places."""
        return self.points or Points(self.given.sharpness, self.refocused, self.refocused)

    @property
    def speaks(self) -> bool:
        """Whether prominent places allow a judgement."""
        judged = [trial.significance for trial in self.trials if trial.places >= FEWEST]
        return self.given.places >= FEWEST and max(judged, default=0.0) > SIGNIFICANT

    @property
    def mended(self) -> bool:
        """Whether a common phase error makes places sharp: the track is wrong, as no phase lights pulses of a dwell."""
        given, refocused, by_others = self.judged
        return min(refocused, by_others) >= FOCUSED and given < SHARP * by_others

    @property
    def beam(self) -> Trial | None:
        """The trial of a beam whose error was undone, if that is to be believed."""
        found = self.pointing.found if self.pointing and not self.mended else None
        trial = next((t for t in self.trials[1:] if found is not None and t.name == found.name), None)
        least = TIED * self.given.sharpness
        return trial if trial is not None and trial.places >= FEWEST and trial.sharpness >= least else None

    @property
    def likely(self) -> Trial | None:
        """The alternative that is sharper than as given beyond chance, if any; by however little."""
        good = [t for t in self.trials[1:] if t.places >= FEWEST and t.significance > SIGNIFICANT]
        if self.mended:  # what sees a part of the dwell is less blurred
            good = [t for t in good if not t.of_beam and t.pulses >= LIKE_DWELL * self.given.pulses]
        best = max(good, key=lambda trial: trial.sharpness, default=None)
        if best is None or best.sharpness < max(SHARPER * self.given.sharpness, AS_REFOCUSED * self.refocused):
            return None
        if not self.given.places:
            return best if best.sharpness > FOCUSED else None
        if best.pulses < LIKE_DWELL * self.given.pulses and best.sharpness < FOCUSED:
            return None  # of a smaller part of the dwell, clutter is more concentrated by chance
        if not self.steered and self.given.sharpness > max(FOCUSED, SETTLED * self.refocused):
            return None
        few = self.given.places < SEEN_TOO * best.places  # as given, that the best of more were sharper by chance
        if best.sharpness < FOCUSED and (few or best.best < BEST_SHARPER * self.given.best):
            return None  # most places are clutter, whose concentration differs by chance
        gain = np.subtract.outer(best.concentration, self.given.concentration)
        if np.mean((1 + np.sign(gain)) / 2) <= CERTAIN:
            return None
        return min((t for t in good if t.sharpness >= TIED * best.sharpness), key=lambda t: (t.changes, -t.sharpness))

    @property
    def better(self) -> Trial | None:
        """The alternative to be believed, if any, but for an error of the beam."""
        likely = self.likely
        if likely is None or likely.sharpness < (SURE if self.steered else SHARPER) * self.given.sharpness:
            return None
        return likely if self.beam is None or likely.sharpness >= SURE * self.beam.sharpness else None

    @property
    def tied(self) -> list[Trial]:
        """Alternatives that places do not tell from the one that is believed, the sharpest first."""
        if (better := self.better) is not None:
            least = TIED * better.sharpness
        elif self.beam is not None:  # over a part of their dwell places are as sharp, so that only clear gains count
            least = max(AS_REFOCUSED * self.beam.sharpness, CLEARLY * self.given.sharpness)
        else:
            return []
        believed, rival = better or self.beam, self.pointing.rival if self.pointing else ""
        known = {believed.name, rival} if believed else set()
        return [t for t in self.trials[1:] if t.places >= FEWEST and t.sharpness >= least and t.name not in known]

    @property
    def sharpness(self) -> float:
        """Concentration as given over that after a refocus."""
        return self.judged.given / max(self.judged.refocused, 1e-30)

    @property
    def blurred(self) -> bool:
        """Whether a refocus helps so much that the track must be wrong."""
        said = self.speaks and (self.better or self.beam) is None and self.sharpness < SHARP
        return said and self.judged.refocused >= REFOCUSED and not self.spread

    @property
    def spread(self) -> bool:
        """Whether what a refocus gains is each place's own, as of clutter and broad targets."""
        return self.points is not None and self.sharpness < SHARP and self.points.given > SHARP * self.points.by_others

    def warning(self) -> str | None:
        """What is wrong, with figures and the remedy; None if nothing is."""
        if (better := self.better) is not None:
            gain = self._decibels(better)
            return (
                f"{better.name}, it seems: so {better.places} prominent places are sharper by {gain:.1f} dB over their "
                f"whole dwell; {better.remedy}{self._unsure(gain)}{self._ties()}"
            )
        if self.beam is not None and self.pointing is not None:
            rival = f" (or {self.pointing.rival}: these places do not tell)" if self.pointing.rival else ""
            return (
                f"{self.beam.name}{rival}, it seems: so {self.pointing.places} prominent places are lit when they "
                f"should be, with {self.pointing.gain:.1f} dB more power a pulse; {self.beam.remedy}{self._ties()}"
            )
        if self.blurred:
            cause = f", as by {self.cause}" if self.cause else ""
            return (
                f"prominent places reach {self.sharpness:.2f} of the sharpness that a refocus gives them: the track is "
                f"off by a phase of {self.track_phase:.2g} rad r.m.s. over a dwell{cause}; {self.remedy}"
            )
        return None

    def sentence(self) -> str:
        """One line for people."""
        if (warning := self.warning()) is not None:
            return warning
        if not self.speaks:
            return "no prominent places: nothing can be said of the samples' sign and order, or of errors of the track"
        if self.spread:
            return (
                f"the {self.given.places} most prominent places are clutter or broad targets, as no phase error is "
                "common to them: nothing can be said of errors of the track"
            )
        return (
            f"the samples fit what is said of them: {self.given.places} prominent places reach "
            f"{min(self.sharpness, 1):.2f} of the sharpness that a refocus gives them{self._of_the_beam()}"
            f"{self._doubt()}"
        )

    def _decibels(self, trial: Trial) -> float:
        return float(10 * np.log10(trial.sharpness / max(self.given.sharpness, 1e-30)))

    def _unsure(self, gain: float) -> str:
        """What else gives a small gain."""
        cause = f", as by {self.cause}" if self.cause else ""
        return "" if gain >= 10 * np.log10(SURE) else f"; an error of the track gives as much{cause}: check it first"

    def _ties(self) -> str:
        """What places do not tell from what is believed."""
        others = " or ".join(f"{t.name} ({self._decibels(t):.1f} dB: {t.remedy})" for t in self.tied[:2])
        return f". These places do not tell whether {others}: look whether the image is mirrored" if others else ""

    def _of_the_beam(self) -> str:
        """Whether the beam was tried."""
        if not self.steered:
            return ""
        if self.pointing is None or not self.pointing.told:
            return "; of the beam's angle they do not tell: too few are points"
        if self.pointing.found is not None:  # and is not believed
            return "; of the beam's angle they do not tell"
        reach = np.degrees(self.pointing.reach)
        return f"; the beam lights them when it should (errors up to {reach:.2g} degrees are tried)"

    def _doubt(self) -> str:
        """An alternative that gains too little to be believed."""
        likely = self.likely
        if likely is None or likely.sharpness <= self.given.sharpness or self.sharpness > DOUBTED:
            return ""
        return (
            f". They are sharper by {self._decibels(likely):.1f} dB if {likely.name}, which an error of the track by "
            "a per cent of the velocity gives as well"
        )


def part_to_read(collection: Collection) -> tuple[slice, slice]:
    """Pulses and range frequencies that a check reads: the middle of the band."""
    most = MOST_SAMPLES if collection.steered else MOST_UNSTEERED
    pulses = _middle(collection.n_pulse, MOST_PULSES)
    width = max(most // (pulses.stop - pulses.start), LEAST_BAND)
    return pulses, _middle(collection.n_range_frequency, width)


def part_of(collection: Collection, pulses: slice, columns: slice) -> Collection:
    """The collection of some pulses and range frequencies."""
    names = ["time", "reference_range", "antenna_position", "beam_azimuth"]
    names += ["beam_axis", "beam_steering"] if collection.has_axis else []
    return replace(
        collection,
        range_frequency=collection.range_frequency[columns],
        **{name: getattr(collection, name)[pulses] for name in names},
    )


def _middle(size: int, at_most: int) -> slice:
    width = min(size, at_most)
    return slice((size - width) // 2, (size - width) // 2 + width)


def check(
    signal: ComplexArray,
    collection: Collection,
    *,
    grid: Grid | None,
    threads: int,
    thorough: bool,
    terrain: Terrain | None = None,
) -> Findings:
    """Compare prominent places as given with the alternatives.

    Parameters
    ----------
    signal : (n_pulse, n_range_frequency) complex64
    collection : Collection
        Of these samples.
    grid : Grid or None
        Where to look; needed if the beam is not steered.
    threads : int
    thorough : bool
        Try all alternatives, even if the places are sharp as given.
    terrain : Terrain, optional
        The ground that places stand on; where it has no height, and by default, the plane.

    Raises
    ------
    InputError
        If the beam is not steered and there is no grid, or the grid lies outside the swath.
    """
    signal = _cleaned(signal)
    given, samples = as_given(collection), Samples(signal, collection, threads=threads)
    ground = _Ground(grid, terrain)
    lines = ground.lines(collection, samples)
    first = _trial(given, lines)
    n_pulse, remedy, cause, refocused, left, points = collection.n_pulse, "", "", first.sharpness, 0.0, None
    if first.places >= FEWEST:
        mended = refocus(lines, n_pulse)
        points = _points(lines, mended, n_pulse)
        refocused, left = float(np.median(mended.concentration)), blurring_phase(lines, mended.phase)
        good = [error for error in explain(lines, mended.phase, collection) if error.explained > EXPLAINED]
        cause = " or ".join(error.text for error in good)
        remedy = good[0].remedy if good else "mend the track from the data (autofocus)"
    findings = Findings(
        (first,), refocused, left, cause, remedy, points=points, steered=collection.steered,
        pointing=point(samples, collection, ground.geometry, ground.region, thorough=thorough),
    )  # fmt: skip
    moved = findings.pointing.found if findings.pointing is not None else None
    if thorough or moved is not None or first.places >= FEWEST:
        doubtful = first.sharpness < CLEAR or first.significance < SIGNIFICANT or findings.sharpness < SHARP
        doubtful = doubtful or moved is not None
        tried = alternatives(collection)
        # Under a beam that is not steered a conjugated signal gives a mirrored image, nearly as sharp.
        tried = tried if thorough or doubtful else [] if collection.steered else tried[:1]
        if moved is not None:
            tried = [*(other for other in tried if other.name != moved.name), moved]
        others = [_tried(other, samples, ground) for other in tried]
        findings = replace(findings, trials=(first, *sorted(others, key=lambda trial: -trial.sharpness)))
    return findings


def _points(lines: list[Line], mended: Refocus, n_pulse: int) -> Points:
    """What judges the track: places that are points if there are enough, else all."""
    given, others = np.array([concentration(line.values) for line in lines]), judged_by_others(lines, n_pulse)
    alone = np.where(mended.concentration >= CLEAR, mended.concentration, given)
    by_others = np.where(others.covered >= COVERED, others.concentration, alone)
    points = np.maximum(given, by_others) >= FOCUSED
    if points.sum() < max(FEWEST, POINTS * len(lines)):
        points[:] = True
    return Points(*(float(np.median(values[points])) for values in (given, mended.concentration, by_others)))


def _cleaned(signal: ComplexArray) -> ComplexArray:
    """The samples over their median modulus, zero where they are missing or spikes."""
    modulus = np.abs(signal).astype(np.float64)
    valid = np.isfinite(modulus) & (modulus > 0)
    if not valid.any():
        return np.zeros_like(signal)
    median = float(np.median(modulus[valid]))
    valid &= modulus < SPIKE * median
    clean = np.zeros(signal.shape, np.complex64)
    np.divide(signal, median, out=clean, where=valid, casting="unsafe")
    return clean


@dataclass(frozen=True)
class _Ground:
    """Where prominent places are looked for."""

    grid: Grid | None
    terrain: Terrain | None

    def geometry(self, collection: Collection) -> Geometry:
        return Geometry(collection=collection) if self.terrain is None else over_terrain(collection, self.terrain)

    def region(self, geometry: Geometry) -> Region:
        return plan_region(geometry, self.grid)

    def lines(self, collection: Collection, samples: Samples) -> list[Line]:
        source = Lines(samples, self.geometry(collection))
        places = source.places(self.region(source.geometry), PLACES)
        return [line for line in map(source.line, places) if line is not None]


def _tried(other: Alternative, given: Samples, ground: _Ground) -> Trial:
    samples = given
    if other.samples is not None:
        signal = np.ascontiguousarray(other.samples(given.signal))
        samples = Samples(signal, given.collection, threads=given.threads)
    try:
        return _trial(other, ground.lines(other.collection, samples))
    except InputError:  # its track does not see the grid, for example
        return Trial(other.name, other.remedy, changes=other.changes, of_beam=other.of_beam)


def _trial(alternative: Alternative, lines: list[Line]) -> Trial:
    if not lines:
        return Trial(alternative.name, alternative.remedy, changes=alternative.changes, of_beam=alternative.of_beam)
    values = np.array([concentration(line.values) for line in lines])
    return Trial(
        alternative.name,
        alternative.remedy,
        concentration=tuple(values.tolist()),
        pulses=float(np.median([line.values.size for line in lines])),
        significance=float(np.median(values * [line.values.size for line in lines])),
        changes=alternative.changes,
        of_beam=alternative.of_beam,
    )
