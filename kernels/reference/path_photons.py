"""Caustics of virtual lights on the receiver, by paths that start at the lights.

Polished metal reflects a lamp's light to a matt surface from few directions, which a path from the camera finds only by
chance. A path from the lamp meets the metal, is reflected, and where it then meets a proxy that the camera sees, it
adds its light to that pixel [Arv86], [PBRT]. So paths from the white surfaces of ``path_picture`` omit virtual lights
at polished objects (``lights_at``), and the light is added here, by paths that meet such an object first. A path meets
a white surface with the power W, at distance r and depth z from the camera. c and c' are the cosines of the geometric
normal toward camera and light, s' that of the shading normal toward the light. The pixel then has the additional
radiance

    L = 1 / N  sum over N paths of  W / pi  s' / c'  c r / z^3  fx fy,

because a pixel covers the area z^3 / (c r fx fy) of the surface.

At each surface a direction d is drawn as by a path from the camera (density q). The surface reflects light from l
toward d as such a path would find it, so both methods have the same mean, for any shading normal. With V the reflected
radiance over the irradiance of a surface that faces l,

    W  ->  W V cos(d) / (q cos(l)),    cosines with the geometric normal.

Light of near emitters of the environment is followed in the same way, from points of the spheres on which they lie.
They have the same intensity in all directions: a point that is drawn with the density p per steradian around the
sphere's centre, and has the radiance L from there, is a light of the intensity L D^2 / p, D the sphere's radius.

Lights with a disk and directional lights are left to paths from the camera. Neither kind of path finds the image of a
light without size in a mirror.

Sums are integers: threads may add to them in any order.

References:
    [Arv86] Arvo, "Backward Ray Tracing", SIGGRAPH course 1986.
    [PBRT] Pharr, Jakob, Humphreys, Physically Based Rendering, 3rd edition, section 16.1.
"""

from __future__ import annotations

import functools

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ar.kernels.camera import project
from warp_ar.kernels.launch import MOST_REGISTERS, row_launcher
from warp_ar.kernels.rays.shadow import sample_light
from warp_ar.kernels.rays.trace import TraceConfig, make_trace, offset_origin
from warp_ar.kernels.reference.path_following import (
    MOST_VERTICES,
    PICK,
    SCATTER,
    is_polished,
    make_see_proxy,
    reflected_from,
    survival,
)
from warp_ar.kernels.reference.path_sampling import (
    PathKey,
    Sky,
    direction_in_texel,
    draw_reflected,
    find_step,
    random_triple,
    surface_density,
    within_step,
)
from warp_ar.kernels.reference.path_vertices import (
    NOTHING,
    OBJECT,
    PROXY,
    LocalScene,
    Vertex,
    from_viewer,
    is_turned,
    make_find_vertex,
    make_hidden_by_physical,
    make_look_up_material,
)
from warp_ar.kernels.sampling import frame_from_normal
from warp_ar.kernels.structs import DIRECTIONAL, LAMBERT, MIRROR, SPHERE, FrameParams, Light

wp.set_module_options({"enable_backward": False})

PATH_OFFSET = wp.constant(wp.uint32(0x80000000))
"""Offset of a path's index, so that it does not share the random numbers of a pixel."""
START = wp.constant(2)
ON_EMITTER = wp.constant(3)
"""Stream of random numbers that draws the start of a path on an emitter."""
UNIT = wp.constant(wp.float32(16777216.0))
"""Fixed-point unit of the sums."""
MOST = wp.constant(wp.float32(8192.0))
"""Largest contribution of a path, as radiance of its pixel if it were the only path of a pass."""
LEAST_VERSINE = wp.constant(wp.float32(1.0e-6))
"""Least versine of the cone toward an object: a half angle of 0.08 degrees."""
COUNTERS = 1024
"""Number of counters over which the count of rays is spread."""


@wp.struct
class LightImage:
    """Light of paths from virtual lights, summed per pixel."""

    sums: wp.array[wp.int64]  # (H W 3) radiance times the number of paths of a pass, over the number of pixels
    squares: wp.array[wp.int64]  # (H W 3) sums of squares of the same
    rays: wp.array[wp.int64]  # (COUNTERS) partial counts of traced rays


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    atomicAdd((unsigned long long*)sums.data + index, (unsigned long long)value);
#else
    __atomic_fetch_add((long long*)sums.data + index, (long long)value, __ATOMIC_RELAXED);
