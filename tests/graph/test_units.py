"""Both executors run the same units to the same receipts, and raise the same errors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from distributed import Client

from blocksar import stores
from blocksar.errors import InputError, ProcessingError
from blocksar.graph.units import Executor, OnCluster, ThisProcess, Unit
from blocksar.places import place
from blocksar.progress import Listener
from blocksar.runs.receipts import Run
from blocksar.runs.record import Receipt


class Events(Listener):
    """Keeps what it hears of stages."""

    def __init__(self) -> None:
        self.heard: list[tuple[Any, ...]] = []

    def begin(self, stage: str, reused: int = 0) -> None:
        self.heard.append((stage, reused))

    def update(self, stage: str, done: int, total: int) -> None:
        self.heard.append((stage, done, total))


@pytest.fixture(params=["here", "dask"])
def executor(request: pytest.FixtureRequest) -> Executor:
    return ThisProcess(Events()) if request.param == "here" else OnCluster(request.getfixturevalue("client"), Events())


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return Run(folder=place(tmp_path), identity="x", threads=1)


def give(run: Run, unit: str, value: int) -> int:
    return value


def double(run: Run, unit: str, value: int) -> int:
    return 2 * value


def add(run: Run, unit: str, first: int, second: int, more: int) -> Receipt:
    """Write the sum to a file."""
    data = f"{first + second + more}".encode()
    (run.folder / unit).write_bytes(data)
    return Receipt(unit=unit, stage="add", seconds=100.0, files={unit: stores.checksum_bytes(data)})


def sums(run: Run) -> list[Unit]:
    """Two units, 2 * 3 + 4 + 5 and 2 * 6 + 7 + 8, each with tasks before it."""
    units = []
    for name, (doubled, plain, more) in {"a": (3, 4, 5), "b": (6, 7, 8)}.items():
        given = Unit("give", run, name, give, (doubled,))
        before = Unit("double", run, name, double, after=(given,)), Unit("keep", run, name, give, (plain,))
        units.append(Unit("add", run, name, add, (more,), before))
    return units


def test_units_run_after_others_and_leave_receipts(executor: Executor, run: Run) -> None:
    receipts = executor.run_units("adding", sums(run))
    assert [receipt.unit for receipt in receipts] == ["a", "b"]
    assert [(run.folder / name).read_bytes() for name in "ab"] == [b"15", b"27"]
    assert [run.receipt(name) for name in "ab"] == receipts
    # What was done before a task counts in its unit's time.
    assert all(100 < receipt.seconds < 200 and receipt.peak_memory for receipt in receipts)
    assert executor.listener.heard == [  # type: ignore[attr-defined]
        ("adding", 0), ("adding", 0, 2), ("adding", 1, 2), ("adding", 2, 2),
    ]  # fmt: skip


def test_receipts_are_the_log(executor: Executor, run: Run) -> None:
    """Of what is there already, only what is damaged is done again."""
    first = executor.run_units("adding", sums(run))
    (run.folder / "b").write_bytes(b"0")
    executor.listener.heard.clear()  # type: ignore[attr-defined]
    again = executor.run_units("adding", sums(run))
    assert (run.folder / "b").read_bytes() == b"27"
    assert [(receipt.reused, receipt.damaged) for receipt in again] == [(True, False), (False, True)]
    assert again[0].seconds == first[0].seconds
    assert executor.listener.heard == [  # type: ignore[attr-defined]
        ("check-adding", 0), ("check-adding", 1, 2), ("check-adding", 2, 2),
        ("adding", 1), ("adding", 1, 2), ("adding", 2, 2),
    ]  # fmt: skip
    other = Run(folder=run.folder, identity="y", threads=1)
    assert not any(receipt.reused for receipt in executor.run_units("adding", sums(other)))


def refuse(run: Run, unit: str, error: type[Exception]) -> Receipt:
    raise error("no good")


@pytest.mark.parametrize(
    ("error", "more", "raised", "text"),
    [
        (InputError, {"reads_input": True}, InputError, "^no good$"),
        (InputError, {}, ProcessingError, "^trying of a failed: InputError: no good$"),
        (ProcessingError, {}, ProcessingError, "^no good$"),
        (OSError, {}, ProcessingError, "^trying of a failed: OSError: no good$"),
        (OSError, {"title": "step of block 1"}, ProcessingError, "^step of block 1 failed: OSError: no good$"),
        (InputError, {"title": "step of block 1"}, ProcessingError, "^step of block 1 failed: no good$"),
    ],
)
def test_errors_name_what_failed(
    executor: Executor, run: Run, error: Any, more: dict[str, Any], raised: Any, text: str
) -> None:
    with pytest.raises(raised, match=text):
        executor.run_units("trying", [Unit("try", run, "a", refuse, (error,), **more)])
    assert run.receipt("a") is None


def test_an_error_before_a_unit_is_that_of_the_unit(executor: Executor, run: Run) -> None:
    before = Unit("try", run, "a", refuse, (OSError,), title="step of block 1")
    with pytest.raises(ProcessingError, match=r"^step of block 1 failed: OSError: no good$"):
        executor.run_units("adding", [Unit("add", run, "a", double, after=(before,), title="step 2 of block 1")])


def test_the_scheduler_sees_units_in_flight_only(client: Client, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Samples pass from task to task within workers, and so many units are under way as were planned for."""
    events, flight = Events(), []
    monkeypatch.setattr(events, "watch", lambda units, workers: flight.append((len(units), workers.number)))
    units = [Unit("give", run, f"{number}", give, (number,)) for number in range(12)]
    found = dict(OnCluster(client, events).execute("giving", units, per_worker=2))
    assert found == {f"{number}": number for number in range(12)}
    assert max(n for n, _ in flight) == 4 and flight[-1] == (0, 2)
