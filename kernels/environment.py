"""The environment over time, whole, and its dominant directions.

**Accumulation.** Every texel keeps a radiance m and a confidence k and is drawn toward what the current frame says, x
with confidence c:

    m += a (x - m),   a = a0 c / (a0 c + (1 - a0) k),   a0 = 1 - exp(-time_step / tau):

the plain exponential mean where c = k, quicker where the new view is the better one, slower where it is the worse, and
nothing at c = 0. A texel that was never seen takes x whole. The form m + a (x - m) is exact where x = m: nothing
drifts. k is drawn toward c in the same way and fades with ``FORGET_TIME``, so that what has not been seen for long
gives way to what is.

tau is ``FOLLOW_TIME`` and drops toward ``FOLLOW_TIME / HASTE`` where the light really changes. Noise and the jitter of
the tracked pose make large differences of both signs in single texels; a change of the environment moves a whole
neighbourhood one way, and stays. So the signed mean of x - m is taken over cells of ``CELL_SIZE`` texels squared, and
what counts is its smaller value in two successive frames of one sign: one corrupt frame is worth no haste, and is
forgotten as fast as it came.

**Filling.** What no ball shows is taken from its confident neighbours by push and pull [GGSC96]: down a pyramid go
means of radiance weighted by confidence and solid angle, up again each texel is completed from its coarser level, as
far as it lacks confidence. Both are normalised, and in forms that are exact for equal values: a constant environment
stays constant under any mask. Texels of a coarser level cover shares of finer ones by exact overlap, so every size
works. Without any confidence there is no light: the map is zero.

**Key lights.** With the mean radiance L0 of the map, a texel's excess max(lum L - lum L0, 0) is what makes it a light;
a uniform environment has none. Light k is where a surface would receive most of the excess that lights 0 .. k - 1 have
left
over: the best of the 8 x 16 cells' directions, moved to the centre of its lobe by mean shifts with ever narrower
kernels: all that faces it (whose fixed point is the maximum of that irradiance), cos^2, cos^8, the texels within
``LOBE_OUTER``; and at last to the centroid of what rises above ``CORE`` of the lobe's peak, where glow and scratches of
the ball do not pull at it. Starting broad keeps the centre of a window half a sky wide where it is.

A direction s dominates as far as the light's flow goes its way and no rival stands elsewhere. With V = integral of L d
and the scalar irradiance phi = integral of L, a surface with normal n receives E(n) = phi / 4 + n . V / 2 to first
order (the cosine lobe's first two bands, pi and 2 pi / 3), so facets toward and away from s differ by (E(s) - E(-s)) /
(E(s) + E(-s)) = 2 V . s / phi: the contrast that relief shows. It is 0 in a uniform environment and between two equal
opposite lights, 1 (held there) for a sun and still for a window that is half a black sky; a lamp that gives a share q
of the light of an otherwise uniform environment has 2 q. Where two lights are of one strength, which is the brighter is
an accident of noise, and a picture that follows it would flicker; the directionality

    D_k = clamp(2 V . s_k / phi, 0, 1) * min over j of (1 - min(1, E_j / E_k) min(1, 2 (1 - s_j . s_k)) valley_jk)

is 0 there if they are 60 degrees apart or more, and hardly less if they are neighbours, between which a change of place
is small. What is bright halfway between two directions too is one window, not two rivals: there the valley is 0.

References:
    [GGSC96] Gortler, Grzeszczuk, Szeliski, Cohen, "The Lumigraph", SIGGRAPH 1996, section 3.4.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import warp as wp

from warp_ar.kernels.latlong import PI, direction_from_latlong, texel_solid_angle, wrap_texel
from warp_ar.kernels.launch import Rows, launch, launch_rows, launch_tiles, wait_for_block
from warp_ar.kernels.structs import FrameParams, KeyLight

wp.set_module_options({"enable_backward": False})

FOLLOW_TIME = wp.constant(wp.float32(0.15))
"""Time constant of accumulation in seconds: after half a second 4 % of a small change are left."""
HASTE = wp.constant(wp.float32(6.0))
"""How much faster a significant change is followed."""
FORGET_TIME = wp.constant(wp.float32(20.0))
"""Time constant in seconds with which the confidence of what is not seen fades."""
CELL_SIZE = 8
"""Texels along the side of a cell in which change is measured."""
LEAST_CHANGE = wp.constant(wp.float32(0.03))
MOST_CHANGE = wp.constant(wp.float32(0.15))
"""Relative change of a cell's mean at which haste begins and is full."""
DARK = wp.constant(wp.float32(0.01))
"""Radiance below which changes count as noise."""

FULL_TRUST = wp.constant(wp.float32(0.5))
"""Confidence above which a texel is kept as it is."""
SUPPORT = wp.constant(wp.float32(4.0))
"""A coarser texel is fully trusted once a quarter of it is: smaller holes are then filled from nearby only."""

COARSE_TEXELS = 2048
"""Texels from which on the levels of filling are the work of one block, of ``COARSE_BLOCK`` threads."""
COARSE_BLOCK = 512

CHANGE_FLOOR = 0.0005
CHANGE_SHARE = 0.01
"""An environment has changed once some texel moved by more than ``CHANGE_FLOOR + CHANGE_SHARE * value``, about one
8-bit step. Any normalised filter F of the map with weights that are not negative (a mirror's sample, a glossy lobe,
irradiance / pi) is then off by at most ``CHANGE_FLOOR + CHANGE_SHARE * F`` while its readers do not run."""

KEY_LIGHT_COUNT = 4
CELL_ROWS = wp.constant(8)
CELL_COLUMNS = wp.constant(16)
KEY_CELLS = wp.constant(CELL_ROWS * CELL_COLUMNS)
CELL_SUMS = 2 * CELL_ROWS * CELL_COLUMNS + 16
"""Length of the scratch array of cells: their excess, what of it is left over, and sums around lights and pairs."""
LOBE_INNER = wp.constant(wp.float32(math.cos(math.radians(20.0))))
LOBE_OUTER = wp.constant(wp.float32(math.cos(math.radians(40.0))))
"""Cosines of the angles up to which a texel belongs to a light whole, and at all."""
CORE = wp.constant(wp.float32(0.9))
"""Share of a lobe's peak above which texels say where exactly the light is."""
LOBE_ANGLE = wp.constant(wp.float32(math.radians(40.0)))
COSINE_ROUNDING = wp.constant(wp.float32(1.0e-5))
"""More than rounding makes of a cosine."""
KEY_BLOCK = 256
KEY_BLOCKS = 8
"""Threads of a block, and blocks of a cluster, that find key lights."""
CLUSTERS_FROM = 90
"""Architecture from which on a device has clusters."""
MAX_KEY_LIGHTS = 4

mat43 = wp.types.matrix(shape=(MAX_KEY_LIGHTS, 3), dtype=wp.float32)


@wp.func
def luminance(radiance: wp.vec3) -> wp.float32:
    """Rec. 709 luminance of linear RGB."""
    return 0.2126 * radiance[0] + 0.7152 * radiance[1] + 0.0722 * radiance[2]


