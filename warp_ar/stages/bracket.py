"""Stage ``bracket``: merges frames of several exposures, of which the longest clips bright light."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels.environment import bracket as kernels
from warp_ar.kernels.launch import copy
from warp_ar.kernels.structs import filled
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Numerics, Pass, Rows, Stage, Wiring, over_rows, unobserved
from warp_ar.stages.features import Features
from warp_ar.stages.shared.probe_maps import UNWRAPPED, find_view


class Bracket(Stage):
    """Merges the latest frames of all exposures; ``ShortFrames`` unwraps those of exposures that are not shown."""

    name: ClassVar[str] = "bracket"
    summary: ClassVar[str] = "merges alternating exposures: clipped pixels come from the shorter one"
    unread: ClassVar[str] = "nothing asks for the environment"
    follows: ClassVar[bool] = True
    numerics: ClassVar[Numerics] = Numerics("float32; running means", 2e-6, "a dozen roundings of weights and means")
    remembers: ClassVar[tuple[str, ...]] = tuple(f"bracket_{part}" for part in UNWRAPPED)

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources read and written for a mirror ball, and frames that alternate between exposures."""
        if not features.observed:
            return LeftOut(unobserved(features))
        if len(features.request.exposures) < 2:
            return LeftOut("the source tells of no alternating exposures")
        if not features.merged:
            return LeftOut("the quality takes the light as the camera clipped it")
        return Wiring(
            (*(f"probe_{part}" for part in UNWRAPPED), "short_frames"), tuple(f"merged_{part}" for part in UNWRAPPED)
        )

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Declare the arrays of all exposures' maps, of the clipped share near each texel, and of the merged map."""
        count = len(self.request.exposures)
        types = dict(zip(UNWRAPPED, (wp.vec3, wp.float32, wp.vec3), strict=True))
        return {
            **{f"merged_{part}": ArraySpec(self.map_shape, kind) for part, kind in types.items()},
            **{f"bracket_{part}": ArraySpec((count, *self.map_shape), kind) for part, kind in types.items()},
            "bracket_spread": ArraySpec((count, *self.map_shape), wp.vec3),
            "bracket_exposures": ArraySpec((count,), kernels.BracketExposure),
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Return passes that store the reference's map, find clipping near each texel, and average the exposures."""
        height = self.map_height
        reference = self.request.exposures.index(1.0)
        stack = filled(kernels.ExposureStack(), **{part: arrays[f"bracket_{part}"] for part in (*UNWRAPPED, "spread")})
        merged = find_view(arrays, "merged")
        own = [(arrays[f"bracket_{part}"][reference], arrays[f"probe_{part}"]) for part in UNWRAPPED]

        def store(rows: Rows | None) -> None:
            for target, source in own:
                copy(target, source)

        return [
            Pass(store),
            over_rows(height, kernels.spread_clipping, kernels.REACH, stack),
            over_rows(height, kernels.merge_exposures, arrays["bracket_exposures"], stack, kernels.REACH, merged),
        ]
