"""Float64 twin of ``mirror_ball.py``: Lambertian objects, one point light with hard shadows, a pinhole."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from tests.twins.visibility import Body, closest

# Off a surface, relative to a scene of decimetres: far above float64's rounding, far below any distance in it.
OFF = 1e-9


@dataclasses.dataclass
class World:
    """What there is; ``rho`` and ``base`` have a row per ball and object."""

    eye: np.ndarray
    balls: list[Body]
    rho: np.ndarray
    proxies: list[Body]
    objects: list[Body]
    base: np.ndarray
    light: np.ndarray | None = None
    intensity: np.ndarray | float = 0.0


def ball(center, radius) -> Body:
    return Body("sphere", np.eye(3), np.asarray(center, float), 1.0, np.array([radius] * 3))


def free(bodies: list[Body], points, to) -> np.ndarray:
    """Whether nothing lies between points and ``points + to``."""
    return closest(bodies, points, to)[0] >= 1.0


def lambert(world: World, points, normals, blockers: list[Body]) -> np.ndarray:
    """Irradiance of surfaces under the light, (n, 3)."""
    to_light = world.light - points
    distance = np.linalg.norm(to_light, axis=-1)
    cosine = np.maximum((normals * to_light).sum(-1) / distance, 0.0)
    lit = free(blockers, points + OFF * normals, to_light)
    return (lit * cosine / distance**2)[:, None] * np.ones(3) * world.intensity


def look_up(world: World, points, normals, project: Callable, layer: Callable, size) -> tuple[np.ndarray, np.ndarray]:
    """A layer of the picture where it shows points of the desk, 1 where it does not; and whether it does."""
    from_camera = points - world.eye
    at, depth = project(from_camera)
    seen = ((from_camera * normals).sum(-1) < 0) & (depth > 0)
    seen &= (at >= 0).all(-1) & (at[:, 0] <= size[1] - 1) & (at[:, 1] <= size[0] - 1)
    seen &= free([*world.proxies, *world.balls], points + OFF * normals, -from_camera)
    return np.where(seen[:, None], layer(at), 1.0), seen


def mirror(world: World, directions, seen, kd: Callable, project: Callable, layer: Callable, size):
    """Change of radiance by rays of the camera, (n, 3), and what each of them meets, as a number per ray.

    Args:
        world: What there is.
        directions: (n, 3).
        seen: (n, 3), radiance of the frame.
        kd: From the proxy's radiance, (m, 3), its reflectance.
        project: From points relative to the camera, (x, y) and depth.
        layer: Of (x, y), the shadows' ratio.
        size: Rows and columns of the frame.
    """
    change, label = np.zeros((len(directions), 3)), np.zeros(len(directions), int)
    eye = np.broadcast_to(world.eye, directions.shape)
    t, which, normal = closest(world.balls, eye, directions)
    on = np.flatnonzero((which >= 0) & (t < closest(world.proxies, eye, directions)[0]))
    which, normal, ray = which[on], normal[on], directions[on] / np.linalg.norm(directions[on], axis=-1, keepdims=True)
    points = eye[on] + t[on, None] * directions[on] + OFF * normal
    outward = ray - 2.0 * (ray * normal).sum(-1, keepdims=True) * normal
    ways = [closest(bodies, points, outward) for bodies in (world.proxies, world.objects, world.balls)]
    t = np.stack([way[0] for way in ways])
    first = np.where(np.isfinite(t.min(0)), t.argmin(0), 3)
    met = points + np.where(np.isfinite(t.min(0)), t.min(0), 0.0)[:, None] * outward
    rho = world.rho[which]
    label[on] = 1 + first + 10 * which

    item = first == 1
    normals = ways[1][2][item]
    normals *= -np.sign((normals * outward[item]).sum(-1, keepdims=True))
    radiance = np.zeros((item.sum(), 3))
    if world.light is not None:
        radiance = lambert(world, met[item], normals, [*world.proxies, *world.objects])
        radiance *= world.base[ways[1][1][item]] / np.pi
    change[on[item]] = rho[item] * radiance - seen[on[item]]
    label[on[item]] += 100 * (radiance.max(-1) > 0) + 1000 * ways[1][1][item]

    desk = first == 0
    normals = ways[0][2][desk]
    towards = (normals * outward[desk]).sum(-1) < 0
    ratio, found = look_up(world, met[desk], normals, project, layer, size)
    change[on[desk]] = towards[:, None] * seen[on[desk]] * (ratio - 1.0)
    light = np.zeros((desk.sum(), 3))
    if world.light is not None:
        light = lambert(world, met[desk], normals, [*world.proxies, *world.objects, *world.balls])
        light = kd(seen[on[desk]] / rho[desk], light / np.pi)
    change[on[desk]] += towards[:, None] * rho[desk] * light
    label[on[desk]] += 100 * (light.max(-1) > 0) + 200 * found + 1000 * ways[0][1][desk]
    return change, label
