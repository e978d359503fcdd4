"""The plane that a ball stands on, from what a hand picks in one photograph: the camera's pose without a marker."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.errors import UsageError
from warp_ar.scene import Camera, Pose
from warp_ar.scene.pixel_rays import undistorted

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Support:
    """A plane before the camera: the world's z = 0."""

    pose: Pose
    """``camera_from_world``: x right, y away from the camera, z up; metres, or radii where no length is known."""
    tilt_deviation: float
    """Standard deviation of the plane's normal, degrees."""
    error: float
    """Pixels by which the picked points miss the plane's rectangle; 0 where nothing is left over to tell."""


def plane_from_rectangle(
    camera: Camera, corners: Sequence[Sequence[float]], size: tuple[float, float], picked: float = 1.0
) -> Support:
    """The plane of a rectangle of known size, such as a sheet of paper, from its corners in the picture.

    Args:
        camera: The camera.
        corners: Four pixels in order round the rectangle; the first side is ``size[0]`` long and becomes the world's x.
        size: Lengths of the first and the second side, metres.
        picked: Pixels (standard deviation) by which a corner may be off.

    Raises:
        UsageError: The points are no rectangle seen from above.
    """
    points = np.array(corners, float)
    if points.shape != (4, 2) or not np.isfinite(points).all() or min(size) <= 0.0:
        raise UsageError(f"rectangle {corners}: expected four pixels round it, and two lengths above 0")
    w, h = size
    corners_3d = np.array([[-w, -h, 0.0], [w, -h, 0.0], [w, h, 0.0], [-w, h, 0.0]]) / 2
    # Turned the other way round the picture shows the rectangle's underside; its y then points to the camera.
    (ax, ay), (bx, by) = points[1] - points[0], points[2] - points[0]
    area = 0.5 * (ax * by - ay * bx)
    if abs(area) < 8.0:
        raise UsageError("rectangle: its corners lie on a line; pick four that span an area")
    if area > 0:
        corners_3d[:, 1] *= -1
    pose, error = _solve(camera, corners_3d, points)
    normals = []
    rng = np.random.default_rng(0)
    for _ in range(24):
        moved, _ = _solve(camera, corners_3d, points + picked * rng.normal(size=(4, 2)))
        normals.append(moved.rotation[:, 2])
    spread = np.degrees(np.arccos(np.clip(np.array(normals) @ pose.rotation[:, 2], -1.0, 1.0)))
    return Support(pose, float(np.sqrt((spread**2).mean())), error)


def _solve(camera: Camera, corners: Array, points: Array) -> tuple[Pose, float]:
    found, rotations, translations, errors = cv2.solvePnPGeneric(
        corners, points, camera.matrix(), np.array(camera.distortion), flags=cv2.SOLVEPNP_IPPE
    )
    # Of the two solutions of a plane the one that explains the corners better, seen from above.
    for k in np.argsort(np.array(errors).ravel()) if found else ():
        rotation, translation = cv2.Rodrigues(rotations[k])[0], translations[k].ravel()
        if translation[2] > 0 and (rotation.T @ -translation)[2] > 0:
            return Pose(rotation, translation), float(np.array(errors).ravel()[k])
    raise UsageError("rectangle: no plane before the camera is seen like that; pick its corners in order round it")


def plane_from_contact(
    sphere: Sequence[float], camera: Camera, contact: Sequence[float], radius: float = 1.0, picked: float = 2.0
) -> Support:
    """The plane that touches a ball at the point that is seen, or guessed through the ball, at a pixel.

    A ball on a table touches it behind its lower half. The ray through the pixel leaves the ball there: the normal is
    the ball's own at that point. A pixel off by d is a normal off by d over the radius in pixels, more near the rim.

    Args:
        sphere: The ball's centre in the camera's frame over its radius.
        camera: The camera.
        contact: Column and row of the point of contact.
        radius: Of the ball, metres; 1 if not known: the world is then in radii.
        picked: Pixels (standard deviation) by which the contact may be off.

    Raises:
        UsageError: The pixel is not on the ball.
    """
    center = np.array(sphere, float)

    def normal(pixel: Array) -> Array | None:
        flat = undistorted(camera, pixel.reshape(1, 2))[0]
        ray = np.array([*flat, 1.0]) / math.hypot(*flat, 1.0)
        b = float(ray @ center)
        disc = b * b - float(center @ center) + 1.0
        return None if disc < 0.0 else center - (b + math.sqrt(disc)) * ray

    up = normal(np.array(contact, float))
    if up is None:
        raise UsageError(f"contact {contact[0]:g}, {contact[1]:g}: not on the ball; pick where it touches its support")
    around = [normal(np.array(contact, float) + picked * np.array(step)) for step in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    turned = [float(np.degrees(np.arccos(np.clip(up @ other, -1.0, 1.0)))) for other in around if other is not None]
    forward = np.array([0.0, 0.0, 1.0]) - up[2] * up
    if np.linalg.norm(forward) < 1e-6:
        forward = np.array([0.0, -1.0, 0.0]) + up[1] * up
    forward /= np.linalg.norm(forward)
    rotation = np.stack([np.cross(forward, up), forward, up], 1)
    foot = radius * (center - up)
    # The world's origin is the point of contact.
    return Support(
        Pose(rotation, foot), float(np.hypot(max(turned[:2], default=90.0), max(turned[2:], default=90.0))), 0.0
    )
