"""Frames out: whole files whatever happens, true colour, errors that come at the right time."""

from __future__ import annotations

import fractions
import pathlib
import shutil

import av
import cv2
import numpy as np
import pytest

from tests.test_sources import no_thread_left, patches  # noqa: F401  (a fixture)
from warp_ar.errors import SinkError
from warp_ar.output.environment_file import write_environment
from warp_ar.output.sink import FRAMES_WAITING
from warp_ar.output.sinks import EnvironmentSink, FolderSink, open_sink
from warp_ar.sources.sources import open_source

# 4:2:0 at limited range keeps 219 of 255 levels; at this quality the codec adds its own rounding.
VIDEO_LEVELS = 3
# Smooth colour ramps at the same quality: chroma is halved, and the codec quantises.
RAMP_LEVELS = 6
# Their mean error: rounding and quantisation are nearly even-handed.
RAMP_MEAN = 0.4

VIDEOS = ("clip.mp4", "clip.mkv", "clip.mov")


def flat(level: int, size: tuple[int, int] = (64, 48)) -> np.ndarray:
    return np.full((size[1], size[0], 3), level, np.uint8)


def radiance() -> np.ndarray:
    rng = np.random.default_rng(0)
    image = rng.exponential(1.0, (8, 16, 3)).astype(np.float32)
    image[0, 0] = (1e6, 1e-30, -0.5)
    return image


def levels(path: pathlib.Path) -> list[float]:
    with open_source(path) as source:
        return [float(frame.image.mean()) for frame in source]


def error_of(path: pathlib.Path) -> str:
    with pytest.raises(SinkError) as caught:
        open_sink(path, fps=24)
    assert "\n" not in str(caught.value)
    return str(caught.value)


# -------------------------------------------------------------------------------------------------------------- folders


def test_folder_holds_exactly_what_was_written(tmp_path: pathlib.Path) -> None:
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (7, 9, 3), dtype=np.uint8) for _ in range(3 * FRAMES_WAITING)]
    with open_sink(tmp_path / "a" / "b", fps=24) as sink:
        for image in images:
            sink.write(image)
    names = sorted(entry.name for entry in (tmp_path / "a" / "b").iterdir())
    assert names == [f"{index:04d}.png" for index in range(len(images))]
    for index, image in enumerate(images):
        read = cv2.imread(str(tmp_path / "a" / "b" / f"{index:04d}.png"))
        assert np.array_equal(read[..., ::-1], image)


def test_folder_leaves_other_files_alone(tmp_path: pathlib.Path) -> None:
    for name in ("notes.txt", "0007.exr", "f0007.png", "7.png"):
        (tmp_path / name).write_text("kept")
    with open_sink(tmp_path, fps=24) as sink:
        sink.write(flat(9))
        assert sink.replaced == ""
    assert cv2.imread(str(tmp_path / "0000.png")).mean() == 9
    for name in ("notes.txt", "0007.exr", "f0007.png", "7.png"):
        assert (tmp_path / name).read_text() == "kept"