@wp.func
def brightness(radiance: wp.vec3) -> wp.float32:
    """Mean of the channels: where change of any colour counts alike."""
    return (radiance[0] + radiance[1] + radiance[2]) / 3.0


@wp.func
def is_finite(value: wp.vec3) -> wp.bool:
    """Whether all three are numbers."""
    return wp.isfinite(value[0]) and wp.isfinite(value[1]) and wp.isfinite(value[2])


@wp.func
def smooth_ramp(low: wp.float32, high: wp.float32, x: wp.float32) -> wp.float32:
    """0 below low, 1 above high, smooth between; 0 for NaN."""
    t = wp.clamp((x - low) / (high - low), 0.0, 1.0)
    return wp.where(x > low, t * t * (3.0 - 2.0 * t), 0.0)


@wp.func
def usable_confidence(value: wp.vec3, confidence: wp.float32) -> wp.float32:
    """Confidence of a texel; 0 where it or its value is not a number."""
    if confidence > 0.0 and is_finite(value):
        return wp.min(confidence, 1.0)
    return 0.0


# A warp works on each sum: its lanes take parts side by side and add them up without waiting for other warps. On CPU a
# warp is one lane, and a block is one warp.


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return 32;
#else
    return 1;
#endif
""")
def lane_count() -> wp.int32:
    """Lanes of a warp."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int reach = 16; reach > 0; reach /= 2)
        for (int k = 0; k < 4; ++k) value[k] += __shfl_xor_sync(0xffffffffu, value[k], reach);
#endif
    return value;
""")
def warp_sum(value: wp.vec4) -> wp.vec4:
    """Sum over the warp's lanes, known to all of them, the same in all bits."""


# A team is the block, or several blocks of one cluster where the device has them (from compute capability 9.0 on):
# their sums go into each other's shared memory. Where they go is another place every other time, so that a block which
# is ahead does not overwrite what one that is behind still reads.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ float parts[32][4], shares[2][16][4];
    for (int reach = 16; reach > 0; reach /= 2)
        for (int k = 0; k < 4; ++k) value[k] += __shfl_xor_sync(0xffffffffu, value[k], reach);
    const int lane = threadIdx.x & 31;
    if (lane == 0)
        for (int k = 0; k < 4; ++k) parts[threadIdx.x / 32][k] = value[k];
    __syncthreads();
    for (int k = 0; k < 4; ++k) value[k] = lane < blockDim.x / 32 ? parts[lane][k] : 0.0f;
    for (int reach = 16; reach > 0; reach /= 2)
        for (int k = 0; k < 4; ++k) value[k] += __shfl_xor_sync(0xffffffffu, value[k], reach);
#if __CUDA_ARCH__ >= 900
    if (blocks > 1) {
        if (threadIdx.x < 4 * blocks) {
            const unsigned int to = threadIdx.x / 4, part = threadIdx.x % 4;
            const unsigned int own = __cvta_generic_to_shared(&shares[turn % 2][blockIdx.x % blocks][part]);
            const float sum = part == 0 ? value[0] : part == 1 ? value[1] : part == 2 ? value[2] : value[3];
            unsigned int other;
            asm volatile("mapa.shared::cluster.u32 %0, %1, %2;" : "=r"(other) : "r"(own), "r"(to));
            asm volatile("st.shared::cluster.f32 [%0], %1;" :: "r"(other), "f"(sum) : "memory");
        }
        asm volatile("barrier.cluster.arrive.release.aligned; barrier.cluster.wait.acquire.aligned;" ::: "memory");
        for (int k = 0; k < 4; ++k) {
            value[k] = 0.0f;
            for (int block = 0; block < blocks; ++block) value[k] += shares[turn % 2][block][k];
        }
        return value;
    }
#endif
    __syncthreads();
#endif
    return value;
""")
def team_sum(value: wp.vec4, blocks: wp.int32, turn: wp.int32) -> wp.vec4:
    """Sum over the team's threads, known to all of them, the same in all bits.

    What was written before can be read after it. ``turn`` counts the calls.
    """


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ float parts[32];
    for (int reach = 16; reach > 0; reach /= 2) value = fmaxf(value, __shfl_xor_sync(0xffffffffu, value, reach));
    const int lane = threadIdx.x & 31;
    if (lane == 0) parts[threadIdx.x / 32] = value;
    __syncthreads();
    value = parts[lane < blockDim.x / 32 ? lane : 0];
    for (int reach = 16; reach > 0; reach /= 2) value = fmaxf(value, __shfl_xor_sync(0xffffffffu, value, reach));
    __syncthreads();
#endif
    return value;
""")
def block_max(value: wp.float32) -> wp.float32:
    """Largest value of the block's threads, known to all of them."""


@wp.func_native("""
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
    __shared__ float shares[2][16];
    if (blocks > 1) {
        if (threadIdx.x < blocks) {
            const unsigned int own = __cvta_generic_to_shared(&shares[turn % 2][blockIdx.x % blocks]);
            unsigned int other;
            asm volatile("mapa.shared::cluster.u32 %0, %1, %2;" : "=r"(other) : "r"(own), "r"(threadIdx.x));
            asm volatile("st.shared::cluster.f32 [%0], %1;" :: "r"(other), "f"(value) : "memory");
        }
        asm volatile("barrier.cluster.arrive.release.aligned; barrier.cluster.wait.acquire.aligned;" ::: "memory");
        for (int block = 0; block < blocks; ++block) value = fmaxf(value, shares[turn % 2][block]);
    }
#endif
    return value;
""")
def team_max(value: wp.float32, blocks: wp.int32, turn: wp.int32) -> wp.float32:
    """Largest value of the team's blocks, known to all of them; arguments as ``team_sum``."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ float from[3];
    if (threadIdx.x == 0)
        for (int k = 0; k < 3; ++k) from[k] = value[k];
    __syncthreads();
    for (int k = 0; k < 3; ++k) value[k] = from[k];
    __syncthreads();
#endif
    return value;
""")
def from_first(value: wp.vec3) -> wp.vec3:
    """What the block's first thread has, known to all of them."""


# ---- accumulation ----


@wp.func
def light_confidence(radiance: wp.vec3, confidence: wp.float32) -> wp.float32:
    """Confidence of what a frame says of a texel; 0 where that is no light: negative, or not a number."""
    if wp.min(radiance) < 0.0:
        return 0.0
    return usable_confidence(radiance, confidence)


