"""The choice of a processor: several are planned, and the one is taken that keeps the fidelity in the least time.

Of the chains, which are alike, only that of the main paper is compared: to plan where they do not serve takes long.

Times are those of a machine whose pace is 1, so that the choice is the same on every machine with as many workers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from blocksar.constants import MIB
from blocksar.errors import InputError
from blocksar.focusing.method import ChainOptions
from blocksar.planning import effort
from blocksar.processors import AUTO, PROCESSORS, options_for
from blocksar.processors.base import Comparison, ImagePlan, Problem, is_general
from blocksar.processors.chain_tables import digits
from blocksar.texts import time_text

HEADER = ("processor", "coherence", "time, usual pace", "memory (MiB)", "disk (MiB)", "keeps the fidelity")


@dataclass(frozen=True)
class Candidate:
    """A processor with its plan and predicted seconds, or with the reason why it has none."""

    processor: str
    plan: ImagePlan | None = None
    seconds: float = 0.0
    refusal: str = ""


class Auto:
    """Plans several processors, and takes the fastest that keeps the fidelity."""

    name = AUTO
    summary = "the fastest that keeps the fidelity"
    options = ChainOptions
    universal = True
    general = True
    compared = False
    on_gpu = True

    def check(self, options: Any) -> None:
        """Processors are compared as they are: options of chains ask for a chain."""

    def plan(self, problem: Problem) -> ImagePlan:
        """Plan an image by several processors; the plan of the chosen one, with all of them in `compared`.

        Raises
        ------
        InputError
            If no processor can form it: the reason of the last, which takes any collection.
        """
        candidates = [
            _candidate(name, problem)
            for name, part in PROCESSORS.sound()
            if part.compared and (part.on_gpu or problem.device == "cpu")
        ]
        planned = [(each, each.plan) for each in candidates if each.plan is not None]
        if not planned:
            raise InputError(candidates[-1].refusal)
        serving = [(each, plan) for each, plan in planned if plan.faithful]
        if serving:
            best, plan = min(serving, key=lambda each: each[0].seconds)
            faster = [each for each, _ in planned if each.seconds < best.seconds]
            reason = f"{best.processor} is chosen: it keeps the fidelity in the least time"
            reason += "".join(f"; {each.processor}, which takes less, does not" for each in faster)
        else:
            best, plan = max(planned, key=lambda each: each[1].coherence)
            reason = f"no processor keeps the fidelity; {best.processor} comes closest"
        refused = "".join(f"; {each.processor} cannot: {each.refusal}" for each in candidates if each.plan is None)
        table = HEADER, [_row(each) for each in candidates]
        return replace(plan, compared=Comparison(reason=reason + refused, table=table))


CHOICE = Auto()


def _candidate(name: str, problem: Problem) -> Candidate:
    machine, processor = problem.machine, PROCESSORS.get(name)
    departures = [each for collection in problem.collections for each in collection.departures]
    if departures and not is_general(processor):
        remedy = f" ({departures[0].remedy}, and it can)" if departures[0].remedy else ""
        return Candidate(name, refusal=departures[0].fact + remedy)
    try:
        plan = processor.plan(replace(problem, options=options_for(name, {})))
    except InputError as error:
        return Candidate(name, refusal=str(error))
    if plan.refusal is not None:
        return Candidate(name, refusal=plan.refusal)
    work = plan.work()
    seconds = effort.seconds_of(work, workers=max(machine.workers, 1), threads=machine.threads, pace=1.0)
    return Candidate(name, plan, sum(seconds.values()))


def _row(candidate: Candidate) -> list[str]:
    plan = candidate.plan
    if plan is None:
        return [candidate.processor, *["-"] * 4, "no"]
    return [
        candidate.processor,
        digits(plan.coherence),
        time_text(candidate.seconds),
        f"{plan.memory(1) / MIB:.0f}",
        f"{plan.stored_bytes() / MIB:.0f}",
        "yes" if plan.faithful else "no",
    ]
