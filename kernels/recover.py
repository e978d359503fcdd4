"""What else the frame says about the environment: how bright surfaces are, and which part of it lights them.

The ball clips where emitters and windows are. Surfaces that the scene models (the white card, planes, boxes) do not, or
not there, and are lit by the same light. A surface point x with normal n and reflectance rho that shows the camera the
radiance L receives

    E(x) = pi L / rho = sum over the environment's cells m of T(x, m) radiance(m),     T(x, m) = cos solid_angle
    visibility.

The kernels here fill the two sides: ``observe_surfaces`` measures L, ``trace_transfer`` works out T, ``trace_emitters``
the same for emitters at finite distances. ``warp_ar.light.recovery`` solves for what is missing in the clipped cells,
``add_recovered`` puts it into the map.

**Saturation boundaries.** Half a pixel around an emitter clips as well: ``weigh_boundaries``.

**Cells.** The environment is condensed to ``CELL_ROWS`` x ``CELL_COLUMNS`` cells of a latlong grid (5.6 degrees), each
with its mean radiance, its share at clipping, and the direction in which that share lies.

**Visibility.** From x a cell is hidden in part or whole by a ball, softly: the cell is taken as a disc of its own
size, the ball as an edge in front of it. The ball also throws the light of every cell onto the point, as a convex
mirror does; that is kept apart, for real balls scatter some of it. Where a proxy is in the way, its radiance is what
the ball shows of it: the share goes to the cell in which the ball sees the point that was hit (no parallax is left for
what is modelled). The horizon needs no mention: what lies below a surface has no cosine.
"""

from __future__ import annotations

import functools

import warp as wp

from warp_ar.kernels.camera import project
from warp_ar.kernels.color import decode, is_saturated, saturation_codes
from warp_ar.kernels.latlong import (
    PI,
    direction_from_latlong,
    latlong_from_direction,
    sample_latlong,
    sample_row,
    texel_solid_angle,
)
from warp_ar.kernels.launch import QUICK_TO_COMPILE, Rows, launch_rows
from warp_ar.kernels.shapes import FAR, ROUNDING
from warp_ar.kernels.structs import FrameParams, Probe, RayScene
from warp_ar.kernels.trace import TraceConfig, make_trace, offset_origin
from warp_ar.kernels.unwrap import reflecting_normal

wp.set_module_options({"enable_backward": False})

CELL_ROWS = 32
CELL_COLUMNS = 64

PATCH = wp.constant(5)
"""Points along the side of the patch over which a surface point is averaged."""
BALL_MARGIN = wp.constant(wp.float32(1.08))
"""How much larger a ball is taken to be where it hides surfaces from the camera: its outline's blur."""
FULL_TRUST = wp.constant(wp.float32(0.5))
"""Confidence above which a texel counts as seen; as for filling."""
LOST = 0.02
"""Clipped share from which a cell's light is where it clips, not where nothing is seen, and the cell is in a region."""
_LOST = wp.constant(wp.float32(LOST))
FAR_FROM_BALL = wp.constant(wp.float32(10.0))
"""Radii from which what a ball throws is left out: (R / 2 s)^2, less than a four-hundredth of the light itself."""
GRAZING = wp.constant(wp.float32(1.0e-3))
"""Cosine below which a ball mirrors nothing: the light passes along its outline, and is seen straight."""
MAX_HALF_PIXEL = wp.constant(wp.float32(0.1))
"""Radians: balls of less than ten pixels are taken to have ten."""
WIDE = wp.constant(wp.float32(6.0))
"""Half pixels: what is wider clips hardly beyond its boundary, for it exceeds clipping by less than an emitter does."""
SHARPNESS = wp.constant(wp.float32(2.0))
"""Exponent of the share around a texel of the smallest emitter."""
BOUNDARY_REACH = wp.constant(2)
"""Samples of a Gaussian to each side, one standard deviation apart."""
MOST_LEFT = wp.constant(wp.float32(4.0))
"""How much more light what still clips of a cell may get because less of it clips."""
CLOSE = wp.constant(wp.float32(1.0e-3))
"""Relative distance within which what a camera ray meets is the surface itself."""


