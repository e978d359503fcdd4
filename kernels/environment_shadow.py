"""Shadows that virtual objects cast on the real desk under the environment, and the light that they bounce onto it.

What a proxy's pixel becomes is a factor on what the camera sees there [Deb98]: reflectance cancels,

    ratio = E_with / E_without,   per channel,

E the irradiance at the pixel's point, without the virtual objects (the proxies and the mirror balls shadow it: they are
real and in the picture already) and with them. Both are sums over the same samples of the environment
(``environment_samples``), so a point that no object shades has a ratio of exactly 1, one that sees nothing but a black
object 0, and an error of the samples cancels to first order.

Cells. One pixel of every ``stride x stride`` is estimated. The cells of a tile of ``side x side`` use one set of
samples each, and every set in turn; a filter then averages over one tile's worth of cells, with the edge cells of a
window of ``side + 1`` at half weight, so that each set counts the same and the window is centred [KH01]. A window half
as wide has half the blur and twice the noise. It takes over where the two means differ by more than noise: at contacts
and at the edges of a lamp's shadow. Few cells of many samples, averaged so, are nearer to the truth than many of few at
twice the rays. Cells on another surface do not count; a pixel between cells of several surfaces looks for its own. All
of it is a function of the frame alone: nothing flickers and nothing lags.

Culling. A sample matters only if its direction meets the bounding sphere of an object; a dot product tells. Only those
rays are traced, and cells that have none are done. Tiles of cells in which a ray met an object note the frame's
number: elsewhere the ratio is 1, and need not be averaged. Nor need it be spread to pixels where it stays within
``NEGLIGIBLE`` of 1; that is made exactly 1.

Bounce. What a ray meets is not black. Either a ray finds out (``traced``): an object reflects one of its two lobes,
picked by their reflectance. Its rough lobe gives albedo E(n) / pi, times what a ray into it meets: nothing, 1; an
object, that object's own colour; the receiver, 1 if a ray from there leaves the scene, else a share of the object's
reflectance, so that light dies out between an object and the ground that it stands on, the slower the whiter the
object. Its glossy lobe gives what is in the mirror direction.

Or it is an estimate without a ray (``estimated``). Both lobes reflect the distant environment, whose part behind the
cell's own surface is that surface: the receiver. Let h be the share of the light that objects hide, u what they send of
the environment before the cell's surface, d of the receiver if it were not shaded. The receiver that they see is near
the cell and shaded as it is, so the ratio r is that of

    r = 1 - h + u + d r,    r = (1 - h + u) / (1 - d)

with all the light that goes to and fro between an object and the ground: white objects in a white environment (u + d =
h) leave it as it is, black ones give 1 - h, and where nothing but the ground is seen (u = 0, h = 1) all is dark.

The physical. A ray that meets a proxy or a mirror ball, with objects or without them, finds its light: the camera's
picture of it where that shows it (``traced``), else what the ball saw in its direction; of a ball what it reflects.

References:
    [Deb98] Debevec 1998, Rendering Synthetic Objects into Real Scenes.
    [KH01] Keller, Heidrich 2001, Interleaved Sampling.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Literal

import warp as wp

from warp_ar.kernels.environment_samples import EnvironmentSample, sample_toward
from warp_ar.kernels.irradiance import sh_irradiance
from warp_ar.kernels.latlong import sample_latlong
from warp_ar.kernels.launch import MOST_REGISTERS, Rows, launch, launch_rows
from warp_ar.kernels.materials import make_surface, reflect
from warp_ar.kernels.prefilter import level_from_alpha, sample_levels
from warp_ar.kernels.reflect import (
    DistantLight,
    DistantLightConfig,
    knows_irradiance,
    knows_levels,
    look_up,
    make_distant_irradiance,
    make_find_in_frame,
    make_mirrored,
    make_shade_unoccluded,
)
from warp_ar.kernels.sampling import frame_from_normal, pcg3d_hash, sample_cosine_hemisphere, uniform_from_bits
from warp_ar.kernels.structs import BOX, PLANE, SPHERE, FrameParams, Probe, RayScene, Shape
from warp_ar.kernels.visibility import (
    FACES,
    FAR,
    MESH_KEY,
    Hit,
    inside_rect,
    intersect_sphere,
    make_trace,
    meets_probe,
    offset_origin,
    surface_key,
)

wp.set_module_options({"enable_backward": False})

SHADED_TILE = wp.constant(4)
"""Cells along a tile that notes whether something in it is shaded."""
CONTRAST = wp.constant(wp.float32(0.03))
"""Least difference of a narrow and a wide mean at which the narrow one takes over."""
NOISE = wp.constant(wp.float32(1.0))
"""The same, in standard errors of the narrow mean."""
NEGLIGIBLE = wp.constant(wp.float32(1.0 / 512.0))
"""Change of the environment that no 8-bit picture shows: a quarter of a code at most, taken for none."""
MAX_PARTS = 8
"""Threads of a CUDA device that share the samples of a cell at most."""
ENOUGH_THREADS = 1 << 20
"""Threads from which more make a CUDA device slower: each finds the cell's point and picks its samples anew."""
CPU_RUN = 32
"""Pixels of a row that one thread of a CPU does: it looks once whether any of them can be shaded."""
WARP_LANES = 32
"""Threads of a CUDA device that go the same way or wait for each other."""
KINDS = wp.constant(4)
"""Sums per part of a cell: light without the objects, what they hide, what they send of the environment and of the
receiver."""
CHUNK = wp.constant(64)
"""Samples that are culled together: the bits of a mask."""
WORD = 32
"""Samples of a part in steps: the bits of a word."""
MOST_ITEMS = 1 << 24
"""Samples that may ask in steps: beyond it their list takes too much memory, 16 bytes each and more."""
ASKING_THREADS = 1 << 17
"""Threads that ask in steps, each for what is left of the list when the others have theirs."""
MIN_IRRADIANCE = wp.constant(wp.float32(1.0e-6))
"""Irradiance, in camera values, below which a surface is dark and a shadow on it means nothing."""
MAX_RATIO = wp.constant(wp.float32(4.0))
"""Largest factor: what objects bounce onto a dark place is bounded, as the picture of it is mostly noise."""
CAUSTIC_ALPHA = wp.constant(wp.float32(0.35))
"""Least width of an object's lobe as the receiver sees it, near the object.

A mirror's image of a lamp on the receiver is too fine for the few rays that look for it: it would come out as specks.
This blurs it to what they can carry, and keeps its energy. From afar fewer rays meet the object and each stands for
more of what it shows: the width grows as the distance over the object's size.
"""
MAX_BRIGHTNESS = wp.constant(wp.float32(2.0))
"""Largest radiance of an object, estimated, over the mean of what its surroundings send to the cell's surface.

The sides of objects are dark beside a top that a lamp lights, and few samples show them: a brighter object is specks.
"""
MAX_RETURN = wp.constant(wp.float32(0.99))
"""Largest share of its light that the receiver gets back from objects, estimated: what goes to and fro stays finite."""
FURTHER = wp.constant(wp.float32(0.5))
"""Light of an object close above the receiver, over that in the open: half of what it sees is its own shadow."""
DEPTH_STEP = wp.constant(wp.float32(0.03))
"""Relative change of depth from which neighbours on a mesh belong to different parts of it."""


@dataclasses.dataclass(frozen=True)
class EnvironmentShadowConfig:
    """What is compiled into the kernel."""

    distant: DistantLightConfig
    """Kinds of shape and forms of light."""
    count: int
    """Samples per set: up to 64, or a multiple of it."""
    side: int
    """Pixels along a tile; there are side^2 sets."""
    bounce: Literal["estimated", "traced"]
    """How what objects reflect onto the receiver is found."""
    asking: float = 1.0
    """Share of a set, its first samples, that is asked what the object that it meets sends; others only stop there."""
    near: bool = False
    """Whether some samples are lamps at a known distance."""
    parts: int = 1
    """Threads that share the samples of a cell: a divisor of count and of 64."""


