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

import importlib
import json
import math
import os
import platform
import re
import shutil
import statistics
import tempfile
import time
import tomllib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field
from functools import cached_property
from importlib import metadata, resources
from itertools import cycle
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import scipy.fft
import typer
from distributed import Client
from rich import box
from rich.console import Console
from rich.table import Table

import blocksar
from blocksar import stores
from blocksar.backprojection import accumulate, form_points, lit_interval, pulse_block_size, range_profiles
from blocksar.cli import parse_blocks, parse_memory
from blocksar.cluster import machine, open_client
from blocksar.geometry import Geometry
from blocksar.graph import peak_memory
from blocksar.measurement import coherence
from blocksar.parameters import Collection, ComplexArray, FloatArray, InputError
from blocksar.planning import MAX_BLOCKS, Plan, Transforms, plan_collection
from blocksar.rows import row_groups
from blocksar.scene import Scene

Tables = dict[str, Any]  # a scene file, read
Seconds = dict[str, float]
Blocks = int | Literal["auto"]

MIB = 2**20
SAMPLE_BYTES = 8  # complex64
CHIP = 192  # pixels a side: enough tiles to keep all threads busy
SAMPLED_PIXELS = 1e6  # of the image, at which lit pulses are counted
CLUTTER = {"scatterers": 100_000, "seed": 3}
NOISE = {"power": 1.0, "seed": 5}
WIDTH = 100  # columns of the tables
SETTLING = 5.0  # s


# ---------------------------------------------------------------- scenes


class Scale(NamedTuple):
    """How many times the range swath, and the aperture, of the scene as it stands."""

    swath: float
    aperture: float

    @classmethod
    def parse(cls, text: str) -> Scale:
        match = re.fullmatch(r"\s*(\d+\.?\d*)x(\d+\.?\d*)\s*", text)
        if match is None or not (float(match[1]) > 0 and float(match[2]) > 0):
            raise InputError(f"--scale has {text!r}; give pairs such as 1x1,2x2: range swath x aperture")
        return cls(float(match[1]), float(match[2]))

    def __str__(self) -> str:
        return f"{self.swath:g}x{self.aperture:g}"


def scene_tables(source: str) -> Tables:
    """A scene file, or a shipped scene by its name, as TOML reads it."""
    path = Path(source)
    place = path if path.is_file() else resources.files("blocksar") / "scenes" / f"{source}.toml"
    if not place.is_file():
        raise InputError(f"--scene {source!r} is neither a file nor a shipped scene")
    return tomllib.loads(place.read_text(encoding="utf-8"))


def scaled(tables: Tables, scale: Scale, *, prf: float | None = None) -> Tables:
    """The scene "AxB": wider about the middle of its swath, longer about the middle of its aperture.

    Scaled scenes hold nine targets in noise: their time does not depend on what they show, and clutter over
    so much ground would take longer to simulate than to focus.
    """
    made = {name: dict(table) if isinstance(table, dict) else table for name, table in tables.items()}
    radar, beam, area, timing = made["radar"], made.get("beam"), made["scene"], made["time"]
    duration = timing.get("duration") or timing["pulses"] / radar["prf"]
    made["time"] = {"duration": scale.aperture * duration}
    if "start" in timing:
        made["time"]["start"] = scale.aperture * timing["start"]
    if prf is not None:
        radar["prf"] = prf
    near, far = area["swath"]
    half = scale.swath * (far - near) / 2
    area["swath"] = [(near + far) / 2 - half, (near + far) / 2 + half]
    if beam is not None:
        middle, half = (beam["start_deg"] + beam["stop_deg"]) / 2, (beam["stop_deg"] - beam["start_deg"]) / 2
        beam["start_deg"], beam["stop_deg"] = middle - scale.aperture * half, middle + scale.aperture * half
    if scale == (1, 1):
        if beam is not None:  # else nobody knows where it should lie
            made.setdefault("clutter", CLUTTER)
        return made
    for name in ("targets", "matrix", "clutter", "reflectivity", "dropped"):
        made.pop(name, None)
    side = 0.8 * (far - near)
    made["matrix"] = {"rows": 3, "columns": 3, "extent": [scale.swath * side, scale.aperture * side]}
    made["noise"] = NOISE
    return made


