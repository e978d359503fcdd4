"""Stage ``unwrap``: the mirror ball in the frame as a latlong map of the light that arrives at it."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels.environment import sphere_map, unwrap
from warp_ar.kernels.environment.probe_weights import measure_seen
from warp_ar.scene.kinds import trace_config
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Numerics, Pass, Stage, Wiring, over_rows, unobserved
from warp_ar.stages.features import Features
from warp_ar.stages.shared.lighting import trace_variant
from warp_ar.stages.shared.picture import frame_reads
from warp_ar.stages.shared.probe_maps import OTHERS, find_view, other_maps, other_names, other_views


class Unwrap(Stage):
    """Computes the light of the current frame, with confidence and clipped share of each direction."""

    name: ClassVar[str] = "unwrap"
    methods: ClassVar[Mapping[str, str]] = {
        "sphere_map": "OpenGL's sphere mapping, ball and light far away",
        "area": "the mean over a texel's footprint",
    }
    summary: ClassVar[str] = "reads the light off the mirror ball, exact for a near camera"
    subject: ClassVar[str] = "reading the light off the mirror ball, judged with a map of 32 rows"
    unread: ClassVar[str] = "nothing asks for the environment"
    converges: ClassVar[bool] = True
    settings: ClassVar[tuple[str, ...]] = ("environment_height",)
    follows: ClassVar[bool] = True
    numerics: ClassVar[Numerics] = Numerics(
        "float32; running means", 1e-4, "Newton's method to 1e-7 rad, times the pixels of a frame's width, on noise"
    )

    @classmethod
    def method_for(cls, features: Features) -> str:
        """Return the quality's method, or the exact one if the quality names none.

        Frames of several exposures use the exact one too: the sphere map is a texture of one frame.
        """
        method = super().method_for(features)
        return method if method in cls.methods and not features.merged else "area"

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources read and written for a scene with a mirror ball."""
        if not features.observed:
            return LeftOut(unobserved(features))
        by_texture = cls.method_for(features) == "sphere_map"
        texture = ("sphere_map",) if by_texture else ()
        frames = frame_reads(features) if by_texture else frame_reads(features)[-1:]
        written = "probe_radiance", "probe_confidence", "probe_clipped"
        seen = ("probes_seen",) if features.others else ()
        return Wiring((*frames, "pose", *texture), (*written, *other_names(features, OTHERS), *seen))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Declare the arrays of the latlong map, and of the image positions of its texels' corners."""
        height, width = self.map_shape
        specs = {
            "probe_radiance": ArraySpec(self.map_shape, wp.vec3),
            "probe_confidence": ArraySpec(self.map_shape, wp.float32),
            "probe_clipped": ArraySpec(self.map_shape, wp.vec3),
            **other_maps(self.features, OTHERS, self.map_shape),
        }
        if self.method != "sphere_map":
            if self.features.others:
                specs["probes_seen"] = ArraySpec((len(self.request.scene.probes), height + 1), wp.float32)
            specs["unwrap_corners"] = ArraySpec((height + 1, width + 1, len(self.request.scene.probes)), wp.vec3)
        return specs

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Return passes for corners, then texels; or one that looks the texels up in the sphere map."""
        if self.method == "sphere_map":
            return self._look_up(arrays)
        kinds = trace_variant(trace_config(self.request.scene), device).proxies
        height = self.map_height
        linear = "linear_frame" in self.wiring.reads
        frame = arrays["linear_frame" if linear else "frame"], arrays["linear_clip" if linear else "decode"]
        probes, corners, others = arrays["probes"], arrays["unwrap_corners"], self.features.others
        view, own = find_view(arrays, "probe"), 0 if others else unwrap.ALL_ALIKE
        seen = arrays["params"], probes, arrays["rays"], arrays["ray_scene"], corners
        gather: Any = functools.partial(over_rows, height, unwrap.gather_probe, linear, *frame)
        passes = [over_rows(height + 1, unwrap.project_corners, kinds, *seen), gather(probes, corners, own, view)]
        for ball, other in enumerate(other_views(self.features, arrays, OTHERS), 1):
            alone = probes[ball : ball + 1], corners[:, :, ball : ball + 1]
            passes.append(gather(*alone, unwrap.ALL_ALIKE, other))
        if others:
            passes.append(Pass(lambda rows: measure_seen(corners, self.request.size, arrays["probes_seen"])))
        return passes

    def _look_up(self, arrays: Arrays) -> list[Pass]:
        """Return the pass that looks every direction up in the sphere map."""
        params, texture, out = arrays["params"], arrays["sphere_map"], arrays["probe_radiance"].flatten()
        names = "params", "probes", "frame", "linear_frame", "linear_clip", "probe_confidence", "probe_clipped"
        seen = (arrays[name] for name in names)
        return [
            over_rows(self.map_height, sphere_map.look_up_level, params, texture, 0, self.map_shape, out),
            over_rows(self.map_height, sphere_map.trust_ball, *seen),
        ]
