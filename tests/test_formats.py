"""Pictures and videos of every ending that sources read."""

from __future__ import annotations

import pathlib

import cv2
import numpy as np
import OpenEXR
import pytest

from tests.test_sources import write_video
from warp_ar.kernels.color import decode_table
from warp_ar.sources.frame_folder import IMAGE_SUFFIXES, LINEAR_SUFFIX
from warp_ar.sources.sources import open_source

LOSSY = 12  # codes by which a smooth picture changes in JPEG or WebP of OpenCV's default quality, or in video


def smooth() -> np.ndarray:
    ramp = np.linspace(20, 220, 64)
    return np.stack([np.tile(ramp, (48, 1)), np.full((48, 64), 90.0), np.tile(ramp[::-1], (48, 1))], 2).astype(np.uint8)


@pytest.mark.parametrize("suffix", sorted(IMAGE_SUFFIXES))
def test_pictures_of_every_ending_are_frames(tmp_path: pathlib.Path, suffix: str) -> None:
    if suffix == LINEAR_SUFFIX:
        light = decode_table("srgb")[smooth(), [0, 1, 2]]
        kind = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(kind, {"RGB": light}).write(str(tmp_path / f"0{suffix}"))
    else:
        (tmp_path / f"0{suffix}").write_bytes(cv2.imencode(suffix, smooth()[..., ::-1])[1].tobytes())
    with open_source(tmp_path) as source:
        frames = [frame.image for frame in source]
    assert len(frames) == 1
    allowed = LOSSY if suffix in (".jpg", ".jpeg", ".webp") else 0
    assert np.abs(frames[0].astype(int) - smooth()).max() <= allowed


@pytest.mark.parametrize(
    ("suffix", "codec"),
    [(".mp4", "libx264"), (".mkv", "libx264"), (".mov", "libx264"), (".webm", "libvpx-vp9"), (".avi", "mjpeg")],
)
def test_videos_of_every_ending_are_frames(tmp_path: pathlib.Path, suffix: str, codec: str) -> None:
    pictures = [smooth(), smooth()[:, ::-1].copy(), smooth()]
    path = write_video(tmp_path / f"clip{suffix}", pictures, codec=codec)
    with open_source(path) as source:
        frames = [frame.image for frame in source]
    assert len(frames) == len(pictures)
    for frame, picture in zip(frames, pictures, strict=True):
        assert np.abs(frame.astype(int) - picture).mean() <= LOSSY
