"""Choice of the processor: the plans of all chains side by side, and the proposed one with the reason.

All plans are of the same geometry. Comparable are therefore the residuals that their traced lines predict, and their
work: the floating-point operations of transforms and resamplings, and the like of pulses that are back-projected
besides.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import get_args

from blocksar.budget import side_lobe_budget
from blocksar.errors import InputError
from blocksar.focusing.method import Chain, Method
from blocksar.planning.block import BlockPlan
from blocksar.planning.effort import operations
from blocksar.planning.plan import Plan

ALIKE = 1.1  # times the least work: among processors within that, the sharpest is proposed


@dataclass(frozen=True)
class Contender:
    """A processor with its plan, or with the reason why it has none."""

    processor: Chain
    plan: Plan | None
    refusal: str | None

    @property
    def worst(self) -> BlockPlan:
        """The block with the largest excess over what the fidelity allows."""
        plan = self.plan
        assert plan is not None
        return max(plan.blocks, key=lambda block: block.prediction.excess(plan.fidelity))

    @cached_property
    def work(self) -> float:
        """Floating-point operations, as `effort.operations` counts them."""
        assert self.plan is not None
        return operations(self.plan)

    @property
    def serves(self) -> bool:
        """Whether the plan keeps the fidelity."""
        return self.plan is not None and self.refusal is None and self.plan.faithful


def contend(planner: Callable[[Method], Plan]) -> list[Contender]:
    """Plan for every processor.

    Raises
    ------
    InputError
        If none can be planned: the error of the first.
    """
    contenders, errors = [], []
    for processor in get_args(Chain):
        try:
            plan = planner(Method(processor=processor))
            contenders.append(Contender(processor, plan, plan.refusal))
        except InputError as error:
            errors.append(error)
            contenders.append(Contender(processor, None, str(error)))
    if len(errors) == len(contenders):
        raise errors[0]
    return contenders


def propose(contenders: list[Contender]) -> tuple[Contender | None, str]:
    """The proposed processor and the reason; None if none qualifies."""
    feasible = [c for c in contenders if c.plan is not None and c.refusal is None]
    if not feasible:
        reasons = {str(contender.refusal): "" for contender in contenders}
        for contender in contenders if len(reasons) > 1 else []:
            reasons[str(contender.refusal)] += f"{contender.processor}: "
        return None, f"no chain focuses this collection ({'; '.join(of + reason for reason, of in reasons.items())})"
    good = [c for c in feasible if c.serves]
    if not good:
        best = min(feasible, key=_excess)
        return best, f"no processor keeps the fidelity; {best.processor} comes closest: {_figures(best)}"
    least = min(c.work for c in good)
    best = min((c for c in good if c.work <= ALIKE * least), key=_excess)
    others = [f"{c.processor} takes {c.work / best.work:.2f} times its work" for c in good if c is not best]
    others += [f"{c.processor} does not ({_failing(c)})" for c in contenders if c not in good]
    return best, f"{best.processor} is proposed: it keeps the fidelity ({_figures(best)}); " + ", ".join(others)


def _excess(contender: Contender) -> float:
    assert contender.plan is not None
    return contender.plan.excess()


def _figures(contender: Contender) -> str:
    plan = contender.plan
    assert plan is not None
    worst = contender.worst.prediction
    allowed = side_lobe_budget(plan.fidelity, worst.ideal_pslr)
    return (
        f"predicted coherence {plan.coherence:.6g} of {plan.fidelity:.6g} with --blocks {plan.n_blocks}, side lobes "
        f"{worst.pslr:.2f} dB, allowed {worst.ideal_pslr:.2f} +- {allowed:.2g}"
    )


def _failing(contender: Contender) -> str:
    return contender.refusal or "" if contender.plan is None else _figures(contender)
