"""Encoders of video: which there are, which of them work here, and how they are asked to encode."""

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
"""Codings of video: the camera's codes in 8 or 10 bits, or HDR: BT.2020's primaries in 10 bits."""

DEFAULT_ENCODERS: Final = {"8bit": "libx264", "10bit": "libx265", "pq": "libx265", "hlg": "libx265"}

CRF: Final = 18
"""Constant rate factor of x264 and x265 with a hardly visible loss."""
_DEFAULTS: Final[Mapping[str, Mapping[str, str]]] = {
    "libx264": {"preset": "veryfast", "crf": str(CRF)},
    "libx265": {"preset": "veryfast", "crf": str(CRF), "x265-params": "log-level=error"},
}
_FORMATS: Final = {
    8: ("yuv420p", "nv12", "yuvj420p", "yuv422p", "yuv444p"),
    10: ("yuv420p10le", "p010le", "yuv422p10le", "yuv444p10le"),
}
"""Pixel formats by bits, in order of preference: what most players decode first."""
_HARDWARE: Final = ("_nvenc", "_qsv", "_vaapi", "_videotoolbox", "_amf", "_mf", "_v4l2m2m", "_vulkan")
_AVX2: Final = 11
"""OpenCV's number of AVX2, ``CPU_AVX2``, which its Python names do not hold."""
_X265_LEARNS: Final = 2
"""Frames of which x265 tells no decoding times."""
_PROBED: Final = 256
"""Pixels of a side of the picture that an encoder is tried with; hardware refuses much smaller ones."""


@dataclasses.dataclass(frozen=True)
class Encoding:
    """Encoding of a video."""

    encoder: str
    """FFmpeg's name."""
    pixel_format: str
    coding: str
    """One of ``CODINGS``."""
    options: Mapping[str, str]
    """The encoder's, the defaults among them."""


def find_encoding(
    coding: str = "8bit", encoder: str | None = None, options: Mapping[str, str] | None = None
) -> Encoding:
    """Choose an encoder, and find out whether it works here and knows its options.

    Args:
        coding: One of ``CODINGS``.
        encoder: FFmpeg's name; None: what is usual for the coding.
        options: The encoder's own, by FFmpeg's names; they go before the defaults.

    Raises:
        SinkError: There is no such encoder, it takes no pictures of that depth, or does not work here.
        UsageError: An option is unknown to it.
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
    """Options of an encoder, the defaults among them; parameters of x264's and x265's own go behind those here.

    x264's tree of macroblocks (`mbtree`), in its code for AVX-512, reads memory that nothing has written: at some
    sizes, 320x240 among them, the same pictures then give other bytes from run to run. Its other code does not, gives
    the same bytes whatever the processor, and is as fast.
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
    """Open the encoder as it will be: what goes wrong, in words, and options that it does not know."""
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
    """Packets that an encoder still held when the frames ended.

    x265 learns by how much decoding goes ahead of showing from its third frame. Of shorter clips it tells times that it
    computed from memory which nothing has written, and what writes files refuses most of them. So few frames are
    decoded in the order in which they are shown.

    Args:
        stream: PyAV's.
        frames: Given to it in all.
    """
    packets: list[Any] = stream.encode(None)
    if frames <= _X265_LEARNS and stream.codec_context.name == "libx265":
        for packet in packets:
            packet.dts = packet.pts
    return packets


def encoder_names() -> list[str]:
    """Names of the encoders of video that PyAV's FFmpeg was built with."""
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
    """A line for each encoder that takes frames: its name, its depths, and of hardware whether it works here."""
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
    """Options of an encoder from ``KEY=VALUE`` each.

    Raises:
        UsageError: One is not of that form.
    """
    options = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            raise UsageError(f"--encoder-option {text!r}: expected KEY=VALUE, such as crf=23")
        options[key.strip()] = value.strip()
    return options
