"""Directions from matt surfaces toward objects and balls: by what they hide, and by the light that they mirror.

A matt surface sends few of its directions where a small object stands, and of these few to where a polished one throws
light of a lamp onto it. Two ways to draw a direction know more, and give their densities, so that ``next_density`` of
``path_tracer`` can mix them with the surface's own.

**Cones.** A direction is drawn evenly within the cone of the sphere around an object, or of a ball.

**Mirrored light.** A sphere that mirrors shows a point P the environment's direction L at one place of its surface at
most: what the sphere hides is at none, all else at one. In the plane of P and L let the sphere's centre be the origin,
its radius the unit, d = |P|, phi the angle between P and L, and a that between P and the place's normal. The place sees
P under the angle of incidence atan2(d sin a, d cos a - 1), and L under phi - a; where both are the same (Alhazen's
problem for light from afar)

    F(a) = a + atan2(d sin a, d cos a - 1) = phi,    F' = 1 + d (d - cos a) / (d^2 - 2 d cos a + 1) > 0,

from F(0) = 0 to F(acos(1 / d)) = acos(1 / d) + pi / 2: beyond that lies what the sphere hides. L is drawn by its light.
By Coddington's equations for a mirror, 1/s' = 1/t + 2 / (r c) and 1/t + 2 c / r in the two principal sections, a pencil
of solid angle w from distance t, which meets a sphere of radius r under the cosine c, leaves it with

    w' = w (1 + 2 t / (r c)) (1 + 2 t c / r),

so that the direction toward the place has the density of L times this factor. Rough metals spread what they mirror; for
them it is still where most of the light comes from.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ar.kernels.reference.path_sampling import Sky, direction_in_texel, find_step, texel_of, within_step
from warp_ar.kernels.sampling import frame_from_normal
from warp_ar.kernels.structs import METALLIC_ROUGHNESS, MIRROR, SPHERE

wp.set_module_options({"enable_backward": False})

MIRRORED = wp.constant(wp.float32(0.5))
"""Share of guided directions that are drawn by mirrored light, where anything mirrors."""
LEAST_VERSINE = wp.constant(wp.float32(1.0e-6))
"""Of a cone: half an angle of 0.08 degrees."""
LEAST_INCIDENCE = wp.constant(wp.float32(1.0e-2))
"""Cosine under which a place is met at least: its square has an error of 1e-6, and nearer to the rim, a part in 1e4 of
the sphere's disk, the factor on densities loses its digits. What is mirrored there is left to the cones."""
RINGS = wp.constant(16)
SECTORS = wp.constant(16)
BINS = wp.constant(256)
"""Of a cone, for what is learned of it: rings of equal solid angle, sectors of each, and both."""
STEPS = wp.constant(12)
"""Of the search for a place, at most."""
POLISHED = 0.3
"""Roughness up to which a metal's lobe is narrower than what surrounds a lamp."""
LEAST_METAL = 0.5
"""Metallic from which on what a sphere mirrors is worth a search."""


@wp.struct
class Guides:
    """What directions are drawn toward: centre and radius of spheres."""

    spheres: wp.array[wp.vec4]  # around virtual objects, after these balls
    mirrors: wp.array[wp.vec4]  # polished spheres: virtual objects, after these balls
    virtual_spheres: wp.int32  # how many of ``spheres`` are of virtual objects
    virtual_mirrors: wp.int32
    learned: wp.array2d[wp.float32]  # (tiles, bins of all virtual spheres + 1) cumulative, from 0 to 1; may be empty


def make_guides(
    objects: npt.NDArray[np.void],
    materials: npt.NDArray[np.void],
    balls: npt.NDArray[np.void],
    device: wp.DeviceLike,
) -> Guides:
    """The spheres of a scene.

    Args:
        objects: Records of ``structs.Shape``: virtual objects where they stand.
        materials: Records of ``structs.Material``.
        balls: Records of ``structs.Probe``.
        device: Where to.
    """
    spheres, mirrors = [], []
    for item in objects:
        is_sphere = item["kind"] == SPHERE
        radius = item["extent"][0] if is_sphere else np.linalg.norm(item["extent"])
        sphere = [*item["position"], item["scale"] * radius]
        spheres.append(sphere)
        look = materials[item["material"]]
        metal = look["model"] == METALLIC_ROUGHNESS and look["metallic"] >= LEAST_METAL
        if is_sphere and (look["model"] == MIRROR or (metal and look["roughness"] <= POLISHED)):
            mirrors.append(sphere)
    guides = Guides()
    guides.virtual_spheres, guides.virtual_mirrors = len(spheres), len(mirrors)
    around = [[*ball["center"], ball["radius"]] for ball in balls]
    for name, found in (("spheres", spheres + around), ("mirrors", mirrors + around)):
        values = np.asarray(found, np.float32).reshape(-1, 4)
        setattr(guides, name, wp.array(values, dtype=wp.vec4, device=device))
    return guides


