"""Wrong input: one table of what is given and of the sentence, tried through every entry that it can come by.

An option comes by the command line, by Python and, where it is of `plan` or `focus`, by a file of options. A field of a
phase history comes by the class, a dataset in memory and a store. What is said is the same, in Python's words, and
nothing is written. Arguments of `blocksar.collection` have a table of their own, which is that of its checks
(`stores/test_incoming.py`), and so have the files of each reader.
"""

from __future__ import annotations

import inspect
import json
import os
import re
import shlex
import shutil
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import small_run
import xarray as xr
import zarr
from arrays import arrays
from axis_beams import axis_collection, axis_scene, with_patterns
from bad_input import EXACT, SCENE, Bench, listing
from typer.testing import CliRunner

import blocksar
from blocksar import stores
from blocksar.cli import commands
from blocksar.cli.plan_and_focus import NOT_CONFIGURED
from blocksar.collection.collection import Collection
from blocksar.collection.raw_echo import RawEcho
from blocksar.errors import InputError, in_python
from blocksar.products.pictures.quicklook import checked_colour_map, checked_size
from blocksar.readers.registry import stated_times

GRID, AWAY = "4040:4121:3,-40:41:3", "9040:9121:3,-40:41:3"
FOCUS = f"focus ph.zarr --out=new --workers=0 --processor=backprojection --grid={GRID}"


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
    "a.png": lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n"),
    "some.tif": lambda path: path.write_bytes(b"II*\x00" + bytes(100)),
    "holes.zarr": heights(np.nan),
    "peaks.zarr": heights(1e6),
    "complex.zarr": heights(1j),
    "letters.zarr": heights("a"),
    "nameless.zarr": heights(0.0, name="z"),
    "away.zarr": heights(0.0, x=np.linspace(0, 100, 9)),
    "uneven.zarr": heights(0.0, x=np.linspace(60, 66, 9) ** 2),
    "binary.toml": lambda path: path.write_bytes(b"\xff\xfe"),
    "broken.toml": text("title = 'a'\n[radar\n"),
    "pipe": os.mkfifo,
    "page.html": text("mine"),
    "linked.zarr": lambda path: path.symlink_to("gone.zarr"),
    "odd.png": lambda path: path.write_bytes(b"\x89PNG\r\n not what it seems = ["),
    "broken.mat": lambda path: path.write_bytes(b"\x89MAT\r\n not what it seems = ["),
    "array": lambda path: zarr.create_array(store=str(path), shape=(3,), dtype="f8"),
    "array2": lambda path: zarr.create_array(store=str(path), shape=(3,), dtype="f8", zarr_format=2),
    "other": lambda path: xr.Dataset({"temperature": ("x", np.zeros(3))}).to_zarr(path, consolidated=False),
}
# Files of targets, and what `quality` says of each.
TARGETS = {
    "A;1;2\n": "looks like CSV, but its first line is 'A;1;2'; give a first line with name, x, y",
    "name,x,y\nA,1,2\nB,3\n": "target 2 has 2 values for 3 columns",
    "name,x,y\nA,nan,2\n": "has a value that is not finite",
    '[{"name": "A", "x": 1e300, "y": 0}]': "is far outside any scene; give metres",
    '[{"name": "A", "x": 1, "y": 2, "reflectivity": 0}]': "has reflectivity 0, so there is nothing to measure",
    "name,x,y,reflectivity\nA,1,2,big\n": "target 1 has the reflectivity 'big'; give",
    '{"type": "FeatureCollection", "features": [{"geometry": {"type": "Line", "coordinates": [[1, 2]]}}]}': (
        "feature 1 is no point"
    ),
    '{"type": "Feature", "geometry": {"type": "Point", "coordinates": [39, 139]}}': "give longitude first",
    '[{"name": "A", "x": 1, "y": 2},\n;]': "is not JSON at line 2; give [{",
    '[{"name": "A", "x": 1, "Y": 2}]': "target 1 has the unknown key 'Y'; did you mean y?",
    '[{"name": "A", "x": 1, "y": 2}, {"name": "B", "x": 1}]': "target 2 has no y; give",
    '[["A", 1, 2]]': 'target 1 is ["A", 1, 2], not a record; give',
    '{"name": "A", "x": 1, "y": 2}': "holds no list of targets; give [{",
}
POINT = '{"type": "Feature", "geometry": {"type": "Point", "coordinates": [-84.09, 39.78]}}'

