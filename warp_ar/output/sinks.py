"""Sinks of frames: folders of numbered pictures or environments, and video.

A folder contains PNGs with 8 or 16 bits, OpenEXRs with linear radiance (channels R, G, B as 16-bit floats, Rec. 709
primaries), or environments. Other files in it are not changed. A frame gets its name only when it is complete.
"""

from __future__ import annotations

import fractions
import os
import pathlib
from collections.abc import Mapping
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt
import OpenEXR

from warp_ar.declared import checked
from warp_ar.errors import SinkError, UsageError, reason
from warp_ar.exr_file import LARGEST, exr_header, store_exr
from warp_ar.files import kind_of, store
from warp_ar.output.encoders import CODINGS, find_encoding
from warp_ar.output.environment_file import check_environment, write_environment
from warp_ar.output.places import earlier_frames
from warp_ar.output.sink import Sink, ThreadedSink, check_image, make_folder
from warp_ar.output.video_sink import VIDEO_SUFFIXES, VideoSink
from warp_ar.signals import REC_709
from warp_ar.signature import encode_png

FOLDER_CODINGS: Final = {"8bit": "numbered frames", "16bit": "numbered frames of 16 bits", "exr": "numbered OpenEXRs"}
"""Codings of a folder's pictures, with their descriptions."""
FOLDER_THREADS = 2
"""Number of threads that compress the frames of a folder."""

# Camera frames hardly repeat: searching repetitions costs time and saves no bytes, but neighbouring pixels are similar.
PNG_OPTIONS = (
    *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB),
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY),
)


class FolderSink(ThreadedSink):
    """A folder of numbered frames, ``0000.png`` or ``0000.exr`` the first.

    The first new frame removes numbered frames of earlier runs, so that the folder contains one run only.

    Args:
        path: The folder.
        overwrite: True to remove numbered frames that this program did not write.
        coding: One of ``FOLDER_CODINGS``; all but ``8bit`` take linear radiance.
        transfer: Transfer function of the camera, for 16-bit codes.

    Raises:
        SinkError: The folder cannot be made or written to, or holds frames that must not be removed.
    """

    _suffix = ".png"

    def __init__(
        self, path: str | pathlib.Path, *, overwrite: bool = False, coding: str = "8bit", transfer: str = "srgb"
    ) -> None:
        self._path, self._coding, self._transfer = pathlib.Path(path), coding, transfer
        if coding == "exr":
            self._suffix = ".exr"
        make_folder(self._path)
        self._earlier: list[pathlib.Path] = []
        self._find_earlier(self._path, self._suffix, overwrite=overwrite)
        self.description = f"{self._path} ({FOLDER_CODINGS[coding]})"
        super().__init__(FOLDER_THREADS)

    def _find_earlier(self, folder: pathlib.Path, suffix: str, *, overwrite: bool) -> None:
        """Find the numbered frames that the first new one replaces; raise SinkError if they must not be removed."""
        self._earlier += earlier_frames(folder, suffix, overwrite=overwrite)
        if self._earlier:
            self.replaced = f"{self._path}: {len(self._earlier)} numbered frames of an earlier run are replaced"

    def _check(self, image: Any) -> None:
        check_image(image, np.uint8 if self._coding == "8bit" else np.float32)

    def write(self, image: Any) -> None:
        """Write the next frame; the first one removes frames of an earlier run.

        Raises:
            SinkError: The image is no frame, another frame could not be written, or an earlier run's frame cannot be
                removed.
        """
        self._check(image)
        earlier, self._earlier = self._earlier, []
        # Last frames first: an interrupted run leaves the beginning of the earlier run with all its files.
        for path in reversed(earlier):
            try:
                path.unlink(missing_ok=True)
            except OSError as error:
                raise SinkError(f"{path} cannot be replaced: {reason(error)}") from error
        super().write(image)

    def _store(self, index: int, image: Any) -> None:
        path = self._path / f"{index:04d}{self._suffix}"
        if self._coding == "exr":
            half = np.clip(image, -LARGEST, LARGEST).astype(np.float16)
            channels = {name: np.ascontiguousarray(half[..., k]) for k, name in enumerate("RGB")}
            store_exr(path, OpenEXR.File(exr_header(chromaticities=REC_709), channels))
            return
        if self._coding == "16bit":
            from warp_ar.kernels.color import encode_codes  # loads Warp: only after the page is open

            image = np.rint(65535.0 * encode_codes(self._transfer, image)).astype(np.uint16)
        store(path, encode_png(image, PNG_OPTIONS))


