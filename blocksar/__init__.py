"""blocksar: focus squint-TOPS synthetic aperture radar data by angular blocks, in parallel.

The functions here are the commands' twins: `simulate`, `ingest`, `plan`, `focus`, `quality`, `export`, `open`. They are
loaded on first use, so that `import blocksar` costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from blocksar.api import export, focus, ingest, open, plan, quality, simulate

__version__ = "0.1.0"

__all__ = ["__version__", "export", "focus", "ingest", "open", "plan", "quality", "simulate"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        return getattr(importlib.import_module("blocksar.api"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
