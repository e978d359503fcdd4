"""Radiance along a ray that leaves a surface: of the receiver in the frame, of virtual objects, of the environment.

The receiver's radiance is known from two sources: the environment, as seen from the mirror ball, and the camera's
frame, whose points the proxies place in space. Near an object the two differ by parallax, so a ray that meets a proxy
uses the frame. The environment is used for points outside the frame, on faces turned away from the camera, or hidden
from it by a proxy or a ball. Proxies are taken to be matt: their radiance toward the camera and toward the ray is the
same. Emitters of the environment whose positions are known appear, and light objects, from those positions
(``emitters``). The light of several mirror balls is interpolated (see ``probe_weights``).
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Literal

import warp as wp

from warp_ar.kernels.camera import project
from warp_ar.kernels.emitters import correct_parallax
from warp_ar.kernels.environment.interpolated_irradiance import OtherBalls, make_irradiance_at
from warp_ar.kernels.environment.lobes import (
    level_from_alpha,
    level_from_roughness,
    level_from_shininess,
    sample_levels,
)
from warp_ar.kernels.environment.probe_weights import probe_weight
from warp_ar.kernels.latlong import sample_latlong
from warp_ar.kernels.materials import lobe_axis, make_surface, reflect, specular_occlusion
from warp_ar.kernels.pixels import shown_radiance
from warp_ar.kernels.rays.trace import TraceConfig, make_trace, meets_probe
from warp_ar.kernels.structs import (
    LAMBERT,
    METALLIC_ROUGHNESS,
    MIRROR,
    PHONG,
    Emitter,
    FrameParams,
    Hit,
    Picture,
    Probe,
    RayScene,
)

wp.set_module_options({"enable_backward": False})

HIDDEN_MARGIN = wp.constant(wp.float32(1.0e-3))
"""Relative distance before a point, on the camera's ray, within which a proxy counts as the point's own surface."""
RAY_SPREAD = wp.constant(wp.float32(0.1))
"""Angle, radians, that each of a few dozen rays represents: width of look-ups in textures that the ray meets."""

DiffuseForm = Literal["none", "sh", "map"]


@dataclasses.dataclass(frozen=True)
class DistantLightConfig:
    """Forms of the environment, and features of the objects that reflect it."""

    trace: TraceConfig
    """Kinds of shape."""
    models: tuple[int, ...]
    """Sorted material models of the objects."""
    textures: bool
    """True if any material has a texture or emits, or any object's triangles have materials of their own."""
    diffuse: DiffuseForm
    """Form of the environment's irradiance: nine coefficients, a latlong map, or none."""
    specular: bool
    """True if the prefiltered environment is read."""
    known: bool
    """True if the environment is known, from mirror balls or from a file."""
    emitters: bool = False
    """True if positions of the environment's emitters are known."""
    several: bool = False
    """True if the light is interpolated between several mirror balls."""
    gathered: bool = True
    """True if rays that meet an emitting object return its light; False if ``area_lights`` adds it."""

    def general(self, form: DiffuseForm) -> DistantLightConfig:
        """Return this configuration with the code that any scene needs; forms of light that a scene lacks may be empty.

        Args:
            form: Form of irradiance for scenes that need it.
        """
        models = tuple(sorted(map(int, (LAMBERT, PHONG, MIRROR, METALLIC_ROUGHNESS))))
        diffuse: DiffuseForm = form if self.known else "none"
        trace = self.trace.general()
        return dataclasses.replace(self, trace=trace, models=models, diffuse=diffuse, specular=self.known)


@wp.struct
class DistantLight:
    """The environment in all its forms; forms that a ``DistantLightConfig`` does not use may be empty."""

    environment: wp.array2d[wp.vec3]
    irradiance_sh: wp.array[wp.vec3]  # nine coefficients
    irradiance_map: wp.array2d[wp.vec3]  # latlong
    levels: wp.array[wp.vec3]  # prefiltered, as ``sample_levels`` reads them
    level_height: wp.int32  # rows of level 0
    dfg: wp.array2d[wp.vec2]  # from ``integrate_dfg``, for METALLIC_ROUGHNESS
    probes: wp.array[Probe]
    emitters: wp.array[Emitter]
    others: OtherBalls


