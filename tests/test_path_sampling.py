"""Where paths go next: densities that integrate to 1, draws that follow them, estimates that agree with quadrature."""

from __future__ import annotations

import math

import numpy as np
import pytest
import warp as wp

from tests.kernel_rig import TEXTURES, records
from warp_ar.kernels import structs
from warp_ar.kernels.emitters import add_emitters
from warp_ar.kernels.materials import make_surface
from warp_ar.kernels.rays.shapes import FAR
from warp_ar.kernels.reference.path_sampling import (
    ALL_MODELS,
    NO_DENSITY,
    PathKey,
    Sky,
    draw_reflected,
    draw_sky,
    make_sky,
    near_radiance,
    random_triple,
    reflect_direct,
    sky_radiance,
    sky_tables,
    split_emitters,
    surface_density,
)
from warp_ar.kernels.sampling import sample_cosine_hemisphere
from warp_ar.kernels.split_sum import integrate_dfg
from warp_ar.kernels.structs import LAMBERT, METALLIC_ROUGHNESS, PHONG, Emitter, Hit, RayScene
from warp_ar.light.captured import latlong_directions

HEIGHT = 16
COUNT = 1 << 16
# Standard errors that a mean may be off: one test in 1.7 million fails by chance, and seeds are fixed.
ERRORS = 5.0
# Of float32 sums over a map's rows and columns against float64.
TABLE_TOLERANCE = 2e-6


