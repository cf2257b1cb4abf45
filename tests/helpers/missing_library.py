"""Hide a library, as if it were not installed, for one test."""

from __future__ import annotations

import sys

import pytest


def hide(library: str, *users: str, patch: pytest.MonkeyPatch) -> None:
    """Make imports of a library fail, and reload the modules and packages that use it on their next import."""
    modules = dict(sys.modules)
    for name in modules:
        if any(name == each or name.startswith(f"{each}.") for each in (library, *users)):
            patch.delitem(sys.modules, name)
            parent, _, child = name.rpartition(".")
            if parent in modules:
                patch.delattr(modules[parent], child, raising=False)
    patch.setitem(sys.modules, library, None)  # type: ignore[arg-type]