@wp.func
def look_up(picture: Picture, x: wp.float32, y: wp.float32) -> wp.vec3:
    """Sample a frame's linear radiance bilinearly at (x, y), pixels, within the outermost pixel centres."""
    j = wp.min(wp.int32(x), picture.frame.shape[1] - 2)
    i = wp.min(wp.int32(y), picture.frame.shape[0] - 2)
    fx = x - wp.float32(j)
    fy = y - wp.float32(i)
    top = (1.0 - fx) * shown_radiance(picture, i, j) + fx * shown_radiance(picture, i, j + 1)
    bottom = (1.0 - fx) * shown_radiance(picture, i + 1, j) + fx * shown_radiance(picture, i + 1, j + 1)
    return (1.0 - fy) * top + fy * bottom


@wp.func
def look_up_layer(layer: wp.array2d[wp.vec3], x: wp.float32, y: wp.float32) -> wp.vec3:
    """Sample a layer of the frame bilinearly at (x, y), pixels, within the outermost pixel centres."""
    j = wp.min(wp.int32(x), layer.shape[1] - 2)
    i = wp.min(wp.int32(y), layer.shape[0] - 2)
    fx = x - wp.float32(j)
    fy = y - wp.float32(i)
    top = (1.0 - fx) * layer[i, j] + fx * layer[i, j + 1]
    bottom = (1.0 - fx) * layer[i + 1, j] + fx * layer[i + 1, j + 1]
    return (1.0 - fy) * top + fy * bottom


@wp.func
def knows_irradiance(distant: DistantLight) -> wp.bool:
    """Return whether an irradiance of the environment is given; a kernel for any scene tests this at run time."""
    return distant.irradiance_map.shape[0] > 0 or distant.irradiance_sh.shape[0] > 0


@wp.func
def knows_levels(distant: DistantLight) -> wp.bool:
    """Return whether the prefiltered environment is given."""
    return distant.levels.shape[0] > 0


@functools.cache
def make_find_in_frame(trace: TraceConfig) -> wp.Function:
    """Return the function ``find_in_frame(params, picture, scene, probes, hit) -> vec2``: a proxy hit's pixel (x, y).

    x is -1 if the camera does not see the hit.
    """
    occluded_by_proxies = make_trace(trace).occluded_by_proxies

    @wp.func(module="unique")
    def find_in_frame(
        params: FrameParams, picture: Picture, scene: RayScene, balls: wp.array[Probe], hit: Hit
    ) -> wp.vec2:
        nowhere = wp.vec2(-1.0, -1.0)
        height = picture.frame.shape[0]
        width = picture.frame.shape[1]
        from_camera = hit.point - params.camera_position
        if wp.dot(from_camera, hit.geometric_normal) >= 0.0:
            return nowhere
        at = project(params, from_camera)
        if at[2] <= 0.0:
            return nowhere
        if at[0] < 0.0 or at[0] > wp.float32(width - 1) or at[1] < 0.0 or at[1] > wp.float32(height - 1):
            return nowhere
        if occluded_by_proxies(scene, params.camera_position, from_camera, 1.0 - HIDDEN_MARGIN):
            return nowhere
        if meets_probe(balls, params.camera_position, from_camera, 1.0 - HIDDEN_MARGIN):
            return nowhere
        return wp.vec2(at[0], at[1])

    return find_in_frame


@functools.cache
def make_shade_unoccluded(config: DistantLightConfig) -> wp.Function:
    """Return the function ``shade_unoccluded(scene, distant, hit, direction, spread) -> vec3``, an object's radiance.

    It is lit by the environment alone. ``spread`` is the angle of the ray's cone, and the least width over which the
    environment is read. Otherwise a few rays that meet a curved mirror would return a lamp's whole radiance or nothing,
    which gives squares of noise on the surfaces that they light.
    """
    surface_at = make_surface(config.models, config.textures)
    glossy = make_reflected_radiance(config)
    distant_irradiance = make_distant_irradiance(config)

    @wp.func(module="unique")
    def shade_unoccluded(
        scene: RayScene, distant: DistantLight, hit: Hit, direction: wp.vec3, spread: wp.float32
    ) -> wp.vec3:
        wo = -wp.normalize(direction)
        normal = hit.normal
        if wp.dot(hit.geometric_normal, wo) < 0.0:
            normal = -normal
        cos_o = wp.max(wp.dot(normal, wo), 0.0)
        surface = surface_at(scene, distant.dfg, hit, cos_o, spread)
        radiance = wp.cw_mul(surface.diffuse, distant_irradiance(distant, hit.point, normal)) / wp.pi
        if wp.static(config.textures):
            if wp.static(config.gathered):
                radiance = surface.occlusion * radiance + surface.emission
            else:
                radiance = surface.occlusion * radiance
        if wp.static(config.specular):
            if knows_levels(distant):
                wi = lobe_axis(surface, reflect(wo, normal), normal)
                floor = level_from_alpha(spread, distant.level_height)
                reflected = glossy(distant, surface.model, surface.roughness, surface.shininess, hit.point, wi, floor)
                if wp.static(config.textures):
                    reflected *= specular_occlusion(surface.occlusion, cos_o, surface.roughness)
                radiance += wp.cw_mul(surface.reflectance, reflected)
        return radiance

    return shade_unoccluded


