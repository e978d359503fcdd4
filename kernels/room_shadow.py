"""Shadows that virtual objects cast on the real desk under the room's light, and the light that they bounce onto it.

What a proxy's pixel becomes is a factor on what the camera sees there [Deb98]: reflectance cancels,

    ratio = E_with / E_without,   per channel,

E the irradiance at the pixel's point, without the virtual objects (the proxies and the mirror balls shadow it: they are
real and in the picture already) and with them. Both are sums over the same samples of the room's light
(``room_samples``), so a point that no object shades has a ratio of exactly 1, one that sees nothing but a black object
0, and an error of the samples cancels to first order.

Sets. The pixels of a tile of ``side x side`` use one set of samples each, and every set in turn; a filter then averages
over one tile's worth of pixels, with the edge pixels of a window of ``side + 1`` at half weight, so that each set
counts the same and the window is centred [KH01]. Neighbours on another surface do not count. All of it is a function of
the frame alone: nothing flickers and nothing lags.

Culling. A sample matters only if its direction meets the bounding sphere of an object; a dot product tells. Only those
rays are traced, and pixels that have none are done. Tiles of cells in which a ray met an object note the frame's
number: elsewhere the ratio is 1, and need not be averaged.

Bounce. What a ray meets is not black: an object reflects one of its two lobes, picked by their reflectance. Its rough
lobe gives albedo E(n) / pi, times what a ray into it meets: nothing, 1; an object, that object's own colour; the desk,
1 if a ray from there leaves the scene, else a share of the object's reflectance, so that light dies out between an
object and the ground that it stands on, the slower the whiter the object. Its glossy lobe gives what is in the mirror
direction.

References:
    [Deb98] Debevec 1998, Rendering Synthetic Objects into Real Scenes.
    [KH01] Keller, Heidrich 2001, Interleaved Sampling.
"""

from __future__ import annotations

import dataclasses
import functools

import warp as wp

from warp_ar.kernels.irradiance import sh_irradiance
from warp_ar.kernels.latlong import sample_latlong
from warp_ar.kernels.launch import Rows, launch_rows
from warp_ar.kernels.materials import make_surface, reflect
from warp_ar.kernels.prefilter import level_from_alpha
from warp_ar.kernels.reflect import Room, RoomConfig, look_up, make_find_in_frame, make_mirrored, make_shade_unoccluded
from warp_ar.kernels.relight import meets_probe
from warp_ar.kernels.room_samples import RoomSample, sample_toward
from warp_ar.kernels.sampling import frame_from_normal, pcg3d_hash, sample_cosine_hemisphere, uniform_from_bits
from warp_ar.kernels.structs import BOX, MESH, PLANE, SPHERE, FrameParams, RayScene, Shape
from warp_ar.kernels.visibility import FAR, Hit, inside_rect, make_trace, offset_origin

wp.set_module_options({"enable_backward": False})

SHADED_TILE = wp.constant(8)
"""Cells along a tile that notes whether something in it is shaded."""
WARP_LANES = 32
"""Threads of a CUDA device that go the same way or wait for each other."""
CHUNK = 64
"""Samples that are culled together: the bits of a mask."""
MIN_IRRADIANCE = wp.constant(wp.float32(1.0e-6))
"""Irradiance, in camera values, below which a surface is dark and a shadow on it means nothing."""
MAX_RATIO = wp.constant(wp.float32(4.0))
"""Largest factor: what objects bounce onto a dark place is bounded, as the picture of it is mostly noise."""
CAUSTIC_ALPHA = wp.constant(wp.float32(0.35))
"""Least width of an object's lobe as the desk sees it.

A mirror's image of a lamp on the desk is too fine for the few rays that look for it: it would come out as specks. This
blurs it to what they can carry, and keeps its energy.
"""
FURTHER = wp.constant(wp.float32(0.5))
"""Light of an object close above the desk, over that in the open: half of what it sees is its own shadow."""
MESH_KEY = wp.constant(7)
"""``surface_key`` modulo 8 of a mesh."""
DEPTH_STEP = wp.constant(wp.float32(0.03))
"""Relative change of depth from which neighbours on a mesh belong to different parts of it."""


@dataclasses.dataclass(frozen=True)
class RoomShadowConfig:
    """What is compiled into the kernel."""

    room: RoomConfig
    """Kinds of shape and forms of light."""
    count: int
    """Samples per set: up to 64, or a multiple of it."""
    side: int
    """Pixels along a tile; there are side^2 sets."""
    bounce: bool
    """Whether objects reflect light onto the desk."""
    near: bool = False
    """Whether some samples are lamps at a known distance."""


