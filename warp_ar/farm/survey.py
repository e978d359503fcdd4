"""Survey of a clip: a first, cheap pass that finds the camera's pose in every frame and the light.

All segments and variations of the clip use its survey. With given poses and light, a frame's picture does not depend on
the frames lit before it. ``survey.npz`` holds arrays for ``numpy.load``:

- ``ticks`` (n,) int64 and ``tick`` (2,) int64: time stamps of frames, and the seconds of a tick as a fraction;
- ``seekable`` bool: True if the time stamps are those of the file;
- ``poses`` (n, 12) float64: ``camera_from_world``, R by rows and t in metres; NaN where the marker was lost;
- ``saturation`` (3,) float64: 8-bit codes at which the camera's channels saturate;
- ``size`` (2,) int64: width and height of the frames in pixels;
- ``coding`` str: coding of a video at the recording's own bit depth;
- ``keys`` (k,) int64: index of the frame from which each of the k environment maps is used;
- ``places`` (k + 1,) int64: offset in ``lights.bin`` of each map, and the end of the last;
- ``shape`` (3,) int64: shape of every map.

``lights.bin`` contains the maps one after another, so that the time to read one does not depend on their number. Each
is a zlib stream of the bytes of a map, float32 (h, 2 h, 3), followed by those of its emitters if the quality finds
their positions.

A new map, called a key, is written when the emitters have changed, or when a texel of the environment has changed since
the last key by more than ``CHANGE_FLOOR + CHANGE_SHARE * value``, about one 8-bit step.

Poses and light of a frame depend on the frames before it, so a clip is surveyed in order. Three steps run in parallel:
the search for the marker in a frame, the light of the frame before it, and on a thread the comparison and compression
of the light of earlier frames.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import fractions
import math
import zipfile
import zlib
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from warp_ar.engine.pipeline import Pipeline
from warp_ar.engine.result import Result
from warp_ar.errors import SceneError, SourceError, reason
from warp_ar.farm.frames import FrameIndex, index_frames, open_part
from warp_ar.farm.jobs import JobFile, inputs_of, jobs_of_clip, lit_range, scene_of, source_of
from warp_ar.farm.manifest import describe_inputs
from warp_ar.kernels.structs import Emitter, struct_dtype
from warp_ar.light.captured import Light, find_emitters
from warp_ar.scene import CapturedLight, Pose, Scene
from warp_ar.sources.source import RecordedSource
from warp_ar.stages.features import has_environment
from warp_ar.tracking.tracking import given_pose

Map = npt.NDArray[np.float32]

NAME = "survey.npz"
MAPS = "lights.bin"
LIGHT = "light.exr"
"""File of the environment at the clip's end, with its emitters."""
WAITING = 4
"""Largest number of frames whose light waits to be compared with the last key."""
CHANGE_FLOOR = 0.0005
"""Absolute part of a texel's change beyond which a new map is written."""
CHANGE_SHARE = 0.01
"""Relative part of a texel's change beyond which a new map is written, about one 8-bit step. Until then, a filtered
value F of the map is off by at most ``CHANGE_FLOOR + CHANGE_SHARE * F``, if the filter's weights are not negative and
sum to 1."""
_MANTISSA = 12
"""Number of mantissa bits of stored radiance. The relative error of 2^-13 is a hundredth of ``CHANGE_SHARE``; further
bits are noise, which does not compress."""


