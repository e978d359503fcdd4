"""Irradiance of a latlong environment on surfaces of any orientation n.

    E(n) = integral of L(w) max(n.w, 0) dw;   a constant L gives E = pi L.

The result has two forms. *Spherical harmonics*: E(n) = sum_i c_i Y_i(n) with the real orthonormal basis in the order
l = 0; l = 1: y, z, x; l = 2: xy, yz, 3z^2 - 1, xz, x^2 - y^2; the cosine lobe is part of c. *Map*: a small latlong map
of E, sampled with ``latlong.sample_latlong``.

Projection. [RH01] eq. 8: c_lm = A_l L_lm with L_lm = integral of L Y_lm and A = pi, 2 pi/3, pi/4, 0, -pi/24. A texel's
radiance is constant, so its integral is a closed form, and a separable one: with Y_lm = N P_lm(cos theta) times cos m
phi or sin |m| phi,

    L_lm = sum over rows [integral of N P_lm(cos theta) sin theta dtheta]
           sum over columns L [integral of cos m phi dphi].

The column integrals for all m are Fourier sums of a row, the row integrals one number per (row, l, |m|). Both are
tables, made once in double precision. There is no quadrature error: of a constant map only the first coefficient is
not zero. Sums run in a fixed order (a tile per row, then a tile per coefficient), so the same input gives the same
bits.

Positivity. A small emitter of flux F has the order-2 irradiance F (1/4 + x/2 + 5/32 (3 x^2 - 1)), x = cos angle, which
falls to -0.04 F at x = -8/15. As in [Sloan17], the coefficients are smoothed by a window with the least strength s that
leaves no negative direction, found from the minimum of E. One s serves the three channels, so that no hue shifts; s = 0
if E is nowhere negative. The mean is not changed, so energy is kept. The window of [Sloan17], 1 / (1 + s l^2 (l +
1)^2), needs w_2 = 0.13 and w_1 = 0.57 for the emitter above. The window (w_1, w_2) causes the mean squared error
(1 - w_1)^2 / 12 + (1 - w_2)^2 / 51, in F^2. On the border of positivity, w_1^2 = w_2 (1/4 - 5/32 w_2) 15/2, that error
is least at (0.86, 0.90). The family of windows used here contains this point and the identity, and tends to the mean:

    w_1 = 1 / (1 + s),  w_2 = 1 / (1 + 0.7 s).

E is a quadratic on the sphere,

    E_s(n) = w_2 n'Q n + 2 w_1 b'n + c,

whose minimum comes from its dual (strong for one quadratic constraint, the S-lemma): with eigenvalues q_i of Q and b in
its eigenvectors' frame

    min E_s = max over mu <= w_2 min q of   c + mu - sum_i (w_1 b_i)^2 / (w_2 q_i - mu),

concave in mu. The window scales the eigenvalues and keeps the eigenvectors, so one eigen-decomposition per channel
serves the whole bisection over s. Evaluation clamps small negative values from rounding to zero.

Clusters. The sum over all texels takes texels times directions terms. Irradiance is smooth, so nearby texels may share
a direction: a block of texels becomes one distant light with their summed flux and their mean direction m, weighted by
brightness. As n.w is linear in w, a block that lies wholly above the horizon contributes its exact irradiance. For a
block on the horizon, max(n.w, 0) is averaged over the spread of its directions. With their covariance C, n.w has the
variance n'C n; a box of that variance has the half width h = sqrt(3 n'C n), so

    mean of max(x, 0) over [c - h, c + h] = (c + h)^2 / (4 h) for |c| < h,  c = n.m.

The result is never negative, keeps the energy and does not jump as an emitter moves. Blocks of one texel are the most
accurate form: C holds the texel's own extent, so that a white furnace stays white for maps of any size.

References:
    [RH01] Ramamoorthi, Hanrahan 2001, An Efficient Representation for Irradiance Environment Maps.
    [Sloan17] Sloan 2017, Deringing Spherical Harmonics, SIGGRAPH Asia technical briefs.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import warp as wp

from warp_ar.kernels.launch import Rows, launch, launch_tiles, row_launcher, tile_kernel
from warp_ar.kernels.safe_math import safe_radiance

wp.set_module_options({"enable_backward": False})

PI = wp.constant(wp.float32(math.pi))
BLOCK = 64  # threads that share one sum on CUDA; on CPU it is one thread
WINDOW_STEPS = wp.constant(24)
DUAL_STEPS = wp.constant(32)
ORDER = 2
"""Highest l of the spherical harmonics."""


@dataclasses.dataclass(frozen=True)
class ShTables:
    """Integrals of the basis over rows and columns of a map, on a device."""

    columns: wp.array2d[wp.float32]
    """Integrals over each column of 1, cos phi, sin phi, cos 2 phi, sin 2 phi, (W, 5)."""
    rows: wp.array2d[wp.float32]
    """A_l times the integral over each row of N P_lm(cos theta) sin theta, (H, 9)."""
    fourier: wp.array[wp.int32]
    """Index of the column integral of each coefficient, (9,)."""


def cosine_lobe(l: int) -> float:
    """Return A_l of the clamped cosine, [RH01] eq. 7: pi, 2 pi/3, pi/4, 0, -pi/24 ..."""
    if l == 1:
        return 2.0 * math.pi / 3.0
    if l % 2:
        return 0.0
    half = l // 2
    return (
        2.0 * math.pi * (-1.0) ** (half - 1 if l else 0) / ((l + 2) * (l - 1 if l else 1)) * math.comb(l, half) / 2.0**l
    )


def basis_row(l: int, m: int, z: np.ndarray) -> np.ndarray:
    """Return N P_l|m|(z) of the real orthonormal basis, float64, without the Condon-Shortley sign.

    The factor sqrt 2 of m != 0 is part of N.

    Args:
        l: Degree.
        m: Order, -l to l.
        z: cos theta, any shape.
    """
    m = abs(m)
    legendre = np.polynomial.legendre.Legendre.basis(l).deriv(m) if m else np.polynomial.legendre.Legendre.basis(l)
    norm = math.sqrt((2 * l + 1) / (4.0 * math.pi) * math.factorial(l - m) / math.factorial(l + m) * (2 if m else 1))
    return norm * (1.0 - z * z) ** (m / 2.0) * legendre(z)


def make_sh_tables(height: int, width: int, device: wp.DeviceLike) -> ShTables:
    """Return the tables for maps of one size, computed in double precision.

    Args:
        height: Rows of the map.
        width: Columns of the map.
        device: Device of the tables.
    """
    edges = (2.0 * np.arange(width + 1) / width - 1.0) * np.pi
    columns = [np.diff(edges)]
    for k in range(1, ORDER + 1):
        columns += [np.diff(np.sin(k * edges)) / k, -np.diff(np.cos(k * edges)) / k]
    # Gauss-Legendre over each row in theta: the integrands are trigonometric polynomials of low degree, exact to
    # rounding.
    nodes, weights = np.polynomial.legendre.leggauss(16)
    half = 0.5 * np.pi / height
    theta = (2.0 * np.arange(height)[:, None] + 1.0 + nodes[None, :]) * half
    measure = np.sin(theta) * weights * half
    rows, fourier = [], []
    for l in range(ORDER + 1):
        for m in range(-l, l + 1):
            rows.append(cosine_lobe(l) * (basis_row(l, m, np.cos(theta)) * measure).sum(1))
            fourier.append(0 if m == 0 else 2 * m - 1 if m > 0 else -2 * m)
    return ShTables(
        wp.array(np.stack(columns, 1).astype(np.float32), dtype=wp.float32, device=device),
        wp.array(np.stack(rows, 1).astype(np.float32), dtype=wp.float32, device=device),
        wp.array(np.array(fourier, np.int32), dtype=wp.int32, device=device),
    )


# Factors: sqrt(1 / 4 pi), sqrt(3 / 4 pi), and for l = 2 sqrt(15 / 4 pi), sqrt(5 / 16 pi), sqrt(15 / 16 pi).
@wp.func
def sum_sh2(coefficients: wp.array[wp.vec3], d: wp.vec3) -> wp.vec3:
    """Return the sum of the first nine harmonics in a unit direction, weighted by their coefficients."""
    x = d[0]
    y = d[1]
    z = d[2]
    total = coefficients[0] * 0.28209479
    total += (coefficients[1] * y + coefficients[2] * z + coefficients[3] * x) * 0.48860251
    total += (coefficients[4] * (x * y) + coefficients[5] * (y * z) + coefficients[7] * (x * z)) * 1.09254843
    total += coefficients[6] * (0.31539157 * (3.0 * z * z - 1.0)) + coefficients[8] * (0.54627422 * (x * x - y * y))
    return total


@wp.func
def sh_irradiance(irradiance_sh: wp.array[wp.vec3], normal: wp.vec3) -> wp.vec3:
    """Return the irradiance on a surface with unit ``normal`` from nine coefficients, clamped to 0."""
    total = sum_sh2(irradiance_sh, normal)
    return wp.vec3(wp.max(total[0], 0.0), wp.max(total[1], 0.0), wp.max(total[2], 0.0))


@tile_kernel
def sum_columns_kernel(
    # In:
    environment: wp.array2d[wp.vec3],
    columns: wp.array2d[wp.float32],
    # Out:
    row_sums_out: wp.array2d[wp.vec3],
):
    """Compute one Fourier sum of one row of radiance; one block of threads computes one sum."""
    i, k, lane = wp.tid()
    total = wp.vec3()
    for j in range(lane, environment.shape[1], wp.block_dim()):
        total += safe_radiance(environment[i, j]) * columns[j, k]
    sums = wp.tile_sum(wp.tile(total, preserve_type=True))
    if lane == 0:
        row_sums_out[i, k] = sums[0]


@tile_kernel
def sum_rows_kernel(
    # In:
    row_sums: wp.array2d[wp.vec3],
    rows: wp.array2d[wp.float32],
    fourier: wp.array[wp.int32],
    # Out:
    irradiance_sh_out: wp.array[wp.vec3],
):
    """Compute one coefficient of the irradiance from the sums of all rows, by one block of threads."""
    c, lane = wp.tid()
    total = wp.vec3()
    for i in range(lane, row_sums.shape[0], wp.block_dim()):
        total += row_sums[i, fourier[c]] * rows[i, c]
    sums = wp.tile_sum(wp.tile(total, preserve_type=True))
    if lane == 0:
        irradiance_sh_out[c] = sums[0]


@wp.func
def sphere_minimum(q: wp.vec3, b: wp.vec3, c: wp.float32) -> wp.float32:
    """Return the minimum of c + 2 b.n + sum q_i n_i^2 over unit n, by bisection on the slope of its concave dual.

    mu lies in [q_min - |b|, q_min]: at the lower end sum b_i^2 / (q_i - mu)^2 <= 1, so the dual's slope is >= 0 there.
    """
    high = wp.min(q[0], wp.min(q[1], q[2]))
    low = high - wp.length(b)
    best = wp.float32(low)
    for _ in range(DUAL_STEPS):
        mu = 0.5 * (low + high)
        slope = wp.float32(1.0)
        for i in range(3):
            ratio = b[i] / wp.max(q[i] - mu, 1.0e-30)
            slope -= ratio * ratio
        if slope > 0.0:
            low = mu
        else:
            high = mu
        best = low
    value = c + best
    for i in range(3):
        value -= b[i] * b[i] / wp.max(q[i] - best, 1.0e-30)
    return value


@wp.func
def sh_window(strength: wp.float32) -> wp.vec2:
    """Return the window's factors on the coefficients of l = 1 and l = 2."""
    return wp.vec2(1.0 / (1.0 + strength), 1.0 / (1.0 + 0.7 * strength))


