"""The dominant directions of the environment.

With the mean radiance L0 of the map, a texel's excess max(lum L - lum L0, 0) is what makes it a light; a uniform
environment has none. Light k is where a surface would receive most of the excess that lights 0 .. k - 1 have left
over: the best of the 8 x 16 sectors' directions, moved to the centre of its lobe by mean shifts with ever narrower
kernels: all that faces it (whose fixed point is the maximum of that irradiance), cos^2, cos^8, the texels within
``LOBE_OUTER``; and at last to the centroid of what rises above ``CORE`` of the lobe's peak, where glow and scratches
of the ball do not pull at it. Starting broad keeps the centre of a window half a sky wide where it is.

A direction s dominates as far as the light's flow goes its way and no rival stands elsewhere. With V = integral of L d
and the scalar irradiance phi = integral of L, a surface with normal n receives E(n) = phi / 4 + n . V / 2 to first
order (the cosine lobe's first two bands, pi and 2 pi / 3), so facets toward and away from s differ by (E(s) - E(-s)) /
(E(s) + E(-s)) = 2 V . s / phi: the contrast that relief shows. It is 0 in a uniform environment and between two equal
opposite lights, 1 (held there) for a sun and still for a window that is half a black sky; an emitter that gives a share
q of the light of an otherwise uniform environment has 2 q. Where two lights are of one strength, which is the brighter
is an accident of noise, and a picture that follows it would flicker; the directionality

    D_k = clamp(2 V . s_k / phi, 0, 1) * min over j of (1 - min(1, E_j / E_k) min(1, 2 (1 - s_j . s_k)) valley_jk)

is 0 there if they are 60 degrees apart or more, and hardly less if they are neighbours, between which a change of
place is small. What is bright halfway between two directions too is one window, not two rivals: there the valley is 0.
"""

from __future__ import annotations

import math

import warp as wp

from warp_ar.kernels.color import luminance
from warp_ar.kernels.cooperative import block_max, from_first, lane_count, team_max, team_sum, warp_sum
from warp_ar.kernels.guards import smooth_ramp
from warp_ar.kernels.latlong import PI, direction_from_latlong, texel_solid_angle
from warp_ar.kernels.launch import launch, launch_tiles, wait_for_block
from warp_ar.kernels.structs import KeyLight

wp.set_module_options({"enable_backward": False})

KEY_LIGHT_COUNT = 4
SECTOR_ROWS = wp.constant(8)
SECTOR_COLUMNS = wp.constant(16)
KEY_SECTORS = wp.constant(SECTOR_ROWS * SECTOR_COLUMNS)
SECTOR_SUMS = 2 * SECTOR_ROWS * SECTOR_COLUMNS + 16
"""Length of the scratch array of sectors: their excess, what of it is left over, and sums around lights and pairs."""
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
def sum_sectors_kernel(
    # In:
    lanes: wp.int32,
    parts: wp.int32,
    environment: wp.array2d[wp.vec3],
    sums: wp.array[wp.vec4],
    # Out:
    sectors_out: wp.array[wp.vec4],  # excess luminance times direction, over the sector's solid angle; and its length
):
    """Excess of one sector a warp; lanes take ``parts`` of its rows."""
    sector, lane = wp.tid()
    sector_row = sector // SECTOR_COLUMNS
    sector_column = sector % SECTOR_COLUMNS
    height = environment.shape[0]
    width = environment.shape[1]
    mean = sum_all(sums, lane, lanes)[3] / (4.0 * PI)
    cos_step = wp.cos(2.0 * PI / wp.float32(width))
    sin_step = wp.sin(2.0 * PI / wp.float32(width))
    first_row = sector_row * height // SECTOR_ROWS
    rows = (sector_row + 1) * height // SECTOR_ROWS - first_row
    first_column = sector_column * width // SECTOR_COLUMNS
    columns = (sector_column + 1) * width // SECTOR_COLUMNS - first_column
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
        sectors_out[sector] = found
        sectors_out[KEY_SECTORS + sector] = found  # what is left over by the lights found so far


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


# What concerns sectors is written so that few instructions do it: a warp that has a processor to itself waits for each.


_LANES = f"""
#if defined(__CUDA_ARCH__)
    constexpr int LANES = 32;
    const int lane = threadIdx.x & 31;
#else
    constexpr int LANES = 1;
    const int lane = 0;
#endif
    constexpr int SECTORS = {SECTOR_ROWS * SECTOR_COLUMNS}, OWN = SECTORS / LANES;
"""


@wp.func_native(
    _LANES
    + """
    const wp::vec_t<4, float>* left_over = sectors.data + SECTORS;
#if defined(__CUDA_ARCH__)
    __shared__ float4 staged[SECTORS];
    for (int sector = threadIdx.x; sector < SECTORS; sector += blockDim.x)
        staged[sector] = make_float4(left_over[sector][0], left_over[sector][1], left_over[sector][2], 0.0f);
    __syncthreads();
    return reinterpret_cast<wp::uint64>(staged);
#else
    return reinterpret_cast<wp::uint64>(left_over);
#endif
"""
)
def stage_sectors(sectors: wp.array[wp.vec4]) -> wp.uint64:
    """Where what is left over can be read fast; for a whole block."""


