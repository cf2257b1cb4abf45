"""Checks of CPHD files by the checker of the standard."""

from __future__ import annotations

from pathlib import Path

from sarkit.verification import CphdConsistency


def failures(path: Path) -> list[str]:
    """What the checker finds wrong with a file, one line each."""
    with open(path, "rb") as file:
        checker = CphdConsistency.from_file(file, thorough=True)
        checker.check()
    assert len(checker.passes()) > 50
    return [f"{name}: {found}" for name, found in checker.failures().items()]
