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
from warp_ar.kernels.environment.key_light_sectors import (
    KEY_SECTORS,
    SECTOR_COLUMNS,
    SECTOR_ROWS,
    excess_around,
    received_from,
    shift_on_sectors,
    stage_sectors,
)
from warp_ar.kernels.latlong import PI, direction_from_latlong, texel_solid_angle
from warp_ar.kernels.launch import launch, launch_tiles, wait_for_block
from warp_ar.kernels.safe_math import smooth_ramp
from warp_ar.kernels.structs import KeyLight

wp.set_module_options({"enable_backward": False})

KEY_LIGHT_COUNT = 4
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


@wp.struct
class Team:
    """Where a thread stands among those that find lights together."""

    thread: wp.int32  # in its block
    threads: wp.int32
    worker: wp.int32  # in all blocks
    workers: wp.int32
    lane: wp.int32  # in its warp
    lanes: wp.int32


@wp.struct
class Sky:
    """What holds for all texels of the map, and all lights."""

    mean: wp.float32  # luminance
    column_angle: wp.float32  # radians
    cos_step: wp.float32  # of the angle from a lane's texel to its next one
    sin_step: wp.float32
    area_of_sine: wp.float32  # a texel's solid angle / sin theta


@wp.struct
class LobeSums:
    """Of a thread's texels of a lobe."""

    sum: wp.vec4
    highest: wp.float32  # excess that is left over


@wp.struct
class Found:
    """The lights found so far; a light's place is picked by comparing."""

    directions: mat43
    strengths: wp.vec4  # luminance of irradiance
    reds: wp.vec4  # irradiance
    greens: wp.vec4
    blues: wp.vec4


