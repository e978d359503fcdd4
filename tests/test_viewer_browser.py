"""The live page in a real browser: what it shows, what dragging and switching do, and a fake camera from end to end.

Screenshots are kept in the folder that WARP_AR_ARTEFACTS names, else in pytest's own.
"""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.browser_rig import CHROMIUM, SMALL, Tab, axe_core, chromium, serious_findings, served, write_camera_file
from tests.gltf_files import Gltf
from tests.test_budget import even_costs
from warp_ar.accuracy.cost_table import relevant_settings
from warp_ar.accuracy.costs import cost_key, write_costs
from warp_ar.engine.pipeline import Pipeline
from warp_ar.input.sources import open_source
from warp_ar.scene import Scene, SourceSpec, dumps_scene, load_scene

pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install '.[test]'")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs a browser: apt-get install chromium")

FRAMES = 48
BITS, CELL = 8, 12  # the time code: squares along the picture's bottom edge, black or white
# Half way between black and white, which JPEG moves by a few levels.
THRESHOLD = 128
# Levels by which a picture changes at most where nothing was edited: JPEG, and the light, which goes on settling.
UNCHANGED = 6.0
BOX = 0.005
"""Metres: what the page calls fitted is within it."""


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


@pytest.fixture(scope="module")
def clip() -> list[np.ndarray]:
    with open_source(load_scene("desk").source.path) as source:  # type: ignore[union-attr, arg-type]
        return [mark(frame.image, frame.index) for frame, _ in zip(source, range(FRAMES), strict=False)]


