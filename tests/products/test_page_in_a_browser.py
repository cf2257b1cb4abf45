"""The report page's controls, in a real browser.

The tests use the Chromium that BLOCKSAR_CHROMIUM names or that is on the path; without one they are skipped.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_page import HOSTILE

import blocksar

pytestmark = pytest.mark.slow

CHROMIUM = os.environ.get("BLOCKSAR_CHROMIUM") or next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
in_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: BLOCKSAR_CHROMIUM may name one")


NARROWER = "(width) => document.getElementById('scene').viewBox.baseVal.width < width"


class Browser:
    """Opens the page; checks that it reports no errors and requests no other resources."""

    def __init__(self, chromium: Any, path: Path) -> None:
        self.chromium, self.path = chromium, path

    @contextmanager
    def open(self, *, width: int = 1440, height: int = 900, **context: Any) -> Iterator[Any]:
        made = self.chromium.new_context(viewport={"width": width, "height": height}, **context)
        complaints: list[str] = []
        try:
            shown = made.new_page()
            shown.set_default_timeout(0)
            shown.on("console", lambda message: complaints.append(f"{message.type}: {message.text}"))
            shown.on("pageerror", lambda error: complaints.append(str(error)))
            shown.on("request", lambda request: complaints.append(request.url) if wanted(request.url) else None)
            made.set_offline(True)
            shown.goto(self.path.as_uri())
            yield shown
        finally:
            made.close()
        assert complaints == [self.path.as_uri()]  # the page requests nothing but itself


def wanted(url: str) -> bool:
    return not url.startswith("data:")


@pytest.fixture(scope="module")
def browser(whole: Path) -> Iterator[Browser]:
    from playwright.sync_api import sync_playwright

    # Chromium cannot use its sandbox as root; it opens only a file written by these tests.
    arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=arguments)
        try:
            yield Browser(chromium, whole)
        finally:
            chromium.close()


def view(shown: Any) -> Any:
    """x, y, width and height of the visible part of the picture, m."""
    return np.array(shown.get_attribute("#scene", "viewBox").split(), float)


def middle(shown: Any) -> Any:
    box = view(shown)
    return box[:2] + box[2:] / 2


def pressed(shown: Any, button: str) -> str:
    return str(shown.get_attribute(button, "aria-pressed"))


@in_browser
def test_the_page_opens_without_errors(browser: Browser) -> None:
    with browser.open() as shown:
        assert shown.inner_text("h1") == HOSTILE.replace("\u202e", "\\u202e")
        assert shown.evaluate("window.pwned") is None
        shown.wait_for_function("() => document.getElementById('readout').textContent.includes('dB')")
        assert shown.evaluate("[...document.images].every((i) => i.complete && i.naturalWidth > 0)")
        assert shown.locator(".card").count() == 4


@in_browser
def test_buttons_zoom_pan_and_reset(browser: Browser) -> None:
    with browser.open() as shown:
        first = view(shown)
        assert shown.is_disabled("#zoom-out") and shown.is_disabled("#reset")
        for _ in range(3):
            shown.click("#zoom-in")
        assert view(shown)[2:] == pytest.approx(first[2:] / 1.5**3)
        assert middle(shown) == pytest.approx([0, 0], abs=1e-6)
        for button, direction in (("right", (1, 0)), ("down", (0, 1)), ("left", (-1, 0)), ("up", (0, -1))):
            before = view(shown)
            shown.click(f"#{button}")
            assert view(shown)[:2] == pytest.approx(before[:2] + np.array(direction) * before[2:] / 4)
        shown.click("#zoom-out")
        assert view(shown)[2:] == pytest.approx(first[2:] / 1.5**2)
        assert "Zoom 2.3" in shown.inner_text("#announcement")  # 1.5 * 1.5
        shown.click("#reset")
        assert view(shown) == pytest.approx(first)


@in_browser
def test_the_composite_is_switched_on_and_off(browser: Browser, polarised: Path) -> None:
    blocksar.report(polarised, channel="VV")
    with Browser(browser.chromium, polarised / "channels" / "VV" / "report.html").open() as shown:
        assert not shown.is_visible("#composite") and shown.is_visible("#pixels")
        black = shown.input_value("#black")
        shown.click("#toggle-composite")
        assert shown.is_visible("#composite") and not shown.is_visible("#pixels")
        shown.wait_for_function(
            "() => /red .* dB, green .* dB, blue .* dB/.test(document.getElementById('readout').textContent)"
        )
        bright = shown.get_attribute("#colours feFuncR", "slope")
        shown.evaluate("() => { black.value = 5 + +black.value; black.dispatchEvent(new Event('input')); }")
        assert float(shown.get_attribute("#colours feFuncR", "slope")) > float(bright)
        shown.click("#toggle-composite")
        assert not shown.is_visible("#composite") and shown.input_value("#black") == black


@in_browser
def test_panning_and_zooming_stay_within_limits(browser: Browser) -> None:
    with browser.open() as shown:
        width, height = (float(shown.get_attribute("#scene", f"data-{name}")) for name in ("width", "height"))
        for _ in range(4):
            shown.click("#zoom-in")
        shown.evaluate("() => { for (let i = 0; i < 30; i++) { right.click(); down.click(); } }")
        box = view(shown)
        assert box[:2] + box[2:] == pytest.approx([width / 2, height / 2], rel=1e-6)
        shown.evaluate("() => { for (let i = 0; i < 60; i++) document.getElementById('zoom-in').click(); }")
        assert shown.is_disabled("#zoom-in") and view(shown)[2] > 0


@in_browser
def test_the_mouse_pans_and_zooms(browser: Browser) -> None:
    with browser.open() as shown:
        shown.click("#zoom-in")
        shown.click("#zoom-in")
        frame = shown.locator("#viewer").bounding_box()
        scale = view(shown)[2] / frame["width"]
        before = view(shown)
        x, y = frame["x"] + 300, frame["y"] + 200
        shown.mouse.move(x, y)
        shown.mouse.down()
        shown.mouse.move(x - 60, y + 25, steps=4)
        shown.mouse.up()
        assert view(shown)[:2] == pytest.approx(before[:2] + scale * np.array([60, -25]), abs=1e-6 * before[2])
        dropped = view(shown)
        shown.mouse.move(x, y)  # the button is released, so nothing is dragged
        assert view(shown) == pytest.approx(dropped)
        under = view(shown)[:2] + scale * np.array([300, 200])
        shown.mouse.wheel(0, -300)  # after a click in the viewer the wheel zooms
        shown.wait_for_function(NARROWER, arg=before[2])
        zoomed = view(shown)[2] / frame["width"]
        assert view(shown)[:2] + zoomed * np.array([300, 200]) == pytest.approx(under, abs=scale)  # one pixel
        assert shown.evaluate("scrollY") == 0
        shown.mouse.dblclick(x, y)
        assert view(shown)[2] == pytest.approx(zoomed * frame["width"] / 2)


@in_browser
def test_the_wheel_scrolls_the_page_unless_control_is_held(browser: Browser) -> None:
    with browser.open() as shown:
        before = view(shown)
        frame = shown.locator("#viewer").bounding_box()
        shown.mouse.move(frame["x"] + 300, frame["y"] + 200)
        shown.mouse.wheel(0, 200)
        shown.wait_for_function("() => scrollY > 100")
        assert view(shown) == pytest.approx(before)
        assert shown.get_attribute("#hint", "class") == "shown"
        shown.keyboard.down("Control")
        shown.mouse.wheel(0, -200)
        shown.wait_for_function(NARROWER, arg=before[2])


@in_browser
def test_touch_pinches_and_pans(browser: Browser) -> None:
    with browser.open(width=375, height=667, has_touch=True, is_mobile=True) as shown:
        shown.locator("#viewer").scroll_into_view_if_needed()
        frame = shown.locator("#viewer").bounding_box()
        x, y = frame["x"] + frame["width"] / 2, frame["y"] + frame["height"] / 2
        touch = shown.context.new_cdp_session(shown)

        def fingers(kind: str, *points: tuple[float, float]) -> None:
            named = [{"x": px, "y": py, "id": i} for i, (px, py) in enumerate(points)]
            touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": named})

        assert shown.evaluate("getComputedStyle(viewer).touchAction") == "pan-y"  # one finger scrolls the page
        before = view(shown)
        fingers("touchStart", (x - 30, y), (x + 30, y))
        for apart in (40, 50, 60, 75, 90):
            fingers("touchMove", (x - apart, y), (x + apart, y))
        fingers("touchEnd")
        assert view(shown)[2] == pytest.approx(before[2] / 3, rel=0.02)
        assert middle(shown) == pytest.approx([0, 0], abs=0.02 * before[2])
        assert shown.evaluate("getComputedStyle(viewer).touchAction") == "none"
        before = view(shown)
        fingers("touchStart", (x, y))
        for moved in (10, 20, 40):
            fingers("touchMove", (x - moved, y))
        fingers("touchEnd")
        assert view(shown)[0] - before[0] == pytest.approx(40 * before[2] / frame["width"], rel=0.02)
        assert shown.evaluate("visualViewport.scale") == 1


@in_browser
def test_overlays_can_be_switched_off(browser: Browser) -> None:
    with browser.open() as shown:
        for name, what in (("borders", "#borders path"), ("marks", ".mark circle")):
            assert pressed(shown, f"#toggle-{name}") == "true" and shown.locator(what).first.is_visible()
            shown.click(f"#toggle-{name}")
            assert pressed(shown, f"#toggle-{name}") == "false" and not shown.locator(what).first.is_visible()
            shown.click(f"#toggle-{name}")
            assert pressed(shown, f"#toggle-{name}") == "true" and shown.locator(what).first.is_visible()
        assert shown.locator(".mark text:visible").count() > 0
        shown.click("#toggle-names")
        assert shown.locator(".mark text:visible").count() == 0
        assert shown.locator(".mark circle").first.is_visible()
        assert shown.locator("#borders path").count() == 4


@in_browser
def test_a_table_row_links_to_its_target_in_the_picture(browser: Browser) -> None:
    """Check ground coordinates against pixels: the cell under the mark has the power of the target."""
    with browser.open() as shown:
        shown.wait_for_function("() => document.getElementById('readout').textContent.includes('dB')")
        bottom, top = (float(shown.get_attribute("#scene", f"data-{name}")) for name in ("bottom", "top"))
        rows = json.loads((browser.path.parent / "quality.json").read_text())["targets"]
        for target in (t for t in rows if t["covered"]):
            link = shown.locator("#targets a.goto", has_text=target["name"]).first
            link.click()
            at = [float(link.get_attribute(f"data-{axis}")) for axis in "xy"]
            assert middle(shown) == pytest.approx(at, abs=1e-3)
            assert shown.locator(".mark.chosen").get_attribute("data-name") == target["name"]
            assert target["name"] in shown.inner_text("#announcement")
            shown.mouse.move(5, 5)
            said = shown.inner_text("#readout").replace("\u202f", "").replace("\N{MINUS SIGN}", "-")
            x, y, power = map(float, re.findall(r"-?\d+\.\d+", said))
            assert (x, y) == pytest.approx((target["x"], target["y"]), abs=0.1)
            # The cell shows its strongest pixel of 4 or 5; the peak may lie between pixels or just outside the cell.
            assert -3.5 < power < 0.1 + (top - bottom) / 255
            assert shown.locator("#chips").is_visible()


@in_browser
def test_every_control_works_from_the_keyboard(browser: Browser) -> None:
    with browser.open() as shown:
        for _ in range(20):
            shown.keyboard.press("Tab")
            if shown.evaluate("document.activeElement.id") == "viewer":
                break
        assert shown.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"
        first = view(shown)
        for _ in range(4):
            shown.keyboard.press("+")
        zoomed = view(shown)
        assert zoomed[2:] == pytest.approx(first[2:] / 1.5**4)
        shown.keyboard.press("ArrowRight")
        assert view(shown)[0] == pytest.approx(zoomed[0] + zoomed[2] / 4)
        assert "centre at x" in shown.inner_text("#announcement")
        shown.keyboard.press("-")
        shown.keyboard.press("0")
        assert view(shown) == pytest.approx(first)
        seen = []
        for _ in range(40):
            shown.keyboard.press("Tab")
            seen.append(shown.evaluate("document.activeElement.id || document.activeElement.className"))
            if seen[-1].startswith("toggle-"):
                before = pressed(shown, f"#{seen[-1]}")
                shown.keyboard.press("Space")
                assert pressed(shown, f"#{seen[-1]}") != before
                shown.keyboard.press("Enter")
            if seen[-1] == "goto":
                break
        buttons = ["zoom-in", "left", "up", "down", "right", "toggle-borders", "toggle-marks", "toggle-names"]
        assert [name for name in seen if name in buttons] == buttons
        assert {"black", "white", "grey-reset", "scroll"} <= set(seen)
        link = shown.evaluate_handle("document.activeElement")
        shown.keyboard.press("Enter")
        assert shown.evaluate("document.activeElement.id") == "viewer"
        assert middle(shown) == pytest.approx([float(link.get_attribute(f"data-{axis}")) for axis in "xy"], abs=1e-3)
        shown.keyboard.press("Escape")
        assert shown.evaluate("(link) => document.activeElement === link", link)


@in_browser
def test_columns_can_be_sorted(browser: Browser) -> None:
    with browser.open() as shown:
        heads = shown.locator("#targets thead th")
        titles = heads.all_inner_texts()
        column = next(i for i, title in enumerate(titles) if title.startswith("worst figure"))

        def values() -> list[str]:
            found = shown.locator(f"#targets tbody tr > :nth-child({column + 1})")
            return [str(value) for value in found.evaluate_all("(cells) => cells.map((cell) => cell.dataset.sort)")]

        before = values()
        for direction in ("ascending", "descending"):
            heads.nth(column).locator("button").click()
            assert heads.nth(column).get_attribute("aria-sort") == direction
            known = sorted((float(v) for v in before if v), reverse=direction == "descending")
            assert [float(v) for v in values()[:-1]] == known
            assert values()[-1] == ""  # the target without a verdict
        heads.nth(0).locator("button").click()
        assert shown.locator("#targets [aria-sort]").count() == 1


@in_browser
def test_the_grey_scale_can_be_adjusted(browser: Browser) -> None:
    def slope() -> float:
        return float(shown.get_attribute("#stretch feFuncG", "slope"))

    with browser.open() as shown:
        bottom, top = (float(shown.get_attribute("#scene", f"data-{name}")) for name in ("bottom", "top"))
        first = slope()
        shown.locator("#black").fill(str(round(bottom) + 1))
        white = float(shown.get_attribute("#scene", "data-white"))
        assert slope() == pytest.approx((top - bottom) / (white - round(bottom) - 1), rel=1e-6)
        shown.locator("#black").fill(str(round(top)))  # above the white level
        assert slope() == pytest.approx(top - bottom, rel=1e-6)
        assert "dB" in shown.inner_text("#black-value")
        shown.click("#grey-reset")
        assert slope() == pytest.approx(first)


@in_browser
@pytest.mark.parametrize(("width", "scheme"), [(1440, "dark"), pytest.param(375, "light", marks=pytest.mark.slow)])
def test_the_page_meets_the_accessibility_rules(width: int, scheme: Any, browser: Browser) -> None:
    from axe_playwright_python.sync_playwright import Axe

    with browser.open(width=width, color_scheme=scheme) as shown:
        assert shown.evaluate("document.documentElement.scrollWidth") <= width
        for summary in shown.locator("summary").all():
            summary.click()
        assert shown.evaluate("document.documentElement.scrollWidth") <= width
        assert shown.locator(".scroll:not([tabindex='0'])").count() == 0
        rules = {"runOnly": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]}
        found = Axe().run(shown, options=rules).response
        assert len(found["passes"]) > 20
        assert [(v["id"], v["nodes"][0]["html"]) for v in found["violations"]] == []


@in_browser
def test_print_layout_and_reduced_motion(browser: Browser) -> None:
    with browser.open(width=794, height=1123, reduced_motion="reduce", color_scheme="dark") as shown:
        assert shown.evaluate("getComputedStyle(document.documentElement).scrollBehavior") == "auto"
        shown.emulate_media(media="print", color_scheme="light", reduced_motion="reduce")
        assert not shown.locator(".controls").is_visible() and not shown.locator("nav").is_visible()
        assert shown.evaluate("document.documentElement.scrollWidth") <= 794
        inner = "(box) => [box.scrollHeight - box.clientHeight, box.scrollWidth - box.clientWidth]"
        assert shown.locator(".scroll").first.evaluate(inner) == [0, 0]


@in_browser
def test_the_page_is_readable_without_scripts(browser: Browser) -> None:
    with browser.open(java_script_enabled=False) as shown:
        assert not shown.locator(".controls").is_visible()
        assert shown.locator("#pixels").is_visible() and shown.locator("#borders path").first.is_visible()
        assert shown.locator("noscript").is_visible()
        assert shown.locator("#targets tbody tr").count() == 5
