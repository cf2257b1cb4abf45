"""The benchmark's tables and sentences."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from blocksar.constants import MIB

WIDTH = 100  # columns of the tables


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
