"""Shading of virtual objects: lit by the environment and by virtual lights, with anti-aliased edges.

The result is premultiplied: RGB is radiance times coverage, alpha the share of the pixel that virtual objects cover.

Edges. Inside a surface one sample per pixel suffices. A pixel is an edge if a neighbour shows another object, a point
farther from the tangent plane than two pixel footprints, or a normal that differs by more than 30 degrees. It is then
traced again with n^2 samples and averaged (by a box filter, like that of a camera's pixels). The samples are n-rooks
along both axes, for n = 2 the rotated grid: no two share a row or column, so nearly vertical and nearly horizontal
edges get n^2 shades, not n. A sample uses the near field of the pixel around it whose normal is most similar.

Normals. Surfaces are two-sided: normals are turned toward the viewer. At a silhouette an interpolated normal can still
point away. It is then tilted until it is perpendicular to the view, which is continuous, so that the mirror direction
leaves the surface.
"""

from __future__ import annotations

import dataclasses
import functools
import math

import warp as wp

from warp_ar.kernels.edges import EdgeList, EdgeLists, holds_all, list_edge, listed_edges, sample_listed_edges
from warp_ar.kernels.launch import MOST_REGISTERS, Rows, launch_rows
from warp_ar.kernels.materials import Surface, lobe_axis, make_reflect_direct, make_surface, reflect, specular_occlusion
from warp_ar.kernels.objects.near_field import NearLight
from warp_ar.kernels.objects.reflect import (
    DiffuseForm,
    DistantLight,
    DistantLightConfig,
    knows_levels,
    make_distant_irradiance,
    make_reflected_radiance,
)
from warp_ar.kernels.rays.area_lights import (
    POINT_SAMPLES,
    lobe_solid_angle,
    looks_by_lobe,
    make_area_count,
    make_area_reflection,
    make_area_sample,
    without_lobe,
)
from warp_ar.kernels.rays.shadow import (
    ALL_LIGHTS,
    LightSample,
    make_sample_light,
    make_shadow,
    make_visible_share,
    tile_turn,
)
from warp_ar.kernels.rays.visibility import (
    VisibleObjects,
    check_edge_samples,
    inside_rect,
    make_primary,
    make_sample_direction,
)
from warp_ar.kernels.structs import FrameParams, Hit, Light, RayScene, filled

wp.set_module_options({"enable_backward": False})

# Distance from the tangent plane, in pixel footprints, beyond which a neighbour belongs to another surface.
EDGE_FOOTPRINTS = wp.constant(wp.float32(2.0))
# Cosine of the turn between neighbouring normals that counts as an edge.
EDGE_COSINE = wp.constant(wp.float32(math.cos(math.radians(30.0))))
# Smallest cosine between shading normal and viewer.
MIN_FACING = wp.constant(wp.float32(1.0e-3))

ALONE = wp.constant(-1)
"""Number that stands for the single sample, at the centre, of a pixel without an edge."""
SAMPLED, LISTED, LEFT = "sampled", "listed", "left"
"""Treatments of edges by a kernel: sampled, listed for another kernel, or sampled if the list overflowed."""


@dataclasses.dataclass(frozen=True)
class ShadeConfig:
    """Compile-time configuration: features that a scene needs."""

    distant: DistantLightConfig
    """Kinds of shape, of material and of the environment."""
    lights: tuple[int, ...]
    """Sorted kinds of virtual light that exist."""
    edge_samples: int
    """Samples per pixel along edges: a square number; 1 leaves edges hard."""
    soft: bool = False
    """True if lights with a radius cast soft shadows."""
    near_field: bool = False
    """True if objects receive light from the near field (``near_field``)."""
    area_samples: int = 0
    """Samples of emitting objects per point; ``area_lights.POINT_SAMPLES``: they are point lights; 0: none emits."""

    def general(self, form: DiffuseForm, *, soft: bool) -> ShadeConfig:
        """Return this configuration with the code that any scene needs, and soft shadows if ``soft``.

        ``form`` is the form of irradiance for scenes that need it.
        """
        distant = self.distant.general(form)
        return dataclasses.replace(self, distant=distant, lights=ALL_LIGHTS, soft=soft)

    def __post_init__(self) -> None:
        check_edge_samples(self.edge_samples)


