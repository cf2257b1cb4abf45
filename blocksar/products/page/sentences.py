"""Sentences of the report page: subtitle, verdicts, and what its sections say beside their tables."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.measurement.figures import BARS, PointResponse, excess, limit, rank, worst_excess
from blocksar.products.page.facts import Facts
from blocksar.products.page.words import SPACE, TIMES, count, memory, number

EDGE = 16  # pixels at the edge of an image in which a response may not be measurable


def bar_text(response: PointResponse) -> str:
    """The limits of a response's figures."""
    lobes = [
        f"{axis} side lobes within {limit(response, f'{axis}_pslr')[1]} of theory, "
        f"{number(getattr(response, f'{axis}_pslr_theory'))} dB at {response.name}"
        for axis in ("range", "azimuth")
    ]
    return (
        f"{' and '.join(lobes)}; widths within {BARS['range_irw'].text} of theory, in range and in azimuth; position "
        f"within {BARS['error_x'].text} in x and in y; amplitude within {BARS['amplitude'].text}, phase within "
        f"{BARS['phase'].text}"
    )


class Verdict(NamedTuple):
    """One part of the page's first line, and whether it is good news."""

    good: bool
    text: str


def subtitle(run: Facts) -> str:
    """Processor, number of blocks, size of the image and carrier."""
    blocks = len({b.block for b in run.predicted})
    dx, dy = run.source.spacing
    spacing = f"{dx:.4g} m" if abs(dx - dy) < 1e-9 * dx else f"{dx:.4g} m {TIMES} {dy:.4g} m"
    size = f"{number(run.source.x.size, 0)} {TIMES} {number(run.source.y.size, 0)} pixels of {spacing}"
    carrier = f"{run.source.collection.carrier / 1e9:.4g} GHz"
    processor = run.record.processor or "blocksar"
    return ", ".join([processor, *([count(blocks, "block")] if blocks else []), size, carrier])


def verdicts(run: Facts) -> list[Verdict]:
    """Verdicts on targets, warnings and memory."""
    warnings = Verdict(not run.warnings, count(len(run.warnings), "warning"))
    return [_verdict_on_targets(run), warnings, _verdict_on_memory(run)]


def _verdict_on_targets(run: Facts) -> Verdict:
    """Fully lit targets within the limits of quality; a target in a gap of the image counts as outside them."""
    if run.why:
        return Verdict(False, "targets could not be measured")
    if not run.responses:
        return Verdict(True, "no targets to measure")
    full = [r for r in run.responses if r.full_dwell]
    if not full:
        return Verdict(False, "no target is lit over its full dwell")
    within = [r for r in run.judged if worst_excess(r) <= 1]
    n = len(run.judged) + sum(_in_a_gap(run, r) for r in full)
    if not n:
        return Verdict(True, "no fully lit target to judge in this image")
    return Verdict(len(within) == n, f"{len(within)} of {count(n, 'fully lit target')} within the limits")


def _in_a_gap(run: Facts, response: PointResponse) -> bool:
    """Whether the image does not cover a target that lies more than EDGE pixels inside its grid."""
    if response.covered or np.isfinite(response.value):
        return False
    if len(run.record.inputs) > 1:  # a seam between collections, which covers the target's own pixel
        read = run.source.read_block(*map(_nearest, (response.y, response.x), (run.source.y, run.source.x)))
        if (read >= 0).all():
            return False
    places = ((response.x, run.source.x), (response.y, run.source.y))
    return all(
        axis[0] + EDGE * step < value < axis[-1] - EDGE * step
        for (value, axis), step in zip(places, run.source.spacing, strict=True)
    )


def _nearest(value: float, axis: FloatArray) -> slice:
    """The pixel nearest to a coordinate, m."""
    at = int(np.abs(axis - value).argmin())
    return slice(at, at + 1)


def _verdict_on_memory(run: Facts) -> Verdict:
    """Peak memory of a worker against the plan."""
    peak, planned = run.peak_memory, run.planned_memory
    if peak is None or planned is None:
        return Verdict(True, f"peak memory of a worker {memory(peak)}")
    return Verdict(
        peak <= planned,
        f"peak memory of a worker {memory(peak)}, {number(100 * peak / planned, 0)}{SPACE}% of the plan",
    )


def plan_sentence(run: Facts) -> str:
    """Introduction to the table of the plan."""
    if run.predicted:
        return (
            "Figures predicted for the worst target of each block by tracing the scene's time-frequency lines, beside "
            "those measured at its fully lit targets. Memory is that of a worker process, interpreter and libraries "
            "included."
        )
    if (coherence := run.record.plan.coherence) is not None:
        return (
            f"Predicted coherence with exact back-projection of the same samples: at least {coherence:.8g}. Parts of "
            "the image have no figures of their own."
        )
    return "Exact back-projection makes no approximation, so the plan predicts no figures."


def quality_sentences(run: Facts) -> list[str]:
    """Paragraphs on targets, limits and worst figure; or the reason why nothing was measured."""
    if not run.responses:
        return [run.why or "The collection names no targets, so there was nothing to measure."]
    full = sum(r.full_dwell for r in run.responses)
    sentences = [
        f"{count(len(run.responses), 'target')}, {full} of them lit over their full dwell. The image covers "
        f"{len(run.judged)} of these; only covered ones are judged.",
        f"The limits: {bar_text([*run.judged, *run.responses][0])}. "
        "Figures outside them are marked with an exclamation mark.",
    ]
    if run.judged:
        worst = min(run.judged, key=rank)
        figure = max(BARS, key=lambda name: excess(worst, name))
        sentences.append(
            f"The worst figure is the {BARS[figure].name} of {worst.name}: "
            f"its deviation is {number(100 * excess(worst, figure), 0)} % of the {limit(worst, figure)[1]} allowed."
        )
    return sentences


def memory_sentence(run: Facts) -> str:
    """Peak, planned and permitted memory of a worker, and the number of workers."""
    planned, limit = run.planned_memory, run.memory_limit
    parts = [f"Peak of a worker: {memory(run.peak_memory)}"]
    parts += [f"planned: {memory(planned)}"] if planned is not None else []
    parts += [f"limit: {memory(limit)}"] if limit is not None else []
    workers, threads = run.record.workers, run.record.threads
    if workers is not None and threads is not None:
        parts.append(f"{count(workers, 'worker')} with {count(threads, 'thread')} each")
    return f"{'; '.join(parts)}."