@wp.func_native(
    _LANES
    + """
    const float* moments = reinterpret_cast<const float*>(staged);
    float sum = 0.0f;
#if defined(__CUDA_ARCH__)
#pragma unroll 8
#endif
    for (int sector = 0; sector < SECTORS; ++sector) {
        const float* at = moments + 4 * sector;
        const float facing = at[0] * toward[0] + at[1] * toward[1] + at[2] * toward[2];
        sum += facing > 0.0f ? facing : 0.0f;
    }
    return sum;
"""
)
def received_from(staged: wp.uint64, toward: wp.vec3) -> wp.float32:
    """What a surface that faces ``toward`` receives of the excess left over; ``staged`` is of ``stage_sectors``."""


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
        own[n] = sectors.data[SECTORS + lane + LANES * n];
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
def shift_on_sectors(sectors: wp.array[wp.vec4], direction: wp.vec3) -> wp.vec3:
    """Ten mean shifts: two with all that faces the direction, two with cos^2, six with cos^8; for a whole warp."""


@wp.func_native(
    _LANES
    + """
    float sum = 0.0f;
    for (int n = 0; n < OWN; ++n) {
        const wp::vec_t<4, float> moment = sectors.data[lane + LANES * n];
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
def excess_around(sectors: wp.array[wp.vec4], direction: wp.vec3) -> wp.float32:
    """Excess within some 17 degrees of a direction, weighted by cos^16; for a whole warp."""


# A module of its own: its block is not that of other launches, and a module is compiled once per size of block.
@wp.kernel(module="unique", enable_backward=False, launch_bounds=KEY_BLOCK, cluster_dim=KEY_BLOCKS)
def find_key_lights_kernel(
    # In:
    blocks: wp.int32,
    environment: wp.array2d[wp.vec3],
    sums: wp.array[wp.vec4],
    # Out:
    sectors_out: wp.array[wp.vec4],
    key_lights_out: wp.array[KeyLight],
):
    """A team of blocks finds all lights, one after another.

    Every block does for itself what concerns sectors: to wait for each other would take longer. Texels are shared out:
    a row to a warp, of which its lanes take every so manyth, and only as far as the lobe reaches. Loops that are not
    to be unrolled are written as ``while``: a kernel that is run through once takes as long as its instructions take
    to arrive.
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
        # The sector's direction in which a surface receives most; the first of equals, whatever the number of threads.
        best = wp.float32(0.0)
        best_sector = wp.float32(KEY_SECTORS)
        staged = stage_sectors(sectors_out)
        candidate = thread
        while candidate < KEY_SECTORS:
            toward = direction_from_latlong(
                wp.float32(candidate // SECTOR_COLUMNS) + 0.5,
                wp.float32(candidate % SECTOR_COLUMNS) + 0.5,
                SECTOR_ROWS,
                SECTOR_COLUMNS,
            )
            received = received_from(staged, toward)
            if received > best:
                best = received
                best_sector = wp.float32(candidate)
            candidate += threads
        most = block_max(best)
        if best < most:
            best_sector = wp.float32(KEY_SECTORS)
        chosen = -wp.int32(block_max(-best_sector))
        direction = wp.vec3(0.0, 0.0, 1.0)
        lit = most > 0.0
        if lit:
            direction = direction_from_latlong(
                wp.float32(chosen // SECTOR_COLUMNS) + 0.5,
                wp.float32(chosen % SECTOR_COLUMNS) + 0.5,
                SECTOR_ROWS,
                SECTOR_COLUMNS,
            )
            if thread < lanes:
                direction = shift_on_sectors(sectors_out, direction)
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
                # Each worker its own sectors; the sums below make all of them wait for that.
                sector = worker
                while sector < KEY_SECTORS:
                    moment = sectors_out[KEY_SECTORS + sector]
                    if moment[3] > 0.0:
                        facing = wp.dot(wp.vec3(moment[0], moment[1], moment[2]), direction)
                        sectors_out[KEY_SECTORS + sector] = (1.0 - lobe_window(facing / moment[3])) * moment
                    sector += workers
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
            excess = excess_around(sectors_out, halfway)
            rivalry = wp.clamp(2.0 * (1.0 - wp.dot(a, b)), 0.0, 1.0)
            if lane == 0:
                sectors_out[2 * KEY_SECTORS + item] = wp.vec4(excess, rivalry, 0.0, 0.0)
        item += threads // lanes
    wait_for_block()

    k = thread
    while k < count:
        around = sectors_out[2 * KEY_SECTORS + (MAX_KEY_LIGHTS + 1) * k][0]
        # Brightest first; of equals the one that was found first.
        place = int(0)
        alone = wp.float32(1.0)
        for j in range(count):
            if strength[j] > strength[k] or (strength[j] == strength[k] and j < k):
                place += 1
            between = sectors_out[2 * KEY_SECTORS + MAX_KEY_LIGHTS * wp.min(j, k) + wp.max(j, k)]
            least = wp.min(around, sectors_out[2 * KEY_SECTORS + (MAX_KEY_LIGHTS + 1) * j][0])
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


def find_key_lights(environment: wp.array, sums_out: wp.array, sectors_out: wp.array, key_lights_out: wp.array) -> None:
    """Find the dominant directions of the environment, brightest first.

    Args:
        environment: ``wp.vec3`` (h, w), finite and not negative.
        sums_out: Scratch, ``wp.vec4`` (h).
        sectors_out: Scratch, ``wp.vec4`` (``SECTOR_SUMS``).
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
    sectors = SECTOR_ROWS * SECTOR_COLUMNS
    launch(sum_sectors_kernel, (sectors, lanes), [lanes, parts, environment, sums_out], [sectors_out], device=device)
    blocks = KEY_BLOCKS if device.is_cuda and device.arch >= CLUSTERS_FROM else 1
    launch_tiles(
        find_key_lights_kernel,
        [blocks],
        [blocks, environment, sums_out],
        [sectors_out, key_lights_out],
        block_dim=KEY_BLOCK,
        device=device,
    )
