"""A desk of one's own set up on the page, from the card to a lit object: Chromium, a fake camera, the keyboard alone.

Screenshots are kept in the folder that WARP_AR_ARTEFACTS names, else in pytest's own.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.browser_rig import CHROMIUM, CanvasCamera, Tab, axe_core, chromium, findings, served
from tests.random_desk import RandomDesk
from warp_ar.calibration.card import write_card
from warp_ar.kernels.color import decode_table
from warp_ar.srgb import decode_srgb
from warp_ar.tracking.card_layout import CARD_MARKER

pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install '.[test]'")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs a browser: apt-get install chromium"),
]

SEED = 31
VIEWS = 14
SHOWN = 0.5
"""Seconds of frames of each view that the page has lit: it keeps one in 0.4 s."""
LIGHTS = (1.4, 0.7, 0.35)
"""What the lamps give, view by view in another order than the tilts."""
FOCAL = 0.015
"""Share of the focal length: twelve views of 640x480, packed as JPEG, their board in half of the picture."""
RADIUS = 0.7e-3
"""Metres: the interval that the page states for this desk."""
CHANGED = 12.0
"""Levels by which the picture changes where the teapot is: JPEG changes it by two."""


def dimmed(image: np.ndarray, light: float) -> np.ndarray:
    """A frame under lamps that give so many times what they gave."""
    decode = decode_table("srgb")[:, 0]
    return np.searchsorted(decode, np.minimum(decode * light, 1.0)).astype(np.uint8)[image]


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> RandomDesk:
    card = tmp_path_factory.mktemp("card") / "card.pdf"
    write_card(CARD_MARKER, card, "a4", 600)
    return RandomDesk(card, SEED)


@pytest.fixture(scope="module")
def views(desk: RandomDesk) -> list[np.ndarray]:
    """What a hand sees that carries a camera around the desk, while lamps go on and off."""
    found = []
    for k in range(VIEWS):
        turn, tilt, far = 2.4 * k, np.radians((14, 32, 46)[k % 3]), 0.36 + 0.03 * (k % 4)
        at = np.array([0.05 * np.cos(1.3 * k), 0.045 + 0.035 * np.sin(1.3 * k), 0.0])
        eye = at + far * np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
        image = desk.photograph(eye, at, (0.0, 25.0, -30.0)[k % 3])
        found.append(dimmed(image, LIGHTS[k // 2 % len(LIGHTS)]))
    return found


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as browser:
        yield browser


class Hands:
    """A page that is used by the keyboard and photographed."""

    def __init__(self, tab: Tab, camera: CanvasCamera, folder: Path) -> None:
        self.page, self._camera, self._folder, self._count = tab.page, camera, folder, 0
        self.page.evaluate(axe_core())

    def reach(self, selector: str, most: int = 120) -> None:
        """Press Tab until the focus is there, backward if that is nearer."""
        for _ in range(most):
            if self.page.evaluate(f"document.activeElement.matches({selector!r})"):
                return
            self.page.keyboard.press("Tab")
        pytest.fail(f"Tab never reaches {selector}")

    def press(self, selector: str, key: str = "Enter") -> None:
        self.reach(selector)
        self.page.keyboard.press(key)

    def type(self, selector: str, text: str) -> None:
        self.reach(selector)
        self.page.keyboard.press("Control+a")
        self.page.keyboard.type(text)

    def choose(self, selector: str, value: str) -> None:
        """Go down a list to an entry."""
        self.reach(selector)
        for _ in range(self.page.evaluate(f"document.querySelector({selector!r}).options.length")):
            if self.page.input_value(selector) == value:
                return
            self.page.keyboard.press("ArrowDown")
        assert self.page.input_value(selector) == value

    def walk(self, *views: int) -> None:
        """Carry the camera around the desk."""
        for view in views:
            self._camera.show(view, SHOWN)

    def look(self, step: str) -> None:
        """Keep a picture of this step."""
        self.page.screenshot(path=self._folder / f"setup_{self._count}_{step}.png")
        self._count += 1

    def wait_for(self, tab: Tab, selector: str, note: str) -> str:
        """Start a step, and let the machine have its time: the frame is held; returns what is said then."""
        self.press("#play")
        tab.until("warpAr.state.playing === false")
        before = f"document.getElementById('{note}').textContent !== {tab.page.text_content('#' + note)!r}"
        self.press(selector)
        tab.until(f"{before} && !document.querySelector('{selector}').disabled", selector)
        self.press("#play")
        tab.until("warpAr.state.playing")
        return self.words(f"#{note}")

    def words(self, selector: str) -> str:
        return str(self.page.inner_text(selector))


def test_from_the_card_to_a_lit_object(desk: RandomDesk, views: list[np.ndarray], browser: Any, tmp_path: Path) -> None:
    folder = Path(os.environ.get("WARP_AR_ARTEFACTS") or tmp_path)
    folder.mkdir(parents=True, exist_ok=True)
    with served(["desk"], tmp_path) as url:
        context = browser.new_context(viewport={"width": 1280, "height": 800})
        camera = CanvasCamera(context, views)
        tab = Tab(context.new_page())
        tab.page.goto(url)
        tab.until("!!window.warpAr && warpAr.view.stats.plan > 0 && !!warpAr.scene", "the first lit frame")
        camera.begin(tab)
        hands = Hands(tab, camera, folder)
        use_the_card(tab, hands, desk)
        measure_the_camera(tab, hands, desk)
        measure_the_ball(tab, hands, desk)
        measure_the_response(tab, hands)
        check(tab, hands)
        the_object_is_lit(tab, hands)
        context.close()
    assert tab.errors == []


def use_the_card(tab: Tab, hands: Hands, desk: RandomDesk) -> None:
    hands.reach("#use-camera")
    hands.page.keyboard.press("Enter")
    tab.until("warpAr.state.camera === true && warpAr.view.stats.stamped", "the camera's frames")
    hands.press("#tab-scene", "ArrowLeft")  # the tabs go round
    assert hands.page.locator("#panel-setup").is_visible()
    hands.look("print")
    hands.reach('[data-download="card-a4.pdf"]')
    with hands.page.expect_download() as card:
        hands.page.keyboard.press("Enter")
    assert card.value.suggested_filename == "card-a4.pdf"
    tab.until("!document.getElementById('guide').hidden", "the guide")
    assert "Use the card with these sizes" in hands.words("#guide")
    guide = hands.page.locator("#guide").bounding_box()
    assert guide["y"] >= 0, "the guide is out of sight"
    assert guide["y"] + guide["height"] <= hands.page.viewport_size["height"], "the guide is out of sight"
    # Typed as a ruler has it: to the millimetre.
    hands.type("#ball-radius", f"{1e3 * desk.radius:.0f}")
    hands.press("#use-card")
    tab.until("warpAr.scene.marker.ruler === 0.1", "the card")
    # The box stood beside the marker of the clip.
    assert hands.page.evaluate("warpAr.scene.proxies.map(p => p.shape).join()") == "plane"
    hands.page.keyboard.press("Control+z")
    tab.until("warpAr.scene.marker.ruler === null && warpAr.scene.proxies.length === 2", "undone")
    hands.page.keyboard.press("Control+Shift+z")
    tab.until("warpAr.scene.marker.ruler === 0.1", "done again")
    tab.until("document.getElementById('track-state').classList.contains('tracked')", "the card in the picture")
    tab.until("document.getElementById('guide').hidden")
    hands.look("card")


def measure_the_camera(tab: Tab, hands: Hands, desk: RandomDesk) -> None:
    hands.press("#calibrate")
    hands.walk(*range(VIEWS))
    tab.until("document.getElementById('calibration-note').textContent.includes('enough')", "a dozen views")
    hands.look("camera")
    assert findings(hands.page) == [], "something hinders somebody"
    hands.press("#calibrate-finish")
    tab.until("warpAr.state.lens === 'calibrated'", "the calibrated camera")
    tab.until("document.getElementById('calibration-note').textContent.startsWith('Calibrated and in use')")
    tab.until(f"Math.abs(warpAr.camera.fx / {desk.camera.fx} - 1) < {FOCAL}", "its focal length in the picture")
    hands.page.keyboard.press("Control+z")
    tab.until("warpAr.state.lens !== 'calibrated'", "undone")
    hands.page.keyboard.press("Control+Shift+z")
    tab.until("warpAr.state.lens === 'calibrated'", "done again")


def measure_the_ball(tab: Tab, hands: Hands, desk: RandomDesk) -> None:
    hands.walk(*range(0, VIEWS, 3))
    said = hands.wait_for(tab, "#measure-ball", "ball-note")
    assert said.startswith("The ball's centre was"), said
    assert abs(hands.page.evaluate("warpAr.scene.probes[0].radius") - desk.radius) < RADIUS
    hands.look("ball")
    # What was measured is no longer said once it is undone.
    hands.page.keyboard.press("Control+z")
    tab.until("document.getElementById('ball-note').textContent.startsWith('Centre and radius are measured')", "undone")
    hands.page.keyboard.press("Control+Shift+z")
    tab.until("document.getElementById('ball-note').textContent.startsWith('The ball')", "done again")


def measure_the_response(tab: Tab, hands: Hands) -> None:
    hands.walk(*range(1, VIEWS, 3))
    said = hands.wait_for(tab, "#measure-response", "response-note")
    found = re.match(r"Code 128 is (0\.\d+) of clipping ± (\d+)%", said)
    assert found, said
    # The desk is seen as sRGB has it.
    assert abs(float(found[1]) / decode_srgb(128 / 255) - 1) < float(found[2]) / 100
    assert hands.page.locator("#response-file").is_visible()
    hands.look("response")
    hands.page.keyboard.press("Control+z")
    tab.until("document.getElementById('response-file').hidden", "undone")
    hands.page.keyboard.press("Control+Shift+z")
    tab.until("!document.getElementById('response-file').hidden", "done again")


def check(tab: Tab, hands: Hands) -> None:
    said = hands.wait_for(tab, "#check", "check-note")
    hands.look("check")
    assert said == "Nothing wrong was found.", hands.words("#findings")


def the_object_is_lit(tab: Tab, hands: Hands) -> None:
    """The teapot is there, and is not in the camera's own picture."""
    hands.press("#play")
    tab.until("warpAr.state.playing === false")
    hands.choose("#compare", "camera")
    tab.until("warpAr.state.compare_ready && warpAr.state.compare === 'camera'")
    tab.shown(3)
    place = hands.page.evaluate(
        "import('/static/geometry.js').then(g => g.project(warpAr.camera, warpAr.pose, warpAr.scene.objects[0].at))"
    )
    x, y = np.clip(place[:2], 20, (619, 459))
    seen = []
    for key in ("End", "Home"):
        hands.press("#split", key)
        seen.append(tab.pixels(x, y))
    assert np.abs(seen[0] - seen[1]).mean() > CHANGED
    for _ in range(5):
        hands.press("#split", "PageUp")
    hands.look("lit")
