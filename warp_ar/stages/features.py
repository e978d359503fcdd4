"""Features that a request calls for, found once before any stage is wired.

Stages ask here instead of asking each other: whether light is recovered, which layers are laid over the frame, which
forms of the environment exist. Nobody asks here whether a stage has readers: the graph finds that out.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

from warp_ar.kernels.objects.reflect import DiffuseForm, DistantLightConfig
from warp_ar.kernels.picture.expose import BOXES
from warp_ar.kernels.rays.area_lights import POINT_SAMPLES
from warp_ar.scene import Scene
from warp_ar.scene.area_lights import emits_light
from warp_ar.scene.kinds import has_sized_lights, material_model, proxies_face, trace_config
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
"""Method of ``relight`` that needs nothing of the environment."""
NEAR = ("few_rays", "one_bounce")
"""Methods of ``shade`` that know what surrounds objects at close range."""
MEASURED = ("reflectance", "bounce", "brute_force")
"""Methods of ``relight`` that take the receiver's reflectance from the environment's irradiance."""
LOCAL = ("bounce", "brute_force")
"""Methods of ``relight`` that know which part of the environment reaches a point, and what lit surfaces send on."""


AREA_SAMPLES: Mapping[str, int] = MappingProxyType(
    {"point": POINT_SAMPLES, "coarse": 8, "fine": 32, "brute_force": 256}
)
"""Samples of what emits, per point, by method of ``area_light``."""
AREA_CELLS: Mapping[str, tuple[int, int]] = MappingProxyType({"coarse": (16, 8), "fine": (32, 6)})
"""The same per cell of the receiver, and pixels per cell; by other methods each pixel asks."""


@dataclasses.dataclass(frozen=True)
class Features:
    """Frozen answers for one request."""

    request: Request
    """Request that they answer."""
    environment: bool
    """The environment is known."""
    observed: bool
    """A mirror ball in the frames shows it; else it comes from a file."""
    recovered: bool
    """Light that clips in the ball is put back."""
    emitters: bool
    """Emitters of the environment are known by their places: there is a resource ``emitters``."""
    merged: bool
    """Frames of several exposures are merged."""
    layers: tuple[str, ...]
    """Resources that are laid over the frame: of ``virtual``, ``added_light``, ``shadow_ratio``, ``mirror_ball``,
    ``reflected``; the last holds the one before."""
    exposed: bool
    """The picture is shown at another exposure than the camera's."""
    boxed: bool
    """Darkening looks at the means of a pixel's surroundings."""
    declipped: bool
    """Radiance above clipping is estimated, which a shorter exposure shows."""
    declipped_by_ball: bool
    """The ball's light, with its energy put back, says more of that radiance."""
    relight_method: str
    """The quality's method of ``relight``; ``flat`` where no ball tells anything of the environment."""
    ambient_visibility: bool
    """Relighting asks which part of the environment reaches the receiver."""
    bounced: bool
    """Proxies that virtual light falls on light each other."""
    soft_lights: bool
    """Virtual lights with a size cast soft shadows."""
    area_samples: int
    """Samples of objects that emit, per point that they light; 0: none does."""
    area_cells: bool
    """Cells of the receiver know what these send there."""
    others: int
    """Mirror balls after the first whose light is interpolated with the first one's, on objects and on the receiver;
    0: one map is all."""
    near_field: str
    """Method of ``shade`` by which objects show what surrounds them at close range, themselves included; empty: none.

    Meshes with materials of their files have parts that shade each other: wherever the environment casts shadows, in
    all presets but ``paper``, they do so by ``few_rays`` at least.
    """
    irradiance: Literal["irradiance_sh", "irradiance_map"]
    """Resource that holds the environment's irradiance."""
    distant: DistantLightConfig
    """Forms of the environment that the objects reflect."""

    @property
    def balls(self) -> str:
        """Mirror balls that light objects, of several, in words; empty where there is one or none."""
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
        """Names of results that only the first ball's light enters."""
        names = ["the light of a path-traced reference"]
        if self.lit and self.relight_method not in (FLAT, *MEASURED):
            names.append("the key light of receivers")
        if self.declipped_by_ball:
            names.append("the radiance above clipping that a shorter exposure shows")
        return ", ".join(names)

    @property
    def others_with_irradiance(self) -> int:
        """Balls after the first whose irradiance is asked for."""
        measured = self.lit and self.relight_method in MEASURED
        return self.others if self.distant.diffuse != "none" or measured else 0

    @property
    def exposure_method(self) -> str:
        """Form of the exposure's kernel: a method that looks at boxes, or a name of its own."""
        if self.boxed:
            return self.request.quality.method("expose")
        return "declipped" if self.declipped else "plain"

    @property
    def shadowed(self) -> bool:
        """Virtual objects change the environment on the receiver."""
        return "shadow_ratio" in self.layers

    @property
    def lit(self) -> bool:
        """Virtual light falls on the receiver."""
        return "added_light" in self.layers

    @property
    def near_names(self) -> tuple[str, ...]:
        """Resources of what surrounds the objects, those that their materials show."""
        diffuse = () if self.distant.diffuse == "none" else ("near_irradiance",)
        return (*diffuse, "near_reflected") if self.distant.specular else diffuse