@pytest.fixture(scope="module")
def scene_file(clip: list[np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bundled desk with time-coded frames."""
    folder = tmp_path_factory.mktemp("desk")
    (folder / "frames").mkdir()
    for index, image in enumerate(clip):
        cv2.imwrite(str(folder / "frames" / f"{index:04d}.png"), image[..., ::-1])
    scene: Scene = dataclasses.replace(load_scene("desk"), source=SourceSpec(path=folder / "frames", fps=24.0))
    (folder / "scene.toml").write_text(dumps_scene(scene))
    return folder / "scene.toml"


@pytest.fixture(scope="module")
def camera_file(clip: list[np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What Chromium's fake camera plays: JPEGs one after another."""
    path = tmp_path_factory.mktemp("camera") / "camera.mjpeg"
    write_camera_file(path, clip)
    return path


@pytest.fixture(scope="module")
def cache(scene_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Costs of all methods on a device that takes a millisecond for each method more, measured beforehand."""
    folder = tmp_path_factory.mktemp("cache")
    with Pipeline(load_scene(scene_file), device="cpu") as pipeline:
        settings = relevant_settings(pipeline.scene, pipeline.size)
        key = cost_key(pipeline.plan, pipeline.device, settings)
    write_costs(folder / "warp_ar", key, even_costs(settings, base=20.0))
    return folder


@pytest.fixture
def options() -> list[str]:
    """Further options of the command."""
    return []


@pytest.fixture
def says() -> list[str] | None:
    """What the command says on its standard error; None: nothing."""
    return None


@pytest.fixture
def url(scene_file: Path, cache: Path, options: list[str], says: list[str] | None) -> Iterator[str]:
    """The page of a server of its own."""
    with served([str(scene_file), *options], cache, says=says) as address:
        yield address


@pytest.fixture(scope="module")
def browser(camera_file: Path) -> Iterator[Any]:
    with chromium(camera_file) as browser:
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
        r"/\d+ samples, error [\d.]+ %, differs by [\d.]+ %/.test(document.getElementById('tag-right').textContent)"
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


def test_the_picture_is_the_frame_that_its_header_says(open_tab: Callable[..., Tab]) -> None:
    tab = open_tab()
    for _ in range(10):
        seen = tab.page.evaluate(CODE)
        # Frames before the first viewer are none: the first frame has id 1 and code 0.
        assert seen["code"] == (seen["id"] - 1) % FRAMES
        tab.shown(1)
    stats = tab.page.evaluate("warpAr.view.stats")
    assert stats["fps"] > 0
    assert stats["latency"] > 0


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


def test_the_clock_of_the_server_is_bounded_by_what_arrives(open_tab: Callable[..., Tab]) -> None:
    """Half of the way there and back would be 200 ms off, and frames could be shown before they were taken."""
    offset = open_tab().page.evaluate(OFFSET)
    # The frame was 1 ms on its way; the page's clock is told in steps of 0.1 ms, and the lines above take a moment.
    assert 4990.0 < offset <= 5000.5


STALE = """() => {
  const { connection, handles, scene } = warpAr;
  const before = JSON.parse(JSON.stringify(scene));
  document.querySelector('[data-key="light 0"]').dispatchEvent(new KeyboardEvent("keydown", { key: "PageUp" }));
  const edited = warpAr.scene.lights[0].at[2];
  connection.dispatchEvent(new CustomEvent("scene", { detail: { scene: before, undo: null, redo: null } }));
  return [before.lights[0].at[2], edited, warpAr.scene.lights[0].at[2]];
}"""


def test_an_older_scene_takes_no_edit_back(open_tab: Callable[..., Tab]) -> None:
    """On a slow machine the answer to a drag arrives after the next key, which then seemed to do nothing."""
    tab = open_tab()
    before, edited, shown = tab.page.evaluate(STALE)
    assert edited == pytest.approx(before + 0.006)
    assert shown == edited
    # The answer to the edit is taken.
    tab.until("warpAr.connection.settled")
    assert tab.page.evaluate("warpAr.scene.lights[0].at[2]") == pytest.approx(edited)


def test_dragging_switching_and_the_budget(open_tab: Callable[..., Tab], artefacts: Path) -> None:
    tab = open_tab()
    page = tab.page
    page.screenshot(path=artefacts / "scene.png")
    tab.hold()

    # The teapot goes where its ring is dragged.
    at = page.evaluate("warpAr.scene.objects[0].at")
    place = page.evaluate(
        "import('/static/geometry.js').then(g => g.project(warpAr.camera, warpAr.pose, [0.15, 0.055, 0.03]))"
    )
    with_teapot = tab.pixels(*place[:2])
    ring = page.locator('[data-key="object 0"] .ring')
    box = ring.bounding_box()
    start = (box["x"] + 0.2 * box["width"], box["y"] + box["height"] / 2)
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(start[0] - 60, start[1] + 40, steps=4)
    page.mouse.move(start[0] - 220, start[1] + 90, steps=4)
    page.mouse.up()
    moved = page.evaluate("warpAr.scene.objects[0].at")
    assert np.hypot(moved[0] - at[0], moved[1] - at[1]) > 0.03
    tab.until(f"JSON.stringify(warpAr.scene.objects[0].at) === '{_json(moved)}'")
    tab.shown(4)
    assert np.abs(tab.pixels(*place[:2]) - with_teapot).mean() > UNCHANGED, "the teapot is still where it was"
    page.screenshot(path=artefacts / "dragged.png")

    # The light: dragged by its foot, raised by the wheel and by a key.
    before = page.evaluate("warpAr.scene.lights[0].at")
    foot = tab.on_screen('[data-key="light 0"] .ring')
    page.mouse.move(*foot)
    page.mouse.down()
    page.mouse.move(foot[0] + 90, foot[1] + 20, steps=5)
    page.mouse.up()
    dragged = page.evaluate("warpAr.scene.lights[0].at")
    assert np.hypot(dragged[0] - before[0], dragged[1] - before[1]) > 0.02
    assert dragged[2] == before[2]
    page.mouse.wheel(0, 240)
    tab.until(f"warpAr.scene.lights[0].at[2] < {before[2]} - 0.01")
    low = page.evaluate("warpAr.scene.lights[0].at[2]")
    page.focus('[data-key="light 0"]')
    page.keyboard.press("PageUp")
    tab.until(f"warpAr.scene.lights[0].at[2] > {low}")

    # Without virtual parts the picture is the camera's.
    lit = tab.pixels(320, 240, 200)
    for name in ("objects", "lights"):
        page.click(f"#effect-{name}")
        tab.until(f"warpAr.scene.effects.{name} === false")
    page.click("#compare")  # opened by hand, chosen below
    page.select_option("#compare", "camera")
    tab.until("warpAr.state.compare === 'camera' && !warpAr.state.building")
    tab.shown(4)
    page.evaluate("document.getElementById('split').value = 1000")
    page.locator("#split").dispatch_event("input")
    bare = tab.pixels(320, 240, 200)
    page.evaluate("document.getElementById('split').value = 0")
    page.locator("#split").dispatch_event("input")
    camera = tab.pixels(320, 240, 200)
    assert np.abs(bare - camera).mean() < 0.5, "what is left is not the camera's picture"
    assert np.abs(lit - camera).mean() > UNCHANGED
    for name in ("objects", "lights"):
        page.click(f"#effect-{name}")
    page.select_option("#compare", "")
    tab.until("warpAr.state.compare === '' && !warpAr.state.building")
    page.click("#play")

    # Stages: those left out are grey and say why; a switched-off effect joins them.
    page.click("#tab-quality")
    tab.until("document.querySelectorAll('#stages li.out').length > 0")
    expose = page.locator('#stages li[data-stage="expose"]')
    assert "out" in (expose.get_attribute("class") or "")
    assert "exposure is 1" in (expose.get_attribute("title") or "")
    tab.until("parseFloat(document.querySelector('#stages li[data-stage=shade] b').style.width) > 0")
    page.screenshot(path=artefacts / "time.png")

    # The budget says at once what a time buys and how far off that is; the picture follows.
    slide = "v => { const r = document.getElementById('budget'); r.value = v; r.dispatchEvent(new Event('input')); }"
    page.evaluate(slide, 900)
    tab.until("document.querySelectorAll('#buys li').length > 5", "the methods that it buys")
    costly = page.inner_text("#buys")
    page.evaluate(slide, 0)
    assert page.inner_text("#buys") != costly, "the methods do not follow the hand"
    assert re.search(r"This buys about [\d.]+ ms a frame, [\d.]+ FLIP off the best", page.inner_text("#budget-note"))
    tab.until("warpAr.scene.quality === 'auto' && warpAr.state.budget === 1", "the budget's own quality")
    tab.until("warpAr.state.auto.settings.environment_shadow === 'none'", "the cheapest methods")
    tab.until("document.querySelector('#stages li[data-stage=environment_shadow]').classList.contains('out')")
    page.evaluate(slide, 600)
    page.wait_for_timeout(1000)
    page.screenshot(path=artefacts / "budget.png")
    page.click("#budget-on")
    tab.until("warpAr.state.budget === null && warpAr.scene.quality === 'low'", "the preset that it had")


def test_saving(open_tab: Callable[..., Tab], tmp_path: Path) -> None:
    tab = open_tab()
    for name in ("frame.png", "scene.toml"):
        with tab.page.expect_download() as download:
            tab.page.click("#save > summary")
            tab.page.click(f'[data-download="{name}"]')
        download.value.save_as(tmp_path / name)
    assert cv2.imread(str(tmp_path / "frame.png")).shape == (480, 640, 3)
    assert load_scene(tmp_path / "scene.toml").objects == load_scene("desk").objects


def test_opening_light_and_a_mesh(open_tab: Callable[..., Tab], tmp_path: Path) -> None:
    tab = open_tab()
    page = tab.page
    tab.until("document.getElementById('light-note').textContent.startsWith('Linear light')", "the light")
    with page.expect_download() as download:
        page.click("#save > summary")
        page.click('#save [data-download="environment.exr"]')
    download.value.save_as(tmp_path / "light.exr")
    page.set_input_files("#open-file", str(tmp_path / "light.exr"))
    tab.until("(warpAr.scene.captured ?? '').endsWith('light.exr')", "the light that was saved")
    page.click("#undo")
    tab.until("warpAr.scene.captured === null")
    count = page.evaluate("warpAr.scene.objects.length")
    # Dropped onto the picture: a tetrahedron of 80 mm.
    mesh = "OFF\n4 4 0\n0 0 0\n80 0 0\n0 80 0\n0 0 80\n3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 2\n"
    drop = """text => {
      const dataTransfer = new DataTransfer();
      dataTransfer.items.add(new File([text], "corner.off"));
      const event = new DragEvent("drop", { dataTransfer, bubbles: true, cancelable: true });
      document.getElementById("figure").dispatchEvent(event);
    }"""
    page.evaluate(drop, mesh)
    tab.until(f"warpAr.scene.objects.length === {count + 1}", "the mesh")
    tab.until("document.getElementById('notices').textContent.includes('taken to be in millimetres')")
    page.evaluate(drop.replace("corner.off", "corner.exe"), mesh)
    tab.until("document.getElementById('notices').textContent.includes('corner.exe: expected a file that ends in')")
    tab.errors = [error for error in tab.errors if "422" not in error]  # the refused one, which was asked for


@pytest.mark.parametrize("says", [["slide.glb: not shown: animations"]], ids=["none is played at first"])
def test_an_animation_is_chosen_held_and_looped(open_tab: Callable[..., Tab], tmp_path: Path, artefacts: Path) -> None:
    """By the panel's own controls, of a file that was dropped; what they show is what the server plays."""
    gltf = Gltf()
    node = gltf.node(gltf.square(), scale=[0.03] * 3, translation=[0.0, 0.03, 0.0])
    times = gltf.array(np.float32([0.0, 2.0]), min=[0.0], max=[2.0])
    places = gltf.array(np.float32([[-0.05, 0.03, 0.0], [0.05, 0.03, 0.0]]))
    channel = {"sampler": 0, "target": {"node": node, "path": "translation"}}
    gltf.tree["animations"] = [
        {"name": "Slide", "samplers": [{"input": times, "output": places}], "channels": [channel]}
    ]
    coded = base64.b64encode(gltf.save(tmp_path / "slide.glb").read_bytes()).decode()
    tab = open_tab()
    page = tab.page
    number = page.evaluate("warpAr.scene.objects.length")
    page.evaluate(
        """coded => {
          const dataTransfer = new DataTransfer();
          const bytes = Uint8Array.from(atob(coded), (letter) => letter.charCodeAt(0));
          dataTransfer.items.add(new File([bytes], "slide.glb"));
          const event = new DragEvent("drop", { dataTransfer, bubbles: true, cancelable: true });
          document.getElementById("figure").dispatchEvent(event);
        }""",
        coded,
    )
    item = f"warpAr.scene.objects[{number}]"
    tab.until(f"warpAr.scene.objects.length === {number + 1}", "the mesh")
    page.click(f'[data-key="object {number}"] .pick')
    choice = page.get_by_label("Animation", exact=True)
    assert choice.locator("option").all_text_contents() == ["None", "Slide"]
    pause, loop = page.locator("#animation-pause"), page.locator("#animation-loop")
    assert pause.is_disabled(), "nothing is played"
    choice.select_option(label="Slide")
    tab.until(f"{item}.animation === 0 && !{item}.paused")
    assert pause.text_content() == "Pause"
    pause.click()
    tab.until(f"{item}.paused")
    assert pause.text_content() == "Play"
    loop.click()
    tab.until(f"{item}.loop === false")
    assert loop.get_attribute("aria-checked") == "false"
    tab.shown()
    page.screenshot(path=artefacts / "animation.png")
    pause.click()
    tab.until(f"!{item}.paused")
    page.click("#undo")
    tab.until(f"{item}.paused")
    tab.until("document.getElementById('animation-pause').textContent === 'Play'", "what the undone edit says")


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
    place = page.evaluate(
        "import('/static/geometry.js').then(g => g.project(warpAr.camera, warpAr.pose, [0.15, 0.055, 0.03]))"
    )
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


def test_a_phone_that_is_turned(open_tab: Callable[..., Tab]) -> None:
    tab = open_tab()
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


@pytest.mark.parametrize("scheme", ["dark", "light"])
def test_on_a_phone(open_tab: Callable[..., Tab], scheme: str, artefacts: Path) -> None:
    tab = open_tab(viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True, color_scheme=scheme)
    page = tab.page
    assert page.evaluate("document.documentElement.scrollWidth") <= 390, "the page is wider than the phone"
    for name in ("scene", "quality", "light"):
        page.tap(f"#tab-{name}")
        assert page.locator(f"#panel-{name}").is_visible()
        page.wait_for_timeout(400)
        page.screenshot(path=artefacts / f"phone_{name}_{scheme}.png")


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
            page.click(f"#tab-{name}")
            page.wait_for_timeout(300)
            page.screenshot(path=artefacts / f"{size[0]}_{name}_{scheme}.png")
            assert serious_findings(page) == [], (name, scheme)
            if phone:
                assert page.evaluate(SMALL) == [], (name, scheme)
        page.context.close()


def test_a_desk_is_set_up_by_keyboard_alone(open_tab: Callable[..., Tab], artefacts: Path) -> None:
    tab = open_tab()
    page = tab.page

    def reach(selector: str, most: int = 80) -> None:
        for _ in range(most):
            if page.evaluate(f"document.activeElement.matches({selector!r})"):
                return
            page.keyboard.press("Tab")
        pytest.fail(f"Tab never reaches {selector}")

    # Sizes are typed; each press is an edit that can be undone.
    reach("#tab-scene")
    page.keyboard.press("ArrowLeft")  # the tabs go round
    assert page.locator("#panel-setup").is_visible()
    reach("#ball-radius")
    page.keyboard.press("Control+a")
    page.keyboard.type("31")
    reach("#use-card")
    page.keyboard.press("Enter")
    tab.until("warpAr.scene.marker.ruler === 0.1 && warpAr.scene.probes[0].radius === 0.031")
    assert "use the printed card" in (page.get_attribute("#undo", "title") or "")
    page.keyboard.press("Control+z")
    tab.until("warpAr.scene.marker.ruler === null && warpAr.scene.probes[0].radius === 0.035")
    page.keyboard.press("Control+Shift+z")
    tab.until("warpAr.scene.marker.ruler === 0.1")
    page.keyboard.press("Control+z")
    tab.until("warpAr.scene.marker.ruler === null")

    # Another marker than the clip's: what is missing is said in words, and what to do.
    reach(".own > summary")
    page.keyboard.press("Enter")
    reach("#marker-id")
    page.keyboard.press("Control+a")
    page.keyboard.type("7")
    reach("#use-marker")
    page.keyboard.press("Enter")
    tab.until("warpAr.scene.marker.id === 7 && !document.getElementById('guide').hidden", "what is missing")
    tab.until("document.getElementById('guide').textContent.includes('the picture shows DICT_4X4_50 0')", "the words")
    page.screenshot(path=artefacts / "missing.png")
    page.keyboard.press("Control+z")
    tab.until("document.getElementById('track-state').classList.contains('tracked')", "the marker again")
    tab.until("document.getElementById('guide').hidden")

    # All is looked at, and said.
    reach("#check")
    page.keyboard.press("Enter")
    tab.until(
        "!document.getElementById('check').disabled"
        " && /found|finding/.test(document.getElementById('check-note').textContent)"
    )
    # The clip's light dims for a second, on all surfaces alike: if that is in the frames, it is all there is to say.
    found = page.inner_text("#findings")
    drifting = page.inner_text("#check-note").startswith("1 finding") and "the exposure drifts" in found.lower()
    assert drifting or page.inner_text("#check-note") == "Nothing wrong was found.", found

    # What is deleted comes back.
    page.keyboard.press("Home")
    page.focus('[data-key="object 0"]')
    page.keyboard.press("Delete")
    tab.until("warpAr.scene.objects.length === 0")
    page.keyboard.press("Control+z")
    tab.until("warpAr.scene.objects.length === 1")

    # A plane is pointed out with the arrow keys.
    shapes = page.evaluate("warpAr.scene.proxies.length")
    page.focus("#tab-scene")
    page.keyboard.press("Enter")
    reach("#point > summary")
    page.keyboard.press("Enter")
    reach('[data-point="plane"]', 3)
    page.keyboard.press("Enter")
    tab.until("!document.getElementById('point-note').hidden && warpAr.state.playing === false")
    for key in ("ArrowLeft", "ArrowDown", "ArrowRight", "ArrowUp"):
        for _ in range(8):
            page.keyboard.press(key)
        page.keyboard.press("Enter")
    tab.until(f"warpAr.scene.proxies.length === {shapes + 1} && warpAr.state.playing === true")
    page.keyboard.press("Control+z")
    tab.until(f"warpAr.scene.proxies.length === {shapes}")


def test_a_box_is_pointed_out_and_fitted(open_tab: Callable[..., Tab], artefacts: Path) -> None:
    tab = open_tab()
    page = tab.page
    truth = page.evaluate("warpAr.scene.proxies.find(p => p.shape === 'box')")
    place = page.evaluate("warpAr.scene.proxies.findIndex(p => p.shape === 'box')")
    page.click(f'#proxies [data-key="proxy {place}"] .drop')
    tab.until("!warpAr.scene.proxies.some(p => p.shape === 'box')")
    tab.hold()
    corners = page.evaluate(
        "truth => Promise.all([import('/static/handles.js'), import('/static/geometry.js')]).then(([h, g]) => "
        "h.proxyCorners(truth).map(c => g.project(warpAr.camera, warpAr.pose, c)))",
        truth,
    )
    box = page.locator("#handles").bounding_box()
    scale = box["width"] / 640
    page.click("#point > summary")
    page.click('[data-point="box"]')
    tab.until("!document.getElementById('point-note').hidden")
    off = [(3, -2), (-3, 2), (2, 3), (-2, -3)]
    for number, (dx, dy) in zip((0, 1, 5, 6), off, strict=True):
        x, y = corners[number][:2]
        page.mouse.click(box["x"] + (x + dx + 0.5) * scale, box["y"] + (y + dy + 0.5) * scale)
    tab.until("warpAr.scene.proxies.some(p => p.shape === 'box')", "the box")
    found = page.evaluate("warpAr.scene.proxies.find(p => p.shape === 'box')")
    page.click("#proxies li:last-child .pick")
    page.wait_for_timeout(300)
    page.screenshot(path=artefacts / "pointed.png")
    assert "fitted to edges of the picture" in page.inner_text("#notices")
    assert sorted(found["size"]) == pytest.approx(sorted(truth["size"]), abs=BOX)
    assert found["at"] == pytest.approx(truth["at"], abs=BOX)
    # It is moved and sized like anything else, and goes.
    page.focus('#handles [data-key^="proxy"].on')
    page.keyboard.press("ArrowRight")
    tab.until(f"Math.abs(warpAr.scene.proxies.at(-1).at[0] - {found['at'][0]}) > 0.002")
    page.keyboard.press("Delete")
    tab.until("!warpAr.scene.proxies.some(p => p.shape === 'box')")
    page.click("#undo")
    tab.until("warpAr.scene.proxies.some(p => p.shape === 'box')")


def _json(values: list[float]) -> str:
    return "[" + ",".join(f"{value:g}" if value != int(value) else str(int(value)) for value in values) + "]"
