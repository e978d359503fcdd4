"""Deterministic sample points, and lobes from which directions are sampled.

Local frames have the normal (or the lobe's axis) along +z. Directions ``wi``, ``wo`` and half vectors ``wh`` are unit
and point away from the surface. A pdf is per steradian, of the vector that its sampler returns. Sample points ``u`` lie
in [0, 1)^2. ``alpha`` is the square of the perceptual roughness; smaller values are raised to ``MIN_ALPHA``, so that
the lobe of a mirror stays finite.

References:
    [JO20] Jarzynski, Olano 2020, Hash Functions for GPU Rendering: the PCG hash.
    [SC97] Shirley, Chiu 1997, A Low Distortion Map Between Disk and Square.
    [Duff17] Duff et al. 2017, Building an Orthonormal Basis, Revisited.
    [Walter07] Walter et al. 2007, Microfacet Models for Refraction through Rough Surfaces: GGX.
    [Heitz14] Heitz 2014, Understanding the Masking-Shadowing Function: height-correlated Smith, eq. 99.
    [DB23] Dupuy, Benyoub 2023, Sampling Visible GGX Normals with Spherical Caps.
"""

from __future__ import annotations

import math

import warp as wp

wp.set_module_options({"enable_backward": False})

PI = wp.constant(wp.float32(math.pi))
MIN_ALPHA = wp.constant(wp.float32(1.0e-4))
# Largest float32 below 1: keeps samples inside [0, 1).
BELOW_ONE = wp.constant(wp.float32(1.0 - 2.0**-24))
# Masks as typed constants: literals above 2^31 in a kernel make the compiler warn.
ODD_BITS = wp.constant(wp.uint32(0x55555555))
EVEN_BITS = wp.constant(wp.uint32(0xAAAAAAAA))
ODD_PAIRS = wp.constant(wp.uint32(0x33333333))
EVEN_PAIRS = wp.constant(wp.uint32(0xCCCCCCCC))
ODD_NIBBLES = wp.constant(wp.uint32(0x0F0F0F0F))
EVEN_NIBBLES = wp.constant(wp.uint32(0xF0F0F0F0))
ODD_BYTES = wp.constant(wp.uint32(0x00FF00FF))
EVEN_BYTES = wp.constant(wp.uint32(0xFF00FF00))


@wp.func
def pcg3d_hash(x: wp.uint32, y: wp.uint32, z: wp.uint32) -> wp.vec3ui:
    """Return three hashes of three integers, such as row, column and frame ([JO20] pcg3d)."""
    scale = wp.uint32(1664525)
    shift = wp.uint32(1013904223)
    a = x * scale + shift
    b = y * scale + shift
    c = z * scale + shift
    a += b * c
    b += c * a
    c += a * b
    a = a ^ (a >> wp.uint32(16))
    b = b ^ (b >> wp.uint32(16))
    c = c ^ (c >> wp.uint32(16))
    a += b * c
    b += c * a
    c += a * b
    return wp.vec3ui(a, b, c)


@wp.func
def uniform_from_bits(bits: wp.uint32) -> wp.float32:
    """Return a number in [0, 1) from the upper 24 bits, which float32 holds exactly, so that 1 is never reached."""
    return wp.float32(bits >> wp.uint32(8)) * 5.9604644775390625e-08


@wp.func
def radical_inverse(index: wp.uint32) -> wp.float32:
    """Return an element of the van der Corput sequence in base 2: ``index``'s bits mirrored about the point."""
    bits = index
    bits = (bits << wp.uint32(16)) | (bits >> wp.uint32(16))
    bits = ((bits & ODD_BITS) << wp.uint32(1)) | ((bits & EVEN_BITS) >> wp.uint32(1))
    bits = ((bits & ODD_PAIRS) << wp.uint32(2)) | ((bits & EVEN_PAIRS) >> wp.uint32(2))
    bits = ((bits & ODD_NIBBLES) << wp.uint32(4)) | ((bits & EVEN_NIBBLES) >> wp.uint32(4))
    bits = ((bits & ODD_BYTES) << wp.uint32(8)) | ((bits & EVEN_BYTES) >> wp.uint32(8))
    return uniform_from_bits(bits)


@wp.func
def hammersley(index: wp.int32, count: wp.int32) -> wp.vec2:
    """Return point ``index`` of a Hammersley set of ``count`` points, moved to the centres of its strata (never 0)."""
    shift = 0.5 / wp.float32(count)
    u = (wp.float32(index) + 0.5) / wp.float32(count)
    return wp.vec2(wp.min(u, BELOW_ONE), wp.min(radical_inverse(wp.uint32(index)) + shift, BELOW_ONE))


@wp.func
def frame_from_normal(normal: wp.vec3) -> wp.mat33:
    """Return the rotation world_from_local for any unit normal: columns tangent, bitangent, ``normal`` [Duff17]."""
    sign = wp.float32(1.0)
    if normal[2] < 0.0:
        sign = wp.float32(-1.0)
    a = -1.0 / (sign + normal[2])
    b = normal[0] * normal[1] * a
    tangent = wp.vec3(1.0 + sign * normal[0] * normal[0] * a, sign * b, -sign * normal[0])
    bitangent = wp.vec3(b, sign + normal[1] * normal[1] * a, -normal[1])
    return wp.matrix_from_cols(tangent, bitangent, normal)


