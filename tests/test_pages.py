"""Pages, docstrings and help: their Python runs, their command lines parse, their links resolve."""

from __future__ import annotations

import ast
import doctest
import importlib
import os
import re
import shlex
import tomllib
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer
from extension import NAME, PARTS
from scene_reference import scene_tables
from typer.testing import CliRunner

import blocksar
from blocksar.application import parsing
from blocksar.cli import commands
from blocksar.errors import InputError
from blocksar.processors.base import Processor
from blocksar.readers.kinds import Start
from blocksar.readers.registry import Reader

ROOT = Path(__file__).resolve().parents[1]
BUILT = {"build", "dist", "node_modules"}  # folders to skip at any depth, as hidden ones
WORKFLOWS = sorted(path.stem for path in (ROOT / "workflows").glob("*.py"))
SCRIPT_FOLDERS = [ROOT / "workflows", ROOT / "deploy" / "slurm", ROOT / "deploy" / "site"]
EXTENSION = "tests/helpers/extension/README.md"
# Notation of running text that is not part of a command.
NOTATION = re.compile(r"[|…]|\.\.\.|COMMAND")
# Values that are validated after the command line is parsed.
READERS = {
    "grid": parsing.parse_grid,
    "blocks": lambda text: parsing.parse_blocks(text.split(",")[0]),  # the study of blocks takes several values
    "memory_limit": parsing.parse_memory,
    "origin": parsing.parse_origin,
}


# Pages and docstrings


def files(folder: Path, *patterns: str) -> Iterator[Path]:
    """Yield the files below a folder that match a pattern, except those in hidden folders and builds."""
    for root, folders, names in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith(".") and name not in BUILT)
        found = [Path(root, name) for name in sorted(names)]
        yield from (path for path in found if any(path.match(pattern) for pattern in patterns))


def place_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


PAGES = {
    place_of(path): path.read_text(encoding="utf-8") for path in files(ROOT, "README.md", "deploy/site/pages/*.md")
}
DOCSTRINGS = {
    place_of(path): ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    for folder in ("blocksar", "workflows", "deploy")
    for path in files(ROOT / folder, "*.py")
}


def fenced(text: str, language: str) -> list[tuple[int, str]]:
    """Return the code blocks of a language on a page, each with its first line number."""
    blocks = re.finditer(rf"^```{language}\n(.*?)^```$", text, re.M | re.S)
    return [(text[: block.start()].count("\n") + 2, block[1]) for block in blocks]


def prose(text: str) -> str:
    """Return a page without its code blocks."""
    return re.sub(r"^```.*?^```$", "", text, flags=re.M | re.S)


def command_lines(text: str) -> Iterator[str]:
    """Yield the command lines of blocksar and of our scripts in a shell text, with continuation lines joined."""
    for line in re.sub(r"\\\n\s*", " ", text).splitlines():
        for part in re.split(r"&&|;", line):
            own = re.match(r"\s*((\S*/)?blocksar\s.*)", part)
            script = re.search(r"(?:^|\s)((\S*/)?python3?(\.\d+)?\s+(\S*/)?(workflows|deploy)/\S+\.py\b.*)", part)
            if match := script or own:
                yield match[1].strip()


def documented() -> dict[str, str]:
    """Return complete command lines by place: shell blocks of pages, indented lines of module docstrings."""
    lines = {
        f"{page}:{line}: {command}": command
        for page, text in PAGES.items()
        for line, block in fenced(text, "bash")
        for command in command_lines(block)
    }
    for path, text in DOCSTRINGS.items():
        shell = "\n".join(line for line in text.splitlines() if line.startswith("    "))
        lines |= {f"{path}: {command}": command for command in command_lines(shell)}
    return lines


def inline() -> list[str]:
    """Return the command lines in running text, complete or not."""
    spans = [span for text in PAGES.values() for span in re.findall(r"`([^`\n]+)`", prose(text))]
    return sorted({span for span in spans if list(command_lines(span)) and not NOTATION.search(span)})


# Programs


@cache
def program(name: str) -> Any:
    """Return the command of `blocksar`, or that of a script by its module name."""
    if name == "blocksar":
        return typer.main.get_command(commands.app)
    app = typer.Typer(add_completion=False)
    app.command()(importlib.import_module(name).main)
    return typer.main.get_command(app)


