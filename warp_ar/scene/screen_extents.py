"""Parts of the screen that objects, lights and shadows can touch.

Boxes around shapes are clipped by the cones of lights; what is left is a set of convex polygons, an `Outline`, of which
each frame asks the smallest rectangle of pixels whose rays can meet it. Shadows and light that proxies send on may
reach all of the proxies: clipped by what reaches them, no bundled scene's rectangle was smaller.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from warp_ar import scene as scenes
from warp_ar.kernels import structs
from warp_ar.scene import Pose

FloatArray = npt.NDArray[np.float64]

Rect = tuple[int, int, int, int]
"""Part of the screen: row_start, row_stop, column_start, column_stop; all zero where nothing of it is needed."""
EMPTY: Final[Rect] = (0, 0, 0, 0)

# Sides of the pyramid around a spot's cone: 8 sides reach 8 % farther out than the cone at their edges.
_CONE_SIDES: Final = 8

# From this half angle on a pyramid would be nearly flat; the cone is then taken to reach everything.
_WIDE_CONE: Final = math.radians(75.0)

# Faces of a box as (2, 2, 2) corner indices; the first is that of a plane, whose box has no height.
_FACES: Final = (
    (0, 2, 6, 4),
    (1, 3, 7, 5),
    (0, 1, 5, 4),
    (2, 3, 7, 6),
    (0, 1, 3, 2),
    (4, 5, 7, 6),
)
_CORNERS: Final = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])


def box_faces(record: Any) -> list[FloatArray]:
    """Faces of the box around a shape in the world, (4, 3) each."""
    half = np.array(record["extent"], np.float64)
    # Float32 records are rounded; a part in a million more keeps the box around what the device sees.
    corners = _CORNERS * (half * (1.0 + 1e-6)) * float(record["scale"])
    corners = corners @ np.array(record["rotation"], np.float64).T + np.array(record["position"], np.float64)
    if record["kind"] == structs.PLANE:
        return [corners[[0, 2, 6, 4]]]
    return [corners[list(face)] for face in _FACES]


def ball_outline(probes: Iterable[scenes.Probe]) -> Outline:
    """Boxes around mirror balls."""
    boxes = [np.array(probe.center) + probe.radius * _CORNERS for probe in probes]
    return Outline([box[list(face)] for box in boxes for face in _FACES])


def _clip(polygon: FloatArray, normal: FloatArray, offset: float) -> FloatArray:
    """The part of a convex polygon (n, 3) where normal . p >= offset (Sutherland, Hodgman); empty if there is none."""
    height = polygon @ normal - offset
    if (height >= 0.0).all():
        return polygon
    points: list[FloatArray] = []
    for index in range(len(polygon)):
        a, b = height[index - 1], height[index]
        if (a < 0.0) != (b < 0.0):
            points.append(polygon[index - 1] + (polygon[index] - polygon[index - 1]) * (a / (a - b)))
        if b >= 0.0:
            points.append(polygon[index])
    return np.array(points).reshape(-1, 3)


def lit_faces(light: Any, faces: list[FloatArray]) -> list[FloatArray]:
    """Parts of a box's faces that a light may reach.

    A spot's cone is taken as the pyramid around it. For a mesh, whose surface lies inside its box, the parts of the
    faces inside the pyramid and, if the light is in the box, the light itself span all that can be lit.
    """
    if light["kind"] != structs.SPOT or light["outer_angle"] >= _WIDE_CONE:
        return faces
    apex = np.array(light["position"], np.float64)
    axis = np.array(light["direction"], np.float64)
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    across = np.cross(axis, side)
    # A plane that touches the cone along a line contains its apex; its normal leans by the half angle toward the axis.
    outer = float(light["outer_angle"]) + 1e-6
    parts = []
    for face in faces:
        part = face
        for turn in np.arange(_CONE_SIDES) * (2.0 * math.pi / _CONE_SIDES):
            outward = math.cos(turn) * side + math.sin(turn) * across
            normal = math.sin(outer) * axis - math.cos(outer) * outward
            part = _clip(part, normal, float(normal @ apex) - 1e-9)
            if len(part) == 0:
                break
        if len(part):
            parts.append(part)
    if len(faces) > 1:
        center = np.mean([face.mean(axis=0) for face in faces], axis=0)
        if all((apex - face.mean(axis=0)) @ (center - face.mean(axis=0)) >= 0.0 for face in faces):
            parts.append(apex[None, :])
    return parts


@functools.lru_cache(maxsize=8)
def _ray_bounds(camera: scenes.Camera) -> tuple[npt.NDArray[Any], ...]:
    """Smallest and largest x / z of each column's rays and y / z of each row's, a pixel's own width included.

    In ascending order: where a lens bends rows or columns back, a bound is that of all columns to one side.
    """
    if not any(camera.distortion):
        x = (np.arange(camera.width) - camera.cx) / camera.fx
        y = (np.arange(camera.height) - camera.cy) / camera.fy
        bounds = (x, x, y, y)
    else:
        from warp_ar.scene.pixel_rays import pixel_rays

        rays = pixel_rays(camera).astype(np.float64)
        bounds = (rays[..., 0].min(0), rays[..., 0].max(0), rays[..., 1].min(1), rays[..., 1].max(1))
    return (
        np.minimum.accumulate(bounds[0][::-1])[::-1] - 1.0 / camera.fx,
        np.maximum.accumulate(bounds[1]) + 1.0 / camera.fx,
        np.minimum.accumulate(bounds[2][::-1])[::-1] - 1.0 / camera.fy,
        np.maximum.accumulate(bounds[3]) + 1.0 / camera.fy,
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Outline:
    """Convex polygons in the world, looked at in every frame from somewhere else."""

    polygons: Sequence[FloatArray]
    """(n, 3) each."""

    @functools.cached_property
    def corners(self) -> FloatArray:
        """Those of all polygons, (n, 3)."""
        return np.concatenate(self.polygons)


NOTHING: Final = Outline(())
"""That of no shape."""


def screen_rects(outlines: Sequence[Outline], pose: Pose, camera: scenes.Camera) -> list[Rect]:
    """Smallest rectangles of pixels whose rays can meet the convex hulls of outlines, one pixel of margin included.

    Safe for what reaches behind the camera: polygons are clipped just in front of it. Safe for any distortion: pixels
    are picked by their undistorted rays, not by distorting the polygons. All at once, because a frame has several, and
    NumPy takes no longer for all than for one.

    Args:
        outlines: What to look at, each by itself.
        pose: ``camera_from_world``.
        camera: The camera of the frames.
    """
    rects = [EMPTY] * len(outlines)
    parts = _join(tuple(outlines))
    if parts is None:
        return rects
    points, starts, places = pose.apply(parts.corners), parts.starts, parts.places
    nearest = points[:, 2].min()
    # All that is asked of the depth of most frames; where that is not enough, points are looked at.
    if nearest < 2e-6 * (parts.radius + float(np.abs(pose.translation).sum())) and nearest < _nearest(points):
        clipped = {index: _in_front(outlines[index], pose) for index in places}
        left = {index: part for index, part in clipped.items() if len(part)}
        if not left:
            return rects
        points, starts, places = np.concatenate(list(left.values())), _starts(left.values()), tuple(left)
    projected = points[:, :2] / points[:, 2:]
    low, high = np.minimum.reduceat(projected, starts), np.maximum.reduceat(projected, starts)
    x_low, x_high, y_low, y_high = _ray_bounds(camera)
    edges = (
        y_high.searchsorted(low[:, 1]),
        y_low.searchsorted(high[:, 1], "right"),
        x_high.searchsorted(low[:, 0]),
        x_low.searchsorted(high[:, 0], "right"),
    )
    for index, rect in zip(places, zip(*(edge.tolist() for edge in edges), strict=True), strict=True):
        top, bottom, first, last = rect
        if top < bottom and first < last:
            rects[index] = rect
    return rects


@dataclasses.dataclass(frozen=True)
class _Joined:
    """Several outlines one behind the other."""

    corners: FloatArray
    """Corners of all, (n, 3)."""
    starts: list[int]
    """First index of each that has any."""
    places: tuple[int, ...]
    """Indices of these outlines."""
    radius: float
    """No corner is farther from the origin."""


@functools.lru_cache(maxsize=16)
def _join(outlines: tuple[Outline, ...]) -> _Joined | None:
    """Outlines stay the same for many frames, and to join them takes as long as to look at them."""
    parts = {index: outline.corners for index, outline in enumerate(outlines) if outline.polygons}
    if not parts:
        return None
    corners = np.concatenate(list(parts.values()))
    radius = float(np.linalg.norm(corners, axis=1).max())
    return _Joined(corners, _starts(parts.values()), tuple(parts), radius)


def _starts(parts: Iterable[FloatArray]) -> list[int]:
    return list(itertools.accumulate(map(len, parts), initial=0))[:-1]


def _nearest(points: FloatArray) -> float:
    """Depth from which on points of the camera's space are looked at."""
    return 1e-6 * max(float(np.abs(points).max()), 1e-12)


def _in_front(outline: Outline, pose: Pose) -> FloatArray:
    """Corners of what is left of an outline, in the camera's space, when what is behind the camera is cut off."""
    points = pose.apply(outline.corners)
    near = _nearest(points)
    if points[:, 2].min() >= near:
        return points
    forward = np.array([0.0, 0.0, 1.0])
    return np.concatenate([_clip(pose.apply(polygon), forward, near) for polygon in outline.polygons])
