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
from warp_ar.kernels.environment_samples import SampleSets
from warp_ar.kernels.environment_shadow_bounce import (
    Before,
    ReflectedLight,
    make_look_before,
    make_reflect_back,
    meet,
)
from warp_ar.kernels.environment_shadow_cells import (
    CHUNK,
    SHADED_TILE,
    WARP_LANES,
    EnvironmentShadowConfig,
    ShadowCells,
    bounced_of,
    cell_column,
    first_of_set,
    ratio_of,
)
from warp_ar.kernels.environment_shadow_rays import (
    SampleRay,
    Sender,
    make_aim,
    make_find_sender,
    make_masks,
    make_see_cell,
)
from warp_ar.kernels.environment_shadow_wavefront import Wavefront, shade_wavefront
from warp_ar.kernels.launch import Rows, launch_rows, slow_to_compile
from warp_ar.kernels.reflect import DistantLight
from warp_ar.kernels.sampling import pcg3d_hash
from warp_ar.kernels.shapes import surface_key
from warp_ar.kernels.structs import FrameParams, Hit, Picture, RayScene
from warp_ar.kernels.trace import make_trace, offset_origin

wp.set_module_options({"enable_backward": False})


@wp.struct
class CellSums:
    """What the samples of a cell have brought so far."""

    without: wp.vec3  # irradiance without virtual objects
    hidden: wp.vec3  # of it what objects hide
    reflected: ReflectedLight
    before: Before  # the cell's surface, once an object was asked what it sends without a ray; up is 0 until then


@functools.cache
def make_meet_objects(config: EnvironmentShadowConfig) -> wp.Function:
    """``meet_objects(params, picture, scene, distant, hit, ray, sender, key, asks, sums) -> CellSums``.

    What objects hide of the ``sender`` along a ray from the cell's ``hit``, and, if the ray ``asks``, what they send
    instead. ``key`` is for the random numbers of this ray.
    """
    trace = make_trace(config.distant.trace)
    closest_object, occluded_by_objects = trace.closest_object, trace.occluded_by_objects
    traced = config.bounce == "traced"
    look_before = None if traced else make_look_before(config.distant)
    reflect_back = make_reflect_back(config.distant, traced)

    @wp.func(module="unique")
    def meet_objects(
        params: wp.array[FrameParams],
        picture: Picture,
        scene: RayScene,
        distant: DistantLight,
        hit: Hit,
        ray: SampleRay,
        sender: Sender,
        key: wp.vec3ui,
        asks: wp.bool,
        sums: CellSums,
    ) -> CellSums:
        out = sums
        other = Hit()
        other.shape = -1
        hides = wp.bool(False)
        if asks:
            other = closest_object(scene, ray.origin, ray.direction, sender.distance)
            hides = other.shape >= 0
        else:
            hides = occluded_by_objects(scene, ray.origin, ray.direction, sender.distance)
        if hides:
            out.hidden += ray.weight * sender.radiance
        if other.shape >= 0:
            stands_for = ray.weight * wp.static(config.count / config.secondary_count)
            meeting = meet(scene, other, ray.direction, hit.point, stands_for)
            seed = wp.vec3ui()
            if wp.static(traced):
                seed = pcg3d_hash(key[0], key[1], key[2])
            elif out.before.up == wp.vec3(0.0, 0.0, 0.0):
                out.before = look_before(distant, hit.point, hit.geometric_normal, ray.direction)
            out.reflected = reflect_back(params[0], picture, scene, distant, meeting, out.before, seed, out.reflected)
        return out

    return meet_objects


@functools.cache
def make_environment_shadow_kernel(config: EnvironmentShadowConfig) -> wp.Kernel:
    """Kernel specialised to ``config``; equal configs share one kernel."""
    side = config.side
    chunk = min(config.count, CHUNK)
    mask_objects, mask_physical = make_masks(config, chunk)
    see_cell, aim, find_sender = (
        make_see_cell(config),
        make_aim(config.emitters, config.distant.several),
        make_find_sender(config),
    )
    meet_objects = make_meet_objects(config)
    secondary_count = config.secondary_count
    all_ask = secondary_count == config.count

    @slow_to_compile
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
        j = cell_column(j, cells_out.surface.shape[1], side, lanes)
        cells_out.surface[i, j] = -1
        hit = see_cell(params, picture.rays, scene, distant.probes, cells_out.stride, i, j)
        if hit.shape < 0:
            return
        cells_out.surface[i, j] = surface_key(scene.proxies[hit.shape], hit.shape, hit.geometric_normal)
        cells_out.ratio[i, j] = wp.vec4(1.0, 1.0, 1.0, hit.t)
        cells_out.bounced[i, j] = wp.vec3(0.0)

        row = cell_pixel(i, cells_out.stride, picture.rays.shape[0])
        column = cell_pixel(j, cells_out.stride, picture.rays.shape[1])
        sums = CellSums()
        # A set is in the order of its sequence: any first part of it is a smaller set.
        first = first_of_set(i, j, side, sets.samples.shape[0])
        for block in range(wp.static(config.count // chunk)):
            at = first + block * wp.static(chunk)
            virtual_mask = mask_objects(scene, sets, at, hit.point)
            if wp.static(config.count == chunk):
                if virtual_mask == wp.uint64(0):
                    return
            physical = mask_physical(scene, distant, sets, at, hit.point, hit.shape)
            # Most samples meet nothing: they are but a sum.
            met = virtual_mask | physical.proxies | physical.balls
            bit = wp.uint64(1)
            size = wp.int32(wp.static(chunk))  # a variable: unrolled, the kernel would hold its rays many times over
            for k in range(size):
                ray = aim(sets, distant.others.places, at + k, hit)
                if ray.cosine > 0.0:
                    if (met & bit) == wp.uint64(0):
                        sums.without += ray.cosine * ray.grown * sets.flux[at + k]
                    else:
                        ray.weight = ray.cosine * ray.grown * sets.samples[at + k].measure
                        ray.origin = offset_origin(hit.point, hit.geometric_normal, ray.direction, hit.error)
                        by_proxy = (physical.proxies & bit) != wp.uint64(0)
                        by_ball = (physical.balls & bit) != wp.uint64(0)
                        sender = find_sender(params, picture, scene, distant, sets, at + k, ray, by_proxy, by_ball)
                        sums.without += ray.weight * sender.radiance
                        if (virtual_mask & bit) != wp.uint64(0):
                            key = wp.vec3ui(wp.uint32(at + k), wp.uint32(row), wp.uint32(column))
                            asks = wp.static(all_ask) or block * wp.static(chunk) + k < wp.static(secondary_count)
                            sums = meet_objects(params, picture, scene, distant, hit, ray, sender, key, asks, sums)
                bit = bit << wp.uint64(1)
        unchanged = sums.hidden + sums.reflected.sent == wp.vec3(0.0, 0.0, 0.0)
        if cells_out.shaded.shape[0] > 0 and not unchanged:
            cells_out.shaded[i / SHADED_TILE, j / SHADED_TILE] = params[0].frame_index
        cells_out.ratio[i, j] = ratio_of(sums.without, sums.hidden, hit.t)
        cells_out.bounced[i, j] = bounced_of(sums.without, sums.hidden, sums.reflected.sent, sums.reflected.returned)

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
        shade_wavefront(config, params, picture, scene, distant, sets, cells_out, wave)
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
