"""Editing on the page in a real browser: dragging, a budget, files saved and opened, animations, pointing out."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.browser_rig import Tab
from tests.page_rig import (  # noqa: F401  (fixtures)
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
from warp_ar.scene import load_scene

pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install '.[test]'")
pytestmark = [pytest.mark.slow, needs_browser]

BOX = 0.015
"""Metres: clicks that miss corners by up to 4 pixels, of 2 mm along the desk's depth; two ends add up."""


STALE = """() => {
  const { connection, handles, scene } = warpAr;
  const before = JSON.parse(JSON.stringify(scene));
  document.querySelector('[data-key="light 0"]').dispatchEvent(new KeyboardEvent("keydown", { key: "PageUp" }));
  const edited = warpAr.scene.lights[0].at[2];
  connection.dispatchEvent(new CustomEvent("scene", { detail: { scene: before, undo: null, redo: null } }));
  return [before.lights[0].at[2], edited, warpAr.scene.lights[0].at[2]];
}"""


def take_no_edit_back(tab: Tab) -> None:
    """On a slow machine the answer to a drag arrives after the next key, which then seemed to do nothing."""
    before, edited, shown = tab.page.evaluate(STALE)
    assert edited == pytest.approx(before + 0.006)
    assert shown == edited
    # The answer to the edit is taken.
    tab.until("warpAr.connection.settled")
    assert tab.page.evaluate("warpAr.scene.lights[0].at[2]") == pytest.approx(edited)


def _json(values: list[float]) -> str:
    return "[" + ",".join(f"{value:g}" if value != int(value) else str(int(value)) for value in values) + "]"


def move_the_teapot(tab: Tab, artefacts: Path) -> None:
    """The teapot goes where its ring is dragged."""
    page = tab.page
    at = page.evaluate("warpAr.scene.objects[0].at")
    place = page.evaluate(TEAPOT)
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


def move_the_light(tab: Tab) -> None:
    """Dragged by its foot, raised by the wheel and by a key."""
    page = tab.page
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


def record_a_video(tab: Tab) -> None:
    """Of the picture as it is shown."""
    tab.page.click("#record")
    tab.shown(6)
    assert tab.page.is_visible("#recording-badge")
    with tab.page.expect_download() as video:
        tab.page.click("#record")
    assert video.value.suggested_filename.startswith("recording.")
    read, picture = cv2.VideoCapture(str(video.value.path())).read()
    assert read
    assert picture.shape == (480, 640, 3)


def shape_the_teapot(tab: Tab) -> None:
    """Turned by the wheel over its pixels alone, scaled by its hollow point, doubled, set on the desk."""
    page = tab.page
    x, y = page.evaluate(SCREEN, [page.evaluate(f"{TEAPOT}")[:2]])[0]
    turned = page.evaluate("warpAr.scene.objects[0].rotate[2]")
    page.mouse.move(*tab.on_screen("#figure"))
    box = page.locator("#figure").bounding_box()
    page.mouse.move(box["x"] + 20, box["y"] + box["height"] - 40)
    page.mouse.wheel(0, 240)
    tab.shown(3)
    assert page.evaluate("warpAr.scene.objects[0].rotate[2]") == turned, "turned from afar"
    page.mouse.move(x, y)
    page.mouse.wheel(0, 240)
    tab.until(f"warpAr.scene.objects[0].rotate[2] !== {turned}")
    size = page.evaluate("warpAr.scene.objects[0].scale")
    point = tab.on_screen('[data-key="object 0"] .scale')
    page.mouse.move(*point)
    page.mouse.down()
    page.mouse.move(point[0] - 30, point[1], steps=4)
    page.mouse.up()
    tab.until(f"warpAr.scene.objects[0].scale > 1.05 * {size}")
    page.focus('[data-key="object 0"]')
    page.keyboard.press("PageUp")
    page.keyboard.press("d")
    tab.until("warpAr.scene.objects.length === 2 && !!document.querySelector('[data-key=\"object 1\"].on')")
    page.click("text=Set on the desk")
    tab.until("warpAr.scene.objects[1].at[2] < warpAr.scene.objects[0].at[2]")
    for _ in range(5):
        page.click("#undo")
    tab.until(f"warpAr.scene.objects.length === 1 && warpAr.scene.objects[0].scale === {size}")


def compare_with_the_camera(tab: Tab) -> None:
    """Without virtual parts the picture is the camera's."""
    page = tab.page
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


def read_the_stages(tab: Tab, artefacts: Path) -> None:
    """Those left out are grey and say why."""
    page = tab.page
    page.click("#tab-quality")
    tab.until("document.querySelectorAll('#stages li.out').length > 0")
    expose = page.locator('#stages li[data-stage="expose"]')
    assert "out" in (expose.get_attribute("class") or "")
    assert "exposure is 1" in (expose.get_attribute("title") or "")
    tab.until("parseFloat(document.querySelector('#stages li[data-stage=shade] b').style.width) > 0")
    page.screenshot(path=artefacts / "time.png")


