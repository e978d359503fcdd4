"""Frames per second of whole frames, and the time of every stage.

On CPU, stages are timed by the processor time of one thread, on which other programs have little effect; frames per
second are elapsed time. On CUDA, stages are timed by events on the device, and a whole frame is one captured graph.
"""

from __future__ import annotations

import collections
import dataclasses
import functools
import itertools
import os
import statistics
import time
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import warp as wp

from bench.common import measure, report
from warp_ar.engine.pipeline import Pipeline
from warp_ar.scene import Pose, Scene, load_scene
from warp_ar.sources.sources import open_source
from warp_ar.stages.quality import PRESETS, Quality
from warp_ar.tracking.tracking import Tracker

CLIP_FRAMES = 48
"""Number of frames of a clip, which is repeated."""
WARM_UP = 6
"""Number of frames before the measured ones."""
STREAM_FRAMES = {"": 300, ", fast camera": 3000}
"""Number of frames of a stream, with the clip's times and with those of a camera of 1,000 frames per second. The first
estimates of light are the most expensive; the fast camera's stream is long enough to contain later ones."""
SETTLED_FRAMES = 1000
"""Number of last frames of a stream, for which frames per second are stated separately."""
STEPS_EVERY = 10
"""Stride of the frames of a stream whose steps are timed, because reading the times takes a third of a millisecond."""
WRITTEN = 12
"""Number of frames in pinned memory, from which they are sent without a copy."""
SIZES = {"480p": (640, 480), "1080p": (1920, 1080), "4K": (3840, 2160)}
QUALITIES = {
    "medium": PRESETS["medium"],
    "high": PRESETS["high"],
}


@dataclasses.dataclass(frozen=True)
class Clip:
    """Frames of a scene at one size, with their poses."""

    scene: Scene
    images: list[np.ndarray]
    poses: list[Pose]


@functools.cache
def clip(name: str, size: tuple[int, int], count: int = CLIP_FRAMES) -> Clip:
    """Return the first frames of a bundled scene, enlarged to a size; the sides of a wider picture are mirrored."""
    scene = load_scene(name)
    camera = scene.camera
    with open_source(scene.source.path) as source:
        images = [frame.image.copy() for frame in itertools.islice(source, count)]
    tracker = Tracker(scene.marker, camera)
    poses = [tracker.track(image, index / 24.0).pose for index, image in enumerate(images)]
    if size != (camera.width, camera.height):
        scale = size[1] / camera.height
        inner = (round(camera.width * scale), size[1])
        side = (size[0] - inner[0]) // 2
        images = [
            cv2.copyMakeBorder(cv2.resize(image, inner), 0, 0, side, side, cv2.BORDER_REFLECT) for image in images
        ]
        scaled = camera.scaled_to(*inner)
        scene = dataclasses.replace(scene, camera=dataclasses.replace(scaled, width=size[0], cx=scaled.cx + side))
    return Clip(scene, images, poses)


def measure_stages(pipeline: Pipeline, frames: Clip, count: int) -> dict[str, list[float]]:
    """Return the milliseconds of each stage in every frame after the warm-up; processor time of one thread on CPU."""
    scheduler = pipeline._scheduler
    if pipeline.device.is_cpu:
        scheduler.clock = time.thread_time
    times: dict[str, list[float]] = collections.defaultdict(list)
    for index in range(WARM_UP + count):
        at = index % len(frames.images)
        result = pipeline(frames.images[at], time_seconds=index / 24.0, pose=frames.poses[at])
        for name, timing in result.stages.items():
            if index >= WARM_UP and not timing.skipped:
                times[name].append(timing.milliseconds)
    return times


def bench_stages(label: str, frames: Clip, device: str, quality: Quality, count: int) -> None:
    """Print one line per stage, and one with the sum of their medians."""
    bands = 1 if device == "cpu" else None
    with Pipeline(frames.scene, device=device, quality=quality, bands=bands, profile=True) as pipeline:
        times = measure_stages(pipeline, frames, count)
    for name, values in times.items():
        report(f"stage {label} {name}", values, device)
    report(f"stages {label} sum", [sum(statistics.median(values) for values in times.values())], device)


def bench_graph(label: str, frames: Clip, device: str, quality: Quality, count: int) -> None:
    """Print the device time of a whole frame as one graph, and frames per second with transfers in both directions."""
    poses, images = frames.poses, frames.images
    with Pipeline(frames.scene, device=device, quality=quality) as pipeline:
        for index in range(WARM_UP):
            pipeline(images[index], time_seconds=index / 24.0, pose=poses[index])
        scheduler, arrays = pipeline._scheduler, pipeline.arrays
        stream = wp.get_stream(device)
        begin, end = wp.Event(device, enable_timing=True), wp.Event(device, enable_timing=True)
        times = []
        for _ in range(count):
            for name in ("frame", "pose", "clock"):
                arrays.touch(name)
            stream.record_event(begin)
            scheduler.run()
            stream.record_event(end)
            times.append(wp.get_event_elapsed_time(begin, end))
        report(f"graph {label}", times, device)

        # Streams have the clip's times, or those of a fast camera, because the recovery of light depends on time.
        seconds = WARM_UP / 24.0
        for clock, step in (("", 1.0 / 24.0), (", fast camera", 1.0e-3)):
            bench_stream(f"{label}{clock}", pipeline, frames, seconds, step, STREAM_FRAMES[clock])
            seconds += step * STREAM_FRAMES[clock]

        staging = wp.zeros(images[0].shape[:2], dtype=wp.vec3ub, device="cpu", pinned=True)
        target = arrays["image"]
        copies = {"upload": lambda: wp.copy(target, staging), "download": lambda: wp.copy(staging, target)}
        for name, values in measure(copies, device).items():
            report(f"bus {label} {name}", values, device)

    # With a live camera, no frame waits for an estimate of the light.
    with Pipeline(frames.scene, device=device, quality=quality, estimates="real_time") as pipeline:
        for index in range(WARM_UP):
            pipeline(images[index], time_seconds=index * 1e-3, pose=poses[index])
        bench_stream(f"{label}, live camera", pipeline, frames, 0.01, 1.0e-3, 3000)
        there = written_there(pipeline, frames)
        bench_stream(f"{label}, live camera, frames in pinned memory", pipeline, there, 4.0, 1.0e-3, 3000)


