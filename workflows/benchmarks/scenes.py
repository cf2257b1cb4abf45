"""Scenes of the benchmark, scaled, and their plans."""

from __future__ import annotations

import json
import re
import tomllib
from contextlib import suppress
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, Literal, NamedTuple

from blocksar.collection.collection import Collection
from blocksar.errors import InputError, PrfTooLow
from blocksar.planning.plan import MAX_BLOCKS, Plan, plan_collection
from blocksar.simulation.scene import Scene

Tables = dict[str, Any]  # a scene file, read
Blocks = int | Literal["auto"]
CLUTTER = {"scatterers": 100_000, "seed": 3}
NOISE = {"power": 1.0, "seed": 5}


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
    place = path if path.is_file() else resources.files("blocksar.simulation") / "scenes" / f"{source}.toml"
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
        except PrfTooLow as error:
            if error.needed <= scene.radar.prf:
                raise
            prf = error.needed
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