# n'Q n is the sum of the five terms of l = 2 on the unit sphere: each of Q's two entries for a product such as x y is
# 1.0925 c / 2, and 3 z^2 - 1 is written as 2 z^2 - x^2 - y^2. 2 b'n is the sum of the three terms of l = 1. All values
# are divided by the mean, so that c = 1.
@wp.kernel(enable_backward=False)
def window_sh_kernel(
    # Out (and in: coefficients as projected):
    irradiance_sh_out: wp.array[wp.vec3],
):
    """Apply the weakest window to nine coefficients that makes the irradiance of no direction negative."""
    scale = irradiance_sh_out[0] * 0.28209479  # mean irradiance; minima are compared relative to it
    strength = wp.float32(0.0)
    for channel in range(3):
        mean = scale[channel]
        if mean > 0.0:
            inverse = 1.0 / mean
            c4 = irradiance_sh_out[4][channel] * inverse * 0.54627422
            c5 = irradiance_sh_out[5][channel] * inverse * 0.54627422
            c6 = irradiance_sh_out[6][channel] * inverse * 0.31539157
            c7 = irradiance_sh_out[7][channel] * inverse * 0.54627422
            c8 = irradiance_sh_out[8][channel] * inverse * 0.54627422
            quadratic = wp.mat33(c8 - c6, c4, c7, c4, -c8 - c6, c5, c7, c5, 2.0 * c6)
            linear = wp.vec3(
                irradiance_sh_out[3][channel], irradiance_sh_out[1][channel], irradiance_sh_out[2][channel]
            ) * (0.5 * 0.48860251 * inverse)
            axes, q = wp.eig3(quadratic)
            b = wp.transpose(axes) * linear
            w = sh_window(strength)
            if sphere_minimum(q * w[1], b * w[0], 1.0) < 0.0:
                # The previous channels' strength is too small. Search between it and 16, where almost only the mean is
                # left.
                low = strength
                high = wp.float32(16.0)
                for _ in range(WINDOW_STEPS):
                    middle = 0.5 * (low + high)
                    w = sh_window(middle)
                    if sphere_minimum(q * w[1], b * w[0], 1.0) < 0.0:
                        low = middle
                    else:
                        high = middle
                strength = high
    w = sh_window(strength)
    for i in range(1, 9):
        irradiance_sh_out[i] = irradiance_sh_out[i] * w[wp.where(i > 3, 1, 0)]


