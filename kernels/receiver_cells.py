"""What ``relight`` needs to know of the receiver beyond its own pixel, estimated for cells of the frame.

**Share.** Reflectance is what the camera sees over what the environment sends (``relight``, equation 3). The
environment's filtered irradiance knows nothing of what stands in the way: in the shadow of the ball or of a box it is
too much, and the receiver would be taken for darker than it is. So per cell, over the environment's samples
(``environment_samples``),

    share = 1 - sum over hidden ones of measure * cos * (radiance - what hides it) / sum of measure * cos * radiance,

which is 1 to the bit where nothing is hidden. Only cells that virtual light falls on are asked: first those that a
light shines on, then, once it is known what these send on, those that are reached by that.
What hides light sends some itself: a ball its reflectance times the mean of what its normal faces, a box as grey paper
would. Planes hide nothing: the ball has seen them where the environment has them. A CUDA device has several threads
share the samples of a cell; their sums are added in one order, so that the same frame gives the same bits.

**Bounced light.** A lit proxy lights the others. Every cell of a coarse grid is a patch: radiance L that virtual light
adds there (``relight``'s own, direct), and the area A of the surface that its pixels show. A receiver at distance r
gets

    E = sum over patches of  L A cos cos' / (r^2 + A / pi),

which is a disc's form factor on its axis: finite where a box stands on the lit desk, and pi L for a patch that fills
the hemisphere. One bounce; what the camera does not show sends nothing, and nothing stands between. Points of one flat
surface, which rounding puts above or below each other, share a normal: of two the upper one turns its back.
"""

from __future__ import annotations

import dataclasses
import functools

import warp as wp

from warp_ar.kernels.environment_samples import EnvironmentSample, sample_toward
from warp_ar.kernels.irradiance import sh_irradiance
from warp_ar.kernels.latlong import sample_latlong
from warp_ar.kernels.launch import MOST_REGISTERS, Rows, launch, launch_rows
from warp_ar.kernels.relight import (
    DEFAULT_REFLECTANCE,
    Receiver,
    RelightConfig,
    look_up_cells,
    make_lit_by,
    middle_pixel,
)
from warp_ar.kernels.shadow import sample_light, tile_turn
from warp_ar.kernels.structs import PLANE, FrameParams, Light, RayScene
from warp_ar.kernels.visibility import (
    FAR,
    Hit,
    TraceConfig,
    inside_rect,
    intersect_sphere,
    make_trace,
    meets_probe,
    offset_origin,
    surface_key,
)

wp.set_module_options({"enable_backward": False})

MIN_IRRADIANCE = wp.constant(wp.float32(1.0e-6))
"""Irradiance, in camera values, below which a share means nothing."""
NEGLIGIBLE = wp.constant(wp.float32(1.0 / 1024.0))
"""Bounced light over the environment's that no 8-bit picture shows: an eighth of a code at most, taken for none."""
MIN_FACING = wp.constant(wp.float32(0.02))
"""Least cosine at which the area that pixels show is believed: beyond it a patch would reach over the horizon."""
SHARE_PARTS = 16
"""Threads of a CUDA device that share the samples of a cell at most: few cells are asked, each of many samples."""
SHARE_SUMS = wp.constant(2)
"""Sums per part of a cell: the environment, and what is lost of it."""
PENDING = wp.constant(-2)
"""What ``surface_out`` holds less the cell's surface while parts of its share are not yet added."""


@wp.struct
class Patch:
    """A piece of a proxy that sends virtual light on."""

    position: wp.vec3
    normal: wp.vec3
    flux: wp.vec3  # radiance times area
    area: wp.float32  # square metres


@dataclasses.dataclass(frozen=True)
class CellConfig:
    """What is compiled into the kernels."""

    relight: RelightConfig
    """Of the direct light: kinds of shape, and form of the environment's irradiance."""

    @property
    def trace(self) -> TraceConfig:
        """Kinds of shape."""
        return self.relight.trace


@functools.cache
def make_seen_receiver(config: CellConfig) -> wp.Function:
    """``seen_receiver(params, rays, scene, desk, row, col) -> Hit``: the proxy that a pixel shows, or shape -1."""
    closest_proxy = make_trace(config.trace).closest_proxy

    @wp.func(module="unique")
    def seen_receiver(
        params: FrameParams, rays: wp.array2d[wp.vec2], scene: RayScene, desk: Receiver, row: wp.int32, col: wp.int32
    ) -> Hit:
        ray = rays[row, col]
        direction = params.world_from_camera * wp.vec3(ray[0], ray[1], 1.0)
        hit = closest_proxy(scene, params.camera_position, direction, FAR)
        if hit.shape >= 0:
            if wp.dot(hit.geometric_normal, direction) >= 0.0:
                hit.shape = -1
            if wp.static(config.relight.probes):
                if meets_probe(desk.probes, params.camera_position, direction, hit.t):
                    hit.shape = -1
        return hit

    return seen_receiver


