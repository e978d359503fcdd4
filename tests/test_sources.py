"""Frames in: order, colour, damage, threads."""

from __future__ import annotations

import fractions
import json
import math
import pathlib
import shutil
import struct
import subprocess
import threading
import wave
from collections.abc import Iterator
from typing import Any

import av
import cv2
import numpy as np
import pytest
from av.video.reformatter import ColorRange, Colorspace, VideoReformatter

from warp_ar.errors import SourceError, UsageError
from warp_ar.sources import video_file
from warp_ar.sources.source import FRAMES_AHEAD, QueueSource, Source
from warp_ar.sources.sources import open_source
from warp_ar.sources.video_file import _IN_PLANES, TO_RGB, rgb_from_video

# 4:2:0 at limited range keeps 219 of 255 levels, and the codec adds its own rounding.
VIDEO_LEVELS = 3
# Long enough for any thread to come by on a loaded machine; a test that passes never waits for it.
PATIENCE = 20.0
# The colour matrix of a stream that says nothing of it.
UNNAMED = 2


@pytest.fixture(autouse=True)
def no_thread_left() -> Iterator[None]:
    """Fail where a test leaves a thread; one that was told to end has time to."""
    before = set(threading.enumerate())
    yield
    for thread in set(threading.enumerate()) - before:
        thread.join(PATIENCE)
    assert set(threading.enumerate()) <= before


def write_png(path: pathlib.Path, picture: np.ndarray) -> None:
    path.write_bytes(cv2.imencode(".png", picture)[1].tobytes())


def write_folder(folder: pathlib.Path, count: int, size: tuple[int, int] = (8, 6)) -> pathlib.Path:
    """Frame n is filled with the value n."""
    folder.mkdir(exist_ok=True)
    for index in range(count):
        write_png(folder / f"{index:04d}.png", np.full((size[1], size[0], 3), index, np.uint8))
    return folder


def write_video(
    path: pathlib.Path,
    pictures: list[np.ndarray],
    *,
    codec: str = "libx264",
    fps: int = 24,
    matrix: Colorspace = Colorspace.ITU709,
    tagged: bool = True,
    stamps: list[int] | None = None,
    options: dict[str, str] | None = None,
) -> pathlib.Path:
    with av.open(str(path), "w", options=options or {}) as container:
        stream = container.add_stream(codec, rate=fps)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        if codec == "libx264":
            stream.options = {"crf": "10", "preset": "veryfast"}
        if tagged:
            stream.codec_context.colorspace = matrix
        for index, picture in enumerate(pictures):
            full = ColorRange.JPEG if codec == "mjpeg" else ColorRange.MPEG
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24").reformat(
                format=stream.pix_fmt, dst_colorspace=matrix, dst_color_range=full
            )
            if not tagged:
                frame.colorspace = 2
            frame.pts = stamps[index] if stamps else index
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def noise(count: int, size: tuple[int, int] = (64, 48)) -> list[np.ndarray]:
    rng = np.random.default_rng(1)
    return [rng.integers(0, 256, (size[1], size[0], 3), dtype=np.uint8) for _ in range(count)]


def patches() -> np.ndarray:
    """Flat patches of the colours that a wrong matrix or range moves most."""
    colors = [(255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 0), (0, 255, 255), (255, 0, 255)]
    colors += [(0, 0, 0), (255, 255, 255), (128, 128, 128), (200, 120, 60), (20, 40, 90), (90, 160, 70)]
    return np.concatenate([np.full((32, 32, 3), color, np.uint8) for color in colors], axis=1)


def patch_centers(image: np.ndarray) -> np.ndarray:
    return image[16, 16::32].astype(int)


def take_until_error(source: Source) -> tuple[int, str]:
    count = 0
    try:
        for _ in source:
            count += 1
    except SourceError as error:
        return count, str(error)
    pytest.fail("the source ended without an error")


