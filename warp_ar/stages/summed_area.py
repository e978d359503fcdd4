"""Stage ``summed_area``: summed-area table of the frame's intensity."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels.picture import summed_area
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Numerics, Pass, Stage, Wiring, over_rows
from warp_ar.stages.features import Features
from warp_ar.stages.shared.picture import SUMMED, SUMMED_CUT, box_reads, frame_reads


class SummedArea(Stage):
    """Sums the frame's intensity, so that the mean of any box needs four look-ups."""

    name: ClassVar[str] = "summed_area"
    summary: ClassVar[str] = "summed-area table of the frame: means over boxes of any size"
    unread: ClassVar[str] = "the exposure does not look at means of a pixel's surroundings"
    numerics: ClassVar[Numerics] = Numerics("uint32 modulo 2^32", 0.0, "exact for boxes of up to 2^32 / 255 pixels")

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources read and written; deeper frames have a second table, of the residual below 8 bits."""
        if SUMMED_CUT in box_reads(features):
            return Wiring(frame_reads(features), (SUMMED, SUMMED_CUT))
        return Wiring(("frame",), (SUMMED,))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Declare the array of the table; for deeper frames also those of the residual and of its table."""
        specs = {name: ArraySpec(self.shape, wp.uint32) for name in self.wiring.writes}
        if SUMMED_CUT in specs:
            specs["summed_area_cut_frame"] = ArraySpec(self.shape, wp.vec3ub)
        return specs

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Return passes along rows, then down columns, for each table."""
        frame = arrays["frame"]
        passes = self._sum(frame, arrays[SUMMED])
        if SUMMED_CUT not in self.wiring.writes:
            return passes
        cut, known = arrays["summed_area_cut_frame"], (frame, arrays["decode"], arrays["linear_frame"])
        passes.append(over_rows(self.height, summed_area.write_cut, *known, cut))
        return [*passes, *self._sum(cut, arrays[SUMMED_CUT])]

    def _sum(self, frame: wp.array, table: wp.array) -> list[Pass]:
        """Return the passes that write the table of one frame."""
        groups = summed_area.column_groups(self.shape[1])
        return [
            over_rows(self.height, summed_area.sum_rows, frame, table),
            over_rows(groups, summed_area.sum_columns, table),
        ]
