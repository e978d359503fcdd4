"""Video encoders: their names, their availability on this machine, and their options."""

from __future__ import annotations

import dataclasses
import fractions
from collections.abc import Mapping, Sequence
from typing import Any, Final

import av
import cv2
from av.codec import codecs_available

from warp_ar.errors import SinkError, UsageError, reason
from warp_ar.scene.messages import nearest

CODINGS: Final = ("8bit", "10bit", "pq", "hlg")
"""Codings of video: the camera's codes with 8 or 10 bits, or HDR with BT.2020 primaries and 10 bits."""

DEFAULT_ENCODERS: Final = {"8bit": "libx264", "10bit": "libx265", "pq": "libx265", "hlg": "libx265"}

CRF: Final = 18
"""Constant rate factor of x264 and x265, with hardly visible loss."""
_DEFAULTS: Final[Mapping[str, Mapping[str, str]]] = {
    "libx264": {"preset": "veryfast", "crf": str(CRF)},
    "libx265": {"preset": "veryfast", "crf": str(CRF), "x265-params": "log-level=error"},
}
_FORMATS: Final = {
    8: ("yuv420p", "nv12", "yuvj420p", "yuv422p", "yuv444p"),
    10: ("yuv420p10le", "p010le", "yuv422p10le", "yuv444p10le"),
}
"""Pixel formats by bits, the most widely supported by players first."""
_HARDWARE: Final = ("_nvenc", "_qsv", "_vaapi", "_videotoolbox", "_amf", "_mf", "_v4l2m2m", "_vulkan")
_AVX2: Final = 11
"""OpenCV's number of the CPU feature AVX2, which has no name in Python."""
_X265_LEARNS: Final = 2
"""Number of first frames for which x265 gives no valid decoding times."""
_PROBED: Final = 256
"""Side in pixels of the test picture for an encoder; hardware refuses much smaller pictures."""


@dataclasses.dataclass(frozen=True)
class Encoding:
    """Encoder of a video with its coding and options."""

    encoder: str
    """FFmpeg's name of the encoder."""
    pixel_format: str
    coding: str
    """One of ``CODINGS``."""
    options: Mapping[str, str]
    """Options of the encoder, including defaults."""


def find_encoding(
    coding: str = "8bit", encoder: str | None = None, options: Mapping[str, str] | None = None
) -> Encoding:
    """Choose an encoder, and check that it works on this machine and has the given options.

    Args:
        coding: One of ``CODINGS``.
        encoder: FFmpeg's name of the encoder; None: the coding's default.
        options: Options of the encoder, by FFmpeg's names; they override the defaults.

    Raises:
        SinkError: The encoder does not exist, does not support that depth, or does not work on this machine.
        UsageError: The encoder has no such option.
    """
    name = encoder or DEFAULT_ENCODERS[coding]
    try:
        codec = av.Codec(name, "w")
    except av.codec.codec.UnknownCodecError as error:
        hint = nearest(name, encoder_names())
        raise SinkError(f"there is no encoder {name!r}; {hint} (--encoder list shows all)") from error
    if codec.type != "video":
        raise SinkError(f"{name} encodes {codec.type}; choose an encoder of video, --encoder list shows them")
    bits = 8 if coding == "8bit" else 10
    formats = [known.name for known in codec.video_formats or ()]
    pixel_format = next((known for known in _FORMATS[bits] if known in formats), None)
    if pixel_format is None:
        raise SinkError(
            f"{name} takes no pictures of {bits} bits, only {', '.join(formats[:8])}; choose another encoder"
        )
    encoding = Encoding(name, pixel_format, coding, _with_defaults(name, options or {}))
    problem, unknown = _try(encoding)
    if problem:
        raise SinkError(f"{name} does not work here ({problem}); choose another encoder or other options")
    if unknown:
        raise UsageError(
            f"--encoder-option {unknown[0]}: {name} has no such option; ffmpeg -h encoder={name} lists them"
        )
    return encoding


def _with_defaults(encoder: str, options: Mapping[str, str]) -> dict[str, str]:
    """Return an encoder's options with defaults; given parameters of x264 and x265 are appended to the default ones.

    x264's macroblock tree (`mbtree`) reads uninitialised memory in its AVX-512 code: at some sizes, such as 320x240,
    equal pictures give different bytes in each run. Its AVX2 code does not, gives the same bytes on all processors, and
    is as fast.
    """
    wanted = {**_DEFAULTS.get(encoder, {}), **options}
    key = {"libx264": "x264-params", "libx265": "x265-params"}.get(encoder)
    if key is None:
        return wanted
    own = _DEFAULTS[encoder].get(key, "")
    if encoder == "libx264" and cv2.checkHardwareSupport(_AVX2):
        own = "asm=avx2"
    joined = ":".join(text for text in (own, options.get(key, "")) if text)
    return {**wanted, key: joined} if joined else wanted


def _try(encoding: Encoding) -> tuple[str, Sequence[str]]:
    """Try to open the encoder; return the error as text, and the options that it does not have."""
    context: Any = av.CodecContext.create(encoding.encoder, "w")
    context.width = context.height = _PROBED
    context.pix_fmt, context.time_base = encoding.pixel_format, fractions.Fraction(1, 30)
    context.framerate, context.options = fractions.Fraction(30), dict(encoding.options)
    try:
        context.open()
    except (av.FFmpegError, OSError, ValueError) as error:
        return reason(error), ()
    return "", tuple(context.options)


def last_packets(stream: Any, frames: int) -> list[Any]:
    """Return the packets that an encoder still holds after the last frame.

    x265 determines the offset of decoding times from its third frame. For shorter clips its decoding times come from
    uninitialised memory, and most muxers refuse them. Decoding times are therefore set to display times for so few
    frames.

    Args:
        stream: Output stream of PyAV.
        frames: Total number of frames given to the encoder.
    """
    packets: list[Any] = stream.encode(None)
    if frames <= _X265_LEARNS and stream.codec_context.name == "libx265":
        for packet in packets:
            packet.dts = packet.pts
    return packets


def encoder_names() -> list[str]:
    """Return the names of the video encoders in PyAV's FFmpeg."""
    found = []
    for name in sorted(codecs_available):
        try:
            codec = av.Codec(name, "w")
        except av.codec.codec.UnknownCodecError:
            continue
        if codec.type == "video":
            found.append(name)
    return found


def describe_encoders() -> list[str]:
    """Return a line for each usable encoder: its name, its bit depths, and for hardware if it works on this machine."""
    lines = []
    for name in encoder_names():
        formats = {known.name for known in av.Codec(name, "w").video_formats or ()}
        depths = [str(bits) for bits, known in _FORMATS.items() if formats.intersection(known)]
        if not depths:
            continue
        line = f"{name:18s} {' and '.join(depths)} bits"
        if name.endswith(_HARDWARE):
            taken = next(known for known in _FORMATS[int(depths[0])] if known in formats)
            problem, _ = _try(Encoding(name, taken, "8bit", {}))
            line += f", hardware, {'works here' if not problem else 'does not work here: ' + problem}"
        lines.append(line)
    return lines


def parse_options(texts: Sequence[str]) -> dict[str, str]:
    """Return the encoder options of texts of the form ``KEY=VALUE``.

    Raises:
        UsageError: A text has another form.
    """
    options = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            raise UsageError(f"--encoder-option {text!r}: expected KEY=VALUE, such as crf=23")
        options[key.strip()] = value.strip()
    return options