def error_of(spec: str | int | pathlib.Path, **options: Any) -> str:
    with pytest.raises(SourceError) as caught:
        open_source(spec, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


# -------------------------------------------------------------------------------------------------------------- folders


def test_folder_yields_every_frame_in_natural_order(tmp_path: pathlib.Path) -> None:
    for value in (10, 9, 1, 100):
        write_png(tmp_path / f"f{value}.png", np.full((6, 8, 3), value, np.uint8))
    (tmp_path / "notes.txt").write_text("not a frame")
    with open_source(tmp_path, fps=10) as source:
        frames = list(source)
        assert (source.size, source.length, source.live, source.dropped) == ((8, 6), 4, False, 0)
    assert [int(frame.image[0, 0, 0]) for frame in frames] == [1, 9, 10, 100]
    assert [frame.index for frame in frames] == [0, 1, 2, 3]
    assert [frame.time for frame in frames] == pytest.approx([0, 0.1, 0.2, 0.3])
    assert all(frame.image.flags.c_contiguous and frame.image.dtype == np.uint8 for frame in frames)


def test_folder_can_be_read_twice_and_left_early(tmp_path: pathlib.Path) -> None:
    with open_source(write_folder(tmp_path, 3 * FRAMES_AHEAD)) as source:
        for frame in source:
            if frame.index == 1:
                break
        assert len(list(source)) == 3 * FRAMES_AHEAD
    with pytest.raises(SourceError, match="closed"):
        iter(source)


def test_loop_goes_on_counting(tmp_path: pathlib.Path) -> None:
    with open_source(write_folder(tmp_path, 3), fps=4, loop=True) as source:
        frames = [frame for frame, _ in zip(source, range(8), strict=False)]
    assert [frame.index for frame in frames] == list(range(8))
    assert [int(frame.image[0, 0, 0]) for frame in frames] == [0, 1, 2, 0, 1, 2, 0, 1]
    assert [frame.time for frame in frames] == pytest.approx([index / 4 for index in range(8)])


def test_one_image_is_a_source(tmp_path: pathlib.Path) -> None:
    write_folder(tmp_path, 2)
    with open_source(tmp_path / "0001.png") as source:
        assert [int(frame.image[0, 0, 0]) for frame in source] == [1]


def test_grey_alpha_and_16_bit_become_rgb(tmp_path: pathlib.Path) -> None:
    values = np.arange(0, 65536, dtype=np.uint16).reshape(256, 256)
    write_png(tmp_path / "0.png", values)
    write_png(tmp_path / "1.png", np.full((256, 256), 77, np.uint8))
    write_png(tmp_path / "2.png", np.full((256, 256, 4), (30, 20, 10, 0), np.uint8))
    write_png(tmp_path / "3.png", np.full((256, 256, 3), (257 * 3, 257 * 2, 257), np.uint16))
    with open_source(tmp_path) as source:
        deep, grey, alpha, color = (frame.image for frame in source)
    assert all(image.shape == (256, 256, 3) for image in (deep, grey, alpha, color))
    rounded = np.round(values.astype(np.float64) / 257)
    assert all(np.array_equal(deep[..., channel], rounded) for channel in range(3))
    assert (grey == 77).all()
    assert (alpha == (10, 20, 30)).all()
    assert (color == (1, 2, 3)).all()


def test_image_of_32_bit_numbers_is_an_error(tmp_path: pathlib.Path) -> None:
    (tmp_path / "0.tif").write_bytes(cv2.imencode(".tif", np.full((4, 4, 3), 7, np.int32))[1].tobytes())
    assert "holds int32 values; 8 or 16 bits, or floats, are needed" in error_of(tmp_path)


def test_exposures_come_from_the_sidecar(tmp_path: pathlib.Path) -> None:
    write_folder(tmp_path, 3)
    (tmp_path / "exposures.json").write_text(json.dumps({"0000.png": 0.01, "0002.png": 0.5}))
    with open_source(tmp_path) as source:
        assert [frame.exposure_time for frame in source] == [0.01, None, 0.5]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ('{"000.png": 1}', "did you mean '0000.png'"),
        ('{"0000.png": -1}', "positive"),
        ('{"0000.png": "fast"}', "positive"),
        ("1", "object"),
        ("[]", "list"),
        ("[0.01, 0]", "positive"),
        ("{", "cannot be read"),
    ],
)
def test_bad_sidecar_is_an_error(tmp_path: pathlib.Path, text: str, told: str) -> None:
    write_folder(tmp_path, 1)
    (tmp_path / "exposures.json").write_text(text)
    message = error_of(tmp_path)
    assert told in message
    assert "exposures.json" in message


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tif", ".webp"])
@pytest.mark.parametrize("kept", [0.0, 0.2, 0.7, "tail"])
def test_damaged_image_is_named_after_the_frames_before_it(
    tmp_path: pathlib.Path, suffix: str, kept: float | str, capfd: pytest.CaptureFixture[str]
) -> None:
    whole = cv2.imencode(suffix, noise(1)[0])[1].tobytes()
    if kept == "tail" and suffix in {".bmp", ".tif"}:
        kept = 0.99
    end = len(whole) - 2 if kept == "tail" else int(len(whole) * float(kept))
    for index in range(5):
        (tmp_path / f"{index}{suffix}").write_bytes(whole[:end] if index == 3 else whole)
    with open_source(tmp_path) as source:
        count, message = take_until_error(source)
    # The usual formats are looked at before a decoder complains in its own way.
    complaints = capfd.readouterr().err
    assert suffix not in {".png", ".jpg"} or not complaints
    assert count == 3
    assert f"3{suffix}" in message
    assert ("(0 bytes)" in message) == (end == 0)


