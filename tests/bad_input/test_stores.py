"""Damaged stores, unusual names and links: each is handled, accepted as stated, or refused."""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import shutil
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numcodecs
import numpy as np
import pytest
import xarray as xr
import zarr
from bad_input import (
    CHAIN,
    EXACT,
    JSON,
    LIT,
    MANY,
    OUTCOMES,
    REPLACED,
    ROUNDING,
    Bench,
    Bomb,
    flipped,
    grown,
    listing,
    one_sentence,
    overwritten,
    seeded,
    truncated,
)
from hypothesis import given, settings
from hypothesis import strategies as st

import blocksar
from blocksar import stores
from blocksar.api import focusing
from blocksar.errors import InputError
from blocksar.stores import regions

OUTLIER = 100  # times its neighbours: a sample up to this ratio may be valid


# Files of a store

FILES = [
    "zarr.json",
    *(f"{name}/zarr.json" for name in stores.PHASE_HISTORY),
    *(f"{name}/c/0" for name in stores.PHASE_HISTORY if name not in ("signal", "antenna_position")),
    "antenna_position/c/0/0",
    "signal/c/0/0",
]


def what_it_says(store: Path) -> Any:
    """Return the collection, or None if it cannot be read."""
    try:
        return stores.open_phase_history(store).collection.as_dict()
    except InputError:
        return None


def tolerance(bench: Bench, store: Path) -> float:
    """Return the largest permitted difference between the image of a store and the clean image.

    Only rounding if the metadata agree. Where some pulses differ: twice their share of a dwell, once for the missing
    contribution and once for the wrong one. Unlimited where a value that holds for all pulses differs.
    """
    said, clean = what_it_says(store), what_it_says(bench.store)
    if said is None:
        return ROUNDING  # the store will be refused
    if any(said[name] != clean[name] for name in ("carrier", "beam_width", "ground_height")):
        return np.inf
    if any(said[name].shape != clean[name].shape for name in clean if isinstance(clean[name], np.ndarray)):
        return np.inf
    pulses = np.zeros(clean["time"].size, bool)
    for name in ("reference_range", "antenna_position", "beam_azimuth"):
        pulses |= (said[name] != clean[name]).reshape(pulses.size, -1).any(axis=1)
    # An axis must be uniform to a thousandth of a step, so one changed value has a bounded effect.
    axes = [name for name in ("time", "range_frequency") if (said[name] != clean[name]).any()]
    lit = 2 if pulses.any() else 0  # a changed track may light one pulse more or less at either end of a dwell
    return ROUNDING + 2 * (pulses.sum() + lit) / LIT + (0.02 if axes else 0.0)


SLOW = pytest.mark.slow


@pytest.mark.slow
@pytest.mark.parametrize(
    "damage", [truncated, flipped, pytest.param(overwritten, marks=SLOW), pytest.param(grown, marks=SLOW)]
)
def test_damaged_bytes(damage: Any, bench: Bench) -> None:
    def case(name: str, attempt: int) -> None:
        store = bench.copy()
        damage(store / name, seeded(f"{damage.__name__} {name} {attempt}"))
        if name == "signal/c/0/0":
            bench.attempt(f"bytes {damage.__name__}", store, error=1.0)
        else:
            bench.attempt(f"bytes {damage.__name__}", store, error=tolerance(bench, store))
        shutil.rmtree(store)

    times = 2 if damage in (flipped, overwritten) else 1
    bench.all({f"{name} {i}": lambda name=name, i=i: case(name, i) for name in FILES for i in range(times)})


@pytest.mark.slow
@pytest.mark.parametrize("how", REPLACED)
def test_files_replaced_by_something_else(how: str, bench: Bench) -> None:
    def case(name: str) -> None:
        store = bench.copy()
        REPLACED[how](store / name)
        outcome = bench.attempt("files replaced", store)
        assert outcome == ("the clean image" if how == "a link to the file" else "refused")
        shutil.rmtree(store)

    some = ("zarr.json", "time/zarr.json", "time/c/0", "signal/c/0/0")
    bench.all({name: lambda name=name: case(name) for name in some})


