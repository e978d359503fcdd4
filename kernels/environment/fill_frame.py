"""Directions that no ball shows, looked up in the camera's own picture.

Behind the ball, and near its rim, where a pixel is many degrees, the map of the environment is filled from neighbours.
A good part of it stands in the picture, beyond and beside the ball. A direction d from the ball's centre is looked up

- where a proxy is in the way: at the pixel of the point that is hit, if the camera sees that point, and if it lies
  ``OWN_SHADOW`` radii from every ball: closer, the picture shows the ball's own shadow, which no object elsewhere sees;
- elsewhere at infinity: at the pixel in which the camera looks along d, if it sees past balls and proxies there.

What is near and not modelled is seen from another side than the ball would see it, so the picture is trusted less than
the ball, ``FRAME_TRUST``, and only for that part of a texel's trust which the ball leaves open. A texel is the mean of
``SIDE`` x ``SIDE`` directions, by the share that is seen.
"""

from __future__ import annotations

import functools

import warp as wp

from warp_ar.kernels.camera import project
from warp_ar.kernels.latlong import direction_from_latlong
from warp_ar.kernels.launch import row_launcher
from warp_ar.kernels.pixels import pixel_radiance
from warp_ar.kernels.rays.shapes import FAR
from warp_ar.kernels.rays.trace import TraceConfig, make_trace
from warp_ar.kernels.structs import FrameParams, Picture, Probe, RayScene

wp.set_module_options({"enable_backward": False})

SIDE = wp.constant(3)
"""Directions along the side of a texel."""
FRAME_TRUST = wp.constant(wp.float32(0.8))
"""Trust in a texel from the picture; one from a ball has 1."""
BALL_MARGIN = wp.constant(wp.float32(1.08))
"""Factor on a ball's radius for hiding surfaces, because its outline is blurred."""
OWN_SHADOW = wp.constant(wp.float32(6.0))
"""Distance in radii within which a ball shades surfaces: its shadow in light 10 degrees above them."""
CLOSE = wp.constant(wp.float32(1.0e-3))
"""Relative distance within which a camera ray's hit is the surface itself."""
ENOUGH = wp.constant(wp.float32(0.999))
"""Trust from which a ball needs no help of the picture."""


@wp.func
def passes_balls(probes: wp.array[Probe], origin: wp.vec3, direction: wp.vec3, reach: wp.float32) -> wp.bool:
    """Return whether a ray of unit direction meets no ball up to a distance."""
    for k in range(probes.shape[0]):
        to_center = probes[k].center - origin
        along = wp.dot(to_center, direction)
        off = to_center - along * direction
        radius = BALL_MARGIN * probes[k].radius
        if along > 0.0 and along < reach and wp.dot(off, off) < radius * radius:
            return False
    return True


@wp.func
def shaded_by_ball(probes: wp.array[Probe], point: wp.vec3) -> wp.bool:
    """Return whether a ball may shade a point of a surface."""
    for k in range(probes.shape[0]):  # noqa: SIM110 - kernels have no any()
        if wp.length(point - probes[k].center) < OWN_SHADOW * probes[k].radius:
            return True
    return False


@functools.cache
def make_see_texel(proxies: tuple[int, ...]) -> wp.Function:
    """``see_texel(picture, params, probes, scene, shape, ball, i, j) -> vec4``: radiance and number of directions seen.

    The radiance is their sum.
    """
    trace = make_trace(TraceConfig(objects=(), proxies=proxies))

    @wp.func(module="unique")
    def see_texel(
        picture: Picture,
        params: wp.array[FrameParams],
        probes: wp.array[Probe],
        scene: RayScene,
        shape: wp.vec2i,
        ball: wp.int32,
        i: wp.int32,
        j: wp.int32,
    ) -> wp.vec4:
        camera = params[0]
        frame = picture.frame
        total = wp.vec3(0.0, 0.0, 0.0)
        count = wp.float32(0.0)
        side = wp.int32(SIDE)  # a variable: the loops stay loops
        for row_of_texel in range(side):
            y = wp.float32(i) + (wp.float32(row_of_texel) + 0.5) / wp.float32(SIDE)
            for column_of_texel in range(side):
                x = wp.float32(j) + (wp.float32(column_of_texel) + 0.5) / wp.float32(SIDE)
                direction = direction_from_latlong(y, x, shape[0], shape[1])
                ray = direction
                reach = wp.float32(FAR)
                hit = trace.closest_proxy(scene, probes[ball].center, direction, FAR)
                shaded = wp.bool(False)
                if hit.shape >= 0:
                    shaded = shaded_by_ball(probes, hit.point)
                    ray = hit.point - camera.camera_position
                    reach = wp.length(ray)
                    ray = ray / reach
                at = project(camera, ray)
                row = wp.int32(wp.round(wp.clamp(at[1], -1.0, 1.0e6)))
                column = wp.int32(wp.round(wp.clamp(at[0], -1.0, 1.0e6)))
                inside = at[2] > 0.0 and row >= 0 and column >= 0 and row < frame.shape[0] and column < frame.shape[1]
                if inside and not shaded and passes_balls(probes, camera.camera_position, ray, reach):
                    if not trace.occluded_by_proxies(scene, camera.camera_position, ray, (1.0 - CLOSE) * reach):
                        total += pixel_radiance(frame, picture.decode_table, picture.linear, row, column)
                        count += 1.0
        return wp.vec4(total[0], total[1], total[2], count)

    return see_texel


@wp.func
def with_seen(known: wp.vec4, seen: wp.vec4) -> wp.vec4:
    """A texel of which the ball knows a part, and what ``see_texel`` found."""
    count = seen[3]
    if count <= 0.0 or known[3] >= ENOUGH:
        return known
    weight = (1.0 - known[3]) * FRAME_TRUST * count / wp.float32(SIDE * SIDE)
    trust = known[3] + weight
    total = wp.vec3(seen[0], seen[1], seen[2])
    mixed = (known[3] * wp.vec3(known[0], known[1], known[2]) + (weight / count) * total) / trust
    return wp.vec4(mixed[0], mixed[1], mixed[2], trust)


@functools.cache
def make_fill_frame_kernel(proxies: tuple[int, ...]) -> wp.Kernel:
    """Kernel for the given kinds of proxy."""
    see_texel = make_see_texel(proxies)

    @wp.kernel(module="unique", enable_backward=False)
    def fill_frame_kernel(
        # In:
        row_start: wp.int32,
        picture: Picture,
        params: wp.array[FrameParams],
        probes: wp.array[Probe],
        scene: RayScene,
        shape: wp.vec2i,
        ball: wp.int32,
        # In and out:
        levels_out: wp.array[wp.vec4],
    ):
        band_row, j = wp.tid()
        i = row_start + band_row
        known = levels_out[i * shape[1] + j]
        if known[3] >= ENOUGH:
            return
        seen = see_texel(picture, params, probes, scene, shape, ball, i, j)
        levels_out[i * shape[1] + j] = with_seen(known, seen)

    return fill_frame_kernel


fill_frame = row_launcher(make_fill_frame_kernel, like=lambda *given: given[4])
"""Put what the frame shows into a seeded fill pyramid, where balls left trust open.

Args:
    proxies: Kinds of proxy in the scene.
    picture: (frame rows, columns) the camera's; its rays are not read.
    params: ``FrameParams`` (1): the camera.
    probes: ``Probe`` (P), at least one; all hide what is behind them.
    scene: Its proxies are seen where they are.
    shape: Rows and columns of the map.
    ball: The one whose light the map is.
    levels_out: From ``fill.seed_fill``; its level 0 changes.
"""
