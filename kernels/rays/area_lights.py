"""Light of emitting objects: sampling of points on them, seen from a point that they light.

A surface of radiance L that covers the solid angle dOmega, seen from a point, gives it the irradiance L cos dOmega. The
estimate is a sum over n points on the emitting triangles of all objects,

    E = sum over k of L_k cos_k visible_k / (n p_k),    p the density of the point per solid angle.                  (1)

A triangle is picked with the probability P, proportional to its area times its mean emission, by one number in each of
n equal parts of the cumulative table (stratification). Triangles stand in the order of their mesh, in which neighbours
in the table are mostly neighbours in space, so the points are spread over the light. A triangle of not too small a
solid angle Omega is sampled uniformly in solid angle [Arv95], p = P / Omega. Then a term of (1) is at most
Omega L / (n P), bounded even where a light touches a receiver. A smaller triangle is sampled uniformly by area,
p = P d^2 / (A cos_light). A sphere is sampled uniformly in the cone of directions that it covers [SW91].

A shadow ray costs more than a sample point. So one of ``CANDIDATES`` points is drawn, with a probability proportional
to w = |L_k| cos_k / p_k, and its term is multiplied by (sum of w) / (candidates w_k) [Tal05]. Unoccluded light then has
the noise of all candidates, partly occluded light that of the rays.

Highlights have the shape of the emitting object. The lobe of a surface is integrated by rays into the lobe if its solid
angle is less than that of the object's bounding sphere, else by (1). The choice depends on point and object alone, and
each direction is counted once, so there is no bias.

As point lights: each emitting object is at the centre of its bounding box. Toward a direction w it has the intensity

    I(w) = (1 - |f|) / 4 S + max(f . w, 0) S,    S the integral of L over its area, f the mean normal.               (2)

That is exact for a flat light (|f| = 1) and for a sphere (f = 0), and the mean over all directions is right for all
that are convex.

Sample numbers are fixed: pixel (i, j) of every tile of 4 x 4 has its own shift of one sequence, so noise does not
change between frames of a scene at rest. Where nothing hides part of the light, noise falls as 1 / n, not 1 / sqrt n.

References:
    [Arv95] Arvo, "Stratified Sampling of Spherical Triangles", SIGGRAPH 1995.
    [Tal05] Talbot, Cline, Egbert, "Importance Resampling for Global Illumination", EGSR 2005.
    [SW91] Shirley, Wang, "Direct Lighting Calculation by Monte Carlo Integration", EGWR 1991.
"""

from __future__ import annotations

import functools
import math

import warp as wp

from warp_ar.kernels.color import brightness
from warp_ar.kernels.materials import Surface, emitted_radiance, material_at, reflect, schlick, surface_point
from warp_ar.kernels.rays.shapes import sphere_uv, to_local_point
from warp_ar.kernels.rays.trace import TraceConfig, make_trace, offset_origin
from warp_ar.kernels.sampling import (
    frame_from_normal,
    ggx_masking,
    ggx_masking_shadowing,
    sample_ggx_visible,
    sample_phong_lobe,
)
from warp_ar.kernels.structs import METALLIC_ROUGHNESS, MIRROR, PHONG, SPHERE, AreaLight, Hit, RayScene, Shape
from warp_ar.kernels.textures import SurfacePoint, point_of_triangle

wp.set_module_options({"enable_backward": False})