#endif
""")
def add_whole(sums: wp.array[wp.int64], index: wp.int32, value: wp.int64):
    """Add to a sum atomically, on every device."""


def is_polished_one(objects: npt.NDArray[np.void], materials: npt.NDArray[np.void]) -> bool:
    """Return whether an object may be polished, by any of the materials.

    Args:
        objects: Records of ``structs.Shape``.
        materials: Records of ``structs.Material``.
    """
    models = {int(model) for model in materials["model"]} if len(objects) else set()
    return bool(models - {int(LAMBERT), int(MIRROR)})


def follows_lights(
    lights: npt.NDArray[np.void], objects: npt.NDArray[np.void], materials: npt.NDArray[np.void]
) -> bool:
    """Return whether paths start at virtual lights: if all have a position and no size, and an object is polished.

    Args:
        lights: Records of ``structs.Light``.
        objects: Records of ``structs.Shape``, one of which must be polished.
        materials: Records of ``structs.Material``.
    """
    sized = bool((lights["radius"] > 0.0).any() or (lights["kind"] == int(DIRECTIONAL)).any())
    return len(lights) > 0 and is_polished_one(objects, materials) and not sized


def spheres_around(objects: npt.NDArray[np.void]) -> npt.NDArray[np.float32]:
    """Return centre and radius of a sphere around each object, (n, 4).

    Args:
        objects: Records of ``structs.Shape`` at their current poses.
    """
    radius = np.where(objects["kind"] == SPHERE, objects["extent"][:, 0], np.linalg.norm(objects["extent"], axis=1))
    return np.concatenate([objects["position"], (objects["scale"] * radius)[:, None]], axis=1).astype(np.float32)


@wp.func
def cone_versine(sphere: wp.vec4, point: wp.vec3) -> wp.float32:
    """Return 1 - cosine of the half angle under which a sphere is seen; 2, all directions, from within."""
    away = wp.vec3(sphere[0], sphere[1], sphere[2]) - point
    square = wp.dot(away, away)
    radius = sphere[3] * sphere[3]
    if square <= radius:
        return 2.0
    sine = radius / square
    return wp.max(sine / (1.0 + wp.sqrt(1.0 - sine)), LEAST_VERSINE)


@wp.func
def versine_between(a: wp.vec3, b: wp.vec3) -> wp.float32:
    """Return 1 - cosine between unit vectors, without cancellation."""
    off = a - b
    return 0.5 * wp.dot(off, off)


@wp.func
def draw_in_cone(axis: wp.vec3, most: wp.float32, u: wp.vec2) -> wp.vec3:
    """Draw a uniform direction in a cone; ``most`` is 1 - cosine of its half angle."""
    versine = u[0] * most
    sine = wp.sqrt(wp.max(versine * (2.0 - versine), 0.0))
    phi = 2.0 * wp.pi * u[1]
    return wp.normalize(frame_from_normal(axis) * wp.vec3(sine * wp.cos(phi), sine * wp.sin(phi), 1.0 - versine))


@wp.func
def toward_sphere(sphere: wp.vec4, point: wp.vec3) -> wp.vec3:
    """Return the unit direction to a sphere's centre."""
    away = wp.vec3(sphere[0], sphere[1], sphere[2]) - point
    if wp.dot(away, away) > 0.0:
        return wp.normalize(away)
    return wp.vec3(0.0, 0.0, 1.0)


@wp.func
def draw_start(scene: LocalScene, at: wp.vec3, u: wp.vec3) -> wp.vec3:
    """Draw the direction in which a path leaves a light: toward a virtual object."""
    count = scene.spheres.shape[0]
    k = wp.min(wp.int32(u[2] * wp.float32(count)), count - 1)
    sphere = scene.spheres[k]
    return draw_in_cone(toward_sphere(sphere, at), cone_versine(sphere, at), wp.vec2(u[0], u[1]))


@wp.func
def start_density(scene: LocalScene, at: wp.vec3, direction: wp.vec3) -> wp.float32:
    """Return the density of ``draw_start`` for a direction, per steradian."""
    density = float(0.0)
    count = scene.spheres.shape[0]
    for k in range(count):
        sphere = scene.spheres[k]
        most = cone_versine(sphere, at)
        if versine_between(toward_sphere(sphere, at), direction) <= most:
            density += 1.0 / (2.0 * wp.pi * most * wp.float32(count))
    return density


@wp.struct
class PointOfEmitter:
    """Start of a path at a near emitter."""

    position: wp.vec3
    intensity: wp.vec3  # over the density with which the point was drawn


