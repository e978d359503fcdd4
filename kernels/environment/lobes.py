"""Lobes of glossy reflection: their widths, where their maps lie in memory, and their shapes in numbers.

Levels. Level 0 is the environment itself (a mirror). Level l >= 1 holds the environment averaged with a lobe of width

    alpha_l = 2^(l - L),  l = 1 .. L,

L such that the narrowest is about three texels of the map wide (full width at half maximum). A wider lobe needs fewer
texels: level l has (H >> s, 2 H >> s) with s = max(l - 2, 0), which leaves eight texels per unit of alpha, bilinear
error below 2 % of a single emitter's peak. All levels lie in one packed ``wp.array[wp.vec3]``, row-major, one after
another. ``kernels/environment/prefilter.py`` fills them, ``sample_levels`` reads them.

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

# How much coarser a level of the pyramid is read than the bare share of a sample asks for: samples then overlap, as
# [KC08] advise. Between 0, best for smooth skies, and 0.5, best for small emitters, by error against brute force.
SAMPLE_BIAS = 0.25
Lobe = Literal["ggx", "phong"]


def lobe_count(height: int) -> int:
    """Levels of a prefiltered environment of ``height`` rows, the mirror among them."""
    return 1 + max(1, (height >> 2).bit_length())


def lobe_size(height: int, level: int) -> tuple[int, int]:
    """Rows and columns of a level."""
    shift = max(level - 2, 0)
    return height >> shift, 2 * height >> shift


def lobe_offset(height: int, level: int) -> int:
    """Index of a level's first texel."""
    return sum(rows * columns for rows, columns in (lobe_size(height, below) for below in range(level)))


def lobe_texels(height: int) -> int:
    """Texels of all levels together: the length of ``prefilter_levels``."""
    return lobe_offset(height, lobe_count(height))


def lobe_alpha(height: int, level: int) -> float:
    """Width alpha of a level's lobe; 0 for the mirror."""
    return 0.0 if level == 0 else 2.0 ** (level - (lobe_count(height) - 1))


@wp.func
def last_lobe(height: wp.int32) -> wp.int32:
    """Index L of the widest lobe's level."""
    last = wp.int32(1)
    while (height >> (last + 2)) > 0:
        last += 1
    return last


# Between levels, the level is linear in log2 alpha: that lies between the blend with the least squared error and the
# one with the best encircled energy, for both lobes and all widths.
@wp.func
def level_from_alpha(alpha: wp.float32, height: wp.int32) -> wp.float32:
    """Level, with fraction, of a lobe of width ``alpha``; below the narrowest, a share of it proportional to alpha."""
    last = last_lobe(height)
    narrowest = 2.0 / wp.float32(1 << last)
    if alpha < narrowest:
        return wp.max(alpha, 0.0) / narrowest
    return wp.float32(last) + wp.log2(wp.min(alpha, 1.0))


@wp.func
def level_from_roughness(roughness: wp.float32, height: wp.int32) -> wp.float32:
    """Level of a perceptual roughness (glTF): alpha is its square."""
    return level_from_alpha(roughness * roughness, height)


@wp.func
def level_from_shininess(shininess: wp.float32, height: wp.int32) -> wp.float32:
    """Level of a Phong exponent: alpha = 1 / sqrt n; 1 and below are the widest lobe."""
    return level_from_alpha(1.0 / wp.sqrt(wp.max(shininess, 1.0)), height)


