"""Shadows that virtual objects cast on the receiver under the environment, and the light that they bounce onto it.

What a proxy's pixel becomes is a factor on what the camera sees there [Deb98]: reflectance cancels,

    ratio = E_with / E_without,   per channel,

E the irradiance at the pixel's point, without the virtual objects (the proxies and the mirror balls shadow it: they are
real and in the picture already) and with them. Both are sums over the same samples of the environment
(``environment_samples``), so a point that no object shades has a ratio of exactly 1, one that sees nothing but a black
object 0, and an error of the samples cancels to first order.

Culling. A sample matters only if its direction meets the bounding sphere of an object; a dot product tells. Only those
rays are traced, and cells that have none are done.

The physical. A ray that meets a proxy or a mirror ball, with objects or without them, finds its light: the camera's
picture of it where that shows it (``traced``), else what the ball saw in its direction; of a ball what it reflects.

Cells, their sets of samples and the mean of neighbours are those of ``environment_shadow_cells``; what objects send
back is found by ``environment_shadow_bounce``. Several threads may share the samples of a cell, each with a partial
sum; these are added in the order of the samples, so that the same frame gives the same bits.

References:
    [Deb98] Debevec 1998, Rendering Synthetic Objects into Real Scenes.
"""

from __future__ import annotations

import functools

import warp as wp

from warp_ar.kernels.cells import cell_pixel
from warp_ar.kernels.environment.environment_samples import SampleSets, ball_of_sample, sample_toward
from warp_ar.kernels.environment.probe_weights import probe_share
from warp_ar.kernels.latlong import sample_latlong
from warp_ar.kernels.launch import Rows, launch, launch_rows
from warp_ar.kernels.materials import reflect
from warp_ar.kernels.objects.reflect import DistantLight, look_up, make_find_in_frame
from warp_ar.kernels.rays.shapes import FAR, intersect_sphere, surface_key
from warp_ar.kernels.rays.trace import make_trace, offset_origin
from warp_ar.kernels.rays.visibility import make_visible_proxy
from warp_ar.kernels.receiver.environment_shadow_bounce import (
    Before,
    Meeting,
    ReflectedLight,
    bounding_radius,
    caustic_alpha,
    make_look_before,
    make_look_wide,
    make_reflect_back,
)
from warp_ar.kernels.receiver.environment_shadow_cells import (
    CHUNK,
    SHADED_TILE,
    EnvironmentShadowConfig,
    ShadowCells,
    bounced_of,
    can_matter,
    cell_column,
    first_of_set,
    ratio_of,
)
from warp_ar.kernels.sampling import pcg3d_hash
from warp_ar.kernels.structs import BOX, PLANE, FrameParams, Hit, Picture, RayScene, Shape

wp.set_module_options({"enable_backward": False})

SUMS = wp.constant(4)
"""Values of a partial sum: light without the objects, what they hide, what they send of it, and of the receiver."""


@wp.func
def may_be_one_sided(objects: wp.array[Shape]) -> wp.bool:
    """Return whether the closest hit may pass what hides the environment: triangles that are seen from one side only.

    They throw shadows from both sides, and ``occluded_by_objects`` knows no other.
    """
    found = wp.bool(False)
    for index in range(objects.shape[0]):
        found = found or objects[index].holed != 0
    return found


@wp.func
def cone_threshold(to_center: wp.vec3, radius: wp.float32) -> wp.float32:
    """Unit directions w with w . to_center above this meet the sphere; from inside, all do."""
    squared = wp.dot(to_center, to_center) - radius * radius
    if squared <= 0.0:
        return -FAR
    return wp.sqrt(squared)


@functools.cache
def make_mask_cone(count: int, emitters: bool) -> wp.Function:
    """``mask_cone(sets, first, point, to_center, radius) -> uint64``: samples that point at a sphere."""

    @wp.func(module="unique")
    def mask_cone(
        sets: SampleSets, first: wp.int32, point: wp.vec3, to_center: wp.vec3, radius: wp.float32
    ) -> wp.uint64:
        directions = sets.directions
        threshold = cone_threshold(to_center, radius)
        mask = wp.uint64(0)
        bit = wp.uint64(1)
        # Its end is no constant: a loop that is unrolled loads all of its samples at once, into as many registers.
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
    """Samples that may meet a proxy or a mirror ball, a bit each."""

    proxies: wp.uint64
    balls: wp.uint64


