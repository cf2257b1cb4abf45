"""How fast blocksar is, against what cannot be avoided and against exact back-projection.

    python workflows/benchmark.py --scale 1x1,2x2 --repeats 5 --json benchmark.json

Everything is measured in one run, on the same data and the same cores, one after the other in every
repeat, so that ratios compare neighbours in time:

- `blocksar focus`, end to end and by stage, on a cluster that is warm;
- the FFT floor: the bare transforms of the plan, in groups of rows that stay in the cache, by the same
  worker processes, each its share;
- the I/O floor: the bytes that the run reads and writes, as plain files of the same sizes in the same folder,
  by the same processes, without fsync, and into memory that is at hand;
- exact back-projection of chips spread over the image, extrapolated to every covered pixel;
- torchbp, where it is installed, on one of these chips.

A scene "AxB" has A times the range swath, and B times the aperture and the steering interval, at the same
bandwidth, beam width and steering rate: resolution and dwell stay, data and image grow.
"""

from __future__ import annotations

import math
import os
import platform
import re
import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import typer
from benchmarks.back_projection import back_project, compare_chips, count_updates, place_chips, run_peer, version_of
from benchmarks.figures import Measured, compare_scenes, describe, over, spread
from benchmarks.floors import fft_share, io_share, on_every_worker, traffic_of
from benchmarks.scenes import Blocks, Case, Scale, plan_case, scene_tables
from benchmarks.tables import show
from distributed import Client

import blocksar
from blocksar import stores
from blocksar.cli.parsing import parse_blocks, parse_memory
from blocksar.errors import InputError
from blocksar.graph.cluster import machine, open_client
from blocksar.graph.tasks import peak_memory
from blocksar.runs.record import RunRecord

SETTLING = 5.0  # s


@dataclass
class Bench:
    """What is the same for all scenes of a run."""

    source: str
    folder: Path
    workers: int
    threads: int
    blocks: Blocks
    memory_limit: int | None
    repeats: int
    peer: bool

    def cluster(self, workers: int) -> AbstractContextManager[Client]:
        return open_client(workers=workers, threads=self.threads, memory_limit=self.limit)

    @cached_property
    def limit(self) -> int:
        """Bytes a worker."""
        return self.memory_limit or machine()[1] // self.workers

    def prepare(self, scale: Scale) -> Case:
        return plan_case(self.source, scale, blocks=self.blocks, workers=self.workers, memory_limit=self.limit)

    def simulate(self, case: Case) -> Path:
        store = self.folder / f"{case.scale}" / "phase_history.zarr"
        tell(f"{case.scale}: simulating {case.samples / 1e6:.1f} M samples")
        blocksar.simulate(case.scene, store, threads=machine()[0])
        return store

    def focus(self, client: Client, case: Case, store: Path) -> tuple[float, RunRecord, Path]:
        """Focus into an empty folder; seconds from call to return, the run's record, the run."""
        run = emptied(self.folder / str(case.scale) / "run")
        started = time.perf_counter()
        report = blocksar.focus(store, run, blocks=case.plan.n_blocks, threads=self.threads, client=client)
        return time.perf_counter() - started, RunRecord.from_json(report.result), run

    def measure(self, case: Case, store: Path) -> dict[str, Any]:
        """Everything about one scene but the speed-up. A cluster of its own: peaks of memory are per process."""
        plan, history, cores = case.plan, stores.open_phase_history(store), self.workers * self.threads
        measured, parts, raw = Measured(), [], store.parent / "raw"
        with self.cluster(self.workers) as client:
            tell(f"{case.scale}: warming up")
            _, record, run = self.focus(client, case, store)
            chips, traffic, transforms = place_chips(plan, run), traffic_of(store, run, plan), plan.transforms()
            compared, exact = compare_chips(history, plan, run, chips, cores)
            pixels, updates = count_updates(plan, run)
            for repeat in range(self.repeats):
                tell(f"{case.scale}: repeat {repeat + 1} of {self.repeats}")
                seconds, record, _ = self.focus(client, case, store)
                measured.add_run(seconds, record)
                fft = on_every_worker(client, fft_share, transforms, self.threads)
                io = on_every_worker(client, io_share, emptied(raw), traffic)
                measured.add_floors(fft, io)
                parts.append(back_project(history, plan.geometry, chips, cores))
            peaks = list(client.run(peak_memory).values())
        measured.profiles = [part.profiles for part in parts]
        measured.accumulation = [part.accumulation * updates / part.updates for part in parts]
        result = describe(case, measured, traffic, peaks, record)
        result["back_projection"] = {
            "covered_pixels": pixels,
            "updates": updates,
            "chip_updates": parts[0].updates,
            "updates_per_second": spread([part.updates / part.accumulation for part in parts]),
        }
        if case.scene.clutter is not None:
            result["chips"] = compared
            result["coherence"] = spread([chip["coherence"] for chip in compared])
        if self.peer and case.scale == (1, 1):
            result["peer"] = run_peer(history, plan, chips, exact, self.repeats)
        return result

    def block_stage(self, case: Case, store: Path, workers: int) -> list[float]:
        """Seconds of the block stage on a cluster of so many workers of the same size."""
        with self.cluster(workers) as client:
            self.focus(client, case, store)
            tell(f"{case.scale}: {self.repeats} runs by {workers} worker")
            return [self.focus(client, case, store)[1].timings["focus"] for _ in range(self.repeats)]


