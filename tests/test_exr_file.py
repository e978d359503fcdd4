"""OpenEXR files that lack their end are told from whole ones."""

from __future__ import annotations

import errno
import pathlib
import sys

import numpy as np
import OpenEXR
import pytest

from tests.test_full_disk import file_limit
from warp_ar.accuracy.path_tracer import TracedPicture
from warp_ar.errors import SinkError
from warp_ar.exr_file import check_whole_exr, write_exr
from warp_ar.light.captured import Light
from warp_ar.output.environment_file import write_environment
from warp_ar.output.stmap import write_stmap
from warp_ar.reference import write_picture

HEADER = {"type": OpenEXR.scanlineimage, "software": "a test"}


@pytest.mark.parametrize(
    "compression",
    ["NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB"],
)
@pytest.mark.parametrize("rows", [1, 17, 300])
def test_whole_files_are_whole(tmp_path: pathlib.Path, compression: str, rows: int) -> None:
    header = {**HEADER, "compression": getattr(OpenEXR, f"{compression}_COMPRESSION")}
    pixels = np.random.default_rng(0).random((rows, 9, 3)).astype(np.float32)
    confidence = np.ones((rows, 9), np.float32)
    path = tmp_path / "a.exr"
    write_exr(path, OpenEXR.File(header, {"RGB": pixels, "confidence": confidence}))
    before = path.read_bytes()
    check_whole_exr(path)
    assert path.read_bytes() == before
    path.write_bytes(before[:-1])
    with pytest.raises(OSError, match="error"):
        check_whole_exr(path)


@pytest.mark.parametrize("parts", [1, 3])
def test_a_file_is_told_wherever_it_is_cut(tmp_path: pathlib.Path, parts: int) -> None:
    path = tmp_path / "a.exr"
    header = {**HEADER, "compression": OpenEXR.ZIP_COMPRESSION}
    pixels = np.ones((20, 4), np.float32)
    if parts == 1:
        image = OpenEXR.File(header, {"Y": pixels})
    else:
        image = OpenEXR.File([OpenEXR.Part(dict(header), {"Y": k + pixels}, f"part {k}") for k in range(parts)])
    write_exr(path, image)
    whole = path.read_bytes()
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        with pytest.raises(OSError, match="error"):
            check_whole_exr(path)


@pytest.mark.skipif(sys.platform == "win32", reason="no limit of a file's size")
def test_the_system_says_why_a_file_lacks_its_end(tmp_path: pathlib.Path) -> None:
    import resource

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    try:
        with pytest.raises(OSError, match="large") as caught:
            write_exr(tmp_path / "a.exr", OpenEXR.File(HEADER, {"Y": np.ones((20, 4), np.float32)}))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert caught.value.errno == errno.EFBIG


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
