"""The estimates of cells as a wavefront of kernels, for a CUDA device.

Secondary rays, which ask what an object sends, trace three more each and are rare: in one kernel they stall their warp.
So rays only stop at objects at first; the light of cells where one did is summed; secondary rays are queued and traced
side by side; and the partial sums are reduced in the order of the samples, with the same bits in every run.
"""

from __future__ import annotations

import functools

import warp as wp

from warp_ar.kernels.cells import cell_pixel
from warp_ar.kernels.environment.environment_samples import SampleSets
from warp_ar.kernels.launch import MOST_REGISTERS, launch
from warp_ar.kernels.objects.reflect import DistantLight
from warp_ar.kernels.rays.shapes import FAR, intersect_sphere, surface_key
from warp_ar.kernels.rays.trace import make_trace, offset_origin
from warp_ar.kernels.rays.visibility import make_visible_proxy
from warp_ar.kernels.receiver.environment_shadow import (
    CHUNK,
    SHADED_TILE,
    EnvironmentShadowConfig,
    ShadowCells,
    bounced_of,
    can_matter,
    first_of_set,
    make_aim,
    make_find_sender,
    make_masks,
    ratio_of,
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

WORD = 32
"""Samples of a partial sum: the bits of a word."""
MAX_QUEUE = 1 << 24
"""Secondary rays that may be queued: beyond it the queue takes too much memory, 16 bytes each and more."""
WARP_LANES = 32
"""Threads that go the same way or wait for each other."""
TILE_ROWS, TILE_COLUMNS = 4, 8
"""Cells of a warp, which takes a square of the frame."""
MAX_PARTIALS = 8
"""Threads of a CUDA device that share a cell's samples at most, each with a partial sum."""
ENOUGH_THREADS = 1 << 20
"""Threads from which more make a CUDA device slower: each finds the cell's point and picks its samples anew."""
QUEUE_THREADS = 1 << 17
"""Threads that trace the queue, each what is left of it when the others have theirs."""


@wp.struct
class Wavefront:
    """Arrays that kernels hand on; a cell has several partial sums, each over as many samples as a word has bits."""

    occluded: wp.array3d[wp.uint32]  # (partials, rows, columns): samples that an object hides, a bit each
    queue_starts: wp.array3d[wp.int32]  # (partials, rows, columns): place in the queue of the first secondary ray
    queue: wp.array[wp.int32]  # number of the cell times CHUNK, plus the sample
    queue_length: wp.array[wp.int32]  # (1,)
    sums: wp.array3d[wp.vec3]  # (2 * partials, rows, columns): light without the objects, and what they hide
    reflected: wp.array2d[wp.vec3]  # (2, queue): what objects send of the environment, and of the receiver


@wp.func
def tiled_cell(i: wp.int32, thread: wp.int32, side: wp.int32, columns: wp.int32) -> wp.vec2i:
    """Row and column of the cell of a thread, of those that ``tiled_shape`` asks for; ``columns`` is its second.

    A warp takes cells of one set, so that their rays go the same way, from a square of the frame, so that they meet the
    same or nothing: TILE_ROWS x TILE_COLUMNS of them, ``side`` apart. The warps that follow take the other sets there.
    """
    number = i * columns + thread
    lane = number % WARP_LANES
    one_of = number / WARP_LANES % (side * side)
    tile = number / (WARP_LANES * side * side)
    across = columns / (TILE_COLUMNS * side)
    row = (tile / across * TILE_ROWS + lane / TILE_COLUMNS) * side + one_of / side
    return wp.vec2i(row, (tile % across * TILE_COLUMNS + lane % TILE_COLUMNS) * side + one_of % side)


def tiled_shape(rows: int, columns: int, side: int) -> tuple[int, int]:
    """Return the launch's rows and columns of threads: the cells' rounded up to whole tiles of ``tiled_cell``."""
    down, across = side * int(TILE_ROWS), side * int(TILE_COLUMNS)
    return -(-rows // down) * down, -(-columns // across) * across


@functools.cache
def make_find_occluded_kernel(config: EnvironmentShadowConfig) -> wp.Kernel:
    """Kernel of the first pass: samples that objects hide, and the queue of secondary rays."""
    size = config.count // config.partials
    secondary_count = config.secondary_count
    side = config.side
    mask_objects, mask_physical = make_masks(config, size)
    aim, trace = make_aim(config.emitters, config.distant.several), make_trace(config.distant.trace)
    closest_proxy, occluded_by_objects = trace.closest_proxy, trace.occluded_by_objects
    visible_proxy = make_visible_proxy(config.distant.trace)

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def find_occluded_kernel(
        # In:
        params: wp.array[FrameParams],
        picture: Picture,
        scene: RayScene,
        distant: DistantLight,
        sets: SampleSets,
        tiled: wp.int32,
        # Out:
        cells_out: ShadowCells,
        wave_out: Wavefront,
    ):
        partial, i, thread = wp.tid()
        rays = picture.rays
        stride = cells_out.stride
        columns = cells_out.surface.shape[1]
        cell = tiled_cell(i, thread, side, tiled)
        i, j = cell[0], cell[1]
        if i >= cells_out.surface.shape[0] or j >= columns:
            return
        row = cell_pixel(i, stride, rays.shape[0])
        column = cell_pixel(j, stride, rays.shape[1])
        key = wp.int32(-1)
        found = wp.uint32(0)
        if can_matter(row, column, stride * side, params[0].shadow_rect):
            hit = visible_proxy(params[0], rays[row, column], scene, distant.probes)
            if hit.shape >= 0:
                key = surface_key(scene.proxies[hit.shape], hit.shape, hit.geometric_normal)
                if partial == 0:
                    cells_out.ratio[i, j] = wp.vec4(1.0, 1.0, 1.0, hit.t)
                    cells_out.bounced[i, j] = wp.vec3(0.0)
                begin = partial * size
                at = first_of_set(i, j, side, sets.samples.shape[0]) + begin
                virtual_mask = mask_objects(scene, sets, at, hit.point)
                if virtual_mask != wp.uint64(0):
                    physical = mask_physical(scene, distant, sets, at, hit.point, hit.shape)
                    count = wp.int32(0)
                    # Its end is no constant: unrolled, the kernel would hold its rays many times over.
                    for k in range(begin, begin + size):
                        bit = wp.uint64(1) << wp.uint64(k - begin)
                        if (virtual_mask & bit) == wp.uint64(0):
                            continue
                        ray = aim(sets, distant.others.places, at + k - begin, hit)
                        if ray.cosine <= 0.0:
                            continue
                        ray.origin = offset_origin(hit.point, hit.geometric_normal, ray.direction, hit.error)
                        if (physical.proxies & bit) != wp.uint64(0):
                            proxy = closest_proxy(scene, ray.origin, ray.direction, ray.distance)
                            ray.distance = wp.min(ray.distance, proxy.t)
                        if (physical.balls & bit) != wp.uint64(0):
                            for index in range(distant.probes.shape[0]):
                                probe = distant.probes[index]
                                from_ball = ray.origin - probe.center
                                t = intersect_sphere(probe.radius, from_ball, ray.direction, ray.distance)
                                ray.distance = wp.min(ray.distance, t)
                        if occluded_by_objects(scene, ray.origin, ray.direction, ray.distance):
                            found = found | (wp.uint32(1) << wp.uint32(k - begin))
                            if k < secondary_count:
                                count += 1
                    if count > 0:
                        start = wp.atomic_add(wave_out.queue_length, 0, count)
                        wave_out.queue_starts[partial, i, j] = start
                        for k in range(begin, wp.min(begin + size, secondary_count)):
                            if (found & (wp.uint32(1) << wp.uint32(k - begin))) != wp.uint32(0):
                                wave_out.queue[start] = (i * columns + j) * CHUNK + k
                                start += 1
        if partial == 0:
            cells_out.surface[i, j] = key
        wave_out.occluded[partial, i, j] = found

    return find_occluded_kernel


@wp.func
def any_occluded(occluded: wp.array3d[wp.uint32], i: wp.int32, j: wp.int32) -> wp.bool:
    """Return whether an object hides any sample from a cell."""
    found = wp.uint32(0)
    for partial in range(occluded.shape[0]):
        found = found | occluded[partial, i, j]
    return found != wp.uint32(0)


@functools.cache
def make_sum_light_kernel(config: EnvironmentShadowConfig) -> wp.Kernel:
    """Kernel of the second pass: light of the environment, and how much of it is hidden, where something is."""
    size = config.count // config.partials
    side = config.side
    _, mask_physical = make_masks(config, size)
    visible_proxy = make_visible_proxy(config.distant.trace)
    aim, find_sender = make_aim(config.emitters, config.distant.several), make_find_sender(config)

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def sum_light_kernel(
        # In:
        params: wp.array[FrameParams],
        picture: Picture,
        scene: RayScene,
        distant: DistantLight,
        sets: SampleSets,
        tiled: wp.int32,
        cells: ShadowCells,
        # Out:
        wave_out: Wavefront,
    ):
        partial, i, thread = wp.tid()
        cell = tiled_cell(i, thread, side, tiled)
        i, j = cell[0], cell[1]
        if i >= cells.surface.shape[0] or j >= cells.surface.shape[1]:
            return
        if not any_occluded(wave_out.occluded, i, j):
            return
        rays = picture.rays
        stride = cells.stride
        pixel = rays[cell_pixel(i, stride, rays.shape[0]), cell_pixel(j, stride, rays.shape[1])]
        hit = visible_proxy(params[0], pixel, scene, distant.probes)
        begin = partial * size
        at = first_of_set(i, j, side, sets.samples.shape[0]) + begin
        physical = mask_physical(scene, distant, sets, at, hit.point, hit.shape)
        met = physical.proxies | physical.balls
        found = wp.uint64(wave_out.occluded[partial, i, j])
        without = wp.vec3(0.0)
        hidden = wp.vec3(0.0)
        for k in range(at, at + size):
            bit = wp.uint64(1) << wp.uint64(k - at)
            ray = aim(sets, distant.others.places, k, hit)
            if ray.cosine > 0.0:
                light = ray.cosine * ray.grown * sets.flux[k]
                if (met & bit) != wp.uint64(0):
                    ray.origin = offset_origin(hit.point, hit.geometric_normal, ray.direction, hit.error)
                    by_proxy = (physical.proxies & bit) != wp.uint64(0)
                    by_ball = (physical.balls & bit) != wp.uint64(0)
                    sender = find_sender(params, picture, scene, distant, sets, k, ray, by_proxy, by_ball)
                    light = ray.cosine * ray.grown * sets.samples[k].measure * sender.radiance
                without += light
                if (found & bit) != wp.uint64(0):
                    hidden += light
        wave_out.sums[2 * partial, i, j] = without
        wave_out.sums[2 * partial + 1, i, j] = hidden

    return sum_light_kernel


@functools.cache
def make_trace_secondary_kernel(config: EnvironmentShadowConfig) -> wp.Kernel:
    """Kernel of the third pass: what objects send along the queued rays."""
    secondary_count = config.secondary_count
    side = config.side
    aim = make_aim(config.emitters, config.distant.several)
    closest_object = make_trace(config.distant.trace).closest_object
    visible_proxy = make_visible_proxy(config.distant.trace)
    traced = config.bounce == "traced"
    look_before = None if traced else make_look_before(config.distant)
    reflect_back = make_reflect_back(config.distant, traced)

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def trace_secondary_kernel(
        # In:
        params: wp.array[FrameParams],
        picture: Picture,
        scene: RayScene,
        distant: DistantLight,
        sets: SampleSets,
        cells: ShadowCells,
        threads: wp.int32,
        # Out:
        wave_out: Wavefront,
    ):
        rays = picture.rays
        stride = cells.stride
        columns = cells.surface.shape[1]
        for place in range(wp.tid(), wave_out.queue_length[0], threads):
            item = wave_out.queue[place]
            i = item / CHUNK / columns
            j = item / CHUNK % columns
            index = first_of_set(i, j, side, sets.samples.shape[0]) + item % CHUNK
            row = cell_pixel(i, stride, rays.shape[0])
            column = cell_pixel(j, stride, rays.shape[1])
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
            wave_out.reflected[0, place] = reflected.sent
            if wp.static(not traced):
                wave_out.reflected[1, place] = reflected.returned

    return trace_secondary_kernel


@functools.cache
def make_reduce_partials_kernel(config: EnvironmentShadowConfig) -> wp.Kernel:
    """Kernel of the last pass: estimates of the cells from which something is hidden."""
    size = config.count // config.partials
    secondary_count = config.secondary_count
    traced = config.bounce == "traced"

    @wp.kernel(module="unique", enable_backward=False)
    def reduce_partials_kernel(
        # In:
        params: wp.array[FrameParams],
        wave: Wavefront,
        # Out:
        cells_out: ShadowCells,
    ):
        """Sums in the order of the samples, wherever their threads put them: the same bits in every run."""
        i, j = wp.tid()
        if not any_occluded(wave.occluded, i, j):
            return
        without = wp.vec3(0.0)
        hidden = wp.vec3(0.0)
        sent = wp.vec3(0.0)
        returned = wp.vec3(0.0)
        for partial in range(wave.occluded.shape[0]):
            without += wave.sums[2 * partial, i, j]
            hidden += wave.sums[2 * partial + 1, i, j]
            found = wave.occluded[partial, i, j]
            place = wave.queue_starts[partial, i, j]
            for k in range(partial * size, wp.min((partial + 1) * size, secondary_count)):
                if (found & (wp.uint32(1) << wp.uint32(k - partial * size))) != wp.uint32(0):
                    sent += wave.reflected[0, place]
                    if wp.static(not traced):
                        returned += wave.reflected[1, place]
                    place += 1
        unchanged = hidden + sent == wp.vec3(0.0, 0.0, 0.0)
        if cells_out.shaded.shape[0] > 0 and not unchanged:
            cells_out.shaded[i / SHADED_TILE, j / SHADED_TILE] = params[0].frame_index
        cells_out.ratio[i, j] = ratio_of(without, hidden, cells_out.ratio[i, j][3])
        cells_out.bounced[i, j] = bounced_of(without, hidden, sent, returned)

    return reduce_partials_kernel


def count_partials(rows: int, columns: int) -> int:
    """Threads per cell: as many as it takes to fill a CUDA device, up to ``MAX_PARTIALS``, a power of 2."""
    partials = MAX_PARTIALS
    while partials > 1 and partials * rows * columns > ENOUGH_THREADS:
        partials //= 2
    return partials


def make_wavefront(config: EnvironmentShadowConfig, rows: int, columns: int, device: wp.DeviceLike) -> Wavefront | None:
    """Scratch of ``shade_wavefront``; None where a cell has more than one set of samples, or too many secondary rays.

    Args:
        config: As for ``shade_wavefront``; the samples of a partial sum are the bits of a word: 32 at most.
        rows: Rows of cells.
        columns: Cells in a row.
        device: Where.
    """
    queue = rows * columns * config.secondary_count
    if config.count > CHUNK or config.count // config.partials > WORD or queue > MAX_QUEUE:
        return None
    cells = config.partials, rows, columns
    wave = Wavefront()
    wave.occluded, wave.queue_starts = (wp.empty(cells, dtype=kind, device=device) for kind in (wp.uint32, wp.int32))
    wave.queue, wave.queue_length = wp.empty(queue, dtype=wp.int32, device=device), wp.zeros(1, wp.int32, device=device)
    wave.sums = wp.empty((2 * cells[0], *cells[1:]), dtype=wp.vec3, device=device)
    wave.reflected = wp.empty((1 if config.bounce == "traced" else 2, queue), dtype=wp.vec3, device=device)
    return wave


Given = tuple[wp.array[FrameParams], Picture, RayScene, DistantLight, SampleSets]
"""Inputs of the kernels, as ``shade_environment`` has them: params, picture, scene, distant, sets."""


def _threads(config: EnvironmentShadowConfig, wave: Wavefront) -> tuple[tuple[int, int, int], int]:
    """Extent of a launch over partial sums and cells, and its last axis for ``tiled_cell``."""
    partials, rows, columns = wave.occluded.shape
    down, across = tiled_shape(rows, columns, config.side)
    return (partials, down, across), across


def find_occluded(config: EnvironmentShadowConfig, given: Given, cells_out: ShadowCells, wave: Wavefront) -> None:
    """First pass: what objects hide, and which secondary rays there are. Of the light it reads the samples alone."""
    wave.queue_length.zero_()
    kernel, (size, tiled) = make_find_occluded_kernel(config), _threads(config, wave)
    launch(kernel, size, [*given, tiled], [cells_out, wave], device=wave.occluded.device)


def sum_light(config: EnvironmentShadowConfig, given: Given, cells: ShadowCells, wave: Wavefront) -> None:
    """Second pass: light of the environment, and how much of it is hidden."""
    kernel, (size, tiled) = make_sum_light_kernel(config), _threads(config, wave)
    launch(kernel, size, [*given, tiled, cells], [wave], device=wave.occluded.device)


def trace_secondary(config: EnvironmentShadowConfig, given: Given, cells: ShadowCells, wave: Wavefront) -> None:
    """Third pass: what objects send. It reads nothing that the second writes."""
    threads = min(wave.queue.shape[0], QUEUE_THREADS)
    kernel = make_trace_secondary_kernel(config)
    launch(kernel, threads, [*given, cells, threads], [wave], device=wave.occluded.device)


def reduce_partials(config: EnvironmentShadowConfig, given: Given, cells_out: ShadowCells, wave: Wavefront) -> None:
    """Last pass: the estimates."""
    kernel, size = make_reduce_partials_kernel(config), wave.occluded.shape[1:]
    launch(kernel, size, [given[0], wave], [cells_out], device=wave.occluded.device)


PASSES = (find_occluded, sum_light, trace_secondary, reduce_partials)
"""In their order; the first and the third do not read what the second writes."""


def shade_wavefront(config: EnvironmentShadowConfig, given: Given, cells_out: ShadowCells, wave: Wavefront) -> None:
    """Estimate all cells, pass after pass, with the scratch of ``make_wavefront``."""
    for one in PASSES:
        one(config, given, cells_out, wave)