@pytest.mark.parametrize("kind", ["png", "exr"])
def test_frames_of_an_earlier_run_go_with_a_word(tmp_path: pathlib.Path, kind: str) -> None:
    def run(count: int, **options: bool) -> str:
        with FolderSink(tmp_path, **options) if kind == "png" else EnvironmentSink(tmp_path, **options) as sink:
            for _ in range(count):
                sink.write(flat(9) if kind == "png" else radiance())
            return sink.replaced

    assert run(6) == ""
    assert "6 numbered frames of an earlier run" in run(0)
    assert len(list(tmp_path.iterdir())) == 6  # nothing new, nothing lost
    assert "6 numbered frames of an earlier run" in run(2)
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"0000.{kind}", f"0001.{kind}"]
    (tmp_path / f"0009.{kind}").write_bytes(b"mine")
    with pytest.raises(SinkError, match=r"1 numbered frames that this program did not write, such as 0009"):
        run(2)
    assert (tmp_path / f"0009.{kind}").read_bytes() == b"mine"
    assert "3 numbered frames" in run(1, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == [f"0000.{kind}"]


@pytest.mark.parametrize("name", ["clip.mp4", "clip.mkv", "clip.mov", "e.exr"])
def test_only_what_was_written_here_is_replaced(tmp_path: pathlib.Path, name: str) -> None:
    path = tmp_path / name

    def write(**options: bool) -> str:
        if name == "e.exr":
            write_environment(path, radiance(), **options)
            return ""
        with open_sink(path, fps=24, **options) as sink:
            for _ in range(30):
                sink.write(flat(9))
            return sink.replaced

    assert write() == ""
    assert name == "e.exr" or "this program wrote it before" in write()
    path.write_bytes(b"mine")
    with pytest.raises(SinkError, match="did not write it; name another, or replace it with --overwrite"):
        write()
    assert path.read_bytes() == b"mine"
    write(overwrite=True)
    write()
    path.write_bytes(b"")  # an empty file, as mktemp makes one: nothing is lost
    write()
    assert path.stat().st_size > 4


def test_a_video_that_was_cut_off_by_a_kill_is_known_as_ones_own(tmp_path: pathlib.Path) -> None:
    with open_sink(tmp_path / "clip.mp4", fps=24) as sink:
        for level in range(96):
            sink.write(flat(level))
        while not (tmp_path / "clip.mp4").exists():
            sink.write(flat(0))
        shutil.copy(tmp_path / "clip.mp4", tmp_path / "killed.mp4")
    with open_sink(tmp_path / "killed.mp4", fps=24) as sink:
        assert "this program wrote it before" in sink.replaced


@pytest.mark.parametrize("name", ["frames", "clip.mp4"])
def test_written_array_may_be_reused(tmp_path: pathlib.Path, name: str) -> None:
    image = flat(0)
    with open_sink(tmp_path / name, fps=24) as sink:
        for level in range(0, 200, 10):
            image[:] = level
            sink.write(image)
    assert levels(tmp_path / name) == pytest.approx(list(range(0, 200, 10)), abs=VIDEO_LEVELS)


def test_png_that_cannot_be_written_is_told_once(tmp_path: pathlib.Path) -> None:
    (tmp_path / "0001.png").mkdir()
    sink = open_sink(tmp_path, fps=24)

    def write_many() -> None:
        for _ in range(3 + FRAMES_WAITING):
            sink.write(flat(1))

    with pytest.raises(SinkError, match=r"0001\.png cannot be written"):
        write_many()
    with pytest.raises(SinkError, match=r"0001\.png"):
        sink.write(flat(1))
    sink.close()
    assert not list(tmp_path.glob(".*"))


def test_light_of_balls_of_an_earlier_run_goes(tmp_path: pathlib.Path) -> None:
    for folder in (tmp_path, tmp_path / "ball_1", tmp_path / "ball_2", tmp_path / "ball_room"):
        with EnvironmentSink(folder) as sink:
            sink.write(radiance())
            sink.write(radiance())
    theirs = tmp_path / "ball_2" / "0007.exr"
    theirs.write_bytes(b"somebody's")
    with pytest.raises(SinkError, match=r"ball_2 holds 1 numbered frames that this program did not write"):
        EnvironmentSink(tmp_path)
    theirs.unlink()
    with EnvironmentSink(tmp_path) as sink:
        assert (tmp_path / "ball_1" / "0001.exr").exists(), "nothing goes before there is a frame"
        assert sink.replaced.endswith("6 numbered frames of an earlier run are replaced")
        sink.write(radiance())
    assert {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.exr")} == {
        "0000.exr",
        "ball_room/0000.exr",
        "ball_room/0001.exr",
    }


# ---------------------------------------------------------------------------------------------------------------- video


@pytest.mark.parametrize("name", VIDEOS)
def test_video_holds_every_frame_at_its_rate(tmp_path: pathlib.Path, name: str) -> None:
    with open_sink(tmp_path / "new" / name, fps=25, size=(64, 48)) as sink:
        for index in range(50):
            sink.write(flat(5 * index))
    path = tmp_path / "new" / name
    assert levels(path) == pytest.approx([5 * index for index in range(50)], abs=VIDEO_LEVELS)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        assert (context.name, context.pix_fmt) == ("h264", "yuv420p")
        assert (context.colorspace, context.color_primaries, context.color_trc) == (1, 1, 1)
        assert int(context.color_range) == 1
        assert stream.average_rate == 25
        assert container.duration == pytest.approx(2 * av.time_base, rel=1e-3)


@pytest.mark.parametrize("name", VIDEOS)
def test_times_of_a_variable_rate_are_kept(tmp_path: pathlib.Path, name: str) -> None:
    times = [0.0, 0.033, 0.066, 0.1, 0.6, 0.633, 0.633, 1.2]
    with open_sink(tmp_path / name, fps=8.9, tick=fractions.Fraction(1, 16000)) as sink:
        for index, seconds in enumerate(times):
            sink.write_at(flat(20 * index), seconds)
    with av.open(str(tmp_path / name)) as container:
        shown = [float(picture.time) for picture in container.decode(video=0)]
    # Two frames at one time are a tick apart; Matroska's is a millisecond.
    assert shown == pytest.approx(times, abs=1.1e-3)
    assert all(np.diff(shown) > 0)
    assert levels(tmp_path / name) == pytest.approx([20 * index for index in range(8)], abs=VIDEO_LEVELS)


@pytest.mark.parametrize("name", VIDEOS)
def test_colours_survive(tmp_path: pathlib.Path, name: str) -> None:
    with open_sink(tmp_path / name, fps=24) as sink:
        for _ in range(4):
            sink.write(patches())
    with open_source(tmp_path / name) as source:
        for frame in source:
            difference = frame.image[16, 16::32].astype(int) - patches()[16, 16::32]
            assert np.abs(difference).max() <= VIDEO_LEVELS


def test_stored_luma_is_bt709_limited(tmp_path: pathlib.Path) -> None:
    # A round trip would forgive a wrong matrix used twice: look at the stored values.
    with open_sink(tmp_path / "clip.mp4", fps=24) as sink:
        for _ in range(3):
            sink.write(patches())
    with av.open(str(tmp_path / "clip.mp4")) as container:
        luma = next(container.decode(video=0)).to_ndarray()[16, 16 : 32 * 12 : 32]
    expected = 16 + 219 / 255 * (patches()[16, 16::32] @ [0.2126, 0.7152, 0.0722])
    assert np.abs(luma - expected).max() <= VIDEO_LEVELS


def test_pictures_are_not_shifted(tmp_path: pathlib.Path) -> None:
    x, y = np.meshgrid(np.arange(128), np.arange(96))
    ramp = np.stack([2 * x, 2 * y + 30, 250 - x - y], axis=-1).astype(np.uint8)
    with open_sink(tmp_path / "clip.mp4", fps=24) as sink:
        for _ in range(4):
            sink.write(ramp)
    with open_source(tmp_path / "clip.mp4") as source:
        # Left-sited chroma has nothing to lean on at the borders.
        difference = np.stack([frame.image.astype(int) - ramp for frame in source])[:, 8:-8, 8:-8]
    assert np.abs(difference).max() <= RAMP_LEVELS
    # Chroma half a column off is a mean of 0.8.
    assert np.abs(difference.mean(axis=(0, 1, 2))).max() < RAMP_MEAN


@pytest.mark.parametrize("size", [(1, 1), (63, 48), (64, 47), (33, 17)])
def test_odd_sizes_are_padded_and_say_so(tmp_path: pathlib.Path, size: tuple[int, int]) -> None:
    width, height = size
    image = flat(120, size)
    image[:, -1] = 60
    with open_sink(tmp_path / "clip.mp4", fps=24) as sink:
        for _ in range(3):
            sink.write(image)
        even = (width + width % 2, height + height % 2)
        assert f"padded to {even[0]}x{even[1]}" in sink.description
    assert "padded" in open_sink(tmp_path / "other.mp4", fps=24, size=size).description
    with open_source(tmp_path / "clip.mp4") as source:
        assert source.size == even
        decoded = next(iter(source)).image
    assert abs(int(decoded[height // 2, even[0] - 1, 1]) - 60) <= RAMP_LEVELS + 10 * (width > 1)


def test_no_frame_leaves_no_file_and_no_loss(tmp_path: pathlib.Path) -> None:
    open_sink(tmp_path / "new.mp4", fps=24).close()
    assert not (tmp_path / "new.mp4").exists()
    (tmp_path / "old.mp4").write_text("old")
    open_sink(tmp_path / "old.mp4", fps=24, overwrite=True).close()
    assert (tmp_path / "old.mp4").read_text() == "old"


# --------------------------------------------------------------------------------------------------------------- errors


def test_bad_paths_are_told_at_open(tmp_path: pathlib.Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.mp4").mkdir()
    (tmp_path / "frames.v2").mkdir()
    assert ".gif" in (message := error_of(tmp_path / "clip.gif"))
    assert ".mp4" in message
    assert "is a file" in error_of(tmp_path / "file")
    assert "is a folder" in error_of(tmp_path / "folder.mp4")
    assert "is a file, not a folder" in error_of(tmp_path / "file" / "clip.mp4")
    assert "Not a directory" in error_of(tmp_path / "file" / "frames")
    open_sink(tmp_path / "frames.v2", fps=24).close()
    open_sink(f"{tmp_path}/frames.v3/", fps=24).close()
    assert (tmp_path / "frames.v3").is_dir()


@pytest.mark.parametrize("name", ["frames", "clip.mp4"])
def test_other_images_are_refused(tmp_path: pathlib.Path, name: str) -> None:
    with open_sink(tmp_path / name, fps=24) as sink:
        sink.write(flat(0))
        for image in (flat(0)[..., 0], flat(0).astype(np.float32), flat(0)[:0]):
            with pytest.raises(SinkError, match="uint8 RGB"):
                sink.write(image)
        with pytest.raises(SinkError, match="frame 1 is 32x48, not 64x48"):
            sink.write(flat(0, (32, 48)))
    with pytest.raises(SinkError, match="closed"):
        sink.write(flat(0))