def emptied(path: Path) -> Path:
    """An empty folder, some seconds after it was emptied: run and floor find memory in the same state.

    A virtual machine gives memory that was set free back to its host after a while, and to get it anew costs
    more than to write it. Whoever came first after a deletion would be served at several times the speed.
    """
    shutil.rmtree(path, ignore_errors=True)
    path.mkdir(parents=True)
    time.sleep(SETTLING)
    return path


def tell(text: str) -> None:
    typer.echo(text, err=True)


def about_machine() -> dict[str, Any]:
    """CPU, cores and bytes that this process may use, and how busy the machine is."""
    cpu = platform.processor() or platform.machine()
    with_name = Path("/proc/cpuinfo")
    if with_name.exists():
        match = re.search(r"^model name\s*:\s*(.+)$", with_name.read_text(), re.MULTILINE)
        cpu = match[1] if match else cpu
    cores, memory = machine()
    return {
        "cpu": cpu,
        "cores": cores,
        "memory_bytes": memory,
        "load_average_1_minute": os.getloadavg()[0],
        "system": platform.platform(),
    }


@contextmanager
def working_folder(parent: Path, *, keep: bool) -> Iterator[Path]:
    parent.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix="blocksar-benchmark-", dir=parent.resolve()))
    try:
        yield folder
    finally:
        if keep:
            tell(f"left: {folder}")
        else:
            shutil.rmtree(folder, ignore_errors=True)


def benchmark(bench: Bench, scales: Sequence[Scale], *, speedup: bool) -> dict[str, Any]:
    """Measure every scene, the smallest first: the others are compared with that one."""
    packages = ("blocksar", "numpy", "scipy", "numba", "dask", "distributed", "zarr", "xarray")
    result: dict[str, Any] = {
        "machine": about_machine(),
        "versions": {"python": platform.python_version()} | {name: version_of(name) for name in packages},
        "settings": {
            "scene": bench.source, "scales": [str(scale) for scale in scales], "workers": bench.workers,
            "threads": bench.threads, "blocks": bench.blocks, "memory_limit_bytes": bench.limit,
            "repeats": bench.repeats,
        },
        "scenes": {},
        "refused": [],
    }  # fmt: skip
    first: tuple[Case, Path] | None = None
    for scale in sorted(set(scales), key=math.prod):
        try:
            case = bench.prepare(scale)
        except InputError as error:
            result["refused"].append(f"{scale} cannot be focused: {error}")
            continue
        store = bench.simulate(case)
        result["scenes"][str(scale)] = bench.measure(case, store)
        if first is None:
            first = case, store
        else:
            shutil.rmtree(store.parent)
    if first is None:
        raise InputError("; ".join(result["refused"]))
    compare_scenes(result["scenes"])
    if speedup and bench.workers > 1:
        found = result["scenes"][str(first[0].scale)]
        one = bench.block_stage(*first, workers=1)
        found["seconds"]["block_stage_one_worker"] = spread(one)
        found["ratios"]["block_stage_speedup"] = spread(over(one, found["seconds"]["stages"]["focus"]["runs"]))
    return result


def main(
    scene: Annotated[str, typer.Option(help="Scene file, or the name of a shipped scene.")] = "table1",
    scale: Annotated[str, typer.Option(help="Scenes to derive: range swath x aperture, smallest first.")] = "1x1,2x2",
    repeats: Annotated[int, typer.Option(min=1, help="Runs of everything; medians are shown.")] = 5,
    workers: Annotated[int, typer.Option(min=1, help="Worker processes.")] = 2,
    blocks: Annotated[str, typer.Option(metavar="auto|N", help="Angular blocks.")] = "auto",
    memory_limit: Annotated[str | None, typer.Option(metavar="SIZE", help="Memory of each worker.")] = None,
    speedup: Annotated[bool, typer.Option(help="Also the block stage by one worker.")] = True,
    out: Annotated[Path, typer.Option(help="Folder to work in; its file system is measured.")] = Path(),
    json_file: Annotated[Path | None, typer.Option("--json", help="File to write the numbers to.")] = None,
    peer: Annotated[bool, typer.Option(help="Also torchbp, where it is installed.")] = True,
    keep: Annotated[bool, typer.Option("--keep", help="Leave the working folder.")] = False,
) -> None:
    """Measure blocksar against its floors and against exact back-projection.

    Example: python workflows/benchmark.py --scale 1x1,2x2 --repeats 5 --json benchmark.json
    """
    try:
        scales = [Scale.parse(part) for part in scale.split(",")]
        limit = None if memory_limit is None else parse_memory(memory_limit)
        wanted = parse_blocks(blocks)
        scene_tables(scene)  # a scene that is not there is refused once, not for every scale
        with working_folder(out, keep=keep) as folder:
            bench = Bench(
                source=scene, folder=folder, workers=workers, threads=max(machine()[0] // workers, 1), blocks=wanted,
                memory_limit=limit, repeats=repeats, peer=peer,
            )  # fmt: skip
            result = benchmark(bench, scales, speedup=speedup)
    except InputError as error:
        tell(f"benchmark: {error}")
        raise typer.Exit(2) from None
    if json_file is not None:
        stores.write_json(json_file, result)
    show(result)


if __name__ == "__main__":
    typer.run(main)