@wp.func
def sector_direction(sector: wp.int32) -> wp.vec3:
    """Direction of a sector's middle."""
    return direction_from_latlong(
        wp.float32(sector // SECTOR_COLUMNS) + 0.5,
        wp.float32(sector % SECTOR_COLUMNS) + 0.5,
        SECTOR_ROWS,
        SECTOR_COLUMNS,
    )


@wp.func
def best_direction(sectors: wp.array[wp.vec4], team: Team) -> wp.vec4:
    """The sector's direction in which a surface receives most, moved by mean shifts, and what it receives.

    The first of equals, whatever the number of threads. Where nothing is left over, +z and 0. For a whole block.
    """
    best = wp.float32(0.0)
    best_sector = wp.float32(KEY_SECTORS)
    staged = stage_sectors(sectors)
    candidate = team.thread
    while candidate < KEY_SECTORS:
        received = received_from(staged, sector_direction(candidate))
        if received > best:
            best = received
            best_sector = wp.float32(candidate)
        candidate += team.threads
    most = block_max(best)
    if best < most:
        best_sector = wp.float32(KEY_SECTORS)
    chosen = -wp.int32(block_max(-best_sector))
    direction = wp.vec3(0.0, 0.0, 1.0)
    if most > 0.0:
        direction = sector_direction(chosen)
        if team.thread < team.lanes:
            direction = shift_on_sectors(sectors, direction)
        direction = from_first(direction)
    return wp.vec4(direction[0], direction[1], direction[2], most)


# What a texel adds to a lobe's sums, pass by pass; share: of it, by the lobe's window and the lights found before.
#     0, 1  share excess at                      centroid of the excess; its largest share excess is the peak
#     2     share max(excess - CORE peak, 0) at  centroid of the core
#     3     share excess / luminance cos value   irradiance: light above the map's mean, in the texel's own colour
@wp.func
def sum_lobe(
    environment: wp.array2d[wp.vec3],
    team: Team,
    sky: Sky,
    direction: wp.vec3,
    found: mat43,
    k: wp.int32,
    step: wp.int32,
    peak: wp.float32,
) -> LobeSums:
    """A thread's part of a pass over the texels of light ``k``: a row to a warp, shared by its lanes."""
    height = environment.shape[0]
    width = environment.shape[1]
    sums = LobeSums()
    theta = wp.atan2(wp.length(wp.vec2(direction[0], direction[1])), direction[2])
    first_row = wp.max(wp.int32((theta - LOBE_ANGLE) / PI * wp.float32(height)), 0)
    last_row = wp.min(wp.int32((theta + LOBE_ANGLE) / PI * wp.float32(height)), height - 1)
    middle = (wp.atan2(direction[1], direction[0]) / PI + 1.0) * 0.5 * wp.float32(width) - 0.5
    i = first_row + team.worker // team.lanes
    while i <= last_row:
        row_theta = (wp.float32(i) + 0.5) * PI / wp.float32(height)
        sin_theta = wp.sin(row_theta)
        cos_theta = wp.cos(row_theta)
        span = columns_of_lobe(direction, sin_theta, cos_theta, middle, width)
        area = sky.area_of_sine * sin_theta
        phi = (wp.float32(span[0] + team.lane) + 0.5) * sky.column_angle - PI
        at = wp.vec3(sin_theta * wp.cos(phi), sin_theta * wp.sin(phi), cos_theta)
        column = team.lane
        while column < span[1]:
            j = span[0] + column
            if j < 0:
                j += width
            if j >= width:
                j -= width
            value = load_constant(environment, i, j)
            cosine = wp.dot(at, direction)
            excess = wp.max(luminance(value) - sky.mean, 0.0)
            if cosine > LOBE_OUTER and excess > 0.0:
                share = lobe_window(cosine) * left_over(at, found, k)
                weight = area * share * excess
                if step == 2:
                    weight = area * share * wp.max(excess - CORE * peak, 0.0)
                if step < 3:
                    sums.highest = wp.max(sums.highest, share * excess)
                    sums.sum += weight * wp.vec4(at[0], at[1], at[2], 0.0)
                else:
                    given = (weight / luminance(value) * cosine) * value
                    sums.sum += wp.vec4(given[0], given[1], given[2], 0.0)
            at = rotated(at, sky.cos_step, sky.sin_step)
            column += team.lanes
        i += team.workers // team.lanes
    return sums


@wp.func
def take_from_sectors(direction: wp.vec3, team: Team, sectors_out: wp.array[wp.vec4]):
    """Take a light from what sectors have left over, each worker from its own; seen by others after the next sum."""
    sector = team.worker
    while sector < KEY_SECTORS:
        moment = sectors_out[KEY_SECTORS + sector]
        if moment[3] > 0.0:
            facing = wp.dot(wp.vec3(moment[0], moment[1], moment[2]), direction)
            sectors_out[KEY_SECTORS + sector] = (1.0 - lobe_window(facing / moment[3])) * moment
        sector += team.workers


@wp.func
def compare_lights(lights: mat43, count: wp.int32, team: Team, sectors_out: wp.array[wp.vec4]):
    """Note of each pair of lights the excess halfway between them, and how far they are rivals; a pair to a warp.

    Rivals by their angle alone: min(1, 2 (1 - s_j . s_k)), 1 from 60 degrees on. Of a light with itself, the excess
    around it.
    """
    item = team.thread // team.lanes
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
            if team.lane == 0:
                sectors_out[2 * KEY_SECTORS + item] = wp.vec4(excess, rivalry, 0.0, 0.0)
        item += team.threads // team.lanes
    wait_for_block()


@wp.func
def write_lights(
    found: Found, all: wp.vec4, team: Team, sectors: wp.array[wp.vec4], key_lights_out: wp.array[KeyLight]
):
    """Write all lights with their directionality, the module's D_k, brightest first.

    ``sectors`` holds what ``compare_lights`` noted, ``all`` is of ``sum_all``.
    """
    count = key_lights_out.shape[0]
    lights = found.directions
    strength = found.strengths
    flow = wp.vec3(all[0], all[1], all[2])
    k = team.thread
    while k < count:
        around = sectors[2 * KEY_SECTORS + (MAX_KEY_LIGHTS + 1) * k][0]
        # Of equals the one that was found first.
        place = int(0)
        alone = wp.float32(1.0)
        for j in range(count):
            if strength[j] > strength[k] or (strength[j] == strength[k] and j < k):
                place += 1
            between = sectors[2 * KEY_SECTORS + MAX_KEY_LIGHTS * wp.min(j, k) + wp.max(j, k)]
            least = wp.min(around, sectors[2 * KEY_SECTORS + (MAX_KEY_LIGHTS + 1) * j][0])
            rivalry = between[1]
            if least > 0.0:
                rivalry *= 1.0 - smooth_ramp(0.3, 0.6, between[0] / least)
            if j != k and strength[k] > 0.0:
                alone = wp.min(alone, 1.0 - wp.min(1.0, strength[j] / strength[k]) * rivalry)
        light = KeyLight()
        light.direction = wp.vec3(lights[k, 0], lights[k, 1], lights[k, 2])
        light.irradiance = wp.vec3(found.reds[k], found.greens[k], found.blues[k])
        light.directionality = 0.0
        if strength[k] > 0.0:
            light.directionality = alone * wp.clamp(2.0 * wp.dot(flow, light.direction) / all[3], 0.0, 1.0)
        key_lights_out[place] = light
        k += team.threads


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

    Every block does for itself what concerns sectors: to wait for each other would take longer. Texels are shared out,
    and only as far as the lobe reaches. Loops that are not to be unrolled are written as ``while``: a kernel that is
    run through once takes as long as its instructions take to arrive.
    """
    block, thread = wp.tid()
    team = Team()
    team.thread = thread
    team.threads = wp.block_dim()
    team.worker = block * team.threads + thread
    team.workers = blocks * team.threads
    team.lanes = lane_count()
    team.lane = thread % team.lanes
    all = sum_all(sums, team.lane, team.lanes)
    sky = Sky()
    sky.mean = all[3] / (4.0 * PI)
    sky.column_angle = 2.0 * PI / wp.float32(environment.shape[1])
    sky.cos_step = wp.cos(sky.column_angle * wp.float32(team.lanes))
    sky.sin_step = wp.sin(sky.column_angle * wp.float32(team.lanes))
    sky.area_of_sine = 2.0 * wp.sin(0.5 * PI / wp.float32(environment.shape[0])) * sky.column_angle
    found = Found()
    count = key_lights_out.shape[0]
    turn = int(0)

    for k in range(count):
        best = best_direction(sectors_out, team)
        direction = wp.vec3(best[0], best[1], best[2])
        peak = wp.float32(0.0)
        step = int(0)
        while step < 4:
            mine = LobeSums()
            if best[3] > 0.0:
                mine = sum_lobe(environment, team, sky, direction, found.directions, k, step, peak)
            if step == 3:
                take_from_sectors(direction, team, sectors_out)
            total = team_sum(mine.sum, blocks, turn)
            turn += 1
            if step == 1:
                peak = team_max(block_max(mine.highest), blocks, turn)
                turn += 1
            if step < 3:
                centre = wp.vec3(total[0], total[1], total[2])
                if wp.length(centre) > 0.0:
                    direction = wp.normalize(centre)
            else:
                given = wp.vec3(total[0], total[1], total[2])
                for place in range(MAX_KEY_LIGHTS):
                    if place == k:
                        found.reds[place] = given[0]
                        found.greens[place] = given[1]
                        found.blues[place] = given[2]
                        found.strengths[place] = luminance(given)
            step += 1
        for place in range(MAX_KEY_LIGHTS):
            if place == k:
                for axis in range(3):
                    found.directions[place, axis] = direction[axis]

    if block > 0:
        return
    compare_lights(found.directions, count, team, sectors_out)
    write_lights(found, all, team, sectors_out, key_lights_out)


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