@wp.struct
class SurfacePoint:
    """A place on a physical surface."""

    position: wp.vec3
    normal: wp.vec3
    tangent: wp.vec3  # unit, along the patch's first side
    half: wp.float32  # half the side of the patch, metres


@wp.struct
class Observation:
    """What the frame shows of a surface point."""

    radiance: wp.vec3  # mean over the patch, linear camera values
    deviation: wp.vec3  # standard deviation over the patch
    clipped: wp.vec3  # share of the patch at clipping
    visible: wp.float32  # share of the patch that the camera sees, 0 where it sees none


@wp.struct
class Cell:
    """A part of the environment."""

    radiance: wp.vec3  # mean, as captured
    clipped: wp.vec3  # mean share that may lack light: at clipping, or, in a cell that shows no light, not seen
    missing: wp.vec3  # the same, saturation boundaries counting less
    hidden: wp.float32  # mean share that is not seen; 0 in a cell that shows some light
    modelled: wp.float32  # 1 where the first ball looks at a proxy, 0 where at the environment beyond
    middle: wp.vec3  # unit
    direction: wp.vec3  # unit: of what is at clipping, or of the cell's middle
    solid_angle: wp.float32


def cell_shape(height: int, width: int) -> tuple[int, int]:
    """Rows and columns of cells for a map of this size."""
    return min(CELL_ROWS, height), min(CELL_COLUMNS, width)


@wp.func
def trust(confidence: wp.float32) -> wp.float32:
    """How far a texel counts as seen, 0..1; 0 for NaN."""
    t = wp.clamp(confidence / FULL_TRUST, 0.0, 1.0)
    return wp.where(confidence > 0.0, t * t * (3.0 - 2.0 * t), 0.0)


@wp.func
def mean_around(
    clipped: wp.array2d[wp.vec3], i: wp.int32, j: wp.int32, deviation: wp.float32, near_pole: wp.float32
) -> wp.vec3:
    """Gaussian mean around a texel, of a standard deviation in radians.

    ``near_pole`` standard deviations from a pole it is taken around directions, elsewhere along rows and columns.
    """
    height = wp.float32(clipped.shape[0])
    width = wp.float32(clipped.shape[1])
    sine = wp.sin(PI * (wp.float32(i) + 0.5) / height)
    total = wp.vec3(0.0, 0.0, 0.0)
    total_weight = wp.float32(0.0)
    a = wp.int32(-BOUNDARY_REACH)
    if sine < near_pole * deviation:
        # A circle of latitude is no straight line here.
        direction = direction_from_latlong(wp.float32(i) + 0.5, wp.float32(j) + 0.5, clipped.shape[0], clipped.shape[1])
        across = wp.normalize(wp.cross(direction, wp.vec3(1.0, 0.0, 0.0)))
        upward = wp.cross(across, direction)
        while a <= BOUNDARY_REACH:
            b = wp.int32(-BOUNDARY_REACH)
            while b <= BOUNDARY_REACH:
                toward = direction + deviation * (wp.float32(a) * across + wp.float32(b) * upward)
                weight = wp.exp(-0.5 * wp.float32(a * a + b * b))
                total += weight * sample_latlong(clipped, toward)
                total_weight += weight
                b += 1
            a += 1
        return total / total_weight
    down_step = deviation * height / PI
    across_step = deviation * width / (2.0 * PI * sine)
    # One row of samples at a time, those unrolled: their loads do not wait for each other.
    while a <= BOUNDARY_REACH:
        y = wp.float32(i) + down_step * wp.float32(a)
        row = wp.int32(wp.floor(y))
        part = y - wp.floor(y)
        for b in range(wp.static(-BOUNDARY_REACH), wp.static(BOUNDARY_REACH + 1)):
            x = wp.float32(j) + across_step * wp.float32(b)
            top = sample_row(clipped, row, x)
            weight = wp.exp(-0.5 * wp.float32(a * a + b * b))
            total += weight * (top + part * (sample_row(clipped, row + 1, x) - top))
            total_weight += weight
        a += 1
    return total / total_weight