def set_a_budget(tab: Tab, artefacts: Path) -> None:
    """The budget says at once what a time buys and how far off that is; the picture follows."""
    page = tab.page
    slide = "v => { const r = document.getElementById('budget'); r.value = v; r.dispatchEvent(new Event('input')); }"
    page.evaluate(slide, 900)
    tab.until("document.querySelectorAll('#buys li').length > 5", "the methods that it buys")
    costly = page.text_content("#buys")
    page.evaluate(slide, 0)
    assert page.text_content("#buys") != costly, "the methods do not follow the hand"
    assert re.search(
        r"This buys about [\d.]+ ms a frame, with an error of [\d.]+ FLIP", page.inner_text("#budget-note")
    )
    tab.until("warpAr.scene.quality === 'auto' && warpAr.state.budget === 1", "the budget's own quality")
    tab.until("document.querySelector('#stages li[data-stage=environment_shadow]').classList.contains('out')")
    page.evaluate(slide, 600)
    page.wait_for_timeout(1000)
    page.screenshot(path=artefacts / "budget.png")
    page.click("#budget-on")
    tab.until("warpAr.state.budget === null && warpAr.scene.quality === 'low'", "the preset that it had")


def test_dragging_switching_and_the_budget(open_tab: Callable[..., Tab], artefacts: Path) -> None:
    tab = open_tab()
    tab.page.screenshot(path=artefacts / "scene.png")
    take_no_edit_back(tab)
    record_a_video(tab)
    tab.hold()
    shape_the_teapot(tab)
    move_the_teapot(tab, artefacts)
    move_the_light(tab)
    compare_with_the_camera(tab)
    read_the_stages(tab, artefacts)
    set_a_budget(tab, artefacts)


def save_files(tab: Tab, tmp_path: Path) -> None:
    for name in ("frame.png", "scene.toml"):
        with tab.page.expect_download() as download:
            tab.page.click("#save > summary")
            tab.page.click(f'[data-download="{name}"]')
        download.value.save_as(tmp_path / name)
    assert cv2.imread(str(tmp_path / "frame.png")).shape == (480, 640, 3)
    assert load_scene(tmp_path / "scene.toml").objects == load_scene("desk").objects


def drop_a_mesh(tab: Tab) -> None:
    page = tab.page
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


SIZES = [(1280, 800), (390, 844), (844, 390)]
"""Windows of a desktop, and of a phone upright and on its side."""

INSIDE = """() => {
  const { top, left, bottom, right } = document.querySelector("#notices .notice.bad").getBoundingClientRect();
  return top >= 0 && left >= 0 && bottom <= innerHeight && right <= innerWidth;
}"""
DRAG_OVER = """() => {
  const dataTransfer = new DataTransfer();
  dataTransfer.items.add(new File(["-"], "corner.exe"));
  const event = (name) => new DragEvent(name, { dataTransfer, bubbles: true, cancelable: true });
  const figure = document.getElementById("figure");
  figure.dispatchEvent(event("dragover"));
  const zone = getComputedStyle(figure, "::after").content;
  figure.dispatchEvent(event("drop"));
  return zone;
}"""


def refuse_a_file(tab: Tab, artefacts: Path) -> None:
    """Say so inside the window, until it is closed."""
    page = tab.page
    tab.hold()
    assert "Drop" in page.evaluate(DRAG_OVER), "where a file may be dropped is not shown"
    tab.until("document.getElementById('notices').textContent.includes('corner.exe: expected')")
    for width, height in SIZES:
        page.set_viewport_size({"width": width, "height": height})
        page.wait_for_timeout(200)
        assert page.evaluate(INSIDE), (width, height)
        page.screenshot(path=artefacts / f"notice_{width}x{height}.png")
    page.wait_for_timeout(9000)
    assert page.locator(".notice.bad").count() == 1
    page.click(".notice.bad [aria-label=Close]")
    assert page.locator(".notice.bad").count() == 0
    tab.errors = [error for error in tab.errors if "422" not in error]  # the refused one, which was asked for


def test_files_in_and_out_and_a_box_that_is_pointed_out(
    open_tab: Callable[..., Tab], tmp_path: Path, artefacts: Path
) -> None:
    tab = open_tab()
    save_files(tab, tmp_path)
    point_a_box_out(tab, artefacts)
    tab.page.click("#play")
    tab.until("warpAr.state.playing")
    drop_a_mesh(tab)
    refuse_a_file(tab, artefacts)


def point_a_box_out(tab: Tab, artefacts: Path) -> None:
    """By its corners; then it is edited like anything else."""
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
    assert "from the four points" in page.inner_text("#notices")
    assert sorted(found["size"]) == pytest.approx(sorted(truth["size"]), abs=BOX)
    assert found["at"] == pytest.approx(truth["at"], abs=BOX)
    # It is moved like anything else.
    page.focus('#handles [data-key^="proxy"].on')
    page.keyboard.press("ArrowRight")
    tab.until(f"Math.abs(warpAr.scene.proxies.at(-1).at[0] - {found['at'][0]}) > 0.002")


SCREEN = """(pixels) => {
  const box = document.getElementById("handles").getBoundingClientRect();
  const { width, height } = warpAr.camera;
  return pixels.map(([x, y]) => [
    box.left + ((x + 0.5) / width) * box.width, box.top + ((y + 0.5) / height) * box.height
  ]);
}"""
