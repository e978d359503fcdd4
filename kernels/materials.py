"""Reflection of light by surfaces: four models under virtual lights and under the environment.

Directions ``wi`` (to the light), ``wo`` (to the viewer) and ``normal`` are unit and point away from the surface. Every
model is first reduced to a ``Surface``: a diffuse reflectance and a lobe. Under the environment it reflects

    diffuse E(normal) / pi + reflectance L(mirror direction, width of the lobe),

with E the irradiance and L the prefiltered environment. Under a virtual light, models return the reflected radiance
over the irradiance of a surface that *faces* the light, so the cosine is part of the result.

Phong is used in its radiance form: the reflected radiance is the mean of the incoming radiance, weighted by
(n + 1) / (2 pi) cos^n around the mirror direction. The weight integrates to 1 at any exponent, so a small distant
light shades the same as part of the environment and as a virtual light.

Metallic-roughness is glTF's: GGX with alpha = roughness^2, height-correlated Smith visibility, and Schlick's Fresnel
with F0 = 0.04 for dielectrics. Two choices that glTF leaves open follow from conservation of energy. Light that
scatters more than once between the facets is added back (``split_sum``). The diffuse part receives the light that the
facets transmit, 1 - (their directional albedo), rather than 1 - F of one facet. So a white surface in a white
environment is white at any roughness.

References:
    [LW94] Lafortune, Willems, "Using the Modified Phong Reflectance Model for Physically Based Rendering", CW 197,
    1994.
    [WMLT07] Walter et al., "Microfacet Models for Refraction through Rough Surfaces", EGSR 2007.
    [Hei14] Heitz, "Understanding the Masking-Shadowing Function in Microfacet-Based BRDFs", JCGT 3(2), 2014.
    [glTF] Khronos, glTF 2.0 specification, appendix B.
    [LdR14] Lagarde, de Rousiers, "Moving Frostbite to Physically Based Rendering", 2014, sections 4.9.3 and 4.10.2.
"""

from __future__ import annotations

import functools

import warp as wp

from warp_ar.kernels.split_sum import energy_compensation, sample_dfg
from warp_ar.kernels.structs import BOX, METALLIC_ROUGHNESS, MIRROR, PHONG, Hit, Material, RayScene
from warp_ar.kernels.textures import SurfacePoint, point_of_triangle, sample_texture, slant

wp.set_module_options({"enable_backward": False})

DIELECTRIC_F0 = wp.constant(wp.float32(0.04))

# Least alpha of highlights of virtual lights. A point light's image in a mirror is a point, and its D(h) =
# 1 / (pi alpha^2) has no limit. Half of D's energy lies within tan(theta_h) = alpha, so the highlight is about 4 alpha
# wide. At 1e-3 that is 4 pixels of a camera with a focal length of 1000 pixels, the narrowest width that does not
# flicker, and D stays below 3.2e5.
MIN_ALPHA = wp.constant(wp.float32(1.0e-3))

# Smith's visibility grows as 1 / cosine at grazing angles, and the light that it weighs falls as the cosine. Below
# this cosine both are noise.
MIN_COSINE = wp.constant(wp.float32(1.0e-4))


@wp.struct
class Surface:
    """A material at one point seen from one direction, after texture look-ups and division of the energy."""

    model: wp.int32
    diffuse: wp.vec3  # Lambertian reflectance, of light that the lobe does not reflect
    reflectance: wp.vec3  # directional albedo of the lobe
    # METALLIC_ROUGHNESS: reflectance of a facet, times the factor for light that scatters more than once
    f0: wp.vec3  # at normal incidence
    f90: wp.vec3  # at grazing incidence
    shininess: wp.float32  # PHONG
    roughness: wp.float32  # METALLIC_ROUGHNESS; perceptual
    steady: wp.float32  # METALLIC_ROUGHNESS: share of the lobe that F0 weighs, independent of the angle
    # Only set where there are textures:
    emission: wp.vec3  # emitted radiance
    occlusion: wp.float32  # share of the environment's irradiance that reaches the point


@wp.func
def material_at(scene: RayScene, hit: Hit) -> wp.int32:
    """Return the index of the material at a hit."""
    index = scene.objects[hit.shape].material
    if hit.corner >= 0:
        if scene.triangle_materials.shape[0] > 0:
            index += scene.triangle_materials[hit.corner / 3]
    return index


