"""The page for everybody, in a real browser: on phones, by keyboard alone, nothing that axe-core finds serious."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.browser_rig import SMALL, Tab, axe_core, findings
from tests.page_rig import (  # noqa: F401  (fixtures)
    artefacts,
    browser,
    needs_browser,
    open_tab,
    options,
    page_files,
    says,
    url,
)

pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install '.[test]'")
pytestmark = [pytest.mark.slow, needs_browser]


def move_the_teapot(tab: Tab) -> None:
    """It is reached by Tab, moved, turned and held."""
    page = tab.page
    reach(page, '[data-key="object 0"]')
    x, y, _ = page.evaluate("warpAr.scene.objects[0].at")
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("ArrowUp")
    tab.until(f"Math.hypot(warpAr.scene.objects[0].at[0] - {x}, warpAr.scene.objects[0].at[1] - {y}) > 0.005")
    page.keyboard.press("]")
    tab.until("warpAr.scene.objects[0].rotate[2] === -20")
    for playing in ("false", "true"):
        page.keyboard.press(" ")
        tab.until(f"warpAr.state.playing === {playing}")


PRESSED = """import('/static/geometry.js').then(({ project }) => {
  const [x, y] = project(warpAr.camera, warpAr.pose, [0.15, 0.055, 0.03]);
  const { left, top, width } = document.getElementById("handles").getBoundingClientRect();
  const scale = width / warpAr.camera.width;
  return [left + x * scale, top + y * scale];
})"""
"""Place of the teapot on the screen."""


def pinch_the_teapot(tab: Tab) -> None:
    """Two fingers that part and turn make it larger and turn it; it stays where it is."""
    tab.hold()
    x, y = tab.page.evaluate(PRESSED)
    before = tab.page.evaluate("warpAr.scene.objects[0]")
    touch = tab.page.context.new_cdp_session(tab.page)

    def fingers(kind: str, *places: tuple[float, float]) -> None:
        points = [{"x": px, "y": py, "id": number} for number, (px, py) in enumerate(places)]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    fingers("touchStart", (x, y))
    tab.until("warpAr.handles.dragged === 'object 0'")
    fingers("touchStart", (x, y), (x + 40, y))
    for step in range(1, 6):
        fingers("touchMove", (x, y), (x + 40 + 8 * step, y + 6 * step))
    fingers("touchEnd")
    tab.until(f"warpAr.scene.objects[0].scale > 1.2 * {before['scale']}")
    assert tab.page.evaluate("warpAr.scene.objects[0].rotate[2]") < before["rotate"][2] - 5.0
    assert tab.page.evaluate("warpAr.scene.objects[0].at") == before["at"]
    tab.page.click("#play")
    tab.until("warpAr.state.playing")


TOPS = """() => [...document.querySelectorAll(".toolbar > *")].filter((e) => e.offsetParent)
  .map((e) => { const box = e.getBoundingClientRect(); return box.top + box.height / 2; })"""


NOTICE = """() => {
  const text = "a_file_with_a_name_that_is_long_and_has_no_spaces.toml: foo: unknown key";
  warpAr.connection.dispatchEvent(new CustomEvent("notice", { detail: { text, bad: true } }));
}"""
BEYOND = """() => [...document.querySelectorAll("aside :is(select, input, button)")].filter((e) => e.offsetParent
  && e.getBoundingClientRect().right > innerWidth + 0.5).map((e) => e.outerHTML)"""


def test_nothing_hinders_anybody(open_tab: Callable[..., Tab], artefacts: Path) -> None:
    """By keyboard alone; on a desktop, a phone, and a phone on its side."""
    tab = open_tab()
    set_a_desk_up_by_keyboard(tab, artefacts)
    tab.page.close()
    for size in ((1280, 800), (390, 844), (844, 390)):
        phone = min(size) < 800
        shape = {"viewport": {"width": size[0], "height": size[1]}, "has_touch": phone, "is_mobile": phone}
        tab = open_tab(**shape)
        look_over(tab, size, phone, artefacts)
        tab.page.close()


def look_over(tab: Tab, size: tuple[int, int], phone: bool, artefacts: Path) -> None:
    page = tab.page
    if size == (390, 844):
        pinch_the_teapot(tab)
    tab.hold()  # nothing is lit or drawn while it is looked at
    page.evaluate(NOTICE)
    box = page.locator(".notice.bad").bounding_box()
    assert min(box["x"], box["y"]) >= 0, "the notice is out of sight"
    assert box["x"] + box["width"] <= size[0], "the notice is out of sight"
    assert box["y"] + box["height"] <= size[1], "the notice is out of sight"
    page.click(".notice.bad button", timeout=10_000)
    page.evaluate(axe_core())
    page.evaluate("for (const one of document.querySelectorAll('aside .own')) one.open = true")
    for scheme in ("dark",) if phone else ("dark", "light"):  # colours are those of every size
        page.emulate_media(color_scheme=scheme)
        middles = page.evaluate(TOPS)
        assert max(middles) - min(middles) < 12, "the toolbar wraps"
        for name in ("scene", "quality", "light", "setup"):
            press = page.tap if phone else page.click
            press(f"#tab-{name}")
            assert page.locator(f"#panel-{name}").is_visible()
            page.wait_for_timeout(300)
            assert page.evaluate("document.documentElement.scrollWidth") <= size[0], "wider than the screen"
            assert page.evaluate(BEYOND) == [], "wider than the panel"
            page.screenshot(path=artefacts / f"{size[0]}_{name}_{scheme}.png")
            if size != (844, 390):  # the upright phone has the same names and order, and colours are those of a desktop
                assert findings(page, contrast=not phone, names=scheme == "dark") == [], (name, scheme)
            if phone:
                assert page.evaluate(SMALL) == [], (name, scheme)
    page.evaluate("document.getElementById('play').click()")
    tab.until("warpAr.state.playing")


def reach(page: Any, selector: str, most: int = 80) -> None:
    """Press Tab until an element has the focus."""
    for _ in range(most):
        if page.evaluate(f"document.activeElement.matches({selector!r})"):
            return
        page.keyboard.press("Tab")
    pytest.fail(f"Tab never reaches {selector}")


def ask_for_another_marker(tab: Tab, artefacts: Path) -> None:
    """Another marker than the clip's: what is missing is said in words, and what to do."""
    page = tab.page
    reach(page, "#tab-scene")
    page.keyboard.press("ArrowLeft")  # the tabs go round
    assert page.locator("#panel-setup").is_visible()
    reach(page, ".own > summary")
    page.keyboard.press("Enter")
    reach(page, "#marker-id")
    page.keyboard.press("Control+a")
    page.keyboard.type("7")
    reach(page, "#use-marker")
    page.keyboard.press("Enter")
    tab.until("warpAr.scene.marker.id === 7 && !document.getElementById('guide').hidden", "what is missing")
    words = "the picture shows marker 0 of the family 4X4_50"
    tab.until(f"document.getElementById('guide').textContent.includes('{words}')", "the words")
    page.screenshot(path=artefacts / "missing.png")
    page.keyboard.press("Control+z")
    tab.until("document.getElementById('track-state').classList.contains('tracked')", "the marker again")
    tab.until("document.getElementById('guide').hidden")


