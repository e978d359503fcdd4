"""Error of recovered light and of captured light over random tables, some without card, with grey cards or clutter.

    WARP_AR_SHARED=../shared python -m bench.bench_never_worse --count 300    # ten minutes on two cores
    python -m bench never_worse                                               # 20 of them

The relative errors of irradiance over all directions with and without recovery are printed, their ratio, and the share
of intervals of irradiance that contain the truth; the last line is JSON. Without ``WARP_AR_SHARED`` the environment is
a generated one, which gives other figures; ``made_up`` is the number of such tables.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.random_tables import Setup, make_setup
from bench.table_world import latlong_directions
from warp_ar import PRESETS, Pipeline, Pose
from warp_ar.scene import loads_scene
from warp_ar.stages.quality import DEFAULT_PRESET

NO_WORSE = 1.02
"""Ratio of errors up to which recovered light counts as no worse."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Errors of one set-up."""

    clipped: float
    """Relative error of irradiance over all directions with the captured light."""
    recovered: float
    """Relative error of irradiance over all directions with recovered light."""
    held: float
    """Share of the 18 intervals of irradiance (six directions, three channels) that contain the truth."""
    method: str
    """Method of the estimate."""

    @property
    def ratio(self) -> float:
        """Ratio of the error with recovered light to that with captured light."""
        return self.recovered / max(self.clipped, 1e-9)


def irradiance(environment: NDArray[Any], normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the irradiance of surfaces with normals (k, 3) under a latlong map, (k, 3)."""
    small = cv2.resize(np.asarray(environment, np.float32), (128, 64), interpolation=cv2.INTER_AREA)
    d, area = latlong_directions(64, 128)
    return np.asarray(np.maximum(normals @ d.reshape(-1, 3).T, 0.0) @ (small.reshape(-1, 3) * area.reshape(-1, 1)))


def evaluate(setup: Setup, *, device: str = "cpu", quality: str = DEFAULT_PRESET) -> Outcome:
    """Return the errors of a preset on one picture."""
    pipeline = Pipeline(loads_scene(setup.scene), device=device, quality=PRESETS[quality], outputs=("environment",))
    try:
        result = pipeline(setup.image, time_seconds=0.0, pose=Pose(setup.rotation, setup.translation))
        recovered = result.environment
        assert recovered is not None
        captured = pipeline.arrays["filled_radiance"].numpy().reshape(recovered.shape)
        status = pipeline.arrays["recover_status"]()
    finally:
        pipeline.close()
    normals = latlong_directions(24, 48)[0].reshape(-1, 3)
    truth = irradiance(setup.truth, normals)
    errors = [
        float(np.linalg.norm(irradiance(one, normals) - truth) / np.linalg.norm(truth)) for one in (captured, recovered)
    ]
    axes = np.repeat(np.eye(3), 2, axis=0) * np.tile([1.0, -1.0], 3)[:, None]
    true_axes = irradiance(setup.truth, axes)
    low, high = (np.array(status[f"irradiance_{name}"]) for name in ("low", "high"))
    held = float(((low <= true_axes) & (true_axes <= high)).mean())
    return Outcome(errors[0], errors[1], held, str(status["method"]))


def summarise(outcomes: list[Outcome]) -> dict[str, float]:
    """Return the printed figures over all set-ups.

    Returns:
        ``no_worse``: share of the set-ups whose error recovery raises at most ``NO_WORSE`` times. ``ratio_median`` and
        ``ratio_99``: quantiles of the error with recovery over that without. ``error_clipped``, ``error_recovered``:
        mean errors without and with recovery. ``interval_holds``: share of intervals that contain the truth.
    """
    ratios = np.array([outcome.ratio for outcome in outcomes])
    return {
        "count": len(outcomes),
        "no_worse": float((ratios <= NO_WORSE).mean()),
        "ratio_median": float(np.median(ratios)),
        "ratio_99": float(np.quantile(ratios, 0.99)),
        "error_clipped": float(np.mean([outcome.clipped for outcome in outcomes])),
        "error_recovered": float(np.mean([outcome.recovered for outcome in outcomes])),
        "interval_holds": float(np.mean([outcome.held for outcome in outcomes])),
    }


def main(device: str, first: int = 0, count: int = 20, quality: str = DEFAULT_PRESET) -> None:
    """Evaluate set-ups, and print figures by kind of card and over all."""
    outcomes: dict[str, list[Outcome]] = {}
    made_up = 0
    for seed in range(first, first + count):
        print(f"table {seed - first + 1} of {count}", end="\r", file=sys.stderr, flush=True)
        setup = make_setup(seed)
        made_up += setup.about["environment"] == "made up"
        outcome = evaluate(setup, device=device, quality=quality)
        outcomes.setdefault(setup.about["card"], []).append(outcome)
        if outcome.ratio > NO_WORSE:
            print(f"worse: {outcome.clipped:.3f} -> {outcome.recovered:.3f} {outcome.method} {setup.about}", flush=True)
    for card, own in outcomes.items():
        print(card, {key: round(value, 3) for key, value in summarise(own).items()})
    figures = summarise([one for own in outcomes.values() for one in own])
    print(json.dumps({"bench": "never_worse", "quality": quality, "made_up": made_up, **figures}))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Recovered light against light as captured, over random tables.")
    parser.add_argument("--count", type=int, default=300, help="set-ups")
    parser.add_argument("--first", type=int, default=0, help="number of the first")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--quality", choices=PRESETS, default=DEFAULT_PRESET, help="preset (default: %(default)s)")
    arguments = parser.parse_args()
    main(arguments.device, arguments.first, arguments.count, arguments.quality)
