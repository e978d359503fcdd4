"""Motion vectors: motion of the surface point in each pixel since the previous frame, in pixels.

    motion = projection of the point now - projection, by the previous camera, of the point's previous position

with x to the right and y down: ``previous_picture[pixel - motion]`` shows the same point. Objects move as rigid bodies,
by ``Shape``; proxies and mirror balls do not move. Both projections are computed by the same function, with the lens's
distortion, so that a point at rest before a camera at rest has a motion of exactly 0.
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.camera import project
from warp_ar.kernels.launch import launch, row_launcher
from warp_ar.kernels.rays.shapes import to_local_point
from warp_ar.kernels.structs import FrameParams, RayScene, Shape

wp.set_module_options({"enable_backward": False})


@wp.func
def point_before(point: wp.vec3, now: Shape, before: Shape) -> wp.vec3:
    """Return a rigid body's point's world position in the previous frame, given the body's ``Shape`` now and before."""
    if now.position == before.position and now.rotation == before.rotation and now.scale == before.scale:
        return point
    return before.rotation * (before.scale * to_local_point(now, point)) + before.position


@wp.kernel(enable_backward=False)
def find_motion_kernel(
    # In:
    row_start: wp.int32,
    params: wp.array[FrameParams],
    params_before: wp.array[FrameParams],
    scene: RayScene,
    objects_before: wp.array[Shape],
    index: wp.array2d[wp.int32],
    position: wp.array2d[wp.vec3],
    # Out:
    motion_out: wp.array2d[wp.vec2],
):
    """Write the motion vector of one pixel."""
    i, j = wp.tid()
    i += row_start
    motion = wp.vec2(0.0, 0.0)
    known = index[i, j]
    # Before the first frame there is no camera, so its focal length is 0.
    if known >= 0 and params_before[0].focal[0] > 0.0:
        point = position[i, j]
        earlier = point
        if known < scene.objects.shape[0]:
            earlier = point_before(point, scene.objects[known], objects_before[known])
        here = project(params[0], point - params[0].camera_position)
        there = project(params_before[0], earlier - params_before[0].camera_position)
        if here[2] > 0.0 and there[2] > 0.0:
            motion = wp.vec2(here[0] - there[0], here[1] - there[1])
    motion_out[i, j] = motion


@wp.kernel(enable_backward=False)
def remember_kernel(
    # In:
    params: wp.array[FrameParams],
    scene: RayScene,
    # Out:
    params_out: wp.array[FrameParams],
    objects_out: wp.array[Shape],
):
    """Save one object's pose per thread, for the next frame's motion vectors.

    Thread 0 also saves the camera, so at least one thread is launched.
    """
    k = wp.tid()
    if k == 0:
        params_out[0] = params[0]
    if k < scene.objects.shape[0]:
        objects_out[k] = scene.objects[k]


find_motion = row_launcher(find_motion_kernel)
"""Write the motion of every pixel; 0 where no modelled surface is shown, and in the first frame.

Args:
    params: (1,) FrameParams, the camera.
    params_before: (1,) FrameParams of the previous frame, from ``remember``; zeros before the first.
    scene: Objects at their current poses.
    objects_before: (n,) Shape of the previous frame.
    index: (H, W) int32, from ``trace_surfaces``.
    position: (H, W) vec3, world, metres.
    motion_out: (H, W) vec2, pixels.
"""


def remember(params: wp.array, scene: RayScene, params_out: wp.array, objects_out: wp.array) -> None:
    """Save the camera and the objects' poses for ``find_motion`` in the next frame."""
    count = max(1, scene.objects.shape[0])
    launch(remember_kernel, count, [params, scene], [params_out, objects_out], device=params.device)
