"""A source and a pipeline that fit each other: the common case in one call."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_ar.accuracy.budget import AutoPipeline
from warp_ar.ball.ball import BallFit, refine_balls
from warp_ar.closing import Closing
from warp_ar.engine.modules import Progress
from warp_ar.engine.pipeline import Pipeline, Result, resolve_quality
from warp_ar.engine.switcher import PipelineSwitcher, Target
from warp_ar.errors import UsageError, WarpArError
from warp_ar.light.captured import Light
from warp_ar.scene import CapturedLight, Scene, SourceSpec, load_calibration, load_scene
from warp_ar.scene.exif import camera_by_exif
from warp_ar.sources.deep_frame import check_linear
from warp_ar.sources.exposures import plan_bracket
from warp_ar.sources.sources import Frame, Source, open_source
from warp_ar.stages.quality import AUTO, DEFAULT_BUDGET_MS, DEFAULT_PRESET, Quality


def _where(spec: SourceSpec) -> str | int | Path:
    """What ``open_source`` calls the source that a scene names; a scene names exactly one."""
    if spec.path is not None:
        return spec.path
    return spec.camera if spec.camera is not None else f"synthetic:{spec.synthetic}"


def _open_source(scene: Scene, chosen: str | int | Path | None, loop: bool) -> Source:
    """Open the source that is chosen, or else the scene's own, with what the scene says of it.

    Raises:
        SourceError: It cannot be opened.
        UsageError: There is none.
    """
    if chosen is not None:
        return open_source(chosen, fps=None, loop=loop, exposures=())
    if (spec := scene.source) is None:
        raise UsageError(f"scene {scene.name!r} names no source; give one with --source")
    return open_source(_where(spec), fps=spec.fps, loop=loop, exposures=spec.exposures or ())


def calibrated(scene: Scene, calibration: str | Path, source: str | int | Path | None = None) -> Scene:
    """The scene with its camera by a calibration file or, for ``exif``, by the EXIF of the source's first picture.

    Raises:
        SceneError: The calibration or the EXIF cannot be used.
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
    """Return the scene lit by a captured light instead of what a mirror ball in its frames shows.

    Args:
        scene: The scene.
        light: Latlong OpenEXR or Radiance HDR.
        axes: Axes of that file; None: as it says, else by the convention of its format.

    Raises:
        SceneError: The file cannot be used.
    """
    Light.load(light, axes)
    spec = scene.captured or CapturedLight(Path(light))
    return dataclasses.replace(scene, captured=dataclasses.replace(spec, file=Path(light).resolve(), axes=axes))


def _chosen_scene(
    scene: Scene | str | Path,
    source: str | int | Path | None,
    calibration: str | Path | None,
    light: str | Path | None,
    light_axes: str | None,
) -> Scene:
    """The scene with the camera and the light that are given instead of its own."""
    scene = scene if isinstance(scene, Scene) else load_scene(scene)
    if calibration is not None:
        scene = calibrated(scene, calibration, source)
    return scene if light is None else with_light(scene, light, light_axes)