def test_size_that_changes_is_named(tmp_path: pathlib.Path) -> None:
    write_folder(tmp_path, 4)
    write_png(tmp_path / "0002.png", np.zeros((9, 9, 3), np.uint8))
    with open_source(tmp_path) as source:
        count, message = take_until_error(source)
    assert count == 2
    assert "0002.png" in message
    assert "9x9, not 8x6" in message


def test_frame_that_vanishes_is_named(tmp_path: pathlib.Path) -> None:
    with open_source(write_folder(tmp_path, 3)) as source:
        (tmp_path / "0001.png").unlink()
        count, message = take_until_error(source)
    assert count == 1
    assert "0001.png" in message


# ---------------------------------------------------------------------------------------------------------------- paths


def test_missing_path_names_the_nearest(tmp_path: pathlib.Path) -> None:
    write_folder(tmp_path / "frames", 1)
    assert f"did you mean {tmp_path / 'frames'}?" in error_of(tmp_path / "frame")
    assert f"did you mean {tmp_path / 'frames'}?" in error_of(tmp_path / "frmes" / "0000.png")
    assert "nothing in" in error_of(tmp_path / "zzz")


def test_path_that_cannot_exist(tmp_path: pathlib.Path) -> None:
    assert "too long" in error_of(tmp_path / ("x" * 5000))


def test_empty_folder_says_what_it_needs(tmp_path: pathlib.Path) -> None:
    assert ".png" in error_of(tmp_path)


@pytest.mark.parametrize("fps", [0.0, -1.0, float("nan"), float("inf")])
def test_impossible_rate(tmp_path: pathlib.Path, fps: float) -> None:
    with pytest.raises(UsageError, match="fps"):
        open_source(write_folder(tmp_path, 1), fps=fps)


# ---------------------------------------------------------------------------------------------------------------- video


def test_video_loses_no_frame(tmp_path: pathlib.Path) -> None:
    levels = [np.full((48, 64, 3), 4 * index, np.uint8) for index in range(50)]
    path = write_video(tmp_path / "clip.mp4", levels)
    with open_source(path) as source:
        assert (source.size, source.length, source.live) == ((64, 48), 50, False)
        assert source.fps == pytest.approx(24)
        frames = list(source)
    assert [frame.index for frame in frames] == list(range(50))
    assert [frame.time for frame in frames] == pytest.approx([index / 24 for index in range(50)], abs=1e-4)
    means = [frame.image.mean() for frame in frames]
    assert means == pytest.approx([4 * index for index in range(50)], abs=VIDEO_LEVELS)
    assert all(frame.image.flags.c_contiguous for frame in frames)


