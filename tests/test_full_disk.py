"""Frames out where the disk is full, or files may grow no further: whole files and true counts."""

from __future__ import annotations

import contextlib
import pathlib
import sys
from collections.abc import Iterator

import cv2
import numpy as np
import OpenEXR
import pytest

from tests.test_sinks import VIDEOS, flat, levels, no_thread_left  # noqa: F401  (a fixture)
from warp_ar.errors import SinkError
from warp_ar.output.environment_file import read_environment
from warp_ar.output.layer_file import LayerFrame, LayerSink
from warp_ar.output.sinks import EnvironmentSink, FolderSink, open_sink

pytestmark = pytest.mark.slow


@contextlib.contextmanager
def file_limit(size: int) -> Iterator[None]:
    """Let no file of this process grow beyond so many bytes: a quota where no disk can be mounted.

    Python ignores SIGXFSZ, so that a write beyond the limit fails with EFBIG, as one onto a full disk does with ENOSPC.
    """
    import resource

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.skipif(sys.platform == "win32", reason="no limit of a file's size")
@pytest.mark.parametrize("limit", [0, 30_000, 150_000])
@pytest.mark.parametrize("name", VIDEOS)
def test_a_limit_of_files_leaves_whole_videos_and_true_counts(tmp_path: pathlib.Path, name: str, limit: int) -> None:
    rng = np.random.default_rng(0)
    sink = open_sink(tmp_path / name, fps=24)

    def fill() -> None:
        with sink:
            for _ in range(200):
                sink.write(rng.integers(0, 256, (48, 320, 3), dtype=np.uint8))

    with file_limit(limit), pytest.raises(SinkError, match="File too large"):
        fill()
    if (tmp_path / name).exists():
        assert len(levels(tmp_path / name)) == sink.written > 0
    else:
        assert sink.written == 0
    assert limit < 150_000 or sink.written > 0
    assert not list(tmp_path.rglob(".*"))


FOLDERS = {
    "frames": (lambda path: FolderSink(path), lambda image: image, lambda path: cv2.imread(str(path))),
    "light": (lambda path: EnvironmentSink(path), lambda image: image.astype(np.float32), read_environment),
    "layers": (
        lambda path: LayerSink(path, pictures=("plate",)),
        lambda image: LayerFrame({"plate": image.astype(np.float32)}, image, ()),
        lambda path: OpenEXR.File(str(path)).parts[0].channels["plate"].pixels,
    ),
}


@pytest.mark.skipif(sys.platform == "win32", reason="no limit of a file's size")
@pytest.mark.parametrize("limit", [0, 2_000, 30_000])
@pytest.mark.parametrize("name", FOLDERS)
def test_a_limit_of_files_leaves_whole_frames_and_true_counts(tmp_path: pathlib.Path, name: str, limit: int) -> None:
    """Three flat frames fit or not; the fourth, of noise, does not."""
    opened, prepared, read = FOLDERS[name]
    noise = np.random.default_rng(0).integers(0, 256, (240, 320, 3), dtype=np.uint8)
    sink = opened(tmp_path / name)

    def fill() -> None:
        with sink:
            for image in [*(np.full_like(noise, level) for level in (1, 2, 3)), noise]:
                sink.write(prepared(image))

    with file_limit(limit), pytest.raises(SinkError, match="File too large"):
        fill()
    paths = sorted(path for path in (tmp_path / name).iterdir() if path.is_file())
    assert [read(path).shape for path in paths] == [(240, 320, 3)] * len(paths)
    # Layers count where their pictures are there, too.
    assert sink.written <= len(paths) if name == "layers" else sink.written == len(paths)
    assert sink.written == 3 or limit < 30_000
    assert sink.written == 0 or limit > 0
    assert not list(tmp_path.rglob(".*"))


@pytest.mark.skipif(sys.platform == "win32", reason="no limit of a file's size")
@pytest.mark.parametrize("name", VIDEOS)
def test_an_end_that_does_not_fit_leaves_the_fragments(tmp_path: pathlib.Path, name: str) -> None:
    # 60 frames take 110 to 124 kB: the last fragments fit or not, and so does what makes an ordinary file of them.
    outcomes = set()
    for limit in range(96, 136, 8):
        (tmp_path / name).unlink(missing_ok=True)
        rng, told = np.random.default_rng(0), ""
        with file_limit(1024 * limit):
            try:
                with open_sink(tmp_path / name, fps=24) as sink:
                    for _ in range(60):
                        sink.write(rng.integers(0, 256, (48, 64, 3), dtype=np.uint8))
            except SinkError as error:
                told = str(error)
        assert len(levels(tmp_path / name)) == sink.written
        assert (sink.written == 60) == (told == "") or "finished" in told
        outcomes.add(sink.written)
    assert 60 in outcomes
    assert len(outcomes) > 1