@wp.func
def draw_on_emitters(sky: Sky, u: wp.vec2) -> PointOfEmitter:
    """Return the start of a path at a near emitter: a point drawn with a probability proportional to its light."""
    out = PointOfEmitter()
    height = sky.radiance.shape[0]
    width = sky.radiance.shape[1]
    step = find_step(sky.near_steps, u[0])
    row = sky.near_texels[step] / width
    column = sky.near_texels[step] % width
    within = wp.vec2(within_step(sky.near_steps, step, u[0]), u[1])
    normal = direction_in_texel(row, column, height, width, within)
    emitter = sky.emitters[sky.near_owner[row, column]]
    out.position = emitter.origin + emitter.distance * normal
    square = emitter.distance * emitter.distance
    out.intensity = square / sky.near_density[row, column] * sky.near_radiance[row, column]
    return out


@wp.func
def seen_area(params: FrameParams, vertex: Vertex, toward_light: wp.vec3) -> wp.float32:
    """Return the radiance that a path of power 1 adds to the pixel that shows its vertex; 0 if that faces away."""
    away = vertex.hit.point - params.camera_position
    distance = wp.length(away)
    view = away / wp.max(distance, 1.0e-6)
    depth = (wp.transpose(params.world_from_camera) * away)[2]
    facing = from_viewer(vertex, -view)
    cosine = -wp.dot(vertex.hit.geometric_normal, view)
    arriving = wp.dot(facing.hit.geometric_normal, toward_light)
    shaded = wp.dot(facing.hit.normal, toward_light)
    if depth <= 0.0 or is_turned(vertex, view) or arriving <= 0.0 or shaded <= 0.0:
        return 0.0
    per_pixel = cosine * distance / (depth * depth * depth) * params.focal[0] * params.focal[1]
    return shaded / arriving / wp.pi * per_pixel


@wp.func
def add_to_pixels(
    params: FrameParams, rays: wp.array2d[wp.vec2], point: wp.vec3, radiance: wp.vec3, image_out: LightImage
):
    """Add radiance to the pixel that shows a point; pixels have the extent of the rays of ``camera_ray``."""
    away = point - params.camera_position
    at = project(params, away)
    local = wp.transpose(params.world_from_camera) * away
    row = wp.int32(wp.floor(at[1] + 0.5))
    column = wp.int32(wp.floor(at[0] + 0.5))
    scale = 1.0 / wp.float32(rays.shape[0] * rays.shape[1])
    for i in range(wp.max(row - 1, 0), wp.min(row + 2, rays.shape[0])):
        for j in range(wp.max(column - 1, 0), wp.min(column + 2, rays.shape[1])):
            x = (local[0] / local[2] - rays[i, j][0]) * params.focal[0]
            y = (local[1] / local[2] - rays[i, j][1]) * params.focal[1]
            if x >= -0.5 and x < 0.5 and y >= -0.5 and y < 0.5:
                for c in range(3):
                    value = wp.min(radiance[c] * scale, MOST)
                    place = 3 * (i * rays.shape[1] + j) + c
                    if value > 0.0:
                        add_whole(image_out.sums, place, wp.int64(value * UNIT + 0.5))
                        add_whole(image_out.squares, place, wp.int64(value * value * UNIT + 0.5))


