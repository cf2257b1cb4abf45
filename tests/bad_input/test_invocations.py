"""Wrong options and files of every command: one sentence, exit status 2, nothing written."""

from __future__ import annotations

import json
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
    "empty": text(""),
    "folder": os.mkdir,
    "two.json": text('[1, "two"]'),
    "far.json": text('[{"name": "A", "x": "far", "y": 0}]'),
    "huge.json": text('[{"name": "A", "x": 1e400, "y": 0}]'),
    "dark.json": text('[{"name": "A", "x": 4080, "y": 0, "reflectivity": 0}]'),
    "nan.csv": text("name,x,y\nA,nan,2\n"),
    "short.csv": text("name,x,y\nA,1\n"),
    "headless.csv": text("A,1,2\nB,3,4\n"),
    "points.geojson": lambda path: path.write_text(json.dumps({"type": "FeatureCollection", "features": [{
        "type": "Feature", "geometry": {"type": "Point", "coordinates": [10, 50]},
    }]})),
    "unknown.toml": text("bloks = 3\n"),
    "table.toml": text("[focus]\nblocks = 3\n"),
    "list.toml": text("blocks = [1, 2]\n"),
    "words.toml": text('blocks = "many"\n'),
    "bytes.toml": lambda path: path.write_bytes(b"\xff\xfe"),
    "some.mat": lambda path: path.write_bytes(b"MATLAB 5.0" + bytes(200)),
    "some.nc": lambda path: path.write_bytes(b"CDF\x01" + bytes(40)),
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
    "plan ph.zarr --processor=angular": "'angular' is not one of",
    "plan ph.zarr --weighting=taylr": "weighting 'taylr' is unknown; give uniform,",
    "plan ph.zarr --weighting=taylor:4:35": "SLL = 35 dB; give a level from -80 to -15 dB",
    "plan ph.zarr --weighting=taylor:99999999:-35": "give a whole number from 2 to 12",
    "plan ph.zarr --weighting=kaiser:1e9": "give one above 0, up to 12",
    "plan ph.zarr --weighting-range=hanning": "weighting 'hanning' is unknown",
    "plan ph.zarr --fidelity=nan": "fidelity = nan: ask for a coherence from 0.5",
    "plan ph.zarr --blocks=1001": "'1001' is neither 'auto' nor a whole number from 1 to 1000; try",
    "plan ph.zarr --looks=33": "looks = 33: give 2 to 32 looks",
    "plan ph.zarr --range-model=conventional": "ask for coefficients closed-form",
    "plan ph.zarr --surface=sphere": "'sphere' is not one of",
    "plan ph.zarr --surface=ellipsoid": "put the attribute georeference into the phase history",
    "plan ph.zarr --vertical=egm96": "vertical = 'egm96', but there is no terrain; leave --vertical out",
    "plan ph.zarr --terrain=nothing.tif": "terrain nothing.tif does not exist; check the path",
    "plan ph.zarr --terrain=some.tif": "terrain some.tif needs to know where on the Earth",
    "plan ph.zarr --terrain=http://localhost/x.tif": "give a path, or s3://bucket/name",
    "plan ph.zarr --terrain=text.txt": "give zarr or netCDF with height",
    "plan ph.zarr --terrain=folder": "give zarr or netCDF with height",
    "plan ph.zarr --terrain=some.nc": "has no height (y, x)",
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
    "focus ph.zarr --out text.txt": "text.txt is not a folder; choose another --out",
    "focus ph.zarr --out ftp://a/b": "give a path, or s3://bucket/name",
    "focus ph.zarr --out s3://": "names no bucket",
    f"{FOCUS} --scheduler=tcp://127.0.0.1:1": "--workers 0 is given together with --scheduler",
    f"{FOCUS} --performance-report=p.html": "--performance-report 'p.html' is given, but dask does no work",
    f"{FOCUS} --json-log=folder": "--json-log 'folder' cannot be written",
    f"{FOCUS} --json-log=ph.zarr/zarr.json": "lies in the store",
    f"{FOCUS} --control=two.json": "control is given without autofocus",
    f"{FOCUS} --autofocus --control=absent.csv": "absent.csv does not exist",
    f"{FOCUS} --config=absent.toml": "--config absent.toml cannot be read",
    "focus ph.zarr --out new --config=unknown.toml": "'bloks' is no option of focus; did you mean blocks?",
    "focus ph.zarr --out new --config=table.toml": "'focus' is no option of focus",
    "focus ph.zarr --out new --config=list.toml": "write it as on the command line",
    "focus ph.zarr --out new --config=words.toml": "'many' is neither 'auto' nor a whole number",
    "focus ph.zarr --out new --config=bytes.toml": "is not TOML",
    "quality ''": "a path is '', which names nothing",
    "quality run --targets=two.json": "target 1 is 1, not a record",
    "quality run --targets=far.json": "'far', 'y': 0} cannot be read",
    "quality run --targets=huge.json": "has a value that is not finite",
    "quality run --targets=dark.json": "has reflectivity 0, so there is nothing to measure",
    "quality run --targets=nan.csv": "has a value that is not finite",
    "quality run --targets=short.csv": "has 2 values for 3 columns",
    "quality run --targets=headless.csv": "give a first line with name, x, y",
    "quality run --targets=points.geojson": "whose points are in degrees, but there is no georeference",
    "quality run --found=100000000": "found = 100000000: ask for 1 to 1000 points",
    "quality run --area=1:2": "area = '1:2': give the ends",
    "quality run --area=0:1,0:1": "area: y from 0 to 1 m has 0 pixels",
    "quality run --channel=HH": "channel is 'HH', but",
    "quality run --against=nothing": "nothing does not exist",
    "report run --out=a.pdf": "which is that of another kind of file; give report a name that ends in .html",
    "report run --out=folder": "folder exists; choose another name",
    "export png run --out=a.jpg": "give png a name that ends in .png",
    "export png run --out=a.png --range=10:0": "give two ends in dB, the lower first",
    "export png run --out=a.png --colour-map=viridiss": "did you mean 'viridis'?",
    "export png run --out=a.png --size=0": "size = 0: give 200 to 20000 pixels",
    "export png run --out=a.png --crop=0:1,0:1": "crop: y from 0 to 1 m has 0 pixels",
    "export png run --out=a.png --composite=pauli": "composite pauli takes the channels",
    "export png run --out=ph.zarr/a.png": "would lie within the store",
    "export geotiff run --out=a.tif --looks=0x0": "looks = '0x0': give pixels",
    "export geotiff run --out=a.tif --content=complex --looks=2x2": "complex pixels is no image",
    "export geotiff run --out=a.tif --content=amplitude --scale=uint8": "the content is amplitude; take content db",
    "export geotiff run --out=a.tif --range=-40:0": "give a scale",
    "export geotiff run --out=a.tif --looks=90x1": "take fewer looks",
    "export geotiff run --out=a.tif --crop=900:950,0:10": "which runs from 4040 to 4118 m",
    "export geotiff run --out=a.png": "give geotiff a name that ends in .tif",
    "export geotiff run --out=a.tif --scale=uint9": "'uint9' is not one of",
    "export geotiff run --out=a.tif --content=height": "focus again with --terrain",
    "export sicd run --out=a.nitf": "has no georeference",
    "ingest cphd half.cphd --out n.zarr": "it was cut short; copy it again",
    "ingest cphd a.cphd --out n.zarr --channel=HV": "channel 'HV' is not in it; it has '1'",
    "ingest cphd a.cphd --out n.zarr --collection-start=yesterday": "give UTC in ISO 8601",
    "ingest cphd a.cphd --out n.zarr --time-zero=nan": "--time-zero is nan s; give the seconds",
    "ingest cphd a.cphd --out ''": "a path is '', which names nothing",
    "ingest gotcha some.mat --out n.zarr": "it is no MATLAB file of version 5",
    "simulate nothing --out n.zarr": "is neither a file nor one of the shipped scenes",
    "simulate scene.toml --out ph.zarr": "ph.zarr exists; choose another name",
    "simulate scene.toml --out text.txt --overwrite": "is not a zarr store, so it is not overwritten",
    "simulate scene.toml --out n.cphd --cphd --origin=north": "--origin 'north' is not three numbers; give",
    "simulate scene.toml --out n.zarr --origin=1,2,3": "only CPHD files have one; leave it out",
    "simulate scene.toml --out n.cphd --cphd --raw": "leave out one",
    "ingest cphd scene.toml --out n.zarr": "is a scene",
    "info nothing": "nothing does not exist; check the path",
    "info ''": "a path is '', which names nothing",
    "info empty": "is an empty file; get it again",
    "preview ph.zarr --out a.jpg": "give png a name that ends in .png",
    "preview ph.zarr --out a.png --size=3": "size = 3: give 50 to 8000 pixels",
    f"preview ph.zarr --out a.png --quiet --grid={AWAY}": "lies outside the swath: it spans yaw",
    f"check ph.zarr --grid={AWAY}": "lies outside the swath: it spans yaw",
    "autofocus ph.zarr --out ph.zarr": "lie in each other; choose another place",
    "autofocus ph.zarr --out ''": "a path is '', which names nothing",
    "demo --out text.txt": "text.txt is not a folder; choose another --out",
    "demo --out folder/..": "is not a demonstration run; choose another --out",
    "compile table1": "got unexpected extra argument(s) (table1)",
}


@pytest.fixture(scope="module")
def room(bench: Bench, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a good store, run, scene and CPHD file, and many bad files."""
    folder = tmp_path_factory.mktemp("invocations")
    shutil.copytree(bench.store, folder / "ph.zarr")
    shutil.copytree(bench.run(**EXACT), folder / "run")
    (folder / "scene.toml").write_text(SCENE)
    blocksar.simulate(folder / "scene.toml", folder / "a.cphd", cphd=True)
    (folder / "half.cphd").write_bytes((folder / "a.cphd").read_bytes()[:3000])
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
