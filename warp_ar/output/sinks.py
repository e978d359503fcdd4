"""Frames out: numbered PNGs, H.264 video, and environments as OpenEXR."""

from __future__ import annotations

import os
import pathlib

from warp_ar.errors import SinkError, reason
from warp_ar.files import kind_of
from warp_ar.output.environment_file import EnvironmentSink, read_environment, write_environment
from warp_ar.output.folder_sink import FolderSink
from warp_ar.output.sink import NullSink, Sink, TeeSink
from warp_ar.output.video_sink import VIDEO_SUFFIXES, VideoSink

__all__ = [
    "EnvironmentSink",
    "FolderSink",
    "NullSink",
    "Sink",
    "TeeSink",
    "VideoSink",
    "open_sink",
    "read_environment",
    "write_environment",
]


def open_sink(
    path: str | pathlib.Path, *, fps: float, size: tuple[int, int] | None = None, overwrite: bool = False
) -> Sink:
    """A sink for ``path``: a video for .mp4, .mkv and .mov, a folder of PNGs for a name without an ending.

    Folders that are missing on the way are made.

    Args:
        path: File or folder; a folder that exists may have any name, as may one whose name ends in a slash.
        fps: Frames per second of a video.
        size: (width, height) of the frames in pixels, if known; the first frame tells otherwise.
        overwrite: Whether files that this program did not write may be replaced.

    Raises:
        SinkError: The path cannot be written, may not be replaced, or its ending is unknown.
        UsageError: ``fps`` is not a positive number.
    """
    named_as_folder = str(path).endswith(("/", os.sep))
    path = pathlib.Path(path)
    if path.suffix.lower() in VIDEO_SUFFIXES and not named_as_folder:
        return VideoSink(path, fps=fps, size=size, overwrite=overwrite)
    try:
        is_folder = kind_of(path) == "folder"
    except OSError as error:
        raise SinkError(f"{path} cannot be written: {reason(error)}") from error
    if is_folder or not path.suffix or named_as_folder:
        return FolderSink(path, overwrite=overwrite)
    raise SinkError(f"{path} ends in {path.suffix}; use {', '.join(VIDEO_SUFFIXES)}, or a folder for PNG frames")
