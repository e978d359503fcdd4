"""Linear equations of recovery: radiance of surface points, and light transfer from cells of the environment.

Emitters and windows clip in the ball. Surfaces that the scene models (the white card, planes, boxes) are lit by them
and mostly do not clip. A surface point x with normal n, reflectance rho and radiance L toward the camera receives

    E(x) = pi L / rho = sum over cells m of the environment of  T(x, m) radiance(m),
    T(x, m) = cos(n, m) solid_angle(m) visibility(x, m).

``observe_surfaces`` measures L. ``trace_transfer`` computes T for cells, ``trace_emitters`` for emitters at finite
distances. ``kernels/recovery/recover_cells.py`` makes the cells; ``warp_ar.light.recovery`` solves for the missing
radiance of the clipped ones.
"""

import functools

import warp as wp

from warp_ar.kernels.camera import project
from warp_ar.kernels.color import decode, is_saturated, saturation_codes
from warp_ar.kernels.environment.unwrap import reflecting_normal
from warp_ar.kernels.latlong import PI
from warp_ar.kernels.launch import row_launcher
from warp_ar.kernels.pixels import clip_levels, is_at_clipping, keep_linear
from warp_ar.kernels.rays.shapes import FAR, ROUNDING
from warp_ar.kernels.rays.trace import TraceConfig, make_trace, offset_origin
from warp_ar.kernels.recovery.recover_cells import Cell, cell_of
from warp_ar.kernels.structs import FrameParams, Probe, RayScene

wp.set_module_options({"enable_backward": False})

PATCH = wp.constant(5)
"""Points along the side of the square patch over which a surface point's radiance is averaged."""
BALL_MARGIN = wp.constant(wp.float32(1.08))
"""Factor on a ball's radius in tests of what it hides, because its outline in the frame is blurred."""
FAR_FROM_BALL = wp.constant(wp.float32(10.0))
"""Distance in radii beyond which light reflected by a ball is ignored: (R / 2 s)^2, less than 1/400 of the light
itself."""
GRAZING = wp.constant(wp.float32(1.0e-3))
"""Cosine below which reflection at a ball is ignored: such light passes the ball's outline directly."""
CLOSE = wp.constant(wp.float32(1.0e-3))
"""Relative distance within which a camera ray's hit is the surface itself."""


@wp.struct
class SurfacePoint:
    """A square patch of a physical surface."""

    position: wp.vec3  # centre
    normal: wp.vec3
    tangent: wp.vec3  # unit, along the patch's first side
    half: wp.float32  # half the side of the patch, metres


@wp.struct
class Observation:
    """Radiance of a surface point in the frame."""

    radiance: wp.vec3  # mean over the patch, linear camera values
    deviation: wp.vec3  # standard deviation over the patch
    clipped: wp.vec3  # clipped share of the patch
    visible: wp.float32  # share of the patch that the camera sees


@wp.func
def surface_error(scene: RayScene, point: SurfacePoint) -> wp.float32:
    """Return a bound, metres, on a point's distance from its surface by rounding, for the largest proxy."""
    size = wp.float32(0.0)
    for index in range(scene.proxies.shape[0]):
        size = wp.max(size, scene.proxies[index].scale * wp.length(scene.proxies[index].extent))
    return ROUNDING * (8.0 * wp.max(wp.abs(point.position)) + 32.0 * size)


@wp.func
def distance_to_sphere(center: wp.vec3, radius: wp.float32, origin: wp.vec3, direction: wp.vec3) -> wp.float32:
    """Return the distance, metres, at which a ray of unit direction enters a sphere; negative if it does not."""
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
    """Return the share of a disc of angular radius ``cell_angle`` around ``direction`` that a ball hides.

    The ball's outline is taken to be straight over the disc: (3 t - t^3) / 4 + 1 / 2 with t in -1..1 is within 2 % of
    the disc's exact share beyond a straight edge.
    """
    to_center = center - origin
    away = wp.length(to_center)
    if away <= radius:
        return 0.0
    # atan2 of sine and cosine: accurate for small angles.
    side = wp.length(wp.cross(to_center, direction))
    t = (wp.asin(radius / away) - wp.atan2(side, wp.dot(to_center, direction))) / cell_angle
    t = wp.clamp(t, -1.0, 1.0)
    return 0.5 + 0.25 * t * (3.0 - t * t)