@wp.func
def share_of(lost: wp.float32, whole: wp.float32) -> wp.float32:
    """Part of ``whole`` that is left without ``lost``; within 0..1 for whatever comes in, 1 where nothing is known."""
    if not whole > MIN_IRRADIANCE:  # NaN as well
        return 1.0
    share = 1.0 - lost / whole
    if not share < 1.0:
        return 1.0
    return wp.max(share, 0.0)


@wp.func
def shares_of(lost: wp.vec3, whole: wp.vec3) -> wp.vec3:
    """``share_of`` for each channel."""
    return wp.vec3(share_of(lost[0], whole[0]), share_of(lost[1], whole[1]), share_of(lost[2], whole[2]))


@wp.func
def near_ball(away: wp.vec3, radius: wp.float32, direction: wp.vec3) -> wp.bool:
    """Whether a direction leads from a point into the ball around ``away``, or the point is in it."""
    beside = wp.dot(away, away) - radius * radius
    along = wp.dot(away, direction)
    return beside <= 0.0 or (along > 0.0 and along * along > beside)


@wp.func
def in_lit_cells(cell_row: wp.int32, cell_col: wp.int32, stride: wp.int32, rect: wp.vec4i) -> wp.bool:
    """Whether a pixel of the rectangle may look a cell up."""
    reach = wp.vec4i(rect[0] - 2 * stride, rect[1] + 2 * stride, rect[2] - 2 * stride, rect[3] + 2 * stride)
    return rect[0] < rect[1] and inside_rect(cell_row * stride, cell_col * stride, reach)


@functools.cache
def make_mean_facing(config: CellConfig) -> wp.Function:
    """``mean_facing(desk, normal) -> vec3``: mean radiance, by the cosine, of the environment before a surface."""
    form = config.relight.irradiance

    @wp.func(module="unique")
    def mean_facing(desk: Receiver, normal: wp.vec3) -> wp.vec3:
        if wp.static(form == "sh"):
            mean = sh_irradiance(desk.irradiance_sh, normal) / wp.pi
        else:
            mean = sample_latlong(desk.irradiance_map, normal) / wp.pi
        # A series may ring below zero, which no light does.
        return wp.max(mean, wp.vec3(0.0, 0.0, 0.0))

    return mean_facing


