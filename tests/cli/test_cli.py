"""The command line: arguments become the right call, and an error becomes one message and an exit status."""

from __future__ import annotations

import inspect
import io
import signal
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import typer
from every_command import every_command
from rich.console import Console
from typer.testing import CliRunner, Result

import blocksar
from blocksar.application import parsing
from blocksar.application.settings import options_taken
from blocksar.cli import commands, endings, printing
from blocksar.errors import InputError, ProcessingError
from blocksar.imaging.method import ChainOptions
from blocksar.options import options_of
from blocksar.progress import Progress
from blocksar.simulation.scene import Scene

COMMANDS = {
    "demo": ["demo", "--out", "run"],
    "simulate": ["simulate", "table1", "--out", "ph.zarr"],
    "info": ["info", "table1"],
    "plan": ["plan", "table1"],
    "preview": ["preview", "ph.zarr", "--out", "ph.png"],
    "check": ["check", "ph.zarr"],
    "autofocus": ["autofocus", "ph.zarr", "--out", "mended.zarr"],
    "focus": ["focus", "ph.zarr", "--out", "run"],
    "quality": ["quality", "run"],
    "report": ["report", "run"],
    "compare": ["compare", "a", "b", "--out", "pair"],
    "calibrate": ["calibrate", "run", "--reflectors", "corners.geojson"],
    "view": ["view", "run", "--no-browser"],
    "compile": ["compile"],
}


class Answer(dict[str, Any]):
    """The result of any command; that of `view` serves."""

    def serve(self) -> None:
        pass


REPORT = SimpleNamespace(
    measurable=True,
    details=[],
    definitions=(),
    summary=["three blocks"],
    table=lambda: [(["target", "width [m]"], [["A1", "1.89"], ["B2", "[bold]1.90"]])],
    refusal=None,
    result=Answer(next=[["plan", "a b.zarr"]]),
)


class Calls(ModuleType):
    """Replace blocksar.api: record each call, and return or raise what the test sets."""

    def __init__(self) -> None:
        super().__init__("blocksar.api")
        self.seen: dict[str, tuple[tuple[object, ...], dict[str, object]]] = {}
        self.answer: object = REPORT
        self.updates: list[tuple[str, int, int]] = []
        for name in (*COMMANDS, "autofocus", "export"):
            setattr(self, name, lambda *args, _name=name, **kwargs: self._called(_name, args, kwargs))

    def _called(self, name: str, args: tuple[object, ...], kwargs: dict[str, object]) -> object:
        self.seen[name] = args, kwargs
        if isinstance(self.answer, BaseException):
            raise self.answer
        for update in self.updates:
            kwargs["progress"].update(*update)  # type: ignore[attr-defined]
        return self.answer


@pytest.fixture
def api(monkeypatch: pytest.MonkeyPatch) -> Calls:
    calls = Calls()
    monkeypatch.setitem(sys.modules, "blocksar.api", calls)
    monkeypatch.setattr(blocksar, "api", calls, raising=False)
    return calls


def run(*words: str) -> Result:
    return CliRunner().invoke(commands.app, words, prog_name="blocksar")


# Arguments


@pytest.mark.parametrize("command", ["focus", "plan"])
def test_options_arrive_as_their_model_reads_them(command: str, api: Calls) -> None:
    words = "--blocks 5 --grid -10:10:0.5,100:200:1 --memory-limit 2GiB --ground-height 30 --whole-pulses --no-keystone"
    assert run(command, "ph.zarr", *(["--out", "run"] if command == "focus" else []), *words.split()).exit_code == 0
    kwargs = api.seen[command][1]
    kwargs.pop("progress", None)
    assert kwargs == {each.name: each.default for each in (*options_taken(command), *options_of(ChainOptions))} | {
        "blocks": 5, "grid": ((-10.0, 10.0, 0.5), (100.0, 200.0, 1.0)), "memory_limit": 2 * 1024**3,
        "ground_height": 30.0, "whole_pulses": True, "keystone": False,
    }  # fmt: skip


