"""Glossy reflections of a latlong environment: one map per lobe, from mirror to the widest, for a shader to blend.

Levels. Level 0 is the environment itself (a mirror). Level l >= 1 holds the environment averaged with a lobe of width

    alpha_l = 2^(l - L),  l = 1 .. L,

L such that the narrowest is about three texels of the map wide (full width at half maximum). Between levels,
``level_from_alpha`` is linear in log2 alpha: that lies between the blend with the least squared error and the one with
the best encircled energy, for both lobes and all widths. A wider lobe needs fewer texels: level l has (H >> s, 2 H >>
s) with s = max(l - 2, 0), which leaves eight texels per unit of alpha, bilinear error below 2 % of a single emitter's
peak. All levels lie in one packed ``wp.array[wp.vec3]``, row-major, one after another.

Lobes, about the mirror direction R, cos theta = R.w, each normalised by its own sum so that a constant environment
stays constant:

    GGX with N = V = R, as split-sum shading takes it [Karis13], alpha = roughness^2, c = cos theta:
    D(half vector) c ~ c / ((1 - c) / 2 + alpha^2 (1 + c) / 2)^2.
    At alpha = 1 it is the plain cosine: roughness 1 reflects irradiance / pi.
    Phong:  cos^n theta with n = 1 / alpha^2. At alpha = 1 it is the plain cosine as well; exponents below 1 act as 1.
    The variance per axis of a narrow Phong lobe is 1 / n = alpha^2: both lobes are about as wide at equal alpha.

Ways to fill the levels, cheapest first.

Box mips: level l is level l of a box pyramid, magnified bilinearly: the paper's filter. Its texel is 1.6 alpha wide.

Mixed mips: level l is a sum of several levels m of an isotropic pyramid, sum_m w_lm mip_m with w >= 0 and sum w = 1,
each read through quadratic B-splines. A box mip read so blurs with variance sigma_m^2 = (T_m^2 - T_0^2) / 12 + T_m^2 /
4 per axis, T_m = pi / H_m: the box and the spline; mip 0 is read as it is. On the sphere that is close to exp(-k (k +
1) sigma_m^2 / 2) in degree k. The weights minimise the expected squared error

    sum_k (2 k + 1) S_k (K_k - sum_m w_lm B_mk)^2,   S_k = 1 / (k + 1/2)^2,

K_k the lobe's zonal coefficients (K_0 = 1) and S_k the power per coefficient of natural scenes. A single level with the
lobe's second moment would do for Phong; GGX has tails so long that its moment grows without bound as alpha falls, and a
single box cannot have peak and tails. Each level is then scaled, per channel, to hold exactly the energy of the
environment.

Filtered importance sampling [KC08]: S directions drawn from the lobe, each read from the level of an isotropic pyramid
whose texel covers the direction's share 1 / (S pdf) of the sphere: m = log2(share / T_0^2) / 2 + bias. Directions are a
Hammersley set in the frame of theta and phi, the same for every texel of a level: no noise between neighbours, no
flicker between frames. Scaled to the energy as above.

Brute force: every texel of the environment weighted by its solid angle and the lobe. The reference.

Split sum. ``sample_dfg`` returns (scale, bias): the specular reflectance of the GGX surface under a white sky is F0
scale + bias [Karis13]. One scattering loses energy on rough surfaces; ``energy_compensation`` puts it back: a white
metal keeps a white furnace white.

References:
    [AG02] Ashikhmin, Ghosh 2002, Simple Blurry Reflections with Environment Maps.
    [KC08] Krivanek, Colbert 2008, Real-time Shading with Filtered Importance Sampling.
    [Karis13] Karis 2013, Real Shading in Unreal Engine 4.
    [MS16] Manson, Sloan 2016, Fast Filtering of Reflection Probes: levels of a pyramid combined with fitted weights.
    [Turquin19] Turquin 2019, Practical Multiple Scattering Compensation for Microfacet Models.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

import numpy as np
import warp as wp

from warp_ar.kernels.guards import safe_radiance
from warp_ar.kernels.latlong import latlong_from_direction, texel_solid_angle
from warp_ar.kernels.launch import Rows, launch, launch_rows, launch_tiles, tile_kernel
from warp_ar.kernels.pyramid import level_count, sample_packed, sample_packed_smooth
from warp_ar.kernels.sampling import ggx_masking, ggx_masking_shadowing, hammersley, sample_ggx_visible

wp.set_module_options({"enable_backward": False})

PI = wp.constant(wp.float32(math.pi))
BLOCK = 64
LARGE_LEVELS = wp.constant(3)
"""Levels that have as many texels as the environment, if there are so many at all."""
# How much coarser a level of the pyramid is read than the bare share of a sample asks for: samples then overlap, as
# [KC08] advise. Between 0, best for smooth skies, and 0.5, best for small emitters, by error against brute force.
SAMPLE_BIAS = 0.25
# An energy correction beyond this factor would be a fault, not a correction.
MAX_CORRECTION = wp.constant(wp.float32(4.0))

Lobe = Literal["ggx", "phong"]


# --- Where levels lie -------------------------------------------------------------------------------------------------


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


def mixed_texels(height: int) -> int:
    """Work items of ``mix_mips``: levels that are as large as level 0 are written along with it."""
    return lobe_texels(height) - (min(LARGE_LEVELS, lobe_count(height)) - 1) * 2 * height**2


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


# --- Lobes in numbers, made once in double precision ------------------------------------------------------------------


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


# --- Kernels ----------------------------------------------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def mix_mips_kernel(
    row_start: wp.int32,
    # In:
    pyramid: wp.array[wp.vec3],
    weights: wp.array2d[wp.float32],
    height: wp.int32,
    smooth: wp.int32,
    # Out:
    levels_out: wp.array[wp.vec3],
):
    """One texel from the levels of a pyramid, where levels are equally large one of each; no trigonometry is needed.

    What several levels read of a mip at the same place is read once.
    """
    index = wp.tid() + row_start
    texels = height * 2 * height
    at = wp.vec4i(0, index / (2 * height), index % (2 * height), 0)
    if index >= texels:
        at = locate_texel(index + (LARGE_LEVELS - 1) * texels, height)
    level = at[0]
    h = height >> wp.max(level - 2, 0)
    w = 2 * height >> wp.max(level - 2, 0)
    v = (wp.float32(at[1]) + 0.5) / wp.float32(h)
    u = (wp.float32(at[2]) + 0.5) / wp.float32(w)
    total = wp.vec3()
    total_1 = wp.vec3()
    total_2 = wp.vec3()
    offset = wp.int32(0)
    for m in range(weights.shape[1]):
        mip_height = height >> m
        mip_width = 2 * height >> m
        weight = weights[level, m]
        weight_1 = wp.float32(0.0)
        weight_2 = wp.float32(0.0)
        if level == 0:
            weight_1 = weights[1, m]
            if weights.shape[0] > 2:
                weight_2 = weights[2, m]
        if weight + weight_1 + weight_2 > 0.0:
            row = v * wp.float32(mip_height)
            column = u * wp.float32(mip_width)
            value = wp.vec3()
            if smooth != 0 and m > 0:
                value = sample_packed_smooth(pyramid, offset, mip_height, mip_width, row, column)
            else:
                value = sample_packed(pyramid, offset, mip_height, mip_width, row, column)
            total += value * weight
            total_1 += value * weight_1
            total_2 += value * weight_2
        offset += mip_height * mip_width
    if level > 0:
        levels_out[index + (LARGE_LEVELS - 1) * texels] = total
        return
    levels_out[index] = total
    levels_out[index + texels] = total_1
    if weights.shape[0] > 2:
        levels_out[index + 2 * texels] = total_2


@wp.kernel(enable_backward=False)
def sample_lobes_kernel(
    row_start: wp.int32,
    # In:
    pyramid: wp.array[wp.vec3],
    directions: wp.array2d[wp.vec4],
    weights: wp.array2d[wp.float32],
    height: wp.int32,
    # Out:
    levels_out: wp.array[wp.vec3],
):
    """One packed texel by filtered importance sampling."""
    index = wp.tid() + row_start
    at = locate_texel(index, height)
    level = at[0]
    if level == 0:
        levels_out[index] = pyramid[index]
        return
    h = height >> wp.max(level - 2, 0)
    w = 2 * height >> wp.max(level - 2, 0)
    last = wp.int32(0)
    while (height >> (last + 1)) > 0:
        last += 1
    # By symmetry about z a texel's samples are those of longitude 0, turned by the texel's own: its column is added to
    # theirs.
    theta = PI * (wp.float32(at[1]) + 0.5) / wp.float32(h)
    sin_theta = wp.sin(theta)
    cos_theta = wp.cos(theta)
    turn = (wp.float32(at[2]) + 0.5) / wp.float32(w)
    total = wp.vec3()
    for s in range(directions.shape[1]):
        weight = weights[level, s]
        if weight > 0.0:
            local = directions[level, s]
            x = local[0] * cos_theta + local[2] * sin_theta
            z = local[2] * cos_theta - local[0] * sin_theta
            v = wp.atan2(wp.sqrt(x * x + local[1] * local[1]), z) / PI
            u = wp.atan2(local[1], x) / (2.0 * PI) + turn
            u = u - wp.floor(u)
            mip = wp.min(local[3], wp.float32(last))
            fine = wp.min(wp.int32(mip), wp.max(last - 1, 0))
            fraction = mip - wp.float32(fine)
            offset = wp.int32(0)
            for m in range(fine):
                offset += (height >> m) * (2 * height >> m)
            mh = height >> fine
            mw = 2 * height >> fine
            value = sample_packed(pyramid, offset, mh, mw, v * wp.float32(mh), u * wp.float32(mw))
            if fraction > 0.0:
                offset += mh * mw
                mh = height >> (fine + 1)
                mw = 2 * height >> (fine + 1)
                coarse = sample_packed(pyramid, offset, mh, mw, v * wp.float32(mh), u * wp.float32(mw))
                value = value * (1.0 - fraction) + coarse * fraction
            total += value * weight
    levels_out[index] = total


@wp.kernel(enable_backward=False)
def integrate_lobes_kernel(
    row_start: wp.int32,
    # In:
    environment: wp.array2d[wp.vec3],
    phong: wp.int32,
    # Out:
    levels_out: wp.array[wp.vec3],
):
    """One packed texel from every texel of the environment."""
    index = wp.tid() + row_start
    height = environment.shape[0]
    width = environment.shape[1]
    at = locate_texel(index, height)
    if at[0] == 0:
        levels_out[index] = safe_radiance(environment[at[1], at[2]])
        return
    h = height >> wp.max(at[0] - 2, 0)
    w = 2 * height >> wp.max(at[0] - 2, 0)
    alpha = 1.0 / wp.float32(1 << (last_lobe(height) - at[0]))
    exponent = 1.0 / (alpha * alpha)
    theta = PI * (wp.float32(at[1]) + 0.5) / wp.float32(h)
    sin_theta = wp.sin(theta)
    phi = 2.0 * PI * (wp.float32(at[2]) + 0.5) / wp.float32(w)
    total = wp.vec3()
    total_weight = wp.float32(0.0)
    for i in range(height):
        source_theta = PI * (wp.float32(i) + 0.5) / wp.float32(height)
        # 1 - cos of the angle between = 2 (sin^2(dtheta / 2) + sin sin sin^2(dphi / 2)): no cancellation in narrow
        # lobes.
        across = wp.sin(0.5 * (source_theta - theta))
        around = sin_theta * wp.sin(source_theta)
        row_total = wp.vec3()
        row_weight = wp.float32(0.0)
        for j in range(width):
            half_turn = wp.sin(0.5 * (2.0 * PI * (wp.float32(j) + 0.5) / wp.float32(width) - phi))
            versine = 2.0 * (across * across + around * half_turn * half_turn)
            cosine = 1.0 - versine
            if cosine > 0.0:
                weight = wp.float32(0.0)
                if phong != 0:
                    weight = wp.pow(cosine, exponent)
                else:
                    t = 0.5 * versine + 0.5 * alpha * alpha * (1.0 + cosine)
                    weight = cosine * (alpha * alpha) * (alpha * alpha) / (t * t)
                row_total += safe_radiance(environment[i, j]) * weight
                row_weight += weight
        solid_angle = texel_solid_angle(i, height, width)
        total += row_total * solid_angle
        total_weight += row_weight * solid_angle
    levels_out[index] = total / wp.max(total_weight, 1.0e-30)


@wp.func
def locate_row(row: wp.int32, height: wp.int32) -> wp.vec4i:
    """(level, row of the level, index of its first texel, 0) of the packed rows, counted through all levels."""
    level = wp.int32(0)
    first = wp.int32(0)
    offset = wp.int32(0)
    h = height
    while row >= first + h:
        offset += h * (2 * height >> wp.max(level - 2, 0))
        first += h
        level += 1
        h = height >> wp.max(level - 2, 0)
    return wp.vec4i(level, row - first, offset + (row - first) * (2 * height >> wp.max(level - 2, 0)), 0)


@tile_kernel
def sum_level_rows_kernel(
    # In:
    levels: wp.array[wp.vec3],
    height: wp.int32,
    # Out:
    row_energy_out: wp.array[wp.vec3],
):
    """Energy of one row of one level, by one block."""
    row, lane = wp.tid()
    at = locate_row(row, height)
    h = height >> wp.max(at[0] - 2, 0)
    w = 2 * height >> wp.max(at[0] - 2, 0)
    total = wp.vec3()
    for j in range(lane, w, wp.block_dim()):
        total += levels[at[2] + j]
    sums = wp.tile_sum(wp.tile(total, preserve_type=True))
    if lane == 0:
        row_energy_out[row] = sums[0] * texel_solid_angle(at[1], h, w)


@tile_kernel
def sum_levels_kernel(
    # In:
    row_energy: wp.array[wp.vec3],
    height: wp.int32,
    # Out:
    energy_out: wp.array[wp.vec3],
):
    """Energy of one level, by one block."""
    level, lane = wp.tid()
    first = wp.int32(0)
    for l in range(level):
        first += height >> wp.max(l - 2, 0)
    total = wp.vec3()
    for i in range(lane, height >> wp.max(level - 2, 0), wp.block_dim()):
        total += row_energy[first + i]
    sums = wp.tile_sum(wp.tile(total, preserve_type=True))
    if lane == 0:
        energy_out[level] = sums[0]


@wp.kernel(enable_backward=False)
def scale_levels_kernel(
    row_start: wp.int32,
    # In:
    energy: wp.array[wp.vec3],
    height: wp.int32,
    # Out (and in: levels as filtered):
    levels_out: wp.array[wp.vec3],
):
    """Scale every level to the energy of level 0."""
    index = wp.tid() + row_start
    level = locate_texel(index, height)[0]
    if level > 0:
        value = levels_out[index]
        for c in range(3):
            if energy[level][c] > 0.0:
                value[c] = value[c] * wp.clamp(energy[0][c] / energy[level][c], 1.0 / MAX_CORRECTION, MAX_CORRECTION)
        levels_out[index] = value


# --- Split sum --------------------------------------------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def integrate_dfg_kernel(
    # In:
    samples: wp.int32,
    # Out:
    dfg_out: wp.array2d[wp.vec2],
):
    """Scale and bias of F0 for one roughness (row) and one n_dot_v (column), both from 0 to 1 at the table's ends.

    With half vectors visible from wo, D and one masking cancel: the estimate is F(wo.wh) G2 / G1(wo) [Heitz14].
    """
    i, j = wp.tid()
    roughness = wp.float32(i) / wp.float32(dfg_out.shape[0] - 1)
    alpha = roughness * roughness
    # The limit at grazing view exists, the formulas do not like it.
    cos_theta = wp.max(wp.float32(j) / wp.float32(dfg_out.shape[1] - 1), 1.0e-3)
    wo = wp.vec3(wp.sqrt(1.0 - cos_theta * cos_theta), 0.0, cos_theta)
    masking = ggx_masking(wo, alpha)
    total = wp.vec2(0.0, 0.0)
    for s in range(samples):
        wh = sample_ggx_visible(hammersley(s, samples), wo, alpha)
        cosine = wp.clamp(wp.dot(wo, wh), 0.0, 1.0)
        wi = wh * (2.0 * cosine) - wo
        if wi[2] > 0.0:
            visibility = ggx_masking_shadowing(wi, wo, alpha) / masking
            m = 1.0 - cosine
            fresnel = m * m * m * m * m
            total += wp.vec2((1.0 - fresnel) * visibility, fresnel * visibility)
    dfg_out[i, j] = total / wp.float32(samples)


@wp.func
def sample_dfg(table: wp.array2d[wp.vec2], n_dot_v: wp.float32, roughness: wp.float32) -> wp.vec2:
    """(scale, bias) such that the specular reflectance under a white sky is F0 scale + bias.

    Args:
        table: (roughness, n_dot_v), as ``integrate_dfg`` writes.
        n_dot_v: Cosine between normal and viewer; clamped to [0, 1].
        roughness: Perceptual; clamped to [0, 1].
    """
    y = wp.clamp(roughness, 0.0, 1.0) * wp.float32(table.shape[0] - 1)
    x = wp.clamp(n_dot_v, 0.0, 1.0) * wp.float32(table.shape[1] - 1)
    i = wp.min(wp.int32(y), table.shape[0] - 2)
    j = wp.min(wp.int32(x), table.shape[1] - 2)
    fy = y - wp.float32(i)
    fx = x - wp.float32(j)
    top = table[i, j] * (1.0 - fx) + table[i, j + 1] * fx
    bottom = table[i + 1, j] * (1.0 - fx) + table[i + 1, j + 1] * fx
    return top * (1.0 - fy) + bottom * fy


@wp.func
def energy_compensation(dfg: wp.vec2, f0: wp.vec3) -> wp.vec3:
    """Factor on the specular part that adds what scatters more than once [Turquin19]: 1 + F0 (1 / E - 1).

    E = scale + bias is what a surface with F0 = 1 reflects after one scattering. Times this factor it reflects
    exactly 1: a white furnace stays white. The factor holds for environment light and virtual lights alike.
    """
    return wp.vec3(1.0, 1.0, 1.0) + f0 * (1.0 / wp.max(dfg[0] + dfg[1], 1.0e-3) - 1.0)


# --- Launchers --------------------------------------------------------------------------------------------------------


def mix_mips(
    pyramid: wp.array[wp.vec3],
    weights: wp.array2d[wp.float32],
    height: int,
    levels_out: wp.array[wp.vec3],
    *,
    smooth: bool = False,
    rows: Rows | None = None,
) -> None:
    """Fill all levels with weighted sums of a pyramid's levels.

    Args:
        pyramid: Pyramid of the (height, 2 height) environment, see ``pyramid.build_pyramid``.
        weights: (levels, mips): ``box_weights`` for the paper's filter, ``mip_weights`` for the fitted one.
        height: Rows of the environment.
        levels_out: (lobe_texels(height),).
        smooth: Read mips through quadratic B-splines, as the fitted weights expect; else bilinearly, as the paper does.
        rows: Band of ``mixed_texels``; None means all.
    """
    launch_rows(
        mix_mips_kernel,
        (mixed_texels(height),),
        [pyramid, weights, height, int(smooth)],
        [levels_out],
        rows=rows,
        device=pyramid.device,
    )


def box_weights(height: int) -> np.ndarray:
    """Weights for ``mix_mips`` that make level l of the pyramid level l of the reflections: the paper's filter."""
    weights = np.zeros((lobe_count(height), level_count(height, 2 * height)))
    for level in range(weights.shape[0]):
        weights[level, min(level, weights.shape[1] - 1)] = 1.0
    return weights