@wp.func
def texel_direction(i: wp.int32, j: wp.int32, height: wp.int32, width: wp.int32) -> wp.vec3:
    """Return the direction of a texel's centre."""
    theta = PI * (wp.float32(i) + 0.5) / wp.float32(height)
    phi = (2.0 * (wp.float32(j) + 0.5) / wp.float32(width) - 1.0) * PI
    sin_theta = wp.sin(theta)
    return wp.vec3(sin_theta * wp.cos(phi), sin_theta * wp.sin(phi), wp.cos(theta))


@wp.struct
class Cluster:
    """Distant light that stands for a block of texels."""

    flux: wp.vec3  # sum of radiance times solid angle
    direction: wp.vec3  # mean direction, weighted by brightness; shorter than 1
    variance: wp.vec3  # covariance of the block's directions: xx, yy, zz
    covariance: wp.vec3  # covariance of the block's directions: yz, xz, xy


# Moments of a texel's directions (r cos phi, r sin phi, z), r = sin, z = cos of the polar angle, from t0 to t1 with the
# middle t and half the height h. Means weigh by sin, whose integral is c0 - c1 = 2 sin t sin h; c and s are the cosines
# and sines of t0 and t1, and s1 - s0 = 2 cos t sin h:
#
#     mean z  = (s1^2 - s0^2) / 2 / (c0 - c1)   = cos t cos h
#     mean z^2 = (c0^3 - c1^3) / 3 / (c0 - c1)  = (c0^2 + c0 c1 + c1^2) / 3,      mean r^2 = 1 - mean z^2
#     mean r z = (s1^3 - s0^3) / 3 / (c0 - c1)  = cos t / sin t (s0^2 + s0 s1 + s1^2) / 3
#     mean r  = (h - sin 2h cos 2t / 2) / (c0 - c1)  = sin t cos h + (2h - sin 2h) / (4 sin t sin h).
#
# Over a column of half width g, the mean of cos phi is sin g / g times its value in the middle, and the mean of
# cos 2 phi is sin 2g / 2g times its value there; cos^2 phi = (1 + cos 2 phi) / 2, cos phi sin phi = sin 2 phi / 2.
@wp.kernel(enable_backward=False)
def gather_clusters_kernel(
    row_start: wp.int32,
    # In:
    environment: wp.array2d[wp.vec3],
    blocks: wp.vec2i,
    # Out:
    clusters_out: wp.array[Cluster],
):
    """Write the distant light (``Cluster``) that stands for one block of texels."""
    bi, bj = wp.tid()
    bi += row_start
    height = environment.shape[0]
    width = environment.shape[1]
    flux = wp.vec3()
    moment = wp.vec3()
    squares = wp.vec3()
    products = wp.vec3()
    weight = wp.float32(0.0)
    half_step = 0.5 * PI / wp.float32(height)
    half_column = PI / wp.float32(width)
    sin_half = wp.sin(half_step)
    cos_half = wp.cos(half_step)
    # 2 half_step - sin(2 half_step), by its series for small steps, where the difference would cancel.
    step = 2.0 * half_step
    arc_excess = step - wp.sin(step)
    if step < 0.5:
        arc_excess = step * step * step / 6.0 * (1.0 - step * step / 20.0 * (1.0 - step * step / 42.0))
    # Means of cos phi and cos 2 phi over a column, relative to their centre's.
    single = wp.sin(half_column) / half_column
    double = wp.sin(2.0 * half_column) / (2.0 * half_column)
    for i in range(bi * height / blocks[0], (bi + 1) * height / blocks[0]):
        theta = (2.0 * wp.float32(i) + 1.0) * half_step
        sin_theta = wp.sin(theta)
        cos_theta = wp.cos(theta)
        solid_angle = 4.0 * sin_theta * sin_half * half_column
        # Exact moments of z and of r = sqrt(x^2 + y^2) over the row, from its edges' sines and cosines.
        s0 = sin_theta * cos_half - cos_theta * sin_half
        s1 = sin_theta * cos_half + cos_theta * sin_half
        c0 = cos_theta * cos_half + sin_theta * sin_half
        c1 = cos_theta * cos_half - sin_theta * sin_half
        mean_z = cos_theta * cos_half
        mean_r = sin_theta * cos_half + arc_excess / (4.0 * sin_theta * sin_half)
        mean_zz = (c0 * c0 + c0 * c1 + c1 * c1) / 3.0
        mean_rz = cos_theta / sin_theta * (s0 * s0 + s0 * s1 + s1 * s1) / 3.0
        mean_rr = 0.5 * (1.0 - mean_zz)
        for j in range(bj * width / blocks[1], (bj + 1) * width / blocks[1]):
            phi = (2.0 * wp.float32(j) + 1.0) * half_column - PI
            cos_phi = wp.cos(phi)
            sin_phi = wp.sin(phi)
            x = single * cos_phi
            y = single * sin_phi
            cos_two = double * (cos_phi * cos_phi - sin_phi * sin_phi)
            sin_two = double * 2.0 * cos_phi * sin_phi
            radiance = safe_radiance(environment[i, j]) * solid_angle
            brightness = radiance[0] + radiance[1] + radiance[2]
            flux += radiance
            weight += brightness
            moment += wp.vec3(mean_r * x, mean_r * y, mean_z) * brightness
            squares += wp.vec3(mean_rr * (1.0 + cos_two), mean_rr * (1.0 - cos_two), mean_zz) * brightness
            products += wp.vec3(mean_rz * y, mean_rz * x, mean_rr * sin_two) * brightness
    inverse = 1.0 / wp.max(weight, 1.0e-30)
    mean = moment * inverse
    cluster = Cluster()
    cluster.flux = flux
    cluster.direction = mean
    cluster.variance = squares * inverse - wp.cw_mul(mean, mean)
    cluster.covariance = products * inverse - wp.vec3(mean[1] * mean[2], mean[0] * mean[2], mean[0] * mean[1])
    clusters_out[bi * blocks[1] + bj] = cluster


