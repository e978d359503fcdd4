"""Shadows that virtual objects cast on the receiver under the environment, and the light that they bounce onto it.

The result is a factor on the frame's radiance at each pixel of a proxy [Deb98], from which the reflectance cancels:

    ratio = E_with / E_without,   per channel.

E is the irradiance at the pixel's point, without and with the virtual objects. Proxies and mirror balls hide light in
both: they are real, and their shadows are in the frame. Both are sums over the same samples of the environment
(``environment_samples``). So the ratio is exactly 1 where no object hides light, 0 where a point sees only a black
object, and errors of the samples cancel to first order.

Cells. A cell is a block of ``stride x stride`` pixels; the ratio is estimated at one of them. Each cell of a tile of
``side x side`` cells has its own set of samples. ``environment_shadow_filter`` then averages over as many cells as a
tile has, so that each set has the same weight [KH01]. The result depends on the current frame alone: it does not
flicker or lag.

Culling. Only rays whose direction meets the bounding sphere of an object, by a dot product, are traced for objects.
Cells without such samples have a ratio of 1.

Physical surfaces. If the first surface of a ray is a proxy or a mirror ball, with or without objects, its radiance
replaces the sample's. For a proxy it is taken from the frame if the camera shows the point (``traced``), else from the
environment in that direction. For a ball it is the light that the ball reflects.

Light that objects reflect to the receiver is found by ``environment_shadow_bounce``. On a CPU, and for sets of any
size, this happens as soon as a ray meets an object. These secondary rays are rare and trace three more rays each, so on
CUDA they would stall their warp. There, several threads share a cell's samples, rays stop at objects, and secondary
rays are queued and traced in a kernel of their own, with the same result. Sums are added in the order of the samples,
so every run gives the same bits.

References:
    [Deb98] Debevec 1998, Rendering Synthetic Objects into Real Scenes.
    [KH01] Keller, Heidrich 2001, Interleaved Sampling.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, Literal

import warp as wp

from warp_ar.kernels.cells import cell_pixel
from warp_ar.kernels.environment.environment_samples import SampleSets, ball_of_sample, sample_toward
from warp_ar.kernels.environment.probe_weights import probe_share
from warp_ar.kernels.latlong import sample_latlong
from warp_ar.kernels.launch import MOST_REGISTERS, launch, row_launcher
from warp_ar.kernels.materials import reflect
from warp_ar.kernels.objects.reflect import DistantLight, DistantLightConfig, look_up, make_find_in_frame
from warp_ar.kernels.rays.shapes import FAR, intersect_sphere, surface_key
from warp_ar.kernels.rays.trace import make_trace, offset_origin
from warp_ar.kernels.rays.visibility import make_visible_cell, make_visible_proxy
from warp_ar.kernels.receiver.environment_shadow_bounce import (
    Before,
    ReflectedLight,
    bounding_radius,
    make_look_before,
    make_look_wide,
    make_reflect_back,
    meet_object,
)
from warp_ar.kernels.sampling import pcg3d_hash
from warp_ar.kernels.structs import BOX, PLANE, FrameParams, Hit, Picture, RayScene, Shape

wp.set_module_options({"enable_backward": False})

CHUNK = wp.constant(64)
"""Number of samples that are culled together; each has one bit of a mask."""
TILE_ROWS, TILE_COLUMNS = wp.constant(4), wp.constant(8)
"""Rows and columns of cells that a CUDA warp computes."""
QUEUED_REGISTERS = 128
"""Registers of a CUDA thread where rays are queued. With 80 a frame of ``high`` is 3 % slower, without a limit 4 %."""
MAX_QUEUE = 1 << 24
"""Largest number of queued rays, to bound memory: a ray takes at least 16 bytes."""
MAX_PARTIALS = 8
"""Largest number of CUDA threads that share a cell's samples, each with a partial sum."""
ENOUGH_THREADS = 1 << 20
"""Number of threads from which more threads per cell are slower: each thread repeats the culling of its cell."""
QUEUE_THREADS = 1 << 17
"""Threads that trace the queue; each takes every ``QUEUE_THREADS``-th ray."""
MIN_IRRADIANCE = wp.constant(wp.float32(1.0e-6))
"""Irradiance, in camera values, below which a surface is taken to be dark and gets no shadow."""
MAX_RATIO = wp.constant(wp.float32(4.0))
"""Largest ratio: bounds light that objects bounce onto dark surfaces, where the frame is mostly noise."""
MAX_RETURN = wp.constant(wp.float32(0.99))
"""Largest estimated share of the receiver's light that returns from objects: keeps the interreflection finite."""