# What is asked for, as it is typed, and words of the message as Python says it: the field, the value, what to do.
ASKED = {
    "plan ph.zarr --grid=10": "1 axis",
    "plan ph.zarr --grid=-60:60": "1 axis",
    "plan ph.zarr --grid=0:1,0:1:1": "'0:1' for x, which is not three numbers",
    "plan ph.zarr --grid=a:b:c,0:1:1": "'a:b:c' for x, which is not three numbers",
    "plan ph.zarr --grid=0:nan:1,0:1:1": "not finite",
    "plan ph.zarr --grid=0:inf:1,0:1:1": "not finite",
    "plan ph.zarr --grid=0:1:0,0:1:1": "spacing of 0 m for x",
    "plan ph.zarr --grid=0:1:-1,0:1:1": "spacing of -1 m for x",
    "plan ph.zarr --grid=0:1:1,5:5:1": "empty: y runs from 5 to 5",
    f"plan ph.zarr --grid={AWAY}": "lies outside the swath: it spans yaw",
    **{
        f"plan ph.zarr --memory-limit={shlex.quote(size)}": "is no amount of memory"
        for size in ("lots", "", "GiB", "-1GiB", "0", "2 Gib b", "nan", "1i", "2PiB", "1e", "auto")
    },
    "plan ph.zarr --memory-limit=1e30T": "is not an amount of memory that a machine has; give one such as 2GiB",
    **{
        f"plan ph.zarr --blocks={shlex.quote(blocks)}": f"blocks {blocks!r} is neither 'auto' nor a whole number"
        for blocks in ("many", "0", "-1", "2.5", "", "²")
    },
    "plan ph.zarr --workers=-1": "workers",
    "plan ph.zarr --fidelity=1.5": "fidelity = 1.5: ask for a coherence from 0.5 to below 1, such as",
    "plan ph.zarr --weighting=taylor": "weighting 'taylor' has no parameters, but taylor takes 2",
    "plan ph.zarr --weighting=''": "weighting '' is unknown",
    "plan ph.zarr --weighting=cosine": "weighting 'cosine' is unknown",
    "plan ph.zarr --weighting=taylor:4:x": "has a parameter that is no number",
    "plan ph.zarr --weighting=taylor:4.5:-35": "NBAR = 4.5; give a whole number from 2 to 12",
    "plan ph.zarr --weighting=taylor:99999999:-35": "give a whole number from 2 to 12",
    "plan ph.zarr --weighting=taylor:4:35": "SLL = 35 dB; give a level from -80 to -15 dB",
    "plan ph.zarr --weighting=kaiser:-1": "BETA = -1; give one above 0",
    "plan ph.zarr --processor=omega-k": "processor 'omega-k' is unknown; use angular-division",
    "plan ph.zarr --processor=angular-division --perturbation=some": (
        "perturbation 'some' is unknown; use all, frequency, none"
    ),
    "plan ph.zarr --processor=high-order-phase --no-keystone": "high-order-phase has no keystone to leave out",
    "plan ph.zarr --processor=angular-division --range-model=conventional": (
        "conventional makes closed-form coefficients for angular-division"
    ),
    "plan ph.zarr --processor=backprojection --derotation=linear": "backprojection has no derotation to choose",
    "plan ph.zarr --processor=hierarchical-backprojection --no-keystone": (
        "an option of angular-division, keystone-resampling and high-order-phase only; leave it out"
    ),
    "plan ph.zarr --looks=33": "looks = 33: give 2 to 32 looks",
    "plan ph.zarr --looks=1": "looks = 1: give 2 to 32 looks",
    "plan ph.zarr other.zarr --looks=2": "looks = 2: looks are formed of one collection, and here are 2; give",
    "plan ph.zarr --ground-height=nan": "give a finite number of m",
    "plan ph.zarr --ground-height=9500": "z must point up",
    "plan ph.zarr --ground-height=30 --terrain=dem.tif": "which has heights; leave one out",
    "plan table1 --ground-height=30": "a scene on z = 0",
    "plan ph.zarr --surface=sphere": "give plane or ellipsoid",
    "plan ph.zarr --surface=ellipsoid": "put the attribute georeference",
    "plan ph.zarr --surface=ellipsoid --terrain=dem.nc": "leave one of them out",
    "plan ph.zarr --vertical=egm96": "there is no terrain",
    "plan ph.zarr --vertical=egm96 --terrain=dem.nc": "z of the scene frame",
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
    "plan ph.zarr table1": "table1 is a scene among phase histories",
    "plan ph.zarr ph.zarr": "given twice",
    "plan still.zarr": "so give grid x0:x1:dx,y0:y1:dy for the ground to image, such as grid='",
    "plan ''": "a path is '', which names nothing",
    "plan text.txt": "text.txt is a text file; give the data that it describes",
    "plan folder": "is not a zarr store",
    "plan array": "single zarr array",
    "plan array2": "single zarr array",
    "plan other": "holds neither signal nor echo",
    "plan linked.zarr": "is a symbolic link to gone.zarr, which does not exist; correct",
    "plan run/image.zarr": "is an image of a run, not a phase history",
    "plan ph.zar": "ph.zar does not exist; did you mean ph.zarr?",
    f"plan {'ph' * 200}.zarr": "File name too long",
    "plan ph.zarr --grid=4.04:4.12:0.003,-0.04:0.041:0.003": "it looks like km: give metres",
    "focus scene.toml --out=new": (
        "is a scene, not a phase history; write one first: `blocksar simulate scene.toml --out scene.zarr`"
    ),
    "focus table1 --out=new": (
        "table1 is a shipped scene, not a phase history; write one first: `blocksar simulate table1 --out table1.zarr`"
    ),
    "focus still.zarr --out=new": "grid is missing: a collection whose beam is not",
    "plan a.cphd": ("is a CPHD file; turn it into a phase history first: `blocksar ingest cphd a.cphd --out a.zarr`"),
    "focus ph.zarr --out=''": "a path is '', which names nothing",
    "focus ph.zarr --out=s3://": "names no bucket",
    "focus ph.zarr --out=folder/..": "holds no run of blocksar",
    "focus ph.zarr --out=folder/.. --overwrite": "holds no run of blocksar",
    "focus ph.zarr --out=folder/.. --dry-run": "holds no run of blocksar",
    "focus ph.zarr --out=text.txt": "is not a folder",
    "focus ph.zarr --out=new --wait-workers=-1": "is no time; give seconds, or 0 to wait for no worker",
    f"{FOCUS} --memory-limit=1": "memory_limit '1' is 1 bytes; give it with a unit, such as 2GiB",
    f"{FOCUS} --scheduler=tcp://127.0.0.1:1": "workers 0 is given together with scheduler",
    f"{FOCUS} --performance-report=p.html": "performance_report 'p.html' is given, but dask does no work",
    f"{FOCUS} --control=two.json": "control is given without autofocus",
    f"{FOCUS} --autofocus --control=absent.csv": "absent.csv does not exist",
    "quality ''": "a path is '', which names nothing",
    "quality ph.zarr": "is a store, not a run; give the folder that `blocksar focus",
    "quality run --targets=ph.zarr": "ph.zarr is no regular file; give [{",
    "quality run/image.zarr": "image.zarr is the image alone; give the folder of its run, such as",
    "quality run --found=-1": "found = -1: ask for 1 to 1000 points",
    "quality run --area=1:2": "area = '1:2': give the ends",
    "quality run --area=0:1,0:1": "area: y from 0 to 1 m has no pixels",
    "quality run --area=-29.9:-28,-25.9:-24": "area: ",
    "quality placed --found=2 --area=-11.9:-10,-9.9:-8": "the image covers 0 pixels there",
    "quality run --against=nothing": "nothing does not exist",
    "quality run --source=ph.zarr": "which only the reference needs; give reference=True, or leave it out",
    "quality run --targets=point.geojson": "is GeoJSON, whose points are in degrees, but there is no georeference",
    **{f"quality placed --targets=targets{i}": said for i, said in enumerate(TARGETS.values())},
    "report rnu": "rnu does not exist; give the folder that `blocksar focus --out` left",
    "report run --out=page.html": "page.html exists; choose another name",
    "report run --out=a.pdf": "which is that of another kind of file; give report a name that ends in .html",
    "report run --out=run/run.json --overwrite": "is the name of a run's record",
    "compare run run --out=pair --window=4x4": "window = '4x4': give pixels along y and along x, odd",
    "compare run run --out=pair --window=251x3": "window of 251 pixels along y is larger than the image of 27",
    "compare run run --out=pair --false-alarms=0.5": "false_alarms = 0.5: give a probability",
    "compare run run --out=pair --crop=900:950,0:10": "crop: x from 900 to 950 m has no pixels",
    "compare run run --out=pair --channel=HH": "channel is 'HH'",
    "export jpeg run --out=a.jpeg": "jpeg",
    "export png folder --out=a.png": "holds no run.json; give the folder",
    "export png run --out=folder": "is a folder",
    "export png run --out=pipe --overwrite": "is no regular file, and is not replaced",
    "export png run --out=s3://bucket/image.png": "is no local path",
    "export png run --out=text.txt/image.png": "cannot be written",
    f"export png run --out={'a' * 300}.png": "choose a shorter name",
    "export png run --out=ph.zarr/image.png --overwrite": "would lie within the store",
    "export png run --out=ph.zarr/signal/c/0/0 --overwrite": "would lie within the store",
    "export png run --out=a.jpg": "give png a name that ends in .png",
    "export png run --out=a.png --colour-map=viridiss": "did you mean 'viridis'?",
    "export png run --out=a.png --size=0": "size = 0: give 200 to 20000 pixels",
    "export png run --out=a.png --channel=VV": "channel is 'VV'",
    "export geotiff run --out=a.tif": "has no georeference",
    "export geotiff run --out=a.tif --looks=''": "looks = ''",
    "export geotiff run --out=a.tif --content=complex --looks=2x2": "complex pixels is no image",
    "export geotiff run --out=a.tif --content=amplitude --scale=uint8": "the content is amplitude; take content db",
    "export geotiff run --out=a.tif --range=-40:0": "give a scale",
    "export geotiff run --out=a.tif --crop=900:950,0:10": "which runs from 4040 to 4118 m",
    "export geotiff placed --out=a.tif --content=gamma": "lies on the plane and has no visibility; focus again with",
    "export geotiff placed --out=a.tif --crs=EPSG:99999": (
        "is no coordinate reference system; give a projected one, such as EPSG:32616"
    ),
    "export geotiff placed --out=a.tif --crs=EPSG:4978": "Geocentric",
    "export geotiff placed --out=a.tif --crs=EPSG:4979": "Geographic 3D",
    "export geotiff placed --out=a.tif --crs=EPSG:32633": "for longitudes 12 .. 18",
    "export geotiff placed --out=a.tif --crs=EPSG:32716": "UTM there is EPSG:32616",
    "export sicd run --out=a.nitf": "has no georeference",
    "export sicd placed --out=a.json": "which is that of stac; give sicd a name that ends in .nitf",
    "export sicd unknown --out=a.nitf": "is 'eyes only', and NITF knows only those",
    "export sidd unknown --out=a.nitf": "is 'eyes only', and NITF knows only those",
    "export sidd run --out=a.nitf": "no georeference, and a SIDD says where",
    "export sidd placed --out=a.nitf --looks=90x1": "take fewer looks",
    "export sidd placed --out=a.nitf --range=0:-40": "the lower first",
    "export stac run --out=a.json": "no georeference, and a STAC item says where",
    "export stac placed --out=a.json --assets=nowhere.tif": "nowhere.tif is no file; export it first",
    "ingest cphd a.cphd --out=''": "a path is '', which names nothing",
    "ingest cphd nowhere.cphd --out=new": "does not exist",
    "ingest cphd folder --out=new": "no regular file",
    "ingest gotcha nowhere.mat --out=new": "does not exist",
    "ingest gotcha folder --out=new": "regular file",
    "ingest gotcha pipe --out=new": "regular file",
    "ingest cphd a.cphd --out=ph.zarr": "exists; choose another name",
    "ingest cphd a.cphd --out=new --pulses=196:": "pulses 196: leaves 4 of 200 vectors; at least 8 are needed",
    "ingest cphd a.cphd --out=new --pulses=4:2": "is not two numbers, the lower first; give them as pulses 0:4096",
    "ingest cphd a.cphd --out=new --pulses=1.5:20": "is not two whole numbers from 0",
    "ingest cphd a.cphd --out=new --frequencies=1e9:2e9": "has nothing of what all vectors have, 99",
    "ingest cphd a.cphd --out=new --frequencies=9.99e9": "is not two numbers",
    "ingest cphd a.cphd --out=new --area=5:1,0:3": "give the ends of x and of y in metres",
    "ingest cphd a.cphd --out=new --area=90000:90100,0:100": "m in range from the middle of what was recorded",
    "ingest cphd a.cphd --out=new --ground-height=1e5": "z must point up",
    "ingest cphd a.cphd --out=new --sgn=2": "it must be -1 or +1",
    "ingest cphd a.cphd --out=new --range-window=near": "range_window is 'near'; it must be saved or reference",
    "ingest cphd a.cphd --out=new --troposphere=wet": "troposphere is 'wet'; it must be file or standard",
    "ingest cphd a.cphd --out=new --channel=x": "channel 'x' is not in it; it has",
    "ingest gotcha a.png --out=new --collection-start=yesterday": "collection_start 'yesterday' is not a date",
    "ingest gotcha a.png --out=new --collection-start=2008-08-19": "collection_start '2008-08-19' is not a date",
    "ingest gotcha a.png --out=new --collection-start=2008-13-01T00:00": "is not a date with a time",
    "ingest gotcha a.png --out=new --time-zero=1e10": "s; give the seconds from collection_start to slow time 0",
    "simulate tabel1 --out=new": "neither a file nor one of the shipped scenes: ",
    "simulate binary.toml --out=new": "cannot be read",
    "simulate broken.toml --out=new": "is not TOML: ",
    "simulate scene.toml --out=text.txt --overwrite": "is not a zarr store, so it is not overwritten",
    "simulate scene.toml --out=ph.zarr": "exists; choose another name",
    "simulate scene.toml --out=a.cphd --cphd": "exists; choose another name",
    "simulate scene.toml --out=text.txt --cphd --overwrite": "is no CPHD file, so it is not overwritten",
    "simulate scene.toml --out=s3://bucket/a.cphd --cphd": "object store",
    "simulate scene.toml --out=n.cphd --cphd --origin=95,0,0": "origin is",
    "simulate scene.toml --out=n.zarr --threads=0": "threads",
    "simulate scene.toml --out=n.zarr --origin=1,2,3": "only CPHD files have one; leave it out",
    "simulate scene.toml --out=n.cphd --cphd --raw": "leave out one",
    "info nothing": "nothing does not exist; check the path",
    "info ''": "a path is '', which names nothing",
    "info folder": "is nothing that blocksar reads or writes",
    "info odd.png": "is of no kind that blocksar knows (it begins with",
    "info broken.mat": "broken.mat is of no kind",
    "info binary.toml": "give a scene file in UTF-8",
    "preview ph.zarr --out=b.png --size=3": "give 50 to 8000 pixels",
    "preview ph.zarr --out=b.tif": "give png a name that ends in .png",
    "preview ph.zarr --out=b.png --range=x": "range",
    "preview ph.zarr --out=b.png --colour-map=greyish": "colour map 'greyish' is none that matplotlib knows",
    "preview still.zarr --out=b.png --grid=10": "1 axis",
    f"preview ph.zarr --out=b.png --grid={AWAY}": "lies outside the swath: it spans yaw",
    f"check ph.zarr --grid={AWAY}": "lies outside the swath: it spans yaw",
    "check still.zarr": "grid is missing",
    "check run": "is a run, not a phase history; `blocksar info` names the phase history",
    "check ph.zarr --ground-height=9500": "z must point up",
    "autofocus ph.zarr --out=''": "a path is '', which names nothing",
    f"autofocus ph.zarr --out=ph.zarr --grid={GRID}": "lie in each other",
    f"autofocus ph.zarr --out=new --grid={GRID} --ground-height=9500": "z must point up",
    "view run --port=80 --no-browser": "port is 80; give a whole number from 1024",
    "view nothing --no-browser": "does not exist",
}
# What only a command line has.
TYPED = {
    f"{FOCUS} --json-log=folder": "--json-log 'folder' cannot be written",
    f"{FOCUS} --json-log=ph.zarr/zarr.json": "lies in the store",
    f"{FOCUS} --json-log=no/such/log": "--json-log 'no/such/log' cannot be written",
    f"{FOCUS} --json-log=": "--json-log ''",
    f"{FOCUS} --config=absent.toml": "--config absent.toml cannot be read",
    f"{FOCUS} --config=binary.toml": "--config binary.toml is not TOML",
    "simulate scene.toml --out=n.cphd --cphd --origin=north": "--origin 'north' is not three numbers; give",
    "simulate scene.toml": "--out is missing",
    "simulate scene.toml --out=new.zarr --json-log=scene.toml": (
        "--json-log 'scene.toml' holds something else than a log; give another file"
    ),
    "fokus ph.zarr --out=new": "no such command 'fokus'. Did you mean 'focus'?",
    "demo --out=text.txt": "text.txt is not a folder; choose another --out",
    "demo --out=folder/..": "is not a demonstration run; choose another --out",
    "plan ph.zarr --processor=omega": "invalid value for '--processor': 'omega' is not one of",
    "plan ph.zarr --workers=-3": "greater than or equal to 0, not '-3'; see blocksar plan --help",
    "plan": "missing argument 'PH.zarr|SCENE.toml'; see blocksar plan --help",
    "--speed": "no such option: --speed; see blocksar --help",
    "export tiff run --out=a": "no such command 'tiff'. Did you mean 'geotiff'? See blocksar export --help",
}
# What only a file of options has: its text, of `focus`.
STATED = {
    "blokcs = 3": "c.toml: 'blokcs' is no option of focus; did you mean blocks?",
    "zzz = 1": "'zzz' is no option of focus; known are source, out, processor, device, blocks",
    "memory_limit = '1GiB'\nmemory-limit = '2GiB'": "c.toml: memory_limit and memory-limit are one option",
    "workers = -1": "c.toml: workers = '-1': must be greater than or equal to 0",
    "overwrite = 1": "c.toml: overwrite = '1' is neither true nor false",
    "blocks = true": "c.toml: blocks = true is neither text nor a number",
    "blocks = ": "--config c.toml is not TOML: ",
    "blocks = 0": "c.toml: --blocks '0' is neither",
}
NUMERIC = {"workers", "threads", "fidelity", "looks", "ground_height", "wait_workers", "found", "size", "port", "sgn",
           "false_alarms", "time_zero"}  # fmt: skip
