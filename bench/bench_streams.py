"""Many cameras in one process: what a further pipeline costs, frames a second of all, and how long each frame takes.

A stream is a pipeline, a thread that hands it the frames of ``desk``, tracking included, and another that waits for
each picture: a frame's marker is found while the one before is rendered. Frames lie in memory of the pipeline's, where
a source would have written them. ``latency_ms`` runs from the time at which
the camera has a frame to the picture on the host. A camera that finds two frames of its own under way drops what it
takes until one of them is a picture. All streams must show the same first pictures before anything is timed.

``WARP_AR_BENCH`` may name rows, frames a second of each camera (0: the next frame is there when the last picture is)
and numbers of streams, as in ``1080,60,1,4,16``; usual are ``240,0,1,2,4`` on CPU and ``1080,60,1,4,16,8x2,16x1`` on
CUDA. ``8x2`` are 8 processes of 2 streams each, begun together, with one thread of OpenCV and of NumPy's BLAS for each
stream; of their latencies the median of medians and the worst 99th percentile are told.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import queue
import resource
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import warp as wp

from bench.bench_frame import Clip, clip, written_there
from bench.common import report
from warp_ar.engine.pipeline import Pipeline, Result
from warp_ar.stages.recover import EVERY_FRAME

USUAL = {"cpu": "240,0,1,2,4", "cuda": "1080,60,1,4,16,8x2,16x1"}
SIZES = {240: (320, 240), 480: (640, 480), 1080: (1920, 1080), 2160: (3840, 2160)}
WARM_UP = 12
FRAMES = 60
"""Of each stream that are timed; ten seconds' worth of a camera's."""
CLIP_RATE = 24.0
UNDER_WAY = 2
"""Frames of a camera that are handed over and are no picture as yet, at most."""
LEAST_SIZE = 1 << 20
TOGETHER = "WARP_AR_BENCH_TOGETHER"
"""Of a process among several: how many there are, and a folder in which they meet."""


@dataclasses.dataclass
class Stream:
    """One camera: its pipeline, and what was measured of its frames."""

    pipeline: Pipeline
    frames: Clip
    """What the camera shows."""
    latency_ms: list[float] = dataclasses.field(default_factory=list)
    dropped: int = 0
    error: BaseException | None = None

    def submit(self, index: int, rate: float) -> Result:
        """Hand over a frame, by the camera's clock."""
        image = self.frames.images[index % len(self.frames.images)]
        return self.pipeline.submit(image, time_seconds=index / (rate or CLIP_RATE))

    def show(self, index: int, rate: float) -> np.ndarray:
        """The picture of a frame."""
        return self.submit(index, rate).image

    def run(self, count: int, rate: float, begin: threading.Barrier) -> None:
        """Light so many frames after the warm-up; what fails is told by ``error``."""
        room = threading.Semaphore(UNDER_WAY if rate else 1)
        handed_over: queue.SimpleQueue[tuple[float, Result] | None] = queue.SimpleQueue()
        taker = threading.Thread(target=self._take_pictures, args=(handed_over, room))
        taker.start()
        try:
            begin.wait()
            start = time.perf_counter()
            index = 0
            while True:
                room.acquire()
                if rate:  # what the camera took while there was no room is gone
                    following = max(index, math.ceil((time.perf_counter() - start) * rate))
                    self.dropped += min(following, count) - index
                    index = following
                if index >= count or self.error is not None:
                    break
                due = start + index / rate if rate else time.perf_counter()
                time.sleep(max(due - time.perf_counter(), 0.0))
                handed_over.put((due, self.submit(WARM_UP + index, rate)))
                index += 1
        except BaseException as error:
            self.error = error
            begin.abort()
        finally:
            handed_over.put(None)
            taker.join()

    def _take_pictures(
        self, handed_over: queue.SimpleQueue[tuple[float, Result] | None], room: threading.Semaphore
    ) -> None:
        """Wait for each picture and note when it came."""
        while (item := handed_over.get()) is not None:
            due, result = item
            try:
                _ = result.image
            except BaseException as error:
                self.error = error
            self.latency_ms.append((time.perf_counter() - due) * 1e3)
            room.release()


def used_memory(device: Any) -> float:
    """MB that this process holds: of the device, on CPU of the host."""
    if device.is_cuda:
        return (device.total_memory - device.free_memory) / LEAST_SIZE
    if sys.platform == "linux":
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[1]) * resource.getpagesize() / LEAST_SIZE
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / LEAST_SIZE


def open_streams(
    frames: Clip, count: int, device: Any, close: contextlib.ExitStack
) -> tuple[list[Stream], list[tuple[float, float, float]]]:
    """Streams whose first pictures were made; for each milliseconds by the clock and of all threads, and MB."""
    streams: list[Stream] = []
    costs: list[tuple[float, float, float]] = []
    first = None
    for _ in range(count):
        wp.synchronize_device(device)
        begin, busy, before = time.perf_counter(), time.process_time(), used_memory(device)
        pipeline = close.enter_context(Pipeline(frames.scene, device=str(device), estimates="real_time"))
        stream = Stream(pipeline, frames)
        picture = stream.show(0, 0.0)
        spent = time.perf_counter() - begin, time.process_time() - busy
        costs.append((spent[0] * 1e3, spent[1] * 1e3, used_memory(device) - before))
        first = picture.copy() if first is None else first
        np.testing.assert_array_equal(picture, first)
        stream.frames = written_there(pipeline, frames)
        streams.append(stream)
    return streams, costs


