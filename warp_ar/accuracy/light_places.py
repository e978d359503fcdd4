"""Distances of the emitters of a given light, by what a frame's surfaces show.

Light that a file gives is light as one point sees it: it says in which direction an emitter stands, not how far. Taken
for distant, a lamp half a metre away lights all of a desk alike, and its shadows fall in one direction. The frame knows
better. With the right distances the reflectance that it tells of a desk, radiance over irradiance, is the same
everywhere but for texture; with wrong ones it falls off across the desk, and has shadows in it that are no shadows and
lights where there should be shadows. So emitters are placed one after another, the most powerful first, where the
reflectance of each proxy scatters least:

    cost = mean over pixels of log(1 + (r / GRAIN)^2),    r = log(reflectance) - its median over the proxy,

by the path tracer, which knows shadows, interreflection and balls. ``Light.save`` keeps what was found.
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
"""Width, pixels, of the pictures that measure reflectance."""
SAMPLES = 16
"""Samples of each of their pixels."""
GRAIN = 0.1
"""Deviation of a reflectance's logarithm, about that of wood or paper, beyond which it counts less and less."""
SHOWN = (0.01, 0.95)
"""Radiance between which a pixel tells reflectance, in camera values."""
LEAST_PIXELS = 50
"""Least number of a proxy's pixels for an estimate."""
WORTH = 0.1
"""Fall of the cost, as a share of it, that a place must be worth: grain and clutter look like shadows by chance."""
MOST = 3
"""Emitters that are placed at most."""
NEAREST, FARTHEST = 0.25, 2.0
"""Metres: nearer ones would stand in the picture, and farther ones are as good as distant."""
BOUND = 0.9 * FARTHEST
"""Metres beyond which nothing is placed: what does best where the search ends has no place, such as paint that is
darker toward one side under light from afar."""
STEPS = 6
"""Steps of the search between two tried distances."""
GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)


def reflectance_scatter(tracer: PathTracer) -> float:
    """Return the scatter of the reflectance that a frame tells over each proxy: the cost above.

    Args:
        tracer: Of the frame, in the light that is judged.

    Raises:
        UsageError: No proxy is shown well enough to tell.
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
        raise UsageError("the frame shows no proxy by which emitters could be placed")
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
    """The light with the distances of its emitters, as far as the frame tells them.

    Args:
        light: As the first mirror ball of the scene sees it, in the world's axes; an image is latlong (h, 2 h, 3). A
            light that has an emitter of known distance is returned as it is.
        scene: Whose proxies tell.
        frame: What the camera saw, (H, W, 3), without anything virtual.
        pose: ``camera_from_world``.
        device: ``auto``, ``cpu`` or ``cuda:N``.
        seconds: Since the first frame.

    Raises:
        UsageError: The scene has no ball, from whose centre distances count, or shows no proxy.
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
    """The light with one emitter at a distance."""
    emitters = list(light.emitters)
    emitters[number] = dataclasses.replace(emitters[number], distance=distance)
    return dataclasses.replace(light, emitters=tuple(emitters))


def _placed(light: Light, number: int, cost: Callable[[Light], float]) -> tuple[Light, float]:
    """The light with one emitter at the distance of least cost, which is returned too: a grid, then golden sections."""
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
