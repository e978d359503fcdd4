"""Reflectance of a mirror ball, from surfaces that the frame shows both directly and mirrored in the ball.

A matt surface has the same radiance from all directions. Where the ball mirrors a point of a modelled plane that the
camera also sees directly, the ratio of both pixels is the ball's reflectance:

    reflectance = median over pixels of L(pixel of the ball) / L(projection of the mirrored point).

Neither card nor light must be known, and shadows do not matter, because they lie on the point in both views. Two errors
remain. A wrong response curve turns a ratio r into r^g with an exponent g: at most 7 % for gammas of 1.8 to 2.6 taken
for sRGB. A wrong position of the ball makes the two pictures differ, which lowers their correlation. A glossy surface
has different radiance in the two directions, and the difference varies over the ball: one half of the ball then gives
another reflectance than the other.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.ball.surface_rays import dot, nearest_shape, shapes_of
from warp_ar.scene import Camera, Pose, Probe, Proxy, Scene
from warp_ar.scene.pixel_rays import project, undistorted

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

FACING: Final = 0.35
"""Smallest cosine of incidence on the ball; closer to its rim, a pixel mirrors a wide area."""
GRAZING: Final = 0.25
"""Smallest cosine at which a plane is seen, directly and by way of the ball; at grazing angles even paper is glossy."""
CLEAR: Final = 1.15
"""Distance in the picture from the ball's centre, in radii, from which a point is not hidden by the ball."""
CODES: Final = (12, 200)
"""Range of codes that are neither quantised nor near clipping."""
BLUR: Final = 1.5
"""Blur in pixels of the direct view, because the mirror image of its texture is smaller."""
BLUR_REACH: Final = 6
"""Extent of the blur in pixels to each side: four standard deviations."""
BLUR_SIZE: Final = 2 * BLUR_REACH + 1
FEWEST: Final = 200
"""Smallest number of usable pixels."""
SCATTER: Final = 0.2
"""Largest standard deviation, over pixels, of the ratio's logarithm; above it, both views show different surfaces."""
ALIKE: Final = 0.6
"""Smallest correlation, over pixels, of the logarithms of mirrored and direct radiance."""
HALVES: Final = 0.15
"""Largest difference of the ratio's logarithm between halves of the ball: at most 0.11 on matt tables and the clips,
0.26 and more on three of four polished tables."""
LEAST_DEVIATION: Final = 0.025
"""Systematic error of the logarithm, from the ball's position and radius."""
REFLECTANCE: Final = 0.12
"""Largest logarithm of the ratio to the scene's reflectance that is within error: another response curve, or a radius
error of 5 %, changes the measurement by up to 0.09."""


@dataclasses.dataclass(frozen=True)
class Reflected:
    """Reflectance of a ball measured in one picture."""

    reflectance: tuple[float, float, float]
    """RGB."""
    pixels: int
    """Number of pixels used."""
    deviation: float = 0.0
    """Standard deviation of the logarithm, by the difference between halves of the ball."""


def measure_reflectance(
    scene: Scene, camera: Camera, probe: Probe, view: tuple[Image, Pose], table: NDArray[np.float32]
) -> Reflected | None:
    """Measure a ball's reflectance in one picture.

    Args:
        scene: Scene around the ball.
        camera: Camera at the picture's size.
        probe: The ball at its place in the picture.
        view: RGB picture (h, w, 3) and ``camera_from_world``.
        table: Linear value of each code, (256, 3).

    Returns:
        The reflectance; None if the ball mirrors too few directly visible points, or the two views disagree.
    """
    image, pose = view
    mirrored, points = _mirrored_points(scene, camera, probe, pose)
    if len(points) < FEWEST:
        return None
    direct = project(camera, pose.apply(points))
    column, row = np.round(direct).astype(int).T
    own, other = image[mirrored[:, 1], mirrored[:, 0]], image[row, column]
    tells = ((own > CODES[0]) & (own < CODES[1]) & (other > CODES[0]) & (other < CODES[1])).all(axis=1)
    if tells.sum() < FEWEST:
        return None
    decoded = np.stack([table[own[tells, k], k] for k in range(3)], -1)
    logs = np.log(decoded.astype(float)), np.log(_blurred(image, table, direct[tells]))
    ratio = logs[0] - logs[1]
    both = [part.mean(axis=1) for part in logs]
    off = np.abs(both[0] - both[1] - np.median(both[0] - both[1]))
    correlation = float(np.corrcoef(*both)[0, 1]) if min(np.ptp(part) for part in both) > 0.0 else 0.0
    if 1.4826 * float(np.median(off)) > SCATTER or correlation < ALIKE:
        return None
    halves = difference_of_halves(ratio, mirrored[tells])
    if halves > HALVES:
        return None
    red, green, blue = (float(value) for value in np.exp(np.median(ratio, axis=0)))
    return Reflected((red, green, blue), int(tells.sum()), math.hypot(halves / 2.0, LEAST_DEVIATION))


