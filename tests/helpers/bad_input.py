"""Bad input: hundreds of damaged stores, runs, scene files, names and options passed to the public commands.

Each case must have one of three outcomes. The input is handled: the image equals the clean one, or differs by no more
than the missing or wrong data explain. It is taken at its word: it is valid, though its values differ from the clean
ones. It is refused: one sentence, nothing written.

A traceback, a hang or a changed input is a defect. `-s` prints the table of outcomes.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import shutil
import socket
import stat
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

import blocksar
from blocksar.errors import InputError

SCENE = """
title = "tiny"
[radar]
carrier = 10e9
bandwidth = 40e6
range_sampling = 48e6
prf = 1000.0
[track]
position = [0.0, 0.0, 3000.0]
velocity = [0.0, 100.0, 0.0]
[time]
pulses = 200
[beam]
start_deg = -4.0
stop_deg = 4.0
dwell = 0.06
[scene]
swath = [4960.0, 5140.0]
[[targets]]
name = "P"
range = 5050.0
yaw_deg = 0.0
"""
LIT = 60  # number of pulses in a dwell
GRID = ((4040.0, 4121.0, 3.0), (-40.0, 41.0, 3.0))  # around the target; every pixel has a full dwell
EXACT: dict[str, Any] = {"processor": "backprojection", "grid": GRID}  # a whole run takes 0.1 s
CHAIN: dict[str, Any] = {"blocks": 1, "grid": GRID}  # a whole run takes 0.5 s
OUTCOMES = ("the clean image", "within what is missing or in error", "taken at its word", "refused")
ROUNDING = 1e-5  # difference of images that are equal except for the order of additions

MANY = settings(
    derandomize=True, deadline=None, database=None, suppress_health_check=list(HealthCheck), print_blob=False
)  # fmt: skip


def listing(folder: Path) -> dict[str, tuple[int, int, int]]:
    """Return mode, size and time of modification of everything below a folder; links are not followed."""
    found = {}
    for parent, folders, names in os.walk(folder):
        for name in (*folders, *names):
            status = os.lstat(os.path.join(parent, name))
            folder_like = stat.S_ISDIR(status.st_mode)
            found[os.path.join(parent, name)] = (
                status.st_mode,
                0 if folder_like else status.st_size,
                0 if folder_like else status.st_mtime_ns,
            )
    return found


def one_sentence(error: BaseException | str) -> str:
    text = str(error).encode(errors="backslashreplace").decode()  # as a terminal shows it
    assert text and len(re.sub("x{100,}", "x", text)) < 1000 and text.isprintable(), f"not one plain sentence: {text!r}"
    assert "Traceback" not in text
    return text


@dataclass(repr=False)
class Bench:
    """A clean store and its images; counts the outcomes of all cases."""

    room: Path
    store: Path
    clean: dict[str, Any] = field(default_factory=dict)
    tally: Counter[tuple[str, str]] = field(default_factory=Counter)
    number: Iterator[int] = field(default_factory=itertools.count)

    def fresh(self, suffix: str = "") -> Path:
        return self.room / f"{next(self.number)}{suffix}"

    def copy(self) -> Path:
        return Path(shutil.copytree(self.store, self.fresh(".zarr"), symlinks=True))

    def finished_run(self, **wanted: Any) -> Path:
        """Return a copy of a finished run."""
        return Path(shutil.copytree(self.run(**wanted), self.fresh()))

    def run(self, **wanted: Any) -> Path:
        """Return the run of the clean store, computed on the first call."""
        name = f"clean-{wanted.get('processor', 'chain')}"
        if name not in self.clean:
            blocksar.focus(self.store, self.room / name, workers=0, **wanted)
            self.clean[name] = blocksar.open(self.room / name).image.values
        return self.room / name

    def image(self, **wanted: Any) -> Any:
        return self.clean[self.run(**wanted).name]

    def attempt(
        self, kind: str, source: Any, *, out: Path | None = None, error: float = ROUNDING, **wanted: Any
    ) -> str:
        """Focus a source that may be bad, and return the outcome.

        Parameters
        ----------
        error : float
            Largest permitted difference from the clean image; infinite where the source may be taken at its word.
        """
        wanted = wanted or EXACT
        out = out or self.fresh()
        before = listing(Path(source)) if isinstance(source, str | Path) else {}
        try:
            blocksar.focus(source, out, workers=0, **wanted)
        except InputError as refusal:
            one_sentence(refusal)
            assert not os.path.lexists(out), "refused, but something was written"
            outcome = "refused"
        else:
            difference = self.difference(out, **wanted)
            assert difference <= error, f"the image differs by {difference:g}, more than {error:g}"
            outcome = "the clean image" if difference <= ROUNDING else "within what is missing or in error"
            if error == np.inf and difference > ROUNDING:
                outcome = "taken at its word"
        if before:
            assert listing(Path(source)) == before, "the input was changed"
        self.tally[kind, outcome] += 1
        return outcome

    def difference(self, run: Path, **wanted: Any) -> float:
        image, clean = blocksar.open(run).image.values, self.image(**wanted)
        if image.shape != clean.shape:
            return np.inf
        covered = np.isfinite(image.real)
        lost = np.isfinite(clean.real) & ~covered
        if not covered.any():
            return np.inf
        return np.inf if lost.any() else float(np.abs((image - clean)[covered]).max())

    def refused(self, kind: str, command: Callable[..., Any], *args: Any, listed: bool = False, **kwargs: Any) -> str:
        """Check that a command raises InputError; with `listed`, the message may list many wrong fields of a scene."""
        with pytest.raises(InputError) as caught:
            command(*args, **kwargs)
        self.tally[kind, "refused"] += 1
        text = str(caught.value)
        for line in text.split("\n  ") if listed else [text]:
            one_sentence(line)
        return text

    def check_tally(self, request: pytest.FixtureRequest, least: int, outcomes: Collection[str]) -> None:
        """Print the outcomes of a module's cases; check that there are `least` or more, with exactly these outcomes."""
        collected = {getattr(item, "originalname", None) for item in request.session.items if item.path == request.path}
        if collected != {name for name in vars(request.module) if name.startswith("test_")}:
            pytest.skip("only a part of this file was asked for")
        kinds = sorted({kind for kind, _ in self.tally})
        print("\n" + " " * 24 + "".join(f"{word:>10}" for word in ("clean", "within", "its word", "refused")))
        for kind in kinds:
            print(f"{kind:24}" + "".join(f"{self.tally[kind, outcome]:>10}" for outcome in OUTCOMES))
        assert self.tally.total() >= least
        assert {outcome for _, outcome in self.tally} == set(outcomes) <= set(OUTCOMES)

    def all(self, cases: dict[str, Callable[[], Any]]) -> None:
        """Run every case, then report the defects of all of them together."""
        defects = []
        for name, case in cases.items():
            try:
                case()
            except (Exception, pytest.fail.Exception) as error:
                defects.append(f"{name}: {type(error).__name__}: {str(error)[:300]}")
        assert not defects, f"{len(defects)} of {len(cases)}:\n" + "\n".join(defects)


