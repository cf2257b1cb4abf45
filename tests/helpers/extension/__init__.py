"""A package of its own that adds parts to blocksar, put on disk as an installer leaves it."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from pathlib import Path

NAME = "blocksar_extension"
PARTS: Mapping[str, Mapping[str, str]] = {
    "blocksar.processors": {"polar-format": f"{NAME}.processor:POLAR_FORMAT"},
    "blocksar.products": {"kml": f"{NAME}.product:KML"},
    "blocksar.readers": {"madeup": f"{NAME}.reader:MADEUP"},
}


def install(folder: Path, parts: Mapping[str, Mapping[str, str]] = PARTS) -> dict[str, str]:
    """Install the package into a folder, with "module:attribute" of its parts by group and name.

    Returns the environment of a process that finds it.
    """
    shutil.copytree(Path(__file__).parent / NAME, folder / NAME)
    told = folder / f"{NAME}-1.0.dist-info"
    told.mkdir()
    (told / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {NAME}\nVersion: 1.0\n")
    lines = [line for group in parts for line in (f"[{group}]", *(f"{a} = {b}" for a, b in parts[group].items()))]
    (told / "entry_points.txt").write_text("\n".join(lines))
    return os.environ | {"PYTHONPATH": str(folder), "COLUMNS": "120"}
