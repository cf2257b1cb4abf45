"""Scenes, plans and focused runs that several exhibits share."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import typer
from distributed import Client

import blocksar
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.graph.cluster import open_client
from blocksar.graph.machine import machine
from blocksar.imaging.method import Method
from blocksar.measurement.figures import PointResponse, measure
from blocksar.measurement.response import Response, read_response
from blocksar.measurement.targets import Target
from blocksar.places import place
from blocksar.processors.chain.planning.plan import Plan
from blocksar.processors.chain.planning.planner import plan_collection
from blocksar.runs.finished import FinishedRun
from blocksar.simulation.scene import Scene

THREADS = machine()[0]
SWATH = {"near": 27_600.0, "middle": 30_000.0, "far": 32_400.0}  # m: paper A's swath less the width of a response


@cache
def scene(name: str) -> Scene:
    """Read a shipped scene."""
    return Scene.read(name)


@cache
def geometry(name: str) -> Geometry:
    return Geometry(collection=scene(name).collection().centred())


@cache
def plan_scene(name: str, blocks: int, **options: Any) -> Plan:
    """Plan a shipped scene; options are those of `Method`."""
    return plan_collection(geometry(name).collection, blocks=blocks, method=Method(**options))


def targets(name: str, names: Sequence[str] | None = None) -> list[Target]:
    """Point targets of a shipped scene: all of them, or those of the given names in their order."""
    known = {target.name: Target(*target) for target in scene(name).point_targets()}
    return [known[n] for n in (known if names is None else names)]


def log(text: str) -> None:
    """Print a line of progress on stderr."""
    typer.echo(text, err=True)


@dataclass(kw_only=True)
class Bench:
    """Output and scratch folders, cluster and focused runs; runs are computed on first use and kept."""

    out: Path
    folder: Path
    workers: int
    stack: ExitStack
    runs: dict[str, Run] = field(default_factory=dict)

    @cached_property
    def client(self) -> Client:
        cores, memory = machine()
        threads, limit = max(cores // self.workers, 1), memory // self.workers
        return self.stack.enter_context(open_client(workers=self.workers, threads=threads, memory_limit=limit))

    def history(self, name: str) -> Path:
        """Simulated phase history of a shipped scene."""
        store = self.folder / f"{name}.zarr"
        if not store.exists():
            log(f"  simulating {name}")
            blocksar.simulate(scene(name), store, threads=THREADS)
        return store

    def run(self, name: str, *, blocks: int, grid: Grid | None = None, **options: Any) -> Run:
        """Focus a shipped scene through the public interface; options are those of `blocksar.focus`."""
        label = "-".join([name, str(blocks), *map(str, options.values())])
        if label not in self.runs:
            store = self.history(name)
            log(f"  focusing {label}")
            blocksar.focus(store, self.folder / label, blocks=blocks, grid=grid, client=self.client, **options)
            self.runs[label] = Run.open(place(self.folder / label))
        return self.runs[label]

    def picture(self, name: str) -> Path:
        return self.out / f"{name}.png"


class Run(FinishedRun):
    """A finished run, ready to be measured."""

    def responses(self, wanted: Sequence[Target]) -> list[Response]:
        responses = [read_response(self.read, self.x, self.y, self.geometry, target) for target in wanted]
        return [response for response in responses if response is not None]

    @cache  # noqa: B019 - runs live as long as the script
    def measured(self, name: str, names: tuple[str, ...] | None = None) -> dict[str, PointResponse]:
        return {r.target.name: measure(r) for r in self.responses(targets(name, names))}
