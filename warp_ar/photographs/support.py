"""Support plane of a photograph from points selected by a user: the camera's pose without a marker."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.errors import UsageError
from warp_ar.scene import (
    Camera,
    CapturedLight,
    LambertMaterial,
    MetallicRoughnessMaterial,
    Object,
    Pose,
    PoseSpec,
    Proxy,
    Scene,
    SourceSpec,
)
from warp_ar.scene.calibration_file import load_calibration
from warp_ar.scene.pixel_rays import project, undistorted
from warp_ar.scene.pose_file import load_pose_file
from warp_ar.tracking.card_layout import CARD_MARKER
from warp_ar.tracking.markers import MarkerDetector, pattern_of

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

MODEL = "cameras", "images"
"""Files of a COLMAP model that are read, without suffix."""
FEWEST_MARKERS = 3
"""Smallest number of the printed card's markers that count as the card: clutter resembles single ones."""


@dataclasses.dataclass(frozen=True)
class Support:
    """Plane in front of the camera, which is z = 0 in the world."""

    pose: Pose
    """``camera_from_world``: x right, y away from the camera, z up; in metres, or in ball radii if no length is
    known."""
    tilt_deviation: float
    """Standard deviation of the plane's normal, degrees."""
    error: float
    """Root mean square distance in pixels of the selected points from the plane's points; 0 without redundancy."""
    ball_radius: float | None = None
    """Radius of the ball, metres, if it is known; None: the ball stands on the plane."""

    def radius_of(self, sphere: Sequence[float]) -> float:
        """Return the radius of the ball, from its centre in the camera's frame divided by its radius.

        Of all balls with the same outline, one whose centre is one radius above the plane stands on it.
        """
        if self.ball_radius is not None:
            return self.ball_radius
        up = self.pose.rotation[:, 2]
        return max(float(up @ self.pose.translation / (up @ np.array(sphere) - 1.0)), 1e-3)


