"""The version of the package: hatch reads it here, workers are compared by it."""

from __future__ import annotations

__version__ = "0.2.0"