def seeded(name: str) -> np.random.Generator:
    return np.random.default_rng(list(name.encode()))


def truncated(file: Path, rng: np.random.Generator) -> None:
    data = file.read_bytes()
    file.write_bytes(data[: rng.integers(len(data))])


def overwritten(file: Path, rng: np.random.Generator) -> None:
    data = bytearray(file.read_bytes())
    start = rng.integers(len(data))
    data[start : start + 8] = rng.bytes(min(8, len(data) - start))
    file.write_bytes(data)


def flipped(file: Path, rng: np.random.Generator) -> None:
    data = bytearray(file.read_bytes())
    data[rng.integers(len(data))] ^= 1 << rng.integers(8)
    file.write_bytes(data)


def grown(file: Path, rng: np.random.Generator) -> None:
    file.write_bytes(file.read_bytes() + rng.bytes(int(rng.integers(1, 100))))


REPLACED: dict[str, Callable[[Path], Any]] = {
    "deleted": lambda file: file.unlink(),
    "empty": lambda file: file.write_bytes(b""),
    "a folder": lambda file: (file.unlink(), file.mkdir()),
    "a link to the file": lambda file: file.symlink_to(file.rename(file.with_name("elsewhere"))),
    "a link to nothing": lambda file: (file.unlink(), file.symlink_to("nothing")),
    "a link to itself": lambda file: (file.unlink(), file.symlink_to(file.name)),
    "a link to zeros without end": lambda file: (file.unlink(), file.symlink_to("/dev/zero")),
    "a link to nothing at all": lambda file: (file.unlink(), file.symlink_to("/dev/null")),
    "a pipe": lambda file: (file.unlink(), os.mkfifo(file)),
    "a socket": lambda file: (file.unlink(), bound(file)),
}


# Metadata

NUMBERS = st.one_of(st.integers(), st.floats(), st.sampled_from([0, -1, 2**31, 2**63, 10**400, 1e308, -0.0]))
JSON = st.recursive(
    st.none() | st.booleans() | NUMBERS | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


# Pickled code


class Bomb:
    """An object that runs code when it is unpickled."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.file),)


def bound(file: Path) -> None:
    with contextlib.chdir(file.parent), socket.socket(socket.AF_UNIX) as s:
        s.bind(file.name)
