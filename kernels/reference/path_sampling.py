"""Sampling of directions for paths: by the environment's light, by a virtual light, or by the surface.

Each strategy has a density per steradian, so that two strategies can be combined by the balance heuristic [VG95]: light
from a direction of density p, which the other strategy draws with density q, is weighted by p / (p + q).

Environment. A texel is drawn by inverting cumulative sums of rows, then of the texels of one row. Within a texel
directions are uniform. The sums are of brightness times solid angle. Brightness is filtered by a tent of three texels,
because radiance is interpolated bilinearly and reaches into neighbouring texels. A hundredth of the mean is added, so
that every direction with light has samples.

Near emitters. The texels that show an emitter at a known distance D are taken out of the distant environment, less the
radiance around them, and placed on a sphere of radius D around the point that reflects the emitter. Seen from a point
at distance d, a texel has D^2 cos / d^2 times its solid angle, cos between the ray and the sphere's normal, and 1 / cos
times its radiance: emitters have the same intensity in all directions. They hide nothing. A fixed share of directions,
``near_share``, is drawn toward them, by their light.

Surfaces. A lobe is chosen with a probability proportional to its reflectance: the cosine for the diffuse part, visible
half vectors for GGX, the lobe itself for Phong. Reflection is that of ``materials``; this module adds the densities
alone. A mirror has no density, and its direction is weighted in full.

Virtual lights with a radius are disks that face the point, as in ``shadow``. With E the irradiance of a surface that
faces the light, the disk has the radiance E p, where p = d^2 / (pi r^2 cos^3) is the density of a uniform point of the
disk at distance d and the angle of cos to its centre. So the disk's irradiance is E at any d.

References:
    [VG95] Veach, Guibas, "Optimally Combining Sampling Techniques for Monte Carlo Rendering", SIGGRAPH 1995.
    [DB23] Dupuy, Benyoub, "Sampling Visible GGX Normals with Spherical Caps", 2023.
"""

from __future__ import annotations

import math

import numpy as np
import warp as wp

from warp_ar.kernels.color import brightness
from warp_ar.kernels.emitters import MAX_DISTANCE
from warp_ar.kernels.environment.environment_samples import EMITTER_COSINE, MIN_EMITTER_DISTANCE
from warp_ar.kernels.latlong import latlong_from_direction, sample_latlong
from warp_ar.kernels.materials import MIN_ALPHA, Surface, make_reflect_direct, reflect
from warp_ar.kernels.rays.shadow import LightSample, has_penumbra, sample_light
from warp_ar.kernels.rays.shapes import FAR
from warp_ar.kernels.safe_math import MAX_RADIANCE
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
from warp_ar.kernels.structs import LAMBERT, METALLIC_ROUGHNESS, MIRROR, PHONG, Emitter, Light

wp.set_module_options({"enable_backward": False})

PI = wp.constant(wp.float32(math.pi))
ALL_MODELS = tuple(sorted(map(int, (LAMBERT, PHONG, METALLIC_ROUGHNESS, MIRROR))))
"""All models of materials."""
NO_DENSITY = wp.constant(wp.float32(-1.0))
"""Value that stands for the density of a direction that is not drawn at random: a mirror's or a camera's ray."""
LEAST_CHANCE = wp.constant(wp.float32(0.1))
"""Least probability of sampling either lobe of a surface with two; a weak lobe can carry all visible light."""
EVEN_SHARE = 0.01
"""Least density of any direction of the environment, relative to the mean density."""
STREAMS = wp.constant(16)
"""Largest number of random triples per vertex of a path."""
SEED_STEP = wp.constant(wp.uint32(0x9E3779B9))

LEAST_COSINE = wp.constant(wp.float32(0.1))
"""Least cosine between a ray and the normal of an emitter's sphere: bounds the radiance of emitters seen edge-on."""

reflect_direct = make_reflect_direct(ALL_MODELS)