@wp.func
def guide_count(guides: Guides, changes_only: wp.bool) -> wp.int32:
    """Spheres that directions are drawn to: those of balls show what is there anyway, which changes nothing."""
    return wp.where(changes_only, guides.virtual_spheres, guides.spheres.shape[0])


@wp.func
def mirror_count(guides: Guides, changes_only: wp.bool) -> wp.int32:
    """Spheres whose mirrored light directions are drawn by."""
    return wp.where(changes_only, guides.virtual_mirrors, guides.mirrors.shape[0])


@wp.func
def mirrored_share(guides: Guides, changes_only: wp.bool) -> wp.float32:
    """Chance of a guided direction to be drawn by mirrored light."""
    return wp.where(mirror_count(guides, changes_only) > 0, MIRRORED, 0.0)


@wp.func
def cone_versine(sphere: wp.vec4, point: wp.vec3) -> wp.float32:
    """1 - cosine of the half angle under which a sphere is seen; 2, all directions, from within."""
    away = wp.vec3(sphere[0], sphere[1], sphere[2]) - point
    square = wp.dot(away, away)
    radius = sphere[3] * sphere[3]
    if square <= radius:
        return 2.0
    sine = radius / square
    return wp.max(sine / (1.0 + wp.sqrt(1.0 - sine)), LEAST_VERSINE)


@wp.func
def mirrored_density(sphere: wp.vec4, sky: Sky, point: wp.vec3, direction: wp.vec3) -> wp.float32:
    """Density with which ``draw_mirrored`` gives a direction; 0 where it misses the sphere or meets its rim."""
    radius = sphere[3]
    away = (wp.vec3(sphere[0], sphere[1], sphere[2]) - point) / radius
    half = wp.dot(away, direction)
    square = wp.dot(away, away)
    nearest = away - half * direction
    reach = 1.0 - wp.dot(nearest, nearest)
    if half <= 0.0 or reach <= LEAST_INCIDENCE * LEAST_INCIDENCE or square <= 1.0:
        return 0.0
    # |a|^2 - 1 = t1 t2, without the cancellation of half - sqrt(reach) near the sphere.
    t = (square - 1.0) / (half + wp.sqrt(reach))
    normal = wp.normalize(t * direction - away)
    cosine = wp.sqrt(reach)
    mirrored = direction + 2.0 * cosine * normal
    texel = texel_of(wp.normalize(mirrored), sky.density.shape[0], sky.density.shape[1])
    return sky.density[texel[0], texel[1]] * (1.0 + 2.0 * t / cosine) * (1.0 + 2.0 * t * cosine)


@wp.func
def place_on_sphere(distance: wp.float32, phi: wp.float32) -> wp.float32:
    """The angle a with F(a) = ``phi``, by Newton's steps that stay between two bounds; -1 where there is none."""
    low = float(0.0)
    # acos(1 / d) by atan2, which keeps its digits near the sphere.
    high = wp.atan2(wp.sqrt((distance - 1.0) * (distance + 1.0)), 1.0)
    if phi >= high + 0.5 * wp.pi:
        return -1.0
    angle = phi * high / (high + 0.5 * wp.pi)
    gap = distance - 1.0
    step = wp.int32(0)
    while step < STEPS:  # not unrolled: each step is a hundred instructions
        step += 1
        # 1 - cos(a) by half of a: near the sphere d cos a - 1 and d - cos a are small.
        sine = wp.sin(0.5 * angle)
        fall = 2.0 * distance * sine * sine
        off = angle + wp.atan2(distance * wp.sin(angle), gap - fall) - phi
        if off > 0.0:
            high = angle
        else:
            low = angle
        slope = 1.0 + (distance * gap + fall) / (gap * gap + 2.0 * fall)
        angle -= off / slope
        if angle < low or angle > high:
            angle = 0.5 * (low + high)
    return angle


@wp.func
def draw_mirrored(sphere: wp.vec4, sky: Sky, point: wp.vec3, u: wp.vec2) -> wp.vec3:
    """Direction in which a sphere mirrors light drawn from the environment; zero where none has a density."""
    height = sky.density.shape[0]
    width = sky.density.shape[1]
    row = find_step(sky.rows, u[0])
    line = sky.columns[row]
    column = find_step(line, u[1])
    within = wp.vec2(within_step(sky.rows, row, u[0]), within_step(line, column, u[1]))
    light = direction_in_texel(row, column, height, width, within)
    from_center = (point - wp.vec3(sphere[0], sphere[1], sphere[2])) / sphere[3]
    distance = wp.length(from_center)
    if distance <= 1.0:
        return wp.vec3(0.0, 0.0, 0.0)
    axis = from_center / distance
    across = light - wp.dot(light, axis) * axis
    sine = wp.length(across)
    angle = place_on_sphere(distance, wp.atan2(sine, wp.dot(light, axis)))
    if angle < 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    if sine > 1.0e-7:
        across = across / sine
    normal = wp.cos(angle) * axis + wp.sin(angle) * across
    direction = wp.normalize(normal - from_center)
    # The same test decides what is drawn and what has a density.
    return wp.where(mirrored_density(sphere, sky, point, direction) > 0.0, direction, wp.vec3(0.0, 0.0, 0.0))