def find_features(request: Request) -> Features:
    """Answer for ``request``; pure Python, nothing of Warp is touched."""
    scene, quality = request.scene, request.quality
    environment = has_environment(scene)
    observed = environment and scene.captured is None
    bracketed = observed and quality.method("recover") not in ("default", "clipped")
    # Without a card or anything else that is modelled, nothing tells what clipped light does.
    # What lies around a ball that is moved is another each time.
    still = all(probe.marker is None for probe in scene.probes)
    recovered = bracketed and still and (scene.has_marker or bool(scene.proxies))
    layers = _find_layers(scene, quality)
    scale = scene.exposure.scale
    exposed = "added_light" in layers if isinstance(scale, str) else scale != 1.0
    darkened = exposed and (isinstance(scale, str) or scale < 1.0)
    relight_method = quality.method("relight") if environment else FLAT
    shines = sheds_light(scene)
    lit_by_both = bool(environment and shines and scene.proxies)
    area_samples = AREA_SAMPLES[area_method(quality)] if any(map(emits_light, scene.objects)) else 0
    placed = recovered or (environment and not observed and request.emitters)
    emitters = placed and quality.method("recover") == "shading"
    by_texture = quality.method("irradiance") == "sphere_mip"
    by_series = quality.method("irradiance") == "sh2" or (by_texture and environment and not observed)
    merged = bracketed and len(request.exposures) > 1
    others = len(scene.probes) - 1 if observed and not merged and interpolates(scene, quality) else 0
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
        ambient_visibility=lit_by_both and relight_method in LOCAL,
        bounced=relight_method in LOCAL and proxies_face(scene),
        soft_lights=quality.method("light_shadow") == "soft" and has_sized_lights(scene),
        area_samples=area_samples,
        area_cells=area_samples > 0 and area_method(quality) in AREA_CELLS and relight_method in (FLAT, *MEASURED),
        others=others,
        near_field=_near_method(scene, quality) if environment else "",
        irradiance="irradiance_sh" if by_series else "irradiance_map",
        distant=_find_forms(
            scene,
            "sh" if by_series else "map",
            emitters=emitters,
            several=others > 0,
            gathered=area_samples == 0,
            layers=layers,
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
    """Return whether a mirror ball or a file tells of the environment."""
    return bool(scene.probes) or scene.captured is not None


def interpolates(scene: Scene, quality: Quality) -> bool:
    """Return whether the light of several balls is interpolated: something is lit by it, by no sphere map's method.

    That are objects, and receivers whose reflectance is measured by it. A sphere map is a texture of one ball.
    """
    measured = bool(scene.proxies) and sheds_light(scene) and quality.method("relight") in MEASURED
    ways = ((stage, quality.method(stage)) for stage in ("unwrap", "irradiance", "prefilter"))
    textures = any(method in ("sphere_map", "sphere_mip") for _, method in ways)
    return len(scene.probes) > 1 and (bool(scene.objects) or measured) and not textures


def sheds_light(scene: Scene) -> bool:
    """Return whether any virtual light exists: one that is nothing else, or an object that emits."""
    return bool(scene.lights) or any(map(emits_light, scene.objects))


def area_method(quality: Quality) -> str:
    """Return the method by which light of objects that emit is found."""
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
    if layers and scene.probes and quality.method("mirror_ball") not in ("default", "none"):
        layers.append("mirror_ball")
    if (
        layers
        and scene.has_gloss
        and has_environment(scene)
        and quality.method("mirror_ball") not in ("default", "none")
    ):
        layers.append("reflected")
    return tuple(layers)


def _find_forms(
    scene: Scene, form: DiffuseForm, *, emitters: bool, several: bool, gathered: bool, layers: tuple[str, ...]
) -> DistantLightConfig:
    materials = scene_materials(scene)
    environment = has_environment(scene)
    # Shadows ask how much light the receiver has.
    diffuse = "shadow_ratio" in layers or any(map(reflects_diffusely, materials))
    return DistantLightConfig(
        trace=trace_config(scene),
        models=tuple(sorted(set(map(material_model, materials)))),
        textures=is_detailed(scene),
        diffuse=form if environment and diffuse else "none",
        specular=environment and (any(map(reflects_glossily, materials)) or "reflected" in layers),
        known=environment,
        emitters=emitters,
        several=several,
        gathered=gathered,
    )
