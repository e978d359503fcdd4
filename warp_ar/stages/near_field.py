"""Stage ``near_field``: light from the close surroundings of virtual objects."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels.objects import near_field
from warp_ar.kernels.picture import frame_levels
from warp_ar.scene import MetallicRoughnessMaterial, PhongMaterial
from warp_ar.scene.materials import MeshMaterial
from warp_ar.scene.object_materials import reflects_glossily, scene_materials
from warp_ar.stages import base
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Numerics, Pass, Reach, Stage, Wiring, over_rows
from warp_ar.stages.features import Features
from warp_ar.stages.shared.lighting import distant_light_reads, distant_variant, make_distant_light
from warp_ar.stages.shared.picture import find_picture, find_visible, frame_reads

SIDE = 4
"""Pixels along one side of a tile."""


@dataclasses.dataclass(frozen=True)
class RayCounts:
    """Rays per pixel."""

    samples: int
    """Rays toward the environment."""
    lobe: int
    """Rays into a glossy lobe."""
    mirror: int
    """Rays of a mirror; a square number."""
    known: bool
    """True if samples estimate only the difference from the environment's irradiance, which is known."""


RAYS: Mapping[str, RayCounts] = MappingProxyType(
    {"few_rays": RayCounts(4, 1, 1, known=True), "one_bounce": RayCounts(32, 4, 4, known=False)}
)
"""Ray counts by method of ``shade``."""


def lobe_widths(material: MeshMaterial) -> tuple[float, float]:
    """Return the least and the largest lobe width alpha of a material, as ``kernels.near_field`` defines it."""
    surface = material.surface
    match surface:
        case MetallicRoughnessMaterial():
            low, high = ((factor * surface.roughness) ** 2 for factor in material.roughness_span)
            return low, high
        case PhongMaterial():
            width = 1.0 / math.sqrt(max(surface.shininess, 1.0))
            return width, width
    return 0.0, 0.0


def near_field_config(features: Features, device: Any) -> near_field.NearFieldConfig:
    """Return the compile-time configuration of the kernels."""
    layers = features.layers
    rays = RAYS[features.near_field]
    materials = scene_materials(features.request.scene)
    widths = [width for item in materials if reflects_glossily(item) for width in lobe_widths(item)]
    sharp = [width < near_field.SHARP_ALPHA for width in widths]
    # The forms of light are always the scene's, because the kernel writes them.
    forms, variant = features.distant, distant_variant(features, device)
    return near_field.NearFieldConfig(
        dataclasses.replace(variant, diffuse=forms.diffuse, specular=forms.specular),
        rays.samples,
        0 if all(sharp) else rays.lobe,
        rays.mirror if any(sharp) else 0,
        SIDE,
        "shadow_ratio" in layers,
        "added_light" in layers,
        # With several balls each has a part of the samples, enough only for the difference from the known irradiance.
        rays.known or features.others > 0,
    )


class NearField(Stage):
    """Estimates light between objects, and their reflections of the receiver and of each other."""

    name: ClassVar[str] = "near_field"
    summary: ClassVar[str] = "receiver and other objects as virtual objects reflect them"
    unread: ClassVar[str] = "virtual objects show the distant environment only"
    numerics: ClassVar[Numerics] = Numerics(
        "float32", 6e-2, "two rays of 64 at the picture's border see the receiver or do not"
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources read and written for a scene with objects and an environment that lights them."""
        if not features.request.scene.objects:
            return LeftOut(base.NO_OBJECT)
        if not features.environment:
            return LeftOut(base.NO_BALL)
        reads = [*frame_reads(features), "pose", "objects", "hit_object", "hits", *distant_light_reads(features)]
        if features.distant.diffuse != "none":
            reads.append("environment_samples")
            reads += [name for name in ("probe_places",) if features.others and name not in reads]
        reads += [name for name in features.layers if name not in ("virtual", "mirror_ball", "reflected")]
        return Wiring(tuple(reads), features.near_names)

    def idle(self, reach: Reach) -> str | None:
        """Return the reason for no effect in a frame if no object is in the picture, else None."""
        return None if reach.objects else base.OUT_OF_PICTURE

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Declare the arrays of irradiance and reflected radiance, before and after averaging."""
        config = self.features.distant
        specs = {}
        if config.diffuse != "none":
            specs["near_irradiance"] = specs["near_field_irradiance"] = ArraySpec(self.shape, wp.vec3)
        if config.specular:
            specs["near_reflected"] = specs["near_field_reflected"] = ArraySpec(self.shape, wp.vec4)
            specs["near_field_transmitted"] = ArraySpec(self.shape, wp.vec4)
            specs["near_field_levels"] = ArraySpec((frame_levels.level_texels(*self.shape),), wp.vec3)
        return specs

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Return passes for the estimates, then for their means."""
        config = near_field_config(self.features, device)
        params, scene, visible = arrays["params"], arrays["ray_scene"], find_visible(arrays)
        picture, layers = find_picture(arrays), near_field.ReceiverLayers()
        if config.ratio:
            layers.shadow_ratio = arrays["shadow_ratio"]
        if config.added:
            layers.added = arrays["added_light"]
        if self.features.distant.specular:
            layers.levels = arrays["near_field_levels"]
        distant = make_distant_light(self.features, arrays)
        samples = arrays["environment_samples"] if config.distant.diffuse != "none" else None
        raw, near = near_field.NearLight(), near_field.NearLight()
        for light, prefix in ((raw, "near_field_"), (near, "near_")):
            for name in ("irradiance", "reflected", "transmitted"):
                if prefix + name in arrays:
                    setattr(light, name, arrays[prefix + name])
        height, extent = self.height, arrays["object_rows"]
        given = params, picture, layers, scene, distant, samples, visible, raw
        return [
            *self._shrink(params, picture, layers),
            over_rows(height, near_field.estimate_near_field, config, *given, extent=extent),
            over_rows(height, near_field.filter_near_field, config, params, scene, visible, raw, near, extent=extent),
        ]

    def _shrink(self, params: Any, picture: Any, layers: Any) -> list[Pass]:
        """Return passes for the frame's mip levels, if an object reflects the frame."""
        if not self.features.distant.specular:
            return []
        rows = frame_levels.level_size(*self.shape, 1)[0]
        further = range(2, frame_levels.LAST_LEVEL + 1)
        return [
            over_rows(rows, frame_levels.shrink_frame, params, picture, layers, layers.levels),
            *(over_rows(None, frame_levels.shrink_level, *self.shape, level, layers.levels) for level in further),
        ]
