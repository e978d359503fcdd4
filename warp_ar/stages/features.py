"""Features of a request: properties of scene, quality and outputs, derived once before any stage is wired.

Stages read features instead of each other: whether light is recovered, which layers are laid over the frame, which
forms of the environment exist. Whether a stage has readers is not a feature; the graph finds it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

from warp_ar.kernels.objects.reflect import DistantLightConfig
from warp_ar.kernels.picture.expose import BOXES
from warp_ar.kernels.rays.area_lights import POINT_SAMPLES
from warp_ar.scene import Scene
from warp_ar.scene.area_lights import emits_light
from warp_ar.scene.kinds import material_model, proxies_face, trace_config
from warp_ar.scene.object_materials import (
    is_detailed,
    materials_of,
    reflects_diffusely,
    reflects_glossily,
    scene_materials,
)
from warp_ar.stages.quality import Quality
from warp_ar.stages.request import Request

FLAT = "flat"
"""Method of ``relight`` that does not use the environment."""
NEAR = ("few_rays", "one_bounce")
"""Methods of ``shade`` that include the close surroundings of objects."""
MEASURED = ("reflectance", "bounce", "brute_force")
"""Methods of ``relight`` that derive the receiver's reflectance from the environment's light that reaches it."""
LOCAL = ("bounce", "brute_force")
"""Methods of ``relight`` that add virtual light that lit surfaces reflect."""


AREA_SAMPLES: Mapping[str, int] = MappingProxyType({"point": POINT_SAMPLES, "coarse": 4, "fine": 8, "brute_force": 256})
"""Samples of emitting objects per lit point, by method of ``area_light``."""
AREA_CELLS: Mapping[str, tuple[int, int]] = MappingProxyType({"coarse": (8, 8), "fine": (16, 6)})
"""Samples of emitting objects per cell of the receiver, and pixels per cell; other methods sample at each pixel."""


@dataclasses.dataclass(frozen=True)
class Features:
    """Frozen features of one request."""

    request: Request
    """Request from which they are derived."""
    environment: bool
    """True if there is an environment."""
    observed: bool
    """True if the environment comes from a mirror ball in the frames; otherwise it comes from a file."""
    recovered: bool
    """True if light that clips in the ball is recovered."""
    emitters: bool
    """True if the positions of the environment's emitters are known, in the resource ``emitters``."""
    merged: bool
    """True if frames of several exposures are merged."""
    layers: tuple[str, ...]
    """Resources that are laid over the frame: of ``virtual``, ``added_light``, ``shadow_ratio``, ``mirror_ball``,
    ``reflected``; the last includes ``mirror_ball``."""
    exposed: bool
    """True if the picture has another exposure than the camera's frame."""
    boxed: bool
    """True if the method for a shorter exposure uses the mean of a clipped pixel's surroundings."""
    declipped: bool
    """True if the radiance of clipped pixels is estimated, because a shorter exposure shows it."""
    declipped_by_ball: bool
    """True if that estimate also uses the ball's light, with its recovered energy."""
    relight_method: str
    """The quality's method of ``relight``; ``flat`` without an environment."""
    ambient_visibility: bool
    """True if relighting computes the part of the environment that reaches the receiver."""
    bounced: bool
    """True if proxies reflect virtual light onto each other."""
    soft_lights: bool
    """True if virtual lights with a size cast soft shadows."""
    area_samples: int
    """Samples of emitting objects per point that they light; 0: none emits."""
    area_cells: bool
    """True if light of emitting objects is computed in cells of the receiver."""
    others: int
    """Number of mirror balls after the first whose light is interpolated with the first ball's, on objects and on the
    receiver; 0: one map lights all."""
    near_field: str
    """Method of ``shade`` for the close surroundings of objects, including their own parts; empty: none.

    Meshes with materials from their files have parts that shade each other. If the environment casts shadows, in all
    presets but ``paper``, they use ``few_rays`` at least.
    """
    irradiance: Literal["irradiance_sh", "irradiance_map"]
    """Resource with the environment's irradiance."""
    distant: DistantLightConfig
    """Forms of the environment that the objects reflect."""

    @property
    def balls(self) -> str:
        """Description of how several mirror balls light objects; empty with one ball or none."""
        scene = self.request.scene
        count = len(scene.probes)
        if count < 2 or not self.observed or not (scene.objects or self.others):
            return ""
        if self.others:
            lit = "objects and receivers are" if scene.objects else "receivers are"
            first = f"by the first one alone are found {self._first_alone}"
            return f"{lit} lit by what is interpolated between {count} mirror balls; {first}"
        if self.merged:
            return f"of several exposures {count} mirror balls make one map, which lights all objects"
        return "the quality's sphere map is a texture of one mirror ball, the first, whose light is that of all objects"

    @property
    def _first_alone(self) -> str:
        """Names of results that use only the first ball's light."""
        names = ["the light of a path-traced reference"]
        if self.lit and self.relight_method not in (FLAT, *MEASURED):
            names.append("the key light of receivers")
        if self.declipped_by_ball:
            names.append("the radiance above clipping that a shorter exposure shows")
        return ", ".join(names)

    @property
    def others_with_irradiance(self) -> int:
        """Number of balls after the first whose irradiance is needed."""
        measured = self.lit and self.relight_method in MEASURED
        return self.others if self.distant.diffuse != "none" or measured else 0

    @property
    def exposure_method(self) -> str:
        """Method of ``expose`` that runs: one that averages boxes, ``declipped`` or ``plain``."""
        if self.boxed:
            return self.request.quality.method("expose")
        return "declipped" if self.declipped else "plain"

    @property
    def shadowed(self) -> bool:
        """True if virtual objects change the environment's light on the receiver."""
        return "shadow_ratio" in self.layers

    @property
    def lit(self) -> bool:
        """True if virtual light falls on the receiver."""
        return "added_light" in self.layers

    @property
    def near_names(self) -> tuple[str, ...]:
        """Resources of the near field that the objects' materials reflect."""
        diffuse = () if self.distant.diffuse == "none" else ("near_irradiance",)
        return (*diffuse, "near_reflected") if self.distant.specular else diffuse


