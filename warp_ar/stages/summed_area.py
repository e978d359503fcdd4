"""Summed-area table of the frame's intensity."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.device import usable_cores
from warp_ar.kernels.picture import summed_area
from warp_ar.kernels.picture.summed_area_strips import (
    make_sum_strips_kernel,
    strip_config,
    strip_shapes,
    sum_area_by_strips,
)
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Numerics, Pass, Stage, Wiring
from warp_ar.stages.features import Features
from warp_ar.stages.shared.clipped import box_reads
from warp_ar.stages.shared.picture import frame_reads
from warp_ar.stages.shared.relighting import SUMMED, SUMMED_CUT, relight_reads


class SummedArea(Stage):
    """Sums the frame's intensity so that any box's mean costs four look-ups."""

    name: ClassVar[str] = "summed_area"
    summary: ClassVar[str] = "summed-area table of the frame: means over boxes of any size"
    unread: ClassVar[str] = "neither relighting nor the exposure looks at means of a pixel's surroundings"
    numerics: ClassVar[Numerics] = Numerics(
        precision="uint32 modulo 2^32",
        bound=0.0,
        cause="exact for boxes of up to 2^32 / 255 pixels",
        measured=0,
        rows=(6, 11, 12, 17),
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Reads the frame alone; where it is wanted deeper than 8 bits, what these cut off has a table too."""
        if (features.lit and SUMMED_CUT in relight_reads(features)) or SUMMED_CUT in box_reads(features):
            return Wiring(frame_reads(features), (SUMMED, SUMMED_CUT))
        return Wiring(("frame",), (SUMMED,))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """The table, and the sums on the way to it by strips, or by slabs."""
        width, height = self.request.size
        ends = summed_area.slab_shape(height, width, usable_cores())
        names = ("summed_area_sums", "summed_area_group_sums", "summed_area_state")
        shapes = zip(names, strip_shapes(height, width), strict=True)
        sums = {name: ArraySpec(shape, wp.uint32) for name, shape in shapes}
        sums["summed_area_ends"] = ArraySpec(ends, wp.uint32)
        if SUMMED_CUT in self.wiring.writes:
            sums["summed_area_cut_frame"] = ArraySpec((height, width), wp.vec3ub)
        return {name: ArraySpec((height, width), wp.uint32) for name in self.wiring.writes} | sums

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """On CPU by slabs, a thread each; on CUDA by strips."""
        frame, height = arrays["frame"], self.request.size[1]
        passes = self._sum(frame, arrays[SUMMED], arrays, device)
        if SUMMED_CUT not in self.wiring.writes:
            return passes
        cut, known = arrays["summed_area_cut_frame"], (frame, arrays["decode"], arrays["linear_frame"])
        passes.append(Pass(lambda rows: summed_area.write_cut(*known, cut, rows=rows), rows=height))
        return [*passes, *self._sum(cut, arrays[SUMMED_CUT], arrays, device)]

    def _sum(self, frame: wp.array, table: wp.array, arrays: Arrays, device: Any) -> list[Pass]:
        """Passes that write the table of one frame; two tables use the same scratch, one after the other."""
        width, height = self.request.size
        if not device.is_cpu:
            sums = [arrays[f"summed_area_{name}"] for name in ("sums", "group_sums", "state")]
            make_sum_strips_kernel(strip_config(height, width, device))
            return [Pass(lambda rows: sum_area_by_strips(frame, *sums, table))]
        ends = arrays["summed_area_ends"]
        passes = [Pass(lambda rows: summed_area.sum_slabs(frame, table, ends, rows=rows), rows=len(ends))]
        if len(ends) == 1:
            return passes
        passes.append(Pass(lambda rows: summed_area.add_ends(ends)))
        passes.append(Pass(lambda rows: summed_area.join_slabs(ends, table, rows=rows), rows=len(ends) - 1))
        return passes
