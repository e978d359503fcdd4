"""Spread of the recovered light over draws of a camera's noise, on the open cases of ``../shared/truth``.

    python -m bench stability [--seeds 16] [--quality high] [--noise 0.7]

Each case is run once for each seed, its frames under Gaussian noise of so many codes. Per case one JSON line: relative
error of the last frame's irradiance over all directions, its mean and the 10th and 90th percentile over seeds, percent;
``spread`` is their difference.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bench.bench_camera_faults import TRUTH, irradiance
from warp_ar import Pipeline
from warp_ar.scene import load_scene
from warp_ar.sources.sources import open_source


def light_error(case: Path, seed: int, noise: float, quality: str, device: str) -> float:
    """Return the relative error of the irradiance after all frames of a case, under one draw of noise."""
    scene, rng = load_scene(case / "scene_object.toml"), np.random.default_rng(seed)
    assert scene.source is not None
    with (
        open_source(scene.source.path) as source,
        Pipeline(scene, device=device, quality=quality, outputs=("environment",)) as pipeline,
    ):
        for frame in source:
            noisy = np.round(frame.image + rng.normal(0.0, noise, frame.image.shape))
            result = pipeline(np.clip(noisy, 0, 255).astype(np.uint8), time_seconds=frame.time)
        light = irradiance(result.environment)
    truth = irradiance(np.load(sorted((case / "env").glob("*.npy"))[-1]))
    return float(np.linalg.norm(light - truth) / np.linalg.norm(truth))


def main(device: str, arguments: Sequence[str] = ()) -> None:
    """Run all cases and print a line for each, and one for their mean."""
    parser = argparse.ArgumentParser(prog="python -m bench stability")
    parser.add_argument("--seeds", type=int, default=16)
    parser.add_argument("--quality", default="high")
    parser.add_argument("--noise", type=float, default=0.7, help="standard deviation in codes")
    given = parser.parse_args(arguments)
    spreads = []
    for case in sorted(path.parent for path in TRUTH.glob("*/case.json")):
        errors = [light_error(case, seed, given.noise, given.quality, device) for seed in range(given.seeds)]
        low, high = 100.0 * np.quantile(errors, (0.1, 0.9))
        spreads.append(high - low)
        line = {"case": case.name, "mean": 100.0 * np.mean(errors), "p10": low, "p90": high, "spread": high - low}
        print(
            json.dumps({key: one if isinstance(one, str) else round(one, 2) for key, one in line.items()}), flush=True
        )
    print(json.dumps({"case": "all", "spread": round(float(np.mean(spreads)), 2), "seeds": given.seeds}))
