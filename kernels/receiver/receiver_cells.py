"""Light on the receiver that varies slowly over pixels, estimated per cell (block of pixels) of the frame.

``relight`` interpolates the results between cells. The receiver is the real surface that virtual light reaches.

**Ambient visibility.** The receiver's reflectance is its radiance in the frame over the environment's irradiance
(``receiver``, equation 2). The filtered irradiance ignores occlusion: in the shadow of the ball or of a box it is too
large, and the reflectance comes out too small. So each cell finds, over samples of the environment
(``environment_samples``),

    visibility = 1 - sum over hidden samples of measure * cos * (radiance - radiance of the occluder)
                     / sum over all samples of measure * cos * radiance,

which is exactly 1 where nothing is hidden. It is estimated only for cells that virtual light reaches: first those that
a light shines on, then, once bounced light is known, those that only bounced light reaches. An occluder emits or
reflects light itself: a ball its reflectance times the mean radiance that its normal faces, a box its radiance in the
frame or, where the camera does not see it, that of a grey surface. Planes hide nothing: the environment captured by the
ball contains them. On CUDA several threads share the samples of a cell. Their sums are added in a fixed order, so that
the same frame gives the same bits.

**Light of emitting objects.** It is estimated per cell, because it varies slowly and its shadows are soft
(``area_lights``).

**Bounced light.** A lit proxy lights the others. Every cell of a coarse grid is a patch with the radiance L of direct
virtual light there (as ``relight`` finds it) and the area A of the surface that its pixels show. Where a virtual object
is in front, the patch lies on the object and reflects light diffusely by its material's colour. The irradiance of a
point at distance r is

    E = sum over patches of  L A cos cos' / (r^2 + A / pi),

the form factor of a disc on its axis. It stays finite where a box stands on the lit receiver, and is pi L for a patch
that fills the hemisphere. There is one bounce. Surfaces that the camera does not see reflect nothing, and occlusion
between patch and point is ignored. Points of one flat surface do not light each other, although rounding moves them
off the plane: they share a normal, so one of the two cosines is not positive.
"""

from __future__ import annotations

import dataclasses
import functools

import warp as wp

from warp_ar.kernels.cells import SurfaceCells, cell_pixel, look_up_cells
from warp_ar.kernels.environment.environment_samples import EnvironmentSample, Incidence, ball_of_sample, sample_toward
from warp_ar.kernels.environment.interpolated_irradiance import make_irradiance_at
from warp_ar.kernels.environment.probe_weights import probe_share
from warp_ar.kernels.launch import MOST_REGISTERS, row_launcher
from warp_ar.kernels.materials import material_at
from warp_ar.kernels.objects.reflect import look_up, make_find_in_frame
from warp_ar.kernels.rays.shadow import make_shadow, sample_light, tile_turn
from warp_ar.kernels.rays.shapes import intersect_sphere, surface_key
from warp_ar.kernels.rays.trace import TraceConfig, make_trace, offset_origin
from warp_ar.kernels.rays.visibility import make_visible_cell
from warp_ar.kernels.receiver.receiver import (
    DEFAULT_REFLECTANCE,
    Matter,
    Receiver,
    RelightConfig,
    frame_size,
)
from warp_ar.kernels.receiver.relight import make_area_response, make_direct_lighting
from warp_ar.kernels.structs import MIRROR, PHONG, PLANE, FrameParams, Hit, Light, RayScene

wp.set_module_options({"enable_backward": False})

MIN_IRRADIANCE = wp.constant(wp.float32(1.0e-6))
"""Irradiance, in camera values, below which ambient visibility is taken to be 1."""
NEGLIGIBLE = wp.constant(wp.float32(1.0 / 256.0))
"""Ratio of bounced to environment light that is treated as 0: at most half an 8-bit code."""
MIN_FACING = wp.constant(wp.float32(0.02))
"""Least cosine by which the area of a patch is divided: bounds the area of a patch seen at a grazing angle."""


MARGIN = wp.constant(2)
"""Number of rows and columns of cells around the rectangle of lit pixels that interpolation may read."""


@wp.struct
class Patch:
    """A piece of a surface that reflects virtual light diffusely."""

    position: wp.vec3
    normal: wp.vec3
    flux: wp.vec3  # radiance times area
    area: wp.float32  # square metres


@wp.struct
class LightPart:
    """Sums over a part of the samples of a cell, in camera values of irradiance."""

    surface: wp.int32  # ``surface_key`` of the cell; -1: not estimated
    whole: wp.vec3  # all light
    lost: wp.vec3  # hidden light, less the light that occluders emit or reflect