@wp.func
def bin_in_cone(sphere: wp.vec4, point: wp.vec3, direction: wp.vec3) -> wp.int32:
    """The bin of a sphere's cone in which a direction lies; -1 outside."""
    axis = wp.normalize(wp.vec3(sphere[0], sphere[1], sphere[2]) - point)
    off = axis - direction
    # |a - b|^2 / 2 is 1 - cos, without its cancellation.
    part = 0.5 * wp.dot(off, off) / cone_versine(sphere, point)
    if part > 1.0:
        return -1
    local = wp.transpose(frame_from_normal(axis)) * direction
    turn = wp.atan2(local[1], local[0]) / (2.0 * wp.pi)
    turn = wp.where(turn < 0.0, turn + 1.0, turn)
    ring = wp.min(wp.int32(part * wp.float32(RINGS)), RINGS - 1)
    return ring * SECTORS + wp.min(wp.int32(turn * wp.float32(SECTORS)), SECTORS - 1)


@wp.func
def guided_bin(guides: Guides, point: wp.vec3, direction: wp.vec3) -> wp.int32:
    """The bin, of all those of virtual spheres, in which a direction lies first; -1 for none."""
    for k in range(guides.virtual_spheres):
        found = bin_in_cone(guides.spheres[k], point, direction)
        if found >= 0:
            return k * BINS + found
    return -1


@wp.func
def guide_density(
    guides: Guides, sky: Sky, point: wp.vec3, direction: wp.vec3, changes_only: wp.bool, tile: wp.int32
) -> wp.float32:
    """Density with which ``draw_guide`` gives a direction."""
    count = guide_count(guides, changes_only)
    density = float(0.0)
    for k in range(count):
        sphere = guides.spheres[k]
        found = bin_in_cone(sphere, point, direction)
        if found >= 0:
            share = float(1.0)
            if tile >= 0:
                step = k * BINS + found
                share = wp.float32(count * BINS) * (guides.learned[tile, step + 1] - guides.learned[tile, step])
            density += share / (2.0 * wp.pi * cone_versine(sphere, point))
    density = density / wp.float32(wp.max(count, 1))
    mirrors = mirror_count(guides, changes_only)
    if mirrors > 0:
        mirrored = float(0.0)
        for k in range(mirrors):
            mirrored += mirrored_density(guides.mirrors[k], sky, point, direction)
        density = (1.0 - MIRRORED) * density + MIRRORED * mirrored / wp.float32(mirrors)
    return density


@wp.func
def draw_guide(
    guides: Guides, sky: Sky, point: wp.vec3, pick: wp.float32, u: wp.vec2, changes_only: wp.bool, tile: wp.int32
) -> wp.vec3:
    """Direction toward an object or a ball, by what was learned for a tile unless that is -1; zero where none is."""
    share = mirrored_share(guides, changes_only)
    if pick < share:
        mirrors = mirror_count(guides, changes_only)
        k = wp.min(wp.int32(pick / share * wp.float32(mirrors)), mirrors - 1)
        return draw_mirrored(guides.mirrors[k], sky, point, u)
    count = guide_count(guides, changes_only)
    left = (pick - share) / (1.0 - share)
    k = wp.min(wp.int32(left * wp.float32(count)), count - 1)
    part = u[0]
    turn = u[1]
    if tile >= 0:
        step = find_step(guides.learned[tile], left)
        k = step / BINS
        part = (wp.float32(step % BINS / SECTORS) + u[0]) / wp.float32(RINGS)
        turn = (wp.float32(step % SECTORS) + u[1]) / wp.float32(SECTORS)
    sphere = guides.spheres[k]
    versine = part * cone_versine(sphere, point)
    sine = wp.sqrt(wp.max(versine * (2.0 - versine), 0.0))
    phi = 2.0 * wp.pi * turn
    axis = wp.normalize(wp.vec3(sphere[0], sphere[1], sphere[2]) - point)
    return wp.normalize(frame_from_normal(axis) * wp.vec3(sine * wp.cos(phi), sine * wp.sin(phi), 1.0 - versine))
