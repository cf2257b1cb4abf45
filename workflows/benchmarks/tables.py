"""The benchmark's tables and sentences."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from blocksar.constants import MIB

WIDTH = 100  # columns of the tables

RATIOS = {
    "end_to_end_over_floor": "end to end / (FFT + I/O floor)",
    "end_to_end_over_direct_floor": "the same, I/O past the page cache",
    "shell_over_warm": "blocksar focus from a shell / end to end",
    "planning_over_warm": "plan of 200 blocks / end to end",
    "compilation_over_warm": "compilation of a plain run / end to end",
    "chain_over_own_ffts": "chain / its own FFTs",
    "recovery_over_own_ffts": "recovery / its own FFTs",
    "back_projection_over_end_to_end": "back-projection / end to end",
    "other_version_over_end_to_end": "other version / end to end",
    "block_stage_speedup": "block stage, 1 worker on its core(s) / all",
    "time_per_sample_over_first_scene": "time per sample / first scene's",
    "peak_memory_over_planned": "peak memory / planned",
    "written_over_predicted": "bytes written / planned",
    "kernel_time": "system's share of the workers' time",
}


def show(result: dict[str, Any]) -> None:
    """Print ratios, times, sizes and notes, in 100 columns."""
    console = Console(width=WIDTH, highlight=False)
    scenes = result["scenes"]
    console.print(_ratio_table(scenes), _time_table(scenes), _size_table(scenes))
    for line in _notes(result):
        console.print(f"- {line}", markup=False)


def _table(title: str, scenes: dict[str, Any]) -> Table:
    table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left", pad_edge=False)
    table.add_column("")
    for name in scenes:
        table.add_column(name, justify="right")
    return table


def _cell(figure: dict[str, Any] | None) -> str:
    """Median and extremes of a figure; empty if it was not measured."""
    if not figure:
        return ""
    median, low, high = (_number(figure[name]) for name in ("median", "min", "max"))
    return median if low == high else f"{median} ({low}..{high})"


def _number(value: float) -> str:
    return f"{value:.{3 if value < 1 else 2 if value < 10 else 1 if value < 100 else 0}f}"


def _ratio_table(scenes: dict[str, Any]) -> Table:
    table = _table("ratios: median (min..max)", scenes)
    for name, label in RATIOS.items():
        if any(name in scene["ratios"] for scene in scenes.values()):
            table.add_row(label, *(_cell(scene["ratios"].get(name)) for scene in scenes.values()))
    return table


def _time_table(scenes: dict[str, Any]) -> Table:
    table = _table("seconds: median (min..max)", scenes)
    seconds = [scene["seconds"] for scene in scenes.values()]

    def row(name: str, label: str) -> None:
        table.add_row(label, *(_cell(scene[name]) for scene in seconds))

    def parts(name: str) -> None:
        for part in dict.fromkeys(part for scene in seconds for part in scene[name]):
            table.add_row(f"  {part}", *(_cell(scene[name].get(part)) for scene in seconds))

    if any("end_to_end_other_version" in scene for scene in seconds):
        row("end_to_end_other_version", "end to end, other version")
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
    row("io_floor_direct", "I/O floor past the page cache")
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
    row("geometric correction (ns a pixel)", _correction)
    row("back-projection (M updates/s)", lambda s: _cell(_scaled(s["back_projection"]["updates_per_second"], 1e-6)))
    row("coherence with it on clutter", _coherence)
    return table


def _correction(scene: dict[str, Any]) -> str:
    """Nanoseconds of a core for each covered pixel, with its writing."""
    figure = scene["seconds"]["steps_summed_over_workers"].get("geometric-correction")
    return "" if figure is None else _cell(_scaled(figure, 1e9 / scene["back_projection"]["covered_pixels"]))


def _start_lines(starts: dict[str, Any]) -> list[str]:
    planning = ", ".join(f"{name} {s:.2f} s" for name, s in starts["planning_processor_seconds"].items())
    commands = ", ".join(f"{name} {min(s):.2f}..{max(s):.2f} s" for name, s in starts["commands"].items())
    compiling = ", ".join(f"{name} {s:.1f} s" for name, s in starts["compile"].items())
    return [
        f"planning, processor time: {planning}", f"from a shell: {commands}", f"blocksar compile: {compiling}"
    ]  # fmt: skip


def _mib(values: Sequence[int]) -> list[str]:
    return [f"{value / MIB:.0f}" for value in values]


def _scaled(figure: dict[str, Any], factor: float) -> dict[str, Any]:
    return {name: factor * figure[name] for name in ("median", "min", "max")}


def _coherence(scene: dict[str, Any]) -> str:
    figure = scene.get("coherence")
    return "" if figure is None else f"{figure['median']:.4f} ({figure['min']:.4f}..{figure['max']:.4f})"


def _notes(result: dict[str, Any]) -> list[str]:
    settings, computer = result["settings"], result["machine"]
    workers, threads = settings["workers"], settings["threads"]
    notes = [
        f"{computer['cpu']}, {computer['cores']} cores; load {computer['load_average_1_minute']:.2f} at the start; "
        f"{settings['repeats']} repeats",
        f"run and floors: {workers} worker processes of {threads} thread{'s' * (threads > 1)} at the same time; "
        f"back-projection: one process of {workers * threads} threads, range profiles counted once for the whole "
        "image, which favours it",
        "plan: before the cluster is used; stores and receipts: the time outside all stages",
        "chain of a block: its range and azimuth steps, without the reading of its slab and the geometric correction",
    ]
    for scene in result["scenes"].values():
        notes += scene["notes"]
        if "starts" in scene:
            notes += _start_lines(scene["starts"])
        if "peer" in scene:
            notes.append(peer_line(scene["peer"]))
        if "other_version" in scene:
            other = scene["other_version"]
            notes.append(f"other version: blocksar {other['version']} of {other['python']}, in turns with this one")
    notes += result["refused"]
    return list(dict.fromkeys(notes))


def peer_line(peer: dict[str, Any]) -> str:
    if peer["status"] != "run":
        return f"{peer['name']}: {peer['status']} ({peer['reason']})"
    rate = _cell(_scaled(peer["updates_per_second"], 1e-6))
    return (
        f"{peer['name']} {peer['versions']['torchbp']}: {peer['what']}: {rate} M updates/s; coherence with exact "
        f"back-projection {peer['coherence']:.3f} (its phases are float32)"
    )
