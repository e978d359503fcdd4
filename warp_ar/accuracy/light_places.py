"""Distances of a given light's emitters, estimated from the surfaces in a frame.

Light from a file is measured at one point: it contains the direction of an emitter, not its distance. If a lamp half a
metre away is treated as distant, it lights the whole desk evenly, with parallel shadows. The frame determines the
distances. With the right ones, the estimated reflectance of the desk (radiance divided by irradiance) is constant
except for texture. With wrong ones it falls off across the desk and contains false shadows and false lights. Emitters
are therefore placed one after another, the most powerful first, at the distance for which the reflectance of each proxy
scatters least:

    cost = mean over pixels of log(1 + (r / GRAIN)^2),    r = log(reflectance) - its median over the proxy

The path tracer computes the irradiance, with shadows, interreflection and balls. ``Light.save`` stores the result.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from warp_ar.accuracy.path_tracer import FloatImage, Image, PathTracer
from warp_ar.errors import UsageError
from warp_ar.light.captured import Light, find_emitters
from warp_ar.light.config import CONFIG
from warp_ar.scene import Pose, Scene

WIDTH = 160
"""Width in pixels of the pictures in which reflectance is measured."""
SAMPLES = 16
"""Samples per pixel of the pictures in which reflectance is measured."""
GRAIN = 0.1
"""Deviation of the logarithm of reflectance beyond which pixels have less weight: about that of wood or paper."""
SHOWN = (0.01, 0.95)
"""Range of linear radiance, 1 at clipping, in which a pixel measures reflectance."""
LEAST_PIXELS = 50
"""Smallest number of a proxy's pixels for an estimate."""
WORTH = 0.1
"""Smallest relative decrease of the cost for which a distance is accepted, because wood grain and clutter may resemble
shadows by chance."""
MOST = 3
"""Largest number of emitters with an estimated distance."""
NEAREST, FARTHEST = 0.25, 2.0
"""Smallest and largest tested distance, metres: nearer emitters would be visible, farther ones count as distant."""
BOUND = 0.9 * FARTHEST
"""Largest accepted distance, metres. A minimum at the end of the search has other causes, such as paint that is darker
on one side."""
STEPS = 6
"""Number of costs evaluated by the search between two tested distances."""
GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
"""Golden ratio, 0.618."""


def reflectance_scatter(tracer: PathTracer) -> float:
    """Return the scatter of the estimated reflectance over each proxy, the cost that the module's docstring defines.

    Args:
        tracer: Path tracer of the frame, with the light to evaluate.

    Raises:
        UsageError: The frame does not show a proxy sufficiently.
    """
    reflectance, shown, frame = tracer.reflectance(), tracer.shown(), tracer.frame()
    usable = (frame.min(axis=2) > SHOWN[0]) & (frame.max(axis=2) < SHOWN[1])
    total, count = 0.0, 0
    for proxy in np.unique(shown[shown >= 0]):
        values = reflectance[usable & (shown == proxy)].mean(axis=1)
        if len(values) >= LEAST_PIXELS:
            logarithm = np.log(np.maximum(values, 1e-4))
            total += float(np.log1p(((logarithm - np.median(logarithm)) / GRAIN) ** 2).sum())
            count += len(values)
    if not count:
        raise UsageError("the frame shows no proxy, which is needed to place emitters")
    return total / count


def place_emitters(
    light: Light | FloatImage,
    scene: Scene,
    frame: Image | FloatImage,
    pose: Pose,
    *,
    device: str = "auto",
    seconds: float = 0.0,
) -> Light:
    """Return a light with estimated distances of its emitters, where the frame determines them.

    Args:
        light: Light at the first mirror ball of the scene, in the world's axes; an image is latlong (h, 2 h, 3). A
            light with an emitter of known distance is returned unchanged.
        scene: Scene with the proxies.
        frame: Camera frame, (H, W, 3), without virtual content.
        pose: ``camera_from_world``.
        device: ``auto``, ``cpu`` or ``cuda:N``.
        seconds: Time since the first frame.

    Raises:
        UsageError: The scene has no ball, from whose centre distances are measured, or the frame shows no proxy.
    """
    if not isinstance(light, Light):
        light = Light(np.asarray(light, np.float32), np.ones(light.shape[:2], np.float32))
    if any(emitter.distance is not None for emitter in light.emitters):
        return light
    if not scene.probes:
        raise UsageError("emitters are placed as seen from a mirror ball: the scene has none")
    origin = scene.probes[0].center
    found = light.emitters or find_emitters(light.radiance, np.zeros_like(light.radiance), 0.0)
    placed = dataclasses.replace(light, emitters=tuple(dataclasses.replace(one, origin=origin) for one in found))
    if not placed.emitters:
        return placed
    size = (WIDTH, round(WIDTH * scene.camera.height / scene.camera.width))
    if size[0] * scene.camera.height != size[1] * scene.camera.width:
        size = (scene.camera.width, scene.camera.height)

    def cost(tried: Light) -> float:
        tracer = PathTracer(scene, tried, frame, pose, device=device, size=size, seconds=seconds, light_samples=SAMPLES)
        return reflectance_scatter(tracer)

    least = cost(placed)
    for number in range(min(len(placed.emitters), MOST)):
        tried, its_cost = _placed(placed, number, cost)
        if its_cost < (1.0 - WORTH) * least and (tried.emitters[number].distance or FARTHEST) < BOUND:
            placed, least = tried, its_cost
    return placed


def _at(light: Light, number: int, distance: float) -> Light:
    """Return a light with emitter ``number`` at a distance in metres."""
    emitters = list(light.emitters)
    emitters[number] = dataclasses.replace(emitters[number], distance=distance)
    return dataclasses.replace(light, emitters=tuple(emitters))


def _placed(light: Light, number: int, cost: Callable[[Light], float]) -> tuple[Light, float]:
    """Return a light with emitter ``number`` at the distance of least cost, and that cost.

    The distance is searched on a grid, and then between the neighbours of the best one by golden sections.
    """
    distances = sorted({NEAREST, FARTHEST, *CONFIG.search.distances})
    costs = [cost(_at(light, number, distance)) for distance in distances]
    best = int(np.argmin(costs))
    low, high = (math.log(distances[k]) for k in (max(best - 1, 0), min(best + 1, len(distances) - 1)))
    inner = [high - GOLDEN * (high - low), low + GOLDEN * (high - low)]
    inside = [cost(_at(light, number, math.exp(place))) for place in inner]
    for _ in range(STEPS - 2):
        if inside[0] < inside[1]:
            high = inner[1]
            inner, inside = [high - GOLDEN * (high - low), inner[0]], [0.0, inside[0]]
            inside[0] = cost(_at(light, number, math.exp(inner[0])))
        else:
            low = inner[0]
            inner, inside = [inner[1], low + GOLDEN * (high - low)], [inside[1], 0.0]
            inside[1] = cost(_at(light, number, math.exp(inner[1])))
    found = [(costs[best], distances[best]), *zip(inside, map(math.exp, inner), strict=True)]
    least, distance = min(found)
    return _at(light, number, distance), least
