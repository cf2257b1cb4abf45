"""Room on the disk: what is written takes what was predicted, and what would not fit is refused before it begins."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from faults import digests
from scenes import scene, write_store

import blocksar
from blocksar import api
from blocksar.api import focusing
from blocksar.application import rehearsing
from blocksar.application.rehearsing import needed
from blocksar.errors import NoRoom, in_python
from blocksar.places import place
from blocksar.places.local import LocalPlace
from blocksar.progress import Listener
from blocksar.texts import size_text

SCENE: dict[str, Any] = {
    "swath": [29700.0, 30300.0],
    "prf": 4000.0,
    "duration": 0.2,
    "steering": (48.0, 52.0),
    "dwell": 0.05,
    "more": '[[targets]]\nname = "P"\nrange = 30000.0\nyaw_deg = 50.0\n',
}
SETTINGS: dict[str, Any] = {"coefficients": "closed-form", "workers": 0, "blocks": 3}
METADATA = 600e3  # bytes, of a run, at most: coordinates, receipts, and files that end within a page
PART = ((15900.0, 16500.0, 1.0), (18700.0, 19300.0, 1.0))
PARTLY: dict[str, Any] = {**SETTINGS, "grid": PART}


class Most(Listener):
    """The most that a folder takes while units end."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.bytes = place(folder), 0

    def update(self, stage: str, done: int, total: int) -> None:
        self.bytes = max(self.bytes, self.folder.taken())


class Stop(Listener):
    """Interrupts a run once a stage is done."""

    def __init__(self, stage: str) -> None:
        self.stage = stage

    def update(self, stage: str, done: int, total: int) -> None:
        if stage == self.stage and done == total:
            raise KeyboardInterrupt


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_store(tmp_path_factory.mktemp("room"), **SCENE)


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_store(tmp_path_factory.mktemp("raw"), raw=True, **SCENE)


