"""Where a path goes next: directions drawn by the environment's light, by a virtual light, or by what a surface is.

Each way to draw a direction has its density, per steradian, so that two ways can be combined by the balance heuristic
[VG95]: a direction of density p that another way would have drawn with density q counts p / (p + q) of its light.

Environment. A texel is drawn by inverting the cumulative sums of rows, then of the texels of one row, of brightness
times solid angle; within a texel directions are uniform. Radiance is looked up bilinearly, so that the light of one
texel reaches into those around it: what is summed is brightness after a tent of three texels, and a hundredth of the
mean everywhere, which leaves no direction that has light without samples.

Surfaces. A lobe is chosen in proportion to its reflectance, a cosine for the diffuse part, visible half vectors for
GGX, the lobe itself for Phong. What a surface reflects is that of ``materials``, to which all of this only adds
densities. A mirror has no density: its direction counts in full.

Virtual lights of a radius are disks that face the point, as ``shadow`` has them: with the irradiance E of a surface
that faces the light, its disk has the radiance E p, p = d^2 / (pi r^2 cos^3) the density of a uniform point of the disk
seen from distance d under the angle to its centre, so that the disk's irradiance is E whatever d is.

References:
    [VG95] Veach, Guibas, "Optimally Combining Sampling Techniques for Monte Carlo Rendering", SIGGRAPH 1995.
    [DB23] Dupuy, Benyoub, "Sampling Visible GGX Normals with Spherical Caps", 2023.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

from warp_ar.kernels.color import brightness
from warp_ar.kernels.guards import MAX_RADIANCE
from warp_ar.kernels.latlong import latlong_from_direction, sample_latlong
from warp_ar.kernels.materials import MIN_ALPHA, Surface, make_reflect_direct, reflect
from warp_ar.kernels.sampling import (
    frame_from_normal,
    ggx_visible_pdf,
    pcg3d_hash,
    phong_lobe_pdf,
    sample_cosine_hemisphere,
    sample_disk,
    sample_ggx_visible,
    sample_phong_lobe,
    uniform_from_bits,
)
from warp_ar.kernels.shadow import LightSample, has_penumbra, sample_light
from warp_ar.kernels.structs import LAMBERT, METALLIC_ROUGHNESS, MIRROR, PHONG, Light

wp.set_module_options({"enable_backward": False})

PI = wp.constant(wp.float32(math.pi))
ALL_MODELS = tuple(sorted(map(int, (LAMBERT, PHONG, METALLIC_ROUGHNESS, MIRROR))))
"""Of materials."""
NO_DENSITY = wp.constant(wp.float32(-1.0))
"""Instead of the density of a direction that was not drawn from one: a mirror's, or the camera's."""
LEAST_CHANCE = wp.constant(wp.float32(0.1))
"""Of either lobe of a surface that has two: what one of them hardly reflects may still be all that is to be seen."""
EVEN_SHARE = 0.01
"""Of the mean density, what every direction of the environment gets at least."""
STREAMS = wp.constant(16)
"""Triples of random numbers that a vertex of a path may ask for."""
SEED_STEP = wp.constant(wp.uint32(0x9E3779B9))

reflect_direct = make_reflect_direct(ALL_MODELS)


@wp.struct
class Sky:
    """The environment as paths read it."""

    radiance: wp.array2d[wp.vec3]  # latlong
    density: wp.array2d[wp.float32]  # per steradian, of ``draw_sky``, constant within a texel
    rows: wp.array[wp.float32]  # (H + 1) cumulative, from 0 to 1
    columns: wp.array2d[wp.float32]  # (H, W + 1) cumulative along each row, from 0 to 1


@wp.struct
class PathKey:
    """What makes the random numbers of one path its own."""

    pixel: wp.uint32
    sample: wp.uint32
    seed: wp.uint32


@wp.struct
class Drawn:
    """A direction that was drawn."""

    direction: wp.vec3  # unit; zero where there is none
    weight: wp.vec3  # reflected radiance per radiance from there: f cos / density
    density: wp.float32  # per steradian, or NO_DENSITY


@wp.func
def random_triple(key: PathKey, vertex: wp.int32, stream: wp.int32) -> wp.vec3:
    """Three independent numbers in [0, 1), the same whenever they are asked for."""
    z = key.seed * SEED_STEP + wp.uint32(vertex * STREAMS + stream)
    bits = pcg3d_hash(key.pixel, key.sample, z)
    return wp.vec3(uniform_from_bits(bits[0]), uniform_from_bits(bits[1]), uniform_from_bits(bits[2]))


@wp.func
def balance(density: wp.float32, other: wp.float32) -> wp.float32:
    """Share of the light of a direction that counts for the way that drew it with ``density``."""
    if density < 0.0:
        return 1.0
    return density / (density + other)


@wp.func
def find_step(cumulative: wp.array[wp.float32], u: wp.float32) -> wp.int32:
    """Index k with cumulative[k] <= u < cumulative[k + 1], of sums from 0 to 1; never a step of no height."""
    low = wp.int32(0)
    high = cumulative.shape[0] - 2
    while low < high:
        middle = (low + high) / 2
        if cumulative[middle + 1] > u:
            high = middle
        else:
            low = middle + 1
    return low


@wp.func
def draw_sky(sky: Sky, u: wp.vec2) -> Drawn:
    """Direction toward the environment; its weight is left out."""
    height = sky.radiance.shape[0]
    width = sky.radiance.shape[1]
    row = find_step(sky.rows, u[0])
    line = sky.columns[row]
    column = find_step(line, u[1])
    down = wp.clamp((u[0] - sky.rows[row]) / wp.max(sky.rows[row + 1] - sky.rows[row], 1.0e-30), 0.0, 1.0)
    along = wp.clamp((u[1] - line[column]) / wp.max(line[column + 1] - line[column], 1.0e-30), 0.0, 1.0)
    # Uniform in solid angle: in sin^2 of half the polar angle, which keeps its digits at the pole.
    step = 0.5 * PI / wp.float32(height)
    top = wp.sin(step * wp.float32(row))
    bottom = wp.sin(step * wp.float32(row + 1))
    half = top * top + down * (bottom * bottom - top * top)
    sine = 2.0 * wp.sqrt(wp.max(half * (1.0 - half), 0.0))
    phi = (2.0 * (wp.float32(column) + along) / wp.float32(width) - 1.0) * PI
    drawn = Drawn()
    drawn.direction = wp.vec3(sine * wp.cos(phi), sine * wp.sin(phi), 1.0 - 2.0 * half)
    drawn.density = sky.density[row, column]
    return drawn


@wp.func
def sky_density(sky: Sky, direction: wp.vec3) -> wp.float32:
    """Density with which ``draw_sky`` gives a direction."""
    height = sky.radiance.shape[0]
    width = sky.radiance.shape[1]
    at = latlong_from_direction(direction, height, width)
    row = wp.clamp(wp.int32(at[0]), 0, height - 1)
    column = wp.clamp(wp.int32(at[1]), 0, width - 1)
    return sky.density[row, column]


@wp.func
def sky_radiance(sky: Sky, direction: wp.vec3) -> wp.vec3:
    """Radiance of the environment."""
    return sample_latlong(sky.radiance, direction)


@wp.func
def lobe_chance(surface: Surface) -> wp.float32:
    """Probability of the glossy lobe."""
    glossy = brightness(surface.reflectance)
    diffuse = brightness(surface.diffuse)
    if glossy <= 0.0:
        return 0.0
    if diffuse <= 0.0:
        return 1.0
    return wp.clamp(glossy / (glossy + diffuse), LEAST_CHANCE, 1.0 - LEAST_CHANCE)


@wp.func
def lobe_alpha(surface: Surface) -> wp.float32:
    """Width of a GGX lobe, no narrower than ``reflect_direct`` has it."""
    return wp.max(surface.roughness * surface.roughness, MIN_ALPHA)


@wp.func
def surface_density(surface: Surface, normal: wp.vec3, wo: wp.vec3, wi: wp.vec3) -> wp.float32:
    """Density with which ``draw_reflected`` gives ``wi``; 0 for mirrors and behind the surface."""
    cosine = wp.dot(normal, wi)
    if cosine <= 0.0 or surface.model == wp.static(int(MIRROR)):
        return 0.0
    chance = lobe_chance(surface)
    density = (1.0 - chance) * cosine / PI
    if surface.model == wp.static(int(PHONG)):
        density += chance * phong_lobe_pdf(wp.dot(reflect(wo, normal), wi), surface.shininess)
    if surface.model == wp.static(int(METALLIC_ROUGHNESS)):
        half = wi + wo
        length = wp.length(half)
        if length > 1.0e-6:
            half = half / length
            from_world = wp.transpose(frame_from_normal(normal))
            facing = wp.max(wp.dot(wo, half), 1.0e-7)
            visible = ggx_visible_pdf(from_world * half, from_world * wo, lobe_alpha(surface))
            density += chance * visible / (4.0 * facing)
    return density


@wp.func
def draw_reflected(
    surface: Surface, normal: wp.vec3, geometric: wp.vec3, wo: wp.vec3, pick: wp.float32, u: wp.vec2
) -> Drawn:
    """Direction from which a surface reflects light toward ``wo``; none if it leads into the surface."""
    drawn = Drawn()
    if surface.model == wp.static(int(MIRROR)):
        wi = reflect(wo, normal)
        if wp.dot(wi, geometric) > 0.0:
            drawn.direction = wi
            drawn.weight = surface.reflectance
            drawn.density = NO_DENSITY
        return drawn
    basis = frame_from_normal(normal)
    if pick >= lobe_chance(surface):
        wi = basis * sample_cosine_hemisphere(u)
    elif surface.model == wp.static(int(PHONG)):
        wi = frame_from_normal(reflect(wo, normal)) * sample_phong_lobe(u, surface.shininess)
    else:
        half = basis * sample_ggx_visible(u, wp.transpose(basis) * wo, lobe_alpha(surface))
        wi = reflect(wo, half)
    wi = wp.normalize(wi)
    if wp.dot(wi, geometric) <= 0.0:
        return drawn
    density = surface_density(surface, normal, wo, wi)
    if density > 0.0:
        drawn.direction = wi
        drawn.weight = reflect_direct(surface, normal, wo, wi) / density
        drawn.density = density
    return drawn


@wp.func
def disk_density(light: Light, distance: wp.float32, cosine: wp.float32) -> wp.float32:
    """Density of a uniform point of a light's disk, seen from a distance of its centre under an angle to it."""
    return distance * distance / (PI * light.radius * light.radius * cosine * cosine * cosine)