@functools.cache
def make_share_environment_kernel(config: CellConfig) -> wp.Kernel:
    """Kernel of ``share_environment``."""
    seen_receiver = make_seen_receiver(config)
    mean_facing = make_mean_facing(config)
    closest_proxy = make_trace(config.trace).closest_proxy
    only_planes = set(config.trace.proxies) <= {PLANE}

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def share_environment_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        rays: wp.array2d[wp.vec2],
        scene: RayScene,
        lights: wp.array[Light],
        desk: Receiver,
        samples: wp.array[EnvironmentSample],
        count: wp.int32,
        stride: wp.int32,
        bounced: wp.bool,
        parts: wp.int32,
        # Out:
        share_out: wp.array2d[wp.vec3],
        surface_out: wp.array2d[wp.int32],
        sums_out: wp.array3d[wp.vec3],
    ):
        ci, cj = wp.tid()
        ci += row_start
        part = ci / share_out.shape[0]
        ci = ci % share_out.shape[0]
        # One part of a cell writes its surface, and no surface that another part may still read as found before.
        if not bounced:
            if part == 0:
                surface_out[ci, cj] = -1
        elif surface_out[ci, cj] >= 0:
            return
        if not in_lit_cells(ci, cj, stride, params[0].light_rect):
            return
        i = middle_pixel(ci, stride, rays.shape[0])
        j = middle_pixel(cj, stride, rays.shape[1])
        hit = seen_receiver(params[0], rays, scene, desk, i, j)
        if hit.shape < 0:
            return
        key = surface_key(scene.proxies[hit.shape], hit.shape, hit.geometric_normal)
        needed = bool(False)
        if bounced:
            cells = desk.cells
            size = wp.vec2i(rays.shape[0], rays.shape[1])
            sent = look_up_cells(cells.bounced, cells.bounced_surface, cells.bounced_stride, key, size, i, j)
            needed = sent[0] + sent[1] + sent[2] > 0.0
        else:
            for index in range(lights.shape[0]):
                light = sample_light(lights[index], hit.point)
                if wp.dot(hit.geometric_normal, light.wi) > 0.0 and wp.max(light.irradiance_normal) > 0.0:
                    needed = True
        if not needed:
            return
        if part == 0:
            surface_out[ci, cj] = wp.where(parts > 1, PENDING - key, key)
        # One ball around all that can hide light and is no mirror ball: most samples pass it by.
        middle = wp.vec3()
        solid = float(0.0)
        reach = float(0.0)
        if wp.static(not only_planes):
            for index in range(scene.proxies.shape[0]):
                if scene.proxies[index].kind != PLANE:
                    middle += scene.proxies[index].position
                    solid += 1.0
            middle = middle / wp.max(solid, 1.0)
            for index in range(scene.proxies.shape[0]):
                shape = scene.proxies[index]
                if shape.kind != PLANE:
                    reach = wp.max(reach, wp.length(shape.position - middle) + shape.scale * wp.length(shape.extent))
        whole = wp.vec3()
        lost = wp.vec3()
        for k in range(count * part / parts, count * (part + 1) / parts):
            sample = samples[k]
            toward = sample_toward(sample, hit.point)
            cosine = wp.dot(hit.normal, toward.direction)
            if cosine > 0.0:
                flux = cosine * toward.measure * sample.radiance
                whole += flux
                nearest = toward.distance
                hides = bool(False)
                radiance = wp.vec3()  # of what hides the sample
                for index in range(desk.probes.shape[0]):
                    probe = desk.probes[index]
                    away = probe.center - hit.point
                    if near_ball(away, probe.radius, toward.direction):
                        t = intersect_sphere(probe.radius, -away, toward.direction, nearest)
                        if t < nearest:
                            nearest = t
                            hides = True
                            normal = (t * toward.direction - away) / probe.radius
                            radiance = wp.cw_mul(probe.reflectance, mean_facing(desk, normal))
                if wp.static(not only_planes):
                    if near_ball(middle - hit.point, reach, toward.direction):
                        origin = offset_origin(hit.point, hit.geometric_normal, toward.direction, hit.error)
                        hidden = closest_proxy(scene, origin, toward.direction, nearest)
                        if hidden.shape >= 0:
                            if scene.proxies[hidden.shape].kind != PLANE:
                                facing = hidden.normal
                                if wp.dot(facing, toward.direction) > 0.0:
                                    facing = -facing
                                hides = True
                                radiance = DEFAULT_REFLECTANCE * mean_facing(desk, facing)
                if hides:
                    lost += cosine * toward.measure * (sample.radiance - radiance)
        if parts > 1:
            sums_out[part * SHARE_SUMS, ci, cj] = whole
            sums_out[part * SHARE_SUMS + 1, ci, cj] = lost
        else:
            share_out[ci, cj] = shares_of(lost, whole)

    return share_environment_kernel


@wp.kernel(enable_backward=False)
def join_shares_kernel(
    # In:
    sums: wp.array3d[wp.vec3],
    # Out:
    share_out: wp.array2d[wp.vec3],
    surface_out: wp.array2d[wp.int32],
):
    """Shares of cells whose samples several threads have just summed."""
    i, j = wp.tid()
    pending = surface_out[i, j]
    if pending > PENDING:
        return
    whole = wp.vec3()
    lost = wp.vec3()
    for part in range(sums.shape[0] / SHARE_SUMS):
        whole += sums[part * SHARE_SUMS, i, j]
        lost += sums[part * SHARE_SUMS + 1, i, j]
    share_out[i, j] = shares_of(lost, whole)
    surface_out[i, j] = PENDING - pending


