"""STMaps against OpenCV's own undistortion, and against each other."""

import cv2
import numpy as np
import OpenEXR
import pytest

from warp_ar.errors import SinkError
from warp_ar.output.stmap import distort_map, undistort_map, write_stmap
from warp_ar.scene import Camera

CAMERA = Camera(96, 64, 80.0, 81.0, 46.0, 33.0, (-0.2, 0.05, 0.002, -0.001, 0.01))
# A lens's inverse is found to 1e-9, then kept in float32.
PIXELS = 1e-4


def sample(picture, coordinates):
    """The picture where an STMap says, as a compositor samples it: bilinear between pixel centres."""
    height, width = picture.shape[:2]
    x = coordinates[..., 0] * width - 0.5
    y = (1.0 - coordinates[..., 1]) * height - 0.5
    return cv2.remap(picture, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)


def test_undistorts_as_opencv_does():
    columns, rows = np.meshgrid(np.linspace(0, 3, 96), np.linspace(0, 2, 64))
    picture = np.stack([np.sin(columns), np.cos(rows), columns * rows], -1).astype(np.float32)
    expected = cv2.undistort(picture, CAMERA.matrix(), np.array(CAMERA.distortion))
    # OpenCV's remap rounds places to 1/32 of a pixel; the picture changes by 0.1 a pixel at most.
    np.testing.assert_allclose(sample(picture, undistort_map(CAMERA)), expected, atol=0.1 / 32 * 2)


def test_one_undoes_the_other():
    """Each map, looked up where the other points, gives the place it began at."""
    height, width = CAMERA.height, CAMERA.width
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    there = distort_map(CAMERA)
    points = np.stack([there[..., 0] * width - 0.5, (1 - there[..., 1]) * height - 0.5], -1).astype(float)
    flat = (points - (CAMERA.cx, CAMERA.cy)) / (CAMERA.fx, CAMERA.fy)
    rays = np.concatenate([flat, np.ones((height, width, 1))], -1).reshape(-1, 3)
    back, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), CAMERA.matrix(), np.array(CAMERA.distortion))
    np.testing.assert_allclose(back[:, 0], np.stack([columns, rows], -1).reshape(-1, 2), atol=PIXELS)


def test_a_pinhole_leaves_every_pixel():
    pinhole = Camera(8, 4, 9.0, 9.0, 3.0, 2.0)
    for coordinates in (undistort_map(pinhole), distort_map(pinhole)):
        np.testing.assert_allclose(coordinates[0, 0], (0.5 / 8, 1 - 0.5 / 4), atol=1e-6)
        np.testing.assert_allclose(coordinates[-1, -1], (7.5 / 8, 0.5 / 4), atol=1e-6)


def test_the_file_holds_it(tmp_path):
    write_stmap(tmp_path / "st.exr", undistort_map(CAMERA))
    with OpenEXR.File(str(tmp_path / "st.exr")) as file:
        pixels = file.channels()["RGB"].pixels
    assert pixels.dtype == np.float32
    np.testing.assert_array_equal(pixels[..., :2], undistort_map(CAMERA))
    with pytest.raises(SinkError, match=r"st\.exr cannot be written"):
        write_stmap(tmp_path / "missing" / "st.exr", undistort_map(CAMERA))