@wp.func
def visible_shares_of(lost: wp.vec3, whole: wp.vec3) -> wp.vec3:
    """Return 1 - lost / whole per channel, within 0..1; 1 where ``whole`` is below ``MIN_IRRADIANCE`` or NaN."""
    shares = wp.vec3(1.0, 1.0, 1.0)
    for channel in range(3):
        if whole[channel] > MIN_IRRADIANCE:  # NaN is not
            share = 1.0 - lost[channel] / whole[channel]
            if share < 1.0:
                shares[channel] = wp.max(share, 0.0)
    return shares


@wp.func
def meets_ball(away: wp.vec3, radius: wp.float32, direction: wp.vec3) -> wp.bool:
    """Return whether a ray meets a ball or starts in it; ``away`` leads from its origin to the ball's centre."""
    beside = wp.dot(away, away) - radius * radius
    along = wp.dot(away, direction)
    return beside <= 0.0 or (along > 0.0 and along * along > beside)


@functools.cache
def make_mean_facing(config: RelightConfig) -> wp.Function:
    """Return the function ``mean_facing(receiver, point, normal) -> vec3``: mean radiance above a surface, by cosine.

    Emitters keep the directions in which the balls show them.
    """
    irradiance_at = make_irradiance_at(config.irradiance, False, config.several)

    @wp.func(module="unique")
    def mean_facing(receiver: Receiver, point: wp.vec3, normal: wp.vec3) -> wp.vec3:
        received = irradiance_at(
            receiver.irradiance_sh, receiver.irradiance_map, receiver.emitters, receiver.others, point, normal
        )
        mean = received / wp.pi
        # Spherical harmonics may ring below 0; radiance does not.
        return wp.max(mean, wp.vec3(0.0, 0.0, 0.0))

    return mean_facing


@wp.func
def bound_solids(scene: RayScene) -> wp.vec4:
    """Return (x, y, z, radius) of a sphere around all proxies except planes: those that can hide light."""
    middle = wp.vec3()
    solid = float(0.0)
    for index in range(scene.proxies.shape[0]):
        if scene.proxies[index].kind != PLANE:
            middle += scene.proxies[index].position
            solid += 1.0
    middle = middle / wp.max(solid, 1.0)
    reach = float(0.0)
    for index in range(scene.proxies.shape[0]):
        shape = scene.proxies[index]
        if shape.kind != PLANE:
            reach = wp.max(reach, wp.length(shape.position - middle) + shape.scale * wp.length(shape.extent))
    return wp.vec4(middle[0], middle[1], middle[2], reach)


@wp.struct
class Hider:
    """Obstacle between a point of the receiver and a sample of the environment."""

    hides: wp.bool
    radiance: wp.vec3  # of the obstacle, toward the point


@functools.cache
def make_find_hider(config: RelightConfig) -> wp.Function:
    """Return ``find_hider(params, scene, receiver, hit, toward, solids) -> Hider``, which finds what hides a sample.

    ``toward`` leads to the sample; ``solids`` is the result of ``bound_solids``.
    """
    mean_facing = make_mean_facing(config)
    find_in_frame = make_find_in_frame(config.trace)
    closest_proxy = make_trace(config.trace).closest_proxy
    only_planes = set(config.trace.proxies) <= {PLANE}

    @wp.func(module="unique")
    def find_hider(
        params: FrameParams, scene: RayScene, receiver: Receiver, hit: Hit, toward: Incidence, solids: wp.vec4
    ) -> Hider:
        found = Hider()
        nearest = toward.distance
        for index in range(receiver.probes.shape[0]):
            probe = receiver.probes[index]
            away = probe.center - hit.point
            if meets_ball(away, probe.radius, toward.direction):
                t = intersect_sphere(probe.radius, -away, toward.direction, nearest)
                if t < nearest:
                    nearest = t
                    found.hides = True
                    normal = (t * toward.direction - away) / probe.radius
                    found.radiance = wp.cw_mul(probe.reflectance, mean_facing(receiver, probe.center, normal))
        if wp.static(not only_planes):
            # Most rays miss the sphere around all proxies.
            if meets_ball(wp.vec3(solids[0], solids[1], solids[2]) - hit.point, solids[3], toward.direction):
                origin = offset_origin(hit.point, hit.geometric_normal, toward.direction, hit.error)
                hidden = closest_proxy(scene, origin, toward.direction, nearest)
                if hidden.shape >= 0:
                    if scene.proxies[hidden.shape].kind != PLANE:
                        found.hides = True
                        at = find_in_frame(params, receiver.picture, scene, receiver.probes, hidden)
                        if at[0] >= 0.0:
                            found.radiance = look_up(receiver.picture, at[0], at[1])
                        else:
                            facing = hidden.normal
                            if wp.dot(facing, toward.direction) > 0.0:
                                facing = -facing
                            found.radiance = DEFAULT_REFLECTANCE * mean_facing(receiver, hidden.point, facing)
        return found

    return find_hider