@functools.cache
def make_send_light_kernel(config: CellConfig) -> wp.Kernel:
    """Kernel of ``send_light``."""
    seen_receiver = make_seen_receiver(config)
    lit_by = make_lit_by(dataclasses.replace(config.relight, bounced=False))

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def send_light_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        rays: wp.array2d[wp.vec2],
        scene: RayScene,
        lights: wp.array[Light],
        desk: Receiver,
        stride: wp.int32,
        # Out:
        patches_out: wp.array2d[Patch],
    ):
        ci, cj = wp.tid()
        ci += row_start
        patch = Patch()
        i = middle_pixel(ci, stride, rays.shape[0])
        j = middle_pixel(cj, stride, rays.shape[1])
        if inside_rect(i, j, params[0].light_rect):
            hit = seen_receiver(params[0], rays, scene, desk, i, j)
            if hit.shape >= 0:
                lit = lit_by(scene, lights, desk, hit, i, j, wp.vec3(), tile_turn(ci, cj))
                added = lit.added
                if added[0] + added[1] + added[2] > 0.0:
                    ray = rays[i, j]
                    # A pixel's solid angle is cos^3 / (fx fy), the distance to its point t / cos.
                    length = wp.sqrt(ray[0] * ray[0] + ray[1] * ray[1] + 1.0)
                    direction = params[0].world_from_camera * wp.vec3(ray[0], ray[1], 1.0) / length
                    facing = wp.max(-wp.dot(direction, hit.geometric_normal), MIN_FACING)
                    # A patch at the frame's border has fewer pixels.
                    rows = wp.min(stride, rays.shape[0] - ci * stride)
                    pixels = wp.float32(rows * wp.min(stride, rays.shape[1] - cj * stride))
                    patch.area = pixels * hit.t * hit.t / (length * params[0].focal[0] * params[0].focal[1] * facing)
                    patch.position = hit.point
                    patch.normal = hit.geometric_normal
                    patch.flux = patch.area * added
        patches_out[ci, cj] = patch

    return send_light_kernel


@wp.kernel(enable_backward=False)
def list_patches_kernel(
    # In:
    row_start: wp.int32,
    patches: wp.array2d[Patch],
    # Out:
    listed_out: wp.array2d[Patch],
    count_out: wp.array[wp.int32],
):
    """Patches of a row that send light, in their order: sums over them are the same in every run."""
    i = wp.tid() + row_start
    count = int(0)
    for j in range(patches.shape[1]):
        if patches[i, j].area > 0.0:
            listed_out[i, count] = patches[i, j]
            count += 1
    count_out[i] = count


@functools.cache
def make_gather_light_kernel(config: CellConfig) -> wp.Kernel:
    """Kernel of ``gather_light``."""
    seen_receiver = make_seen_receiver(config)
    mean_facing = make_mean_facing(config)

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def gather_light_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        rays: wp.array2d[wp.vec2],
        scene: RayScene,
        desk: Receiver,
        patches: wp.array2d[Patch],
        count: wp.array[wp.int32],
        patch_stride: wp.int32,
        stride: wp.int32,
        # Out:
        bounced_out: wp.array2d[wp.vec3],
        surface_out: wp.array2d[wp.int32],
    ):
        ci, cj = wp.tid()
        ci += row_start
        surface_out[ci, cj] = -1
        if not in_lit_cells(ci, cj, stride, params[0].light_rect):
            return
        i = middle_pixel(ci, stride, rays.shape[0])
        j = middle_pixel(cj, stride, rays.shape[1])
        hit = seen_receiver(params[0], rays, scene, desk, i, j)
        if hit.shape < 0:
            return
        surface_out[ci, cj] = surface_key(scene.proxies[hit.shape], hit.shape, hit.geometric_normal)
        total = wp.vec3()
        # Rows that the light reaches: the others may be of an earlier frame.
        rect = params[0].light_rect
        for row in range(rect[0] / patch_stride, wp.min((rect[1] - 1) / patch_stride + 1, patches.shape[0])):
            for k in range(count[row]):
                patch = patches[row, k]
                way = patch.position - hit.point
                here = wp.dot(way, hit.normal)
                there = -wp.dot(way, patch.normal)
                if here > 0.0 and there > 0.0:
                    squared = wp.dot(way, way)
                    total += here * there / (squared * (squared + patch.area / wp.pi)) * patch.flux
        distant = wp.pi * mean_facing(desk, hit.normal)
        seen = bool(False)
        for channel in range(3):
            if total[channel] > NEGLIGIBLE * distant[channel]:
                seen = True
        bounced_out[ci, cj] = wp.where(seen, total, wp.vec3(0.0, 0.0, 0.0))

    return gather_light_kernel