@functools.cache
def make_masks(config: EnvironmentShadowConfig, count: int) -> tuple[wp.Function, wp.Function]:
    """Which of ``count`` samples from ``first`` on may meet something, a bit each, as a point sees them.

    ``mask_objects(scene, sets, first, point) -> uint64``, and ``mask_physical(scene, distant, sets, first, point, own)
    -> Physical``, ``own`` being the proxy that the point is on.
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
        scene: RayScene,
        distant: DistantLight,
        sets: SampleSets,
        first: wp.int32,
        point: wp.vec3,
        own: wp.int32,
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
        if wp.static(config.distant.probes):
            for index in range(distant.probes.shape[0]):
                probe = distant.probes[index]
                mask.balls = mask.balls | mask_cone(sets, first, point, probe.center - point, probe.radius)
        return mask

    return mask_objects, mask_physical


@wp.struct
class SampleRay:
    """From a point of the receiver toward a sample of the environment."""

    origin: wp.vec3  # set where the ray is traced
    direction: wp.vec3
    distance: wp.float32  # of the sample, metres
    grown: wp.float32  # the sample's measure as the point sees it, over that from the ball, and what the ball counts
    cosine: wp.float32  # at the receiver; the point sees the sample if it is above 0


@functools.cache
def make_aim(emitters: bool, several: bool = False) -> wp.Function:
    """``aim(sets, places, index, hit) -> SampleRay``: less its origin; ``places`` of the balls, if ``several``."""

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
    """What sends light along a sample's direction where no virtual object stands."""

    radiance: wp.vec3
    distance: wp.float32


@functools.cache
def make_find_sender(config: EnvironmentShadowConfig) -> wp.Function:
    """``find_sender(params, picture, scene, distant, sets, index, ray, by_proxy, by_ball) -> Sender``.

    The sample itself, or the physical before it: a proxy if ``by_proxy``, a mirror ball if
    ``by_ball``; those that the ray cannot meet need not be asked.
    """
    closest_proxy = make_trace(config.distant.trace).closest_proxy
    traced = config.bounce == "traced"
    find_in_frame = make_find_in_frame(config.distant.trace, config.distant.probes) if traced else None
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
                    # Where the ball saw it; an emitter right beside it is not its light.
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
        if wp.static(config.distant.probes):
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


@wp.func
def write_cell(
    params: wp.array[FrameParams],
    i: wp.int32,
    j: wp.int32,
    without: wp.vec3,
    hidden: wp.vec3,
    reflected: ReflectedLight,
    cells_out: ShadowCells,
):
    """Write a cell's estimate, and note its tile where an object changes anything."""
    unchanged = hidden + reflected.sent == wp.vec3(0.0, 0.0, 0.0)
    if cells_out.shaded.shape[0] > 0 and not unchanged:
        cells_out.shaded[i / SHADED_TILE, j / SHADED_TILE] = params[0].frame_index
    cells_out.ratio[i, j] = ratio_of(without, hidden, cells_out.ratio[i, j][3])
    cells_out.bounced[i, j] = bounced_of(without, hidden, reflected.sent, reflected.returned)


