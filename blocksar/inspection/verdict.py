"""Verdict of a check, as figures and sentences."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from blocksar.inspection.pointing import Pointing
from blocksar.inspection.prominent import SIGNIFICANT, Contrast, deviations

IN_FOCUS = 0.5  # share of the energy near it that a point in focus holds; the largest of speckle holds a fifth
AS_SHARP = 0.6  # of the best focus of any alternative: with less, one is not believed
TIED = 0.75  # of the concentration as given: a moved beam is accepted if places keep as much
REFOCUSED = 0.15  # concentration that a refocus reaches where the track is doubted: what stays below is no point
FOCUSED = 0.5  # concentration of points after a refocus, where the track and not the beam is doubted
SHARP = 0.8  # of the concentration after a refocus: below it the track is doubted
ALIKE = 3.0  # standard deviations: gains of two alternatives that differ by less do not tell them apart
MIRRORED = "the axes of the scene are mirrored"
NAMED = 4  # alternatives that a sentence names


@dataclass(frozen=True)
class Trial:
    """An alternative, and the contrast of echoes under it.

    Attributes
    ----------
    name : str
    remedy : str
        What to change where it is right.
    given, contrast : tuple of Contrast
        Of each echo as given, and under the alternative.
    focus : tuple of float
        Of each echo under the alternative, see `Line`; empty amid clutter.
    concentration : tuple of float
        Likewise, over the whole dwell.
    changes : int
        Number of changes to the samples that it makes: of those that tie, the fewest are believed.
    of_beam : bool
        Whether it changes what is lit.
    """

    name: str
    remedy: str
    given: tuple[Contrast, ...] = ()
    contrast: tuple[Contrast, ...] = ()
    focus: tuple[float, ...] = ()
    concentration: tuple[float, ...] = ()
    changes: int = 1
    of_beam: bool = False

    @property
    def echoes(self) -> int:
        """Number of echoes that were compared."""
        return len(self.contrast)

    @property
    def in_focus(self) -> float:
        """Median focus of the echoes; 0 amid clutter."""
        return float(np.median(self.focus)) if self.focus else 0.0

    @property
    def sharpness(self) -> float:
        """Median concentration of the echoes."""
        return float(np.median(self.concentration)) if self.concentration else 0.0

    @property
    def gain(self) -> float:
        """Mean gain of contrast, dB."""
        return float(np.mean([b.decibels - a.decibels for a, b in zip(self.given, self.contrast, strict=True)] or [0]))

    @property
    def error(self) -> float:
        """Standard deviation of the gain, dB."""
        variance = sum(a.variance + b.variance for a, b in zip(self.given, self.contrast, strict=True))
        return float(variance**0.5 / max(self.echoes, 1))

    @property
    def deviations(self) -> float:
        """The gain over its standard deviation."""
        return deviations(self.given, self.contrast)

    @property
    def verdict(self) -> str:
        """Describe the gain."""
        if not self.echoes:
            return "nothing to compare"
        if abs(self.deviations) < SIGNIFICANT:
            return "not told"
        return "sharper" if self.deviations > 0 else "ruled out"


class Concentrations(NamedTuple):
    """Median concentrations of the places that judge the track: points rather than clutter.

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
        As given first, then the alternatives that were tried, those that gain most first.
    refocused : float
        Median concentration as given, after a refocus.
    track_phase : float
        Root mean square phase error that the refocus removed, rad.
    cause : str
        What explains that error, empty if nothing simple does.
    remedy : str
    refocus : Trial or None
        The prominent echoes after that refocus, if an alternative has to be compared with it.
    points : Points or None
        What judges the track.
    steered : bool
        Whether the beam is.
    mirrored : bool
        Whether axes of the scene with other signs were left out, as they mirror the image and nothing else.
    pointing : Pointing or None
        What tells of the beam. If it found an error, one of the trials has its name.
    empty : str
        Why nothing could be compared; empty if something was.
    """

    trials: tuple[Trial, ...]
    refocused: float = 0.0
    track_phase: float = 0.0
    cause: str = ""
    remedy: str = ""
    refocus: Trial | None = None
    points: Concentrations | None = None
    steered: bool = True
    mirrored: bool = False
    pointing: Pointing | None = None
    empty: str = ""

    @property
    def given(self) -> Trial:
        return self.trials[0]

    @property
    def clutter(self) -> bool:
        """Whether there are no prominent places, so that clutter was compared."""
        return not self.given.concentration

    @property
    def judged(self) -> Concentrations:
        """Concentrations that judge the track: of the points, or else the median of all places."""
        return self.points or Concentrations(self.given.sharpness, self.refocused, self.refocused)

    @property
    def in_focus(self) -> bool:
        """Whether prominent places are points, sharp in range and along the track."""
        return self.given.in_focus >= IN_FOCUS

    @property
    def speaks(self) -> bool:
        """Tell whether the echoes allow a judgement: points in focus, or an alternative clearly better or worse."""
        return self.in_focus or any(abs(trial.deviations) >= SIGNIFICANT for trial in self.trials[1:])

    @property
    def mended(self) -> bool:
        """Tell whether one phase error common to all places blurs them: the track is wrong."""
        given, refocused, by_others = self.judged
        return min(refocused, by_others) >= FOCUSED and given < SHARP * by_others

    @property
    def _good(self) -> list[Trial]:
        """Alternatives by which echoes gain beyond chance.

        Those are left out that an error of the track would explain as well, and what brings echoes much less into focus
        than something else.
        """
        good = [t for t in self.trials[1:] if t.deviations >= SIGNIFICANT]
        if self.mended:  # an alternative that sees part of the dwell is less blurred
            good = [t for t in good if not t.of_beam]
        focus = AS_SHARP * max(trial.in_focus for trial in self.trials)
        good = [t for t in good if not t.focus or t.in_focus >= focus]
        return [t for t in good if self.refocus is None or t.gain > self.refocus.gain or _tied(t, self.refocus)]

    @property
    def better(self) -> Trial | None:
        """The best alternative, if any; of those that echoes cannot distinguish, the one with the fewest changes."""
        best = max(self._good, key=lambda trial: trial.gain, default=None)
        if best is None:
            return None
        beam = self._moved_beam
        if beam is not None and beam.sharpness >= TIED * self.given.sharpness and _tied(beam, best):
            return beam
        return min((t for t in self._good if _tied(t, best)), key=lambda t: (t.changes, -t.gain))

    @property
    def beam(self) -> Trial | None:
        """The trial of a changed beam, if that is the best alternative."""
        trial = self._moved_beam
        if trial is None or self.mended or not trial.echoes or trial.sharpness < TIED * self.given.sharpness:
            return None
        return trial if self.better in (None, trial) else None

    @property
    def _moved_beam(self) -> Trial | None:
        found = self.pointing.found if self.pointing else None
        return next((t for t in self.trials[1:] if found is not None and t.name == found.name), None)

    @property
    def tied(self) -> list[Trial]:
        """Alternatives that echoes cannot distinguish from the best one, those that gain most first."""
        if (better := self.better) is None:
            return []
        known = {better.name, self.pointing.rival if self.pointing else ""}
        return [t for t in self._good if t.name not in known and _tied(t, better)]

    @property
    def sharpness(self) -> float:
        """Ratio of the concentration as given to that after a refocus."""
        return self.judged.given / max(self.judged.refocused, 1e-30)

    @property
    def blurred(self) -> bool:
        """Whether a refocus helps so much that the track must be wrong."""
        settled = bool(self.given.concentration) and (self.better or self.beam) is None and self.sharpness < SHARP
        return settled and self.judged.refocused >= REFOCUSED and not self.spread

    @property
    def as_sharp(self) -> list[Trial]:
        """Alternatives that sharpen blurred places as much as a refocus does."""
        enough = SHARP * self.given.sharpness / max(self.sharpness, 1e-30)
        return [t for t in self.trials[1:] if t.gain > 0 and t.in_focus >= IN_FOCUS and t.sharpness >= enough]

    @property
    def spread(self) -> bool:
        """Tell whether a refocus gains only because each place fits a phase error of its own, as clutter does."""
        return self.points is not None and self.sharpness < SHARP and self.points.given > SHARP * self.points.by_others

    @property
    def untold(self) -> bool:
        """Tell whether an alternative that mirrors or moves the image is possible: untried, or not distinguished."""
        return len(self.trials) == 1 or self.mirrored or any(t.verdict == "not told" for t in self.trials[1:])

    def warning(self) -> str | None:
        """Say what is wrong, with figures and the remedy; None if nothing is."""
        if (beam := self.beam) is not None and self.pointing is not None:
            rival = f" (or {self.pointing.rival}: these places do not tell)" if self.pointing.rival else ""
            return (
                f"{beam.name}{rival}, it seems: so {self.pointing.places} prominent places are lit when they should "
                f"be, with {self.pointing.gain:.1f} dB more power a pulse; {beam.remedy}{self._ties()}"
            )
        if (better := self.better) is not None:
            what = "prominent places have" if better.focus else "patches of clutter have"
            return (
                f"{better.name}, it seems: so {better.echoes} {what} {better.gain:.2g} dB more contrast over their "
                f"whole dwell, {better.deviations:.0f} standard deviations; {better.remedy}{self._ties()}"
            )
        if self.blurred:
            cause = f", as by {self.cause}" if self.cause else ""
            others = " or ".join(f"{t.name} ({t.remedy})" for t in self.as_sharp[:2])
            others = f". It may as well be that {others}" if others else ""
            return (
                f"prominent places reach {self.sharpness:.2f} of the sharpness that a refocus gives them: the track is "
                f"off by a phase of {self.track_phase:.2g} rad r.m.s. over a dwell{cause}; {self.remedy}{others}"
            )
        return None

    def sentence(self) -> str:
        """The verdict in one line."""
        if (warning := self.warning()) is not None:
            return warning
        if self.empty:
            return f"nothing was tested: {self.empty}"
        if not self.speaks:
            what = "patches of clutter" if self.clutter else "prominent places"
            return (
                f"nothing can be said of the samples' sign and order, or of errors of the track: "
                f"{self.given.echoes} {what} are about as sharp whatever is tried"
            )
        if self.clutter:
            return (
                f"nothing that was tried is sharper: {self.given.echoes} patches of clutter, without prominent places"
                f"{self._compared()}; of errors of the track they do not tell"
            )
        if self.spread:
            return (
                f"the {self.given.echoes} most prominent places are clutter or broad targets, as no phase error is "
                f"common to them: nothing can be said of errors of the track{self._compared()}"
            )
        if not self.in_focus:
            return (
                f"nothing that was tried is sharper, but the {self.given.echoes} most prominent places are no points "
                f"in focus: they hold {self.given.in_focus:.2f} of the energy about them{self._compared()}"
            )
        fit = "the samples fit what is said of them"
        if self.untold:
            fit = "the image is sharp as given, but whether it is mirrored or moved is not told"
        return (
            f"{fit}, as far as {self.given.echoes} prominent places tell: they reach "
            f"{min(self.sharpness, 1):.2f} of the sharpness that a refocus gives them{self._of_the_beam()}"
            f"{self._compared()}"
        )

    def _ties(self) -> str:
        """Name the alternatives that echoes cannot distinguish from the best one."""
        others = " or ".join(f"{t.name} ({t.gain:.2g} dB: {t.remedy})" for t in self.tied[:2])
        return f". They do not tell whether {others}: look whether the image is mirrored" if others else ""

    def _compared(self) -> str:
        """Name the alternatives that were ruled out, and those that remain undecided."""
        if len(self.trials) == 1:
            return "; `blocksar check` tries a mirrored image, and one seen a PRF away"
        text = ""
        for verdict, lead in (("ruled out", "ruled out"), ("not told", "not told from what is given")):
            names = [t.name for t in self.trials[1:] if t.verdict == verdict]
            names += [MIRRORED] if verdict == "not told" and self.mirrored else []
            more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
            text += f"; {lead}: {', '.join(names[:NAMED])}{more}" if names else ""
        return text

    def _of_the_beam(self) -> str:
        """State whether the beam was checked."""
        if not self.steered:
            return ""
        if self.pointing is None or not self.pointing.told:
            return "; of the beam's angle they do not tell: too few are points"
        if self.pointing.found is not None:  # and is not believed
            return "; of the beam's angle they do not tell"
        reach = np.degrees(self.pointing.reach)
        narrower = ", and may be narrower than said" if self.pointing.narrower else ""
        return f"; the beam lights them when it should{narrower} (errors up to {reach:.2g} degrees are tried)"


def _tied(one: Trial, other: Trial) -> bool:
    """Tell whether the gains of two alternatives differ by no more than chance."""
    return abs(one.gain - other.gain) < ALIKE * float(np.hypot(one.error, other.error))
