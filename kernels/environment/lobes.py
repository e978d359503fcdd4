"""Lobes of glossy reflection: their widths, the layout of their maps in memory, and their tables of weights.

Levels. Level 0 is the environment itself (a mirror). Level l >= 1 holds the environment averaged with a lobe of width

    alpha_l = 2^(l - L),  l = 1 .. L,

where L is such that the narrowest lobe is about three texels of the map wide (full width at half maximum). A wider lobe
needs fewer texels: level l has (H >> s, 2 H >> s) texels with s = max(l - 2, 0), which keeps the bilinear error below
2 % of a single emitter's peak. All levels lie in one packed ``wp.array[wp.vec3]``, row-major, one after another.
``kernels/environment/prefilter.py`` fills them, ``sample_levels`` reads them.

References:
    [KC08] Krivanek, Colbert 2008, Real-time Shading with Filtered Importance Sampling.
    [Karis13] Karis 2013, Real Shading in Unreal Engine 4.
    [MS16] Manson, Sloan 2016, Fast Filtering of Reflection Probes: levels of a pyramid combined with fitted weights.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Literal

import numpy as np
import warp as wp

from warp_ar.kernels.environment.pyramid import level_count, sample_packed
from warp_ar.kernels.latlong import latlong_from_direction

wp.set_module_options({"enable_backward": False})

# Added to the pyramid level whose texel has a sample's solid angle, so that samples overlap, as [KC08] advise. By error
# against brute force, 0 is best for smooth skies and 0.5 for small emitters; this value is a compromise.
SAMPLE_BIAS = 0.25
Lobe = Literal["ggx", "phong"]


def lobe_count(height: int) -> int:
    """Return the number of levels of a prefiltered environment of ``height`` rows, the mirror included."""
    return 1 + max(1, (height >> 2).bit_length())


def lobe_size(height: int, level: int) -> tuple[int, int]:
    """Return the rows and columns of a level."""
    shift = max(level - 2, 0)
    return height >> shift, 2 * height >> shift


def lobe_offset(height: int, level: int) -> int:
    """Return the index of a level's first texel."""
    return sum(rows * columns for rows, columns in (lobe_size(height, below) for below in range(level)))


def lobe_texels(height: int) -> int:
    """Return the number of texels of all levels: the length of the array ``prefilter_levels``."""
    return lobe_offset(height, lobe_count(height))


def lobe_alpha(height: int, level: int) -> float:
    """Return the width alpha of a level's lobe; 0 for the mirror."""
    return 0.0 if level == 0 else 2.0 ** (level - (lobe_count(height) - 1))


@wp.func
def last_lobe(height: wp.int32) -> wp.int32:
    """Return the index L of the level with the widest lobe."""
    last = wp.int32(1)
    while (height >> (last + 2)) > 0:
        last += 1
    return last


# Between levels, the level is linear in log2 alpha. For both lobes and all widths this lies between the blend with the
# least squared error and the blend with the best encircled energy.
@wp.func
def level_from_alpha(alpha: wp.float32, height: wp.int32) -> wp.float32:
    """Return the fractional level of a lobe of width ``alpha``; below level 1 the level is proportional to alpha."""
    last = last_lobe(height)
    narrowest = 2.0 / wp.float32(1 << last)
    if alpha < narrowest:
        return wp.max(alpha, 0.0) / narrowest
    return wp.float32(last) + wp.log2(wp.min(alpha, 1.0))


@wp.func
def level_from_roughness(roughness: wp.float32, height: wp.int32) -> wp.float32:
    """Return the level of a perceptual roughness as in glTF, whose square is alpha."""
    return level_from_alpha(roughness * roughness, height)


@wp.func
def level_from_shininess(shininess: wp.float32, height: wp.int32) -> wp.float32:
    """Return the level of a Phong exponent n: alpha = 1 / sqrt n; n <= 1 gives the widest lobe."""
    return level_from_alpha(1.0 / wp.sqrt(wp.max(shininess, 1.0)), height)


@wp.func
def sample_levels(levels: wp.array[wp.vec3], direction: wp.vec3, level: wp.float32, height: wp.int32) -> wp.vec3:
    """Return the radiance reflected from ``direction``, blended between the two nearest levels.

    Args:
        levels: Packed levels, (lobe_texels(height),).
        direction: Mirror direction, world; need not be unit.
        level: Level from ``level_from_roughness`` or ``level_from_shininess``, clamped to the existing levels.
        height: Rows of level 0.
    """
    last = last_lobe(height)
    clamped = wp.clamp(level, 0.0, wp.float32(last))
    below = wp.min(wp.int32(clamped), last - 1)
    fraction = clamped - wp.float32(below)
    offset = wp.int32(0)
    for l in range(below):
        offset += (height >> wp.max(l - 2, 0)) * (2 * height >> wp.max(l - 2, 0))
    h = height >> wp.max(below - 2, 0)
    w = 2 * height >> wp.max(below - 2, 0)
    at = latlong_from_direction(direction, height, 2 * height)
    v = at[0] / wp.float32(height)
    u = at[1] / wp.float32(2 * height)
    fine = sample_packed(levels, offset, h, w, v * wp.float32(h), u * wp.float32(w))
    if fraction == 0.0:
        return fine
    offset += h * w
    h = height >> wp.max(below - 1, 0)
    w = 2 * height >> wp.max(below - 1, 0)
    coarse = sample_packed(levels, offset, h, w, v * wp.float32(h), u * wp.float32(w))
    return fine * (1.0 - fraction) + coarse * fraction


