"""Lighting of a job's frames, with pipelines that are kept between jobs."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import gc
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_ar.closing import Closing
from warp_ar.engine.pipeline import Pipeline
from warp_ar.engine.result import Result
from warp_ar.farm.frames import open_part
from warp_ar.farm.jobs import Job, JobFile, lit_range, scene_of, source_of
from warp_ar.farm.survey import Survey, lit_scene
from warp_ar.scene import Pose, Scene
from warp_ar.scene.kinds import skeleton
from warp_ar.sources.deep_frame import DeepFrame
from warp_ar.sources.source import Frame, RecordedSource
from warp_ar.tracking.tracking import given_pose

PIPELINES = 4
"""Largest number of pipelines that are kept for scenes with different objects; each holds arrays of its own."""

Image = npt.NDArray[np.uint8]


@dataclasses.dataclass(frozen=True)
class Lit:
    """Frame with its pose and its result."""

    frame: Frame
    pose: Pose | None
    """Pose from the survey; None if the marker was lost, or if the pipeline tracks the marker itself."""
    result: Result | None
    """Result of the pipeline; None if the marker was lost, so that the frame is written without virtual objects."""
    pipeline: Pipeline
    """Pipeline that lit the frame."""

    @property
    def image(self) -> Image:
        """The picture, uint8 RGB (height, width, 3)."""
        return self.frame.image if self.result is None else self.result.image

    @property
    def radiance(self) -> npt.NDArray[np.float32]:
        """The picture as linear radiance, float32 RGB (height, width, 3); only if this output was requested."""
        if self.result is not None:
            return self.result.radiance
        deep = self.frame.deep
        wide = self.frame.image.astype(np.uint16) * np.uint16(257)
        return self.pipeline.inputs.radiance(DeepFrame(wide) if deep is None else deep)


class Lighter(Closing):
    """Lighting of a worker's segments and variations."""

    def __init__(self, jobs: JobFile, folder: Path, device: str) -> None:
        """Store the job file; pipelines are made when they are needed.

        Args:
            jobs: The job file.
            folder: Folder of the run.
            device: ``cpu`` or ``cuda:N``.
        """
        self._jobs, self._folder, self._device = jobs, folder, device
        self._pipelines: collections.OrderedDict[Any, Pipeline] = collections.OrderedDict()
        self._survey: tuple[int, Survey] | None = None

    def close(self) -> None:
        """End the pipelines' threads."""
        for pipeline in self._pipelines.values():
            pipeline.close()
        self._pipelines.clear()

    def survey(self, clip: int) -> Survey:
        """Return the survey of a clip."""
        if self._survey is None or self._survey[0] != clip:
            self._survey = clip, Survey(self._folder / Job("survey", clip).place(self._jobs))
        return self._survey[1]

    def light(
        self, job: Job, scene: Scene | None = None, *, outputs: tuple[str, ...] = ("image",), every: int = 1
    ) -> Iterator[Lit]:
        """Return the lit frames of a job.

        If only pictures are requested, a frame is yielded after the next one was begun, so that both overlap.

        Args:
            job: A segment or a variation.
            scene: Scene to show; None: the clip's own.
            outputs: Outputs of the pipeline.
            every: Interval of lit frames; 1 lights every frame.

        Raises:
            WarpArError: The recording or the scene cannot be used.
        """
        if self._jobs.settings.light == "preroll":
            frames = self._light_alone(job, outputs)
        else:
            frames = self._light_surveyed(job, scene, outputs, every)
        if outputs != ("image",):
            return frames
        return (lit for lit, _ in itertools.pairwise(itertools.chain(frames, (None,))) if lit is not None)

    def _light_surveyed(self, job: Job, scene: Scene | None, outputs: tuple[str, ...], every: int) -> Iterator[Lit]:
        """Yield frames that are lit with the poses and the light of their clip's survey."""
        survey = self.survey(job.clip)
        own = lit_scene(self._jobs, job.clip, survey) if scene is None else scene
        with contextlib.closing(self._open(job, job.first)) as source:
            follows = len(survey.keys) > 0
            pipeline = self._pipeline_for(own, source, outputs, follows=follows)
            pipeline.restart(saturation=survey.saturation)
            follows = follows and pipeline.scheduler.stage("captured") is not None
            last = None
            for frame in source:
                if (frame.index - job.first) % every:
                    continue
                pose, result = survey.pose(frame.index), None
                if pose is not None:
                    if follows and (key := survey.key_of(frame.index)) != last:
                        pipeline.take_light(*survey.light(key))
                        last = key
                    result = pipeline.submit(frame.deepest, time_seconds=frame.time, pose=pose)
                yield Lit(frame, pose, result, pipeline)

    def _light_alone(self, job: Job, outputs: tuple[str, ...]) -> Iterator[Lit]:
        """Yield the frames of a segment, lit by a pipeline that tracks the marker and captures the light itself.

        The pipeline begins ``preroll`` frames before the segment.
        """
        own = scene_of(self._jobs, job.clip)
        first, _ = lit_range(self._jobs.clips[job.clip], self.survey(job.clip).index.length)
        with (
            contextlib.closing(self._open(job, max(first, job.first - self._jobs.settings.preroll))) as source,
            Pipeline(own, **self._options(own, source, outputs)) as pipeline,
        ):
            pipeline.start_clock(0.0)
            for frame in source:
                pose = given_pose(own.pose, frame)
                result = pipeline.submit(frame.deepest, time_seconds=frame.time, pose=pose)
                if frame.index >= job.first:
                    yield Lit(frame, None, result, pipeline)

    def _open(self, job: Job, first: int) -> RecordedSource:
        """Return the frames of a job's clip from ``first`` to the job's end."""
        path, fps = source_of(self._jobs, job.clip)
        gpu = self._jobs.settings.gpu_of(self._device)
        return open_part(path, self.survey(job.clip).index, first, job.end, fps, gpu)

    def _options(self, scene: Scene, source: RecordedSource, outputs: tuple[str, ...]) -> dict[str, Any]:
        """Return arguments of ``Pipeline`` for a scene, the source of its frames, and outputs."""
        linear = source.keep_depth(str(scene.camera.transfer))
        own = {"device": self._device, "quality": self._jobs.settings.quality, "estimates": "synchronous"}
        return {**own, "size": source.size, "outputs": outputs, "linear": linear}

    def _pipeline_for(
        self, scene: Scene, source: RecordedSource, outputs: tuple[str, ...], *, follows: bool
    ) -> Pipeline:
        """Return a pipeline for a scene: an existing one if its scene differs only in numbers, else a new one.

        Args:
            scene: Scene to show.
            source: Source of the frames.
            outputs: Outputs of the pipeline.
            follows: True if each frame is lit with a map of the survey.
        """
        options = self._options(scene, source, outputs)
        key = skeleton(scene), source.size, outputs, follows, options["linear"]
        pipeline = self._pipelines.pop(key, None)
        if pipeline is not None:
            pipeline.change(scene)
        else:
            pipeline = Pipeline(scene, follows_camera=False, emitters=follows, **options)
        self._pipelines[key] = pipeline
        while len(self._pipelines) > PIPELINES:
            self._pipelines.popitem(last=False)[1].close()
            gc.collect()  # large arrays are part of reference cycles
        return pipeline