@wp.func
def surface_point(scene: RayScene, hit: Hit, cos_o: wp.float32, spread: wp.float32) -> SurfacePoint:
    """Return the ``SurfacePoint`` of a hit, for texture look-ups.

    ``spread`` is the angle of the ray's cone, whose apex is the ray's origin. The density of texture coordinates is
    taken from a sphere's largest circle and from a box's mean side.
    """
    shape = scene.objects[hit.shape]
    width = spread * hit.t * slant(cos_o)
    if hit.corner >= 0:
        return point_of_triangle(scene, hit.corner, hit.weights, hit.uv, width, shape.scale)
    point = SurfacePoint()
    point.uv = hit.uv
    point.uv_second = hit.uv
    point.color = wp.vec4(1.0, 1.0, 1.0, 1.0)
    point.width = width
    length = wp.pi * shape.extent[0]
    if shape.kind == BOX:
        length = 2.0 * (shape.extent[0] + shape.extent[1] + shape.extent[2]) / 3.0
    density = 1.0 / (shape.scale * length)
    point.density = wp.vec2(density, density)
    return point


@wp.func
def roughness_at(scene: RayScene, material: Material, point: SurfacePoint) -> wp.float32:
    """Return the roughness at a point: the material's, times the texture's value if there is one."""
    if material.metallic_roughness_texture >= 0:
        return material.roughness * sample_texture(scene, material.metallic_roughness_texture, point)[1]
    return material.roughness


@wp.func
def emitted_radiance(scene: RayScene, material: Material, point: SurfacePoint) -> wp.vec3:
    """Return the radiance that a point emits on its emitting side; of an unlit material, the base colour."""
    if material.unlit != 0:
        base = wp.cw_mul(material.base_color, wp.vec3(point.color[0], point.color[1], point.color[2]))
        if material.base_texture >= 0:
            base = wp.cw_mul(base, rgb(sample_texture(scene, material.base_texture, point)))
        return base
    emission = material.emission
    if material.emissive_texture >= 0:
        emission = wp.cw_mul(emission, rgb(sample_texture(scene, material.emissive_texture, point)))
    return emission


@wp.func
def mix_metal(
    surface: Surface,
    dfg: wp.array2d[wp.vec2],
    base: wp.vec3,
    metallic: wp.float32,
    roughness: wp.float32,
    cos_o: wp.float32,
) -> Surface:
    """Return a ``METALLIC_ROUGHNESS`` surface seen at the cosine ``cos_o``.

    The reflected light of metal and dielectric is mixed, not the F0 of their facets: each has its own factor for
    light that scatters more than once. Otherwise a mixture of two white ones would be darker than either.
    """
    out = surface
    one = wp.vec3(1.0, 1.0, 1.0)
    scale_bias = sample_dfg(dfg, cos_o, roughness)
    plastic_gain = energy_compensation(scale_bias, DIELECTRIC_F0 * one)
    metal_gain = energy_compensation(scale_bias, base)
    dielectric = (DIELECTRIC_F0 * scale_bias[0] + scale_bias[1]) * plastic_gain
    out.f0 = DIELECTRIC_F0 * (1.0 - metallic) * plastic_gain + metallic * wp.cw_mul(base, metal_gain)
    out.f90 = (1.0 - metallic) * plastic_gain + metallic * metal_gain
    out.reflectance = scale_bias[0] * out.f0 + scale_bias[1] * out.f90
    steady = scale_bias[0] * (out.f0[0] + out.f0[1] + out.f0[2])
    reflected = out.reflectance[0] + out.reflectance[1] + out.reflectance[2]
    out.steady = steady / wp.max(reflected, 1.0e-6)
    out.diffuse = (1.0 - metallic) * wp.cw_mul(base, one - dielectric)
    out.roughness = roughness
    return out


