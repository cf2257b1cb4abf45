"""Loading of typer's help, without what it imports from rich and does not use here."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType

# Help in Markdown and pretty tracebacks are both off in `commands`; their imports would take a quarter of the time of
# `blocksar --help`.
UNUSED = {"rich.markdown": "Markdown", "rich.traceback": "Traceback"}


def load_help() -> None:
    """Import typer's module of help texts, with empty modules in place of the unused ones while it is imported."""
    absent = {name: part for name, part in UNUSED.items() if name not in sys.modules}
    for name, part in absent.items():
        sys.modules[name] = ModuleType(name)
        setattr(sys.modules[name], part, None)
    try:
        importlib.import_module("typer.rich_utils")
    finally:
        for name in absent:
            del sys.modules[name]
