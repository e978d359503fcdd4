"""Stage ``gloss``: reflections of virtual content in polished receivers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import warp as wp

from warp_ar.kernels.receiver import gloss
from warp_ar.kernels.structs import struct_dtype
from warp_ar.scene.kinds import light_kind, proxies_face, trace_config
from warp_ar.stages import base
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Numerics, Pass, Reach, Stage, Wiring, over_rows
from warp_ar.stages.features import Features
from warp_ar.stages.shared import lighting
from warp_ar.stages.shared.picture import GrowingRows, find_picture, frame_reads

SAMPLES: Mapping[str, int] = {"single": 4, "smooth": 16, "brute_force": 256}
"""Rays per pixel of a rough receiver, by the method of ``mirror_ball``."""


class Gloss(Stage):
    """Computes reflections of virtual objects and lights in receivers with a material."""

    name: ClassVar[str] = "gloss"
    summary: ClassVar[str] = "reflections of virtual objects and lights in polished receivers"
    numerics: ClassVar[Numerics] = Numerics(
        "float32; GGX by half vectors, no cancellation near the peak",
        2e-3,
        "edges of what is mirrored fall to either side; 1e-7 of an angle in narrow highlights",
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources read and written, among them objects' light and the layers that receivers reflect."""
        if not features.request.scene.has_gloss:
            return LeftOut("no proxy has a material: the receiver is matt")
        if not features.environment:
            return LeftOut(base.NO_BALL)
        if "reflected" not in features.layers:
            return LeftOut("nothing virtual can be mirrored, or the quality leaves mirrors as the camera saw them")
        reads = {"pose", *frame_reads(features), "objects", *lighting.distant_light_reads(features)}
        reads |= {"lights"} if features.request.scene.lights else set()
        reads |= {name for name in features.layers if name in ("shadow_ratio", "added_light", "mirror_ball")}
        return Wiring(tuple(sorted(reads)), ("reflected",))

    def idle(self, reach: Reach) -> str | None:
        """Return the reason for no effect in a frame if no glossy receiver is in the picture, else None."""
        return None if reach.balls else "no receiver with a material is in the picture"

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Declare the arrays of the change of radiance before and after averaging, and of the proxies' reflection."""
        return {
            "reflected": ArraySpec(self.shape, wp.vec3),
            "gloss_change": ArraySpec(self.shape, wp.vec3),
            "gloss_surface": ArraySpec(self.shape, wp.int32),
            "gloss_surfaces": ArraySpec((len(self.request.scene.proxies),), gloss.Gloss),
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Return passes for reflections, then for means over neighbours, over the rows of receivers and balls."""
        config = self._config(device)
        arrays["gloss_surfaces"].assign(self._surfaces())
        sight, layers = gloss.Sight(), gloss.GlossLayers()
        for field, name in (("shadow_ratio", "shadow_ratio"), ("added", "added_light")):
            if name in self.wiring.reads:
                setattr(layers, field, arrays[name])
        sight.scene, sight.picture, sight.probes = arrays["ray_scene"], find_picture(arrays), arrays["probes"]
        sight.distant, sight.layers = lighting.make_distant_light(self.features, arrays), layers
        lights = arrays["light_array"] if config.lights else None
        own = arrays["gloss_change"], arrays["gloss_surface"]
        mirror_ball = arrays["mirror_ball"] if "mirror_ball" in self.wiring.reads else None
        given = arrays["params"], sight, lights, arrays["gloss_surfaces"], *own
        extents = [GrowingRows(arrays["ball_rows"]) for _ in range(2)]
        return [
            over_rows(self.height, gloss.gloss, config, *given, extent=extents[0]),
            over_rows(self.height, gloss.smooth_gloss, *own, mirror_ball, arrays["reflected"], extent=extents[1]),
        ]

    def _config(self, device: Any) -> gloss.GlossConfig:
        """Return the compile-time configuration of the kernel."""
        features, scene = self.features, self.request.scene
        shading = lighting.mirrored_shading(features) if scene.objects else None
        return gloss.GlossConfig(
            lighting.trace_variant(trace_config(scene), device),
            SAMPLES[self.request.quality.method("mirror_ball")],
            tuple(sorted({light_kind(light) for light in scene.lights})),
            None if shading is None else lighting.shade_variant(shading, features, device),
            features.emitters,
            proxies_face(scene),
        )

    def _surfaces(self) -> Any:
        """Return records of ``Gloss``, one for each proxy."""
        proxies = self.request.scene.proxies
        records = np.zeros(len(proxies), struct_dtype(gloss.Gloss))
        for record, proxy in zip(records, proxies, strict=True):
            if proxy.material is not None:
                record["reflectance"], record["roughness"] = proxy.material.reflectance, proxy.material.roughness
        return records