def test_quality_and_simulate_pass_their_options(api: Calls) -> None:
    words = ("--targets", "t.json", "--reference", "--against", "r", "--found=5", "--area", "0:9,-3:3", "--channel=HV",
             "--source=p.zarr")  # fmt: skip
    assert run("quality", "run", *words).exit_code == 0
    options = {"targets": "t.json", "reference": True, "against": "r", "found": 5, "area": "0:9,-3:3", "channel": "HV",
               "source": "p.zarr"}  # fmt: skip
    assert api.seen["quality"] == (("run",), options)
    assert run("simulate", "a.toml", "--out", "p.zarr", "--raw", "--threads", "4").exit_code == 0
    args, kwargs = api.seen["simulate"]
    assert args == ("a.toml", "p.zarr")
    assert (kwargs["raw"], kwargs["threads"], kwargs["overwrite"]) == (True, 4, False)


def test_a_printed_scene_is_read_again(tmp_path: Path) -> None:
    printed = CliRunner().invoke(commands.app, ["simulate", "table1", "--print"])
    (tmp_path / "own.toml").write_text(printed.stdout, encoding="utf-8")
    assert (
        printed.exit_code == 0 and Scene.read(tmp_path / "own.toml").model_dump() == Scene.read("table1").model_dump()
    )
    missing = CliRunner().invoke(commands.app, ["simulate", "table1"])
    assert missing.exit_code == 2 and "--out is missing" in missing.stderr


