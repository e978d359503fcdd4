"""What surfaces do with light: textures, and four reflection models under virtual lights and under the room's light.

Directions ``wi`` (to the light), ``wo`` (to the viewer) and ``normal`` are unit and point away from the surface. For
virtual lights a model gives the reflected radiance per irradiance of a surface that *faces* the light, so the cosine is
part of it. For the room it gives radiance from the prefiltered environment.

Phong is used in its radiance form: what is seen is the mean of the incoming radiance, weighted by (n + 1) / (2 pi)
cos^n around the mirror direction. The weight integrates to 1, so the lobe neither gains energy at any exponent nor
loses it above the horizon; a small far light shades the same whether it is part of the environment or a virtual light.

Metallic-roughness is glTF's: GGX with alpha = roughness^2, height-correlated Smith visibility, Schlick's Fresnel with
F0 = 0.04 for what is no metal, Lambert weighted by 1 - F below it; one scattering event, as glTF and the usual path
tracers have it.

References:
    [LW94] Lafortune, Willems, "Using the Modified Phong Reflectance Model for Physically Based Rendering", CW 197,
    1994.
    [WMLT07] Walter et al., "Microfacet Models for Refraction through Rough Surfaces", EGSR 2007.
    [Hei14] Heitz, "Understanding the Masking-Shadowing Function in Microfacet-Based BRDFs", JCGT 3(2), 2014.
    [glTF] Khronos, glTF 2.0 specification, appendix B.
    [Kar13] Karis, "Real Shading in Unreal Engine 4", SIGGRAPH 2013 course.
"""

from __future__ import annotations

import functools

import warp as wp

from warp_ar.kernels.structs import LAMBERT, METALLIC_ROUGHNESS, MIRROR, PHONG, Material, RayScene

wp.set_module_options({"enable_backward": False})

DIELECTRIC_F0 = wp.constant(wp.float32(0.04))

# Highlights of virtual lights. A light without extent in a mirror is a point without extent: nothing to see, and D(h) =
# 1 / (pi alpha^2) has no limit. Half of D's energy lies within tan(theta_h) = alpha, so the highlight is about 4 alpha
# wide; at 1e-3 that is 4 pixels of a camera with a focal length of 1000 pixels, the narrowest that does not flicker. D
# stays below 3.2e5.
MIN_ALPHA = wp.constant(wp.float32(1.0e-3))

# Smith's visibility grows as 1 / cosine at grazing angles; the light that it weighs falls as the cosine. Below this
# both are noise.
MIN_COSINE = wp.constant(wp.float32(1.0e-4))


@wp.struct
class Surface:
    """A material at one point, textures looked up."""

    model: wp.int32
    base_color: wp.vec3
    specular: wp.vec3
    shininess: wp.float32
    metallic: wp.float32
    roughness: wp.float32


@wp.func
def sample_texture(scene: RayScene, index: wp.int32, uv: wp.vec2) -> wp.vec3:
    """Bilinear, repeating lookup; v points up the picture, texel centres lie at half-integers."""
    texture = scene.textures[index]
    x = (uv[0] - wp.floor(uv[0])) * wp.float32(texture.width) - 0.5
    y = (1.0 - (uv[1] - wp.floor(uv[1]))) * wp.float32(texture.height) - 0.5
    fx = x - wp.floor(x)
    fy = y - wp.floor(y)
    # x lies in [-0.5, width - 0.5], also where uv is so close below an integer that its fraction rounds to 1.
    left = wp.int32(wp.floor(x))
    top = wp.int32(wp.floor(y))
    right = wp.where(left + 1 >= texture.width, 0, left + 1)
    bottom = wp.where(top + 1 >= texture.height, 0, top + 1)
    left = wp.where(left < 0, texture.width - 1, left)
    top = wp.where(top < 0, texture.height - 1, top)
    upper = texture.offset + top * texture.width
    lower = texture.offset + bottom * texture.width
    above = scene.texels[upper + left] * (1.0 - fx) + scene.texels[upper + right] * fx
    below = scene.texels[lower + left] * (1.0 - fx) + scene.texels[lower + right] * fx
    return above * (1.0 - fy) + below * fy


