"""Cost against error: the processors on small scenes, beside exact back-projection."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import blocksar
from benchmarks.environment import describe_machine, versions
from blocksar import stores
from blocksar.arrays import ComplexArray
from blocksar.errors import InputError
from blocksar.graph.machine import machine
from blocksar.measurement.coherence import coherence
from blocksar.processors import AUTO, PROCESSORS, REFERENCE

PEER = "fastsar"
SCRIPT = Path(__file__).with_name("peer_image.py")
FIDELITIES = (0.99, 0.9999)  # that are asked for
CLUTTER = "\n[clutter]\nscatterers = 20000\nseed = 3\nx = [{0}, {1}]\ny = [{0}, {1}]\n"


class Small(NamedTuple):
    """A scene about the origin: what it is, its file, and half of the side of its image and the pixels' step, m."""

    what: str
    text: str
    half: float
    step: float

    @property
    def grid(self) -> str:
        return ",".join([f"{-self.half}:{self.half}:{self.step}"] * 2)


SQUINT_TOPS = """
title = "squint TOPS"
[radar]
carrier = 15e9
bandwidth = 50e6
range_sampling = 60e6
prf = 8e3
[track]
position = [-16100.0, -19200.0, 16500.0]
velocity = [-40.0, 1300.0, -600.0]
acceleration = [-15.0, -30.0, -35.0]
[time]
duration = 0.3
[beam]
start_deg = 46.07
stop_deg = 53.93
dwell = 0.162
[scene]
swath = [29400.0, 30600.0]
"""
STRIPMAP = """
title = "stripmap"
[radar]
carrier = 9.6e9
bandwidth = 60e6
range_sampling = 75e6
prf = 320
[track]
position = [-9000.0, 0.0, 4000.0]
velocity = [0.0, 200.0, -2.0]
acceleration = [0.2, 0.5, 0.0]
[time]
pulses = 901
[beam]
mode = "stripmap"
width_deg = 1.1
[scene]
swath = [9550.0, 10150.0]
centre_yaw_deg = 0.0
"""
SPOTLIGHT = """
title = "spotlight"
[radar]
carrier = 10e9
bandwidth = 120e6
range_sampling = 144e6
prf = 250
[track]
position = [-4000.0, 0.0, 3000.0]
velocity = [0.0, 100.0, 0.0]
[time]
pulses = 1000
[scene]
swath = [4750.0, 5250.0]
centre_yaw_deg = 0.0
reference_range = "scene_centre"
"""
SCENES = {
    "squint TOPS": Small("30 km away, 15 GHz, 50 MHz, diving and turning", SQUINT_TOPS, 400.0, 1.0),
    "stripmap": Small("10 km away, 9.6 GHz, 60 MHz, slightly curved", STRIPMAP, 180.0, 0.8),
    "spotlight": Small("5 km away, 10 GHz, 120 MHz, beam not steered", SPOTLIGHT, 200.0, 0.5),
}


@dataclass(frozen=True)
class Row:
    """What a processor did on a scene: processor time, s, and its error beside exact back-projection.

    `error` is the power of the difference over that of the exact image, `coherence` that of both, where
    both cover; None of the exact image itself. `asked` is the fidelity that was asked for.
    """

    processor: str
    asked: float | None
    seconds: float
    coherence: float | None = None
    error: float | None = None