def as_toml(tables: Tables) -> str:
    """Tables of numbers, strings, lists and one more level of tables; JSON writes such values as TOML does."""
    lines = [f"{key} = {json.dumps(value)}" for key, value in tables.items() if not _has_tables(value)]
    for name, value in tables.items():
        for table in value if isinstance(value, list) else [value]:
            if isinstance(table, dict):
                lines.append(f"[[{name}]]" if isinstance(value, list) else f"[{name}]")
                inner = {key: v for key, v in table.items() if isinstance(v, dict)}
                lines += [f"{key} = {json.dumps(v)}" for key, v in table.items() if key not in inner]
                for key, v in inner.items():
                    lines += [f"[{name}.{key}]", *(f"{k} = {json.dumps(x)}" for k, x in v.items())]
    return "\n".join(lines)


def _has_tables(value: Any) -> bool:
    return isinstance(value, dict) or (isinstance(value, list) and bool(value) and isinstance(value[0], dict))


@dataclass(frozen=True)
class Case:
    """A scaled scene and its plan; `notes` say what had to be changed for it to be possible."""

    scale: Scale
    scene: Scene
    plan: Plan
    notes: list[str]

    @property
    def samples(self) -> int:
        collection = self.plan.geometry.collection
        return collection.n_pulse * collection.n_range_frequency


def plan_case(source: str, scale: Scale, *, blocks: Blocks, workers: int, memory_limit: int) -> Case:
    """Scale a scene and plan it; raise the PRF and the number of blocks where the plan asks for that, and no more.

    Raises
    ------
    InputError
        If the scene cannot be focused all the same.
    """
    tables, notes, prf = scene_tables(source), [], None
    folder = Path(source).parent if Path(source).is_file() else None
    while True:
        text = as_toml(scaled(tables, scale, prf=prf))
        scene = Scene.parse(text, name=f"{Path(source).stem} {scale}", label=f"scene {scale}", folder=folder)
        try:
            plan = _plan(scene.collection().centred(), blocks, workers=workers, memory_limit=memory_limit)
            break
        except InputError as error:
            asked = re.search(r"a PRF of at least ([\d.e+]+) Hz", str(error))
            if asked is None or float(asked[1]) <= scene.radar.prf:
                raise
            prf = float(asked[1])
    if prf is not None:
        notes.append(f"{scale}: PRF {tables['radar']['prf']:g} Hz raised to the {prf:g} Hz that the plan asks for")
    if not plan.within_budget():
        notes.append(f"{scale}: the plan is over its budget of phase or migration: a figure of speed, not of quality")
    return Case(scale, scene, plan, notes)


def _plan(collection: Collection, blocks: Blocks, *, workers: int, memory_limit: int) -> Plan:
    """The plan as asked; where `auto` is refused, with twice the blocks, and again."""
    plan = plan_collection(collection, blocks=blocks, workers=workers, memory_limit=memory_limit)
    count = plan.n_blocks
    while plan.refusal is not None and blocks == "auto" and 2 * count <= MAX_BLOCKS:
        count *= 2
        with suppress(InputError):  # too much memory: the next has less
            plan = plan_collection(collection, blocks=count, memory_limit=memory_limit)
    if plan.refusal is not None:
        raise InputError(plan.refusal)
    return plan


# ---------------------------------------------------------------- floors: tasks of the workers


def _share(items: Sequence[Any], index: int, shares: int) -> Sequence[Any]:
    return items[index::shares]