@wp.func
def is_shone_on(lights: wp.array[Light], hit: Hit) -> wp.bool:
    """Return whether any virtual light reaches a point if nothing hides it."""
    for index in range(lights.shape[0]):
        light = sample_light(lights[index], hit.point)
        if wp.dot(hit.geometric_normal, light.wi) > 0.0 and wp.max(light.irradiance_normal) > 0.0:
            return True
    return False


@functools.cache
def make_ambient_visibility_kernel(config: RelightConfig) -> wp.Kernel:
    """Return the kernel of ``sum_ambient_light`` for the given configuration."""
    visible_cell = make_visible_cell(config.trace)
    find_hider = make_find_hider(config)

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def ambient_visibility_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        scene: RayScene,
        lights: wp.array[Light],
        receiver: Receiver,
        samples: wp.array[EnvironmentSample],
        bounced: wp.bool,
        cells: SurfaceCells,
        # Out:
        parts_out: wp.array3d[LightPart],
    ):
        ci, cj, part = wp.tid()
        ci += row_start
        rays = receiver.picture.rays
        rect = params[0].light_rect
        stride = cells.stride
        parts_out[ci, cj, part].surface = -1
        if bounced and cells.surface[ci, cj] >= 0:
            return
        hit = visible_cell(params[0], rays, scene, receiver.probes, wp.vec2i(ci, cj), stride, MARGIN * stride, rect)
        if hit.shape < 0:
            return
        needed = bool(False)
        if bounced:
            i = cell_pixel(ci, stride, rays.shape[0])
            j = cell_pixel(cj, stride, rays.shape[1])
            sent = look_up_cells(receiver.cells.bounced, surface_key(scene, hit), frame_size(receiver), i, j)
            needed = sent[0] + sent[1] + sent[2] > 0.0
        else:
            needed = is_shone_on(lights, hit)
        if not needed:
            return
        solids = bound_solids(scene)
        sums = LightPart()
        sums.surface = surface_key(scene, hit)
        for k in range(part, samples.shape[0], parts_out.shape[2]):
            sample = samples[k]
            toward = sample_toward(sample, hit.point)
            cosine = wp.dot(hit.normal, toward.direction)
            if cosine > 0.0:
                if wp.static(config.several):
                    places = receiver.others.places
                    toward.measure *= probe_share(places, ball_of_sample(k, places.shape[0]), hit.point)
                flux = cosine * toward.measure * sample.radiance
                sums.whole += flux
                hider = find_hider(params[0], scene, receiver, hit, toward, solids)
                if hider.hides:
                    sums.lost += cosine * toward.measure * (sample.radiance - hider.radiance)
        parts_out[ci, cj, part] = sums

    return ambient_visibility_kernel


@wp.kernel(enable_backward=False)
def add_parts_kernel(
    # In:
    row_start: wp.int32,
    parts: wp.array3d[LightPart],
    bounced: wp.bool,
    # Out:
    cells_out: SurfaceCells,
):
    """Compute a cell's ambient visibility from its sums, in a fixed order; if ``bounced``, cells without sums stay."""
    ci, cj = wp.tid()
    ci += row_start
    surface = parts[ci, cj, 0].surface
    if surface < 0 and bounced:
        return
    cells_out.surface[ci, cj] = surface
    if surface >= 0:
        whole = wp.vec3()
        lost = wp.vec3()
        for part in range(parts.shape[2]):
            whole += parts[ci, cj, part].whole
            lost += parts[ci, cj, part].lost
        cells_out.values[ci, cj] = visible_shares_of(lost, whole)


@functools.cache
def make_area_light_kernel(config: RelightConfig) -> wp.Kernel:
    """Return the kernel of ``estimate_area_light`` for the given configuration."""
    visible_cell = make_visible_cell(config.trace)
    area_response = make_area_response(dataclasses.replace(config, method="flat"))

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def area_light_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        scene: RayScene,
        receiver: Receiver,
        # Out:
        cells_out: SurfaceCells,
    ):
        ci, cj = wp.tid()
        ci += row_start
        rays = receiver.picture.rays
        rect = params[0].light_rect
        stride = cells_out.stride
        hit = visible_cell(params[0], rays, scene, receiver.probes, wp.vec2i(ci, cj), stride, MARGIN * stride, rect)
        cells_out.surface[ci, cj] = surface_key(scene, hit)
        if hit.shape >= 0:
            cells_out.values[ci, cj] = area_response(scene, receiver, hit, Matter(), tile_turn(ci, cj))

    return area_light_kernel