class Survey:
    """Survey of a clip, read from its files; maps are read on demand."""

    def __init__(self, folder: Path) -> None:
        """Open the survey in a folder.

        Raises:
            SourceError: The survey is damaged or missing.
        """
        self._path, self._maps = folder / NAME, folder / MAPS
        self.light_file = folder / LIGHT
        try:
            # Opened here, because NumPy does not close a damaged file that it has opened itself.
            with open(self._path, "rb") as stream, np.load(stream) as values:
                numerator, denominator = (int(v) for v in values["tick"])
                tick = fractions.Fraction(numerator, denominator)
                self.index = FrameIndex(values["ticks"], tick, bool(values["seekable"]))
                self.poses: npt.NDArray[np.float64] = values["poses"]
                self.saturation: npt.NDArray[np.float64] = values["saturation"]
                self.keys: npt.NDArray[np.int64] = values["keys"]
                self._places: npt.NDArray[np.int64] = values["places"]
                width, height = (int(v) for v in values["size"])
                self.size = width, height
                self.coding = str(values["coding"])
                self._shape = tuple(int(v) for v in values["shape"])
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise SourceError(f"{self._path} cannot be read: {reason(error)}; remove its folder and resume") from error

    def pose(self, frame: int) -> Pose | None:
        """Return the camera's pose in a frame; None if the marker was lost."""
        row = self.poses[frame]
        return None if np.isnan(row[0]) else Pose(row[:9].reshape(3, 3), row[9:])

    def key_of(self, frame: int) -> int:
        """Return the index of the environment map for a frame."""
        return max(int(np.searchsorted(self.keys, frame, side="right")) - 1, 0)

    def light(self, key: int) -> tuple[Map, npt.NDArray[Any] | None]:
        """Return an environment map and its emitters.

        Args:
            key: Index of the map.

        Returns:
            Radiance, float32 (h, 2 h, 3); and records of ``Emitter``, or None if the emitters are not known.

        Raises:
            SourceError: The map is damaged or missing.
        """
        begin, end = (int(place) for place in self._places[key : key + 2])
        try:
            with open(self._maps, "rb") as stream:
                stream.seek(begin)
                stored = zlib.decompress(stream.read(end - begin))
            count = math.prod(self._shape)
            radiance = np.frombuffer(stored, np.float32, count).reshape(self._shape)
            emitters = np.frombuffer(stored, struct_dtype(Emitter), offset=radiance.nbytes)
            return radiance, emitters if emitters.size else None
        except (OSError, ValueError, zlib.error) as error:
            raise SourceError(f"{self._maps} cannot be read: {reason(error)}; remove its folder and resume") from error


def survey_clip(jobs: JobFile, clip: int, folder: Path, device: str) -> dict[str, Any]:
    """Survey a clip.

    Args:
        jobs: The job file.
        clip: Index of the clip.
        folder: Existing, empty folder to write to.
        device: ``cpu`` or ``cuda:N``.

    Returns:
        Values for the manifest: numbers of frames (``length``), jobs, frames with a pose (``found``) and maps
        (``keys``), and the ``inputs`` that were read.

    Raises:
        WarpArError: The clip or its scene cannot be used.
    """
    path, fps = source_of(jobs, clip)
    index = index_frames(path, fps)
    first, end = lit_range(jobs.clips[clip], index.length)
    scene = scene_of(jobs, clip)
    alone = jobs.settings.light == "preroll"
    source = open_part(path, index, first, end, fps, jobs.settings.gpu_of(device))
    with contextlib.closing(source), open(folder / MAPS, "wb") as maps:
        look = _Look(jobs.settings.light, maps, np.full((index.length, 12), np.nan))
        if not alone:
            for number, name in zip(range(first, end), source.names or [""] * (end - first), strict=True):
                given = None if scene.pose is None else scene.pose.at(number, name)
                if given is not None:
                    look.poses[number] = np.concatenate([np.ravel(part) for part in given])
            captures = scene.captured is None and has_environment(scene)
            if captures or scene.pose is None:
                _look_at_frames(scene, source, look, jobs.settings.quality, device, captures=captures)
        if look.latest is not None:
            if jobs.settings.light == "fixed":
                look.keep(first, *look.latest)
            last = _rounded(look.latest[0])
            emitters = find_emitters(last, np.zeros_like(last), 0.0)
            Light(last, np.ones(last.shape[:2], np.float32), emitters).save(folder / LIGHT)
    np.savez_compressed(
        folder / NAME,
        ticks=index.ticks,
        tick=[index.tick.numerator, index.tick.denominator],
        seekable=index.seekable,
        poses=look.poses,
        size=source.size,
        coding=source.curve or ("10bit" if source.deep else "8bit"),
        saturation=look.saturation,
        keys=look.keys,
        places=look.places,
        shape=look.shape,
    )
    found = int(np.isfinite(look.poses[first:end, 0]).sum())
    if not alone and not found:
        missing = "marker was found" if scene.pose is None else f"pose of {scene.pose.file} is"
        raise SourceError(f"{path}: no {missing} in frames {first} to {end - 1}: nothing can be placed there")
    inputs = describe_inputs(inputs_of(jobs, clip))
    count = jobs_of_clip(jobs, clip, index.length)
    return {"length": index.length, "jobs": count, "found": found, "keys": len(look.keys), "inputs": inputs}