@wp.struct
class Sky:
    """The environment with its sampling tables."""

    radiance: wp.array2d[wp.vec3]  # latlong
    density: wp.array2d[wp.float32]  # of ``draw_sky``, per steradian, constant within a texel
    rows: wp.array[wp.float32]  # (H + 1) cumulative, from 0 to 1
    columns: wp.array2d[wp.float32]  # (H, W + 1) cumulative along each row, from 0 to 1

    emitters: wp.array[Emitter]  # near ones
    near_share: wp.float32  # probability that ``draw_sky`` draws a direction toward near emitters
    near_radiance: wp.array2d[wp.vec3]  # of texels that show an emitter, seen from the point that reflects it
    near_density: wp.array2d[wp.float32]  # of these texels, per steradian from that point
    near_owner: wp.array2d[wp.int32]  # index of the emitter that a texel shows, or -1
    near_texels: wp.array[wp.int32]  # (n) indices of the texels that show an emitter
    near_steps: wp.array[wp.float32]  # (n + 1) cumulative over these texels, from 0 to 1


@wp.struct
class SkyLight:
    """A sample of the environment's light."""

    direction: wp.vec3  # unit
    distance: wp.float32  # of its source; FAR for the distant environment
    radiance: wp.vec3
    density: wp.float32  # per steradian


@wp.struct
class PathKey:
    """Key of the random numbers of one path."""

    pixel: wp.uint32
    sample: wp.uint32
    seed: wp.uint32


@wp.func
def random_triple(key: PathKey, vertex: wp.int32, stream: wp.int32) -> wp.vec3:
    """Return three independent random numbers in [0, 1), always the same for the same arguments."""
    z = key.seed * SEED_STEP + wp.uint32(vertex * STREAMS + stream)
    bits = pcg3d_hash(key.pixel, key.sample, z)
    return wp.vec3(uniform_from_bits(bits[0]), uniform_from_bits(bits[1]), uniform_from_bits(bits[2]))


@wp.func
def balance(density: wp.float32, other: wp.float32) -> wp.float32:
    """Return the balance heuristic's weight, density / (density + other), of a sample drawn with ``density``."""
    if density < 0.0:
        return 1.0
    return density / (density + other)


@wp.func
def find_step(cumulative: wp.array[wp.float32], u: wp.float32) -> wp.int32:
    """Return the k with cumulative[k] <= u < cumulative[k + 1], of sums from 0 to 1; never a step of height 0."""
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
def direction_in_texel(row: wp.int32, column: wp.int32, height: wp.int32, width: wp.int32, u: wp.vec2) -> wp.vec3:
    """Draw a uniform direction in a texel, by sin^2 of half the polar angle, which is accurate near the pole."""
    step = 0.5 * PI / wp.float32(height)
    top = wp.sin(step * wp.float32(row))
    bottom = wp.sin(step * wp.float32(row + 1))
    half = top * top + u[0] * (bottom * bottom - top * top)
    sine = 2.0 * wp.sqrt(wp.max(half * (1.0 - half), 0.0))
    phi = (2.0 * (wp.float32(column) + u[1]) / wp.float32(width) - 1.0) * PI
    return wp.vec3(sine * wp.cos(phi), sine * wp.sin(phi), 1.0 - 2.0 * half)


@wp.func
def within_step(cumulative: wp.array[wp.float32], step: wp.int32, u: wp.float32) -> wp.float32:
    """Return the position, 0 to 1, of ``u`` within a step of ``find_step``."""
    low = cumulative[step]
    return wp.clamp((u - low) / wp.max(cumulative[step + 1] - low, 1.0e-30), 0.0, 1.0)


@wp.func
def texel_of(direction: wp.vec3, height: wp.int32, width: wp.int32) -> wp.vec2i:
    """Return the row and column of the texel that contains a direction."""
    at = latlong_from_direction(direction, height, width)
    return wp.vec2i(wp.clamp(wp.int32(at[0]), 0, height - 1), wp.clamp(wp.int32(at[1]), 0, width - 1))