def fft_share(transforms: list[Transforms], threads: int, index: int, shares: int) -> Seconds:
    """Seconds by stage for one worker's share of bare transforms.

    In place, in groups that stay in the cache. Of zeros: the time does not depend on the values, and zeros
    never overflow however often they are transformed.
    """
    found: Seconds = {}

    def work(asked: Transforms, thread: int) -> None:
        groups = _share(row_groups(0, asked.count, asked.length), index * threads + thread, shares * threads)
        if not groups:
            return
        scratch = np.zeros((groups[0].stop - groups[0].start, asked.length), np.complex64)
        for rows in groups:
            scipy.fft.fft(scratch[: rows.stop - rows.start], axis=1, overwrite_x=True)

    with ThreadPoolExecutor(threads) as pool:
        for asked in transforms:
            started = time.perf_counter()
            futures = [pool.submit(work, asked, thread) for thread in range(threads)]
            for future in futures:
                future.result()
            found[asked.stage] = found.get(asked.stage, 0.0) + time.perf_counter() - started
    return found


@dataclass(frozen=True)
class Traffic:
    """Bytes of one kind that a run writes and reads, in files of at most `file_bytes`.

    What is read is what was written, or `files` where these are there.
    """

    name: str
    file_bytes: int
    written: int
    read: int
    files: tuple[Path, ...] = ()