def test_video_loops_and_can_be_retimed(tmp_path: pathlib.Path) -> None:
    path = write_video(tmp_path / "clip.mkv", [np.full((48, 64, 3), 100 * index, np.uint8) for index in range(3)])
    with open_source(path, fps=10, loop=True) as source:
        frames = [frame for frame, _ in zip(source, range(7), strict=False)]
    assert [frame.time for frame in frames] == pytest.approx([index / 10 for index in range(7)])
    assert [round(frame.image.mean() / 100) for frame in frames] == [0, 1, 2, 0, 1, 2, 0]


def test_variable_rate_keeps_its_times(tmp_path: pathlib.Path) -> None:
    stamps = [5, 6, 9, 10, 20]
    path = write_video(tmp_path / "clip.mp4", noise(5), fps=10, stamps=stamps)
    with open_source(path) as source:
        assert [frame.time for frame in source] == pytest.approx([0, 0.1, 0.4, 0.5, 1.5], abs=1e-3)


@pytest.mark.parametrize("matrix", [Colorspace.ITU709, Colorspace.ITU601, Colorspace.BT2020])
def test_video_is_decoded_with_its_own_matrix(tmp_path: pathlib.Path, matrix: Colorspace) -> None:
    path = write_video(tmp_path / "clip.mp4", [patches()] * 3, matrix=matrix)
    with open_source(path) as source:
        image = list(source)[-1].image
    assert np.abs(patch_centers(image) - patch_centers(patches())).max() <= VIDEO_LEVELS


@pytest.mark.parametrize(("rows", "matrix"), [(480, Colorspace.ITU601), (720, Colorspace.ITU709)])
def test_video_without_a_matrix_follows_its_height(tmp_path: pathlib.Path, rows: int, matrix: Colorspace) -> None:
    picture = np.vstack([patches(), np.zeros((rows - 32, patches().shape[1], 3), np.uint8)])
    with open_source(write_video(tmp_path / "clip.mp4", [picture] * 2, matrix=matrix, tagged=False)) as source:
        image = next(iter(source)).image
    assert np.abs(patch_centers(image) - patch_centers(picture)).max() <= VIDEO_LEVELS


@pytest.mark.slow
@pytest.mark.parametrize("size", [(64, 48), (65, 47), (1922, 38)])
@pytest.mark.parametrize("kind", sorted(_IN_PLANES))
def test_colours_made_in_planes_are_those_made_in_turn(kind: str, size: tuple[int, int]) -> None:
    rng = np.random.default_rng(3)
    for given in (ColorRange.MPEG, ColorRange.JPEG):
        for matrix in (Colorspace.ITU709, Colorspace.ITU601, UNNAMED):
            picture = av.VideoFrame(*size, kind)
            for plane in picture.planes:
                codes = np.frombuffer(plane, np.uint16 if picture.format.components[0].bits > 8 else np.uint8)
                codes[:] = rng.integers(0, 1 << picture.format.components[0].bits, codes.shape)
            picture.colorspace, picture.color_range = matrix, given
            expected = VideoReformatter().reformat(
                picture,
                format="rgb24",
                src_colorspace=Colorspace.ITU601 if matrix == UNNAMED else None,
                interpolation=TO_RGB,
            )
            np.testing.assert_array_equal(rgb_from_video(VideoReformatter(), picture), expected.to_ndarray())
            memory = np.zeros((size[1], size[0], 3), np.uint8)
            written = rgb_from_video(VideoReformatter(), picture, lambda height, width, given=memory: given)
            np.testing.assert_array_equal(written, expected.to_ndarray())
            assert np.shares_memory(written, memory) == (size[1] % 2 == 0)


