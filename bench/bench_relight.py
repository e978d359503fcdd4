"""Virtual light on a desk of one plane and one box, 640x480, every rung, light on the whole frame."""

from __future__ import annotations

import numpy as np
import warp as wp

from bench.common import measure, report
from warp_ar.kernels import color, relight, summed_area
from warp_ar.kernels.structs import BOX, PLANE, POINT, SPHERE, FrameParams, KeyLight, Light, Probe, RayScene, Shape
from warp_ar.kernels.visibility import TraceConfig

H, W = 480, 640


def _records(struct: type, device: str, *values: dict) -> wp.array:
    out = np.zeros(len(values), np.dtype(struct.numpy_dtype()))
    for record, value in zip(out, values, strict=True):
        for key, item in value.items():
            record[key] = item
    return wp.array(out, dtype=struct, device=device)


def _shape(kind: int, position: tuple, extent: tuple) -> dict:
    return {"kind": kind, "rotation": np.eye(3), "position": position, "scale": 1.0, "extent": extent, "material": -1}


def main(device: str) -> None:
    columns, rows = np.meshgrid((np.arange(W) - W / 2) / 600, (np.arange(H) - H / 2) / 600)
    rays = wp.array(np.stack([columns, rows], -1), dtype=wp.vec2, device=device)
    frame = wp.array(np.random.default_rng(0).integers(60, 200, (H, W, 3)), dtype=wp.vec3ub, device=device)
    table = wp.zeros((H, W), wp.uint32, device=device)
    summed_area.sum_area(frame, table)
    look_down = np.diag([1.0, -1.0, -1.0])
    camera = {"camera_position": (0, 0, 0.6), "world_from_camera": look_down, "light_rect": (0, H, 0, W)}
    params = _records(FrameParams, device, camera)
    light = {"kind": POINT, "position": (0.1, 0.1, 0.3), "intensity": (0.3,) * 3, "attenuation": (0, 0, 1)}
    lights = _records(Light, device, light)
    keys = _records(KeyLight, device, {"direction": (0.6, 0, 0.8), "dominance": 0.5})
    probes = _records(Probe, device, {"center": (-0.1, 0, 0.04), "radius": 0.035})
    scene = RayScene()
    scene.objects = _records(Shape, device, _shape(SPHERE, (0.05, 0, 0.05), (0.03, 0, 0)))
    scene.proxies = _records(
        Shape, device, _shape(PLANE, (0, 0, 0), (2, 2, 0)), _shape(BOX, (0, 0.15, 0.05), (0.1, 0.04, 0.05))
    )
    sh = np.zeros((9, 3), np.float32)
    sh[0] = np.pi / 0.28209479
    room = wp.array(sh, dtype=wp.vec3, device=device)
    decode = wp.array(color.decode_table("srgb"), dtype=wp.vec3, device=device)
    out = wp.zeros((H, W), wp.vec3, device=device)
    contenders = {}
    for rung in relight.RUNGS:
        config = relight.RelightConfig(rung, TraceConfig((SPHERE,), (PLANE, BOX)), "sh", True)

        def call(config: relight.RelightConfig = config) -> None:
            relight.relight(config, params, rays, frame, decode, table, scene, probes, lights, keys, room, out)

        call()
        bright = 0.3 * 0.3 / (np.pi * (0.02 + 0.09) ** 1.5)  # a white desk at the frame's centre
        centre = out.numpy()[H // 2, W // 2]
        assert ((centre > 0.0) & (centre <= bright * 1.01)).all(), (rung, centre)
        contenders[rung] = call
    for rung, times in measure(contenders, device).items():
        report(f"relight {W}x{H} {rung}", times, device)