@wp.func
def bounding_radius(shape: Shape) -> wp.float32:
    """Radius of a sphere around a shape's position that holds it, metres."""
    if shape.kind == SPHERE:
        return shape.scale * shape.extent[0]
    return shape.scale * wp.length(shape.extent)


@wp.func
def cone_threshold(to_center: wp.vec3, radius: wp.float32) -> wp.float32:
    """Unit directions w with w . to_center above this meet the sphere; from inside, all do."""
    squared = wp.dot(to_center, to_center) - radius * radius
    if squared <= 0.0:
        return -FAR
    return wp.sqrt(squared)


@functools.cache
def make_mask_cone(count: int, near: bool) -> wp.Function:
    """``mask_cone(directions, samples, first, point, to_center, radius) -> uint64``: samples that point at a sphere."""

    @wp.func(module="unique")
    def mask_cone(
        directions: wp.array[wp.vec3],
        samples: wp.array[RoomSample],
        first: wp.int32,
        point: wp.vec3,
        to_center: wp.vec3,
        radius: wp.float32,
    ) -> wp.uint64:
        threshold = cone_threshold(to_center, radius)
        mask = wp.uint64(0)
        bit = wp.uint64(1)
        for k in range(count):
            direction = directions[first + k]
            if wp.static(near):
                direction = sample_toward(samples[first + k], point).direction
            if wp.dot(direction, to_center) >= threshold:
                mask = mask | bit
            bit = bit << wp.uint64(1)
        return mask

    return mask_cone


@functools.cache
def make_bounced(config: RoomConfig) -> wp.Function:
    """``bounced(params, frame, decode_table, scene, room, hit, direction, seed) -> vec3``.

    Radiance that an object sends back along a ray that met it at ``hit``: one lobe, one ray; a Monte-Carlo estimate.
    """
    trace = make_trace(config.trace)
    closest_object, closest_proxy, occluded_by_objects = (
        trace.closest_object,
        trace.closest_proxy,
        trace.occluded_by_objects,
    )
    surface_at = make_surface(config.models, config.textures)
    find_in_frame = make_find_in_frame(config.trace, config.probes)
    shade_unoccluded = make_shade_unoccluded(config)
    mirrored = make_mirrored(config)

    @wp.func(module="unique")
    def bounced(
        params: FrameParams,
        frame: wp.array2d[wp.vec3ub],
        decode_table: wp.array[wp.vec3],
        scene: RayScene,
        room: Room,
        hit: Hit,
        direction: wp.vec3,
        seed: wp.vec3ui,
    ) -> wp.vec3:
        wo = -direction
        normal = hit.normal
        geometric = hit.geometric_normal
        if wp.dot(geometric, wo) < 0.0:
            normal = -normal
            geometric = -geometric
        surface = surface_at(
            scene, room.dfg, scene.objects[hit.shape].material, hit.uv, wp.max(wp.dot(normal, wo), 0.0)
        )
        rough = surface.diffuse[0] + surface.diffuse[1] + surface.diffuse[2]
        glossy = surface.reflectance[0] + surface.reflectance[1] + surface.reflectance[2]
        if wp.static(config.diffuse == "none"):
            rough = float(0.0)
        if wp.static(not config.specular):
            glossy = float(0.0)
        if rough + glossy <= 0.0:
            return wp.vec3(0.0)
        rough_share = rough / (rough + glossy)
        u = wp.vec2(uniform_from_bits(seed[0]), uniform_from_bits(seed[1]))
        is_rough = uniform_from_bits(seed[2]) < rough_share
        weight = surface.reflectance / wp.max(1.0 - rough_share, 1.0e-6)
        outward = reflect(wo, normal)
        if is_rough:
            weight = surface.diffuse / rough_share
            outward = frame_from_normal(normal) * sample_cosine_hemisphere(u)
        if wp.dot(outward, geometric) <= 0.0:
            return wp.vec3(0.0)

        received = wp.vec3(0.0)
        origin = offset_origin(hit.point, geometric, outward, hit.error)
        other = closest_object(scene, origin, outward, FAR)
        proxy = closest_proxy(scene, origin, outward, other.t)
        if proxy.shape >= 0:
            # Light of the desk, as far as a ray from there leaves the scene.
            up = proxy.geometric_normal
            if wp.dot(up, outward) > 0.0:
                up = -up
            leaving = frame_from_normal(up) * sample_cosine_hemisphere(wp.vec2(u[1], u[0]))
            start = offset_origin(proxy.point, up, leaving, proxy.error)
            at = find_in_frame(
                params, frame.shape[0], frame.shape[1], scene, room.probes, proxy.point, proxy.geometric_normal
            )
            if at[0] >= 0.0:
                received = look_up(frame, decode_table, at[0], at[1])
            else:
                received = sample_latlong(room.environment, outward)
            if is_rough:
                if wp.static(config.diffuse == "sh"):
                    received = sh_irradiance(room.irradiance_sh, normal) / wp.pi
                if wp.static(config.diffuse == "map"):
                    received = sample_latlong(room.irradiance_map, normal) / wp.pi
            if occluded_by_objects(scene, start, leaving, FAR):
                received = wp.cw_mul(received, FURTHER * (surface.diffuse + surface.reflectance))
        elif other.shape >= 0:
            received = shade_unoccluded(scene, room, other, outward)
        elif is_rough:
            if wp.static(config.diffuse == "sh"):
                received = sh_irradiance(room.irradiance_sh, normal) / wp.pi
            if wp.static(config.diffuse == "map"):
                received = sample_latlong(room.irradiance_map, normal) / wp.pi
        else:
            if wp.static(config.specular):
                floor = level_from_alpha(CAUSTIC_ALPHA, room.level_height)
                received = mirrored(room, surface.model, surface.roughness, surface.shininess, outward, floor)
        return wp.cw_mul(weight, received)

    return bounced


