"""The ground that the user asks for, as a `Terrain` of the scene frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np

from blocksar.collection.georeference import Georeference
from blocksar.collection.grid import Grid
from blocksar.collection.surface import Surface
from blocksar.collection.terrain import Terrain
from blocksar.errors import InputError
from blocksar.ingestion.terrain.earth import ellipsoid, read_geotiff
from blocksar.ingestion.terrain.frame_grid import read_frame_grid
from blocksar.places import Location, place

GEOTIFF = (".tif", ".tiff", ".vrt")
SURFACE = "surface"  # the attribute of a phase history
UNTOLD = 1e-6  # of the grid: a share without heights that is not worth a note


@dataclass(frozen=True, kw_only=True)
class Ground:
    """Ground as the user states it: a file of heights with its datum, or a surface; None: that of the collection.

    Raises
    ------
    InputError
        If the settings exclude each other.
    """

    terrain: Location | None = None
    surface: Surface | None = None
    vertical: str | None = None

    def __post_init__(self) -> None:
        if self.surface not in (None, *get_args(Surface)):
            raise InputError(f"surface = {self.surface!r} is unknown; give {' or '.join(get_args(Surface))}")
        if self.terrain is not None and self.surface not in (None, "plane"):
            raise InputError(f"surface = {self.surface} and a terrain are both given; leave one of them out")
        if self.vertical is not None and (self.terrain is None or not self.geotiff):
            what = "there is no terrain" if self.terrain is None else "the terrain's heights are z of the scene frame"
            raise InputError(f"vertical = {self.vertical!r}, but {what}; leave --vertical out")

    @property
    def plane(self) -> bool:
        return self.terrain is None and self.surface in (None, "plane")

    def under(self, attrs: Mapping[str, Any]) -> Ground:
        """Copy under a collection with attributes of its store, whose `surface` counts if the user names no ground.

        Raises
        ------
        InputError
            If they have another one.
        """
        if self.terrain is not None or self.surface is not None or attrs.get(SURFACE) is None:
            return self
        return replace(self, surface=attrs[SURFACE])

    def describe(self, terrain: Terrain) -> str:
        """One line about a ground that is no plane."""
        low, high = terrain.limits
        what = "ellipsoid WGS 84" if self.terrain is None else f"terrain {self.terrain}"
        return f"{what}: z = {low:.6g} .. {high:.6g} m"

    @property
    def geotiff(self) -> bool:
        return str(self.terrain).lower().endswith(GEOTIFF)

    def read(self, georeference: Georeference | None, ground_height: float, grid: Grid) -> Terrain | None:
        """The ground under a grid; None for the plane.

        Raises
        ------
        InputError
            If a file cannot be read, lies elsewhere or has no height under the grid, or there is no georeference
            where one is needed.
        """
        if self.plane:
            return None
        x, y = (float(grid.x[0]), float(grid.x[-1])), (float(grid.y[0]), float(grid.y[-1]))
        if self.terrain is not None and (georeference is not None or not self.geotiff):
            terrain = self.read_box(georeference, x, y, level=ground_height)
        elif georeference is None:
            if self.terrain is not None and not place(self.terrain).exists():
                raise InputError(f"terrain {self.terrain} does not exist; check the path")
            what = "surface = ellipsoid" if self.terrain is None else f"terrain {self.terrain}"
            raise InputError(
                f"{what} needs to know where on the Earth the scene lies; put the attribute georeference into the "
                "phase history"
            )
        else:
            terrain = ellipsoid(georeference, ground_height, x, y)
        if covered(terrain, grid) == 0:
            where = f"x {x[0]:.6g} .. {x[1]:.6g} m and y {y[0]:.6g} .. {y[1]:.6g} m"
            raise InputError(
                f"terrain {self.terrain} has no height under the grid, {where}; fill the hole "
                "(rasterio.fill.fillnodata), or give one that has heights there"
            )
        return terrain

    def read_box(
        self, georeference: Georeference | None, x: tuple[float, float], y: tuple[float, float], *, refine: bool = True,
        level: float | None = None,
    ) -> Terrain:  # fmt: skip
        """The part of the file about a box, x and y from .. to, m; a GeoTIFF needs the georeference.

        Without `refine` a GeoTIFF's heights are as dense as in the file: enough for what they hide. With the scene's
        plane z = level, m, the terrain has remarks on them.

        Raises
        ------
        InputError
            If the file cannot be read, or lies elsewhere.
        """
        assert self.terrain is not None
        if not self.geotiff:
            return read_frame_grid(self.terrain, x, y)
        assert georeference is not None
        return read_geotiff(self.terrain, self.vertical, georeference, x, y, refine=refine, level=level)


def covered(terrain: Terrain, grid: Grid) -> float:
    """Share of a grid that has heights, from every n-th row and column."""
    x, y = grid.x[:: max(grid.x.size // 512, 1)], grid.y[:: max(grid.y.size // 512, 1)]
    return float(np.isfinite(terrain.on_grid(x, y)).mean())


def terrain_notes(terrain: Terrain, grid: Grid) -> list[str]:
    """Sentences on what a terrain may not mean, and on a part of a grid without heights."""
    share = covered(terrain, grid)
    if share >= 1 - UNTOLD:
        return list(terrain.remarks)
    return [
        *terrain.remarks,
        f"the terrain has no height at {100 * (1 - share):.3g} % of the grid (holes, or beyond its edge): these pixels "
        "are not covered",
    ]
