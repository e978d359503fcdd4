"""Rays that ask what an object sends, queued and traced side by side, for a CUDA device.

They trace three more each and are rare: beside the estimates they stall their warp. So those rays only stop at objects,
several threads sharing a cell's samples; what the objects send is found for all cells together; and sums are added in
the order of the samples, with the same bits in every run.
"""

from __future__ import annotations

import functools
from typing import Any

import warp as wp

from warp_ar.kernels.cells import cell_pixel
from warp_ar.kernels.environment.environment_samples import SampleSets
from warp_ar.kernels.launch import MOST_REGISTERS, launch
from warp_ar.kernels.objects.reflect import DistantLight
from warp_ar.kernels.rays.shapes import FAR
from warp_ar.kernels.rays.trace import make_trace, offset_origin
from warp_ar.kernels.rays.visibility import make_visible_proxy
from warp_ar.kernels.receiver.environment_shadow import (
    CHUNK,
    SHADED_TILE,
    EnvironmentShadowConfig,
    ShadowCells,
    ShadowQueue,
    bounced_of,
    first_of_set,
    make_aim,
    ratio_of,
    shade_environment,
    tiled_shape,
)
from warp_ar.kernels.receiver.environment_shadow_bounce import (
    Before,
    ReflectedLight,
    make_look_before,
    make_reflect_back,
    meet_object,
)
from warp_ar.kernels.sampling import pcg3d_hash
from warp_ar.kernels.structs import FrameParams, Picture, RayScene

wp.set_module_options({"enable_backward": False})

MAX_QUEUE = 1 << 24
"""Rays that may be queued: beyond it the queue takes too much memory, 16 bytes each and more."""
MAX_PARTIALS = 8
"""Threads of a CUDA device that share a cell's samples at most, each with a partial sum."""
ENOUGH_THREADS = 1 << 20
"""Threads from which more make a CUDA device slower: each finds the cell's point and picks its samples anew."""
QUEUE_THREADS = 1 << 17
"""Threads that trace the queue, each what is left of it when the others have theirs."""


@functools.cache
def make_trace_queue_kernel(config: EnvironmentShadowConfig) -> wp.Kernel:
    """Kernel of ``trace_queue``."""
    secondary_count, side = config.secondary_count, config.side
    aim = make_aim(config.emitters, config.distant.several)
    closest_object = make_trace(config.distant.trace).closest_object
    visible_proxy = make_visible_proxy(config.distant.trace)
    traced = config.bounce == "traced"
    look_before = None if traced else make_look_before(config.distant)
    reflect_back = make_reflect_back(config.distant, traced)

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def trace_queue_kernel(
        # In:
        threads: wp.int32,
        params: wp.array[FrameParams],
        picture: Picture,
        scene: RayScene,
        distant: DistantLight,
        sets: SampleSets,
        cells: ShadowCells,
        # Out:
        queue_out: ShadowQueue,
    ):
        rays = picture.rays
        columns = cells.surface.shape[1]
        for place in range(wp.tid(), queue_out.length[0], threads):
            item = queue_out.items[place]
            i = item / CHUNK / columns
            j = item / CHUNK % columns
            index = first_of_set(i, j, side, sets.samples.shape[0]) + item % CHUNK
            row = cell_pixel(i, cells.stride, rays.shape[0])
            column = cell_pixel(j, cells.stride, rays.shape[1])
            hit = visible_proxy(params[0], rays[row, column], scene, distant.probes)
            ray = aim(sets, distant.others.places, index, hit)
            ray.origin = offset_origin(hit.point, hit.geometric_normal, ray.direction, hit.error)
            reflected = ReflectedLight()
            # What is nearer than all that is physical is nearest.
            other = closest_object(scene, ray.origin, ray.direction, FAR)
            if other.shape >= 0:
                weight = ray.cosine * ray.grown * sets.samples[index].measure
                stands_for = weight * wp.static(config.count / secondary_count)
                meeting = meet_object(scene, other, hit.point, ray.direction, stands_for)
                seed = wp.vec3ui()
                before = Before()
                if wp.static(traced):
                    seed = pcg3d_hash(wp.uint32(index), wp.uint32(row), wp.uint32(column))
                else:
                    before = look_before(distant, hit.point, hit.geometric_normal, ray.direction)
                reflected = reflect_back(params[0], picture, scene, distant, meeting, before, seed, reflected)
            queue_out.reflected[0, place] = reflected.sent
            queue_out.reflected[1, place] = reflected.returned

    return trace_queue_kernel


