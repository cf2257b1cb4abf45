"""What README.md, the docstrings and the help tell people to type: Python is run, command lines are parsed."""

from __future__ import annotations

import ast
import doctest
import importlib
import re
import shlex
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

import blocksar
from blocksar.cli import commands, parsing
from blocksar.errors import InputError

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
WORKFLOWS = sorted(path.stem for path in (ROOT / "workflows").glob("*.py"))
# What stands for something else: README's notation in running text, not what anybody types.
NOTATION = re.compile(r"[|…]|\.\.\.|COMMAND")
# Values that are read after the parsing of the command line.
READERS = {
    "grid": parsing.parse_grid,
    "blocks": lambda text: parsing.parse_blocks(text.split(",")[0]),  # of the study of blocks, several
    "memory_limit": parsing.parse_memory,
    "origin": parsing.parse_origin,
}


# ---------------------------------------------------------------- what is told


def fenced(language: str) -> list[tuple[int, str]]:
    """README's blocks of a language, with the line where each begins."""
    found = re.finditer(rf"^```{language}\n(.*?)^```$", README, re.M | re.S)
    return [(README[: m.start()].count("\n") + 2, m[1]) for m in found]


def command_lines(text: str) -> Iterator[str]:
    """Command lines of blocksar or of a workflow in a shell text, continued lines joined."""
    for line in re.sub(r"\\\n\s*", " ", text).splitlines():
        for part in re.split(r"&&|;", line):
            if re.match(r"\s*(\S*/)?(blocksar\s|python3?(\.\d+)?\s+workflows/)", part):
                yield part.strip()


def documented() -> dict[str, str]:
    """Whole command lines, by where they are told: README's shell blocks, indented lines of module docstrings."""
    told = {f"README.md:{line}: {command}": command for line, text in fenced("bash") for command in command_lines(text)}
    for path in sorted([*(ROOT / "blocksar").glob("*.py"), *(ROOT / "workflows").glob("*.py")]):
        text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        shell = "\n".join(line for line in text.splitlines() if line.startswith("    "))
        told |= {f"{path.name}: {command}": command for command in commands(shell)}
    return told


def inline() -> list[str]:
    """Command lines in README's running text: complete or not, what they name has to be there."""
    prose = re.sub(r"^```.*?^```$", "", README, flags=re.M | re.S)
    spans = re.findall(r"`([^`\n]+)`", prose)
    return sorted({span for span in spans if list(commands(span)) and not NOTATION.search(span)})


# ---------------------------------------------------------------- who would read it


@cache
def program(name: str) -> Any:
    """The command of `blocksar`, or of a workflow by its module's name."""
    if name == "blocksar":
        return typer.main.get_command(commands.app)
    app = typer.Typer(add_completion=False)
    app.command()(importlib.import_module(name).main)
    return typer.main.get_command(app)


@pytest.fixture(autouse=True)
def _workflows_can_be_imported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "workflows"))


def split(command: str) -> tuple[str, list[str]]:
    """Which program, and its words."""
    first, *words = shlex.split(command, comments=True)
    if Path(first).name == "blocksar":
        return "blocksar", words
    return Path(words[0]).stem, words[1:]


def command_of(command: str) -> tuple[Any, list[str]]:
    """The command that a line names, groups walked through, and the words that are its own."""
    name, words = split(command)
    entry = program(name)
    while words and words[0] in getattr(entry, "commands", {}):
        entry = entry.commands[words.pop(0)]
    return entry, words


def parse(command: str) -> None:
    """Parse a command line as its program would, without running it: every option known, every argument there."""
    entry, words = command_of(command)
    if hasattr(entry, "commands"):
        raise LookupError(f"No such command: {command}")
    context = entry.make_context(entry.name, words)
    for option, read in READERS.items():
        if isinstance(value := context.params.get(option), str):
            read(value)


def below(entry: Any, *names: str) -> Iterator[tuple[tuple[str, ...], Any]]:
    """A command and all commands under it, with the words that name them."""
    yield names, entry
    for name, command in getattr(entry, "commands", {}).items():
        yield from below(command, *names, name)


BLOCKSAR = dict(below(program("blocksar")))


# ---------------------------------------------------------------- Python is run


