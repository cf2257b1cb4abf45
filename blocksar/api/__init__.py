"""The commands as functions: simulate, ingest, plan, focus, quality, report, export, open, demo.

One module a stage of the data's way: `sources`, `planned`, `focused`, `measured`, `shown`; `common` is what they share.
"""

from __future__ import annotations

from blocksar.api.common import Report
from blocksar.api.focused import focus
from blocksar.api.measured import quality
from blocksar.api.planned import plan
from blocksar.api.shown import demo, export, open, report
from blocksar.api.sources import ingest, ingest_cphd, ingest_gotcha, simulate

__all__ = [
    "Report",
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
