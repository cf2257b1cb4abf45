"""The former name of `blocksar.readers`, under which readers of other packages import what they need."""

from __future__ import annotations

import sys
from importlib import import_module

for _former, _name in {"kinds": "kinds", "orbit": "orbit", "readers": "registry", "reading": "reading"}.items():
    globals()[_former] = sys.modules[f"{__name__}.{_former}"] = import_module(f"blocksar.readers.{_name}")