@wp.struct
class ObjectLight:
    """Light on virtual objects; parts that a ``ShadeConfig`` does not use may be empty."""

    lights: wp.array[Light]
    distant: DistantLight  # its ``environment`` and ``probes`` are not read
    near: NearLight  # from ``filter_near_field``


def make_object_light(
    distant: DistantLight, lights: wp.array | None = None, near: NearLight | None = None
) -> ObjectLight:
    """Return an ``ObjectLight`` of the environment, virtual lights and the near field.

    Args:
        distant: Light of the environment, see ``reflect.DistantLight``.
        lights: (n,) Light; None without virtual lights.
        near: (H, W) each, from ``near_field.filter_near_field``; None if objects reflect the environment alone.
    """
    return filled(ObjectLight(), distant=distant, lights=lights, near=near)


@wp.struct
class NearPoint:
    """Near field at a point of an object."""

    known: wp.bool  # False: the point is lit by the distant environment alone
    irradiance: wp.vec3
    reflected: wp.vec4  # radiance added to the prefiltered environment, and the share of the latter that it replaces


@wp.func
def face_viewer(normal: wp.vec3, geometric_normal: wp.vec3, wo: wp.vec3):
    """Return both normals of a surface, turned toward the viewer; the shading normal has a cosine >= ``MIN_FACING``."""
    shading = normal
    geometric = geometric_normal
    if wp.dot(geometric, wo) < 0.0:
        shading = -shading
        geometric = -geometric
    facing = wp.dot(shading, wo)
    if facing < MIN_FACING:
        shading = wp.normalize(shading + (MIN_FACING - facing) * wo)
    return shading, geometric


@functools.cache
def make_lit_by_areas(config: ShadeConfig) -> wp.Function:
    """Return the function ``lit_by_areas(scene, hit, surface, normal, geometric, wo, turn) -> vec3``.

    Its result is the radiance toward ``wo`` that the surface reflects of the scene's emitting objects.
    """
    trace, samples = config.distant.trace, config.area_samples
    reflect_direct = make_reflect_direct(config.distant.models)
    is_lit = make_shadow(trace)
    area_count, area_sample = make_area_count(samples), make_area_sample(samples)
    by_rays = samples != POINT_SAMPLES and config.distant.specular
    area_reflection = make_area_reflection(trace, samples) if by_rays else None

    @wp.func(module="unique")
    def lit_by_areas(
        scene: RayScene, hit: Hit, surface: Surface, normal: wp.vec3, geometric: wp.vec3, wo: wp.vec3, turn: wp.float32
    ) -> wp.vec3:
        total = wp.vec3(0.0)
        count = area_count(scene)
        lobe = lobe_solid_angle(surface)
        for k in range(count):
            area = area_sample(scene, hit.point, normal, k, count, turn)
            if wp.max(area.irradiance_normal) > 0.0 and wp.dot(geometric, area.wi) > 0.0:
                lit = surface
                if wp.static(by_rays):
                    if looks_by_lobe(scene.objects[area.object], hit.point, lobe):
                        lit = without_lobe(surface)
                direct = reflect_direct(lit, normal, wo, area.wi)
                if wp.max(direct) > 0.0:
                    light = LightSample()
                    light.wi = area.wi
                    light.distance = area.distance
                    if is_lit(scene, hit.point, geometric, hit.error, light):
                        total += wp.cw_mul(direct, area.irradiance_normal)
        if wp.static(by_rays):
            if count > 0:
                total += area_reflection(scene, hit, surface, normal, geometric, wo, turn)
        return total

    return lit_by_areas


