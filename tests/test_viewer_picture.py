"""The page's picture in a real browser: its frame, clock and error; the browser's camera, turned, and over TLS."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.browser_rig import Tab
from tests.page_rig import (  # noqa: F401  (fixtures)
    CODE,
    FRAMES,
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


def test_the_picture_is_the_frame_that_its_header_says_and_shows_its_error(
    open_tab: Callable[..., Tab], artefacts: Path
) -> None:
    """Of the clip, of the browser's camera, and of a phone that is turned."""
    tab = open_tab()
    for _ in range(10):
        seen = tab.page.evaluate(CODE)
        # Frames before the first viewer are none: the first frame has id 1 and code 0.
        assert seen["code"] == (seen["id"] - 1) % FRAMES
        tab.shown(1)
    stats = tab.page.evaluate("warpAr.view.stats")
    assert stats["fps"] > 0
    assert stats["latency"] > 0
    # Half of the way there and back would be 200 ms off, and frames could be shown before they were taken.
    # The frame was 1 ms on its way; the page's clock is told in steps of 0.1 ms, and the lines take a moment.
    assert 4990.0 < tab.page.evaluate(OFFSET) <= 5000.5
    show_the_difference(tab, artefacts)
    light_the_camera(tab, artefacts)
    turn_a_phone(open_tab())


def show_the_difference(tab: Tab, artefacts: Path) -> None:
    """It holds the frame; colours, a scale and samples that grow; pressed again, and let go on, all of it is gone."""
    page = tab.page
    page.click("#difference")
    tab.until("warpAr.state.playing === false && warpAr.state.compare === 'difference'")
    tab.until("warpAr.state.convergence?.samples >= 2", "the reference")
    tab.until("!document.getElementById('difference-scale').hidden", "the scale")
    assert page.inner_text("#difference-scale").split() == ["0", "20", "%"]
    tab.until(
        r"/the picture is [\d.]+ % off on average; the reference, \d+ samples a pixel, is /.test("
        "document.getElementById('tag-right').textContent)"
    )
    page.evaluate("document.getElementById('split').value = 0")
    page.locator("#split").dispatch_event("input")
    colors = tab.pixels(320, 240, 200)
    # Where nothing virtual reaches, nothing differs, and that is black; somewhere on the desk something does.
    assert tab.pixels(40, 40).mean() < 6.0
    assert colors.max() > 60.0
    page.screenshot(path=artefacts / "difference.png")
    samples = page.evaluate("warpAr.state.convergence.samples")
    tab.until(f"warpAr.state.convergence.samples > {samples}", "more samples")
    page.click("#difference")
    tab.until("warpAr.state.compare === '' && document.getElementById('difference-scale').hidden")
    page.click("#play")
    tab.until("warpAr.state.playing && warpAr.state.convergence === null")


def light_the_camera(tab: Tab, artefacts: Path) -> None:
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


OFFSET = """async () => {
  const { Connection } = await import("/static/net.js");
  const connection = new Connection();
  const real = window.WebSocket;
  let socket;
  window.WebSocket = class {
    constructor() { socket = this; }
    send() {}
  };
  connection.open();
  window.WebSocket = real;
  socket.onopen();
  // The server's clock is 5 s ahead. Its answer was 400 ms on the way back; then a frame is quick.
  const now = performance.now();
  socket.onmessage({ data: JSON.stringify({ type: "pong", sent: now - 400, clock: now + 4600 }) });
  const frame = { type: "frame", taken: performance.now() + 4999, sizes: [] };
  const header = new TextEncoder().encode(JSON.stringify(frame));
  const data = new Uint8Array(4 + header.length);
  new DataView(data.buffer).setUint32(0, header.length, true);
  data.set(header, 4);
  socket.onmessage({ data: data.buffer });
  return connection.offset;
}"""
"""The offset of the server's clock, milliseconds, where it is 5 s ahead and its answer took 400 ms on the way back."""

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
