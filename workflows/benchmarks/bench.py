"""The measurements of a benchmark run: simulation, focusing, floors and back-projection of each scene."""

from __future__ import annotations

import os
import resource
import sys
import time
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import typer
from distributed import Client

import blocksar
from benchmarks import starts
from benchmarks.back_projection import back_project, compare_chips, count_updates, place_chips, run_peer
from benchmarks.figures import Measured, TimedRun, describe, over, spread
from benchmarks.floors import fft_share, io_share, on_every_worker, traffic_of
from benchmarks.folders import empty_folder
from benchmarks.other_version import OtherVersion, other_version
from benchmarks.scenes import Blocks, Case, Scale, plan_case
from blocksar import stores
from blocksar.graph.cluster import open_client
from blocksar.graph.machine import machine
from blocksar.graph.units import peak_memory
from blocksar.runs.record import RunRecord


@dataclass
class Bench:
    """Settings that all scenes of a run share, and the measurements of one scene."""

    source: str
    folder: Path
    workers: int
    threads: int
    blocks: Blocks
    memory_limit: int | None
    repeats: int
    peer: bool
    against: str | None = None

    def cluster(self, workers: int) -> AbstractContextManager[Client]:
        return open_client(workers=workers, threads=self.threads, memory_limit=self.limit)

    @cached_property
    def limit(self) -> int:
        """Memory of a worker, bytes."""
        return self.memory_limit or machine()[1] // self.workers

    def prepare(self, scale: Scale) -> Case:
        return plan_case(self.source, scale, blocks=self.blocks, workers=self.workers, memory_limit=self.limit)

    def simulate(self, case: Case) -> Path:
        store = self.folder / f"{case.scale}" / "phase_history.zarr"
        log(f"{case.scale}: simulating {case.samples / 1e6:.1f} M samples")
        blocksar.simulate(case.scene, store, threads=machine()[0])
        return store

    def focus(self, client: Client, case: Case, store: Path) -> tuple[TimedRun, RunRecord, Path]:
        """Focus into an empty folder; its time, the run's record, the run."""
        run = empty_folder(self.folder / str(case.scale) / "run")
        planned: list[float] = []
        clock = SimpleNamespace(
            update=lambda stage, done, total: planned.append(time.perf_counter()) if stage == "plan" and done else None
        )
        before, started = client.run(processor_time), time.perf_counter()
        report = blocksar.focus(
            store, run, blocks=case.plan.n_blocks, threads=self.threads, client=client, progress=clock
        )  # fmt: skip
        seconds = time.perf_counter() - started
        used = np.sum([np.subtract(now, before[worker]) for worker, now in client.run(processor_time).items()], axis=0)
        timed = TimedRun(seconds, planned[0] - started, float(used[1] / used.sum()))
        return timed, RunRecord.from_json(report.result), run

    def measure(self, case: Case, store: Path) -> dict[str, Any]:
        """Measure one scene, except for the speed-up; on a new cluster, as peak memory is per process."""
        plan, history, cores = case.plan, stores.open_phase_history(store), self.workers * self.threads
        measured, projected, raw = Measured(), [], store.parent / "raw"
        with self.cluster(self.workers) as client, ExitStack() as stack:
            log(f"{case.scale}: warming up")
            _, record, run = self.focus(client, case, store)
            chips, traffic, transforms = place_chips(plan, run), traffic_of(store, run, plan), plan.transforms()
            compared, exact = compare_chips(history, plan, run, chips, cores)
            pixels, updates = count_updates(plan, run)
            other = self.start_other(stack, case, store)
            for repeat in range(self.repeats):
                log(f"{case.scale}: repeat {repeat + 1} of {self.repeats}")
                if other is not None and repeat % 2:  # in turns: neither is always the first
                    measured.other_version.append(self.focus_other(other, case, store))
                timed, record, _ = self.focus(client, case, store)
                measured.add_run(timed, record)
                if other is not None and not repeat % 2:
                    measured.other_version.append(self.focus_other(other, case, store))
                fft = on_every_worker(client, fft_share, transforms, self.threads)
                io = on_every_worker(client, io_share, empty_folder(raw), traffic, False)
                past_cache = on_every_worker(client, io_share, empty_folder(raw), traffic, True)
                measured.add_floors(fft, io, past_cache)
                projected.append(back_project(history, plan.geometry, chips, cores))
            peaks = list(client.run(peak_memory).values())
        measured.profiles = [part.profiles for part in projected]
        measured.accumulation = [part.accumulation * updates / part.updates for part in projected]
        result = describe(case, measured, traffic, peaks, record)
        result["back_projection"] = {
            "covered_pixels": pixels,
            "updates": updates,
            "chip_updates": projected[0].updates,
            "updates_per_second": spread([part.updates / part.accumulation for part in projected]),
        }
        if other is not None:
            result["other_version"] = {"python": other.python, "version": other.version}
        if case.scene.clutter is not None:
            result["chips"] = compared
            result["coherence"] = spread([chip["coherence"] for chip in compared])
        if self.peer and case.scale == (1, 1):
            result["peer"] = run_peer(history, plan, chips, exact, self.repeats)
        return result

    def add_starts(self, case: Case, store: Path, result: dict[str, Any]) -> None:
        """Measure what is paid before the samples, and add it to the result of `measure`."""
        log(f"{case.scale}: planning, commands, compilation")
        planning = starts.planning_seconds(self.source, case, workers=self.workers, memory_limit=self.limit)
        shell = starts.shell_seconds(store, store.parent, case, workers=self.workers, repeats=self.repeats)
        compiling = starts.compilation()
        result["starts"] = starts.describe(planning, shell, compiling)
        warm = result["seconds"]["end_to_end"]["median"]
        measured = {"shell_over_warm": shell["blocksar focus"], "compilation_over_warm": [compiling["plain run"]]}
        if "200 blocks" in planning:
            measured["planning_over_warm"] = [planning["200 blocks"]]
        result["ratios"] |= {name: spread([each / warm for each in seconds]) for name, seconds in measured.items()}

    def start_other(self, stack: ExitStack, case: Case, store: Path) -> OtherVersion | None:
        """The version to compare with, warmed up; None without --against."""
        if self.against is None:
            return None
        log(f"{case.scale}: warming up {self.against}")
        started = other_version(self.against, workers=self.workers, threads=self.threads, memory_limit=self.limit)
        other = stack.enter_context(started)
        self.focus_other(other, case, store)
        return other

    def focus_other(self, other: OtherVersion, case: Case, store: Path) -> float:
        """Focus with the other version as `focus` does; seconds."""
        return other.focus(store, empty_folder(self.folder / str(case.scale) / "run"), blocks=case.plan.n_blocks)

    def add_speedup(self, case: Case, store: Path, result: dict[str, Any]) -> None:
        """Measure the block stage by one worker on its share of the cores, and add it to the result of `measure`."""
        with self.cluster(1) as client:
            client.run(keep_to_cores, self.threads)
            self.focus(client, case, store)
            log(f"{case.scale}: {self.repeats} runs by 1 worker")
            one = [self.focus(client, case, store)[1].timings["focus"] for _ in range(self.repeats)]
        result["seconds"]["block_stage_one_worker"] = spread(one)
        result["ratios"]["block_stage_speedup"] = spread(over(one, result["seconds"]["stages"]["focus"]["runs"]))


def keep_to_cores(count: int) -> None:
    """Run this process, with the threads it has and will have, on the first so many of its cores."""
    if sys.platform == "linux":
        cores = sorted(os.sched_getaffinity(0))[:count]
        for thread in Path("/proc/self/task").iterdir():
            os.sched_setaffinity(int(thread.name), cores)


def processor_time() -> tuple[float, float]:
    """Seconds that this process has used, its own and the system's for it."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime, usage.ru_stime


def log(text: str) -> None:
    """Print a line of progress on stderr."""
    typer.echo(text, err=True)
