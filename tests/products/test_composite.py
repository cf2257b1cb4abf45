"""Pauli composites of a run with several polarisations."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread
from report_page import read
from sicd_files import errors, read_sicd
from typer.testing import CliRunner

import blocksar
from blocksar.cli import commands
from blocksar.errors import InputError
from blocksar.places import place
from blocksar.products.pictures import composite
from blocksar.runs.finished import FinishedRun


def sources_of(run: Path, names: tuple[str, ...] = ("HH", "HV", "VV")) -> dict[str, FinishedRun]:
    return {name: FinishedRun.open(place(run / "channels" / name)) for name in names}


def images_of(sources: dict[str, FinishedRun]) -> Any:
    read = (source.read(slice(0, source.y.size), slice(0, source.x.size)) for source in sources.values())
    return dict(zip(sources, (image.astype(np.complex128) for image in read), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("names", [("HH", "VH", "VV"), ("HH", "HV", "VH", "VV")])
def test_colours_are_mean_powers_of_the_pauli_vector(polarised: Path, names: tuple[str, ...]) -> None:
    alone = sources_of(polarised)
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


@pytest.mark.slow
def test_a_composite_shows_kinds_of_scattering_in_their_colours(polarised: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(
        commands.app,
        [
            "export",
            "png",
            str(polarised),
            "--out",
            str(tmp_path / "a.png"),
            "--composite",
            "pauli",
            "--range=-20:0",
            "-q",
        ],
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


def test_a_composite_is_cropped_and_needs_its_channels(polarised: Path, tmp_path: Path) -> None:
    options: dict[str, Any] = {"composite": "pauli", "crop": "-10:10,-10:10", "size": 400}
    blocksar.export("png", polarised, tmp_path / "part.png", **options)
    assert max(imread(tmp_path / "part.png").shape[:2]) == 400
    for more, said in (
        ({"channel": "HH"}, "channel is 'HH', but a composite has"),
        ({"colour_map": "viridis"}, "colour_map is 'viridis', but a composite"),
        ({"composite": "paul"}, "composite is 'paul'; it must be 'pauli'"),
    ):
        with pytest.raises(InputError, match=said):
            blocksar.export("png", polarised, tmp_path / "no.png", **{**options, **more})
    with pytest.raises(InputError, match=r"takes the channels HH, VV and HV or VH, and .*HH has none"):
        blocksar.export("png", polarised / "channels" / "HH", tmp_path / "no.png", **options)
    with pytest.raises(InputError, match="and RUN has HH, VV; leave it out"):
        composite.pauli_channels(("HH", "VV"), "RUN")
    with pytest.raises(InputError, match="composite is 'pauli', but it is an option of png only"):
        blocksar.export("geotiff", polarised, tmp_path / "no.tif", composite="pauli")
    assert composite.pauli_channels(("vv", "hh", "vh"), "RUN") == {"HH": "hh", "VH": "vh", "VV": "vv"}
    assert not list(tmp_path.glob("no*"))


@pytest.mark.slow
def test_the_report_pages_have_the_composite(polarised: Path) -> None:
    """On each channel's page: the colours of the picture, at the picture's place, in the levels that are stated."""
    blocksar.report(polarised)
    reduced, power = composite.pauli_powers(sources_of(polarised), max_pixels=800)
    with np.errstate(divide="ignore"):
        decibel = 10 * np.log10(power)[::-1]
    for name in ("HH", "HV", "VV"):
        page = read(polarised / "channels" / name / "report.html")
        assert page.text("h1").endswith(f", {name}") and "red |HH \N{MINUS SIGN} VV|" in page.text()
        (shown,) = (attrs for attrs in page.all("image") if attrs.get("id") == "composite")
        assert shown["display"] == "none" and any(b.get("id") == "toggle-composite" for b in page.all("button"))
        assert float(shown["width"]) == pytest.approx(reduced.x_edges[-1] - reduced.x_edges[0])
        levels = imread(io.BytesIO(base64.b64decode(shown["href"].partition(",")[2])), format="webp")
        bottom, top = float(shown["data-bottom"]), float(shown["data-top"])
        assert bottom < float(shown["data-black"]) < float(shown["data-white"]) < top
        said = bottom + levels[..., :3] / 255 * (top - bottom)
        covered = levels[..., 3] > 0
        assert np.array_equal(covered, np.isfinite(power[::-1, :, 0]))
        assert np.abs(said - decibel.clip(bottom, top))[covered].max() < 0.51 * (top - bottom) / 255


@pytest.mark.slow
def test_exports_say_the_channel(polarised: Path, tmp_path: Path) -> None:
    for given, wanted in ((None, "HH"), ("hv", "HV")):
        out = tmp_path / f"{wanted}.nitf"
        said = blocksar.export("sicd", polarised, out, channel=given).summary
        assert said[0] == f"channel {wanted} of HH, HV, VV" + ("" if given else "; --channel chooses another")
        found = read_sicd(out)
        assert errors(found.checked) == []
        assert found.load("RadarCollection/TxPolarization") == wanted[0]
        assert found.load("ImageFormation/TxRcvPolarizationProc") == ":".join(wanted)
        assert f", {wanted}" in found.load("CollectionInfo/CoreName")
        image = images_of(sources_of(polarised))[wanted]
        assert np.sort(np.abs(found.pixels[found.pixels != 0]))[-9:] == pytest.approx(
            np.sort(np.abs(image[np.isfinite(image)]))[-9:], rel=1e-5
        )
