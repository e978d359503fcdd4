"""Stage ``coverage``: the surfaces that share a pixel, and the share of the pixel that each covers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from warp_ar.kernels.receiver.surfaces import count_coverage
from warp_ar.kernels.structs import vec8
from warp_ar.scene.kinds import trace_config
from warp_ar.stages.base import NOT_ASKED, Arrays, ArraySpec, LeftOut, Numerics, Pass, Stage, Wiring, over_rows
from warp_ar.stages.features import Features
from warp_ar.stages.shared.lighting import trace_variant


class Coverage(Stage):
    """Counts the samples of edge pixels by the surface that they show."""

    name: ClassVar[str] = "coverage"
    summary: ClassVar[str] = "share of each pixel that objects, proxies and balls cover"
    unread: ClassVar[str] = NOT_ASKED
    numerics: ClassVar[Numerics] = Numerics(
        "counts of up to 16 samples, exact", 0.0, "none: shares are multiples of 1/16; edges fall to either side"
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources read and written; the graph leaves the stage out if coverage is not requested."""
        return Wiring(("pose", "objects", "surface_ids"), ("coverage",))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Declare the array of up to four surfaces with their shares per pixel."""
        return {"coverage": ArraySpec(self.shape, vec8)}

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Return one pass over all pixels."""
        config = trace_variant(trace_config(self.request.scene), device)
        given = (arrays[name] for name in ("params", "rays", "ray_scene", "probes", "surface_ids", "coverage"))
        return [over_rows(self.height, count_coverage, config, self.request.quality.edge_samples, *given)]