@wp.kernel(enable_backward=False)
def measure_change_kernel(
    # In:
    row_start: wp.int32,
    lanes: wp.int32,
    radiance: wp.array2d[wp.vec3],
    confidence: wp.array2d[wp.float32],
    environment: wp.array2d[wp.vec3],
    environment_confidence: wp.array2d[wp.float32],
    # Out:
    change_out: wp.array2d[wp.vec2],  # this frame's signed relative change, and the one before
):
    """Mean signed change of one cell a warp."""
    band_row, cell_column, lane = wp.tid()
    cell_row = row_start + band_row
    height = radiance.shape[0]
    width = radiance.shape[1]
    first_row = cell_row * height // change_out.shape[0]
    first_column = cell_column * width // change_out.shape[1]
    rows = (cell_row + 1) * height // change_out.shape[0] - first_row
    columns = (cell_column + 1) * width // change_out.shape[1] - first_column
    difference = wp.float32(0.0)
    level = wp.float32(0.0)
    for item in range(lane, rows * columns, lanes):
        i = first_row + item // columns
        j = first_column + item % columns
        x = radiance[i, j]
        m = environment[i, j]
        weight = wp.min(light_confidence(x, confidence[i, j]), usable_confidence(m, environment_confidence[i, j]))
        if weight > 0.0:
            weight *= texel_solid_angle(i, height, width)
            new = brightness(x)
            old = brightness(m)
            difference += weight * (new - old)
            level += weight * (wp.max(new, old) + DARK)
    sum = warp_sum(wp.vec4(difference, level, 0.0, 0.0))
    if lane == 0:
        change = wp.float32(0.0)
        if sum[1] > 0.0:
            change = sum[0] / sum[1]
        if not wp.isfinite(change):
            change = 0.0
        change_out[cell_row, cell_column] = wp.vec2(change, change_out[cell_row, cell_column][0])


@wp.func
def lasting_change(change: wp.array2d[wp.vec2], row: wp.int32, column: wp.int32) -> wp.float32:
    """Size of a cell's change as far as two frames agree on it; rows end at the poles, columns wrap."""
    width = change.shape[1]
    c = change[wp.clamp(row, 0, change.shape[0] - 1), (column + width) % width]
    if c[0] * c[1] <= 0.0:
        return 0.0
    return wp.min(wp.abs(c[0]), wp.abs(c[1]))


@wp.kernel(enable_backward=False)
def accumulate_environment_kernel(
    # In:
    row_start: wp.int32,
    radiance: wp.array2d[wp.vec3],
    confidence: wp.array2d[wp.float32],
    clipped: wp.array2d[wp.vec3],
    change: wp.array2d[wp.vec2],
    params: wp.array[FrameParams],
    # Out:
    environment_out: wp.array2d[wp.vec3],
    confidence_out: wp.array2d[wp.float32],
    clipped_out: wp.array2d[wp.vec3],
):
    """One texel a thread, in place."""
    band_row, j = wp.tid()
    i = row_start + band_row
    x = radiance[i, j]
    c = light_confidence(x, confidence[i, j])
    if wp.min(clipped[i, j]) < 0.0 or not is_finite(clipped[i, j]):
        c = 0.0
    m = environment_out[i, j]
    share = clipped_out[i, j]
    k = usable_confidence(m, confidence_out[i, j])
    if params[0].environment_reset != 0 or k == 0.0 or not is_finite(share):
        k = 0.0
        m = wp.vec3(0.0, 0.0, 0.0)
        share = wp.vec3(0.0, 0.0, 0.0)
    time_step = params[0].time_step
    if not (time_step > 0.0):
        time_step = 0.0

    # Cells are blended bilinearly: no edges between them.
    y = (wp.float32(i) + 0.5) * wp.float32(change.shape[0]) / wp.float32(radiance.shape[0]) - 0.5
    z = (wp.float32(j) + 0.5) * wp.float32(change.shape[1]) / wp.float32(radiance.shape[1]) - 0.5
    row = wp.int32(wp.floor(y))
    column = wp.int32(wp.floor(z))
    fz = z - wp.floor(z)
    above = wp.lerp(lasting_change(change, row, column), lasting_change(change, row, column + 1), fz)
    below = wp.lerp(lasting_change(change, row + 1, column), lasting_change(change, row + 1, column + 1), fz)
    significance = smooth_ramp(LEAST_CHANGE, MOST_CHANGE, wp.lerp(above, below, y - wp.floor(y)))

    rate = 1.0 - wp.exp(-time_step / FOLLOW_TIME * (1.0 + (HASTE - 1.0) * significance))
    a = wp.float32(0.0)
    if c > 0.0:
        a = 1.0
        if k > 0.0:
            a = rate * c / (rate * c + (1.0 - rate) * k)
        m = m + a * (x - m)
        share = share + a * (clipped[i, j] - share)
    k = k * wp.exp(-time_step / FORGET_TIME)
    environment_out[i, j] = m
    confidence_out[i, j] = k + a * (c - k)
    clipped_out[i, j] = share


def change_shape(height: int, width: int) -> tuple[int, int]:
    """Rows and columns of the cells in which change is measured for a map of this size."""
    return max(1, height // CELL_SIZE), max(1, width // CELL_SIZE)


def measure_change(
    radiance: wp.array,
    confidence: wp.array,
    environment: wp.array,
    environment_confidence: wp.array,
    change_out: wp.array,
    *,
    rows: Rows | None = None,
) -> None:
    """Signed relative change of each cell between the accumulated light and a frame's.

    Args:
        radiance: This frame's light, ``wp.vec3`` (h, w).
        confidence: Its confidence, ``wp.float32`` (h, w).
        environment: Accumulated light, ``wp.vec3`` (h, w).
        environment_confidence: Its confidence, ``wp.float32`` (h, w).
        change_out: ``wp.vec2`` of ``change_shape(h, w)``: the change in -1..1, and what stood there before.
        rows: Band of cell rows, None for all.
    """
    lanes = 1 if change_out.device.is_cpu else 32
    launch_rows(
        measure_change_kernel,
        (*change_out.shape, lanes),
        [lanes, radiance, confidence, environment, environment_confidence],
        [change_out],
        rows=rows,
        device=change_out.device,
    )


def accumulate_environment(
    radiance: wp.array,
    confidence: wp.array,
    clipped: wp.array,
    change: wp.array,
    params: wp.array,
    environment_out: wp.array,
    confidence_out: wp.array,
    clipped_out: wp.array,
    *,
    rows: Rows | None = None,
) -> None:
    """Draw the accumulated light toward a frame's; outputs are read and written in place and start at zero.

    Args:
        radiance: This frame's light, ``wp.vec3`` (h, w).
        confidence: Its confidence, ``wp.float32`` (h, w); 0 or NaN: not seen.
        clipped: Share at clipping per channel, ``wp.vec3`` (h, w).
        change: From ``measure_change``.
        params: ``FrameParams`` (1): ``time_step`` and ``environment_reset``.
        environment_out: Accumulated light, ``wp.vec3`` (h, w).
        confidence_out: Its confidence, ``wp.float32`` (h, w).
        clipped_out: Its share at clipping, ``wp.vec3`` (h, w).
        rows: Band of rows, None for all.
    """
    launch_rows(
        accumulate_environment_kernel,
        environment_out.shape,
        [radiance, confidence, clipped, change, params],
        [environment_out, confidence_out, clipped_out],
        rows=rows,
        device=environment_out.device,
    )


# ---- filling ----


@wp.func
def band_solid_angle(start: wp.float32, stop: wp.float32, height: wp.int32) -> wp.float32:
    """Solid angle of the rows from start to stop per unit of longitude; a product of sines: no cancellation."""
    half = 0.5 * PI / wp.float32(height)
    return 2.0 * wp.sin((start + stop) * half) * wp.sin((stop - start) * half)


@wp.func
def sample_level_row(
    levels: wp.array[wp.vec4], offset: wp.int32, height: wp.int32, width: wp.int32, row: wp.int32, x: wp.float32
) -> wp.vec3:
    """Linear sample along one row of a level, across the seam and the poles; see ``latlong.sample_row``."""
    r = row
    at = x
    if r < 0:
        r = -1 - r
        at += 0.5 * wp.float32(width)
    elif r >= height:
        r = 2 * height - 1 - r
        at += 0.5 * wp.float32(width)
    left = wp.floor(at)
    first = wrap_texel(r, wp.int32(left), height, width)
    second = wrap_texel(r, wp.int32(left) + 1, height, width)
    a = levels[offset + first[0] * width + first[1]]
    b = levels[offset + second[0] * width + second[1]]
    t = at - left
    return wp.vec3(a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1]), a[2] + t * (b[2] - a[2]))