@dataclasses.dataclass
class _Look:
    """Poses and light, collected over the frames of a survey."""

    light: str
    """Value of the key ``light``."""
    maps: BinaryIO
    """File of the maps."""
    poses: npt.NDArray[np.float64]
    """Poses in the form of the module's ``poses``, (n, 12)."""
    keys: list[int] = dataclasses.field(default_factory=list)
    """Index of the frame from which each map is used."""
    places: list[int] = dataclasses.field(default_factory=lambda: [0])
    """Offset in the file of each map, and the end of the last."""
    saturation: npt.NDArray[np.float64] = dataclasses.field(default_factory=lambda: np.full(3, 255.0))
    """8-bit codes at which the camera's channels saturate, (3,)."""
    latest: tuple[Map, npt.NDArray[Any] | None] | None = None
    """Environment and emitters of the last frame with a marker."""
    kept: tuple[Map, npt.NDArray[Any] | None] | None = None
    """Environment and emitters of the last key."""
    shape: tuple[int, ...] = (0, 0, 3)
    """Shape of every map."""

    def take(self, frame: int, result: Result) -> None:
        """Wait for the pose and the light of a frame, and store them; the light only if it follows each frame."""
        if result.pose is None:
            _ = result.stages  # waits for the frame, and raises its errors
            return
        self.poses[frame] = (*result.pose.rotation.ravel(), *result.pose.translation)
        self.latest = None if result.environment is None else (result.environment, result.emitters)
        if self.latest is not None and self.light == "follow":
            self.keep(frame, *self.latest)

    def keep(self, frame: int, environment: Map, emitters: npt.NDArray[Any] | None) -> None:
        """Write an environment map for the frames from ``frame`` on, if it or its emitters have changed enough."""
        if self.kept is not None:
            last, before = self.kept
            same = emitters is None or (before is not None and emitters.tobytes() == before.tobytes())
            if same and not (np.abs(environment - last) > CHANGE_FLOOR + CHANGE_SHARE * np.abs(last)).any():
                return
        self.kept = _rounded(environment), emitters
        stored = b"".join(array.tobytes() for array in self.kept if array is not None)
        self.shape = environment.shape
        self.places.append(self.places[-1] + self.maps.write(zlib.compress(stored, 1)))
        self.keys.append(frame)


def _look_at_frames(
    scene: Scene, source: RecordedSource, look: _Look, quality: str, device: str, *, captures: bool
) -> None:
    """Track the camera in all frames and, if ``captures``, measure the light; store both in ``look``.

    Args:
        scene: Scene of the clip.
        source: The clip's frames.
        look: Poses and light to be filled in.
        quality: Name of a quality preset.
        device: ``cpu`` or ``cuda:N``.
        captures: True to measure the light.
    """
    with ThreadPoolExecutor(1, "warp_ar-survey") as packer:
        pipeline = Pipeline(
            scene,
            device=device,
            quality=quality,
            size=source.size,
            outputs=("pose", "environment") if captures else ("pose",),
            estimates="synchronous",
            follows_camera=False,
            linear=source.keep_depth(str(scene.camera.transfer)),
        )
        waiting: collections.deque[Future[None]] = collections.deque()
        with pipeline:
            for frame in source:
                frame.image.flags.writeable = False  # so that the pipeline need not copy it
                pose = given_pose(scene.pose, frame)
                result = pipeline.submit(frame.deepest, time_seconds=frame.time, pose=pose)
                waiting.append(packer.submit(look.take, frame.index, result))
                if len(waiting) > WAITING:
                    waiting.popleft().result()
            for future in waiting:
                future.result()
            look.saturation = pipeline.inputs.saturation.levels


def _rounded(values: Map) -> Map:
    """Return values rounded to ``_MANTISSA`` bits of the mantissa."""
    drop = 23 - _MANTISSA
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    return ((bits + np.uint32(1 << (drop - 1))) & np.uint32(0xFFFFFFFF << drop & 0xFFFFFFFF)).view(np.float32)


def lit_scene(jobs: JobFile, clip: int, survey: Survey) -> Scene:
    """Return the scene of a clip with the light that its survey captured.

    Raises:
        SceneError: The light cannot be read.
    """
    scene = scene_of(jobs, clip)
    if scene.captured is not None or not has_environment(scene):
        return scene
    if not survey.light_file.is_file():
        raise SceneError(f"{survey.light_file} is not there; remove its folder and resume")
    return dataclasses.replace(scene, captured=CapturedLight(survey.light_file))