@wp.func
def bounding_radius(shape: Shape) -> wp.float32:
    """Radius of a sphere around a shape's position that holds it, metres."""
    if shape.kind == SPHERE:
        return shape.scale * shape.extent[0]
    return shape.scale * wp.length(shape.extent)


@wp.func
def caustic_alpha(shape: Shape, point: wp.vec3) -> wp.float32:
    """Least width of the lobe of an object as a point of the receiver sees it."""
    return wp.clamp(CAUSTIC_ALPHA * wp.length(shape.position - point) / bounding_radius(shape), CAUSTIC_ALPHA, 1.0)


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
        samples: wp.array[EnvironmentSample],
        first: wp.int32,
        point: wp.vec3,
        to_center: wp.vec3,
        radius: wp.float32,
    ) -> wp.uint64:
        threshold = cone_threshold(to_center, radius)
        mask = wp.uint64(0)
        bit = wp.uint64(1)
        # Its end is no constant: a loop that is unrolled loads all of its samples at once, into as many registers.
        for k in range(first, first + count):
            direction = directions[k]
            if wp.static(near):
                direction = sample_toward(samples[k], point).direction
            if wp.dot(direction, to_center) >= threshold:
                mask = mask | bit
            bit = bit << wp.uint64(1)
        return mask

    return mask_cone


@wp.struct
class Sent:
    """What an object reflects along a ray."""

    distant: wp.vec3  # radiance that it has from the environment
    desk: wp.vec3  # radiance that it would have from a receiver without shadows


@functools.cache
def make_look_wide(config: DistantLightConfig) -> wp.Function:
    """``look_wide(environment, direction) -> vec3``: the environment around a direction, as few rays carry it."""

    @wp.func(module="unique")
    def look_wide(distant: DistantLight, direction: wp.vec3) -> wp.vec3:
        radiance = wp.vec3(0.0)
        if wp.static(config.diffuse != "none"):
            if knows_irradiance(distant) and not knows_levels(distant):
                if wp.static(config.diffuse == "sh"):
                    radiance = sh_irradiance(distant.irradiance_sh, direction) / wp.pi
                if wp.static(config.diffuse == "map"):
                    radiance = sample_latlong(distant.irradiance_map, direction) / wp.pi
        if wp.static(config.specular):
            if knows_levels(distant):
                level = level_from_alpha(CAUSTIC_ALPHA, distant.level_height)
                radiance = sample_levels(distant.levels, direction, level, distant.level_height)
        return radiance

    return look_wide


@functools.cache
def make_estimated(config: DistantLightConfig) -> wp.Function:
    """``estimated(scene, environment, hit, direction, alpha, up, from_desk) -> Sent``.

    What an object sends back along a ray that met it at ``hit``, without a further ray: both lobes of the distant
    environment, the glossy one ``alpha`` wide or more. What lies below ``up`` is the receiver; ``from_desk`` is the
    irradiance that a surface above it has from there.
    """
    surface_at = make_surface(config.models, config.textures)
    mirrored = make_mirrored(config)
    distant_irradiance = make_distant_irradiance(config)

    @wp.func(module="unique")
    def estimated(
        scene: RayScene,
        distant: DistantLight,
        hit: Hit,
        direction: wp.vec3,
        alpha: wp.float32,
        up: wp.vec3,
        from_desk: wp.vec3,
    ) -> Sent:
        wo = -direction
        normal = hit.normal
        if wp.dot(hit.geometric_normal, wo) < 0.0:
            normal = -normal
        cosine = wp.max(wp.dot(normal, wo), 0.0)
        surface = surface_at(scene, distant.dfg, scene.objects[hit.shape].material, hit.uv, cosine)
        sent = Sent()
        if wp.static(config.diffuse != "none"):
            irradiance = distant_irradiance(distant, hit.point, normal)
            # A surface sees (1 - n.up) / 2 of what an even desk sends to one that faces it.
            desk = wp.min(0.5 * (1.0 - wp.dot(normal, up)) * from_desk, irradiance)
            sent.desk = wp.cw_mul(surface.diffuse, desk) / wp.pi
            sent.distant = wp.cw_mul(surface.diffuse, irradiance - desk) / wp.pi
        if wp.static(config.specular):
            if knows_levels(distant):
                outward = reflect(wo, normal)
                floor = level_from_alpha(alpha, distant.level_height)
                radiance = wp.cw_mul(
                    surface.reflectance,
                    mirrored(distant, surface.model, surface.roughness, surface.shininess, hit.point, outward, floor),
                )
                share = wp.clamp(0.5 - 0.5 * wp.dot(outward, up) / CAUSTIC_ALPHA, 0.0, 1.0)
                sent.desk += share * radiance
                sent.distant += (1.0 - share) * radiance
        return sent

    return estimated


@functools.cache
def make_bounced(config: DistantLightConfig) -> wp.Function:
    """``bounced(params, frame, decode_table, scene, environment, hit, direction, alpha, seed) -> vec3``.

    Radiance that an object sends back along a ray that met it at ``hit``: one lobe, the glossy one ``alpha`` wide or
    more, one ray; a Monte-Carlo estimate.
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
    distant_irradiance = make_distant_irradiance(config)

    @wp.func(module="unique")
    def bounced(
        params: FrameParams,
        frame: wp.array2d[wp.vec3ub],
        decode_table: wp.array[wp.vec3],
        scene: RayScene,
        distant: DistantLight,
        hit: Hit,
        direction: wp.vec3,
        alpha: wp.float32,
        seed: wp.vec3ui,
    ) -> wp.vec3:
        wo = -direction
        normal = hit.normal
        geometric = hit.geometric_normal
        if wp.dot(geometric, wo) < 0.0:
            normal = -normal
            geometric = -geometric
        surface = surface_at(
            scene, distant.dfg, scene.objects[hit.shape].material, hit.uv, wp.max(wp.dot(normal, wo), 0.0)
        )
        rough = surface.diffuse[0] + surface.diffuse[1] + surface.diffuse[2]
        glossy = surface.reflectance[0] + surface.reflectance[1] + surface.reflectance[2]
        if wp.static(config.diffuse == "none") or not knows_irradiance(distant):
            rough = float(0.0)
        if wp.static(not config.specular) or not knows_levels(distant):
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
            # Light of the receiver, as far as a ray from there leaves the scene.
            up = proxy.geometric_normal
            if wp.dot(up, outward) > 0.0:
                up = -up
            leaving = frame_from_normal(up) * sample_cosine_hemisphere(wp.vec2(u[1], u[0]))
            start = offset_origin(proxy.point, up, leaving, proxy.error)
            at = find_in_frame(
                params, frame.shape[0], frame.shape[1], scene, distant.probes, proxy.point, proxy.geometric_normal
            )
            if at[0] >= 0.0:
                received = look_up(frame, decode_table, at[0], at[1])
            else:
                received = sample_latlong(distant.environment, outward)
            if is_rough:
                if wp.static(config.diffuse != "none"):  # what is rough here has an irradiance
                    received = distant_irradiance(distant, hit.point, normal) / wp.pi
            if occluded_by_objects(scene, start, leaving, FAR):
                received = wp.cw_mul(received, FURTHER * (surface.diffuse + surface.reflectance))
        elif other.shape >= 0:
            received = shade_unoccluded(scene, distant, other, outward)
        elif is_rough:
            received = distant_irradiance(distant, hit.point, normal) / wp.pi
        else:
            if wp.static(config.specular):
                floor = level_from_alpha(alpha, distant.level_height)
                received = mirrored(
                    distant, surface.model, surface.roughness, surface.shininess, hit.point, outward, floor
                )
        return wp.cw_mul(weight, received)

    return bounced


@functools.cache
def make_seen_proxy(config: DistantLightConfig) -> wp.Function:
    """``seen_proxy(params, ray, scene, probes) -> Hit``: the receiver's surface that a pixel shows, or shape -1."""
    closest_proxy = make_trace(config.trace).closest_proxy

    @wp.func(module="unique")
    def seen_proxy(params: FrameParams, ray: wp.vec2, scene: RayScene, probes: wp.array[Probe]) -> Hit:
        direction = params.world_from_camera * wp.vec3(ray[0], ray[1], 1.0)
        hit = closest_proxy(scene, params.camera_position, direction, FAR)
        if hit.shape >= 0:
            if wp.dot(hit.geometric_normal, direction) >= 0.0:
                hit.shape = -1
            if wp.static(config.probes):
                if meets_probe(probes, params.camera_position, direction, hit.t):
                    hit.shape = -1
        return hit

    return seen_proxy


