"""True if the pictures show the places where virtual objects stand."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from warp_ar.checks.finding import Finding
from warp_ar.errors import SceneError
from warp_ar.scene import Camera, EmissiveMaterial, Object, Pose, Probe, Scene
from warp_ar.scene.geometry import Mesh
from warp_ar.scene.object_materials import mesh_of
from warp_ar.scene.screen_extents import EMPTY, ball_outline, screen_rects

Array = npt.NDArray[np.float64]

MOST_POSES: Final = 120
"""Largest number of a recording's poses that are checked."""


def check_objects(scene: Scene, camera: Camera, poses: Sequence[Pose]) -> list[Finding]:
    """A finding that names the objects which no picture shows; arguments as those of ``find_outside``."""
    found = find_outside(scene, camera, poses)
    if not found:
        return []
    outside = [f"[[object]] {index} ({scene.objects[index].shape}) lies {side}" for index, side in found.items()]
    where = f"in all {len(poses)} frames that were looked at" if len(poses) > 1 else "so it cannot be seen"
    remedy = "write at, in metres, where the picture shows the desk, or use pictures that show more of it"
    return [Finding("object.outside", f"{', '.join(outside)}, {where}", remedy)]


def find_outside(scene: Scene, camera: Camera, poses: Sequence[Pose]) -> dict[int, str]:
    """The objects that no picture shows, by number, and on which side of the first picture they lie.

    Objects that move, that stand on a marker of their own, or that are there for the light that they emit, may lie
    outside.

    Args:
        scene: The scene.
        camera: It took the pictures.
        poses: ``camera_from_world`` of each picture.
    """
    found = {}
    for index, item in enumerate(scene.objects):
        if item.animate or item.play or item.marker or isinstance(item.material, EmissiveMaterial):
            continue
        try:
            ball = sphere_around(item)
        except SceneError:
            continue  # the run meets it too, and says it
        around = [ball_outline([ball])]
        if poses and all(screen_rects(around, pose, camera) == [EMPTY] for pose in poses):
            found[index] = _side(ball, poses[0], camera)
    return found


def written_poses(scene: Scene) -> list[Pose]:
    """Some of the poses that a scene without a marker has written down, from all of its frames."""
    if scene.pose is None:
        return []
    poses = scene.pose.poses
    return [Pose(np.reshape(r, (3, 3)), np.array(t)) for r, t in poses[:: -(-len(poses) // MOST_POSES)]]


def sphere_around(item: Object) -> Probe:
    """A sphere around an object where it stands at first.

    Raises:
        SceneError: Its mesh cannot be read.
    """
    mesh = mesh_of(item)
    middle, radius = np.zeros(3), _reach(item)
    if mesh is not None:
        middle, radius = _sphere_of(mesh)
    rotation, position = item.pose_at(0.0)
    x, y, z = map(float, rotation @ (item.scale * middle) + position)
    return Probe((x, y, z), item.scale * radius)


@functools.lru_cache(maxsize=64)
def _sphere_of(mesh: Mesh) -> tuple[Array, float]:
    """Centre (3,) and radius of a sphere around a mesh, in its own lengths."""
    low, high = mesh.vertices.min(0).astype(np.float64), mesh.vertices.max(0).astype(np.float64)
    return (low + high) / 2, float(np.linalg.norm(high - low)) / 2


def _reach(item: Object) -> float:
    """Return how far a shape that is no mesh reaches from its origin, in metres without its scale."""
    return max(
        item.major_radius + item.minor_radius,
        math.hypot(item.radius, item.length / 2),
        float(np.linalg.norm(item.size)) / 2,
    )


def _side(ball: Probe, pose: Pose, camera: Camera) -> str:
    """On which side of the picture something outside of it lies."""
    x, y, z = map(float, pose.apply(np.array(ball.center)))
    if z <= 0.0:
        return "behind the camera"
    column, row = camera.cx + camera.fx * x / z, camera.cy + camera.fy * y / z
    beyond = {
        "left of the picture": -column,
        "right of the picture": column - camera.width,
        "above the picture": -row,
        "below the picture": row - camera.height,
    }
    return max(beyond, key=beyond.__getitem__)