@dataclasses.dataclass(frozen=True)
class EnvironmentShadowConfig:
    """Compile-time configuration of the kernels."""

    distant: DistantLightConfig
    """Kinds of shape and forms of light."""
    count: int
    """Samples per set: up to 64, or a multiple of it."""
    side: int
    """Cells along a tile; there are side^2 sets."""
    bounce: Literal["estimated", "traced"]
    """Method by which light from objects onto the receiver is found."""
    secondary: float = 1.0
    """Share of a set's samples, from its first, for which the light of the object that their ray meets is found."""
    emitters: bool = False
    """True if some samples are emitters at a known distance."""
    partials: int = 1
    """Partial sums per cell, one thread each: a divisor of count."""
    queued: bool = False
    """True if secondary rays, which find the light of objects, are queued; for sets of up to 64 samples."""

    def __post_init__(self) -> None:
        if self.count > CHUNK and self.count % CHUNK:
            raise ValueError(f"count is {self.count}; expected up to {CHUNK} or a multiple of it")
        if not 1 <= self.secondary_count <= self.count:
            raise ValueError(f"secondary is {self.secondary}; expected a share of {self.count} samples")
        if self.count % self.partials:
            raise ValueError(f"partials is {self.partials}; expected a divisor of {self.count}")
        if self.partials > 1 and not self.queued:
            raise ValueError(f"partials is {self.partials}; expected 1 where rays are not queued")

    @property
    def secondary_count(self) -> int:
        """Number of a set's samples that send secondary rays."""
        return round(self.count * self.secondary)


@wp.struct
class ShadowCells:
    """Estimates of all cells and their filtered values."""

    stride: wp.int32  # pixels along a cell
    ratio: wp.array2d[wp.vec4]  # RGB share of the environment that is not hidden, and depth
    bounced: wp.array2d[wp.vec3]  # irradiance by light from objects, over the environment's
    surface: wp.array2d[wp.int32]  # key of the surface that the cell shows; -1: none, and ratio is not valid
    filtered: wp.array2d[wp.vec3]  # factor on the frame; written only where a surface is seen


@wp.struct
class ShadowQueue:
    """Queue of secondary rays, and partial sums of cells; empty if rays are not queued."""

    extent: wp.vec2i  # rows and columns of threads, from ``tiled_shape``
    items: wp.array[wp.int32]  # index of the cell times CHUNK, plus the sample
    length: wp.array[wp.int32]  # (1,) number of queued rays
    spans: wp.array3d[wp.vec2i]  # (partials, rows, columns): first queued ray, and count; -1: nothing is hidden
    sums: wp.array3d[wp.vec3]  # (2 partials, rows, columns): light without objects, and the part that they hide
    reflected: wp.array2d[wp.vec3]  # (2, queue): light that objects reflect of the environment, and of the receiver


@wp.func
def ratio_of(without: wp.vec3, hidden: wp.vec3, depth: wp.float32) -> wp.vec4:
    """Return (R, G, B, depth): the share of the environment's irradiance that objects leave, per channel."""
    ratio = wp.vec4(1.0, 1.0, 1.0, depth)
    for channel in range(3):
        if without[channel] > MIN_IRRADIANCE:
            ratio[channel] = wp.clamp(1.0 - hidden[channel] / without[channel], 0.0, 1.0)
    return ratio