def sunny(height: int = HEIGHT) -> np.ndarray:
    """A sky with a gradient and a sun of one texel."""
    radiance = np.ones((height, 2 * height, 3), np.float32) * np.linspace(1.0, 0.2, height)[:, None, None]
    radiance[height // 4, height // 2] = 300.0
    return radiance.astype(np.float32)


def solid_angles(height: int) -> np.ndarray:
    edges = np.cos(np.linspace(0.0, math.pi, height + 1))
    return np.repeat(((edges[:-1] - edges[1:]) * math.pi / height)[:, None], 2 * height, axis=1)


surface_of = make_surface(ALL_MODELS, True)


@wp.kernel(enable_backward=False)
def sky_kernel(
    sky: Sky, point: wp.vec3, normal: wp.vec3, estimates: wp.array2d[wp.float32], directions: wp.array[wp.vec3]
):
    """Irradiance of one draw toward the light, by its light and by the surface's cosine."""
    i = wp.tid()
    key = PathKey()
    key.sample = wp.uint32(i)
    u = random_triple(key, 0, 0)
    light = draw_sky(sky, point, wp.vec2(u[0], u[1]), u[2])
    cosine = wp.max(wp.dot(light.direction, normal), 0.0)
    estimates[0, i] = light.radiance[0] * cosine / light.density
    v = random_triple(key, 0, 1)
    local = sample_cosine_hemisphere(wp.vec2(v[0], v[1]))
    wi = wp.vec3(local[0], local[1], local[2])
    if normal[2] < 0.0:
        wi = wp.vec3(local[0], local[1], -local[2])
    radiance = sky_radiance(sky, wi, NO_DENSITY) + near_radiance(sky, point, wi, FAR, NO_DENSITY)
    estimates[1, i] = wp.pi * radiance[0]
    # Both ways, balanced.
    density = wp.max(wp.dot(wi, normal), 0.0) / wp.pi
    both = sky_radiance(sky, wi, density) + near_radiance(sky, point, wi, FAR, density)
    estimates[2, i] = wp.pi * both[0] + light.radiance[0] * cosine / (light.density + cosine / wp.pi)
    directions[i] = light.direction


@wp.kernel(enable_backward=False)
def emitter_kernel(emitters: wp.array[Emitter], point: wp.vec3, normal: wp.vec3, irradiance: wp.array[wp.vec3]):
    """What ``emitters`` makes of the irradiance of a map."""
    irradiance[0] = add_emitters(irradiance[0], emitters, point, normal)


@wp.kernel(enable_backward=False)
def surface_kernel(
    scene: RayScene,
    dfg: wp.array2d[wp.vec2],
    wo: wp.vec3,
    estimates: wp.array2d[wp.float32],
    missing: wp.array[wp.int32],
):
    """Albedo by the surface's draws and by uniform ones, and the integral of the density."""
    i = wp.tid()
    normal = wp.vec3(0.0, 0.0, 1.0)
    hit = Hit()
    hit.corner = -1
    surface = surface_of(scene, dfg, hit, wo[2], 0.0)
    key = PathKey()
    key.sample = wp.uint32(i)
    u = random_triple(key, 0, 0)
    direction = draw_reflected(surface, normal, normal, wo, u[2], wp.vec2(u[0], u[1]))
    if wp.length(direction) > 0.0:
        density = surface_density(surface, normal, wo, direction)
        estimates[0, i] = reflect_direct(surface, normal, wo, direction)[0] / density
    else:
        missing[i] = 1
    v = random_triple(key, 0, 1)
    sin_theta = wp.sqrt(v[0] * (2.0 - v[0]))
    phi = 2.0 * wp.pi * v[1]
    wi = wp.vec3(sin_theta * wp.cos(phi), sin_theta * wp.sin(phi), 1.0 - v[0])  # uniform over the hemisphere
    estimates[1, i] = 2.0 * wp.pi * reflect_direct(surface, normal, wo, wi)[0]
    estimates[2, i] = 2.0 * wp.pi * surface_density(surface, normal, wo, wi)


def check_mean(samples: np.ndarray, expected: float) -> None:
    error = samples.std() / math.sqrt(len(samples))
    assert abs(samples.mean() - expected) <= ERRORS * error + 1e-5 * abs(expected), (samples.mean(), expected, error)


def draw(sky: Sky, point: tuple[float, ...], normal: tuple[float, ...], device: str) -> tuple[np.ndarray, np.ndarray]:
    estimates = wp.zeros((3, COUNT), dtype=wp.float32, device=device)
    directions = wp.zeros(COUNT, dtype=wp.vec3, device=device)
    wp.launch(sky_kernel, COUNT, [sky, wp.vec3(*point), wp.vec3(*normal)], [estimates, directions], device=device)
    return estimates.numpy().astype(np.float64), directions.numpy()


def test_densities_of_the_sky_integrate_to_one() -> None:
    radiance = sunny()
    radiance[3, 3] = (np.nan, -1.0, np.inf)
    tables = sky_tables(radiance)
    total = (tables["density"].astype(np.float64) * solid_angles(HEIGHT)).sum()
    assert total == pytest.approx(1.0, abs=TABLE_TOLERANCE)
    assert (np.diff(tables["rows"]) > 0).all()
    assert (np.diff(tables["columns"], axis=1) > 0).all(), "a direction is never drawn"
    assert np.isfinite(tables["radiance"]).all()


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0)])
def test_every_way_to_draw_gives_the_same_irradiance(normal: tuple[float, float, float], device: str) -> None:
    """Bilinear radiance over a gradient and a sun: what a fine quadrature gives."""
    estimates, _ = draw(make_sky(sunny(), device), (0, 0, 0), normal, device)
    fine = 8 * HEIGHT
    v, u = ((np.arange(fine) + 0.5) / 8 - 0.5), ((np.arange(2 * fine) + 0.5) / 8 - 0.5)
    radiance = sunny()[..., 0].astype(np.float64)
    tall = np.concatenate([np.roll(radiance[:1], HEIGHT, 1), radiance, np.roll(radiance[-1:], HEIGHT, 1)])
    i, j = np.floor(v).astype(int), np.floor(u).astype(int)
    fy, fx = (v - i)[:, None], (u - j)[None]
    rows = (1 - fy) * tall[i + 1] + fy * tall[i + 2]
    values = (1 - fx) * rows[:, j % (2 * HEIGHT)] + fx * rows[:, (j + 1) % (2 * HEIGHT)]
    theta = (np.arange(fine) + 0.5)[:, None] * math.pi / fine
    expected = (values * np.maximum(np.cos(theta) * normal[2], 0.0) * solid_angles(fine)).sum()
    for way in estimates:
        # The quadrature itself is right within 1e-3.
        error = way.std() / math.sqrt(COUNT)
        assert abs(way.mean() - expected) <= ERRORS * error + 1e-3 * expected


def near_emitters() -> np.ndarray:
    far = {"direction": (-0.6, 0.0, 0.8), "distance": np.inf}
    return records(Emitter, {"direction": (0.6, 0.0, 0.8), "distance": 0.8}, far).numpy()


def lamp_sky(height: int = 64) -> np.ndarray:
    """A dim sky with a lamp toward the first of ``near_emitters``."""
    radiance = np.full((height, 2 * height, 3), 0.2, np.float32)
    radiance[latlong_directions(height) @ (0.6, 0.0, 0.8) > math.cos(math.radians(4.0))] = 50.0
    return radiance