@functools.cache
def make_surface(models: tuple[int, ...], textures: bool) -> wp.Function:
    """Return the function ``surface_at(scene, dfg, hit, cos_o, spread) -> Surface``, the material at a hit.

    ``dfg`` is the table of ``integrate_dfg``, ``spread`` the angle of the ray's cone, radians.

    Args:
        models: Sorted models of the scene's materials.
        textures: Whether any material has a texture, or any mesh has a material per triangle.
    """
    label = "_".join(map(str, models))

    @wp.func(name=f"surface_at_{label}_{int(textures)}", module="unique")
    def surface_at(
        scene: RayScene, dfg: wp.array2d[wp.vec2], hit: Hit, cos_o: wp.float32, spread: wp.float32
    ) -> Surface:
        index = scene.objects[hit.shape].material
        if wp.static(textures):
            index = material_at(scene, hit)
        material = scene.materials[index]
        base = material.base_color
        specular = material.specular
        metallic = material.metallic
        roughness = material.roughness
        surface = Surface()
        if wp.static(textures):
            point = surface_point(scene, hit, cos_o, spread)
            base = wp.cw_mul(base, wp.vec3(point.color[0], point.color[1], point.color[2]))
            if material.base_texture >= 0:
                base = wp.cw_mul(base, rgb(sample_texture(scene, material.base_texture, point)))
            if material.specular_texture >= 0:
                specular = wp.cw_mul(specular, rgb(sample_texture(scene, material.specular_texture, point)))
            if material.metallic_roughness_texture >= 0:
                factors = sample_texture(scene, material.metallic_roughness_texture, point)
                roughness *= factors[1]
                metallic *= factors[2]
            surface.emission = material.emission
            if material.emissive_texture >= 0:
                surface.emission = wp.cw_mul(
                    surface.emission, rgb(sample_texture(scene, material.emissive_texture, point))
                )
            surface.occlusion = float(1.0)
            if material.occlusion_texture >= 0:
                reached = sample_texture(scene, material.occlusion_texture, point)[0]
                surface.occlusion = 1.0 + material.occlusion_strength * (reached - 1.0)
        surface.model = material.model
        surface.diffuse = base
        if wp.static(PHONG in models):
            if material.model == PHONG:
                surface.reflectance = specular
                surface.shininess = material.shininess
        if wp.static(MIRROR in models):
            if material.model == MIRROR:
                surface.diffuse = wp.vec3(0.0)
                surface.reflectance = base
        if wp.static(METALLIC_ROUGHNESS in models):
            if material.model == METALLIC_ROUGHNESS:
                surface = mix_metal(surface, dfg, base, metallic, roughness, cos_o)
        if wp.static(textures):
            if material.unlit != 0:
                surface.emission = base
                surface.diffuse = wp.vec3(0.0)
                surface.reflectance = wp.vec3(0.0)
                surface.f0 = wp.vec3(0.0)
                surface.f90 = wp.vec3(0.0)
        return surface

    return surface_at


@wp.func
def rgb(color: wp.vec4) -> wp.vec3:
    """Return a colour without its alpha."""
    return wp.vec3(color[0], color[1], color[2])


@wp.func
def specular_occlusion(occlusion: wp.float32, cos_o: wp.float32, roughness: wp.float32) -> wp.float32:
    """Return the share of the environment's light in the lobe that reaches a point [LdR14].

    ``occlusion`` is the share of the environment's irradiance that reaches the point. The result is 1 where nothing is
    hidden. It is about ``occlusion`` for a rough lobe, and larger for a mirror that is viewed along its normal.
    """
    power = wp.pow(2.0, -16.0 * roughness - 1.0)
    return wp.clamp(wp.pow(wp.max(cos_o + occlusion, 0.0), power) - 1.0 + occlusion, 0.0, 1.0)


@wp.func
def reflect(wo: wp.vec3, normal: wp.vec3) -> wp.vec3:
    """Return the direction of perfect mirror reflection of ``wo`` at a surface of unit ``normal``."""
    return 2.0 * wp.dot(normal, wo) * normal - wo


# A GGX lobe is cut off by the surface and shadowed by its facets. The rougher it is, the further its mean lies from the
# mirror direction R toward the normal n; at roughness 1 the lobe is a cosine around n ([LdR14] 4.9.3). This holds for
# the part that F0 weighs, ``steady``. The other part, of facets at grazing angles, pulls back toward the horizon and is
# taken to stay around R. So the axis is, normalised,
#
#     R + steady roughness^3 (n - R).
#
# The cube fits integrals over eight environments: the best weight of n - R is 0.01, 0.04, 0.14, 0.45, 0.8 at roughness
# 0.25, 0.35, 0.5, 0.7, 0.9. Around R alone the error of the reflection is twice as large at 0.7, five times at 1.
@wp.func
def lobe_axis(surface: Surface, mirror: wp.vec3, normal: wp.vec3) -> wp.vec3:
    """Return the unit direction in which the prefiltered environment is read for a surface's lobe."""
    if surface.model != METALLIC_ROUGHNESS:
        return mirror
    roughness = surface.roughness
    return wp.normalize(mirror + surface.steady * roughness * roughness * roughness * (normal - mirror))


