"""The first, cheap pass over a clip: where its camera stood in every frame, and by what light.

All segments and variations of the clip start from it: poses are given, the light is given, and so a frame's picture
does not depend on which frames were lit before it. The file is a ZIP of NumPy arrays, as ``numpy.load`` reads it:

- ``ticks`` (n,) int64 and ``tick`` (2,) int64: time stamps of the frames, and the seconds of a tick as a fraction;
- ``poses`` (n, 12) float64: ``camera_from_world``, R row by row and t in metres; NaN where the marker was lost;
- ``saturation`` (3,) float64: codes at which the camera's channels saturate;
- ``size`` (2,) int64: width and height of the frames in pixels;
- ``coding`` str: what a video of the recording's own depth is encoded in;
- ``keys`` (k,) int64: numbers of the frames from which on each of the k maps holds;
- ``places`` (k + 1,) int64: where in ``lights.bin`` each begins, and where the last ends.

``lights.bin`` holds maps one after another, so that one of 100,000 is read as quickly as one of two: each a zlib stream
of a map, float32 (h, 2 h, 3), and, where the quality finds their places, its emitters, as ``numpy.save`` has both.

A key is written once a texel of the environment has moved by more than one 8-bit step (``CHANGE_FLOOR + CHANGE_SHARE *
value``) since the last key: the tolerance within which stages that read the environment do not run again either.

Poses and light of a frame rest on the frames before it, so a clip is surveyed in order; while the marker of one is
looked for, kernels gather the light of the one before, and a thread compares and packs that of those before it.
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
from warp_ar.kernels.environment.change import CHANGE_FLOOR, CHANGE_SHARE
from warp_ar.kernels.structs import Emitter, struct_dtype
from warp_ar.light.captured import Light, find_emitters
from warp_ar.scene import CapturedLight, Pose, Scene
from warp_ar.sources.deep_frame import check_linear
from warp_ar.sources.source import RecordedSource
from warp_ar.sources.sources import open_source
from warp_ar.stages.features import has_environment
from warp_ar.tracking.tracking import given_pose

Map = npt.NDArray[np.float32]

NAME = "survey.npz"
MAPS = "lights.bin"
LIGHT = "light.exr"
"""The environment at the clip's end, with the emitters that were found."""
WAITING = 4
"""Frames at most whose light waits to be compared with the last that was kept."""
_MANTISSA = 12
"""Bits of a radiance that are kept: a relative error of 2^-13, a hundredth of what a key may be off; the rest is noise
that does not compress."""


