"""Session: a frame source and a pipeline that fits it, opened in one call."""

from __future__ import annotations

import asyncio
import dataclasses
import hashlib
import os
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_ar.accuracy.budget import AutoPipeline
from warp_ar.ball.ball import BallFit, posed_frames, refine_balls
from warp_ar.cache_folder import cache_folder
from warp_ar.closing import Closing
from warp_ar.declared import checked
from warp_ar.engine.modules import Progress
from warp_ar.engine.pipeline import Pipeline, Result
from warp_ar.errors import UsageError, WarpArError, check_process, warn_renamed
from warp_ar.light.captured import Light
from warp_ar.light.card_light import light_by_card
from warp_ar.output.environment_file import write_environment
from warp_ar.scene import CapturedLight, Scene, load_calibration, load_scene
from warp_ar.scene.exif import camera_by_exif
from warp_ar.sources.exposures import plan_bracket
from warp_ar.sources.source import Frame, Source
from warp_ar.sources.sources import open_scene_source
from warp_ar.stages.quality import AUTO, DEFAULT_BUDGET_MS, DEFAULT_PRESET, Quality
from warp_ar.tracking.markers import tell_upright
from warp_ar.tracking.tracking import given_pose, tell_missing_poses

BY_CARD = "card"
"""Value of ``light``: estimate the light from the card and other known surfaces."""
CARD_FRAMES = 24
"""Number of frames in which the marker is searched for."""


def calibrated(scene: Scene, calibration: str | Path, source: str | int | Path | None = None) -> Scene:
    """Return the scene with its camera from a calibration file or, for ``exif``, from the source's first picture.

    Raises:
        SceneError: The calibration file or the EXIF cannot be used.
        UsageError: The source has no EXIF.
    """
    transfer = scene.camera.transfer
    if str(calibration) != "exif":
        return dataclasses.replace(scene, camera=load_calibration(calibration, transfer))
    own = scene.source.path if scene.source is not None else None
    path = own if source is None else Path(str(source))
    if path is None or not path.exists():
        raise UsageError("calibration exif: the source is no picture or folder of pictures; give a calibration file")
    return dataclasses.replace(scene, camera=camera_by_exif(path, transfer))


def with_light(scene: Scene, light: str | Path, axes: str | None = None) -> Scene:
    """Return the scene with a captured light in place of the light from mirror balls in its frames.

    Args:
        scene: The scene.
        light: Latlong OpenEXR or Radiance HDR.
        axes: Axes of the light file; None: those that the file states, else the convention of its format.

    Raises:
        SceneError: The file cannot be used.
    """
    Light.load(light, axes)
    spec = scene.captured or CapturedLight(Path(light))
    return dataclasses.replace(scene, captured=dataclasses.replace(spec, file=Path(light).resolve(), axes=axes))


def lit_by_card(scene: Scene, source: Source) -> tuple[Scene, str]:
    """Return the scene with light estimated from its card and other surfaces, and a line with the estimate's accuracy.

    Args:
        scene: The scene.
        source: Frames of the scene; a capture device's frames that are read here are not delivered again.

    Raises:
        UsageError: The first frames do not show the marker clearly.
    """
    scene = dataclasses.replace(scene, camera=scene.camera.scaled_to(*source.size))
    views = posed_frames(source, scene.marker, scene.camera, CARD_FRAMES) if scene.has_marker else []
    if not views:
        raise UsageError(f"light {BY_CARD!r}: the first {CARD_FRAMES} frames do not show the marker well")
    found = light_by_card(views[0][0], scene, views[0][1])
    name = hashlib.sha256(found.radiance.tobytes()).hexdigest()[:16]
    path = cache_folder() / "card_light" / f"{name}.exr"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_environment(path, found.latlong)
    return with_light(scene, path), found.words


def chosen_scene(
    scene: Scene | str | Path,
    source: str | int | Path | None,
    calibration: str | Path | None,
    light: str | Path | None,
    light_axes: str | None,
) -> Scene:
    """Return the scene with its camera and light replaced by those that are given."""
    scene = scene if isinstance(scene, Scene) else load_scene(scene)
    if calibration is not None:
        scene = calibrated(scene, calibration, source)
    return scene if light is None else with_light(scene, light, light_axes)


