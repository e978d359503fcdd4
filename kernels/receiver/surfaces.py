"""The modelled surface that each pixel shows: a virtual object, a proxy or a mirror ball; its depth, normal and place.

One ray per pixel, through its centre: nothing here is filtered, for a mean of two depths is the depth of neither. The
depth is along the camera's axis, as depth cameras and OpenEXR's ``Z`` have it. What hides what is as in the picture:
an object is hidden by proxies alone, and a proxy shows its front.
"""

from __future__ import annotations

import functools

import warp as wp

from warp_ar.kernels.launch import Rows, launch_rows
from warp_ar.kernels.rays.shapes import FAR, intersect_sphere
from warp_ar.kernels.rays.trace import TraceConfig, make_trace
from warp_ar.kernels.rays.visibility import VisibleObjects, inside_rect
from warp_ar.kernels.structs import FrameParams, Probe, RayScene

wp.set_module_options({"enable_backward": False})


@wp.struct
class Surface:
    """First surface that a ray from the camera meets."""

    index: wp.int32  # objects, then proxies, then mirror balls; -1: nothing that is modelled
    depth: wp.float32  # metres along the camera's axis, infinite where there is nothing
    normal: wp.vec3  # unit, world, toward the camera; zero where there is nothing
    position: wp.vec3  # world, metres; zero where there is nothing


@wp.struct
class Surfaces:
    """``Surface`` of every pixel, (H, W) each."""

    index: wp.array2d[wp.int32]
    depth: wp.array2d[wp.float32]
    normal: wp.array2d[wp.vec3]
    position: wp.array2d[wp.vec3]


@functools.cache
def make_physical_surface(config: TraceConfig) -> wp.Function:
    """``physical_surface(scene, balls, origin, direction) -> Surface``: the proxy or ball that a ray meets.

    ``direction`` is as long as its part along the camera's axis is 1.
    """
    closest_proxy = make_trace(config).closest_proxy

    @wp.func(module="unique")
    def physical_surface(scene: RayScene, balls: wp.array[Probe], origin: wp.vec3, direction: wp.vec3) -> Surface:
        surface = Surface()
        surface.index = -1
        surface.depth = wp.inf
        objects = scene.objects.shape[0]
        nearest = FAR
        for k in range(balls.shape[0]):
            t = intersect_sphere(balls[k].radius, origin - balls[k].center, direction, nearest)
            if t < nearest:
                nearest = t
                surface.index = objects + scene.proxies.shape[0] + k
                surface.depth = t
                surface.normal = wp.normalize(origin + t * direction - balls[k].center)
                surface.position = balls[k].center + balls[k].radius * surface.normal
        if wp.static(len(config.proxies) > 0):
            hit = closest_proxy(scene, origin, direction, nearest)
            if hit.shape >= 0:
                surface = Surface()
                surface.index = -1
                surface.depth = wp.inf
                # From behind a proxy hides what is beyond, and is not what the camera sees of it.
                if wp.dot(hit.geometric_normal, direction) < 0.0:
                    surface.index = objects + hit.shape
                    surface.depth = hit.t
                    surface.normal = hit.normal
                    surface.position = hit.point
        return surface

    return physical_surface


@functools.cache
def make_trace_surfaces_kernel(config: TraceConfig) -> wp.Kernel:
    """Kernel of ``trace_surfaces``, specialised to the kinds of shape that exist."""
    physical_surface = make_physical_surface(config)

    @wp.kernel(module="unique", enable_backward=False)
    def trace_surfaces_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        rays: wp.array2d[wp.vec2],
        scene: RayScene,
        balls: wp.array[Probe],
        visible: VisibleObjects,
        # Out:
        out: Surfaces,
    ):
        i, j = wp.tid()
        i += row_start
        direction = params[0].world_from_camera * wp.vec3(rays[i, j][0], rays[i, j][1], 1.0)
        found = wp.int32(-1)
        if visible.objects.shape[0] > 0 and inside_rect(i, j, params[0].object_rect):
            found = visible.objects[i, j]
        surface = Surface()
        if found >= 0:
            hit = visible.hits[i, j]
            surface.index = found
            surface.depth = hit.t
            surface.normal = wp.where(wp.dot(hit.geometric_normal, direction) > 0.0, -hit.normal, hit.normal)
            surface.position = hit.point
        else:
            surface = physical_surface(scene, balls, params[0].camera_position, direction)
        out.index[i, j] = surface.index
        out.depth[i, j] = surface.depth
        out.normal[i, j] = surface.normal
        out.position[i, j] = surface.position

    return trace_surfaces_kernel


def make_surfaces(index: wp.array, depth: wp.array, normal: wp.array, position: wp.array) -> Surfaces:
    """The arrays of ``trace_surfaces`` together."""
    surfaces = Surfaces()
    surfaces.index, surfaces.depth, surfaces.normal, surfaces.position = index, depth, normal, position
    return surfaces


def trace_surfaces(
    config: TraceConfig,
    params: wp.array,
    rays: wp.array,
    scene: RayScene,
    balls: wp.array,
    visible: VisibleObjects,
    out: Surfaces,
    *,
    rows: Rows | None = None,
) -> None:
    """Write the surface that every pixel's centre shows.

    Args:
        config: Kinds of shape in ``scene``.
        params: (1,) FrameParams: camera and ``object_rect``.
        rays: (H, W) undistorted x / z and y / z of each pixel centre.
        scene: What rays meet.
        balls: (n,) Probe, the mirror balls.
        visible: (H, W) as ``trace_pixels`` writes; its arrays are empty in a scene without objects.
        out: (H, W) arrays, all four.
        rows: Band of rows; None means all.
    """
    launch_rows(
        make_trace_surfaces_kernel(config),
        rays.shape,
        [params, rays, scene, balls, visible],
        [out],
        rows=rows,
        device=rays.device,
    )
