"""The path tracer on bundled scenes: rays a second beside the bare rate, and the time to an error of 1 %.

Bare is one ray through the middle of every pixel to the first surface, objects included, and nothing else. The time to
1 % is that of the samples that were taken times the square of their error over 1 %: what is left falls with the root of
their number.
"""

from __future__ import annotations

import functools
import statistics
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import warp as wp

from bench.common import measure, report, time_once
from warp_ar.accuracy.known_frame import light_up_to
from warp_ar.accuracy.path_tracer import BAND, PathTracer
from warp_ar.device import usable_cores
from warp_ar.kernels.launch import launch_rows
from warp_ar.kernels.path_vertices import LocalScene, make_find_vertex
from warp_ar.kernels.structs import FrameParams
from warp_ar.kernels.trace import TraceConfig
from warp_ar.scene import load_scene

CASES = ("torus", "desk", "mirror")
FRAME = 6
SIZES = {"cpu": (160, 120), "cuda": (1440, 1080)}
STEPS = {"cpu": 2, "cuda": 4}
"""Samples per pixel of one timed call."""
RUNS = 12
SAMPLES = 64
"""Per pixel, for the time to an error."""
WANTED = 0.01


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
    """One ray per pixel, by as many threads as paths are followed by."""

    def __init__(self, tracer: PathTracer) -> None:
        self.tracer = tracer
        self.shape = tracer.camera.height, tracer.camera.width
        self.depth = wp.zeros(self.shape, dtype=wp.float32, device=tracer.device)
        self.kernel = make_primary_kernel(tracer._trace)

    def launch(self, rows: tuple[int, int] | None) -> None:
        """A band of rows."""
        inputs = [self.tracer._params, self.tracer._local]
        launch_rows(self.kernel, self.shape, inputs, [self.depth], rows=rows, device=self.tracer.device)

    def __call__(self) -> None:
        """All rows."""
        if not self.tracer.device.is_cpu:
            self.launch(None)
            return
        self.launch((0, 1))
        height = self.shape[0]
        bands = [(row, min(row + BAND, height)) for row in range(0, height, BAND)]
        with ThreadPoolExecutor(usable_cores()) as pool:
            list(pool.map(self.launch, bands))


def main(device: str) -> None:
    kind = "cpu" if wp.get_device(device).is_cpu else "cuda"
    for name in CASES:
        known = light_up_to(load_scene(name), FRAME, quality="high", device=device)
        tracer = known.tracer(device=device, size=SIZES[kind])
        *_, picture = tracer.render(SAMPLES, step=SAMPLES // 4)
        assert np.isfinite(picture.radiance).all()
        changed = np.abs(picture.image.astype(int) - np.round(255.0 * _encoded(tracer))).max(axis=2) > 2
        assert 0.01 < changed.mean() < 0.9, "nothing virtual is in the picture"
        pixels = SIZES[kind][0] * SIZES[kind][1]
        before, samples = tracer.rays(), tracer.samples
        contenders = {"paths": lambda t=tracer: t.sample(STEPS[kind]), "bare": Primary(tracer)}
        times = _measure(contenders, device)
        rays = (tracer.rays() - before) / (tracer.samples - samples) * STEPS[kind]
        rate = rays / (statistics.median(times["paths"]) * 1e-3)
        bare = pixels / (statistics.median(times["bare"]) * 1e-3)
        report(
            f"reference {name} {SIZES[kind][0]}x{SIZES[kind][1]}",
            times["paths"],
            device,
            samples_per_call=STEPS[kind],
            rays_per_sample=round(rays / pixels / STEPS[kind], 2),
            million_rays_per_second=round(rate / 1e6, 3),
            bare_million_rays_per_second=round(bare / 1e6, 3),
            of_bare=round(rate / bare, 3),
            relative_error=round(picture.relative_error, 4),
            seconds_to_one_percent=round(picture.seconds * (picture.relative_error / WANTED) ** 2, 2),
        )


def _encoded(tracer: PathTracer) -> np.ndarray:
    """The frame that the tracer has, as sRGB from 0 to 1."""
    linear = np.clip(tracer._local.radiance.numpy(), 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def _measure(contenders: dict, device: str) -> dict[str, list[float]]:
    """In turn; by the clock of the host on CUDA as well, for sampling counts what is done."""
    if wp.get_device(device).is_cpu:
        return measure(contenders, device, runs=RUNS)
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for run in range(RUNS + 2):
        for name, contender in contenders.items():
            elapsed = time_once(contender, device)
            if run >= 2:
                times[name].append(elapsed)
    return times
