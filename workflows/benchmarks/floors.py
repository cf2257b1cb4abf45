"""Lower limits of a run's time: the bare transforms of its plan, and the bare reading and writing of its bytes."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import scipy.fft
from distributed import Client

from blocksar.kernels.groups import row_groups
from blocksar.places import direct
from blocksar.processors.chain.planning.plan import Plan, Transforms
from blocksar.processors.chain.planning.written_bytes import run_bytes

Seconds = dict[str, float]
SAMPLE_BYTES = 8  # complex64


def _share(items: Sequence[Any], index: int, shares: int) -> Sequence[Any]:
    return items[index::shares]


def fft_share(transforms: list[Transforms], threads: int, index: int, shares: int) -> Seconds:
    """Seconds by stage for one worker's share of the bare transforms.

    They are done in place, in groups that fit the cache, on zeros: the time does not depend on the values, and
    zeros do not overflow however often they are transformed.
    """
    seconds: Seconds = {}

    def transform(part: Transforms, thread: int) -> None:
        groups = _share(row_groups(0, part.count, part.length), index * threads + thread, shares * threads)
        if not groups:
            return
        scratch = np.zeros((groups[0].stop - groups[0].start, part.length), np.complex64)
        for rows in groups:
            scipy.fft.fft(scratch[: rows.stop - rows.start], axis=1, overwrite_x=True)

    with ThreadPoolExecutor(threads) as pool:
        for part in transforms:
            started = time.perf_counter()
            futures = [pool.submit(transform, part, thread) for thread in range(threads)]
            for future in futures:
                future.result()
            seconds[part.stage] = seconds.get(part.stage, 0.0) + time.perf_counter() - started
    return seconds


@dataclass(frozen=True)
class Traffic:
    """Bytes of one kind that a run writes and reads, in files of at most `file_bytes`.

    `files` are read if there are any, otherwise what was written.
    """

    name: str
    file_bytes: int
    written: int
    read: int
    files: tuple[Path, ...] = ()


def io_share(folder: Path, traffic: list[Traffic], past_cache: bool, index: int, shares: int) -> Seconds:
    """Seconds by kind and direction for one worker's share of plain files, written then read.

    `past_cache`: as a run writes them, where the file system allows it, except for the input.
    """
    seconds: Seconds = {}
    for kind in traffic:
        sizes = [kind.file_bytes] * (kind.written // kind.file_bytes)
        sizes += [kind.written % kind.file_bytes] if kind.written % kind.file_bytes else []
        mine = [folder / f"{kind.name}-{index}-{i}" for i in range(len(_share(sizes, index, shares)))]
        started = time.perf_counter()
        for path, size in zip(mine, _share(sizes, index, shares), strict=True):
            (_write_direct if past_cache else _write)(path, size)
        if mine:
            seconds[f"write {kind.name}"] = time.perf_counter() - started
        paths = cycle(_share(kind.files, index, shares) or mine)
        left = kind.read // shares
        started = time.perf_counter()
        while left > 0 and (source := next(paths, None)):
            read = _read_direct if past_cache and not kind.files else _read
            left -= read(source, left) or left  # an empty file counts as read
        if kind.read:
            seconds[f"read {kind.name}"] = time.perf_counter() - started
    return seconds


def _write(path: Path, size: int) -> None:
    with path.open("wb") as file:
        np.ones(size, np.uint8).tofile(file)


def _read(path: Path, most: int) -> int:
    """Read at most so many bytes of a file into a new array; the number of bytes read."""
    return int(np.fromfile(path, np.uint8, count=most).size)


def _write_direct(path: Path, size: int) -> None:
    with direct.writing(str(path)) as file:
        file.write(np.ones(size, np.uint8).data)


def _read_direct(path: Path, most: int) -> int:
    target = np.empty(min(path.stat().st_size, most), np.uint8)
    with direct.reading(str(path)) as file:
        return file.readinto(target.data)


def on_every_worker(client: Client, task: Any, *arguments: Any) -> list[Seconds]:
    """Run task(*arguments, index, n_workers) on all workers at the same time; their results."""
    addresses = sorted(client.nthreads())
    futures = [
        client.submit(task, *arguments, index, len(addresses), workers=[address], pure=False)
        for index, address in enumerate(addresses)
    ]
    return list(client.gather(futures))


def traffic_of(store: Path, run: Path, plan: Plan) -> list[Traffic]:
    """Bytes that a finished run has read and written: its samples once, the spectrum by the blocks or their gates."""
    row = SAMPLE_BYTES * plan.geometry.collection.n_range_frequency
    signal = _chunks(store / "signal")
    traffic = [Traffic("input", _largest(signal), 0, row * plan.geometry.collection.n_pulse, tuple(signal))]
    if spectrum := _chunks(run / "spectrum.zarr" / "spectrum"):
        whole = sum(block.n_bin for block in plan.blocks if block.range_gate is None)
        read = row * (whole + sum(last - first for first, last in plan.gate_spans()))
        traffic.append(Traffic("spectrum", _largest(spectrum), row * plan.recovery.doppler.size, read))
    if gated := run_bytes(plan).get("gated", 0):  # removed at the end of the run
        chunk = max(math.prod(plan.gated_chunk(block)) for block in plan.blocks)
        traffic.append(Traffic("gated", SAMPLE_BYTES * chunk, gated, gated))
    image, counted = run / "image.zarr", set()
    for name, folder, reads in (
        ("patches", run / "patches", 1),
        ("image", image / "image", 0),
        ("block", image / "block", 0),
    ):
        # Hard links to one file were written once.
        files = [path for path in _chunks(folder) if path.stat().st_ino not in counted]
        counted |= {path.stat().st_ino for path in files}
        if files:
            stored = sum(path.stat().st_size for path in files)
            merged = sum(path.stat().st_size for path in files if path.stat().st_nlink == 1)
            traffic.append(Traffic(name, _largest(files), stored, reads * merged))
    return traffic


def _chunks(folder: Path) -> list[Path]:
    """Files of samples below a folder, without metadata."""
    return sorted(path for path in folder.rglob("*") if path.is_file() and path.suffix != ".json")


def _largest(files: Sequence[Path]) -> int:
    return max(path.stat().st_size for path in files)