# Samples


def with_values(bench: Bench, name: str, change: Callable[[Any], Any]) -> Path:
    """Copy the store and change a variable's values: `change` edits them in place or returns new ones."""
    store = bench.copy()
    array: Any = zarr.open_array(str(store / name), mode="r+")
    values = array[...]
    changed = change(values)
    array[...] = values if changed is None else changed
    return store


def with_samples(bench: Bench, change: Callable[[Any], Any]) -> Path:
    return with_values(bench, "signal", change)


def lit_samples(bench: Bench) -> Any:
    samples: Any = zarr.open_array(str(bench.store / "signal"), mode="r")[...]
    return np.flatnonzero(samples)


@pytest.mark.slow
def test_one_flipped_bit_of_one_sample(bench: Bench) -> None:
    """Impossible samples count as missing; a changed sample that is still possible changes the image by its share."""
    lit = lit_samples(bench)
    columns = lit.size / LIT

    def case(bit: int, **wanted: Any) -> None:
        place = int(seeded(f"sample {bit}").choice(lit))

        def flip(samples: Any) -> None:
            samples.reshape(-1).view(np.uint64)[place] ^= np.uint64(1 << bit)

        bench.attempt("one flipped bit", with_samples(bench, flip), error=1.5 * OUTLIER / (LIT * columns), **wanted)

    bench.all(
        {f"bit {bit}": lambda bit=bit: case(bit, **EXACT) for bit in (0, 22, 28, 29, 30, 31, 52, 62)}
        | {f"bit {bit}, chain": lambda bit=bit: case(bit, **CHAIN) for bit in (3, 62)}
    )


def rows(value: complex, pulses: Any) -> Callable[[Any], None]:
    def change(samples: Any) -> None:
        samples[pulses] = value

    return change


# Arrays that violate the contract


def altered(bench: Bench, change: Callable[[xr.Dataset], xr.Dataset], **options: Any) -> Path:
    """Write the store as another program would, after a change."""
    with xr.open_zarr(bench.store, consolidated=False) as opened:
        dataset = opened.load()
    path = bench.fresh(".zarr")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # zarr 3 has no specification for some of these data types
        changed = change(dataset.drop_encoding()).drop_encoding()
        changed.to_zarr(path, **{"zarr_format": 3, "consolidated": False, **options})
    return path


def put(where: Any, value: float) -> Callable[[Any], Any]:
    def change(values: Any) -> Any:
        values[where] = value
        return values

    return change


def astray(values: Any, where: int) -> Any:
    """Displace one pulse by the span of the values, and at least by 50 m."""
    values[where] += (1 if where else -1) * max(np.ptp(values), 50.0)
    return values


