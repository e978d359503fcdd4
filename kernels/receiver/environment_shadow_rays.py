"""What a cell's rays toward the samples of the environment may meet, and what sends light along them.

Culling. A sample matters only if its direction meets the bounding sphere of an object; a dot product tells. Only those
rays are traced, and cells that have none are done.

The physical. A ray that meets a proxy or a mirror ball, with objects or without them, finds its light: the camera's
picture of it where that shows it (``traced``), else what the ball saw in its direction; of a ball what it reflects.
"""

from __future__ import annotations

import functools

import warp as wp

from warp_ar.kernels.environment.environment_samples import SampleSets, ball_of_sample, sample_toward
from warp_ar.kernels.environment.probe_weights import probe_share
from warp_ar.kernels.latlong import sample_latlong
from warp_ar.kernels.materials import reflect
from warp_ar.kernels.objects.reflect import DistantLight, look_up, make_find_in_frame
from warp_ar.kernels.rays.shapes import FAR, intersect_sphere
from warp_ar.kernels.rays.trace import make_trace
from warp_ar.kernels.receiver.environment_shadow_bounce import bounding_radius, make_look_wide
from warp_ar.kernels.receiver.environment_shadow_cells import EnvironmentShadowConfig
from warp_ar.kernels.structs import BOX, PLANE, FrameParams, Hit, Picture, RayScene, Shape

wp.set_module_options({"enable_backward": False})


@wp.func
def may_be_one_sided(objects: wp.array[Shape]) -> wp.bool:
    """Whether the closest hit may pass what hides the environment: triangles that are seen from one side only.

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