@pytest.mark.parametrize("point", [(0.0, 0.0, 0.0), (0.15, 0.05, 0.1)])
def test_near_emitters_shine_from_where_they_are(point: tuple[float, float, float], device: str) -> None:
    """As ``emitters`` has it, for each way to draw: irradiance of the map, moved."""
    lamps = near_emitters()
    radiance = lamp_sky()
    estimates, _ = draw(make_sky(radiance, device, lamps), point, (0, 0, 1), device)
    height = len(radiance)
    lamp = (radiance[..., 0] > 1.0) * 49.8 * solid_angles(height)
    toward = latlong_directions(height)
    mean = (lamp[..., None] * toward).sum((0, 1))
    lamps["power"][0], lamps["direction"][0] = lamp.sum(), mean / np.linalg.norm(mean)
    before = 0.2 * math.pi + (lamp * np.maximum(toward[..., 2], 0.0)).sum()
    irradiance = wp.array(np.full((1, 3), before, np.float32), dtype=wp.vec3, device=device)
    emitters = wp.array(lamps, dtype=Emitter, device=device)
    normal = wp.vec3(0.0, 0.0, 1.0)
    wp.launch(emitter_kernel, 1, [emitters, wp.vec3(*point), normal], [irradiance], device=device)
    expected = float(irradiance.numpy()[0, 0])
    if point != (0.0, 0.0, 0.0):
        assert abs(expected / before - 1.0) > 0.1, "the place makes no difference here"
    for way in estimates:
        # A lamp of 4 degrees is no point: its far parts are farther, by some thousandths of its light.
        assert abs(way.mean() - expected) <= ERRORS * way.std() / math.sqrt(COUNT) + 1e-2 * expected


MATTER = {
    "lambert": ({"model": LAMBERT, "base_color": (0.5, 0.5, 0.5)}, 1.0),
    "phong": ({"model": PHONG, "base_color": (0.3,) * 3, "specular": (0.5,) * 3, "shininess": 8.0}, 0.9),
    "plastic": ({"model": METALLIC_ROUGHNESS, "base_color": (0.6,) * 3, "roughness": 0.4}, 0.8),
    "metal": ({"model": METALLIC_ROUGHNESS, "base_color": (0.9,) * 3, "roughness": 0.6, "metallic": 1.0}, 0.9),
    "grazing": ({"model": METALLIC_ROUGHNESS, "base_color": (0.9,) * 3, "roughness": 0.5, "metallic": 1.0}, 0.05),
}
"""Fields of a material, and the cosine under which it is seen."""


@pytest.mark.parametrize("name", MATTER)
def test_surfaces_are_drawn_as_their_density_says(name: str, device: str) -> None:
    fields, cosine = MATTER[name]
    scene = RayScene()
    scene.materials = records(structs.Material, {**dict.fromkeys(TEXTURES, -1), **fields}, device=device)
    scene.objects = wp.zeros(1, dtype=structs.Shape, device=device)
    dfg = wp.zeros((32, 32), dtype=wp.vec2, device=device)
    integrate_dfg(dfg)
    estimates = wp.zeros((3, COUNT), dtype=wp.float32, device=device)
    missing = wp.zeros(COUNT, dtype=wp.int32, device=device)
    wo = wp.vec3(math.sqrt(1.0 - cosine * cosine), 0.0, cosine)
    wp.launch(surface_kernel, COUNT, [scene, dfg, wo], [estimates, missing], device=device)
    drawn, uniform, density = estimates.numpy().astype(np.float64)
    error = math.hypot(drawn.std(), uniform.std()) / math.sqrt(COUNT)
    assert abs(drawn.mean() - uniform.mean()) <= ERRORS * error
    # What is drawn leads into the surface or has a density.
    check_mean(density + missing.numpy(), 1.0)
    assert drawn.std() < uniform.std() + 1e-6


def test_near_emitters_are_taken_out_of_the_sky() -> None:
    radiance = lamp_sky()
    distant, sent, owner = split_emitters(radiance, near_emitters()[:1])
    np.testing.assert_allclose(distant + sent, radiance, rtol=1e-6)
    assert distant.max() == pytest.approx(0.2, rel=1e-5)
    assert sent.max() == pytest.approx(49.8, rel=1e-5)
    assert (owner[sent.max(axis=2) > 0] == 0).all()
    assert (sent[owner < 0] == 0).all()