def test_full_range_video(tmp_path: pathlib.Path) -> None:
    path = write_video(tmp_path / "clip.avi", [patches()] * 2, codec="mjpeg", matrix=Colorspace.ITU601)
    with open_source(path) as source:
        image = next(iter(source)).image
    # Motion JPEG at its default quality is coarse in chroma; black and white tell the range.
    assert np.abs(patch_centers(image)[6:9] - patch_centers(patches())[6:9]).max() <= VIDEO_LEVELS


def turn(path: pathlib.Path, matrix: tuple[int, int, int, int]) -> None:
    """Write the upper left of an MP4's display matrix, rows first, as a phone held sideways does."""
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 44
    a, b, c, d = (value << 16 for value in matrix)
    data[at : at + 20] = struct.pack(">5i", a, b, 0, c, d)
    path.write_bytes(data)


TURNS = [(1, 0, 0, 1), (0, 1, -1, 0), (-1, 0, 0, -1), (0, -1, 1, 0)]
MIRRORS = [(-1, 0, 0, 1), (1, 0, 0, -1), (0, 1, 1, 0), (0, -1, -1, 0)]


@pytest.mark.parametrize("matrix", [*TURNS, *MIRRORS])
def test_mirrors_of_a_display_matrix_are_honoured(tmp_path: pathlib.Path, matrix: tuple[int, int, int, int]) -> None:
    picture = np.zeros((32, 64, 3), np.uint8)
    picture[:16, :32] = 250
    path = write_video(tmp_path / "clip.mp4", [picture] * 3)
    turn(path, matrix)
    # Where the matrix puts each pixel, moved back into the picture.
    a, b, c, d = matrix
    y, x = np.mgrid[:32, :64]
    column, row = a * x + c * y, b * x + d * y
    expected = np.zeros((32, 64, 3) if a else (64, 32, 3), np.uint8)
    expected[row - row.min(), column - column.min()] = picture
    with open_source(path) as source:
        assert source.size == (expected.shape[1], expected.shape[0])
        image = next(iter(source)).image
    assert np.abs(image.astype(int) - expected).mean() < VIDEO_LEVELS
    assert image.flags.c_contiguous


