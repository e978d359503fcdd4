"""OpenEXR files that lack their end are told from whole ones."""

from __future__ import annotations

import json
import pathlib
import sys

import cv2
import numpy as np
import OpenEXR
import pytest

from tests.test_full_disk import file_limit
from warp_ar.accuracy.path_tracer import TracedPicture
from warp_ar.errors import SinkError
from warp_ar.exr_file import write_exr
from warp_ar.light.captured import Light
from warp_ar.output.camera_files import distort_map, undistort_map, write_stmap
from warp_ar.output.environment_file import encode_hdr, write_environment
from warp_ar.output.layer_file import MATTES, matte_bits, matte_channels, matte_header, murmur3
from warp_ar.reference import write_picture
from warp_ar.scene import Camera
from warp_ar.signature import is_signed

HEADER = {"type": OpenEXR.scanlineimage, "software": "a test"}


class CutShort:
    """A picture of which only so many bytes reach the disk, without a word."""

    def __init__(self, image: OpenEXR.File, length: int) -> None:
        self.parts, self._image, self._length = image.parts, image, length

    def write(self, name: str) -> None:
        self._image.write(name)
        with open(name, "r+b") as stream:
            stream.truncate(self._length)


@pytest.mark.parametrize("compression", ["NO", "ZIP"])
@pytest.mark.parametrize("parts", [1, 3])
def test_a_file_is_told_wherever_it_is_cut(tmp_path: pathlib.Path, parts: int, compression: str) -> None:
    path = tmp_path / "a.exr"
    header = {**HEADER, "compression": getattr(OpenEXR, f"{compression}_COMPRESSION")}
    pixels = np.ones((20, 4), np.float32)
    if parts == 1:
        image = OpenEXR.File(header, {"Y": pixels})
    else:
        image = OpenEXR.File([OpenEXR.Part(dict(header), {"Y": k + pixels}, f"part {k}") for k in range(parts)])
    write_exr(path, image)
    whole = path.read_bytes()
    for length in range(len(whole)):
        with pytest.raises((OSError, RuntimeError)):
            write_exr(path, CutShort(image, length))
    write_exr(path, CutShort(image, len(whole)))
    assert path.read_bytes() == whole


RADIANCE = np.random.default_rng(1).uniform(0.0, 4.0, (4, 8, 3)).astype(np.float32)
WRITERS = {
    "stmap": lambda path: write_stmap(path, RADIANCE[..., :2]),
    "environment": lambda path: write_environment(path, RADIANCE, overwrite=False),
    "captured": lambda path: Light(RADIANCE, RADIANCE[..., 0]).save(path),
    "reference": lambda path: write_picture(
        path, TracedPicture(RADIANCE, RADIANCE, np.zeros((1, 1, 3), np.uint8), 8, 0.0, 0.0)
    ),
}


@pytest.mark.skipif(sys.platform == "win32", reason="no limit of a file's size")
@pytest.mark.parametrize("name", WRITERS)
def test_what_does_not_fit_is_not_there(tmp_path: pathlib.Path, name: str) -> None:
    """Whole or absent, and told, wherever the space ends: OpenEXR itself looks at none of a buffer's last bytes."""
    WRITERS[name](tmp_path / "whole.exr")
    size = (tmp_path / "whole.exr").stat().st_size
    (tmp_path / "whole.exr").unlink()
    for limit in (0, 100, size // 2, size - 100, size - 1):
        with file_limit(limit), pytest.raises(SinkError, match=r"a\.exr cannot be written"):
            WRITERS[name](tmp_path / "a.exr")
        assert not list(tmp_path.iterdir())


# --- Radiance's HDR: other readers see what was written, within half a step -------------------------------------------


STEP = 1.0 / 256.0  # half of the least mantissa, 1 part in 128


def written(tmp_path: pathlib.Path, radiance: np.ndarray) -> pathlib.Path:
    path = tmp_path / "e.hdr"
    path.write_bytes(encode_hdr(radiance, "latlong"))
    return path


def read(path: pathlib.Path) -> np.ndarray:
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1]


