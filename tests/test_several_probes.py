"""Several mirror balls: objects between them are lit by what is interpolated between their maps."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.kernel_rig import look_at
from tests.twins import latlong
from tests.twins.probe_weights import weights
from warp_ar.engine.pipeline import Pipeline
from warp_ar.scene import Camera, LambertMaterial, Marker, MirrorMaterial, Object, Probe, Proxy, Scene
from warp_ar.stages.quality import PRESETS

pytestmark = pytest.mark.slow

Array = NDArray[np.float64]
SIZE = (320, 240)
FOCAL = 320.0
CAMERA = Camera(*SIZE, FOCAL, FOCAL, (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
EYE = np.array([0.0, -0.8, 0.35])
POSE = look_at(EYE, (0.0, 0.0, 0.04))
BALLS = tuple(Probe((x, 0.0, 0.04), 0.04, (0.85,) * 3) for x in (-0.2, 0.2))
PLACES, RADIUS = ((-0.2, -0.05, 0.05), (-0.1, -0.05, 0.05), (0.0, -0.05, 0.05), (0.2, -0.05, 0.05)), 0.015
"""Of the objects, beside the line from ball to ball."""
ALBEDO = 0.8
# Float32 through a hit (a normal is a difference of metres over 15 mm, 1e-5), a map and a sum of a few terms.
SHADING = 1e-4
# The same normals turn what a mirror shows by twice as much, across edges of the map's texels.
MIRRORING = 1e-3


def make_scene(surface: Any) -> Scene:
    """Spheres of one material between the balls."""
    objects = tuple(Object("sphere", at=at, radius=RADIUS, material=surface) for at in PLACES)
    return Scene(
        CAMERA, marker=Marker(size=0.08), probes=BALLS, proxies=(Proxy("plane", size=(2.0, 2.0)),), objects=objects
    )


def hits(place: tuple[float, float, float]) -> tuple[NDArray[np.bool_], Array, Array, Array]:
    """Pixels (H, W) that show an object; there its points, its normals and what they mirror, (n, 3) each."""
    x, y = np.meshgrid(
        (np.arange(SIZE[0]) - (SIZE[0] - 1) / 2) / FOCAL, (np.arange(SIZE[1]) - (SIZE[1] - 1) / 2) / FOCAL
    )
    d = np.stack([x, y, np.ones_like(x)], -1) @ POSE.rotation
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    o = EYE - place
    along = d @ o
    under = along**2 - o @ o + RADIUS**2
    shown = under > 0.0
    points = EYE + (-along - np.sqrt(np.maximum(under, 0.0)))[shown, None] * d[shown]
    normals = (points - place) / RADIUS
    return shown, points, normals, d[shown] - 2.0 * (d[shown] * normals).sum(-1, keepdims=True) * normals


@pytest.mark.parametrize("mirror", [False, True])
def test_objects_have_the_light_of_the_balls_maps_by_their_weights(device: str, mirror: bool) -> None:
    frame = cv2.resize(np.random.default_rng(2).integers(20, 200, (24, 32, 3)).astype(np.uint8), SIZE)
    surface = MirrorMaterial() if mirror else LambertMaterial((ALBEDO,) * 3)
    name, places = "environment" if mirror else "irradiance", [(*ball.center, 1.0) for ball in BALLS]
    quality = PRESETS["low"].with_methods(recover="clipped")
    with Pipeline(make_scene(surface), device=device, quality=quality) as pipeline:
        pipeline(frame, pose=POSE, time_seconds=0.0)
        virtual = pipeline.arrays["virtual"].numpy().astype(np.float64)
        first = pipeline.arrays[name if mirror else "irradiance_map"].numpy()
        maps = [one.astype(np.float64) for one in (first, *pipeline.arrays[f"others_{name}"].numpy())]
    assert np.abs(maps[0] - maps[1]).max() > 0.1, "the balls must see different light"
    # Pixels of one sample alone: the object covers them and all beside them.
    inside = cv2.erode((virtual[..., 3] == 1.0).astype(np.uint8), np.ones((3, 3), np.uint8))
    for place in PLACES:
        shown, points, normals, toward = hits(place)
        whole = inside[shown] == 1
        assert whole.sum() > 50
        light = [latlong.sample_latlong(one, toward if mirror else normals) for one in maps]
        mixed = np.einsum("nb,bnc->nc", np.array([weights(places, point) for point in points]), light)
        expected = mixed if mirror else ALBEDO / np.pi * mixed
        found = virtual[shown][:, :3]
        np.testing.assert_allclose(found[whole], expected[whole], rtol=MIRRORING if mirror else SHADING)
