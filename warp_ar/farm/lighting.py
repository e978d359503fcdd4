"""How a worker lights the frames of a job: pipelines that are kept between jobs, and what they are given."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import gc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_ar.closing import Closing
from warp_ar.engine.pipeline import Pipeline
from warp_ar.engine.result import Result
from warp_ar.farm.frames import CONVERTERS, open_part
from warp_ar.farm.jobs import Job, JobFile, lit_range, scene_of, source_of
from warp_ar.farm.survey import Survey, keep_depth, lit_scene
from warp_ar.input.plate import Plate
from warp_ar.input.source import Frame, RecordedSource
from warp_ar.scene import Pose, Scene
from warp_ar.scene.kinds import skeleton

PIPELINES = 4
"""Pipelines that are kept for scenes of other objects: each holds its arrays."""

Image = npt.NDArray[np.uint8]


@dataclasses.dataclass(frozen=True)
class Lit:
    """A frame and what became of it."""

    frame: Frame
    pose: Pose | None
    """None where the marker was lost: the picture passes as it came."""
    result: Result | None
    """None where the marker was lost."""
    pipeline: Pipeline

    @property
    def image(self) -> Image:
        """The picture, uint8 RGB (height, width, 3)."""
        return self.frame.image if self.result is None else self.result.image

    @property
    def radiance(self) -> npt.NDArray[np.float32]:
        """The picture as linear radiance, float32 RGB (height, width, 3); where ``light`` was asked for it."""
        if self.result is not None:
            return self.result.radiance
        plate = self.frame.plate
        wide = self.frame.image.astype(np.uint16) * np.uint16(257)
        return self.pipeline.inputs.radiance(Plate(wide) if plate is None else plate)


class Lighter(Closing):
    """Lights segments and variations; one for each worker."""

    def __init__(self, jobs: JobFile, folder: Path, device: str, *, converters: int = CONVERTERS) -> None:
        """Light nothing yet.

        Args:
            jobs: The job file.
            folder: Of the run.
            device: ``cpu`` or ``cuda:N``.
            converters: Threads that turn decoded pictures into RGB.
        """
        self._jobs, self._folder, self._device, self._converters = jobs, folder, device, converters
        self._pipelines: collections.OrderedDict[Any, Pipeline] = collections.OrderedDict()
        self._survey: tuple[int, Survey] | None = None
        self._key: tuple[int, int, Any] | None = None

    def close(self) -> None:
        """Let the pipelines' threads go."""
        for pipeline in self._pipelines.values():
            pipeline.close()
        self._pipelines.clear()

    def survey(self, clip: int) -> Survey:
        """What the survey of a clip found."""
        if self._survey is None or self._survey[0] != clip:
            self._survey = clip, Survey(self._folder / Job("survey", clip).place(self._jobs))
        return self._survey[1]

    def light(
        self, job: Job, scene: Scene | None = None, *, outputs: tuple[str, ...] = ("image",), every: int = 1
    ) -> Iterator[Lit]:
        """Light the frames of a job; of pictures alone the next is begun before one is handed out.

        Args:
            job: A segment or a variation.
            scene: What to show; None: the clip's own scene.
            outputs: Outputs of the pipeline.
            every: One of so many frames is lit.

        Raises:
            WarpArError: The recording or the scene cannot be used.
        """
        frames = self._light(job, scene, outputs, every)
        if outputs != ("image",):
            yield from frames
            return
        before = next(frames, None)
        for lit in frames:
            assert before is not None
            yield before
            before = lit
        if before is not None:
            yield before

    def _light(self, job: Job, scene: Scene | None, outputs: tuple[str, ...], every: int) -> Iterator[Lit]:
        """As ``light``, each frame as soon as it is handed over."""
        survey = self.survey(job.clip)
        if self._jobs.settings.light == "preroll":
            yield from self._light_alone(job, survey, outputs)
            return
        own = lit_scene(self._jobs, job.clip, survey) if scene is None else scene
        with contextlib.closing(self._open(job.clip, job.first, job.end)) as source:
            linear = keep_depth(source, own)
            pipeline = self._pipeline_for(own, source.size, outputs, follows=len(survey.keys) > 0, linear=linear)
            pipeline.restart(saturation=survey.saturation)
            self._key = None
            for frame in source:
                if (frame.index - job.first) % every:
                    continue
                pose = survey.pose(frame.index)
                if pose is None:
                    yield Lit(frame, None, None, pipeline)
                    continue
                self._follow(pipeline, survey, job.clip, frame.index)
                call = pipeline.submit if outputs == ("image",) else pipeline
                yield Lit(frame, pose, call(frame.deepest, time_seconds=frame.time, pose=pose), pipeline)

    def _open(self, clip: int, first: int, end: int) -> RecordedSource:
        """Frames of a clip."""
        path, fps = source_of(self._jobs, clip)
        gpu = self._jobs.settings.gpu_of(self._device)
        return open_part(path, self.survey(clip).index, first, end, fps, gpu, converters=self._converters)

    def _follow(self, pipeline: Pipeline, survey: Survey, clip: int, frame: int) -> None:
        """Give a pipeline the light that holds for a frame."""
        if not len(survey.keys) or pipeline.scheduler.stage("captured") is None:
            return
        key = survey.key_of(frame)
        if self._key != (clip, key, pipeline):
            self._key = clip, key, pipeline
            pipeline.take_light(*survey.light(key))

    def _pipeline_for(
        self, scene: Scene, size: tuple[int, int], outputs: tuple[str, ...], *, follows: bool, linear: bool
    ) -> Pipeline:
        """A pipeline for a scene, one that is there where only numbers differ.

        Args:
            scene: What to show.
            size: Of the frames, width and height.
            outputs: Of the pipeline.
            follows: Whether it is lit by what a survey found.
            linear: Whether frames have more than 8 bits.
        """
        key = skeleton(scene), size, outputs, follows, linear
        pipeline = self._pipelines.pop(key, None)
        if pipeline is not None and not pipeline.update(scene):
            pipeline.close()
            pipeline = None
        if pipeline is None:
            pipeline = Pipeline(
                scene,
                device=self._device,
                quality=self._jobs.settings.quality,
                size=size,
                outputs=outputs,
                estimates="synchronous",
                follows_camera=False,
                emitters=follows,
                linear=linear,
            )
        self._pipelines[key] = pipeline
        while len(self._pipelines) > PIPELINES:
            self._pipelines.popitem(last=False)[1].close()
            gc.collect()  # its arrays are part of cycles, and large
        return pipeline

    def _light_alone(self, job: Job, survey: Survey, outputs: tuple[str, ...]) -> Iterator[Lit]:
        """Light a segment that gathers its own light and track from the frames before it on."""
        scene = scene_of(self._jobs, job.clip)
        first, _ = lit_range(self._jobs.clips[job.clip], survey.index.length)
        begin = max(first, job.first - self._jobs.settings.preroll)
        with contextlib.closing(self._open(job.clip, begin, job.end)) as source:
            linear = keep_depth(source, scene)
            pipeline = Pipeline(
                scene,
                device=self._device,
                quality=self._jobs.settings.quality,
                size=source.size,
                outputs=outputs,
                estimates="synchronous",
                linear=linear,
            )
            with pipeline:
                pipeline.start_clock(0.0)
                for frame in source:
                    given = None if scene.pose is None else Pose(*scene.pose.at(frame.index))
                    call = pipeline.submit if outputs == ("image",) else pipeline
                    result = call(frame.deepest, time_seconds=frame.time, pose=given)
                    if frame.index >= job.first:
                        yield Lit(frame, result.pose, result, pipeline)
