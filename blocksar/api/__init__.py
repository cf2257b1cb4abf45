"""The commands as functions: simulate, ingest, check, autofocus, plan, focus, quality, report, export, compare,
calibrate, open, info, preview, view, demo, compile; and collection, scene_centre and write, for data in memory.

One module for each stage: `sources`, `datasets`, `describing`, `previewing`, `checking`, `autofocusing`
(with `tracks`), `planning`, `focusing` (with `jobs`), `measuring`, `reporting`, `exporting`, `comparing`,
`calibrating`, `viewing`, `demonstrating`, `compile_ahead`. They share `settings`, which states every option once,
`arguments` and `reports`.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from blocksar.garbage import uncollected

if TYPE_CHECKING:
    from blocksar.api.autofocusing import autofocus
    from blocksar.api.calibrating import calibrate
    from blocksar.api.checking import check
    from blocksar.api.comparing import compare
    from blocksar.api.compile_ahead import compile
    from blocksar.api.demonstrating import demo
    from blocksar.api.describing import info
    from blocksar.api.exporting import export, open
    from blocksar.api.focusing import focus
    from blocksar.api.from_arrays import collection, scene_centre, write
    from blocksar.api.measuring import quality
    from blocksar.api.planning import plan
    from blocksar.api.previewing import preview
    from blocksar.api.reporting import report
    from blocksar.api.sources import (
        ingest,
        ingest_cphd,
        ingest_crsd,
        ingest_gotcha,
        ingest_nisar,
        ingest_palsar,
        ingest_sentinel1,
        simulate,
    )
    from blocksar.api.viewing import view
    from blocksar.application.reports import Report
    from blocksar.application.shown import PlanReport, RunReport

# The module of each function: it is loaded on first use, since a command needs one of them.
_HOMES = {
    "PlanReport": "application.shown", "Report": "application.reports", "RunReport": "application.shown",
    "autofocus": "api.autofocusing", "calibrate": "api.calibrating", "check": "api.checking",
    "collection": "api.from_arrays", "compare": "api.comparing", "compile": "api.compile_ahead",
    "demo": "api.demonstrating", "export": "api.exporting", "focus": "api.focusing", "info": "api.describing",
    "ingest": "api.sources", "ingest_cphd": "api.sources", "ingest_crsd": "api.sources",
    "ingest_gotcha": "api.sources", "ingest_nisar": "api.sources", "ingest_palsar": "api.sources",
    "ingest_sentinel1": "api.sources", "open": "api.exporting", "plan": "api.planning", "preview": "api.previewing",
    "quality": "api.measuring", "report": "api.reporting", "scene_centre": "api.from_arrays",
    "simulate": "api.sources", "view": "api.viewing", "write": "api.from_arrays",
}  # fmt: skip
__all__ = [
    "PlanReport",
    "Report",
    "RunReport",
    "autofocus",
    "calibrate",
    "check",
    "collection",
    "compare",
    "compile",
    "demo",
    "export",
    "focus",
    "info",
    "ingest",
    "ingest_cphd",
    "ingest_crsd",
    "ingest_gotcha",
    "ingest_nisar",
    "ingest_palsar",
    "ingest_sentinel1",
    "open",
    "plan",
    "preview",
    "quality",
    "report",
    "scene_centre",
    "simulate",
    "view",
    "write",
]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        with uncollected():
            found = getattr(importlib.import_module(f"blocksar.{_HOMES[name]}"), name)
        globals()[name] = found
        return found
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
