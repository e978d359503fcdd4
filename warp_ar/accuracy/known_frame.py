"""Frame of a scene with the pose, the light and the picture that a pipeline found for it."""

from __future__ import annotations

import dataclasses
import functools
import logging
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_ar.accuracy.light_places import place_emitters
from warp_ar.accuracy.path_tracer import Image, PathTracer
from warp_ar.device import exclusive
from warp_ar.engine.pipeline import Pipeline
from warp_ar.engine.result import Result
from warp_ar.errors import SourceError, UsageError
from warp_ar.light.captured import CapturedEmitter, Light, texel_solid_angles
from warp_ar.scene import Exposure, Pose, Scene
from warp_ar.sources.sources import open_scene_source
from warp_ar.stages.quality import Quality
from warp_ar.tracking.tracking import given_pose

_LOG = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class KnownFrame:
    """Frame, with the pipeline's pose, light and picture."""

    scene: Scene
    """Scene with its camera scaled to the frame's size."""
    image: Image
    """The camera's picture."""
    lit: Image
    """The pipeline's picture."""
    pose: Pose
    """``camera_from_world``."""
    light: Light
    """Light of the environment; emitters of known distance are in ``Light.emitters``."""
    seconds: float
    """Seconds since the first frame."""
    milliseconds: float
    """Total time of the frame's stages."""
    balls: int = 1
    """Number of mirror balls between which the pipeline interpolates light; ``light`` is that at the first one."""

    def tracer(self, **options: Any) -> PathTracer:
        """Return a path tracer of this frame; the arguments are those of ``PathTracer``."""
        if self.balls > 1:
            _tell_first(self.scene.name, self.balls)
        return PathTracer(self.scene, self.light, self.image, self.pose, seconds=self.seconds, **options)

    def placed(self, *, device: str = "auto") -> KnownFrame:
        """Return this frame with estimated distances of its light's emitters, or unchanged if a distance was known.

        Raises:
            UsageError: The scene has no mirror ball, or the frame does not show a proxy sufficiently.
        """
        light = place_emitters(self.light, self.scene, self.image, self.pose, device=device, seconds=self.seconds)
        return dataclasses.replace(self, light=light)


@functools.cache
def _tell_first(scene: str, balls: int) -> None:
    """Log once that a path-traced reference uses only the light at the first ball."""
    _LOG.warning(
        "%s: the path tracer's light is that of the first of %d mirror balls, everywhere; the pipeline's is "
        "interpolated between them, so the two differ away from the first",
        scene,
        balls,
    )


def light_up_to(
    scene: Scene,
    number: int,
    *,
    quality: str | Quality,
    device: str = "auto",
    source: str | int | Path | None = None,
) -> KnownFrame:
    """Light a scene's frames by a pipeline up to frame ``number``, and return that frame.

    Args:
        scene: Scene to light.
        number: Index of the frame.
        quality: Quality of the pipeline, which determines the accuracy of the light.
        device: ``auto``, ``cpu`` or ``cuda:N``.
        source: Frames to use in place of the scene's own.

    Raises:
        SceneError: The scene cannot be used.
        SourceError: The source ends before the frame, or the frame cannot be path-traced.
        UsageError: Any other argument cannot be used.
    """
    if number < 0:
        raise UsageError(f"--frame {number}: expected 0 or more")
    shown = scene.source.shown if scene.source is not None and source is None else None
    with (
        open_scene_source(scene, source, loop=False) as frames,
        Pipeline(
            scene,
            device=device,
            quality=quality,
            size=frames.size,
            outputs=("image", "environment", "pose"),
            exposures=frames.exposures,
            shown=shown,
            estimates="synchronous",
        ) as pipeline,
    ):
        first: float | None = None
        for frame in frames:
            first = frame.time if first is None else first
            known = {"time_seconds": frame.time, "exposure_time": frame.exposure_time}
            result = pipeline(frame.image, **known, pose=given_pose(scene.pose, frame))
            if frame.index < number:
                continue
            where = f"frame {number} of {frames.description}"
            if not result.shown:
                raise SourceError(f"{where} has another exposure than the shown frames; choose one of those")
            if result.pose is None:
                raise SourceError(f"{where} shows no marker, so objects' places are unknown; choose another frame")
            return known_frame(pipeline, frame.image, result, frame.time - first)
    raise SourceError(f"{frames.description} has no frame {number}; it ends before")


def known_frame(pipeline: Pipeline, image: Image, result: Result, seconds: float) -> KnownFrame:
    """Return the data that a path tracer needs of a frame.

    Args:
        pipeline: Pipeline that has just lit the frame.
        image: The frame, uint8 RGB.
        result: Result of the pipeline, with a pose.
        seconds: Seconds since the first frame.
    """
    assert result.pose is not None
    others = pipeline.plan.features.others
    with exclusive(pipeline.device):
        scene, light = exposed_scene(pipeline), light_of(pipeline)
    milliseconds = sum(timing.milliseconds for timing in result.stages.values())
    return KnownFrame(scene, image.copy(), result.image, result.pose, light, seconds, milliseconds, others + 1)


def exposed_scene(pipeline: Pipeline) -> Scene:
    """Return the pipeline's scene, with an automatic exposure replaced by its value in the last frame."""
    scale = pipeline.arrays.get("expose_scale")
    if scale is None:
        return pipeline.scene
    return dataclasses.replace(pipeline.scene, exposure=Exposure(float(scale.numpy()[0])))


def light_of(pipeline: Pipeline) -> Light:
    """Return the pipeline's light of the last frame; black if the scene needs none."""
    arrays = pipeline.arrays
    radiance: npt.NDArray[np.float32] = np.zeros((2, 4, 3), np.float32)
    if arrays.get("environment") is not None:
        radiance = np.array(arrays["environment"].numpy())
    emitters = []
    if arrays.get("emitters") is not None:
        for record in arrays["emitters"].numpy():
            distance = float(record["distance"])
            if distance > 0.0:
                emitters.append(_emitter(record, distance if np.isfinite(distance) else None, len(radiance)))
    return Light(radiance, np.ones(radiance.shape[:2], np.float32), tuple(emitters))


def _triple(values: npt.NDArray[np.float32]) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z


def _emitter(record: np.void, distance: float | None, height: int) -> CapturedEmitter:
    """Return an emitter with the solid angle of one texel.

    Args:
        record: The pipeline's record of the emitter.
        distance: Its distance in metres; None if it is infinite.
        height: Rows of the environment map.
    """
    direction, origin, power = (_triple(record[name]) for name in ("direction", "origin", "power"))
    size = float(texel_solid_angles(height)[height // 2, 0])
    return CapturedEmitter(direction, size, power, power, None, distance, origin)