@functools.cache
def make_sent_unlit(config: ShadeConfig) -> wp.Function:
    """Return the function ``sent_unlit(distant, hit, surface, normal, wo, near) -> vec3``.

    Its result is the radiance without virtual lights: emitted light, and reflected light of the environment and of the
    near field ``near``.
    """
    forms = config.distant
    glossy = make_reflected_radiance(forms)
    distant_irradiance = make_distant_irradiance(forms)

    @wp.func(module="unique")
    def sent_unlit(
        distant: DistantLight, hit: Hit, surface: Surface, normal: wp.vec3, wo: wp.vec3, near: NearPoint
    ) -> wp.vec3:
        radiance = wp.vec3(0.0)
        if wp.static(forms.textures):
            radiance = surface.emission
        if wp.static(forms.diffuse != "none"):
            irradiance = distant_irradiance(distant, hit.point, normal)
            share = float(1.0)
            if wp.static(forms.textures):
                share = surface.occlusion
            if wp.static(config.near_field):
                if near.known:
                    # The occlusion texture and near-field rays find the same occluders: use the darker of the two.
                    if share < 1.0:
                        more = wp.max(near.irradiance - irradiance, wp.vec3(0.0))
                        irradiance = wp.min(share * irradiance, near.irradiance) + more
                    else:
                        irradiance = near.irradiance
                    share = 1.0
            irradiance *= share
            radiance += wp.cw_mul(surface.diffuse, irradiance) / wp.pi
        if wp.static(forms.specular):
            glossiness = surface.reflectance[0] + surface.reflectance[1] + surface.reflectance[2]
            if glossiness > 0.0 and knows_levels(distant):
                wi = lobe_axis(surface, reflect(wo, normal), normal)
                reflected = glossy(distant, surface.model, surface.roughness, surface.shininess, hit.point, wi, 0.0)
                if wp.static(config.near_field):
                    if near.known:
                        added = wp.vec3(near.reflected[0], near.reflected[1], near.reflected[2])
                        reflected = (1.0 - near.reflected[3]) * reflected + added
                if wp.static(forms.textures):
                    hidden = 1.0 - specular_occlusion(surface.occlusion, wp.dot(normal, wo), surface.roughness)
                    if wp.static(config.near_field):
                        if near.known:
                            hidden = 0.0  # near-field rays have found the occlusion
                    reflected *= 1.0 - hidden
                radiance += wp.cw_mul(surface.reflectance, reflected)
        return radiance

    return sent_unlit


@functools.cache
def make_shade_hit(config: ShadeConfig) -> wp.Function:
    """Return the function ``shade_hit(...) -> vec3``: radiance from a hit toward the origin of a ray of ``direction``.

    ``direction`` is not unit. ``turn`` is the rotation, in turns, of the pixel's samples of lights;
    ``spread`` is the width of the ray at t = 1, metres.
    """
    forms = config.distant
    surface_at = make_surface(forms.models, forms.textures)
    sent_unlit = make_sent_unlit(config)
    reflect_direct = make_reflect_direct(forms.models)
    sample_light = make_sample_light(config.lights)
    is_lit = make_shadow(forms.trace)
    visible_share = make_visible_share(forms.trace) if config.soft else None
    lit_by_areas = make_lit_by_areas(config) if config.area_samples > 0 else None

    @wp.func(module="unique")
    def shade_hit(
        scene: RayScene,
        lights: wp.array[Light],
        distant: DistantLight,
        hit: Hit,
        direction: wp.vec3,
        near: NearPoint,
        turn: wp.float32,
        spread: wp.float32,
    ) -> wp.vec3:
        wo = -wp.normalize(direction)
        normal, geometric = face_viewer(hit.normal, hit.geometric_normal, wo)
        surface = surface_at(scene, distant.dfg, hit, wp.dot(normal, wo), spread)
        radiance = sent_unlit(distant, hit, surface, normal, wo, near)
        if wp.static(len(config.lights) > 0):
            for index in range(lights.shape[0]):
                light = sample_light(lights[index], hit.point)
                if wp.max(light.irradiance_normal) > 0.0:
                    direct = reflect_direct(surface, normal, wo, light.wi)
                    if wp.max(direct) > 0.0:
                        if wp.static(config.soft):
                            share = visible_share(scene, hit.point, geometric, hit.error, lights[index], light, turn)
                            radiance += share * wp.cw_mul(direct, light.irradiance_normal)
                        else:
                            if is_lit(scene, hit.point, geometric, hit.error, light):
                                radiance += wp.cw_mul(direct, light.irradiance_normal)
        if wp.static(config.area_samples > 0):
            radiance += lit_by_areas(scene, hit, surface, normal, geometric, wo, turn)
        return radiance

    return shade_hit


