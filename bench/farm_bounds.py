"""What a frame costs in each step of a worker of the farm, alone and on one stream."""

from __future__ import annotations

import contextlib
import itertools
import shutil
import statistics
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import av
import numpy as np
import warp as wp
from av.codec.hwaccel import HWAccel
from av.video.reformatter import VideoReformatter

from bench.farm_bench import Bench
from bench.farm_clip import surveyed, write_clips
from bench.farm_recordings import RATE, TICK
from warp_ar.device import usable_cores
from warp_ar.engine.pipeline import Pipeline
from warp_ar.farm.frames import index_frames, open_part
from warp_ar.farm.jobs import Job, parse_jobs, read_jobs
from warp_ar.farm.lighting import Lighter, Lit
from warp_ar.farm.lit_picture import LitPicture
from warp_ar.farm.part_video import PartSink
from warp_ar.farm.records import Context
from warp_ar.farm.work import Work
from warp_ar.scene import load_scene
from warp_ar.sources.sources import open_source
from warp_ar.sources.video_file import rgb_from_video
from warp_ar.tracking.tracking import Tracker

FRAMES = {"cpu": 12, "cuda": 96}
WARM = 3


def _timed(frames: Iterable[Any], limit: int) -> tuple[float, float]:
    """Milliseconds of an item of an iteration, by the clock and of all threads, after some to warm up."""
    iterator = iter(frames)
    for _ in itertools.islice(iterator, WARM):
        pass
    start, spent, count = time.perf_counter(), time.process_time(), 0
    for _ in itertools.islice(iterator, limit):
        count += 1
    wall, busy = time.perf_counter() - start, time.process_time() - spent
    return 1e3 * wall / max(count, 1), 1e3 * busy / max(count, 1)


def measure_worker(bench: Bench) -> None:
    """Milliseconds of a whole worker's frame, by the clock and of all its threads: ``bench.costs``."""
    if "worker" in bench.costs:
        return
    source, count = surveyed(bench), FRAMES[bench.device]
    jobs = parse_jobs(read_jobs(write_clips(bench, "bounds.toml", 1, count)), "bounds.toml")
    folder = bench.folder / "bounds"
    shutil.copytree(source / "clips", folder / "clips")
    device = bench.one_device
    with Work(Context(jobs, folder, device)) as worker:
        for number in (0, 1):  # the first loads kernels and allocates
            job = Job("segment", 0, number, number * count, (number + 1) * count)
            start, spent = time.perf_counter(), time.process_time()
            outcome = worker.do(job, lambda _: None)
            wall, busy = time.perf_counter() - start, time.process_time() - spent
            if outcome.state != "done":
                raise RuntimeError(outcome.reason)
            if not number:
                bench.say(f"a worker's first job took {wall:.1f} s")
    bench.costs |= {"worker": 1e3 * wall / count, "worker_processor": 1e3 * busy / count}
    shutil.rmtree(folder)


def run_bounds(bench: Bench) -> None:
    """Every step alone, then a whole worker."""
    surveyed(bench)
    video, limit = bench.folder / "desk.mp4", FRAMES[bench.device]
    steps: dict[str, tuple[float, float]] = {}

    with av.open(str(video)) as container:
        container.streams.video[0].thread_type = "AUTO"
        steps["decode"] = _timed(container.decode(video=0), limit)
    with open_source(video) as source:
        steps["decode and convert to RGB"] = _timed(source, limit)
        images = [frame.image for frame in itertools.islice(source, limit + WARM)]
    if bench.device != "cpu":
        _decode_by_unit(bench, video, images, steps)
    reformatter = VideoReformatter()
    with av.open(str(video)) as container:
        pictures = list(itertools.islice(container.decode(video=0), limit + WARM))
    steps["convert to RGB"] = _timed((rgb_from_video(reformatter, picture) for picture in pictures), limit)
    steps["encode codes"] = _encode(bench.folder / "encoded.mp4", [_codes_of(picture) for picture in pictures], limit)
    del pictures
    scene = load_scene(bench.folder / "desk.toml")
    tracker = Tracker(scene.marker, scene.camera)
    steps["track"] = _timed((tracker.track(image, n / RATE) for n, image in enumerate(images)), limit)
    steps["convert to YUV and encode"] = _encode(bench.folder / "encoded.mp4", images, limit)
    steps["copy"] = _timed((image.copy() for image in images), limit)
    bench.say("steps on the host are measured")
    kernels = _light(bench, steps, limit)
    measure_worker(bench)
    steps["worker"] = bench.costs["worker"], bench.costs["worker_processor"]
    alone = {name: wall for name, (wall, _) in steps.items() if name not in ("worker", "light")}
    bench.tell(
        "bounds",
        milliseconds={name: round(wall, 3) for name, (wall, _) in steps.items()},
        processor_milliseconds={name: round(busy, 3) for name, (_, busy) in steps.items()},
        kernels_ms=kernels,
        slowest_step_on_host=max(alone, key=lambda name: alone[name]),
        frames=limit,
        machine_fps_by_processor=round(1e3 * usable_cores() / bench.costs["worker_processor"], 1),
    )