def delete_an_object(tab: Tab) -> None:
    """What is deleted comes back."""
    page = tab.page
    page.keyboard.press("Home")
    page.focus('[data-key="object 0"]')
    page.keyboard.press("Delete")
    tab.until("warpAr.scene.objects.length === 0")
    page.keyboard.press("Control+z")
    tab.until("warpAr.scene.objects.length === 1")


def point_out_a_plane(tab: Tab) -> None:
    """With the arrow keys."""
    page = tab.page
    shapes = page.evaluate("warpAr.scene.proxies.length")
    page.focus("#tab-scene")
    page.keyboard.press("Enter")
    reach(page, "#point > summary")
    page.keyboard.press("Enter")
    reach(page, '[data-point="plane"]', 3)
    page.keyboard.press("Enter")
    tab.until("!document.getElementById('point-note').hidden && warpAr.state.playing === false")
    for key in ("ArrowLeft", "ArrowDown", "ArrowRight", "ArrowUp"):
        for _ in range(8):
            page.keyboard.press(key)
        page.keyboard.press("Enter")
    tab.until(f"warpAr.scene.proxies.length === {shapes + 1} && warpAr.state.playing === true")
    page.keyboard.press("Control+z")
    tab.until(f"warpAr.scene.proxies.length === {shapes}")


def set_a_desk_up_by_keyboard(tab: Tab, artefacts: Path) -> None:
    move_the_teapot(tab)
    ask_for_another_marker(tab, artefacts)
    delete_an_object(tab)
    point_out_a_plane(tab)
