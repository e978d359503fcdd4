"""Frames of more than 8 bits: what sources read, what a pipeline makes of them, what sinks write.

What is expected of a video is computed here from the numbers of its planes, by ITU-R's forms in float64.
"""

from __future__ import annotations

import math
import pathlib
from typing import Any

import av
import cv2
import numpy as np
import OpenEXR
import pytest

import warp_ar
from warp_ar.errors import SinkError, UsageError
from warp_ar.kernels.color import decode_codes, encode_codes
from warp_ar.output.encoders import parse_options
from warp_ar.output.sinks import open_sink
from warp_ar.session import Session
from warp_ar.signals import REC_709, REC_2020, hlg_of_light, light_of_hlg, light_of_pq, pq_of_light, rgb_from_rgb
from warp_ar.sources.deep_frame import DeepFrame, srgb8
from warp_ar.sources.sources import open_source

pytestmark = pytest.mark.slow

SIZE = (64, 48)
STEP16 = 1.0 / 65535.0
HALF_STEP16 = 0.51 * STEP16  # a signal is rounded to one of 65536 steps
STEP10 = 1.0 / 876.0  # of luma in 10 bits of limited range
HALF = 2.0**-11  # rounding to 16-bit floats, relative
SCALED = 1e-5  # of a factor: rounding, of which a power of two makes none
FLOAT32 = 2e-6  # of a matrix and a table in float32, relative to the largest part
TAGS = {"sdr": (1, 1, 1), "pq": (9, 9, 16), "hlg": (9, 9, 18), "p3": (1, 12, 1)}
LUMA = {1: (0.2126, 0.0722), 9: (0.2627, 0.0593)}


def planes_of(bits: int) -> list[np.ndarray]:
    """Y, Cb, Cr in limited range: a ramp of greys, and patches of colour."""
    unit = 2 ** (bits - 8)
    y, cb, cr = (np.full((SIZE[1], SIZE[0]), v * unit, np.uint16) for v in (16, 128, 128))
    y[:24] = np.rint(np.linspace(16 * unit, 235 * unit, SIZE[0]))
    for k, (a, b, c) in enumerate(((120, 100, 150), (60, 140, 120), (180, 120, 135), (90, 128, 160))):
        at = (slice(24, 48), slice(16 * k, 16 * k + 16))
        y[at], cb[at], cr[at] = a * unit + k, b * unit + 1, c * unit - 1
    return [y, cb, cr]


def write_yuv(path: pathlib.Path, planes: list[np.ndarray], bits: int, tags: tuple[int, int, int]) -> pathlib.Path:
    """One picture without loss (FFV1, 4:4:4), tagged with matrix, primaries and transfer."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.width, stream.height, stream.pix_fmt = *SIZE, f"yuv444p{bits}le"
        context = stream.codec_context
        context.colorspace, context.color_primaries, context.color_trc = tags
        context.color_range = 1
        picture = av.VideoFrame(*SIZE, stream.pix_fmt)
        for plane, values in zip(picture.planes, planes, strict=True):
            rows = np.zeros((plane.height, plane.line_size // 2), np.uint16)
            rows[:, : SIZE[0]] = values
            plane.update(rows.tobytes())
        picture.colorspace, picture.color_primaries, picture.color_trc = tags
        picture.color_range = 1
        container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
    return path


def signal_of(planes: list[np.ndarray], bits: int, matrix: int) -> np.ndarray:
    """R'G'B' in float64 by BT.709-6 and BT.2020-2."""
    unit, (kr, kb) = 2.0 ** (bits - 8), LUMA[matrix]
    y = (planes[0].astype(float) - 16 * unit) / (219 * unit)
    cb, cr = ((plane.astype(float) - 128 * unit) / (224 * unit) for plane in planes[1:])
    red, blue = y + 2 * (1 - kr) * cr, y + 2 * (1 - kb) * cb
    return np.clip(np.stack([red, (y - kr * red - kb * blue) / (1 - kr - kb), blue], -1), 0.0, 1.0)


def read_one(path: pathlib.Path) -> Any:
    with open_source(path) as source:
        source.keeps_depth = True
        return source.deep, next(iter(source))