@wp.func
def surface_key(scene: RayScene, hit: Hit) -> wp.int32:
    """Number that neighbours on one surface share: the proxy, and the face of a box."""
    shape = scene.proxies[hit.shape]
    key = 8 * hit.shape
    if shape.kind == MESH:
        key += MESH_KEY
    if shape.kind == BOX:
        local = wp.transpose(shape.rotation) * hit.geometric_normal
        for axis in range(3):
            if wp.abs(local[axis]) > 0.7:
                key += 2 * axis + wp.where(local[axis] > 0.0, 1, 0)
    return key


@functools.cache
def make_room_shadow_kernel(config: RoomShadowConfig) -> wp.Kernel:
    """Kernel specialised to ``config``; equal configs share one kernel."""
    if config.count > CHUNK and config.count % CHUNK:
        raise ValueError(f"count is {config.count}; expected up to {CHUNK} or a multiple of it")
    trace = make_trace(config.room.trace)
    closest_proxy, closest_object = trace.closest_proxy, trace.closest_object
    occluded_by_objects, occluded_by_proxies = trace.occluded_by_objects, trace.occluded_by_proxies
    mask_cone = make_mask_cone(min(config.count, CHUNK), config.near)
    bounced = make_bounced(config.room)
    find_in_frame = make_find_in_frame(config.room.trace, config.room.probes)
    side = config.side
    chunk = min(config.count, CHUNK)

    @wp.kernel(module="unique", enable_backward=False)
    def room_shadow_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        rays: wp.array2d[wp.vec2],
        frame: wp.array2d[wp.vec3ub],
        decode_table: wp.array[wp.vec3],
        scene: RayScene,
        room: Room,
        directions: wp.array[wp.vec3],
        flux: wp.array[wp.vec3],
        samples: wp.array[RoomSample],
        stride: wp.int32,
        lanes: wp.int32,
        # Out:
        ratio_out: wp.array2d[wp.vec4],
        surface_out: wp.array2d[wp.int32],
        shaded_out: wp.array2d[wp.int32],
    ):
        i, j = wp.tid()
        i += row_start
        # Neighbouring threads take the cells of one set, so that their rays go the same way.
        group = lanes * side
        place = j % group
        if j - place + group <= ratio_out.shape[1]:
            j += (place % lanes) * side + place / lanes - place
        row = wp.min(i * stride + stride / 2, rays.shape[0] - 1)
        column = wp.min(j * stride + stride / 2, rays.shape[1] - 1)
        surface_out[i, j] = -1
        rect = params[0].shadow_rect
        # The filter looks half a tile beyond the pixels that it writes.
        margin = stride * wp.static(config.side)
        wide = wp.vec4i(rect[0] - margin, rect[1] + margin, rect[2] - margin, rect[3] + margin)
        if rect[0] >= rect[1] or not inside_rect(row, column, wide):
            return
        ray = rays[row, column]
        direction = params[0].world_from_camera * wp.vec3(ray[0], ray[1], 1.0)
        hit = closest_proxy(scene, params[0].camera_position, direction, FAR)
        if hit.shape < 0 or wp.dot(hit.geometric_normal, direction) >= 0.0:
            return
        if wp.static(config.room.probes):
            if meets_probe(room.probes, params[0].camera_position, direction, hit.t):
                return
        surface_out[i, j] = surface_key(scene, hit)
        ratio_out[i, j] = wp.vec4(1.0, 1.0, 1.0, hit.t)

        point = hit.point
        own = hit.shape
        everywhere = wp.uint64(0) - wp.uint64(1)
        without = wp.vec3(0.0)
        change = wp.vec3(0.0)
        # A set is in the order of its sequence: any first part of it is a smaller set.
        first = samples.shape[0] / wp.static(side * side) * ((i % side) * side + j % side)
        for part in range(wp.static(config.count // chunk)):
            at = first + part * wp.static(chunk)
            virtual_mask = wp.uint64(0)
            for index in range(scene.objects.shape[0]):
                shape = scene.objects[index]
                virtual_mask = virtual_mask | mask_cone(
                    directions, samples, at, point, shape.position - point, bounding_radius(shape)
                )
            if wp.static(config.count == chunk):
                if virtual_mask == wp.uint64(0):
                    return
            proxy_mask = wp.uint64(0)
            for index in range(scene.proxies.shape[0]):
                shape = scene.proxies[index]
                if shape.kind == PLANE:
                    if index != own:
                        proxy_mask = everywhere
                elif shape.kind != BOX or index != own:
                    proxy_mask = proxy_mask | mask_cone(
                        directions, samples, at, point, shape.position - point, bounding_radius(shape)
                    )
            ball_mask = wp.uint64(0)
            if wp.static(config.room.probes):
                for index in range(room.probes.shape[0]):
                    probe = room.probes[index]
                    ball_mask = ball_mask | mask_cone(
                        directions, samples, at, point, probe.center - point, probe.radius
                    )
            # Most samples meet nothing: they are but a sum.
            met = virtual_mask | proxy_mask | ball_mask
            bit = wp.uint64(1)
            stop = wp.int32(wp.static(chunk))  # a loop: unrolled, the kernel would hold its rays many times over
            for k in range(stop):
                direction = directions[at + k]
                reach = float(FAR)
                grown = float(1.0)
                if wp.static(config.near):
                    toward = sample_toward(samples[at + k], point)
                    direction = toward.direction
                    reach = toward.distance
                    grown = toward.measure / samples[at + k].measure
                cosine = wp.min(wp.dot(hit.normal, direction), wp.dot(hit.geometric_normal, direction))
                if cosine > 0.0:
                    if (met & bit) == wp.uint64(0):
                        without += cosine * grown * flux[at + k]
                    else:
                        measure = samples[at + k].measure
                        weight = cosine * grown * measure
                        origin = offset_origin(point, hit.geometric_normal, direction, hit.error)
                        radiance = samples[at + k].radiance
                        if (ball_mask & bit) != wp.uint64(0):
                            radiance = wp.vec3(0.0)
                        elif (proxy_mask & bit) != wp.uint64(0):
                            if wp.static(config.bounce):
                                proxy = closest_proxy(scene, origin, direction, reach)
                                if proxy.shape >= 0:
                                    reach = proxy.t
                                    radiance = wp.vec3(0.0)
                                    pixel = find_in_frame(
                                        params[0],
                                        frame.shape[0],
                                        frame.shape[1],
                                        scene,
                                        room.probes,
                                        proxy.point,
                                        proxy.geometric_normal,
                                    )
                                    if pixel[0] >= 0.0:
                                        radiance = look_up(frame, decode_table, pixel[0], pixel[1])
                            else:
                                if occluded_by_proxies(scene, origin, direction, reach):
                                    radiance = wp.vec3(0.0)
                        without += weight * radiance
                        if (virtual_mask & bit) != wp.uint64(0):
                            if wp.static(config.bounce):
                                other = closest_object(scene, origin, direction, reach)
                                if other.shape >= 0:
                                    seed = pcg3d_hash(wp.uint32(at + k), wp.uint32(row), wp.uint32(column))
                                    light = bounced(params[0], frame, decode_table, scene, room, other, direction, seed)
                                    change += weight * (light - radiance)
                            else:
                                if occluded_by_objects(scene, origin, direction, reach):
                                    change -= weight * radiance
                bit = bit << wp.uint64(1)
        unchanged = change == wp.vec3(0.0, 0.0, 0.0)
        if shaded_out.shape[0] > 0 and not unchanged:
            shaded_out[i / SHADED_TILE, j / SHADED_TILE] = params[0].frame_index
        ratio = wp.vec4(1.0, 1.0, 1.0, hit.t)
        for channel in range(3):
            if without[channel] > MIN_IRRADIANCE:
                ratio[channel] = wp.clamp(1.0 + change[channel] / without[channel], 0.0, MAX_RATIO)
        ratio_out[i, j] = ratio

    return room_shadow_kernel


@wp.func
def is_near_shaded(
    shaded: wp.array2d[wp.int32], frame_index: wp.int32, i: wp.int32, j: wp.int32, reach: wp.int32
) -> wp.bool:
    """Whether something is shaded in this frame in a tile within ``reach`` cells."""
    for a in range(wp.max(i - reach, 0) / SHADED_TILE, wp.min((i + reach) / SHADED_TILE + 1, shaded.shape[0])):
        for b in range(wp.max(j - reach, 0) / SHADED_TILE, wp.min((j + reach) / SHADED_TILE + 1, shaded.shape[1])):
            if shaded[a, b] == frame_index:
                return True
    return False


@wp.kernel(enable_backward=False)
def filter_ratio_kernel(
    # In:
    row_start: wp.int32,
    params: wp.array[FrameParams],
    shaded: wp.array2d[wp.int32],
    ratio: wp.array2d[wp.vec4],
    surface: wp.array2d[wp.int32],
    side: wp.int32,
    # Out:
    filtered_out: wp.array2d[wp.vec3],
):
    """Mean over one tile's worth of neighbours on the same surface."""
    i, j = wp.tid()
    i += row_start
    key = surface[i, j]
    if key < 0:
        return
    depth = ratio[i, j][3]
    reach = side / 2
    if shaded.shape[0] > 0:
        if not is_near_shaded(shaded, params[0].frame_index, i, j, reach):
            filtered_out[i, j] = wp.vec3(1.0, 1.0, 1.0)
            return
    total = wp.vec3(0.0)
    weights = float(0.0)
    for ni in range(wp.max(i - reach, 0), wp.min(i + reach + 1, ratio.shape[0])):
        for nj in range(wp.max(j - reach, 0), wp.min(j + reach + 1, ratio.shape[1])):
            if surface[ni, nj] == key:
                value = ratio[ni, nj]
                weight = float(1.0)
                if side > 1:
                    weight = wp.where(wp.abs(ni - i) == reach, 0.5, 1.0) * wp.where(wp.abs(nj - j) == reach, 0.5, 1.0)
                # A mesh has no faces to tell apart: neighbours much nearer or farther are another part of it.
                if key % 8 == MESH_KEY and wp.abs(value[3] - depth) > DEPTH_STEP * depth:
                    weight = 0.0
                total += weight * wp.vec3(value[0], value[1], value[2])
                weights += weight
    filtered_out[i, j] = total / weights


@wp.kernel(enable_backward=False)
def spread_ratio_kernel(
    # In:
    row_start: wp.int32,
    params: wp.array[FrameParams],
    filtered: wp.array2d[wp.vec3],
    surface: wp.array2d[wp.int32],
    stride: wp.int32,
    # Out:
    physical_ratio_out: wp.array2d[wp.vec3],
):
    """From cells to pixels: bilinear among the cells on the surface of the nearest one."""
    i, j = wp.tid()
    i += row_start
    physical_ratio_out[i, j] = wp.vec3(1.0, 1.0, 1.0)
    if not inside_rect(i, j, params[0].shadow_rect):
        return
    key = surface[wp.min(i / stride, surface.shape[0] - 1), wp.min(j / stride, surface.shape[1] - 1)]
    if key < 0:
        return
    # Cell c was estimated at pixel c * stride + stride / 2.
    y = wp.float32(i - stride / 2) / wp.float32(stride)
    x = wp.float32(j - stride / 2) / wp.float32(stride)
    row = wp.int32(wp.floor(y))
    column = wp.int32(wp.floor(x))
    total = wp.vec3(0.0)
    weights = float(0.0)
    for a in range(2):
        for b in range(2):
            weight = (1.0 - wp.abs(y - wp.float32(row + a))) * (1.0 - wp.abs(x - wp.float32(column + b)))
            ni = wp.clamp(row + a, 0, surface.shape[0] - 1)
            nj = wp.clamp(column + b, 0, surface.shape[1] - 1)
            if weight > 0.0 and surface[ni, nj] == key:
                total += weight * filtered[ni, nj]
                weights += weight
    if weights > 0.0:
        physical_ratio_out[i, j] = total / weights


def shade_room(
    config: RoomShadowConfig,
    params: wp.array[FrameParams],
    rays: wp.array2d[wp.vec2],
    frame: wp.array2d[wp.vec3ub],
    decode_table: wp.array[wp.vec3],
    scene: RayScene,
    room: Room,
    directions: wp.array[wp.vec3],
    flux: wp.array[wp.vec3],
    samples: wp.array[RoomSample],
    stride: int,
    ratio_out: wp.array2d[wp.vec4],
    surface_out: wp.array2d[wp.int32],
    *,
    shaded_out: wp.array2d[wp.int32] | None = None,
    rows: Rows | None = None,
) -> None:
    """Estimate the ratio for one pixel of every ``stride x stride``, each with one set of samples.

    Args:
        config: What the scene calls for.
        params: (1,) FrameParams: camera and shadow_rect.
        rays: (H, W) undistorted (x / z, y / z) of each pixel's centre.
        frame: (H, W) the camera's frame, RGB.
        decode_table: (256,) of ``color.decode_table``.
        scene: Objects and proxies.
        room: The room's light; what ``config.room`` leaves out may be empty.
        directions: (config.side^2 * n,) directions of the samples, set after set; n is config.count or more.
        flux: (the same) radiance times solid angle of the samples.
        samples: (the same) the samples.
        stride: Pixels from one estimate to the next.
        ratio_out: (ceil(H / stride), ceil(W / stride)) RGB ratio and depth.
        surface_out: (the same) number of the surface seen; -1 for none, where ratio_out holds nothing.
        shaded_out: ``shaded_shape`` of that: number of the last frame in which something in a tile of cells was shaded.
        rows: Band of rows of the outputs; None means all.
    """
    # Few short rays gain less from it than they lose by writing far apart: 2.4 against 2.8 ms for a frame of 4K.
    lanes = WARP_LANES if config.bounce and not rays.device.is_cpu else 1
    launch_rows(
        make_room_shadow_kernel(config),
        ratio_out.shape,
        [params, rays, frame, decode_table, scene, room, directions, flux, samples, stride, lanes],
        [ratio_out, surface_out, shaded_out],
        rows=rows,
        device=rays.device,
    )


def shaded_shape(rows: int, columns: int) -> tuple[int, int]:
    """Shape of the array that notes shaded tiles, for so many cells."""
    return -(-rows // int(SHADED_TILE)), -(-columns // int(SHADED_TILE))


def filter_ratio(
    ratio: wp.array2d[wp.vec4],
    surface: wp.array2d[wp.int32],
    side: int,
    filtered_out: wp.array2d[wp.vec3],
    *,
    params: wp.array[FrameParams] | None = None,
    shaded: wp.array2d[wp.int32] | None = None,
    rows: Rows | None = None,
) -> None:
    """Average the estimates over tiles, along surfaces only; exactly 1 where nothing is shaded.

    Args:
        ratio: From ``shade_room``.
        surface: From ``shade_room``.
        side: Cells along a tile.
        filtered_out: As ``ratio``, without the depth; written only where a surface is seen.
        params: (1,) FrameParams: frame_index; needed with ``shaded``.
        shaded: From ``shade_room``; where it is left out every cell is averaged.
        rows: Band of rows; None means all.
    """
    launch_rows(
        filter_ratio_kernel,
        surface.shape,
        [params, shaded, ratio, surface, side],
        [filtered_out],
        rows=rows,
        device=surface.device,
    )


def spread_ratio(
    params: wp.array[FrameParams],
    filtered: wp.array2d[wp.vec3],
    surface: wp.array2d[wp.int32],
    stride: int,
    physical_ratio_out: wp.array2d[wp.vec3],
    *,
    rows: Rows | None = None,
) -> None:
    """Give every pixel its ratio.

    Args:
        params: (1,) FrameParams: shadow_rect.
        filtered: From ``filter_ratio``.
        surface: From ``shade_room``.
        stride: Pixels per cell.
        physical_ratio_out: (H, W) factor on the frame; 1 outside the rectangle and where no proxy is seen.
        rows: Band of rows; None means all.
    """
    launch_rows(
        spread_ratio_kernel,
        physical_ratio_out.shape,
        [params, filtered, surface, stride],
        [physical_ratio_out],
        rows=rows,
        device=surface.device,
    )
