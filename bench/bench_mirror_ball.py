"""What the mirror ball shows of virtual objects, 640x480, every method; light, objects, shadows, alone and together."""

from __future__ import annotations

import numpy as np
import warp as wp

from bench.common import measure, report
from tests.kernel_rig import constant_environment, records, shape
from warp_ar.kernels import color
from warp_ar.kernels.objects.reflect import DistantLight, DistantLightConfig
from warp_ar.kernels.objects.shade import ShadeConfig
from warp_ar.kernels.rays.trace import TraceConfig
from warp_ar.kernels.receiver import mirror_ball
from warp_ar.kernels.receiver.receiver import Receiver, RelightConfig, make_receiver
from warp_ar.kernels.structs import (
    DIRECTIONAL,
    LAMBERT,
    PLANE,
    SPHERE,
    FrameParams,
    KeyLight,
    Light,
    Material,
    Probe,
    RayScene,
    Shape,
    make_picture,
)
from warp_ar.stages.mirror_ball import SAMPLES

H, W, FOCAL = 480, 640, 600.0
RHO, CODE, SHADOW = 0.85, 188, 0.5
CASES = {"light": (False, True, False), "objects": (True, False, False), "all": (True, True, True)}
"""By name: whether there are objects, light and shadows."""
RELIGHTING = RelightConfig("reflectance", TraceConfig((SPHERE,), (PLANE,)), "sh", True)
# From 0.5 m above the desk, straight down on a ball of 38 pixels' radius: its inner half shows what is above.
CENTER, RADIUS = (0.0, 0.0, 0.04), 0.035
# A pixel on the left, away from the sphere, whose ray goes down to the desk outside the ball's shadow.
PIXEL = H // 2, W // 2 - round(0.9 * RADIUS * FOCAL / 0.56)


def make_world(device: str) -> tuple[wp.array, RayScene, wp.array]:
    """Camera, a sphere on a desk, and a sun."""
    camera = {
        "camera_position": (0.0, 0.0, 0.6),
        "world_from_camera": np.diag([1.0, -1.0, -1.0]),
        "focal": (FOCAL, FOCAL),
        "principal": (W / 2, H / 2),
        "ball_rect": (H // 2 - 42, H // 2 + 42, W // 2 - 42, W // 2 + 42),
    }
    sun = {"kind": DIRECTIONAL, "direction": (0.0, 0.0, -1.0), "intensity": (0.5,) * 3}
    scene = RayScene()
    scene.proxies = records(Shape, shape(PLANE, (0, 0, 0), (2, 2, 0)), device=device)
    scene.objects = records(Shape, shape(SPHERE, (0.12, 0.0, 0.04), (0.04,) * 3, 0), device=device)
    scene.materials = records(
        Material,
        {"model": LAMBERT, "base_color": (0.8,) * 3, "base_texture": -1, "specular_texture": -1},
        device=device,
    )
    return records(FrameParams, camera, device=device), scene, records(Light, sun, device=device)


def make_config(objects: bool, lit: bool, shaded: bool) -> mirror_ball.MirrorBallConfig:
    """What the kernel is compiled for."""
    trace = TraceConfig((SPHERE,), (PLANE,))
    forms = DistantLightConfig(trace, (LAMBERT,), False, "sh", False, True)
    shading = ShadeConfig(forms, (DIRECTIONAL,), 1) if objects else None
    return mirror_ball.MirrorBallConfig(trace, shading, RELIGHTING if lit else None, shaded)


def make_desk(device: str, irradiance: wp.array) -> Receiver:
    """A grey frame, the ball, and what is known of its light."""
    columns, rows = np.meshgrid((np.arange(W) - W / 2) / FOCAL, (np.arange(H) - H / 2) / FOCAL)
    rays = wp.array(np.stack([columns, rows], -1), dtype=wp.vec2, device=device)
    frame = wp.full((H, W), wp.vec3ub(CODE, CODE, CODE), dtype=wp.vec3ub, device=device)
    decode = wp.array(color.decode_table("srgb"), dtype=wp.vec3, device=device)
    probes = records(Probe, {"center": CENTER, "radius": RADIUS, "reflectance": (RHO,) * 3}, device=device)
    keys = records(KeyLight, {"direction": (0.6, 0, 0.8), "directionality": 0.5}, device=device)
    picture = make_picture(frame, decode, rays)
    return make_receiver(RELIGHTING, picture, probes=probes, key_lights=keys, irradiance=irradiance)


def main(device: str) -> None:
    params, scene, lights = make_world(device)
    irradiance = wp.array(constant_environment(1.0), dtype=wp.vec3, device=device)
    receiver = make_desk(device, irradiance)
    surroundings = DistantLight()
    surroundings.irradiance_sh = irradiance
    ratio = wp.full((H, W), wp.vec3(SHADOW, SHADOW, SHADOW), dtype=wp.vec3, device=device)
    out = wp.zeros((H, W), wp.vec3, device=device)
    seen = float(color.decode_table("srgb")[CODE, 0])
    desk_light = RHO * 0.5 / np.pi * seen / RHO
    expected = {"light": desk_light, "objects": 0.0, "all": desk_light + seen * (SHADOW - 1.0)}
    for case, (objects, lit, shaded) in CASES.items():
        config, contenders = make_config(objects, lit, shaded), {}
        for method, samples in SAMPLES.items():

            def call(config: mirror_ball.MirrorBallConfig = config, samples: int = samples) -> None:
                inputs = (params, scene, lights, surroundings, receiver, ratio)
                mirror_ball.mirror_ball(config, *inputs, out, samples=samples)

            call()
            found = out.numpy()
            assert np.isfinite(found).all(), (case, method)
            assert abs(found[PIXEL][0] - expected[case]) < 0.01 * seen, (case, method, found[PIXEL], expected[case])
            right = found[:, W // 2 + 5 :]
            assert (abs(right - found[:, W // 2 - 5 : 0 : -1]).max() > 0.1) == objects, (case, method)
            contenders[method] = call
        for method, times in measure(contenders, device).items():
            report(f"mirror_ball {W}x{H} {case} {method}", times, device)
