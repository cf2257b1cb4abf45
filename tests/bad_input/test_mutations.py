"""Random damage to unfinished runs and to CPHD files: refused in one sentence, or without effect."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bad_input import (
    CHAIN,
    REPLACED,
    Bench,
    flipped,
    grown,
    one_sentence,
    overwritten,
    truncated,
)

import blocksar
from blocksar.errors import InputError, ProcessingError
from blocksar.processors.chain.tasks import stages

pytestmark = pytest.mark.slow

FEW, MANY = 8, 600  # cases by default, and with -m slow
BYTES = (flipped, grown, overwritten, truncated)
VALUES = [None, True, -1, 0, 2.5, 1e300, 10**30, "", "../..", "/dev/zero", [], [None], {}, {"a": 1}]


def seeds(test: Callable[..., None]) -> Callable[..., None]:
    """Parametrise a test by seed: a few by default."""
    return pytest.mark.parametrize(
        "first", [0, pytest.param(FEW, marks=[pytest.mark.slow, pytest.mark.timeout(1800)])]
    )(test)


def cases(first: int) -> range:
    return range(first, MANY if first else FEW)


@pytest.fixture(scope="module")
def unfinished(bench: Bench) -> Path:
    """A run that was interrupted before its mosaic."""

    def interrupted(*_: Any, **__: Any) -> Any:
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch, contextlib.suppress(KeyboardInterrupt):
        patch.setattr(stages, "mosaic", interrupted)
        blocksar.focus(bench.store, bench.room / "unfinished", workers=0, **CHAIN)
    return bench.room / "unfinished"


def alter_json(file: Path, rng: np.random.Generator) -> None:
    """Give a random member of a random object another value."""
    content = json.loads(file.read_bytes())
    node = content
    while True:
        key = list(node)[rng.integers(len(node))] if isinstance(node, dict) else int(rng.integers(len(node)))
        if isinstance(node[key], dict | list) and node[key] and rng.random() < 0.7:
            node = node[key]
            continue
        node[key] = VALUES[rng.integers(len(VALUES))]
        break
    file.write_text(json.dumps(content))


def damage(folder: Path, rng: np.random.Generator) -> str:
    """Damage a random file; metadata and receipts as often as samples."""
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    small = [file for file in files if file.suffix == ".json"]
    chosen = small if rng.random() < 0.8 else files
    file = chosen[rng.integers(len(chosen))]
    kind = rng.random()
    if kind < 0.5 and file.suffix == ".json":
        how: Any = alter_json
        how(file, rng)
    elif kind < 0.85:
        how = BYTES[rng.integers(len(BYTES))]
        how(file, rng)
    else:
        how = sorted(REPLACED)[rng.integers(len(REPLACED))]
        REPLACED[how](file)
    return f"{file.relative_to(folder)}: {how if isinstance(how, str) else how.__name__}"


@seeds
def test_unfinished_runs(first: int, bench: Bench, unfinished: Path) -> None:
    """The next run finishes with the right image, or says what is wrong; so does the one after it."""
    clean = bench.image(**CHAIN)

    def case(seed: int) -> None:
        rng = np.random.default_rng(seed)
        run = Path(shutil.copytree(unfinished, bench.fresh(), symlinks=True))
        what = damage(run, rng)
        for _ in range(2):
            try:
                blocksar.focus(bench.store, run, workers=0, **CHAIN)
            except (InputError, ProcessingError) as error:
                one_sentence(error)
                outcome = "refused"
            else:
                np.testing.assert_array_equal(blocksar.open(run).image.values, clean, what)
                outcome = "the clean image"
                break
        bench.tally["unfinished runs", outcome] += 1
        shutil.rmtree(run)

    bench.all({f"seed {seed}": lambda seed=seed: case(seed) for seed in cases(first)})


@pytest.fixture(scope="module")
def product(bench: Bench) -> Path:
    return Path(blocksar.simulate(bench.room / "scene.toml", bench.room / "clean.cphd", cphd=True))


@seeds
def test_cphd_files(first: int, bench: Bench, product: Path) -> None:
    """The header and the XML are damaged as often as the vectors and the samples."""
    whole = product.read_bytes()
    text = whole.index(b"</CPHD>") + 7

    def case(seed: int) -> None:
        rng = np.random.default_rng(seed)
        data = bytearray(whole)
        for _ in range(int(rng.integers(1, 4))):
            end = text if rng.random() < 0.7 else len(data)
            start = int(rng.integers(end))
            match int(rng.integers(3)):
                case 0:
                    data[start] ^= 1 << int(rng.integers(8))
                case 1:
                    data[start : start + 4] = rng.bytes(4)
                case 2:
                    del data[start : start + int(rng.integers(1, 40))]
        file, out = bench.fresh(".cphd"), bench.fresh(".zarr")
        file.write_bytes(data)
        try:
            blocksar.ingest("cphd", file, out)
        except InputError as error:
            one_sentence(error)
            assert not os.path.lexists(out)
            outcome = "refused"
        else:
            outcome = "taken at its word"
            shutil.rmtree(out)
        bench.tally["CPHD", outcome] += 1
        file.unlink()

    bench.all({f"seed {seed}": lambda seed=seed: case(seed) for seed in range(first, MANY if first else 4 * FEW)})
