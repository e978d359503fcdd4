"""What surfaces do with light: textures, and four reflection models under virtual lights and under the environment.

Directions ``wi`` (to the light), ``wo`` (to the viewer) and ``normal`` are unit and point away from the surface. Every
model is first reduced to a ``Surface``: a diffuse reflectance and a lobe. Under the environment that is

    diffuse E(normal) / pi + reflectance L(mirror direction, width of the lobe),

E the irradiance, L the prefiltered environment; under a virtual light it is the reflected radiance per irradiance of a
surface that *faces* the light, so the cosine is part of it.

Phong is used in its radiance form: what is seen is the mean of the incoming radiance, weighted by (n + 1) / (2 pi)
cos^n around the mirror direction. The weight integrates to 1 at any exponent, so a small far light shades the same
whether it is part of the environment or a virtual light.

Metallic-roughness is glTF's: GGX with alpha = roughness^2, height-correlated Smith visibility, Schlick's Fresnel with
F0 = 0.04 for what is no metal. Two objects that glTF leaves open are settled by energy: light that scatters more than
once between the facets is put back [Tur19], and the diffuse part gets what the facets let pass, 1 - (their directional
albedo), rather than 1 - F of one facet. A white surface in a white environment is white, at any roughness.

References:
    [LW94] Lafortune, Willems, "Using the Modified Phong Reflectance Model for Physically Based Rendering", CW 197,
    1994.
    [WMLT07] Walter et al., "Microfacet Models for Refraction through Rough Surfaces", EGSR 2007.
    [Hei14] Heitz, "Understanding the Masking-Shadowing Function in Microfacet-Based BRDFs", JCGT 3(2), 2014.
    [glTF] Khronos, glTF 2.0 specification, appendix B.
    [Tur19] Turquin, "Practical Multiple Scattering Compensation for Microfacet Models", 2019.
"""

from __future__ import annotations

import functools

import warp as wp

from warp_ar.kernels.prefilter import energy_compensation, sample_dfg
from warp_ar.kernels.structs import METALLIC_ROUGHNESS, MIRROR, PHONG, RayScene

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
    """A material at one point seen from one direction: textures looked up, energy divided."""

    model: wp.int32
    diffuse: wp.vec3  # Lambertian reflectance of what the lobe leaves
    reflectance: wp.vec3  # of the lobe, under light from everywhere
    f0: wp.vec3  # METALLIC_ROUGHNESS: reflectance of a facet at normal incidence
    gain: wp.vec3  # METALLIC_ROUGHNESS: factor for light that scatters more than once
    shininess: wp.float32  # PHONG
    roughness: wp.float32  # METALLIC_ROUGHNESS; perceptual


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
def make_surface(models: tuple[int, ...], textures: bool) -> wp.Function:
    """``surface_at(scene, dfg, material, uv, cos_o) -> Surface``; ``dfg`` is a table as ``integrate_dfg`` writes it.

    Args:
        models: Sorted models that exist.
        textures: Whether any material has a texture.
    """
    label = "_".join(map(str, models))

    @wp.func(name=f"surface_at_{label}_{int(textures)}", module="unique")
    def surface_at(
        scene: RayScene, dfg: wp.array2d[wp.vec2], index: wp.int32, uv: wp.vec2, cos_o: wp.float32
    ) -> Surface:
        material = scene.materials[index]
        base = material.base_color
        specular = material.specular
        if wp.static(textures):
            if material.base_texture >= 0:
                base = wp.cw_mul(base, sample_texture(scene, material.base_texture, uv))
            if material.specular_texture >= 0:
                specular = wp.cw_mul(specular, sample_texture(scene, material.specular_texture, uv))
        surface = Surface()
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
                one = wp.vec3(1.0, 1.0, 1.0)
                metallic = material.metallic
                scale_bias = sample_dfg(dfg, cos_o, material.roughness)
                dielectric = (DIELECTRIC_F0 * scale_bias[0] + scale_bias[1]) * energy_compensation(
                    scale_bias, DIELECTRIC_F0 * one
                )
                surface.f0 = DIELECTRIC_F0 * (1.0 - metallic) * one + metallic * base
                surface.gain = energy_compensation(scale_bias, surface.f0)
                surface.reflectance = wp.cw_mul(scale_bias[0] * surface.f0 + scale_bias[1] * one, surface.gain)
                surface.diffuse = (1.0 - metallic) * wp.cw_mul(base, one - dielectric)
                surface.roughness = material.roughness
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
def ggx_lobe(normal: wp.vec3, half: wp.vec3, cos_i: wp.float32, cos_o: wp.float32, roughness: wp.float32) -> wp.float32:
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


@functools.cache
def make_reflect_direct(models: tuple[int, ...]) -> wp.Function:
    """``reflect_direct(surface, normal, wo, wi) -> vec3`` for the given models; zero unless the light is in front.

    The result times ``LightSample.irradiance_normal`` is radiance. A mirror would show the light itself, and a light
    without extent is nothing to see.
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
                        fresnel = surface.f0 + schlick(wp.dot(wo, half)) * (wp.vec3(1.0) - surface.f0)
                        lobe = ggx_lobe(normal, half, cos_i, wp.dot(normal, wo), surface.roughness)
                        result += cos_i * lobe * wp.cw_mul(fresnel, surface.gain)
        return result

    return reflect_direct