def time_streams(streams: list[Stream], rate: float) -> tuple[float, float]:
    """Run all side by side; returns seconds by the clock and of all threads."""
    count = round(10 * rate) if rate else FRAMES
    for index in range(1, WARM_UP):
        pictures = [stream.show(index, rate) for stream in streams]
        if index < EVERY_FRAME:  # later ones take what was estimated beside them when it is there
            for picture in pictures:
                np.testing.assert_array_equal(picture, pictures[0])
    barrier = threading.Barrier(len(streams) + 1)
    wait_for_others()
    threads = [threading.Thread(target=stream.run, args=(count, rate, barrier)) for stream in streams]
    for thread in threads:
        thread.start()
    with contextlib.suppress(threading.BrokenBarrierError):  # whoever broke it says why
        barrier.wait()
    begin, busy = time.perf_counter(), time.process_time()
    for thread in threads:
        thread.join()
    spent = time.perf_counter() - begin, time.process_time() - busy
    for stream in streams:
        if stream.error is not None:
            raise stream.error
    return spent


def run_processes(processes: int, streams: int, rows: int, rate: int, device: str) -> None:
    """Streams in processes of their own, and what all of them did."""
    with tempfile.TemporaryDirectory(prefix="warp_ar-streams-") as folder:
        environment = {
            **os.environ,
            "WARP_AR_BENCH": f"{rows},{rate},{streams}",
            TOGETHER: f"{processes},{folder}",
            "OPENBLAS_NUM_THREADS": "1",
        }
        command = [sys.executable, "-m", "bench", "streams", "--device", device]
        running = [
            subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
            for _ in range(processes)
        ]
        records = []
        for process in running:
            printed, errors = process.communicate()
            if process.returncode:
                for other in running:
                    other.kill()
                raise RuntimeError(errors[-2000:])
            records += [json.loads(line) for line in printed.splitlines() if line.startswith("{")]
    summed = {name: round(sum(record[name] for record in records), 1) for name in ("fps", "dropped")}
    told = {
        "case": f"streams {processes} processes of {streams} of {rows} rows, {rate or 'as many'} frames a second each",
        "median_ms": statistics.median(record["median_ms"] for record in records),
        "p99_ms": max(record["p99_ms"] for record in records),
        **summed,
        "processor_ms": statistics.median(record["processor_ms"] for record in records),
    }
    kept = ("cores", "device", "warp", "commit")
    print(json.dumps({**told, **{name: records[0][name] for name in kept}}), flush=True)


def wait_for_others() -> None:
    """In one of several processes: until all of them are here."""
    if TOGETHER not in os.environ:
        return
    count, _, folder = os.environ[TOGETHER].partition(",")
    Path(folder, str(os.getpid())).touch()
    while len(os.listdir(folder)) < int(count):
        time.sleep(0.01)


def main(device: str) -> None:
    """Every number of streams in turn, each with pipelines of its own."""
    target = wp.get_device(device)
    asked = os.environ.get("WARP_AR_BENCH") or USUAL["cuda" if target.is_cuda else "cpu"]
    rows, rate = (int(part) for part in asked.split(",")[:2])
    counts = [int(part) for part in asked.split(",")[2:] if "x" not in part]
    if TOGETHER in os.environ:
        cv2.setNumThreads(1)
    frames = clip("desk", SIZES[rows])
    with Pipeline(frames.scene, device=device) as pipeline:
        pipeline.warm_up()  # compiles what is missing
        pipeline(frames.images[0])
    for count in counts:
        with contextlib.ExitStack() as close:
            streams, costs = open_streams(frames, count, target, close)
            wall, busy = time_streams(streams, float(rate))
        latency = [value for stream in streams for value in stream.latency_ms]
        start_ms, start_busy, megabytes = np.median(costs[1:] or costs, axis=0).tolist()
        report(
            f"streams {count} of {rows} rows, {rate or 'as many'} frames a second each",
            latency,
            device,
            p99_ms=round(float(np.percentile(latency, 99)), 3),
            fps=round(len(latency) / wall, 1),
            dropped=sum(stream.dropped for stream in streams),
            processor_ms=round(busy * 1e3 / len(latency), 2),
            further_start_ms=round(start_ms),
            further_start_processor_ms=round(start_busy),
            further_mb=round(megabytes, 1),
            cores=os.cpu_count(),
        )
    for part in asked.split(",")[2:]:
        if "x" in part:
            processes, _, streams_each = part.partition("x")
            run_processes(int(processes), int(streams_each), rows, rate, device)
