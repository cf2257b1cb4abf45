"""A library that is not installed, as far as one test is concerned."""

from __future__ import annotations

import sys

import pytest


def hide(library: str, *users: str, patch: pytest.MonkeyPatch) -> None:
    """Let imports of a library fail, and the modules and packages that use it be imported anew."""
    modules = dict(sys.modules)
    for name in modules:
        if any(name == each or name.startswith(f"{each}.") for each in (library, *users)):
            patch.delitem(sys.modules, name)
            parent, _, child = name.rpartition(".")
            if parent in modules:
                patch.delattr(modules[parent], child, raising=False)
    patch.setitem(sys.modules, library, None)  # type: ignore[arg-type]