@wp.func
def differs(
    i: wp.int32, j: wp.int32, found: wp.int32, reach: wp.float32, rect: wp.vec4i, visible: VisibleObjects, hit: Hit
) -> wp.bool:
    """Return whether pixel (i, j) shows another surface than a neighbour, whose hit is ``hit`` of object ``found``.

    ``reach`` is the largest distance, metres, from the tangent plane at ``hit``.
    """
    other = wp.int32(-1)
    if inside_rect(i, j, rect):
        other = visible.objects[i, j]
    if other != found:
        return True
    if found < 0:
        return False
    hits = visible.hits
    if wp.abs(wp.dot(hit.geometric_normal, hits[i, j].point - hit.point)) > reach:
        return True
    return wp.dot(hit.normal, hits[i, j].normal) < EDGE_COSINE


@wp.func
def most_alike(visible: VisibleObjects, i: wp.int32, j: wp.int32, hit: Hit) -> wp.vec2i:
    """Return (row, column) of the pixel around (i, j), of nine, whose normal is most similar to a hit's.

    Among equal normals the nearest pixel is returned. The result is (-1, -1) if none shows the hit's object.
    """
    objects = visible.objects
    hits = visible.hits
    found = wp.vec2i(-1, -1)
    best = float(-2.0)
    for a in range(-1, 2):
        for b in range(-1, 2):
            row = i + a
            column = j + b
            if row >= 0 and column >= 0 and row < objects.shape[0] and column < objects.shape[1]:
                if objects[row, column] == hit.shape:
                    likeness = wp.dot(hits[row, column].normal, hit.normal) - 1.0e-3 * wp.float32(a * a + b * b)
                    if likeness > best:
                        best = likeness
                        found = wp.vec2i(row, column)
    return found


@functools.cache
def make_shade_sample(config: ShadeConfig) -> wp.Function:
    """Return the function ``shade_sample(...) -> vec4``: radiance and coverage of one sample of a pixel.

    For the sample number ``ALONE`` it shades the hit ``centre`` without tracing a ray.
    """
    shade_hit = make_shade_hit(config)
    closest_visible = make_primary(config.distant.trace)
    centre_direction, sample_direction = make_sample_direction(1), make_sample_direction(config.edge_samples)

    @wp.func(module="unique")
    def shade_sample(
        params: wp.array[FrameParams],
        rays: wp.array2d[wp.vec2],
        scene: RayScene,
        light: ObjectLight,
        visible: VisibleObjects,
        pixel: wp.vec2i,
        sample: wp.int32,
        centre: Hit,
    ) -> wp.vec4:
        i, j = pixel[0], pixel[1]
        alone = sample == ALONE
        direction = centre_direction(params, rays[i, j], 0)
        hit = centre
        if wp.static(config.edge_samples > 1):
            if not alone:
                direction = sample_direction(params, rays[i, j], sample)
                hit = closest_visible(scene, params[0].camera_position, direction)
        if hit.shape < 0:
            return wp.vec4(0.0)
        point = NearPoint()
        if wp.static(config.near_field):
            alike = pixel
            if not alone:
                alike = most_alike(visible, i, j, hit)
            point.known = alike[0] >= 0
            if point.known:
                if wp.static(config.distant.diffuse != "none"):
                    if light.near.irradiance.shape[0] > 0:
                        point.irradiance = light.near.irradiance[alike[0], alike[1]]
                if wp.static(config.distant.specular):
                    if light.near.reflected.shape[0] > 0:
                        point.reflected = light.near.reflected[alike[0], alike[1]]
        spread = scene.pixel_spread
        radiance = shade_hit(scene, light.lights, light.distant, hit, direction, point, tile_turn(i, j), spread)
        return wp.vec4(radiance[0], radiance[1], radiance[2], 1.0)

    return shade_sample