@pytest.mark.parametrize("bits", [10, 12, 16])
def test_a_standard_video_keeps_its_codes(tmp_path: pathlib.Path, bits: int) -> None:
    planes = planes_of(bits)
    deep, frame = read_one(write_yuv(tmp_path / "a.mkv", planes, bits, TAGS["sdr"]))
    assert deep == "codes"
    assert frame.deep.picture.dtype == np.uint16
    expected = signal_of(planes, bits, 1)
    np.testing.assert_allclose(frame.deep.picture * STEP16, expected, atol=HALF_STEP16 + FLOAT32)
    # Neighbouring steps of the ramp stay apart, which 8 bits would not keep.
    assert len(np.unique(frame.deep.picture[0, :, 1])) == SIZE[0]
    assert np.abs(frame.image / 255.0 - expected).max() < 1.6 / 255.0


@pytest.mark.parametrize(("kind", "curve"), [("pq", light_of_pq), ("hlg", light_of_hlg)])
def test_hdr_video_becomes_light(tmp_path: pathlib.Path, kind: str, curve: Any) -> None:
    planes = planes_of(10)
    deep, frame = read_one(write_yuv(tmp_path / "a.mkv", planes, 10, TAGS[kind]))
    assert deep == "light"
    signal = signal_of(planes, 10, 9)
    light = curve(signal) @ rgb_from_rgb(REC_2020, REC_709).T
    # The table has 65536 steps of the signal: half a step on the curve, mixed by the matrix (largest row sum 2.3).
    slope = 2.4 * (curve(np.minimum(signal + HALF_STEP16, 1.0)) - curve(np.maximum(signal - HALF_STEP16, 0.0)))
    bound = slope.max(-1, keepdims=True) + 1e-5 * (1.0 + light.max(-1, keepdims=True))
    assert (np.abs(frame.deep.picture - light) <= bound).all()
    assert frame.deep.picture.max() > 3.0, "highlights are above reference white"
    np.testing.assert_array_equal(frame.image, srgb8(frame.deep.picture))
    assert math.isinf(frame.deep.clip) if kind == "pq" else 3.5 < frame.deep.clip < 3.8


def test_wide_primaries_are_converted(tmp_path: pathlib.Path) -> None:
    planes = planes_of(10)
    deep, frame = read_one(write_yuv(tmp_path / "a.mkv", planes, 10, TAGS["p3"]))
    assert deep == "light"
    p3 = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290)
    light = decode_codes("srgb", signal_of(planes, 10, 1).reshape(-1))[:, 0].reshape(SIZE[1], SIZE[0], 3)
    np.testing.assert_allclose(frame.deep.picture, light @ rgb_from_rgb(p3, REC_709).T, atol=6e-5)


def write_exr_picture(path: pathlib.Path, pixels: np.ndarray, **header: Any) -> None:
    channels = {name: np.ascontiguousarray(pixels[..., k]) for k, name in enumerate("RGB")}
    kinds = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File({**kinds, **header}, channels).write(str(path))


def light(seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.0, 4.0, (SIZE[1], SIZE[0], 3)).astype(np.float32)


@pytest.mark.parametrize("kind", [np.float16, np.float32])
def test_openexr_is_light(tmp_path: pathlib.Path, kind: type) -> None:
    pixels = light().astype(kind)
    pixels[0, 0], pixels[0, 1], pixels[0, 2] = np.nan, np.inf, -0.5
    for number in range(3):
        write_exr_picture(tmp_path / f"{number}.exr", pixels)
    with open_source(tmp_path) as source:
        source.keeps_depth = True
        assert (source.deep, source.length, source.size) == ("light", 3, SIZE)
        for frame in source:
            np.testing.assert_array_equal(frame.deep.picture[1:], pixels[1:].astype(np.float32))
            np.testing.assert_array_equal(frame.deep.picture[0, :3, 0], np.float32([0.0, 65504.0, -0.5]))
            np.testing.assert_array_equal(frame.image, srgb8(frame.deep.picture))
    with open_source(tmp_path) as source:
        assert next(iter(source)).deep is None, "nobody asked for it"


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_pictures_of_16_bits_keep_their_codes(tmp_path: pathlib.Path, suffix: str) -> None:
    codes = np.random.default_rng(2).integers(0, 65536, (SIZE[1], SIZE[0], 3), np.uint16)
    (tmp_path / f"a{suffix}").write_bytes(cv2.imencode(suffix, codes[..., ::-1])[1].tobytes())
    deep, frame = read_one(tmp_path / f"a{suffix}")
    assert deep == "codes"
    np.testing.assert_array_equal(frame.deep.picture, codes)