def written_there(pipeline: Pipeline, frames: Clip) -> Clip:
    """Return a few frames, forward and backward, in arrays of ``Pipeline.new_frame``, as a source would write them."""
    images = []
    for image in frames.images[:WRITTEN]:
        images.append(pipeline.new_frame())
        images[-1][...] = image
    return Clip(frames.scene, images + images[-2:0:-1], frames.poses[:WRITTEN] + frames.poses[WRITTEN - 2 : 0 : -1])


def bench_stream(label: str, pipeline: Pipeline, frames: Clip, seconds: float, step: float, count: int) -> None:
    """Print the frames per second of a stream with transfers in both directions.

    Args:
        label: Name of the case.
        pipeline: Pipeline that has lit a few frames.
        frames: Frames, which are repeated.
        seconds: Time before the first frame, on the camera's clock.
        step: Seconds between frames, on the camera's clock.
        count: Number of frames.
    """
    waiting: collections.deque[Any] = collections.deque()
    submitting, each = [], []
    steps: dict[str, list[float]] = collections.defaultdict(list)
    busy, last = time.process_time(), time.perf_counter()
    for index in range(count):
        at = index % len(frames.images)
        start = time.perf_counter()
        given = {"time_seconds": seconds + (index + 1) * step, "pose": frames.poses[at]}
        waiting.append(pipeline.submit(frames.images[at], **given))
        submitting.append((time.perf_counter() - start) * 1e3)
        if len(waiting) > 2:
            result = waiting.popleft()
            _ = result.image
            if not index % STEPS_EVERY:
                for name, milliseconds in result.steps.items():
                    steps[name].append(milliseconds)
        now = time.perf_counter()
        each.append((now - last) * 1e3)
        last = now
    while waiting:
        _ = waiting.popleft().image
    more = {f"{name}_ms": round(statistics.median(values), 4) for name, values in steps.items()}
    rates = {
        "fps": 1e3 / statistics.mean(each[5:]),
        "fps_median": 1e3 / statistics.median(each[5:]),
        "fps_settled": 1e3 / statistics.mean(each[-SETTLED_FRAMES:]),
    }
    more |= {name: round(rate, 1) for name, rate in rates.items()}
    more["p99_ms"] = round(float(np.percentile(each[5:], 99)), 4)
    more["submit_ms"] = round(statistics.median(submitting), 4)
    more["processor_ms"] = round((time.process_time() - busy) * 1e3 / count, 4)
    report(f"stream {label}", each[5:], pipeline.device, **more)


def stream_frames(pipeline: Pipeline, frames: Clip, count: int) -> Iterator[tuple[float, float]]:
    """Light frames as a stream: each is submitted before the picture of the one before it is read.

    Yields:
        Elapsed time and processor time of each frame, milliseconds.
    """
    before = None
    for index in range(count):
        begin, spent = time.perf_counter(), time.process_time()
        result = pipeline.submit(frames.images[index % len(frames.images)], time_seconds=index / 24.0)
        if before is not None:
            _ = before.image
        before = result
        yield (time.perf_counter() - begin) * 1e3, (time.process_time() - spent) * 1e3


def bench_cpu_frames(label: str, frames: Clip, quality: Quality, count: int) -> None:
    """Print the frames per second on CPU, with tracking, without decoding and encoding."""
    with Pipeline(frames.scene, device="cpu", quality=quality) as pipeline:
        times = list(stream_frames(pipeline, frames, WARM_UP + count))[WARM_UP:]
    wall, cpu = (list(part) for part in zip(*times, strict=True))
    fps = 1e3 / statistics.median(wall)
    load = round(os.getloadavg()[0], 1)
    report(f"frame {label}", wall, "cpu", fps=round(fps, 1), processor_ms=round(statistics.median(cpu), 2), load=load)


def main(device: str) -> None:
    """Run all parts (``frame``, ``graph``, ``stages``), or those that ``WARP_AR_BENCH`` names, separated by commas."""
    parts = set(filter(None, os.environ.get("WARP_AR_BENCH", "").split(",")))

    def wanted(part: str) -> bool:
        return not parts or part in parts

    if wp.get_device(device).is_cpu:
        frames = clip("desk", SIZES["480p"])
        if wanted("frame"):
            bench_cpu_frames("480p medium", frames, PRESETS["medium"], 60)
        if wanted("stages"):
            bench_stages("480p medium", frames, device, PRESETS["medium"], 40)
    else:
        for size in SIZES:
            frames = clip("desk", SIZES[size])
            for name, quality in QUALITIES.items():
                label = f"{size} {name}"
                if name == "high" and size != "1080p":
                    continue
                if wanted("graph"):
                    bench_graph(label, frames, device, quality, 300)
                if wanted("stages"):
                    bench_stages(label, frames, device, quality, 200)