@pytest.fixture(autouse=True)
def _scripts_can_be_imported(monkeypatch: pytest.MonkeyPatch) -> None:
    for folder in SCRIPT_FOLDERS:
        monkeypatch.syspath_prepend(str(folder))


def split(command: str) -> tuple[str, list[str]]:
    """Return the program's name and its arguments."""
    first, *words = shlex.split(command.partition(" > ")[0], comments=True)
    if Path(first).name == "blocksar":
        return "blocksar", words
    return Path(words[0]).stem, words[1:]


def command_of(command: str) -> tuple[Any, list[str]]:
    """Return the command that a line names, resolved through its groups, and the command's own arguments."""
    name, words = split(command)
    entry = program(name)
    while words and words[0] in getattr(entry, "commands", {}):
        entry = entry.commands[words.pop(0)]
    return entry, words


def parse(command: str) -> None:
    """Parse a command line as its program does, without running it."""
    entry, words = command_of(command)
    if hasattr(entry, "commands"):
        raise LookupError(f"No such command: {command}")
    context = entry.make_context(entry.name, words)
    for option, read in READERS.items():
        if isinstance(value := context.params.get(option), str):
            read(value)


def below(entry: Any, *names: str) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield a command and all its subcommands, each with its path of names."""
    yield names, entry
    for name, command in getattr(entry, "commands", {}).items():
        yield from below(command, *names, name)


BLOCKSAR = dict(below(program("blocksar")))


# Python examples


def check_own_data(names: dict[str, Any]) -> None:
    assert names["value"] == pytest.approx(1, abs=0.01)


def check_xarray(names: dict[str, Any]) -> None:
    assert names["part"].sizes == {"y": 53, "x": 67}
    assert float(names["power"].max()) <= float(names["ds"].sar.db().max())
    assert names["cut"].sizes["distance"] == 401
    assert names["axes"].get_title() == "first image"


def check_reference(names: dict[str, Any]) -> None:
    assert names["plan"].refusal is None
    assert names["image"].sizes == {"y": 80, "x": 80}
    assert 0.5 < float(abs(names["image"]).max()) < 1.1  # the target has reflectivity 1 and lies between pixels


def check_extension(names: dict[str, Any]) -> None:
    """The page has the modules of the package in full, in their order, and its entry points."""
    page = PAGES[EXTENSION]
    parts = tomllib.loads(fenced(page, "toml")[0][1])["project"]["entry-points"]
    assert parts == PARTS
    for text, module in zip(fenced(page, "python"), ("reader", "product", "processor"), strict=True):
        assert text[1] == (ROOT / EXTENSION).parent.joinpath(NAME, f"{module}.py").read_text(encoding="utf-8")
    assert {*Reader.__annotations__, "read", "describe"} <= set(dir(names["MADEUP"]))
    assert names["MADEUP"].kind.mark(Start("flight.madeup", b"MADEUP 1\n", whole=True))
    assert {*Processor.__annotations__, "check", "plan"} <= set(dir(names["POLAR_FORMAT"]))


def check_arrays(names: dict[str, Any]) -> None:
    image = names["run"].open()["image"]
    assert image.sel(x=30, y=-24).item() == pytest.approx(1, abs=0.01)
    assert abs(image).argmax(...)["x"].item() == image.indexes["x"].get_loc(30.0)
    assert Path("arrays.png").stat().st_size > 10_000


CHECKS: dict[str, Callable[[dict[str, Any]], None]] = {
    "README.md": check_arrays,
    "blocksar/products/README.md": check_xarray,
    "blocksar/stores/README.md": check_own_data,
    "deploy/site/pages/reference.md": check_reference,
    EXTENSION: check_extension,
}


def test_every_page_with_python_has_a_check() -> None:
    assert {page for page, text in PAGES.items() if fenced(text, "python")} == set(CHECKS)


@pytest.mark.slow
@pytest.mark.parametrize("page", CHECKS)
def test_python_on_a_page_runs(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the code blocks in order, in a folder with a run of a small scene."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(importlib.import_module("first_image").SCENE)
    if page == "blocksar/products/README.md":
        blocksar.simulate("scene.toml", "ph.zarr")
        blocksar.focus("ph.zarr", "run", blocks=1, workers=0, grid=((-60, 60, 1.5), (-60, 60, 1.5)))
    names: dict[str, Any] = {"__name__": "__main__"}
    for line, text in fenced(PAGES[page], "python"):
        exec(compile("\n" * (line - 1) + text, str(ROOT / page), "exec"), names)
    CHECKS[page](names)
    from matplotlib import pyplot

    pyplot.close("all")


@pytest.mark.parametrize("name", [*(page for page, text in PAGES.items() if ">>>" in text), *WORKFLOWS])
def test_interactive_examples_give_the_documented_output(name: str) -> None:
    """Test `>>>` examples of pages and workflows; pytest collects those of the package's modules."""
    if name in PAGES:
        tests = [doctest.DocTestParser().get_doctest(PAGES[name], {}, name, name, 0)]
    else:
        tests = doctest.DocTestFinder().find(importlib.import_module(name))
    runner = doctest.DocTestRunner()
    for test in tests:
        runner.run(test)
    assert runner.failures == 0