@pytest.fixture
def free(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Sets what is free on every disk."""
    return lambda size: monkeypatch.setattr(LocalPlace, "free", lambda _: size)


@pytest.fixture
def needs(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """What each run needs, as it is checked, bytes."""
    seen: list[int] = []

    def check(job: Any, beside: Any, *, resumed: bool) -> None:
        seen.append(needed(job, beside, resumed=resumed))
        rehearsing.check_room_for_run(job, beside, resumed=resumed)

    monkeypatch.setattr(focusing, "check_room_for_run", check)
    return seen


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"raw": True, "discard": True, "grid": PART},
        {"raw": True, "processor": "backprojection", "grid": PART},
    ],
    ids=str,
)  # fmt: skip
def test_a_run_takes_what_was_predicted(
    settings: dict[str, Any], store: Path, raw: Path, needs: list[int], tmp_path: Path
) -> None:
    source: Any = raw if settings.pop("raw", False) else store
    most = Most(tmp_path / "run")
    blocksar.focus(source, tmp_path / "run", progress=most, **of_processor(SETTINGS | settings))
    assert needs[0] == pytest.approx(most.bytes, rel=0.02, abs=METADATA)


def of_processor(settings: dict[str, Any]) -> dict[str, Any]:
    """The settings that a processor has."""
    others = ("blocks", "coefficients") if "backprojection" in settings.get("processor", "") else ()
    return {name: value for name, value in settings.items() if name not in others}


def refusal(source: Any, out: Path, **settings: Any) -> str:
    """The message about a run that does not fit, of which nothing is left."""
    before = digests(out) if out.exists() else None
    with pytest.raises(NoRoom) as refused:
        blocksar.focus(source, out, **of_processor(SETTINGS | settings))
    assert (digests(out) if out.exists() else None) == before
    return str(refused.value)


@pytest.mark.slow
def test_what_would_make_a_run_fit_does(store: Path, needs: list[int], free: Any, tmp_path: Path) -> None:
    """At any size of the disk all options that make it fit are named, and no others."""
    run, sizes = tmp_path / "run", {}
    exact = "processor hierarchical-backprojection, as exact as is asked for, any geometry,"
    variants: dict[str, Any] = {"": {}, "blocks 1": {"blocks": 1}, exact: {"processor": "hierarchical-backprojection"}}
    free(0)
    for name, settings in variants.items():
        for discard in (False, True):
            refusal(store, run, grid=PART, discard=discard, **settings)
            sizes[name, discard] = needs[-1]
    for size in (*sizes.values(), min(sizes.values()) - 1):
        if size >= sizes["", False]:
            continue
        named = []
        for name in variants:
            discard = sizes[name, False] > size
            if sizes[name, discard] <= size:
                words = f"{name} discard=True".strip() if discard else name
                named.append(f"{words} ({size_text(sizes[name, discard])})")
        free(size)
        said = refusal(store, run, grid=PART)
        assert said.startswith(f"{run} needs {size_text(sizes['', False])} of disk, and {size_text(size)} are free ")
        remedy = f"{' or '.join(named)} would fit; else" if named else "no option but a smaller grid makes it fit:"
        assert said.endswith(f"; {remedy} make room, or choose another out")
    free(sizes["blocks 1", True])
    blocksar.focus(store, run, **PARTLY | {"blocks": 1, "discard": True})
    assert blocksar.info(run).result["facts"]["state"].startswith("finished")


@pytest.mark.slow
def test_a_rehearsal_says_the_same(store: Path, needs: list[int], free: Any, tmp_path: Path) -> None:
    free(12 << 20)
    said = refusal(store, tmp_path / "run")
    rehearsed = blocksar.focus(store, tmp_path / "run", dry_run=True, **SETTINGS).summary
    (line,) = [line for line in rehearsed if line.startswith("would write")]
    figure, remedy = re.search(r"needs (.*) of disk.*?; (.*)", said).groups()  # type: ignore[union-attr]
    assert f"about {figure}, of 12.0 MiB free, which is too little: discard=True (" in in_python(line)
    assert in_python(line).endswith(remedy)


@pytest.mark.slow
def test_a_resumed_run_needs_what_is_not_there(store: Path, needs: list[int], free: Any, tmp_path: Path) -> None:
    run = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        blocksar.focus(store, run, progress=Stop("focus"), **PARTLY)
    there = place(run).taken()
    free(0)
    said = refusal(store, run, grid=PART)
    assert needs[1] == pytest.approx(needs[0] - there, abs=4096) and needs[1] < needs[0] / 2
    assert "blocks" not in said and "processor" not in said  # they are those that the run began with
    free(needs[1])
    blocksar.focus(store, run, **PARTLY)
    assert "nothing to do" in blocksar.focus(store, run, **PARTLY).summary[0]


@pytest.mark.slow
def test_an_earlier_run_stays_until_the_new_input_is_read(
    store: Path, needs: list[int], free: Any, tmp_path: Path
) -> None:
    """Of as many blocks, the new one then takes the place of the earlier one."""
    run = tmp_path / "run"
    blocksar.focus(store, run, **PARTLY)
    blocksar.focus(store, run, overwrite=True, fidelity=0.99, **PARTLY)
    free(round(0.99 * needs[1]))  # the plan, which is kept, differs by some bytes
    assert 0 < needs[1] < 0.55 * needs[0]
    refusal(store, run, grid=PART, overwrite=True)
    assert blocksar.info(run).result["facts"]["state"].startswith("finished")


@pytest.mark.slow
def test_all_channels_must_fit(needs: list[int], free: Any, tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(f'channels = ["HH", "HV"]\n{scene(**SCENE)}')
    both = blocksar.simulate(tmp_path / "scene.toml", tmp_path / "ph.zarr")
    run = tmp_path / "run"
    free(0)
    refusal(both, run, grid=PART)
    whole = needs[-1]
    free(whole - 1)
    assert "discard=True (" in refusal(both, run, grid=PART)
    free(whole)
    most = Most(run)
    blocksar.focus(both, run, progress=most, **PARTLY)
    assert whole == pytest.approx(most.bytes, rel=0.02, abs=2 * METADATA)
    assert needs[-1] == pytest.approx(whole / 2, rel=0.01)
    free(0)
    refusal(both, run, grid=PART, overwrite=True, fidelity=0.99)


@pytest.mark.parametrize("command", ["simulate", "write", "autofocus", "demo", "focus"])
def test_other_commands_check_the_disk_before_they_write(command: str, store: Path, free: Any, tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(scene(**SCENE))
    out = tmp_path / "out"
    start: Any = {
        "simulate": lambda: blocksar.simulate(tmp_path / "scene.toml", out),
        "write": lambda: blocksar.write(blocksar.open(store).copy(), out),
        "autofocus": lambda: blocksar.autofocus(store, out, workers=0),
        "demo": lambda: api.demo(out, workers=0),
        "focus": lambda: blocksar.focus(store, out, autofocus=True, **SETTINGS),
    }[command]
    samples = sum(path.stat().st_size for path in (store / "signal" / "c").rglob("*") if path.is_file())
    free(samples - 1)
    with pytest.raises(NoRoom, match=r"out needs .* of disk, and .* are free there; .*make room, or choose another"):
        start()
    assert not [path for path in tmp_path.iterdir() if path.name.startswith("out")]
    if command in ("simulate", "write"):
        free(samples)
        start()


def test_an_object_store_has_no_such_limit() -> None:
    assert place("s3://bucket/run").free() is None
