"""Emitters of a light that is given: placed where a frame's surfaces say, and left alone where they say nothing."""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
import numpy.typing as npt
import pytest

from tests.kernel_rig import look_at
from warp_ar.accuracy import light_places
from warp_ar.accuracy.light_places import place_emitters
from warp_ar.accuracy.path_tracer import PathTracer
from warp_ar.errors import UsageError
from warp_ar.light.captured import CapturedEmitter, Light, latlong_directions
from warp_ar.scene import Camera, Pose, Probe, Proxy, Scene

pytestmark = pytest.mark.slow

SCENE = Scene(
    Camera(80, 60, 80.0, 80.0, 39.5, 29.5),
    proxies=(
        Proxy("plane", size=(1.6, 1.2)),
        Proxy("box", size=(0.2, 0.06, 0.08), at=(0.03, 0.22, 0.04)),
    ),
    probes=(Probe(center=(-0.12, 0.03, 0.036), radius=0.035),),
)
POSE = look_at((0.08, -0.6, 0.5), (0.0, 0.03, 0.0))
REFLECTANCES = ((0.4, 0.3, 0.22), (0.3, 0.3, 0.32))
TOWARD = np.array((-0.47, 0.45, 0.76)) / np.linalg.norm((-0.47, 0.45, 0.76))
# Of a distance: a lamp of half a metre on a desk of a metre. Found are 0.3 to 9 % on five desks.
DISTANCE_TOLERANCE = 0.12
GRAIN = 0.3
"""Deviation of the logarithm of a reflectance from texel to texel: more than wood has."""


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measure reflectance at the pictures' own size: each trial distance is a picture."""
    monkeypatch.setattr(light_places, "WIDTH", SCENE.camera.width)


def lamp_light(distance: float | None) -> Light:
    """Dim light, and a lamp of seven degrees that brings most of what falls on the desk."""
    directions = latlong_directions(64)
    radiance = np.full((64, 128, 3), 0.05, np.float32)
    radiance[directions @ TOWARD > math.cos(math.radians(3.5))] = (60.0, 48.0, 30.0)
    emitter = CapturedEmitter(tuple(TOWARD), 0.012, (0.7, 0.6, 0.4), (0, 0, 0), None, distance, SCENE.probes[0].center)
    return Light(radiance, np.ones((64, 128), np.float32), (emitter,))


def photograph(light: Light, scene: Scene = SCENE, pose: Pose = POSE) -> npt.NDArray[np.float32]:
    """What a camera would see of the empty desk, exposed so that nothing of it clips."""
    tracer = PathTracer(scene, light, None, pose, device="cpu", reflectances=REFLECTANCES, seed=5)
    tracer.sample(64)
    radiance = tracer.picture().radiance
    # A ball shows the lamp itself, which no proxy is told by.
    return np.minimum(radiance, 0.9)


@functools.cache
def under_lamp(distance: float | None) -> npt.NDArray[np.float32]:
    """The desk under ``lamp_light``."""
    return photograph(lamp_light(distance))


def distances(light: Light) -> list[float | None]:
    return [emitter.distance for emitter in light.emitters]


def test_a_lamp_is_found_where_it_stands(device: str) -> None:
    distance = 0.35
    frame = under_lamp(distance)
    (found,) = distances(place_emitters(lamp_light(None), SCENE, frame, POSE, device=device))
    assert found is not None
    assert abs(math.log(found / distance)) < DISTANCE_TOLERANCE


def test_light_from_afar_stays_there(device: str) -> None:
    """Where nothing falls off, nothing is near, whatever grain the desk has."""
    grain = np.exp(GRAIN * np.random.default_rng(3).standard_normal((60, 80, 1))).astype(np.float32)
    for frame in (under_lamp(None), np.minimum(under_lamp(None) * grain, 0.9)):
        assert distances(place_emitters(lamp_light(None), SCENE, frame, POSE, device=device)) == [None]


def test_paint_that_is_darker_to_one_side_is_no_lamp(device: str) -> None:
    """Hard case: under light from afar, a desk that falls off as under a near lamp."""
    paint = np.linspace(1.0, 0.5, 60, dtype=np.float32)[:, None, None]
    assert distances(place_emitters(lamp_light(None), SCENE, under_lamp(None) * paint, POSE, device=device)) == [None]


def test_emitters_are_found_in_an_image_of_light(device: str) -> None:
    light = lamp_light(0.5)
    placed = place_emitters(light.radiance, SCENE, photograph(light), POSE, device=device)
    (found,) = distances(placed)
    assert found is not None
    assert abs(math.log(found / 0.5)) < DISTANCE_TOLERANCE
    assert placed.emitters[0].origin == SCENE.probes[0].center
    assert np.dot(placed.emitters[0].direction, TOWARD) > math.cos(math.radians(1.0))


def test_what_is_known_stays_as_it_is(device: str) -> None:
    light = lamp_light(0.7)
    assert place_emitters(light, SCENE, np.zeros((60, 80, 3), np.float32), POSE, device=device) is light


def test_what_tells_nothing_is_named(device: str) -> None:
    frame = np.full((60, 80, 3), 0.3, np.float32)
    with pytest.raises(UsageError, match="mirror ball"):
        place_emitters(lamp_light(None), dataclasses.replace(SCENE, probes=()), frame, POSE, device=device)
    with pytest.raises(UsageError, match="no proxy"):
        place_emitters(lamp_light(None), SCENE, np.ones_like(frame), POSE, device=device)


def test_even_light_has_no_emitters(device: str) -> None:
    frame = np.full((60, 80, 3), 0.3, np.float32)
    assert place_emitters(np.ones((16, 32, 3), np.float32), SCENE, frame, POSE, device=device).emitters == ()