POINT_SAMPLES = 1
"""Value of ``samples`` that means: each emitting object is a point light."""
CANDIDATES = 4
"""Number of candidate points, of which one gets a shadow ray, if samples are fewer than ``MANY_SAMPLES``."""
MANY_SAMPLES = 128
"""Number of samples from which each has a single candidate."""
LEAST_FACING = wp.constant(wp.float32(0.05))
"""Constant added to the cosine in a candidate's weight: a lobe may reflect light that the cosine makes small."""
# Solid angles between which a triangle is sampled by its angle. Directions lose 1e-7 / angle^2 to float32: 1e-3 here,
# where all of a triangle is seen nearly alike anyway. Above, it is nearly a half space.
LEAST_SOLID_ANGLE = wp.constant(wp.float32(1.0e-2))
MOST_SOLID_ANGLE = wp.constant(wp.float32(6.2))
# Least height of a point over a triangle, relative to the triangle's size. A lower point lies on the light: rounding
# decides its side and whether it is inside the triangle, and two neighbouring triangles could both count it.
LEAST_HEIGHT = wp.constant(wp.float32(1.0e-6))
# Length of shadow rays over the distance to the light, so that they do not meet the light itself.
NEARLY = wp.constant(wp.float32(1.0 - 1.0e-4))
# Steps of the R2 sequence, whose points fill a square evenly for any count: powers of 1 / the plastic number.
STEP_U = wp.constant(wp.float32(0.7548776662466927))
STEP_V = wp.constant(wp.float32(0.5698402909980532))
STEP_W = wp.constant(wp.float32(0.6180339887498949))  # the golden ratio's, for one number
FOUR_PI = wp.constant(wp.float32(4.0 * math.pi))


@wp.struct
class AreaSample:
    """A sample point on an emitting object, seen from a lit point, occlusion ignored."""

    wi: wp.vec3  # unit, toward the sample point
    distance: wp.float32  # metres
    irradiance_normal: wp.vec3  # irradiance of a surface that faces it, over its probability; zero: no light
    object: wp.int32


@wp.func
def fraction(x: wp.float32) -> wp.float32:
    """Return the fractional part of a number, below 1."""
    return wp.min(x - wp.floor(x), 0.99999994)


@wp.func
def area_numbers(k: wp.int32, count: wp.int32, turn: wp.float32) -> wp.vec3:
    """Return three numbers in [0, 1) for sample k of ``count``: one picks the triangle, two the point on it.

    ``turn`` is the pixel's result of ``tile_turn``.
    """
    rank = 16.0 * turn
    pick = (wp.float32(k) + turn + 1.0 / 32.0) / wp.float32(count)
    place = wp.float32(k) + 0.5
    u = fraction(place * STEP_U + rank * STEP_V)
    v = fraction(place * STEP_V + rank * STEP_U)
    return wp.vec3(wp.min(pick, 0.99999994), u, v)


@wp.func
def find_share(shares: wp.array[wp.float32], pick: wp.float32) -> wp.int32:
    """Return the index of the first entry above ``pick``, in [0, 1), in a table of cumulative shares."""
    low = wp.int32(0)
    high = shares.shape[0] - 1
    while low < high:
        middle = (low + high) / 2
        if shares[middle] > pick:
            high = middle
        else:
            low = middle + 1
    return low


