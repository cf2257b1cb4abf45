"""Simulation of scene files as phase histories, raw echoes and CPHD files; and the scenes in the package."""

from __future__ import annotations

from importlib import resources


def shipped_text(name: str) -> str:
    """The text of a scene in the package."""
    return (resources.files("blocksar.simulation") / "scenes" / f"{name}.toml").read_text(encoding="utf-8")


def shipped_scenes() -> list[str]:
    """List the names of the scenes in the package."""
    folder = resources.files("blocksar.simulation") / "scenes"
    return sorted(item.name.removesuffix(".toml") for item in folder.iterdir() if item.name.endswith(".toml"))