def test_a_measured_response_is_read_between_its_codes(tmp_path: pathlib.Path) -> None:
    values = (np.arange(256) / 255.0) ** 1.8
    path = tmp_path / "response.txt"
    path.write_text("\n".join(f"{v} {v} {v}" for v in values))
    between = decode_codes(str(path), np.array([100.5 / 255.0]))[0]
    np.testing.assert_allclose(between, 0.5 * (values[100] + values[101]), rtol=1e-12)
    codes = np.linspace(0.0, 1.0, 99)
    np.testing.assert_allclose(
        encode_codes(str(path), decode_codes(str(path), codes)), codes[:, None] * np.ones(3), atol=1e-9
    )


@pytest.fixture(scope="module")
def first() -> Any:
    """The first frame of the bundled desk at a third of its size."""
    with Session("desk", device="cpu") as session:
        frame = next(iter(session.source)).image
    return cv2.resize(frame, (160, 120), interpolation=cv2.INTER_AREA)


OUTPUTS = ("image", "radiance", "environment")


def lit(frame: Any, pose: Any = None, quality: Any = "medium", scene: str = "desk", **more: Any) -> Any:
    with warp_ar.Pipeline(
        scene, device="cpu", quality=quality, size=(160, 120), outputs=OUTPUTS, estimates="synchronous", **more
    ) as pipeline:
        result = pipeline(frame, pose=pose)
        return result.image, result.radiance, result.environment, result.layers


@pytest.mark.parametrize("quality", ["paper", "medium"])
def test_8_bits_through_a_deep_pipeline_are_the_same_to_the_bit(first: np.ndarray, quality: str) -> None:
    plain, deep = lit(first, quality=quality), lit(first, quality=quality, linear=True)
    wide = lit(first.astype(np.uint16) * 257, quality=quality, linear=True)
    for a, b, c in zip(plain[:3], deep[:3], wide[:3], strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a, c)


def test_light_above_white_lights_as_it_is(first: np.ndarray) -> None:
    """Five times the light makes five times the environment, where 8 bits cut and guess all above white."""
    radiance = decode_codes("srgb", first.reshape(-1) / 255.0)[:, 0].reshape(first.shape).astype(np.float32)
    with warp_ar.Pipeline("desk", device="cpu", size=(160, 120), outputs=("pose",)) as pipeline:
        pose = pipeline(first).pose
    assert pose is not None
    _, _, once, _ = lit(radiance, linear=True, pose=pose)
    _, picture, five, layers = lit(5.0 * radiance, linear=True, pose=pose)
    _, _, cut, _ = lit(srgb8(5.0 * radiance), pose=pose)
    # What the ball does not show is filled by what 8 bits show; it is less than half of the map.
    assert np.median(five / np.maximum(once, 1e-6)) == pytest.approx(5.0, rel=0.01)
    assert five.max() > 4.9 * once.max()
    assert np.abs(cut - 5.0 * once).mean() > 2.0 * np.abs(five - 5.0 * once).mean()
    laid = (layers["shadow_ratio"] != 1.0) | (layers["added_light"] != 0.0) | (layers["mirror_ball"] != 0.0)
    untouched = (layers["objects"] == 0.0).all(-1) & ~laid.any(-1)
    assert untouched.sum() > 1000
    np.testing.assert_array_equal(picture[untouched], (5.0 * radiance)[untouched])


