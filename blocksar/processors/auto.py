"""The choice of a processor: the one that keeps the fidelity in the least time, or nearly.

Processors that take any collection come first: their plans cost little, and one of them serves nearly always. Those
that expand about a place or a time, as chains do, err more, serve fewer collections, and search long for a division.
One of them is taken where it keeps the fidelity in at most WORTH of the time of the others, and is not planned whole
where it is known early that it does not (`base.Bounding`).

Of the chains, which are alike, only that of the main paper is compared.

Times are those of a machine whose pace is 1, so that the choice is the same on every machine with as many workers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from blocksar.constants import MIB
from blocksar.errors import InputError
from blocksar.imaging.method import ChainOptions
from blocksar.processors import AUTO, PROCESSORS, options_for
from blocksar.processors.base import Bound, Bounding, Comparison, ImagePlan, Problem, is_general, usual_seconds
from blocksar.texts import digits, time_text

# Where an image is not planned whole, coherence is at most, and time at least, what is shown.
HEADER = ("processor", "coherence", "time, usual pace", "memory (MiB)", "disk (MiB)", "keeps the fidelity")


WORTH = 0.5  # of the time of those that take any collection: half, in words as well


@dataclass(frozen=True)
class Candidate:
    """A processor with its plan and predicted seconds, what a plan cannot be better than, or why it has none."""

    processor: str
    plan: ImagePlan | None = None
    seconds: float = 0.0
    bound: Bound | None = None
    refusal: str = ""

    @property
    def serves(self) -> bool:
        """Whether it has a plan that keeps the fidelity."""
        return self.plan is not None and self.plan.faithful

    @property
    def row(self) -> list[str]:
        """Its row of the table: bounds are marked, and what is not known is left out."""
        if self.plan is None:
            least, most = "-", "-"
            if self.bound is not None:
                least = f"at least {time_text(self.bound.seconds)}" if self.bound.seconds else "-"
                most = f"at most {digits(self.bound.coherence)}" if self.bound.coherence < 1 else "-"
            unknown = self.bound is not None and self.bound.faithful
            return [self.processor, most, least, "-", "-", "-" if unknown else "no"]
        return [
            self.processor,
            digits(self.plan.coherence),
            time_text(self.seconds),
            f"{self.plan.memory(1) / MIB:.0f}",
            f"{self.plan.stored_bytes() / MIB:.0f}",
            "yes" if self.plan.faithful else "no",
        ]


class Auto:
    """Plans several processors, and takes the fastest that keeps the fidelity, or nearly."""

    name = AUTO
    summary = "a fast one that keeps the fidelity"
    options = ChainOptions
    universal = True
    general = True
    compared = False
    on_gpu = True

    def check(self, options: Any) -> None:
        """Refuse options of chains: processors are compared with their defaults."""

    def plan(self, problem: Problem) -> ImagePlan:
        """Plan an image by several processors; return the chosen plan, with all others in `compared`.

        Raises
        ------
        InputError
            If no processor can form it: the reason of the last, which takes any collection.
        """
        parts = {
            name: part
            for name, part in PROCESSORS.sound()
            if part.compared and (part.on_gpu or problem.device == "cpu")
        }
        with suppress(InputError):
            _ = problem.pieces  # found once for all of them
        found = {name: _candidate(name, problem) for name, part in parts.items() if part.universal}
        usual = min((each for each in found.values() if each.serves), key=_seconds, default=None)
        most = math.inf if usual is None else WORTH * usual.seconds
        found |= {name: _candidate(name, problem, most) for name, part in parts.items() if not part.universal}
        candidates = [found[name] for name in parts]
        chosen, reason = _choose(candidates, usual, most)
        if chosen.plan is None:
            raise InputError(chosen.refusal)
        reason += "".join(f"; {each.processor} cannot: {each.refusal}" for each in candidates if each.refusal)
        table = HEADER, [each.row for each in candidates]
        return replace(chosen.plan, compared=Comparison(reason=reason, table=table))


CHOICE = Auto()


def _seconds(candidate: Candidate) -> float:
    return candidate.seconds


def _choose(candidates: Sequence[Candidate], usual: Candidate | None, most: float) -> tuple[Candidate, str]:
    """The candidate to take, and why.

    `usual` is the fastest of those that take any collection and keep the fidelity; others have to take `most` seconds.
    """
    quick = [each for each in candidates if each.serves and each is not usual and each.seconds <= most]
    planned = [each for each in candidates if each.plan is not None]
    if quick:
        best = min(quick, key=_seconds)
        reason = f"{best.processor} is chosen: it keeps the fidelity in the least time"
    elif usual is not None:
        best = usual
        reason = (
            f"{best.processor} is chosen: it keeps the fidelity in the least time of those that take any collection"
        )
    elif planned:
        best = max(planned, key=lambda each: each.plan.coherence if each.plan else 0.0)
        return best, f"no processor keeps the fidelity; {best.processor} comes closest"
    else:
        return candidates[-1], ""
    for each in candidates:
        if each.bound is not None:
            late = ", more than half as long" if each.bound.seconds else ""
            reason += f"; {each.processor} is not planned: {each.bound.reason}{late}"
        elif each.serves and each.seconds < best.seconds:
            reason += f"; {each.processor} does too, but takes more than half as long"
        elif each.plan is not None and each.seconds < best.seconds:
            reason += f"; {each.processor}, which takes less, does not"
    return best, reason


def _candidate(name: str, problem: Problem, most: float = math.inf) -> Candidate:
    """Plan an image by a processor; one that has to take at most so many seconds may say that it takes longer."""
    part, problem = PROCESSORS.get(name), problem.with_options(options_for(name, {}))
    departures = [each for collection in problem.collections for each in collection.departures]
    if departures and not is_general(part):
        remedy = f" ({departures[0].remedy}, and it can)" if departures[0].remedy else ""
        return Candidate(name, refusal=departures[0].fact + remedy)
    try:
        within = part.plan_within if isinstance(part, Bounding) and most < math.inf else None
        plan = part.plan(problem) if within is None else within(problem, most)
    except InputError as error:
        return Candidate(name, refusal=str(error))
    if isinstance(plan, Bound):
        return Candidate(name, bound=plan)
    if plan.refusal is not None:
        return Candidate(name, refusal=plan.refusal)
    return Candidate(name, plan, usual_seconds(plan.work(), problem.machine))
