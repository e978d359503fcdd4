"""Opening of sources of frames: image folders, video files, capture devices, streams and generated clips.

Every source yields a `Frame` in 8-bit RGB. A recorded source (folder, video, generated) loses no frame and is decoded a
few frames ahead on one thread. A live source (device, stream, queue) keeps only the newest frame, because latency
matters more than completeness; ``dropped`` counts the skipped frames.

Frames may alternate between exposures. Only one exposure is shown; the others measure light that clips in it.
"""

from __future__ import annotations

import os
import pathlib
from collections.abc import Sequence

from warp_ar.declared import checked
from warp_ar.errors import SourceError, UsageError
from warp_ar.pictures import RAW, foreign_words
from warp_ar.scene import Scene
from warp_ar.sources.capture_device import CaptureDevice
from warp_ar.sources.frame_folder import IMAGE_SUFFIXES, FrameFolder
from warp_ar.sources.network_stream import SCHEMES, NetworkStream
from warp_ar.sources.source import DEFAULT_FPS, Source, check_exposures, check_fps, existing_path
from warp_ar.sources.synthetic import Synthetic
from warp_ar.sources.video_file import VideoFile

MOST_INDEX = 1023
"""Largest index of a capture device."""


@checked
def open_source(
    spec: str | int | pathlib.Path, *, fps: float | None = None, loop: bool = False, exposures: Sequence[float] = ()
) -> Source:
    """Open the source named by ``spec``.

    Args:
        spec: A folder of images, an image, a video file, the index of a capture device (a number, also as text), the
            URL of a camera's stream (``rtsp://...``, ``http://...``), or ``synthetic:NAME``.
        fps: Frames per second: the rate of a folder (default 30), a new rate for a video, or the rate requested from a
            device.
        loop: Start again at the end; index and time of the frames continue. Without effect on live sources.
        exposures: Exposure times in seconds that repeat over the frames: those of a recording, or those to request from
            a device.

    Raises:
        SourceError: There is no such source, or it cannot be read.
        UsageError: ``fps`` is not a positive number, ``exposures`` are no times, or there is no generated source of
            that name.
    """
    check_fps(fps)
    check_exposures(exposures)
    text = str(spec)
    if isinstance(spec, int) or (text.isdecimal() and not os.path.lexists(text)):
        if len(text) > 4 or not 0 <= (index := int(text)) <= MOST_INDEX:
            raise SourceError(f"there is no capture device {text[:40]}; they are numbered from 0 to {MOST_INDEX}")
        return CaptureDevice(index, fps=fps, exposures=exposures)
    if text.startswith("synthetic:"):
        return Synthetic(text.removeprefix("synthetic:"), fps=fps or DEFAULT_FPS, loop=loop)
    if "://" in text:
        scheme = text.partition("://")[0].lower()
        if scheme not in SCHEMES:
            raise SourceError(f"{text[:60]}: no stream is read by {scheme!r}; expected {', '.join(SCHEMES)}")
        if exposures:
            raise UsageError("exposures: a stream from the network does not let its exposure be set")
        return NetworkStream(text, fps=fps)
    path = existing_path(pathlib.Path(spec))
    if path.is_dir() or path.suffix.lower() in IMAGE_SUFFIXES | RAW:
        return FrameFolder(path, fps=fps or DEFAULT_FPS, loop=loop, exposures=exposures)
    if words := foreign_words(path.suffix.lower()):
        raise SourceError(f"{path} is {words}")
    return VideoFile(path, fps=fps, loop=loop, exposures=exposures)


def source_of(scene: Scene, given: str | int | pathlib.Path | None = None) -> str | int | pathlib.Path | None:
    """Return the given source, or else the scene's own, as an argument for ``open_source``; None if there is neither.

    Args:
        scene: The scene.
        given: Source that replaces the scene's own.
    """
    if given is not None or scene.source is None:
        return given
    spec = scene.source
    return spec.path or (f"synthetic:{spec.synthetic}" if spec.synthetic is not None else spec.camera)


def open_scene_source(scene: Scene, given: str | int | pathlib.Path | None, *, loop: bool) -> Source:
    """Open the given source, or else the scene's own source with the scene's rate and exposures.

    Args:
        scene: The scene.
        given: Source that replaces the scene's own.
        loop: Start again at the end.

    Raises:
        SourceError: The source cannot be opened.
        UsageError: There is neither a given source nor one in the scene.
    """
    if (where := source_of(scene, given)) is None:
        raise UsageError(f"scene {scene.name!r} names no source; give one with --source")
    if given is not None or (spec := scene.source) is None:
        return open_source(where, loop=loop)
    return open_source(where, fps=spec.fps, loop=loop, exposures=spec.exposures or ())
