"""Cards that print at size; cameras, responses and balls that are measured as they were rendered."""

from __future__ import annotations

import re

import cv2
import imageio.v3
import numpy as np
import pytest

from tests.test_tracking import look, make_camera, render
from warp_ar import calibrate
from warp_ar.calibration import camera_calibration, response
from warp_ar.errors import UsageError
from warp_ar.kernels.color import decode_table
from warp_ar.scene import Camera, CharucoBoard, Marker, Pose, load_calibration

pytestmark = pytest.mark.slow

BOARD = Marker("DICT_5X5_100", board=CharucoBoard(7, 5, 0.035, 0.026))
FOCAL = 0.003
"""Share of the focal length: 14 views with corners good to a tenth of a pixel; measured 0.0006."""
CURVE = 0.012
"""Of clipping, linear: quantised codes and OpenCV's smoothing; measured 0.0097."""


def test_card_prints_at_exact_size(tmp_path):
    path = tmp_path / "card.png"
    assert calibrate.main(["card", "--output", str(path), "--size", "0.08", "--dpi", "300"]) == 0
    page = imageio.v3.imread(path)
    per_metre = round(300 / 0.0254)
    assert np.allclose(imageio.v3.immeta(path)["dpi"], per_metre * 0.0254, rtol=1e-6)
    assert page.shape == (round(0.297 * per_metre), round(0.21 * per_metre))
    corners = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)).detectMarkers(page)[0]
    low, high = np.min(corners[0][0], axis=0), np.max(corners[0][0], axis=0)
    black = np.argwhere(page[int(low[1]) - 9 : int(high[1]) + 9, int(low[0]) - 9 : int(high[0]) + 9] == 0)
    assert np.abs(np.ptp(black, axis=0) + 1 - 0.08 * per_metre).max() <= 1  # each edge at its nearest pixel
    bar = np.argwhere(page[-round(0.01 * per_metre) - 4, :] == 0)
    assert abs(np.ptp(bar) + 1 - 0.1 * per_metre) <= 1


def views(camera: Camera) -> list[np.ndarray]:
    """The board tilted to every side: one direction of tilt alone leaves focal length and centre uncertain."""
    images = []
    for k in range(15):
        pose = look((5, 25, 40)[k % 3], 24 * k, distance=0.42 + 0.02 * (k % 4))
        rolled = cv2.Rodrigues(np.array([0.0, 0.0, np.radians(77.0 * k)]))[0] @ pose.rotation
        at = np.array([0.09 * np.cos(1.3 * k), 0.07 * np.sin(1.3 * k), 0.0])
        images.append(render((BOARD, Pose(rolled, pose.translation + at)), camera=camera, seed=k))
    return images


def test_camera_is_found_and_read_back(tmp_path, capsys):
    truth = make_camera(700.0, (-0.2, 0.06, 0.001, -0.0008, 0.0))
    for k, view in enumerate(views(truth)):
        imageio.v3.imwrite(tmp_path / f"{k:04d}.png", view)
    output = tmp_path / "camera.yml"
    text = str(BOARD.board)
    assert calibrate.main(["camera", str(tmp_path), "--board", text, "--output", str(output)]) == 0
    found = load_calibration(output)
    assert (found.width, found.height) == (640, 480)
    assert abs(found.fx / 700 - 1) < FOCAL
    assert abs(found.fy / 700 - 1) < FOCAL
    # What matters is where rays go, but for a turn of them all: not how the numbers share it.
    pixels = np.array([[x, y] for x in (30.0, 320, 610) for y in (30.0, 240, 450)])[:, None]
    rays = [cv2.undistortPoints(pixels, c.matrix(), np.array(c.distortion)) for c in (truth, found)]
    bent = rays[0] - rays[1]
    assert np.abs(bent - bent.mean(0)).max() * 700 < 0.5  # pixels
    said = capsys.readouterr()
    assert float(re.search(r"error ([0-9.]+) pixels", said.out)[1]) < 0.2


def test_camera_warns_of_poor_views():
    camera = make_camera()
    images = [
        render((BOARD, look(3 + k, distance=0.9, at=(0.05 * k - 0.12, 0.0))), camera=camera, seed=k) for k in range(6)
    ]
    report = camera_calibration.calibrate_camera(images, BOARD)
    said = " ".join(report.warnings)
    assert "views" in said
    assert "never reached" in said
    assert "tilted" in said


def test_camera_needs_views():
    image = render((BOARD, look(20)))
    with pytest.raises(UsageError, match="1 different views"):
        camera_calibration.calibrate_camera([image, image, image], BOARD)  # the same again does not count
    with pytest.raises(UsageError, match="0 different views"):
        camera_calibration.calibrate_camera([], BOARD)
    with pytest.raises(UsageError, match="ChArUco"):
        camera_calibration.calibrate_camera([image], Marker())


def test_response_is_recovered(tmp_path, capsys):
    """A bracket of a scene with every brightness, encoded as sRGB."""
    y, x = np.mgrid[0:100, 0:150]
    scene = np.stack([0.02 * 60 ** (x / 150), 0.02 * 60 ** (y / 100), 0.02 * 60 ** ((x + y) / 250)], -1)
    exposures = [0.25, 0.5, 1.0, 2.0, 4.0]
    paths = []
    for k, exposure in enumerate(exposures):
        linear = np.clip(scene * exposure, 0, 1)
        encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        paths.append(str(tmp_path / f"{k}.png"))
        imageio.v3.imwrite(paths[-1], np.round(255 * encoded).astype(np.uint8))
    output = tmp_path / "response.txt"
    assert (
        calibrate.main(["response", *paths, "--exposures", "1/4", "1/2", "1", "2", "4", "--output", str(output)]) == 0
    )
    assert np.abs(decode_table(output) - decode_table("srgb")).max() < CURVE


@pytest.mark.parametrize("exposures", [[1.0, 2.0], [1.0, 1.1, 1.2], [1.0, 2.0, -4.0], [1.0, 2.0, float("nan")]])
def test_response_needs_a_bracket(exposures):
    with pytest.raises(UsageError, match="expected"):
        response.measure_response([np.zeros((8, 8, 3), np.uint8)] * len(exposures), exposures)


def test_a_picture_without_a_marker_is_counted(capsys, tmp_path):
    """One picture is one, whatever the number of frames that would be read."""
    (tmp_path / "frames").mkdir()
    cv2.imwrite(str(tmp_path / "frames" / "a.png"), np.full((480, 640, 3), 128, np.uint8))
    assert calibrate.main(["ball", "desk", "--source", str(tmp_path / "frames")]) == 2
    assert "no marker in the only frame" in capsys.readouterr().err
