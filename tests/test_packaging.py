"""What is handed out: the wheel, the sdist, and the lines that install them."""

from __future__ import annotations

import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml
from repository import ROOT

from blocksar.version import __version__

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
PAGES = [*ROOT.glob("*.md"), *(path for folder in ("blocksar", "workflows", "deploy", "tests")
                               for path in (ROOT / folder).rglob("README.md"))]  # fmt: skip


def built(kind: str, folder: Path) -> Path:
    pytest.importorskip("hatchling", reason="the extra `test` is not installed as it is now")
    from hatchling.builders.sdist import SdistBuilder
    from hatchling.builders.wheel import WheelBuilder

    builder = {"wheel": WheelBuilder, "sdist": SdistBuilder}[kind](str(ROOT))
    (path,) = builder.build(directory=str(folder))
    return Path(path)


def test_the_wheel_holds_the_package_and_nothing_else(tmp_path: Path) -> None:
    names = set(zipfile.ZipFile(built("wheel", tmp_path)).namelist())
    ours = {path.relative_to(ROOT).as_posix() for path in (ROOT / "blocksar").rglob("*.py")}
    data = {"blocksar/py.typed", "blocksar/products/view.html"}
    data |= {f"blocksar/products/page/templates/report.{kind}" for kind in ("html", "css", "js")}
    data |= {path.relative_to(ROOT).as_posix() for path in (ROOT / "blocksar/simulation/scenes").glob("*.toml")}
    assert ours | data <= names
    rest = {name for name in names - ours - data if ".dist-info/" not in name}
    assert not rest
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)
    entry = next(name for name in names if name.endswith("entry_points.txt"))
    assert (
        "blocksar = blocksar.cli:main" in zipfile.ZipFile(tmp_path / next(tmp_path.glob("*.whl"))).read(entry).decode()
    )


def test_the_sdist_holds_what_is_needed_to_build_and_to_test(tmp_path: Path) -> None:
    with tarfile.open(built("sdist", tmp_path)) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    for folder in ("blocksar", "tests", "workflows", "deploy"):
        code = {path.relative_to(ROOT).as_posix() for path in (ROOT / folder).rglob("*.py")}
        assert code <= names
    assert {"pyproject.toml", "README.md", "CHANGELOG.md", "CITATION.cff", "LICENSE", ".ci/run", "PKG-INFO"} <= names
    assert not [name for name in names if "__pycache__" in name or name.endswith((".nbi", ".nbc", ".pyc"))]


def test_the_citation_is_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert (citation["cff-version"], citation["title"], citation["version"]) == ("1.2.0", "blocksar", __version__)
    assert citation["license"] == PROJECT["license"]
    assert [author["name"] for author in citation["authors"]] == [each["name"] for each in PROJECT["authors"]]


def test_pages_install_from_a_clone_or_a_wheel_with_extras_that_exist() -> None:
    extras = set(PROJECT["optional-dependencies"])
    named, wrong = set(), []
    for page in PAGES:
        for line in page.read_text(encoding="utf-8").splitlines():
            if re.search(r"pip install .*\bblocksar\[", line) and "/opt/blocksar[" not in line:
                wrong.append(f"{page}: {line}: no index has blocksar")
            for group in re.findall(r"pip install [^`]*?\[([a-z0-9,]+)\]", line):
                named |= set(group.split(","))
    assert not wrong
    assert named and named <= extras
    section = (ROOT / "README.md").read_text(encoding="utf-8").split("## Installation")[1].split("\n## ")[0]
    table = re.findall(r"^\| `(\w+)` \|", section, re.M)
    assert set(table) == extras


def test_messages_name_extras_that_exist() -> None:
    code = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "blocksar").rglob("*.py"))
    named = set(re.findall(r"install blocksar\[(\w+)\]", code))
    assert named and named <= set(PROJECT["optional-dependencies"])


def test_the_citation_agrees_with_the_project() -> None:
    cited = (ROOT / "README.md").read_text(encoding="utf-8").partition("```bibtex")[2].partition("```")[0]
    fields = dict(re.findall(r"^\s+(\w+)\s+= \{+(.+?)\}+,?$", cited, re.M))
    assert fields["version"] == __version__ and fields["license"] == PROJECT["license"]
    assert fields["author"] == PROJECT["authors"][0]["name"]


# A system without this module, as Windows is. (Windows lacks `resource`, too, but psutil needs that one here.)
ELSEWHERE = "import sys; sys.modules['fcntl'] = None; "


def test_a_system_without_posix_is_refused_with_a_sentence() -> None:
    def run(code: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([sys.executable, "-c", ELSEWHERE + code], capture_output=True, text=True, check=False)

    done = run("import blocksar; print(blocksar.__version__)")
    assert done.returncode == 0  # until something is asked for
    done = run("import blocksar; blocksar.plan('table1')")
    assert done.returncode == 1 and done.stderr.splitlines()[-1].startswith(
        "blocksar.errors.UnsupportedSystem: this system has no fcntl, which locks and workers need; use Linux"
    )
    done = run("from blocksar.cli import main; sys.argv = ['blocksar', 'plan', 'table1']; main()")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("blocksar: this system has no fcntl") and done.stderr.count("\n") == 1
