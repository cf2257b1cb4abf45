"""Names of grounds without heights, in a module without arrays, which the command line imports quickly."""

from __future__ import annotations

from typing import Literal

Surface = Literal["plane", "ellipsoid"]
