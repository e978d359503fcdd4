"""Environment shadows and near light of bundled scenes, 640 x 480, by method; one band: CPU times are of one core."""

from __future__ import annotations

import dataclasses

import numpy as np
import warp as wp

from bench.common import measure, report
from warp_ar.engine.pipeline import Pipeline
from warp_ar.scene import load_scene
from warp_ar.sources.sources import open_source
from warp_ar.stages.quality import PRESETS
from warp_ar.stages.shared.environment_sets import METHODS

CASES = tuple((scene, method) for scene in ("torus", "mirror") for method in METHODS if method != "brute_force")


def main(device: str) -> None:
    for name, method in CASES:
        scene = load_scene(name)
        quality = dataclasses.replace(PRESETS["high"], edge_samples=4).with_methods(environment_shadow=method)
        assert scene.source is not None
        assert scene.source.path is not None
        with open_source(scene.source.path) as source, Pipeline(scene, device=device, quality=quality, bands=1) as pipe:
            frame = next(iter(source)).image
            pipe(frame)
            ratio = pipe.arrays["shadow_ratio"].numpy()
            # Checked before it is timed: there is a shadow, most of the picture is far from it, nothing is broken.
            assert np.isfinite(ratio).all()
            assert ratio.min() < 0.8
            assert np.median(ratio) > 0.95
            passes = {
                stage.name: [step.launch for step in steps]
                for stage, steps in pipe._scheduler._stages
                if stage.name in ("environment_samples", "environment_shadow", "near_field")
            }

            def run_all(launches):
                for launch in launches:
                    launch(None)

            with wp.ScopedDevice(device):
                times = measure({key: lambda steps=steps: run_all(steps) for key, steps in passes.items()}, device)
        for key, values in times.items():
            report(f"{key}/{name}/{method}", values, device, changed=round(float((ratio != 1).any(-1).mean()), 3))