def test_opencv_reads_it_within_half_a_step(tmp_path: pathlib.Path) -> None:
    rng = np.random.default_rng(0)
    radiance = np.exp(rng.uniform(-20, 20, (64, 128, 3))).astype(np.float32)
    error = np.abs(read(written(tmp_path, radiance)) - radiance) / radiance.max(2, keepdims=True)
    assert error.max() <= STEP
    assert is_signed(tmp_path / "e.hdr")


def test_edges_of_its_range(tmp_path: pathlib.Path) -> None:
    """255.6 steps round to the next exponent; black, no number, negative and endless values are told."""
    values = [0.0, 0.999, 1.0, 255.6 / 256, np.nan, -1.0, np.inf, 1e-44]
    radiance = np.repeat(np.array(values, np.float32)[None, :, None], 3, 2)
    back = read(written(tmp_path, radiance))[0, :, 0]
    np.testing.assert_allclose(back[:4], values[:4], rtol=STEP)
    assert back[4] == back[5] == back[7] == 0.0
    assert back[6] == pytest.approx(1e38, rel=STEP)


def test_a_wide_map_is_not_taken_for_run_lengths(tmp_path: pathlib.Path) -> None:
    """A scanline that began with 2, 2 would be: the brightest mantissa, at 128 or more, forbids it."""
    radiance = np.full((2, 300, 3), 2.0 / 256, np.float32)
    radiance[..., 2] = 300 / 65536
    back = read(written(tmp_path, radiance))
    assert np.abs(back - radiance).max() <= STEP * radiance.max()


# --- STMaps against OpenCV's own undistortion, and against each other -------------------------------------------------


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


# --- Mattes: hashes by published vectors, and what a compositor picks by a name ---------------------------------------


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("", 0),
        ("a", 0x3C2569B2),
        ("hello, world", 0x149BBB7F),
        ("The quick brown fox jumps over the lazy dog", 0x2E4FF723),
    ],
)
def test_hash_by_published_vectors(text, value):
    assert murmur3(text.encode()) == value


def test_no_hash_is_a_float_that_cannot_be_kept():
    bits = np.array([matte_bits(f"object_{k}") for k in range(20_000)], np.uint32)
    raw = np.array([murmur3(f"object_{k}".encode()) for k in range(20_000)], np.uint32)
    changed = bits != raw
    assert changed.any(), "some fall on denormal, infinite or NaN floats"
    assert np.isfinite(bits.view(np.float32)).all()
    assert (np.abs(bits.view(np.float32)) >= np.finfo(np.float32).tiny).all()


def test_a_name_picks_its_matte():
    names = ("sphere", "plane", "ball")
    coverage = np.zeros((2, 2, 8), np.float32)
    coverage[..., 0::2] = -1.0
    coverage[0, 0, :4] = (1, 0.75, 0, 0.25)
    coverage[1, 1, :6] = (2, 0.5, 1, 0.25, 0, 0.25)
    channels = matte_channels(coverage, names)
    assert sorted(channels) == [f"{MATTES}{rank}.{c}" for rank in ("00", "01") for c in "ABGR"]
    header = matte_header(names)
    key = next(iter(header)).rsplit("/", 1)[0]
    assert len(key) == len("cryptomatte/") + 7
    manifest = json.loads(header[f"{key}/manifest"])
    for number, name in enumerate(names):
        wanted = np.array([int(manifest[name], 16)], np.uint32).view(np.float32)[0]
        matte = sum(
            np.where(channels[f"{MATTES}{rank}.{a}"] == wanted, channels[f"{MATTES}{rank}.{b}"], 0.0)
            for rank in ("00", "01")
            for a, b in ("RG", "BA")
        )
        expected = sum(np.where(coverage[..., 2 * k] == number, coverage[..., 2 * k + 1], 0.0) for k in range(4))
        np.testing.assert_array_equal(matte, expected)