def compare_processors(folder: Path, *, repeats: int, peers: str | None) -> dict[str, Any]:
    """Focus each scene by each processor, in this process; median processor times of `repeats`, and errors.

    `peers` is a Python whose environment has fastsar, which forms the image of what lights all pulses.
    """
    blocksar.compile()
    scenes = {}
    for name, small in SCENES.items():
        scene = folder / f"{name.replace(' ', '-')}.toml"
        scene.write_text(small.text + CLUTTER.format(-1.2 * small.half, 1.2 * small.half))
        store = blocksar.simulate(scene, scene.with_suffix(".zarr"), progress=False)
        exact, row = _focus(store, small, folder, REFERENCE, None, repeats)
        rows, refused = [row], {}
        pulses, samples = blocksar.open(store).signal.shape
        for processor, fidelity in _asked():
            if processor in refused:
                continue
            try:
                _, row = _focus(store, small, folder, processor, fidelity, repeats, exact=exact)
            except InputError as error:
                refused[processor] = str(error)
                continue
            rows.append(row)
        if stores.open_phase_history(store).collection.beam_width is None:  # all pulses light all ground
            try:
                rows += _peers(peers, store, exact, folder)
            except InputError as error:
                refused[PEER] = str(error)
        scenes[name] = {
            "what": small.what, "pulses": pulses, "samples": samples, "pixels": list(exact.shape), "rows": rows,
            "refused": refused,
        }  # fmt: skip
    return {"machine": describe_machine(), "versions": versions(), "repeats": repeats, "scenes": scenes}


def _asked() -> Iterator[tuple[str, float]]:
    for processor in PROCESSORS.names():
        if processor not in (AUTO, REFERENCE):
            yield from ((processor, fidelity) for fidelity in FIDELITIES)


def _focus(
    store: Any, small: Small, folder: Path, processor: str, fidelity: float | None, repeats: int,
    *, exact: ComplexArray | None = None,
) -> tuple[ComplexArray, Row]:  # fmt: skip
    settings: dict[str, Any] = {"grid": small.grid, "processor": processor}
    if fidelity is not None:
        settings["fidelity"] = fidelity
    seconds = []
    for _ in range(repeats):
        started = time.process_time()
        blocksar.focus(
            store, folder / "run", workers=0, threads=machine()[0], overwrite=True, progress=False, **settings
        )
        seconds.append(time.process_time() - started)
    image = blocksar.open(folder / "run").image.values
    found = None if exact is None else _error(image, exact)
    return image, Row(processor, fidelity, float(np.median(seconds)), *(found or ()))


def _peers(python: str | None, store: Any, exact: ComplexArray, folder: Path) -> list[Row]:
    """Images by fastsar, from arrays to arrays, once its loops are compiled.

    Raises
    ------
    InputError
        If there is no such Python, or it has no fastsar.
    """
    if python is None:
        raise InputError("not run; --peers names a Python whose environment has it")
    history, image = blocksar.open(store), blocksar.open(folder / "run")
    source, out = folder / "peers-in.npz", folder / "peers-out.npz"
    np.savez(
        source, signal=history.signal.values, position=history.antenna_position.values,
        reference=history.reference_range.values, x=image.x.values, y=image.y.values,
        frequency=history.attrs["carrier_frequency"] + history.range_frequency.values,
    )  # fmt: skip
    try:
        done = subprocess.run([python, str(SCRIPT), str(source), str(out)], capture_output=True, text=True, check=False)
    except OSError as error:
        raise InputError(f"--peers {python}: {error.strerror}; give the path of a Python that has fastsar") from None
    if done.returncode:
        said = (done.stderr.strip().splitlines() or ["it says nothing"])[-1]
        raise InputError(f"--peers {python}: {said}; give the path of a Python that has fastsar")
    rows = []
    with np.load(out) as found:
        for name in (key.removesuffix(": seconds") for key in found.files if key.endswith(": seconds")):
            # Sums of theirs are means of ours.
            values = found[f"{name}: image"] / history.signal.size
            rows.append(
                Row(f"{name} {found['version']}", None, float(found[f"{name}: seconds"]), *_error(values, exact))
            )
    return rows


def _error(image: ComplexArray, exact: ComplexArray) -> tuple[float, float]:
    """Coherence, and power of the difference over that of the exact image."""
    both = np.isfinite(image) & np.isfinite(exact)
    ours, theirs = image[both].astype(np.complex128), exact[both].astype(np.complex128)
    difference = float(np.sum(np.abs(ours - theirs) ** 2) / np.sum(np.abs(theirs) ** 2))
    return abs(coherence(image[both], exact[both]).coherence), difference