def test_python_in_the_readme_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Block after block, in a folder with a run of a small scene; and the image of one's own data is right."""
    monkeypatch.chdir(tmp_path)
    scene = importlib.import_module("first_image").SCENE
    (tmp_path / "scene.toml").write_text(scene)
    blocksar.simulate("scene.toml", "ph.zarr")
    blocksar.focus("ph.zarr", "run", blocks=1, workers=1, grid=((-60, 60, 1.5), (-60, 60, 1.5)))
    names: dict[str, Any] = {"__name__": "__main__"}
    for line, text in fenced("python"):
        code = compile("\n" * (line - 1) + text, str(ROOT / "README.md"), "exec")
        exec(code, names)
    assert names["value"] == pytest.approx(1, abs=0.01)
    assert names["part"].sizes == {"y": 53, "x": 67}
    assert float(names["power"].max()) <= float(names["ds"].sar.db().max())
    assert names["cut"].sizes["distance"] == 401
    assert names["axes"].get_title() == "first image"
    from matplotlib import pyplot

    pyplot.close("all")


@pytest.mark.parametrize("name", ["README.md", *WORKFLOWS])
def test_prompts_are_answered_as_told(name: str) -> None:
    """`>>>` of README and workflows; those of the package's modules are run with all tests."""
    if name == "README.md":
        tests = [doctest.DocTestParser().get_doctest(README, {}, name, name, 0)]
    else:
        tests = doctest.DocTestFinder().find(importlib.import_module(name))
    runner = doctest.DocTestRunner()
    for test in tests:
        runner.run(test)
    assert runner.failures == 0


def test_prompts_of_the_package_are_run_with_all_tests() -> None:
    options = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["pytest"]["ini_options"]
    assert "--doctest-modules" in options["addopts"] and "blocksar" in options["testpaths"]


# ---------------------------------------------------------------- command lines are parsed


@pytest.mark.parametrize("command", documented().values(), ids=documented().keys())
def test_a_command_line_that_is_told_can_be_given(command: str) -> None:
    parse(command)


def test_command_lines_are_found() -> None:
    told, programs = documented(), {split(command)[0] for command in documented().values()}
    assert programs == {"blocksar", *WORKFLOWS}
    assert sum(name.startswith("README") for name in told) >= 5
    assert len(inline()) >= 8


@pytest.mark.parametrize("command", inline())
def test_what_running_text_names_is_there(command: str) -> None:
    entry, words = command_of(command)
    known = {option for parameter in entry.params for option in (*parameter.opts, *parameter.secondary_opts)}
    assert {word.split("=")[0] for word in words if word.startswith("-")} <= known | {"--help"}
    assert not hasattr(entry, "commands") or all(word.startswith("-") for word in words), "no such command"


def test_a_wrong_command_line_is_seen() -> None:
    """Else all of the above says nothing."""
    for wrong in ("blocksar focus ph.zarr", "blocksar focus ph.zarr --out run --block 3", "blocksar defocus run"):
        with pytest.raises(Exception, match=r"Missing parameter|No such"):
            parse(wrong)
    with pytest.raises(InputError, match="two"):
        parse("blocksar focus ph.zarr --out run --grid 0:1:1")
    with pytest.raises(Exception, match="No such option"):
        parse("python workflows/first_image.py --nothing")


# ---------------------------------------------------------------- help has examples


def examples(entry: Any) -> list[str]:
    """Command lines after "Example:" in a command's help."""
    text = re.sub(r"\[/?bold\]", "", entry.help or "")
    return [" ".join(found.split()) for found in re.findall(r"Example: (.*?)(?:\n\n|\Z)", text, re.S)]


@pytest.mark.parametrize("names", BLOCKSAR, ids=lambda names: " ".join(("blocksar", *names)))
def test_help_has_an_example_that_can_be_given(names: tuple[str, ...]) -> None:
    shown = CliRunner().invoke(commands.app, [*names, "--help"])
    assert shown.exit_code == 0
    assert "Example:" in shown.output
    told = examples(BLOCKSAR[names])
    assert told
    for command in told:
        assert command.startswith(" ".join(("blocksar", *names)))
        parse(command)


@pytest.mark.parametrize("name", WORKFLOWS)
def test_help_of_a_workflow_has_an_example_that_can_be_given(name: str) -> None:
    told = examples(program(name))
    assert told
    for command in told:
        assert split(command)[0] == name
        parse(command)
