"""What the mirror ball shows of virtual objects, 640x480, every method; light, objects, shadows, alone and together."""

from __future__ import annotations

import numpy as np
import warp as wp

from bench.common import measure, report
from warp_ar.kernels import color, mirror_ball
from warp_ar.kernels.receiver import Receiver, RelightConfig, make_receiver
from warp_ar.kernels.reflect import DistantLight, DistantLightConfig
from warp_ar.kernels.shade import ShadeConfig
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
from warp_ar.kernels.trace import TraceConfig
from warp_ar.stages.mirror_ball import SAMPLES

H, W, FOCAL = 480, 640, 600.0
RHO, CODE, SHADOW = 0.85, 188, 0.5
CASES = {"light": (False, True, False), "objects": (True, False, False), "all": (True, True, True)}
"""By name: whether there are objects, light and shadows."""


def _records(struct: type, device: str, *values: dict) -> wp.array:
    out = np.zeros(len(values), np.dtype(struct.numpy_dtype()))
    for record, value in zip(out, values, strict=True):
        for key, item in value.items():
            record[key] = item
    return wp.array(out, dtype=struct, device=device)


def _shape(kind: int, position: tuple, extent: tuple) -> dict:
    return {"kind": kind, "rotation": np.eye(3), "position": position, "scale": 1.0, "extent": extent}


def main(device: str) -> None:
    columns, rows = np.meshgrid((np.arange(W) - W / 2) / FOCAL, (np.arange(H) - H / 2) / FOCAL)
    rays = wp.array(np.stack([columns, rows], -1), dtype=wp.vec2, device=device)
    frame = wp.full((H, W), wp.vec3ub(CODE, CODE, CODE), dtype=wp.vec3ub, device=device)
    # From 0.5 m above the desk, straight down on a ball of 38 pixels' radius: its inner half shows what is above.
    center, radius = np.array([0.0, 0.0, 0.04]), 0.035
    camera = {
        "camera_position": (0.0, 0.0, 0.6),
        "world_from_camera": np.diag([1.0, -1.0, -1.0]),
        "focal": (FOCAL, FOCAL),
        "principal": (W / 2, H / 2),
        "ball_rect": (H // 2 - 42, H // 2 + 42, W // 2 - 42, W // 2 + 42),
    }
    params = _records(FrameParams, device, camera)
    sun = {"kind": DIRECTIONAL, "direction": (0.0, 0.0, -1.0), "intensity": (0.5,) * 3}
    lights = _records(Light, device, sun)
    scene = RayScene()
    scene.proxies = _records(Shape, device, _shape(PLANE, (0, 0, 0), (2, 2, 0)))
    scene.objects = _records(Shape, device, _shape(SPHERE, (0.12, 0.0, 0.04), (0.04,) * 3))
    scene.materials = _records(
        Material, device, {"model": LAMBERT, "base_color": (0.8,) * 3, "base_texture": -1, "specular_texture": -1}
    )
    decode_table = color.decode_table("srgb")
    ratio = wp.full((H, W), wp.vec3(SHADOW, SHADOW, SHADOW), dtype=wp.vec3, device=device)
    sh = np.zeros((9, 3), np.float32)
    sh[0] = np.pi / 0.28209479
    irradiance = wp.array(sh, dtype=wp.vec3, device=device)
    surroundings = DistantLight()
    surroundings.irradiance_sh = irradiance
    out = wp.zeros((H, W), wp.vec3, device=device)
    # A pixel on the left, away from the sphere, whose ray goes down to the desk outside the ball's shadow.
    pixel = H // 2, W // 2 - round(0.9 * radius * FOCAL / 0.56)
    seen = float(decode_table[CODE, 0])
    desk_light = RHO * 0.5 / np.pi * seen / RHO
    expected = {"light": desk_light, "objects": 0.0, "all": desk_light + seen * (SHADOW - 1.0)}
    for case, (objects, lit, shaded) in CASES.items():
        contenders = {}
        for method, samples in SAMPLES.items():
            trace = TraceConfig((SPHERE,), (PLANE,))
            forms = DistantLightConfig(trace, (LAMBERT,), False, "sh", False, True)
            relighting = RelightConfig("reflectance", trace, "sh", True)
            config = mirror_ball.MirrorBallConfig(
                trace,
                samples,
                ShadeConfig(forms, (DIRECTIONAL,), 1) if objects else None,
                relighting if lit else None,
                shaded,
            )
            probes = _records(Probe, device, {"center": center, "radius": radius, "reflectance": (RHO,) * 3})
            keys = _records(KeyLight, device, {"direction": (0.6, 0, 0.8), "directionality": 0.5})
            decode = wp.array(decode_table, dtype=wp.vec3, device=device)
            picture = make_picture(frame, decode, rays)
            receiver = make_receiver(relighting, picture, probes=probes, key_lights=keys, irradiance=irradiance)

            def call(config: mirror_ball.MirrorBallConfig = config, receiver: Receiver = receiver) -> None:
                inputs = (params, scene, lights, surroundings, receiver, ratio)
                mirror_ball.mirror_ball(config, *inputs, out)

            call()
            found = out.numpy()
            assert np.isfinite(found).all(), (case, method)
            assert abs(found[pixel][0] - expected[case]) < 0.01 * seen, (case, method, found[pixel], expected[case])
            right = found[:, W // 2 + 5 :]
            assert (abs(right - found[:, W // 2 - 5 : 0 : -1]).max() > 0.1) == objects, (case, method)
            contenders[method] = call
        for method, times in measure(contenders, device).items():
            report(f"mirror_ball {W}x{H} {case} {method}", times, device)
