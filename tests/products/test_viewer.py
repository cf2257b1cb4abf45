"""The viewer: its tiles against the image, its server, and its page in a browser."""

from __future__ import annotations

import json
import os
import shutil
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_run import TARGETS, Made, make

import blocksar
from blocksar import stores
from blocksar.kernels.halving import halve
from blocksar.products.viewer import NOTHING, ViewerTiles

CHROMIUM = os.environ.get("BLOCKSAR_CHROMIUM") or next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
# The lightest grey of the rows in the middle of the picture.
BRIGHTEST = """() => {
    const canvas = document.getElementById("scene"), context = canvas.getContext("2d");
    const { data } = context.getImageData(0, canvas.height / 2 - 8, canvas.width, 16);
    let most = 0;
    for (let i = 0; i < data.length; i += 4)
        if (data[i] === data[i + 1] && data[i] === data[i + 2]) most = Math.max(most, data[i]);
    return most;
}"""
HOSTILE = "</script><script>window.pwned = 1</script>"


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """A run of 3 levels of tiles, without a pyramid."""
    targets = [TARGETS[0]._asdict() | {"name": HOSTILE, "reflectivity": [1.0, 0.0]}]
    return make(tmp_path_factory.mktemp("large"), size=(701, 590), step=0.1, more={"targets": targets})


@pytest.fixture(scope="module")
def with_pyramid(large: Made, tmp_path_factory: pytest.TempPathFactory) -> Made:
    """The same with the first level of its pyramid."""
    folder = tmp_path_factory.mktemp("with") / "run"
    shutil.copytree(large.folder, folder)
    level = halve(large.image)
    stores.create(
        folder / "image.zarr" / "pyramid" / "1", {"power": stores.LEVEL["power"]}, coords={}, attrs={}, chunks={},
        sizes=dict(zip("yx", level.shape, strict=True)),
        fill=lambda at: stores.write_region(at, "power", tuple(slice(0, n) for n in level.shape), level),
    )  # fmt: skip
    return Made(folder, large.collection, large.image, large.x, large.y)


@pytest.fixture(scope="module")
def url(large: Made) -> Iterator[str]:
    with blocksar.view(large.folder, browser=False).result as viewer:
        yield viewer.url


def fetch(url: str, **headers: str) -> tuple[int, bytes, Any]:
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=60) as answer:
            return answer.status, answer.read(), answer.headers
    except urllib.error.HTTPError as error:
        return error.code, error.read(), error.headers


def test_tiles_are_the_mean_power_of_their_cells(large: Made, with_pyramid: Made) -> None:
    power = np.abs(large.image.astype(np.complex128)) ** 2
    for made in (large, with_pyramid):
        tiles = ViewerTiles(made.source)
        assert tiles.shapes == [(590, 701), (295, 351), (148, 176)]
        for level, row, column in ((0, 1, 2), (1, 0, 1), (1, 1, 0), (2, 0, 0)):
            found, window = tiles.power(level, row, column), tiles.window(level, row, column)
            side = 2**level
            for y, x in ((0, 0), (-1, -1), (21, 30)):
                own = [range(part.start, part.stop)[at] * side for part, at in zip(window, (y, x), strict=True)]
                cells = power[own[0] : own[0] + side, own[1] : own[1] + side]
                if np.isfinite(cells).any():
                    # A hundredth of a dB; with a pyramid, cells at the edge of what is covered are means of means.
                    assert found[y, x] / 100 == pytest.approx(10 * np.log10(np.nanmean(cells)), abs=0.011)
                else:
                    assert found[y, x] == NOTHING
            blocks = tiles.blocks(level, row, column)
            assert blocks.shape == found.shape
            assert ((blocks >= 0) <= (found > NOTHING)).all()


def test_a_pixel_is_told(url: str, large: Made) -> None:
    target = TARGETS[0]
    row, column = (int(np.abs(axis - at).argmin()) for axis, at in ((large.y, target.y), (large.x, target.x)))
    status, content, _ = fetch(f"{url}pixel?row={row}&column={column}")
    found = json.loads(content)
    assert status == 200 and found["block"] == 0
    assert found["db"] == pytest.approx(20 * np.log10(abs(large.image[row, column])), abs=0.01)
    assert (found["x"], found["y"]) == (large.x[column], large.y[row])
    assert found["latitude"] == pytest.approx(39.78, abs=1e-4)
    assert "db" not in json.loads(fetch(f"{url}pixel?row=0&column=0")[1])  # not covered


@pytest.mark.parametrize(
    "path", ["pixel?row=9999&column=0", "pixel?row=x", "power/9/0/0", "power/0/77/0", "../run.json", "power/0/-1/0"]
)
def test_nothing_else_is_served(url: str, path: str) -> None:
    assert fetch(url + path)[0] == 404


