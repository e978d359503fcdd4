"""Shadows that virtual objects cast on the receiver under the environment, and the light that they bounce onto it.

What a proxy's pixel becomes is a factor on what the camera sees there [Deb98]: reflectance cancels,

    ratio = E_with / E_without,   per channel,

E the irradiance at the pixel's point, without the virtual objects (the proxies and the mirror balls shadow it: they are
real and in the picture already) and with them. Both are sums over the same samples of the environment
(``environment_samples``), so a point that no object shades has a ratio of exactly 1, one that sees nothing but a black
object 0, and an error of the samples cancels to first order.

How that is done stands in its parts: cells and sets of samples (``environment_shadow_cells``), what their rays may meet
(``environment_shadow_rays``), what objects send back (``environment_shadow_bounce``), and the mean of neighbours
(``environment_shadow_filter``). The estimate is one kernel here, for a CPU and for sets of any size, or a wavefront of
kernels (``environment_shadow_wavefront``) with the same result.

References:
    [Deb98] Debevec 1998, Rendering Synthetic Objects into Real Scenes.
"""

from __future__ import annotations

import functools

import warp as wp

from warp_ar.kernels.cells import cell_pixel
from warp_ar.kernels.environment.environment_samples import SampleSets
from warp_ar.kernels.launch import Rows, launch_rows
from warp_ar.kernels.objects.reflect import DistantLight
from warp_ar.kernels.rays.shapes import surface_key
from warp_ar.kernels.rays.trace import make_trace, offset_origin
from warp_ar.kernels.rays.visibility import make_visible_proxy
from warp_ar.kernels.receiver.environment_shadow_bounce import (
    Before,
    Meeting,
    ReflectedLight,
    caustic_alpha,
    make_look_before,
    make_reflect_back,
)
from warp_ar.kernels.receiver.environment_shadow_cells import (
    CHUNK,
    SHADED_TILE,
    WARP_LANES,
    EnvironmentShadowConfig,
    ShadowCells,
    bounced_of,
    can_matter,
    cell_column,
    first_of_set,
    ratio_of,
)
from warp_ar.kernels.receiver.environment_shadow_rays import make_aim, make_find_sender, make_masks, may_be_one_sided
from warp_ar.kernels.receiver.environment_shadow_wavefront import Wavefront, shade_wavefront
from warp_ar.kernels.sampling import pcg3d_hash
from warp_ar.kernels.structs import FrameParams, Hit, Picture, RayScene

wp.set_module_options({"enable_backward": False})


