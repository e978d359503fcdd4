"""Lighting of the frames of a job: pipelines that are kept between jobs, and their inputs."""

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
from av.video.reformatter import VideoReformatter

from warp_ar.closing import Closing
from warp_ar.device import exclusive, resolve_device
from warp_ar.engine.pipeline import Pipeline
from warp_ar.engine.result import Result
from warp_ar.errors import UsageError
from warp_ar.farm.codes import DecodedPicture, DeviceVideo, LitPicture
from warp_ar.farm.frames import CONVERTERS, open_part
from warp_ar.farm.jobs import Job, JobFile, lit_range, scene_of, source_of
from warp_ar.farm.survey import Survey, keep_depth, lit_scene
from warp_ar.scene import Pose, Scene
from warp_ar.scene.kinds import skeleton
from warp_ar.sources.deep_frame import Plate
from warp_ar.sources.source import Frame, RecordedSource
from warp_ar.sources.video_file import rgb_from_video
from warp_ar.tracking.own_markers import own_markers

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
    coded: LitPicture | None = None
    """The picture for the encoder, where the device made its codes; None: it is ``image``."""
    kept: Image | None = None
    """The picture in RGB, where the device made its codes and RGB was asked for too."""

    @property
    def image(self) -> Image:
        """The picture, uint8 RGB (height, width, 3).

        Raises:
            UsageError: The device made its codes, and RGB was not asked for.
        """
        if self.coded is not None:
            if self.kept is None:
                raise UsageError("the picture's RGB stayed on the device; light with keep_rgb=True")
            return self.kept
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

    def __init__(
        self,
        jobs: JobFile,
        folder: Path,
        device: str,
        *,
        converters: int = CONVERTERS,
        device_converts: bool | None = None,
    ) -> None:
        """Light nothing yet.

        Args:
            jobs: The job file.
            folder: Of the run.
            device: ``cpu`` or ``cuda:N``.
            converters: Threads that turn decoded pictures into RGB.
            device_converts: Whether the device turns pictures of video into RGB and back; None: a GPU does.
        """
        self._device_converts = device != "cpu" if device_converts is None else device_converts
        self._jobs, self._folder, self._device, self._converters = jobs, folder, device, converters
        self._pipelines: collections.OrderedDict[Any, Pipeline] = collections.OrderedDict()
        self._videos: dict[tuple[int, int], DeviceVideo] = {}
        """By size of the pictures."""
        self._survey: tuple[int, Survey] | None = None
        self._key: tuple[int, int, Any] | None = None

    def close(self) -> None:
        """Let the pipelines' threads go."""
        for pipeline in self._pipelines.values():
            pipeline.close()
        self._pipelines.clear()
        self._videos.clear()

    def survey(self, clip: int) -> Survey:
        """Return the survey of a clip."""
        if self._survey is None or self._survey[0] != clip:
            self._survey = clip, Survey(self._folder / Job("survey", clip).place(self._jobs))
        return self._survey[1]

    def light(
        self,
        job: Job,
        scene: Scene | None = None,
        *,
        outputs: tuple[str, ...] = ("image",),
        every: int = 1,
        coded: bool = False,
        keep_rgb: bool = False,
    ) -> Iterator[Lit]:
        """Light the frames of a job; of pictures alone the next is begun before one is handed out.

        Args:
            job: A segment or a variation.
            scene: What to show; None: the clip's own scene.
            outputs: Outputs of the pipeline.
            every: One of so many frames is lit.
            coded: Whether the device may make the encoder's codes of pictures, where it has those of the recording:
                a ``Lit`` then has ``coded``, to be copied before the next but one is asked for.
            keep_rgb: Whether those have ``image`` as well.

        Raises:
            WarpArError: The recording or the scene cannot be used.
        """
        if coded and outputs == ("image",) and self._may_convert(job):
            frames = self._light_coded(job, scene, every, keep_rgb=keep_rgb)
        else:
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

    def _may_convert(self, job: Job) -> bool:
        """Return whether the device may convert a job's pictures.

        Not where light is gathered from them, or markers that something rides on are looked for: that is done with the
        host's picture.
        """
        follows = self._jobs.settings.light != "preroll"
        return self._device_converts and follows and not own_markers(scene_of(self._jobs, job.clip))

    def _light_coded(self, job: Job, scene: Scene | None, every: int, *, keep_rgb: bool) -> Iterator[Lit]:
        """As ``_light``, of pictures whose codes go to the device, and to the encoder from there."""
        survey = self.survey(job.clip)
        own = lit_scene(self._jobs, job.clip, survey) if scene is None else scene
        with contextlib.closing(self._open(job.clip, job.first, job.end, decoded=True)) as source:
            frames = iter(source)
            first = next(frames, None)
            video = None if first is None else self._video_for(first)
            if first is not None and video is not None:
                pipeline = self._pipeline_for(own, source.size, ("image",), follows=len(survey.keys) > 0, linear=False)
                pipeline.restart(saturation=survey.saturation)
                self._key = None
                for frame in itertools.chain([first], frames):
                    if not (frame.index - job.first) % every:
                        yield self._light_codes(frame, survey, job.clip, pipeline, video, keep_rgb=keep_rgb)
                return
        yield from self._light(job, scene, ("image",), every)

    def _light_codes(
        self, frame: Frame, survey: Survey, clip: int, pipeline: Pipeline, video: DeviceVideo, *, keep_rgb: bool
    ) -> Lit:
        decoded: Any = frame.image
        picture = video.send(decoded) if isinstance(decoded, DecodedPicture) else video.send_rgb(decoded)
        pose, result = survey.pose(frame.index), None
        if pose is not None:
            self._follow(pipeline, survey, clip, frame.index)
            result = pipeline(picture, time_seconds=frame.time, pose=pose)
            picture = result.image_array
        kept = None
        if keep_rgb:
            with exclusive(picture.device):
                kept = np.array(picture.numpy())
        return Lit(frame, pose, result, pipeline, video.fetch(picture), kept)

    def _video_for(self, first: Frame) -> DeviceVideo | None:
        """Return the converter of a job's pictures, by its first one; None: the host converts it otherwise."""
        decoded: Any = first.image
        if not isinstance(decoded, DecodedPicture):
            return None
        height, width, _ = decoded.shape
        video = self._video_of((width, height))
        return video if video.adapt(decoded, rgb_from_video(VideoReformatter(), decoded.picture)) else None

    def _video_of(self, size: tuple[int, int]) -> DeviceVideo:
        if size not in self._videos:
            self._videos[size] = DeviceVideo(size, resolve_device(self._device))
        return self._videos[size]

    def _open(self, clip: int, first: int, end: int, *, decoded: bool = False) -> RecordedSource:
        """Frames of a clip."""
        path, fps = source_of(self._jobs, clip)
        gpu, index = self._jobs.settings.gpu_of(self._device), self.survey(clip).index
        return open_part(path, index, first, end, fps, gpu, converters=self._converters, decoded=decoded)

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
