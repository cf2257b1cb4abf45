"""Names of grounds without heights; apart, since the command line needs no arrays to name its options."""

from __future__ import annotations

from typing import Literal

Surface = Literal["plane", "ellipsoid"]
