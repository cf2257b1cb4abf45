"""Measure the speed of blocksar against its lower limits and against exact back-projection.

    python workflows/benchmark.py --scale 1x1,2x2 --repeats 5 --json benchmark.json

All quantities are measured in one run, on the same data and the same cores, one after the other in every repeat, so
that ratios compare measurements that are close in time:

- `blocksar focus`, end to end and by stage, on a warm cluster;
- the FFT floor: the bare transforms of the plan, in groups of rows that fit the cache, shared by the same worker
  processes;
- the I/O floor: the bytes that the run reads and writes, as plain files of the same sizes in the same folder, by the
  same processes, without fsync, and to memory that is already allocated;
- the same bytes past the page cache, as a run writes them;
- planning, commands from a shell and compilation;
- exact back-projection of chips spread over the image, extrapolated to all covered pixels;
- torchbp on one of these chips, if it is installed.

A scene "AxB" has A times the range swath, and B times the aperture and the steering interval, at the same bandwidth,
beam width and steering rate: resolution and dwell stay the same, data and image grow.

--guard FILE compares the ratios with bounds, `workflows/benchmarks/bounds.json` for instance.

--against PYTHON compares with another version of blocksar, which must be installed for the Python at that path. It
focuses the same store on a warm cluster of its own of the same size, in turns with this version; the seconds of both
and their ratio are printed (above 1, this version is faster):

    python workflows/benchmark.py --scale 1x1 --against /opt/blocksar-0.1/bin/python

--cost-against-error PAGE measures something else instead: the processor time and the error of every processor on small
scenes, beside exact back-projection. PAGE gets the tables, and a picture beside it. --peers PYTHON adds fastsar, which
must be installed for the Python at that path.
"""

from __future__ import annotations

import math
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.bench import Bench, log
from benchmarks.environment import describe_machine, versions
from benchmarks.figures import compare_scenes
from benchmarks.guard import read_bounds, violations
from benchmarks.processor_page import write_page
from benchmarks.processors import compare_processors
from benchmarks.scenes import Case, Scale, scene_tables
from benchmarks.tables import show
from blocksar import stores
from blocksar.application.parsing import parse_blocks, parse_memory
from blocksar.errors import InputError, ProcessingError
from blocksar.graph.machine import machine


@contextmanager
def working_folder(parent: Path, *, keep: bool) -> Iterator[Path]:
    """A new folder in `parent`, removed at the end unless it is to be kept."""
    parent.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix="blocksar-benchmark-", dir=parent.resolve()))
    try:
        yield folder
    finally:
        if keep:
            log(f"kept: {folder}")
        else:
            shutil.rmtree(folder, ignore_errors=True)


def benchmark(bench: Bench, scales: Sequence[Scale], *, speedup: bool, starts: bool) -> dict[str, Any]:
    """Measure every scene, the smallest first, which is the reference of the others.

    Raises
    ------
    InputError
        If no scene can be focused.
    """
    result: dict[str, Any] = {
        "machine": describe_machine(),
        "versions": versions(),
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
        bench.add_speedup(*first, result["scenes"][str(first[0].scale)])
    if starts:
        bench.add_starts(*first, result["scenes"][str(first[0].scale)])
    return result


def main(
    scene: Annotated[str, typer.Option(help="Scene file, or the name of a shipped scene.")] = "table1",
    scale: Annotated[str, typer.Option(help="Scenes to derive: range swath x aperture, smallest first.")] = "1x1,2x2",
    repeats: Annotated[int, typer.Option(min=1, help="Repeats of every measurement; medians are printed.")] = 5,
    workers: Annotated[int, typer.Option(min=1, help="Worker processes.")] = 2,
    blocks: Annotated[str, typer.Option(metavar="auto|N", help="Angular blocks.")] = "auto",
    memory_limit: Annotated[str | None, typer.Option(metavar="SIZE", help="Memory of each worker.")] = None,
    speedup: Annotated[bool, typer.Option(help="Also measure the block stage with one worker.")] = True,
    starts: Annotated[bool, typer.Option(help="Also measure planning, commands from a shell, compilation.")] = True,
    guard: Annotated[
        Path | None, typer.Option(metavar="FILE", help="End with status 1 if a ratio is outside the bounds there.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder to work in; its file system is measured.")] = Path(),
    json_file: Annotated[Path | None, typer.Option("--json", help="File to write the numbers to.")] = None,
    peer: Annotated[bool, typer.Option(help="Also measure torchbp, if it is installed.")] = True,
    keep: Annotated[bool, typer.Option("--keep", help="Keep the working folder.")] = False,
    against: Annotated[
        str | None, typer.Option(metavar="PYTHON", help="Path of a Python with another blocksar to compare with.")
    ] = None,
    cost_against_error: Annotated[
        Path | None, typer.Option(metavar="PAGE", help="Measure every processor instead; a page (.md) to write.")
    ] = None,
    peers: Annotated[
        str | None, typer.Option(metavar="PYTHON", help="Path of a Python with fastsar, to be on that page, too.")
    ] = None,
) -> None:
    """Measure blocksar against its lower limits and against exact back-projection.

    Example: python workflows/benchmark.py --scale 1x1,2x2 --repeats 5 --json benchmark.json
    """
    try:
        scales = [Scale.parse(part) for part in scale.split(",")]
        limit = None if memory_limit is None else parse_memory(memory_limit)
        n_blocks = parse_blocks(blocks)
        bounds = {} if guard is None else read_bounds(guard)
        scene_tables(scene)  # refuse a missing scene once, not for every scale
        with working_folder(out, keep=keep) as folder:
            if cost_against_error is not None:
                write_page(compare_processors(folder, repeats=repeats, peers=peers), cost_against_error)
                return
            bench = Bench(
                source=scene, folder=folder, workers=workers, threads=max(machine()[0] // workers, 1), blocks=n_blocks,
                memory_limit=limit, repeats=repeats, peer=peer, against=against,
            )  # fmt: skip
            result = benchmark(bench, scales, speedup=speedup, starts=starts)
    except (InputError, ProcessingError) as error:
        log(f"benchmark: {error}")
        raise typer.Exit(2 if isinstance(error, InputError) else 1) from None
    if json_file is not None:
        stores.write_json(json_file, result)
    show(result)
    if worse := violations(result["scenes"], bounds):
        log("\n".join(worse))
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