class Session(Closing):
    """Opens a scene's source and lights its frames one after another.

    Iterating gives ``(frame, result)`` pairs. Use it in a ``with`` statement, so that devices and threads are let go.
    """

    ahead = True
    """Whether frames may be begun before the one ahead of them is handed out, where that is possible."""
    decode_ms = 0.0
    """Milliseconds that the source took for its last frame."""
    ball_fits: tuple[BallFit | None, ...] = ()
    """Where ``refine_ball`` found the mirror balls; None for one that it did not find."""
    bracket_notes: tuple[str, ...] = ()
    """What of the source's exposures is not merged, and why, one line each."""

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
        """Open everything.

        Args:
            scene: A scene, a scene file or a bundled scene's name.
            source: Frames instead of the scene's own: a folder, a picture, a video file, a capture device's index, or
                the URL of a camera's stream.
            calibration: OpenCV calibration file instead of the scene's camera numbers, or ``exif``: by the EXIF of the
                first picture.
            light: Captured light instead of what a mirror ball shows: a latlong OpenEXR or Radiance HDR.
            light_axes: Axes of that file, ``z-up``, ``blender``, ``y-up`` or ``opengl``; None: as it says, else y-up of
                an OpenEXR and blender of an HDR.
            device: ``auto``, ``cpu`` or ``cuda:N``.
            quality: A preset's name, a value of one's own, or ``auto``: the least error within a budget.
            budget_ms: Milliseconds per frame for ``auto``; None means 33.
            outputs: What results shall hold: ``image``, ``environment``, ``pose``, layers of ``warp_ar.LAYERS``.
            loop: Start a clip again when it ends.
            refine_ball: Look for the mirror balls first, in the source's first frames, which takes some seconds; what
                was found is in ``ball_fits``.

        Raises:
            SceneError: The scene or the calibration cannot be used.
            SourceError: The source cannot be opened.
            UsageError: Any other argument cannot be used.
        """
        self.scene = _chosen_scene(scene, source, calibration, light, light_axes)
        if budget_ms is not None and quality != AUTO:
            raise UsageError(f"a budget of {budget_ms:g} ms needs the quality {AUTO!r}, not {quality!r}")
        shown = self.scene.source.shown if source is None and self.scene.source is not None else None
        self.source: Source = _open_source(self.scene, source, loop)
        self.pipeline: Pipeline | AutoPipeline
        self._switcher: PipelineSwitcher | None = None
        try:
            if refine_ball:
                self.scene, self.ball_fits = refine_balls(self.scene, self.source)
            size, exposures = self.source.size, self.source.exposures
            self.bracket_notes = plan_bracket(exposures, shown).notes
            given: dict[str, Any] = {"size": size, "outputs": outputs, "exposures": exposures, "shown": shown}
            if quality == AUTO:
                budget = DEFAULT_BUDGET_MS if budget_ms is None else budget_ms
                # A budget is kept by frames that do not wait, of recordings too.
                given["estimates"] = "real_time" if self.source.live else "delayed"
                self.pipeline = AutoPipeline(self.scene, budget_ms=budget, device=device, **given)
            else:
                self.pipeline = self._open(Target(self.scene, resolve_quality(quality), **given), device)
                if self.pipeline.device.is_cuda:
                    self.source.memory = self._new_frame
        except BaseException:
            self.source.close()
            raise

    def _open(self, target: Target, device: str) -> Pipeline:
        """A pipeline that can be changed; the one before is kept: results that were handed out may still be read."""
        self._target = target
        source = self.source
        linear = source.deep != "" and not target.exposures
        if source.deep == "light":
            check_linear(str(target.scene.camera.transfer))
        source.keeps_depth = linear
        self._switcher = PipelineSwitcher(
            device=device,
            keep=1,
            profile=False,
            estimates="real_time" if source.live else "synchronous",
            linear=linear,
        )
        return self._switcher.open(target)

    def _new_frame(self) -> npt.NDArray[np.uint8]:
        """Where the source writes a frame, so that it need not be copied to be sent."""
        assert isinstance(self.pipeline, Pipeline)
        return self.pipeline.new_frame()

    def close(self) -> None:
        """Let the source and the pipeline's threads go."""
        try:
            self.source.close()
        finally:
            if self._switcher is None:
                self.pipeline.close()
            else:
                self._switcher.close()

    def change(self, *, scene: Scene | None = None, quality: str | Quality | None = None) -> None:
        """Light the frames to come with another scene or quality; source, light and clock go on.

        What differs in numbers alone, such as where an object is, takes effect at once. For all else a pipeline is
        built, here and now; ``warp_ar.engine.switcher.PipelineSwitcher`` builds it beside the frames.

        Args:
            scene: What to show; None leaves it.
            quality: A preset's name or a value; None leaves it.

        Raises:
            UsageError: The session keeps to a budget, ``scene`` is no scene, or the quality is none or cannot run
                here. What is refused changes nothing: frames go on as they were.
            SceneError: The scene's camera does not fit the source, or a file that it names cannot be used.
        """
        if self._switcher is None:
            raise UsageError(f"a session of quality {AUTO!r} chooses for itself; open another one")
        if scene is not None and not isinstance(scene, Scene):
            raise UsageError(f"scene is {type(scene).__name__}; expected a Scene, such as load_scene returns")
        target = dataclasses.replace(
            self._target,
            scene=self._target.scene if scene is None else scene,
            quality=self._target.quality if quality is None else resolve_quality(quality),
        )
        pipeline = self._switcher.follow(target, wait=True)
        assert pipeline is not None
        self._target, self.scene, self.pipeline = target, target.scene, pipeline

    def warm_up(self, progress: Progress | None = None) -> None:
        """Compile and load what the frames need; left out, the first frame does it.

        Args:
            progress: Called with how many of how many modules are compiled, first with 0, if any must be.
        """
        self.pipeline.warm_up(progress)

    def _frames(self) -> Iterator[Frame]:
        """The source's frames; notes what they are waited for."""
        frames = iter(self.source)
        while True:
            start = time.perf_counter()
            frame = next(frames, None)
            self.decode_ms = (time.perf_counter() - start) * 1e3
            if frame is None:
                return
            yield frame

    def __iter__(self) -> Iterator[tuple[Frame, Result]]:
        pipeline, live = self.pipeline, self.source.live
        kept = pipeline.device.is_cpu or set(pipeline.plan.request.outputs) <= {"image", "pose"}
        called = live and pipeline.device.is_cpu  # which is to have no copy of the frame
        if not self.ahead or called or not kept or not isinstance(pipeline, Pipeline):
            for frame in self._frames():
                yield frame, self.pipeline(frame.deepest, time_seconds=frame.time, exposure_time=frame.exposure_time)
            return
        # One frame ahead of what is handed out: the next is decoded and its marker found while this one is rendered,
        # and reading a picture does not hold up the next frame. The first is handed out at once: somebody waits for it.
        # So is each of a camera's: they are submitted because the picture then comes into memory that it stays in.
        ready: list[tuple[Frame, Result]] = []
        ahead = 0
        try:
            for frame in self._frames():
                result = self.pipeline.submit(frame.deepest, time_seconds=frame.time, exposure_time=frame.exposure_time)
                ready.append((frame, result))
                if len(ready) > ahead:
                    yield ready.pop(0)
                ahead = 0 if live else 1
        except WarpArError:
            yield from ready
            raise
        yield from ready
