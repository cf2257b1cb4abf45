"""Measured figures: lists of seconds, their ratios and spread."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from benchmarks.floors import Seconds, Traffic
from benchmarks.scenes import Case
from blocksar.processors.chain.planning.written_bytes import run_bytes
from blocksar.runs.record import RunRecord


@dataclass(frozen=True)
class TimedRun:
    """Seconds of a run from call to return and of its planning, and the system's share of its processor time."""

    seconds: float
    plan: float
    kernel: float


@dataclass
class Measured:
    """Seconds of every repeat; `steps`, `recovery_tasks` and `fft_tasks` are summed over the workers."""

    end_to_end: list[float] = field(default_factory=list)
    stages: dict[str, list[float]] = field(default_factory=dict)
    steps: dict[str, list[float]] = field(default_factory=dict)
    recovery_tasks: list[float] = field(default_factory=list)
    fft: list[float] = field(default_factory=list)
    fft_tasks: dict[str, list[float]] = field(default_factory=dict)
    io: list[float] = field(default_factory=list)
    io_kinds: dict[str, list[float]] = field(default_factory=dict)
    other_version: list[float] = field(default_factory=list)  # end to end, if measured
    direct: list[float] = field(default_factory=list)  # the floor of I/O past the page cache
    profiles: list[float] = field(default_factory=list)
    accumulation: list[float] = field(default_factory=list)
    kernel: list[float] = field(default_factory=list)  # the system's share of the workers' processor time

    def add_run(self, timed: TimedRun, record: RunRecord) -> None:
        """Add a run's seconds, end to end and by the stages, steps and tasks of its record."""
        self.end_to_end.append(timed.seconds)
        self.kernel.append(timed.kernel)
        timings = dict(record.timings)
        total = timings.pop("total")
        rest, finish = total - sum(timings.values()), timed.seconds - timed.plan - total
        _append(self.stages, {"plan": timed.plan, **timings, "stores and receipts": rest, "finish": finish})
        steps: Seconds = {}
        for receipt in record.receipts:
            for name, taken in receipt.steps.items():
                steps[name] = steps.get(name, 0.0) + taken
        _append(self.steps, steps)
        self.recovery_tasks.append(sum(r.seconds for r in record.receipts if r.stage == "recover"))

    def add_floors(self, fft: list[Seconds], io: list[Seconds], direct: list[Seconds]) -> None:
        """Add the floors, one dict per worker: all start at once, so the slowest worker counts."""
        self.direct.append(max(sum(worker.values()) for worker in direct))
        self.fft.append(max(sum(worker.values()) for worker in fft))
        self.io.append(max(sum(worker.values()) for worker in io))
        _append(self.fft_tasks, {stage: sum(worker[stage] for worker in fft) for stage in fft[0]})
        kinds = dict.fromkeys(name for worker in io for name in worker)
        _append(self.io_kinds, {name: max(worker.get(name, 0.0) for worker in io) for name in kinds})


def _append(lists: dict[str, list[float]], values: Seconds) -> None:
    for name, value in values.items():
        lists.setdefault(name, []).append(value)


def spread(values: Sequence[float]) -> dict[str, Any]:
    """Median, extremes, and the values themselves."""
    return {"median": statistics.median(values), "min": min(values), "max": max(values), "runs": list(values)}


def over(numerators: Sequence[float], denominators: Sequence[float]) -> list[float]:
    """Quotients, repeat by repeat."""
    return [a / b for a, b in zip(numerators, denominators, strict=True)]


def total(lists: dict[str, list[float]], names: Sequence[str]) -> list[float]:
    """Sum of some lists, repeat by repeat; empty if there is none of these names."""
    return [sum(values) for values in zip(*(lists[name] for name in names if name in lists), strict=True)]


def describe(case: Case, m: Measured, traffic: list[Traffic], peaks: list[int], record: RunRecord) -> dict[str, Any]:
    """The JSON object of a scene: ratios, seconds, sizes, memory."""
    plan, collection = case.plan, case.plan.geometry.collection
    names = {step.name for block in plan.blocks for step in block.chain}
    # Steps that run in one pass share one time under a joint name such as read-slab+residual-walk+keystone.
    chain = [name for name in m.steps if names.intersection(name.split("+"))]
    timed = {step for name in chain for step in name.split("+")}
    chain_fft = total(m.fft_tasks, [stage for stage in m.fft_tasks if timed.issuperset(stage.split("+"))])
    projected = [a + b for a, b in zip(m.profiles, m.accumulation, strict=True)]
    ratios = {
        "end_to_end_over_floor": over(m.end_to_end, [a + b for a, b in zip(m.fft, m.io, strict=True)]),
        "recovery_over_own_ffts": over(m.recovery_tasks, m.fft_tasks["recover"]),
        "back_projection_over_end_to_end": over(projected, m.end_to_end),
        "end_to_end_over_direct_floor": over(m.end_to_end, [a + b for a, b in zip(m.fft, m.direct, strict=True)]),
        "peak_memory_over_planned": [max(peaks) / plan.memory],
        "written_over_predicted": [sum(kind.written for kind in traffic) / sum(run_bytes(plan).values())],
        "kernel_time": m.kernel,
    }
    if steps := total(m.steps, chain):
        ratios["chain_over_own_ffts"] = over(steps, chain_fft)
    if m.other_version:
        ratios["other_version_over_end_to_end"] = over(m.other_version, m.end_to_end)
    return {
        "ratios": {name: spread(values) for name, values in ratios.items()},
        "seconds": {
            "end_to_end": spread(m.end_to_end),
            **({"end_to_end_other_version": spread(m.other_version)} if m.other_version else {}),
            "stages": {name: spread(values) for name, values in m.stages.items()},
            "recovery_summed_over_workers": spread(m.recovery_tasks),
            "steps_summed_over_workers": {name: spread(values) for name, values in m.steps.items()},
            "fft_floor": spread(m.fft),
            "fft_floor_summed_over_workers": {name: spread(values) for name, values in m.fft_tasks.items()},
            "io_floor": spread(m.io),
            "io_floor_direct": spread(m.direct),
            "io_floor_by_kind": {name: spread(values) for name, values in m.io_kinds.items()},
            "back_projection_extrapolated": spread(projected),
            "back_projection_profiles": spread(m.profiles),
        },
        "size": {
            "pulses": collection.n_pulse,
            "range_frequencies": collection.n_range_frequency,
            "samples": case.samples,
            "prf_hertz": collection.prf,
            "blocks": plan.n_blocks,
            "range_sub_blocks": plan.parts,
            "image_pixels": plan.grid.shape[0] * plan.grid.shape[1],
            "written_bytes": {kind.name: kind.written for kind in traffic},
            "read_bytes": {kind.name: kind.read for kind in traffic},
        },
        "memory": {
            "peak_by_worker_bytes": peaks,
            "peak_in_receipts_bytes": record.peak_memory,
            "planned_bytes": plan.memory,
        },
        "notes": case.notes,
    }


def compare_scenes(scenes: dict[str, dict[str, Any]]) -> None:
    """Add the time per input sample over that of the first scene."""
    per_sample = {
        name: [seconds / scene["size"]["samples"] for seconds in scene["seconds"]["end_to_end"]["runs"]]
        for name, scene in scenes.items()
    }
    reference = statistics.median(next(iter(per_sample.values())))
    for name, scene in scenes.items():
        scene["ratios"]["time_per_sample_over_first_scene"] = spread([s / reference for s in per_sample[name]])
