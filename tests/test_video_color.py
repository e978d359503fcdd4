"""Conversion of video's codes on the device: FFmpeg's own results, to the bit."""

from __future__ import annotations

import fractions

import av
import numpy as np
import pytest
import warp as wp
from av.video.reformatter import ColorRange, Colorspace, VideoReformatter

from tests.farm_rig import desk_frames
from warp_ar.farm.decoded_picture import LEAST_SIZE
from warp_ar.input.video_file import rgb_from_video
from warp_ar.kernels.video_color import rgb_factors, rgb_from_yuv, yuv_from_rgb, yuv_layout
from warp_ar.output.video_sink import rgb_to_yuv

SIZES = ((LEAST_SIZE, LEAST_SIZE), (66, 70), (240, 320))
"""Rows and columns."""
MATRICES = {"bt709": Colorspace.ITU709, "bt601": Colorspace.ITU601}


def planes_of(picture):
    return [
        np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)[:, : plane.width].copy()
        for plane in picture.planes
    ]


def picture_of(planes, matrix, full):
    height, width = planes[0].shape
    picture = av.VideoFrame(width, height, "yuv420p")
    for plane, values in zip(picture.planes, planes, strict=True):
        rows = np.zeros((plane.height, plane.line_size), np.uint8)
        rows[:, : plane.width] = values
        plane.update(rows.tobytes())
    picture.colorspace, picture.color_range = MATRICES[matrix], ColorRange.JPEG if full else ColorRange.MPEG
    return picture


def packed(planes, interleaved):
    luma, cb, cr = planes
    chroma = (np.stack([cb, cr], -1),) if interleaved else (cb, cr)
    return np.concatenate([part.ravel() for part in (luma, *chroma)])


def random_planes(size, seed, low=0, high=256):
    rng = np.random.default_rng(seed)
    height, width = size
    shapes = ((height, width), *[(height // 2, width // 2)] * 2)
    return [rng.integers(low, high, shape).astype(np.uint8) for shape in shapes]


def to_rgb(planes, matrix, full, interleaved, device):
    height, width = planes[0].shape
    with wp.ScopedDevice(device):
        rgb = wp.zeros((height, width), dtype=wp.vec3ub)
        layout = yuv_layout(height, width, interleaved=interleaved, left=False)
        rgb_from_yuv(wp.array(packed(planes, interleaved)), layout, rgb_factors(matrix, full_range=full), rgb)
        return rgb.numpy()


def to_yuv(image, device):
    height, width = image.shape[:2]
    with wp.ScopedDevice(device):
        codes = wp.zeros(height * width * 3 // 2, dtype=wp.uint8)
        yuv_from_rgb(wp.array(image, dtype=wp.vec3ub), yuv_layout(height, width), codes)
        return codes.numpy()


def ffmpeg_yuv(image):
    height, width = image.shape[:2]
    tick = fractions.Fraction(1, 30)
    converter = rgb_to_yuv(width, height, tick)
    picture = av.VideoFrame.from_ndarray(image, format="rgb24")
    picture.pts, picture.time_base = 0, tick
    converter.push(picture)
    return packed(planes_of(converter.pull()), interleaved=False)


@pytest.mark.parametrize("interleaved", [False, True])
@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("matrix", MATRICES)
def test_rgb_is_that_of_ffmpeg(matrix, full, interleaved, device):
    for seed, size in enumerate(SIZES):
        for low, high in ((0, 256), (16, 241), (0, 2), (250, 256)):
            planes = random_planes(size, seed, low, high)
            expected = rgb_from_video(VideoReformatter(), picture_of(planes, matrix, full))
            np.testing.assert_array_equal(to_rgb(planes, matrix, full, interleaved, device), expected)


def test_a_sum_wraps_around_as_that_of_ffmpeg(device):
    planes = [np.full((32, 32), 255, np.uint8), *[np.full((16, 16), 255, np.uint8)] * 2]
    expected = rgb_from_video(VideoReformatter(), picture_of(planes, "bt709", full=False))
    assert (expected[..., 2] == 0).all()  # blue would be far above white
    np.testing.assert_array_equal(to_rgb(planes, "bt709", False, False, device), expected)


def test_codes_of_video_are_those_of_ffmpeg(device):
    rng = np.random.default_rng(3)
    for height, width in SIZES:
        noise = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
        for image in (noise, np.where(noise > 127, 255, 0).astype(np.uint8), np.full_like(noise, 255), noise // 128):
            np.testing.assert_array_equal(to_yuv(image, device), ffmpeg_yuv(image))


def test_a_camera_s_picture_forth_and_back(device):
    image = np.ascontiguousarray(desk_frames(1)[0])
    codes = to_yuv(image, device)
    np.testing.assert_array_equal(codes, ffmpeg_yuv(image))
    height, width = image.shape[:2]
    luma, cb, cr = np.split(codes, [height * width, height * width * 5 // 4])
    planes = [luma.reshape(height, width), cb.reshape(height // 2, -1), cr.reshape(height // 2, -1)]
    expected = rgb_from_video(VideoReformatter(), picture_of(planes, "bt709", full=False))
    np.testing.assert_array_equal(to_rgb(planes, "bt709", False, False, device), expected)


def test_grey_has_no_chroma(device):
    codes = to_yuv(np.full((32, 32, 3), 128, np.uint8), device)
    assert set(codes[: 32 * 32]) == {round(16 + 219 * 128 / 255)}
    assert set(codes[32 * 32 :]) == {128}