@wp.func
def draw_on_light(light: Light, sample: LightSample, u: wp.vec2) -> wp.vec4:
    """Direction toward a point of a light, unit, and how far that is; a light without a disk is its centre."""
    if not has_penumbra(light, sample):
        return wp.vec4(sample.wi[0], sample.wi[1], sample.wi[2], sample.distance)
    disk = light.radius * sample_disk(u)
    away = frame_from_normal(sample.wi) * wp.vec3(disk[0], disk[1], sample.distance)
    distance = wp.length(away)
    return wp.vec4(away[0] / distance, away[1] / distance, away[2] / distance, distance)


@wp.func
def lights_in_the_way(
    lights: wp.array[Light], origin: wp.vec3, direction: wp.vec3, t_max: wp.float32, density: wp.float32
) -> wp.vec3:
    """Radiance of the disks of virtual lights that a ray of ``density`` meets before ``t_max``, by its share."""
    radiance = wp.vec3(0.0, 0.0, 0.0)
    for index in range(lights.shape[0]):
        light = lights[index]
        if light.radius > 0.0:
            sample = sample_light(light, origin)
            if has_penumbra(light, sample):
                cosine = wp.dot(sample.wi, direction)
                if cosine > 0.0 and sample.distance < t_max * cosine:
                    sine = wp.length(wp.cross(sample.wi, direction))
                    if sample.distance * sine < light.radius * cosine:
                        own = disk_density(light, sample.distance, cosine)
                        radiance += own * balance(density, own) * sample.irradiance_normal
    return radiance


