"""The page of a bundled desk in a real browser: its server, time-coded frames, the fake camera, and tabs.

Test modules import the fixtures that they use. Screenshots are kept in the folder that WARP_AR_ARTEFACTS names, else in
pytest's own.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.browser_rig import CHROMIUM, Tab, chromium, served, write_camera_file
from tests.test_budget import even_costs
from warp_ar.accuracy.cost_table import relevant_settings
from warp_ar.accuracy.costs import cost_key, write_costs
from warp_ar.engine.pipeline import Pipeline
from warp_ar.scene import SourceSpec, dumps_scene, load_scene
from warp_ar.sources.sources import open_source

needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="needs a browser: apt-get install chromium")

FRAMES = 48
RATE = 8.0
"""Frames a second: server and browser, without a GPU, are busy with each of them while a test waits."""
BITS, CELL = 8, 12
"""The time code: squares along the picture's bottom edge, black or white, and their side in pixels."""
THRESHOLD = 128
"""Half way between black and white, which JPEG moves by a few levels."""
UNCHANGED = 6.0
"""Levels by which a picture changes at most where nothing was edited: JPEG, and the light, which goes on settling."""
TEAPOT = "import('/static/geometry.js').then(g => g.project(warpAr.camera, warpAr.pose, [0.15, 0.055, 0.03]))"
"""Place, in pixels, at which the clip shows the teapot."""


def mark(image: np.ndarray, index: int) -> np.ndarray:
    """The picture with its number as a time code."""
    image = image.copy()
    for bit in range(BITS):
        image[-CELL:, bit * CELL : (bit + 1) * CELL] = 255 * (index >> bit & 1)
    return image


CODE = f"""() => {{
  const canvas = document.getElementById("canvas");
  const row = canvas.height - {CELL // 2};
  const data = canvas.getContext("2d").getImageData(0, row, {BITS * CELL}, 1).data;
  let code = 0;
  for (let bit = 0; bit < {BITS}; bit++) if (data[4 * (bit * {CELL} + {CELL // 2})] > {THRESHOLD}) code |= 1 << bit;
  return {{ code, id: warpAr.view.stats.id }};
}}"""


@dataclasses.dataclass(frozen=True)
class PageFiles:
    """What the page's server and the browser read."""

    scene: Path
    """The bundled desk with time-coded frames."""
    camera: Path
    """What Chromium's fake camera plays: JPEGs one after another."""
    cache: Path
    """Costs of all methods on a device that takes a millisecond for each method more, measured beforehand."""


@functools.cache
def make_page_files(folder: Path) -> PageFiles:
    """Write them into ``folder``, once in a process."""
    (folder / "frames").mkdir(parents=True)
    with open_source(load_scene("desk").source.path) as source:  # type: ignore[union-attr, arg-type]
        clip = [mark(frame.image, frame.index) for frame, _ in zip(source, range(FRAMES), strict=False)]
    for index, image in enumerate(clip):
        cv2.imwrite(str(folder / "frames" / f"{index:04d}.png"), image[..., ::-1])
    files = PageFiles(folder / "scene.toml", folder / "camera.mjpeg", folder / "cache")
    scene = dataclasses.replace(load_scene("desk"), source=SourceSpec(path=folder / "frames", fps=RATE))
    files.scene.write_text(dumps_scene(scene))
    write_camera_file(files.camera, clip)
    with Pipeline(load_scene(files.scene), device="cpu") as pipeline:
        settings = relevant_settings(pipeline.scene, pipeline.size)
        key = cost_key(pipeline.plan, pipeline.device, settings)
    write_costs(files.cache / "warp_ar", key, even_costs(settings, base=20.0))
    return files


@pytest.fixture(scope="module")
def page_files(tmp_path_factory: pytest.TempPathFactory) -> PageFiles:
    return make_page_files(tmp_path_factory.getbasetemp() / "page")


@pytest.fixture
def options() -> list[str]:
    """Further options of the command."""
    return []


@pytest.fixture
def says() -> list[str] | None:
    """What the command says on its standard error; None: nothing."""
    return None


@pytest.fixture
def url(page_files: PageFiles, options: list[str], says: list[str] | None) -> Iterator[str]:
    """The page of a server of its own."""
    with served([str(page_files.scene), *options], page_files.cache, says=says) as address:
        yield address


@pytest.fixture(scope="module")
def browser(page_files: PageFiles) -> Iterator[Any]:
    with chromium(page_files.camera) as browser:
        yield browser


@pytest.fixture(scope="session")
def artefacts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = Path(os.environ.get("WARP_AR_ARTEFACTS") or tmp_path_factory.mktemp("screenshots"))
    folder.mkdir(parents=True, exist_ok=True)
    return folder


@pytest.fixture
def open_tab(browser: Any, url: str) -> Iterator[Callable[..., Tab]]:
    with contextlib.ExitStack() as stack:
        tabs = []

        def make(**options: Any) -> Tab:
            size = {"viewport": {"width": 1360, "height": 860}}
            context = browser.new_context(**{**size, **options}, permissions=["camera"])
            stack.callback(context.close)
            tab = Tab(context.new_page())
            tabs.append(tab)
            tab.page.goto(url)
            lit = "warpAr.view.stats.plan > 0 && !!warpAr.scene && warpAr.state.building === null"
            tab.until(f"!!window.warpAr && warpAr.view.stats.shown > 5 && {lit}", "the first lit frames")
            return tab

        yield make
        for tab in tabs:
            assert tab.errors == []
