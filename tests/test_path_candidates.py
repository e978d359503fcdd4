"""Light of the environment at first surfaces: one direction of several is followed, and the mean is that of all."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from tests.test_path_sampling import ERRORS, lamp_sky, near_emitters, sunny
from warp_ar.kernels.materials import Surface
from warp_ar.kernels.reference.path_following import PathState, draw_toward_sky, reflected_from
from warp_ar.kernels.reference.path_sampling import PathKey, balance, make_sky, surface_density
from warp_ar.kernels.reference.path_vertices import LocalScene
from warp_ar.kernels.structs import LAMBERT, METALLIC_ROUGHNESS, Hit

pytestmark = pytest.mark.slow

COUNT = 1 << 16


@wp.kernel(enable_backward=False)
def candidates_kernel(
    scene: LocalScene,
    metal: wp.bool,
    point: wp.vec3,
    normal: wp.vec3,
    wo: wp.vec3,
    depth: wp.int32,
    plain: wp.array[wp.float32],
    balanced: wp.array[wp.float32],
):
    """What a surface reflects of what is drawn: all of it, and by its share beside what the surface draws itself."""
    i = wp.tid()
    surface = Surface()
    surface.model = wp.static(int(LAMBERT))
    surface.diffuse = wp.vec3(1.0, 1.0, 1.0)
    if metal:
        surface.model = wp.static(int(METALLIC_ROUGHNESS))
        surface.diffuse = wp.vec3(0.0, 0.0, 0.0)
        surface.f0 = wp.vec3(0.9, 0.9, 0.9)
        surface.reflectance = surface.f0
        surface.f90 = wp.vec3(1.0, 1.0, 1.0)
        surface.roughness = 0.5
    hit = Hit()
    hit.point = point
    hit.normal = normal
    hit.geometric_normal = normal
    path = PathState()
    path.depth = depth
    key = PathKey()
    key.sample = wp.uint32(i)
    drawn = draw_toward_sky(scene, hit, surface, wo, path, False, key)
    if wp.length(drawn.direction) > 0.0:
        light = reflected_from(surface, hit, wo, drawn.direction)[0] * drawn.radiance[0] / drawn.per
        own = surface_density(surface, normal, wo, drawn.direction)
        plain[i] = light
        balanced[i] = light * balance(drawn.times * drawn.density, own)


def draws(
    scene: LocalScene, metal: bool, normal: tuple[float, ...], depth: int, device: str
) -> tuple[np.ndarray, np.ndarray]:
    found = [wp.zeros(COUNT, dtype=wp.float32, device=device) for _ in range(2)]
    wo = np.array(normal) + np.array((0.5, 0.3, 0.0))
    vectors = [wp.vec3(0.1, 0.05, 0.02), wp.vec3(*normal), wp.vec3(*(wo / np.linalg.norm(wo)))]
    wp.launch(candidates_kernel, COUNT, [scene, metal, *vectors, depth], found, device=device)
    return found[0].numpy().astype(np.float64), found[1].numpy().astype(np.float64)


SKIES = {"sunny": (sunny(), None), "lamps": (lamp_sky(), near_emitters())}


@pytest.mark.parametrize("name", SKIES)
@pytest.mark.parametrize("metal", [False, True], ids=["matt", "metal"])
@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0)], ids=["up", "down"])
def test_candidates_have_the_mean_of_one_draw(
    name: str, metal: bool, normal: tuple[float, float, float], device: str
) -> None:
    """At a first surface, and at a later one, whose single draw is the plain estimate."""
    radiance, emitters = SKIES[name]
    scene = LocalScene()
    scene.sky = make_sky(radiance, device, emitters)
    first, _ = draws(scene, metal, normal, 0, device)
    later, _ = draws(scene, metal, normal, 1, device)
    assert np.isfinite(first).all()
    noise = np.hypot(first.std(), later.std()) / np.sqrt(COUNT)
    assert abs(first.mean() - later.mean()) <= ERRORS * noise + 1e-5 * later.mean()
    assert later.mean() > 10.0 * noise
    assert first.std() < 0.8 * later.std()
