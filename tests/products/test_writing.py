"""Common behaviour of all products: reading in strips, full disks, existing files and invalid input."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from missing_library import hide
from sicd_files import read_sicd
from sidd_files import read_sidd
from small_run import Made, make
from typer.testing import CliRunner

import blocksar
from blocksar import stores
from blocksar.cli import commands
from blocksar.errors import InputError, NoRoom
from blocksar.places.local import LocalPlace
from blocksar.products import writing
from blocksar.runs import finished

pytestmark = pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")  # by affine, in rioxarray


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "pixel"), [("sicd", 8), ("sidd", 2), ("geotiff", 4)])
def test_a_product_that_does_not_fit_the_disk_is_not_begun(
    kind: Any, pixel: int, made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(LocalPlace, "free", lambda _: pixel * made.image.size - 1)
    with pytest.raises(NoRoom, match=r"product needs .* of disk, and .* are free there; make room, or choose another"):
        blocksar.export(kind, made.folder, tmp_path / "product")
    assert not list(tmp_path.iterdir())
    monkeypatch.setattr(LocalPlace, "free", lambda _: pixel * made.image.size)
    blocksar.export(kind, made.folder, tmp_path / "product")


@pytest.mark.parametrize("kind", ["sicd", "sidd", "geotiff", "png"])
def test_products_do_not_depend_on_the_strip_size(
    kind: Any, made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No product reads more than a strip at once."""
    options: Any = {"range": "-40:0"} if kind == "sidd" else {}  # which is not chosen by a look at the whole image
    blocksar.export(kind, made.folder, tmp_path / "whole", **options)
    largest, read = 0, finished.FinishedRun.read

    def watched(self: finished.FinishedRun, rows: slice, columns: slice) -> Any:
        nonlocal largest
        values = read(self, rows, columns)
        largest = max(largest, values.size)
        return values

    monkeypatch.setattr(finished, "STRIP", 1000)
    monkeypatch.setattr(finished.FinishedRun, "read", watched)
    blocksar.export(kind, made.folder, tmp_path / "strips", **options)
    if kind != "png":  # the picture has as few pixels as the image here
        assert 0 < largest <= 1000
    if kind == "sidd":
        np.testing.assert_array_equal(read_sidd(tmp_path / "whole").pixels, read_sidd(tmp_path / "strips").pixels)
    elif kind == "sicd":
        np.testing.assert_array_equal(read_sicd(tmp_path / "whole").pixels, read_sicd(tmp_path / "strips").pixels)
    else:
        assert (tmp_path / "whole").read_bytes() == (tmp_path / "strips").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["geotiff", "png"])
def test_what_a_killed_process_has_left_of_a_product_goes(kind: Any, made: Made, tmp_path: Path) -> None:
    for name in (".whole.0123abcd.part", "..whole.0123abcd.part.0123abce.part"):
        (tmp_path / name).write_text("half")
    blocksar.export(kind, made.folder, tmp_path / "whole")
    assert os.listdir(tmp_path) == ["whole"]


def test_coverage_matches_the_finite_pixels(made: Made) -> None:
    found, covered = made.source.coverage(), np.isfinite(made.image)
    for first, last, along in ((*found[:2], covered), (*found[2:], covered.T)):
        for i, line in enumerate(along):
            there = np.flatnonzero(line)
            assert (first[i], last[i]) == ((there[0], there[-1]) if there.size else (line.size, -1))


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return make(tmp_path_factory.mktemp("large"), size=(520, 300), step=0.1)


@pytest.mark.slow
def test_a_full_disk_leaves_no_partial_file(large: Made, tmp_path: Path) -> None:
    """GDAL does not report a failure of its last write, and raises errors of its own for earlier ones."""
    blocksar.export("geotiff", large.folder, tmp_path / "whole", content="complex")
    size = (tmp_path / "whole").stat().st_size
    (tmp_path / "out").mkdir()
    out = str(tmp_path / "out" / "file")
    program = (
        "import resource, blocksar, rasterio\n"
        "from blocksar.errors import ProcessingError\n"
        f"for room in {size // 2 - 2}, {size - 2}:\n"
        "    resource.setrlimit(resource.RLIMIT_FSIZE, (room, resource.RLIM_INFINITY))\n"
        f"    try: blocksar.export('geotiff', {str(large.folder)!r}, {out!r}, content='complex')\n"
        "    except ProcessingError as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.stdout.count("cannot be written") == 2, done.stdout + done.stderr
    assert list((tmp_path / "out").iterdir()) == []


# ---------------------------------------------------------------- refused input and existing files


@pytest.mark.parametrize("kind", ["sicd", "sidd", "geotiff", "png", "stac"])
def test_an_existing_file_is_kept_unless_overwrite_is_given(kind: Any, made: Made, tmp_path: Path) -> None:
    out = tmp_path / "file"
    out.write_text("mine")
    arguments = ["export", kind, str(made.folder), "--out", str(out), "--quiet"]
    done = CliRunner().invoke(commands.app, arguments)
    assert (done.exit_code, out.read_text()) == (2, "mine")
    assert "exists; choose another name" in done.stderr
    assert CliRunner().invoke(commands.app, [*arguments, "--overwrite"]).exit_code == 0
    assert out.stat().st_size > 1000
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["sicd", "sidd", "geotiff", "png"])
def test_a_damaged_chunk_leaves_the_existing_file(kind: Any, tmp_path: Path) -> None:
    run = make(tmp_path / "run", size=(60, 140))
    chunk = run.folder / "image.zarr" / "image" / "c" / "1" / "0"
    chunk.write_bytes(chunk.read_bytes()[:-8])
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "file").write_text("mine")
    with pytest.raises(InputError, match="damaged"):
        blocksar.export(kind, run.folder, tmp_path / "out" / "file", overwrite=True)
    assert [(p.name, p.read_text()) for p in (tmp_path / "out").iterdir()] == [("file", "mine")]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["sicd", "sidd", "geotiff", "png", "stac"])
def test_a_folder_without_write_permission_is_wrong_input_for_every_format(
    kind: Any, made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """GDAL would raise an error of its own. Root may write everywhere, so the test simulates the system error."""

    def refused(*_: Any, **__: Any) -> Any:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(writing, "new_file", refused)
    with pytest.raises(InputError, match=r"cannot be written \(Permission denied\)"):
        blocksar.export(kind, made.folder, tmp_path / "file")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_an_image_without_a_covered_pixel_is_refused(tmp_path: Path) -> None:
    empty = make(tmp_path / "empty", size=(40, 40))
    whole = (slice(0, 40), slice(0, 40))
    stores.write_region(empty.folder / "image.zarr", "block", whole, np.full((40, 40), -1, np.int16))
    with pytest.raises(InputError, match="has no covered pixel"):
        blocksar.export("sicd", empty.folder, tmp_path / "a.nitf")


@pytest.mark.parametrize(
    ("kind", "library", "extra"),
    [
        ("sicd", "sarkit", "formats"),
        ("sidd", "sarkit", "formats"),
        ("geotiff", "rasterio", "geotiff"),
        ("png", "matplotlib", "plots"),
        ("stac", "shapely", "formats"),
    ],
)
def test_a_missing_library_is_reported_with_its_extra(
    kind: Any, library: str, extra: str, made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hide(library, "blocksar.products.pictures", patch=monkeypatch)
    with pytest.raises(InputError, match=rf"{library} is not installed.*install blocksar\[{extra}\]$"):
        blocksar.export(kind, made.folder, tmp_path / "file")
    assert not (tmp_path / "file").exists()
