"""Paths that are no phase history, and the command that leads from there to one."""

from __future__ import annotations

import difflib
import os
from pathlib import Path

from blocksar.ingestion.found import found_at
from blocksar.places import Location, place
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place
from blocksar.runs.record import RECORD
from blocksar.simulation.shipped import shipped_scenes


def mistaken(source: Location) -> str | None:
    """Say what a path holds that is no phase history, with the remedy; None if there is nothing to say."""
    where = place(source)
    try:
        return _told(where, str(source))
    except OSError:  # the first error says what cannot be read
        return None


def _told(where: Place, text: str) -> str | None:
    if isinstance(where, LocalPlace):
        path = where.path
        if not os.path.exists(path):
            return _missing(path, text)
        if (path / RECORD).exists() or (path / "receipts").exists():
            return (
                f"{where} is a run, not a phase history; `blocksar info` names the phase history that it was made from"
            )
        for name, kind in (("image", "an image"), ("spectrum", "a spectrum")):
            if (path / name / "zarr.json").exists():
                return f"{where} is {kind} of a run, not a phase history; give the run's input"
        if (path / "zarr.json").exists() or (path / ".zgroup").exists():
            return None
    found = found_at(where)
    return None if found is None else found.sentence(where, text)


def _missing(path: Path, text: str) -> str | None:
    """A shipped scene given for its phase history, a link that leads nowhere, or the nearest name to a missing one."""
    if text in shipped_scenes():
        return (
            f"{text} is a shipped scene, not a phase history; write one first: `blocksar simulate {text} --out "
            f"{text}.zarr`"
        )
    if path.is_symlink():
        return f"{path} is a symbolic link to {os.readlink(path)}, which does not exist; correct the link"
    names = os.listdir(path.parent) if path.parent.is_dir() else []
    close = difflib.get_close_matches(path.name, [*names, *shipped_scenes()], n=1, cutoff=0.75)
    return f"{path} does not exist; did you mean {close[0]}?" if close else None
