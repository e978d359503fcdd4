"""Projection of points by the camera, with lens distortion."""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.structs import FrameParams, vec8

wp.set_module_options({"enable_backward": False})


@wp.func
def distort(point: wp.vec2, k: vec8) -> wp.vec2:
    """Distort a normalised image point (x / z, y / z) by OpenCV's rational model, k1 k2 p1 p2 k3 k4 k5 k6."""
    x = point[0]
    y = point[1]
    r2 = x * x + y * y
    radial = (1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
    return wp.vec2(
        x * radial + 2.0 * k[2] * x * y + k[3] * (r2 + 2.0 * x * x),
        y * radial + k[2] * (r2 + 2.0 * y * y) + 2.0 * k[3] * x * y,
    )


@wp.func
def project(params: FrameParams, from_camera: wp.vec3) -> wp.vec3:
    """Return (column, row, depth) of a point relative to the camera, in world axes; pixels need a positive depth."""
    p = wp.transpose(params.world_from_camera) * from_camera
    if p[2] <= 0.0:
        return wp.vec3(0.0, 0.0, p[2])
    at = distort(wp.vec2(p[0] / p[2], p[1] / p[2]), params.distortion)
    return wp.vec3(params.focal[0] * at[0] + params.principal[0], params.focal[1] * at[1] + params.principal[1], p[2])