@wp.func
def sample_levels(levels: wp.array[wp.vec3], direction: wp.vec3, level: wp.float32, height: wp.int32) -> wp.vec3:
    """Radiance reflected from ``direction``, blended between the two nearest levels; seam and poles are safe.

    Args:
        levels: Packed levels, (lobe_texels(height),).
        direction: Mirror direction, world; need not be unit.
        level: From ``level_from_roughness`` or ``level_from_shininess``; clamped to those that exist.
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
    """(level, row, column, first index of the level) of a packed texel."""
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


# Lobes, about the mirror direction R, cos theta = R.w, each normalised by its own sum so that a constant environment
# stays constant:
#
#     GGX with N = V = R, as split-sum shading takes it [Karis13], alpha = roughness^2, c = cos theta:
#     D(half vector) c ~ c / ((1 - c) / 2 + alpha^2 (1 + c) / 2)^2.
#     At alpha = 1 it is the plain cosine: roughness 1 reflects irradiance / pi.
#     Phong:  cos^n theta with n = 1 / alpha^2. At alpha = 1 it is the plain cosine as well; exponents below 1 act as 1.
#     The variance per axis of a narrow Phong lobe is 1 / n = alpha^2: both lobes are about as wide at equal alpha.
def lobe_kernel(cos_theta: np.ndarray, alpha: float, lobe: Lobe) -> np.ndarray:
    """Lobe before normalisation, float64.

    Args:
        cos_theta: Cosine of the angle to the mirror direction.
        alpha: Width.
        lobe: ``ggx`` or ``phong``.
    """
    c = np.maximum(cos_theta, 0.0)
    if lobe == "phong":
        return c ** (1.0 / alpha**2)
    return c / (0.5 * (1.0 - cos_theta) + 0.5 * alpha**2 * (1.0 + cos_theta)) ** 2


# Mixed mips: level l is a sum of several levels m of an isotropic pyramid [MS16], sum_m w_lm mip_m with w >= 0 and sum
# w
# = 1, each read through quadratic B-splines. A box mip read so blurs with variance sigma_m^2 = (T_m^2 - T_0^2) / 12 +
# T_m^2 / 4 per axis, T_m = pi / H_m: the box and the spline; mip 0 is read as it is. On the sphere that is close to
# exp(-k (k + 1) sigma_m^2 / 2) in degree k. The weights minimise the expected squared error
#
#     sum_k (2 k + 1) S_k (K_k - sum_m w_lm B_mk)^2,   S_k = 1 / (k + 1/2)^2,
#
# K_k the lobe's zonal coefficients (K_0 = 1) and S_k the power per coefficient of natural scenes. A single level with
# the lobe's second moment would do for Phong; GGX has tails so long that its moment grows without bound as alpha falls,
# and a single box cannot have peak and tails.
@functools.lru_cache(maxsize=4)
def mip_weights(height: int, lobe: Lobe) -> np.ndarray:
    """Weights w_lm of box mips m (columns) that make the lobe of level l (rows), as derived above; row 0 is the mirror.

    Args:
        height: Rows of the environment; it has twice as many columns.
        lobe: ``ggx`` or ``phong``.
    """
    mips, count = level_count(height, 2 * height), lobe_count(height)
    nodes = (np.arange(2048) + 0.5) / 2048
    theta = 0.5 * np.pi * nodes**2  # midpoints that gather at the peak
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
    """Least squares over weights that are not negative and sum to 1: drop the most negative weight, solve again."""
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
    """Directions drawn from the lobe of every level, on a device."""

    directions: wp.array2d[wp.vec4]
    """(levels, S): local direction, the lobe's axis along +z, and the level of the pyramid to read."""
    weights: wp.array2d[wp.float32]
    """(levels, S): weight of each; those of a level sum to 1."""


# Filtered importance sampling [KC08]: S directions drawn from the lobe, each read from the level of an isotropic
# pyramid whose texel covers the direction's share 1 / (S pdf) of the sphere: m = log2(share / T_0^2) / 2 + bias.
# GGX is that of a surface seen from straight ahead, its normal the axis: half vectors are drawn by D cos, which gives
# cos^2 = (1 - u) / (1 - u + alpha^2 u), directions then have pdf D / 4, and count by n.l [Karis13].
# Directions are a Hammersley set in the frame of theta and phi, the same for every texel of a level: no noise between
# neighbours, no flicker between frames.
def make_lobe_samples(height: int, lobe: Lobe, count: int, device: wp.DeviceLike) -> LobeSamples:
    """Draw ``count`` directions for every level; level 0 gets the mirror direction.

    Args:
        height: Rows of the environment; it has twice as many columns.
        lobe: ``ggx`` or ``phong``.
        count: Samples per texel.
        device: Where the samples live.
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
        # A few directions do not balance: turned until their mean lies on the axis, or reflections would be shifted.
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
    """Rows of all levels together."""
    return sum(lobe_size(height, level)[0] for level in range(lobe_count(height)))
