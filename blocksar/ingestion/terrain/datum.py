"""Vertical datums: from heights over a geoid to heights over the WGS 84 ellipsoid."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.errors import InputError

if TYPE_CHECKING:
    from pyproj import CRS

Undulation = Callable[[FloatArray, FloatArray], FloatArray]  # of longitude and latitude, degrees: m
GRIDS = {"egm96": "us_nga_egm96_15.tif", "egm2008": "us_nga_egm08_25.tif"}  # PROJ's names of its grids
KNOWN_AS = {"egm96": "EGM96", "egm2008": "EGM2008"}  # part of the names of vertical CRSs
REMEDY = "say --vertical ellipsoid, egm96 or egm2008"
WHY = "datums differ by up to 100 m"


@dataclass(frozen=True)
class Datum:
    """Vertical datum of heights: "ellipsoid", "egm96" or "egm2008", and the file of the geoid, if one is named."""

    name: str
    grid: str | None = None

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read "ellipsoid", "egm96", "egm2008", or a geoid with the file that has it, as "egm2008:FILE".

        Raises
        ------
        InputError
            If it is none of these, or there is no such file.
        """
        name, _, grid = text.partition(":")
        if name != "ellipsoid" and name not in GRIDS:
            raise InputError(f"vertical = {text!r} is unknown; {REMEDY}")
        if name == "ellipsoid" and grid:
            raise InputError(f"vertical = {text!r}: heights over the ellipsoid need no file; leave it out")
        if grid and not os.path.isfile(grid):
            raise InputError(f"vertical = {text!r}: there is no file {grid}; name the geoid's grid, in GTX or GeoTIFF")
        return cls(name, os.path.abspath(grid) if grid else None)

    def undulation(self) -> Undulation:
        """The geoid's height over the ellipsoid.

        Raises
        ------
        InputError
            If PROJ does not have the grid: nothing is downloaded.
        """
        if self.name == "ellipsoid":
            return lambda longitude, latitude: np.zeros(np.shape(longitude))
        from pyproj import Transformer
        from pyproj.exceptions import ProjError
        from pyproj.network import set_network_enabled  # type: ignore[attr-defined]

        set_network_enabled(active=False)
        grid = self.grid or GRIDS[self.name]
        try:
            shift = Transformer.from_pipeline(
                "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
                f"+step +proj=vgridshift +grids={grid} +multiplier=1 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
            )
        except ProjError as error:
            raise InputError(
                f"vertical = {self.name}: PROJ has no grid {grid}; install it "
                f"(`pyproj sync --file {GRIDS[self.name]}`), or name a file: --vertical {self.name}:FILE"
            ) from error

        def undulation(longitude: FloatArray, latitude: FloatArray) -> FloatArray:
            height = shift.transform(longitude, latitude, np.zeros(np.shape(longitude)))[2]
            return np.where(np.isfinite(height), height, np.nan)

        return undulation


def datum_of(crs: CRS, vertical: str | None, label: str) -> Datum:
    """The datum that a file states, or the one that the user states.

    Raises
    ------
    InputError
        If neither does, or they differ, or the file's is another one, or not in m upwards.
    """
    stated = _stated(crs, label)
    given = None if vertical is None else Datum.parse(vertical)
    if stated is None and given is None:
        raise InputError(f"{label} does not say what its heights are measured from, and {WHY}; {REMEDY}")
    if stated is not None and given is not None and stated != given.name:
        raise InputError(f"{label} has heights over {stated}, but vertical is {given.name!r}; leave --vertical out")
    return given or Datum(str(stated))


def _stated(crs: CRS, label: str) -> str | None:
    vertical = next((part for part in crs.sub_crs_list if part.is_vertical), None)
    if vertical is None and len(crs.axis_info) < 3:
        return None
    axis = (vertical or crs).axis_info[-1]
    if axis.unit_conversion_factor != 1 or axis.direction != "up":
        raise InputError(f"{label} has heights in {axis.unit_name}, {axis.direction}wards; convert them to m, upwards")
    if vertical is None:
        return "ellipsoid"
    for name, word in KNOWN_AS.items():
        if word in vertical.name.upper().replace(" ", ""):
            return name
    if "ELLIPSOID" in vertical.name.upper():
        return "ellipsoid"
    raise InputError(f"{label} has heights over {vertical.name!r}, which is not supported; convert them, and {REMEDY}")
