"""Unwrapping of a mirror ball by map size and method; beside it ``cv2.remap`` with ready-made coordinates."""

from __future__ import annotations

import dataclasses
from typing import Any

import cv2
import numpy as np
import warp as wp

from bench.common import measure, paired_ratio, report
from warp_ar.kernels.color import decode_table
from warp_ar.kernels.environment import unwrap
from warp_ar.kernels.structs import BOX, FrameParams, Material, Probe, RayScene, Shape, Texture, make_environment_view


@dataclasses.dataclass(frozen=True)
class Case:
    """One unwrapping."""

    name: str
    height: int
    """Rows of the map."""
    ball_pixels: int
    """Radius of the ball in the frame."""
    method: str
    boxes: int = 0
    """Proxies that could hide it."""


CASES = (
    Case("low", 32, 40, "area"),
    Case("medium_bilinear", 64, 40, "bilinear"),
    Case("medium", 64, 40, "area"),
    Case("medium_two_boxes", 64, 40, "area", 2),
    Case("medium_close", 64, 160, "area"),
    Case("high", 128, 40, "area"),
)
SIZE = (640, 480)
DISTANCE, RADIUS = 0.6, 0.035


def empty_scene(boxes: int) -> RayScene:
    """Boxes beside the ball."""
    shapes = np.zeros(boxes, np.dtype(Shape.numpy_dtype()))
    shapes["kind"], shapes["rotation"], shapes["scale"], shapes["extent"] = BOX, np.eye(3), 1.0, 0.05
    shapes["position"] = (0.0, 0.3, 0.0)
    scene = RayScene()
    scene.proxies = wp.array(shapes, dtype=Shape) if boxes else wp.zeros(0, dtype=Shape)
    scene.objects, scene.materials = wp.zeros(0, dtype=Shape), wp.zeros(0, dtype=Material)
    scene.textures, scene.texels = wp.zeros(0, dtype=Texture), wp.zeros(0, dtype=wp.vec3)
    scene.vertex_normals, scene.vertex_uvs = wp.zeros(0, dtype=wp.vec3), wp.zeros(0, dtype=wp.vec2)
    return scene


def run_case(case: Case, device: Any) -> None:
    width, height = SIZE
    focal = case.ball_pixels * np.sqrt((DISTANCE / RADIUS) ** 2 - 1)
    params = np.zeros(1, np.dtype(FrameParams.numpy_dtype()))
    params["camera_position"], params["world_from_camera"] = (DISTANCE, 0, 0), [[0, 0, -1], [1, 0, 0], [0, -1, 0]]
    params["focal"], params["principal"] = focal, ((width - 1) / 2, (height - 1) / 2)
    ball = np.zeros(1, np.dtype(Probe.numpy_dtype()))
    ball["radius"], ball["reflectance"] = RADIUS, 0.85
    x, y = np.meshgrid(np.arange(width) - (width - 1) / 2, np.arange(height) - (height - 1) / 2)
    picture = np.random.default_rng(0).integers(0, 256, (height, width, 3)).astype(np.uint8)
    scene, config = empty_scene(case.boxes), unwrap.ProjectConfig((BOX,) if case.boxes else ())
    params, ball = wp.array(params, dtype=FrameParams), wp.array(ball, dtype=Probe)
    rays = wp.array(np.stack([x, y], -1) / focal, dtype=wp.vec2)
    table, frame = wp.array(decode_table("srgb"), dtype=wp.vec3), wp.array(picture, dtype=wp.vec3ub)
    shape = (case.height, 2 * case.height)
    corners = wp.zeros((shape[0] + 1, shape[1] + 1, 1), dtype=wp.vec3)
    radiance, clipped = (wp.zeros(shape, dtype=wp.vec3) for _ in range(2))
    confidence = wp.zeros(shape, dtype=wp.float32)

    view = make_environment_view(radiance, confidence, clipped)

    def project() -> None:
        unwrap.project_corners(params, ball, rays, scene, corners, config=config)

    def gather() -> None:
        unwrap.gather_probe(frame, table, ball, corners, view, method=case.method)

    # Right before fast: the map of a constant frame is constant.
    frame.fill_(wp.vec3ub(100, 100, 100))
    project()
    gather()
    seen = confidence.numpy() > 0
    assert 0.5 < seen.mean() < 1.0
    assert np.ptp(radiance.numpy()[seen], axis=0).max() == 0.0
    frame.assign(picture)

    contenders = {"project": project, "gather": gather}
    if wp.get_device(device).is_cpu:
        at = corners.numpy()[:-1, :-1, 0]
        map_x, map_y = np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])
        contenders["remap"] = lambda: cv2.remap(picture, map_x, map_y, cv2.INTER_LINEAR)
    times = measure(contenders, device)
    ratio = {"over_remap": round(paired_ratio(times, "gather", "remap"), 2)} if "remap" in times else {}
    report(f"unwrap_{case.name}_project", times["project"], device)
    report(f"unwrap_{case.name}_gather", times["gather"], device, **ratio)


def main(device: str) -> None:
    with wp.ScopedDevice(device):
        for case in CASES:
            run_case(case, device)
