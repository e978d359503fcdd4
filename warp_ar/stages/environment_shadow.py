"""What virtual objects do to the environment on the desk."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import warp as wp

from warp_ar.kernels import environment_shadow
from warp_ar.stages.base import NO_BALL, NO_OBJECT, Arrays, ArraySpec, LeftOut, Numerics, Pass, Rows, Stage, Wiring
from warp_ar.stages.features import Features
from warp_ar.stages.shared.distant_light import distant_light_arrays, distant_light_reads, make_distant_light
from warp_ar.stages.shared.environment_sets import REFERENCE_SIZE, sample_names
from warp_ar.stages.shared.rows import GrowingRows
from warp_ar.stages.shared.variants import distant_variant


@dataclasses.dataclass(frozen=True)
class Method:
    """How many rays, for how many pixels."""

    count: int
    """Samples of the environment per estimate."""
    side: int
    """Estimates along a tile."""
    stride: int
    """Pixels from one estimate to the next in frames of ``STRIDE_ROWS`` rows."""
    bounce: Literal["estimated", "traced"]
    """How what objects reflect onto the desk is found."""
    asking: float = 1.0
    """Share of the rays that asks for it: light that takes rays to find is smooth, and half of them find it."""


METHODS: Mapping[str, Method] = {
    "coarse": Method(32, 4, 5, "estimated"),
    "bounce": Method(64, 4, 2, "traced", 0.5),
    "brute_force": Method(REFERENCE_SIZE[0] * REFERENCE_SIZE[1], 1, 1, "traced"),
}
"""Cheapest first, after ``none``."""


STRIDE_ROWS = 480
"""Rows of a frame for which the strides of ``METHODS`` are."""


def cell_size(method: Method, rows: int) -> int:
    """Pixels from one estimate to the next, growing as the root of the frame's rows.

    So estimates grow in number as the rows, not as the pixels, and larger pictures still have finer shadows.
    """
    return method.stride if method.stride == 1 else max(1, round(method.stride * math.sqrt(rows / STRIDE_ROWS)))


class EnvironmentShadow(Stage):
    """A factor on the frame: the environment with the virtual objects over that without them."""

    name: ClassVar[str] = "environment_shadow"
    methods: ClassVar[Mapping[str, str]] = {
        "none": "none (the paper)",
        "coarse": "32 rays per estimate, every fifth pixel, and an estimate of reflected light",
        "bounce": "64 rays, every second pixel, and reflected light by a ray for half of them",
        "brute_force": "every texel of the environment at every pixel",
    }
    summary: ClassVar[str] = "shadows of virtual objects on the desk under the environment"
    subject: ClassVar[str] = "shadows of virtual objects in the environment, and light reflected onto the receiver"
    converges: ClassVar[bool] = True
    unseen_method: ClassVar[str | None] = "none"
    numerics: ClassVar[Numerics] = Numerics(
        precision="float32; a ratio of equal sums, exactly 1 where less than 1/512 is shaded",
        bound=2e-3,
        cause="rays at the rims of balls fall to either side",
        measured=5.4e-06,
        rows=(5, 6, 8, 13, 14, 17, 18),
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Needs something that throws a shadow, something that it falls on, and light."""
        scene, quality = features.request.scene, features.request.quality
        if not scene.objects:
            return LeftOut(NO_OBJECT)
        if not scene.proxies:
            return LeftOut("the scene has no proxy for a shadow to fall on")
        if not features.environment:
            return LeftOut(NO_BALL)
        if not features.shadowed:
            return LeftOut(f"the quality {quality.name!r} leaves out shadows of the environment")
        reads = [
            "pose",
            "objects",
            "environment_samples",
            "environment",
            *distant_light_reads(features),
        ]
        if METHODS[quality.method(cls.name)].bounce == "traced":
            reads.append("frame")
        return Wiring(tuple(reads), ("shadow_ratio",))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """The ratio, and the estimates that it is averaged from."""
        width, height = self.request.size
        stride = cell_size(METHODS[self.method], height)
        cells = -(-height // stride), -(-width // stride)
        specs = {
            "shadow_ratio": ArraySpec((height, width), wp.vec3, wp.vec3(1.0, 1.0, 1.0)),
            "environment_shadow_ratio": ArraySpec(cells, wp.vec4),
            "environment_shadow_filtered": ArraySpec(cells, wp.vec3),
            "environment_shadow_surface": ArraySpec(cells, wp.int32, -1),
            "environment_shadow_shaded": ArraySpec(environment_shadow.shaded_shape(*cells), wp.int32, -1),
            "environment_shadow_seen": ArraySpec(environment_shadow.shaded_shape(*cells), wp.int32, -1),
            "environment_shadow_bounced": ArraySpec(cells, wp.vec3),
        }
        return {**specs, **distant_light_arrays(self.features, self.name)}

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Estimates, then their mean."""
        method = METHODS[self.method]
        forms = distant_variant(self.features, device)
        near = self.features.emitters
        cells = arrays["environment_shadow_ratio"].shape
        parts = 1 if device.is_cpu else environment_shadow.count_parts(*cells)
        config = environment_shadow.EnvironmentShadowConfig(
            forms, method.count, method.side, method.bounce, method.asking, near, parts
        )
        steps = None if device.is_cpu else environment_shadow.make_steps(config, *cells, device)
        sums = None
        if steps is None:
            environment_shadow.make_environment_shadow_kernel(config)
            if parts > 1:
                sums = wp.empty(environment_shadow.sums_shape(parts, *cells), dtype=wp.vec3, device=device)
        environment_shadow.make_filter_ratio_kernel(method.side)
        environment_shadow.make_spread_ratio_kernel(forms)
        distant = make_distant_light(self.features, arrays, self.name)
        distant.environment = arrays["environment"]
        ratio, bounced, surface, filtered = (
            arrays[f"environment_shadow_{name}"] for name in ("ratio", "bounced", "surface", "filtered")
        )
        out = arrays["shadow_ratio"]
        frame = arrays["frame"] if method.bounce == "traced" else None
        inputs = [arrays["params"], arrays["rays"], frame, arrays["decode"], arrays["ray_scene"]]
        shadow_rows, stride = arrays["shadow_rows"], cell_size(method, self.request.size[1])

        def cell_rows() -> Rows:
            start, stop = shadow_rows()
            reach = method.side  # the filter looks beyond the rows that it writes
            return max(start // stride - reach, 0), min(-(-stop // stride) + reach, ratio.shape[0])

        params, shaded, seen = arrays["params"], arrays["environment_shadow_shaded"], arrays["environment_shadow_seen"]
        samples = [arrays[name] for name in sample_names(self.features)]

        def estimate(rows: Rows | None) -> None:
            environment_shadow.shade_environment(
                config,
                *inputs,
                distant,
                *samples,
                stride,
                ratio,
                bounced,
                surface,
                shaded_out=shaded,
                sums_out=sums,
                steps=steps,
                rows=rows,
            )

        def average(rows: Rows | None) -> None:
            environment_shadow.filter_ratio(
                ratio, bounced, surface, method.side, filtered, params=params, shaded=shaded, seen_out=seen, rows=rows
            )

        def spread(rows: Rows | None) -> None:
            environment_shadow.spread_ratio(
                forms,
                params,
                arrays["rays"],
                arrays["ray_scene"],
                arrays["probes"],
                filtered,
                surface,
                stride,
                out,
                seen=seen,
                rows=rows,
            )

        return [
            Pass(estimate, rows=ratio.shape[0], extent=cell_rows),
            Pass(average, rows=ratio.shape[0], extent=cell_rows),
            Pass(spread, rows=self.request.size[1], extent=GrowingRows(shadow_rows)),
        ]
