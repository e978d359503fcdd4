"""Calibration of a camera from the page, with the printed card."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from tests.printed_card import PrintedCard
from tests.rendered_room import look_at
from warp_ar.errors import UsageError
from warp_ar.scene import Camera, Pose
from warp_ar.viewer.setup import CalibrationSession

pytestmark = pytest.mark.slow


def test_a_calibration_that_tells_too_little_is_not_used() -> None:
    """The same words as the command has; the views stay, so that others can be added."""
    used: list[Camera] = []
    truth = Camera(480, 360, 430.0, 430.0, 243.0, 176.0, (0.0, 0.0, 0.0, 0.0))
    with ThreadPoolExecutor(1) as helper:
        session = CalibrationSession(helper, lambda message: None, used.append)
        with pytest.raises(UsageError, match="no calibration is running"):
            session.step("finish")
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