@wp.func
def solid_angle(a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.float32:
    """Return the solid angle of a triangle with corners in three unit directions (van Oosterom and Strackee)."""
    volume = wp.abs(wp.dot(a, wp.cross(b, c)))
    return 2.0 * wp.atan2(volume, 1.0 + wp.dot(a, b) + wp.dot(b, c) + wp.dot(c, a))


@wp.func
def safe_sqrt(x: wp.float32) -> wp.float32:
    """Return the square root of a number, 0 if rounding made it negative."""
    return wp.sqrt(wp.max(x, 0.0))


@wp.func
def unit_across(v: wp.vec3, axis: wp.vec3) -> wp.vec3:
    """Return the component of a vector perpendicular to a unit axis, normalised."""
    return wp.normalize(v - wp.dot(v, axis) * axis)


@wp.func
def angle_between(a: wp.vec3, b: wp.vec3) -> wp.float32:
    """Return the angle between two vectors of any length, accurate for small angles."""
    return wp.atan2(wp.length(wp.cross(a, b)), wp.dot(a, b))


@wp.func
def sample_spherical_triangle(
    a: wp.vec3, b: wp.vec3, c: wp.vec3, angle: wp.float32, u: wp.float32, v: wp.float32
) -> wp.vec3:
    """Draw a uniform direction in a spherical triangle of solid angle ``angle`` [Arv95].

    u picks a sub-triangle a, b, c' of u times the area, c' on the edge from a to c; v a point on the arc from b to c'.
    """
    at_a = angle_between(wp.cross(a, b), wp.cross(a, c))
    part = u * angle
    s = wp.sin(part - at_a)
    t = wp.cos(part - at_a)
    cos_a = wp.cos(at_a)
    sin_a = wp.sin(at_a)
    cos_c = wp.dot(a, b)
    p = t - cos_a
    q = s + sin_a * cos_c
    below = (q * s + p * t) * sin_a
    cos_b = float(1.0)
    if wp.abs(below) > 1.0e-12:
        cos_b = wp.clamp(((q * t - p * s) * cos_a - q) / below, -1.0, 1.0)
    toward_c = cos_b * a + safe_sqrt((1.0 - cos_b) * (1.0 + cos_b)) * unit_across(c, a)
    z = 1.0 - v * (1.0 - wp.dot(toward_c, b))
    return wp.normalize(z * b + safe_sqrt((1.0 - z) * (1.0 + z)) * unit_across(toward_c, b))


# With s = r / d the cone's half angle has 1 - cos = 1 - sqrt(1 - s^2) = s^2 / (1 + sqrt(1 - s^2)): no cancellation far
# away. Directions uniform in the cone are uniform in 1 - cos, and 1 / p is the cone's solid angle 2 pi (1 - cos).
@wp.func
def draw_on_sphere(scene: RayScene, shape: Shape, point: wp.vec3, u: wp.float32, v: wp.float32) -> AreaSample:
    """Draw a uniform direction in the cone of an emitting sphere; a point inside it receives no light."""
    sample = AreaSample()
    radius = shape.scale * shape.extent[0]
    away = shape.position - point
    distance = wp.length(away)
    if distance <= radius:
        return sample
    axis = away / distance
    sine = radius / distance
    versine = sine * sine / (1.0 + wp.sqrt((1.0 - sine) * (1.0 + sine)))
    x = u * versine
    sin2 = x * (2.0 - x)
    phi = 2.0 * wp.pi * v
    local = wp.vec3(wp.sqrt(sin2) * wp.cos(phi), wp.sqrt(sin2) * wp.sin(phi), 1.0 - x)
    sample.wi = wp.normalize(frame_from_normal(axis) * local)
    sample.distance = distance * (1.0 - x) - safe_sqrt(radius * radius - distance * distance * sin2)
    normal = wp.normalize(point + sample.distance * sample.wi - shape.position)
    at = SurfacePoint()
    at.uv = sphere_uv(wp.transpose(shape.rotation) * normal)
    at.uv_second = at.uv
    at.color = wp.vec4(1.0, 1.0, 1.0, 1.0)
    radiance = emitted_radiance(scene, scene.materials[shape.material], at)
    sample.irradiance_normal = 2.0 * wp.pi * versine * radiance
    return sample


@wp.func
def draw_on_triangle(
    scene: RayScene, shape: Shape, face: wp.int32, front: wp.bool, point: wp.vec3, u: wp.float32, v: wp.float32
) -> AreaSample:
    """Draw a point on a triangle: uniform in solid angle, or by area if its solid angle is small."""
    sample = AreaSample()
    # Coordinates relative to the point: differences far from the origin would lose digits.
    eye = to_local_point(shape, point)
    p = wp.mesh_get_point(shape.mesh, 3 * face) - eye
    q = wp.mesh_get_point(shape.mesh, 3 * face + 1) - eye
    r = wp.mesh_get_point(shape.mesh, 3 * face + 2) - eye
    facing = float(1.0)
    if shape.stretch != 0.0:  # angles are those in the world: map the triangle there, except for the scale
        p = shape.rotation * p
        q = shape.rotation * q
        r = shape.rotation * r
        facing = wp.where(wp.determinant(shape.rotation) < 0.0, -1.0, 1.0)
    across = wp.cross(q - p, r - p)
    doubled = wp.length(across)
    if doubled <= 0.0:
        return sample
    normal = facing * across / doubled
    height = -wp.dot(normal, p)  # of the point over the triangle's plane
    if (front and height <= 0.0) or wp.abs(height) <= LEAST_HEIGHT * wp.sqrt(doubled):
        return sample
    angle = solid_angle(wp.normalize(p), wp.normalize(q), wp.normalize(r))
    weights = wp.vec2(0.0, 0.0)
    if angle > LEAST_SOLID_ANGLE and angle < MOST_SOLID_ANGLE:
        wi = sample_spherical_triangle(wp.normalize(p), wp.normalize(q), wp.normalize(r), angle, u, v)
        cosine = -wp.dot(normal, wi)
        if cosine * height <= 0.0:
            return sample
        t = height / cosine
        met = t * wi
        weights[0] = wp.clamp(wp.dot(wp.cross(q - met, r - met), across) / (doubled * doubled), 0.0, 1.0)
        weights[1] = wp.clamp(wp.dot(wp.cross(r - met, p - met), across) / (doubled * doubled), 0.0, 1.0)
    else:
        root = wp.sqrt(u)
        weights = wp.vec2(1.0 - root, root * (1.0 - v))
        met = weights[0] * p + weights[1] * q + (1.0 - weights[0] - weights[1]) * r
        t = wp.length(met)
        wi = met / t
        angle = 0.5 * doubled * wp.abs(height) / (t * t * t)
        if angle >= MOST_SOLID_ANGLE:
            return sample
    corner = shape.first_vertex + 3 * face
    uvs = scene.vertex_uvs
    rest = 1.0 - weights[0] - weights[1]
    uv = weights[0] * uvs[corner] + weights[1] * uvs[corner + 1] + rest * uvs[corner + 2]
    # Textures are filtered over a part of the triangle: finer detail would be noise.
    width = 0.25 * wp.sqrt(doubled) * shape.scale
    at = point_of_triangle(scene, corner, weights, uv, width, shape.scale)
    material = shape.material
    if scene.triangle_materials.shape[0] > 0:
        material += scene.triangle_materials[corner / 3]
    sample.wi = wp.normalize(wi)
    if shape.stretch == 0.0:
        sample.wi = wp.normalize(shape.rotation * wi)
    sample.distance = t * shape.scale
    sample.irradiance_normal = angle * emitted_radiance(scene, scene.materials[material], at)
    return sample


@wp.func
def draw_on_area(scene: RayScene, point: wp.vec3, numbers: wp.vec3) -> AreaSample:
    """Draw one sample of all emitting objects; equation (1) is the mean over n triples of ``area_numbers``."""
    shares = scene.emitting_shares
    index = find_share(shares, numbers[0])
    before = float(0.0)
    if index > 0:
        before = shares[index - 1]
    chance = shares[index] - before
    face = scene.emitting_faces[index]
    shape = scene.objects[face[0]]
    sample = AreaSample()
    if face[1] < 0:
        sample = draw_on_sphere(scene, shape, point, numbers[1], numbers[2])
    else:
        sample = draw_on_triangle(scene, shape, face[1], face[2] != 0, point, numbers[1], numbers[2])
    sample.object = face[0]
    sample.irradiance_normal = sample.irradiance_normal / wp.max(chance, 1.0e-12)
    sample.distance = NEARLY * sample.distance
    return sample


@wp.func
def area_radius(shape: Shape) -> wp.float32:
    """Return the radius, metres, of a sphere around the centre of an object that encloses it."""
    if shape.kind == SPHERE:
        return shape.scale * shape.extent[0]
    return shape.scale * wp.length(shape.extent)


@wp.func
def light_as_point(scene: RayScene, light: AreaLight, point: wp.vec3) -> AreaSample:
    """Return an emitting object as a point light, equation (2).

    Shadow rays to objects that are not flat end at the bounding sphere.
    """
    sample = AreaSample()
    shape = scene.objects[light.object]
    away = shape.position - point
    radius = area_radius(shape)
    distance = wp.length(away)
    flat = wp.min(wp.length(light.facing), 1.0)
    # There is no direction to the light from within it, and no inverse square so close to a flat one.
    if distance <= 1.0e-4 or (flat < 0.5 and distance <= radius):
        return sample
    sample.wi = away / distance
    share = 0.25 * (1.0 - flat) + wp.max(-wp.dot(shape.rotation * light.facing, sample.wi), 0.0)
    scale = shape.scale * shape.scale
    if shape.stretch != 0.0:  # areas of one normal scale by the cofactors, areas of all normals by their mean
        volume = wp.abs(wp.determinant(shape.rotation))
        facing = volume * (wp.transpose(shape.inverse) * light.facing)
        share = 0.25 * (1.0 - flat) * wp.pow(volume, 2.0 / 3.0) + wp.max(-wp.dot(facing, sample.wi), 0.0)
    sample.irradiance_normal = scale * share / (distance * distance) * light.power
    sample.distance = NEARLY * wp.max(distance - (1.0 - flat) * radius, 0.0)
    sample.object = light.object
    return sample


@functools.cache
def make_area_sample(samples: int) -> wp.Function:
    """Return the function ``area_sample(scene, point, normal, k, count, turn) -> AreaSample``: term k of equation (1).

    ``normal`` is that of the lit surface, ``count`` the number of terms, ``turn`` the pixel's result of ``tile_turn``.
    """
    candidates = 1 if samples >= MANY_SAMPLES else CANDIDATES

    @wp.func(name=f"area_sample_{0 if samples == POINT_SAMPLES else candidates}", module="unique")
    def area_sample(
        scene: RayScene, point: wp.vec3, normal: wp.vec3, k: wp.int32, count: wp.int32, turn: wp.float32
    ) -> AreaSample:
        chosen = AreaSample()
        if wp.static(samples == POINT_SAMPLES):
            chosen = light_as_point(scene, scene.area_lights[k], point)
        elif wp.static(candidates == 1):
            chosen = draw_on_area(scene, point, area_numbers(k, count, turn))
            chosen.irradiance_normal = chosen.irradiance_normal / wp.float32(count)
        else:
            total = float(0.0)
            worth = float(0.0)
            u = fraction((wp.float32(k) + 0.5) * STEP_W + 16.0 * turn * STEP_U)
            tries = wp.int32(wp.static(candidates))  # a variable: the loop is not unrolled
            for c in range(tries):
                sample = draw_on_area(scene, point, area_numbers(k * tries + c, count * tries, turn))
                weight = brightness(sample.irradiance_normal) * (LEAST_FACING + wp.max(wp.dot(normal, sample.wi), 0.0))
                total += weight
                if weight > 0.0:
                    share = weight / total
                    if u < share:
                        chosen = sample
                        worth = weight
                        u = u / share
                    else:
                        u = (u - share) / wp.max(1.0 - share, 1.0e-6)
            if worth > 0.0:
                scale = total / (worth * wp.float32(count * tries))
                chosen.irradiance_normal = scale * chosen.irradiance_normal
        return chosen

    return area_sample


@functools.cache
def make_area_count(samples: int) -> wp.Function:
    """Return the function ``area_count(scene) -> int``: number of terms of (1) or of point lights, 0 for none."""

    @wp.func(name=f"area_count_{samples}", module="unique")
    def area_count(scene: RayScene) -> wp.int32:
        if wp.static(samples == POINT_SAMPLES):
            return scene.area_lights.shape[0]
        return wp.where(scene.area_lights.shape[0] > 0, wp.static(samples), 0)

    return area_count


@wp.func
def lobe_solid_angle(surface: Surface) -> wp.float32:
    """Return the approximate solid angle of a surface's lobe; 0 for a mirror.

    Half of GGX's normals lie within tan = alpha, and reflection doubles angles: a cone of 2 alpha. Phong's
    (n + 1) / (2 pi) cos^n has the solid angle of the inverse of its peak.
    """
    if surface.model == PHONG:
        return 2.0 * wp.pi / (surface.shininess + 1.0)
    if surface.model == METALLIC_ROUGHNESS:
        alpha = surface.roughness * surface.roughness
        return FOUR_PI * alpha * alpha
    return 0.0


@wp.func
def looks_by_lobe(shape: Shape, point: wp.vec3, lobe: wp.float32) -> wp.bool:
    """Return whether the solid angle ``lobe`` is less than an emitting object's: then rays into the lobe sample it."""
    away = shape.position - point
    square = wp.dot(away, away)
    radius = area_radius(shape)
    if square <= radius * radius:
        return True
    sine2 = radius * radius / square
    return lobe < 2.0 * wp.pi * sine2 / (1.0 + wp.sqrt(1.0 - sine2))


@wp.func
def draw_lobe(surface: Surface, normal: wp.vec3, wo: wp.vec3, u: wp.vec2) -> wp.vec3:
    """Return a unit direction toward the light, sampled from a surface's lobe by ``u``, a point of the unit square."""
    if surface.model == PHONG:
        return frame_from_normal(reflect(wo, normal)) * sample_phong_lobe(u, surface.shininess)
    if surface.model == METALLIC_ROUGHNESS:
        basis = frame_from_normal(normal)
        alpha = surface.roughness * surface.roughness
        return wp.normalize(reflect(wo, basis * sample_ggx_visible(u, wp.transpose(basis) * wo, alpha)))
    return reflect(wo, normal)


@wp.func
def lobe_weight(surface: Surface, normal: wp.vec3, wo: wp.vec3, wi: wp.vec3) -> wp.vec3:
    """Return the weight of a ray from ``draw_lobe``: BRDF times cosine over the pdf, per channel."""
    if surface.model == METALLIC_ROUGHNESS:
        half = wp.normalize(wi + wo)
        alpha = surface.roughness * surface.roughness
        from_world = wp.transpose(frame_from_normal(normal))
        o = from_world * wo
        fresnel = surface.f0 + schlick(wp.dot(wo, half)) * (surface.f90 - surface.f0)
        shadowing = ggx_masking_shadowing(from_world * wi, o, alpha) / wp.max(ggx_masking(o, alpha), 1.0e-6)
        return shadowing * fresnel
    return surface.reflectance


@wp.func
def without_lobe(surface: Surface) -> Surface:
    """Return a copy of the surface that reflects diffusely alone."""
    result = surface
    result.reflectance = wp.vec3(0.0)
    result.f0 = wp.vec3(0.0)
    result.f90 = wp.vec3(0.0)
    return result


@functools.cache
def make_area_reflection(trace: TraceConfig, samples: int) -> wp.Function:
    """Return the function ``area_reflection(scene, hit, surface, normal, geometric, wo, turn) -> vec3``.

    Its result is the radiance reflected toward ``wo`` from objects for which ``looks_by_lobe`` holds, found by
    ``samples`` rays, or by one for a mirror.
    """
    functions = make_trace(trace)
    closest_object, occluded_by_proxies = functions.closest_object, functions.occluded_by_proxies

    @wp.func(module="unique")
    def area_reflection(
        scene: RayScene,
        hit: Hit,
        surface: Surface,
        normal: wp.vec3,
        geometric: wp.vec3,
        wo: wp.vec3,
        turn: wp.float32,
    ) -> wp.vec3:
        total = wp.vec3(0.0)
        lobe = lobe_solid_angle(surface)
        worth = bool(False)
        for index in range(scene.area_lights.shape[0]):
            if looks_by_lobe(scene.objects[scene.area_lights[index].object], hit.point, lobe):
                worth = True
        if not worth or surface.reflectance[0] + surface.reflectance[1] + surface.reflectance[2] <= 0.0:
            return total
        count = wp.int32(wp.static(samples))
        if surface.model == MIRROR:
            count = 1
        for k in range(count):
            numbers = area_numbers(k, count, turn)
            wi = draw_lobe(surface, normal, wo, wp.vec2(numbers[1], numbers[0]))
            if wp.dot(wi, geometric) > 0.0 and wp.dot(wi, normal) > 0.0:
                origin = offset_origin(hit.point, geometric, wi, hit.error)
                other = closest_object(scene, origin, wi, 1.0e8)
                if other.shape >= 0:
                    if looks_by_lobe(scene.objects[other.shape], hit.point, lobe):
                        material = scene.materials[material_at(scene, other)]
                        spread = wp.sqrt(lobe / wp.float32(count))
                        at = surface_point(scene, other, wp.dot(other.geometric_normal, wi), spread)
                        radiance = emitted_radiance(scene, material, at)
                        if wp.max(radiance) > 0.0:
                            if not occluded_by_proxies(scene, origin, wi, NEARLY * other.t):
                                total += wp.cw_mul(lobe_weight(surface, normal, wo, wi), radiance)
        return total / wp.float32(count)

    return area_reflection