def sky_tables(radiance: np.ndarray) -> dict[str, Any]:
    """The cumulative sums and densities of ``Sky``, computed in float64.

    Args:
        radiance: Latlong (H, W, 3), linear; negative values and NaN count as 0.

    Returns:
        ``radiance`` (H, W, 3), ``density`` (H, W), ``rows`` (H + 1,) and ``columns`` (H, W + 1), all float32.
    """
    clean = np.clip(np.nan_to_num(radiance, nan=0.0, posinf=float(MAX_RADIANCE)), 0.0, float(MAX_RADIANCE))
    height, width = clean.shape[:2]
    bright = clean.astype(np.float64).mean(axis=2)
    beyond = np.roll(bright, width // 2, axis=1)  # beyond a pole lies its other side
    tall = np.concatenate([beyond[:1], bright, beyond[-1:]])
    tall = 0.25 * tall[:-2] + 0.5 * tall[1:-1] + 0.25 * tall[2:]
    tent = 0.25 * np.roll(tall, 1, axis=1) + 0.5 * tall + 0.25 * np.roll(tall, -1, axis=1)
    edges = np.cos(np.linspace(0.0, np.pi, height + 1))
    angle = np.repeat(((edges[:-1] - edges[1:]) * 2.0 * np.pi / width)[:, None], width, axis=1)
    mean = float((tent * angle).sum()) / (4.0 * np.pi)
    weight = (tent + max(EVEN_SHARE * mean, 1e-30)) * angle
    weight /= weight.sum()
    along = np.cumsum(weight, axis=1)
    columns = np.concatenate([np.zeros((height, 1)), along / along[:, -1:]], axis=1)
    down = np.cumsum(along[:, -1])
    rows = np.concatenate([[0.0], down / down[-1]])
    tables = {"radiance": clean, "density": weight / angle, "rows": rows, "columns": columns}
    return {name: np.ascontiguousarray(table, np.float32) for name, table in tables.items()}


def make_sky(radiance: np.ndarray, device: wp.DeviceLike) -> Sky:
    """The environment with its tables on a device; ``radiance`` as for ``sky_tables``."""
    tables = sky_tables(radiance)
    sky = Sky()
    sky.radiance = wp.array(tables["radiance"], dtype=wp.vec3, device=device)
    sky.density = wp.array(tables["density"], dtype=wp.float32, device=device)
    sky.rows = wp.array(tables["rows"], dtype=wp.float32, device=device)
    sky.columns = wp.array(tables["columns"], dtype=wp.float32, device=device)
    return sky