@wp.func
def bounced_of(without: wp.vec3, hidden: wp.vec3, sent: wp.vec3, returned: wp.vec3) -> wp.vec3:
    """Return the irradiance that objects reflect to a point, over that of the environment, per channel.

    Args:
        without: Irradiance of the environment without objects.
        hidden: Part of ``without`` that objects hide.
        sent: Irradiance by light of the environment that objects reflect.
        returned: Irradiance by light of an unshaded receiver that objects reflect.
    """
    ratio = wp.vec3(0.0)
    for channel in range(3):
        if without[channel] > MIN_IRRADIANCE:
            left = wp.clamp(1.0 - hidden[channel] / without[channel], 0.0, 1.0)
            back = wp.min(returned[channel] / without[channel], MAX_RETURN)
            total = (left + sent[channel] / without[channel]) / (1.0 - back)
            ratio[channel] = wp.min(total - left, MAX_RATIO)
    return ratio


@wp.func
def first_of_set(i: wp.int32, j: wp.int32, side: wp.int32, count: wp.int32) -> wp.int32:
    """Return the index of the first sample of the set of cell (i, j); ``count`` is the number of all sets' samples."""
    return count / (side * side) * ((i % side) * side + j % side)


@wp.func
def may_be_one_sided(objects: wp.array[Shape]) -> wp.bool:
    """Return whether some triangles may be seen from one side only.

    The closest hit of a ray may skip them although they hide the environment: they cast shadows from both sides, as
    ``occluded_by_objects`` finds them.
    """
    found = wp.bool(False)
    for index in range(objects.shape[0]):
        found = found or objects[index].holed != 0
    return found


@wp.func
def cone_threshold(to_center: wp.vec3, radius: wp.float32) -> wp.float32:
    """Return the least value of w . to_center for which a ray along the unit direction w meets a sphere.

    ``to_center`` leads from the ray's origin to the sphere's centre. Inside the sphere every ray meets it: -FAR.
    """
    squared = wp.dot(to_center, to_center) - radius * radius
    if squared <= 0.0:
        return -FAR
    return wp.sqrt(squared)


@functools.cache
def make_mask_cone(count: int, emitters: bool) -> wp.Function:
    """Return the function ``mask_cone(sets, first, point, to_center, radius) -> uint64``.

    Its result has one bit for each of ``count`` samples: 1 if the ray from ``point`` toward it may meet the sphere.
    """

    @wp.func(module="unique")
    def mask_cone(
        sets: SampleSets, first: wp.int32, point: wp.vec3, to_center: wp.vec3, radius: wp.float32
    ) -> wp.uint64:
        directions = sets.directions
        threshold = cone_threshold(to_center, radius)
        mask = wp.uint64(0)
        bit = wp.uint64(1)
        # The bound is a variable: an unrolled loop would load all samples at once, into as many registers.
        for k in range(first, first + count):
            direction = directions[k]
            if wp.static(emitters):
                direction = sample_toward(sets.samples[k], point).direction
            if wp.dot(direction, to_center) >= threshold:
                mask = mask | bit
            bit = bit << wp.uint64(1)
        return mask

    return mask_cone


@wp.struct
class Physical:
    """Masks of the samples that may meet a proxy or a mirror ball, one bit each."""

    proxies: wp.uint64
    balls: wp.uint64


@functools.cache
def make_masks(config: EnvironmentShadowConfig, count: int) -> tuple[wp.Function, wp.Function]:
    """Return two functions that cull ``count`` samples from ``first`` on; masks have one bit per sample.

    ``mask_objects(scene, sets, first, point) -> uint64`` marks samples that may meet an object, ``mask_physical(scene,
    distant, sets, first, point, own) -> Physical`` those that may meet a proxy other than ``own``, or a ball.
    """
    mask_cone = make_mask_cone(count, config.emitters)

    @wp.func(module="unique")
    def mask_objects(scene: RayScene, sets: SampleSets, first: wp.int32, point: wp.vec3) -> wp.uint64:
        mask = wp.uint64(0)
        for index in range(scene.objects.shape[0]):
            shape = scene.objects[index]
            mask = mask | mask_cone(sets, first, point, shape.position - point, bounding_radius(shape))
        return mask

    @wp.func(module="unique")
    def mask_physical(
        scene: RayScene, distant: DistantLight, sets: SampleSets, first: wp.int32, point: wp.vec3, own: wp.int32
    ) -> Physical:
        mask = Physical()
        everywhere = wp.uint64(0) - wp.uint64(1)
        for index in range(scene.proxies.shape[0]):
            shape = scene.proxies[index]
            if shape.kind == PLANE:
                if index != own:
                    mask.proxies = everywhere
            elif shape.kind != BOX or index != own:
                cone = mask_cone(sets, first, point, shape.position - point, bounding_radius(shape))
                mask.proxies = mask.proxies | cone
        for index in range(distant.probes.shape[0]):
            probe = distant.probes[index]
            mask.balls = mask.balls | mask_cone(sets, first, point, probe.center - point, probe.radius)
        return mask

    return mask_objects, mask_physical