class EnvironmentSink(FolderSink):
    """A folder of ``NNNN.exr``, numbered from 0, each as `write_environment` writes it.

    The first map also removes the maps in the subfolders ``ball_1``, ``ball_2``, ...: light of an earlier run at mirror
    balls that the scene may no longer have.
    """

    _suffix = ".exr"

    def __init__(self, path: str | pathlib.Path, *, overwrite: bool = False) -> None:
        super().__init__(path, overwrite=overwrite)
        for folder in self._path.glob("ball_*"):
            if folder.name.removeprefix("ball_").isdecimal() and folder.is_dir():
                self._find_earlier(folder, self._suffix, overwrite=overwrite)

    def _check(self, image: Any) -> None:
        check_environment(image)

    def _store(self, index: int, image: npt.NDArray[Any]) -> None:
        write_environment(self._path / f"{index:04d}.exr", image, overwrite=True)


@checked
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
    """Open a sink: a video for .mp4, .mkv and .mov, a folder of pictures for a name without an ending.

    Missing parent folders are made.

    Args:
        path: File or folder; a folder that exists may have any name, as may one whose name ends in a slash.
        fps: Frames per second of a video.
        size: (width, height) of the frames in pixels, if known; else that of the first frame.
        overwrite: True to replace files that this program did not write.
        coding: What is written: ``8bit``; of linear radiance ``10bit``, ``pq`` or ``hlg`` in a video, ``16bit`` (PNG)
            or ``exr`` in a folder.
        transfer: Transfer function of the camera, for 10- and 16-bit codes.
        encoder: FFmpeg's name of a video's encoder; None: H.264 for 8 bits, H.265 for more.
        encoder_options: Options of the encoder, by FFmpeg's names.
        tick: Seconds of the unit in which a video keeps the times of `Sink.write_at`; None: one frame's at ``fps``.

    Raises:
        SinkError: The path cannot be written, may not be replaced, or its ending is unknown; the encoder does not work.
        UsageError: ``fps`` is not a positive number, or the coding or an option does not fit the path.
    """
    known = dict.fromkeys((*CODINGS, *FOLDER_CODINGS))
    if coding not in known:
        raise UsageError(f"coding {coding!r}: expected {', '.join(known)}")
    named_as_folder = str(path).endswith(("/", os.sep))
    path = pathlib.Path(path)
    is_video = path.suffix.lower() in VIDEO_SUFFIXES and not named_as_folder
    try:
        if not is_video and path.suffix and not named_as_folder and kind_of(path) != "folder":
            endings = ", ".join(VIDEO_SUFFIXES)
            raise SinkError(f"{path} ends in {path.suffix}; use {endings}, or a folder for PNG frames")
    except OSError as error:
        raise SinkError(f"{path} cannot be written: {reason(error)}") from error
    what, held = ("video", CODINGS) if is_video else ("folder", FOLDER_CODINGS)
    if coding not in held:
        raise UsageError(f"coding {coding!r}: {path} is a {what}, which holds {', '.join(held)}")
    if is_video:
        encoding = find_encoding(coding, encoder, encoder_options)
        return VideoSink(path, fps=fps, size=size, overwrite=overwrite, encoding=encoding, transfer=transfer, tick=tick)
    if encoder is not None or encoder_options:
        raise UsageError(f"encoder {encoder or ', '.join(encoder_options or ())}: {path} is a folder; name a video")
    return FolderSink(path, overwrite=overwrite, coding=coding, transfer=transfer)