@functools.cache
def make_follow_lights_kernel(trace: TraceConfig) -> wp.Kernel:
    """Return the kernel of ``follow_lights`` for the kinds of shape in ``trace``."""
    find_vertex, see_proxy = make_find_vertex(trace), make_see_proxy(trace)
    hidden_by_physical, look_up_material = make_hidden_by_physical(trace), make_look_up_material()
    occluded_by_objects = make_trace(trace).occluded_by_objects

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def follow_lights_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        scene: LocalScene,
        seed: wp.int32,
        number: wp.int32,
        paths: wp.int32,
        of_lights: wp.int32,
        # Out:
        image_out: LightImage,
    ):
        k = wp.tid() + row_start
        key = PathKey()
        # An index that no pixel has.
        key.pixel = wp.uint32(k) + PATH_OFFSET
        key.sample = wp.uint32(number)
        key.seed = wp.uint32(seed)
        origin = wp.vec3(0.0, 0.0, 0.0)
        of_emitter = wp.vec3(0.0, 0.0, 0.0)
        light = Light()
        # As if all were of the kind that this one is.
        times = wp.float32(paths)
        if k < of_lights:
            light = scene.lights[k % scene.lights.shape[0]]
            origin = light.position
            times = times * wp.float32(scene.lights.shape[0]) / wp.float32(of_lights)
        else:
            on = random_triple(key, 0, ON_EMITTER)
            drawn = draw_on_emitters(scene.sky, wp.vec2(on[0], on[1]))
            origin = drawn.position
            of_emitter = drawn.intensity
            times = times / wp.float32(paths - of_lights)
        direction = draw_start(scene, origin, random_triple(key, 0, START))
        power = wp.vec3(0.0, 0.0, 0.0)
        kept = wp.vec3(1.0, 1.0, 1.0)
        depth = wp.int32(0)
        rays = wp.int32(0)
        while depth < MOST_VERTICES:
            vertex = find_vertex(scene, origin, direction, True)
            rays += 1
            goes_on = vertex.kind == OBJECT or (depth > 0 and vertex.kind != NOTHING)
            toward = -direction
            if depth == 0 and goes_on:
                power = of_emitter
                if k < of_lights:
                    sample = sample_light(light, vertex.hit.point)
                    power = sample.distance * sample.distance * sample.irradiance_normal
                power = power * times / wp.max(start_density(scene, origin, direction), 1.0e-20)
                goes_on = wp.max(power) > 0.0
            reflectance = wp.vec3(1.0, 1.0, 1.0)
            if goes_on and vertex.kind == PROXY:
                hit = vertex.hit
                if depth > 0:
                    area = seen_area(params[0], vertex, toward)
                    if area > 0.0:
                        away = params[0].camera_position - hit.point
                        distance = wp.length(away)
                        start = offset_origin(hit.point, hit.geometric_normal, away, hit.error)
                        rays += 1
                        hidden = hidden_by_physical(scene, start, away / distance, distance)
                        if not hidden:
                            hidden = occluded_by_objects(scene.rays, start, away / distance, distance)
                        if not hidden:
                            radiance = area * wp.cw_mul(kept, power)
                            add_to_pixels(params[0], scene.picture.rays, hit.point, radiance, image_out)
                seen = see_proxy(params[0], scene, vertex)
                rays += seen.rays
                reflectance = seen.reflectance
            if goes_on:
                facing = from_viewer(vertex, toward)
                hit = facing.hit
                surface = look_up_material(scene, facing, toward, reflectance)
                u = random_triple(key, depth, SCATTER)
                pick = random_triple(key, depth, PICK)
                on = draw_reflected(surface, hit.normal, hit.geometric_normal, toward, pick[0], wp.vec2(u[0], u[1]))
                is_mirror = surface.model == wp.static(int(MIRROR))
                begins = depth > 0 or is_polished(vertex.kind, surface)
                share = wp.vec3(0.0, 0.0, 0.0)
                if is_mirror and begins and wp.max(wp.abs(on)) > 0.0:
                    share = surface.reflectance
                elif begins and not is_mirror:
                    density = surface_density(surface, hit.normal, toward, on)
                    arriving = wp.dot(hit.geometric_normal, toward)
                    if density > 0.0 and arriving > 0.0:
                        viewed = from_viewer(vertex, on)
                        look = look_up_material(scene, viewed, on, reflectance)
                        leaving = wp.abs(wp.dot(hit.geometric_normal, on))
                        reflected = reflected_from(look, viewed.hit, on, toward)
                        share = leaving / (density * arriving) * reflected
                kept = wp.cw_mul(kept, share)
                chance = survival(kept, depth)
                goes_on = pick[1] < chance and wp.max(kept) > 0.0
                kept = kept / wp.max(chance, 1.0e-30)
                origin = offset_origin(hit.point, hit.geometric_normal, on, hit.error)
                direction = on
            depth = wp.where(goes_on, depth + 1, MOST_VERTICES)
        add_whole(image_out.rays, k % wp.static(COUNTERS), wp.int64(rays))

    return follow_lights_kernel


def make_light_image(shape: tuple[int, int], device: wp.DeviceLike) -> LightImage:
    """Return a ``LightImage`` of zeros for a picture of (H, W) pixels."""
    image = LightImage()
    size = 3 * shape[0] * shape[1]
    image.sums, image.squares = (wp.zeros(size, dtype=wp.int64, device=device) for _ in range(2))
    image.rays = wp.zeros(COUNTERS, dtype=wp.int64, device=device)
    return image


follow_lights = row_launcher(make_follow_lights_kernel, like=lambda *given: given[5:6])
"""Follow paths from virtual lights and near emitters, and add their light to pixels.

Args:
    trace: Kinds of shape in the scene.
    params: (1,) FrameParams: the camera.
    scene: Surfaces and lights; for the lights ``follows_lights`` must hold.
    seed: Seed of the random numbers.
    number: Index of this pass, so that its random numbers differ from those of other passes.
    count: Number of paths, at most 2^31.
    of_lights: Number of the first paths, which start at virtual lights; the others start at near emitters.
    image_out: From ``make_light_image``.
"""