BAD_VALUES: dict[str, Callable[[Any], Any]] = {
    "one NaN": put(17, np.nan),
    "infinity": put(17, np.inf),
    "one huge": put(17, 1e300),
    "one astray": lambda values: astray(values, len(values) // 3),
    "the last astray": lambda values: astray(values, -1),
    "all huge": lambda values: values + 1e300,
    "zeros": np.zeros_like,
    "backwards": lambda values: values[::-1],
    "jittered": lambda values: values + 0.1 * np.ptp(values) / len(values) * seeded("j").standard_normal(values.shape),
    "a step in the middle": lambda values: values + max(np.ptp(values), 5.0) * (values > np.median(values)),
    "in kilo": lambda values: values * 1e-3,
}
AXES = ("time", "range_frequency")


@pytest.mark.parametrize("name", [*AXES, *stores.TRACK_AND_BEAM])
def test_impossible_values_are_refused(name: str, bench: Bench) -> None:
    def case(what: str) -> None:
        outcome = bench.attempt("bad values", with_values(bench, name, BAD_VALUES[what]), error=np.inf)
        valid = what in ("in kilo", "jittered")  # for an axis
        never = ("one NaN", "infinity", "one huge", "all huge")
        if (name in AXES and not valid) or what in never or "astray" in what:
            assert outcome == "refused"

    bench.all({what: lambda what=what: case(what) for what in BAD_VALUES})


def retyped(name: str, dtype: str) -> Callable[[xr.Dataset], xr.Dataset]:
    def change(dataset: xr.Dataset) -> xr.Dataset:
        variable = dataset[name].variable
        values = variable.values.real if np.dtype(dtype).kind != "c" else variable.values
        return dataset.assign({name: (variable.dims, values.astype(dtype))})

    return change


ALTERED: dict[str, tuple[Callable[[xr.Dataset], xr.Dataset], str]] = {
    "as it is": (lambda d: d, "the clean image"),
    "wider": (retyped("signal", "c16"), "the clean image"),
    "big-endian": (retyped("signal", ">c8"), "the clean image"),
    "time of strings": (retyped("time", "U8"), "refused"),
    "time of booleans": (retyped("time", "?"), "refused"),
    "time as dates": (retyped("time", "M8[ns]"), "refused"),
    "half-precision time": (retyped("time", "f2"), "refused"),
    "dimensions renamed": (lambda d: d.rename(pulse="azimuth"), "refused"),
    "dimensions exchanged": (lambda d: d.rename(pulse="axis", axis="pulse"), "refused"),
    "another dimension": (lambda d: d.expand_dims(channel=2), "refused"),
    "no pulses": (lambda d: d.isel(pulse=slice(0)), "refused"),
    "no frequencies": (lambda d: d.isel(range_frequency=slice(0)), "refused"),
    "one pulse": (lambda d: d.isel(pulse=slice(1)), "refused"),
    "one frequency": (lambda d: d.isel(range_frequency=slice(1)), "refused"),
    "no axes": (lambda d: d.isel(axis=slice(0)), "refused"),
    "signal is echo": (lambda d: d.rename(signal="echo"), "refused"),
    "no attributes": (lambda d: d.drop_attrs(deep=False), "refused"),
    "more variables": (lambda d: d.assign(more=("pulse", d.time.values)), "the clean image"),
    "every other pulse": (lambda d: d.isel(pulse=slice(0, None, 2)), "taken at its word"),
}


@pytest.mark.slow
def test_altered_arrays(bench: Bench) -> None:
    def case(what: str) -> None:
        change, wanted = ALTERED[what]
        error = np.inf if wanted == "taken at its word" else ROUNDING
        assert bench.attempt("altered arrays", altered(bench, change), error=error) == wanted

    bench.all({what: lambda what=what: case(what) for what in ALTERED})


ATTRIBUTES = [
    "carrier_frequency",
    "beam_width",
    "ground_height",
    "title",
    "history",
    "targets",
    "scene",
    "georeference",
]
KEYS = [
    *("shape", "data_type", "chunk_grid", "chunk_key_encoding", "fill_value", "codecs", "attributes"),
    *("dimension_names", "zarr_format", "node_type", "storage_transformers", "consolidated_metadata", "unknown"),
]


def with_metadata(bench: Bench, name: str, change: Callable[[dict[str, Any]], Any]) -> Path:
    store = bench.copy()
    file = store / name / "zarr.json"
    metadata = json.loads(file.read_bytes())
    change(metadata)
    file.write_text(json.dumps(metadata))
    return store


@pytest.mark.slow
@settings(MANY, max_examples=20)
@given(name=st.sampled_from(ATTRIBUTES), value=JSON)
def test_arbitrary_attributes(bench: Bench, name: str, value: Any) -> None:
    store = with_metadata(bench, "", lambda m: m["attributes"].update({name: value}))
    bench.attempt("attributes", store, error=np.inf)
    shutil.rmtree(store)


@pytest.mark.slow
@settings(MANY, max_examples=50)
@given(variable=st.sampled_from(["", *stores.PHASE_HISTORY]), key=st.sampled_from(KEYS), value=JSON)
def test_arbitrary_metadata(bench: Bench, variable: str, key: str, value: Any) -> None:
    store = with_metadata(bench, variable, lambda m: m.update({key: value}))
    error = np.inf if key in ("fill_value", "attributes", "chunk_grid", "data_type") else ROUNDING
    bench.attempt("metadata", store, error=error)
    shutil.rmtree(store)


# Those that are named when a store is opened are in `stores/test_layout.py`.
LIES: dict[str, tuple[str, Callable[[dict[str, Any]], Any]]] = {
    "chunks of 0": ("signal", lambda m: m["chunk_grid"]["configuration"].update(chunk_shape=[0, 0])),
    "2^60 pulses": ("signal", lambda m: m.update(shape=[1 << 60, 53])),
    "pulses by the half": ("time", lambda m: m.update(shape=[200.5])),
    "three dimensions": ("signal", lambda m: m.update(shape=[200, 53, 1])),
    "another separator": (
        "signal",
        lambda m: m.update(chunk_key_encoding={"name": "default", "configuration": {"separator": "."}}),
    ),
    "the other byte order": ("time", lambda m: m["codecs"][0]["configuration"].update(endian="big")),
    "deep": ("", lambda m: m["attributes"].update(title=nested(400))),
}


def nested(depth: int) -> Any:
    value: Any = 1
    for _ in range(depth):
        value = [value]
    return value


@pytest.mark.slow
def test_false_metadata(bench: Bench) -> None:
    def case(what: str) -> None:
        outcome = bench.attempt("lying metadata", with_metadata(bench, *LIES[what]))
        assert outcome == ("the clean image" if what == "deep" else "refused")

    bench.all({what: lambda what=what: case(what) for what in LIES})


TEXTS = {
    "twice the same key": ('"zarr_format"', '"zarr_format": 2, "zarr_format"'),
    "twice the same attribute": ('"carrier_frequency"', '"carrier_frequency": 1e6, "carrier_frequency"'),
    "NaN": ('"ground_height": 0.0', '"ground_height": NaN'),
    "infinity": ('"ground_height": 0.0', '"ground_height": -Infinity'),
    "beyond floats": ('"ground_height": 0.0', '"ground_height": 1e999'),
    "ten thousand digits": ('"ground_height": 0.0', f'"ground_height": {"9" * 10_000}'),
    "nested without end": ('"ground_height": 0.0', f'"ground_height": {"[" * 100_000}'),
    "a lone surrogate": ('"title": "tiny"', '"title": "\\udcff"'),
    "control characters": ('"title": "tiny"', '"title": "\\u0000\\u001b[31m\\n"'),
    "an unfinished string": ('"title": "tiny"', '"title": "tiny'),
    "a comment": ('"title": "tiny"', '/* hello */ "title": "tiny"'),
}


@pytest.mark.slow
def test_malformed_or_unusual_metadata_text(bench: Bench) -> None:
    def case(what: str) -> None:
        store = bench.copy()
        text = (store / "zarr.json").read_text()
        assert TEXTS[what][0] in text
        (store / "zarr.json").write_text(text.replace(*TEXTS[what]))
        bench.attempt("metadata as text", store, error=tolerance(bench, store))

    bench.all({what: lambda what=what: case(what) for what in TEXTS})


def test_a_metadata_file_of_a_terabyte_is_refused(bench: Bench) -> None:
    for name in ("zarr.json", "time/zarr.json"):
        store = bench.copy()
        os.truncate(store / name, 1 << 40)  # a sparse file that takes no disk space
        assert "1099511627776 bytes" in bench.refused("metadata as text", blocksar.plan, store)


# Stores of other kinds


@pytest.mark.slow
@pytest.mark.parametrize("version", [2, 3])
def test_stores_of_other_programs_can_be_focused(version: int, bench: Bench) -> None:
    compressors = [numcodecs.Zlib(1), numcodecs.Blosc(), numcodecs.Zstd(1), numcodecs.BZ2(1), numcodecs.LZMA(preset=0)]
    modern = [zarr.codecs.GzipCodec(level=1), zarr.codecs.BloscCodec(), zarr.codecs.ZstdCodec(level=1)]
    for compressor in compressors if version == 2 else modern:
        encoding = {name: {"compressors": [compressor]} for name in stores.PHASE_HISTORY}
        if version == 2:
            encoding["time"]["filters"] = [numcodecs.Delta("<f8"), numcodecs.Shuffle(8)]
        store = altered(bench, lambda d: d, zarr_format=version, encoding=encoding)
        error = tolerance(bench, store)
        bench.attempt("other programs", store, error=error)
    if version == 3:
        shards = {"signal": {"chunks": (50, 53), "shards": (100, 53)}}
        assert bench.attempt("other programs", altered(bench, lambda d: d, encoding=shards)) == "the clean image"


class Trojan(numcodecs.abc.Codec):
    """A codec that unpickles its input, as an installed package might offer."""

    codec_id = "trojan"

    def encode(self, buf: Any) -> Any:
        return buf

    def decode(self, buf: Any, out: Any = None) -> Any:
        return pickle.loads(buf)


ARMED = {
    "a filter that unpickles": {"filters": [{"id": "pickle"}]},
    "a compressor that unpickles": {"compressor": {"id": "pickle"}},
    "objects": {"dtype": "|O", "fill_value": None, "filters": [{"id": "pickle"}]},
    "strings, pickled": {"dtype": "|O", "fill_value": None, "filters": [{"id": "vlen-utf8"}, {"id": "pickle"}]},
    "a codec of another package": {"filters": [{"id": "trojan"}]},
    "a compressor of another package": {"compressor": {"id": "trojan"}},
    "behind one that is allowed": {"filters": [{"id": "shuffle", "elementsize": 8}, {"id": "trojan"}]},
}


@pytest.fixture
def armed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disable the safety checks of the libraries, so that only those of blocksar protect."""
    monkeypatch.setattr(numcodecs.pickles, "ALLOW_UNSAFE_PICKLE_DECODE", True, raising=False)
    monkeypatch.setitem(numcodecs.registry.codec_registry, "trojan", Trojan)


@pytest.mark.parametrize("variable", ["time", "signal"])
@pytest.mark.parametrize("how", ARMED)
def test_focus_and_plan_unpickle_nothing(how: str, variable: str, armed: None, bench: Bench) -> None:
    store = altered(bench, lambda d: d, zarr_format=2)
    fuse = bench.fresh()
    arm(store / variable, fuse, ARMED[how])
    with contextlib.suppress(InputError):
        blocksar.plan(store)
    assert bench.attempt("armed", store) == "refused"
    bench.refused("armed", blocksar.plan, store)
    assert not fuse.exists()


def arm(variable: Path, fuse: Path, change: dict[str, Any]) -> None:
    metadata = json.loads((variable / ".zarray").read_bytes())
    (variable / ".zarray").write_text(json.dumps({**metadata, "filters": None, "compressor": None, **change}))
    for chunk in variable.iterdir():
        if not chunk.name.startswith(".z"):
            chunk.write_bytes(pickle.dumps(Bomb(fuse)))


@pytest.mark.slow
@pytest.mark.parametrize("how", ARMED)
def test_opening_an_image_unpickles_nothing(how: str, armed: None, bench: Bench) -> None:
    run, fuse = bench.fresh(), bench.fresh()
    blocksar.open(bench.run(**EXACT)).drop_encoding().to_zarr(run / "image.zarr", zarr_format=2, consolidated=False)
    arm(run / "image.zarr" / "x", fuse, ARMED[how])
    bench.refused("armed", blocksar.open, run)
    assert not fuse.exists()


def test_zarr_alone_runs_the_bomb(armed: None, bench: Bench) -> None:
    """Check that the bomb works; the tests above rely on it."""
    store, fuse = altered(bench, lambda d: d, zarr_format=2), bench.fresh()
    arm(store / "time", fuse, ARMED["a codec of another package"])
    with contextlib.suppress(Exception):
        print(zarr.open_array(str(store / "time"), mode="r")[...])
    assert fuse.exists()


def test_codecs_within_shards_are_checked(monkeypatch: pytest.MonkeyPatch, bench: Bench) -> None:
    encoding = {"signal": {"chunks": (50, 53), "shards": (100, 53)}}
    store = altered(bench, lambda d: d, encoding=encoding)
    monkeypatch.setattr(regions, "CODECS", regions.CODECS - {"crc32c"})  # codec of the index
    assert "crc32c" in bench.refused("armed", blocksar.plan, store)
    monkeypatch.setattr(regions, "CODECS", regions.CODECS - {"zstd"})  # codec of the samples
    assert "zstd" in bench.refused("armed", blocksar.plan, store)


# Names

NAMES = [
    *(
        "quo'te\"s",
        "%41%2F",
        "#hash",
        "why?",
        "zip::a",
        "a:b",
        "--out",
        "\u00fcn\u00efc\u00f6d\u00e9 \u222b \U0001f6f0",
    ),
    *(os.fsdecode(b"\xff\xfe"), "x" * 255, "a&b;c|d$(e)`f", "~", "*", "[bold]", "back\\slash", "a\nb", "\x1b[31mred"),
]
PLAIN = [name for name in NAMES if name.isprintable() and len(name) < 100]
URLS = ["file://x", "memory://x", "simplecache::s3://x", "gs://bucket/x"]


@pytest.mark.slow
def test_unusual_names_of_sources_and_runs(bench: Bench) -> None:
    def case(name: str) -> None:
        folder = bench.fresh()
        path, out = Path(shutil.copytree(bench.store, folder / "in" / name)), folder / "out" / name
        outcome = bench.attempt("names", path, out=out)
        assert outcome == "the clean image" or name not in PLAIN
        if outcome == "the clean image":
            assert "nothing to do" in blocksar.focus(path, out, workers=0, **EXACT).summary[0]

    bench.all({repr(name): lambda name=name: case(name) for name in NAMES})


@pytest.mark.parametrize("command", [blocksar.plan, blocksar.quality, lambda path: blocksar.focus(path, "x")])
def test_a_missing_source_is_refused_in_one_line(command: Any, bench: Bench) -> None:
    bench.all(
        {repr(name): lambda name=name: bench.refused("names of nothing", command, bench.room / name) for name in NAMES}
    )


@pytest.mark.slow
def test_relative_names(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """Relative paths as typed: a name that resembles a URL of an unknown scheme is a path."""

    def case(name: str) -> None:
        folder = bench.fresh()
        folder.mkdir()
        monkeypatch.chdir(folder)
        shutil.copytree(bench.store, name)
        out = f"out-{name}" if "/" not in name else f"{name}.out"
        bench.attempt("relative names", name, out=Path(out))
        bench.attempt("relative names", Path(name))

    bench.all({repr(name): lambda name=name: case(name) for name in ["--help", "~", "$HOME", *URLS]})


def test_impossible_names_of_runs_are_refused(bench: Bench) -> None:
    file = bench.fresh()
    file.write_text("x")
    loop = bench.fresh()
    loop.symlink_to(loop.name)
    dangling = bench.fresh()
    dangling.symlink_to("nowhere/at/all")
    pipe = bench.fresh()
    os.mkfifo(pipe)
    names = {
        "too long": bench.room / ("x" * 256),
        "far too long": bench.room / "/".join(["x" * 200] * 30),
        "with a null": bench.room / "a\0b",
        "a file": file,
        "below a file": file / "run",
        "a link to itself": loop,
        "below a link to itself": loop / "run",
        "a link to nowhere": dangling,
        "a pipe": pipe,
        "no name": Path(),
        "a device": Path("/dev/null"),
        "below /proc": Path("/proc/blocksar/run"),
    }
    for name, path in names.items():
        before = os.path.lexists(path) if "\0" not in str(path) else False

        def case(path: Path = path, before: bool = before) -> None:
            bench.refused("impossible names", blocksar.focus, bench.store, path, workers=0, **EXACT)
            assert before == ("\0" not in str(path) and os.path.lexists(path))

        names[name] = case  # type: ignore[assignment]
    bench.all(names)  # type: ignore[arg-type]
    assert file.read_text() == "x"


# Overlapping paths


@pytest.mark.slow
def test_links_to_stores_and_runs_work(bench: Bench) -> None:
    store, run = bench.fresh(".zarr"), bench.fresh()
    store.symlink_to(bench.store)
    assert bench.attempt("links", store) == "the clean image"
    target = bench.finished_run(**EXACT)
    run.symlink_to(target)
    assert "nothing to do" in blocksar.focus(bench.store, run, workers=0, **EXACT).summary[0]
    blocksar.quality(run)
    blocksar.focus(bench.store, run, workers=0, overwrite=True, **EXACT)
    assert run.is_symlink() and bench.difference(target, **EXACT) <= ROUNDING
    bench.tally["links", "the clean image"] += 2


def overlapping(bench: Bench) -> dict[str, tuple[Path, Path]]:
    """Return pairs of source and run of which one lies inside the other."""
    inside = bench.fresh()
    shutil.copytree(bench.store, inside / "input.zarr")
    beside = bench.fresh()
    shutil.copytree(bench.store, beside / "phase_history.zarr")
    named: dict[str, Path] = {}
    for name in ("collection.zarr", "compressed.zarr", "spectrum.zarr", "image.zarr", "patches/0"):
        run = bench.finished_run(**EXACT)
        shutil.rmtree(run / name, ignore_errors=True)
        shutil.copytree(bench.store, run / name)
        named[name] = run
    stores_of = [bench.copy() for _ in range(6)]
    link = bench.fresh()
    link.symlink_to(stores_of[0])
    return {
        "the run is the store": (stores_of[1], stores_of[1]),
        "the run is a link to the store": (stores_of[0], link),
        "the store is given by a link to the run": (link, stores_of[0]),
        "the run in the store": (stores_of[2], stores_of[2] / "run"),
        "the run in a variable": (stores_of[3], stores_of[3] / "signal" / "run"),
        "the run among the chunks": (stores_of[4], stores_of[4] / "signal" / "c" / "0" / "run"),
        "the run is a variable": (stores_of[5], stores_of[5] / "signal"),
        "the store in the run's folder": (inside / "input.zarr", inside),
        "the store in the run's folder, by its usual name": (beside / "phase_history.zarr", beside),
        **{f"the store is the run's {name}": (run / name, run) for name, run in named.items()},
    }


@pytest.mark.parametrize("overwrite", [False, True])
def test_the_input_is_never_changed(overwrite: bool, bench: Bench) -> None:
    def case(source: Path, out: Path) -> None:
        samples = {p: p.read_bytes() for p in sorted(source.rglob("*")) if p.is_file()}
        try:
            blocksar.focus(source, out, workers=0, overwrite=overwrite, **EXACT)
        except InputError as error:
            one_sentence(error)
            outcome = "refused"
        else:
            assert bench.difference(out, **EXACT) <= ROUNDING
            outcome = "the clean image"
        for file, content in samples.items():
            assert file.read_bytes() == content, f"{file} was changed"
        assert stores.open_phase_history(source).read(slice(None), slice(None)).any()
        bench.tally["one in the other", outcome] += 1

    bench.all({name: lambda pair=pair: case(*pair) for name, pair in overlapping(bench).items()})


@pytest.mark.parametrize("wanted", [EXACT, CHAIN], ids=["exact", "chain"])
def test_a_bad_input_leaves_the_old_run_unchanged(wanted: dict[str, Any], bench: Bench) -> None:
    """This also holds with --overwrite, and for errors that appear only when samples are read."""
    bad: dict[str, Path] = {
        "no store": bench.fresh(),
        "no track": bench.copy(),
        "time backwards": with_values(bench, "time", lambda values: values[::-1]),
        "a truncated chunk": bench.copy(),
        "no valid sample": with_samples(bench, rows(np.nan, slice(None))),
        "a chunk that is a pipe": bench.copy(),
    }
    shutil.rmtree(bad["no track"] / "antenna_position")
    chunk = bad["a truncated chunk"] / "signal/c/0/0"
    chunk.write_bytes(chunk.read_bytes()[:1000])
    REPLACED["a pipe"](bad["a chunk that is a pipe"] / "signal/c/0/0")

    def case(source: Path, overwrite: bool) -> None:
        run = bench.finished_run(**wanted)
        before = listing(run)
        options: dict[str, Any] = {"workers": 0, "overwrite": overwrite, **wanted}
        bench.refused("old runs", blocksar.focus, source, run, **options)
        assert listing(run) == before, "the old run was changed"

    bench.all(
        {
            f"{name}, overwrite={overwrite}": lambda source=source, overwrite=overwrite: case(source, overwrite)
            for name, source in bad.items()
            for overwrite in (False, True)
        }
    )


# Permissions

LOCKED = ["", "zarr.json", "time", "time/c", "time/c/0", "signal/zarr.json", "signal/c"]


def test_stores_without_read_permission_are_refused(bench: Bench) -> None:
    with tempfile.TemporaryDirectory() as room:
        os.chmod(room, 0o755)
        paths = [Path(shutil.copytree(bench.store, f"{room}/{i}.zarr")) for i in range(len(LOCKED))]
        for path, name in zip(paths, LOCKED, strict=True):
            os.chmod(path / name, 0)
        said = as_nobody(lambda: [refusal(path, Path(room, "run")) for path in paths])
        for path, name in zip(paths, LOCKED, strict=True):
            os.chmod(path / name, 0o700)
        assert len(said) == len(LOCKED) and all("ermission" in one_sentence(text) for text in said), said
        assert not os.path.lexists(f"{room}/run")
    bench.tally["permission", "refused"] += len(LOCKED)


def refusal(source: Path, out: Path) -> str:
    try:
        blocksar.focus(source, out, client=object(), **EXACT)  # type: ignore[arg-type]
    except InputError as error:
        return str(error)
    except Exception as error:
        return f"{type(error).__name__}\n{error}"
    return "handled\n"


def as_nobody(ask: Callable[[], list[str]]) -> list[str]:
    """Return the messages that an unprivileged user gets; as root, ask in a forked process that drops its rights."""
    if os.geteuid() != 0:
        return ask()
    assert focusing.__name__  # imported before: nobody may write loops into numba's cache
    reading, writing = os.pipe()
    with warnings.catch_warnings(action="ignore", category=DeprecationWarning):  # about forking a process with threads
        child = os.fork()
    if child == 0:
        os.setgroups([])
        os.setgid(65534)
        os.setuid(65534)
        os.write(writing, json.dumps(ask()).encode())
        os._exit(0)
    os.close(writing)
    with open(reading, "rb") as file:
        said = file.read()
    os.waitpid(child, 0)
    return list(json.loads(said))


def test_the_number_and_outcomes_of_cases_are_as_expected(bench: Bench, request: pytest.FixtureRequest) -> None:
    bench.check_tally(request, 250, OUTCOMES)