@wp.func
def mirrored_irradiance(probe: Probe, point: SurfacePoint, light: wp.vec3) -> wp.float32:
    """Return the irradiance at a surface point by reflection at a ball, per unit irradiance of a parallel beam.

    The beam comes from the direction ``light``. At the ball's point with normal n that reflects it to x, a is the angle
    of incidence. There a convex mirror has the focal lengths R cos a / 2 (in the plane of incidence) and R / (2 cos a)
    (across it). At the distance s the cross-section of the beam has grown by the factor

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
        return 0.0  # the point lies in the ball's shadow, which no reflected ray reaches
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


@functools.cache
def make_observe_surfaces_kernel(proxies: tuple[int, ...], linear: bool = False) -> wp.Kernel:
    """Return the kernel of ``observe_surfaces`` for kinds of proxy, and frames of 8-bit codes or ``linear`` ones."""
    trace = make_trace(TraceConfig(objects=(), proxies=proxies))
    pixel = wp.vec3 if linear else wp.vec3ub
    to_light = keep_linear if linear else decode
    find_levels = clip_levels if linear else saturation_codes
    clips = is_at_clipping if linear else is_saturated

    @wp.kernel(module="unique", enable_backward=False)
    def observe_surfaces_kernel(
        # In:
        row_start: wp.int32,
        frame: wp.array2d[pixel],
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
        levels = find_levels(table)
        if wp.dot(point.normal, camera.camera_position - point.position) > 0.0:
            squares = wp.vec3(0.0, 0.0, 0.0)
            count = wp.float32(0.0)
            side = wp.int32(PATCH)  # a variable: loops are not unrolled, and the kernel is a seventh of the size
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
                        shown = frame[i, j]
                        value = to_light(table, shown)
                        count += 1.0
                        before = value - seen.radiance
                        seen.radiance += before / count
                        squares += wp.cw_mul(before, value - seen.radiance)
                        seen.clipped += clips(shown, levels)
            if count > 0.0:
                seen.clipped /= count
                seen.visible = count / wp.float32(PATCH * PATCH)
                for channel in range(3):
                    seen.deviation[channel] = wp.sqrt(wp.max(squares[channel], 0.0) / count)
        observations_out[index] = seen

    return observe_surfaces_kernel


observe_surfaces = row_launcher(make_observe_surfaces_kernel, configs=2)
"""Measure the frame's radiance at surface points.

Args:
    proxies: Kinds of proxy in the scene.
    linear: Whether the frame is linear.
    frame: ``wp.vec3ub`` (frame rows, columns), RGB codes; or ``wp.vec3``, linear radiance.
    decode_table: Linear value of each code, ``wp.vec3`` (256). For a linear frame, ``wp.vec3`` (2): the values from
        which channels count as clipped, alone and beside a clipped channel.
    params: ``FrameParams`` (1): the camera.
    probes: ``Probe`` (P): they hide surfaces.
    scene: Its proxies hide surfaces as well.
    points: ``SurfacePoint`` (n).
    observations_out: ``Observation`` (n).
"""


# Visibility. A ball may hide part of a cell: the cell is taken to be a disc of its own size, the ball's outline a
# straight edge before it. The ball also reflects the light of every cell onto the point, as a convex mirror. That light
# is kept apart, because real balls scatter some of it. If a proxy hides the cell, its radiance is that which the ball
# shows: the transfer is added to the cell in which the ball sees the point that was hit, so modelled surfaces have no
# parallax error. Cells below the surface's horizon have a negative cosine and are left out.
@functools.cache
def make_trace_transfer_kernel(proxies: tuple[int, ...]) -> wp.Kernel:
    """Return the kernel of ``trace_transfer`` for the given kinds of proxy."""
    trace = make_trace(TraceConfig(objects=(), proxies=proxies))

    @wp.kernel(module="unique", enable_backward=False)
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

    return trace_transfer_kernel


trace_transfer = row_launcher(make_trace_transfer_kernel, outputs=3, like=lambda points, *_: points)
"""Compute the irradiance of surface points by each cell of the environment, per unit of the cell's radiance.

It does not change between frames, so each point is traced once, when the camera first sees it.

Args:
    proxies: Kinds of proxy in the scene.
    points: ``SurfacePoint`` (n).
    observations: ``Observation`` (n): points that the camera does not see are left out.
    cells: ``Cell`` (rows, columns): centres and solid angles.
    probes: ``Probe`` (P), at least one; the environment is that of the first.
    scene: Its proxies hide the environment.
    traced_out: 1 if a point was traced, else 0, ``wp.int32`` (n).
    transfer_out: Direct transfer, with occlusion by balls and proxies, ``wp.float32`` (n, rows * columns).
    mirrored_out: Transfer by reflection at balls, ``wp.float32`` (n, rows * columns).
"""


@functools.cache
def make_trace_emitters_kernel(proxies: tuple[int, ...]) -> wp.Kernel:
    """Return the kernel of ``trace_emitters`` for the given kinds of proxy."""
    trace = make_trace(TraceConfig(objects=(), proxies=proxies))

    @wp.kernel(module="unique", enable_backward=False)
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

    return trace_emitters_kernel


trace_emitters = row_launcher(make_trace_emitters_kernel)
"""Compute the irradiance of surface points by emitters, per unit of the emitters' radiant intensity.

Args:
    proxies: Kinds of proxy in the scene.
    points: ``SurfacePoint`` (n).
    observations: ``Observation`` (n): points that the camera does not see receive nothing.
    emitters: ``wp.vec4`` (q): position and radius in metres.
    probes: ``Probe`` (P).
    scene: Its proxies hide emitters.
    transfer_out: ``wp.float32`` (n, q), per square metre.
    stream: CUDA stream; None means the device's current one.
"""