def io_share(folder: Path, traffic: list[Traffic], index: int, shares: int) -> Seconds:
    """Seconds by kind and direction for one worker's share of plain files, written then read."""
    found: Seconds = {}
    for kind in traffic:
        sizes = [kind.file_bytes] * (kind.written // kind.file_bytes)
        sizes += [kind.written % kind.file_bytes] if kind.written % kind.file_bytes else []
        mine = [folder / f"{kind.name}-{index}-{i}" for i in range(len(_share(sizes, index, shares)))]
        started = time.perf_counter()
        for path, size in zip(mine, _share(sizes, index, shares), strict=True):
            _write(path, size)
        if mine:
            found[f"write {kind.name}"] = time.perf_counter() - started
        paths = cycle(_share(kind.files, index, shares) or mine)
        left = kind.read // shares
        started = time.perf_counter()
        while left > 0 and (source := next(paths, None)):
            left -= _read(source, left) or left  # an empty file would be read for ever
        if kind.read:
            found[f"read {kind.name}"] = time.perf_counter() - started
    return found


def _write(path: Path, size: int) -> None:
    with path.open("wb") as file:
        np.ones(size, np.uint8).tofile(file)


def _read(path: Path, most: int) -> int:
    """Read at most so many bytes of a file into a new array; how many there were."""
    return int(np.fromfile(path, np.uint8, count=most).size)


def on_every_worker(client: Client, task: Any, *arguments: Any) -> list[Seconds]:
    """Run task(*arguments, index, n_workers) on all workers at the same time."""
    addresses = sorted(client.scheduler_info(n_workers=-1)["workers"])
    futures = [
        client.submit(task, *arguments, index, len(addresses), workers=[address], pure=False)
        for index, address in enumerate(addresses)
    ]
    return list(client.gather(futures))


def traffic_of(store: Path, run: Path, plan: Plan) -> list[Traffic]:
    """What a finished run has read and written: its samples once, the spectrum as often as blocks read it."""
    row = SAMPLE_BYTES * plan.geometry.collection.n_range_frequency
    signal = _chunks(store / "signal")
    found = [Traffic("input", _largest(signal), 0, row * plan.geometry.collection.n_pulse, tuple(signal))]
    if spectrum := _chunks(run / "spectrum.zarr" / "spectrum"):
        read = row * sum(block.n_bin for block in plan.blocks)
        found.append(Traffic("spectrum", _largest(spectrum), row * plan.recovery.doppler.size, read))
    image, known = run / "image.zarr", set()
    for name, folder, reads in (
        ("patches", run / "patches", 1),
        ("image", image / "image", 0),
        ("block", image / "block", 0),
    ):
        # A file may be a hard link to one that was there: written once.
        files = [path for path in _chunks(folder) if path.stat().st_ino not in known]
        known |= {path.stat().st_ino for path in files}
        if files:
            stored = sum(path.stat().st_size for path in files)
            found.append(Traffic(name, _largest(files), stored, reads * stored))
    return found


def _chunks(folder: Path) -> list[Path]:
    """Files of samples below a folder; axes of a store lie in folders of their own and are small change."""
    return sorted(path for path in folder.rglob("*") if path.is_file() and path.suffix != ".json")


def _largest(files: Sequence[Path]) -> int:
    return max(path.stat().st_size for path in files)


# ---------------------------------------------------------------- back-projection


@dataclass(frozen=True)
class Chips:
    """Windows of the image at telling places: x, y (n * CHIP, CHIP) m, and the places' names."""

    names: list[str]
    windows: list[tuple[slice, slice]]
    x: FloatArray
    y: FloatArray


def place_chips(plan: Plan, run: Path) -> Chips:
    """Near, middle and far range of every block's centre, and the middles of the seams, where the image covers them."""
    names, windows = [], []
    for name, slant_range, yaw in _places(plan):
        x, y, _ = plan.geometry.ground_point(np.array(slant_range), np.array(yaw))
        row = round((float(y) - plan.grid.y[0]) / plan.grid.dy) - CHIP // 2
        column = round((float(x) - plan.grid.x[0]) / plan.grid.dx) - CHIP // 2
        if not (0 <= row <= plan.grid.shape[0] - CHIP and 0 <= column <= plan.grid.shape[1] - CHIP):
            continue
        window = (slice(row, row + CHIP), slice(column, column + CHIP))
        if np.isfinite(stores.read_region(run / "image.zarr", "image", window).real).mean() > 0.5:
            names.append(name)
            windows.append(window)
    if not windows:
        raise InputError(f"the image of scene {run.name} has no room for a chip of {CHIP} x {CHIP} pixels")
    meshes = [np.meshgrid(plan.grid.x[columns], plan.grid.y[rows]) for rows, columns in windows]
    x, y = (np.concatenate([mesh[axis] for mesh in meshes]) for axis in (0, 1))
    return Chips(names, windows, x, y)


def _places(plan: Plan) -> Iterator[tuple[str, float, float]]:
    for block in plan.blocks:
        near, far = block.ground.near, block.ground.far
        for where, share in (("near", 0.1), ("middle", 0.5), ("far", 0.9)):
            yield f"block {block.name}, {where} range", near + share * (far - near), (block.low + block.high) / 2
    for seam in plan.seams[1:-1]:
        near, far = plan.region.limits(seam, seam)
        yield f"seam at {np.degrees(seam):.2f} degrees", (near + far) / 2, seam


class Projected(NamedTuple):
    """Seconds for reading and the profiles of all pulses, seconds for updates, and how many these were."""

    profiles: float
    accumulation: float
    updates: int


def back_project(history: stores.PhaseHistory, geometry: Geometry, chips: Chips, threads: int) -> Projected:
    """Time the parts of back-projection: they do not grow alike with the image."""
    collection = geometry.collection
    clock = [0.0, 0.0]
    started = time.perf_counter()
    first, last = lit_interval(geometry, chips.x, chips.y)
    image, outside = np.zeros(chips.x.shape, np.complex64), np.zeros(chips.x.shape, np.bool_)
    clock[1] += time.perf_counter() - started
    step = pulse_block_size(collection)
    for begin in range(0, collection.n_pulse, step):
        pulses = slice(begin, min(begin + step, collection.n_pulse))
        started = time.perf_counter()
        samples = history.read(pulses, slice(None))
        profiles = range_profiles(samples, collection=collection, pulses=pulses, threads=threads)
        ready = time.perf_counter()
        accumulate(
            image, outside, profiles, geometry=geometry, x=chips.x, y=chips.y, first=first, last=last, threads=threads
        )
        clock[0] += ready - started
        clock[1] += time.perf_counter() - ready
    return Projected(clock[0], clock[1], int((last - first).sum()))


def count_updates(plan: Plan, run: Path) -> tuple[int, int]:
    """Covered pixels of the image, and their lit pulses in all, from every n-th pixel either way."""
    height, width = plan.grid.shape
    step = max(1, int(math.sqrt(height * width / SAMPLED_PIXELS)))
    rows, columns = slice(0, height, step), slice(0, width, step)
    covered = stores.read_region(run / "image.zarr", "block", (rows, columns)) >= 0
    x, y = np.meshgrid(plan.grid.x[columns], plan.grid.y[rows])
    first, last = lit_interval(plan.geometry, x[covered], y[covered])
    return int(covered.sum()) * step**2, int((last - first).sum()) * step**2


def compare_chips(
    history: stores.PhaseHistory, plan: Plan, run: Path, chips: Chips, threads: int
) -> tuple[list[dict[str, Any]], ComplexArray]:
    """Coherence, gain and phase of the image with exact back-projection, by chip; and the exact chips."""
    exact = form_points(lambda p: history.read(p, slice(None)), plan.geometry, chips.x, chips.y, threads=threads)
    found = []
    for i, (name, window) in enumerate(zip(chips.names, chips.windows, strict=True)):
        mine = stores.read_region(run / "image.zarr", "image", window)
        c = coherence(mine, exact[i * CHIP : (i + 1) * CHIP])
        found.append({"place": name, "coherence": abs(c.coherence), "gain": c.gain, "phase_radians": c.phase})
    return found, exact


# ---------------------------------------------------------------- peer


def run_peer(
    history: stores.PhaseHistory, plan: Plan, chips: Chips, exact: ComplexArray, repeats: int
) -> dict[str, Any]:
    """torchbp's backprojection_cart_2d on the first chip: its dwell only, as that function knows no steered beam.

    On CPU, with as many threads as it takes itself (all processors). Range profiles are made here and not timed.
    torchbp counts phases in float32: at tens of kilometres of range and centimetres of wavelength they do not
    hold, as the coherence that is reported shows, so that speed is all there is to compare.
    """
    try:
        torch, torchbp = importlib.import_module("torch"), importlib.import_module("torchbp")
    except ImportError as error:
        return {"name": "torchbp", "status": "not installed", "reason": str(error)}
    collection, x, y = plan.geometry.collection, chips.x[:CHIP], chips.y[:CHIP]
    first, last = lit_interval(plan.geometry, x, y)
    pulses = slice(int(first.min()), int(last.max()))
    reference = collection.reference_range[pulses]
    if np.ptp(reference) > 0:
        return {"name": "torchbp", "status": "not run", "reason": "it needs a constant reference range"}
    samples = history.read(pulses, slice(None))
    profiles = range_profiles(samples, collection=collection, pulses=pulses, threads=1)
    corner = np.array([x[0, 0], y[0, 0], collection.ground_height])  # its ground is z = 0
    position = (collection.antenna_position[pulses] - corner).astype(np.float32)
    arguments = {
        "data": torch.from_numpy(profiles.values),
        "grid": {"x": (0.0, CHIP * plan.grid.dx), "y": (0.0, CHIP * plan.grid.dy), "nx": CHIP, "ny": CHIP},
        "fc": float(collection.carrier + collection.range_frequency[collection.n_range_frequency // 2]),
        "r_res": profiles.spacing,
        "pos": torch.from_numpy(position),
        "d0": profiles.centre * profiles.spacing - float(reference[0]),
    }
    image, seconds = None, []
    for _ in range(repeats + 1):
        started = time.perf_counter()
        image = torchbp.ops.backprojection_cart_2d(**arguments)
        seconds.append(time.perf_counter() - started)
    theirs = np.asarray(image).reshape(CHIP, CHIP).T.astype(np.complex64)
    updates = CHIP * CHIP * (pulses.stop - pulses.start)
    return {
        "name": "torchbp",
        "status": "run",
        "versions": {"torch": str(torch.__version__), "torchbp": _version("torchbp")},
        "what": f"backprojection_cart_2d, one chip of {CHIP} x {CHIP} pixels, {pulses.stop - pulses.start} pulses, CPU",
        "updates_per_second": spread([updates / s for s in seconds[1:]]),
        "coherence": abs(coherence(theirs, exact[:CHIP]).coherence),
    }


# ---------------------------------------------------------------- measuring


@dataclass
class Measured:
    """One number a repeat, by name: seconds; `tasks`: seconds summed over workers."""

    end_to_end: list[float] = field(default_factory=list)
    stages: dict[str, list[float]] = field(default_factory=dict)
    steps: dict[str, list[float]] = field(default_factory=dict)
    recovery_tasks: list[float] = field(default_factory=list)
    fft: list[float] = field(default_factory=list)
    fft_tasks: dict[str, list[float]] = field(default_factory=dict)
    io: list[float] = field(default_factory=list)
    io_kinds: dict[str, list[float]] = field(default_factory=dict)
    profiles: list[float] = field(default_factory=list)
    accumulation: list[float] = field(default_factory=list)

    def add_run(self, seconds: float, record: dict[str, Any]) -> None:
        self.end_to_end.append(seconds)
        timings = dict(record["timings"])
        plan = seconds - timings.pop("total")
        rest = seconds - plan - sum(timings.values())
        _append(self.stages, {"plan": plan, **timings, "stores and receipts": rest})
        steps: Seconds = {}
        for receipt in record["receipts"]:
            for name, taken in receipt.get("steps", {}).items():
                steps[name] = steps.get(name, 0.0) + taken
        _append(self.steps, steps)
        self.recovery_tasks.append(sum(r["seconds"] for r in record["receipts"] if r["unit"].startswith("columns-")))

    def add_floors(self, fft: list[Seconds], io: list[Seconds]) -> None:
        # All workers start at once: the floor is the slowest's.
        self.fft.append(max(sum(worker.values()) for worker in fft))
        self.io.append(max(sum(worker.values()) for worker in io))
        _append(self.fft_tasks, {stage: sum(worker[stage] for worker in fft) for stage in fft[0]})
        kinds = dict.fromkeys(name for worker in io for name in worker)
        _append(self.io_kinds, {name: max(worker.get(name, 0.0) for worker in io) for name in kinds})


def _append(lists: dict[str, list[float]], values: Seconds) -> None:
    for name, value in values.items():
        lists.setdefault(name, []).append(value)


def spread(values: Sequence[float]) -> dict[str, Any]:
    """Median, extremes, and every run's."""
    return {"median": statistics.median(values), "min": min(values), "max": max(values), "runs": list(values)}


def over(numerators: Sequence[float], denominators: Sequence[float]) -> list[float]:
    """Quotients repeat by repeat."""
    return [a / b for a, b in zip(numerators, denominators, strict=True)]


def total(lists: dict[str, list[float]], names: Sequence[str]) -> list[float]:
    """Sum of some lists, repeat by repeat; empty if none is there."""
    return [sum(values) for values in zip(*(lists[name] for name in names if name in lists), strict=True)]


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

    def focus(self, client: Client, case: Case, store: Path) -> tuple[float, dict[str, Any], Path]:
        """Focus into an empty folder; seconds from call to return, the run's record, the run."""
        run = emptied(self.folder / str(case.scale) / "run")
        started = time.perf_counter()
        report = blocksar.focus(store, run, blocks=case.plan.n_blocks, threads=self.threads, client=client)
        return time.perf_counter() - started, report.result, run

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
            return [self.focus(client, case, store)[1]["timings"]["focus"] for _ in range(self.repeats)]


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


def describe(
    case: Case, m: Measured, traffic: list[Traffic], peaks: list[int], record: dict[str, Any]
) -> dict[str, Any]:
    """A scene's part of the JSON: ratios first."""
    plan, collection = case.plan, case.plan.geometry.collection
    names = {step.name for block in plan.blocks for step in block.chain}
    # Steps that run in one pass have one time, and a name such as read-slab+residual-walk+keystone.
    chain = [name for name in m.steps if names.intersection(name.split("+"))]
    timed = {step for name in chain for step in name.split("+")}
    chain_fft = total(m.fft_tasks, [stage for stage in m.fft_tasks if timed.issuperset(stage.split("+"))])
    projected = [a + b for a, b in zip(m.profiles, m.accumulation, strict=True)]
    ratios = {
        "end_to_end_over_floor": over(m.end_to_end, [a + b for a, b in zip(m.fft, m.io, strict=True)]),
        "recovery_over_own_ffts": over(m.recovery_tasks, m.fft_tasks["recover"]),
        "back_projection_over_end_to_end": over(projected, m.end_to_end),
        "peak_memory_over_planned": [max(peaks) / plan.memory],
    }
    if steps := total(m.steps, chain):
        ratios["chain_over_own_ffts"] = over(steps, chain_fft)
    return {
        "ratios": {name: spread(values) for name, values in ratios.items()},
        "seconds": {
            "end_to_end": spread(m.end_to_end),
            "stages": {name: spread(values) for name, values in m.stages.items()},
            "recovery_summed_over_workers": spread(m.recovery_tasks),
            "steps_summed_over_workers": {name: spread(values) for name, values in m.steps.items()},
            "fft_floor": spread(m.fft),
            "fft_floor_summed_over_workers": {name: spread(values) for name, values in m.fft_tasks.items()},
            "io_floor": spread(m.io),
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
            "peak_in_receipts_bytes": record["peak_memory"],
            "planned_bytes": plan.memory,
        },
        "notes": case.notes,
    }


def compare_scenes(scenes: dict[str, dict[str, Any]]) -> None:
    """Add the time for an input sample relative to the first scene's."""
    per_sample = {
        name: [seconds / scene["size"]["samples"] for seconds in scene["seconds"]["end_to_end"]["runs"]]
        for name, scene in scenes.items()
    }
    reference = statistics.median(next(iter(per_sample.values())))
    for name, scene in scenes.items():
        scene["ratios"]["time_per_sample_over_first_scene"] = spread([s / reference for s in per_sample[name]])


# ---------------------------------------------------------------- what is printed


RATIOS = {
    "end_to_end_over_floor": "end to end / (FFT + I/O floor)",
    "chain_over_own_ffts": "chain / its own FFTs",
    "recovery_over_own_ffts": "recovery / its own FFTs",
    "back_projection_over_end_to_end": "back-projection / end to end",
    "block_stage_speedup": "block stage, 1 worker / all",
    "time_per_sample_over_first_scene": "time per sample / first scene's",
    "peak_memory_over_planned": "peak memory / planned",
}


def show(result: dict[str, Any]) -> None:
    """Ratios, then times, then sizes, then sentences, in 100 columns."""
    console = Console(width=WIDTH, highlight=False)
    scenes = result["scenes"]
    console.print(_ratio_table(scenes), _time_table(scenes), _size_table(scenes))
    for line in _lines(result):
        console.print(f"- {line}", markup=False)


def _table(title: str, scenes: dict[str, Any]) -> Table:
    table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left", pad_edge=False)
    table.add_column("")
    for name in scenes:
        table.add_column(name, justify="right")
    return table


def _cell(found: dict[str, Any] | None) -> str:
    if not found:
        return ""
    median, low, high = (_number(found[name]) for name in ("median", "min", "max"))
    return median if low == high else f"{median} ({low}..{high})"


def _number(value: float) -> str:
    return f"{value:.{3 if value < 1 else 2 if value < 10 else 1 if value < 100 else 0}f}"


def _ratio_table(scenes: dict[str, Any]) -> Table:
    table = _table("ratios: median (min..max)", scenes)
    for name, label in RATIOS.items():
        table.add_row(label, *(_cell(scene["ratios"].get(name)) for scene in scenes.values()))
    return table


def _time_table(scenes: dict[str, Any]) -> Table:
    table = _table("seconds: median (min..max)", scenes)
    seconds = [scene["seconds"] for scene in scenes.values()]

    def row(name: str, label: str) -> None:
        table.add_row(label, *(_cell(found[name]) for found in seconds))

    def parts(name: str) -> None:
        for part in dict.fromkeys(part for found in seconds for part in found[name]):
            table.add_row(f"  {part}", *(_cell(found[name].get(part)) for found in seconds))

    row("end_to_end", "end to end")
    parts("stages")
    table.add_row("tasks, summed over workers")
    row("recovery_summed_over_workers", "  recover")
    parts("steps_summed_over_workers")
    row("fft_floor", "FFT floor")
    table.add_row("of it, summed over workers")
    parts("fft_floor_summed_over_workers")
    row("io_floor", "I/O floor")
    parts("io_floor_by_kind")
    row("back_projection_extrapolated", "back-projection, extrapolated")
    row("back_projection_profiles", "  range profiles, once")
    return table


def _size_table(scenes: dict[str, Any]) -> Table:
    table = _table("sizes", scenes)

    def row(label: str, text: Any) -> None:
        table.add_row(label, *(text(scene) for scene in scenes.values()))

    row("pulses x range frequencies", lambda s: f"{s['size']['pulses']} x {s['size']['range_frequencies']}")
    row("PRF (Hz)", lambda s: f"{s['size']['prf_hertz']:g}")
    row("blocks x range sub-blocks", lambda s: f"{s['size']['blocks']} x {s['size']['range_sub_blocks']}")
    row("covered pixels (M)", lambda s: f"{s['back_projection']['covered_pixels'] / 1e6:.3g}")
    row("written (MiB)", lambda s: f"{sum(s['size']['written_bytes'].values()) / MIB:.0f}")
    row("read (MiB)", lambda s: f"{sum(s['size']['read_bytes'].values()) / MIB:.0f}")
    row("peak memory of each worker (MiB)", lambda s: ", ".join(_mib(s["memory"]["peak_by_worker_bytes"])))
    row("planned memory of a worker (MiB)", lambda s: _mib([s["memory"]["planned_bytes"]])[0])
    row("back-projection (M updates/s)", lambda s: _cell(_scaled(s["back_projection"]["updates_per_second"], 1e-6)))
    row("coherence with it on clutter", _coherence)
    return table


def _mib(values: Sequence[int]) -> list[str]:
    return [f"{value / MIB:.0f}" for value in values]


def _scaled(found: dict[str, Any], factor: float) -> dict[str, Any]:
    return {name: factor * found[name] for name in ("median", "min", "max")}


def _coherence(scene: dict[str, Any]) -> str:
    found = scene.get("coherence")
    return "" if found is None else f"{found['median']:.4f} ({found['min']:.4f}..{found['max']:.4f})"


def _lines(result: dict[str, Any]) -> list[str]:
    settings, computer = result["settings"], result["machine"]
    workers, threads = settings["workers"], settings["threads"]
    lines = [
        f"{computer['cpu']}, {computer['cores']} cores; load {computer['load_average_1_minute']:.2f} at the start; "
        f"{settings['repeats']} repeats",
        f"run and floors: {workers} worker processes of {threads} thread{'s' * (threads > 1)}, all at once; "
        f"back-projection: one process of {workers * threads} threads, "
        "range profiles counted once for the whole image, the kindest to it",
        "plan: before the cluster is asked; stores and receipts: what no stage accounts for",
        "the chain of a block is its range and azimuth steps: neither the reading of its slab nor the correction",
    ]
    for scene in result["scenes"].values():
        lines += scene["notes"]
        if "peer" in scene:
            lines.append(_peer_line(scene["peer"]))
    lines += result["refused"]
    return lines


def _peer_line(peer: dict[str, Any]) -> str:
    if peer["status"] != "run":
        return f"{peer['name']}: {peer['status']} ({peer['reason']})"
    rate = _cell(_scaled(peer["updates_per_second"], 1e-6))
    return (
        f"{peer['name']} {peer['versions']['torchbp']}: {peer['what']}: {rate} M updates/s; coherence with exact "
        f"back-projection {peer['coherence']:.3f} (its phases are float32)"
    )


# ---------------------------------------------------------------- the command


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "unknown"


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
        "versions": {"python": platform.python_version()} | {name: _version(name) for name in packages},
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