def _decode_by_unit(bench: Bench, video: Path, images: list[np.ndarray], steps: dict[str, tuple[float, float]]) -> None:
    """Frames by the GPU's decoding unit, and whether they are those of the processor to the bit."""
    unit = HWAccel("cuda", device="0", allow_software_fallback=True)
    try:
        with av.open(str(video), hwaccel=unit) as container:
            first = next(container.decode(video=0))
            used = container.streams.video[0].codec_context.is_hwaccel
            bench.tell("GPU's decoding unit", used=bool(used), pixels=first.format.name)
    except (av.FFmpegError, OSError, NotImplementedError) as error:
        bench.tell("GPU's decoding unit", used=False, error=str(error))
        return
    index = index_frames(video, None)
    with contextlib.closing(open_part(video, index, 0, len(images), None, 0)) as source:
        same = [bool((frame.image == image).all()) for frame, image in zip(source, images, strict=True)]
    with contextlib.closing(open_part(video, index, 0, len(images), None, 0)) as source:
        steps["decode by the GPU's unit and convert to RGB"] = _timed(source, len(images) - WARM)
    with contextlib.closing(open_part(video, index, 0, len(images), None)) as source:
        steps["decode and convert to RGB on two threads"] = _timed(source, len(images) - WARM)
    bench.tell("pictures by the GPU's unit", compared=len(same), unlike=same.count(False))


def _codes_of(picture: Any) -> LitPicture:
    """A decoded picture as one that a device has lit."""
    planes = [
        np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)[:, : plane.width].ravel()
        for plane in picture.planes
    ]
    return LitPicture((picture.height, picture.width, 3), np.concatenate(planes), lambda: None)


def _encode(path: Path, images: Sequence[Any], limit: int) -> tuple[float, float]:
    start, spent = 0.0, 0.0
    sink = PartSink(path, list(range(len(images))), TICK, RATE)
    for number, image in enumerate(images[: limit + WARM]):
        if number == WARM:
            start, spent = time.perf_counter(), time.process_time()
        sink.write(image)
    sink.close()
    count = max(min(len(images) - WARM, limit), 1)
    wall, busy = time.perf_counter() - start, time.process_time() - spent
    path.unlink()
    return 1e3 * wall / count, 1e3 * busy / count


def _light(bench: Bench, steps: dict[str, tuple[float, float]], limit: int) -> dict[str, float]:
    """Frames from the file to what the encoder takes; returns the kernels' milliseconds on a CUDA device."""
    source = surveyed(bench)
    jobs = parse_jobs(read_jobs(write_clips(bench, "light.toml", 1, limit)), "light.toml")
    folder = bench.folder / "light"
    shutil.copytree(source / "clips", folder / "clips")
    device = bench.one_device
    kernels: dict[str, float] = {}
    with Lighter(jobs, folder, device) as lighter:
        for lit in lighter.light(Job("segment", 0, 0, 0, WARM), coded=True):
            _picture_of(lit)
        job = Job("segment", 0, 0, 0, limit + WARM)
        steps["light"] = _timed((_picture_of(lit) for lit in lighter.light(job, coded=True)), limit)
        if device != "cpu":
            kernels = {
                "same light": _kernels(lit.pipeline, device, ("frame", "pose", "clock")),
                "new light": _kernels(lit.pipeline, device, ("frame", "pose", "clock", "captured_light")),
            }
    shutil.rmtree(folder)
    return kernels


def _picture_of(lit: Lit) -> Any:
    """What a sink is given of a lit frame."""
    return lit.image if lit.coded is None else lit.coded.copy()


def _kernels(pipeline: Pipeline, device: str, changed: Sequence[str]) -> float:
    """Median milliseconds on the device of a frame in which some inputs have changed."""
    begin, end = (wp.Event(device, enable_timing=True) for _ in range(2))
    stream, times = wp.get_stream(device), []
    with wp.ScopedDevice(device):
        for _ in range(60):
            for name in changed:
                pipeline.arrays.touch(name)
            stream.record_event(begin)
            pipeline.scheduler.run()
            stream.record_event(end)
            times.append(wp.get_event_elapsed_time(begin, end))
    return round(statistics.median(times[10:]), 4)