@functools.cache
def make_environment_shadow_kernel(config: EnvironmentShadowConfig) -> wp.Kernel:
    """Return the kernel specialised to ``config``; equal configs share one kernel."""
    trace = make_trace(config.distant.trace)
    closest_object, occluded_by_objects = trace.closest_object, trace.occluded_by_objects
    # A partial sum is over ``size`` samples, culled by ``chunk`` at a time.
    size = config.count // config.partials
    chunk = min(size, int(CHUNK))
    mask_objects, mask_physical = make_masks(config, chunk)
    visible_proxy = make_visible_proxy(config.distant.trace, config.distant.probes)
    aim, find_sender = make_aim(config.emitters, config.distant.several), make_find_sender(config)
    traced = config.bounce == "traced"
    look_before = None if traced else make_look_before(config.distant)
    reflect_back = make_reflect_back(config.distant, traced)
    side = config.side
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
        # Out:
        cells_out: ShadowCells,
        sums_out: wp.array3d[wp.vec3],
    ):
        place, j = wp.tid()
        place += row_start
        i = place % cells_out.surface.shape[0]
        partial = place / cells_out.surface.shape[0]
        rays = picture.rays
        stride = cells_out.stride
        j = cell_column(j, cells_out.surface.shape[1], side)
        row = cell_pixel(i, stride, rays.shape[0])
        column = cell_pixel(j, stride, rays.shape[1])
        if partial == 0:
            cells_out.surface[i, j] = -1
        if not can_matter(row, column, stride * side, params[0].shadow_rect):
            return
        hit = visible_proxy(params[0], rays[row, column], scene, distant.probes)
        if hit.shape < 0:
            return
        if partial == 0:
            cells_out.surface[i, j] = surface_key(scene.proxies[hit.shape], hit.shape, hit.geometric_normal)
            cells_out.ratio[i, j] = wp.vec4(1.0, 1.0, 1.0, hit.t)
            cells_out.bounced[i, j] = wp.vec3(0.0)
        if wp.static(config.partials > 1):
            for kind in range(SUMS):
                sums_out[partial * SUMS + kind, i, j] = wp.vec3(0.0)

        point = hit.point
        own = hit.shape
        without = wp.vec3(0.0)
        hidden = wp.vec3(0.0)
        one_sided = may_be_one_sided(scene.objects)
        reflected = ReflectedLight()
        before = Before()
        # A set is in the order of its sequence: any first part of it is a smaller set.
        first = first_of_set(i, j, side, sets.samples.shape[0])
        virtual_mask = wp.uint64(0)
        blocks = wp.int32(wp.static(config.count // chunk))  # a variable: not to be unrolled
        for block in range(blocks):
            if virtual_mask == wp.uint64(0):
                virtual_mask = mask_objects(scene, sets, first + block * wp.static(chunk), point)
        if virtual_mask == wp.uint64(0):
            return
        begin = partial * wp.static(size)
        while begin < (partial + 1) * wp.static(size):
            at = first + begin
            if wp.static(config.count > chunk):
                virtual_mask = mask_objects(scene, sets, at, point)
            physical = mask_physical(scene, distant, sets, at, point, own)
            # Most samples meet nothing: they are but a sum.
            met = virtual_mask | physical.proxies | physical.balls
            bit = wp.uint64(1)
            count = wp.int32(wp.static(chunk))  # a variable: unrolled, the kernel would hold its rays many times over
            for k in range(count):
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
                            if begin + k < wp.static(secondary_count):
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
            begin += wp.static(chunk)
        if wp.static(config.partials > 1):
            sums_out[partial * SUMS, i, j] = without
            sums_out[partial * SUMS + 1, i, j] = hidden
            sums_out[partial * SUMS + 2, i, j] = reflected.sent
            sums_out[partial * SUMS + 3, i, j] = reflected.returned
        else:
            write_cell(params, i, j, without, hidden, reflected, cells_out)

    return environment_shadow_kernel


@wp.kernel(enable_backward=False)
def reduce_sums_kernel(
    # In:
    params: wp.array[FrameParams],
    sums: wp.array3d[wp.vec3],
    # Out:
    cells_out: ShadowCells,
):
    """Add the partial sums of a cell."""
    i, j = wp.tid()
    if cells_out.surface[i, j] < 0:
        return
    without = wp.vec3(0.0)
    hidden = wp.vec3(0.0)
    reflected = ReflectedLight()
    for partial in range(sums.shape[0] / SUMS):
        without += sums[partial * SUMS, i, j]
        hidden += sums[partial * SUMS + 1, i, j]
        reflected.sent += sums[partial * SUMS + 2, i, j]
        reflected.returned += sums[partial * SUMS + 3, i, j]
    write_cell(params, i, j, without, hidden, reflected, cells_out)


def partial_sums_shape(partials: int, rows: int, columns: int) -> tuple[int, int, int]:
    """Return the shape of the scratch of ``shade_environment`` for so many cells; empty for one partial sum."""
    return (partials * int(SUMS), rows, columns) if partials > 1 else (0, 0, 0)


def shade_environment(
    config: EnvironmentShadowConfig,
    params: wp.array[FrameParams],
    picture: Picture,
    scene: RayScene,
    distant: DistantLight,
    sets: SampleSets,
    cells_out: ShadowCells,
    sums_out: wp.array3d[wp.vec3] | None = None,
    *,
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
        sums_out: Scratch of ``partial_sums_shape``, if ``config.partials`` is more than 1.
        rows: Band of rows of the cells; None means all, as it must where there are partial sums.
    """
    shape, device = cells_out.surface.shape, picture.rays.device
    launch_rows(
        make_environment_shadow_kernel(config),
        (shape[0] * config.partials, shape[1]),
        [params, picture, scene, distant, sets],
        [cells_out, sums_out],
        rows=rows,
        device=device,
    )
    if config.partials > 1:
        launch(reduce_sums_kernel, shape, [params, sums_out], [cells_out], device=device)
