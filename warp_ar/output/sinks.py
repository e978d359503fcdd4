"""Frames out: numbered PNGs and OpenEXRs, video, and environments as OpenEXR."""

from __future__ import annotations

import fractions
import os
import pathlib
from collections.abc import Mapping
from typing import Final

from warp_ar.errors import SinkError, UsageError, reason
from warp_ar.files import kind_of
from warp_ar.output.encoders import CODINGS, find_encoding
from warp_ar.output.environment_file import EnvironmentSink, read_environment, write_environment
from warp_ar.output.folder_sink import DeepPngSink, FolderSink, RadianceSink
from warp_ar.output.sink import NullSink, Sink, TeeSink
from warp_ar.output.video_sink import VIDEO_SUFFIXES, VideoSink

__all__ = [
    "DeepPngSink",
    "EnvironmentSink",
    "FolderSink",
    "NullSink",
    "RadianceSink",
    "Sink",
    "TeeSink",
    "VideoSink",
    "open_sink",
    "read_environment",
    "write_environment",
]

FOLDER_CODINGS: Final = ("8bit", "16bit", "exr")
"""What pictures of a folder hold."""


def open_sink(
    path: str | pathlib.Path,
    *,
    fps: float,
    size: tuple[int, int] | None = None,
    overwrite: bool = False,
    coding: str = "8bit",
    transfer: str = "srgb",
    encoder: str | None = None,
    encoder_options: Mapping[str, str] | None = None,
    tick: fractions.Fraction | None = None,
) -> Sink:
    """A sink for ``path``: a video for .mp4, .mkv and .mov, a folder of pictures for a name without an ending.

    Folders that are missing on the way are made.

    Args:
        path: File or folder; a folder that exists may have any name, as may one whose name ends in a slash.
        fps: Frames per second of a video.
        size: (width, height) of the frames in pixels, if known; the first frame tells otherwise.
        overwrite: Whether files that this program did not write may be replaced.
        coding: What is written: ``8bit``; of linear radiance ``10bit``, ``pq`` or ``hlg`` in a video, ``16bit`` (PNG)
            or ``exr`` in a folder.
        transfer: The camera's, by which 10- and 16-bit codes are encoded.
        encoder: FFmpeg's name of a video's; None: H.264 for 8 bits, H.265 for more.
        encoder_options: Its own, by FFmpeg's names.
        tick: Seconds of the unit in which a video keeps the times of `Sink.write_at`; None: one frame's at ``fps``.

    Raises:
        SinkError: The path cannot be written, may not be replaced, or its ending is unknown; the encoder does not work.
        UsageError: ``fps`` is not a positive number, or the coding or an option does not fit the path.
    """
    if coding not in FOLDER_CODINGS + CODINGS:
        raise UsageError(f"coding {coding!r}: expected {', '.join(dict.fromkeys(CODINGS + FOLDER_CODINGS))}")
    named_as_folder = str(path).endswith(("/", os.sep))
    path = pathlib.Path(path)
    if path.suffix.lower() in VIDEO_SUFFIXES and not named_as_folder:
        if coding not in CODINGS:
            raise UsageError(f"coding {coding!r}: {path} is a video, which holds {', '.join(CODINGS)}")
        encoding = find_encoding(coding, encoder, encoder_options)
        return VideoSink(path, fps=fps, size=size, overwrite=overwrite, encoding=encoding, transfer=transfer, tick=tick)
    try:
        is_folder = kind_of(path) == "folder"
    except OSError as error:
        raise SinkError(f"{path} cannot be written: {reason(error)}") from error
    if not is_folder and path.suffix and not named_as_folder:
        raise SinkError(f"{path} ends in {path.suffix}; use {', '.join(VIDEO_SUFFIXES)}, or a folder for PNG frames")
    if coding not in FOLDER_CODINGS:
        raise UsageError(f"coding {coding!r}: {path} is a folder, which holds {', '.join(FOLDER_CODINGS)}")
    if encoder is not None or encoder_options:
        raise UsageError(f"encoder {encoder or ', '.join(encoder_options or ())}: {path} is a folder; name a video")
    if coding == "16bit":
        return DeepPngSink(path, overwrite=overwrite, transfer=transfer)
    return RadianceSink(path, overwrite=overwrite) if coding == "exr" else FolderSink(path, overwrite=overwrite)
