"""Stage ``sphere_map``: the mirror ball's part of the frame as a texture with mip levels, as in the paper."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels.environment import sphere_map
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Numerics, Pass, Stage, Wiring, over_rows, unobserved
from warp_ar.stages.features import Features
from warp_ar.stages.shared.picture import frame_reads


class SphereMap(Stage):
    """Copies the square around the ball and halves it level by level."""

    name: ClassVar[str] = "sphere_map"
    summary: ClassVar[str] = "the ball's square of the frame as a texture with mip levels (the paper)"
    unread: ClassVar[str] = "no stage is on the paper's own way to look the ball up"
    numerics: ClassVar[Numerics] = Numerics(
        "float32; running means, exact for equal texels",
        1e-4,
        "places of 1e-7 of a frame's width, times the contrast of noise",
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources read and written for a scene with a mirror ball."""
        if not features.observed:
            return LeftOut(unobserved(features))
        return Wiring((*frame_reads(features), "pose"), ("sphere_map",))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Declare the array that holds all mip levels."""
        return {"sphere_map": ArraySpec((sphere_map.map_texels(),), wp.vec3)}

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Return passes for the ball's square, then for its mip levels."""
        texture = arrays["sphere_map"]
        known = (arrays[name] for name in ("params", "probes", "frame", "decode", "linear_frame"))
        return [
            over_rows(sphere_map.SIZE, sphere_map.copy_ball, *known, texture),
            Pass(lambda rows: sphere_map.halve_levels(texture)),
        ]