class Session(Closing):
    """Opens a scene's frame source and lights its frames one after another.

    Iterating yields ``(frame, result)`` pairs; ``async for`` waits for each frame in a thread and does not block the
    event loop. Use a session in a ``with`` statement, which closes its source and threads.
    """

    ahead = True
    """True if a frame may be submitted before the previous result is yielded, where source and device allow it."""
    decode_ms = 0.0
    """Time of decoding the source's last frame, milliseconds."""
    ball_fits: tuple[BallFit | None, ...] = ()
    """Fit of each mirror ball by ``refine_ball``; None for a ball that was not found."""
    notes: tuple[str, ...] = ()
    """Notes, a line each: exposures not merged, frames without a pose, orientation of a marker, card light."""

    @checked
    def __init__(
        self,
        scene: Scene | str | Path = "desk",
        *,
        source: str | int | Path | None = None,
        calibration: str | Path | None = None,
        light: str | Path | None = None,
        light_axes: str | None = None,
        device: str = "auto",
        quality: str | Quality = DEFAULT_PRESET,
        budget_ms: float | None = None,
        outputs: tuple[str, ...] = ("image",),
        loop: bool = False,
        refine_ball: bool = False,
    ) -> None:
        """Open the source and build the pipeline.

        Args:
            scene: A scene, a scene file or a bundled scene's name.
            source: Frames to use in place of the scene's own: a folder, a picture, a video file, a capture device's
                index, or the URL of a camera's stream.
            calibration: OpenCV calibration file that replaces the scene's camera, or ``exif`` for a camera from the
                first picture's EXIF.
            light: Captured light that replaces the light from mirror balls: a latlong OpenEXR or Radiance HDR. Or
                ``card``: light estimated from the card and other surfaces in the first frames, to second order of
                spherical harmonics; ``notes`` states the interval of its error.
            light_axes: Axes of the light file, ``z-up``, ``blender``, ``y-up`` or ``opengl``; None: those that the file
                states, else y-up for OpenEXR and blender for HDR.
            device: ``auto``, ``cpu`` or ``cuda:N``.
            quality: A preset's name, a ``Quality``, or ``auto``: the least error within a budget.
            budget_ms: Time budget of a frame for ``auto``, milliseconds; None means 33.
            outputs: Parts of the results: ``image``, ``environment``, ``pose``, and layers of ``warp_ar.LAYERS``.
            loop: Start a clip again when it ends.
            refine_ball: Whether to measure the mirror balls' places in the source's first frames, which takes some
                seconds; ``ball_fits`` has the results.

        Raises:
            SceneError: The scene or the calibration cannot be used.
            SourceError: The source cannot be opened.
            UsageError: Any other argument cannot be used.
        """
        self._process = os.getpid()
        scene = chosen_scene(scene, source, calibration, None if light == BY_CARD else light, light_axes)
        if budget_ms is not None and quality != AUTO:
            raise UsageError(f"a budget of {budget_ms:g} ms needs the quality {AUTO!r}, not {quality!r}")
        shown = scene.source.shown if source is None and scene.source is not None else None
        self.source: Source = open_scene_source(scene, source, loop=loop)
        self.pipeline: Pipeline | AutoPipeline
        try:
            if refine_ball:
                scene, self.ball_fits = refine_balls(scene, self.source)
            by_card = ""
            if light == BY_CARD:
                scene, by_card = lit_by_card(scene, self.source)
            size, exposures = self.source.size, self.source.exposures
            told = tell_missing_poses(scene.pose, self.source), tell_upright(scene)
            self.notes = (*plan_bracket(exposures, shown).notes, *filter(None, (*told, by_card)))
            given: dict[str, Any] = {"size": size, "outputs": outputs, "exposures": exposures, "shown": shown}
            if quality == AUTO:
                budget = DEFAULT_BUDGET_MS if budget_ms is None else budget_ms
                # A budget needs frames that do not wait for estimates, also in recordings.
                given["estimates"] = "real_time" if self.source.live else "delayed"
                self.pipeline = AutoPipeline(scene, budget_ms=budget, device=device, **given)
            else:
                self.pipeline = self._open(scene, quality=quality, device=device, **given)
                if self.pipeline.device.is_cuda:
                    self.source.memory = self._new_frame
        except BaseException:
            self.source.close()
            raise

    def _open(self, scene: Scene, **given: Any) -> Pipeline:
        """Return a pipeline of a fixed quality."""
        linear = self.source.keep_depth(str(scene.camera.transfer))
        return Pipeline(scene, estimates="real_time" if self.source.live else "synchronous", linear=linear, **given)

    @property
    def bracket_notes(self) -> tuple[str, ...]:
        """Former name of ``notes``."""
        warn_renamed("Session.bracket_notes", "notes")
        return self.notes

    @property
    def scene(self) -> Scene:
        """Scene by which frames are lit."""
        return self.pipeline.scene

    def _new_frame(self) -> npt.NDArray[np.uint8]:
        """Return memory into which the source writes a frame, so that it is sent to the device without a copy."""
        assert isinstance(self.pipeline, Pipeline)
        return self.pipeline.new_frame()

    def close(self) -> None:
        """Close the source, and end the pipeline's threads."""
        if os.getpid() != self._process:
            return  # a fork has neither the threads nor the device
        try:
            self.source.close()
        finally:
            self.pipeline.close()

    def change(self, *, scene: Scene | None = None, quality: str | Quality | None = None) -> None:
        """Change scene or quality from the next frame on, as ``Pipeline.change`` does; the source goes on.

        Args:
            scene: The next scene; None keeps the current one.
            quality: A preset's name or a ``Quality``; None keeps the current one.

        Raises:
            UsageError: The session's quality is ``auto``, or as for ``Pipeline.change``.
            SceneError: As for ``Pipeline.change``.
        """
        if not isinstance(self.pipeline, Pipeline):
            raise UsageError(f"a session of quality {AUTO!r} chooses its methods itself; open another session")
        self.pipeline.change(scene, quality=quality)

    def warm_up(self, progress: Progress | None = None) -> None:
        """Compile and load the kernels that frames need; without this call the first frame does it.

        Args:
            progress: Receives the numbers of compiled modules and of all modules to compile, first 0; not called if
                none is.
        """
        self.pipeline.warm_up(progress)

    def _frames(self) -> Iterator[Frame]:
        """Yield the source's frames and measure the time of decoding each."""
        frames = iter(self.source)
        while True:
            start = time.perf_counter()
            frame = next(frames, None)
            self.decode_ms = (time.perf_counter() - start) * 1e3
            if frame is None:
                return
            yield frame

    def _known_of(self, frame: Frame) -> dict[str, Any]:
        """Return the keyword arguments of a pipeline's call for a frame."""
        pose = given_pose(self.pipeline.scene.pose, frame)
        return {"time_seconds": frame.time, "exposure_time": frame.exposure_time, "pose": pose}

    async def __aiter__(self) -> AsyncIterator[tuple[Frame, Result]]:
        frames = iter(self)
        while (pair := await asyncio.to_thread(next, frames, None)) is not None:
            yield pair

    def __iter__(self) -> Iterator[tuple[Frame, Result]]:
        pairs = self._pairs()
        while True:
            check_process("the session was opened", self._process)
            if (pair := next(pairs, None)) is None:
                return
            yield pair

    def _pairs(self) -> Iterator[tuple[Frame, Result]]:
        pipeline, live = self.pipeline, self.source.live
        on_cpu = pipeline.device.is_cpu
        kept = on_cpu or set(pipeline.plan.request.outputs) <= {"image", "pose"}
        called = live and on_cpu  # a call, unlike ``submit``, needs no copy of the frame
        if not self.ahead or called or not kept or not isinstance(pipeline, Pipeline):
            for frame in self._frames():
                yield frame, self.pipeline(frame.deepest, **self._known_of(frame))
            return
        # Results are yielded one frame late: the next frame is decoded and its marker found while this one is
        # rendered, and reading a picture does not delay the next frame. Frames of a live camera are yielded at once.
        # They are submitted all the same, because the picture then stays in the memory to which it is copied from the
        # device.
        ready: list[tuple[Frame, Result]] = []
        ahead = 0
        try:
            for frame in self._frames():
                ready.append((frame, self.pipeline.submit(frame.deepest, **self._known_of(frame))))
                if len(ready) > ahead:
                    yield ready.pop(0)
                ahead = 0 if live else 1
        except WarpArError:
            yield from ready
            raise
        yield from ready