@wp.func
def sent_share(scene: RayScene, hit: Hit) -> wp.vec3:
    """Return the diffuse reflectance of an object for bounced light: its colour, or grey if it has a texture.

    It is 0 for a mirror, which reflects light to one side only.
    """
    material = scene.materials[material_at(scene, hit)]
    if material.model == MIRROR or material.unlit != 0:
        return wp.vec3(0.0, 0.0, 0.0)
    share = material.base_color
    if material.base_texture >= 0:
        share = DEFAULT_REFLECTANCE * share
    if material.model == PHONG:
        share = share + material.specular
    return wp.min(wp.max(share, wp.vec3(0.0, 0.0, 0.0)), wp.vec3(1.0, 1.0, 1.0))


@functools.cache
def make_sent_by_object(trace: TraceConfig) -> wp.Function:
    """Return ``sent_by_object(scene, lights, hit) -> vec3``: diffuse radiance of a virtual object at ``hit``.

    Lights count as points: their shadows on objects have no penumbra.
    """
    is_lit = make_shadow(trace)

    @wp.func(module="unique")
    def sent_by_object(scene: RayScene, lights: wp.array[Light], hit: Hit) -> wp.vec3:
        share = sent_share(scene, hit)
        received = wp.vec3()
        if wp.max(share) > 0.0:
            for index in range(lights.shape[0]):
                light = sample_light(lights[index], hit.point)
                n_dot_l = wp.dot(hit.normal, light.wi)
                if n_dot_l <= 0.0 or wp.dot(hit.geometric_normal, light.wi) <= 0.0:
                    continue
                if wp.max(light.irradiance_normal) > 0.0:
                    if is_lit(scene, hit.point, hit.geometric_normal, hit.error, light):
                        received += n_dot_l * light.irradiance_normal
        return wp.cw_mul(share, received) / wp.pi

    return sent_by_object


@functools.cache
def make_send_light_kernel(config: RelightConfig) -> wp.Kernel:
    """Return the kernel of ``send_light`` for the given configuration."""
    visible_cell = make_visible_cell(config.trace)
    direct_lighting = make_direct_lighting(dataclasses.replace(config, bounced=False))
    has_objects = bool(config.trace.objects)
    closest_object = make_trace(config.trace).closest_object
    sent_by_object = make_sent_by_object(config.trace)

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def send_light_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        scene: RayScene,
        lights: wp.array[Light],
        receiver: Receiver,
        stride: wp.int32,
        # Out:
        patches_out: wp.array2d[Patch],
    ):
        ci, cj = wp.tid()
        ci += row_start
        rays = receiver.picture.rays
        patch = Patch()
        i = cell_pixel(ci, stride, rays.shape[0])
        j = cell_pixel(cj, stride, rays.shape[1])
        hit = visible_cell(params[0], rays, scene, receiver.probes, wp.vec2i(ci, cj), stride, 0, params[0].light_rect)
        if hit.shape >= 0:
            added = wp.vec3()
            is_object = bool(False)
            if wp.static(has_objects):
                toward = params[0].world_from_camera * wp.vec3(rays[i, j][0], rays[i, j][1], 1.0)
                item = closest_object(scene, params[0].camera_position, toward, hit.t)
                if item.shape >= 0:
                    is_object = True
                    hit = item
                    if wp.dot(hit.geometric_normal, toward) > 0.0:
                        hit.geometric_normal = -hit.geometric_normal
                        hit.normal = -hit.normal
                    added = sent_by_object(scene, lights, hit)
            if not is_object:
                lit = direct_lighting(scene, lights, receiver, hit, i, j, wp.vec3(), tile_turn(ci, cj))
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
    """List the patches of a row that reflect light, from left to right, so that sums are the same in every run."""
    i = wp.tid() + row_start
    count = int(0)
    for j in range(patches.shape[1]):
        if patches[i, j].area > 0.0:
            listed_out[i, count] = patches[i, j]
            count += 1
    count_out[i] = count