def sample_lobes(
    pyramid: wp.array[wp.vec3],
    samples: LobeSamples,
    height: int,
    levels_out: wp.array[wp.vec3],
    *,
    rows: Rows | None = None,
) -> None:
    """Fill all levels by filtered importance sampling.

    Args:
        pyramid: Isotropic pyramid of the (height, 2 height) environment.
        samples: For the same height.
        height: Rows of the environment.
        levels_out: (lobe_texels(height),).
        rows: Band of packed texels; None means all.
    """
    inputs = [pyramid, samples.directions, samples.weights, height]
    launch_rows(sample_lobes_kernel, levels_out.shape, inputs, [levels_out], rows=rows, device=pyramid.device)


def integrate_lobes(
    environment: wp.array2d[wp.vec3], lobe: Lobe, levels_out: wp.array[wp.vec3], *, rows: Rows | None = None
) -> None:
    """Fill all levels by summing over the whole environment: the reference.

    Args:
        environment: (H, 2 H) radiance.
        lobe: ``ggx`` or ``phong``.
        levels_out: (lobe_texels(H),).
        rows: Band of packed texels; None means all.
    """
    inputs = [environment, int(lobe == "phong")]
    launch_rows(integrate_lobes_kernel, levels_out.shape, inputs, [levels_out], rows=rows, device=environment.device)


