"""Automatic choice of a processor: several are planned, the fastest that keeps the fidelity is taken.

Of the chains, which have similar limits, only that of the main paper is compared: planning chains takes long where they
do not apply.

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
from blocksar.processors.base import Comparison, ImagePlan, Problem
from blocksar.processors.chain_tables import digits
from blocksar.texts import time_text

HEADER = ("processor", "coherence", "time, usual pace", "memory (MiB)", "disk (MiB)", "keeps the fidelity")


@dataclass(frozen=True)
class Candidate:
    """A processor with its plan and predicted seconds, or the reason why it has no plan."""

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
    machine = problem.machine
    try:
        plan = PROCESSORS.get(name).plan(replace(problem, options=options_for(name, {})))
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