@wp.struct
class SampleRay:
    """Ray from a point of the receiver toward a sample of the environment."""

    origin: wp.vec3  # set where the ray is traced
    direction: wp.vec3
    distance: wp.float32  # of the sample, metres
    grown: wp.float32  # measure seen from the point over measure seen from the ball, times the ball's weight
    cosine: wp.float32  # at the receiver; above 0 if the sample is before the surface


@functools.cache
def make_aim(emitters: bool, several: bool = False) -> wp.Function:
    """Return the function ``aim(sets, places, index, hit) -> SampleRay``: ray from ``hit`` to a sample, without origin.

    ``places`` holds the balls' positions, and is read if ``several``.
    """

    @wp.func(module="unique")
    def aim(sets: SampleSets, places: wp.array[wp.vec4], index: wp.int32, hit: Hit) -> SampleRay:
        ray = SampleRay()
        ray.direction = sets.directions[index]
        ray.distance = FAR
        ray.grown = 1.0
        if wp.static(emitters):
            toward = sample_toward(sets.samples[index], hit.point)
            ray.direction = toward.direction
            ray.distance = toward.distance
            ray.grown = toward.measure / sets.samples[index].measure
        if wp.static(several):
            ray.grown *= probe_share(places, ball_of_sample(index, places.shape[0]), hit.point)
        ray.cosine = wp.min(wp.dot(hit.normal, ray.direction), wp.dot(hit.geometric_normal, ray.direction))
        return ray

    return aim


@wp.struct
class Sender:
    """Radiance that arrives along a sample's direction without virtual objects, and its source's distance, metres."""

    radiance: wp.vec3
    distance: wp.float32


@functools.cache
def make_find_sender(config: EnvironmentShadowConfig) -> wp.Function:
    """Return ``find_sender(params, picture, scene, distant, sets, index, ray, by_proxy, by_ball) -> Sender``.

    The sender is the source of the light that arrives along ``ray``: the first proxy (sought if ``by_proxy``) or mirror
    ball (sought if ``by_ball``) on the ray, else sample ``index`` of the environment.
    """
    closest_proxy = make_trace(config.distant.trace).closest_proxy
    traced = config.bounce == "traced"
    find_in_frame = make_find_in_frame(config.distant.trace) if traced else None
    look_wide = make_look_wide(config.distant)

    @wp.func(module="unique")
    def find_sender(
        params: wp.array[FrameParams],
        picture: Picture,
        scene: RayScene,
        distant: DistantLight,
        sets: SampleSets,
        index: wp.int32,
        ray: SampleRay,
        by_proxy: wp.bool,
        by_ball: wp.bool,
    ) -> Sender:
        sender = Sender()
        sender.radiance = sets.samples[index].radiance
        sender.distance = ray.distance
        if by_proxy:
            proxy = closest_proxy(scene, ray.origin, ray.direction, ray.distance)
            if proxy.shape >= 0:
                sender.distance = proxy.t
                at = wp.vec2(-1.0, -1.0)
                if wp.static(traced):
                    at = find_in_frame(params[0], picture, scene, distant.probes, proxy)
                if at[0] >= 0.0:
                    sender.radiance = look_up(picture, at[0], at[1])
                else:
                    # In the direction in which the ball saw the point. A nearby emitter is not the proxy's light.
                    toward = proxy.point - sets.samples[index].origin
                    from_ball = wp.vec3(0.0)
                    if wp.static(config.distant.several):
                        ball = ball_of_sample(index, distant.others.places.shape[0])
                        if ball == 0:
                            from_ball = sample_latlong(distant.environment, toward)
                        else:
                            from_ball = sample_latlong(distant.others.environment[ball - 1], toward)
                    else:
                        from_ball = sample_latlong(distant.environment, toward)
                    sender.radiance = wp.min(from_ball, wp.vec3(1.0, 1.0, 1.0))
        if by_ball:
            for ball in range(distant.probes.shape[0]):
                probe = distant.probes[ball]
                t = intersect_sphere(probe.radius, ray.origin - probe.center, ray.direction, sender.distance)
                if t < sender.distance:
                    sender.distance = t
                    normal = (ray.origin + t * ray.direction - probe.center) / probe.radius
                    wi = reflect(-ray.direction, normal)
                    sender.radiance = wp.cw_mul(probe.reflectance, look_wide(distant, probe.center, wi))
        return sender

    return find_sender