@wp.kernel(enable_backward=False)
def seed_fill_kernel(
    # In:
    row_start: wp.int32,
    radiance: wp.array2d[wp.vec3],
    confidence: wp.array2d[wp.float32],
    # Out:
    levels_out: wp.array[wp.vec4],  # radiance and trust
):
    """Level 0: radiance, and how far it is to be kept."""
    band_row, j = wp.tid()
    i = row_start + band_row
    value = radiance[i, j]
    trust = smooth_ramp(0.0, FULL_TRUST, usable_confidence(value, confidence[i, j]))
    if trust == 0.0:
        value = wp.vec3(0.0, 0.0, 0.0)
    levels_out[i * radiance.shape[1] + j] = wp.vec4(
        wp.max(value[0], 0.0), wp.max(value[1], 0.0), wp.max(value[2], 0.0), trust
    )


@wp.func
def pulled(
    levels: wp.array[wp.vec4],
    i: wp.int32,
    j: wp.int32,
    fine_offset: wp.int32,
    fine_height: wp.int32,
    fine_width: wp.int32,
    height: wp.int32,
    width: wp.int32,
) -> wp.vec4:
    """Texel of the next coarser level: means over exactly what it covers."""
    top = wp.float32(i * fine_height) / wp.float32(height)
    bottom = wp.float32((i + 1) * fine_height) / wp.float32(height)
    left = wp.float32(j * fine_width) / wp.float32(width)
    right = wp.float32((j + 1) * fine_width) / wp.float32(width)
    mean = wp.vec3(0.0, 0.0, 0.0)
    total = wp.float32(0.0)
    area = wp.float32(0.0)
    for r in range(wp.int32(top), wp.min(wp.int32(wp.ceil(bottom)), fine_height)):
        band = band_solid_angle(wp.max(top, wp.float32(r)), wp.min(bottom, wp.float32(r + 1)), fine_height)
        for c in range(wp.int32(left), wp.min(wp.int32(wp.ceil(right)), fine_width)):
            part = band * (wp.min(right, wp.float32(c + 1)) - wp.max(left, wp.float32(c)))
            texel = levels[fine_offset + r * fine_width + c]
            area += part
            weight = part * texel[3]
            if weight > 0.0:
                total += weight
                mean += (weight / total) * (wp.vec3(texel[0], texel[1], texel[2]) - mean)
    return wp.vec4(mean[0], mean[1], mean[2], wp.min(1.0, SUPPORT * total / area))


@wp.kernel(enable_backward=False)
def pull_level_kernel(
    # In:
    row_start: wp.int32,
    fine_offset: wp.int32,
    fine_height: wp.int32,
    fine_width: wp.int32,
    offset: wp.int32,
    height: wp.int32,
    width: wp.int32,
    # Out:
    levels_out: wp.array[wp.vec4],
):
    """Next coarser level."""
    band_row, j = wp.tid()
    i = row_start + band_row
    levels_out[offset + i * width + j] = pulled(levels_out, i, j, fine_offset, fine_height, fine_width, height, width)


@wp.func
def completed(
    levels: wp.array[wp.vec4],
    i: wp.int32,
    j: wp.int32,
    offset: wp.int32,
    height: wp.int32,
    width: wp.int32,
    coarse_offset: wp.int32,
    coarse_height: wp.int32,
    coarse_width: wp.int32,
) -> wp.vec3:
    """A texel, completed from the coarser level as far as it lacks trust."""
    texel = levels[offset + i * width + j]
    value = wp.vec3(texel[0], texel[1], texel[2])
    if texel[3] < 1.0 and coarse_height > 0:
        y = (wp.float32(i) + 0.5) * wp.float32(coarse_height) / wp.float32(height) - 0.5
        x = (wp.float32(j) + 0.5) * wp.float32(coarse_width) / wp.float32(width) - 0.5
        row = wp.floor(y)
        above = sample_level_row(levels, coarse_offset, coarse_height, coarse_width, wp.int32(row), x)
        below = sample_level_row(levels, coarse_offset, coarse_height, coarse_width, wp.int32(row) + 1, x)
        value += (1.0 - texel[3]) * (above + (y - row) * (below - above) - value)
    return value


@wp.kernel(enable_backward=False)
def push_level_kernel(
    # In:
    row_start: wp.int32,
    offset: wp.int32,
    height: wp.int32,
    width: wp.int32,
    coarse_offset: wp.int32,
    coarse_height: wp.int32,
    coarse_width: wp.int32,
    # Out:
    levels_out: wp.array[wp.vec4],
):
    """Complete a level from its coarser one, in place."""
    band_row, j = wp.tid()
    i = row_start + band_row
    value = completed(levels_out, i, j, offset, height, width, coarse_offset, coarse_height, coarse_width)
    # Trust stays: nothing reads it again but this texel.
    levels_out[offset + i * width + j] = wp.vec4(value[0], value[1], value[2], 1.0)


# A module of its own: its block is not that of other launches, and a module is compiled once per size of block.
@wp.kernel(module="unique", enable_backward=False)
def fill_coarse_kernel(
    # In:
    first_offset: wp.int32,
    first_height: wp.int32,
    first_width: wp.int32,
    count: wp.int32,
    # Out:
    levels_out: wp.array[wp.vec4],
):
    """One block builds the ``count`` levels below the first and completes them and the first, up again."""
    _block, thread = wp.tid()
    offset = first_offset
    height = first_height
    width = first_width
    for _level in range(count):
        coarse_height = (height + 1) / 2
        coarse_width = (width + 1) / 2
        coarse_offset = offset + height * width
        for texel in range(thread, coarse_height * coarse_width, wp.block_dim()):
            levels_out[coarse_offset + texel] = pulled(
                levels_out,
                texel // coarse_width,
                texel % coarse_width,
                offset,
                height,
                width,
                coarse_height,
                coarse_width,
            )
        wait_for_block()
        offset = coarse_offset
        height = coarse_height
        width = coarse_width
    for level in range(count):
        offset = first_offset
        height = first_height
        width = first_width
        for _finer in range(count - 1 - level):
            offset += height * width
            height = (height + 1) / 2
            width = (width + 1) / 2
        coarse_height = (height + 1) / 2
        coarse_width = (width + 1) / 2
        coarse_offset = offset + height * width
        for texel in range(thread, height * width, wp.block_dim()):
            value = completed(
                levels_out,
                texel // width,
                texel % width,
                offset,
                height,
                width,
                coarse_offset,
                coarse_height,
                coarse_width,
            )
            levels_out[offset + texel] = wp.vec4(value[0], value[1], value[2], 1.0)
        wait_for_block()