# n'C n is at most the trace of C, so h is at most sqrt(3 trace). For larger |c| no product with C is needed.
@wp.func
def cluster_cosine(cluster: Cluster, normal: wp.vec3) -> wp.float32:
    """Return the mean of max(n.w, 0) over a cluster: exact above the horizon, by a box of equal variance on it."""
    cosine = wp.dot(cluster.direction, normal)
    total = wp.max(cluster.variance[0] + cluster.variance[1] + cluster.variance[2], 1.0e-8)
    if cosine * cosine >= 3.0 * total:
        return wp.max(cosine, 0.0)
    squares = wp.cw_mul(normal, normal)
    products = wp.vec3(normal[1] * normal[2], normal[0] * normal[2], normal[0] * normal[1])
    variance = wp.dot(cluster.variance, squares) + 2.0 * wp.dot(cluster.covariance, products)
    half_width = wp.sqrt(3.0 * wp.max(variance, 1.0e-10))
    if cosine >= half_width:
        return cosine
    reach = wp.max(cosine + half_width, 0.0)
    return reach * reach / (4.0 * half_width)


@tile_kernel
def sum_clusters_kernel(
    row_start: wp.int32,
    # In:
    clusters: wp.array[Cluster],
    # Out:
    irradiance_map_out: wp.array2d[wp.vec3],
):
    """Sum the irradiance of one direction over all clusters, by one block of threads."""
    i, j, lane = wp.tid()
    i += row_start
    normal = texel_direction(i, j, irradiance_map_out.shape[0], irradiance_map_out.shape[1])
    total = wp.vec3()
    # Partial sums of 256 terms keep the error of float32 within 1e-5 over 100,000 terms.
    part = wp.vec3()
    count = wp.int32(0)
    for k in range(lane, clusters.shape[0], wp.block_dim()):
        part += clusters[k].flux * cluster_cosine(clusters[k], normal)
        count += 1
        if count == 256:
            total += part
            part = wp.vec3()
            count = 0
    sums = wp.tile_sum(wp.tile(total + part, preserve_type=True))
    if lane == 0:
        irradiance_map_out[i, j] = sums[0]


