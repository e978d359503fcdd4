"""The table of formats: every row has its tests, every ending that the code takes has its row."""

from __future__ import annotations

import pathlib
import re

import cv2
import numpy as np
import OpenEXR
import pytest

import warp_ar
from docs.tables import READERS, formats
from tests.test_sources import write_video
from warp_ar.kernels.color import decode_table
from warp_ar.output.camera_files import TRACK_SUFFIX
from warp_ar.output.environment_file import ENVIRONMENT_SUFFIXES
from warp_ar.output.gltf_file import GLTF_SUFFIX
from warp_ar.output.usd_file import USD_SUFFIXES
from warp_ar.output.video_sink import VIDEO_SUFFIXES
from warp_ar.scene.mesh_files import MESH_SUFFIXES
from warp_ar.sources.frame_folder import IMAGE_SUFFIXES, LINEAR_SUFFIX
from warp_ar.sources.sources import open_source

ROOT = pathlib.Path(warp_ar.__file__).parents[1]
PAGE = ROOT / "docs" / "formats.md"
LOSSY = 12  # codes by which a smooth picture changes in JPEG or WebP of OpenCV's default quality, or in video


def rows(section: str) -> list[list[str]]:
    """Cells of a section's table, without its head."""
    text = PAGE.read_text(encoding="utf-8").split(f"## {section}\n")[1].split("\n## ")[0]
    lines = [line for line in re.sub(r"\[(.*?)\]\(.*?\)", r"\1", text).splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


@pytest.mark.parametrize(
    ("section", "what", "suffixes"),
    [
        ("In", "frames", IMAGE_SUFFIXES),
        ("In", "mesh with its materials", MESH_SUFFIXES),
        ("Out", "lit frames", VIDEO_SUFFIXES),
        ("Out", "environment", ENVIRONMENT_SUFFIXES),
        ("Out", "a shot", (*USD_SUFFIXES, GLTF_SUFFIX, TRACK_SUFFIX)),
    ],
)
def test_every_ending_has_its_row(section: str, what: str, suffixes: tuple[str, ...]) -> None:
    told = {ending for row in rows(section) if row[0] == what for ending in re.findall(r"`(\.\w+)`", row[1])}
    assert told == set(suffixes)


def test_every_mesh_has_a_reader_that_says_what_it_follows() -> None:
    assert set(re.findall(r"`(\.\w+)`", " ".join(READERS))) >= {*MESH_SUFFIXES, ".exr", ".hdr"}
    obj = next(row for row in formats().splitlines() if row.startswith("| `.obj`"))
    assert "surf" in obj
    assert "the material …, which no library has" in obj  # of the code itself


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
