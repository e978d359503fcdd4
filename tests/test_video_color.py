"""Conversion of video's codes on the device: FFmpeg's own results, to the bit."""

from __future__ import annotations

import fractions

import av
import numpy as np
import pytest
import warp as wp
from av.video.reformatter import ColorRange, Colorspace, VideoReformatter

from tests.farm_rig import desk_frames, write_recording
from warp_ar.farm import codes as device_video
from warp_ar.farm.codes import LEAST_SIZE, SLOTS, DecodedPicture, DeviceVideo, can_convert
from warp_ar.kernels.picture.video_color import rgb_factors, rgb_from_yuv, yuv_from_rgb, yuv_layout
from warp_ar.output.video_sink import rgb_to_yuv
from warp_ar.sources.video_file import rgb_from_video

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


def to_rgb(planes, matrix, full, interleaved, device, left=False):
    height, width = planes[0].shape
    with wp.ScopedDevice(device):
        rgb = wp.zeros((height, width), dtype=wp.vec3ub)
        layout = yuv_layout(height, width, interleaved=interleaved, left=left)
        codes = wp.array(packed(planes, interleaved))
        factors = rgb_factors(matrix, full_range=full)
        rgb_from_yuv(codes[: height * width], codes[height * width :], layout, factors, rgb)
        return rgb.numpy()


def to_yuv(image, device):
    height, width = image.shape[:2]
    with wp.ScopedDevice(device):
        codes = wp.zeros(height * width * 3 // 2, dtype=wp.uint8)
        planes = codes[: height * width], codes[height * width :]
        yuv_from_rgb(wp.array(image, dtype=wp.vec3ub), yuv_layout(height, width), *planes)
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


def decoded_picture(tmp_path):
    """A picture as H.264's decoder gives it: chroma at the left one of two columns."""
    write_recording(tmp_path / "a.mp4", 2)
    with av.open(str(tmp_path / "a.mp4")) as container:
        return next(container.decode(video=0))


@pytest.mark.parametrize("interleaved", [False, True])
def test_a_decoded_picture_has_its_chroma_at_the_left(tmp_path, interleaved, device):
    picture = decoded_picture(tmp_path)
    expected = rgb_from_video(VideoReformatter(), picture)
    planes = planes_of(picture)
    np.testing.assert_array_equal(to_rgb(planes, "bt601", False, interleaved, device, left=True), expected)
    assert (to_rgb(planes, "bt601", False, interleaved, device) != expected).any()


def test_where_chroma_lies_is_found_out(tmp_path, device):
    decoded = DecodedPicture(decoded_picture(tmp_path))
    height, width, _ = decoded.shape
    video = DeviceVideo((width, height), wp.get_device(device))
    planes = random_planes((height, width), 5)
    between = picture_of(planes, "bt709", full=True)
    in_turn = av.VideoFrame(width, height, "nv12")
    in_turn.colorspace, in_turn.color_range = between.colorspace, between.color_range
    for plane, values in zip(in_turn.planes, (planes[0], np.stack(planes[1:], -1).reshape(-1, width)), strict=True):
        rows = np.zeros((plane.height, plane.line_size), np.uint8)
        rows[:, :width] = values
        plane.update(rows.tobytes())
    for other, left in ((decoded, True), (DecodedPicture(between), False), (DecodedPicture(in_turn), False)):
        assert can_convert(other.picture)
        assert video.adapt(other, rgb_from_video(VideoReformatter(), other.picture))
        assert video.left is left
        np.testing.assert_array_equal(video.send(other).numpy(), rgb_from_video(VideoReformatter(), other.picture))
        video.fetch(video.send(other))


def test_a_picture_with_other_arithmetic_is_told(tmp_path, monkeypatch, device):
    decoded = DecodedPicture(decoded_picture(tmp_path))
    video = DeviceVideo((decoded.shape[1], decoded.shape[0]), wp.get_device(device))
    expected = rgb_from_video(VideoReformatter(), decoded.picture)
    assert video.adapt(decoded, expected)
    assert not video.adapt(decoded, expected ^ 1)
    monkeypatch.setattr(device_video, "rgb_to_yuv", lambda *a: rgb_to_yuv(*a, pixel_format="yuvj420p"))
    assert not video.adapt(decoded, expected)


@pytest.mark.parametrize(
    ("kind", "size"),
    [
        ("yuv422p", (32, 32)),
        ("yuv420p10le", (32, 32)),
        ("rgb24", (32, 32)),
        ("yuv420p", (8, 32)),
        ("yuv420p", (33, 32)),
    ],
)
def test_what_the_device_cannot_convert(kind, size):
    assert can_convert(av.VideoFrame(32, 32, "yuv420p"))
    assert not can_convert(av.VideoFrame(*size, kind))


def test_codes_of_several_frames_are_kept_apart(tmp_path, device):
    decoded = DecodedPicture(decoded_picture(tmp_path))
    height, width, _ = decoded.shape
    video = DeviceVideo((width, height), wp.get_device(device))
    images = [np.full((height, width, 3), 20 * n, np.uint8) for n in range(SLOTS)]
    lit = []
    for image in images:
        video.send(decoded)
        lit.append(video.fetch(wp.array(image, dtype=wp.vec3ub, device=device)))
    for image, picture in zip(images, lit, strict=True):
        assert picture.shape == image.shape
        np.testing.assert_array_equal(packed(planes_of(picture.copy()), False), ffmpeg_yuv(image))