@functools.cache
def make_gather_light_kernel(config: RelightConfig) -> wp.Kernel:
    """Return the kernel of ``gather_light`` for the given configuration."""
    visible_cell = make_visible_cell(config.trace)
    mean_facing = make_mean_facing(config)

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def gather_light_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        scene: RayScene,
        receiver: Receiver,
        patches: wp.array2d[Patch],
        count: wp.array[wp.int32],
        patch_stride: wp.int32,
        # Out:
        cells_out: SurfaceCells,
    ):
        ci, cj = wp.tid()
        ci += row_start
        rays = receiver.picture.rays
        rect = params[0].light_rect
        stride = cells_out.stride
        hit = visible_cell(params[0], rays, scene, receiver.probes, wp.vec2i(ci, cj), stride, MARGIN * stride, rect)
        cells_out.surface[ci, cj] = surface_key(scene, hit)
        if hit.shape < 0:
            return
        total = wp.vec3()
        # Other rows than those of light_rect may hold patches of an earlier frame.
        for row in range(rect[0] / patch_stride, wp.min((rect[1] - 1) / patch_stride + 1, patches.shape[0])):
            for k in range(count[row]):
                patch = patches[row, k]
                way = patch.position - hit.point
                here = wp.dot(way, hit.normal)
                there = -wp.dot(way, patch.normal)
                if here > 0.0 and there > 0.0:
                    squared = wp.dot(way, way)
                    total += here * there / (squared * (squared + patch.area / wp.pi)) * patch.flux
        distant = wp.pi * mean_facing(receiver, hit.point, hit.normal)
        matters = bool(False)
        for channel in range(3):
            if total[channel] > NEGLIGIBLE * distant[channel]:
                matters = True
        cells_out.values[ci, cj] = wp.where(matters, total, wp.vec3(0.0, 0.0, 0.0))

    return gather_light_kernel


sum_ambient_light = row_launcher(make_ambient_visibility_kernel)
"""Sum the environment's light on the receiver, for cells on which virtual lights may shine, and its hidden part.

Args:
    config: Kinds of shape, form of the environment's irradiance.
    params: (1,) FrameParams: camera and light_rect.
    scene: Proxies.
    lights: (n,) Light.
    receiver: From ``make_receiver``: picture, balls and the environment's irradiance; with the cells of
        ``gather_light`` if ``bounced``.
    samples: (n,) samples of the environment, the same for all cells, so that neighbours do not differ by noise. If n is
        a power of 2, the first n of a longer sequence are an aligned block of Sobol's sequence.
    bounced: True to estimate only the cells that bounced light alone reaches.
    cells: Cells of ambient visibility.
    parts_out: (r, c, threads per cell) sums.
"""


find_ambient_visibility = row_launcher(add_parts_kernel, like=lambda *given: given[-1].values)
"""Compute the share of the environment that reaches each cell of the receiver.

Args:
    parts: (r, c, n) from ``sum_ambient_light``.
    bounced: True if ``parts`` are of cells that only bounced light reaches; other cells keep their values.
    cells_out: Cells of ambient visibility.
"""


estimate_area_light = row_launcher(make_area_light_kernel, like=lambda *given: given[-1].values)
"""Estimate the irradiance of each cell of the receiver by emitting objects.

Args:
    config: Kinds of shape, and samples of emitting objects per cell.
    params: (1,) FrameParams: camera and light_rect.
    scene: Objects and proxies.
    receiver: From ``make_receiver``: picture and balls.
    cells_out: Cells of irradiance.
"""


send_light = row_launcher(make_send_light_kernel)
"""Find the virtual light that every patch (block of pixels of the receiver) reflects.

Args:
    config: Kinds of shape, form of the environment's irradiance.
    params: (1,) FrameParams: camera and light_rect.
    scene: Objects and proxies.
    lights: (n,) Light.
    receiver: From ``make_receiver``, with the cells of ``find_ambient_visibility`` where the config has them.
    stride: Pixels along a patch.
    patches_out: (ceil(H / stride), ceil(W / stride)) patches; those that reflect nothing have area 0.
"""


list_patches = row_launcher(list_patches_kernel, outputs=2, like=lambda patches, listed, count: count)
"""Move the patches that reflect light to the front of their rows.

Args:
    patches: (r, c) from ``send_light``.
    listed_out: (r, c) patches.
    count_out: (r,) number of patches of each row that reflect light.
"""


gather_light = row_launcher(make_gather_light_kernel, like=lambda *given: given[-1].values)
"""Sum the irradiance that patches send to each cell of the receiver.

Args:
    config: Kinds of shape, form of the environment's irradiance.
    params: (1,) FrameParams: camera and light_rect.
    scene: Proxies.
    receiver: From ``make_receiver``: picture, balls and the environment's irradiance.
    patches: (r, c) from ``list_patches``; only rows in light_rect are read.
    count: (r,) number of patches of each row that reflect light.
    patch_stride: Pixels along a patch.
    cells_out: Cells of bounced light; it is 0 where it is less than ``NEGLIGIBLE`` times the environment's.
"""
