"""Irradiance: the time of every method, and its error on a made-up environment of a window, a lamp and a sun.

``WARP_AR_SHARED=FOLDER`` adds the real environments in ``FOLDER/hdri``. The error is the relative RMS over all
directions against ``brute_force``.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

from bench.common import measure, report
from bench.environments import environments
from warp_ar.kernels.environment import irradiance
from warp_ar.kernels.latlong import direction_from_latlong, sample_latlong
from warp_ar.stages.irradiance import CLUSTERS, MAP_SIZE

HEIGHTS = (32, 64, 128)


@wp.kernel(enable_backward=False)
def spread_map_kernel(values: wp.array2d[wp.vec3], out: wp.array2d[wp.vec3]):
    i, j = wp.tid()
    row, column = wp.float32(i) + 0.5, wp.float32(j) + 0.5
    out[i, j] = sample_latlong(values, direction_from_latlong(row, column, out.shape[0], out.shape[1]))


@wp.kernel(enable_backward=False)
def spread_sh_kernel(coefficients: wp.array[wp.vec3], out: wp.array2d[wp.vec3]):
    i, j = wp.tid()
    row, column = wp.float32(i) + 0.5, wp.float32(j) + 0.5
    out[i, j] = irradiance.sh_irradiance(coefficients, direction_from_latlong(row, column, out.shape[0], out.shape[1]))


def spread(output: wp.array) -> np.ndarray:
    """Irradiance at the texel centres of a map."""
    out = wp.zeros(MAP_SIZE, dtype=wp.vec3, device=output.device)
    kernel = spread_sh_kernel if output.ndim == 1 else spread_map_kernel
    wp.launch(kernel, out.shape, [output], [out], device=output.device)
    return out.numpy().astype(np.float64)


def methods(environment: wp.array, device: Any) -> dict[str, tuple[Any, wp.array]]:
    """Work and output of every method."""
    height, width = environment.shape
    with wp.ScopedDevice(device):
        sh, sums = wp.zeros(9, dtype=wp.vec3), wp.zeros((height, 5), dtype=wp.vec3)
        tables = irradiance.make_sh_tables(height, width, device)
        few, clustered = wp.zeros(math.prod(CLUSTERS), dtype=irradiance.Cluster), wp.zeros(MAP_SIZE, dtype=wp.vec3)
        all_, exact = wp.zeros(height * width, dtype=irradiance.Cluster), wp.zeros(MAP_SIZE, dtype=wp.vec3)

    def sh2() -> None:
        irradiance.project_irradiance_sh(environment, tables, sums, sh)
        irradiance.window_sh(sh)

    def clusters() -> None:
        irradiance.gather_clusters(environment, CLUSTERS, few)
        irradiance.sum_clusters(few, clustered)

    def brute_force() -> None:
        irradiance.gather_clusters(environment, (height, width), all_)
        irradiance.sum_clusters(all_, exact)

    return {
        "sh2": (sh2, sh),
        "clusters": (clusters, clustered),
        "brute_force": (brute_force, exact),
    }


def main(device: str) -> None:
    weight = np.sin(np.pi * (np.arange(MAP_SIZE[0]) + 0.5) / MAP_SIZE[0])[:, None, None]
    for height in HEIGHTS:
        errors: dict[str, dict[str, float]] = {}
        work: dict[str, tuple[Any, wp.array]] = {}
        for surroundings, environment in environments(height, device).items():
            work = methods(environment, device)
            results = {}
            for name, (function, output) in work.items():
                function()
                results[name] = spread(output)
            exact = results["brute_force"]
            for name, values in results.items():
                error = math.sqrt((weight * (values - exact) ** 2).sum() / (weight * exact**2).sum())
                errors.setdefault(name, {})[surroundings] = round(error, 5)
        assert all(error < 0.03 for error in errors["clusters"].values())
        for name, milliseconds in measure({name: function for name, (function, _) in work.items()}, device).items():
            report(f"irradiance {name} {height}x{2 * height}", milliseconds, device, relative_rms=errors[name])