@wp.kernel(enable_backward=False)
def weigh_boundaries_kernel(
    # In:
    row_start: wp.int32,
    clipped: wp.array2d[wp.vec3],
    params: wp.array[FrameParams],
    probes: wp.array[Probe],
    # Out:
    missing_out: wp.array2d[wp.vec3],
):
    """A texel times a power of the mean around it."""
    i, j = wp.tid()
    i += row_start
    share = clipped[i, j]
    if not wp.max(share) > 0.0:
        missing_out[i, j] = wp.vec3(0.0, 0.0, 0.0)
        return
    to_ball = probes[0].center - params[0].camera_position
    pixels = params[0].focal[0] * probes[0].radius / wp.length(to_ball)
    # A pixel in the middle of the ball is 1 / pixels radians of its normals, twice that of what they mirror.
    half_pixel = wp.clamp(1.0 / pixels, 0.0, MAX_HALF_PIXEL)
    around = wp.max(mean_around(clipped, i, j, half_pixel, 6.0))
    if around < 0.999:
        # Along rows and columns nearly everywhere: how wide something is need not be known exactly.
        wide = wp.max(mean_around(clipped, i, j, WIDE * half_pixel, 1.5))
        around = wp.pow(around, SHARPNESS * wp.max(1.0 - 2.0 * wide, 0.0))
    missing_out[i, j] = share * around


def weigh_boundaries(
    clipped: wp.array,
    params: wp.array,
    probes: wp.array,
    missing_out: wp.array,
    *,
    rows: Rows | None = None,
) -> None:
    """Weigh what clips by how likely it is the light itself: saturation boundaries count less.

    A pixel at a light's boundary shows part of the light, and clips all the same if that is bright: what clips in the
    ball's picture is larger than the light by up to a pixel. A texel counts by the mean share at clipping around it,
    in the channel that clips most and by a Gaussian of half a pixel's standard deviation, to the power

        2 max(0, 1 - 2 w),    w the same mean by a Gaussian of three pixels.

    An emitter of a few pixels becomes as small as it is, and so do its shadows and highlights. Windows keep theirs
    (w is a half there): they are not so much brighter than clipping that a pixel clips of which they are a small part.

    Args:
        clipped: Share at clipping per channel, ``wp.vec3`` (h, w).
        params: ``FrameParams`` (1): the camera.
        probes: ``Probe`` (P), at least one: the ball.
        missing_out: ``wp.vec3`` (h, w), 0 where nothing clips.
        rows: Band of rows, None for all.
    """
    launch_rows(
        weigh_boundaries_kernel,
        clipped.shape,
        [clipped, params, probes],
        [missing_out],
        rows=rows,
        device=clipped.device,
    )


