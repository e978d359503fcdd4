"""One's own desk set up in the page from the card to the check, by keyboard alone, in real Chromium.

The browser's camera shows a printed card with a mirror ball, rendered from all sides: how far off the page's
measurements are is known. Screenshots are kept in the folder that WARP_AR_ARTEFACTS names, else in pytest's own.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.random_desk import RandomDesk
from tests.test_viewer_browser import (  # noqa: F401
    CHROMIUM,
    SMALL,
    WORKS,
    Tab,
    artefacts,
    axe,
    browser,
    cache,
    clip,
    open_tab,
    options,
    scene_file,
    url,
)
from warp_ar.input.card import write_card
from warp_ar.input.sheet import SHEET

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs a browser: apt-get install chromium")

SEED = 5
VIEWS = 26
HELD = 13
"""Times that each view is shown: 0.43 s of the fake camera's 30 frames a second, and the page looks every 0.4 s."""
FOCAL = 0.01
"""Share of the focal length: frames were packed as JPEG twice."""
RADIUS_MM = 0.5
"""As in ``test_own_desk``."""
CENTER_MM = 2.0
"""The interval that the page shows, and as much again as frames that are packed twice add."""


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> RandomDesk:
    path = tmp_path_factory.mktemp("card") / "card.pdf"
    write_card(SHEET, path, "a4", 600)
    return RandomDesk(path, SEED)


@pytest.fixture(scope="module")
def camera_file(desk: RandomDesk, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What Chromium's fake camera plays: the camera goes around the card, from above and from the side."""
    path = tmp_path_factory.mktemp("camera") / "desk.mjpeg"
    with path.open("wb") as file:
        for k in range(VIEWS):
            tilt, turn = np.radians((20, 42, 54)[k % 3]), np.radians(-90 + 75 * np.sin(0.9 * k))
            far, shift = 0.42 + 0.03 * (k % 4), 0.05 * np.array([np.cos(2.3 * k), np.sin(2.3 * k)])
            target = np.array([shift[0], 0.06 + shift[1], 0.0])
            eye = target + far * np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
            image = desk.photograph(eye, target, 15.0 * np.sin(1.7 * k))
            packed = cv2.imencode(".jpg", image[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, 95))[1].tobytes()
            file.write(HELD * packed)
    return path


def press(tab: Tab, selector: str, key: str = "Enter", most: int = 120) -> None:
    """Go to an element by the Tab key, and press another there."""
    for _ in range(most):
        if tab.page.evaluate(f"document.activeElement.matches({selector!r})"):
            tab.page.keyboard.press(key)
            return
        tab.page.keyboard.press("Tab")
    pytest.fail(f"Tab never reaches {selector}")


def text_of(selector: str) -> str:
    return f"document.querySelector('{selector}').textContent"


@pytest.mark.parametrize("size", [(1280, 800), (390, 844)], ids=["desktop", "phone"])
def test_from_the_card_to_the_check(
    open_tab: Callable[..., Tab],
    desk: RandomDesk,
    axe: str,
    size: Any,
    artefacts: Path,
    tmp_path: Path,
) -> None:
    phone = size[0] < 800
    tab = open_tab(viewport={"width": size[0], "height": size[1]}, has_touch=phone, is_mobile=phone)
    page = tab.page

    def shoot(name: str) -> None:
        page.wait_for_timeout(200)
        page.screenshot(path=artefacts / f"setup_{size[0]}_{name}.png")

    press(tab, "#use-camera")
    tab.until("warpAr.state.camera === true && warpAr.view.stats.stamped", "the camera's frames")
    press(tab, "#tab-scene", "ArrowLeft")
    assert page.locator("#panel-setup").is_visible()
    with page.expect_download() as download:
        press(tab, '#panel-setup [data-download="card-a4.pdf"]')
    download.value.save_as(tmp_path / "card.pdf")
    assert (tmp_path / "card.pdf").read_bytes().startswith(b"%PDF")
    # The scene expects the clip's marker: what to press is said.
    tab.until(f"{text_of('#seen-note')}.includes('Press “Use the card')", "what is missing")
    shoot("missing")

    press(tab, "#ball-radius", "Control+a")
    page.keyboard.type(f"{1e3 * desk.radius + 1.5:.1f}")
    press(tab, "#use-card")
    tab.until(f"{text_of('#seen-note')}.includes('The marker is seen')", "the card")

    press(tab, "#calibrate")
    tab.until(f"parseInt({text_of('#calibration-note')}) >= 12", "views of the card")
    shoot("calibrating")
    press(tab, "#calibrate-finish")
    tab.until("!document.getElementById('camera-file').hidden", "the camera")
    assert abs(page.evaluate("warpAr.camera.fx") / desk.camera.fx - 1) < FOCAL, page.inner_text("#calibration-note")

    # Frames of the new camera are needed.
    page.wait_for_timeout(9000)
    press(tab, "#measure-ball")
    tab.until(f"{text_of('#ball-note')}.includes('Its radius')", "the ball")
    ball = page.evaluate("warpAr.scene.probes[0]")
    assert abs(ball["radius"] - desk.radius) * 1e3 < RADIUS_MM, page.inner_text("#ball-note")
    assert np.linalg.norm(np.subtract(ball["center"], desk.center)) * 1e3 < CENTER_MM, page.inner_text("#ball-note")

    press(tab, "#check")
    tab.until("!document.getElementById('check').disabled")
    shoot("checked")
    assert page.inner_text("#check-note") == "Nothing wrong was found.", page.inner_text("#findings")
    assert page.evaluate("document.documentElement.scrollWidth") <= size[0], "wider than the screen"

    page.evaluate(axe)
    found = page.evaluate(f"axe.run({{runOnly: {list(WORKS)}}})")["violations"]
    serious = [(one["id"], one["help"]) for one in found if one["impact"] in ("serious", "critical")]
    assert serious == []
    if phone:
        assert page.evaluate(SMALL) == []
    # Each step is an edit that can be undone.
    press(tab, "#undo")
    tab.until(f"warpAr.scene.probes[0].radius !== {ball['radius']}", "the ball as it was typed")
