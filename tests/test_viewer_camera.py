"""The browser's camera on the page, in a real browser: lit, turned as phones are, and over TLS."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.browser_rig import Tab
from tests.page_rig import (  # noqa: F401  (fixtures)
    CODE,
    TEAPOT,
    UNCHANGED,
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


def test_the_browsers_camera_is_lit(open_tab: Callable[..., Tab], artefacts: Path) -> None:
    tab = open_tab()
    page = tab.page
    page.click("#use-camera")
    tab.until("warpAr.state.camera === true && warpAr.view.stats.stamped", "the camera's frames")
    tab.until("document.getElementById('track-state').classList.contains('tracked')", "the marker")
    tab.shown(10)
    codes = set()
    for _ in range(12):
        codes.add(page.evaluate(CODE)["code"])
        tab.shown(1)
    assert len(codes) > 4, "the picture stands still"
    assert page.evaluate("warpAr.view.stats.latency") > 0
    # The teapot is there: where it stands, lit and camera's frame differ.
    page.select_option("#compare", "camera")
    tab.until("warpAr.state.compare === 'camera'")
    tab.hold()
    place = page.evaluate(TEAPOT)
    split = "v => { const s = document.getElementById('split'); s.value = v; s.dispatchEvent(new Event('input')); }"
    page.evaluate(split, 1000)
    lit = tab.pixels(*place[:2])
    page.evaluate(split, 0)
    assert np.abs(lit - tab.pixels(*place[:2])).mean() > UNCHANGED
    page.evaluate(split, 500)
    page.screenshot(path=artefacts / "camera.png")
    page.click("#play")
    # Its focal length was guessed, then estimated; the page offers to measure it.
    tab.until("!!document.querySelector('.notice.offer .go')", "the offer to calibrate")
    page.click(".notice.offer .go")
    tab.until("!document.getElementById('coverage').hidden", "the fields that the board should reach")
    page.screenshot(path=artefacts / "calibration.png")
    page.click("#calibrate")
    tab.until("document.getElementById('coverage').hidden")
    page.click("#use-clip")
    tab.until("warpAr.state.camera === false")
    turn_a_phone(open_tab())


# A camera whose pictures change their shape, as a phone's do.
TURNING = """() => {
  const canvas = document.createElement("canvas");
  const shape = (width, height) => ([canvas.width, canvas.height] = [width, height]);
  const context = canvas.getContext("2d");
  setInterval(() => {
    context.fillStyle = `hsl(${(performance.now() / 10) % 360} 50% 50%)`;
    context.fillRect(0, 0, canvas.width, canvas.height);
  }, 20);
  shape(640, 480);
  navigator.mediaDevices.getUserMedia = async () => canvas.captureStream(30);
  window.turn = () => shape(480, 640);
  window.lost = 0;
  warpAr.connection.addEventListener("lost", () => (window.lost += 1));
}"""


def turn_a_phone(tab: Tab) -> None:
    """Its pictures are upright from then on, on the same connection."""
    tab.page.evaluate(TURNING)
    tab.page.click("#use-camera")
    tab.until("warpAr.view.stats.stamped && warpAr.camera.width === 640 && warpAr.camera.height === 480")
    tab.page.evaluate("turn()")
    tab.until("warpAr.camera.width === 480 && warpAr.camera.height === 640", "upright pictures")
    tab.shown(3)
    canvas = tab.page.evaluate("[document.getElementById('canvas').width, document.getElementById('canvas').height]")
    assert canvas == [480, 640]
    assert tab.page.evaluate("lost") == 0, "a picture of the old shape cost the connection"


@pytest.mark.parametrize("options", [["--tls", "--token", "abc123"]])
def test_the_camera_of_another_machine(open_tab: Callable[..., Tab], url: str) -> None:
    """Over TLS with a certificate made on the spot and a token, as a phone sees the page."""
    assert url.startswith("https://")
    assert url.endswith("?token=abc123")
    tab = open_tab(ignore_https_errors=True)
    assert tab.page.evaluate("isSecureContext")
    tab.page.click("#use-camera")
    tab.until("warpAr.state.camera === true && warpAr.view.stats.stamped", "the camera's frames")
    tab.until("document.getElementById('track-state').classList.contains('tracked')", "the marker")
    tab.shown(5)
    assert tab.page.evaluate("fetch('download/frame.png').then(answer => answer.status)") == 403
    assert tab.page.evaluate("fetch('download/frame.png' + location.search).then(answer => answer.status)") == 200
    tab.errors = [error for error in tab.errors if "403" not in error]  # the refused one, which was asked for
