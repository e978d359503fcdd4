"""Check that the pictures show the places of virtual objects."""

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
"""Largest number of a recording's poses that are tested."""


def check_objects(scene: Scene, camera: Camera, poses: Sequence[Pose]) -> list[Finding]:
    """Return a finding that names the objects outside all pictures, if there are any.

    Args:
        scene: The scene.
        camera: Camera of the pictures.
        poses: ``camera_from_world`` of each picture.
    """
    found = find_outside(scene, camera, poses)
    if not found:
        return []
    outside = [f"[[object]] {index} ({scene.objects[index].shape}) lies {side}" for index, side in found.items()]
    where = f"in all {len(poses)} frames that were looked at" if len(poses) > 1 else "so it cannot be seen"
    remedy = "write at, in metres, where the picture shows the desk, or use pictures that show more of it"
    return [Finding("object.outside", f"{', '.join(outside)}, {where}", remedy)]


def find_outside(scene: Scene, camera: Camera, poses: Sequence[Pose]) -> dict[int, str]:
    """Return the indices of objects outside all pictures, each with a phrase such as "left of the picture".

    The phrase refers to the first picture. Objects that move, have a marker of their own, or emit light may be outside
    and are left out.

    Args:
        scene: The scene.
        camera: Camera of the pictures.
        poses: ``camera_from_world`` of each picture.
    """
    found = {}
    for index, item in enumerate(scene.objects):
        if item.animate or item.play or item.marker or isinstance(item.material, EmissiveMaterial):
            continue
        try:
            ball = sphere_around(item)
        except SceneError:
            continue  # this error is reported when the scene is run
        around = [ball_outline([ball])]
        if poses and all(screen_rects(around, pose, camera) == [EMPTY] for pose in poses):
            found[index] = _side(ball, poses[0], camera)
    return found


def written_poses(scene: Scene) -> list[Pose]:
    """Return a sample of the poses that a scene gives, spread over all frames; empty if it gives none."""
    if scene.pose is None:
        return []
    poses = scene.pose.poses
    return [Pose(np.reshape(r, (3, 3)), np.array(t)) for r, t in poses[:: -(-len(poses) // MOST_POSES)]]


def sphere_around(item: Object) -> Probe:
    """Return a sphere around an object at time 0, as centre and radius of a ``Probe``.

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
    """Return centre (3,) and radius of a sphere around a mesh, in the mesh's coordinates."""
    low, high = mesh.bounds.astype(np.float64)
    return (low + high) / 2, float(np.linalg.norm(high - low)) / 2


def _reach(item: Object) -> float:
    """Return an upper bound on the distance of a non-mesh shape's points from its origin, in metres before scaling."""
    return max(
        item.major_radius + item.minor_radius,
        math.hypot(item.radius, item.length / 2),
        float(np.linalg.norm(item.size)) / 2,
    )


def _side(ball: Probe, pose: Pose, camera: Camera) -> str:
    """Return a phrase for the place of a ball outside the picture, such as "left of the picture"."""
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
