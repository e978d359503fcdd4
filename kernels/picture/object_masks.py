"""Silhouettes of virtual objects for data sets: all objects on the ray through each pixel's centre, hidden or not."""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.launch import row_launcher
from warp_ar.kernels.rays.shapes import (
    FAR,
    intersect_box,
    intersect_sphere,
    meets_mesh,
    to_local_point,
    to_local_vector,
)
from warp_ar.kernels.rays.visibility import inside_rect
from warp_ar.kernels.structs import BOX, MESH, SPHERE, FrameParams, RayScene

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def trace_object_masks_kernel(
    row_start: wp.int32,
    # In:
    params: wp.array[FrameParams],
    rays: wp.array2d[wp.vec2],
    scene: RayScene,
    # Out:
    masks_out: wp.array2d[wp.uint64],
):
    """Write one pixel's mask: each object is tested against the ray separately, so none hides another."""
    i, j = wp.tid()
    i += row_start
    mask = wp.uint64(0)
    if inside_rect(i, j, params[0].object_rect):
        ray = rays[i, j]
        origin = params[0].camera_position
        direction = params[0].world_from_camera * wp.vec3(ray[0], ray[1], 1.0)
        for index in range(scene.objects.shape[0]):
            shape = scene.objects[index]
            o = to_local_point(shape, origin)
            d = to_local_vector(shape, direction)
            met = wp.bool(False)
            if shape.kind == SPHERE:
                met = intersect_sphere(shape.extent[0], o, d, FAR) < FAR
            if shape.kind == BOX:
                met = intersect_box(shape.extent, o, d, FAR) < FAR
            if shape.kind == MESH:
                met = meets_mesh(shape, o, d, FAR)
            if met:
                mask |= wp.uint64(1) << wp.uint64(index)
    masks_out[i, j] = mask


trace_object_masks = row_launcher(trace_object_masks_kernel)
"""Write the set of objects that the ray through each pixel's centre meets.

Args:
    params: (1,) FrameParams: camera and object_rect, outside which there are no objects.
    rays: (H, W) undistorted x / z and y / z of each pixel centre.
    scene: At most 64 objects: a pixel's mask has one bit for each.
    masks_out: (H, W) uint64; bit k is set if the ray meets object k, whether or not another surface hides it.
"""