@wp.func
def sample_disk(u: wp.vec2) -> wp.vec2:
    """Return a uniform point of the unit disk by the concentric map [SC97], which keeps neighbours close."""
    x = 2.0 * u[0] - 1.0
    y = 2.0 * u[1] - 1.0
    if x == 0.0 and y == 0.0:
        return wp.vec2(0.0, 0.0)
    radius = x
    phi = 0.25 * PI * (y / wp.where(x == 0.0, 1.0, x))
    if wp.abs(y) >= wp.abs(x):
        radius = y
        phi = 0.5 * PI - 0.25 * PI * (x / wp.where(y == 0.0, 1.0, y))
    return wp.vec2(radius * wp.cos(phi), radius * wp.sin(phi))


@wp.func
def sample_cosine_hemisphere(u: wp.vec2) -> wp.vec3:
    """Return a direction with pdf cos_theta / pi (Malley's method)."""
    disk = sample_disk(u)
    return wp.vec3(disk[0], disk[1], wp.sqrt(wp.max(1.0 - disk[0] * disk[0] - disk[1] * disk[1], 0.0)))


@wp.func
def sample_phong_lobe(u: wp.vec2, exponent: wp.float32) -> wp.vec3:
    """Return a direction with pdf (n + 1) / (2 pi) cos^n theta about +z.

    cos theta = u^(1 / (n + 1)). 1 - cos theta is computed by 1 - e^x = -2 e^(x/2) sinh(x/2), which stays exact for
    exponents of 1e5.
    """
    x = wp.log(wp.max(1.0 - u[0], 1.0e-30)) / (exponent + 1.0)
    versine = -2.0 * wp.exp(0.5 * x) * wp.sinh(0.5 * x)
    sin_theta = wp.sqrt(wp.max(versine * (2.0 - versine), 0.0))
    phi = 2.0 * PI * u[1]
    return wp.vec3(sin_theta * wp.cos(phi), sin_theta * wp.sin(phi), 1.0 - versine)


@wp.func
def phong_lobe_pdf(cos_theta: wp.float32, exponent: wp.float32) -> wp.float32:
    """Return the pdf (n + 1) / (2 pi) cos^n theta; zero for cos theta <= 0, also for n = 0."""
    if cos_theta <= 0.0:
        return 0.0
    return (exponent + 1.0) / (2.0 * PI) * wp.pow(wp.min(cos_theta, 1.0), exponent)


@wp.func
def ggx_distribution(wh: wp.vec3, alpha: wp.float32) -> wp.float32:
    """Return GGX D(wh) = a^2 / (pi (x^2 + y^2 + a^2 z^2)^2) of a local unit half vector.

    It equals [Walter07] eq. 33. 1 - z^2 is written as x^2 + y^2 to avoid cancellation near the peak.
    """
    a2 = wp.max(alpha, MIN_ALPHA) * wp.max(alpha, MIN_ALPHA)
    t = wh[0] * wh[0] + wh[1] * wh[1] + a2 * wh[2] * wh[2]
    return a2 / (PI * t * t)


@wp.func
def ggx_lambda(w: wp.vec3, alpha: wp.float32) -> wp.float32:
    """Return Smith's Lambda, (sqrt(1 + a^2 tan^2) - 1) / 2, without cancellation for small a tan."""
    a = wp.max(alpha, MIN_ALPHA)
    z2 = wp.max(w[2] * w[2], 1.0e-14)
    t = a * a * (w[0] * w[0] + w[1] * w[1]) / z2
    return 0.5 * t / (wp.sqrt(1.0 + t) + 1.0)


@wp.func
def ggx_masking(w: wp.vec3, alpha: wp.float32) -> wp.float32:
    """Return the Smith masking function G1."""
    return 1.0 / (1.0 + ggx_lambda(w, alpha))


@wp.func
def ggx_masking_shadowing(wi: wp.vec3, wo: wp.vec3, alpha: wp.float32) -> wp.float32:
    """Return the height-correlated Smith masking-shadowing function G2 ([Heitz14] eq. 99)."""
    return 1.0 / (1.0 + ggx_lambda(wi, alpha) + ggx_lambda(wo, alpha))


@wp.func
def sample_ggx_visible(u: wp.vec2, wo: wp.vec3, alpha: wp.float32) -> wp.vec3:
    """Return a half vector visible from ``wo`` (local, z >= 0) by a spherical cap [DB23]; pdf ``ggx_visible_pdf``."""
    a = wp.max(alpha, MIN_ALPHA)
    stretched = wp.normalize(wp.vec3(a * wo[0], a * wo[1], wp.max(wo[2], 1.0e-7)))
    phi = 2.0 * PI * u[0]
    z = (1.0 - u[1]) * (1.0 + stretched[2]) - stretched[2]
    sin_theta = wp.sqrt(wp.clamp(1.0 - z * z, 0.0, 1.0))
    half = wp.vec3(sin_theta * wp.cos(phi), sin_theta * wp.sin(phi), z) + stretched
    return wp.normalize(wp.vec3(a * half[0], a * half[1], wp.max(half[2], 1.0e-9)))


@wp.func
def ggx_visible_pdf(wh: wp.vec3, wo: wp.vec3, alpha: wp.float32) -> wp.float32:
    """Return the pdf of ``sample_ggx_visible``, G1(wo) D(wh) max(wo.wh, 0) / cos_theta_o.

    The pdf of wi is this pdf divided by 4 wo.wh.
    """
    cos_theta = wp.max(wo[2], 1.0e-7)
    return ggx_masking(wo, alpha) * ggx_distribution(wh, alpha) * wp.max(wp.dot(wo, wh), 0.0) / cos_theta
