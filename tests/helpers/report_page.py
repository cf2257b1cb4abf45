"""Runs for the report page, and a parser of the page."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

from scenes import SMALL_SCAN, scene

import blocksar
from blocksar.places import place
from blocksar.runs.finished import FinishedRun

HOSTILE = "</title></script><script>window.pwned = 1</script><img src=x onerror=window.pwned=1> & \u202e{{ 7 * 7 }}"
TARGETS = {"A": (29900.0, 48.5), "B": (30100.0, 51.5), "seam": (30000.0, 50.2), "<i>D": (29950.0, 50.0)}
EDGE = {"edge": (30000.0, 44.2)}  # lit by only a part of the beam's sweep, and outside the image
VOID = ["area", "base", "br", "col", "embed", "hr", "img", "input", "link", "meta", "source", "track", "wbr"]


def write_scene(folder: Path) -> Path:
    """Simulate a part of Table 1's scene, with markup in its title."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = [f"[[targets]]\nname = '{n}'\nrange = {r}\nyaw_deg = {y}\n" for n, (r, y) in (TARGETS | EDGE).items()]
    text = scene(**SMALL_SCAN, more="\n".join(rows))
    (folder / "scene.toml").write_text(text.replace('title = "test"', f"title = {json.dumps(HOSTILE)}"))
    return Path(blocksar.simulate(folder / "scene.toml", folder / "ph.zarr", threads=1))


def borrowed(run: Path, folder: Path) -> Path:
    folder.mkdir()
    for name in ("run.json", "quality.json"):
        if (run / name).exists():
            shutil.copy(run / name, folder / name)
    shutil.copytree(run / "collection.zarr", folder / "collection.zarr")
    (folder / "image.zarr").symlink_to(run / "image.zarr")
    return folder


def changed(path: Path, change: Callable[[Any], None]) -> None:
    record = json.loads(path.read_text())
    change(record)
    path.write_text(json.dumps(record))


def source_of(run: Path) -> FinishedRun:
    return FinishedRun.open(place(run))


class Reading(HTMLParser):
    """Collects elements with their attributes and their text, in order; refuses unbalanced tags."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.texts: list[tuple[str, str]] = []
        self._open: list[str] = []
        self.feed(text)
        self.close()
        assert not self._open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append((self._open[-1] if self._open else "", data))

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attrs for name, attrs in self.elements if name == tag]

    def text(self, tag: str = "") -> str:
        words = (
            text for inside, text in self.texts if inside == tag or (not tag and inside not in ("script", "style"))
        )
        return " ".join(" ".join(words).split())


def read(path: Any) -> Reading:
    return Reading(Path(str(path)).read_text(encoding="utf-8"))