def test_pytest_collects_the_doctests_of_the_package() -> None:
    options = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["pytest"]["ini_options"]
    assert "--doctest-modules" in options["addopts"] and "blocksar" in options["testpaths"]


# Command lines


@pytest.mark.slow
@pytest.mark.parametrize("command", documented().values(), ids=documented().keys())
def test_a_documented_command_line_parses(command: str) -> None:
    parse(command)


def test_command_lines_are_found_on_the_expected_pages() -> None:
    programs = {split(command)[0] for command in documented().values()}
    assert programs == {"blocksar", *WORKFLOWS, "focus_on_slurm", "focused_scene"}
    assert {name.split(":")[0] for name in documented()} >= {
        "README.md", "blocksar/graph/README.md", "blocksar/readers/README.md", "workflows/README.md",
        "deploy/slurm/README.md",
    }  # fmt: skip
    assert len(inline()) >= 8


@pytest.mark.parametrize("command", inline())
def test_running_text_names_known_commands_and_options(command: str) -> None:
    entry, words = command_of(command)
    known = {option for parameter in entry.params for option in (*parameter.opts, *parameter.secondary_opts)}
    assert {word.split("=")[0] for word in words if word.startswith("-")} <= known | {"--help"}
    assert not hasattr(entry, "commands") or all(word.startswith("-") for word in words) or not words[1:], "no command"


def test_an_invalid_command_line_fails() -> None:
    """Check that `parse` detects errors; the tests above rely on it."""
    for wrong in ("blocksar focus ph.zarr", "blocksar focus ph.zarr --out run --block 3", "blocksar defocus run"):
        with pytest.raises(Exception, match=r"Missing parameter|No such"):
            parse(wrong)
    with pytest.raises(InputError, match="two"):
        parse("blocksar focus ph.zarr --out run --grid 0:1:1")
    with pytest.raises(Exception, match="No such option"):
        parse("python workflows/first_image.py --nothing")


def test_the_second_command_of_the_readme_runs_the_checks() -> None:
    """`.ci/run` reads the command from the README, and runs the slow tests after it."""
    assert "pytest -m slow" in (ROOT / ".ci" / "run").read_text()
    section = PAGES["README.md"].split("\n## Two commands\n")[1].split("\n## ")[0]
    first, second = (text for _, text in fenced(section, "bash"))
    assert "blocksar demo" in first
    assert all(tool in second for tool in ("ruff check", "ruff format --check", "mypy", "pytest"))


# Help texts


def examples(entry: Any) -> list[str]:
    """Return the command lines after "Example:" in a command's help."""
    text = re.sub(r"\[/?bold\]", "", entry.help or "")
    return [" ".join(line.split()) for line in re.findall(r"Example: (.*?)(?:\n\n|\Z)", text, re.S)]


@pytest.mark.parametrize("names", BLOCKSAR, ids=lambda names: " ".join(("blocksar", *names)))
def test_help_has_an_example_that_parses(names: tuple[str, ...]) -> None:
    help_text = CliRunner().invoke(commands.app, [*names, "--help"])
    assert help_text.exit_code == 0
    assert "Example:" in help_text.output
    lines = examples(BLOCKSAR[names])
    assert lines
    for command in lines:
        assert command.startswith(" ".join(("blocksar", *names)))
        parse(command)


@pytest.mark.parametrize("name", [*WORKFLOWS, "focused_scene"])
def test_help_of_a_script_has_an_example_that_parses(name: str) -> None:
    lines = examples(program(name))
    assert lines
    for command in lines:
        assert split(command)[0] == name
        parse(command)