@wp.func
def locate_texel(index: wp.int32, height: wp.int32) -> wp.vec4i:
    """Return (level, row, column, index of the level's first texel) of a packed texel."""
    level = wp.int32(0)
    offset = wp.int32(0)
    w = 2 * height
    size = height * w
    while index >= offset + size:
        offset += size
        level += 1
        w = 2 * height >> wp.max(level - 2, 0)
        size = (height >> wp.max(level - 2, 0)) * w
    i = (index - offset) / w
    return wp.vec4i(level, i, index - offset - i * w, offset)


# Lobes about the mirror direction R, c = cos theta = R.w. Each is normalised by its own sum, so that a constant
# environment stays constant:
#
#     GGX with N = V = R, as in split-sum shading [Karis13], alpha = roughness^2:
#     D(half vector) c ~ c / ((1 - c) / 2 + alpha^2 (1 + c) / 2)^2.
#     At alpha = 1 it is the plain cosine: roughness 1 reflects irradiance / pi.
#     Phong:  cos^n theta with n = 1 / alpha^2. At alpha = 1 it is the plain cosine too; exponents below 1 act as 1.
#     The variance per axis of a narrow Phong lobe is 1 / n = alpha^2, so both lobes are about equally wide.
def lobe_kernel(cos_theta: np.ndarray, alpha: float, lobe: Lobe) -> np.ndarray:
    """Return the values of a lobe before normalisation, float64.

    Args:
        cos_theta: Cosine of the angle to the mirror direction.
        alpha: Width.
        lobe: ``ggx`` or ``phong``.
    """
    c = np.maximum(cos_theta, 0.0)
    if lobe == "phong":
        return c ** (1.0 / alpha**2)
    return c / (0.5 * (1.0 - cos_theta) + 0.5 * alpha**2 * (1.0 + cos_theta)) ** 2


# Mixed mips: level l is a weighted sum of levels m of an isotropic pyramid [MS16], sum_m w_lm mip_m with w >= 0 and
# sum w = 1, each read through quadratic B-splines. Box and spline of mip m together blur with the variance
# sigma_m^2 = (T_m^2 - T_0^2) / 12 + T_m^2 / 4 per axis, T_m = pi / H_m; mip 0 is read without a spline. On the sphere
# this attenuates degree k by about B_mk = exp(-k (k + 1) sigma_m^2 / 2). The weights minimise the expected error
#
#     sum_k (2 k + 1) S_k (K_k - sum_m w_lm B_mk)^2,   S_k = 1 / (k + 1/2)^2,
#
# with the lobe's zonal coefficients K_k (K_0 = 1) and the power S_k per coefficient of natural scenes. For Phong a
# single level with the lobe's second moment would suffice. GGX has long tails, whose second moment exceeds alpha^2 by
# more and more as alpha falls, and no single box has both its peak and its tails.
@functools.lru_cache(maxsize=4)
def mip_weights(height: int, lobe: Lobe) -> np.ndarray:
    """Return the weights w_lm of mips m (columns) that approximate the lobe of level l (rows); row 0 is the mirror.

    Args:
        height: Rows of the environment; it has twice as many columns.
        lobe: ``ggx`` or ``phong``.
    """
    mips, count = level_count(height, 2 * height), lobe_count(height)
    nodes = (np.arange(2048) + 0.5) / 2048
    theta = 0.5 * np.pi * nodes**2  # midpoints, denser near the peak
    measure = np.sin(theta) * nodes
    degrees = 4 * height
    cosine = np.cos(theta)
    legendre = np.empty((degrees, theta.size))
    legendre[0], legendre[1] = 1.0, cosine
    for k in range(2, degrees):
        legendre[k] = ((2 * k - 1) * cosine * legendre[k - 1] - (k - 1) * legendre[k - 2]) / k
    k = np.arange(degrees)
    root_power = np.sqrt((2 * k + 1) / (k + 0.5) ** 2)
    texel = np.pi / np.array([max(height >> m, 1) for m in range(mips)])
    variance = (texel**2 - texel[0] ** 2) / 12.0 + texel**2 / 4.0
    variance[0] = 0.0
    mip_response = np.exp(-0.5 * (k * (k + 1))[None, :] * variance[:, None])
    weights = np.zeros((count, mips))
    weights[0, 0] = 1.0
    for level in range(1, count):
        lobe_measure = lobe_kernel(cosine, lobe_alpha(height, level), lobe) * measure
        response = legendre @ lobe_measure / lobe_measure.sum()
        weights[level] = _simplex_least_squares((mip_response * root_power).T, response * root_power)
    return weights


