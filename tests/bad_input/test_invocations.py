"""Wrong options and files of every command: one sentence, exit status 2, nothing written."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from bad_input import EXACT, SCENE, Bench, listing
from typer.testing import CliRunner

import blocksar
from blocksar.cli import commands

GRID, AWAY = "4040:4121:3,-40:41:3", "9040:9121:3,-40:41:3"
FOCUS = f"focus ph.zarr --out new --workers=0 --processor=backprojection --grid={GRID}"


def heights(values: object, *, name: str = "height", x: object = None) -> Callable[[Path], object]:
    """Write a zarr store of heights about the scene."""
    z = np.broadcast_to(np.asarray(values), (9, 9))
    along = np.linspace(3900, 4300, 9) if x is None else x

    def write(path: Path) -> object:
        made = xr.Dataset({name: (("y", "x"), z)}, coords={"x": along, "y": np.linspace(-200, 200, 9)})
        return made.to_zarr(path, zarr_format=3, consolidated=False)

    return write


def text(content: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(content)


FILES: dict[str, Callable[[Path], object]] = {
    "text.txt": text("hello\n"),
    "folder": os.mkdir,
    "two.json": text('[1, "two"]'),
    "some.tif": lambda path: path.write_bytes(b"II*\x00" + bytes(100)),
    "holes.zarr": heights(np.nan),
    "peaks.zarr": heights(1e6),
    "complex.zarr": heights(1j),
    "letters.zarr": heights("a"),
    "nameless.zarr": heights(0.0, name="z"),
    "away.zarr": heights(0.0, x=np.linspace(0, 100, 9)),
    "uneven.zarr": heights(0.0, x=np.linspace(60, 66, 9) ** 2),
}  # fmt: skip

# The command, and words of its message: the field, the value, and what to do.
CASES = {
    "plan ph.zarr --weighting=taylor:99999999:-35": "give a whole number from 2 to 12",
    "plan ph.zarr --looks=33": "looks = 33: give 2 to 32 looks",
    "plan ph.zarr --terrain=nothing.tif": "terrain nothing.tif does not exist; check the path",
    "plan ph.zarr --terrain=some.tif": "terrain some.tif needs to know where on the Earth",
    "plan ph.zarr --terrain=http://localhost/x.tif": "give a path, or s3://bucket/name",
    "plan ph.zarr --terrain=text.txt": "give zarr or netCDF with height",
    "plan ph.zarr --terrain=run/image.zarr": "has no height (y, x)",
    "plan ph.zarr --terrain=nameless.zarr": "has no height (y, x)",
    "plan ph.zarr --terrain=complex.zarr": "complex.zarr is complex128, no real numbers; give zarr or netCDF",
    "plan ph.zarr --terrain=letters.zarr": "letters.zarr is <U1, no real numbers; give zarr or netCDF",
    "plan ph.zarr --terrain=uneven.zarr": "x is not uniform",
    f"plan ph.zarr --grid={GRID} --terrain=holes.zarr": "has no height under the grid",
    f"plan ph.zarr --grid={GRID} --terrain=peaks.zarr": "a height of 1e+06 m",
    f"plan ph.zarr --grid={GRID} --terrain=away.zarr": "lies elsewhere: it spans x 0 .. 100 m",
    f"plan ph.zarr --grid={AWAY}": "lies outside the swath: it spans yaw",
    "plan ph.zarr table1": "table1 is a scene among phase histories",
    "plan ''": "a path is '', which names nothing",
    "focus ph.zarr --out ''": "a path is '', which names nothing",
    "focus ph.zarr --out s3://": "names no bucket",
    f"{FOCUS} --scheduler=tcp://127.0.0.1:1": "--workers 0 is given together with --scheduler",
    f"{FOCUS} --performance-report=p.html": "--performance-report 'p.html' is given, but dask does no work",
    f"{FOCUS} --json-log=folder": "--json-log 'folder' cannot be written",
    f"{FOCUS} --json-log=ph.zarr/zarr.json": "lies in the store",
    f"{FOCUS} --control=two.json": "control is given without autofocus",
    f"{FOCUS} --autofocus --control=absent.csv": "absent.csv does not exist",
    f"{FOCUS} --config=absent.toml": "--config absent.toml cannot be read",
    "quality ''": "a path is '', which names nothing",
    "quality run --area=1:2": "area = '1:2': give the ends",
    "quality run --area=0:1,0:1": "area: y from 0 to 1 m has 0 pixels",
    "quality run --against=nothing": "nothing does not exist",
    "quality run --source=ph.zarr": "which only the reference needs; give --reference, or leave it out",
    "report run --out=a.pdf": "which is that of another kind of file; give report a name that ends in .html",
    "export png run --out=a.jpg": "give png a name that ends in .png",
    "export png run --out=a.png --colour-map=viridiss": "did you mean 'viridis'?",
    "export png run --out=a.png --size=0": "size = 0: give 200 to 20000 pixels",
    "export geotiff run --out=a.tif --content=complex --looks=2x2": "complex pixels is no image",
    "export geotiff run --out=a.tif --content=amplitude --scale=uint8": "the content is amplitude; take content db",
    "export geotiff run --out=a.tif --range=-40:0": "give a scale",
    "export geotiff run --out=a.tif --crop=900:950,0:10": "which runs from 4040 to 4118 m",
    "export sicd run --out=a.nitf": "has no georeference",
    "ingest cphd a.cphd --out ''": "a path is '', which names nothing",
    "simulate scene.toml --out text.txt --overwrite": "is not a zarr store, so it is not overwritten",
    "simulate scene.toml --out n.cphd --cphd --origin=north": "--origin 'north' is not three numbers; give",
    "simulate scene.toml --out n.zarr --origin=1,2,3": "only CPHD files have one; leave it out",
    "simulate scene.toml --out n.cphd --cphd --raw": "leave out one",
    "info nothing": "nothing does not exist; check the path",
    "info ''": "a path is '', which names nothing",
    f"preview ph.zarr --out a.png --quiet --grid={AWAY}": "lies outside the swath: it spans yaw",
    f"check ph.zarr --grid={AWAY}": "lies outside the swath: it spans yaw",
    "autofocus ph.zarr --out ''": "a path is '', which names nothing",
    "demo --out text.txt": "text.txt is not a folder; choose another --out",
    "demo --out folder/..": "is not a demonstration run; choose another --out",
}


@pytest.fixture(scope="module")
def room(bench: Bench, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a good store, run, scene and CPHD file, and many bad files."""
    folder = tmp_path_factory.mktemp("invocations")
    shutil.copytree(bench.store, folder / "ph.zarr")
    shutil.copytree(bench.run(**EXACT), folder / "run")
    (folder / "scene.toml").write_text(SCENE)
    blocksar.simulate(folder / "scene.toml", folder / "a.cphd", cphd=True)
    for name, write in FILES.items():
        write(folder / name)
    return folder


@pytest.mark.filterwarnings("ignore::zarr.errors.UnstableSpecificationWarning")
@pytest.mark.parametrize("command", CASES)
def test_wrong_invocations_get_one_sentence(command: str, room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(room)
    before = listing(room)
    result = CliRunner().invoke(commands.app, [word if word != "''" else "" for word in command.split(" ")])
    assert result.exit_code == 2, (result.output, result.exception)
    assert result.stderr.startswith("blocksar: ") and result.stderr.count("\n") == 1 and len(result.stderr) < 1000
    assert CASES[command] in result.stderr
    assert listing(room) == before
