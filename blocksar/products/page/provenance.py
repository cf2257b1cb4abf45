"""Provenance of a run for the report page: input, collection, versions, settings, and the command that repeats it."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from blocksar.budget import FIDELITY
from blocksar.focusing.method import Method
from blocksar.products.page.facts import Facts
from blocksar.products.page.words import number
from blocksar.runs import demonstration
from blocksar.runs.finished import FinishedRun
from blocksar.runs.folder import INPUT


def repeat_command(settings: Mapping[str, Any], paths: Sequence[str], folder: str) -> str:
    """The command that focuses the inputs in the same way again; empty if settings or paths are unknown.

    An input that lies in the run folder, as samples from memory do, is focused into another one.
    """
    if not settings or not paths:
        return ""
    inside = any(f"{path}/".startswith(f"{folder}/{INPUT}/") for path in paths)
    words = ["blocksar", "focus", *paths, "--out", f"{folder}-again" if inside else folder]
    defaults = Method().as_settings() | {
        "processor": "auto",
        "blocks": "auto",
        "fidelity": FIDELITY,
        "grid": None,
        "autofocus": False,
        "terrain": None,
        "surface": "plane",
        "vertical": None,
        "looks": None,
        "weighting_range": "uniform",
        "weighting_azimuth": "uniform",
    }
    names = list(settings)
    own = names[1 : names.index("blocks")] if {"processor", "blocks"} <= {*names} else []  # options of its processor
    for name, value in settings.items():
        if value == defaults.get(name, None if name in own else value):
            continue
        if name == "grid":
            x0, x1, dx, y0, y1, dy = value
            words.append(f"--grid={x0!r}:{x1!r}:{dx!r},{y0!r}:{y1!r}:{dy!r}")
        elif isinstance(value, bool):
            words.append(f"--{'' if value else 'no-'}{name}")
        elif name == "control":
            words += ["--control", "TARGETS.json"]  # the run keeps the points, and no name of a file
        else:
            words += [f"--{name.replace('_', '-')}", str(value)]
    return shlex.join(words)


def repeat_run(run: Facts, folder: str, looks: int | None = None) -> str:
    """The command that repeats a run: `blocksar demo` for a demonstration, `blocksar focus` for others."""
    history = f"{folder}/{demonstration.HISTORY}"
    settings = run.settings if looks is None else {**run.settings, "looks": looks}
    command = repeat_command(settings, run.record.inputs, folder)
    shown = {"blocks": demonstration.BLOCKS, "grid": [*demonstration.GRID[0], *demonstration.GRID[1]]}
    usual = repeat_command(shown, [history], folder)
    if command == usual and run.source.attrs.get("scene") == demonstration.SCENE:
        return shlex.join(["blocksar", "demo", "--out", folder, "--overwrite"])
    return command


def provenance(run: Facts) -> list[tuple[str, str]]:
    """Names and values of what is known of the run's input, image and collection."""
    collection = run.source.collection
    rows = [
        ("input", ", ".join(run.record.inputs)),
        ("fingerprint of the input", run.record.input.fingerprint),
        ("identity of the run", run.record.identity),
        ("weighting", run.source.weighting.text),
        ("image", _extent(run.source)),
        ("segments", _segments(run)),
        ("collection", f"{collection.n_pulse} pulses of {collection.n_range_frequency} range frequencies, "
         f"{collection.prf:.6g} Hz, {collection.carrier / 1e9:.6g} GHz, {collection.bandwidth / 1e6:.4g} MHz wide"),
        ("samples", run.samples),
        ("Doppler centroid", run.centroid),
        ("noise", "" if run.source.noise is None else run.source.noise.sentence()),
        ("georeference", _georeference(run.source)),
        ("versions", ", ".join(f"{name} {version}" for name, version in run.versions.items())),
    ]  # fmt: skip
    return [(name, str(value)) for name, value in rows if value]


def _segments(run: Facts) -> str:
    """Find what each segment of a run is of, and its blocks; empty in a run of one."""
    texts = []
    for index, segment in enumerate(run.record.segments):
        last = segment.first_block + (segment.blocks or 1) - 1
        pulses = "" if segment.pulses is None else f", pulses {segment.pulses[0]} .. {segment.pulses[1] - 1}"
        texts.append(f"{index}: {segment.path}{pulses}, blocks {segment.first_block} .. {last}")
    return "; ".join(texts)


def _extent(source: FinishedRun) -> str:
    """Extent of the image and height of its ground."""
    ends = [
        f"{name} {number(axis[0], 1)} .. {number(axis[-1], 1)} m" for name, axis in (("x", source.x), ("y", source.y))
    ]
    return f"{', '.join(ends)}, ground at {number(source.ground_height, 1)} m"


def _georeference(source: FinishedRun) -> str:
    """Place of the scene frame; empty if it is unknown."""
    frame = source.attrs.get("georeference")
    if not isinstance(frame, Mapping):
        return ""
    parts = [f"{name} {frame[name]}\N{DEGREE SIGN}" for name in ("latitude", "longitude") if name in frame]
    parts += [f"height {frame['height']} m"] if "height" in frame else []
    rotation = frame.get("rotation_deg")
    return ", ".join([*parts, *([f"x rotated {rotation}\N{DEGREE SIGN} from east"] if rotation else [])])


def settings_rows(run: Facts) -> list[tuple[str, str]]:
    """Names and values of the settings."""
    return [(name.replace("_", " "), _as_text(value)) for name, value in run.settings.items()]


def _as_text(value: Any) -> str:
    """A setting's value as text."""
    match value:
        case None:
            return "default"
        case bool():
            return "yes" if value else "no"
        case list():
            return ", ".join(f"{v:g}" if isinstance(v, float) else str(v) for v in value)
    return str(value)
