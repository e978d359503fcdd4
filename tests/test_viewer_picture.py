"""The page's picture in a real browser: which frame it shows, its clock, and its difference to the reference."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.browser_rig import Tab
from tests.page_rig import (  # noqa: F401  (fixtures)
    CODE,
    FRAMES,
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


@pytest.mark.slow
def test_a_button_shows_the_difference_to_the_reference(open_tab: Callable[..., Tab], artefacts: Path) -> None:
    """It holds the frame; colours, a scale and samples that grow; pressed again, and let go on, all of it is gone."""
    tab = open_tab()
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


def test_the_picture_is_the_frame_that_its_header_says_and_clocks_agree(open_tab: Callable[..., Tab]) -> None:
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