# Links


def links(text: str) -> list[str]:
    """Return the relative targets of a page's links and pictures."""
    plain = re.sub(r"`[^`\n]*`", "", prose(text))
    targets = re.findall(r"\]\(([^)\s]+)\)", plain)
    return [target for target in targets if not re.match(r"[a-z]+:", target)]


def anchors(text: str) -> set[str]:
    """Return the anchors of a page's headings, as GitHub and the site generate them."""
    headings = re.findall(r"^#+ +(.*?)\s*$", prose(text), re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


# Links between pages of the site resolve on the site only; its strict build checks them.
@pytest.mark.parametrize("page", [page for page in PAGES if page.endswith("README.md")])
def test_links_resolve_to_files_and_headings(page: str) -> None:
    wrong = []
    for link in links(PAGES[page]):
        path, _, anchor = link.partition("#")
        target = (ROOT / page).parent.joinpath(path).resolve() if path else ROOT / page
        if not target.exists():
            wrong.append(f"{link}: no such file")
        elif anchor and anchor not in anchors(target.read_text(encoding="utf-8")):
            wrong.append(f"{link}: no such heading")
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("place", [*PAGES, *(path for path, text in DOCSTRINGS.items() if text)])
def test_named_files_exist(place: str) -> None:
    """Check files of the repository that backticks or commands name by their path from the root."""
    text = PAGES.get(place) or DOCSTRINGS[place]
    named = re.findall(r"(?<![\w/.-])(?:blocksar|workflows|deploy|tests)/[\w./-]*\w\.(?:py|md|toml|sh)\b", text)
    assert not [name for name in named if not (ROOT / name).exists()]


def test_the_readme_lists_every_command() -> None:
    section = PAGES["README.md"].split("\n## Commands\n")[1].split("\n## ")[0]
    listed = set(re.findall(r"^\| `(\w+)` \|", section, re.M))
    assert listed == {names[0] for names in BLOCKSAR if names}


def test_every_page_is_listed() -> None:
    """The tables in README.md and deploy/README.md together link to every page."""
    listed = set()
    for page in ("README.md", "deploy/README.md"):
        for link in links(PAGES[page]):
            listed.add(place_of((ROOT / page).parent.joinpath(link.partition("#")[0]).resolve()))
    assert {page for page in PAGES if page.endswith("README.md")} <= listed | {"README.md"}


# Tables that repeat the code


def test_the_page_about_scene_files_has_all_keys_of_the_models() -> None:
    """To renew the page, put the text of `scene_tables` below its heading."""
    assert PAGES["blocksar/simulation/README.md"].split("\n## Tables and keys\n\n")[1] == scene_tables()


def test_the_table_of_layers_matches_test_layers() -> None:
    tree = ast.parse((ROOT / "tests" / "test_layers.py").read_text(encoding="utf-8"))
    (value,) = (
        node.value for node in tree.body if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "LAYERS"
    )
    layers = ast.literal_eval(value)
    rows = re.findall(r"^\| (\d+) \| ([^|]*) \|", PAGES["blocksar/README.md"], re.M)
    table = {int(number): set(re.findall(r"`(\w+)`", rooms)) for number, rooms in rows}
    assert table == {number: set(rooms) for number, rooms in enumerate(layers, 1)}


def sentences(path: Path) -> Iterator[str]:
    """Yield the strings of a module, without the values of f-strings."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.JoinedStr):
            yield "\0".join(part.value for part in node.values if isinstance(part, ast.Constant))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def test_documented_messages_occur_in_the_code() -> None:
    section = PAGES["blocksar/cli/README.md"].split("\n## When something is wrong\n")[1]
    cells = re.findall(r"^\| (.*?) \|", section, re.M)
    quoted = [span for cell in cells for span in re.findall(r"`([^`]+)`", cell) if not span.startswith(("Nanny", "--"))]
    code = "\n".join(sentence for path in files(ROOT / "blocksar", "*.py") for sentence in sentences(path))
    parts = [(span, part.strip()) for span in quoted for part in re.split(r"\.\.\.|\d+", span)]
    missing = {span: part for span, part in parts if len(part) > 3 and part not in code}
    assert len(quoted) >= 12
    assert not missing
