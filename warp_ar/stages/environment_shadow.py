"""Stage ``environment_shadow``: shadows that virtual objects cast on the receiver in the environment's light."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels.cells import cell_shape, cell_stride
from warp_ar.kernels.environment.environment_samples import SampleSets
from warp_ar.kernels.receiver import environment_shadow as kernels
from warp_ar.kernels.receiver import environment_shadow_filter as filters
from warp_ar.kernels.receiver.environment_shadow import EnvironmentShadowConfig, ShadowCells, ShadowQueue
from warp_ar.kernels.structs import filled
from warp_ar.stages import base
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Numerics, Pass, Reach, Rows, Stage, Wiring, over_rows
from warp_ar.stages.features import Features
from warp_ar.stages.shared.environment_sets import METHODS, Method, lists_texels, sample_names, sample_slots
from warp_ar.stages.shared.lighting import distant_light_reads, distant_variant, make_distant_light, make_other_balls
from warp_ar.stages.shared.picture import GrowingRows, find_picture, frame_reads


def find_stride(method: Method, rows: int) -> int:
    """Return the pixels along a cell, which has one shadow estimate; they grow with the square root of frame rows."""
    return int(cell_stride(method.stride, rows, slowly=True))


def shadow_cells(features: Features) -> tuple[int, int]:
    """Return the rows and columns of cells (blocks of pixels with one estimate each)."""
    size, method = features.request.size, METHODS[EnvironmentShadow.method_for(features)]
    rows, columns = cell_shape(size, find_stride(method, size[1]))
    return rows, columns


def shadow_config(features: Features, device: Any) -> EnvironmentShadowConfig:
    """Return the compile-time configuration of the kernels."""
    method = METHODS[EnvironmentShadow.method_for(features)]
    return EnvironmentShadowConfig(
        distant_variant(features, device),
        method.count * (sample_slots(features) if lists_texels(features) else 1),
        method.side,
        method.bounce,
        method.secondary,
        features.emitters,
    )


class EnvironmentShadow(Stage):
    """Computes the shadow ratio, a factor on the frame: irradiance with virtual objects over irradiance without."""

    name: ClassVar[str] = "environment_shadow"
    methods: ClassVar[Mapping[str, str]] = {
        "none": "none",
        "coarse": "32 rays at every sixth pixel; reflected light estimated",
        "bounce": "64 rays at every second pixel; half of them trace reflected light",
        "brute_force": "every texel of the environment at every pixel",
    }
    summary: ClassVar[str] = "shadows of virtual objects on the receiver under the environment"
    subject: ClassVar[str] = "shadows and reflected light of virtual objects on the receiver"
    converges: ClassVar[bool] = True
    unseen_method: ClassVar[str | None] = "none"
    numerics: ClassVar[Numerics] = Numerics(
        "float32; a ratio of equal sums, exactly 1 where less than 1/512 is shaded",
        2e-3,
        "rays at the outlines of balls fall to either side",
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources read and written for a scene with light, objects that cast shadows, and a receiver."""
        scene, quality = features.request.scene, features.request.quality
        if not scene.objects:
            return LeftOut(base.NO_OBJECT)
        if not scene.proxies:
            return LeftOut("the scene has no proxy for a shadow to fall on")
        if not features.environment:
            return LeftOut(base.NO_BALL)
        if not features.shadowed:
            return LeftOut(f"the quality {quality.name!r} leaves out shadows of the environment")
        reads = ["pose", "objects", "environment_samples", "environment", *distant_light_reads(features)]
        if features.others:
            reads += [name for name in ("others_environment", "probe_places") if name not in reads]
        if METHODS[quality.method(cls.name)].bounce == "traced":
            reads += frame_reads(features)
        return Wiring(tuple(reads), ("shadow_ratio",))

    def idle(self, reach: Reach) -> str | None:
        """Return the reason for no effect in a frame if no virtual object shades anything in the picture, else None."""
        return None if reach.shadows else "no virtual object is near anything in the picture"

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Declare the arrays of the shadow ratio, and of the cells' estimates that are averaged to it."""
        cells = shadow_cells(self.features)
        return {
            "shadow_ratio": ArraySpec(self.shape, wp.vec3, wp.vec3(1.0, 1.0, 1.0)),
            "environment_shadow_ratio": ArraySpec(cells, wp.vec4),
            "environment_shadow_filtered": ArraySpec(cells, wp.vec3),
            "environment_shadow_surface": ArraySpec(cells, wp.int32, -1),
            "environment_shadow_bounced": ArraySpec(cells, wp.vec3),
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Return passes for the estimates, then for their means."""
        config = shadow_config(self.features, device)
        queue = None
        if not device.is_cpu:
            size = shadow_cells(self.features)
            by_queue = dataclasses.replace(config, partials=kernels.count_partials(*size), queued=True)
            queue = kernels.make_queue(by_queue, *size, device)
            config = config if queue is None else by_queue
        distant = make_distant_light(self.features, arrays)
        distant.environment = arrays["environment"]
        if self.features.others:
            distant.others = make_other_balls(self.features, arrays, self.wiring.reads)
        params, scene, cells = arrays["params"], arrays["ray_scene"], self._cells(arrays)
        picture = find_picture(arrays, frame=config.bounce == "traced")
        sets = SampleSets()
        sets.directions, sets.flux, sets.samples = (arrays[name] for name in sample_names(self.features))
        given = params, picture, scene, distant, sets
        shadow_rows, stride, count = arrays["shadow_rows"], int(cells.stride), cells.surface.shape[0]

        def cell_rows() -> Rows:
            start, stop = shadow_rows()
            reach = config.side  # the filter reads beyond the rows that it writes
            return max(start // stride - reach, 0), min(-(-stop // stride) + reach, count)

        own = config, *given, cells
        estimates = over_rows(count, kernels.shade_environment, *own, ShadowQueue(), extent=cell_rows)
        if queue is not None:
            estimates = Pass(lambda _: kernels.shade_by_queue(*own, queue))
        seen = params, arrays["rays"], scene, arrays["probes"], cells, arrays["shadow_ratio"]
        return [
            estimates,
            over_rows(count, filters.filter_ratio, config, cells, extent=cell_rows),
            over_rows(self.height, filters.spread_ratio, config, *seen, extent=GrowingRows(shadow_rows)),
        ]

    def _cells(self, arrays: Arrays) -> ShadowCells:
        """Return the ``ShadowCells`` of the stage's arrays."""
        names = "ratio", "bounced", "surface", "filtered"
        stride = find_stride(METHODS[self.method], self.height)
        return filled(ShadowCells(), stride=stride, **{name: arrays[f"{self.name}_{name}"] for name in names})