@wp.func
def phong_lobe(mirror: wp.vec3, wi: wp.vec3, exponent: wp.float32) -> wp.float32:
    """Return (n + 1) / (2 pi) cos^n of the angle between two unit vectors, or 0 beyond 90 degrees [LW94].

    With x = 1 - cos = |mirror - wi|^2 / 2, cos^n = exp(n log1p(-x)): x keeps its digits near the peak, where those of
    the cosine are gone at exponents of 1e5, and log1p is Kahan's log(u) z / (u - 1) with u = 1 + z rounded.
    """
    difference = mirror - wi
    x = 0.5 * wp.dot(difference, difference)
    if x >= 1.0:
        return 0.0
    u = 1.0 - x
    log_cosine = -x
    if u != 1.0:
        log_cosine = -x * wp.log(u) / (u - 1.0)
    return (exponent + 1.0) / (2.0 * wp.pi) * wp.exp(exponent * log_cosine)


@wp.func
def ggx_lobe(normal: wp.vec3, half: wp.vec3, cos_i: wp.float32, cos_o: wp.float32, roughness: wp.float32) -> wp.float32:
    """Return the GGX distribution times Smith visibility, D V = D G / (4 cos_i cos_o), without Fresnel.

    With s^2 = |n x h|^2 for 1 - (n.h)^2, D = k^2 / pi, k = alpha / (s^2 + alpha^2 (n.h)^2): equal to [WMLT07] eq. 33,
    no cancellation at the peak, where 1 - (n.h)^2 has none of its digits left. In V, 1 - alpha^2 is (1 - a)(1 + a).
    """
    alpha = wp.max(roughness * roughness, MIN_ALPHA)
    cross = wp.cross(normal, half)
    cos_h = wp.dot(normal, half)
    k = alpha / (wp.dot(cross, cross) + alpha * alpha * cos_h * cos_h)
    i = wp.max(cos_i, MIN_COSINE)
    o = wp.max(cos_o, MIN_COSINE)
    flat = (1.0 - alpha) * (1.0 + alpha)
    # [Hei14] eq. 99 divided by 4 cos_i cos_o.
    visibility = 0.5 / (i * wp.sqrt(o * o * flat + alpha * alpha) + o * wp.sqrt(i * i * flat + alpha * alpha))
    return k * k / wp.pi * visibility


@wp.func
def schlick(cosine: wp.float32) -> wp.float32:
    """Return (1 - cos)^5, the weight of F90 = 1 in Schlick's Fresnel term."""
    x = wp.clamp(1.0 - cosine, 0.0, 1.0)
    return x * x * x * x * x


@functools.cache
def make_reflect_direct(models: tuple[int, ...]) -> wp.Function:
    """Return the function ``reflect_direct(surface, normal, wo, wi) -> vec3``: reflected radiance of a virtual light.

    It is that radiance over ``LightSample.irradiance_normal``. It is zero for a light behind the surface, and for a
    mirror, in which the image of a point light has no extent.
    """
    label = "_".join(map(str, models))

    @wp.func(name=f"reflect_direct_{label}", module="unique")
    def reflect_direct(surface: Surface, normal: wp.vec3, wo: wp.vec3, wi: wp.vec3) -> wp.vec3:
        cos_i = wp.dot(normal, wi)
        result = wp.vec3(0.0)
        if cos_i > 0.0:
            result = surface.diffuse * (cos_i / wp.pi)
            if wp.static(PHONG in models):
                if surface.model == PHONG:
                    result += surface.reflectance * phong_lobe(reflect(wo, normal), wi, surface.shininess)
            if wp.static(METALLIC_ROUGHNESS in models):
                if surface.model == METALLIC_ROUGHNESS:
                    half = wi + wo
                    length = wp.length(half)
                    # wi = -wo has no half vector; it only comes up where both graze, and nothing is reflected there.
                    if length > 1.0e-6:
                        half = half / length
                        fresnel = surface.f0 + schlick(wp.dot(wo, half)) * (surface.f90 - surface.f0)
                        lobe = ggx_lobe(normal, half, cos_i, wp.dot(normal, wo), surface.roughness)
                        result += cos_i * lobe * fresnel
        return result

    return reflect_direct
