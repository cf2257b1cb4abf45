"""Products of other packages stand beside the own ones, in help, commands, Python and messages."""

from __future__ import annotations

import json
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from extension import Ended, install
from matplotlib.image import imread
from small_run import DAYTON, TARGETS, Made

from blocksar.options import options_of
from blocksar.products.registry import PRODUCTS

# What a session in Python says of calls, each a list of arguments and keywords, and whether the package is loaded then;
# and what commands leave after them.
SESSION = """
import json, sys
import blocksar
each, commands = map(json.loads, sys.argv[1:])
said = []
for arguments, keywords in each:
    try:
        answer = blocksar.export(*arguments, **keywords).summary
    except blocksar.InputError as error:
        answer = str(error)
    said.append((answer, "blocksar_extension.product" in sys.modules))
from typer.testing import CliRunner
from blocksar.cli.commands import app
done = [CliRunner().invoke(app, words, prog_name="blocksar") for words in commands]
print(json.dumps((said, [(one.exit_code, one.stdout, one.stderr) for one in done])))
"""


def session(environment: dict[str, str], calls: list[Any], commands: list[Any]) -> tuple[list[Any], list[Ended]]:
    words = (sys.executable, "-c", SESSION, json.dumps(calls), json.dumps(commands))
    run = subprocess.run(words, env=environment, capture_output=True, text=True, check=True)
    said, done = json.loads(run.stdout)
    return said, [Ended(*each) for each in done]


@pytest.mark.slow
def test_a_product_of_another_package_has_a_command_and_is_one_in_python(made: Made, tmp_path: Path) -> None:
    run, out, drawn = str(made.folder), tmp_path / "image.kml", str(tmp_path / "a")
    said, (listed, helped, done) = session(
        install(tmp_path / "site"),
        [
            (("png", run, f"{drawn}.png"), {"size": 200}),
            (("kml", run, f"{drawn}.kml"), {"opacity": 2}),
            (("kml", run, f"{drawn}.kml"), {"opacity": 0.25}),
            (("kmz", run, f"{drawn}.kmz"), {}),
            (("png", run, f"{drawn}.png"), {"opacity": 0.25}),
            (("png", run, f"{drawn}.kml"), {}),
        ],
        [
            ("export", "--help"),
            ("export", "kml", "--help"),
            ("export", "kml", run, "--out", str(out), "-q", "--opacity", "0.5"),
        ],
    )
    assert [loaded for _, loaded in said] == [False, *[True] * 5]  # what is not asked for costs nothing
    _, wrong, written, kind, option, ending = (answer for answer, _ in said)
    assert wrong == "opacity = 2: give a number from 0 to 1"
    assert written[-1] == f"wrote {drawn}.kml" and "<color>40ffffff" in Path(f"{drawn}.kml").read_text()
    assert kind == "kind is 'kmz'; it must be 'sicd', 'sidd', 'geotiff', 'png', 'stac' or 'kml'"
    assert option == "opacity is 0.25, but it is an option of kml only; leave it out"
    assert ending == f"{drawn}.kml ends in .kml, which is that of kml; give png a name that ends in .png"

    assert all(name in listed.stdout for name in PRODUCTS.own)
    assert "│ kml      Lay the image over the Earth, as a KML file." in listed.stdout
    shown = " ".join(helped.stdout.split())
    assert "A picture is written beside it." in shown and "--out image.kml" in shown
    assert "--opacity SHARE Of the picture, from 0 to 1. [default: 1.0]" in shown

    assert done.returncode == 0 and f"wrote {out}" in " ".join(done.stdout.split()), done.stderr
    overlay = ET.parse(out).getroot()[0]
    assert overlay[0].text == "80ffffff" and overlay[1][0].text == "image.kml.png"
    west, south, east, _, _, north, _, _ = map(float, (overlay[2][0].text or "").replace(",", " ").split())
    picture = imread(tmp_path / "image.kml.png")[..., 0]
    rows, columns = picture.shape
    for target in TARGETS:  # white, where the file says that they are
        latitude, longitude, _ = DAYTON.to_geodetic(np.array([target.x, target.y, 0.0]))
        row, column = (north - latitude) / (north - south) * rows, (longitude - west) / (east - west) * columns
        assert picture[int(row), int(column)] > 0.95


@pytest.mark.parametrize("name", PRODUCTS.own)
def test_an_own_product_has_all_that_one_needs(name: str) -> None:
    product = PRODUCTS.get(name)
    assert "\n" not in product.summary.partition("\n\n")[0] and product.summary.endswith(".")
    assert all(ending.startswith(".") for ending in product.endings)
    assert all(each.default is None and each.option.help.endswith(".") for each in options_of(product.options))
