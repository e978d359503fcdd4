"""Prefiltered reflections: the time of every method, and its error on a made-up environment of window, lamp and sun.

``WARP_AR_SHARED=FOLDER`` adds the real environments in ``FOLDER/hdri``. The error is the relative RMS of each level
against ``brute_force``, averaged over the levels after the mirror.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

from bench.common import measure, report
from bench.environments import environments
from warp_ar.kernels.environment import prefilter, pyramid
from warp_ar.kernels.environment.lobes import (
    Lobe,
    lobe_count,
    lobe_offset,
    lobe_rows,
    lobe_size,
    lobe_texels,
    make_lobe_samples,
    mip_weights,
)

HEIGHTS = {"cpu": (32, 64), "cuda": (32, 64, 128, 256)}
RUNS = {"cpu": 30, "cuda": 200}
FEW_ROWS = 64
"""Rows up to which brute force is timed as often as the rest on CUDA; beyond it takes tenths of a second a run."""
SAMPLES = (8, 32, 128)


def methods(environment: wp.array, lobe: Lobe, device: Any) -> dict[str, tuple[Any, wp.array]]:
    """Work and output of every method."""
    height = environment.shape[0]

    def levels() -> wp.array:
        return wp.zeros(lobe_texels(height), dtype=wp.vec3, device=device)

    mips = wp.zeros(pyramid.packed_texels(height, 2 * height), dtype=wp.vec3, device=device)
    row_energy = wp.zeros(lobe_rows(height), dtype=wp.vec3, device=device)
    energy = wp.zeros(lobe_count(height), dtype=wp.vec3, device=device)

    def mix(numbers: np.ndarray) -> tuple[Any, wp.array]:
        out, weights = levels(), wp.array(numbers.astype(np.float32), dtype=wp.float32, device=device)

        def function() -> None:
            pyramid.build_pyramid(environment, mips)
            prefilter.mix_mips(mips, weights, height, out)
            prefilter.measure_energy(out, height, row_energy, energy)
            prefilter.scale_levels(energy, height, out)

        return function, out

    def sample(count: int) -> tuple[Any, wp.array]:
        out, samples = levels(), make_lobe_samples(height, lobe, count, device)

        def function() -> None:
            pyramid.build_pyramid(environment, mips)
            prefilter.sample_lobes(mips, samples, height, out)
            prefilter.measure_energy(out, height, row_energy, energy)
            prefilter.scale_levels(energy, height, out)

        return function, out

    exact = levels()
    return {
        "energy_mip": mix(mip_weights(height, lobe)),
        **{f"fis{count}": sample(count) for count in SAMPLES},
        "brute_force": (lambda: prefilter.integrate_lobes(environment, lobe, exact), exact),
    }


def mean_error(values: np.ndarray, exact: np.ndarray, height: int) -> float:
    """Relative RMS error, averaged over the levels after the mirror."""
    errors = []
    for level in range(1, lobe_count(height)):
        rows, columns = lobe_size(height, level)
        start = lobe_offset(height, level)
        ours, truth = (a[start : start + rows * columns].reshape(rows, columns, 3) for a in (values, exact))
        weight = np.sin(np.pi * (np.arange(rows) + 0.5) / rows)[:, None, None]
        errors.append(math.sqrt((weight * (ours - truth) ** 2).sum() / (weight * truth**2).sum()))
    return round(float(np.mean(errors)), 4)


def main(device: str) -> None:
    on_cpu = wp.get_device(device).is_cpu
    kind = "cpu" if on_cpu else "cuda"
    for height in HEIGHTS[kind]:
        for lobe in ("ggx", "phong"):
            errors: dict[str, dict[str, float]] = {}
            work: dict[str, tuple[Any, wp.array]] = {}
            for surroundings, environment in environments(height, device).items():
                work = methods(environment, lobe, device)
                results = {}
                for name, (function, output) in work.items():
                    function()
                    results[name] = output.numpy().astype(np.float64)
                for name, values in results.items():
                    errors.setdefault(name, {})[surroundings] = mean_error(values, results["brute_force"], height)
            assert all(error < 0.3 for error in errors["fis128"].values())
            contenders = {name: function for name, (function, _) in work.items()}
            if on_cpu or height > FEW_ROWS:
                # Long runs: its error is known to be none, its time is taken from few.
                times = {
                    "brute_force": measure({"brute_force": contenders.pop("brute_force")}, device, 3)["brute_force"]
                }
            else:
                times = {}
            for name, milliseconds in (measure(contenders, device, RUNS[kind]) | times).items():
                report(
                    f"prefilter {lobe} {name} {height}x{2 * height}", milliseconds, device, relative_rms=errors[name]
                )
