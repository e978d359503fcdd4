"""Stage ``declip``: estimated radiance of the camera's clipped pixels."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels.picture import declip
from warp_ar.kernels.structs import make_picture
from warp_ar.scene.kinds import trace_config
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Numerics, Pass, Stage, Wiring, over_rows
from warp_ar.stages.features import Features
from warp_ar.stages.shared.lighting import trace_variant


class Declip(Stage):
    """Estimates the radiance of clipped pixels, which a shorter exposure shows; ``expose`` chooses the method."""

    name: ClassVar[str] = "declip"
    summary: ClassVar[str] = "estimates the radiance of clipped pixels by hue, depth and the ball"
    unread: ClassVar[str] = "nothing asks how bright clipped pixels were"
    numerics: ClassVar[Numerics] = Numerics(
        "float32; sums of sums over a pyramid", 2e-5, "sums over ten levels, and a power"
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources read and written, with the ball's light if the exposure's method uses it."""
        reads = ("frame", "pose", "environment") if features.declipped_by_ball else ("frame",)
        return Wiring(reads, ("declipped",))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Declare the arrays of the frame's radiance near clipped pixels, of tiles with such pixels, and of hues."""
        tiles = ArraySpec(declip.tile_shape(*self.shape), wp.int32)
        return {
            "declipped": ArraySpec(self.shape, wp.vec3),
            "declip_marked": tiles,
            "declip_active": tiles,
            "declip_levels": ArraySpec((declip.level_texels(*self.shape),), wp.vec4),
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Return passes down and up the pyramid, for partly clipped pixels, then for fully clipped ones."""
        ball = self.features.declipped_by_ball
        kinds = trace_variant(trace_config(self.request.scene), device).proxies
        config = declip.DeclipConfig(ball, kinds if ball else ())
        frame, decode, out, levels = (arrays[name] for name in ("frame", "decode", "declipped", "declip_levels"))
        marked, active = arrays["declip_marked"], arrays["declip_active"]
        picture, shape = make_picture(frame, None, arrays["rays"]), frame.shape
        half = declip.level_shapes(*shape)[0][0]
        seen = arrays["params"], arrays["ray_scene"], arrays["probes"], arrays["environment"] if ball else None
        fill = Pass(lambda rows: declip.fill_levels(active, shape, levels))
        return [
            over_rows(marked.shape[0], declip.mark_tiles, frame, marked),
            Pass(lambda rows: declip.widen_tiles(marked, active)),
            over_rows(half, declip.pull_frame, active, frame, decode, None, levels),
            fill,
            over_rows(shape[0], declip.complete, active, frame, decode, levels, out),
            over_rows(half, declip.pull_frame, active, frame, decode, out, levels),
            dataclasses.replace(fill),
            over_rows(shape[0], declip.complete_core, config, picture, levels, *seen, out),
        ]