def card_points(image: Image) -> tuple[Array, Array] | None:
    """Return corners of the printed card's markers, (n, 3) metres, and their pixels, (n, 2).

    The origin is the middle of the card's board: x right, y up the page, z out of it. Return None if fewer than
    ``FEWEST_MARKERS`` of its markers are visible.
    """
    known = pattern_of(CARD_MARKER).markers
    seen = MarkerDetector(CARD_MARKER.dictionary).detect(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    found = {one.id: one.corners for one in seen if one.id in known}
    if len(found) < FEWEST_MARKERS:
        return None
    return np.concatenate([known[number] for number in found]), np.concatenate(list(found.values())).astype(float)


def plane_from_points(
    camera: Camera, points: Sequence[Sequence[float]] | Array, pixels: Sequence[Sequence[float]] | Array
) -> Support:
    """Return the plane z = 0 and the camera's pose from the pixels of known points.

    Args:
        camera: The camera.
        points: Four or more points, metres, z up.
        pixels: Column and row of each point.

    Raises:
        UsageError: No camera pose explains the pixels.
    """
    world, seen = np.array(points, float), np.array(pixels, float)
    lens = camera.matrix(), np.array(camera.distortion)
    found, turn, translation = cv2.solvePnP(world, seen, *lens, flags=cv2.SOLVEPNP_SQPNP)
    if not found:
        raise UsageError("no camera sees these points at these pixels; is one of them mistaken?")
    turn, translation = cv2.solvePnPRefineLM(world, seen, *lens, turn, translation)
    pose = Pose(cv2.Rodrigues(turn)[0], translation.ravel())
    off = project(camera, pose.apply(world)) - seen
    return Support(pose, math.nan, float(np.sqrt((off**2).sum(1).mean())))


def focal_range(
    camera: Camera, find: Callable[[Camera], Support], count: int = 4, picked: float = 1.0
) -> tuple[Camera, float, float]:
    """Return a camera with the best focal length for selected points, and the smallest and largest that still fit.

    Args:
        camera: Camera whose focal length is unknown.
        find: Function from a camera to the plane.
        count: Number of points.
        picked: Standard deviation of a point in pixels. A length fits if it adds at most 4 ``picked``^2 to the sum of
            squared errors, which are two standard deviations.

    Raises:
        UsageError: No focal length explains the points.
    """
    lengths = math.hypot(camera.width, camera.height) * np.geomspace(0.4, 8.0, 121)
    tried = [dataclasses.replace(camera, fx=float(f), fy=float(f)) for f in lengths]
    squares, problem = np.full(len(tried), np.inf), None
    for k, one in enumerate(tried):
        try:
            squares[k] = find(one).error ** 2
        except UsageError as error:
            problem = error
    best = int(squares.argmin())
    if problem is not None and np.isinf(squares[best]):
        raise problem
    fits = lengths[squares <= squares[best] + 4.0 * picked**2 / count]
    around = squares[best - 1 : best + 2]
    if len(around) == 3 and np.isfinite(around).all() and (bend := around[0] - 2.0 * around[1] + around[2]) > 0.0:
        # The vertex of the parabola through the best three.
        focal = lengths[best] * (lengths[1] / lengths[0]) ** (0.5 * (around[0] - around[2]) / bend)
        return dataclasses.replace(camera, fx=float(focal), fy=float(focal)), float(fits.min()), float(fits.max())
    return tried[best], float(fits.min()), float(fits.max())


def plane_from_vanishing(
    camera: Camera, lines: Mapping[str, Sequence[Sequence[float]]], length: Sequence[float]
) -> Support:
    """Return the plane z = 0 and the camera's pose from parallel segments along two or three of the world's axes.

    The planes through the camera and the segments of one axis share that axis as a line: with the planes' normals n_i,
    its direction d minimises sum (n_i . d)^2. The rotation is the nearest to the directions of all axes.

    Args:
        camera: The camera.
        lines: By axis ("x", "y" or "z"), two or more segments: column and row of both ends. The first segments of x and
            y run in the axis's direction; z points up, and y turns about where that makes the axes right-handed.
        length: Columns and rows of two points on the plane z = 0, of which the first is the origin, and their distance
            in metres.

    Raises:
        UsageError: A point of ``length`` lies above the plane's horizon.
    """

    def rays(pixels: Sequence[Sequence[float]] | Array) -> Array:
        flat = undistorted(camera, np.reshape(pixels, (-1, 2)))
        return np.column_stack([flat, np.ones(len(flat))])

    ends = {"xyz".index(axis): rays(segments).reshape(-1, 2, 3) for axis, segments in lines.items()}
    first, second = rays(np.reshape(length[:4], (2, 2)))
    ways = np.zeros((3, 3))
    for axis, pairs in ends.items():
        normals = np.cross(pairs[:, 0], pairs[:, 1])
        way = np.linalg.svd(normals / np.linalg.norm(normals, axis=1, keepdims=True))[2][-1]
        from_, to = pairs[0]
        ahead = -way @ first if axis == 2 else (to - from_) @ (way - way[2] * from_)
        ways[:, axis] = way * np.sign(ahead)
    for axis in {0, 1, 2} - set(ends):
        ways[:, axis] = np.cross(ways[:, axis - 2], ways[:, axis - 1])
    ways[:, 2] *= -np.sign(ways[:, 2] @ first)
    if np.linalg.det(ways) < 0.0:
        ways[:, 1] *= -1.0
    left, _, right = np.linalg.svd(ways)
    rotation = left @ right
    off = []
    for axis, pairs in ends.items():
        through = np.cross(pairs.mean(1), rotation[:, axis])
        off.append((pairs @ through[..., None])[..., 0] / np.linalg.norm(through[:, :2], axis=1, keepdims=True))
    down = np.array([first, second]) @ -rotation[:, 2]
    if down.min() <= 1e-6:
        raise UsageError(f"--length {' '.join(f'{value:g}' for value in length)}: expected points below the horizon")
    # Both points on the plane one metre below the camera.
    near, far = first / down[0], second / down[1]
    error = camera.fx * math.sqrt(float(np.mean(np.concatenate(off) ** 2)))
    return Support(Pose(rotation, length[4] / float(np.linalg.norm(near - far)) * near), math.nan, error)


def plane_from_colmap(folder: Path, photograph: Path, scale: float) -> tuple[Camera, Support]:
    """Return the camera of a photograph in a COLMAP model, and the plane z = 0 of the model with the camera's pose.

    Args:
        folder: Folder with cameras and images, both ``.txt`` or both ``.bin``.
        photograph: The photograph, which the model has by its name.
        scale: Metres per unit of the model.

    Raises:
        UsageError: The model is not there, or does not have the photograph.
        SceneError: A file of the model cannot be used.
    """
    ends = [end for end in (".bin", ".txt") if all((folder / f"{name}{end}").is_file() for name in MODEL)]
    if not ends:
        right = "expected the folder of a sparse model, with cameras and images as .txt or .bin"
        raise UsageError(f"--colmap {folder}: {right}")
    cameras, images = (folder / f"{name}{ends[0]}" for name in MODEL)
    poses = load_pose_file(images)
    place = poses.index_of(photograph.as_posix())
    if place is None:
        raise UsageError(f"{images}: expected one picture of the name {photograph.name} among {len(poses.names)}")
    rotation, translation = poses.poses[place]
    pose = Pose(np.reshape(rotation, (3, 3)), scale * np.array(translation))
    return load_calibration(cameras, number=poses.cameras[place]), Support(pose, math.nan, 0.0)


def scene_on(
    support: Support, camera: Camera, picture: Path, light: CapturedLight, at: tuple[float, float], unit: float
) -> Scene:
    """Return a scene with a photograph, and a mirror and a chalk ball on either side of a place on the plane.

    Args:
        support: The plane.
        camera: Camera of the photograph.
        picture: The photograph.
        light: Light of the environment.
        at: Place between the balls, x and y.
        unit: Radius of the balls.
    """
    (x, y), (a, b, c) = at, map(float, support.pose.translation)
    metal, chalk = MetallicRoughnessMaterial((0.95, 0.95, 0.95), 1.0, 0.05), LambertMaterial((0.8, 0.8, 0.8))
    balls = [
        Object("sphere", radius=unit, at=(x + side * 3.0 * unit, y, unit), material=material)
        for side, material in ((1.0, metal), (-1.0, chalk))
    ]
    return Scene(
        camera=camera,
        name=light.file.stem,
        source=SourceSpec(path=picture.resolve()),
        proxies=(Proxy("plane", at=(x, y, 0.0), size=(40.0 * unit, 40.0 * unit)),),
        objects=tuple(balls),
        captured=light,
        pose=PoseSpec(((tuple(map(float, support.pose.rotation.reshape(-1))), (a, b, c)),)),
        has_marker=False,
    )


def plane_from_rectangle(
    camera: Camera, corners: Sequence[Sequence[float]], size: tuple[float, float], picked: float = 1.0
) -> Support:
    """Return the plane of a rectangle of known size, such as a sheet of paper, from its corners in the picture.

    Args:
        camera: The camera.
        corners: Four pixels in order round the rectangle; the first side is ``size[0]`` long and becomes the world's x.
        size: Lengths of the first and the second side, metres.
        picked: Standard deviation of a corner in pixels.

    Raises:
        UsageError: The points are no rectangle seen from above.
    """
    points = np.array(corners, float)
    if points.shape != (4, 2) or not np.isfinite(points).all() or min(size) <= 0.0:
        raise UsageError(f"rectangle {corners}: expected four pixels in order around it, and two lengths above 0")
    w, h = size
    corners_3d = np.array([[-w, -h, 0.0], [w, -h, 0.0], [w, h, 0.0], [-w, h, 0.0]]) / 2
    # In the other order, the picture would show the rectangle's underside, with y toward the camera.
    (ax, ay), (bx, by) = points[1] - points[0], points[2] - points[0]
    area = 0.5 * (ax * by - ay * bx)
    if abs(area) < 8.0:
        raise UsageError("rectangle: its corners lie on a line; pick four that span an area")
    if area > 0:
        corners_3d[:, 1] *= -1
    found = plane_from_points(camera, corners_3d, points)
    up = found.pose.rotation[:, 2]
    if up @ found.pose.translation >= 0.0:
        raise UsageError("rectangle: no plane seen from above looks like that; give its corners in order around it")
    moves = picked * np.random.default_rng(0).normal(size=(24, 4, 2))
    normals = [plane_from_points(camera, corners_3d, points + move).pose.rotation[:, 2] for move in moves]
    spread = np.degrees(np.arccos(np.clip(np.array(normals) @ up, -1.0, 1.0)))
    return dataclasses.replace(found, tilt_deviation=float(np.sqrt((spread**2).mean())))


def plane_from_contact(
    sphere: Sequence[float],
    camera: Camera,
    contact: Sequence[float],
    radius: float = 1.0,
    picked: float = 2.0,
    stand: float = 0.0,
) -> Support:
    """Return the plane under a ball that touches it, or a stand on it, at a pixel: the visible or guessed contact.

    A ball touches the table behind its lower half, where the ray through the pixel leaves the ball. The plane's normal
    is the ball's normal at that point. An error of d pixels tilts the normal by d divided by the radius in pixels, and
    by more near the rim.

    Args:
        sphere: The ball's centre in the camera's frame over its radius.
        camera: The camera.
        contact: Column and row of the point of contact.
        radius: Radius of the ball, metres; 1 if unknown: the world's unit is then the radius.
        picked: Standard deviation of the point of contact in pixels.
        stand: Height of the stand between plane and ball, metres.

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
    foot = radius * center - (radius + stand) * up
    # The point below the contact is the world's origin.
    tilt = float(np.hypot(max(turned[:2], default=90.0), max(turned[2:], default=90.0)))
    return Support(Pose(rotation, foot), tilt, 0.0, radius)
