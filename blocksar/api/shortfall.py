"""What is said of a plan that does not keep the fidelity that was asked for."""

from __future__ import annotations

from blocksar.budget import side_lobe_budget
from blocksar.planning.plan import Plan

# What helps where no number of blocks does, by what takes most of the coherence.
_REMEDIES = {
    "residual phase": "try --processor auto, or a smaller --grid",
    "range migration": "try --processor auto, or a smaller --grid",
    "the ends of the dwell": "try --processor auto",
    "noise of the track": "smooth the positions",
}
_TAPER = ", or taper the dwells, for example with --weighting-azimuth hann"  # where they have none


def describe_shortfall(plan: Plan) -> str:
    """Which fidelity is not kept, and what would help most."""
    worst = max(plan.blocks, key=lambda block: block.prediction.excess(plan.fidelity))
    p = worst.prediction
    losses = {
        "residual phase": p.phase_loss, "range migration": p.range_loss, "the ends of the dwell": p.dispersion_loss,
        "noise of the track": p.track_loss,
    }  # fmt: skip
    cause = max(losses, key=losses.__getitem__)
    if plan.searched:
        taper = _TAPER if cause == "the ends of the dwell" and plan.weighting.azimuth.uniform else ""
        remedy = f"{_REMEDIES[cause]}{taper}, or take --processor backprojection, which is exact"
    elif cause == "noise of the track":
        remedy = _REMEDIES[cause]
    else:
        remedy = "ask for more --blocks, or for --blocks auto"
    if plan.method.rival:
        remedy += ", or leave the alternative methods out"
    if 1 - p.coherence > 1 - plan.fidelity:
        kept, figure = f"fidelity {plan.fidelity:.12g} is", f"coherence {p.coherence:.6g}"
    else:  # said apart, for it is no matter of coherence
        allowed = side_lobe_budget(plan.fidelity, p.ideal_pslr)
        kept = f"fidelity {plan.fidelity:.12g} is kept in coherence, but side lobes to {allowed:.2g} dB are"
        figure = f"side lobes of {p.pslr:.2f} dB instead of {p.ideal_pslr:.2f}"
    if plan.searched:
        noun = "block" if plan.n_blocks == 1 else "blocks"
        return (
            f"{kept} not kept by any division that was tried: {plan.n_blocks} {noun} come closest, with {figure} "
            f"predicted in block {worst.name}, and most is lost by {cause}; {remedy}"
        )
    return f"{kept} not kept: block {worst.name} predicts {figure}, and most is lost by {cause}; {remedy}"
