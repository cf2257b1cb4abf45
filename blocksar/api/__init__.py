"""The commands as functions: simulate, ingest, check, plan, focus, quality, report, export, open, demo.

One module for each stage: `sources`, `checking`, `planning`, `focusing` (with `jobs`), `measuring`, `exporting`,
`demo`. They share `arguments` and `reports`.
"""

from __future__ import annotations

from blocksar.api.checking import check
from blocksar.api.demo import demo
from blocksar.api.exporting import export, open, report
from blocksar.api.focusing import focus
from blocksar.api.measuring import quality
from blocksar.api.planning import plan
from blocksar.api.reports import Report
from blocksar.api.sources import ingest, ingest_cphd, ingest_gotcha, simulate

__all__ = [
    "Report",
    "check",
    "demo",
    "export",
    "focus",
    "ingest",
    "ingest_cphd",
    "ingest_gotcha",
    "open",
    "plan",
    "quality",
    "report",
    "simulate",
]
