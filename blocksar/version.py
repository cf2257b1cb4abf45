"""The package's version: hatch reads it here, and workers must have the same one."""

from __future__ import annotations

__version__ = "0.3.0"