@pytest.mark.parametrize(("shape", "width"), [((2, 1), 128), ((4, 3), 85), ((1, 2), 32), ((1280, 1281), 64)])
def test_pixels_become_square(tmp_path: pathlib.Path, shape: tuple[int, int], width: int) -> None:
    with av.open(str(tmp_path / "clip.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=24, options={"crf": "10"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.sample_aspect_ratio = fractions.Fraction(*shape)
        picture = np.zeros((48, 64, 3), np.uint8)
        picture[:, :32] = 250
        container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))
    with open_source(tmp_path / "clip.mp4") as source:
        assert source.size == (width, 48)
        assert ("square" in source.note) == (width != 64)
        image = next(iter(source)).image
    assert image.shape == (48, width, 3)
    assert abs(int((image[:, :, 1] > 125).mean(0).sum()) - width // 2) <= 1
    turn(tmp_path / "clip.mp4", (0, 1, -1, 0))
    with open_source(tmp_path / "clip.mp4") as source:
        assert source.size == (48, width)


FFMPEG = ["ffmpeg", "-v", "error", "-y"]


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg, which writes the empty edit")
def test_an_empty_first_edit_loses_no_frame(tmp_path: pathlib.Path) -> None:
    path = write_video(tmp_path / "clip.mp4", [np.full((32, 64, 3), 40 * k, np.uint8) for k in range(6)])
    late = tmp_path / "late.mp4"
    subprocess.run([*FFMPEG, "-itsoffset", "0.5", "-i", str(path), "-c", "copy", str(late)], check=True)
    data = late.read_bytes()
    edits = data.index(b"elst")
    assert struct.unpack_from(">i", data, edits + 16)[0] == -1  # media time of the first edit: it is empty
    with open_source(late) as source:
        frames = list(source)
        assert source.length == 6
    assert [round(float(frame.image.mean()) / 40) for frame in frames] == list(range(6))
    np.testing.assert_allclose([frame.time for frame in frames], np.arange(6) / 24, atol=1e-3)


def test_pixel_shapes_beyond_the_limit_are_refused(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_video(tmp_path / "clip.mp4", noise(2))
    monkeypatch.setattr(video_file, "pixel_shape", lambda stream: fractions.Fraction(10**6))
    assert "64000000x48" in error_of(path)


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg, which cuts by an edit list")
def test_frames_that_an_edit_list_leaves_out_are_none(tmp_path: pathlib.Path) -> None:
    write_video(tmp_path / "whole.mp4", noise(60))
    cut = ["ffmpeg", "-v", "error", "-ss", "1", "-i", "whole.mp4", "-t", "0.5", "-c", "copy", "cut.mp4"]
    subprocess.run(cut, cwd=tmp_path, check=True)
    with open_source(tmp_path / "cut.mp4") as source, av.open(str(tmp_path / "cut.mp4")) as container:
        shown = sum(1 for _ in container.decode(video=0))
        frames = list(source)
        assert container.streams.video[0].frames > shown == len(frames) == source.length
    assert [frame.time for frame in frames] == pytest.approx([index / 24 for index in range(shown)], abs=1e-3)


@pytest.mark.parametrize("kept", [0.25, 0.6, 0.97])
@pytest.mark.parametrize("suffix", [".avi", ".mp4"])
def test_truncated_video_gives_what_is_whole_and_names_the_frame(
    tmp_path: pathlib.Path, suffix: str, kept: float
) -> None:
    codec = "mpeg4" if suffix == ".avi" else "libx264"
    options = {"movflags": "faststart"} if suffix == ".mp4" else {}
    path = write_video(tmp_path / f"clip{suffix}", noise(30), codec=codec, options=options)
    with av.open(str(path)) as container:
        packets = [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]
    end = int(path.stat().st_size * kept)
    whole = sum(pos + size <= end for pos, size in packets)
    path.write_bytes(path.read_bytes()[:end])
    with open_source(path) as source:
        count, message = take_until_error(source)
    assert f"frame {count} " in message
    assert path.name in message
    # A frame that refers to a later one, which is lost, may be lost with it.
    assert max(1, whole - 3) <= count <= whole


def test_empty_and_foreign_files(tmp_path: pathlib.Path) -> None:
    (tmp_path / "empty.mp4").write_bytes(b"")
    assert "cannot be read as a video" in error_of(tmp_path / "empty.mp4")
    (tmp_path / "text.mp4").write_text("This is not a video. " * 100)
    assert "cannot be read as a video" in error_of(tmp_path / "text.mp4")
    (tmp_path / "text.txt").write_text("This is not a video. " * 100)
    assert "cannot be read as a video" in error_of(tmp_path / "text.txt")


def test_sound_alone_is_no_video(tmp_path: pathlib.Path) -> None:
    with wave.open(str(tmp_path / "sound.wav"), "wb") as sound:
        sound.setparams((1, 2, 8000, 0, "NONE", ""))
        sound.writeframes(bytes(16000))
    assert "no video stream, only audio" in error_of(tmp_path / "sound.wav")


def test_size_that_changes_in_a_video_is_named(tmp_path: pathlib.Path) -> None:
    # Two MPEG transport streams in a row are one; its second half has another size.
    first = write_video(tmp_path / "a.ts", noise(6)).read_bytes()
    second = write_video(tmp_path / "b.ts", noise(6, (96, 64))).read_bytes()
    (tmp_path / "c.ts").write_bytes(first + second)
    with open_source(tmp_path / "c.ts") as source:
        count, message = take_until_error(source)
    assert count == 6
    assert "frame 6 is 96x64, not 64x48" in message


# ----------------------------------------------------------------------------------------------------------------- live


def grey(level: int, size: tuple[int, int] = (8, 6)) -> np.ndarray:
    return np.full((size[1], size[0], 3), level, np.uint8)


def test_queue_keeps_the_newest() -> None:
    with QueueSource((8, 6)) as source:
        assert source.live
        assert source.length is None
        for level in range(4):
            assert source.push(grey(level), 10.0 + level)
        frames = iter(source)
        frame = next(frames)
        assert (int(frame.image[0, 0, 0]), frame.index, frame.time, source.dropped) == (3, 0, 0.0, 3)
        source.push(grey(9), 15.5)
        frame = next(frames)
        assert (int(frame.image[0, 0, 0]), frame.index, frame.time, source.dropped) == (9, 1, 2.5, 3)
    assert list(source) == []
    assert not source.push(grey(0), 20.0)


def test_queue_waits_and_ends_across_threads() -> None:
    source = QueueSource((8, 6))
    seen: list[int] = []
    reader = threading.Thread(target=lambda: seen.extend(int(frame.image[0, 0, 0]) for frame in source))
    reader.start()
    for level in range(200):
        source.push(grey(level), level / 30)
    source.close()
    reader.join(PATIENCE)
    assert not reader.is_alive()
    assert seen[-1] == 199
    assert seen == sorted(seen)
    assert len(seen) + source.dropped == 200


@pytest.mark.parametrize("image", [grey(0, (9, 6)), grey(0)[..., 0], grey(0).astype(np.float32)])
def test_queue_refuses_other_images(image: np.ndarray) -> None:
    with QueueSource((8, 6)) as source, pytest.raises(SourceError, match="not"):
        source.push(image, 0.0)


# ------------------------------------------------------------------------------------------------------------ synthetic


def test_unknown_synthetic_names_the_nearest() -> None:
    with pytest.raises(UsageError, match="did you mean card"):
        open_source("synthetic:cart")


# ---- alternating exposures ----


def test_exposures_in_turn(tmp_path: pathlib.Path) -> None:
    write_folder(tmp_path, 5)
    (tmp_path / "exposures.json").write_text("[0.01, 0.08]")
    with open_source(tmp_path) as source:
        assert source.exposures == (0.08, 0.01)
        assert [frame.exposure_time for frame in source] == [0.01, 0.08, 0.01, 0.08, 0.01]
    with open_source(tmp_path, exposures=(0.5,), loop=True) as source:  # instead of the sidecar's
        frames = iter(source)
        assert [next(frames).exposure_time for _ in range(7)] == [0.5] * 7
    (tmp_path / "exposures.json").write_text("[0.01, 0.08, 0.04]")
    with open_source(tmp_path, loop=True) as source:  # a new pass begins anew
        frames = iter(source)
        assert [next(frames).exposure_time for _ in range(7)] == [0.01, 0.08, 0.04, 0.01, 0.08, 0.01, 0.08]


@pytest.mark.parametrize("exposures", [(0.01, 0.0), (-1.0,), (math.nan, 1.0)])
def test_impossible_exposures(tmp_path: pathlib.Path, exposures: tuple[float, ...]) -> None:
    with pytest.raises(UsageError, match=r"expected (positive numbers of seconds|a tuple)"):
        open_source(tmp_path, exposures=exposures)


def test_close_ends_a_reading_in_progress(tmp_path: pathlib.Path) -> None:
    source = open_source(write_folder(tmp_path, 3))
    frames = iter(source)
    next(frames)
    source.close()
    assert list(frames) == []


def test_video_cut_between_two_frames(tmp_path: pathlib.Path) -> None:
    path = write_video(tmp_path / "clip.mp4", noise(20), codec="mpeg4", options={"movflags": "faststart"})
    with av.open(str(path)) as container:
        packets = [packet.pos for packet in container.demux(video=0) if packet.size]
    path.write_bytes(path.read_bytes()[: packets[12]])
    with open_source(path) as source:
        assert take_until_error(source)[0] == 12


def test_video_that_never_was_finished(tmp_path: pathlib.Path) -> None:
    path = write_video(tmp_path / "clip.mp4", noise(20))
    path.write_bytes(path.read_bytes()[:5000])
    assert "cannot be read as a video" in error_of(path)