@wp.func
def ratio_of(without: wp.vec3, hidden: wp.vec3, depth: wp.float32) -> wp.vec4:
    """Share of the environment that is left, and the depth beside it."""
    ratio = wp.vec4(1.0, 1.0, 1.0, depth)
    for channel in range(3):
        if without[channel] > MIN_IRRADIANCE:
            ratio[channel] = wp.clamp(1.0 - hidden[channel] / without[channel], 0.0, 1.0)
    return ratio


@wp.func
def bounced_of(without: wp.vec3, hidden: wp.vec3, sent: wp.vec3, returned: wp.vec3) -> wp.vec3:
    """What objects send, relative to the environment; ``returned`` is the part that the receiver itself must light."""
    ratio = wp.vec3(0.0)
    for channel in range(3):
        if without[channel] > MIN_IRRADIANCE:
            left = wp.clamp(1.0 - hidden[channel] / without[channel], 0.0, 1.0)
            back = wp.min(returned[channel] / without[channel], MAX_RETURN)
            total = (left + sent[channel] / without[channel]) / (1.0 - back)
            ratio[channel] = wp.min(total - left, MAX_RATIO)
    return ratio


@wp.struct
class Sender:
    """What sends light along a sample's direction where no virtual object stands."""

    radiance: wp.vec3
    distance: wp.float32


@functools.cache
def make_find_sender(config: EnvironmentShadowConfig) -> wp.Function:
    """``find_sender(params, frame, decode_table, scene, environment, samples, index, origin, ...) -> Sender``.

    The sample itself, ``distance`` away, or the physical before it: a proxy if ``by_proxy``, a mirror ball if
    ``by_ball``; those that the ray cannot meet need not be asked.
    """
    closest_proxy = make_trace(config.distant.trace).closest_proxy
    traced = config.bounce == "traced"
    find_in_frame = make_find_in_frame(config.distant.trace, config.distant.probes) if traced else None
    look_wide = make_look_wide(config.distant)

    @wp.func(module="unique")
    def find_sender(
        params: wp.array[FrameParams],
        frame: wp.array2d[wp.vec3ub],
        decode_table: wp.array[wp.vec3],
        scene: RayScene,
        distant: DistantLight,
        samples: wp.array[EnvironmentSample],
        index: wp.int32,
        origin: wp.vec3,
        direction: wp.vec3,
        distance: wp.float32,
        by_proxy: wp.bool,
        by_ball: wp.bool,
    ) -> Sender:
        sender = Sender()
        sender.radiance = samples[index].radiance
        sender.distance = distance
        if by_proxy:
            proxy = closest_proxy(scene, origin, direction, distance)
            if proxy.shape >= 0:
                sender.distance = proxy.t
                seen = wp.vec2(-1.0, -1.0)
                if wp.static(traced):
                    seen = find_in_frame(
                        params[0],
                        frame.shape[0],
                        frame.shape[1],
                        scene,
                        distant.probes,
                        proxy.point,
                        proxy.geometric_normal,
                    )
                if seen[0] >= 0.0:
                    sender.radiance = look_up(frame, decode_table, seen[0], seen[1])
                else:
                    # Where the ball saw it; a lamp right beside it is not its light.
                    sender.radiance = wp.min(
                        sample_latlong(distant.environment, proxy.point - samples[index].origin), wp.vec3(1.0, 1.0, 1.0)
                    )
        if wp.static(config.distant.probes):
            if by_ball:
                for ball in range(distant.probes.shape[0]):
                    probe = distant.probes[ball]
                    t = intersect_sphere(probe.radius, origin - probe.center, direction, sender.distance)
                    if t < sender.distance:
                        sender.distance = t
                        normal = (origin + t * direction - probe.center) / probe.radius
                        sender.radiance = wp.cw_mul(probe.reflectance, look_wide(distant, reflect(-direction, normal)))
        return sender

    return find_sender


@wp.struct
class Before:
    """What lies before a cell's surface, for ``estimated``."""

    up: wp.vec3  # the surface's normal, on the side that light comes from
    from_desk: wp.vec3  # irradiance that a surface above it has from below
    brightest: wp.float32  # largest radiance that an object is believed to have


@functools.cache
def make_look_before(config: DistantLightConfig) -> wp.Function:
    """``look_before(environment, normal, direction) -> Before``: of a surface that ``direction`` leaves."""
    look_wide = make_look_wide(config)

    @wp.func(module="unique")
    def look_before(distant: DistantLight, normal: wp.vec3, direction: wp.vec3) -> Before:
        before = Before()
        before.up = normal
        if wp.dot(normal, direction) < 0.0:
            before.up = -normal
        before.brightest = MAX_BRIGHTNESS * wp.max(look_wide(distant, before.up))
        if wp.static(config.diffuse != "none"):
            if knows_irradiance(distant):
                if wp.static(config.diffuse == "sh"):
                    before.from_desk = sh_irradiance(distant.irradiance_sh, -before.up)
                    before.brightest = MAX_BRIGHTNESS * wp.max(sh_irradiance(distant.irradiance_sh, before.up)) / wp.pi
                if wp.static(config.diffuse == "map"):
                    before.from_desk = sample_latlong(distant.irradiance_map, -before.up)
                    before.brightest = (
                        MAX_BRIGHTNESS * wp.max(sample_latlong(distant.irradiance_map, before.up)) / wp.pi
                    )
        return before

    return look_before


@wp.struct
class Physical:
    """Samples that may meet a proxy or a mirror ball, a bit each."""

    proxies: wp.uint64
    balls: wp.uint64


