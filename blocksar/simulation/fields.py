"""What all tables of a scene file are made of: their base, and types of fields with their limits."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

LARGEST, SMALLEST = 1e19, 1e-19  # in any unit: numbers beyond are mistakes, and would overflow

Positive = Annotated[float, Field(gt=0)]
Seed = Annotated[int, Field(ge=0, lt=2**63)]
# TOML has lists only: tuples are read from lists, while their elements stay strict.
Pair = Annotated[tuple[float, float], Field(strict=False)]
Vector = Annotated[tuple[float, float, float], Field(strict=False)]


class Table(BaseModel):
    """A table of a scene file: frozen, without unknown keys, without conversion of types, finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)