def find_features(request: Request) -> Features:
    """Return the features of ``request``, in pure Python, without Warp."""
    scene, quality = request.scene, request.quality
    environment = has_environment(scene)
    observed = environment and scene.captured is None
    bracketed = observed and quality.method("recover") not in ("default", "clipped")
    # Clipped light is measured by its effect on the card or another modelled surface.
    # The surroundings of a ball that moves change with its place.
    still = all(probe.marker is None for probe in scene.probes)
    recovered = bracketed and still and (scene.has_marker or bool(scene.proxies))
    layers = _find_layers(scene, quality)
    scale = scene.exposure.scale
    exposed = "added_light" in layers if isinstance(scale, str) else scale != 1.0
    darkened = exposed and (isinstance(scale, str) or scale < 1.0)
    relight_method = quality.method("relight") if environment else FLAT
    hidden = bool(scene.probes) or any(proxy.shape != "plane" for proxy in scene.proxies)
    area_samples = AREA_SAMPLES[area_method(quality)] if any(map(emits_light, scene.objects)) else 0
    placed = recovered or (environment and not observed and request.emitters)
    emitters = placed and quality.method("recover") == "shading"
    by_texture = quality.method("irradiance") == "sphere_mip"
    by_series = quality.method("irradiance") == "sh2" or (by_texture and environment and not observed)
    merged = bracketed and len(request.exposures) > 1
    others = len(scene.probes) - 1 if observed and not merged and interpolates(scene, quality) else 0
    materials = scene_materials(scene)
    # Shadows need the irradiance of the receiver.
    diffuse = "shadow_ratio" in layers or any(map(reflects_diffusely, materials))
    return Features(
        request=request,
        environment=environment,
        observed=observed,
        recovered=recovered,
        emitters=emitters,
        merged=merged,
        layers=layers,
        exposed=exposed,
        boxed=darkened and quality.method("expose") in BOXES,
        declipped=darkened and quality.method("expose") == "ball",
        declipped_by_ball=quality.method("expose") == "ball" and recovered,
        relight_method=relight_method,
        ambient_visibility=environment and "added_light" in layers and hidden and relight_method in MEASURED,
        bounced=relight_method in LOCAL and proxies_face(scene),
        soft_lights=quality.method("light_shadow") == "soft" and any(light.radius > 0.0 for light in scene.lights),
        area_samples=area_samples,
        area_cells=area_samples > 0 and area_method(quality) in AREA_CELLS and relight_method in (FLAT, *MEASURED),
        others=others,
        near_field=_near_method(scene, quality) if environment else "",
        irradiance="irradiance_sh" if by_series else "irradiance_map",
        distant=DistantLightConfig(
            trace=trace_config(scene),
            models=tuple(sorted(set(map(material_model, materials)))),
            textures=is_detailed(scene),
            diffuse=("sh" if by_series else "map") if environment and diffuse else "none",
            specular=environment and (any(map(reflects_glossily, materials)) or "reflected" in layers),
            known=environment,
            emitters=emitters,
            several=others > 0,
            gathered=area_samples == 0,
        ),
    )


def _near_method(scene: Scene, quality: Quality) -> str:
    method = quality.method("shade")
    shadows = quality.method("environment_shadow") not in ("default", "none")
    models = any(item.shape == "mesh" and materials_of(item).detailed for item in scene.objects)
    if method not in NEAR and shadows and models:
        return NEAR[0]
    return method if method in NEAR else ""


def has_environment(scene: Scene) -> bool:
    """Return True if a mirror ball or a file gives the environment."""
    return bool(scene.probes) or scene.captured is not None


def interpolates(scene: Scene, quality: Quality) -> bool:
    """Return True if the light of several balls is interpolated, for objects or receivers of measured reflectance.

    Methods of the sphere map, which is a texture of one ball, do not interpolate.
    """
    measured = bool(scene.proxies) and sheds_light(scene) and quality.method("relight") in MEASURED
    ways = ((stage, quality.method(stage)) for stage in ("unwrap", "irradiance", "prefilter"))
    textures = any(method in ("sphere_map", "sphere_mip") for _, method in ways)
    return len(scene.probes) > 1 and (bool(scene.objects) or measured) and not textures


def sheds_light(scene: Scene) -> bool:
    """Return True if the scene has a virtual light or an object that emits."""
    return bool(scene.lights) or any(map(emits_light, scene.objects))


def area_method(quality: Quality) -> str:
    """Return the quality's method for the light of emitting objects."""
    method = quality.method("area_light")
    return method if method in AREA_SAMPLES else "coarse"


def _find_layers(scene: Scene, quality: Quality) -> tuple[str, ...]:
    layers = []
    if scene.objects:
        layers.append("virtual")
    if scene.proxies and sheds_light(scene):
        layers.append("added_light")
    shadows = quality.method("environment_shadow") not in ("default", "none")
    if shadows and scene.objects and scene.proxies and has_environment(scene):
        layers.append("shadow_ratio")
    mirrored = bool(layers) and quality.method("mirror_ball") not in ("default", "none")
    if mirrored and scene.probes:
        layers.append("mirror_ball")
    if mirrored and scene.has_gloss and has_environment(scene):
        layers.append("reflected")
    return tuple(layers)