@wp.func
def draw_sky(sky: Sky, origin: wp.vec3, u: wp.vec2, v: wp.float32) -> SkyLight:
    """Draw light of the environment at ``origin``, occlusion ignored; of near emitters if ``v`` < ``near_share``."""
    height = sky.radiance.shape[0]
    width = sky.radiance.shape[1]
    light = SkyLight()
    if v < sky.near_share:
        step = find_step(sky.near_steps, u[0])
        texel = sky.near_texels[step]
        row = texel / width
        column = texel % width
        # The remainder of the number that picked the texel gives the position within the texel.
        within = wp.vec2(within_step(sky.near_steps, step, u[0]), u[1])
        normal = direction_in_texel(row, column, height, width, within)
        emitter = sky.emitters[sky.near_owner[row, column]]
        away = emitter.origin + emitter.distance * normal - origin
        distance = wp.max(wp.length(away), 1.0e-6)
        light.direction = away / distance
        light.distance = distance
        cosine = wp.max(wp.abs(wp.dot(light.direction, normal)), LEAST_COSINE)
        light.radiance = sky.near_radiance[row, column] / cosine
        spread = distance * distance / (emitter.distance * emitter.distance * cosine)
        light.density = sky.near_share * sky.near_density[row, column] * spread
        return light
    row = find_step(sky.rows, u[0])
    line = sky.columns[row]
    column = find_step(line, u[1])
    within = wp.vec2(within_step(sky.rows, row, u[0]), within_step(line, column, u[1]))
    light.direction = direction_in_texel(row, column, height, width, within)
    light.distance = FAR
    light.radiance = sample_latlong(sky.radiance, light.direction)
    light.density = (1.0 - sky.near_share) * sky.density[row, column]
    return light


@wp.func
def sky_radiance(sky: Sky, direction: wp.vec3, density: wp.float32) -> wp.vec3:
    """Return the radiance of the distant environment, weighted for a ray that was drawn with ``density``."""
    texel = texel_of(direction, sky.radiance.shape[0], sky.radiance.shape[1])
    other = (1.0 - sky.near_share) * sky.density[texel[0], texel[1]]
    return balance(density, other) * sample_latlong(sky.radiance, direction)


@wp.func
def near_radiance(sky: Sky, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32, density: wp.float32) -> wp.vec3:
    """Return the radiance of near emitters on a ray before ``t_max``, weighted for a ray drawn with ``density``."""
    radiance = wp.vec3(0.0, 0.0, 0.0)
    height = sky.radiance.shape[0]
    width = sky.radiance.shape[1]
    for k in range(sky.emitters.shape[0]):
        emitter = sky.emitters[k]
        from_center = origin - emitter.origin
        half = wp.dot(from_center, direction)
        nearest = from_center - half * direction
        reach = emitter.distance * emitter.distance - wp.dot(nearest, nearest)
        if reach > 0.0:
            root = wp.sqrt(reach)
            for side in range(2):
                t = wp.where(side == 0, -half - root, -half + root)
                if t > 0.0 and t < t_max:
                    normal = (from_center + t * direction) / emitter.distance
                    texel = texel_of(normal, height, width)
                    if sky.near_owner[texel[0], texel[1]] == k:
                        cosine = wp.max(wp.abs(wp.dot(direction, normal)), LEAST_COSINE)
                        spread = t * t / (emitter.distance * emitter.distance * cosine)
                        other = sky.near_share * sky.near_density[texel[0], texel[1]] * spread
                        radiance += balance(density, other) / cosine * sky.near_radiance[texel[0], texel[1]]
    return radiance


@wp.func
def lobe_chance(surface: Surface) -> wp.float32:
    """Return the probability of sampling the glossy lobe."""
    glossy = brightness(surface.reflectance)
    diffuse = brightness(surface.diffuse)
    if glossy <= 0.0:
        return 0.0
    if diffuse <= 0.0:
        return 1.0
    return wp.clamp(glossy / (glossy + diffuse), LEAST_CHANCE, 1.0 - LEAST_CHANCE)


