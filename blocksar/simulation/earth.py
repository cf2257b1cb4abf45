"""The place of a scene's frame on the Earth."""

from __future__ import annotations

from functools import cached_property
from typing import Self

from pydantic import Field, model_validator

from blocksar.collection.georeference import Georeference
from blocksar.errors import InputError
from blocksar.simulation.fields import Table


class GeoreferenceTable(Table):
    """Where the frame's origin x = y = z = 0 lies, and how its axes are turned."""

    latitude: float = Field(description="of the frame's origin, geodetic, WGS 84, degrees")
    longitude: float = Field(description="of the frame's origin, degrees")
    height: float = Field(0.0, description="of the frame's origin above the WGS 84 ellipsoid, m")
    rotation_deg: float = Field(0.0, description="x axis from east, counter-clockwise seen from above, degrees")

    @model_validator(mode="after")
    def _check(self) -> Self:
        try:
            self.frame  # noqa: B018 - checks its numbers
        except InputError as error:
            raise ValueError(str(error).removeprefix("georeference: ").partition(";")[0]) from None
        return self

    @cached_property
    def frame(self) -> Georeference:
        return Georeference(
            latitude=self.latitude, longitude=self.longitude, height=self.height, rotation=self.rotation_deg
        )