def project_irradiance_sh(
    environment: wp.array2d[wp.vec3],
    tables: ShTables,
    row_sums_out: wp.array2d[wp.vec3],
    irradiance_sh_out: wp.array[wp.vec3],
) -> None:
    """Write the irradiance coefficients of a map: exact integrals over its texels with the cosine lobe, no window.

    Args:
        environment: Radiance, (H, W).
        tables: Tables for maps of this size.
        row_sums_out: Temporary array, (H, 5).
        irradiance_sh_out: Coefficients, (9,).
    """
    launch_tiles(sum_columns_kernel, row_sums_out.shape, [environment, tables.columns], [row_sums_out], block_dim=BLOCK)
    launch_tiles(
        sum_rows_kernel,
        irradiance_sh_out.shape,
        [row_sums_out, tables.rows, tables.fourier],
        [irradiance_sh_out],
        block_dim=BLOCK,
    )


def window_sh(irradiance_sh_out: wp.array[wp.vec3]) -> None:
    """Apply the weakest window to nine coefficients, (9,), in place, that makes irradiance nowhere negative."""
    launch(window_sh_kernel, dim=1, outputs=[irradiance_sh_out])


gather_clusters = row_launcher(gather_clusters_kernel, like=lambda environment, blocks, clusters: blocks)
"""Write the distant lights that stand for blocks of texels.

Args:
    environment: Radiance, (H, W).
    blocks: Numbers of blocks along rows and columns, at most (H, W).
    clusters_out: Distant lights, (blocks[0] blocks[1],).
"""


def sum_clusters(
    clusters: wp.array[Cluster], irradiance_map_out: wp.array2d[wp.vec3], *, rows: Rows | None = None
) -> None:
    """Write a latlong map of the irradiance from distant lights.

    Args:
        clusters: Distant lights as written by ``gather_clusters``, (N,).
        irradiance_map_out: Irradiance, (h, w).
        rows: Band of the map's rows; None means all.
    """
    launch_tiles(
        sum_clusters_kernel,
        irradiance_map_out.shape,
        [clusters],
        [irradiance_map_out],
        block_dim=BLOCK,
        rows=rows if rows is not None else (0, irradiance_map_out.shape[0]),
    )
