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
from blocksar.processors.chain.planning.plan import Plan
from blocksar.processors.chain.planning.planner import MAX_BLOCKS, plan_collection
from blocksar.simulation.scene import Scene

Tables = dict[str, Any]  # of a scene file, as TOML reads it
Blocks = int | Literal["auto"]
CLUTTER = {"scatterers": 100_000, "seed": 3}
NOISE = {"power": 1.0, "seed": 5}


class Scale(NamedTuple):
    """Factors of the range swath and of the aperture."""

    swath: float
    aperture: float

    @classmethod
    def parse(cls, text: str) -> Scale:
        """Read a scale such as 2x2.

        Raises
        ------
        InputError
            If it is not two positive numbers.
        """
        match = re.fullmatch(r"\s*(\d+\.?\d*)x(\d+\.?\d*)\s*", text)
        if match is None or not (float(match[1]) > 0 and float(match[2]) > 0):
            raise InputError(f"--scale has {text!r}; give pairs such as 1x1,2x2: range swath x aperture")
        return cls(float(match[1]), float(match[2]))

    def __str__(self) -> str:
        return f"{self.swath:g}x{self.aperture:g}"


def scene_tables(source: str) -> Tables:
    """Read a scene file, or a shipped scene by its name.

    Raises
    ------
    InputError
        If there is no such file or scene.
    """
    path = Path(source)
    place = path if path.is_file() else resources.files("blocksar.simulation") / "scenes" / f"{source}.toml"
    if not place.is_file():
        raise InputError(f"--scene {source!r} is neither a file nor a shipped scene")
    return tomllib.loads(place.read_text(encoding="utf-8"))


def scaled(tables: Tables, scale: Scale, *, prf: float | None = None) -> Tables:
    """Scale a scene about the middle of its swath and of its aperture.

    Scaled scenes hold nine targets in noise: the time does not depend on their content, and clutter over so much
    ground would take longer to simulate than to focus. The unscaled scene gets clutter, if its beam is steered.
    """
    new = {name: dict(table) if isinstance(table, dict) else table for name, table in tables.items()}
    radar, beam, area, timing = new["radar"], new.get("beam"), new["scene"], new["time"]
    duration = timing.get("duration") or timing["pulses"] / radar["prf"]
    new["time"] = {"duration": scale.aperture * duration}
    if "start" in timing:
        new["time"]["start"] = scale.aperture * timing["start"]
    if prf is not None:
        radar["prf"] = prf
    near, far = area["swath"]
    half = scale.swath * (far - near) / 2
    area["swath"] = [(near + far) / 2 - half, (near + far) / 2 + half]
    if beam is not None:
        middle, half = (beam["start_deg"] + beam["stop_deg"]) / 2, (beam["stop_deg"] - beam["start_deg"]) / 2
        beam["start_deg"], beam["stop_deg"] = middle - scale.aperture * half, middle + scale.aperture * half
    if scale == (1, 1):
        if beam is not None:  # without a beam the extent of the clutter is undefined
            new.setdefault("clutter", CLUTTER)
        return new
    for name in ("targets", "matrix", "clutter", "reflectivity", "dropped"):
        new.pop(name, None)
    side = 0.8 * (far - near)
    new["matrix"] = {"rows": 3, "columns": 3, "extent": [scale.swath * side, scale.aperture * side]}
    new["noise"] = NOISE
    return new


def as_toml(tables: Tables) -> str:
    """Write tables of numbers, strings, lists and one more level of tables; JSON writes such values as TOML does."""
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
    """A scaled scene and its plan; `notes` name what was changed to make it possible."""

    scale: Scale
    scene: Scene
    plan: Plan
    notes: list[str]

    @property
    def samples(self) -> int:
        collection = self.plan.geometry.collection
        return collection.n_pulse * collection.n_range_frequency


def plan_case(source: str, scale: Scale, *, blocks: Blocks, workers: int, memory_limit: int) -> Case:
    """Scale a scene and plan it; raise the PRF and the number of blocks as far as the plan requires.

    Raises
    ------
    InputError
        If the scene cannot be focused even so.
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
        notes.append(f"{scale}: PRF {tables['radar']['prf']:g} Hz raised to the {prf:g} Hz that the plan requires")
    if not plan.faithful:
        notes.append(f"{scale}: predicted coherence {plan.coherence:.4f}, below the fidelity {plan.fidelity:g}")
    return Case(scale, scene, plan, notes)


def _plan(collection: Collection, blocks: Blocks, *, workers: int, memory_limit: int) -> Plan:
    """Plan as requested; if `auto` is refused, double the number of blocks until a plan is accepted."""
    plan = plan_collection(collection, blocks=blocks, workers=workers, memory_limit=memory_limit)
    count = plan.n_blocks
    while plan.refusal is not None and blocks == "auto" and 2 * count <= MAX_BLOCKS:
        count *= 2
        with suppress(InputError):  # too much memory: the next plan needs less
            plan = plan_collection(collection, blocks=count, memory_limit=memory_limit)
    if plan.refusal is not None:
        raise InputError(plan.refusal)
    return plan
