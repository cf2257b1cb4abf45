"""Scenes, plans and runs that several figures share."""

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
from blocksar.focusing.method import Method
from blocksar.graph.cluster import machine, open_client
from blocksar.measurement.figures import PointResponse, measure
from blocksar.measurement.response import Response, read_response
from blocksar.measurement.targets import Target
from blocksar.places import place
from blocksar.planning.plan import Plan, plan_collection
from blocksar.runs.finished import FinishedRun
from blocksar.simulation.scene import Scene

THREADS = machine()[0]


# ---------------------------------------------------------------- plans, runs, samples


@cache
def scene(name: str) -> Scene:
    """A shipped scene."""
    return Scene.read(name)


@cache
def geometry(name: str) -> Geometry:
    return Geometry(collection=scene(name).collection().centred())


@cache
def plan(name: str, blocks: int, **options: Any) -> Plan:
    """Of a shipped scene; options are those of `Method`."""
    return plan_collection(geometry(name).collection, blocks=blocks, method=Method(**options))


def targets(name: str, names: Sequence[str] | None = None) -> list[Target]:
    """Point targets of a shipped scene: all, or some, in that order."""
    known = {target.name: Target(*target) for target in scene(name).point_targets()}
    return [known[n] for n in (known if names is None else names)]


def tell(text: str) -> None:
    typer.echo(text, err=True)


@dataclass(kw_only=True)
class Bench:
    """Where things are put, and focused runs: each is made when it is asked for first."""

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
        store = self.folder / f"{name}.zarr"
        if not store.exists():
            tell(f"  simulating {name}")
            blocksar.simulate(scene(name), store, threads=THREADS)
        return store

    def run(self, name: str, *, blocks: int, grid: Grid | None = None, **options: Any) -> Run:
        """A shipped scene, focused through the public interface."""
        label = "-".join([name, str(blocks), *map(str, options.values())])
        if label not in self.runs:
            store = self.history(name)
            tell(f"  focusing {label}")
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