def test_a_desk_in_the_dark_is_lit_as_a_bright_one(first: np.ndarray) -> None:
    """A hundredth of the light: all that objects and their shadows take from the environment is a hundredth as well.

    The desk is then darker than 1/255 nearly everywhere. A power of two, so that not one bit of it is lost.
    """
    radiance = decode_codes("srgb", first.reshape(-1) / 255.0)[:, 0].reshape(first.shape).astype(np.float32)
    radiance = np.minimum(radiance, np.float32(0.5))  # no light that clips is guessed
    with warp_ar.Pipeline("desk", device="cpu", size=(160, 120), outputs=("pose",)) as pipeline:
        pose = pipeline(first).pose
    dim = np.float32(1.0 / 128.0)
    assert np.median(dim * radiance) < 1.0 / 255.0
    _, _, bright, many = lit(radiance, linear=True, pose=pose)
    _, _, dark, few = lit(dim * radiance, linear=True, pose=pose)
    np.testing.assert_allclose(dark, dim * bright, rtol=FLOAT32, atol=1e-9)
    shadow = np.abs(few["shadow_ratio"] - many["shadow_ratio"])
    assert (many["shadow_ratio"] < 0.9).any()
    assert shadow.max() < SCALED
    _, _, _, codes = lit(srgb8(dim * radiance), pose=pose)
    assert np.abs(codes["shadow_ratio"] - many["shadow_ratio"]).max() > 0.03, "8 bits do not hold it"


def test_what_no_deep_frame_is_gets_one_line(first: np.ndarray) -> None:
    with warp_ar.Pipeline("desk", device="cpu", size=(160, 120)) as pipeline:
        with pytest.raises(UsageError, match=r"float32 .*expected uint8 RGB .*or a pipeline made with linear=True"):
            pipeline(first.astype(np.float32))
        with pytest.raises(UsageError, match=r'radiance needs outputs=\("radiance",\)'):
            _ = pipeline(first).radiance
    with warp_ar.Pipeline("desk", device="cpu", size=(160, 120), linear=True) as pipeline:
        with pytest.raises(UsageError, match=r"frame is int64 \(120, 160, 3\); expected"):
            pipeline(first.astype(np.int64))
        with pytest.raises(UsageError, match=r"frame is float32 \(2, 2, 3\); expected"):
            pipeline(DeepFrame(np.zeros((2, 2, 3), np.float32)))


def probe(path: pathlib.Path) -> dict[str, str]:
    """What the video stream says of its coding."""
    names = {1: "bt709", 9: "bt2020", 16: "smpte2084", 18: "arib-std-b67"}
    with av.open(str(path)) as container:
        context = container.streams.video[0].codec_context
        space = "bt2020nc" if context.colorspace == 9 else names[context.colorspace]
        return {
            "codec_name": context.name,
            "pix_fmt": context.pix_fmt,
            "color_range": "tv" if context.color_range == 1 else "?",
            "color_space": space,
            "color_transfer": names[context.color_trc],
            "color_primaries": names[context.color_primaries],
        }


def ramp() -> np.ndarray:
    """Smooth linear light, some of it above white."""
    grey = np.linspace(0.0, 1.0, SIZE[0], dtype=np.float32) ** 2.2
    return np.repeat(np.tile(grey, (SIZE[1], 1))[..., None], 3, 2) * np.float32([1.0, 0.8, 0.6])


