"""A source and a pipeline that fit each other: the common case in one call."""

from __future__ import annotations

import dataclasses
import hashlib
import time
from collections.abc import Iterator
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
from warp_ar.errors import UsageError, WarpArError
from warp_ar.light.captured import Light
from warp_ar.light.card_light import light_by_card
from warp_ar.output.environment_file import write_environment
from warp_ar.scene import CapturedLight, Scene, load_calibration, load_scene
from warp_ar.scene.exif import camera_by_exif
from warp_ar.sources.deep_frame import check_linear
from warp_ar.sources.exposures import plan_bracket
from warp_ar.sources.sources import Frame, Source, open_scene_source
from warp_ar.stages.quality import AUTO, DEFAULT_BUDGET_MS, DEFAULT_PRESET, Quality
from warp_ar.tracking.markers import tell_upright
from warp_ar.tracking.tracking import given_pose, tell_missing_poses

BY_CARD = "card"
"""Word for light that the card and other surfaces tell of."""
CARD_FRAMES = 24
"""Frames in which the marker is looked for."""


def calibrated(scene: Scene, calibration: str | Path, source: str | int | Path | None = None) -> Scene:
    """Return the scene with its camera by a calibration file, or for ``exif`` by the source's first picture.

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


def lit_by_card(scene: Scene, source: Source) -> tuple[Scene, str]:
    """Return the scene lit by what its card and other surfaces show of the light, and a line that says how surely.

    Args:
        scene: The scene.
        source: Its frames; those of a device are gone afterwards.

    Raises:
        UsageError: The first frames do not show the marker well.
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
    """Return the scene with the camera and the light that are given instead of its own."""
    scene = scene if isinstance(scene, Scene) else load_scene(scene)
    if calibration is not None:
        scene = calibrated(scene, calibration, source)
    return scene if light is None else with_light(scene, light, light_axes)


class Session(Closing):
    """Opens a scene's source and lights its frames one after another.

    Iterating gives ``(frame, result)`` pairs. Use it in a ``with`` statement, so that devices and threads are let go.
    """

    ahead = True
    """True if frames may be begun before the one ahead of them is handed out, where that is possible."""
    decode_ms = 0.0
    """Milliseconds that the source took for its last frame."""
    ball_fits: tuple[BallFit | None, ...] = ()
    """Fits of the mirror balls by ``refine_ball``; None for one that it did not find."""
    notes: tuple[str, ...] = ()
    """Exposures that are not merged, frames without a pose, upright of a marker: a line each."""

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
        """Open everything.

        Args:
            scene: A scene, a scene file or a bundled scene's name.
            source: Frames instead of the scene's own: a folder, a picture, a video file, a capture device's index, or
                the URL of a camera's stream.
            calibration: OpenCV calibration file instead of the scene's camera numbers, or ``exif``: by the EXIF of the
                first picture.
            light: Captured light instead of what a mirror ball shows: a latlong OpenEXR or Radiance HDR. Or ``card``:
                what the card and other surfaces of the first frame tell of it, to second order (``notes`` has the
                interval).
            light_axes: Axes of that file, ``z-up``, ``blender``, ``y-up`` or ``opengl``; None: as it says, else y-up of
                an OpenEXR and blender of an HDR.
            device: ``auto``, ``cpu`` or ``cuda:N``.
            quality: A preset's name, a value of one's own, or ``auto``: the least error within a budget.
            budget_ms: Milliseconds per frame for ``auto``; None means 33.
            outputs: Parts of the results: ``image``, ``environment``, ``pose``, layers of ``warp_ar.LAYERS``.
            loop: Start a clip again when it ends.
            refine_ball: Look for the mirror balls first, in the source's first frames, which takes some seconds; what
                was found is in ``ball_fits``.

        Raises:
            SceneError: The scene or the calibration cannot be used.
            SourceError: The source cannot be opened.
            UsageError: Any other argument cannot be used.
        """
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
                # A budget is kept by frames that do not wait, of recordings too.
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
        """Open the pipeline of a fixed quality."""
        source = self.source
        linear = source.deep != "" and not given["exposures"]
        if source.deep == "light":
            check_linear(str(scene.camera.transfer))
        source.keeps_depth = linear
        return Pipeline(scene, estimates="real_time" if source.live else "synchronous", linear=linear, **given)

    @property
    def scene(self) -> Scene:
        """Scene that frames are lit by."""
        return self.pipeline.scene

    def _new_frame(self) -> npt.NDArray[np.uint8]:
        """Return memory in which the source writes a frame, so that it need not be copied to be sent."""
        assert isinstance(self.pipeline, Pipeline)
        return self.pipeline.new_frame()

    def close(self) -> None:
        """Let the source and the pipeline's threads go."""
        try:
            self.source.close()
        finally:
            self.pipeline.close()

    def change(self, *, scene: Scene | None = None, quality: str | Quality | None = None) -> None:
        """Light the frames to come with another scene or quality, as ``Pipeline.change`` does; the source goes on.

        Args:
            scene: The next scene; None leaves it.
            quality: A preset's name or a value; None leaves it.

        Raises:
            UsageError: The session keeps to a budget, or as ``Pipeline.change``.
            SceneError: As ``Pipeline.change``.
        """
        if not isinstance(self.pipeline, Pipeline):
            raise UsageError(f"a session of quality {AUTO!r} chooses for itself; open another one")
        self.pipeline.change(scene, quality=quality)

    def warm_up(self, progress: Progress | None = None) -> None:
        """Compile and load what the frames need; left out, the first frame does it.

        Args:
            progress: Called with how many of how many modules are compiled, first with 0, if any must be.
        """
        self.pipeline.warm_up(progress)

    def _frames(self) -> Iterator[Frame]:
        """Yield the source's frames, and note the time that each was waited for."""
        frames = iter(self.source)
        while True:
            start = time.perf_counter()
            frame = next(frames, None)
            self.decode_ms = (time.perf_counter() - start) * 1e3
            if frame is None:
                return
            yield frame

    def _known_of(self, frame: Frame) -> dict[str, Any]:
        """Return the arguments of a pipeline's call besides the picture."""
        pose = given_pose(self.pipeline.scene.pose, frame)
        return {"time_seconds": frame.time, "exposure_time": frame.exposure_time, "pose": pose}

    def __iter__(self) -> Iterator[tuple[Frame, Result]]:
        pipeline, live = self.pipeline, self.source.live
        on_cpu = pipeline.device.is_cpu
        kept = on_cpu or set(pipeline.plan.request.outputs) <= {"image", "pose"}
        called = live and on_cpu  # which is to have no copy of the frame
        if not self.ahead or called or not kept or not isinstance(pipeline, Pipeline):
            for frame in self._frames():
                yield frame, self.pipeline(frame.deepest, **self._known_of(frame))
            return
        # One frame ahead of what is handed out: the next is decoded and its marker found while this one is rendered,
        # and reading a picture does not hold up the next frame. The first is handed out at once: somebody waits for it.
        # So is each of a camera's: they are submitted because the picture then comes into memory that it stays in.
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
