"""Light of what emits against the path tracer, which only meets it: receivers, shadows, and every kind of lobe."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp

from tests.kernel_rig import look_at
from tests.test_path_tracer import ERRORS
from warp_ar.accuracy.path_tracer import PathTracer, TracedPicture
from warp_ar.kernels.objects.reflect import DistantLight, DistantLightConfig
from warp_ar.kernels.objects.shade import NearPoint, ShadeConfig, make_shade_hit
from warp_ar.kernels.rays.area_lights import make_area_count, make_area_sample
from warp_ar.kernels.rays.shadow import LightSample, make_shadow, tile_turn
from warp_ar.kernels.rays.shapes import FAR
from warp_ar.kernels.rays.trace import TraceConfig, make_trace
from warp_ar.kernels.split_sum import integrate_dfg
from warp_ar.kernels.structs import LAMBERT, METALLIC_ROUGHNESS, MIRROR, PHONG, Light, RayScene
from warp_ar.scene import (
    AreaLight,
    Camera,
    LambertMaterial,
    MetallicRoughnessMaterial,
    MirrorMaterial,
    Object,
    PhongMaterial,
    Pose,
    Proxy,
    Scene,
)
from warp_ar.scene.pixel_rays import pixel_rays
from warp_ar.scene.ray_scene import HostScene

pytestmark = pytest.mark.slow

CAMERA = Camera(32, 24, 40.0, 40.0, 15.5, 11.5)
NIGHT = np.zeros((8, 16, 3), np.float32)
RHO = 0.6
SAMPLES = 64
FINE = 4
"""Pixels of the kernel along one of the path tracer, which spreads its paths over it."""
# Of the sixteen patterns of 64 places in a pixel, and the kernel's sixteen places within it.
PATTERN = 0.05

TRACE = TraceConfig(objects=(0, 1, 2, 3), proxies=(0, 1, 2, 3), detail=True).general()
CONFIG = ShadeConfig(
    DistantLightConfig(TRACE, tuple(sorted(map(int, (LAMBERT, PHONG, METALLIC_ROUGHNESS, MIRROR)))), True, "none", True,
                       False, gathered=False),
    (), 1, area_samples=SAMPLES,
)  # fmt: skip
shade_hit, is_lit = make_shade_hit(CONFIG), make_shadow(TRACE)
area_count, area_sample = make_area_count(SAMPLES), make_area_sample(SAMPLES)
closest_object, closest_proxy = make_trace(TRACE).closest_object, make_trace(TRACE).closest_proxy


@wp.kernel(enable_backward=False, module="unique")
def picture_kernel(
    # In:
    scene: RayScene,
    lights: wp.array[Light],
    distant: DistantLight,
    origin: wp.vec3,
    directions: wp.array2d[wp.vec3],
    reflectance: wp.float32,
    # Out:
    radiance_out: wp.array2d[wp.vec3],
):
    i, j = wp.tid()
    direction = directions[i, j]
    hit = closest_object(scene, origin, direction, FAR)
    ground = closest_proxy(scene, origin, direction, hit.t)
    result = wp.vec3()
    turn = tile_turn(i, j)
    if ground.shape >= 0:
        count = area_count(scene)
        for k in range(count):
            sample = area_sample(scene, ground.point, ground.normal, k, count, turn)
            cosine = wp.dot(ground.geometric_normal, sample.wi)
            if cosine > 0.0:
                light = LightSample()
                light.wi = sample.wi
                light.distance = sample.distance
                if is_lit(scene, ground.point, ground.geometric_normal, ground.error, light):
                    result += reflectance / wp.pi * cosine * sample.irradiance_normal
    elif hit.shape >= 0:
        result = shade_hit(scene, lights, distant, hit, direction, NearPoint(), turn, 0.0)
    radiance_out[i, j] = result


def picture(scene: Scene, pose: Pose, device: str) -> npt.NDArray[Any]:
    """Radiance of pixels under the area lights alone, (h, w, 3)."""
    height, width = scene.camera.height, scene.camera.width
    fine = scene.camera.scaled_to(FINE * width, FINE * height)
    with wp.ScopedDevice(device):
        host = HostScene(scene, wp.get_device(device))
        distant = DistantLight()
        distant.dfg = wp.zeros((32, 32), dtype=wp.vec2)
        integrate_dfg(distant.dfg)
        rays = np.concatenate([pixel_rays(fine), np.ones((fine.height, fine.width, 1))], axis=2)
        inverse = pose.inverse()
        directions = wp.array((rays @ inverse.rotation.T).astype(np.float32), dtype=wp.vec3)
        out = wp.zeros(directions.shape, dtype=wp.vec3)
        inputs = [host.ray_scene, None, distant, wp.vec3(*map(float, inverse.translation)), directions, RHO]
        wp.launch(picture_kernel, out.shape, inputs, [out])
        return out.numpy().reshape(height, FINE, width, FINE, 3).mean(axis=(1, 3))


def trace(scene: Scene, pose: Pose, device: str, samples: int) -> TracedPicture:
    tracer = PathTracer(
        scene, NIGHT, None, pose, device=device, reflectances=((RHO,) * 3,) * len(scene.proxies), seed=1
    )
    tracer.sample(samples)
    return tracer.picture()


def check(shown: npt.NDArray[Any], traced: TracedPicture) -> None:
    """The mean within its standard error, and hardly a pixel far off."""
    where = (shown.max(axis=2) > 0.0) | (traced.radiance.max(axis=2) > 0.0)
    assert where.sum() > 15
    off = (shown - traced.radiance)[where].astype(np.float64)
    error = traced.error[where].astype(np.float64)
    mean = math.sqrt((error**2).sum()) / error.size
    assert abs(off.mean()) <= ERRORS * mean + 0.01 * shown[where].mean(), (off.mean(), mean, shown[where].mean())
    # Few paths find what long tails of a lobe hold, and then know nothing of their error: other pixels are asked.
    sure = error < 0.3 * traced.radiance[where]
    within = np.abs(off) <= 6.0 * error + PATTERN * np.abs(shown[where])
    assert sure.sum() > 45
    assert within[sure].mean() > 0.97


LIGHTS = {
    "rect": AreaLight("rect", 4.0, (1.0, 0.7, 0.4), at=(0.1, 0.0, 0.3), rotate=(160.0, 0.0, 30.0), size=(0.2, 0.1)),
    "sphere": AreaLight("sphere", 4.0, at=(0.1, 0.0, 0.25), radius=0.06),
}  # fmt: skip


@pytest.mark.parametrize("kind", LIGHTS)
def test_receiver_and_soft_shadow(kind: str, device: str) -> None:
    """A black box throws the shadow, so that no light goes to and fro."""
    box = Object("box", size=(0.05, 0.05, 0.1), at=(-0.03, 0.0, 0.05), material=LambertMaterial((0.0, 0.0, 0.0)))
    scene = Scene(CAMERA, proxies=(Proxy("plane", size=(3.0, 3.0)),), objects=(box, LIGHTS[kind].as_object()))
    pose = look_at((-0.2, -0.5, 0.5))
    check(picture(scene, pose, device), trace(scene, pose, device, 192))


@pytest.mark.parametrize(
    "material",
    [
        PhongMaterial((0.0, 0.0, 0.0), (0.9, 0.9, 0.9), 500.0),
        MetallicRoughnessMaterial((0.2, 0.4, 0.8), 0.0, 0.3),
        MirrorMaterial((0.9, 0.9, 0.9)),
    ],
    ids=["sharp phong", "plastic", "mirror"],
)
def test_objects_and_highlights_of_the_lights_shape(material: Any, device: str) -> None:
    """A ball under a rect, seen from where the light's image is on it."""
    ball = Object("sphere", radius=0.1, material=material)
    scene = Scene(CAMERA, objects=(ball, LIGHTS["rect"].as_object()))
    pose = look_at((0.15, -0.2, 0.22))
    check(picture(scene, pose, device), trace(scene, pose, device, 192))