@wp.kernel(enable_backward=False)
def reduce_cells_kernel(
    # In:
    params: wp.array[FrameParams],
    queue: ShadowQueue,
    # Out:
    cells_out: ShadowCells,
):
    """Sums in the order of the samples, wherever their threads put them: the same bits in every run."""
    i, j = wp.tid()
    if queue.spans[0, i, j][1] < 0:
        return
    without = wp.vec3(0.0)
    hidden = wp.vec3(0.0)
    sent = wp.vec3(0.0)
    returned = wp.vec3(0.0)
    for partial in range(queue.spans.shape[0]):
        without += queue.sums[2 * partial, i, j]
        hidden += queue.sums[2 * partial + 1, i, j]
        span = queue.spans[partial, i, j]
        for place in range(span[0], span[0] + span[1]):
            sent += queue.reflected[0, place]
            returned += queue.reflected[1, place]
    unchanged = hidden + sent == wp.vec3(0.0, 0.0, 0.0)
    if cells_out.shaded.shape[0] > 0 and not unchanged:
        cells_out.shaded[i / SHADED_TILE, j / SHADED_TILE] = params[0].frame_index
    cells_out.ratio[i, j] = ratio_of(without, hidden, cells_out.ratio[i, j][3])
    cells_out.bounced[i, j] = bounced_of(without, hidden, sent, returned)


def count_partials(rows: int, columns: int) -> int:
    """Threads per cell: as many as it takes to fill a CUDA device, up to ``MAX_PARTIALS``, a power of 2."""
    partials = MAX_PARTIALS
    while partials > 1 and partials * rows * columns > ENOUGH_THREADS:
        partials //= 2
    return partials


def make_queue(config: EnvironmentShadowConfig, rows: int, columns: int, device: wp.DeviceLike) -> ShadowQueue | None:
    """Scratch for so many cells; None where a cell has more than ``CHUNK`` samples, or too many rays may be queued."""
    size = rows * columns * config.secondary_count
    if config.count > CHUNK or size > MAX_QUEUE:
        return None
    queue = ShadowQueue()
    queue.extent = wp.vec2i(*tiled_shape(rows, columns, config.side))
    queue.items, queue.length = wp.empty(size, dtype=wp.int32, device=device), wp.zeros(1, wp.int32, device=device)
    queue.spans = wp.empty((config.partials, rows, columns), dtype=wp.vec2i, device=device)
    queue.sums = wp.empty((2 * config.partials, rows, columns), dtype=wp.vec3, device=device)
    queue.reflected = wp.empty((2, size), dtype=wp.vec3, device=device)
    return queue


def queue_shadows(config: EnvironmentShadowConfig, *given: Any) -> None:
    """Estimate cells but for what objects send, with the arguments of ``shade_environment``."""
    given[-1].length.zero_()
    shade_environment(config, *given)


def trace_queue(config: EnvironmentShadowConfig, *given: Any) -> None:
    """Find what objects send along the rays that were queued, with the same arguments."""
    queue = given[-1]
    threads = min(queue.items.shape[0], QUEUE_THREADS)
    kernel = make_trace_queue_kernel(config)
    launch(kernel, threads, [threads, *given[:-1]], [queue], device=queue.items.device)


def reduce_cells(params: wp.array[FrameParams], queue: ShadowQueue, cells_out: ShadowCells) -> None:
    """Write ratio, bounced and shaded of the cells from which something may be hidden."""
    launch(reduce_cells_kernel, cells_out.surface.shape, [params, queue], [cells_out], device=cells_out.surface.device)
