"""The documentation site: strict build, complete pages and links, and a reference of all that is public."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

import blocksar
from blocksar import api
from blocksar.products.dataset import SarAccessor

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / "deploy" / "site" / "mkdocs.yml"
REFERENCE = (CONFIG.parent / "pages" / "reference.md").read_text(encoding="utf-8")
FUNCTIONS = [getattr(api, name) for name in api.__all__ if not name.endswith("Report")]


def build(config: Path, out: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "mkdocs", "build", "--config-file", str(config), "--site-dir", str(out)]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built with the documented command, which fails on any warning."""
    out = tmp_path_factory.mktemp("site")
    run = build(CONFIG, out)
    assert run.returncode == 0, run.stdout + run.stderr
    return out


class Links(HTMLParser):
    """Resources that a page loads, targets that it links to, and its anchors."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.loaded: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.anchors |= {value for name in ("id", "name") if (value := values.get(name))}
        if tag == "a" and (target := values.get("href")):
            self.targets.append(target)
        loaded = values.get("src") if tag in ("img", "script") else values.get("href") if tag == "link" else None
        if loaded:
            self.loaded.append(loaded)


def pages(site: Path) -> dict[Path, Links]:
    return {path: Links(path.read_text(encoding="utf-8")) for path in site.rglob("*.html") if path.name != "404.html"}


def test_the_site_contains_every_page(site: Path) -> None:
    settings = CONFIG.read_text(encoding="utf-8")
    listed = re.findall(r": (\S+\.md)$", settings.split("\nnav:\n")[1].split("\n\n")[0], re.M)
    assert len(listed) == len(set(listed)) >= 20
    for name in listed:
        stem = name.removesuffix(".md").removesuffix("README")
        assert (site / stem / "index.html").is_file(), name


def test_links_of_the_site_are_valid(site: Path) -> None:
    found, wrong = pages(site), []
    for path, links in found.items():
        for target in links.targets:
            if re.match(r"[a-z]+:", target):
                continue
            place, _, anchor = target.partition("#")
            page = (path.parent / place).resolve() if place else path
            page = page / "index.html" if page.is_dir() else page
            if not page.is_file() or (anchor and page in found and anchor not in found[page].anchors):
                wrong.append(f"{path.relative_to(site)}: {target}")
    assert not wrong, "\n".join(wrong)


def test_the_site_loads_nothing_from_the_network(site: Path) -> None:
    for links in pages(site).values():
        assert not [target for target in links.loaded if re.match(r"(https?:)?//", target)]


def test_a_broken_link_fails_the_build(tmp_path: Path) -> None:
    """This confirms that a strict build detects broken links."""
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "index.md").write_text("[nowhere](nowhere.md)\n")
    settings = CONFIG.read_text(encoding="utf-8")
    kept = [re.search(pattern, settings, re.M | re.S) for pattern in (r"^strict:.*?$", r"^validation:\n.*?\n\n")]
    (tmp_path / "mkdocs.yml").write_text("site_name: test\n" + "\n".join(part[0] for part in kept if part))
    run = build(tmp_path / "mkdocs.yml", tmp_path / "out")
    assert run.returncode != 0
    assert "nowhere.md" in run.stdout + run.stderr


# ---------------------------------------------------------------- reference


def test_tables_of_the_reference_name_parameters() -> None:
    rows = re.findall(r"^\| `(\w+)` \| `(\w+)` \| \S", REFERENCE, re.M)
    assert rows
    assert all(name in inspect.signature(getattr(SarAccessor, method)).parameters for method, name in rows)


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda function: function.__name__)
def test_every_function_documents_returns_and_raises(function: Callable[..., Any]) -> None:
    text = inspect.getdoc(function) or ""
    assert "\nReturns\n-------\n" in text
    assert "\nRaises\n------\nInputError\n" in text


def test_the_reference_covers_the_public_interface() -> None:
    shown = {name.rpartition(".")[2] for name in re.findall(r"^::: (\S+)$", REFERENCE, re.M)}
    assert set(blocksar.__all__) - {"__version__"} <= shown
    assert {"SarAccessor", "Scene", "Report", "ingest_cphd", "ingest_gotcha", "demo"} <= shown
