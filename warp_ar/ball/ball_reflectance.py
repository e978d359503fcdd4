"""Reflectance of a mirror ball, from surfaces that the frame shows both directly and mirrored in the ball.

A matt surface has one radiance wherever it is seen from. So where the ball mirrors a point of a modelled plane that the
camera sees beside the ball as well, the ball's pixel over that point's own is the ball's reflectance:

    reflectance = median over pixels of L(pixel of the ball) / L(projection of the mirrored point).

Neither card nor light must be known, and shadows do no harm: they lie on the point, whichever way it is looked at. What
does is a response that is not the camera's (a ratio r becomes r^g with the wrong exponent g: 7 % at most for gammas of
1.8 to 2.6 taken for sRGB), and a ball elsewhere than the scene has it: the two pictures then differ in their course,
which their correlation tells. A surface that shines has another radiance from either side, and another difference at
each place: one half of the ball then says something else than the other.
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
"""Least cosine at which the ball is met: nearer to its rim a pixel mirrors a wide patch."""
GRAZING: Final = 0.25
"""Least cosine at which a plane is looked at, by the camera and by way of the ball: beyond it even paper shines."""
BESIDE: Final = 1.15
"""Radii from the ball's middle in the picture from which on a point is not the ball's own."""
CODES: Final = (12, 200)
"""Codes that are neither quantised nor near a shoulder."""
BLUR: Final = 1.5
"""Pixels of blur of what is seen directly: its texture is mirrored smaller than it is seen."""
BLUR_REACH: Final = 6
"""Pixels to each side that blur, four standard deviations."""
BLUR_SIZE: Final = 2 * BLUR_REACH + 1
FEWEST: Final = 200
"""Pixels that must tell."""
SCATTER: Final = 0.2
"""Greatest standard deviation of one pixel's logarithm: with more, the two do not show the same."""
ALIKE: Final = 0.6
"""Least correlation of both pictures' logarithms."""
HALVES: Final = 0.15
"""Greatest difference of a logarithm between halves of the pixels: 0.11 at most on matt tables and the clips, 0.26 and
more on three of four polished tables.
"""
LEAST_DEVIATION: Final = 0.025
"""Logarithm by which all of a ball is off together: its place and radius are."""
REFLECTANCE: Final = 0.12
"""Logarithm by which a ball may reflect more or less than the scene says: another response than the camera's, or a
radius that is 5 % off, moves what is measured by up to 0.09.
"""


@dataclasses.dataclass(frozen=True)
class Reflected:
    """Statement of one picture about a ball."""

    reflectance: tuple[float, float, float]
    """RGB."""
    pixels: int
    """Pixels that say so."""
    deviation: float = 0.0
    """Standard deviation of the logarithm, by how far halves of the ball differ."""


def measure_reflectance(
    scene: Scene, camera: Camera, probe: Probe, view: tuple[Image, Pose], table: NDArray[np.float32]
) -> Reflected | None:
    """The reflectance of a ball by one picture.

    Args:
        scene: What stands around the ball.
        camera: Of the picture's size.
        probe: The ball, where it is seen.
        view: RGB picture (h, w, 3) and ``camera_from_world``.
        table: Linear value of each code, (256, 3).

    Returns:
        None where the ball mirrors too little of what the camera sees as well, or both do not show the same.
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
    """Blurred radiance at places of a picture, (n, 3); of the picture only what lies around them is blurred.

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
    """Return how far one half of the ball says something else than the other, in the channel in which it does most.

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
    """Pixels of the ball (n, 2) and the points of matt planes that they mirror and the camera sees, (n, 3)."""
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
    """Return whether the camera sees points of planes beside the ball, (n,)."""
    eye = -pose.rotation.T @ pose.translation
    at = project(camera, pose.apply(points))
    seen = (at > 1.0).all(axis=1) & (at < (camera.width - 2, camera.height - 2)).all(axis=1)  # NaN is not
    ray = points - eye
    away, direction = np.sqrt(dot(ray, ray)), _unit(ray)
    distance, is_matt = _nearest(scene.proxies, np.broadcast_to(eye, points.shape), direction)
    seen &= is_matt & (np.abs(distance - away) < 0.01 * away)
    for ball in scene.probes:
        offset = np.array(ball.center, float) - eye
        along = direction @ offset
        beside = np.sqrt(np.maximum(float(offset @ offset) - along**2, 0.0))
        seen &= (beside > BESIDE * ball.radius) | (along > away)
    return np.asarray(seen, np.bool_)


def _nearest(proxies: tuple[Proxy, ...], origin: Array, rays: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the distance to what rays meet first, and if that is a matt plane not met at a grazing angle, (n,).

    Meshes are left out: what they hide scatters.
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
