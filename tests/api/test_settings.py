"""The settings are stated once: signatures, docstrings and the page of options are held to their model."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from inspect import signature
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import pytest
from docstrings import entries
from scenes import write_store

import blocksar
from blocksar import api
from blocksar.application.jobs import Request
from blocksar.application.parsing import Axis
from blocksar.application.settings import COMMANDS, Settings, options_taken
from blocksar.collection.grid import Grid
from blocksar.imaging.method import ChainOptions
from blocksar.measurement.targets import Target
from blocksar.options import Stated, options_of
from blocksar.places import Location, place

PAGE = Path(blocksar.__file__).parent / "cli" / "README.md"
# Types under names that type checkers alone import.
NAMES: dict[str, Any] = {
    "Control": Location | Sequence[Target], "Grid": Grid, "GridLike": Grid | str | tuple[Axis, Axis],
    "Location": Location, "Target": Target,
}  # fmt: skip
TYPES = {model: get_type_hints(model, localns=NAMES) for model in (Settings, ChainOptions)}
# Parameters of which a docstring has its own to say.
OWN_WORDS = {
    "plan": {"looks", "workers"},
    "autofocus": {"grid", "terrain", "vertical", "control", "workers", "overwrite"},
    "check": {"grid", "terrain", "surface", "vertical"},
    "preview": {"grid", "overwrite"},
    "demo": {"workers", "overwrite"},
}


def taken(command: str) -> tuple[Stated, ...]:
    """The options that the function of a command takes."""
    return (*options_taken(command), *(options_of(ChainOptions) if command in ("focus", "plan") else ()))


CASES = [pytest.param(command, each, id=f"{command}-{each.name}") for command in COMMANDS for each in taken(command)]


def parts(kind: Any) -> set[Any]:
    return {kind} if get_origin(kind) is Literal else set(get_args(kind)) or {kind}


@pytest.mark.parametrize(("command", "stated"), CASES)
def test_a_function_has_every_option_of_its_command(command: str, stated: Stated) -> None:
    function, name = getattr(api, command), stated.name
    known = TYPES[Settings] | TYPES[ChainOptions]
    where = f"blocksar/{function.__module__.partition('.')[2].replace('.', '/')}.py"
    assert name in signature(function).parameters, (
        f"{command} in {where} lacks the option {name} of the model: add `{name}: {stated.type} = {stated.default!r}` "
        f"to its parameters, and an entry for it to its docstring, as `focus` has"
    )
    parameter = signature(function).parameters[name]
    assert parameter.default == stated.default, f"{command} in {where}: give {name} the default {stated.default!r}"
    found = eval(parameter.annotation, vars(sys.modules[function.__module__]) | NAMES)
    wrong = f"{command} in {where}: the type of {name} is {parameter.annotation}, but the model has {known[name]}"
    if stated.option.choices is not None:
        assert set(stated.option.choices()) == {word for each in parts(found) for word in get_args(each) or [each]}, (
            wrong
        )
    elif stated.option.read is not None:  # which reads more than it gives
        assert parts(found) >= parts(known[name]), wrong
    else:
        assert parts(found) == parts(known[name]), wrong


@pytest.mark.parametrize(("command", "stated"), CASES)
def test_docstrings_say_the_same(command: str, stated: Stated) -> None:
    name, found, focus = stated.name, entries(getattr(api, command)), entries(api.focus)
    assert name in found, f"the docstring of {command} has no entry {name}; copy that of focus"
    if name not in OWN_WORDS.get(command, ()):
        assert found[name] == focus[name], f"the docstrings of {command} and focus do not say the same of {name}"


def test_functions_have_no_other_options() -> None:
    options = {each.name for each in (*options_of(Settings), *options_of(ChainOptions))}
    for command in COMMANDS:
        own = {"threads"} if command in ("check", "preview") else set()  # of the calling process
        assert options & set(signature(getattr(api, command)).parameters) - own == {
            each.name for each in taken(command)
        }


def table() -> str:
    """The options of `focus`, as the page has them: what its docstring says of them."""
    rows, said = ["| option | also of | meaning |", "|---|---|---|"], entries(api.focus)
    for each in taken("focus"):
        flag = f"--{'no-' if each.default is True else ''}{each.name.replace('_', '-')}"
        values = get_args(each.type) if each.option.choices is None else ()
        words = [str(word) for word in values if isinstance(word, str)] if get_origin(each.type) is Literal else []
        flag = each.option.flags[0] if bool in get_args(each.type) else flag
        value = "" if bool in (each.type, *get_args(each.type)) else " " + (each.option.metavar or "|".join(words))
        others = [name for name in COMMANDS[1:] if each.name in {other.name for other in taken(name)}]
        shown = f"{flag}{value}".replace("|", "\\|")
        rows.append(f"| `{shown}` | {', '.join(f'`{other}`' for other in others)} | {said[each.name][1]} |")
    return "\n".join(rows) + "\n"


def test_the_page_has_every_option() -> None:
    found = re.search(r"^\| option \| also of \|.*?\n(?!\|)", PAGE.read_text(encoding="utf-8"), re.M | re.S)
    assert found and found[0] == table(), (
        f"the table of options in {PAGE} is not as the model has it; it is\n\n{table()}"
    )


def test_machine_and_output_are_not_what_a_run_is_known_by(tmp_path: Path) -> None:
    store, run = write_store(tmp_path), place(tmp_path / "run")

    def settings(**given: Any) -> dict[str, Any]:
        return Request.open(store, run, Settings.of(given)).settings

    plain = settings()
    assert plain == settings(
        workers=3, threads=2, memory_limit="3GiB", scheduler="tcp://a:1", wait_workers=1.0, overwrite=True,
        discard=True, dry_run=True, performance_report="a.html",
    )  # fmt: skip
    others: dict[str, Any] = {
        "processor": "high-order-phase", "blocks": 3, "fidelity": 0.99, "weighting": "hann", "weighting_range": "hann",
        "weighting_azimuth": "hann", "ground_height": 3.0, "autofocus": True, "derotation": "linear",
    }  # fmt: skip
    assert all(settings(**{name: value}) != plain for name, value in others.items())