@functools.cache
def make_surface(textures: bool) -> wp.Function:
    """``surface_at(scene, material_index, uv) -> Surface``; without textures no lookup is compiled in."""

    @wp.func(name=f"surface_at_{int(textures)}", module="unique")
    def surface_at(scene: RayScene, index: wp.int32, uv: wp.vec2) -> Surface:
        material = scene.materials[index]
        surface = Surface()
        surface.model = material.model
        surface.base_color = material.base_color
        surface.specular = material.specular
        surface.shininess = material.shininess
        surface.metallic = material.metallic
        surface.roughness = material.roughness
        if wp.static(textures):
            if material.base_texture >= 0:
                surface.base_color = wp.cw_mul(surface.base_color, sample_texture(scene, material.base_texture, uv))
            if material.specular_texture >= 0:
                surface.specular = wp.cw_mul(surface.specular, sample_texture(scene, material.specular_texture, uv))
        return surface

    return surface_at


@wp.func
def reflect(wo: wp.vec3, normal: wp.vec3) -> wp.vec3:
    """Mirror direction of ``wo``."""
    return 2.0 * wp.dot(normal, wo) * normal - wo


@wp.func
def phong_lobe(mirror: wp.vec3, wi: wp.vec3, exponent: wp.float32) -> wp.float32:
    """(n + 1) / (2 pi) cos^n of the angle between two unit vectors, 0 behind ([LW94] without the surface's cosine).

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
def ggx_lobe(
    normal: wp.vec3, half: wp.vec3, cos_i: wp.float32, cos_o: wp.float32, roughness: wp.float32
) -> wp.float32:
    """GGX distribution times Smith visibility, D V = D G / (4 cos_i cos_o), without Fresnel.

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
    """(1 - cos)^5, the share of F90 = 1 in Schlick's Fresnel term."""
    x = wp.clamp(1.0 - cosine, 0.0, 1.0)
    return x * x * x * x * x


@wp.func
def mean_schlick(cos_o: wp.float32) -> wp.float32:
    """Mean of ``schlick(wo.h)`` over light from everywhere, cosine-weighted: what Fresnel takes from the diffuse part.

    g(cos_o) = 1 / pi int (1 - wo.h)^5 cos_i dwi has no closed form; this quartic follows its quadrature within 1e-5.
    """
    c = wp.clamp(cos_o, 0.0, 1.0)
    return 0.02816409 + c * (-0.07984867 + c * (0.08643933 + c * (-0.04364023 + c * 0.00896795)))


@wp.func
def specular_f0(surface: Surface) -> wp.vec3:
    """Reflectance at normal incidence of a metallic-roughness surface."""
    m = surface.metallic
    return wp.vec3(DIELECTRIC_F0 * (1.0 - m)) + m * surface.base_color


@functools.cache
def make_reflect_direct(models: tuple[int, ...]) -> wp.Function:
    """``reflect_direct(surface, normal, wo, wi) -> vec3`` for the given models; zero unless the light is in front.

    The result times ``LightSample.irradiance_normal`` is radiance.
    """
    label = "_".join(map(str, models))

    @wp.func(name=f"reflect_direct_{label}", module="unique")
    def reflect_direct(surface: Surface, normal: wp.vec3, wo: wp.vec3, wi: wp.vec3) -> wp.vec3:
        cos_i = wp.dot(normal, wi)
        result = wp.vec3(0.0)
        if cos_i > 0.0:
            if wp.static(LAMBERT in models):
                if surface.model == LAMBERT:
                    result = surface.base_color * (cos_i / wp.pi)
            if wp.static(PHONG in models):
                if surface.model == PHONG:
                    lobe = phong_lobe(reflect(wo, normal), wi, surface.shininess)
                    result = surface.base_color * (cos_i / wp.pi) + surface.specular * lobe
            if wp.static(METALLIC_ROUGHNESS in models):
                if surface.model == METALLIC_ROUGHNESS:
                    half = wi + wo
                    length = wp.length(half)
                    # wi = -wo has no half vector; it only comes up where both graze, and nothing is reflected there.
                    if length > 1.0e-6:
                        half = half / length
                        f = schlick(wp.dot(wo, half))
                        f0 = specular_f0(surface)
                        fresnel = f0 + f * (wp.vec3(1.0) - f0)
                        passed = (1.0 - surface.metallic) * (1.0 - DIELECTRIC_F0) * (1.0 - f)
                        lobe = ggx_lobe(normal, half, cos_i, wp.dot(normal, wo), surface.roughness)
                        result = cos_i * (surface.base_color * (passed / wp.pi) + fresnel * lobe)
            # A mirror shows lights that have an extent; a point light has none.
        return result

    return reflect_direct