@pytest.mark.parametrize(
    ("coding", "transfer", "primaries", "peak", "signal"),
    [
        ("10bit", "bt709", "bt709", 1.0, lambda x: encode_codes("srgb", x)),
        ("pq", "smpte2084", "bt2020", 20.0, pq_of_light),
        ("hlg", "arib-std-b67", "bt2020", 3.7, hlg_of_light),
    ],
)
def test_video_of_10_bits_comes_back(
    tmp_path: pathlib.Path, coding: str, transfer: str, primaries: str, peak: float, signal: Any
) -> None:
    path, picture = tmp_path / "a.mp4", peak * ramp()
    with open_sink(path, fps=25, coding=coding, encoder_options={"crf": "1"}) as sink:
        for _ in range(3):
            sink.write(picture)
    said = probe(path)
    assert (said["codec_name"], said["pix_fmt"], said["color_range"]) == ("hevc", "yuv420p10le", "tv")
    assert (said["color_transfer"], said["color_primaries"]) == (transfer, primaries)
    _, frame = read_one(path)
    got = frame.deep.radiance("srgb")
    # In the signal, whose steps the coding is uniform in: two of 10 bits in the mean, more where chroma is halved.
    wide = REC_709 if coding == "10bit" else REC_2020
    into = rgb_from_rgb(REC_709, wide).T
    errors = np.abs(signal(np.maximum(got @ into, 0.0)) - signal(picture @ into))
    assert errors.mean() < 2.0 * STEP10
    assert np.median(errors) < 1.5 * STEP10
    with (
        pytest.raises(SinkError, match="a frame of radiance is float32 RGB"),
        open_sink(path, fps=25, coding=coding) as sink,
    ):
        sink.write(np.zeros((48, 64, 3), np.uint8))


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_short_videos_of_10_bits_are_written(tmp_path: pathlib.Path, frames: int) -> None:
    with open_sink(tmp_path / "a.mp4", fps=25, coding="10bit") as sink:
        for _ in range(frames):
            sink.write(ramp())
    with av.open(str(tmp_path / "a.mp4")) as container:
        times = [float(packet.pts * packet.time_base) for packet in container.demux(video=0) if packet.size]
    assert np.subtract(sorted(times), min(times)) == pytest.approx([index / 25 for index in range(frames)])


def test_folders_of_16_bits_and_openexr_come_back(tmp_path: pathlib.Path) -> None:
    picture = ramp()
    with open_sink(tmp_path / "png", fps=25, coding="16bit") as sink:
        sink.write(picture)
    with open_sink(tmp_path / "exr", fps=25, coding="exr") as sink:
        sink.write(8.0 * picture - 0.25)
    _, frame = read_one(tmp_path / "png" / "0000.png")
    np.testing.assert_allclose(
        encode_codes("srgb", frame.deep.radiance("srgb")), encode_codes("srgb", picture), atol=HALF_STEP16 + 1e-7
    )
    _, frame = read_one(tmp_path / "exr" / "0000.exr")
    np.testing.assert_allclose(frame.deep.picture, 8.0 * picture - 0.25, rtol=HALF, atol=1e-7)


def test_wrong_codings_and_encoders_get_one_line(tmp_path: pathlib.Path) -> None:
    for path, more, line in (
        ("a.mp4", {"coding": "16bit"}, r"coding '16bit': .*a\.mp4 is a video, which holds 8bit, 10bit, pq, hlg"),
        ("a", {"coding": "pq"}, r"coding 'pq': .*a is a folder, which holds 8bit, 16bit, exr"),
        ("a", {"coding": "9bit"}, r"coding '9bit': expected 8bit, 10bit"),
        ("a", {"encoder": "libx264"}, r"encoder libx264: .* is a folder; name a video"),
        ("a.mp4", {"encoder": "libx265x"}, r"there is no encoder 'libx265x'; did you mean .libx265"),
        ("a.mp4", {"encoder": "aac"}, r"aac encodes audio; choose an encoder of video"),
        ("a.mp4", {"encoder": "mpeg4", "coding": "10bit"}, r"mpeg4 takes no pictures of 10 bits, only yuv420p"),
        ("a.mp4", {"encoder_options": {"crff": "1"}}, r"--encoder-option crff: libx264 has no such option"),
        ("a.mp4", {"encoder_options": {"crf": "many"}}, r"libx264 does not work here \(.+\); choose another"),
    ):
        with pytest.raises((UsageError, SinkError), match=line):
            open_sink(tmp_path / path, fps=25, **more)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(UsageError, match=r"--encoder-option 'crf': expected KEY=VALUE"):
        parse_options(["crf"])
    assert parse_options(["crf=3", "x265-params=a=1:b=2"]) == {"crf": "3", "x265-params": "a=1:b=2"}


def test_options_reach_the_encoder(tmp_path: pathlib.Path) -> None:
    noise = np.random.default_rng(1).integers(0, 255, (48, 64, 3), np.uint8)
    sizes = []
    for crf in ("10", "45"):
        path = tmp_path / f"{crf}.mkv"
        with open_sink(path, fps=25, encoder="libx264", encoder_options={"crf": crf}) as sink:
            for _ in range(4):
                sink.write(noise)
        sizes.append(path.stat().st_size)
    assert sizes[0] > 2 * sizes[1]
