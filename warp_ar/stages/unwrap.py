"""The mirror ball in the frame becomes a map of the light that arrives at it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels import probe
from warp_ar.kernels.structs import BOX, MESH, PLANE
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Pass, Request, Rows, Stage, Wiring
from warp_ar.stages.variants import shares_kernels

NO_PROBE = "the scene has no mirror ball"

_KINDS = {"plane": PLANE, "box": BOX, "mesh": MESH}


class Unwrap(Stage):
    """Light of the current frame, with how far each direction can be trusted and how much of it clips."""

    name: ClassVar[str] = "unwrap"
    methods: ClassVar[tuple[str, ...]] = probe.METHODS
    summary: ClassVar[str] = "reads the light off the mirror ball, exactly for a camera nearby"

    @classmethod
    def wire(cls, request: Request) -> Wiring | LeftOut:
        """Needs a mirror ball."""
        if not request.scene.probes:
            return LeftOut(NO_PROBE)
        return Wiring(("frame", "pose"), ("probe_radiance", "probe_confidence", "probe_clipped"))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """The map, and where its texels' corners are seen."""
        height = self.request.quality.environment_height
        width = 2 * height
        return {
            "probe_radiance": ArraySpec((height, width), wp.vec3),
            "probe_confidence": ArraySpec((height, width), wp.float32),
            "probe_clipped": ArraySpec((height, width), wp.vec3),
            "unwrap_corners": ArraySpec((height + 1, width + 1, len(self.request.scene.probes)), wp.vec3),
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Corners first, then texels between them."""
        kinds = sorted({_KINDS[proxy.shape] for proxy in self.request.scene.proxies})
        config = probe.ProjectConfig(tuple(kinds))
        config = config.general() if shares_kernels(device) else config
        method = self.request.quality.method(self.name)
        method = method if method != "default" else "area"
        height = self.request.quality.environment_height

        def project(rows: Rows | None) -> None:
            probe.project_corners(
                arrays["params"],
                arrays["probes"],
                arrays["rays"],
                arrays["ray_scene"],
                arrays["unwrap_corners"],
                config=config,
                rows=rows,
            )

        def gather(rows: Rows | None) -> None:
            probe.gather_probe(
                arrays["frame"],
                arrays["decode"],
                arrays["probes"],
                arrays["unwrap_corners"],
                arrays["probe_radiance"],
                arrays["probe_confidence"],
                arrays["probe_clipped"],
                method=method,
                rows=rows,
            )

        return [Pass(project, rows=height + 1), Pass(gather, rows=height)]