def test_other_sites_are_refused(url: str) -> None:
    """A page of another site, also one whose name leads here, must not read the run."""
    assert fetch(url, Host="example.org")[0] == 403
    assert fetch(f"{url}pixel?row=1&column=1", Origin="http://example.org")[0] == 403
    assert url.startswith("http://127.0.0.1:")
    status, page, headers = fetch(url)
    assert status == 200 and "default-src 'none'" in headers["Content-Security-Policy"]
    assert HOSTILE.encode() not in page and b"http://" not in page and b"https://" not in page


def test_wrong_calls_are_refused(large: Made, url: str, tmp_path: Path) -> None:
    taken = int(url.rstrip("/").rpartition(":")[2])
    with pytest.raises(blocksar.InputError, match=f"port {taken} cannot be used"):
        blocksar.view(large.folder, port=taken, browser=False)


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    arguments = ["--no-sandbox"] if os.geteuid() == 0 else []  # it opens only the page of these tests
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=arguments)
        try:
            yield browser
        finally:
            browser.close()


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: BLOCKSAR_CHROMIUM may name one")
@pytest.mark.parametrize("size", [(1280, 800), (390, 780)], ids=["wide", "phone"])
def test_the_page_pans_and_zooms(chromium: Any, url: str, large: Made, size: tuple[int, int]) -> None:
    shown = chromium.new_page(viewport={"width": size[0], "height": size[1]})
    shown.set_default_timeout(0)
    complaints: list[str] = []
    shown.on("console", lambda message: complaints.append(message.text))
    shown.on("pageerror", lambda error: complaints.append(str(error)))
    shown.on(
        "request", lambda request: None if request.url.startswith((url, "data:")) else complaints.append(request.url)
    )
    shown.goto(url)

    def settled() -> tuple[list[float], int]:
        shown.wait_for_function(
            "() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => "
            "done(document.getElementById('scene').dataset.pending === '0'))))"
        )
        column, row, scale = map(float, shown.get_attribute("#scene", "data-view").split())
        return [column, row, scale], int(shown.get_attribute("#scene", "data-level"))

    try:
        (column, row, scale), _ = settled()
        assert (column, row) == (701 / 2, 590 / 2) and shown.is_disabled("#zoom-out")
        box = shown.locator("#scene").bounding_box()
        assert box["y"] >= shown.locator("#head").bounding_box()["height"]  # nothing lies over the image
        assert scale == pytest.approx(min(box["width"] / 701, box["height"] / 590), rel=1e-3)
        shown.wait_for_function(f"() => ({BRIGHTEST})() > 200")  # the target in the middle
        assert shown.evaluate("window.pwned") is None
        assert shown.evaluate("facts.targets[0].name") == HOSTILE
        for _ in range(4):
            shown.click("#zoom-in")
        (column, row, closer), level = settled()
        assert closer == pytest.approx(scale * 1.5**4) and level == 0
        shown.keyboard.press("ArrowRight")
        (moved, _, _), _ = settled()
        assert moved == pytest.approx(column + size[0] / 5 / closer)
        middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        shown.mouse.move(*middle)
        shown.mouse.down()
        shown.mouse.move(middle[0] + 60, middle[1] + 30)
        shown.mouse.up()
        (dragged, above, _), _ = settled()
        assert (dragged, above) == pytest.approx((moved - 60 / closer, row + 30 / closer))
        shown.keyboard.press("0")
        assert settled()[0][2] == pytest.approx(scale)
        target = TARGETS[0]
        at = [
            middle[0] + (target.x - large.x.mean()) / 0.1 * scale,
            middle[1] - (target.y - large.y.mean()) / 0.1 * scale,
        ]
        shown.mouse.move(*at)
        shown.wait_for_function("() => /dB .* rad .* block 0/.test(document.getElementById('readout').textContent)")
        told = shown.text_content("#readout")
        shown.keyboard.press("+")  # another pixel comes under the pointer
        shown.wait_for_function(
            "(before) => ![before, 'Move over the image, or tap it.'].includes(readout.textContent)", arg=told
        )
        before = settled()
        shown.wait_for_function("(scale) => location.hash.includes(`scale=${scale}`)", arg=f"{before[0][2]:.6g}")
        shown.reload()
        assert settled()[0] == pytest.approx(before[0], rel=1e-3)
        shown.click("#toggle-blocks")
        shown.click("#toggle-targets")
        settled()
        assert shown.get_attribute("#toggle-blocks", "aria-pressed") == "true"
        assert shown.evaluate("() => document.documentElement.scrollWidth <= innerWidth")
        assert complaints == []
    finally:
        shown.close()
