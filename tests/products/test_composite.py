"""Pauli composites of a run with several polarisations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread
from small_run import make
from typer.testing import CliRunner

import blocksar
from blocksar import stores
from blocksar.cli import commands
from blocksar.errors import InputError
from blocksar.places import place
from blocksar.products.pictures import composite
from blocksar.runs.finished import FinishedRun

# What the targets A, B and C of the small run scatter into HH, HV and VV.
KINDS = {"one bounce": (1, 0, 1), "two bounces": (1, 0, -1), "volume": (0, 0.7, 0)}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of HH, HV and VV: the small run's image, weighted by the part of the scene that a target is in."""
    folder = tmp_path_factory.mktemp("composite") / "run"
    for number, name in enumerate(("HH", "HV", "VV")):
        made = make(folder / "channels" / name, size=(110, 90))
        east, north = made.x[None, :] > 8, made.y[:, None] > 5
        one, two, volume = (factors[number] for factors in KINDS.values())
        weight = np.where(north, np.where(east, two, volume), one)
        for first in range(0, made.y.size, 64):
            rows = slice(first, min(first + 64, made.y.size))
            image = (weight * made.image)[rows].astype(np.complex64)
            stores.write_region(made.folder / "image.zarr", "image", (rows, slice(0, made.x.size)), image)
    stores.write_json(folder / "run.json", {"status": "finished", "identity": "0", "channels": ["HH", "HV", "VV"]})
    return folder


def sources_of(run: Path, names: tuple[str, ...] = ("HH", "HV", "VV")) -> dict[str, FinishedRun]:
    return {name: FinishedRun.open(place(run / "channels" / name)) for name in names}


def images_of(sources: dict[str, FinishedRun]) -> Any:
    read = (source.read(slice(0, source.y.size), slice(0, source.x.size)) for source in sources.values())
    return dict(zip(sources, (image.astype(np.complex128) for image in read), strict=True))


@pytest.mark.parametrize("names", [("HH", "HV", "VV"), ("HH", "VH", "VV"), ("HH", "HV", "VH", "VV")])
def test_colours_are_mean_powers_of_the_pauli_vector(run: Path, names: tuple[str, ...]) -> None:
    alone = sources_of(run)
    sources = {name: alone["HV" if name == "VH" else name] for name in names}
    told: list[tuple[int, int]] = []
    reduced, power = composite.pauli_powers(sources, max_pixels=40, progress=lambda *n: told.append(n))
    images, n = images_of(alone), 3  # pixels along a cell
    assert power.shape == (30, 37, 3) and told[-1] == (270, 270)
    hh, hv, vv = (np.pad(images[name], [(0, 0), (0, 1)], constant_values=np.nan) for name in ("HH", "HV", "VV"))
    for row, column in np.ndindex(30, 37):
        cell = slice(n * row, n * row + n), slice(n * column, n * column + n)
        span = np.abs(hh[cell]) ** 2 + 2 * np.abs(hv[cell]) ** 2 + np.abs(vv[cell]) ** 2
        if np.isnan(span).all():
            assert np.isnan(power[row, column]).all()
            continue
        wanted = np.array([np.nanmean(np.abs(hh - vv)[cell] ** 2) / 2, 2 * np.nanmean(np.abs(hv)[cell] ** 2),
                           np.nanmean(np.abs(hh + vv)[cell] ** 2) / 2])  # fmt: skip
        np.testing.assert_allclose(power[row, column], wanted, rtol=1e-4, atol=1e-9)
        assert power[row, column].sum() == pytest.approx(np.nanmean(span), rel=1e-4)
    assert np.array_equal(np.isnan(reduced.power), np.isnan(power[..., 0]))


def test_a_composite_shows_kinds_of_scattering_in_their_colours(run: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(
        commands.app,
        ["export", "png", str(run), "--out", str(tmp_path / "a.png"), "--composite", "pauli", "--range=-20:0", "-q"],
    )
    assert done.exit_code == 0, done.stderr
    said = " ".join(done.stdout.split())
    assert "red |HH \N{MINUS SIGN} VV|/\N{SQUARE ROOT}2" in said and "each from -20.0 to 0.0 dB" in said
    red, green, blue = np.moveaxis(imread(tmp_path / "a.png")[..., :3], -1, 0)
    below = slice(red.shape[0] // 12, None)  # without the legend

    def centre(mask: Any) -> Any:
        rows, columns = np.nonzero(mask[below])
        return np.median(rows), np.median(columns)

    bright, dark = 0.75, 0.25
    one = centre((blue > bright) & (red < dark) & (green < dark))
    two = centre((red > bright) & (green < dark) & (blue < dark))
    volume = centre((green > bright) & (red < dark) & (blue < dark))
    assert two[0] < one[0] and volume[0] < one[0]  # B and C lie north of A; pictures count from the top
    assert volume[1] < one[1] < two[1]  # C in the west, and B in the east


def test_a_composite_is_cropped_and_needs_its_channels(run: Path, tmp_path: Path) -> None:
    options: dict[str, Any] = {"composite": "pauli", "crop": "-10:10,-10:10", "size": 400}
    blocksar.export("png", run, tmp_path / "part.png", **options)
    assert max(imread(tmp_path / "part.png").shape[:2]) == 400
    for more, said in (
        ({"channel": "HH"}, "channel is 'HH', but a composite has"),
        ({"colour_map": "viridis"}, "colour_map is 'viridis', but a composite"),
        ({"composite": "paul"}, "composite is 'paul'; it must be 'pauli'"),
    ):
        with pytest.raises(InputError, match=said):
            blocksar.export("png", run, tmp_path / "no.png", **{**options, **more})
    with pytest.raises(InputError, match=r"takes the channels HH, VV and HV or VH, and .*HH has none"):
        blocksar.export("png", run / "channels" / "HH", tmp_path / "no.png", **options)
    with pytest.raises(InputError, match="and RUN has HH, VV; leave it out"):
        composite.pauli_channels(("HH", "VV"), "RUN")
    with pytest.raises(InputError, match="composite is 'pauli', but it is an option of png only"):
        blocksar.export("geotiff", run, tmp_path / "no.tif", composite="pauli")
    assert composite.pauli_channels(("vv", "hh", "vh"), "RUN") == {"HH": "hh", "VH": "vh", "VV": "vv"}
    assert not list(tmp_path.glob("no*"))