@functools.cache
def make_environment_shadow_kernel(config: EnvironmentShadowConfig) -> wp.Kernel:
    """Kernel specialised to ``config``; equal configs share one kernel."""
    trace = make_trace(config.distant.trace)
    closest_object, occluded_by_objects = trace.closest_object, trace.occluded_by_objects
    mask_objects, mask_physical = make_masks(config, min(config.count, CHUNK))
    visible_proxy = make_visible_proxy(config.distant.trace, config.distant.probes)
    aim, find_sender = make_aim(config.emitters, config.distant.several), make_find_sender(config)
    traced = config.bounce == "traced"
    look_before = None if traced else make_look_before(config.distant)
    reflect_back = make_reflect_back(config.distant, traced)
    side = config.side
    chunk = min(config.count, CHUNK)
    secondary_count = config.secondary_count

    @wp.kernel(module="unique", enable_backward=False)
    def environment_shadow_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        picture: Picture,
        scene: RayScene,
        distant: DistantLight,
        sets: SampleSets,
        lanes: wp.int32,
        # Out:
        cells_out: ShadowCells,
    ):
        i, j = wp.tid()
        i += row_start
        rays = picture.rays
        stride = cells_out.stride
        j = cell_column(j, cells_out.surface.shape[1], side, lanes)
        row = cell_pixel(i, stride, rays.shape[0])
        column = cell_pixel(j, stride, rays.shape[1])
        cells_out.surface[i, j] = -1
        if not can_matter(row, column, stride * side, params[0].shadow_rect):
            return
        hit = visible_proxy(params[0], rays[row, column], scene, distant.probes)
        if hit.shape < 0:
            return
        cells_out.surface[i, j] = surface_key(scene.proxies[hit.shape], hit.shape, hit.geometric_normal)
        cells_out.ratio[i, j] = wp.vec4(1.0, 1.0, 1.0, hit.t)
        cells_out.bounced[i, j] = wp.vec3(0.0)

        point = hit.point
        own = hit.shape
        without = wp.vec3(0.0)
        hidden = wp.vec3(0.0)
        one_sided = may_be_one_sided(scene.objects)
        reflected = ReflectedLight()
        before = Before()
        # A set is in the order of its sequence: any first part of it is a smaller set.
        first = first_of_set(i, j, side, sets.samples.shape[0])
        virtual_mask = mask_objects(scene, sets, first, point)
        hides_any = virtual_mask != wp.uint64(0)
        blocks = wp.int32(wp.static(config.count // chunk))  # a variable: not to be unrolled
        for block in range(1, blocks):
            if not hides_any:
                hides_any = mask_objects(scene, sets, first + block * wp.static(chunk), point) != wp.uint64(0)
        if not hides_any:
            return
        for block in range(blocks):
            at = first + block * wp.static(chunk)
            if block > 0:
                virtual_mask = mask_objects(scene, sets, at, point)
            physical = mask_physical(scene, distant, sets, at, point, own)
            # Most samples meet nothing: they are but a sum.
            met = virtual_mask | physical.proxies | physical.balls
            bit = wp.uint64(1)
            size = wp.int32(wp.static(chunk))  # a variable: unrolled, the kernel would hold its rays many times over
            for k in range(size):
                ray = aim(sets, distant.others.places, at + k, hit)
                if ray.cosine > 0.0:
                    if (met & bit) == wp.uint64(0):
                        without += ray.cosine * ray.grown * sets.flux[at + k]
                    else:
                        measure = sets.samples[at + k].measure
                        weight = ray.cosine * ray.grown * measure
                        ray.origin = offset_origin(point, hit.geometric_normal, ray.direction, hit.error)
                        by_proxy = (physical.proxies & bit) != wp.uint64(0)
                        by_ball = (physical.balls & bit) != wp.uint64(0)
                        sender = find_sender(params, picture, scene, distant, sets, at + k, ray, by_proxy, by_ball)
                        radiance = sender.radiance
                        without += weight * radiance
                        if (virtual_mask & bit) != wp.uint64(0):
                            other = Hit()
                            other.shape = -1
                            sure = wp.bool(False)
                            if wp.static(secondary_count == config.count) or block * wp.static(chunk) + k < wp.static(
                                secondary_count
                            ):
                                other = closest_object(scene, ray.origin, ray.direction, sender.distance)
                                sure = other.shape >= 0 or not one_sided
                            hides = other.shape >= 0
                            if not sure:
                                hides = occluded_by_objects(scene, ray.origin, ray.direction, sender.distance)
                            if hides:
                                hidden += weight * radiance
                            if other.shape >= 0:
                                meeting = Meeting()
                                meeting.hit = other
                                meeting.direction = ray.direction
                                meeting.alpha = caustic_alpha(scene.objects[other.shape], point)
                                meeting.stands_for = weight * wp.static(config.count / secondary_count)
                                seed = wp.vec3ui()
                                if wp.static(traced):
                                    seed = pcg3d_hash(wp.uint32(at + k), wp.uint32(row), wp.uint32(column))
                                elif before.up == wp.vec3(0.0, 0.0, 0.0):
                                    before = look_before(distant, hit.point, hit.geometric_normal, ray.direction)
                                reflected = reflect_back(
                                    params[0], picture, scene, distant, meeting, before, seed, reflected
                                )
                bit = bit << wp.uint64(1)
        unchanged = hidden + reflected.sent == wp.vec3(0.0, 0.0, 0.0)
        if cells_out.shaded.shape[0] > 0 and not unchanged:
            cells_out.shaded[i / SHADED_TILE, j / SHADED_TILE] = params[0].frame_index
        cells_out.ratio[i, j] = ratio_of(without, hidden, hit.t)
        cells_out.bounced[i, j] = bounced_of(without, hidden, reflected.sent, reflected.returned)

    return environment_shadow_kernel


def shade_environment(
    config: EnvironmentShadowConfig,
    params: wp.array[FrameParams],
    picture: Picture,
    scene: RayScene,
    distant: DistantLight,
    sets: SampleSets,
    cells_out: ShadowCells,
    *,
    wave: Wavefront | None = None,
    rows: Rows | None = None,
) -> None:
    """Estimate the ratio for one pixel of every ``stride x stride``, each with one set of samples.

    Args:
        config: What the scene calls for.
        params: (1,) FrameParams: camera and shadow_rect.
        picture: (H, W) the camera's frame, which is needed if bounces are traced, and its rays.
        scene: Objects and proxies.
        distant: The environment; what ``config.distant`` leaves out may be empty.
        sets: config.side^2 sets of config.count samples or more.
        cells_out: (ceil(H / stride), ceil(W / stride)) cells: ratio, bounced, surface and shaded are written.
        wave: Scratch of ``make_wavefront``, for a CUDA device: as a wavefront of kernels; ``rows`` must be None.
        rows: Band of rows of the cells; None means all.
    """
    if wave is not None:
        shade_wavefront(config, (params, picture, scene, distant, sets), cells_out, wave)
        return
    device = picture.rays.device
    lanes = 1 if device.is_cpu else WARP_LANES
    launch_rows(
        make_environment_shadow_kernel(config),
        cells_out.surface.shape,
        [params, picture, scene, distant, sets, lanes],
        [cells_out],
        rows=rows,
        device=device,
    )
