"""Motion of the surface that a pixel shows since the frame before, in pixels of the picture.

    motion = where the camera shows the point now - where the camera before showed where the point was before

x to the right, y down, as the picture's pixels count: ``picture_before[pixel - motion]`` is the same point. Objects
move as rigid bodies, by ``Shape``; proxies and mirror balls stand still. Both places come from one projection with the
lens's distortion, so that what does not move has a motion of 0 to the bit.
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
    """Return the earlier place of a point of a rigid body, given where the body is and was."""
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
    """One thread per pixel."""
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
    """One thread per object, one at least."""
    k = wp.tid()
    if k == 0:
        params_out[0] = params[0]
    if k < scene.objects.shape[0]:
        objects_out[k] = scene.objects[k]


find_motion = row_launcher(find_motion_kernel)
"""Write the motion of every pixel; 0 where nothing is modelled, and in the first frame.

Args:
    params: (1,) FrameParams, the camera.
    params_before: (1,) FrameParams of the frame before, as ``remember`` writes it; zeros before the first.
    scene: Its objects are where they are now.
    objects_before: (n,) Shape of the frame before.
    index: (H, W) int32, as ``trace_surfaces`` writes.
    position: (H, W) vec3, world, metres.
    motion_out: (H, W) vec2, pixels.
"""


def remember(params: wp.array, scene: RayScene, params_out: wp.array, objects_out: wp.array) -> None:
    """Keep camera and objects for the next frame's ``find_motion``."""
    count = max(1, scene.objects.shape[0])
    launch(remember_kernel, count, [params, scene], [params_out, objects_out], device=params.device)
