"""What is said of a plan that does not keep the fidelity that was asked for."""

from __future__ import annotations

from blocksar.budget import side_lobe_budget
from blocksar.planning.plan import Plan

OTHER, SMALLER, TAPER = (
    "try --processor auto", "image a smaller --grid", "taper the dwells, for example with --weighting-azimuth hann"
)  # fmt: skip
# What helps where no number of blocks does, by what takes most of the coherence.
REMEDIES = {
    "residual phase": (OTHER, SMALLER),
    "range migration": (OTHER, SMALLER),
    "the ends of the dwell": (OTHER, TAPER),
    "noise of the track": ("smooth the positions",),
}


def describe_shortfall(plan: Plan, *, compared: bool = False) -> str:
    """Which fidelity is not kept, and what would help most; `compared`: processors were, and this is the best one."""
    worst = max(plan.blocks, key=lambda block: block.prediction.excess(plan.fidelity))
    p = worst.prediction
    losses = {
        "residual phase": p.phase_loss, "range migration": p.range_loss, "the ends of the dwell": p.dispersion_loss,
        "noise of the track": p.track_loss,
    }  # fmt: skip
    cause = max(losses, key=losses.__getitem__)
    if plan.searched:
        useless = {OTHER} if compared else set()
        useless |= set() if plan.weighting.azimuth.uniform else {TAPER}  # where dwells have one
        ways = [way for way in REMEDIES[cause] if way not in useless]
        remedy = ", or ".join([*ways, "take --processor backprojection, which is exact"])
    elif cause == "noise of the track":
        remedy = REMEDIES[cause][0]
    else:
        remedy = "ask for more --blocks, or for --blocks auto"
    if plan.method.variant:
        remedy += ", or leave the alternative methods out"
    if 1 - p.coherence > 1 - plan.fidelity:
        kept, figure = f"fidelity {plan.fidelity:.12g} is", f"coherence {p.coherence:.6g}"
    else:  # said apart, for it is no matter of coherence
        allowed = side_lobe_budget(plan.fidelity, p.ideal_pslr)
        kept = f"fidelity {plan.fidelity:.12g} is kept in coherence, but side lobes to {allowed:.2g} dB are"
        figure = f"side lobes of {p.pslr:.2f} dB instead of {p.ideal_pslr:.2f}"
    if plan.searched:
        closest = "block comes" if plan.n_blocks == 1 else "blocks come"
        return (
            f"{kept} not kept by any division that was tried: {plan.n_blocks} {closest} closest, with {figure} "
            f"predicted in block {worst.name}, and most is lost by {cause}; {remedy}"
        )
    return f"{kept} not kept: block {worst.name} predicts {figure}, and most is lost by {cause}; {remedy}"