def share_environment(
    config: CellConfig,
    params: wp.array,
    rays: wp.array,
    scene: RayScene,
    lights: wp.array,
    desk: Receiver,
    samples: wp.array,
    count: int,
    stride: int,
    share_out: wp.array,
    surface_out: wp.array,
    *,
    bounced: bool = False,
    sums_out: wp.array | None = None,
    rows: Rows | None = None,
) -> None:
    """Estimate which part of the environment reaches the receiver, for cells that virtual lights may shine on.

    Args:
        config: Kinds of shape, form of the environment's irradiance.
        params: (1,) FrameParams: camera and light_rect.
        rays: (H, W) vec2, undistorted (x / z, y / z) of each pixel's centre.
        scene: Proxies.
        lights: (n,) Light.
        desk: From ``relight.make_receiver``: balls and the environment's irradiance; with the cells of ``gather_light``
            if ``bounced``.
        samples: (n,) EnvironmentSample.
        count: How many of them are used, the first ones. The same for all cells, so there is no noise; an aligned block
            of Sobol's sequence if it is a power of 2.
        stride: Pixels per cell.
        share_out: (ceil(H / stride), ceil(W / stride)) vec3, 0..1; undefined where ``surface_out`` is -1.
        surface_out: The same shape, int32: ``surface_key`` of the cell, -1 for none.
        bounced: Whether to add cells that get bounced light to those that were estimated before.
        sums_out: Scratch of ``share_sums_shape`` in which several threads share a cell; ``rows`` must be None then.
            None means one thread per cell.
        rows: Band of rows of cells; None means all.
    """
    parts = 1 if sums_out is None else sums_out.shape[0] // int(SHARE_SUMS)
    launch_rows(
        make_share_environment_kernel(config),
        (share_out.shape[0] * parts, share_out.shape[1]),
        [params, rays, scene, lights, desk, samples, min(count, samples.shape[0]), stride, bounced, parts],
        [share_out, surface_out, sums_out],
        rows=rows,
        device=rays.device,
    )
    if parts > 1:
        launch(join_shares_kernel, share_out.shape, [sums_out], [share_out, surface_out], device=rays.device)


def share_sums_shape(parts: int, rows: int, columns: int) -> tuple[int, int, int]:
    """Shape of the array that holds the sums of all parts of so many cells."""
    return parts * int(SHARE_SUMS), rows, columns


def send_light(
    config: CellConfig,
    params: wp.array,
    rays: wp.array,
    scene: RayScene,
    lights: wp.array,
    desk: Receiver,
    stride: int,
    patches_out: wp.array,
    *,
    rows: Rows | None = None,
) -> None:
    """Find what every patch of the receiver sends on of the virtual light that falls on it.

    Args:
        config: As for ``share_environment``.
        params: (1,) FrameParams: camera and light_rect.
        rays: (H, W) vec2.
        scene: Objects and proxies.
        lights: (n,) Light.
        desk: From ``relight.make_receiver``, with the cells of ``share_environment`` where the config has them.
        stride: Pixels along a patch.
        patches_out: (ceil(H / stride), ceil(W / stride)) Patch; those that send nothing have no area.
        rows: Band of rows of patches; None means all.
    """
    launch_rows(
        make_send_light_kernel(config),
        patches_out.shape,
        [params, rays, scene, lights, desk, stride],
        [patches_out],
        rows=rows,
        device=rays.device,
    )


def list_patches(patches: wp.array, listed_out: wp.array, count_out: wp.array, *, rows: Rows | None = None) -> None:
    """Move the patches that send light to the front of their rows.

    Args:
        patches: (r, c) Patch of ``send_light``.
        listed_out: (r, c) Patch.
        count_out: (r,) int32, how many of a row send light.
        rows: Band of rows; None means all.
    """
    launch_rows(
        list_patches_kernel, count_out.shape, [patches], [listed_out, count_out], rows=rows, device=patches.device
    )


def gather_light(
    config: CellConfig,
    params: wp.array,
    rays: wp.array,
    scene: RayScene,
    desk: Receiver,
    patches: wp.array,
    count: wp.array,
    patch_stride: int,
    stride: int,
    bounced_out: wp.array,
    surface_out: wp.array,
    *,
    rows: Rows | None = None,
) -> None:
    """Sum what patches send to the cells of the receiver.

    Args:
        config: As for ``share_environment``.
        params: (1,) FrameParams: camera and light_rect.
        rays: (H, W) vec2.
        scene: Proxies.
        desk: From ``relight.make_receiver``: balls and the environment's irradiance.
        patches: (r, c) Patch of ``list_patches``; only rows that light_rect reaches are read.
        count: (r,) int32, how many of a row send light.
        patch_stride: Pixels along a patch.
        stride: Pixels per cell.
        bounced_out: (ceil(H / stride), ceil(W / stride)) vec3, irradiance; 0 where it is less than ``NEGLIGIBLE`` of
            the environment's, undefined where ``surface_out`` is -1.
        surface_out: The same shape, int32: ``surface_key`` of the cell, -1 for none.
        rows: Band of rows of cells; None means all.
    """
    launch_rows(
        make_gather_light_kernel(config),
        bounced_out.shape,
        [params, rays, scene, desk, patches, count, patch_stride, stride],
        [bounced_out, surface_out],
        rows=rows,
        device=rays.device,
    )
