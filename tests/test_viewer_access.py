"""The page for everybody, in a real browser: on phones, by keyboard alone, nothing that axe-core finds serious."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.browser_rig import SMALL, Tab, axe_core, serious_findings
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
pytestmark = needs_browser


def test_by_keyboard_alone(open_tab: Callable[..., Tab]) -> None:
    tab = open_tab()
    page = tab.page
    for _ in range(40):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.dataset?.key") == "object 0":
            break
    else:
        pytest.fail("Tab never reaches the teapot")
    x, y, _ = page.evaluate("warpAr.scene.objects[0].at")
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("ArrowUp")
    tab.until(f"Math.hypot(warpAr.scene.objects[0].at[0] - {x}, warpAr.scene.objects[0].at[1] - {y}) > 0.005")
    page.keyboard.press("]")
    tab.until("warpAr.scene.objects[0].rotate[2] === -20")
    page.keyboard.press(" ")
    tab.until("warpAr.state.playing === false")


@pytest.mark.parametrize("size", [(1280, 800), (390, 844)], ids=["desktop", "phone"])
def test_nothing_serious_hinders_anybody(open_tab: Callable[..., Tab], size: Any, artefacts: Path) -> None:
    phone = size[0] < 800
    shape = {"viewport": {"width": size[0], "height": size[1]}, "has_touch": phone, "is_mobile": phone}
    for scheme in ("dark", "light"):
        tab = open_tab(color_scheme=scheme, **shape)
        page = tab.page
        page.evaluate(axe_core())
        assert page.evaluate("document.documentElement.scrollWidth") <= size[0], "wider than the screen"
        for name in ("scene", "quality", "light", "setup"):
            press = page.tap if phone else page.click
            press(f"#tab-{name}")
            assert page.locator(f"#panel-{name}").is_visible()
            page.wait_for_timeout(300)
            page.screenshot(path=artefacts / f"{size[0]}_{name}_{scheme}.png")
            assert serious_findings(page) == [], (name, scheme)
            if phone:
                assert page.evaluate(SMALL) == [], (name, scheme)
        page.context.close()


def reach(page: Any, selector: str, most: int = 80) -> None:
    """Press Tab until an element has the focus."""
    for _ in range(most):
        if page.evaluate(f"document.activeElement.matches({selector!r})"):
            return
        page.keyboard.press("Tab")
    pytest.fail(f"Tab never reaches {selector}")


def type_sizes(tab: Tab) -> None:
    """Each press is an edit that can be undone."""
    page = tab.page
    reach(page, "#tab-scene")
    page.keyboard.press("ArrowLeft")  # the tabs go round
    assert page.locator("#panel-setup").is_visible()
    reach(page, "#ball-radius")
    page.keyboard.press("Control+a")
    page.keyboard.type("31")
    reach(page, "#use-card")
    page.keyboard.press("Enter")
    tab.until("warpAr.scene.marker.ruler === 0.1 && warpAr.scene.probes[0].radius === 0.031")
    assert "use the printed card" in (page.get_attribute("#undo", "title") or "")
    page.keyboard.press("Control+z")
    tab.until("warpAr.scene.marker.ruler === null && warpAr.scene.probes[0].radius === 0.035")
    page.keyboard.press("Control+Shift+z")
    tab.until("warpAr.scene.marker.ruler === 0.1")
    page.keyboard.press("Control+z")
    tab.until("warpAr.scene.marker.ruler === null")


def ask_for_another_marker(tab: Tab, artefacts: Path) -> None:
    """Another marker than the clip's: what is missing is said in words, and what to do."""
    page = tab.page
    reach(page, ".own > summary")
    page.keyboard.press("Enter")
    reach(page, "#marker-id")
    page.keyboard.press("Control+a")
    page.keyboard.type("7")
    reach(page, "#use-marker")
    page.keyboard.press("Enter")
    tab.until("warpAr.scene.marker.id === 7 && !document.getElementById('guide').hidden", "what is missing")
    tab.until("document.getElementById('guide').textContent.includes('the picture shows DICT_4X4_50 0')", "the words")
    page.screenshot(path=artefacts / "missing.png")
    page.keyboard.press("Control+z")
    tab.until("document.getElementById('track-state').classList.contains('tracked')", "the marker again")
    tab.until("document.getElementById('guide').hidden")


def check_everything(tab: Tab) -> None:
    """All is looked at, and said."""
    page = tab.page
    reach(page, "#check")
    page.keyboard.press("Enter")
    tab.until(
        "!document.getElementById('check').disabled"
        " && /found|finding/.test(document.getElementById('check-note').textContent)"
    )
    # The clip's light dims for a second, on all surfaces alike: if that is in the frames, it is all there is to say.
    found = page.inner_text("#findings")
    drifting = page.inner_text("#check-note").startswith("1 finding") and "the exposure drifts" in found.lower()
    assert drifting or page.inner_text("#check-note") == "Nothing wrong was found.", found


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


def test_a_desk_is_set_up_by_keyboard_alone(open_tab: Callable[..., Tab], artefacts: Path) -> None:
    tab = open_tab()
    type_sizes(tab)
    ask_for_another_marker(tab, artefacts)
    check_everything(tab)
    delete_an_object(tab)
    point_out_a_plane(tab)