@wp.kernel(enable_backward=False)
def finish_fill_kernel(
    # In:
    row_start: wp.int32,
    levels: wp.array[wp.vec4],
    coarse_offset: wp.int32,
    coarse_height: wp.int32,
    coarse_width: wp.int32,
    # Out:
    environment_out: wp.array2d[wp.vec3],
):
    """Complete level 0 into the map."""
    band_row, j = wp.tid()
    i = row_start + band_row
    environment_out[i, j] = completed(
        levels, i, j, 0, environment_out.shape[0], environment_out.shape[1], coarse_offset, coarse_height, coarse_width
    )


@wp.kernel(enable_backward=False)
def measure_difference_kernel(
    # In:
    row_start: wp.int32,
    environment: wp.array2d[wp.vec3],
    published: wp.array2d[wp.vec3],
    floor: wp.float32,
    share: wp.float32,
    # Out:
    difference_out: wp.array[wp.float32],
):
    """Largest change of one row a thread."""
    i = row_start + wp.tid()
    largest = wp.float32(0.0)
    for j in range(environment.shape[1]):
        new = environment[i, j]
        old = published[i, j]
        for channel in range(3):
            largest = wp.max(largest, wp.abs(new[channel] - old[channel]) / (floor + share * wp.abs(old[channel])))
    difference_out[i] = largest


