"""The live page in a real browser: the command as a server, Chromium with a fake camera, and what a tab shows."""

from __future__ import annotations

import base64
import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import warp as wp

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
PATIENCE = 180.0  # seconds that anything may take on a busy machine
FINGER = 43.5
"""Pixels that a target of 44 has after rounding."""


# The command, with a cost table that does not change when that of the package is made anew.
LIVE = """
import faulthandler
import sys
faulthandler.enable()
from warp_ar.accuracy import cost_table
errors = {
    setting.name: {method: 0.1 / (1 + i) for i, method in enumerate(setting.methods)} for setting in cost_table.SETTINGS
}
cost_table.load_errors = lambda: errors
from warp_ar.live import main
sys.exit(main(sys.argv[1:]))
"""
PIXELS = """([x, y, w, h]) => {
  const canvas = document.getElementById("canvas");
  return [...canvas.getContext("2d").getImageData(x, y, w, h).data];
}"""
# Elements that fingers hit, by what they or their label measure; what is not shown is left out.
SMALL = f"""() => [...document.querySelectorAll("button, a[href], select, summary, input")]
  .filter((e) => e.offsetParent && !e.closest(".sr"))
  .map((e) => [e.id || e.outerHTML, ...[e, e.closest("label") ?? e].map((one) => one.getBoundingClientRect())])
  .filter(([, a, b]) => Math.max(a.width, b.width) < {FINGER} || Math.max(a.height, b.height) < {FINGER})
  .map(([name]) => name)"""
WORKS = ("wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice")


def write_camera_file(path: Path, images: Iterable[np.ndarray]) -> None:
    """What Chromium's fake camera plays: JPEGs one after another, thirty a second.

    It takes their codes for a video's, 16 to 235, and stretches them.
    """
    with path.open("wb") as file:
        for image in images:
            codes = np.rint(16 + image[..., ::-1].astype(np.float32) * (219 / 255)).astype(np.uint8)
            file.write(cv2.imencode(".jpg", codes, (cv2.IMWRITE_JPEG_QUALITY, 95))[1].tobytes())


@contextlib.contextmanager
def served(options: Sequence[str], cache: Path, *, says: Sequence[str] | None = None) -> Iterator[str]:
    """The page of a server of its own, which ends as Ctrl-C ends it.

    On its standard error it says ``says``, among others; where that is not given, nothing.
    """
    command = [sys.executable, "-c", LIVE, *options, "--device", "cpu", "--quality", "low"]
    command += ["--port", "0", "--no-browser"]
    # Costs of its own, but the kernels that are compiled already.
    environment = {
        **os.environ,
        "XDG_CACHE_HOME": str(cache),
        "WARP_CACHE_PATH": str(Path(wp.config.kernel_cache_dir).parent),
    }
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        found = re.search(r"https?://\S+", line)
        assert found, (line, process.poll())
        try:
            yield found[0]
        except BaseException:
            process.kill()  # what went wrong is not the server's to wait for
            raise
        process.send_signal(signal.SIGINT)
        try:
            _, errors = process.communicate(timeout=PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            raise
    assert process.returncode == 130, errors
    if says is None:
        assert errors == "", errors
    assert [words for words in says or () if words not in errors] == [], errors


@contextlib.contextmanager
def chromium(camera_file: Path | None = None) -> Iterator[Any]:
    """The browser; its camera plays a file, if one is given."""
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install '.[test]'")
    arguments = ["--no-sandbox"]
    if camera_file is not None:
        arguments += ["--use-fake-ui-for-media-stream", "--use-fake-device-for-media-stream"]
        arguments.append(f"--use-file-for-fake-video-capture={camera_file}")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=arguments)
        yield browser
        browser.close()