# The threads of a warp compute cells that share a set of samples, so that their rays have the same directions. The
# cells are close together, so that the rays meet similar surfaces: TILE_ROWS x TILE_COLUMNS cells, ``side`` apart. The
# next warps compute the cells of the other sets in that area. The threads of one partial sum of all cells are followed
# by those of the next partial sum.
@wp.func
def tiled_cell(i: wp.int32, thread: wp.int32, side: wp.int32, extent: wp.vec2i) -> wp.vec3i:
    """Return (row, column, partial): a thread's cell and partial sum; ``extent`` is from ``tiled_shape``."""
    number = i % extent[0] * extent[1] + thread
    lane = number % (TILE_ROWS * TILE_COLUMNS)
    one_of = number / (TILE_ROWS * TILE_COLUMNS) % (side * side)
    tile = number / (TILE_ROWS * TILE_COLUMNS * side * side)
    across = extent[1] / (TILE_COLUMNS * side)
    row = (tile / across * TILE_ROWS + lane / TILE_COLUMNS) * side + one_of / side
    column = (tile % across * TILE_COLUMNS + lane % TILE_COLUMNS) * side + one_of % side
    return wp.vec3i(row, column, i / extent[0])


def tiled_shape(rows: int, columns: int, side: int) -> tuple[int, int]:
    """Return the rows and columns of threads for ``rows`` x ``columns`` cells, rounded up to whole tiles."""
    down, across = side * int(TILE_ROWS), side * int(TILE_COLUMNS)
    return -(-rows // down) * down, -(-columns // across) * across


@wp.func
def queue_rays(found: wp.uint64, begin: wp.int32, size: wp.int32, cell: wp.int32, queue_out: ShadowQueue) -> wp.vec2i:
    """Queue a cell's rays for the bits set in ``found``, and return the index of the first and their number.

    Bit k stands for sample ``begin`` + k of the cell's set; ``size`` is the number of bits.
    """
    count = wp.int32(0)
    for k in range(size):
        if (found & (wp.uint64(1) << wp.uint64(k))) != wp.uint64(0):
            count += 1
    start = wp.int32(0)
    if count > 0:
        start = wp.atomic_add(queue_out.length, 0, count)
    place = wp.int32(start)
    for k in range(size):
        if (found & (wp.uint64(1) << wp.uint64(k))) != wp.uint64(0):
            queue_out.items[place] = cell * CHUNK + begin + k
            place += 1
    return wp.vec2i(start, count)


@functools.cache
def make_environment_shadow_kernel(config: EnvironmentShadowConfig) -> wp.Kernel:
    """Return the kernel specialised to ``config``; equal configs share one kernel."""
    trace = make_trace(config.distant.trace)
    closest_object, occluded_by_objects = trace.closest_object, trace.occluded_by_objects
    chunk = min(config.count // config.partials, CHUNK)
    mask_objects, mask_physical = make_masks(config, chunk)
    visible_cell = make_visible_cell(config.distant.trace)
    aim, find_sender = make_aim(config.emitters, config.distant.several), make_find_sender(config)
    traced = config.bounce == "traced"
    look_before = None if traced else make_look_before(config.distant)
    reflect_back = make_reflect_back(config.distant, traced)
    side, queued = config.side, config.queued
    size = config.count // config.partials
    secondary_count = config.secondary_count

    registers = {"cuda_max_registers": QUEUED_REGISTERS} if queued else {}

    @wp.kernel(module="unique", enable_backward=False, **registers)
    def environment_shadow_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        picture: Picture,
        scene: RayScene,
        distant: DistantLight,
        sets: SampleSets,
        # Out:
        cells_out: ShadowCells,
        queue_out: ShadowQueue,
    ):
        i, j = wp.tid()
        i += row_start
        partial = wp.int32(0)
        if wp.static(queued):
            cell = tiled_cell(i, j, side, queue_out.extent)
            i, j, partial = cell[0], cell[1], cell[2]
            if i >= cells_out.surface.shape[0] or j >= cells_out.surface.shape[1]:
                return
            queue_out.spans[partial, i, j] = wp.vec2i(0, -1)
        stride = cells_out.stride
        hit = visible_cell(
            params[0],
            picture.rays,
            scene,
            distant.probes,
            wp.vec2i(i, j),
            stride,
            stride * side,
            params[0].shadow_rect,
        )
        if partial == 0:
            cells_out.surface[i, j] = surface_key(scene, hit)
        if hit.shape < 0:
            return
        row = cell_pixel(i, stride, picture.rays.shape[0])
        column = cell_pixel(j, stride, picture.rays.shape[1])
        if partial == 0:
            cells_out.ratio[i, j] = wp.vec4(1.0, 1.0, 1.0, hit.t)
            cells_out.bounced[i, j] = wp.vec3(0.0)

        point = hit.point
        own = hit.shape
        without = wp.vec3(0.0)
        hidden = wp.vec3(0.0)
        one_sided = may_be_one_sided(scene.objects)
        reflected = ReflectedLight()
        before = Before()
        # A set is a block of a sequence, in order: its first samples are a smaller set.
        first = first_of_set(i, j, side, sets.samples.shape[0])
        begin = partial * size
        virtual_mask = mask_objects(scene, sets, first + begin, point)
        hides_any = virtual_mask != wp.uint64(0)
        # Variables, so that loops are not unrolled.
        every = wp.int32(wp.static(config.count // chunk))
        blocks = wp.int32(wp.static(size // chunk))
        for block in range(every):
            other_block = block * wp.static(chunk)
            if not hides_any and other_block != begin:
                hides_any = mask_objects(scene, sets, first + other_block, point) != wp.uint64(0)
        if not hides_any:
            return
        found = wp.uint64(0)
        for block in range(blocks):
            at = first + begin + block * wp.static(chunk)
            if block > 0:
                virtual_mask = mask_objects(scene, sets, at, point)
            physical = mask_physical(scene, distant, sets, at, point, own)
            # Most samples meet nothing: their light is summed without a ray.
            met = virtual_mask | physical.proxies | physical.balls
            bit = wp.uint64(1)
            samples = wp.int32(wp.static(chunk))  # a variable: an unrolled loop would copy the code of a ray many times
            for k in range(samples):
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
                            asks = begin + block * wp.static(chunk) + k < wp.static(secondary_count)
                            other = Hit()
                            other.shape = -1
                            sure = wp.bool(False)
                            if asks and wp.static(not queued):
                                other = closest_object(scene, ray.origin, ray.direction, sender.distance)
                                sure = other.shape >= 0 or not one_sided
                            hides = other.shape >= 0
                            if not sure:
                                hides = occluded_by_objects(scene, ray.origin, ray.direction, sender.distance)
                            if hides:
                                hidden += weight * radiance
                                if asks:
                                    found = found | bit
                            if wp.static(not queued):
                                if other.shape >= 0:
                                    stands_for = weight * wp.static(config.count / secondary_count)
                                    meeting = meet_object(scene, other, point, ray.direction, stands_for)
                                    seed = wp.vec3ui()
                                    if wp.static(traced):
                                        seed = pcg3d_hash(wp.uint32(at + k), wp.uint32(row), wp.uint32(column))
                                    elif before.up == wp.vec3(0.0, 0.0, 0.0):
                                        before = look_before(distant, hit.point, hit.geometric_normal, ray.direction)
                                    reflected = reflect_back(
                                        params[0], picture, scene, distant, meeting, before, seed, reflected
                                    )
                bit = bit << wp.uint64(1)
        if wp.static(queued):
            cell_number = i * cells_out.surface.shape[1] + j
            queue_out.spans[partial, i, j] = queue_rays(found, begin, size, cell_number, queue_out)
            queue_out.sums[2 * partial, i, j] = without
            queue_out.sums[2 * partial + 1, i, j] = hidden
            return
        cells_out.ratio[i, j] = ratio_of(without, hidden, hit.t)
        cells_out.bounced[i, j] = bounced_of(without, hidden, reflected.sent, reflected.returned)

    return environment_shadow_kernel


def _threads(*given: Any) -> tuple[int, int]:
    """Return the rows and columns of threads: one per cell, or one per partial sum if rays are queued."""
    cells, queue = given[-2:]
    if queue.spans is None:
        return cells.surface.shape
    return queue.spans.shape[0] * queue.extent[0], queue.extent[1]


shade_environment = row_launcher(make_environment_shadow_kernel, outputs=2, like=_threads)
"""Estimate the ratio at one pixel of each cell (block of ``stride x stride`` pixels), with one set of samples.

Args:
    config: Features of the scene.
    params: (1,) FrameParams: camera and shadow_rect.
    picture: (H, W) the camera's frame, needed if bounces are traced, and its rays.
    scene: Objects and proxies.
    distant: The environment; arrays that ``config.distant`` does not use may be empty.
    sets: config.side^2 sets of config.count samples or more.
    cells_out: (ceil(H / stride), ceil(W / stride)) cells: ratio, bounced and surface are written. If rays are
        queued, ratio and bounced of cells that objects may shade are left to ``reduce_cells_kernel``.
    queue_out: Secondary rays, and partial sums; empty if ``config.queued`` is not set.
"""


@functools.cache
def make_trace_queue_kernel(config: EnvironmentShadowConfig) -> wp.Kernel:
    """Return a kernel that finds the light that objects reflect along the queued rays."""
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
            # A ray is queued only if an object is nearer than all physical surfaces: only objects are traced here.
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
    queue: ShadowQueue,
    # Out:
    cells_out: ShadowCells,
):
    """Write a cell's ratio and bounced light from its partial sums, added in the order of the samples.

    So every run gives the same bits.
    """
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
    cells_out.ratio[i, j] = ratio_of(without, hidden, cells_out.ratio[i, j][3])
    cells_out.bounced[i, j] = bounced_of(without, hidden, sent, returned)


def count_partials(rows: int, columns: int) -> int:
    """Return the number of threads per cell that fills a CUDA device: a power of 2, at most ``MAX_PARTIALS``."""
    partials = MAX_PARTIALS
    while partials > 1 and partials * rows * columns > ENOUGH_THREADS:
        partials //= 2
    return partials


def make_queue(config: EnvironmentShadowConfig, rows: int, columns: int, device: wp.DeviceLike) -> ShadowQueue | None:
    """Allocate a queue for ``rows`` x ``columns`` cells.

    Return None if a set has more than ``CHUNK`` samples, or the queue would exceed ``MAX_QUEUE``.
    """
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


def shade_by_queue(config: EnvironmentShadowConfig, *given: Any) -> None:
    """Estimate the ratio with queued secondary rays; arguments as for ``shade_environment``."""
    cells, queue = given[-2:]
    device, threads = queue.items.device, min(queue.items.shape[0], QUEUE_THREADS)
    queue.length.zero_()
    shade_environment(config, *given)
    launch(make_trace_queue_kernel(config), threads, [threads, *given[:-1]], [queue], device=device)
    launch(reduce_cells_kernel, cells.surface.shape, [queue], [cells], device=device)
