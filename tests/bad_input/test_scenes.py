"""Scene files with arbitrary content."""

from __future__ import annotations

import contextlib
import gc
import io
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bad_input import EXACT, MANY, NUMBERS, SCENE, Bench, Bomb
from hypothesis import given, settings
from hypothesis import strategies as st

import blocksar
from blocksar.errors import InputError
from blocksar.simulation.scene import Scene

# Scene files


def plan_scene(bench: Bench, content: bytes, kind: str) -> str:
    scene = bench.fresh(".toml")
    scene.write_bytes(content)
    try:
        blocksar.plan(scene, **EXACT)
        outcome = "taken at its word"
    except InputError as error:
        assert "Traceback" not in str(error) and len(str(error)) < 3000
        outcome = "refused"
        out = bench.fresh(".zarr")
        with contextlib.suppress(InputError):
            if Scene.read(scene).n_pulse < 1000:  # a valid scene that cannot be focused may still be simulated
                blocksar.simulate(scene, out)
                shutil.rmtree(out)
        assert not out.exists()
    bench.tally[kind, outcome] += 1
    return outcome


@pytest.mark.slow
@settings(MANY, max_examples=50)
@given(
    place=st.integers(0, len(SCENE) - 1), removed=st.integers(0, 4), text=st.binary(max_size=6),
    again=st.integers(0, len(SCENE) - 1),
)  # fmt: skip
def test_arbitrary_bytes_in_scene_files(bench: Bench, place: int, removed: int, text: bytes, again: int) -> None:
    data = SCENE.encode()
    data = data[:place] + text + data[place + removed :]
    plan_scene(bench, data[:again] + text[::-1] + data[again:], "scene bytes")


SCENE_KEYS = [line.split(" = ")[0] for line in SCENE.splitlines() if " = " in line]
EXTREMES = [
    "1e19",
    "-1e19",
    "1e-19",
    "1e12",
    "-1e5",
    "1e-6",
    "0.0",
    "nan",
    "inf",
    "1e300",
    "1e-300",
    "12345678901234567",
]
TOML = st.one_of(
    NUMBERS.filter(lambda n: n != 10**400).map(repr),
    st.sampled_from([*EXTREMES, "true", "[]", "{}", '""', "1979-05-27", "0x10", "1e400"]),
    st.lists(st.sampled_from(EXTREMES), min_size=2, max_size=3).map(lambda items: f"[{', '.join(items)}]"),
)


@pytest.mark.slow
@settings(MANY, max_examples=50)
@given(key=st.sampled_from(SCENE_KEYS), value=TOML)
def test_arbitrary_values_in_scene_files(bench: Bench, key: str, value: str) -> None:
    lines = [f"{key} = {value}" if line.startswith(f"{key} = ") else line for line in SCENE.splitlines()]
    plan_scene(bench, "\n".join(lines).encode(), "scene values")


SCENES: dict[str, Callable[[Path], Any]] = {
    "empty": lambda path: path.write_bytes(b""),
    "a folder": lambda path: path.mkdir(),
    "a pipe": os.mkfifo,
    "zeros without end": lambda path: path.symlink_to("/dev/zero"),
    "a link to itself": lambda path: path.symlink_to(path.name),
    "absent": lambda path: None,
    "UTF-16": lambda path: path.write_text(SCENE, encoding="utf-16"),
    "deep": lambda path: path.write_text("a = " + "[" * 100_000),
    "deep tables": lambda path: path.write_text(".".join(["a"] * 2000) + " = 1"),
    "an integer of ten thousand digits": lambda path: path.write_text("a = " + "9" * 10_000),
    "a track file that is a pipe": lambda path: beside(path, '[track]\nfile = "pipe"', os.mkfifo),
    "a track file that is a folder": lambda path: beside(path, '[track]\nfile = "pipe"', os.mkdir),
    "a track file without end": lambda path: beside(
        path, '[track]\nfile = "pipe"', lambda p: os.symlink("/dev/zero", p)
    ),
    "a map that is a pipe": lambda path: beside(path, MAP, os.mkfifo),
    "a map without end": lambda path: beside(path, MAP, lambda p: os.symlink("/dev/zero", p)),
    "a map of objects": lambda path: beside(
        path, MAP, lambda p: Path(p).write_bytes(npy(np.array([[Bomb(path.parent / "fuse")]], object)))
    ),
    "a map as zip": lambda path: beside(path, MAP, lambda p: Path(p).write_bytes(npy(np.ones((2, 2)), np.savez))),
    "a map that claims 2^50 pixels": lambda path: beside(path, MAP, claims_too_much),
}
MAP = '[reflectivity]\nfile = "pipe"\nx0 = 0.0\ndx = 1.0\ny0 = 0.0\ndy = 1.0'


def beside(path: Path, table: str, make: Callable[[str], Any]) -> None:
    path.write_text(SCENE + table if "reflectivity" in table else SCENE.replace("[track]", table))
    make(str(path.parent / "pipe"))


def npy(array: Any, save: Callable[..., Any] = np.save) -> bytes:
    file = io.BytesIO()
    save(file, array)
    return file.getvalue()


def claims_too_much(path: str) -> None:
    header = "{'descr': '<f8', 'fortran_order': False, 'shape': (1125899906842624, 1), }".ljust(117) + "\n"
    Path(path).write_bytes(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode() + bytes(800))


def test_invalid_scenes(bench: Bench) -> None:
    def case(make: Callable[[Path], Any]) -> None:
        folder = bench.fresh()
        folder.mkdir()
        make(folder / "scene.toml")
        bench.refused("scenes", blocksar.plan, folder / "scene.toml", listed=True)
        bench.refused("scenes", blocksar.simulate, folder / "scene.toml", folder / "out.zarr", listed=True)
        assert not (folder / "out.zarr").exists() and not (folder / "fuse").exists()

    gc.collect()  # what other tests left: its end, deep in a nested table, would be a RecursionError of theirs
    bench.all({name: lambda make=make: case(make) for name, make in SCENES.items()})


def test_the_number_and_outcomes_of_cases_are_as_expected(bench: Bench, request: pytest.FixtureRequest) -> None:
    bench.check_tally(request, 130, ("taken at its word", "refused"))