@pytest.mark.parametrize("command", COMMANDS)
def test_the_calls_match_the_signatures_of_the_api(command: str, api: Calls, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run(*COMMANDS[command]).exit_code == 0
    args, kwargs = api.seen[command]
    monkeypatch.undo()
    real = pytest.importorskip("blocksar.api")
    inspect.signature(getattr(real, command)).bind(*args, **kwargs)


@pytest.mark.parametrize(
    ("text", "size"),
    [("1GiB", 2**30), ("1.5 gib", 3 * 2**29), ("500MB", 500_000_000), ("4000k", 4_000_000), ("4096Ki", 1 << 22),
     ("1e9", 10**9), (".5GB", 500_000_000), ("1234567", 1234567), ("7000000B", 7_000_000)],
)  # fmt: skip
def test_memory_sizes_are_parsed(text: str, size: int) -> None:
    assert parsing.parse_memory(text) == size


# Exit status and messages


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(
    ("error", "status", "message"),
    [
        (InputError("time is not uniform; resample it"), 2, "blocksar: time is not uniform; resample it\n"),
        (ProcessingError("block 2 failed; run again"), 1, "blocksar: block 2 failed; run again\n"),
        (OSError(28, "No space left on device"), 1, "blocksar: [Errno 28] No space left on device\n"),
        (KeyboardInterrupt(), 130, "blocksar: interrupted;"),
        (endings.Terminated(143), 143, "blocksar: terminated;"),
    ],
)
def test_an_error_gives_one_message_and_an_exit_status(
    command: str, error: BaseException, status: int, message: str, api: Calls
) -> None:
    api.answer = error
    result = run(*COMMANDS[command])
    assert result.exit_code == status
    assert result.stderr.startswith(message)
    assert result.stderr.count("\n") == 1
    assert result.stdout == ""


def test_a_signal_that_a_class_in_the_making_wraps_is_a_signal(api: Calls) -> None:
    """Python 3.11 raises a RuntimeError from what interrupts `__set_name__`, as an import may."""
    api.answer = RuntimeError("Error calling __set_name__ on 'cached_property' instance")
    api.answer.__cause__ = endings.Terminated(143)
    result = run(*COMMANDS["plan"])
    assert result.exit_code == 143
    assert result.stderr.startswith("blocksar: terminated;")
    api.answer = RuntimeError("ours")
    assert isinstance(run(*COMMANDS["plan"]).exception, RuntimeError)


def test_an_internal_error_keeps_its_traceback(api: Calls) -> None:
    api.answer = ZeroDivisionError("ours")
    assert isinstance(run(*COMMANDS["plan"]).exception, ZeroDivisionError)


@pytest.mark.parametrize("words", [(), ("export",), ("ingest",)])
def test_a_group_without_a_command_lists_its_commands(words: tuple[str, ...]) -> None:
    result = run(*words)
    assert (result.exit_code, result.stderr) == (2, "")
    assert "Commands" in result.stdout


def test_plan_prints_its_refusal_after_the_table(api: Calls) -> None:
    api.answer = SimpleNamespace(
        details=[], definitions=(), summary=[], table=REPORT.table, refusal="looks along the velocity"
    )
    result = run("plan", "table1")
    assert (result.exit_code, result.stderr) == (2, "blocksar: looks along the velocity\n")
    assert "A1" in result.stdout


# A separate process receives real signals: its `plan` prints a line when it runs, then waits.
WAITING = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job is born deaf to it
from blocksar import api
def plan(source, **settings):
    try:
        print("ready", flush=True)
        time.sleep(1e6)
    finally:
        if "hang" in sys.argv:
            print("hanging", flush=True)
            time.sleep(1e6)
api.plan = plan
from blocksar import cli
from blocksar.cli import endings
endings.GRACE = float(sys.argv[1])
sys.argv = ["blocksar", "plan", sys.argv[2]]
cli.main()
"""


def waiting(grace: float, source: str) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", WAITING, str(grace), source], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


def ended(process: subprocess.Popen[str], status: int) -> None:
    _, stderr = process.communicate()
    assert process.returncode == status
    assert stderr.startswith("blocksar: ") and stderr.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize("again", [True, False])
def test_a_process_that_hangs_after_a_signal_is_ended(again: bool) -> None:
    with waiting(1e6 if again else 0.2, "hang") as process:
        process.send_signal(signal.SIGTERM)
        assert process.stdout is not None
        assert process.stdout.readline() == "hanging\n"
        if again:
            process.send_signal(signal.SIGINT)
        ended(process, 143)


INTERRUPTED_IMPORT = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
class Finder:
    def find_spec(self, name, *_):
        if name == "blocksar.cli.commands":
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Finder())
from blocksar import cli
cli.main()
"""


def test_ctrl_c_before_the_command_line_is_imported_gives_no_traceback() -> None:
    done = subprocess.run([sys.executable, "-c", INTERRUPTED_IMPORT], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (-signal.SIGINT, "")  # which shells report as 130


# Output


def test_closed_streams_and_missing_characters_end_no_command(monkeypatch: pytest.MonkeyPatch) -> None:
    narrow = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", narrow)
    monkeypatch.setattr(sys, "stderr", None)  # as Python has it after 2>&-
    endings.open_streams()
    with sys.stderr:
        print("nowhere", file=sys.stderr)
        print("k\u00f6ln.zarr")
    narrow.flush()
    assert narrow.buffer.getvalue() == b"k?ln.zarr\n"


def test_tables_and_summary_are_printed(api: Calls) -> None:
    output = run("quality", "run").stdout
    assert "width [m]" in output and "[bold]1.90" in output  # nothing is interpreted as markup
    assert output.endswith("three blocks\n")


def test_table_rows_are_not_wrapped_without_a_terminal(api: Calls) -> None:
    row = [f"{i:08d}" for i in range(20)]
    api.answer = SimpleNamespace(details=[], definitions=(), summary=[], table=lambda: [(row, [row])], refusal=None)
    lines = run("plan", "table1").stdout.splitlines()
    assert sum(all(cell in line for cell in row) for line in lines) == 2  # header and row, each on one line


def test_a_terminal_shows_every_figure_of_a_wide_table() -> None:
    """A wide table is split into parts that repeat its first column; titles wrap between words, nothing is cut off."""
    header = ["target", *(f"residual phase {i} (rad)" for i in range(14))]
    rows = [[f"T{j}", *(f"-{j}.{i:04d} .. 1" for i in range(14))] for j in range(2)]
    width, parts = 60, []
    for table in printing.tables(header, rows, width):
        console = Console(width=width, file=io.StringIO())
        console.print(table)
        parts.append(console.file.getvalue())  # type: ignore[attr-defined]
    shown = "".join(parts)
    assert "\N{HORIZONTAL ELLIPSIS}" not in shown
    assert all(cell in shown for row in rows for cell in row)
    assert all("T0" in part and "T1" in part and "target" in part for part in parts)
    assert len(parts) > 1 and max(map(len, shown.splitlines())) <= width
    assert len(list(printing.tables(header, rows, 1000))) == 1


def test_a_terminal_that_says_it_has_no_columns_shows_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "0")
    monkeypatch.setattr(sys, "stdout", Terminal())
    printing.show(REPORT)
    assert "1.89" in sys.stdout.getvalue()  # type: ignore[attr-defined]


def test_all_and_explain_show_what_is_left_out_at_first(api: Calls) -> None:
    full = [(["target", "width", "phase"], [["A1", "1.89", "0.1"], ["B2", "1.90", "0.2"]])]
    api.answer = SimpleNamespace(
        summary=["two targets"],
        table=REPORT.table,
        details=full,
        definitions=["width: of the main lobe."],
        refusal=None,
    )
    first, all_rows, explained = (run("quality", "run", *more) for more in ([], ["--all"], ["--explain", "-q"]))
    assert "phase" not in first.stdout and "main lobe" not in first.stdout
    assert first.stderr.splitlines()[0] == (
        "more: --all shows every row and column; --explain says what the columns mean"
    )
    assert "phase" in all_rows.stdout and "1.90" in all_rows.stdout
    assert all_rows.stderr.splitlines()[0] == "more: --explain says what the columns mean"
    assert "main lobe" in explained.stdout and explained.stderr == ""
    assert "more:" not in run("demo", "--out", "run").stderr  # it has neither option


def test_texts_are_folded_beside_their_names(api: Calls) -> None:
    text = "one word after the other, " * 8
    (table,) = printing.tables(["phase history", "a.zarr"], [["track", text], ["beam", "narrow"]], 60)
    console = Console(width=60, file=io.StringIO())
    console.print(table)
    lines = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert max(map(len, lines)) <= 60 and "phase history" in lines[1]
    assert " ".join(" ".join(line[17:].strip() for line in lines[3:-2]).split()) == f"{text.strip()}"


def test_a_wide_table_is_divided_evenly_and_its_titles_are_low() -> None:
    header = ["block", "lost by residual phase", "at the ends of the dwell", "by noise of the track", "one", "two"]
    rows = [["0", *["0.0000"] * 5]]
    (table,) = printing.tables(header, rows, 80)
    console = Console(width=80, file=io.StringIO())
    console.print(table)
    lines = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert next(i for i, line in enumerate(lines) if "\N{BOX DRAWINGS LIGHT HORIZONTAL}" in line) <= 3
    sizes = [len(table.columns) for table in printing.tables(["t", *"abcdefghi"], [["0" * 8] * 10], 60)]
    assert sizes == [4, 4, 4]  # not [5, 5, 2]


def test_sentences_wrap_between_words_on_a_terminal(api: Calls) -> None:
    path = "/a/path-that/is-longer/than-a-narrow/terminal/is-wide.zarr"
    line = f"  wrote {path} in 9.7 s (recover 8.0 s, focus 1.0 s, mosaic 0.2 s)"
    api.answer = SimpleNamespace(details=[], definitions=(), summary=[line], table=list, refusal=None)
    assert run("plan", "table1").stdout == f"{line}\n"
    assert printing.wrap_line(line, 40).split() == line.split()
    assert path in printing.wrap_line(line, 40) and "mosaic 0.2 s)" in printing.wrap_line(line, 40).splitlines()[-1]
    assert all(part.startswith("  ") for part in printing.wrap_line(line, 40).splitlines())


def test_plain_progress_is_a_line_a_stage(api: Calls) -> None:
    api.updates = [("recover", i, 1000) for i in range(1001)] + [("mosaic", 1, 1), ("nothing", 0, 0)]
    lines = run("focus", "ph.zarr", "--out", "run").stderr.splitlines()
    told = [line.split(";")[0] for line in lines]
    assert told == ["recover: 1000 of 1000", "mosaic: done", "nothing: 0 of 0", "next: blocksar quality run"]
    assert run("focus", "ph.zarr", "--out", "run", "--quiet").stderr == ""


NEXT = {
    "demo --out run": "info run",
    "simulate table1 --out ph.zarr": "plan ph.zarr",
    "simulate table1 --out ph.cphd --cphd": "ingest cphd ph.cphd --out ph.zarr",
    "info table1": "plan 'a b.zarr'",
    "plan table1 --blocks 3": "simulate table1 --out table1.zarr",
    "plan scenes/own.toml": "simulate scenes/own.toml --out own.zarr",
    "plan s3://bucket/ph.zarr --blocks 3 --no-keystone --workers 2": (
        "focus s3://bucket/ph.zarr --out run --blocks 3 --workers 2 --no-keystone"
    ),
    "check ph.zarr --grid 0:1:1,0:1:1": "plan ph.zarr --grid 0:1:1,0:1:1",
    "focus ph.zarr --out run": "quality run",
    "autofocus ph.zarr --out c.zarr --grid 0:1:1,0:1:1 --control points.json": (
        "focus c.zarr --out RUN --grid 0:1:1,0:1:1"
    ),
    "quality run": "report run",
    "report a/run": "export png a/run --out run.png",
    "compile": "demo --out demo-run",
}


@pytest.mark.parametrize("words", NEXT)
def test_a_command_ends_with_the_next_one(words: str, api: Calls) -> None:
    assert run(*words.split()).stderr.splitlines()[-1] == f"next: blocksar {NEXT[words]}"
    assert "next: " not in run(*words.split(), "-q").output


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class Full(io.StringIO):
    def write(self, _: str) -> int:
        raise OSError(28, "No space left on device")


def test_a_command_goes_on_where_its_progress_cannot_be_written(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", Full())
    with Progress() as progress:
        progress.update("focus", 4, 4)
    with pytest.raises(typer.Exit) as ended:
        endings.complain("wrong", 2)
    assert ended.value.exit_code == 2


def test_all_commands_but_those_of_groups_are_looked_at() -> None:
    assert {(name,) for name in COMMANDS} == {names for names in every_command() if len(names) == 1}


def test_version_is_printed() -> None:
    assert run("--version").stdout == f"blocksar {blocksar.__version__}\n"


@pytest.mark.slow
def test_help_loads_no_more_packages_than_typer_does() -> None:
    """So that it answers at once."""

    def packages(app: str) -> set[str]:
        loaded = "atexit.register(lambda: print(*sys.modules, file=sys.stderr))"
        code = f"import atexit, sys; {loaded}; sys.argv[1:] = ['--help']; {app}"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        return {name.partition(".")[0] for name in done.stderr.split()} - set(sys.stdlib_module_names)

    alone = packages("import typer; app = typer.Typer(); app.command()(lambda: None); app()")
    assert packages("from blocksar.cli import main; main()") - alone == {"blocksar"}


def test_a_product_without_a_name_has_that_of_its_run(api: Calls) -> None:
    for words, name in (
        ("geotiff a/run/", "run.tif"), ("png s3://bucket/runs/night", "night.png"), ("sicd a --out b.nitf", "b.nitf")
    ):  # fmt: skip
        assert run("export", *words.split()).exit_code == 0
        assert api.seen["export"][0][2] == name
