"""Directions toward spheres and what they mirror: draws that follow their densities."""

from __future__ import annotations

import math

import numpy as np
import pytest
import warp as wp

from warp_ar.kernels import structs
from warp_ar.kernels.reference.path_guides import (
    BINS,
    Guides,
    cone_versine,
    draw_guide,
    draw_mirrored,
    guide_density,
    guided_bin,
    make_guides,
    mirrored_density,
    place_on_sphere,
)
from warp_ar.kernels.reference.path_learning import learn_directions, learn_sample, make_squares
from warp_ar.kernels.reference.path_sampling import NO_DENSITY, PathKey, Sky, make_sky, random_triple, sky_radiance
from warp_ar.kernels.sampling import frame_from_normal

COUNT = 1 << 16
# Standard errors that a mean may be off; seeds are fixed.
ERRORS = 5.0
# Share of a sphere's disk, at its rim, that is left to the cones.
RIM = 2e-4
# Radians, of light whose place is found in float32, down to 1e-4 radii above the sphere.
MIRRORED_TOLERANCE = 2e-6


def sunny(height: int = 16) -> np.ndarray:
    """A sky with a gradient and a sun of one texel."""
    radiance = np.ones((height, 2 * height, 3), np.float32) * np.linspace(1.0, 0.2, height)[:, None, None]
    radiance[height // 4, height // 2] = 300.0
    return radiance.astype(np.float32)


@wp.kernel(enable_backward=False)
def mirrored_kernel(sky: Sky, sphere: wp.vec4, point: wp.vec3, found: wp.array2d[wp.float32]):
    """Solid angle and mirrored light of a sphere, by draws of mirrored light and by even ones over its cone."""
    i = wp.tid()
    key = PathKey()
    key.sample = wp.uint32(i)
    u = random_triple(key, 0, 0)
    direction = draw_mirrored(sphere, sky, point, wp.vec2(u[0], u[1]))
    axis = wp.normalize(wp.vec3(sphere[0], sphere[1], sphere[2]) - point)
    versine = cone_versine(sphere, point)
    for way in range(2):
        density = float(0.0)
        if way == 1:
            v = random_triple(key, 0, 1)
            x = v[0] * versine
            sine = wp.sqrt(x * (2.0 - x))
            phi = 2.0 * wp.pi * v[1]
            direction = frame_from_normal(axis) * wp.vec3(sine * wp.cos(phi), sine * wp.sin(phi), 1.0 - x)
            density = 1.0 / (2.0 * wp.pi * versine)
            found[4, i] = mirrored_density(sphere, sky, point, direction) / density
        elif wp.length(direction) > 0.0:
            density = mirrored_density(sphere, sky, point, direction)
        if density > 0.0:
            away = (point - wp.vec3(sphere[0], sphere[1], sphere[2])) / sphere[3]
            half = -wp.dot(away, direction)
            t = half - wp.sqrt(wp.max(half * half - wp.dot(away, away) + 1.0, 0.0))
            normal = away + t * direction
            mirrored = direction - 2.0 * wp.dot(normal, direction) * normal
            found[2 * way, i] = 1.0 / density
            found[2 * way + 1, i] = sky_radiance(sky, wp.normalize(mirrored), NO_DENSITY)[0] / density


def agree(first: np.ndarray, second: np.ndarray | float) -> None:
    error = math.hypot(first.std(), np.std(second)) / math.sqrt(len(first))
    assert abs(first.mean() - np.mean(second)) <= ERRORS * error + RIM * abs(np.mean(second))


@pytest.mark.parametrize("point", [(0.3, -0.2, 0.1), (0.02, 0.0, 0.051), (-0.9, 0.3, -0.4)])
def test_mirrored_light_is_drawn_as_its_density_says(point: tuple[float, float, float], device: str) -> None:
    """The sphere's solid angle and the light that it mirrors come out as by even draws over its cone."""
    sphere = wp.vec4(0.0, 0.0, 0.0, 0.05)
    found = wp.zeros((5, COUNT), dtype=wp.float32, device=device)
    inputs = [make_sky(sunny(), device), sphere, wp.vec3(*point)]
    wp.launch(mirrored_kernel, COUNT, inputs=inputs, outputs=[found], device=device)
    by_light, light, evenly, light_evenly, density = found.numpy().astype(np.float64)
    distance = np.linalg.norm(point)
    solid = 2.0 * math.pi * (1.0 - math.sqrt(1.0 - (0.05 / distance) ** 2))
    agree(by_light, solid)
    agree(evenly, solid)
    agree(light, light_evenly)
    # What is drawn by the light says more of it.
    assert light.std() < 0.5 * light_evenly.std()
    # The sphere hides as much of the sky as has no place on it; the density is less than 1 by that.
    assert 0.3 < density.mean() < 1.0 + ERRORS * density.std() / math.sqrt(COUNT)


@wp.kernel(enable_backward=False)
def place_kernel(distance: wp.array[wp.float32], phi: wp.array[wp.float32], angle_out: wp.array[wp.float32]):
    i = wp.tid()
    angle_out[i] = place_on_sphere(distance[i], phi[i])


def test_the_place_that_mirrors_a_direction(device: str) -> None:
    """The place's normal halves the angle between the point and the light; from the surface itself to far away."""
    rng = np.random.default_rng(2)
    distance = (1.0 + 10.0 ** rng.uniform(-4.0, 1.5, 4096)).astype(np.float32).astype(np.float64)
    phi = rng.uniform(0.0, math.pi, 4096).astype(np.float32).astype(np.float64)
    angle = wp.zeros(4096, dtype=wp.float32, device=device)
    values = [wp.array(v.astype(np.float32), dtype=wp.float32, device=device) for v in (distance, phi)]
    wp.launch(place_kernel, 4096, inputs=values, outputs=[angle], device=device)
    a = angle.numpy().astype(np.float64)
    hidden = phi > np.arccos(1.0 / distance) + 0.5 * math.pi
    sure = np.abs(phi - np.arccos(1.0 / distance) - 0.5 * math.pi) > 1e-3
    np.testing.assert_array_equal((a < 0.0)[sure], hidden[sure])
    seen = ~hidden & sure
    incidence = np.arctan2(distance * np.sin(a), distance - 1.0 - 2.0 * distance * np.sin(0.5 * a) ** 2)
    # Next to the surface a degree of the light is a part of a degree of the place.
    assert np.abs(a + incidence - phi)[seen].max() < MIRRORED_TOLERANCE


@wp.kernel(enable_backward=False)
def guide_kernel(
    guides: Guides, sky: Sky, point: wp.vec3, changes_only: wp.bool, tile: wp.int32, found: wp.array2d[wp.float32]
):
    i = wp.tid()
    key = PathKey()
    key.sample = wp.uint32(i)
    u = random_triple(key, 0, 0)
    direction = draw_guide(guides, sky, point, u[2], wp.vec2(u[0], u[1]), changes_only, tile)
    if wp.length(direction) > 0.0:
        density = guide_density(guides, sky, point, direction, changes_only, tile)
        found[0, i] = (2.0 + direction[0] + direction[2]) / density
        found[2, i] = wp.float32(guided_bin(guides, point, direction))
    v = random_triple(key, 0, 1)
    z = 2.0 * v[0] - 1.0
    sine = wp.sqrt(1.0 - z * z)
    even = wp.vec3(sine * wp.cos(2.0 * wp.pi * v[1]), sine * wp.sin(2.0 * wp.pi * v[1]), z)
    if guide_density(guides, sky, point, even, changes_only, tile) > 0.0:
        found[1, i] = 4.0 * wp.pi * (2.0 + even[0] + even[2])


@pytest.mark.parametrize(
    ("changes_only", "tile"), [(False, -1), (True, -1), (True, 1)], ids=["all", "changes", "learned"]
)
def test_guided_draws_follow_their_density(changes_only: bool, tile: int, device: str) -> None:
    objects = np.zeros(2, np.dtype(structs.Shape.numpy_dtype()))
    objects["kind"], objects["scale"] = (structs.SPHERE, structs.BOX), (1.0, 2.0)
    objects["position"] = (0.0, 0.0, 0.2), (0.3, 0.0, 0.1)
    objects["extent"] = (0.1, 0.0, 0.0), (0.05, 0.04, 0.03)
    objects["material"] = 0, 1
    materials = np.zeros(2, np.dtype(structs.Material.numpy_dtype()))
    materials["model"] = structs.MIRROR, structs.LAMBERT
    balls = np.zeros(1, np.dtype(structs.Probe.numpy_dtype()))
    balls["center"], balls["radius"] = (-0.2, 0.1, 0.08), 0.08
    guides = make_guides(objects, materials, balls, device)
    assert (len(guides.spheres), len(guides.mirrors)) == (3, 2)
    assert (guides.virtual_spheres, guides.virtual_mirrors) == (2, 1)
    chance = np.random.default_rng(7).exponential(size=(2, 2 * int(BINS))) ** 2 + 0.05
    sums = np.cumsum(chance / chance.sum(axis=1, keepdims=True), axis=1)
    learned = np.concatenate([np.zeros((2, 1)), sums / sums[:, -1:]], axis=1)
    guides.learned = wp.array(learned, dtype=wp.float32, device=device)
    found = wp.zeros((3, COUNT), dtype=wp.float32, device=device)
    inputs = [guides, make_sky(sunny(), device), wp.vec3(0.1, -0.2, 0.0), changes_only, tile]
    wp.launch(guide_kernel, COUNT, inputs=inputs, outputs=[found], device=device)
    drawn, evenly, bins = found.numpy().astype(np.float64)
    agree(drawn, evenly)
    # Half of the directions are drawn by mirrored light, of one sphere; those of the other one by its bins alone.
    if tile >= 0:
        others = np.bincount(bins[bins >= BINS].astype(int), minlength=2 * int(BINS))[int(BINS) :]
        expected = 0.5 * COUNT * np.diff(learned[1])[int(BINS) :]
        assert ((others - expected) ** 2 / expected).mean() == pytest.approx(1.0, abs=0.5)


def studio() -> np.ndarray:
    """A dim sky with two lamps of nine texels, one of them low."""
    radiance = np.full((16, 32, 3), (0.10, 0.11, 0.12), np.float32)
    radiance[4:7, 8:11] = (12.0, 11.0, 9.0)
    radiance[6:8, 22:25] = (5.0, 6.0, 8.0)
    return radiance


# Float32 sums of 256 chances.
CHANCE_TOLERANCE = 2e-6


def test_directions_are_learned(device: str) -> None:
    """Chances grow as the root of what tiles around have in a bin; a quarter is even; a tile without any is even."""
    squares = make_squares((20, 33), 1, device)
    assert squares.shape == (15, int(BINS))
    sums = np.zeros((3, 5, int(BINS)), np.int64)
    sums[1, 1, 7], sums[1, 1, 200], sums[0, 2, 7] = 1 << 40, 1 << 42, 1 << 41
    learned = wp.empty((15, int(BINS) + 1), dtype=wp.float32, device=device)
    learn_directions(wp.array(sums.reshape(15, -1), dtype=wp.int64, device=device), learned, width=33)
    cumulative = learned.numpy().astype(np.float64)
    np.testing.assert_array_equal(cumulative[:, [0, -1]], [(0.0, 1.0)] * 15)
    chances = np.diff(cumulative, axis=1).reshape(3, 5, -1)
    padded = np.pad(sums.astype(np.float64), ((1, 1), (1, 1), (0, 0)))
    around = sum(
        (2 - abs(i)) * (2 - abs(j)) * padded[1 + i : 4 + i, 1 + j : 6 + j] for i in (-1, 0, 1) for j in (-1, 0, 1)
    )
    total = np.sqrt(around).sum(axis=2, keepdims=True)
    expected = np.where(total > 0, 0.25 / BINS + 0.75 * np.sqrt(around) / np.maximum(total, 1.0), 1.0 / BINS)
    np.testing.assert_allclose(chances, expected, atol=CHANCE_TOLERANCE)
    assert (np.ptp(chances[2, 4]) < CHANCE_TOLERANCE).all()
    assert chances[1, 1, 200] > chances[1, 1, 7] > 0.2


@wp.kernel(enable_backward=False)
def learn_kernel(
    pixels: wp.array[wp.int32], bins: wp.array[wp.int32], values: wp.array[wp.float32], squares: wp.array2d[wp.int64]
):
    k = wp.tid()
    learn_sample(pixels[k], 33, bins[k], values[k], squares)


def test_what_samples_tell_is_summed_in_their_tile(device: str) -> None:
    """Whatever the order; what is no number, and what tells of no bin, is left out."""
    given = [(0, 3, 1.0), (7 * 33 + 7, 3, 0.5), (8 * 33 + 32, 0, 2.0), (5, -1, 1.0), (5, 4, math.nan), (8, 255, 1e30)]
    pixels, bins, values = (np.array(column) for column in zip(*given, strict=True))
    inputs = [
        wp.array(pixels, dtype=wp.int32, device=device),
        wp.array(bins, dtype=wp.int32, device=device),
        wp.array(values, dtype=wp.float32, device=device),
    ]
    squares = make_squares((20, 33), 1, device)
    wp.launch(learn_kernel, len(given), inputs=inputs, outputs=[squares], device=device)
    expected = np.zeros((15, int(BINS)))
    expected[0, 3], expected[9, 0], expected[1, 255] = 1.5, 2.0, 1e9
    np.testing.assert_array_equal(squares.numpy(), 65536.0 * expected)