def _simplex_least_squares(matrix: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the least-squares weights that are not negative and sum to 1.

    While the solution has a negative weight, the most negative one is set to 0 and the rest is solved again.
    """
    active = list(range(matrix.shape[1]))
    while True:
        columns = matrix[:, active]
        system = np.ones((len(active) + 1, len(active) + 1))
        system[:-1, :-1] = columns.T @ columns
        system[-1, -1] = 0.0
        solution = np.linalg.lstsq(system, np.append(columns.T @ target, 1.0), rcond=None)[0][:-1]
        if solution.min() >= 0.0:
            weights = np.zeros(matrix.shape[1])
            weights[active] = solution
            return weights
        del active[int(solution.argmin())]


@dataclasses.dataclass(frozen=True)
class LobeSamples:
    """Directions sampled from the lobe of every level, on a device."""

    directions: wp.array2d[wp.vec4]
    """Local direction (xyz, lobe's axis along +z) and pyramid level to read (w), (levels, S)."""
    weights: wp.array2d[wp.float32]
    """Weight of each direction, (levels, S); the weights of a level sum to 1."""


# Filtered importance sampling [KC08]: S directions are sampled from the lobe. Each is read from the level of an
# isotropic pyramid whose texel covers its share 1 / (S pdf) of the sphere: m = log2(share / T_0^2) / 2 + bias.
# The GGX lobe is that of a surface viewed along its normal. Half vectors are sampled by D cos, which gives
# cos^2 = (1 - u) / (1 - u + alpha^2 u); the directions then have the pdf D / 4 and the weight n.l [Karis13].
# The same Hammersley set of directions serves every texel of a level: no noise between neighbours, no flicker between
# frames.
def make_lobe_samples(height: int, lobe: Lobe, count: int, device: wp.DeviceLike) -> LobeSamples:
    """Sample ``count`` directions for every level; level 0 gets the mirror direction.

    Args:
        height: Rows of the environment; it has twice as many columns.
        lobe: ``ggx`` or ``phong``.
        count: Samples per texel.
        device: Device of the samples.
    """
    levels = lobe_count(height)
    index = np.arange(count)
    u = (index + 0.5) / count
    v = np.array([int(f"{i:032b}"[::-1], 2) for i in index]) / 2.0**32 + 0.5 / count
    directions = np.zeros((levels, count, 4))
    directions[..., 2] = 1.0
    weights = np.full((levels, count), 1.0 / count)
    for level in range(1, levels):
        alpha = lobe_alpha(height, level)
        if lobe == "phong":
            exponent = 1.0 / alpha**2
            cosine = (1.0 - u) ** (1.0 / (exponent + 1.0))
            pdf = (exponent + 1.0) / (2.0 * np.pi) * cosine**exponent
        else:
            half_cosine2 = (1.0 - u) / (1.0 - u + alpha**2 * u)
            cosine = 2.0 * half_cosine2 - 1.0
            pdf = alpha**2 / (4.0 * np.pi * (1.0 - half_cosine2 + alpha**2 * half_cosine2) ** 2)
            weights[level] = np.maximum(cosine, 0.0) / np.maximum(cosine, 0.0).sum()
        sine = np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
        directions[level, :, 0] = sine * np.cos(2.0 * np.pi * v)
        directions[level, :, 1] = sine * np.sin(2.0 * np.pi * v)
        directions[level, :, 2] = cosine
        # The mean of a few directions is off the axis, which would shift reflections: move the mean onto the axis.
        for _ in range(16):
            mean = weights[level] @ directions[level, :, :3]
            directions[level, :, :2] -= mean[:2] / mean[2] * directions[level, :, 2:3]
            directions[level, :, :3] /= np.linalg.norm(directions[level, :, :3], axis=1, keepdims=True)
        share = 1.0 / (count * pdf)
        directions[level, :, 3] = np.maximum(0.5 * np.log2(share / (np.pi / height) ** 2) + SAMPLE_BIAS, 0.0)
    return LobeSamples(
        wp.array(directions.astype(np.float32), dtype=wp.vec4, device=device),
        wp.array(weights.astype(np.float32), dtype=wp.float32, device=device),
    )


def lobe_rows(height: int) -> int:
    """Return the number of rows of all levels."""
    return sum(lobe_size(height, level)[0] for level in range(lobe_count(height)))