def measure_energy(
    levels: wp.array[wp.vec3], height: int, row_energy_out: wp.array[wp.vec3], energy_out: wp.array[wp.vec3]
) -> None:
    """Energy of every level: the integral of radiance over the sphere, summed in a fixed order.

    Args:
        levels: (lobe_texels(height),).
        height: Rows of the environment.
        row_energy_out: (lobe_rows(height),) scratch.
        energy_out: (lobe_count(height),).
    """
    launch_tiles(
        sum_level_rows_kernel,
        row_energy_out.shape,
        [levels, height],
        [row_energy_out],
        block_dim=BLOCK,
        device=levels.device,
    )
    launch_tiles(
        sum_levels_kernel,
        energy_out.shape,
        [row_energy_out, height],
        [energy_out],
        block_dim=BLOCK,
        device=levels.device,
    )


def lobe_rows(height: int) -> int:
    """Rows of all levels together."""
    return sum(lobe_size(height, level)[0] for level in range(lobe_count(height)))


def scale_levels(
    energy: wp.array[wp.vec3], height: int, levels_out: wp.array[wp.vec3], *, rows: Rows | None = None
) -> None:
    """Scale every level, in place, to the energy of level 0.

    Args:
        energy: As ``measure_energy`` writes.
        height: Rows of the environment.
        levels_out: (lobe_texels(height),).
        rows: Band of packed texels; None means all.
    """
    launch_rows(
        scale_levels_kernel, levels_out.shape, [energy, height], [levels_out], rows=rows, device=levels_out.device
    )


def integrate_dfg(dfg_out: wp.array2d[wp.vec2], *, samples: int = 1024) -> None:
    """Fill the split-sum table; once, when a pipeline is built.

    Args:
        dfg_out: (R, V): roughness and n_dot_v from 0 to 1, at least (2, 2); 32 x 32 is what shading uses.
        samples: Directions per entry.
    """
    launch(integrate_dfg_kernel, dim=dfg_out.shape, inputs=[samples], outputs=[dfg_out], device=dfg_out.device)