@wp.func
def lobe_alpha(surface: Surface) -> wp.float32:
    """Return the width alpha of a GGX lobe, at least the minimum of ``reflect_direct``."""
    return wp.max(surface.roughness * surface.roughness, MIN_ALPHA)


@wp.func
def surface_density(surface: Surface, normal: wp.vec3, wo: wp.vec3, wi: wp.vec3) -> wp.float32:
    """Return the density with which ``draw_reflected`` draws ``wi``; 0 for mirrors and behind the surface."""
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
) -> wp.vec3:
    """Draw a unit direction from which a surface reflects light toward ``wo``; zero if it leads into the surface."""
    wi = reflect(wo, normal)
    if surface.model != wp.static(int(MIRROR)):
        basis = frame_from_normal(normal)
        if pick >= lobe_chance(surface):
            wi = basis * sample_cosine_hemisphere(u)
        elif surface.model == wp.static(int(PHONG)):
            wi = frame_from_normal(wi) * sample_phong_lobe(u, surface.shininess)
        else:
            half = basis * sample_ggx_visible(u, wp.transpose(basis) * wo, lobe_alpha(surface))
            wi = reflect(wo, half)
        wi = wp.normalize(wi)
    if wp.dot(wi, geometric) <= 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    return wi


@wp.func
def disk_density(light: Light, distance: wp.float32, cosine: wp.float32) -> wp.float32:
    """Return the density per steradian of a uniform point of a light's disk; ``cosine`` of the angle to its centre."""
    return distance * distance / (PI * light.radius * light.radius * cosine * cosine * cosine)


@wp.func
def draw_on_light(light: Light, sample: LightSample, u: wp.vec2) -> wp.vec4:
    """Return (x, y, z, distance): unit direction and distance of a random point of a light's disk, or of its centre."""
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
    """Return the weighted radiance of lights' disks that a ray of ``density`` meets before ``t_max``."""
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


def _cumulative(weight: np.ndarray) -> np.ndarray:
    """Return normalised cumulative sums along the last axis, from 0 to 1, longer than the weights by one."""
    sums = np.cumsum(weight, axis=-1)
    return np.concatenate([np.zeros((*weight.shape[:-1], 1)), sums / sums[..., -1:]], axis=-1)


def _solid_angles(height: int, width: int) -> np.ndarray:
    edges = np.cos(np.linspace(0.0, np.pi, height + 1))
    return np.repeat(((edges[:-1] - edges[1:]) * 2.0 * np.pi / width)[:, None], width, axis=1)


