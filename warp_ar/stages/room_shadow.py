"""What virtual objects do to the room's light on the desk."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import warp as wp

from warp_ar.kernels import room_shadow
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Pass, Request, Rows, Stage, Wiring
from warp_ar.stages.composite import shades_room
from warp_ar.stages.recover import knows_lamps
from warp_ar.stages.reflect import make_room, room_arrays, room_config, room_reads
from warp_ar.stages.room_samples import REFERENCE_SIZE, sample_names
from warp_ar.stages.visibility import GrowingRows


@dataclasses.dataclass(frozen=True)
class Rung:
    """How many rays, for how many pixels."""

    count: int
    """Samples of the room per estimate."""
    side: int
    """Estimates along a tile."""
    stride: int
    """Pixels from one estimate to the next in frames of ``STRIDE_ROWS`` rows."""
    bounce: Literal["estimated", "traced"]
    """How what objects reflect onto the desk is found."""
    asking: float = 1.0
    """Share of the rays that asks for it: light that takes rays to find is smooth, and half of them find it."""


RUNGS: Mapping[str, Rung] = {
    "coarse": Rung(32, 4, 5, "estimated"),
    "bounce": Rung(64, 4, 2, "traced", 0.5),
    "brute_force": Rung(REFERENCE_SIZE[0] * REFERENCE_SIZE[1], 1, 1, "traced"),
}
"""Cheapest first, after ``none``."""


STRIDE_ROWS = 480
"""Rows of a frame for which the strides of ``RUNGS`` are."""


def cell_size(rung: Rung, rows: int) -> int:
    """Pixels from one estimate to the next, growing as the root of the frame's rows.

    So estimates grow in number as the rows, not as the pixels, and larger pictures still have finer shadows.
    """
    return rung.stride if rung.stride == 1 else max(1, round(rung.stride * math.sqrt(rows / STRIDE_ROWS)))


def bounces_light(request: Request) -> bool:
    """Whether virtual objects reflect light onto the desk, for which every material's light is read as a wide lobe."""
    return shades_room(request)


class RoomShadow(Stage):
    """A factor on the frame: the room's light with the virtual objects over that without them."""

    name: ClassVar[str] = "room_shadow"
    rungs: ClassVar[tuple[str, ...]] = ("none", *RUNGS)
    summary: ClassVar[str] = "shadows of virtual objects on the desk under the room's light"

    @classmethod
    def wire(cls, request: Request) -> Wiring | LeftOut:
        """Needs something that throws a shadow, something that it falls on, and light."""
        scene = request.scene
        if not scene.objects:
            return LeftOut("the scene has no virtual object")
        if not scene.proxies:
            return LeftOut("the scene has no proxy for a shadow to fall on")
        if not scene.probes:
            return LeftOut("the scene has no probe, so the room's light is unknown")
        if not shades_room(request):
            return LeftOut(f"the quality {request.quality.name!r} leaves out shadows of the room's light")
        reads = ["pose", "objects", "room_samples", "environment", *room_reads(room_config(request))]
        if RUNGS[request.quality.rung(cls.name)].bounce == "traced":
            reads.append("frame")
        return Wiring(tuple(reads), ("physical_ratio",))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """The ratio, and the estimates that it is averaged from."""
        width, height = self.request.size
        stride = cell_size(RUNGS[self.rung], height)
        cells = -(-height // stride), -(-width // stride)
        specs = {
            "physical_ratio": ArraySpec((height, width), wp.vec3, wp.vec3(1.0, 1.0, 1.0)),
            "room_shadow_ratio": ArraySpec(cells, wp.vec4),
            "room_shadow_filtered": ArraySpec(cells, wp.vec3),
            "room_shadow_surface": ArraySpec(cells, wp.int32, -1),
            "room_shadow_shaded": ArraySpec(room_shadow.shaded_shape(*cells), wp.int32, -1),
            "room_shadow_seen": ArraySpec(room_shadow.shaded_shape(*cells), wp.int32, -1),
            "room_shadow_bounced": ArraySpec(cells, wp.vec3),
        }
        return {**specs, **room_arrays(room_config(self.request), self.name)}

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Estimates, then their mean."""
        rung = RUNGS[self.rung]
        forms = room_config(self.request)
        near = knows_lamps(self.request)
        cells = arrays["room_shadow_ratio"].shape
        parts = 1 if device.is_cpu else room_shadow.count_parts(*cells)
        config = room_shadow.RoomShadowConfig(forms, rung.count, rung.side, rung.bounce, rung.asking, near, parts)
        steps = None if device.is_cpu else room_shadow.make_steps(config, *cells, device)
        sums = None
        if steps is None:
            room_shadow.make_room_shadow_kernel(config)
            if parts > 1:
                sums = wp.empty(room_shadow.sums_shape(parts, *cells), dtype=wp.vec3, device=device)
        room_shadow.make_filter_ratio_kernel(rung.side)
        room_shadow.make_spread_ratio_kernel(forms)
        room = make_room(forms, self.request, arrays, self.name)
        room.environment = arrays["environment"]
        ratio, bounced, surface, filtered = (
            arrays[f"room_shadow_{name}"] for name in ("ratio", "bounced", "surface", "filtered")
        )
        out = arrays["physical_ratio"]
        frame = arrays["frame"] if rung.bounce == "traced" else None
        inputs = [arrays["params"], arrays["rays"], frame, arrays["decode"], arrays["ray_scene"]]
        shadow_rows, stride = arrays["shadow_rows"], cell_size(rung, self.request.size[1])

        def cell_rows() -> Rows:
            start, stop = shadow_rows()
            reach = rung.side  # the filter looks beyond the rows that it writes
            return max(start // stride - reach, 0), min(-(-stop // stride) + reach, ratio.shape[0])

        params, shaded, seen = arrays["params"], arrays["room_shadow_shaded"], arrays["room_shadow_seen"]
        samples = [arrays[name] for name in sample_names(self.request)]

        def estimate(rows: Rows | None) -> None:
            room_shadow.shade_room(
                config,
                *inputs,
                room,
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
            room_shadow.filter_ratio(
                ratio, bounced, surface, rung.side, filtered, params=params, shaded=shaded, seen_out=seen, rows=rows
            )

        def spread(rows: Rows | None) -> None:
            room_shadow.spread_ratio(
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
