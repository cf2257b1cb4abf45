"""The first day in Python: a script of fifteen lines, and the most likely mistakes with what the page says of each."""

from __future__ import annotations

import pickle
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arrays import arrays
from repository import ROOT

import blocksar
from blocksar.errors import InputError

PAGE = (ROOT / "blocksar" / "api" / "README.md").read_text(encoding="utf-8")
README = (ROOT / "README.md").read_text(encoding="utf-8")
SCRIPT = re.search(r"^```python\n(.*?)^```$", README, re.M | re.S)[1]  # type: ignore[index]
TABLE = dict(re.findall(r"^\| ([^|]+) \| `([^`|]+)`[^|]*\|$", PAGE, re.M))


def test_fifteen_lines_lead_from_arrays_to_a_picture() -> None:
    """They are run as the page's Python is."""
    statements = len(compile(SCRIPT, "script.py", "exec", flags=0x400).body)  # type: ignore[attr-defined]  # only the tree
    assert statements <= 15 and "__main__" not in SCRIPT


def changed(**changes: Callable[[Any], Any]) -> dict[str, Any]:
    given = arrays()
    return {**given, **{name: change(given[name]) for name, change in changes.items()}}


def dates(time: Any) -> Any:
    return np.datetime64("2026-01-01") + (time * 1e9).astype("timedelta64[ns]")


def other_settings(folder: Path) -> None:
    dataset = blocksar.collection(**arrays())
    blocksar.focus(dataset, folder, grid="-10:10:1,-10:10:1", workers=0)
    blocksar.focus(dataset, folder, grid="-10:10:1,-10:10:1", workers=0, blocks=1)


MISTAKES: dict[str, Callable[[Path], Any]] = {
    "samples transposed": lambda _: blocksar.collection(**changed(signal=np.transpose)),
    "magnitudes instead of complex samples": lambda _: blocksar.collection(**changed(signal=abs)),
    "frequencies with the carrier in them": lambda _: blocksar.collection(
        **changed(range_frequency=lambda f: f + 10e9)
    ),
    "positions in kilometres": lambda _: blocksar.collection(**changed(antenna_position=lambda p: p / 1e3)),
    "times as dates": lambda _: blocksar.collection(**changed(time=dates)),
    "angles in degrees": lambda _: blocksar.collection(**changed(beam_width=lambda w: 60 * 57.295 * w)),
    "no reference range": lambda _: blocksar.collection(**changed(reference_range=lambda r: 0.0)),
    "no grid although the beam is not steered": lambda folder: blocksar.focus(
        blocksar.collection(**arrays(steered=False)), folder
    ),
    "the array itself given to `focus`": lambda folder: blocksar.focus(arrays()["signal"], folder),
    "other settings in the folder of a run": other_settings,
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_answered_as_the_page_says(mistake: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        MISTAKES[mistake](tmp_path / "run")
    assert str(caught.value).replace(str(tmp_path / "run"), "RUN") == TABLE[mistake]
    assert mistake == "other settings in the folder of a run" or not (tmp_path / "run").exists()


@pytest.mark.slow
def test_the_sign_of_the_phase_is_doubted() -> None:
    wrong = blocksar.collection(**changed(signal=np.conj))
    assert blocksar.check(wrong).summary[0].startswith(TABLE["the sign of the phase"].removesuffix(" ..."))


@pytest.mark.slow
def test_times_in_milliseconds_are_doubted(tmp_path: Path) -> None:
    """All of them: the image would be the same, but not the times of products."""
    slow = changed(time=lambda t: 1e3 * t)
    said = "antenna_position moves at 0.15 m/s, 4400 m above the ground, which no aircraft does: time looks like ms"
    settings: dict[str, Any] = {"grid": "-10:10:1,-10:10:1", "workers": 0}
    assert any(said in line for line in blocksar.plan(blocksar.collection(**slow), **settings).summary)
    focused = blocksar.focus(blocksar.collection(**slow), tmp_path / "run", **settings)
    assert any(said in line for line in focused.result["warnings"])
    assert not any("looks like ms" in line for line in blocksar.plan(blocksar.collection(**arrays())).summary)


def test_the_page_lists_no_other_mistakes() -> None:
    assert set(TABLE) == {*MISTAKES, "the sign of the phase", "`focus` in a script without main guard"}


@pytest.mark.slow
def test_a_report_of_a_run_stands_for_its_folder(tmp_path: Path) -> None:
    run = blocksar.focus(blocksar.collection(**arrays()), tmp_path / "run", grid="-45:45:0.5,-45:45:0.5", workers=0)
    assert blocksar.open(run).sizes == {"y": 180, "x": 180}
    listed = [{"name": "A", "x": 0.0, "y": 0.0}]
    assert [t["name"] for t in blocksar.quality(run, targets=listed).result["targets"]] == ["A"]
    for targets, message in (
        ([(0, 0)], r"target \(0, 0\) cannot be read; give it name"),
        (5, r"targets is a int; give"),
    ):
        with pytest.raises(InputError, match=message):
            blocksar.quality(run, targets=targets)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda path: blocksar.focus(path, path, procesor="auto"), "no argument 'procesor'; did you mean proc"),
        (lambda path: blocksar.plan(path, gird="0:1:1,0:1:1"), "plan has no argument 'gird'; did you mean grid"),
        (lambda path: blocksar.collection(carier_frequency=1e10), "'carier_frequency'; did you mean carrier_frequency"),
        (lambda path: blocksar.quality(path, refference=True), "'refference'; did you mean reference"),
        (lambda path: blocksar.ingest("cphd", path, path, overwrit=True), "'overwrit'; did you mean overwrite"),
    ],
)  # fmt: skip
def test_a_misspelt_keyword_is_told_the_nearest(call: Any, sentence: str, tmp_path: Path) -> None:
    dataset = blocksar.collection(**arrays())
    store = blocksar.write(dataset, tmp_path / "ph.zarr")
    with pytest.raises(TypeError, match=sentence) as caught:
        call(store)
    assert isinstance(caught.value, InputError)


@pytest.mark.parametrize(
    "call",
    [
        blocksar.plan, blocksar.info, blocksar.open, blocksar.quality, blocksar.check,
        lambda path: blocksar.focus(path, f"{path}-run", grid="0:1:1,0:1:1"),
        lambda path: blocksar.ingest("cphd", path, f"{path}-out"),
        lambda path: blocksar.ingest(None, path, f"{path}-out"),
        lambda path: blocksar.simulate(f"{path}.toml", f"{path}-out"), blocksar.preview,
    ],
)  # fmt: skip
def test_a_missing_path_is_a_file_that_is_not_found(call: Any, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"does not exist|neither a file") as caught:
        call(tmp_path / "nowhere")
    assert isinstance(caught.value, InputError)
    assert pickle.loads(pickle.dumps(caught.value)).args == caught.value.args