@functools.cache
def make_masks(config: EnvironmentShadowConfig, count: int) -> tuple[wp.Function, wp.Function]:
    """Which of ``count`` samples from ``first`` on may meet something, a bit each, as a point sees them.

    ``mask_objects(scene, directions, samples, first, point) -> uint64``, and ``mask_physical(scene, environment,
    directions, samples, first, point, own) -> Physical``, ``own`` being the proxy that the point is on.
    """
    mask_cone = make_mask_cone(count, config.near)

    @wp.func(module="unique")
    def mask_objects(
        scene: RayScene,
        directions: wp.array[wp.vec3],
        samples: wp.array[EnvironmentSample],
        first: wp.int32,
        point: wp.vec3,
    ) -> wp.uint64:
        mask = wp.uint64(0)
        for index in range(scene.objects.shape[0]):
            shape = scene.objects[index]
            mask = mask | mask_cone(directions, samples, first, point, shape.position - point, bounding_radius(shape))
        return mask

    @wp.func(module="unique")
    def mask_physical(
        scene: RayScene,
        distant: DistantLight,
        directions: wp.array[wp.vec3],
        samples: wp.array[EnvironmentSample],
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
                mask.proxies = mask.proxies | mask_cone(
                    directions, samples, first, point, shape.position - point, bounding_radius(shape)
                )
        if wp.static(config.distant.probes):
            for index in range(distant.probes.shape[0]):
                probe = distant.probes[index]
                mask.balls = mask.balls | mask_cone(
                    directions, samples, first, point, probe.center - point, probe.radius
                )
        return mask

    return mask_objects, mask_physical


@wp.func
def cell_column(thread: wp.int32, columns: wp.int32, side: wp.int32, lanes: wp.int32) -> wp.int32:
    """Column of the cell that a thread takes: neighbours take those of one set, so that their rays go the same way."""
    group = lanes * side
    place = thread % group
    if thread - place + group > columns:
        return thread
    return thread - place + (place % lanes) * side + place / lanes


@wp.func
def first_of_set(i: wp.int32, j: wp.int32, side: wp.int32, count: wp.int32) -> wp.int32:
    """First sample of a cell's set; ``count`` are all sets together."""
    return count / (side * side) * ((i % side) * side + j % side)


@wp.func
def cell_pixel(cell: wp.int32, stride: wp.int32, size: wp.int32) -> wp.int32:
    """Row or column at which a cell is estimated."""
    return wp.min(cell * stride + stride / 2, size - 1)


@functools.cache
def make_environment_shadow_kernel(config: EnvironmentShadowConfig) -> wp.Kernel:
    """Kernel specialised to ``config``; equal configs share one kernel."""
    if config.count > CHUNK and config.count % CHUNK:
        raise ValueError(f"count is {config.count}; expected up to {CHUNK} or a multiple of it")
    trace = make_trace(config.distant.trace)
    closest_object, occluded_by_objects = trace.closest_object, trace.occluded_by_objects
    mask_objects, mask_physical = make_masks(config, min(config.count, CHUNK))
    seen_proxy, find_sender = make_seen_proxy(config.distant), make_find_sender(config)
    traced = config.bounce == "traced"
    bounced = make_bounced(config.distant) if traced else None
    estimated, look_before = (
        (None, None) if traced else (make_estimated(config.distant), make_look_before(config.distant))
    )
    side = config.side
    chunk = min(config.count, CHUNK)
    asked = round(config.count * config.asking)
    if asked < 1 or asked > config.count:
        raise ValueError(f"asking is {config.asking}; expected a share of {config.count} samples")
    if chunk % config.parts:
        raise ValueError(f"parts is {config.parts}; expected a divisor of {chunk}")

    @wp.kernel(module="unique", enable_backward=False)
    def environment_shadow_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        rays: wp.array2d[wp.vec2],
        frame: wp.array2d[wp.vec3ub],
        decode_table: wp.array[wp.vec3],
        scene: RayScene,
        distant: DistantLight,
        directions: wp.array[wp.vec3],
        flux: wp.array[wp.vec3],
        samples: wp.array[EnvironmentSample],
        stride: wp.int32,
        lanes: wp.int32,
        # Out:
        ratio_out: wp.array2d[wp.vec4],
        bounced_out: wp.array2d[wp.vec3],
        surface_out: wp.array2d[wp.int32],
        shaded_out: wp.array2d[wp.int32],
        sums_out: wp.array3d[wp.vec3],
    ):
        i, j = wp.tid()
        i += row_start
        part = wp.int32(0)
        if wp.static(config.parts > 1):
            part = i / surface_out.shape[0]
            i = i % surface_out.shape[0]
        j = cell_column(j, ratio_out.shape[1], side, lanes)
        row = cell_pixel(i, stride, rays.shape[0])
        column = cell_pixel(j, stride, rays.shape[1])
        surface_out[i, j] = -1
        rect = params[0].shadow_rect
        # The filter looks half a tile beyond the pixels that it writes.
        margin = stride * wp.static(config.side)
        wide = wp.vec4i(rect[0] - margin, rect[1] + margin, rect[2] - margin, rect[3] + margin)
        if rect[0] >= rect[1] or not inside_rect(row, column, wide):
            return
        hit = seen_proxy(params[0], rays[row, column], scene, distant.probes)
        if hit.shape < 0:
            return
        surface_out[i, j] = surface_key(scene.proxies[hit.shape], hit.shape, hit.geometric_normal)
        ratio_out[i, j] = wp.vec4(1.0, 1.0, 1.0, hit.t)
        bounced_out[i, j] = wp.vec3(0.0)
        if wp.static(config.parts > 1):
            for kind in range(KINDS):
                sums_out[part * KINDS + kind, i, j] = wp.vec3(0.0)

        point = hit.point
        own = hit.shape
        without = wp.vec3(0.0)
        hidden = wp.vec3(0.0)
        sent = wp.vec3(0.0)
        returned = wp.vec3(0.0)
        before = Before()
        # A set is in the order of its sequence: any first part of it is a smaller set.
        first = first_of_set(i, j, side, samples.shape[0])
        for block in range(wp.static(config.count // chunk)):
            at = first + block * wp.static(chunk)
            virtual_mask = mask_objects(scene, directions, samples, at, point)
            if wp.static(config.count == chunk):
                if virtual_mask == wp.uint64(0):
                    return
            physical = mask_physical(scene, distant, directions, samples, at, point, own)
            # Most samples meet nothing: they are but a sum.
            met = virtual_mask | physical.proxies | physical.balls
            begin = part * wp.static(chunk // config.parts)
            bit = wp.uint64(1) << wp.uint64(begin)
            # Its end is no constant: unrolled, the kernel would hold its rays many times over.
            for k in range(begin, begin + wp.int32(wp.static(chunk // config.parts))):
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
                        by_proxy = (physical.proxies & bit) != wp.uint64(0)
                        by_ball = (physical.balls & bit) != wp.uint64(0)
                        sender = find_sender(
                            params,
                            frame,
                            decode_table,
                            scene,
                            distant,
                            samples,
                            at + k,
                            origin,
                            direction,
                            reach,
                            by_proxy,
                            by_ball,
                        )
                        radiance = sender.radiance
                        reach = sender.distance
                        without += weight * radiance
                        if (virtual_mask & bit) != wp.uint64(0):
                            other = Hit()
                            other.shape = -1
                            if wp.static(asked == config.count) or block * wp.static(chunk) + k < wp.static(asked):
                                other = closest_object(scene, origin, direction, reach)
                                if other.shape >= 0:
                                    hidden += weight * radiance
                            elif occluded_by_objects(scene, origin, direction, reach):
                                hidden += weight * radiance
                            if other.shape >= 0:
                                stands_for = weight * wp.static(config.count / asked)
                                alpha = caustic_alpha(scene.objects[other.shape], point)
                                if wp.static(traced):
                                    seed = pcg3d_hash(wp.uint32(at + k), wp.uint32(row), wp.uint32(column))
                                    sent += stands_for * bounced(
                                        params[0], frame, decode_table, scene, distant, other, direction, alpha, seed
                                    )
                                else:
                                    if before.up == wp.vec3(0.0, 0.0, 0.0):
                                        before = look_before(distant, hit.geometric_normal, direction)
                                    light = estimated(
                                        scene, distant, other, direction, alpha, before.up, before.from_desk
                                    )
                                    stands_for *= wp.min(
                                        before.brightest / wp.max(wp.max(light.distant + light.desk), 1.0e-20), 1.0
                                    )
                                    sent += stands_for * light.distant
                                    returned += stands_for * light.desk
                bit = bit << wp.uint64(1)
        unchanged = hidden + sent == wp.vec3(0.0, 0.0, 0.0)
        if shaded_out.shape[0] > 0 and not unchanged:
            shaded_out[i / SHADED_TILE, j / SHADED_TILE] = params[0].frame_index
        if wp.static(config.parts > 1):
            sums_out[part * KINDS, i, j] = without
            sums_out[part * KINDS + 1, i, j] = hidden
            sums_out[part * KINDS + 2, i, j] = sent
            sums_out[part * KINDS + 3, i, j] = returned
        else:
            ratio_out[i, j] = ratio_of(without, hidden, hit.t)
            bounced_out[i, j] = bounced_of(without, hidden, sent, returned)

    return environment_shadow_kernel


@wp.kernel(enable_backward=False)
def join_parts_kernel(
    # In:
    surface: wp.array2d[wp.int32],
    sums: wp.array3d[wp.vec3],
    # Out:
    ratio_out: wp.array2d[wp.vec4],
    bounced_out: wp.array2d[wp.vec3],
):
    """Estimates of cells whose samples several threads shared."""
    i, j = wp.tid()
    if surface[i, j] < 0:
        return
    without = wp.vec3(0.0)
    hidden = wp.vec3(0.0)
    sent = wp.vec3(0.0)
    returned = wp.vec3(0.0)
    for part in range(sums.shape[0] / KINDS):
        without += sums[part * KINDS, i, j]
        hidden += sums[part * KINDS + 1, i, j]
        sent += sums[part * KINDS + 2, i, j]
        returned += sums[part * KINDS + 3, i, j]
    ratio_out[i, j] = ratio_of(without, hidden, ratio_out[i, j][3])
    bounced_out[i, j] = bounced_of(without, hidden, sent, returned)


# The same in four steps, for a CUDA device. A ray that asks what an object sends traces three more, and few ask: in the
# one kernel the other threads of its warp wait for it. So rays only stop at first; where one did, the cell's light is
# summed; those that ask are listed, and as many threads as there are ask side by side.


@wp.struct
class Steps:
    """What the steps hand on, ``parts`` threads having a share of each cell's samples."""

    hits: wp.array3d[wp.uint32]  # (parts, rows, columns): samples of a part that an object hides, a bit each
    starts: wp.array3d[wp.int32]  # (parts, rows, columns): place in the list of the first of them that asks
    items: wp.array[wp.int32]  # the list: number of the cell times CHUNK, and the sample
    listed: wp.array[wp.int32]  # (1,): its length
    sums: wp.array3d[wp.vec3]  # (2 * parts, rows, columns): light without the objects, and what they hide
    sent: wp.array2d[wp.vec3]  # (2, items): what objects send of the environment, and of the receiver


@functools.cache
def make_find_hits_kernel(config: EnvironmentShadowConfig) -> wp.Kernel:
    """Kernel of the first step: samples that objects hide, and the list of those that ask what these send."""
    size = config.count // config.parts
    asked = round(config.count * config.asking)
    side = config.side
    mask_objects, mask_physical = make_masks(config, size)
    trace = make_trace(config.distant.trace)
    closest_proxy, occluded_by_objects = trace.closest_proxy, trace.occluded_by_objects
    seen_proxy = make_seen_proxy(config.distant)

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def find_hits_kernel(
        # In:
        params: wp.array[FrameParams],
        rays: wp.array2d[wp.vec2],
        scene: RayScene,
        distant: DistantLight,
        directions: wp.array[wp.vec3],
        samples: wp.array[EnvironmentSample],
        stride: wp.int32,
        # Out:
        ratio_out: wp.array2d[wp.vec4],
        bounced_out: wp.array2d[wp.vec3],
        surface_out: wp.array2d[wp.int32],
        steps_out: Steps,
    ):
        part, i, thread = wp.tid()
        j = cell_column(thread, surface_out.shape[1], side, WARP_LANES)
        row = cell_pixel(i, stride, rays.shape[0])
        column = cell_pixel(j, stride, rays.shape[1])
        key = wp.int32(-1)
        found = wp.uint32(0)
        rect = params[0].shadow_rect
        # The filter looks half a tile beyond the pixels that it writes.
        margin = stride * side
        wide = wp.vec4i(rect[0] - margin, rect[1] + margin, rect[2] - margin, rect[3] + margin)
        if rect[0] < rect[1] and inside_rect(row, column, wide):
            hit = seen_proxy(params[0], rays[row, column], scene, distant.probes)
            if hit.shape >= 0:
                key = surface_key(scene.proxies[hit.shape], hit.shape, hit.geometric_normal)
                if part == 0:
                    ratio_out[i, j] = wp.vec4(1.0, 1.0, 1.0, hit.t)
                    bounced_out[i, j] = wp.vec3(0.0)
                begin = part * size
                at = first_of_set(i, j, side, samples.shape[0]) + begin
                virtual_mask = mask_objects(scene, directions, samples, at, hit.point)
                if virtual_mask != wp.uint64(0):
                    physical = mask_physical(scene, distant, directions, samples, at, hit.point, hit.shape)
                    asking = wp.int32(0)
                    # Its end is no constant: unrolled, the kernel would hold its rays many times over.
                    for k in range(begin, begin + size):
                        bit = wp.uint64(1) << wp.uint64(k - begin)
                        if (virtual_mask & bit) == wp.uint64(0):
                            continue
                        direction = directions[at + k - begin]
                        reach = float(FAR)
                        if wp.static(config.near):
                            toward = sample_toward(samples[at + k - begin], hit.point)
                            direction = toward.direction
                            reach = toward.distance
                        if wp.min(wp.dot(hit.normal, direction), wp.dot(hit.geometric_normal, direction)) <= 0.0:
                            continue
                        origin = offset_origin(hit.point, hit.geometric_normal, direction, hit.error)
                        if (physical.proxies & bit) != wp.uint64(0):
                            proxy = closest_proxy(scene, origin, direction, reach)
                            reach = wp.min(reach, proxy.t)
                        if wp.static(config.distant.probes):
                            if (physical.balls & bit) != wp.uint64(0):
                                for index in range(distant.probes.shape[0]):
                                    probe = distant.probes[index]
                                    t = intersect_sphere(probe.radius, origin - probe.center, direction, reach)
                                    reach = wp.min(reach, t)
                        if occluded_by_objects(scene, origin, direction, reach):
                            found = found | (wp.uint32(1) << wp.uint32(k - begin))
                            if k < asked:
                                asking += 1
                    if asking > 0:
                        start = wp.atomic_add(steps_out.listed, 0, asking)
                        steps_out.starts[part, i, j] = start
                        for k in range(begin, wp.min(begin + size, asked)):
                            if (found & (wp.uint32(1) << wp.uint32(k - begin))) != wp.uint32(0):
                                steps_out.items[start] = (i * surface_out.shape[1] + j) * CHUNK + k
                                start += 1
        if part == 0:
            surface_out[i, j] = key
        steps_out.hits[part, i, j] = found

    return find_hits_kernel


@wp.func
def any_hit(hits: wp.array3d[wp.uint32], i: wp.int32, j: wp.int32) -> wp.bool:
    """Whether an object hides any sample from a cell."""
    found = wp.uint32(0)
    for part in range(hits.shape[0]):
        found = found | hits[part, i, j]
    return found != wp.uint32(0)


@functools.cache
def make_sum_light_kernel(config: EnvironmentShadowConfig) -> wp.Kernel:
    """Kernel of the second step: light of the environment, and how much of it is hidden, where something is."""
    size = config.count // config.parts
    side = config.side
    _, mask_physical = make_masks(config, size)
    seen_proxy, find_sender = make_seen_proxy(config.distant), make_find_sender(config)

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def sum_light_kernel(
        # In:
        params: wp.array[FrameParams],
        rays: wp.array2d[wp.vec2],
        frame: wp.array2d[wp.vec3ub],
        decode_table: wp.array[wp.vec3],
        scene: RayScene,
        distant: DistantLight,
        directions: wp.array[wp.vec3],
        flux: wp.array[wp.vec3],
        samples: wp.array[EnvironmentSample],
        stride: wp.int32,
        surface: wp.array2d[wp.int32],
        # Out:
        steps_out: Steps,
    ):
        part, i, thread = wp.tid()
        j = cell_column(thread, surface.shape[1], side, WARP_LANES)
        if not any_hit(steps_out.hits, i, j):
            return
        pixel = rays[cell_pixel(i, stride, rays.shape[0]), cell_pixel(j, stride, rays.shape[1])]
        hit = seen_proxy(params[0], pixel, scene, distant.probes)
        begin = part * size
        at = first_of_set(i, j, side, samples.shape[0]) + begin
        physical = mask_physical(scene, distant, directions, samples, at, hit.point, hit.shape)
        met = physical.proxies | physical.balls
        found = wp.uint64(steps_out.hits[part, i, j])
        without = wp.vec3(0.0)
        hidden = wp.vec3(0.0)
        for k in range(at, at + size):
            bit = wp.uint64(1) << wp.uint64(k - at)
            direction = directions[k]
            reach = float(FAR)
            grown = float(1.0)
            if wp.static(config.near):
                toward = sample_toward(samples[k], hit.point)
                direction = toward.direction
                reach = toward.distance
                grown = toward.measure / samples[k].measure
            cosine = wp.min(wp.dot(hit.normal, direction), wp.dot(hit.geometric_normal, direction))
            if cosine > 0.0:
                light = cosine * grown * flux[k]
                if (met & bit) != wp.uint64(0):
                    origin = offset_origin(hit.point, hit.geometric_normal, direction, hit.error)
                    by_proxy = (physical.proxies & bit) != wp.uint64(0)
                    by_ball = (physical.balls & bit) != wp.uint64(0)
                    sender = find_sender(
                        params,
                        frame,
                        decode_table,
                        scene,
                        distant,
                        samples,
                        k,
                        origin,
                        direction,
                        reach,
                        by_proxy,
                        by_ball,
                    )
                    light = cosine * grown * samples[k].measure * sender.radiance
                without += light
                if (found & bit) != wp.uint64(0):
                    hidden += light
        steps_out.sums[2 * part, i, j] = without
        steps_out.sums[2 * part + 1, i, j] = hidden

    return sum_light_kernel


@functools.cache
def make_ask_kernel(config: EnvironmentShadowConfig) -> wp.Kernel:
    """Kernel of the third step: what objects send along the listed rays."""
    asked = round(config.count * config.asking)
    side = config.side
    closest_object = make_trace(config.distant.trace).closest_object
    seen_proxy = make_seen_proxy(config.distant)
    traced = config.bounce == "traced"
    bounced = make_bounced(config.distant) if traced else None
    estimated, look_before = (
        (None, None) if traced else (make_estimated(config.distant), make_look_before(config.distant))
    )

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def ask_kernel(
        # In:
        params: wp.array[FrameParams],
        rays: wp.array2d[wp.vec2],
        frame: wp.array2d[wp.vec3ub],
        decode_table: wp.array[wp.vec3],
        scene: RayScene,
        distant: DistantLight,
        directions: wp.array[wp.vec3],
        samples: wp.array[EnvironmentSample],
        stride: wp.int32,
        columns: wp.int32,
        threads: wp.int32,
        # Out:
        steps_out: Steps,
    ):
        for place in range(wp.tid(), steps_out.listed[0], threads):
            item = steps_out.items[place]
            i = item / CHUNK / columns
            j = item / CHUNK % columns
            index = first_of_set(i, j, side, samples.shape[0]) + item % CHUNK
            row = cell_pixel(i, stride, rays.shape[0])
            column = cell_pixel(j, stride, rays.shape[1])
            hit = seen_proxy(params[0], rays[row, column], scene, distant.probes)
            direction = directions[index]
            measure = samples[index].measure
            if wp.static(config.near):
                toward = sample_toward(samples[index], hit.point)
                direction = toward.direction
                measure = toward.measure
            cosine = wp.min(wp.dot(hit.normal, direction), wp.dot(hit.geometric_normal, direction))
            origin = offset_origin(hit.point, hit.geometric_normal, direction, hit.error)
            sent = wp.vec3(0.0)
            returned = wp.vec3(0.0)
            # What is nearer than all that is physical is nearest.
            other = closest_object(scene, origin, direction, FAR)
            if other.shape >= 0:
                stands_for = cosine * measure * wp.static(config.count / asked)
                alpha = caustic_alpha(scene.objects[other.shape], hit.point)
                if wp.static(traced):
                    seed = pcg3d_hash(wp.uint32(index), wp.uint32(row), wp.uint32(column))
                    sent = stands_for * bounced(
                        params[0], frame, decode_table, scene, distant, other, direction, alpha, seed
                    )
                else:
                    before = look_before(distant, hit.geometric_normal, direction)
                    light = estimated(scene, distant, other, direction, alpha, before.up, before.from_desk)
                    stands_for *= wp.min(before.brightest / wp.max(wp.max(light.distant + light.desk), 1.0e-20), 1.0)
                    sent = stands_for * light.distant
                    returned = stands_for * light.desk
            steps_out.sent[0, place] = sent
            if wp.static(not traced):
                steps_out.sent[1, place] = returned

    return ask_kernel


@functools.cache
def make_join_steps_kernel(config: EnvironmentShadowConfig) -> wp.Kernel:
    """Kernel of the last step: estimates of the cells from which something is hidden."""
    size = config.count // config.parts
    asked = round(config.count * config.asking)
    traced = config.bounce == "traced"

    @wp.kernel(module="unique", enable_backward=False)
    def join_steps_kernel(
        # In:
        params: wp.array[FrameParams],
        steps: Steps,
        # Out:
        ratio_out: wp.array2d[wp.vec4],
        bounced_out: wp.array2d[wp.vec3],
        shaded_out: wp.array2d[wp.int32],
    ):
        """Sums in the order of the samples, wherever their threads put them: the same bits in every run."""
        i, j = wp.tid()
        if not any_hit(steps.hits, i, j):
            return
        without = wp.vec3(0.0)
        hidden = wp.vec3(0.0)
        sent = wp.vec3(0.0)
        returned = wp.vec3(0.0)
        for part in range(steps.hits.shape[0]):
            without += steps.sums[2 * part, i, j]
            hidden += steps.sums[2 * part + 1, i, j]
            found = steps.hits[part, i, j]
            place = steps.starts[part, i, j]
            for k in range(part * size, wp.min((part + 1) * size, asked)):
                if (found & (wp.uint32(1) << wp.uint32(k - part * size))) != wp.uint32(0):
                    sent += steps.sent[0, place]
                    if wp.static(not traced):
                        returned += steps.sent[1, place]
                    place += 1
        unchanged = hidden + sent == wp.vec3(0.0, 0.0, 0.0)
        if shaded_out.shape[0] > 0 and not unchanged:
            shaded_out[i / SHADED_TILE, j / SHADED_TILE] = params[0].frame_index
        ratio_out[i, j] = ratio_of(without, hidden, ratio_out[i, j][3])
        bounced_out[i, j] = bounced_of(without, hidden, sent, returned)

    return join_steps_kernel


@wp.func
def any_shaded(shaded: wp.array2d[wp.int32], frame_index: wp.int32, rows: wp.vec2i, columns: wp.vec2i) -> wp.bool:
    """Whether a tile of cells from the first to the last row and column is noted in this frame."""
    for a in range(wp.max(rows[0], 0) / SHADED_TILE, wp.min(rows[1] / SHADED_TILE + 1, shaded.shape[0])):
        for b in range(wp.max(columns[0], 0) / SHADED_TILE, wp.min(columns[1] / SHADED_TILE + 1, shaded.shape[1])):
            if shaded[a, b] == frame_index:
                return True
    return False


def window_weight(offset: int, reach: int) -> float:
    """Of a cell in a window around another: whole inside, half at its edge, nothing beyond."""
    distance = abs(offset)
    return 1.0 if distance < max(reach, 1) else 0.5 if distance == reach else 0.0


@functools.cache
def make_filter_ratio_kernel(side: int) -> wp.Kernel:
    """Kernel of ``filter_ratio`` for tiles of so many cells along."""
    wide, narrow = side // 2, side // 4
    width = 2 * wide + 1
    wide_weights = tuple(window_weight(a - wide, wide) for a in range(width))
    narrow_weights = tuple(window_weight(a - wide, narrow) for a in range(width))

    @wp.kernel(module="unique", enable_backward=False)
    def filter_ratio_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        shaded: wp.array2d[wp.int32],
        ratio: wp.array2d[wp.vec4],
        bounced: wp.array2d[wp.vec3],
        surface: wp.array2d[wp.int32],
        # Out:
        filtered_out: wp.array2d[wp.vec3],
        seen_out: wp.array2d[wp.int32],
    ):
        """Mean over neighbours on the same surface: one tile's worth, or a quarter of it where that differs.

        What is hidden decides: what objects bounce is too noisy to tell.
        """
        i, j = wp.tid()
        i += row_start
        key = surface[i, j]
        if key < 0:
            return
        if shaded.shape[0] > 0:
            rows = wp.vec2i(i - wp.static(wide), i + wp.static(wide))
            if not any_shaded(shaded, params[0].frame_index, rows, wp.vec2i(j - wp.static(wide), j + wp.static(wide))):
                filtered_out[i, j] = wp.vec3(1.0, 1.0, 1.0)
                return
        depth = ratio[i, j][3]
        # Means of all neighbours, and of the nearer ones; the fourth component sums the weights.
        far_left = wp.vec4(0.0)
        near_left = wp.vec4(0.0)
        squares = wp.vec4(0.0)
        far_sent = wp.vec3(0.0)
        near_sent = wp.vec3(0.0)
        for a in range(wp.static(width)):
            ni = i + a - wp.static(wide)
            for b in range(wp.static(width)):
                nj = j + b - wp.static(wide)
                if ni >= 0 and nj >= 0 and ni < surface.shape[0] and nj < surface.shape[1]:
                    if surface[ni, nj] == key:
                        value = ratio[ni, nj]
                        # A mesh has no faces to tell apart: neighbours much nearer or farther are another part of it.
                        if key % FACES != MESH_KEY or wp.abs(value[3] - depth) <= DEPTH_STEP * depth:
                            value[3] = 1.0
                            far_left += wp.static(wide_weights[a] * wide_weights[b]) * value
                            if wp.static(narrow_weights[a] * narrow_weights[b] > 0.0):
                                near_left += wp.static(narrow_weights[a] * narrow_weights[b]) * value
                                squares += wp.static(narrow_weights[a] * narrow_weights[b]) * wp.cw_mul(value, value)
                            sent = bounced[ni, nj]
                            far_sent += wp.static(wide_weights[a] * wide_weights[b]) * sent
                            if wp.static(narrow_weights[a] * narrow_weights[b] > 0.0):
                                near_sent += wp.static(narrow_weights[a] * narrow_weights[b]) * sent
        left = wp.vec3(far_left[0], far_left[1], far_left[2]) / far_left[3]
        mean = left + far_sent / far_left[3]
        if wp.static(wide > 1):
            sharp = wp.vec3(near_left[0], near_left[1], near_left[2]) / near_left[3]
            # Cells that differ among themselves are noise, or the middle of an edge, where both means agree.
            count = near_left[3]
            spread = wp.vec3(squares[0], squares[1], squares[2]) / count - wp.cw_mul(sharp, sharp)
            error = wp.sqrt(wp.max(wp.max(spread), 0.0) / count)
            share = wp.clamp(wp.max(wp.abs(sharp - left)) / wp.max(CONTRAST, NOISE * error) - 0.5, 0.0, 1.0)
            mean += share * (sharp + near_sent / near_left[3] - mean)
        if wp.max(wp.abs(mean - wp.vec3(1.0, 1.0, 1.0))) < NEGLIGIBLE:
            mean = wp.vec3(1.0, 1.0, 1.0)
        elif seen_out.shape[0] > 0:
            seen_out[i / SHADED_TILE, j / SHADED_TILE] = params[0].frame_index
        filtered_out[i, j] = mean

    return filter_ratio_kernel


@functools.cache
def make_spread_ratio_kernel(config: DistantLightConfig) -> wp.Kernel:
    """Kernel of ``spread_ratio``, specialised to ``config``."""
    seen_proxy = make_seen_proxy(config)

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def spread_ratio_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        rays: wp.array2d[wp.vec2],
        scene: RayScene,
        probes: wp.array[Probe],
        filtered: wp.array2d[wp.vec3],
        surface: wp.array2d[wp.int32],
        seen: wp.array2d[wp.int32],
        stride: wp.int32,
        run: wp.int32,
        # Out:
        physical_ratio_out: wp.array2d[wp.vec3],
    ):
        """From cells to pixels: bilinear among the cells on the pixel's surface."""
        i, part = wp.tid()
        i += row_start
        begin = part * run
        stop = wp.min(begin + run, physical_ratio_out.shape[1])
        rect = params[0].shadow_rect
        # Cell c was estimated at pixel c * stride + stride / 2.
        y = wp.float32(i - stride / 2) / wp.float32(stride)
        row = wp.int32(wp.floor(y))
        columns = wp.vec2i(begin / stride - 2, stop / stride + 2)  # as far as a pixel looks for its surface
        touched = seen.shape[0] == 0
        if not touched:
            touched = any_shaded(seen, params[0].frame_index, wp.vec2i(row - 1, row + 2), columns)
        for j in range(begin, stop):
            value = wp.vec3(1.0, 1.0, 1.0)
            if touched and inside_rect(i, j, rect):
                x = wp.float32(j - stride / 2) / wp.float32(stride)
                column = wp.int32(wp.floor(x))
                key = surface[wp.clamp(row, 0, surface.shape[0] - 1), wp.clamp(column, 0, surface.shape[1] - 1)]
                mixed = wp.bool(False)
                for corner in range(1, 4):
                    ni = wp.clamp(row + corner / 2, 0, surface.shape[0] - 1)
                    nj = wp.clamp(column + corner % 2, 0, surface.shape[1] - 1)
                    mixed = mixed or surface[ni, nj] != key
                if mixed:
                    hit = seen_proxy(params[0], rays[i, j], scene, probes)
                    key = wp.int32(-1)
                    if hit.shape >= 0:
                        key = surface_key(scene.proxies[hit.shape], hit.shape, hit.geometric_normal)
                if key >= 0:
                    total = wp.vec3(0.0)
                    weights = float(0.0)
                    for corner in range(4):
                        ni = wp.clamp(row + corner / 2, 0, surface.shape[0] - 1)
                        nj = wp.clamp(column + corner % 2, 0, surface.shape[1] - 1)
                        weight = 1.0 - wp.abs(y - wp.float32(row + corner / 2))
                        weight *= 1.0 - wp.abs(x - wp.float32(column + corner % 2))
                        if weight > 0.0 and surface[ni, nj] == key:
                            total += weight * filtered[ni, nj]
                            weights += weight
                    if weights == 0.0:
                        # None of the four is on this surface: those around them.
                        for a in range(wp.max(row - 1, 0), wp.min(row + 3, surface.shape[0])):
                            for b in range(wp.max(column - 1, 0), wp.min(column + 3, surface.shape[1])):
                                if surface[a, b] == key:
                                    total += filtered[a, b]
                                    weights += 1.0
                    if weights > 0.0:
                        value = total / weights
            physical_ratio_out[i, j] = value

    return spread_ratio_kernel


def shade_environment(
    config: EnvironmentShadowConfig,
    params: wp.array[FrameParams],
    rays: wp.array2d[wp.vec2],
    frame: wp.array2d[wp.vec3ub],
    decode_table: wp.array[wp.vec3],
    scene: RayScene,
    distant: DistantLight,
    directions: wp.array[wp.vec3],
    flux: wp.array[wp.vec3],
    samples: wp.array[EnvironmentSample],
    stride: int,
    ratio_out: wp.array2d[wp.vec4],
    bounced_out: wp.array2d[wp.vec3],
    surface_out: wp.array2d[wp.int32],
    *,
    shaded_out: wp.array2d[wp.int32] | None = None,
    sums_out: wp.array3d[wp.vec3] | None = None,
    steps: Steps | None = None,
    rows: Rows | None = None,
) -> None:
    """Estimate the ratio for one pixel of every ``stride x stride``, each with one set of samples.

    Args:
        config: What the scene calls for.
        params: (1,) FrameParams: camera and shadow_rect.
        rays: (H, W) undistorted (x / z, y / z) of each pixel's centre.
        frame: (H, W) the camera's frame, RGB; needed if bounces are traced.
        decode_table: (256,) of ``color.decode_table``.
        scene: Objects and proxies.
        distant: The environment; what ``config.environment`` leaves out may be empty.
        directions: (config.side^2 * n,) directions of the samples, set after set; n is config.count or more.
        flux: (the same) radiance times solid angle of the samples.
        samples: (the same) the samples.
        stride: Pixels from one estimate to the next.
        ratio_out: (ceil(H / stride), ceil(W / stride)) RGB share of the environment that is not hidden, and depth.
        bounced_out: (the same) what objects send there, relative to the environment.
        surface_out: (the same) number of the surface seen; -1 for none, where ratio_out holds nothing.
        shaded_out: ``shaded_shape`` of that: number of the last frame in which something in a tile of cells was shaded.
        sums_out: Scratch of ``sums_shape``; needed if ``config.parts`` is not 1, and then ``rows`` must be None.
        steps: Scratch of ``make_steps``: do it in steps; ``rows`` must be None, and ``sums_out`` is not needed.
        rows: Band of rows of the outputs; None means all.
    """
    if steps is not None:
        seen = [params, rays]
        light = [frame, decode_table, scene, distant, directions]
        threads = min(steps.items.shape[0], ASKING_THREADS)
        cells = steps.hits.shape
        device = rays.device
        steps.listed.zero_()
        launch(
            make_find_hits_kernel(config),
            cells,
            [*seen, scene, distant, directions, samples, stride],
            [ratio_out, bounced_out, surface_out, steps],
            device=device,
        )
        launch(
            make_sum_light_kernel(config),
            cells,
            [*seen, *light, flux, samples, stride, surface_out],
            [steps],
            device=device,
        )
        launch(
            make_ask_kernel(config),
            threads,
            [*seen, *light, samples, stride, cells[2], threads],
            [steps],
            device=device,
        )
        launch(
            make_join_steps_kernel(config),
            cells[1:],
            [params, steps],
            [ratio_out, bounced_out, shaded_out],
            device=device,
        )
        return
    lanes = 1 if rays.device.is_cpu else WARP_LANES
    cells = ratio_out.shape
    launch_rows(
        make_environment_shadow_kernel(config),
        (cells[0] * config.parts, cells[1]),
        [params, rays, frame, decode_table, scene, distant, directions, flux, samples, stride, lanes],
        [ratio_out, bounced_out, surface_out, shaded_out, sums_out],
        rows=rows,
        device=rays.device,
    )
    if config.parts > 1:
        launch(join_parts_kernel, cells, [surface_out, sums_out], [ratio_out, bounced_out], device=rays.device)


def count_parts(rows: int, columns: int, most: int = MAX_PARTS) -> int:
    """Threads of a CUDA device per cell: as many as it takes to fill it, up to ``most``, a power of 2."""
    parts = most
    while parts > 1 and parts * rows * columns > ENOUGH_THREADS:
        parts //= 2
    return parts


def make_steps(config: EnvironmentShadowConfig, rows: int, columns: int, device: wp.DeviceLike) -> Steps | None:
    """Scratch of ``shade_environment`` for cells in steps; None where it needs more than a set, or too much.

    Args:
        config: As for ``shade_environment``; ``config.parts`` at least 2, as one part's samples are the bits of a word.
        rows: Rows of cells.
        columns: Cells in a row.
        device: Where.
    """
    items = rows * columns * round(config.count * config.asking)
    if config.count > CHUNK or config.count // config.parts > WORD or items > MOST_ITEMS:
        return None
    cells = config.parts, rows, columns
    steps = Steps()
    steps.hits, steps.starts = (wp.empty(cells, dtype=kind, device=device) for kind in (wp.uint32, wp.int32))
    steps.items, steps.listed = wp.empty(items, dtype=wp.int32, device=device), wp.zeros(1, wp.int32, device=device)
    steps.sums = wp.empty((2 * cells[0], *cells[1:]), dtype=wp.vec3, device=device)
    steps.sent = wp.empty((1 if config.bounce == "traced" else 2, items), dtype=wp.vec3, device=device)
    return steps


def sums_shape(parts: int, rows: int, columns: int) -> tuple[int, int, int]:
    """Shape of the array that holds the sums of all parts of so many cells."""
    return parts * int(KINDS), rows, columns


def shaded_shape(rows: int, columns: int) -> tuple[int, int]:
    """Shape of the array that notes shaded tiles, for so many cells."""
    return -(-rows // int(SHADED_TILE)), -(-columns // int(SHADED_TILE))


def filter_ratio(
    ratio: wp.array2d[wp.vec4],
    bounced: wp.array2d[wp.vec3],
    surface: wp.array2d[wp.int32],
    side: int,
    filtered_out: wp.array2d[wp.vec3],
    *,
    params: wp.array[FrameParams] | None = None,
    shaded: wp.array2d[wp.int32] | None = None,
    seen_out: wp.array2d[wp.int32] | None = None,
    rows: Rows | None = None,
) -> None:
    """Average the estimates over tiles, along surfaces only; exactly 1 where nothing is shaded, or next to nothing.

    Args:
        ratio: From ``shade_environment``.
        bounced: From ``shade_environment``.
        surface: From ``shade_environment``.
        side: Cells along a tile.
        filtered_out: As ``ratio``, without the depth; written only where a surface is seen.
        params: (1,) FrameParams: frame_index; needed with ``shaded`` and ``seen_out``.
        shaded: From ``shade_environment``; where it is left out every cell is averaged.
        seen_out: As ``shaded``: number of the last frame in which something in a tile of cells is not 1.
        rows: Band of rows; None means all.
    """
    launch_rows(
        make_filter_ratio_kernel(side),
        surface.shape,
        [params, shaded, ratio, bounced, surface],
        [filtered_out, seen_out],
        rows=rows,
        device=surface.device,
    )


def spread_ratio(
    config: DistantLightConfig,
    params: wp.array[FrameParams],
    rays: wp.array2d[wp.vec2],
    scene: RayScene,
    probes: wp.array[Probe],
    filtered: wp.array2d[wp.vec3],
    surface: wp.array2d[wp.int32],
    stride: int,
    physical_ratio_out: wp.array2d[wp.vec3],
    *,
    seen: wp.array2d[wp.int32] | None = None,
    rows: Rows | None = None,
) -> None:
    """Give every pixel its ratio.

    A pixel between cells of several surfaces looks for its own.

    Args:
        config: Kinds of proxies, and whether there are mirror balls.
        params: (1,) FrameParams: camera, shadow_rect, frame_index.
        rays: (H, W) undistorted (x / z, y / z) of each pixel's centre.
        scene: Proxies.
        probes: Mirror balls; needed if ``config.probes``.
        filtered: From ``filter_ratio``.
        surface: From ``shade_environment``.
        stride: Pixels per cell.
        physical_ratio_out: (H, W) factor on the frame; 1 outside the rectangle and where no proxy is seen.
        seen: From ``filter_ratio``; where it is left out every pixel is looked at.
        rows: Band of rows; None means all.
    """
    height, width = physical_ratio_out.shape
    run = CPU_RUN if rays.device.is_cpu else 1
    if run == 1:
        seen = None  # to look costs a thread as much as its pixel does
    launch_rows(
        make_spread_ratio_kernel(config),
        (height, -(-width // run)),
        [params, rays, scene, probes, filtered, surface, seen, stride, run],
        [physical_ratio_out],
        rows=rows,
        device=surface.device,
    )
