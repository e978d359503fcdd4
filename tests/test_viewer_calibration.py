"""Calibration of a camera from the page, with the printed card."""

from __future__ import annotations

import math
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.printed_card import PrintedCard
from tests.rendered_room import look_at
from tests.viewer_rig import Running, page_scene, rendered_cards
from warp_ar.errors import UsageError
from warp_ar.scene import Camera, Pose, load_calibration
from warp_ar.tracking.card_layout import CARD_MARKER
from warp_ar.viewer.host import Lit
from warp_ar.viewer.protocol import Picture
from warp_ar.viewer.server import encode_jpeg
from warp_ar.viewer.setup import CalibrationSession

pytestmark = pytest.mark.slow

# A dozen views of the board in noisy pictures of 480x360, measured 0.3 %.
CALIBRATED_ERROR = 0.01


def calibration_of(running: Running) -> dict[str, Any]:
    """What a new viewer is told of the calibration."""
    return next(message for message in running.host.greetings() if message["type"] == "calibration")


def test_a_calibration_that_tells_too_little_is_not_used() -> None:
    """The same words as the command has; the views stay, so that others can be added."""
    used: list[Camera] = []
    truth = Camera(480, 360, 430.0, 430.0, 243.0, 176.0, (0.0, 0.0, 0.0, 0.0))
    with ThreadPoolExecutor(1) as helper:
        session = CalibrationSession(helper, lambda message: None, used.append)
        session.step("start")

        def show(images: list[np.ndarray]) -> None:
            for image in images:
                session._looked = 0.0  # not slower than frames come
                session.look(image)
                helper.submit(lambda: None).result()

        show(alike_views(truth, 25.0))
        count = session.message()["views"]
        assert count >= 4
        with pytest.raises(UsageError, match=r"degrees only.*nothing is used"):
            session.step("finish")
        assert used == []
        assert session.message()["report"] is None
        with pytest.raises(UsageError, match="no camera was calibrated"):
            session.camera_file()
        assert session.message()["on"]
        assert session.message()["views"] == count


def alike_views(camera: Camera, slant: float) -> list[np.ndarray]:
    """The printed card, always tilted as much, in degrees, turned around its normal."""
    card = PrintedCard(np.random.default_rng(2))
    images = []
    for k in range(7):
        turn = -math.pi / 2 + 0.35 * (k - 3)
        ahead = np.array(
            [math.sin(math.radians(slant)) * math.cos(turn), math.sin(math.radians(slant)) * math.sin(turn)]
        )
        eye = np.array([*(0.4 * ahead), 0.4 * math.cos(math.radians(slant))])
        pose = Pose(*look_at(eye, np.zeros(3)))
        images.append(card.photograph(camera, pose, 0.7, lambda linear: np.clip(linear, 0, 1) ** (1 / 2.2)))
    return images


def test_a_camera_is_calibrated_while_it_is_lit(tmp_path: Path) -> None:
    """The board is shown from a dozen sides; what comes out is the camera that took the pictures."""
    size = (480, 360)
    truth = Camera(*size, 430.0, 430.0, 243.0, 176.0, (-0.12, 0.03, 0.0, 0.0))
    views = list(rendered_cards(truth, 14, seed=5, marker=CARD_MARKER))
    with Running(page_scene()) as running:
        with pytest.raises(UsageError, match="no calibration is running"):
            running.edit(type="calibrate", step="finish")
        with pytest.raises(UsageError, match="no camera was calibrated"):
            running.host.downloads(full_paths=False)["camera.yml"][1]()
        running.edit(type="camera", width=size[0], height=size[1])
        running.edit(type="calibrate", step="start")
        longest = 1.0  # seconds until a view counted: on a busy machine one that does not is waited for as much longer
        for count, image in enumerate(views):
            before, began = calibration_of(running)["views"], time.monotonic()
            while (waited := time.monotonic() - began) < 5.0 * longest:
                running.host.push(Picture(count, 1000.0, encode_jpeg(image)), "me")
                time.sleep(0.1)
                if calibration_of(running)["views"] > before:
                    longest = max(longest, waited)
                    break
        assert calibration_of(running)["views"] >= 10
        running.edit(type="calibrate", step="finish")
        report = calibration_of(running)["report"]
        assert report["focal"] == pytest.approx(truth.fx, rel=CALIBRATED_ERROR)
        (tmp_path / "camera.yml").write_bytes(running.host.downloads(full_paths=False)["camera.yml"][1]())
        camera = load_calibration(tmp_path / "camera.yml")
        assert camera.fx == pytest.approx(report["focal"])

        def lit_so() -> Lit | None:
            running.host.push(Picture(99, 1000.0, encode_jpeg(views[0])), "me")
            return next((lit for lit in running.frames[-3:] if lit.camera.fx == camera.fx), None)

        lit = running.until(lit_so)
        assert lit.camera.distortion[0] == pytest.approx(truth.distortion[0], abs=0.05)
        # The same camera, come back, is known.
        running.edit(type="no_camera")
        running.edit(type="camera", width=size[0], height=size[1])
        running.until(lambda: running.host.state_message()["lens"] == "calibrated")
        # What was calibrated can be undone.
        running.edit(type="undo")
        running.until(lambda: running.host.state_message()["lens"] != "calibrated")
        running.edit(type="redo")
        running.until(lambda: running.host.state_message()["lens"] == "calibrated")
        assert running.host.downloads(full_paths=False)["card-a4.pdf"][1]().startswith(b"%PDF")
