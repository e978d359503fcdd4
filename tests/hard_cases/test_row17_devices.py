"""Row 17: CPU and CUDA agree: integers bit for bit, floats within a stated bound. Skipped without a CUDA device.

Every stage gets the same inputs, those of the CPU, so errors do not add up from stage to stage. CUDA contracts
multiplications and additions and has its own sine and exponential: a few units in the last place each.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import warp as wp

from tests.hard_cases import atlas, generators
from tests.hard_cases.rig import SIZE, Rig, numbers
from warp_ar.scene import Scene
from warp_ar.scene.shapes import torus_mesh

FRAMES = generators.frames(SIZE[1], SIZE[0])
CUDA = [str(device) for device in wp.get_cuda_devices()[:1]]


@dataclasses.dataclass(frozen=True)
class Bound:
    """How far a stage's floats may differ."""

    relative: float
    """Of a value, or of the largest one in its array where that is larger than it."""
    cause: str
    share: float = 0.0
    """Share of the elements that may differ by more: a ray or a sample falls on the other side of an edge."""


BOUNDS = {
    "unwrap": Bound(2e-4, "positions of 1e-7 of a frame's width, times the contrast of noise", 0.01),
    "accumulate": Bound(1e-5, "exponentials and a dozen roundings"),
    "recover": Bound(1e-3, "fits of many terms", 0.01),
    "fill": Bound(1e-5, "sums over a pyramid's levels"),
    "key_lights": Bound(1e-5, "sums over the map"),
    "irradiance": Bound(1e-5, "sums over the map, in the order of a block's lanes"),
    "prefilter": Bound(5e-5, "sums over the map and powers with exponents up to 1e3"),
    "visibility": Bound(1e-5, "a dozen roundings of a hit", 0.005),
    "summed_area": Bound(0.0, "integers"),
    "relight": Bound(1e-4, "shadow edges, powers of distances", 0.005),
    "environment_samples": Bound(1e-4, "cumulative sums inverted: a sample may fall into the neighbouring texel", 0.02),
    "environment_shadow": Bound(2e-3, "one of 64 rays may fall on the other side of an edge", 0.02),
    "near_field": Bound(2e-3, "one of 32 rays may fall on the other side of an edge", 0.05),
    "shade": Bound(5e-4, "powers, and edges of silhouettes and shadows", 0.02),
    "mirror_ball": Bound(5e-4, "as relight and shade, turned by the ball; edges of what it mirrors", 0.02),
    "composite": Bound(0.0, "thresholds are exact; a code may move where radiance lies within an ulp of one", 0.001),
    "declip": Bound(1e-4, "sums of sums over ten levels, and a power"),
    "expose": Bound(0.0, "as composite", 0.001),
}
DEFAULT = Bound(1e-3, "a stage that states no bound of its own", 0.02)
SEEN_ONLY = ("hits", "near_irradiance", "near_reflected")
"""Arrays that are defined only where an object is seen."""


def differences(one: np.ndarray, other: np.ndarray, relative: float) -> float:
    """Share of elements that differ by more than the bound; integers must be equal."""
    if one.size == 0:
        return 0.0
    if one.dtype.kind != "f":
        return float((one != other).mean())
    scale = np.abs(one[np.isfinite(one)]).max(initial=0.0)
    both = np.isfinite(one) & np.isfinite(other)
    near = np.abs(np.where(both, one, 0.0) - np.where(both, other, 0.0)) <= relative * scale
    return float((~((one == other) | (both & near))).mean())


def shortest_edge(scene: Scene) -> float:
    """Of the triangles of a scene's tori, metres."""
    meshes = [torus_mesh(one.major_radius, one.minor_radius) for one in scene.objects if one.shape == "torus"]
    corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).min())


def compare(cpu: Rig, other: Rig, stage: str) -> None:
    """Run a stage on both, on the CPU's inputs."""
    bound = BOUNDS.get(stage, DEFAULT)
    for name, values in cpu.state().items():
        # Shapes refer to meshes by numbers that belong to a device.
        if values.size and "mesh" not in (values.dtype.names or ()):
            other.arrays[name].assign(values)
    expected, found = cpu.run(stage), other.run(stage)
    seen = cpu.get("hit_object") >= 0 if "hit_object" in cpu.arrays else None
    for name, values in expected.items():
        for (part, a), (_, b) in zip(numbers(values), numbers(found[name]), strict=True):
            if seen is not None and name in SEEN_ONLY:
                a, b = a[seen], b[seen]
            # Where on its triangle a hit is, in shares of its edges: as coarse as the hit's point against them.
            on_triangle = values["error"].max() / shortest_edge(cpu.pipeline.scene) if part == ".weights" else 0.0
            share = differences(a, b, max(bound.relative, on_triangle))
            assert share <= bound.share, f"{name}{part}: {share:.4%} beyond {bound.relative:g} ({bound.cause})"


@pytest.mark.parametrize("combination", atlas.combinations(17))
@pytest.mark.skipif(not CUDA, reason="needs a CUDA device")
def test_cuda_agrees_with_cpu(combination):
    with Rig("cpu", combination=combination) as cpu, Rig(CUDA[0], combination=combination) as other:
        for name in ("noise", "torn"):
            cpu.frame(FRAMES[name])
            other.frame(FRAMES[name])
        for stage, _ in cpu.pipeline._scheduler._stages:
            compare(cpu, other, stage.name)


@pytest.mark.atlas(row=17, stage="pipeline")
@pytest.mark.skipif(not CUDA, reason="needs a CUDA device")
def test_pictures_of_cpu_and_cuda():
    """Whole frames, errors of all stages together: hardly a pixel is off by more than one code."""
    with Rig("cpu") as cpu, Rig(CUDA[0]) as cuda:
        for name in ("noise", "ramp", "one saturated pixel"):
            one, other = cpu.frame(FRAMES[name]).astype(int), cuda.frame(FRAMES[name]).astype(int)
            assert (np.abs(one - other) > 1).mean() < 0.01, name
