"""The engine of xarray: what it opens equals what `blocksar.open` and the files of a run have."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from once import once
from repository import ROOT
from small_run import Made

import blocksar
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.products.engine import Engine

CODE = """
import json, sys
import xarray as xr
whole, chunked = (xr.open_dataset(sys.argv[1], engine="blocksar", **more) for more in ({}, {"chunks": {}}))
tree = xr.open_datatree(sys.argv[1], engine="blocksar")
guessed = xr.open_dataset(sys.argv[1])
print(json.dumps({
    "engines": list(xr.backends.list_engines()), "peak": float(whole.sel(channel="HV").sar.db().max()),
    "chunked": chunked.image.chunks is not None, "lazy": not whole.image._in_memory,
    "guessed": guessed.sizes == whole.sizes, "groups": sorted(tree.groups),
}))
"""


def focus_channels(folder: Path) -> None:
    """Two channels, HV at half the amplitude of HH, focused by two blocks, and the same by two looks."""
    time = (np.arange(512) - 256) / 800.0
    frequency = (np.arange(160) - 80) * 0.5e6
    track = np.stack([0 * time - 8000.0, 120.0 * time, 0 * time + 5000.0], axis=1)
    reference = np.linalg.norm(track, axis=1)
    distance = np.linalg.norm(track - [2.0, -3.0, 0.0], axis=1)
    signal = np.exp(-4j * np.pi / SPEED_OF_LIGHT * np.outer(distance - reference, 10e9 + frequency))
    common: dict[str, Any] = {
        "time": time, "range_frequency": frequency, "antenna_position": track, "reference_range": reference,
        "carrier_frequency": 10e9,
    }  # fmt: skip
    channels = blocksar.collection(signal=np.stack([signal, signal / 2]), channel=["HH", "HV"], **common)
    options: dict[str, Any] = {"grid": "-48:48:0.8,-48:48:0.8", "workers": 0}
    blocksar.focus(channels, folder / "channels", processor="angular-division", blocks=1, **options)
    blocksar.quality(folder / "channels", targets=[{"name": "T", "x": 2.0, "y": -3.0, "reflectivity": [1, 0]}])
    blocksar.write(blocksar.collection(signal=signal, **common), folder / "ph.zarr")
    blocksar.focus(folder / "ph.zarr", folder / "looks", processor="backprojection", looks=2, **options)


@pytest.fixture(scope="module")
def several(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return once(tmp_path_factory, "engine", focus_channels)


def test_a_dataset_is_that_of_open_lazy_until_chunks_are_asked_for(made: Made) -> None:
    ours, plain = blocksar.open(made.folder), xr.open_dataset(made.folder, engine=Engine)
    assert not plain.image.variable._in_memory and plain.image.chunks is None
    xr.testing.assert_identical(plain, ours)
    assert plain.encoding["source"] == ours.encoding["source"]
    chunked = xr.open_dataset(made.folder, engine=Engine, chunks={}, drop_variables="block")
    assert chunked.image.data.chunksize == (64, 150) and "block" not in chunked  # those of the store
    assert chunked.image.chunk(y=10).data.chunksize == (10, 150)
    np.testing.assert_array_equal(chunked.image.values, made.image)
    xr.testing.assert_identical(chunked.sar.crop(x=(-10, 10)), ours.sar.crop(x=(-10, 10)).drop_vars("block"))
    assert plain.spatial_ref.attrs["grid_mapping_name"] == "transverse_mercator"
    store = xr.open_dataset(made.folder / "image.zarr", engine=Engine)
    xr.testing.assert_identical(store, ours)


def test_a_tree_has_channels_blocks_and_quality(several: Path) -> None:
    run = several / "channels"
    assert xr.open_datatree(run, engine=Engine, chunks={})["/channels/HV"].image.chunks is not None
    tree = xr.open_datatree(run, engine=Engine)
    assert [group for group in tree.groups if not group.endswith(("blocks", "quality"))] == [
        "/", "/channels", "/channels/HH", "/channels/HV",
    ]  # fmt: skip
    assert tree.image.dims == ("channel", "y", "x") and tree.channel.values.tolist() == ["HH", "HV"]
    for name in ("HH", "HV"):
        own = tree[f"/channels/{name}"]
        alone = blocksar.open(run / "channels" / name)
        assert own.to_dataset().drop_vars("channel").identical(alone)
        np.testing.assert_array_equal(own.image.values, tree.image.sel(channel=name).values)
        assert own.to_dataset().sar.db().max() == pytest.approx(-6.02 if name == "HV" else 0.0, abs=1.0)
        planned = json.loads((run / "channels" / name / "run.json").read_text())["plan"]["predicted"]
        blocks = own["blocks"].to_dataset(inherit=False)
        assert blocks.block.values.tolist() == ["0"] and blocks.number.values.tolist() == [0]
        for figure in ("coherence", "residual_phase", "yaw", "range"):
            np.testing.assert_array_equal(blocks[figure].values, [block[figure] for block in planned])
        assert blocks.part.item() == -1 and blocks.yaw.dims == ("block", "end") and blocks.yaw.units == "rad"
    measured = tree["/channels/HH/quality"].to_dataset(inherit=False)  # of the first channel, as by default
    (told,) = json.loads((run / "channels/HH/quality.json").read_text())["targets"]
    assert measured.target.values.tolist() == ["T"] and measured.target_x.item() == 2 and measured.full_dwell.all()
    assert measured.value.item() == complex(*told["value"]) and measured.value.units == "1"
    assert measured.range_pslr.item() == told["range_pslr"]
    assert [measured[name].units for name in ("range_pslr_theory", "azimuth_irw_theory", "error_x")] == ["dB", "m", "m"]


def test_a_tree_has_sub_apertures(several: Path) -> None:
    tree = xr.open_datatree(several / "looks", engine=Engine)
    assert set(tree["/looks"].children) == {"look-1", "look-2"} and tree.image.dims == ("look", "y", "x")
    np.testing.assert_array_equal(tree["/looks/look-2"].image.values, tree.image.sel(look="look-2").values)
    groups = xr.open_groups(several / "looks", engine=Engine)
    assert set(groups) == set(tree.groups) - {"/looks"}


@pytest.mark.slow
def test_the_engine_is_known_by_its_name_and_brings_the_accessor(several: Path, tmp_path: Path) -> None:
    """In a process of its own, which finds the entry points of this version, and imports nothing of blocksar."""
    told = tmp_path / "blocksar-0.dist-info"
    told.mkdir()
    (told / "METADATA").write_text("Metadata-Version: 2.1\nName: blocksar\nVersion: 0\n")
    points = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["entry-points"]
    lines = [
        line for group, parts in points.items() for line in (f"[{group}]", *(f"{a} = {b}" for a, b in parts.items()))
    ]
    (told / "entry_points.txt").write_text("\n".join(lines))
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}
    words = [sys.executable, "-c", CODE, str(several / "channels")]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    said = json.loads(done.stdout)
    assert "blocksar" in said["engines"] and said["peak"] == pytest.approx(-6.02, abs=1.0)
    assert said["chunked"] and said["lazy"] and said["guessed"] and "/channels/HH/quality" in said["groups"]


@pytest.mark.slow
def test_the_engine_loads_nothing_before_it_is_asked() -> None:
    code = (
        "import sys, blocksar.products.engine as e; e.Engine().guess_can_open('a.nc');"
        "print([name for name in sys.modules if name.startswith('blocksar.')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not [room for room in ("stores", "collection", "runs", "places") if f"blocksar.{room}" in done.stdout]


def test_what_is_no_finished_run_is_refused(made: Made, tmp_path: Path) -> None:
    unfinished = tmp_path / "run"
    unfinished.mkdir()
    (unfinished / "run.json").write_text('{"status": "unfinished"}')
    for opened in (xr.open_dataset, xr.open_datatree):
        with pytest.raises(InputError, match="is not finished; run `blocksar focus` again"):
            opened(unfinished, engine=Engine)
    with pytest.raises(InputError, match=r"image\.zarr is the image alone; give the folder of its run"):
        xr.open_datatree(made.folder / "image.zarr", engine=Engine)
    damaged = tmp_path / "damaged"
    damaged.mkdir()
    for path in made.folder.iterdir():
        (damaged / path.name).symlink_to(path)
    (damaged / "quality.json").write_text('{"targets": [{}]}')
    with pytest.raises(InputError, match=r"quality.json is damaged .*; run `blocksar quality "):
        xr.open_datatree(damaged, engine=Engine)