def fill_level_shapes(height: int, width: int) -> tuple[tuple[int, int], ...]:
    """Rows and columns of the fill pyramid's levels, from the map itself to a single texel."""
    shapes = [(height, width)]
    while shapes[-1] != (1, 1):
        rows, columns = shapes[-1]
        shapes.append(((rows + 1) // 2, (columns + 1) // 2))
    return tuple(shapes)


def fill_level_offsets(height: int, width: int) -> tuple[int, ...]:
    """Where each level starts in the packed array, and as last number the array's length."""
    return (0, *itertools.accumulate(rows * columns for rows, columns in fill_level_shapes(height, width)))


def seed_fill(radiance: wp.array, confidence: wp.array, levels_out: wp.array, *, rows: Rows | None = None) -> None:
    """Write level 0 of the fill pyramid.

    Args:
        radiance: Light that is known in part, ``wp.vec3`` (h, w).
        confidence: ``wp.float32`` (h, w) in 0..1.
        levels_out: ``wp.vec4`` (``fill_level_offsets(h, w)[-1]``): radiance and trust.
        rows: Band of rows, None for all.
    """
    launch_rows(
        seed_fill_kernel, radiance.shape, [radiance, confidence], [levels_out], rows=rows, device=radiance.device
    )


def push_pull(levels_out: wp.array, height: int, width: int, *, most: float = math.inf) -> None:
    """Build the coarser levels of a seeded fill pyramid and complete them, all but level 0.

    Args:
        levels_out: As ``seed_fill`` left it; changed in place.
        height: Rows of level 0.
        width: Columns of level 0.
        most: Radiance above which a texel counts as this much: what is unseen must not get a share of a lamp beside it.
    """
    shapes, offsets = fill_level_shapes(height, width), fill_level_offsets(height, width)
    device = levels_out.device
    levels: list[tuple[Any, ...]] = [(offset, *shape) for offset, shape in zip(offsets, shapes, strict=False)]
    # Small levels take one block less time than a launch each.
    first = next((n for n, shape in enumerate(shapes) if n and shape[0] * shape[1] <= COARSE_TEXELS), len(levels) - 1)
    for fine, coarse in itertools.pairwise(levels[: first + 1]):
        launch_rows(pull_level_kernel, coarse[1:], [*fine, *coarse], [levels_out], rows=None, device=device)
    launch_tiles(
        fill_coarse_kernel,
        [1],
        [*levels[first], len(levels) - 1 - first],
        [levels_out],
        block_dim=COARSE_BLOCK,
        device=device,
    )
    for coarse, fine in itertools.pairwise(reversed(levels[1 : first + 1])):
        launch_rows(push_level_kernel, fine[1:], [*fine, *coarse], [levels_out], rows=None, device=device)


def finish_fill(levels: wp.array, environment_out: wp.array, *, rows: Rows | None = None) -> None:
    """Complete level 0 into the map that everything reads.

    Args:
        levels: As ``push_pull`` left it.
        environment_out: ``wp.vec3`` (h, w): finite, not negative; zero if nothing at all is known.
        rows: Band of rows, None for all.
    """
    height, width = environment_out.shape
    shapes, offsets = fill_level_shapes(height, width), fill_level_offsets(height, width)
    coarse = (offsets[1], *shapes[1]) if len(shapes) > 1 else (0, 0, 0)
    launch_rows(
        finish_fill_kernel,
        environment_out.shape,
        [levels, *coarse],
        [environment_out],
        rows=rows,
        device=environment_out.device,
    )


def measure_difference(
    environment: wp.array,
    published: wp.array,
    difference_out: wp.array,
    *,
    floor: float = CHANGE_FLOOR,
    share: float = CHANGE_SHARE,
    rows: Rows | None = None,
) -> None:
    """Largest change of each row against a map that readers have seen, in units of what is tolerated.

    Args:
        environment: ``wp.vec3`` (h, w).
        published: ``wp.vec3`` (h, w).
        difference_out: ``wp.float32`` (h): largest |difference| / (floor + share * published); above 1 it has changed.
        floor: Tolerated change of a black texel.
        share: Tolerated relative change.
        rows: Band of rows, None for all.
    """
    launch_rows(
        measure_difference_kernel,
        (environment.shape[0],),
        [environment, published, floor, share],
        [difference_out],
        rows=rows,
        device=environment.device,
    )


# ---- key lights ----


@wp.func
def rotated(at: wp.vec3, cos_step: wp.float32, sin_step: wp.float32) -> wp.vec3:
    """The next texel's direction along a row."""
    return wp.vec3(at[0] * cos_step - at[1] * sin_step, at[0] * sin_step + at[1] * cos_step, at[2])


@wp.kernel(enable_backward=False)
def sum_rows_kernel(
    # In:
    lanes: wp.int32,
    environment: wp.array2d[wp.vec3],
    # Out:
    sums_out: wp.array[wp.vec4],  # luminance times direction, and luminance, over the row's solid angle
):
    """Flow of one row a warp."""
    i, lane = wp.tid()
    height = environment.shape[0]
    width = environment.shape[1]
    sum = wp.vec4(0.0, 0.0, 0.0, 0.0)
    start = lane * width // lanes
    at = direction_from_latlong(wp.float32(i) + 0.5, wp.float32(start) + 0.5, height, width)
    cos_step = wp.cos(2.0 * PI / wp.float32(width))
    sin_step = wp.sin(2.0 * PI / wp.float32(width))
    for j in range(start, (lane + 1) * width // lanes):
        sum += luminance(environment[i, j]) * wp.vec4(at[0], at[1], at[2], 1.0)
        at = rotated(at, cos_step, sin_step)
    sum = warp_sum(sum)
    if lane == 0:
        sums_out[i] = texel_solid_angle(i, height, width) * sum


@wp.func
def sum_all(sums: wp.array[wp.vec4], lane: wp.int32, lanes: wp.int32) -> wp.vec4:
    """Vector irradiance and scalar irradiance of the whole map; for a whole warp."""
    total = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for i in range(lane, sums.shape[0], lanes):
        total += sums[i]
    return warp_sum(total)


@wp.kernel(enable_backward=False)
def sum_cells_kernel(
    # In:
    lanes: wp.int32,
    parts: wp.int32,
    environment: wp.array2d[wp.vec3],
    sums: wp.array[wp.vec4],
    # Out:
    cells_out: wp.array[wp.vec4],  # excess luminance times direction, over the cell's solid angle; and its length
):
    """Excess of one cell a warp; lanes take ``parts`` of its rows."""
    cell, lane = wp.tid()
    cell_row = cell // CELL_COLUMNS
    cell_column = cell % CELL_COLUMNS
    height = environment.shape[0]
    width = environment.shape[1]
    mean = sum_all(sums, lane, lanes)[3] / (4.0 * PI)
    cos_step = wp.cos(2.0 * PI / wp.float32(width))
    sin_step = wp.sin(2.0 * PI / wp.float32(width))
    first_row = cell_row * height // CELL_ROWS
    rows = (cell_row + 1) * height // CELL_ROWS - first_row
    first_column = cell_column * width // CELL_COLUMNS
    columns = (cell_column + 1) * width // CELL_COLUMNS - first_column
    moment = wp.vec3(0.0, 0.0, 0.0)
    for item in range(lane, rows * parts, lanes):
        i = first_row + item // parts
        start = first_column + item % parts * columns // parts
        stop = first_column + (item % parts + 1) * columns // parts
        area = texel_solid_angle(i, height, width)
        at = direction_from_latlong(wp.float32(i) + 0.5, wp.float32(start) + 0.5, height, width)
        for j in range(start, stop):
            moment += area * wp.max(luminance(environment[i, j]) - mean, 0.0) * at
            at = rotated(at, cos_step, sin_step)
    sum = warp_sum(wp.vec4(moment[0], moment[1], moment[2], 0.0))
    if lane == 0:
        found = wp.vec4(sum[0], sum[1], sum[2], wp.length(wp.vec3(sum[0], sum[1], sum[2])))
        cells_out[cell] = found
        cells_out[KEY_CELLS + cell] = found  # what is left over by the lights found so far


@wp.func
def lobe_window(cosine: wp.float32) -> wp.float32:
    """How far a texel at an angle with this cosine from a light belongs to it."""
    return smooth_ramp(LOBE_OUTER, LOBE_INNER, cosine)


# Loops over lights have constant ends, and what is known of a light is picked by comparing: indices that are not
# constants would put it into memory.


@wp.func
def left_over(direction: wp.vec3, found: mat43, count: wp.int32) -> wp.float32:
    """Share of a texel that no light found so far has taken."""
    share = wp.float32(1.0)
    for k in range(MAX_KEY_LIGHTS):
        if k < count:
            share *= 1.0 - lobe_window(wp.dot(direction, wp.vec3(found[k, 0], found[k, 1], found[k, 2])))
    return share


@wp.func
def columns_of_lobe(
    direction: wp.vec3, sin_theta: wp.float32, cos_theta: wp.float32, centre: wp.float32, width: wp.int32
) -> wp.vec2i:
    """First column, and number of columns, of a row's texels that may lie within ``LOBE_ANGLE`` of a direction.

    Columns are counted on beyond the seam. A texel lies within where its cosine,
    sin theta |xy| cos(phi - phi0) + cos theta z, is at least that of the angle.

    Args:
        direction: Unit.
        sin_theta: Of the row.
        cos_theta: Of the row.
        centre: Column of the direction, texel centres at integers.
        width: Columns of the map.
    """
    widest = sin_theta * wp.length(wp.vec2(direction[0], direction[1]))
    least = LOBE_OUTER - cos_theta * direction[2]
    if least > widest + COSINE_ROUNDING:
        return wp.vec2i(0, 0)
    if not (least > COSINE_ROUNDING - widest):
        return wp.vec2i(0, width)
    reach = wp.acos(wp.min(least / widest, 1.0)) / (2.0 * PI) * wp.float32(width) + 0.5
    first = wp.int32(wp.floor(centre - reach))
    return wp.vec2i(first, wp.min(wp.int32(wp.ceil(centre + reach)) - first + 1, width))


# What concerns cells is written so that few instructions do it: a warp that has a processor to itself waits for each.


_LANES = f"""
#if defined(__CUDA_ARCH__)
    constexpr int LANES = 32;
    const int lane = threadIdx.x & 31;
#else
    constexpr int LANES = 1;
    const int lane = 0;
#endif
    constexpr int CELLS = {CELL_ROWS * CELL_COLUMNS}, OWN = CELLS / LANES;
"""


@wp.func_native(
    _LANES
    + """
    const wp::vec_t<4, float>* left_over = cells.data + CELLS;
#if defined(__CUDA_ARCH__)
    __shared__ float4 staged[CELLS];
    for (int cell = threadIdx.x; cell < CELLS; cell += blockDim.x)
        staged[cell] = make_float4(left_over[cell][0], left_over[cell][1], left_over[cell][2], 0.0f);
    __syncthreads();
    return reinterpret_cast<wp::uint64>(staged);
#else
    return reinterpret_cast<wp::uint64>(left_over);
#endif
"""
)
def stage_cells(cells: wp.array[wp.vec4]) -> wp.uint64:
    """Where what is left over can be read fast; for a whole block."""


@wp.func_native(
    _LANES
    + """
    const float* moments = reinterpret_cast<const float*>(staged);
    float sum = 0.0f;
#if defined(__CUDA_ARCH__)
#pragma unroll 8
#endif
    for (int cell = 0; cell < CELLS; ++cell) {
        const float* at = moments + 4 * cell;
        const float facing = at[0] * toward[0] + at[1] * toward[1] + at[2] * toward[2];
        sum += facing > 0.0f ? facing : 0.0f;
    }
    return sum;
"""
)
def received_from(staged: wp.uint64, toward: wp.vec3) -> wp.float32:
    """What a surface that faces ``toward`` receives of the excess that is left over; ``staged`` is ``stage_cells``."""


@wp.func_native("""
    const wp::vec3& texel = wp::index(environment, row, column);
#if defined(__CUDA_ARCH__)
    return wp::vec3(__ldg(&texel.c[0]), __ldg(&texel.c[1]), __ldg(&texel.c[2]));
#else
    return texel;
#endif
""")
def load_constant(environment: wp.array2d[wp.vec3], row: wp.int32, column: wp.int32) -> wp.vec3:
    """A texel of what does not change while a team works: it stays in the cache while blocks wait for each other."""


@wp.func_native(
    _LANES
    + """
    wp::vec_t<4, float> own[OWN];
    float inverse[OWN];
    for (int n = 0; n < OWN; ++n) {
        own[n] = cells.data[CELLS + lane + LANES * n];
        inverse[n] = own[n][3] > 0.0f ? 1.0f / own[n][3] : 0.0f;
    }
#if defined(__CUDA_ARCH__)
#pragma unroll 1
#endif
    for (int shift = 0; shift < 10; ++shift) {
        float centre[3] = {0.0f, 0.0f, 0.0f};
        for (int n = 0; n < OWN; ++n) {
            const float facing = own[n][0] * direction[0] + own[n][1] * direction[1] + own[n][2] * direction[2];
            const float cosine = facing * inverse[n], square = cosine * cosine, fourth = square * square;
            const float weight = facing > 0.0f ? (shift < 2 ? 1.0f : shift < 4 ? square : fourth * fourth) : 0.0f;
            for (int k = 0; k < 3; ++k) centre[k] += weight * own[n][k];
        }
#if defined(__CUDA_ARCH__)
        for (int reach = 16; reach > 0; reach /= 2)
            for (int k = 0; k < 3; ++k) centre[k] += __shfl_xor_sync(0xffffffffu, centre[k], reach);
#endif
        const float length = sqrtf(centre[0] * centre[0] + centre[1] * centre[1] + centre[2] * centre[2]);
        if (length > 0.0f)
            for (int k = 0; k < 3; ++k) direction[k] = centre[k] / length;
    }
    return direction;
"""
)
def shift_on_cells(cells: wp.array[wp.vec4], direction: wp.vec3) -> wp.vec3:
    """Ten mean shifts: two with all that faces the direction, two with cos^2, six with cos^8; for a whole warp."""


@wp.func_native(
    _LANES
    + """
    float sum = 0.0f;
    for (int n = 0; n < OWN; ++n) {
        const wp::vec_t<4, float> moment = cells.data[lane + LANES * n];
        const float facing = moment[0] * direction[0] + moment[1] * direction[1] + moment[2] * direction[2];
        if (facing > 0.0f) {
            const float cosine = facing / moment[3], square = cosine * cosine, fourth = square * square;
            sum += moment[3] * fourth * fourth * fourth * fourth;
        }
    }
#if defined(__CUDA_ARCH__)
    for (int reach = 16; reach > 0; reach /= 2) sum += __shfl_xor_sync(0xffffffffu, sum, reach);
#endif
    return sum;
"""
)
def excess_around(cells: wp.array[wp.vec4], direction: wp.vec3) -> wp.float32:
    """Excess within some 17 degrees of a direction, weighted by cos^16; for a whole warp."""


# A module of its own: its block is not that of other launches, and a module is compiled once per size of block.
@wp.kernel(module="unique", enable_backward=False, launch_bounds=KEY_BLOCK, cluster_dim=KEY_BLOCKS)
def find_key_lights_kernel(
    # In:
    blocks: wp.int32,
    environment: wp.array2d[wp.vec3],
    sums: wp.array[wp.vec4],
    # Out:
    cells_out: wp.array[wp.vec4],
    key_lights_out: wp.array[KeyLight],
):
    """A team of blocks finds all lights, one after another.

    Every block does for itself what concerns cells: to wait for each other would take longer. Texels are shared out: a
    row to a warp, of which its lanes take every so manyth, and only as far as the lobe reaches. Loops that are not to
    be unrolled are written as ``while``: a kernel that is run through once takes as long as its instructions take to
    arrive.
    """
    block, thread = wp.tid()
    threads = wp.block_dim()
    worker = block * threads + thread
    workers = blocks * threads
    lanes = lane_count()
    lane = thread % lanes
    height = environment.shape[0]
    width = environment.shape[1]
    all = sum_all(sums, lane, lanes)
    flow = wp.vec3(all[0], all[1], all[2])
    mean = all[3] / (4.0 * PI)
    column_angle = 2.0 * PI / wp.float32(width)
    cos_step = wp.cos(column_angle * wp.float32(lanes))
    sin_step = wp.sin(column_angle * wp.float32(lanes))
    area_of_sine = 2.0 * wp.sin(0.5 * PI / wp.float32(height)) * column_angle  # a texel's solid angle / sin theta
    found = mat43()
    strengths = wp.vec4(0.0, 0.0, 0.0, 0.0)
    reds = wp.vec4(0.0, 0.0, 0.0, 0.0)
    greens = wp.vec4(0.0, 0.0, 0.0, 0.0)
    blues = wp.vec4(0.0, 0.0, 0.0, 0.0)
    count = key_lights_out.shape[0]
    turn = int(0)

    for k in range(count):
        # The cell's direction in which a surface receives most; the first of equals, whatever the number of threads.
        best = wp.float32(0.0)
        best_cell = wp.float32(KEY_CELLS)
        staged = stage_cells(cells_out)
        candidate = thread
        while candidate < KEY_CELLS:
            toward = direction_from_latlong(
                wp.float32(candidate // CELL_COLUMNS) + 0.5,
                wp.float32(candidate % CELL_COLUMNS) + 0.5,
                CELL_ROWS,
                CELL_COLUMNS,
            )
            received = received_from(staged, toward)
            if received > best:
                best = received
                best_cell = wp.float32(candidate)
            candidate += threads
        most = block_max(best)
        if best < most:
            best_cell = wp.float32(KEY_CELLS)
        chosen = -wp.int32(block_max(-best_cell))
        direction = wp.vec3(0.0, 0.0, 1.0)
        lit = most > 0.0
        if lit:
            direction = direction_from_latlong(
                wp.float32(chosen // CELL_COLUMNS) + 0.5,
                wp.float32(chosen % CELL_COLUMNS) + 0.5,
                CELL_ROWS,
                CELL_COLUMNS,
            )
            if thread < lanes:
                direction = shift_on_cells(cells_out, direction)
            direction = from_first(direction)

        # Texels now. Passes 0 and 1: centroid of the lobe's excess and its peak; 2: centroid of the core;
        # 3: what the lobe gives.
        peak = wp.float32(0.0)
        step = int(0)
        while step < 4:
            sum = wp.vec4(0.0, 0.0, 0.0, 0.0)
            highest = wp.float32(0.0)
            theta = wp.atan2(wp.length(wp.vec2(direction[0], direction[1])), direction[2])
            first_row = wp.max(wp.int32((theta - LOBE_ANGLE) / PI * wp.float32(height)), 0)
            last_row = wp.min(wp.int32((theta + LOBE_ANGLE) / PI * wp.float32(height)), height - 1)
            if not lit:
                last_row = first_row - 1
            middle = (wp.atan2(direction[1], direction[0]) / PI + 1.0) * 0.5 * wp.float32(width) - 0.5
            i = first_row + worker // lanes
            while i <= last_row:
                row_theta = (wp.float32(i) + 0.5) * PI / wp.float32(height)
                sin_theta = wp.sin(row_theta)
                cos_theta = wp.cos(row_theta)
                span = columns_of_lobe(direction, sin_theta, cos_theta, middle, width)
                area = area_of_sine * sin_theta
                phi = (wp.float32(span[0] + lane) + 0.5) * column_angle - PI
                at = wp.vec3(sin_theta * wp.cos(phi), sin_theta * wp.sin(phi), cos_theta)
                column = lane
                while column < span[1]:
                    j = span[0] + column
                    if j < 0:
                        j += width
                    if j >= width:
                        j -= width
                    value = load_constant(environment, i, j)
                    cosine = wp.dot(at, direction)
                    excess = wp.max(luminance(value) - mean, 0.0)
                    if cosine > LOBE_OUTER and excess > 0.0:
                        share = lobe_window(cosine) * left_over(at, found, k)
                        weight = area * share * excess
                        if step == 2:
                            weight = area * share * wp.max(excess - CORE * peak, 0.0)
                        if step < 3:
                            highest = wp.max(highest, share * excess)
                            sum += weight * wp.vec4(at[0], at[1], at[2], 0.0)
                        else:
                            # Light above the environment's mean, in the texel's own colour.
                            given = (weight / luminance(value) * cosine) * value
                            sum += wp.vec4(given[0], given[1], given[2], 0.0)
                    at = rotated(at, cos_step, sin_step)
                    column += lanes
                i += workers // lanes
            if step == 3:
                # Each worker its own cells; the sums below make all of them wait for that.
                cell = worker
                while cell < KEY_CELLS:
                    moment = cells_out[KEY_CELLS + cell]
                    if moment[3] > 0.0:
                        facing = wp.dot(wp.vec3(moment[0], moment[1], moment[2]), direction)
                        cells_out[KEY_CELLS + cell] = (1.0 - lobe_window(facing / moment[3])) * moment
                    cell += workers
            total = team_sum(sum, blocks, turn)
            turn += 1
            if step == 1:
                peak = team_max(block_max(highest), blocks, turn)
                turn += 1
            if step < 3:
                centre = wp.vec3(total[0], total[1], total[2])
                if wp.length(centre) > 0.0:
                    direction = wp.normalize(centre)
            else:
                given = wp.vec3(total[0], total[1], total[2])
                for place in range(MAX_KEY_LIGHTS):
                    if place == k:
                        reds[place] = given[0]
                        greens[place] = given[1]
                        blues[place] = given[2]
                        strengths[place] = luminance(given)
            step += 1
        for place in range(MAX_KEY_LIGHTS):
            if place == k:
                for axis in range(3):
                    found[place, axis] = direction[axis]

    # How far each pair of lights are rivals: 60 degrees apart, with a valley between them. A sum to a warp.
    if block > 0:
        return
    lights = found
    strength = strengths
    item = thread // lanes
    while item < MAX_KEY_LIGHTS * MAX_KEY_LIGHTS:
        first = item // MAX_KEY_LIGHTS
        second = item % MAX_KEY_LIGHTS
        if first <= second and second < count:
            a = wp.vec3(lights[first, 0], lights[first, 1], lights[first, 2])
            b = wp.vec3(lights[second, 0], lights[second, 1], lights[second, 2])
            halfway = wp.normalize(a + b)
            if first == second:
                halfway = a
            excess = excess_around(cells_out, halfway)
            rivalry = wp.clamp(2.0 * (1.0 - wp.dot(a, b)), 0.0, 1.0)
            if lane == 0:
                cells_out[2 * KEY_CELLS + item] = wp.vec4(excess, rivalry, 0.0, 0.0)
        item += threads // lanes
    wait_for_block()

    k = thread
    while k < count:
        around = cells_out[2 * KEY_CELLS + (MAX_KEY_LIGHTS + 1) * k][0]
        # Brightest first; of equals the one that was found first.
        place = int(0)
        alone = wp.float32(1.0)
        for j in range(count):
            if strength[j] > strength[k] or (strength[j] == strength[k] and j < k):
                place += 1
            between = cells_out[2 * KEY_CELLS + MAX_KEY_LIGHTS * wp.min(j, k) + wp.max(j, k)]
            least = wp.min(around, cells_out[2 * KEY_CELLS + (MAX_KEY_LIGHTS + 1) * j][0])
            rivalry = between[1]
            if least > 0.0:
                rivalry *= 1.0 - smooth_ramp(0.3, 0.6, between[0] / least)
            if j != k and strength[k] > 0.0:
                alone = wp.min(alone, 1.0 - wp.min(1.0, strength[j] / strength[k]) * rivalry)
        light = KeyLight()
        light.direction = wp.vec3(lights[k, 0], lights[k, 1], lights[k, 2])
        light.irradiance = wp.vec3(reds[k], greens[k], blues[k])
        light.directionality = 0.0
        if strength[k] > 0.0:
            light.directionality = alone * wp.clamp(2.0 * wp.dot(flow, light.direction) / all[3], 0.0, 1.0)
        key_lights_out[place] = light
        k += threads


def find_key_lights(environment: wp.array, sums_out: wp.array, cells_out: wp.array, key_lights_out: wp.array) -> None:
    """Find the dominant directions of the environment, brightest first.

    Args:
        environment: ``wp.vec3`` (h, w), finite and not negative.
        sums_out: Scratch, ``wp.vec4`` (h).
        cells_out: Scratch, ``wp.vec4`` (``CELL_SUMS``).
        key_lights_out: ``KeyLight`` (1 to ``MAX_KEY_LIGHTS``). A place without a light has no irradiance,
            directionality 0 and looks toward +z.

    Raises:
        ValueError: More lights were asked for than can be found.
    """
    if not 1 <= len(key_lights_out) <= MAX_KEY_LIGHTS:
        raise ValueError(f"key_lights_out has {len(key_lights_out)} places; expected 1 to {MAX_KEY_LIGHTS}")
    device = environment.device
    lanes, parts = (1, 1) if device.is_cpu else (32, 4)
    launch(sum_rows_kernel, (environment.shape[0], lanes), [lanes, environment], [sums_out], device=device)
    cells = CELL_ROWS * CELL_COLUMNS
    launch(sum_cells_kernel, (cells, lanes), [lanes, parts, environment, sums_out], [cells_out], device=device)
    blocks = KEY_BLOCKS if device.is_cuda and device.arch >= CLUSTERS_FROM else 1
    launch_tiles(
        find_key_lights_kernel,
        [blocks],
        [blocks, environment, sums_out],
        [cells_out, key_lights_out],
        block_dim=KEY_BLOCK,
        device=device,
    )