@functools.cache
def make_shade_kernel(config: ShadeConfig, edges: str = SAMPLED) -> wp.Kernel:
    """Return the kernel of ``shade``, specialised to ``config`` and to the treatment of edges.

    Args:
        config: Features of the scene.
        edges: ``SAMPLED``: this kernel samples edges. ``LISTED``: it lists edges for another kernel. ``LEFT``: it
            samples all edges if the list did not hold all of them, else none. (The edges that a full list holds depend
            on the order of threads, and kernels that are compiled separately differ in the last place.)
    """
    shade_sample = make_shade_sample(config)

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def shade_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        rays: wp.array2d[wp.vec2],
        scene: RayScene,
        light: ObjectLight,
        visible: VisibleObjects,
        # Out:
        virtual_out: wp.array2d[wp.vec4],
        list_out: EdgeList,
    ):
        i, j = wp.tid()
        if wp.static(edges == LEFT):
            if holds_all(list_out):
                return
        result = wp.vec4(0.0)
        samples = wp.int32(0)
        rect = params[0].object_rect
        i += row_start
        if inside_rect(i, j, rect):
            found = visible.objects[i, j]
            hit = Hit()
            if found >= 0:
                hit = visible.hits[i, j]
            samples = wp.where(found >= 0, 1, 0)
            if wp.static(config.edge_samples > 1):
                reach = EDGE_FOOTPRINTS * hit.t / params[0].focal[0]
                for k in range(4):
                    row = i + wp.where(k == 0, -1, 0) + wp.where(k == 1, 1, 0)
                    column = j + wp.where(k == 2, -1, 0) + wp.where(k == 3, 1, 0)
                    if differs(row, column, found, reach, rect, visible, hit):
                        samples = wp.static(config.edge_samples)
            if wp.static(edges == LISTED):
                if samples > 1:
                    list_edge(i, j, list_out)
                    return
            pixel = wp.vec2i(i, j)
            for number in range(samples):
                sample = wp.where(wp.static(edges == LISTED) or samples == 1, ALONE, number)
                result += shade_sample(params, rays, scene, light, visible, pixel, sample, hit)
            if samples > 1:
                result = result / wp.float32(samples)
        if wp.static(edges == LEFT):
            if samples <= 1:
                return
        virtual_out[i, j] = result

    return shade_kernel


@functools.cache
def make_sample_edges_kernel(config: ShadeConfig) -> wp.Kernel:
    """Return a kernel that shades every sample of the listed edge pixels."""
    shade_sample = make_shade_sample(config)

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def sample_edges_kernel(
        # In:
        threads: wp.int32,
        params: wp.array[FrameParams],
        rays: wp.array2d[wp.vec2],
        scene: RayScene,
        light: ObjectLight,
        visible: VisibleObjects,
        listed: EdgeList,
        # Out:
        samples_out: wp.array[wp.vec4],
    ):
        item = wp.tid()
        stop = listed_edges(listed) * wp.static(config.edge_samples)
        while item < stop:
            pixel = listed.edges[item / wp.static(config.edge_samples)]
            sample = item % wp.static(config.edge_samples)
            samples_out[item] = shade_sample(params, rays, scene, light, visible, pixel, sample, Hit())
            item += threads

    return sample_edges_kernel


def shade(
    config: ShadeConfig,
    params: wp.array[FrameParams],
    rays: wp.array2d[wp.vec2],
    scene: RayScene,
    light: ObjectLight,
    visible: VisibleObjects,
    virtual_out: wp.array2d[wp.vec4],
    *,
    edge_lists: EdgeLists | None = None,
    rows: Rows | None = None,
) -> None:
    """Shade the objects that ``trace_pixels`` found.

    If ``edge_lists`` is given, edges are listed and then sampled in a separate kernel. Results differ in the last bits
    at most, where CUDA's compiler fuses a product and a sum in only one of the kernels.

    Args:
        config: Features of the scene; arguments that it does not use may be None.
        params: (1,) FrameParams: camera and object_rect.
        rays: (H, W) undistorted x / z and y / z of each pixel centre.
        scene: Shapes, materials and textures.
        light: From ``make_object_light``; its near field is needed if ``config.near_field``.
        visible: (H, W) from ``trace_pixels``.
        virtual_out: (H, W) premultiplied linear RGB and coverage; zero outside ``params.object_rect``.
        edge_lists: Scratch memory, for a launch over all rows.
        rows: Band of rows; None means all.
    """
    inputs = [params, rays, scene, light, visible]
    device = rays.device
    if edge_lists is None or config.edge_samples == 1:
        launch_rows(make_shade_kernel(config), rays.shape, inputs, [virtual_out, EdgeList()], rows=rows, device=device)
        return
    edge_lists.listed.count.zero_()
    outputs = [virtual_out, edge_lists.listed]
    for kernel in (make_shade_kernel(config, LISTED), make_shade_kernel(config, LEFT)):
        launch_rows(kernel, rays.shape, inputs, outputs, rows=rows)
    sample_listed_edges(
        make_sample_edges_kernel(config), inputs, edge_lists, config.edge_samples, virtual_out, weighted=False
    )
