"""A pipeline of every effect at a small size, whose stages can be fed by hand: what the hard cases are tried on.

The pose is given, not tracked, so that any picture can be a frame. Stages and methods come from ``warp_ar.stages``: a
new one is tried without a line here.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import warp as wp

from tests import kernel_rig
from warp_ar.engine.graph import Plan, make_plan
from warp_ar.engine.pipeline import Pipeline
from warp_ar.kernels.structs import FrameParams, RayScene
from warp_ar.kernels.structs import Probe as BallRecord
from warp_ar.scene import (
    Camera,
    Exposure,
    LambertMaterial,
    Light,
    Marker,
    MetallicRoughnessMaterial,
    MirrorMaterial,
    Object,
    PhongMaterial,
    Pose,
    Probe,
    Proxy,
    Scene,
)
from warp_ar.stages import STAGES
from warp_ar.stages.base import Arrays, ArraySpec, Pass, Stage, Wiring
from warp_ar.stages.features import Features, find_features
from warp_ar.stages.quality import PRESETS, Quality
from warp_ar.stages.recover import Recover
from warp_ar.stages.request import LAYERS, Request
from warp_ar.tracking.tracking import Track, TrackState

SIZE = (48, 36)
"""Columns and rows of a frame: a few rows per band, and compiled code is the same at any size."""
ENVIRONMENT_HEIGHT = 16
MAY_BE_INFINITE = ("lamps.distance", "depth")
"""Outputs that are documented to be infinite where there is nothing, or nothing near."""


def look_at(eye: Any, target: Any = (0.0, 0.0, 0.02)) -> Pose:
    """Pose of a camera at ``eye`` whose axis goes a little above the marker."""
    return kernel_rig.look_at(eye, target)


POSE = look_at((0.02, -0.3, 0.35))


LIGHT_RADIUS = 0.02
"""Of lamps in all combinations, metres at scale 1."""


def make_scene(scale: float = 1.0, shift: Any = (0.0, 0.0, 0.0), *, radius: float = 0.0, **changes: Any) -> Scene:
    """Every effect: four materials, sphere, box and mesh, two kinds of proxy, three kinds of light, a ball.

    Args:
        scale: Metres per unit: everything is that much larger and farther.
        shift: Where the scene's middle lies, metres.
        radius: Of lamps, metres at scale 1: soft where the method of ``light_shadow`` is.
        changes: Fields of the scene to replace.
    """

    def at(*point: float) -> tuple[float, float, float]:
        x, y, z = (scale * p + s for p, s in zip(point, shift, strict=True))
        return x, y, z

    def metres(*lengths: float) -> tuple[Any, ...]:
        return tuple(scale * length for length in lengths)

    rough = MetallicRoughnessMaterial((0.9, 0.8, 0.4), 0.5, 0.3)
    scene = Scene(
        camera=Camera(*SIZE, 50.0, 50.0, 23.5, 17.5),
        marker=Marker(size=0.08),
        probes=(Probe(at(-0.09, 0.02, 0.04), scale * 0.04),),
        proxies=(
            Proxy("plane", at=at(0, 0, 0), size=metres(1.0, 1.0)),
            Proxy("box", at=at(0.0, 0.13, 0.03), size=metres(0.1, 0.05, 0.06)),
        ),
        objects=(
            Object(
                "sphere",
                radius=scale * 0.03,
                at=at(0.09, 0.0, 0.03),
                material=PhongMaterial((0.5, 0.4, 0.3), (0.3, 0.3, 0.3), 40.0),
            ),
            Object(
                "box",
                size=metres(0.04, 0.04, 0.04),
                at=at(0.0, -0.08, 0.02),
                rotate=(0.0, 0.0, 30.0),
                material=LambertMaterial((0.7, 0.7, 0.7)),
            ),
            Object(
                "torus", major_radius=scale * 0.03, minor_radius=scale * 0.01, at=at(0.05, 0.08, 0.02), material=rough
            ),
            Object("sphere", radius=scale * 0.02, at=at(-0.02, 0.03, 0.02), material=MirrorMaterial((0.9, 0.9, 0.9))),
        ),
        lights=(
            Light("point", 0.1 * scale**2, at=at(0.0, -0.1, 0.3), radius=scale * radius),
            Light(
                "spot",
                0.1 * scale**2,
                at=at(0.2, 0.1, 0.3),
                target=at(0, 0, 0),
                inner_angle=10.0,
                outer_angle=30.0,
                radius=scale * radius,
            ),
            Light("directional", 0.3, direction=(0.3, 0.2, -1.0)),
        ),
        exposure=Exposure(0.7),
    )
    return dataclasses.replace(scene, **changes)


def make_quality(**methods: str) -> Quality:
    """The default preset at a small size, with every stage that a method can switch off switched on."""
    base = dataclasses.replace(PRESETS["medium"], environment_height=ENVIRONMENT_HEIGHT, edge_samples=4)
    switched = {stage.name: list(stage.methods)[1] for stage in STAGES if "none" in stage.methods}
    return base.with_methods(**{**switched, **methods})


BRACKET = (1.0, 1.0 / 16.0)
"""Exposure times between which frames of one combination alternate."""


def _combination(
    preset: str, scale: float = 0.7, more: tuple[str, ...] = (), times: tuple[float, ...] = (), **methods: str
) -> Request:
    base = dataclasses.replace(PRESETS[preset], environment_height=ENVIRONMENT_HEIGHT)
    chosen = {"unwrap": "area", **dict(base.methods), **methods}
    scene = make_scene(radius=LIGHT_RADIUS, exposure=Exposure(scale))
    return Request(scene, base.with_methods(**chosen), SIZE, ("image", "environment", *more), times)


def _further_methods() -> Iterator[dict[str, str]]:
    """Yield methods that no preset names, those of several stages together."""
    named = {pair for preset in PRESETS.values() for pair in preset.methods} | {("unwrap", "area")}
    left = {
        stage.name: [method for method in stage.methods if len(stage.methods) > 1 and (stage.name, method) not in named]
        for stage in STAGES
    }
    for some in itertools.zip_longest(*left.values()):
        yield {name: method for name, method in zip(left, some, strict=True) if method is not None}


COMBINATIONS: dict[str, Request] = {
    **{name: _combination(name) for name in ("medium", "high", "low", "paper", "reference")},
    # Some stages run only without a change of exposure, between exposure times, or where layers are asked for.
    "composed": _combination("medium", 1.0, tuple(LAYERS), BRACKET),
    **{f"further {number}": _combination("low", **some) for number, some in enumerate(_further_methods())},
}
"""Requests that between them hold every stage on every method, so that few pipelines are compiled."""
SLOW = ("reference", "further 0")
"""Those of methods that only `reference` names, or no preset: a plain run leaves them out."""


def plan_names(plan: Plan) -> tuple[str, ...]:
    """Names of the stages that run."""
    return tuple(stage.name for stage, _ in plan.stages)


@functools.cache
def methods_in(name: str) -> dict[str, str]:
    """Method of every stage that runs in a combination."""
    request = COMBINATIONS[name]
    kinds = {stage.name: stage for stage in STAGES}
    return {
        stage: request.quality.method(stage) if len(kinds[stage].methods) > 1 else next(iter(kinds[stage].methods))
        for stage in plan_names(make_plan(request))
    }


def combination_of(stage: str, method: str) -> str:
    """Name of the first combination whose plan holds ``stage`` on ``method``."""
    return next(name for name in COMBINATIONS if methods_in(name).get(stage) == method)


METHODS: dict[str, tuple[str, ...]] = {
    stage.name: tuple(
        method for method in stage.methods if any(methods_in(name).get(stage.name) == method for name in COMBINATIONS)
    )
    for stage in STAGES
}
"""Every method on which a stage does something, by stage; ``none`` of a stage is that it is left out."""
EXACT = tuple(method for method in METHODS["unwrap"] if method != "sphere_map")
"""Methods of ``unwrap`` that know where the ball's points are; the paper's has its tests beside its kernel."""
FILTERS = [
    (stage, method) for stage in ("irradiance", "prefilter") for method in METHODS[stage] if method != "sphere_mip"
]
"""Filters of the environment's map; the paper's filters the frame, and has its tests beside its kernel."""
STAGE_METHODS = [(stage, method) for stage, methods in METHODS.items() for method in methods]


def _marks(stage: str, method: str) -> list[pytest.MarkDecorator]:
    return [pytest.mark.slow] if combination_of(stage, method) in SLOW else []


def cases(*stages: str, without: str = "") -> list[Any]:
    """Parameters ``stage`` and ``method`` of some stages, those of slow combinations marked so."""
    pairs = [(stage, method) for stage in stages for method in METHODS[stage] if method != without]
    return [pytest.param(*pair, marks=_marks(*pair)) for pair in pairs]


def methods(stage: str) -> list[Any]:
    """Parameter ``method`` of one stage, as ``cases`` has it."""
    return [pytest.param(method, marks=_marks(stage, method)) for method in METHODS[stage]]


class FixedPose:
    """A tracker that knows the pose; None is a lost marker."""

    def __init__(self, pose: Pose | None = POSE) -> None:
        self.pose = pose

    def track(self, image: Any, time: float) -> Track:
        """The pose, whatever the picture shows."""
        state = TrackState.LOST if self.pose is None else TrackState.TRACKED
        return Track(self.pose, state, 1.0, None, 0.0)


class Rig:
    """One pipeline, and its stages one by one."""

    def __init__(
        self,
        device: str,
        stage: str | None = None,
        method: str = "default",
        *,
        combination: str = "medium",
        bands: int = 1,
        pose: Pose = POSE,
        **changes: Any,
    ) -> None:
        request = COMBINATIONS[combination if stage is None else combination_of(stage, method)]
        if changes:
            request = dataclasses.replace(request, scene=dataclasses.replace(request.scene, **changes))
        self.device = device
        self.pipeline = Pipeline(
            request.scene,
            device=device,
            quality=request.quality,
            outputs=(*dict.fromkeys(("image", "environment", *request.outputs)),),
            bands=bands,
            exposures=request.exposures,
        )
        self.tracker = FixedPose(pose)
        self.pipeline._tracker = self.tracker  # type: ignore[assignment]
        self.arrays = self.pipeline.arrays
        self.count = 0

    def __enter__(self) -> Rig:
        return self

    def __exit__(self, *_: object) -> None:
        self.pipeline.close()

    def frame(self, image: np.ndarray) -> np.ndarray:
        """One frame through all stages, after one of every shorter exposure if there are any; returns the picture."""
        image = np.ascontiguousarray(image)
        for time in self.pipeline.plan.request.exposures[1:]:
            self.pipeline(image, time_seconds=self.count / 30.0, exposure_time=time)
        result = self.pipeline(image, time_seconds=self.count / 30.0)
        self.count += 1
        return result.image

    def stage(self, name: str) -> tuple[Stage, list[Pass]]:
        """A stage and its passes."""
        return next((stage, passes) for stage, passes in self.pipeline._scheduler._stages if stage.name == name)

    def poke(self, name: str, values: Any) -> None:
        """Write the contents of an array; a single value fills it."""
        array = self.arrays[name]
        if np.ndim(values) == 0:
            values = np.full((*array.shape, *_lanes(array)), values, np.float32)
        array.assign(np.ascontiguousarray(values))
        self.arrays.touch(name)

    def get(self, name: str) -> np.ndarray:
        """A copy of an array's contents."""
        return np.array(self.arrays[name].numpy())

    def run(self, name: str, *, bands: int = 1) -> dict[str, np.ndarray]:
        """Run one stage, its passes cut into bands; returns copies of what it writes."""
        stage, passes = self.stage(name)
        if isinstance(stage, Recover):
            # As at a stream's start, where the solution is waited for: all its passes are enabled.
            if stage._progress.pending is not None:
                stage._progress.pending.result()
            stage._progress.pending, stage._progress.frames = None, 0
        stage.begin()
        for step in passes:
            if step.enabled is None or step.enabled():
                for rows in _bands(step.rows, bands):
                    step.launch(rows)
        return self.written(name, stage)

    def written(self, name: str, stage: Stage | None = None) -> dict[str, np.ndarray]:
        """Copies of what a stage writes."""
        stage = stage or self.stage(name)[0]
        return {output: self.get(output) for output in stage.wiring.writes}

    def set_params(self, **values: Any) -> None:
        """Change fields of the frame's values, as the next frame would."""
        params = self.get("params")
        for field, value in values.items():
            params[field] = value
        self.arrays["params"].assign(params)

    def state(self) -> dict[str, np.ndarray]:
        """Copies of all arrays, to be put back with ``restore``."""
        return {name: self.get(name) for name, array in self.arrays.items() if isinstance(array, wp.array)}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Put back what ``state`` returned, with nothing before the ball."""
        self.pipeline.inputs.covered = False
        for name, values in state.items():
            if values.size:
                self.arrays[name].assign(values)


def _lanes(array: Any) -> tuple[int, ...]:
    return tuple(getattr(array.dtype, "_shape_", ()))


def _bands(rows: int | None, bands: int) -> list[tuple[int, int] | None]:
    if rows is None or bands == 1:
        return [None]
    edges = [rows * band // bands for band in range(bands + 1)]
    return [(start, stop) for start, stop in itertools.pairwise(edges) if stop > start]


def numbers(values: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """The numeric parts of an array, those of a structure by name."""
    if values.dtype.names is None:
        yield "", values
        return
    for name in values.dtype.names:
        for inner, part in numbers(values[name]):
            yield f".{name}{inner}", part


def assert_finite(outputs: dict[str, np.ndarray], cause: str = "") -> None:
    """Every number that a stage wrote is one; those that are documented to be infinite are not NaN."""
    for name, values in outputs.items():
        for part, found in numbers(values):
            if found.dtype.kind == "f":
                good = (
                    ~np.isnan(found) & ~np.isneginf(found) if f"{name}{part}" in MAY_BE_INFINITE else np.isfinite(found)
                )
                assert good.all(), f"{name}{part}: {(~good).sum()} of {good.size} values are not finite {cause}"


def assert_same_bits(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> None:
    """Outputs are equal bit for bit."""
    assert one.keys() == other.keys()
    for name, values in one.items():
        for (part, a), (_, b) in zip(numbers(values), numbers(other[name]), strict=True):
            assert a.tobytes() == b.tobytes(), f"{name}{part}: {(a != b).mean():.3%} of the values differ"


def solid_angles(height: int, width: int) -> np.ndarray:
    """Solid angle of every texel of a row, (height, 1)."""
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    return ((edges[:-1] - edges[1:]) * 2.0 * math.pi / width)[:, None]


def _spec_of(name: str, features: Features) -> ArraySpec:
    """What the stage that writes a resource declares of it."""
    for kind in STAGES:
        wiring = kind.wire(features)
        if isinstance(wiring, Wiring) and name in wiring.writes:
            return kind(features, wiring).arrays()[name]
    raise ValueError(f"no stage writes {name}")


def blind_camera() -> dict[str, Any]:
    """What stages read of a camera that looks nowhere: no direction is projected into its picture.

    One ball without extent, as all scenes with a captured environment have one: a GPU's stages read the first.
    """
    return {
        "pose": None,
        "frame": wp.zeros((1, 1), dtype=wp.vec3ub),
        "linear_frame": wp.zeros((0, 0), dtype=wp.vec3),
        "decode": wp.zeros(257, dtype=wp.vec3),
        "rays": wp.zeros((1, 1), dtype=wp.vec2),
        "params": wp.zeros(1, dtype=FrameParams),
        "probes": wp.zeros(1, dtype=BallRecord),
        "ray_scene": RayScene(),
    }


class LoneStage:
    """A stage of the environment by itself, with an environment of any height."""

    def __init__(self, device: str, name: str, method: str, height: int) -> None:
        request = COMBINATIONS[combination_of(name, method)]
        request = dataclasses.replace(request, quality=dataclasses.replace(request.quality, environment_height=height))
        kind = next(stage for stage in STAGES if stage.name == name)
        features = find_features(request)
        wiring = kind.wire(features)
        assert isinstance(wiring, Wiring)
        self.stage = kind(features, wiring)
        self.arrays = Arrays()
        with wp.ScopedDevice(device):
            for name, value in blind_camera().items():
                self.arrays.add(name, value)
            for read in wiring.reads:
                if read not in self.arrays:
                    spec = _spec_of(read, features)
                    self.arrays.add(read, wp.full(spec.shape, spec.fill, dtype=spec.dtype))
            for own, spec in self.stage.arrays().items():
                self.arrays.add(own, wp.full(spec.shape, spec.fill, dtype=spec.dtype))
            self.passes = self.stage.build(self.arrays, wp.get_device(device))

    def run(self, **inputs: np.ndarray) -> dict[str, np.ndarray]:
        """Run on the given inputs; returns copies of what the stage writes."""
        for name, values in inputs.items():
            self.arrays[name].assign(np.ascontiguousarray(values, np.float32))
        for step in self.passes:
            step.launch(None)
        return {name: np.array(self.arrays[name].numpy()) for name in self.stage.wiring.writes}
