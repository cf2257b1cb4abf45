"""What every refusal of a chain ends with: exact back-projection does it, and how long that takes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress

from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.errors import InputError, PrfTooLow, Unfocusable
from blocksar.graph.machine import Resources
from blocksar.planning import effort
from blocksar.planning.segments import joint_grid
from blocksar.processors import REFERENCE
from blocksar.processors.lines import stage_seconds, time_text

FOLDED = f"; exact back-projection takes any PRF, and shows what folds: --processor {REFERENCE}"
ANY = f"; exact back-projection has no such limit: --processor {REFERENCE}"


def exact_way(collections: Sequence[Collection], grid: Grid | None, assumed: Resources, *, way: str = ANY) -> str:
    """The end of a sentence that says why no chain forms an image of collections on a grid (None: the default one)."""
    geometries = [Geometry(collection=collection) for collection in collections]
    with suppress(InputError):  # no default grid
        points = grid or joint_grid(geometries)
        work = effort.of_backprojection(geometries, points)
        seconds = sum(stage_seconds(work, assumed).values())
        return f"{way}, about {time_text(seconds)} on this machine"
    return way


@contextmanager
def naming_exact(collections: Sequence[Collection], grid: Grid | None, assumed: Resources) -> Iterator[None]:
    """Add the end to errors about what no chain can form."""
    try:
        yield
    except Unfocusable as error:
        way = FOLDED if isinstance(error, PrfTooLow) else ANY
        raise InputError(f"{error}{exact_way(collections, grid, assumed, way=way)}") from error
