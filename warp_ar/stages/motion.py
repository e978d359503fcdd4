"""Stage ``motion``: motion of each pixel's surface since the previous frame."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels.picture.motion import find_motion, remember
from warp_ar.kernels.structs import FrameParams, Shape
from warp_ar.scene.object_shapes import object_shapes
from warp_ar.stages.base import NOT_ASKED, Arrays, ArraySpec, LeftOut, Numerics, Pass, Stage, Wiring, over_rows
from warp_ar.stages.features import Features


class Motion(Stage):
    """Computes motion vectors: each pixel's surface point, projected by this frame's camera and by the previous one."""

    name: ClassVar[str] = "motion"
    summary: ClassVar[str] = "motion of each pixel's surface since the frame before, in pixels"
    unread: ClassVar[str] = NOT_ASKED
    numerics: ClassVar[Numerics] = Numerics(
        "float32; 0 to the bit where nothing moves",
        1e-3,
        "difference of two projections: 1e-7 of a place in the picture over a motion of a few pixels",
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources read and written; the clock among them makes the stage run in every frame."""
        return Wiring(("pose", "objects", "clock", "surface_ids", "position"), ("motion",))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Declare the arrays of the motion, and the previous frame's camera and objects."""
        count = max(1, len(object_shapes(self.request.scene)))
        return {
            "motion": ArraySpec(self.shape, wp.vec2),
            "motion_params": ArraySpec((1,), FrameParams, FrameParams()),
            "motion_objects": ArraySpec((count,), Shape, Shape()),
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Return one pass over all pixels, and one that stores this frame's camera and objects."""
        params, scene = arrays["params"], arrays["ray_scene"]
        before, objects = arrays["motion_params"], arrays["motion_objects"]
        surfaces = arrays["surface_ids"], arrays["position"], arrays["motion"]
        return [
            over_rows(self.height, find_motion, params, before, scene, objects, *surfaces),
            Pass(lambda rows: remember(params, scene, before, objects)),
        ]