@functools.cache
def make_distant_irradiance(config: DistantLightConfig) -> wp.Function:
    """Return ``distant_irradiance(distant, point, normal) -> vec3``: irradiance of the environment; 0 if unknown."""
    form: Literal["sh", "map"] = "sh" if config.diffuse == "sh" else "map"
    irradiance_at = make_irradiance_at(form, config.emitters, config.several)

    @wp.func(module="unique")
    def distant_irradiance(distant: DistantLight, point: wp.vec3, normal: wp.vec3) -> wp.vec3:
        irradiance = wp.vec3(0.0)
        if wp.static(config.diffuse != "none"):
            if knows_irradiance(distant):
                irradiance = irradiance_at(
                    distant.irradiance_sh, distant.irradiance_map, distant.emitters, distant.others, point, normal
                )
        return irradiance

    return distant_irradiance


@functools.cache
def make_radiance_along(config: DistantLightConfig, captured: bool = False) -> wp.Function:
    """Return the function ``radiance_along(distant, point, direction, level) -> vec3``.

    Its result is the prefiltered environment's radiance, with parallax correction. If ``captured``, it is that of the
    unfiltered environment, with emitters in the directions in which the balls show them.
    """
    placed = config.emitters and not captured

    @wp.func(module="unique")
    def radiance_along(distant: DistantLight, point: wp.vec3, direction: wp.vec3, level: wp.float32) -> wp.vec3:
        radiance = wp.vec3(0.0)
        toward = direction
        if wp.static(placed):
            toward = correct_parallax(distant.emitters, point, direction)
        if wp.static(captured):
            radiance = sample_latlong(distant.environment, toward)
        else:
            radiance = sample_levels(distant.levels, toward, level, distant.level_height)
        if wp.static(config.several):
            balls = distant.others
            total = probe_weight(balls.places, 0, point)
            for ball in range(1, balls.places.shape[0]):
                weight = probe_weight(balls.places, ball, point)
                if weight > 0.0:
                    total += weight
                    toward = direction
                    if wp.static(placed):
                        toward = correct_parallax(balls.emitters[ball - 1], point, direction)
                    other = wp.vec3(0.0)
                    if wp.static(captured):
                        other = sample_latlong(balls.environment[ball - 1], toward)
                    else:
                        other = sample_levels(balls.levels[ball - 1], toward, level, distant.level_height)
                    radiance += (weight / total) * (other - radiance)
        return radiance

    return radiance_along


@functools.cache
def make_reflected_radiance(config: DistantLightConfig) -> wp.Function:
    """Return ``reflected_radiance(distant, model, roughness, shininess, point, direction, floor) -> vec3``.

    Its result is the environment's mean radiance over a lobe. The lobe is that of a surface at ``point``, around
    ``direction`` (unit). ``floor`` is the least level to read: 0 for a surface that the camera sees, more for one of
    many rays.
    """
    radiance_along = make_radiance_along(config)

    @wp.func(module="unique")
    def reflected_radiance(
        distant: DistantLight,
        model: wp.int32,
        roughness: wp.float32,
        shininess: wp.float32,
        point: wp.vec3,
        direction: wp.vec3,
        floor: wp.float32,
    ) -> wp.vec3:
        level = level_from_roughness(roughness, distant.level_height)
        if wp.static(PHONG in config.models):
            if model == PHONG:
                level = level_from_shininess(shininess, distant.level_height)
        if wp.static(MIRROR in config.models):
            if model == MIRROR:
                level = 0.0
        return radiance_along(distant, point, direction, wp.max(level, floor))

    return reflected_radiance
