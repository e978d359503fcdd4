"""Glossy reflections of a latlong environment: one map per lobe, from the mirror to the widest lobe.

``kernels/environment/lobes.py`` defines the lobes and the layout of their maps (levels); ``kernels/split_sum.py`` holds
the other factor of the split sum. Three methods fill the levels, cheapest first:

Mixed mips (``mix_mips``): level l is a weighted sum of levels of an isotropic pyramid, each read through quadratic
B-splines. It is then scaled, per channel, to the energy of the environment.

Filtered importance sampling (``sample_lobes``) [KC08]: directions are sampled from the lobe, and each is read from a
level of an isotropic pyramid. The result is scaled as above.

Brute force (``integrate_lobes``): every texel of the environment is weighted by its solid angle and the lobe. This is
the most accurate method.

References:
    [AG02] Ashikhmin, Ghosh 2002, Simple Blurry Reflections with Environment Maps.
    [Karis13] Karis 2013, Real Shading in Unreal Engine 4.
    [KC08] Krivanek, Colbert 2008, Real-time Shading with Filtered Importance Sampling.
"""

from __future__ import annotations

import math

import warp as wp

from warp_ar.kernels.environment.lobes import last_lobe, locate_texel
from warp_ar.kernels.environment.pyramid import last_mip, sample_mips, sample_packed, sample_packed_smooth
from warp_ar.kernels.latlong import texel_solid_angle
from warp_ar.kernels.launch import launch_tiles, row_launcher, tile_kernel
from warp_ar.kernels.safe_math import safe_radiance

wp.set_module_options({"enable_backward": False})

PI = wp.constant(wp.float32(math.pi))
BLOCK = 64
# Largest factor of the energy correction; a larger one would indicate a fault.
MAX_CORRECTION = wp.constant(wp.float32(4.0))


@wp.kernel(enable_backward=False)
def mix_mips_kernel(
    row_start: wp.int32,
    # In:
    pyramid: wp.array[wp.vec3],
    weights: wp.array2d[wp.float32],
    height: wp.int32,
    # Out:
    levels_out: wp.array[wp.vec3],
):
    """Compute one packed texel as a weighted sum of a pyramid's levels."""
    index = wp.tid() + row_start
    at = locate_texel(index, height)
    level = at[0]
    v = (wp.float32(at[1]) + 0.5) / wp.float32(height >> wp.max(level - 2, 0))
    u = (wp.float32(at[2]) + 0.5) / wp.float32(2 * height >> wp.max(level - 2, 0))
    total = wp.vec3()
    offset = wp.int32(0)
    for m in range(weights.shape[1]):
        mip_height = height >> m
        mip_width = 2 * height >> m
        weight = weights[level, m]
        if weight > 0.0:
            row = v * wp.float32(mip_height)
            column = u * wp.float32(mip_width)
            if m > 0:
                total += weight * sample_packed_smooth(pyramid, offset, mip_height, mip_width, row, column)
            else:
                total += weight * sample_packed(pyramid, offset, mip_height, mip_width, row, column)
        offset += mip_height * mip_width
    levels_out[index] = total


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
    """Compute one packed texel by filtered importance sampling."""
    index = wp.tid() + row_start
    at = locate_texel(index, height)
    level = at[0]
    if level == 0:
        levels_out[index] = pyramid[index]
        return
    h = height >> wp.max(level - 2, 0)
    w = 2 * height >> wp.max(level - 2, 0)
    last = last_mip(height, 2 * height)
    # By symmetry about z, a texel's samples are the samples of longitude 0 rotated by the texel's longitude: its column
    # is added to theirs.
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
            total += sample_mips(pyramid, v, u, local[3], last, height, 2 * height) * weight
    levels_out[index] = total


# The GGX lobe is that of a surface viewed along its normal, weighted by n.l [Karis13]. For light at the angle w from
# the axis, the half vector is at w / 2, with sin^2 = (1 - cos w) / 2 and cos^2 = (1 + cos w) / 2, so
#
#     weight ~ cos w D(w / 2) ~ cos w alpha^4 / (sin^2 + alpha^2 cos^2)^2.
#
# The Phong lobe is cos^n w with n = 1 / alpha^2; near the axis both lobes fall as 1 - w^2 / (2 alpha^2).
@wp.kernel(enable_backward=False)
def integrate_lobes_kernel(
    row_start: wp.int32,
    # In:
    environment: wp.array2d[wp.vec3],
    phong: wp.bool,
    # Out:
    levels_out: wp.array[wp.vec3],
):
    """Compute one packed texel from all texels of the environment."""
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
        # 1 - cos of the angle between two directions is 2 (sin^2(dtheta / 2) + sin theta sin theta' sin^2(dphi / 2)),
        # without cancellation in narrow lobes.
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
                if phong:
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
    """Return (level, row in the level, index of the row's first texel, 0) of a row counted through all levels."""
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
    """Compute the energy of one row of one level, by one block of threads."""
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
    """Compute the energy of one level, by one block of threads."""
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
    """Scale one packed texel by the factor that gives its level the energy of level 0."""
    index = wp.tid() + row_start
    level = locate_texel(index, height)[0]
    if level > 0:
        value = levels_out[index]
        for c in range(3):
            if energy[level][c] > 0.0:
                value[c] = value[c] * wp.clamp(energy[0][c] / energy[level][c], 1.0 / MAX_CORRECTION, MAX_CORRECTION)
        levels_out[index] = value


mix_mips = row_launcher(mix_mips_kernel)
"""Fill all levels with weighted sums of a pyramid's levels, each read through quadratic B-splines.

Args:
    pyramid: Pyramid of the (height, 2 height) environment, see ``pyramid.build_pyramid``.
    weights: Weights of ``mip_weights``, (levels, mips).
    height: Rows of the environment.
    levels_out: Packed levels, (lobe_texels(height),).
"""


sample_lobes = row_launcher(sample_lobes_kernel)
"""Fill all levels by filtered importance sampling.

Args:
    pyramid: Isotropic pyramid of the (height, 2 height) environment.
    directions: Directions of ``make_lobe_samples`` for this height, (levels, S).
    weights: Weights of ``make_lobe_samples`` for this height, (levels, S).
    height: Rows of the environment.
    levels_out: Packed levels, (lobe_texels(height),).
"""


integrate_lobes = row_launcher(integrate_lobes_kernel)
"""Fill all levels by brute force, summing over the whole environment.

Args:
    environment: Radiance, (H, 2 H).
    phong: True for Phong lobes, False for GGX lobes.
    levels_out: Packed levels, (lobe_texels(H),).
"""


def measure_energy(
    levels: wp.array[wp.vec3], height: int, row_energy_out: wp.array[wp.vec3], energy_out: wp.array[wp.vec3]
) -> None:
    """Write the energy of every level: the integral of radiance over the sphere, summed in a fixed order.

    Args:
        levels: Packed levels, (lobe_texels(height),).
        height: Rows of the environment.
        row_energy_out: Temporary array, (lobe_rows(height),).
        energy_out: Energy of each level, (lobe_count(height),).
    """
    launch_tiles(sum_level_rows_kernel, row_energy_out.shape, [levels, height], [row_energy_out], block_dim=BLOCK)
    launch_tiles(sum_levels_kernel, energy_out.shape, [row_energy_out, height], [energy_out], block_dim=BLOCK)


scale_levels = row_launcher(scale_levels_kernel)
"""Scale every level, in place, to the energy of level 0.

Args:
    energy: Energy of each level as written by ``measure_energy``.
    height: Rows of the environment.
    levels_out: Packed levels, (lobe_texels(height),).
"""