def sky_tables(radiance: np.ndarray) -> dict[str, np.ndarray]:
    """Compute the cumulative sums and densities of ``Sky`` without near emitters, in float64.

    Args:
        radiance: Latlong (H, W, 3), linear; negative values and NaN count as 0.

    Returns:
        ``radiance`` (H, W, 3), ``density`` (H, W), ``rows`` (H + 1,) and ``columns`` (H, W + 1), all float32.
    """
    clean = np.clip(np.nan_to_num(radiance, nan=0.0, posinf=float(MAX_RADIANCE)), 0.0, float(MAX_RADIANCE))
    height, width = clean.shape[:2]
    bright = clean.astype(np.float64).mean(axis=2)
    beyond = np.roll(bright, width // 2, axis=1)  # rows beyond a pole are those of the opposite meridian
    tall = np.concatenate([beyond[:1], bright, beyond[-1:]])
    tall = 0.25 * tall[:-2] + 0.5 * tall[1:-1] + 0.25 * tall[2:]
    tent = 0.25 * np.roll(tall, 1, axis=1) + 0.5 * tall + 0.25 * np.roll(tall, -1, axis=1)
    angle = _solid_angles(height, width)
    mean = float((tent * angle).sum()) / (4.0 * np.pi)
    weight = (tent + max(EVEN_SHARE * mean, 1e-30)) * angle
    weight /= weight.sum()
    tables = {
        "radiance": clean,
        "density": weight / angle,
        "rows": _cumulative(weight.sum(axis=1)),
        "columns": _cumulative(weight),
    }
    return {name: np.ascontiguousarray(table, np.float32) for name, table in tables.items()}


def split_emitters(radiance: np.ndarray, emitters: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split an environment into the light of near emitters and the rest.

    A texel shows the nearest emitter, if it is as bright as clipping and within ``EMITTER_COSINE`` of the emitter's
    direction, as in ``environment_samples``. The mean of the other texels in that cone remains in its place.

    Args:
        radiance: Latlong (H, W, 3), clean.
        emitters: Records of ``structs.Emitter``, near ones.

    Returns:
        The distant environment and the near part, (H, W, 3) each, and the emitter that each texel shows, or -1, (H, W).
    """
    height, width = radiance.shape[:2]
    theta = (np.arange(height) + 0.5)[:, None] * np.pi / height
    phi = (2.0 * (np.arange(width) + 0.5)[None, :] / width - 1.0) * np.pi
    parts = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0.0 * phi
    cosines = np.stack(parts, axis=-1) @ emitters["direction"].reshape(-1, 3).T.astype(np.float64)
    near = (cosines.max(axis=2) > float(EMITTER_COSINE)) & (radiance.max(axis=2) >= 1.0)
    owner = np.where(near, cosines.argmax(axis=2), -1).astype(np.int32)
    distant = radiance.copy()
    for k in range(len(emitters)):
        around = (cosines[..., k] > float(EMITTER_COSINE)) & ~near
        kept = radiance[around].mean(axis=0) if around.any() else np.zeros(3, np.float32)
        distant[owner == k] = np.minimum(radiance[owner == k], kept)
    return distant, radiance - distant, owner


def _are_near(emitters: np.ndarray) -> np.ndarray:
    return (emitters["distance"] > 0.0) & (emitters["distance"] < float(MAX_DISTANCE))


def make_sky(radiance: np.ndarray, device: wp.DeviceLike, emitters: np.ndarray | None = None) -> Sky:
    """Return the environment with its sampling tables, on a device.

    Args:
        radiance: Latlong (H, W, 3), linear.
        device: Device of the arrays.
        emitters: Records of ``structs.Emitter``; distant ones remain part of the environment.
    """
    sky = Sky()
    clean = sky_tables(radiance)["radiance"]
    near = np.zeros(0) if emitters is None else emitters[_are_near(emitters)].copy()
    if len(near):
        near["distance"] = np.maximum(near["distance"], float(MIN_EMITTER_DISTANCE))
        distant, sent, owner = split_emitters(clean, near)
        angle = _solid_angles(*clean.shape[:2])
        power = np.where(owner >= 0, sent.astype(np.float64).mean(axis=2), 0.0) * angle
        if power.sum() > 0.0:
            clean = distant
            sky.emitters = wp.array(near, dtype=Emitter, device=device)
            share = power.sum() / (power.sum() + float((distant.mean(axis=2) * angle).sum()))
            sky.near_share = float(np.clip(share, LEAST_CHANCE, 1.0 - LEAST_CHANCE))
            texels = np.flatnonzero(power)
            sky.near_radiance = wp.array(sent, dtype=wp.vec3, device=device)
            density = (power / power.sum() / angle).astype(np.float32)
            sky.near_density = wp.array(density, dtype=wp.float32, device=device)
            sky.near_owner = wp.array(owner, dtype=wp.int32, device=device)
            sky.near_texels = wp.array(texels.astype(np.int32), dtype=wp.int32, device=device)
            steps = _cumulative(power.ravel()[texels]).astype(np.float32)
            sky.near_steps = wp.array(steps, dtype=wp.float32, device=device)
    for name, table in sky_tables(clean).items():
        setattr(sky, name, wp.array(table, dtype=wp.vec3 if name == "radiance" else wp.float32, device=device))
    return sky