BY_PARSER = r"[Ii]nvalid value for '|c\.toml: .* (is not one of|must be)|no such command"


@pytest.fixture(scope="module")
def room(bench: Bench, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with good stores, runs, a scene and a CPHD file, and many bad files."""
    folder = tmp_path_factory.mktemp("invocations")
    for name in ("ph.zarr", "other.zarr"):
        shutil.copytree(bench.store, folder / name)
    shutil.copytree(bench.run(**EXACT), folder / "run")
    small_run.make(folder / "placed", size=(60, 50))
    small_run.make(folder / "unknown", size=(60, 50), more={"classification": "eyes only"})
    blocksar.write(blocksar.collection(**arrays(steered=False)), folder / "still.zarr")
    (folder / "scene.toml").write_text(SCENE)
    blocksar.simulate(folder / "scene.toml", folder / "a.cphd", cphd=True)
    files = {**FILES, "point.geojson": text(POINT)}
    for name, write in (files | {f"targets{i}": text(each) for i, each in enumerate(TARGETS)}).items():
        write(folder / name)
    return folder


class Call(NamedTuple):
    """A command in Python: its name, the values without a name, and those with one."""

    name: str
    values: list[Any]
    options: dict[str, Any]

    @classmethod
    def of(cls, command: str) -> Call:
        name, *words = shlex.split(command)
        options: dict[str, Any] = {}
        for word in words:
            if word.startswith("--"):
                option, given, value = word[2:].partition("=")
                option = option.replace("-", "_")
                if not given:
                    options[option.removeprefix("no_")] = not option.startswith("no_")
                else:
                    number = option in NUMERIC and re.fullmatch(r"[-+.e\d]+|nan", value)
                    options[option] = float(value) if number else value
                    if number and float(value).is_integer():
                        options[option] = int(float(value))
        values = [word for word in words if not word.startswith("--")]
        several = name in ("plan", "focus", "check") and len(values) > 1
        return cls(name, [values] if several else values, options)

    def call(self) -> Any:
        if self.name == "simulate" and "origin" in self.options:
            self.options["origin"] = tuple(map(float, self.options["origin"].split(",")))
        if self.name == "view":
            return blocksar.view(*self.values, **self.options)
        quiet = "progress" in inspect.signature(getattr(blocksar, self.name)).parameters
        return getattr(blocksar, self.name)(*self.values, **self.options, **({"progress": False} if quiet else {}))


def typed(*words: str) -> str:
    """The sentence that a command line of wrong words ends with."""
    ended = CliRunner().invoke(commands.app, words)
    assert ended.exit_code == 2, (ended.output, ended.exception)
    *shown, said = ended.stderr.splitlines()
    assert said.startswith("blocksar: ") and len(said) < 1000 and not any(map(re.compile("blocksar: ").match, shown))
    return said.removeprefix("blocksar: ")


def refused(call: Callable[[], Any]) -> str:
    """The sentence that a call with wrong values raises."""
    with pytest.raises(InputError) as caught:
        call()
    said = str(caught.value)
    assert "\n" not in said and len(said) < 1000
    return said


@pytest.mark.filterwarnings("ignore::zarr.errors.UnstableSpecificationWarning")
@pytest.mark.parametrize("command", ASKED)
def test_what_is_asked_for(command: str, room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(room)
    before, words, call = listing(room), shlex.split(command), Call.of(command)
    said = {"typed": in_python(typed(*words)), "called": refused(call.call)}
    if call.name in ("plan", "focus") and call.options and not set(NOT_CONFIGURED) & set(call.options):
        lines = [f"{name} = {json.dumps(value).replace('NaN', 'nan')}" for name, value in call.options.items()]
        (tmp_path / "c.toml").write_text("\n".join(lines))
        sources = [word for word in words if not word.startswith("--")]
        said["stated"] = in_python(typed(*sources, f"--config={tmp_path / 'c.toml'}"))
    for entry, sentence in said.items():
        by_parser = entry != "called" and re.search(BY_PARSER, sentence)
        assert ASKED[command] in sentence or by_parser, (entry, sentence)
    assert "--" not in re.sub("`.*?`", "", said["called"]) and listing(room) == before


@pytest.mark.parametrize("command", TYPED)
def test_what_is_typed(command: str, room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(room)
    before = listing(room)
    assert TYPED[command].lower() in typed(*shlex.split(command)).lower()
    assert listing(room) == before


@pytest.mark.parametrize("lines", STATED)
def test_what_a_file_states(lines: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "c.toml").write_text(lines)
    assert STATED[lines] in typed("focus", "ph.zarr", "--out=run", "--config=c.toml")
    assert os.listdir(tmp_path) == ["c.toml"]


def changed(**changes: Callable[[Any], Any]) -> xr.Dataset:
    given = arrays()
    return blocksar.collection(**{**given, **{name: change(given.get(name)) for name, change in changes.items()}})


def two(signal: Any) -> Any:
    return np.stack([signal, signal])


# What only Python can be given: the call on a dataset and the path of a store, and the beginning of its sentence.
GIVEN: list[tuple[Callable[[xr.Dataset], Any], str]] = [
    (lambda ds: blocksar.plan(ds, grid=(-60, 60, 0.5)), "grid (-60, 60, 0.5) is not two axes of three numbers;"),
    (lambda ds: blocksar.plan(ds, grid=([0, 1, 2, 3], [0, 1, 2])), "grid has [0, 1, 2, 3] for x, which is not"),
    (lambda ds: blocksar.plan(ds, grid=((5, 5, 1), (0, 1, 1))), "grid is empty: x runs from 5 to 5 m; give an end"),
    (lambda ds: blocksar.plan(ds, blocks=2.5), "blocks 2.5 is neither 'auto' nor a whole number"),
    (lambda ds: blocksar.plan(ds, memory_limit=0.5), "memory_limit is 0.5; give a whole number of bytes, or a text"),
    (lambda ds: blocksar.plan(ds, memory_limit=0), "memory_limit is 0 bytes; give what a worker may use, such as"),
    (lambda ds: blocksar.plan(ds, memory_limit=[1]), "memory_limit is [1]; give"),
    (lambda ds: blocksar.plan(ds, fidelity="high"), "fidelity is 'high'; give a number below 1, such as 0.999"),
    (lambda ds: blocksar.plan(ds, workers="2"), "workers is '2'; give a whole number of at least 0"),
    (lambda ds: blocksar.plan(ds, keystone=3), "keystone 3 is unknown; use True, False"),
    (lambda ds: blocksar.plan(ds, ground_height="30"), "ground_height is '30'; give a finite number of m"),
    (lambda ds: blocksar.plan(ds.signal.values), "source is a numpy.ndarray; give the path"),
    (lambda ds: blocksar.plan([]), "source is empty"),
    (lambda ds: blocksar.check(ds, threads="two"), "threads is 'two'; give a whole number"),
    (lambda ds: blocksar.preview(ds, threads=1.5), "threads is 1.5; give a whole number"),
    (lambda ds: blocksar.preview(ds, size="a"), "size = 'a': give 50 to 8000 pixels"),
    (lambda ds: blocksar.focus(ds, None), "a path is needed, but a NoneType was given"),
    (lambda ds: blocksar.focus(ds, "run", progress=print), "progress is <built-in function print>; give an object"),
    (lambda ds: blocksar.focus(ds, "run", progress=True), "progress is True; give an object with a method update"),
    (lambda ds: blocksar.focus(ds, "run", wait_workers="60"), "wait_workers '60' is no time; give seconds"),
    *[
        (lambda ds, wait=wait: blocksar.focus(ds, "run", wait_workers=wait), "wait_workers ")  # type: ignore[misc]
        for wait in (float("nan"), True)
    ],
    (lambda ds: blocksar.focus(ds, "run", client="tcp://127.0.0.1:8786"), "client is a str; give a distributed.Client"),
    (lambda ds: blocksar.focus(ds, "run", client="C", workers=0), "workers 0 is given together with a client, whose"),
    (
        lambda ds: blocksar.focus(ds, "run", client="C", scheduler="tcp://a:1"),
        "scheduler 'tcp://a:1' is given together with a client; leave",
    ),
    (lambda ds: blocksar.autofocus(ds, "run", client="C"), "client is a str; give a distributed.Client"),
    (lambda _: blocksar.simulate({"radar": 1}, "x.zarr"), "scene is a dict; give a file"),
    (lambda _: blocksar.simulate("table1", "none.cphd", cphd=True, origin=(1, 2)), "origin is (1, 2): give"),
    (blocksar.quality, "a path is needed, but a Dataset was given; give a str or a pathlib.Path"),
    (lambda _: blocksar.info(b"ph.zarr"), "a path is needed, but a bytes was given"),
    (lambda _: blocksar.export([], "run", "out"), "kind is []; it must be"),
    (lambda _: blocksar.ingest("gotcha", None, "none.zarr"), "source is None; give the path"),
    (lambda _: blocksar.ingest("gotcha", [], "none.zarr"), "source is a list of 0; a MATLAB 5 file is"),
    (lambda _: blocksar.ingest("sicd", "a.cphd", "none.zarr"), "kind is 'sicd'; it must be 'cphd' or 'crsd'"),
    (lambda _: blocksar.ingest("cphd", ["a", "a"], "none.zarr"), "source is a list of 2; a CPHD file is"),
    (lambda _: blocksar.ingest("gotcha", "a.mat", "x", sgn=1), "sgn is 1, but it is an option of cphd only; leave it"),
    (lambda _: blocksar.ingest("cphd", "a", "x", aera="0:1,0:1"), "aera"),
    (lambda _: blocksar.export("sidd", "run", "a.nitf", scale="uint8"), "scale is 'uint8', but it is an option of"),
    (lambda _: blocksar.export("png", "run", "a.png", content="complex"), "content is 'complex', but it is an option"),
    (lambda _: blocksar.write("ph.zarr", "out.zarr"), "source is a str; give a dataset"),
    (lambda _: blocksar.collection(**{**arrays(), "time": None}), "time is None; give the times"),
    (lambda _: changed(antenna_position=lambda p: p.T), "antenna_position has shape (3, 400), but must have (400, 3)"),
    (lambda _: changed(range_frequency=lambda _: None), "signal is given without range_frequency; give its axis"),
    (lambda _: changed(range_frequency=lambda f: f / 1e6), "range_frequency"),
    (lambda _: changed(echo=lambda _: arrays()["signal"]), "signal and echo are both given"),
    (lambda _: changed(signal=lambda s: s * np.nan), "signal of the dataset holds no finite sample; check"),
    (lambda _: changed(signal=lambda s: s * 0), "signal of the dataset holds zeros only; fill it"),
    (lambda _: changed(carrier_frequency=lambda _: 10.0), "carrier_frequency"),
    (lambda _: changed(targets=lambda _: [{"name": "A"}]), "target {'name': 'A'} cannot be read; give it name"),
    (lambda _: changed(channel=lambda _: "HH"), "channel is 'HH'; give a list of names"),
    (lambda _: changed(signal=two, channel=lambda _: ["HH"]), "signal has shape (2, 400, 96), but must have (1, 400"),
    (lambda _: changed(signal=two), "signal has shape (2, 400, 96), but must have (400, 96)"),
    (lambda ds: blocksar.plan(ds.assign_attrs(made=object())), "the dataset: attribute made = <object"),
    (
        lambda ds: blocksar.plan(ds.assign_coords(time=("pulse", (1e9 * ds.time.values).astype("m8[ns]")))),
        "the dataset: time is timedelta64[ns], but must be float64 in s; convert it",
    ),
    (lambda _: blocksar.compare("run", "run", "pair", window=(7, 7, 7)), "window = (7, 7, 7): give pixels along y"),
    (lambda _: blocksar.collection(**{**arrays(), "targets": 5}), "targets is 5; give a list"),
    (lambda _: checked_colour_map(3), "colour map 3 is none that matplotlib knows; did you mean"),
    (lambda _: checked_size("large"), "size = 'large': give 200 to"),
    (lambda _: stated_times(3, None), "--collection-start '3' is not a date"),  # type: ignore[arg-type]
    (lambda _: stated_times(None, "noon"), "--time-zero is 'noon' s; give the seconds"),  # type: ignore[arg-type]
]  # fmt: skip


@pytest.mark.parametrize("row", GIVEN, ids=lambda row: row[1])
def test_what_python_is_given(row: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    call, sentence = row
    said = refused(lambda: call(blocksar.collection(**arrays())))
    assert said.startswith(sentence), said
    assert not list(tmp_path.iterdir())


# Fields of a phase history


def put(dataset: xr.Dataset, name: str, dims: Any, values: Any) -> xr.Dataset:
    """A dataset with other values of a variable, in the units that it has."""
    attrs = dataset[name].attrs if name in dataset else {}
    return dataset.assign({name: (dims, values, attrs)})


def in_units(name: str, units: str) -> Callable[[xr.Dataset], xr.Dataset]:
    return lambda dataset: dataset.assign({name: dataset[name].assign_attrs(units=units)})


def without(attribute: str) -> Callable[[xr.Dataset], xr.Dataset]:
    def change(dataset: xr.Dataset) -> xr.Dataset:
        dataset.attrs = {name: value for name, value in dataset.attrs.items() if name != attribute}
        return dataset

    return change


def stepped(values: Any, where: int) -> Any:
    """A copy with one pulse 9 m away."""
    values = values.copy()
    values[where] += 9.0
    return values


N = 400
PATTERN = np.array([-0.1, 0.1])
Fields = Callable[[Collection], dict[str, Any]]
# Values of a collection whose beam is steered in yaw, or of one whose beam turns about its axis, and what is said.
STEERED: dict[str, tuple[Fields, str]] = {
    "absolute range frequency": (
        lambda c: {"range_frequency": c.carrier + c.range_frequency},
        r"range_frequency is 9\.57.*e\+09 \.\. .* looks absolute; subtract the carrier",
    ),
    "yaw in degrees": (
        lambda c: {"beam_azimuth": np.degrees(c.beam_azimuth)},
        r"beam_azimuth is 48\..* \.\. 51\..* rad, more than two turns throughout; it looks like degrees",
    ),
    "yaw in degrees, through zero": (
        lambda c: {"beam_azimuth": np.linspace(0.0, 150.0, c.n_pulse)},
        r"beam_azimuth reaches 150 rad, beyond the 100 rad that can be meant",
    ),
    **{
        f"yaw that jumps at pulse {first}": (
            lambda c, first=first: {"beam_azimuth": c.beam_azimuth + 0.5 * (np.arange(c.n_pulse) >= first)},
            r"jumps by 0\.50",
        )
        for first in (100, 255)
    },
    "yaw missing here and there": (lambda c: {"beam_azimuth": np.r_[np.nan, np.ones(255)]}, "beam_azimuth is NaN"),
    "width in degrees": (lambda c: {"beam_width": 4.25}, r"beam_width .* got 4\.25; it looks like degrees"),
    "time in us": (
        lambda c: {"time": c.time / 1e3},
        r"moves at 200272 m/s, but platforms move at up to 20000 m/s: .* or of time",
    ),
    "time in us instead of s": (lambda c: {"time": c.time * 1e6}, r"moves at 0\.000.* m/s, .* or of time"),
    "time that descends": (lambda c: {"time": -c.time}, "time does not ascend"),
    "time that jumps": (lambda c: {"time": c.time + (c.time > 0)}, "time leaps by 1"),
    "time that is missing once": (lambda c: {"time": np.r_[np.nan, c.time[1:]]}, "time is not finite at 1 of"),
    "track in mm": (lambda c: {"antenna_position": c.antenna_position * 1e3}, r"moves at 200272 m/s"),
    "carrier that is no number": (lambda c: {"carrier": np.nan}, "carrier_frequency .* nan"),
    "ground above the antenna": (lambda c: {"ground_height": 6000.0}, "ground_height"),
    **{
        f"{name} of one pulse elsewhere, {where}": (
            lambda c, name=name, where=where: {name: stepped(getattr(c, name), where)},
            f"{name} leaves its neighbours by .* m at pulse ",
        )
        for name in ("antenna_position", "reference_range")
        for where in (31, 255)
    },
}  # fmt: skip
TURNING: dict[str, tuple[dict[str, Any], str]] = {
    "both kinds": ({"beam_azimuth": np.linspace(0, 0.1, N)}, "beam_azimuth and beam_axis are both given"),
    "no steering": ({"beam_steering": None}, "beam_axis is given without beam_steering"),
    "no axis": ({"beam_axis": None}, "beam_steering is given without beam_axis"),
    "no unit vector": ({"beam_axis": np.tile([0.0, 1.01, 0.0], (N, 1))}, r"length of 1\.01 .* must be a unit vector"),
    "axis is NaN": ({"beam_axis": np.full((N, 3), np.nan)}, "beam_axis is not finite at 400 of 400 pulses"),
    "steering is NaN": ({"beam_steering": np.append(np.zeros(N - 1), np.nan)}, r"first: pulse 399"),
    "axis of another shape": ({"beam_axis": np.ones((N, 2))}, r"beam_axis has shape \(400, 2\)"),
    "steering of another shape": ({"beam_steering": np.zeros(3)}, r"beam_steering has shape \(3,\)"),
    "no width": ({"beam_width": None}, "beam_width must lie between 0 and pi rad where beam_axis"),
    "a width that is no number": ({"beam_width": np.nan}, r"beam_width must lie between 0 and pi rad .* got nan"),
    "width in degrees": ({"beam_width": 12.0}, "it looks like degrees"),
    "steered along the axis": ({"beam_steering": np.full(N, 1.6)}, r"beam_steering is 1\.6 rad .* below pi / 2"),
    "steering jumps": ({"beam_steering": np.repeat([0.0, 0.1], N // 2)}, "jumps by 0.1 rad at pulse 200"),
    "axis jumps": (
        {"beam_axis": np.repeat([[0, 1.0, 0], [0, -1.0, 0]], N // 2, axis=0)}, "beam_axis jumps by 2 rad at pulse 200"
    ),
    "another side": ({"side_of_track": "port"}, r"side_of_track is 'port'; it must be 'left' or 'right'"),
    "pattern without angles": ({"beam_pattern": np.ones(3)}, "beam_pattern is given without beam_offset"),
    "pattern without a beam": (
        {"beam_axis": None, "beam_steering": None, "beam_width": None, "beam_offset": PATTERN,
         "beam_pattern": np.ones(2)}, "neither beam_azimuth nor beam_axis",
    ),
    "absurd pattern": (
        {"elevation": np.array([0.1, 1.2]), "elevation_pattern": np.full(2, 1e-300)}, "is 1e-300 at most, which no"
    ),
    "angles without pattern": ({"elevation": np.ones(3)}, "elevation is given without elevation_pattern"),
    "narrow pattern": (
        {"beam_offset": PATTERN / 100, "beam_pattern": np.ones(2)},
        r"beam_pattern covers beam_offset = -0\.001 .* give it for all of that",
    ),
    "elevation elsewhere": (
        {"elevation": np.array([1.0, 1.2]), "elevation_pattern": np.ones(2)}, "ground at reference_range needs 0.41"
    ),
    "pattern descends": ({"beam_offset": -PATTERN, "beam_pattern": np.ones(2)}, "beam_offset does not ascend at index"),
    "pattern is negative": (
        {"beam_offset": PATTERN, "beam_pattern": np.array([1, -1.0])}, "an amplitude: at least 0"
    ),
    "pattern is NaN": ({"beam_offset": PATTERN, "beam_pattern": np.array([1, np.nan])}, "is not finite at 1 of"),
    "pattern of another length": (
        {"beam_offset": PATTERN, "beam_pattern": np.ones(3)}, r"shape \(3,\) and beam_offset has \(2,\)"
    ),
    "noise": ({"noise_power": -1.0}, "noise_power must be 0 or between 1e-30 and 1e"),
    "loud noise": ({"noise_power": 1e300}, "noise_power must be 0 or between 1e-30 and 1e"),
}  # fmt: skip
# Changes of a phase history of one of three kinds as a file has it, and what is said.
PLACE = {"kind": "ENU", "latitude": 45.0, "longitude": 9.5, "height": 100.0}
FORMS: dict[str, tuple[str, Callable[[xr.Dataset], xr.Dataset], str]] = {
    "no track": ("steered", lambda d: d.drop_vars("antenna_position"), "antenna_position .* is missing"),
    "no carrier": ("steered", without("carrier_frequency"), "carrier_frequency is missing"),
    "no beam width": ("steered", without("beam_width"), "beam_width"),
    "beam width alone": ("steered", lambda d: d.drop_vars("beam_azimuth"), "beam_width"),
    "track by rows": ("steered", lambda d: d.transpose("range_frequency", "axis", "pulse"), "transpose"),
    "real samples": ("steered", lambda d: d.assign(signal=d.signal.real.astype(float)), "signal is float64, but must"),
    "no names of its own": (
        "steered", lambda d: d.rename(pulse="line"), r"has dimensions \(line(, range_frequency)?\), but",
    ),
    "two components": ("steered", lambda d: d.isel(axis=slice(2)), r"antenna_position has shape \(256, 2"),
    "one position": ("steered", lambda d: put(d, "antenna_position", "axis", np.ones(3)), "position has dimensions"),
    "an absolute axis": ("steered", lambda d: d.assign_coords(
        range_frequency=("range_frequency", -9.7e9 + np.arange(128.0), {"units": "Hz"})), "baseband"),
    "time in ms": ("steered", in_units("time", "ms"), "time is in 'ms'"),
    "a track in km": ("steered", in_units("antenna_position", "km"), "antenna_position is in 'km', but must be in m;"),
    "a pattern in degrees": ("patterns", in_units("beam_offset", "degrees"), "beam_offset is in 'degrees', but must"),
    "an axis by rows": (
        "patterns", lambda d: d.assign(beam_axis=d.beam_axis.T), r"beam_axis has dimensions \(axis, pulse\).*transpose",
    ),
    "both kinds of samples": (
        "steered", lambda d: put(d, "echo", ("pulse", "fast_time"), np.zeros((256, 9), "c8")), "both signal and echo"
    ),
    "a raw echo without its rate": ("raw", without("chirp_rate"), "chirp_rate is missing"),
    "a raw echo without its width": ("raw", without("pulse_width"), "pulse_width is missing"),
    "a window of compression": (
        "steered", lambda d: d.assign_attrs(recorded={"near": 1.0}), "it must have near, far and pulse in m, and part"
    ),
    "a window that ends before it begins": (
        "steered",
        lambda d: d.assign_attrs(recorded={"near": 9e3, "far": 1.0, "pulse": 600.0, "partial": True}),
        "near below far",
    ),
    "channels without names": ("channels", lambda d: d.drop_vars("channel"), "variable channel .* is missing"),
    "channels of one name": ("channels", lambda d: d.assign_coords(channel=["HH", "HH"]), "a name twice"),
    "a channel elsewhere": ("channels", lambda d: d.assign_coords(channel=["HH", "../x"]), "is no name of a channel"),
    **{
        f"georeference: {sentence}": (
            "steered", lambda d, georeference=georeference: d.assign_attrs(georeference=georeference), sentence
        )
        for georeference, sentence in (
            ("EPSG:4326", "georeference is str instead of a mapping"),
            (PLACE | {"kind": "NED"}, "of kind 'NED'"),
            (PLACE | {"latitude": "1 N"}, "latitude is '1 N'"),
            (PLACE | {"latitude": 91.0}, r"latitude is 91.*, which is not in -90 \.\. 90"),
            (PLACE | {"height": 1e6}, "height is 1000000"),
            (PLACE | {"up": [0, 0, 1]}, "up is not that of its latitude"),
            (PLACE | {"east": [0, 1]}, "east is .* instead of three numbers"),
            (PLACE | {"ecef": [6378137.0, 0, 0]}, "ecef lies 4.* m from its latitude"),
        )
    },
}  # fmt: skip
ATTRIBUTES = {"carrier": "carrier_frequency", "beam_width": "beam_width", "ground_height": "ground_height",
              "noise_power": "noise_power", "side_of_track": "side_of_track"}  # fmt: skip
DIMS = {name: variable.dims for name, variable in stores.PHASE_HISTORY.items()} | {
    "beam_axis": ("pulse", "axis"), "beam_steering": ("pulse",), "beam_pattern": ("beam_offset",),
    "beam_offset": ("beam_offset",), "elevation_pattern": ("elevation",), "elevation": ("elevation",),
}  # fmt: skip


@pytest.fixture(scope="module")
def bases(small_collection: Collection, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Collections, and their phase histories as another program reads them."""
    folder = tmp_path_factory.mktemp("bases")
    turning, rate = axis_collection(), 60e6
    echo = RawEcho(fast_time=80e-6 + np.arange(1200) / rate, chirp_rate=5e12, pulse_width=10e-6, sampling_rate=rate)
    stores.create_phase_history(folder / "steered", small_collection)
    stores.create_phase_history(folder / "turning", turning)
    stores.create_phase_history(folder / "patterns", with_patterns(turning))
    stores.create_phase_history(folder / "raw", small_collection, raw=echo)
    stores.create_phase_history(folder / "channels", small_collection, channels=("HH", "HV"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # zarr's, about text
        opened = {path.name: xr.open_zarr(path, chunks=None).load() for path in folder.iterdir()}
    return {"collections": {"steered": small_collection, "turning": turning}, "datasets": opened}


def check_history(dataset: xr.Dataset, path: Path, sentence: str) -> None:
    """Check what is said of a phase history in memory, and of its store."""
    said = refused(lambda: stores.history_of(dataset))
    assert re.search(sentence, said), said
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # zarr's, about text
        dataset.drop_encoding().to_zarr(path, zarr_format=3, consolidated=False)
    said = refused(lambda: stores.open_phase_history(path))
    assert re.search(sentence, said) and str(path) in said, said


CHANGED = [("steered", name, *row) for name, row in STEERED.items()] + [
    ("turning", name, lambda _, changes=row[0]: changes, row[1])
    for name, row in TURNING.items()  # type: ignore[misc]
]


@pytest.mark.parametrize("row", CHANGED, ids=lambda row: f"{row[0]}: {row[1]}")
def test_fields_of_a_collection(row: Any, bases: dict[str, Any], tmp_path: Path) -> None:
    kind, _, change, sentence = row
    collection, dataset = bases["collections"][kind], bases["datasets"][kind].copy()
    changes = change(collection)
    said = refused(lambda: replace(collection, **changes))
    assert re.search(sentence, said), said
    shaped = all(value is None or np.shape(value) == np.shape(getattr(collection, name))
                 for name, value in changes.items() if name not in ATTRIBUTES)  # fmt: skip
    left_out = any(value is None for value in changes.values())
    if not shaped or left_out or (kind == "turning" and "beam_azimuth" in changes):
        return  # what has another shape or is left out is named as a variable of the dataset
    for name, value in changes.items():
        if name in ATTRIBUTES:
            dataset.attrs[ATTRIBUTES[name]] = value
        else:
            dataset = put(dataset, name, DIMS[name], value)
    check_history(dataset, tmp_path / "ph.zarr", sentence)


@pytest.mark.parametrize("name", FORMS)
def test_forms_of_a_phase_history(name: str, bases: dict[str, Any], tmp_path: Path) -> None:
    kind, change, sentence = FORMS[name]
    check_history(change(bases["datasets"][kind].copy()), tmp_path / "ph.zarr", sentence)


# Scenes


def with_lines(**replaced: str) -> str:
    """The scene with some lines replaced: key = whole new text of that line."""
    lines = [replaced.pop(line.split(" = ")[0], line) for line in SCENE.strip().splitlines()]
    assert not replaced
    return "\n".join([*lines, ""])


STRIP = 'mode = "stripmap"\nwidth_deg = 1.0'
# The text of a scene file, and the beginning of what is said of its field.
SCENES = {
    with_lines(range_sampling="range_sampling = 30e6"): "radar.range_sampling = 3e+07: must be at least the bandwidth",
    with_lines(swath="swath = [5140.0, 4960.0]"): "scene.swath = [5140, 4960]: must be [near, far]",
    with_lines(dwell="width_deg = 8\ndwell = 0.06"): "beam: both given: give either dwell (s) or width_deg",
    with_lines(pulses="pulses = 101\nduration = 1.0"): "time: both given: give either duration (s) or pulses",
    with_lines(pulses="duration = 5e-3"): "time.duration = 0.005: gives 5 pulses; must give 8",
    with_lines(velocity=""): "track.velocity missing: a track needs position and velocity",
    with_lines(title='name = "x"'): "name = 'x': unknown key",
    with_lines(range="range = 5050.0\nscattering = {HV = [0.5, 90.0]}"): (
        "targets[0].scattering.HV: must be one of channels"
    ),
    with_lines(title='channels = ["HV", "HV"]'): "channels",
    f"{SCENE}[dropped]\nfraction = 0.2\n": "dropped.seed missing: fraction needs one",
    f"{SCENE}[dropped]\npulses = [200, -1]\n": "dropped = [-1, 200]: must be indices of the 200 pulses, 0 to 199",
    f"{SCENE}[track.error]\ndrift = [1.0, 2.0]": "track.error.drift = [1.0, 2.0]: has too few elements ([x, y, z], m",
    f"{SCENE}[track.error]\nposition_random_walk = [1.0, 0.0, 0.0]": (
        "track.error.seed missing: position_random_walk needs one"
    ),
    f"{SCENE}[[track.error.vibration]]\nrms = [1.0, 0.0, 0.0]\nband = [30.0, 3.0]\n[track.error]\nseed = 1": (
        "track.error.vibration[0].band = [30, 3]: must be [low, high] with 0 < low < high, Hz"
    ),
    **{
        axis_scene(beam): said
        for beam, said in {
            'mode = "scan"': "beam.mode = 'scan'",
            'mode = "stripmap"': "beam.width_deg missing: mode = 'stripmap' needs it",
            'mode = "tops"\nwidth_deg = 1.0\nrate_deg = 1.0\nstart_deg = 1.0': (
                "beam.start_deg given with mode = 'tops'"
            ),
            'mode = "tops"\nwidth_deg = 1.0': "beam: nothing given with mode = 'tops': give rate_deg or squint_deg",
            f"{STRIP}\nrate_deg = 1.0": "beam.rate_deg given with mode = 'stripmap'",
            "start_deg = 1.0\nstop_deg = 2.0\nwidth_deg = 1.0\nrate_deg = 1.0": "beam.rate_deg given without",
            f"{STRIP}\naxis_pitch_deg = 1.0": "beam.axis_yaw_deg missing",
            f'{STRIP}\nelevation_pattern = "sinc2"': "beam.elevation_width_deg = None: goes with",
            "width_deg = 1.0": "beam.start_deg, stop_deg missing: give start_deg and stop_deg, or mode",
        }.items()
    },
}  # fmt: skip


@pytest.mark.parametrize("scene", SCENES, ids=SCENES.values())
def test_fields_of_a_scene(scene: str, tmp_path: Path) -> None:
    file = tmp_path / "my.toml"
    file.write_text(scene)
    for call in (lambda: blocksar.plan(file), lambda: blocksar.simulate(file, tmp_path / "ph.zarr")):
        with pytest.raises(InputError) as caught:
            call()
        header, problem = str(caught.value).split("\n  ")
        assert header.endswith("my.toml has 1 wrong field:") and problem.startswith(SCENES[scene]), problem
    assert os.listdir(tmp_path) == ["my.toml"]
