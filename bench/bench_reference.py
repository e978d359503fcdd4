"""The path tracer on bundled scenes: rays per second, compared with primary rays, and the time to an error of 1 %.

    python -m bench reference [--scenes torus,desk,mirror] [--size WxH] [--samples N] [--runs N] [--device D]

``bare`` is the rate of primary rays: one ray through the centre of every pixel to the first surface, and nothing else.
The time to 1 % is the time to estimate the reflectance of proxies, plus that of the samples multiplied by the square of
the ratio of their error to 1 %, because the error falls with the square root of the number of samples.
"""

from __future__ import annotations

import argparse
import functools
import os
import statistics
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import warp as wp

from bench.common import measure, report, time_once
from warp_ar.accuracy.known_frame import light_up_to
from warp_ar.accuracy.path_tracer import PathTracer
from warp_ar.device import usable_cores
from warp_ar.kernels.launch import launch_rows
from warp_ar.kernels.rays.trace import TraceConfig
from warp_ar.kernels.reference.path_vertices import LocalScene, make_find_vertex
from warp_ar.kernels.structs import FrameParams
from warp_ar.scene import load_scene

CASES = ("torus", "desk", "mirror")
FRAME = 6
"""Index of the traced frame."""
BAND = 8
"""Number of rows of primary rays that a thread traces at a time."""
SIZES = {"cpu": (160, 120), "cuda": (1440, 1080)}
STEPS = {"cpu": 2, "cuda": 4}
"""Number of samples per pixel of one timed call."""
RUNS = 12
"""Number of timed calls."""
SAMPLES = 64
"""Number of samples per pixel for the time to an error."""
WANTED = 0.01
"""Relative error to which the time is extrapolated."""


@functools.cache
def make_primary_kernel(trace: TraceConfig) -> wp.Kernel:
    find_vertex = make_find_vertex(trace)

    @wp.kernel(module="unique", enable_backward=False)
    def primary_kernel(
        row_start: wp.int32, params: wp.array[FrameParams], scene: LocalScene, depth: wp.array2d[wp.float32]
    ):
        i, j = wp.tid()
        i += row_start
        ray = scene.picture.rays[i, j]
        direction = wp.normalize(params[0].world_from_camera * wp.vec3(ray[0], ray[1], 1.0))
        depth[i, j] = find_vertex(scene, params[0].camera_position, direction, True).hit.t

    return primary_kernel


class Primary:
    """Primary rays of a path tracer's picture, traced by as many threads as its paths."""

    def __init__(self, tracer: PathTracer) -> None:
        self.tracer = tracer
        self.shape = tracer.camera.height, tracer.camera.width
        self.depth = wp.zeros(self.shape, dtype=wp.float32, device=tracer.device)
        self.kernel = make_primary_kernel(tracer._config)

    def launch(self, rows: tuple[int, int] | None) -> None:
        """Trace a band of rows; None: all rows."""
        inputs = [self.tracer._params, self.tracer._local]
        launch_rows(self.kernel, self.shape, inputs, [self.depth], rows=rows, device=self.tracer.device)

    def __call__(self) -> None:
        """Trace all rows, on CPU in bands on all cores."""
        if not self.tracer.device.is_cpu:
            self.launch(None)
            return
        self.launch((0, 1))
        height = self.shape[0]
        bands = [(row, min(row + BAND, height)) for row in range(0, height, BAND)]
        with ThreadPoolExecutor(usable_cores()) as pool:
            list(pool.map(self.launch, bands))


def main(device: str, arguments: list[str] | None = None) -> None:
    kind = "cpu" if wp.get_device(device).is_cpu else "cuda"
    parser = argparse.ArgumentParser(prog="python -m bench reference")
    parser.add_argument("--scenes", default=",".join(CASES))
    parser.add_argument("--size", default="x".join(map(str, SIZES[kind])))
    parser.add_argument("--samples", type=int, default=SAMPLES, help="per pixel, for the time to an error")
    parser.add_argument("--runs", type=int, default=RUNS, help="of the two rates")
    options = parser.parse_args(arguments or [])
    width, height = (int(side) for side in options.size.split("x"))
    for name in options.scenes.split(","):
        measure_scene(name, (width, height), options.samples, options.runs, device)


def measure_scene(name: str, size: tuple[int, int], count: int, runs: int, device: str) -> None:
    """Measure one scene: the time to an error, then both rates in turn."""
    kind = "cpu" if wp.get_device(device).is_cpu else "cuda"
    known = light_up_to(load_scene(name), FRAME, quality="high", device=device)
    # A small picture, which is not timed, loads the kernels.
    known.tracer(device=device, size=(64, 48)).sample(1)
    tracer = known.tracer(device=device, size=size)
    begun = time.perf_counter()
    tracer.prepare()
    prepared = time.perf_counter() - begun
    worked = time.process_time()
    *_, picture = tracer.render(count, step=max(count // 4, 1))
    worked = time.process_time() - worked
    assert np.isfinite(picture.radiance).all()
    changed = np.abs(picture.image.astype(int) - np.round(255.0 * _encoded(tracer))).max(axis=2) > 2
    assert 0.01 < changed.mean() < 0.9, "nothing virtual is in the picture"
    pixels = size[0] * size[1]
    before, samples = tracer.rays(), tracer.samples
    contenders = {"paths": lambda t=tracer: t.sample(STEPS[kind]), "bare": Primary(tracer)}
    times = _measure(contenders, device, runs)
    rays = (tracer.rays() - before) / (tracer.samples - samples) * STEPS[kind]
    rate = rays / (statistics.median(times["paths"]) * 1e-3)
    bare = pixels / (statistics.median(times["bare"]) * 1e-3)
    more = (picture.relative_error / WANTED) ** 2
    report(
        f"reference {name} {size[0]}x{size[1]}",
        times["paths"],
        device,
        samples=count,
        samples_per_call=STEPS[kind],
        rays_per_sample=round(rays / pixels / STEPS[kind], 2),
        million_rays_per_second=round(rate / 1e6, 3),
        bare_million_rays_per_second=round(bare / 1e6, 3),
        of_bare=round(rate / bare, 3),
        relative_error=round(picture.relative_error, 4),
        seconds=round(picture.seconds, 3),
        prepare_seconds=round(prepared, 3),
        seconds_to_one_percent=round(prepared + picture.seconds * more, 2),
        processor_seconds_to_one_percent=round(worked * more, 1),
        cores=len(os.sched_getaffinity(0)),
        load=round(os.getloadavg()[0], 1),
    )


def _encoded(tracer: PathTracer) -> np.ndarray:
    """Return the tracer's frame as sRGB, 0 to 1."""
    linear = np.clip(tracer._local.radiance.numpy(), 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def _measure(contenders: dict, device: str, runs: int) -> dict[str, list[float]]:
    """Return milliseconds of contenders, timed in turn.

    On CUDA they are elapsed time on the host too, because sampling depends on the samples so far and cannot be replayed
    as a graph.
    """
    if wp.get_device(device).is_cpu:
        return measure(contenders, device, runs=runs)
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for run in range(runs + 2):
        for name, contender in contenders.items():
            elapsed = time_once(contender, device)
            if run >= 2:
                times[name].append(elapsed)
    return times
