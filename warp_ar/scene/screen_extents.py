"""Screen rectangles that objects, lights and shadows can affect.

Boxes around shapes are clipped by the cones of lights. The result is an `Outline`, a set of convex polygons; each frame
computes the smallest rectangle of pixels whose rays can meet it. Shadows and light reflected by proxies count as
affecting whole proxies: a tighter bound made no bundled scene's rectangle smaller.
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
"""Screen rectangle: row_start, row_stop, column_start, column_stop; all zero if empty."""
EMPTY: Final[Rect] = (0, 0, 0, 0)

# Number of sides of the pyramid around a spot's cone; with 8 sides, its edges are 8 % farther out than the cone.
_CONE_SIDES: Final = 8

# Half angle above which the pyramid would be nearly flat; such a cone counts as unbounded.
_WIDE_CONE: Final = math.radians(75.0)

# Faces of a box as (2, 2, 2) corner indices; the first is the only face of a plane, whose box has no height.
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
    """Return the faces of a shape's bounding box in the world, (4, 3) each."""
    half = np.array(record["extent"], np.float64)
    # Float32 records are rounded; one millionth more makes the box contain the device's shape.
    corners = _CORNERS * (half * (1.0 + 1e-6)) * float(record["scale"])
    corners = corners @ np.array(record["rotation"], np.float64).T + np.array(record["position"], np.float64)
    if record["kind"] == structs.PLANE:
        return [corners[[0, 2, 6, 4]]]
    return [corners[list(face)] for face in _FACES]


def ball_outline(probes: Iterable[scenes.Probe]) -> Outline:
    """Return the outline of the bounding boxes of mirror balls."""
    boxes = [np.array(probe.center) + probe.radius * _CORNERS for probe in probes]
    return Outline([box[list(face)] for box in boxes for face in _FACES])


def _clip(polygon: FloatArray, normal: FloatArray, offset: float) -> FloatArray:
    """Return the part of a convex polygon (n, 3) with normal . p >= offset (Sutherland-Hodgman); it may be empty."""
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
    """Return the parts of a box's faces that a light may reach.

    A spot's cone is replaced by a pyramid around it. A mesh lies inside its box: the convex hull of the clipped faces
    and, if the light is in the box, of the light's position contains all lit points.
    """
    if light["kind"] != structs.SPOT or light["outer_angle"] >= _WIDE_CONE:
        return faces
    apex = np.array(light["position"], np.float64)
    axis = np.array(light["direction"], np.float64)
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    across = np.cross(axis, side)
    # A plane tangent to the cone contains its apex, and its normal is tilted by the half angle toward the axis.
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
    """Return the bounds of x / z over each pixel column's rays, and of y / z over each row's.

    The bounds ascend: where distortion folds rows or columns back, a bound covers all columns to one side.
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
    """Set of convex polygons in the world; each frame computes its screen rectangle."""

    polygons: Sequence[FloatArray]
    """Polygons, (n, 3) each."""

    @functools.cached_property
    def corners(self) -> FloatArray:
        """Return the corners of all polygons, (n, 3)."""
        return np.concatenate(self.polygons)


NOTHING: Final = Outline(())
"""Empty outline."""


def screen_rects(outlines: Sequence[Outline], pose: Pose, camera: scenes.Camera) -> list[Rect]:
    """Return the smallest screen rectangles, with one pixel of margin, whose rays can meet outlines' convex hulls.

    Polygons that reach behind the camera are clipped in front of it. Lens distortion is handled exactly: pixels are
    selected by their undistorted rays, not by distorting the polygons. All outlines are processed together, because
    NumPy takes as long for one as for several.

    Args:
        outlines: Outlines; each gets a rectangle of its own.
        pose: ``camera_from_world``.
        camera: The camera of the frames.
    """
    rects = [EMPTY] * len(outlines)
    parts = {index: outline.corners for index, outline in enumerate(outlines) if outline.polygons}
    if not parts:
        return rects
    points = pose.apply(np.concatenate(list(parts.values())))
    near = 1e-6 * max(float(np.abs(points).max()), 1e-12)
    if points[:, 2].min() < near:
        forward = np.array([0.0, 0.0, 1.0])
        for index in parts:
            clipped = [_clip(pose.apply(polygon), forward, near) for polygon in outlines[index].polygons]
            parts[index] = np.concatenate(clipped)
        parts = {index: part for index, part in parts.items() if len(part)}
        if not parts:
            return rects
        points = np.concatenate(list(parts.values()))
    starts = list(itertools.accumulate(map(len, parts.values()), initial=0))[:-1]
    projected = points[:, :2] / points[:, 2:]
    low, high = np.minimum.reduceat(projected, starts), np.maximum.reduceat(projected, starts)
    x_low, x_high, y_low, y_high = _ray_bounds(camera)
    edges = (
        y_high.searchsorted(low[:, 1]),
        y_low.searchsorted(high[:, 1], "right"),
        x_high.searchsorted(low[:, 0]),
        x_low.searchsorted(high[:, 0], "right"),
    )
    for index, rect in zip(parts, zip(*(edge.tolist() for edge in edges), strict=True), strict=True):
        top, bottom, first, last = rect
        if top < bottom and first < last:
            rects[index] = rect
    return rects