class Survey:
    """The result of a survey; maps are read when they are asked for."""

    def __init__(self, folder: Path) -> None:
        """Open the survey of a folder.

        Raises:
            SourceError: It is damaged or not there.
        """
        self._path, self._maps = folder / NAME, folder / MAPS
        self.light_file = folder / LIGHT
        try:
            # Opened here: of a damaged file NumPy leaves its own open.
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
        """Return the camera's pose; None where the marker was lost."""
        row = self.poses[frame]
        return None if np.isnan(row[0]) else Pose(row[:9].reshape(3, 3), row[9:])

    def key_of(self, frame: int) -> int:
        """Number of the map that holds for a frame."""
        return max(int(np.searchsorted(self.keys, frame, side="right")) - 1, 0)

    def light(self, key: int) -> tuple[Map, npt.NDArray[Any] | None]:
        """A map, float32 (h, 2 h, 3), and where its emitters are: records of ``Emitter``, if they are known.

        Raises:
            SourceError: It is damaged or not there.
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
        clip: Number of the clip.
        folder: Where to write; it is there, and empty.
        device: ``cpu`` or ``cuda:N``.

    Returns:
        Frames of the clip, and those whose marker was found.

    Raises:
        WarpArError: The clip or its scene cannot be used.
    """
    path, fps = source_of(jobs, clip)
    index = index_frames(path, fps)
    first, end = lit_range(jobs.clips[clip], index.length)
    scene = scene_of(jobs, clip)
    with open_source(path, fps=fps) as source:
        size, names = source.size, source.names
        coding = source.curve or ("10bit" if source.deep else "8bit")
    alone = jobs.settings.light == "preroll"
    with open(folder / MAPS, "wb") as maps:
        look = _Look(jobs.settings.light, maps, np.full((index.length, 12), np.nan))
        if not alone:
            for number in range(first, end):
                given = None if scene.pose is None else scene.pose.at(number, names[number] if names else "")
                if given is not None:
                    look.poses[number] = np.concatenate([np.ravel(part) for part in given])
            captures = scene.captured is None and has_environment(scene)
            if captures or scene.pose is None:
                source = open_part(path, index, first, end, fps, jobs.settings.gpu_of(device))
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
        size=size,
        coding=coding,
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
    """Poses and light, gathered while frames flow."""

    light: str
    """One of ``LIGHTS``."""
    maps: BinaryIO
    """File of the maps."""
    poses: npt.NDArray[np.float64]
    keys: list[int] = dataclasses.field(default_factory=list)
    places: list[int] = dataclasses.field(default_factory=lambda: [0])
    saturation: npt.NDArray[np.float64] = dataclasses.field(default_factory=lambda: np.full(3, 255.0))
    latest: tuple[Map, npt.NDArray[Any] | None] | None = None
    """Environment and emitters of the last frame whose marker was found."""
    kept: tuple[Map, npt.NDArray[Any] | None] | None = None
    """Those of the last key."""
    shape: tuple[int, ...] = (0, 0, 3)
    """Shape of every map."""

    def take(self, frame: int, result: Result) -> None:
        """Wait for the pose and the light of a frame; where all of its light is wanted, ``keep`` it."""
        if result.pose is None:
            _ = result.stages  # waits, and raises what went wrong
            return
        self.poses[frame] = (*result.pose.rotation.ravel(), *result.pose.translation)
        self.latest = None if result.environment is None else (result.environment, result.emitters)
        if self.latest is not None and self.light == "follow":
            self.keep(frame, *self.latest)

    def keep(self, frame: int, environment: Map, emitters: npt.NDArray[Any] | None) -> None:
        """Write an environment if it has moved since the last one that was written, or its emitters have."""
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
    """Follow the camera and, where the frames are to tell it, the light; a thread packs what came of frames before."""
    with contextlib.closing(source), ThreadPoolExecutor(1, "warp_ar-survey") as packer:
        linear = keep_depth(source, scene)
        pipeline = Pipeline(
            scene,
            device=device,
            quality=quality,
            size=source.size,
            outputs=("pose", "environment") if captures else ("pose",),
            estimates="synchronous",
            follows_camera=False,
            linear=linear,
        )
        waiting: collections.deque[Future[None]] = collections.deque()
        with pipeline:
            for frame in source:
                frame.image.flags.writeable = False  # so that it need not be copied to wait for its turn
                pose = given_pose(scene.pose, frame)
                result = pipeline.submit(frame.deepest, time_seconds=frame.time, pose=pose)
                waiting.append(packer.submit(look.take, frame.index, result))
                if len(waiting) > WAITING:
                    waiting.popleft().result()
            for future in waiting:
                future.result()
            look.saturation = pipeline.inputs.saturation.levels


def keep_depth(source: RecordedSource, scene: Scene) -> bool:
    """Have a source keep what of its pictures is more than 8 bits; whether there is such.

    Raises:
        UsageError: They are linear light, which does not fit the camera's transfer.
    """
    if source.deep == "light":
        check_linear(str(scene.camera.transfer))
    source.keeps_depth = source.deep != ""
    return source.keeps_depth


def _rounded(values: Map) -> Map:
    """Values with the last bits of their mantissa rounded away."""
    drop = 23 - _MANTISSA
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    return ((bits + np.uint32(1 << (drop - 1))) & np.uint32(0xFFFFFFFF << drop & 0xFFFFFFFF)).view(np.float32)


def lit_scene(jobs: JobFile, clip: int, survey: Survey) -> Scene:
    """The scene of a clip, lit by what its survey captured.

    Raises:
        SceneError: The light cannot be read.
    """
    scene = scene_of(jobs, clip)
    if scene.captured is not None or not has_environment(scene):
        return scene
    if not survey.light_file.is_file():
        raise SceneError(f"{survey.light_file} is not there; remove its folder and resume")
    return dataclasses.replace(scene, captured=CapturedLight(survey.light_file))
