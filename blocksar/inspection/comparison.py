"""The same echoes as given and under an alternative."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.beam import lit_interval
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry, over_terrain
from blocksar.collection.grid import Grid
from blocksar.collection.region import Region, plan_region
from blocksar.collection.terrain import Terrain
from blocksar.errors import InputError, OutsideSwath
from blocksar.inspection.alternatives import Alternative
from blocksar.inspection.contrast import SIGNIFICANT, UNLIT, Contrast, deviations
from blocksar.inspection.prominent import Echo, Line, Lines, Place, Samples, Seeds
from blocksar.inspection.sharpness import concentration
from blocksar.inspection.verdict import Trial

PLACES, CANDIDATES = 12, 24  # prominent ones that are compared, and that are looked at
PATCHES, FEW_PATCHES = (4, 6), (3, 4)  # yaws and ranges at which clutter is compared; beside a run
SETTLED = 3  # echoes that rule an alternative out, if they do beyond chance: no more are looked at


@dataclass(frozen=True)
class Ground:
    """Where echoes come from, and the yaws and ranges at which clutter is compared."""

    grid: Grid | None
    terrain: Terrain | None
    patches: tuple[int, int] = PATCHES

    def geometry(self, collection: Collection) -> Geometry:
        return Geometry(collection=collection) if self.terrain is None else over_terrain(collection, self.terrain)

    def region(self, geometry: Geometry) -> Region:
        return plan_region(geometry, self.grid)


@dataclass(frozen=True, eq=False)
class View:
    """Samples and their ground under an alternative."""

    alternative: Alternative
    samples: Samples
    ground: Ground

    def under(self, other: Alternative) -> View:
        """The view under an alternative to this one; where only samples differ, of the same ground."""
        samples = self.samples
        if other.samples is not None:
            signal = np.ascontiguousarray(other.samples(samples.signal))
            samples = Samples(signal, samples.collection, threads=samples.threads)
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
        """The ground to look at; all that is lit if the grid lies outside it; None if that is nothing."""
        return self._looked_at[0]

    @property
    def outside(self) -> OutsideSwath | None:
        """Why nothing of the grid is seen, if so."""
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
    def prominent(self) -> list[tuple[Echo, Line]]:
        """The most prominent echoes that are lit, and their lines, each of a place of its own."""
        found: list[tuple[Echo, Line]] = []
        if self.region is None or self.outside is not None:
            return found
        for place in self.lines.places(self.region, CANDIDATES):
            line = self.lines.line(place)
            if line is not None and not self.lines.known(line, [other for _, other in found]):
                found.append((self.lines.echo(place), line))
            if len(found) == PLACES:
                break
        return found

    def line(self, echo: Echo) -> Line | None:
        """The line of an echo; None if nothing lit has its range and Doppler."""
        place = self._place(echo)
        return None if place is None else self.lines.line(place)

    def surroundings(self, echo: Echo) -> Contrast:
        """The contrast of the clutter about an echo."""
        place = self._place(echo)
        return (None if place is None else self.lines.surroundings(place)) or UNLIT

    def _place(self, echo: Echo) -> Place | None:
        return None if self._seeds is None else self.lines.place(echo, self._seeds)

    @cached_property
    def _seeds(self) -> Seeds | None:
        return None if self.region is None else self.lines.seeds(self.region)

    @cached_property
    def lit(self) -> bool:
        """Whether the beam lights anything for long enough to be compared; or nothing of the grid at all."""
        if self.outside is not None or self.region is None or self.prominent:
            return True
        return any(self.lines.lit(place) for place in self._cover(self.region))

    @cached_property
    def patches(self) -> list[tuple[Echo, Contrast]]:
        """Echoes amid clutter that cover the region, and their contrast; none that are dark."""
        places = [] if self.region is None or self.outside is not None else self._cover(self.region)
        seen = [(place, self.lines.surroundings(place)) for place in places]
        return [(self.lines.echo(place), contrast) for place, contrast in seen if contrast is not None]

    def _cover(self, region: Region) -> list[Place]:
        """Places over the region, in an order in which the first few cover it; each with a pulse amid its dwell."""
        geometry = self.lines.geometry
        yaws, shares = ((np.arange(n) + 0.5) / n for n in self.ground.patches)
        yaw = region.yaw[0] + (region.yaw[-1] - region.yaw[0]) * yaws
        near, far = region.at(yaw)
        point = geometry.ground_point(near + (far - near) * shares[:, None], yaw).reshape(-1, 3)
        x, y = point[np.random.default_rng(0).permutation(len(point)), :2].T
        first, last = lit_interval(geometry, x, y)
        return [Place(float(a), float(b), 0.0, int(p)) for a, b, p in zip(x, y, (first + last) // 2, strict=True)]


@dataclass
class _Pairs:
    """Contrasts of echoes as given and under an alternative, and the lines under it."""

    given: list[Contrast] = field(default_factory=list)
    other: list[Contrast] = field(default_factory=list)
    lines: list[Line] = field(default_factory=list)

    def append(self, given: Contrast, other: Contrast, line: Line | None = None) -> None:
        self.given.append(given)
        self.other.append(other)
        self.lines += [] if line is None else [line]

    @property
    def settled(self) -> bool:
        """Whether these echoes rule the alternative out."""
        return len(self.given) >= SETTLED and deviations(self.given, self.other) < -SIGNIFICANT

    def trial(self, of: Alternative) -> Trial:
        return Trial(
            of.name, of.remedy, tuple(self.given), tuple(self.other), tuple(line.focus for line in self.lines),
            tuple(concentration(line.values) for line in self.lines), changes=of.changes, of_beam=of.of_beam,
        )  # fmt: skip


def as_given(view: View) -> Trial:
    """The prominent echoes as given, or the clutter if there are none."""
    pairs = _Pairs()
    for _, line in view.prominent:
        pairs.append(line.contrast, line.contrast, line)
    for _, contrast in () if view.prominent else view.patches:
        pairs.append(contrast, contrast)
    return pairs.trial(view.alternative)


def after_refocus(view: View, phase: FloatArray) -> Trial:
    """The prominent echoes as given, and without a phase error (n_pulse,), rad."""
    pairs = _Pairs()
    for _, line in view.prominent:
        mended = view.lines.line(line.place, phase=phase)
        if mended is not None:
            pairs.append(line.contrast, mended.contrast, mended)
    return pairs.trial(view.alternative)


def compare(given: View, other: Alternative) -> Trial:
    """The same echoes as given and under an alternative.

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
