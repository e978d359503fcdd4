"""Completion of the environment by the camera's frame, in directions that no ball shows.

The ball does not show directions behind it, and near its rim a pixel covers many degrees. The frame shows many of these
directions, behind and beside the ball. The radiance of a direction d from the ball's centre is read

- if a proxy is met: at the pixel of the point that is hit, if the camera sees that point and it lies at least
  ``OWN_SHADOW`` radii from every ball. Closer points may lie in a ball's shadow, which is not part of the light on
  objects elsewhere;
- otherwise, at infinity: at the pixel whose ray has the direction d, if no ball or proxy is in its way.

Near surfaces that are not modelled are seen from another side than the ball's. So the frame has a lower trust,
``FRAME_TRUST``, and fills only the part of a texel's trust that the ball leaves open. A texel is the mean of the
visible ones of ``SIDE`` x ``SIDE`` directions, and its trust is scaled by their share.
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
"""Trust in a texel that the frame shows; one that a ball shows has 1."""
BALL_MARGIN = wp.constant(wp.float32(1.08))
"""Factor on a ball's radius in tests of what it hides, because its outline in the frame is blurred."""
OWN_SHADOW = wp.constant(wp.float32(6.0))
"""Distance from a ball, in radii, within which it may shade a surface: the shadow's length in light at 10 degrees."""
CLOSE = wp.constant(wp.float32(1.0e-3))
"""Relative distance within which a camera ray's hit is the surface itself."""
ENOUGH = wp.constant(wp.float32(0.999))
"""Trust from which on a texel is not completed by the frame."""


@wp.func
def passes_balls(probes: wp.array[Probe], origin: wp.vec3, direction: wp.vec3, reach: wp.float32) -> wp.bool:
    """Return whether a ray of unit direction meets no ball within the distance ``reach``, metres."""
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
    """Return the function ``see_texel(picture, params, probes, scene, shape, ball, i, j) -> vec4``.

    Its result is the sum of radiance, RGB, over the directions in texel (i, j) that the frame shows, and their number.
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
        side = wp.int32(SIDE)  # a variable: the loops are not unrolled
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
    """Return (radiance, trust) of a texel: ``known`` from balls, completed by ``seen`` from ``see_texel``."""
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
    """Return the kernel of ``fill_frame`` for the given kinds of proxy."""
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
"""Add the frame's radiance to level 0 of a seeded fill pyramid, for texels that balls do not trust fully.

Args:
    proxies: Kinds of proxy in the scene.
    picture: (frame rows, columns) the camera's frame; rays are not read.
    params: ``FrameParams`` (1): the camera.
    probes: ``Probe`` (P), at least one; all hide surfaces behind them.
    scene: Its proxies are known surfaces.
    shape: Rows and columns of the map.
    ball: Index of the map's ball.
    levels_out: From ``fill.seed_fill``; level 0 is changed.
"""
