"""Tracking on the host: one marker or board followed, found anew, and searched for in vain.

Tracking runs on the CPU whatever the device; its target is 3 ms at 640x480 on one core while the marker is followed.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import cv2
import numpy as np

from bench.common import measure, report
from warp_ar.scene import Camera, CharucoBoard, Marker, Pose
from warp_ar.tracking.markers import MarkerDetector, find_dictionary, make_board
from warp_ar.tracking.tracking import Tracker, TrackState

SINGLE = Marker()
BOARD = Marker("DICT_5X5_100", board=CharucoBoard(5, 7, 0.03, 0.022))


@dataclasses.dataclass(frozen=True)
class Case:
    """One row of the table."""

    name: str
    width: int = 640
    height: int = 480
    marker: Marker = SINGLE
    kind: str = "followed"
    """followed: found in the frame before; found: searched for in the whole frame; lost: not in the frame."""


CASES = (
    Case("vga followed"),
    Case("vga found", kind="found"),
    Case("vga lost", kind="lost"),
    Case("1080p followed", 1920, 1080),
    Case("1080p found", 1920, 1080, kind="found"),
    Case("vga board followed", marker=BOARD),
)


def draw(camera: Camera, marker: Marker, pose: Pose) -> np.ndarray:
    """RGB frame of the printed page on a cluttered desk."""
    rng = np.random.default_rng(0)
    clutter = rng.integers(40, 200, (camera.height // 20, camera.width // 20), np.uint8)
    image = cv2.resize(clutter, (camera.width, camera.height), interpolation=cv2.INTER_CUBIC)
    if marker.board is None:
        size = (marker.size, marker.size)
        printed = cv2.aruco.generateImageMarker(find_dictionary(marker.dictionary), 0, 360)
    else:
        size = marker.board.size
        printed = make_board(marker).generateImage([int(side * 4000) for side in size])
    texels = np.pad(np.asarray(printed), 60, constant_values=255)
    scale = printed.shape[1] / size[0]
    left, top = 59.5 / scale + size[0] / 2, 59.5 / scale + size[1] / 2
    page = np.array([[1 / scale, 0, -left], [0, -1 / scale, top], [0, 0, 1]])
    homography = camera.matrix() @ np.column_stack([pose.rotation[:, :2], pose.translation]) @ page
    cv2.warpPerspective(
        texels,
        homography,
        (camera.width, camera.height),
        image,
        flags=cv2.INTER_AREA,
        borderMode=cv2.BORDER_TRANSPARENT,
    )
    noise = 2.0 * rng.standard_normal(image.shape)
    return np.repeat(np.clip(cv2.GaussianBlur(image, (0, 0), 0.6) + noise, 0, 255).astype(np.uint8)[..., None], 3, 2)


def main(device: Any) -> None:
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        for case in CASES:
            run(case)
    finally:
        cv2.setNumThreads(threads)


def run(case: Case) -> None:
    w, h = case.width, case.height
    camera = Camera(w, h, float(w), float(w), (w - 1) / 2, (h - 1) / 2)
    tilted = cv2.Rodrigues(np.array([-0.6, 0.0, 0.0]))[0] @ np.diag([1.0, -1.0, -1.0])
    image = draw(camera, case.marker, Pose(tilted, np.array([0.03, 0.02, 0.6])))
    if case.kind == "lost":
        image[:] = draw(camera, case.marker, Pose(tilted, np.array([9.0, 0.0, 0.6])))
    tracker, time = Tracker(case.marker, camera), 0.0
    track = tracker.track(image, time)
    assert (track.state is TrackState.LOST) == (case.kind == "lost")
    if track.pose is not None:
        assert np.linalg.norm(track.pose.translation - (0.03, 0.02, 0.6)) < 2e-3

    def ours() -> None:
        nonlocal time
        if case.kind != "followed":
            tracker.reset()
        time += 1 / 30
        tracker.track(image, time)

    plain = MarkerDetector(case.marker.dictionary)
    times = measure({"ours": ours, "detect": lambda: plain.detect(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))}, "cpu")
    report(f"tracking {case.name}", times["ours"], "cpu", size=f"{w}x{h}", threads=1)
    report(f"tracking {case.name}, whole-frame detection alone", times["detect"], "cpu", size=f"{w}x{h}", threads=1)
