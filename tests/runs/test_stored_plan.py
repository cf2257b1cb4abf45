"""The plan in the folder of an unfinished run: what is read is what was written, and nothing else is made of it."""

from __future__ import annotations

import builtins
import os
import pickle
import sys
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import blocksar
from blocksar import stores
from blocksar.errors import FolderError
from blocksar.places import place
from blocksar.processors.base import ImagePlan
from blocksar.runs import stored_plan


@dataclass(frozen=True)
class Kept:
    """Data, and something that is only computed."""

    values: Any

    @cached_property
    def total(self) -> float:
        return float(np.sum(self.values))


class Call:
    """Something whose pickle calls a function."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> Any:
        return self.call


def read(folder: Path, packed: bytes, kind: type = Kept) -> Any:
    stored_plan.write(place(folder), packed)
    return stored_plan.read(place(folder), stores.checksum_bytes(packed), kind)[0]


@pytest.mark.slow
def test_a_plan_is_read_as_it_was_written(tmp_path: Path) -> None:
    for settings in ({"blocks": 2}, {"processor": "backprojection"}):
        plan = blocksar.plan("table1", **settings).plan
        assert plan is not None
        again = read(tmp_path, stored_plan.pack(plan), ImagePlan)
        assert type(again) is type(plan) and again.grid == plan.grid and again.memory(1) == plan.memory(1)
        assert again.blocks() == plan.blocks() and again.stored() == plan.stored()


def test_what_was_only_computed_is_not_kept(tmp_path: Path) -> None:
    plan = Kept(np.arange(5.0))
    before = stored_plan.pack(plan)
    assert plan.total == 10 and stored_plan.pack(plan) == before
    np.testing.assert_array_equal(read(tmp_path, before).values, plan.values)


@pytest.mark.parametrize(
    "values",
    [Call(os.system, "touch made"), Call(builtins.eval, "1"), Call(getattr, "", "join"), Call(Path, "made"),
     Call(__import__, "antigravity"), Path, os.remove],
)  # fmt: skip
def test_nothing_but_data_is_made(values: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FolderError, match=r"damaged: its run\.json does not have the plan .* --overwrite"):
        read(tmp_path, zlib.compress(pickle.dumps(Kept(values))))
    assert not (tmp_path / "made").exists() and "antigravity" not in sys.modules


@pytest.mark.parametrize("packed", [b"", b"text", zlib.compress(b""), zlib.compress(pickle.dumps([1]))])
def test_what_is_no_plan_is_damaged(packed: bytes, tmp_path: Path) -> None:
    with pytest.raises(FolderError, match="damaged"):
        read(tmp_path, packed)


def test_another_plan_than_that_of_the_record_is_damaged(tmp_path: Path) -> None:
    stored_plan.write(place(tmp_path), stored_plan.pack(Kept(1)))
    with pytest.raises(FolderError, match="damaged"):
        stored_plan.read(place(tmp_path), stores.checksum_bytes(stored_plan.pack(Kept(2))), Kept)
    (tmp_path / "plan.bin").unlink()
    with pytest.raises(FolderError, match="damaged"):
        stored_plan.read(place(tmp_path), "", Kept)
