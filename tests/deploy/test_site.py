"""The documentation site: strict build, complete pages and links, and a reference of all that is public."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

import blocksar
from blocksar import api

ROOT = Path(__file__).resolve().parents[2]
SITE = ROOT / "deploy" / "site"
REFERENCE = (SITE / "pages" / "reference.md").read_text(encoding="utf-8")
FUNCTIONS = [getattr(api, name) for name in api.__all__ if not name.endswith("Report")]


def build(source: Path, out: Path, *options: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run the documented command with another source and output."""
    page = (SITE / "README.md").read_text(encoding="utf-8")
    (documented,) = re.findall(r"^\.venv/bin/sphinx-build (.*) \. build/site$", page, re.M)
    places = ["-d", f"{out}-doctrees", str(source), str(out)]
    command = [sys.executable, "-m", "sphinx", *shlex.split(documented), *options, *places]
    environment = os.environ | variables
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT, env=environment)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built with the documented command, which fails on any warning."""
    out = tmp_path_factory.mktemp("site")
    run = build(ROOT, out)
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
    return {path: Links(path.read_text(encoding="utf-8")) for path in site.rglob("*.html")}


@pytest.mark.slow
def test_the_site_contains_every_page(site: Path) -> None:
    """Every README.md and notebook of the repository, and what has no place beside code, all in the order of pages."""
    folders = ("blocksar", "deploy", "tests", "workflows")
    found = [path for folder in folders for path in (ROOT / folder).rglob("README.md")]
    found += [ROOT / "CHANGELOG.md", *ROOT.glob("workflows/gallery/*.ipynb"), *SITE.glob("pages/*.md")]
    expected = {path.relative_to(ROOT).with_suffix(".html").as_posix() for path in found}
    order = (site / "README.html").read_text(encoding="utf-8").split('aria-label="Pages"')[1].split("</nav>")[0]
    assert sorted(expected) == sorted(re.findall(r'href="([^"#]+)"', order))
    assert len(expected) >= 30
    assert all((site / name).is_file() for name in [*expected, "index.html"])


@pytest.mark.slow
def test_the_site_loads_nothing_from_the_network(site: Path) -> None:
    for links in pages(site).values():
        assert not [target for target in links.loaded if re.match(r"(https?:)?//", target)]


@pytest.mark.slow
def test_what_is_wrong_fails_the_build(tmp_path: Path) -> None:
    text = "Sum.\n\n    Parameters\n    ----------\n    lost : int\n        Not there.\n    "
    (tmp_path / "wrong.py").write_text(f'def function():\n    """{text}"""\n')
    links = "[nowhere](nowhere.md) [gone](#gone-heading)"
    (tmp_path / "index.md").write_text(f"# Page\n\n{links}\n\n```{{eval-rst}}\n.. autofunction:: wrong.function\n```\n")
    (tmp_path / "forgotten.md").write_text("# Page\n")
    options = ("-D", "root_doc=index", "-D", "include_patterns=*.md")
    run = build(tmp_path, tmp_path / "out", *options, PYTHONPATH=str(tmp_path))
    assert run.returncode != 0
    for message in ("nowhere.md", "gone-heading", "isn't included in any toctree", "Unknown parameters {'lost'}"):
        assert message in run.stderr


# ---------------------------------------------------------------- reference


def test_the_reference_covers_the_public_interface() -> None:
    shown = {name.rpartition(".")[2] for name in re.findall(r"^\.\. auto\w+:: (\S+)$", REFERENCE, re.M)}
    assert set(blocksar.__all__) - {"__version__"} <= shown
    assert {"SarAccessor", "Scene", "Report", "ingest_cphd", "ingest_gotcha", "demo"} <= shown