def _blurred(image: Image, table: NDArray[np.float32], places: Array) -> Array:
    """Return blurred radiance at positions of a picture, (n, 3); only their surroundings are blurred.

    Args:
        image: RGB (h, w, 3).
        table: Linear value of each code, (256, 3).
        places: Pixels (n, 2), all in the picture.
    """
    low = np.maximum(np.floor(places.min(axis=0)).astype(int) - BLUR_REACH, 0)
    high = np.floor(places.max(axis=0)).astype(int) + BLUR_REACH + 2
    around = image[low[1] : high[1], low[0] : high[0]]
    blurred = cv2.GaussianBlur(cv2.LUT(around, table[None]), (BLUR_SIZE, BLUR_SIZE), BLUR)
    x, y = (places.astype(np.float32) - low.astype(np.float32)).T
    return np.asarray(cv2.remap(blurred, x[:, None], y[:, None], cv2.INTER_LINEAR)[:, 0], float)


def difference_of_halves(ratio: Array, pixels: NDArray[np.int64]) -> float:
    """Return the largest difference, over channels, between the medians of one half of the ball and the other.

    Args:
        ratio: Logarithms, (n, 3).
        pixels: Column and row of each, (n, 2).
    """
    most = 0.0
    for place in pixels.T:
        first = place < np.median(place)
        if first.any() and not first.all():
            halves = np.median(ratio[first], axis=0) - np.median(ratio[~first], axis=0)
            most = max(most, float(np.abs(halves).max()))
    return most


def _mirrored_points(scene: Scene, camera: Camera, probe: Probe, pose: Pose) -> tuple[NDArray[np.int64], Array]:
    """Return pixels of the ball, (n, 2), and the directly visible matt points that they mirror, (n, 3)."""
    center, radius = np.array(probe.center, float), probe.radius
    eye = -pose.rotation.T @ pose.translation
    nothing = np.zeros((0, 2), np.int64), np.zeros((0, 3))
    depth = float((pose.rotation @ center + pose.translation)[2])
    if depth <= radius:
        return nothing
    middle = project(camera, pose.apply(center[None]))[0]
    reach = camera.fx * radius / (depth - radius)
    low = np.maximum(np.floor(middle - reach), 0).astype(int)
    high = np.minimum(np.ceil(middle + reach) + 1, (camera.width, camera.height)).astype(int)
    if (low >= high).any():
        return nothing
    pixels = np.stack(np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1])), -1).reshape(-1, 2)
    local = undistorted(camera, pixels)
    rays = _unit(np.column_stack([local, np.ones(len(local))]) @ pose.rotation)
    along = rays @ (eye - center)
    within = along**2 - float((eye - center) @ (eye - center)) + radius**2
    hit = eye + (-along - np.sqrt(np.maximum(within, 0.0)))[:, None] * rays
    normal = (hit - center) / radius
    facing = -dot(normal, rays)
    met = (within > 0.0) & (facing > FACING)
    pixels, hit = pixels[met], hit[met]
    outward = rays[met] + 2.0 * facing[met, None] * normal[met]
    distance, is_matt = _nearest(scene.proxies, hit, outward)
    points = hit + np.where(is_matt, distance, 0.0)[:, None] * outward
    seen = is_matt & are_seen(scene, camera, probe, pose, points)
    return pixels[seen], points[seen]


def are_seen(scene: Scene, camera: Camera, probe: Probe, pose: Pose, points: Array) -> NDArray[np.bool_]:
    """Return a mask of plane points that the camera sees directly next to the ball, (n,)."""
    eye = -pose.rotation.T @ pose.translation
    at = project(camera, pose.apply(points))
    seen = (at > 1.0).all(axis=1) & (at < (camera.width - 2, camera.height - 2)).all(axis=1)  # NaN compares false
    ray = points - eye
    away, direction = np.sqrt(dot(ray, ray)), _unit(ray)
    distance, is_matt = _nearest(scene.proxies, np.broadcast_to(eye, points.shape), direction)
    seen &= is_matt & (np.abs(distance - away) < 0.01 * away)
    for ball in scene.probes:
        offset = np.array(ball.center, float) - eye
        along = direction @ offset
        from_ray = np.sqrt(np.maximum(float(offset @ offset) - along**2, 0.0))
        seen &= (from_ray > CLEAR * ball.radius) | (along > away)
    return np.asarray(seen, np.bool_)


def _nearest(proxies: tuple[Proxy, ...], origin: Array, rays: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the distance to the first hit of each ray, and a mask of hits on matt planes that are not grazing, (n,).

    Meshes are ignored: rays that they would block only add scatter.
    """
    known = [proxy for proxy in proxies if proxy.shape != "mesh" and proxy.marker is None]
    shapes = shapes_of(known)
    nearest, which = nearest_shape(shapes, origin, rays)
    matt = np.zeros(len(rays), bool)
    for number, (proxy, (_, axes, _)) in enumerate(zip(known, shapes, strict=True)):
        if proxy.shape == "plane" and proxy.material is None:
            matt |= (which == number) & (rays @ axes[:, 2] < -GRAZING)
    return nearest, matt


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.maximum(np.sqrt(dot(vectors, vectors)), 1e-12)[:, None], float)