# A camera that is a canvas: ten frames a second of one picture, until another is shown.
CANVAS_CAMERA = """
const canvas = Object.assign(document.createElement("canvas"), { width: 640, height: 480 });
const context = canvas.getContext("2d", { alpha: false });
const pictures = [];
let shown = null, since = 0, first = null, seen = 0;
const draw = () => shown && context.drawImage(shown, 0, 0);
setInterval(draw, 200);
navigator.mediaDevices.getUserMedia = async () => canvas.captureStream(5);
window.canvasCamera = {
  async add(coded) {
    const bytes = Uint8Array.from(atob(coded), (letter) => letter.charCodeAt(0));
    pictures.push(await createImageBitmap(new Blob([bytes], { type: "image/png" })));
  },
  show(k) {
    [shown, since, first, seen] = [pictures[k], performance.now(), null, 0];
    draw();
  },
  // Milliseconds, on the server's clock, from the first to the last frame since then that came back lit.
  note(frame) {
    if (frame.stamp === null || frame.stamp < since) return;
    first ??= frame.taken;
    seen = frame.taken - first;
  },
  get seen() { return seen; },
};
"""


class CanvasCamera:
    """A camera whose picture changes when the page has had it long enough, however slow the machine is."""

    def __init__(self, context: Any, images: Sequence[np.ndarray]) -> None:
        """Take the place of a browser context's camera; its pages are opened afterwards."""
        self._images = images
        context.add_init_script(f"(() => {{{CANVAS_CAMERA}}})()")

    def begin(self, tab: Tab) -> None:
        """Show the first picture; the page has been loaded."""
        self._tab = tab
        for image in self._images:
            png = cv2.imencode(".png", image[..., ::-1])[1].tobytes()
            tab.page.evaluate("(coded) => canvasCamera.add(coded)", base64.b64encode(png).decode())
        tab.page.evaluate("warpAr.view.addEventListener('shown', ({ detail }) => canvasCamera.note(detail))")
        tab.page.evaluate("canvasCamera.show(0)")

    def show(self, number: int, seconds: float) -> None:
        """Show a picture until its lit frames on the page were taken over so long a time."""
        self._tab.page.evaluate(f"canvasCamera.show({number})")
        self._tab.until(f"canvasCamera.seen >= {1e3 * seconds}", f"picture {number}, lit")


def axe_core() -> str:
    """The accessibility checks of axe-core, which browsers run."""
    package = pytest.importorskip("axe_playwright_python", reason="needs axe-core: pip install '.[test]'")
    return (Path(package.__file__).parent / "axe.min.js").read_text()


def findings(page: Any, *, contrast: bool = True, names: bool = True) -> list[Any]:
    """What axe-core, which the page must have, finds in it that hinders somebody, minor findings left out.

    Args:
        page: Looked at.
        contrast: Whether colours are looked at, which depend on the scheme and take most of the time.
        names: Whether all else is looked at, which depends on what is shown.
    """
    only = list(WORKS) if names else ["color-contrast"]
    rules = {"color-contrast": {"enabled": contrast}}
    found = page.evaluate("options => axe.run(options)", {"runOnly": only, "rules": rules})["violations"]
    return [
        (one["id"], [node["html"] for node in one["nodes"]], one["help"]) for one in found if one["impact"] != "minor"
    ]


class Tab:
    """A page, and the errors that it reports."""

    def __init__(self, page: Any) -> None:
        self.page = page
        self.errors: list[str] = []
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on("console", lambda message: message.type == "error" and self.errors.append(message.text))

    def until(self, expression: str, what: str = "") -> Any:
        """Wait until an expression of JavaScript holds; returns it. The page's policy forbids doing that inside."""
        deadline = time.monotonic() + PATIENCE
        while not (value := self.page.evaluate(expression)):
            assert time.monotonic() < deadline, f"{what or expression} in vain; errors: {self.errors}"
            self.page.wait_for_timeout(100)
        return value

    def shown(self, more: int = 3) -> None:
        """Wait until so many further frames are on the screen."""
        count = self.page.evaluate("warpAr.view.stats.shown")
        self.until(f"warpAr.view.stats.shown >= {count + more}")

    def hold(self) -> None:
        self.page.click("#play")
        self.until("warpAr.state.playing === false")
        self.shown(3)

    def pixels(self, x: float, y: float, size: int = 24) -> np.ndarray:
        """RGB around a pixel of the picture."""
        box = [round(x) - size // 2, round(y) - size // 2, size, size]
        return np.array(self.page.evaluate(PIXELS, box)).reshape(size, size, 4)[..., :3].astype(float)

    def on_screen(self, selector: str) -> tuple[float, float]:
        """Middle of an element on the screen."""
        box = self.page.locator(selector).first.bounding_box()
        return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