@functools.cache
def make_condense_cells_kernel(proxies: tuple[int, ...]) -> wp.Kernel:
    """Kernel for the given kinds of proxy."""
    trace = make_trace(TraceConfig(objects=(), proxies=proxies))

    @wp.kernel(module="unique", enable_backward=False, module_options=QUICK_TO_COMPILE)
    def condense_cells_kernel(
        # In:
        row_start: wp.int32,
        radiance: wp.array2d[wp.vec3],
        confidence: wp.array2d[wp.float32],
        clipped: wp.array2d[wp.vec3],
        missing: wp.array2d[wp.vec3],
        probes: wp.array[Probe],
        scene: RayScene,
        # Out:
        cells_out: wp.array2d[Cell],
    ):
        band_row, column = wp.tid()
        row = row_start + band_row
        height = radiance.shape[0]
        width = radiance.shape[1]
        rows = cells_out.shape[0]
        columns = cells_out.shape[1]
        cell = Cell()
        toward = wp.vec3(0.0, 0.0, 0.0)
        lost_toward = wp.vec3(0.0, 0.0, 0.0)
        for i in range(row * height // rows, (row + 1) * height // rows):
            area = texel_solid_angle(i, height, width)
            for j in range(column * width // columns, (column + 1) * width // columns):
                direction = direction_from_latlong(wp.float32(i) + 0.5, wp.float32(j) + 0.5, height, width)
                trusted = trust(confidence[i, j])
                lost = trusted * clipped[i, j]
                cell.solid_angle += area
                cell.radiance += area * radiance[i, j]
                cell.clipped += area * lost
                cell.missing += area * trusted * missing[i, j]
                cell.hidden += area * (1.0 - trusted)
                toward += area * direction
                lost_toward += area * (lost[0] + lost[1] + lost[2]) * direction
        cell.radiance /= cell.solid_angle
        cell.clipped /= cell.solid_angle
        cell.missing /= cell.solid_angle
        cell.hidden /= cell.solid_angle
        if wp.max(cell.clipped) > _LOST:
            cell.hidden = 0.0
        else:
            cell.clipped += cell.hidden * wp.vec3(1.0, 1.0, 1.0)
            cell.missing += cell.hidden * wp.vec3(1.0, 1.0, 1.0)
        cell.middle = wp.normalize(toward)
        cell.direction = cell.middle
        if wp.length(lost_toward) > 0.0:
            cell.direction = wp.normalize(lost_toward)
        if trace.occluded_by_proxies(scene, probes[0].center, cell.direction, FAR):
            cell.modelled = 1.0
        cells_out[row, column] = cell

    return condense_cells_kernel


def condense_cells(
    radiance: wp.array,
    confidence: wp.array,
    clipped: wp.array,
    missing: wp.array,
    probes: wp.array,
    scene: RayScene,
    cells_out: wp.array,
    *,
    proxies: tuple[int, ...],
    rows: Rows | None = None,
) -> None:
    """Condense a map to cells.

    Args:
        radiance: ``wp.vec3`` (h, w), complete.
        confidence: How well each texel was seen, ``wp.float32`` (h, w).
        clipped: Share at clipping per channel, ``wp.vec3`` (h, w).
        missing: The same from ``weigh_boundaries``.
        probes: ``Probe`` (P), at least one.
        scene: Its proxies are known surfaces: what clips there is lit, not a light.
        cells_out: ``Cell``, ``cell_shape(h, w)``.
        proxies: Kinds of proxy in the scene.
        rows: Band of cell rows, None for all.
    """
    launch_rows(
        make_condense_cells_kernel(proxies),
        cells_out.shape,
        [radiance, confidence, clipped, missing, probes, scene],
        [cells_out],
        rows=rows,
        device=cells_out.device,
    )


@wp.func
def missing_share(confidence: wp.float32, missing: wp.vec3, unseen: wp.float32) -> wp.vec3:
    """Share of a texel that lacks light, where ``unseen`` is what counts of one that is not seen."""
    trusted = trust(confidence)
    return trusted * missing + unseen * (1.0 - trusted) * wp.vec3(1.0, 1.0, 1.0)


@wp.kernel(enable_backward=False)
def add_recovered_kernel(
    # In:
    row_start: wp.int32,
    radiance: wp.array2d[wp.vec3],
    confidence: wp.array2d[wp.float32],
    missing: wp.array2d[wp.vec3],
    cells: wp.array2d[Cell],
    recovered: wp.array2d[wp.vec3],
    # Out:
    recovered_out: wp.array2d[wp.vec3],
):
    """Every texel of a cell plus its share of the cell's excess."""
    band_row, column = wp.tid()
    row = row_start + band_row
    height = radiance.shape[0]
    width = radiance.shape[1]
    top = row * height // recovered.shape[0]
    bottom = (row + 1) * height // recovered.shape[0]
    left = column * width // recovered.shape[1]
    right = (column + 1) * width // recovered.shape[1]
    unseen = wp.where(cells[row, column].hidden > 0.0, 1.0, 0.0)
    now = wp.vec3(0.0, 0.0, 0.0)
    solid_angle = wp.float32(0.0)
    for i in range(top, bottom):
        area = texel_solid_angle(i, height, width)
        for j in range(left, right):
            now += area * missing_share(confidence[i, j], missing[i, j], unseen)
            solid_angle += area
    now /= solid_angle
    more = recovered[row, column]
    then = cells[row, column].missing
    for c in range(3):
        if now[c] > 0.0:
            more[c] *= wp.min(then[c] / now[c], MOST_LEFT)
    for i in range(top, bottom):
        for j in range(left, right):
            share = missing_share(confidence[i, j], missing[i, j], unseen)
            recovered_out[i, j] = radiance[i, j] + wp.cw_mul(share, more)


def add_recovered(
    radiance: wp.array,
    confidence: wp.array,
    missing: wp.array,
    cells: wp.array,
    recovered: wp.array,
    recovered_out: wp.array,
    *,
    rows: Rows | None = None,
) -> None:
    """Give texels back what they lost.

    Where more or less of a cell clips than when its excess was found, the energy stays what was found: a thousandth
    that clips can have a high excess, and in the next frame be half of the cell; a video codec takes the weakest
    channel of an emitter across the limit and back. Below a quarter of the share the energy falls with it.

    Args:
        radiance: As captured and completed, ``wp.vec3`` (h, w).
        confidence: How well each texel was seen, ``wp.float32`` (h, w).
        missing: Share at clipping per channel from ``weigh_boundaries``, ``wp.vec3`` (h, w).
        cells: ``Cell``, ``cell_shape(h, w)``, of when the excess was found.
        recovered: Radiance that a wholly clipped texel lacks, per cell: ``wp.vec3``, ``cell_shape(h, w)``.
        recovered_out: ``wp.vec3`` (h, w).
        rows: Band of rows of cells, None for all.
    """
    launch_rows(
        add_recovered_kernel,
        recovered.shape,
        [radiance, confidence, missing, cells, recovered],
        [recovered_out],
        rows=rows,
        device=recovered_out.device,
    )


@wp.func
def surface_error(scene: RayScene, point: SurfacePoint) -> wp.float32:
    """How far off its surface a point may lie, metres; which proxy that is is not kept, so the largest bounds it."""
    size = wp.float32(0.0)
    for index in range(scene.proxies.shape[0]):
        size = wp.max(size, scene.proxies[index].scale * wp.length(scene.proxies[index].extent))
    return ROUNDING * (8.0 * wp.max(wp.abs(point.position)) + 32.0 * size)


@wp.func
def distance_to_sphere(center: wp.vec3, radius: wp.float32, origin: wp.vec3, direction: wp.vec3) -> wp.float32:
    """Distance along a unit direction to a sphere that the ray meets from outside; negative if it does not."""
    to_center = center - origin
    along = wp.dot(to_center, direction)
    off = to_center - along * direction
    within = radius * radius - wp.dot(off, off)
    if along <= 0.0 or within <= 0.0:
        return -1.0
    return along - wp.sqrt(within)


@wp.func
def hidden_share(
    center: wp.vec3, radius: wp.float32, origin: wp.vec3, direction: wp.vec3, cell_angle: wp.float32
) -> wp.float32:
    """Share of a disc of angular radius ``cell_angle`` around ``direction`` that a ball hides.

    Both are taken to meet along a straight edge: (3 t - t^3) / 4 + 1 / 2 with t in -1..1 is within 2 % of a disc's
    exact share.
    """
    to_center = center - origin
    away = wp.length(to_center)
    if away <= radius:
        return 0.0
    # atan2 of both: exact for small angles.
    side = wp.length(wp.cross(to_center, direction))
    t = (wp.asin(radius / away) - wp.atan2(side, wp.dot(to_center, direction))) / cell_angle
    t = wp.clamp(t, -1.0, 1.0)
    return 0.5 + 0.25 * t * (3.0 - t * t)


@wp.func
def mirrored_irradiance(probe: Probe, point: SurfacePoint, light: wp.vec3) -> wp.float32:
    """Irradiance at a surface point by way of a ball, per unit irradiance of a parallel beam from direction ``light``.

    The ball's point with normal n that mirrors the beam to x halves the angle a between both. There a convex mirror
    has the focal lengths R cos a / 2 (in the plane of incidence) and R / (2 cos a) (across it); at the distance s the
    beam is wider by

        (1 + 2 s / (R cos a)) (1 + 2 s cos a / R).
    """
    to_point = point.position - probe.center
    distance = wp.length(to_point) / probe.radius
    if distance < 1.001 or distance > FAR_FROM_BALL:
        return 0.0
    axis = wp.normalize(to_point)
    cos_psi = wp.dot(light, axis)
    side = light - cos_psi * axis
    sin_psi = wp.length(side)
    least = 1.0 / distance
    if cos_psi <= -wp.sqrt((1.0 - least) * (1.0 + least)):
        return 0.0  # the point lies in the ball's shadow, where no ray is mirrored to
    if sin_psi > 1.0e-6:
        side = side / sin_psi
    n = reflecting_normal(distance, cos_psi, sin_psi)
    normal = n[0] * axis + n[1] * side
    leave = to_point - probe.radius * normal
    s = wp.length(leave)
    cos_a = wp.dot(normal, light)
    cosine = -wp.dot(leave, point.normal) / s
    if cos_a < GRAZING or cosine <= 0.0 or wp.dot(leave, normal) <= 0.0:
        return 0.0
    spread = (1.0 + 2.0 * s / (probe.radius * cos_a)) * (1.0 + 2.0 * s * cos_a / probe.radius)
    grey = (probe.reflectance[0] + probe.reflectance[1] + probe.reflectance[2]) / 3.0
    return grey * cosine / spread


@wp.func
def cell_of(direction: wp.vec3, rows: wp.int32, columns: wp.int32) -> wp.int32:
    """Index of the cell that holds a direction."""
    at = latlong_from_direction(direction, rows, columns)
    row = wp.clamp(wp.int32(at[0]), 0, rows - 1)
    return row * columns + wp.clamp(wp.int32(at[1]), 0, columns - 1)


@functools.cache
def make_kernels(proxies: tuple[int, ...]) -> tuple[wp.Kernel, wp.Kernel, wp.Kernel]:
    """Kernels for the given kinds of proxy: observe, transfer, emitters."""
    trace = make_trace(TraceConfig(objects=(), proxies=proxies))

    @wp.kernel(module="unique", enable_backward=False, module_options=QUICK_TO_COMPILE)
    def observe_surfaces_kernel(
        # In:
        row_start: wp.int32,
        frame: wp.array2d[wp.vec3ub],
        table: wp.array[wp.vec3],
        params: wp.array[FrameParams],
        probes: wp.array[Probe],
        scene: RayScene,
        points: wp.array[SurfacePoint],
        # Out:
        observations_out: wp.array[Observation],
    ):
        index = row_start + wp.tid()
        camera = params[0]
        point = points[index]
        seen = Observation()
        across = wp.cross(point.normal, point.tangent)
        saturation = saturation_codes(table)
        if wp.dot(point.normal, camera.camera_position - point.position) > 0.0:
            squares = wp.vec3(0.0, 0.0, 0.0)
            count = wp.float32(0.0)
            side = wp.int32(PATCH)  # a variable: the loops stay loops, and the kernel a seventh of its size
            for a in range(side):
                for b in range(side):
                    u = (2.0 * wp.float32(a) + 1.0) / wp.float32(PATCH) - 1.0
                    v = (2.0 * wp.float32(b) + 1.0) / wp.float32(PATCH) - 1.0
                    place = point.position + point.half * (u * point.tangent + v * across)
                    ray = place - camera.camera_position
                    at = project(camera, ray)
                    i = wp.int32(wp.round(wp.clamp(at[1], -1.0, 1.0e6)))
                    j = wp.int32(wp.round(wp.clamp(at[0], -1.0, 1.0e6)))
                    clear = at[2] > 0.0 and i >= 0 and j >= 0 and i < frame.shape[0] and j < frame.shape[1]
                    if clear:
                        reach = wp.length(ray)
                        for k in range(probes.shape[0]):
                            t = distance_to_sphere(
                                probes[k].center, BALL_MARGIN * probes[k].radius, camera.camera_position, ray / reach
                            )
                            if t >= 0.0 and t < reach:
                                clear = False
                        if trace.occluded_by_proxies(scene, camera.camera_position, ray, 1.0 - CLOSE):
                            clear = False
                    if clear:
                        code = frame[i, j]
                        value = decode(table, code)
                        count += 1.0
                        before = value - seen.radiance
                        seen.radiance += before / count
                        squares += wp.cw_mul(before, value - seen.radiance)
                        seen.clipped += is_saturated(code, saturation)
            if count > 0.0:
                seen.clipped /= count
                seen.visible = count / wp.float32(PATCH * PATCH)
                for channel in range(3):
                    seen.deviation[channel] = wp.sqrt(wp.max(squares[channel], 0.0) / count)
        observations_out[index] = seen

    @wp.kernel(module="unique", enable_backward=False, module_options=QUICK_TO_COMPILE)
    def trace_transfer_kernel(
        # In:
        row_start: wp.int32,
        points: wp.array[SurfacePoint],
        observations: wp.array[Observation],
        cells: wp.array2d[Cell],
        probes: wp.array[Probe],
        scene: RayScene,
        # Out:
        traced_out: wp.array[wp.int32],
        transfer_out: wp.array2d[wp.float32],
        mirrored_out: wp.array2d[wp.float32],
    ):
        index = row_start + wp.tid()
        if traced_out[index] != 0 or observations[index].visible <= 0.0:
            return
        traced_out[index] = 1
        rows = cells.shape[0]
        columns = cells.shape[1]
        for m in range(rows * columns):
            transfer_out[index, m] = 0.0
            mirrored_out[index, m] = 0.0
        point = points[index]
        error = surface_error(scene, point)
        for m in range(rows * columns):
            middle = cells[m // columns, m % columns].middle
            solid_angle = cells[m // columns, m % columns].solid_angle
            for k in range(probes.shape[0]):
                more = solid_angle * mirrored_irradiance(probes[k], point, middle)
                mirrored_out[index, m] = mirrored_out[index, m] + more
            cosine = wp.dot(middle, point.normal)
            if cosine > 0.0:
                share = cosine * solid_angle
                angle = wp.sqrt(solid_angle / PI)
                for k in range(probes.shape[0]):
                    share *= 1.0 - hidden_share(probes[k].center, probes[k].radius, point.position, middle, angle)
                target = m
                origin = offset_origin(point.position, point.normal, middle, error)
                hit = trace.closest_proxy(scene, origin, middle, FAR)
                if hit.shape >= 0:
                    target = cell_of(hit.point - probes[0].center, rows, columns)
                transfer_out[index, target] = transfer_out[index, target] + share

    @wp.kernel(module="unique", enable_backward=False, module_options=QUICK_TO_COMPILE)
    def trace_emitters_kernel(
        # In:
        row_start: wp.int32,
        points: wp.array[SurfacePoint],
        observations: wp.array[Observation],
        emitters: wp.array[wp.vec4],
        probes: wp.array[Probe],
        scene: RayScene,
        # Out:
        transfer_out: wp.array2d[wp.float32],
    ):
        band_row, index = wp.tid()
        row = row_start + band_row
        point = points[row]
        emitter = emitters[index]
        center = wp.vec3(emitter[0], emitter[1], emitter[2])
        given = wp.float32(0.0)
        if observations[row].visible > 0.0:
            ray = center - point.position
            away = wp.length(ray)
            cosine = wp.dot(ray, point.normal) / away
            if cosine > 0.0 and away > emitter[3]:
                direction = ray / away
                given = cosine / (away * away)
                origin = offset_origin(point.position, point.normal, direction, surface_error(scene, point))
                if trace.occluded_by_proxies(scene, origin, direction, away - emitter[3]):
                    given = 0.0
                for k in range(probes.shape[0]):
                    if wp.dot(probes[k].center - point.position, direction) < away:
                        given *= 1.0 - hidden_share(
                            probes[k].center, probes[k].radius, point.position, direction, wp.asin(emitter[3] / away)
                        )
            for k in range(probes.shape[0]):
                from_ball = center - probes[k].center
                beam = 1.0 / wp.dot(from_ball, from_ball)
                given += beam * mirrored_irradiance(probes[k], point, wp.normalize(from_ball))
        transfer_out[row, index] = given

    return observe_surfaces_kernel, trace_transfer_kernel, trace_emitters_kernel


def observe_surfaces(
    frame: wp.array,
    decode_table: wp.array,
    params: wp.array,
    probes: wp.array,
    scene: RayScene,
    points: wp.array,
    observations_out: wp.array,
    *,
    proxies: tuple[int, ...],
    rows: Rows | None = None,
) -> None:
    """Measure what the frame shows of surface points.

    Args:
        frame: ``wp.vec3ub`` (frame rows, columns), RGB codes.
        decode_table: Linear value of each code, ``wp.vec3`` (256).
        params: ``FrameParams`` (1): the camera.
        probes: ``Probe`` (P): they hide surfaces.
        scene: Its proxies hide surfaces as well.
        points: ``SurfacePoint`` (n).
        observations_out: ``Observation`` (n).
        proxies: Kinds of proxy in the scene.
        rows: Band of points, None for all.
    """
    launch_rows(
        make_kernels(proxies)[0],
        observations_out.shape,
        [frame, decode_table, params, probes, scene, points],
        [observations_out],
        rows=rows,
        device=observations_out.device,
    )


def trace_transfer(
    points: wp.array,
    observations: wp.array,
    cells: wp.array,
    probes: wp.array,
    scene: RayScene,
    traced_out: wp.array,
    transfer_out: wp.array,
    mirrored_out: wp.array,
    *,
    proxies: tuple[int, ...],
    rows: Rows | None = None,
) -> None:
    """Irradiance that a surface point receives from each cell of the environment, per unit of the cell's radiance.

    Nothing of it changes from frame to frame, so each point is traced once: when the camera first sees it.

    Args:
        points: ``SurfacePoint`` (n).
        observations: ``Observation`` (n): points that the camera does not see are left out.
        cells: ``Cell`` (rows, columns): middles and solid angles.
        probes: ``Probe`` (P), at least one; the environment is the one that the first sees.
        scene: Its proxies hide the environment.
        traced_out: 1 where a point has been traced, 0 before, ``wp.int32`` (n).
        transfer_out: Straight, past balls and proxies, ``wp.float32`` (n, rows * columns).
        mirrored_out: By way of balls, ``wp.float32`` (n, rows * columns).
        proxies: Kinds of proxy in the scene.
        rows: Band of points, None for all.
    """
    launch_rows(
        make_kernels(proxies)[1],
        points.shape,
        [points, observations, cells, probes, scene],
        [traced_out, transfer_out, mirrored_out],
        rows=rows,
        device=transfer_out.device,
    )


def trace_emitters(
    points: wp.array,
    observations: wp.array,
    emitters: wp.array,
    probes: wp.array,
    scene: RayScene,
    transfer_out: wp.array,
    *,
    proxies: tuple[int, ...],
    rows: Rows | None = None,
    stream: wp.Stream | None = None,
) -> None:
    """Irradiance that a surface point receives from emitters, per unit of their radiant intensity.

    Args:
        points: ``SurfacePoint`` (n).
        observations: ``Observation`` (n): points that the camera does not see receive nothing.
        emitters: ``wp.vec4`` (q): position and radius in metres.
        probes: ``Probe`` (P).
        scene: Its proxies hide emitters.
        transfer_out: ``wp.float32`` (n, q), per square metre.
        proxies: Kinds of proxy in the scene.
        rows: Band of points, None for all.
        stream: CUDA stream; None means the device's current one.
    """
    launch_rows(
        make_kernels(proxies)[2],
        transfer_out.shape,
        [points, observations, emitters, probes, scene],
        [transfer_out],
        rows=rows,
        device=transfer_out.device,
        stream=stream,
    )
