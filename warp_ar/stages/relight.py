"""Virtual light on the physical desk."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels import receiver_cells, relight
from warp_ar.kernels.environment_shadow import count_parts
from warp_ar.kernels.structs import PLANE
from warp_ar.scene.ray_scene import trace_config
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Numerics, Pass, Rows, Stage, Wiring
from warp_ar.stages.features import Features
from warp_ar.stages.request import Request
from warp_ar.stages.shared.edge_lists import edge_arrays, make_edge_lists
from warp_ar.stages.shared.environment_sets import SAMPLES
from warp_ar.stages.shared.relighting import relight_config, relight_reads
from warp_ar.stages.shared.rows import GrowingRows
from warp_ar.stages.shared.variants import relight_variant


@dataclasses.dataclass(frozen=True)
class Grain:
    """How finely cells of the desk are estimated."""

    samples: int
    """Of the environment, for its share."""
    share: int
    """Pixels per cell of the environment's share, in frames of ``STRIDE_ROWS`` rows; 1 is every pixel of any frame."""
    bounced: int
    """The same, of bounced light."""
    patch: int
    """The same, of what sends it."""


GRAINS: Mapping[str, Grain] = MappingProxyType({"bounce": Grain(128, 4, 8, 16), "brute_force": Grain(SAMPLES, 1, 1, 4)})
"""By method of ``features.LOCAL``: else these are ``reflectance``."""
STRIDE_ROWS = 480


class Relight(Stage):
    """Adds what virtual lights send to the proxies, shadowed, to the desk in the frame."""

    name: ClassVar[str] = "relight"
    methods: ClassVar[Mapping[str, str]] = {
        "flat": "on a grey desk",
        "paper": "blended by the frame's brightness (the paper)",
        "relief": "the paper's blend, relief told from paint",
        "reflectance": "on the reflectance that frame and environment light give",
        "bounce": "the same, knowing the environment's own shadows, and what lit surfaces send each other",
        "brute_force": "the same at every pixel, with 1,024 rays and patches of 4 pixels",
    }
    summary: ClassVar[str] = "virtual light and its shadows on the physical desk"
    subject: ClassVar[str] = "virtual light on the real desk"
    settings: ClassVar[tuple[str, ...]] = (
        "edge_samples",
        "light_shadow",
    )
    unseen_method: ClassVar[str | None] = "paper"
    numerics: ClassVar[Numerics] = Numerics(
        precision="float32 over an integer table; sums over samples and patches",
        bound=5e-5,
        cause="a dozen roundings, sums over a thousand terms; shadow edges fall to either side",
        measured=3e-07,
        rows=(5, 6, 9, 10, 13, 14, 17),
    )

    @classmethod
    def method_for(cls, features: Features) -> str:
        """``flat`` where no ball tells anything of the environment."""
        return features.relight_method

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Reads what its method needs to know of the environment and the desk."""
        if not features.request.scene.lights:
            return LeftOut("the scene has no virtual light")
        if not features.lit:
            return LeftOut("the scene has no proxy for virtual light to fall on")
        return Wiring(relight_reads(features), ("physical_added",))

    def runs_after(self) -> tuple[str, ...]:
        """Only the picture waits for both; what objects mirror of the desk waits for this alone longer."""
        return () if self.features.near_field else ("environment_shadow",)

    def arrays(self) -> Mapping[str, ArraySpec]:
        """The added radiance, and cells of what it is made from."""
        width, height = self.request.size
        specs = {"physical_added": ArraySpec((height, width), wp.vec3)}
        if self.request.quality.edge_samples > 1:
            specs["relight_seen"] = ArraySpec((height, width), wp.int32)
            specs |= edge_arrays(self.request, self.name)
        if self.features.ambient_visibility:
            cells = _cells(self.request, _grain(self.features).share)
            specs["relight_share"] = ArraySpec(cells, wp.vec3)
            specs["relight_share_surface"] = ArraySpec(cells, wp.int32, -1)
        if self.features.bounced:
            grain = _grain(self.features)
            cells, patches = _cells(self.request, grain.bounced), _cells(self.request, grain.patch)
            specs["relight_bounced"] = ArraySpec(cells, wp.vec3)
            specs["relight_bounced_surface"] = ArraySpec(cells, wp.int32, -1)
            specs["relight_patches"] = ArraySpec(patches, receiver_cells.Patch, receiver_cells.Patch())
            specs["relight_listed"] = ArraySpec(patches, receiver_cells.Patch, receiver_cells.Patch())
            specs["relight_count"] = ArraySpec(patches[:1], wp.int32)
        return specs

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Cells, then one pass over the rows that light can reach."""
        reads, irradiance = self.wiring.reads, self.features.irradiance
        config = relight_variant(relight_config(self.features), self.features, device)
        relight.make_relight_kernel(config)
        cells = make_cells(self.features, arrays)
        distant = arrays[irradiance] if irradiance in reads else None
        known = (
            arrays["frame"],
            arrays["decode"],
            arrays["summed_area"] if "summed_area" in reads else None,
            arrays["ray_scene"],
            arrays["probes"],
            arrays["light_array"],
            arrays["key_lights"] if "key_lights" in reads else None,
            distant,
        )
        lamps = arrays["lamps"] if "lamps" in reads else None
        camera = arrays["params"], arrays["rays"]
        added, seen = arrays["physical_added"], arrays["relight_seen"] if config.edge_samples > 1 else None

        def launch(rows: Rows | None) -> None:
            relight.relight(config, *camera, *known, added, seen, lamps=lamps, cells=cells, rows=rows)

        height = self.request.size[1]
        light_rows = arrays["light_rows"]
        last = [Pass(launch, rows=height, extent=GrowingRows(light_rows))]
        frame, decode, table, scene, probes, lights, key_lights, _ = known
        desk = relight.make_receiver(config, frame, decode, table, probes, key_lights, distant, lamps, cells)
        if config.edge_samples > 1:
            lists = make_edge_lists(arrays, device, self.name)

            def smooth(rows: Rows | None) -> None:
                relight.smooth_edges(config, *camera, scene, lights, desk, seen, added, edge_lists=lists, rows=rows)

            relight.make_smooth_edges_kernel(config, left=lists is not None)
            if lists is not None:
                relight.make_sample_edges_kernel(config)
            last.append(Pass(smooth, rows=height, extent=light_rows))
        if not (config.share or config.bounced):
            return last

        place = receiver_cells.CellConfig(_keep_planes(config, self.request))
        passes: list[Pass] = []

        def rows_of(size: int, count: int, margin: int) -> Callable[[], Rows]:
            """Rows of cells that pixels in the light's rows look up; what stands in the others is never read."""

            def extent() -> Rows:
                start, stop = light_rows()
                if stop <= start:
                    return 0, 0
                return max(start // size - margin, 0), min(-(-stop // size) + margin, count)

            return extent

        grain = _grain(self.features)
        if config.share:
            share, surface, size = arrays["relight_share"], arrays["relight_share_surface"], cells.share_stride
            parts = 1 if device.is_cpu else count_parts(*share.shape, receiver_cells.SHARE_PARTS)
            sums = None
            if parts > 1:
                sums = wp.empty(receiver_cells.share_sums_shape(parts, *share.shape), dtype=wp.vec3, device=device)

            def estimate(rows: Rows | None, bounced: bool = False) -> None:
                own = arrays["environment_samples"], grain.samples, size, share, surface
                more = {"bounced": bounced, "sums_out": sums, "rows": rows}
                receiver_cells.share_environment(place, *camera, scene, lights, desk, *own, **more)

            receiver_cells.make_share_environment_kernel(place)
            passes.append(Pass(estimate, rows=len(share), extent=rows_of(size, len(share), 2)))
        if config.bounced:
            patches, listed, count = (arrays[f"relight_{name}"] for name in ("patches", "listed", "count"))
            bounced, lit = arrays["relight_bounced"], arrays["relight_bounced_surface"]
            step, wide = cells.bounced_stride, _stride(self.request, grain.patch)

            def send(rows: Rows | None) -> None:
                receiver_cells.send_light(place, *camera, scene, lights, desk, wide, patches, rows=rows)

            def arrange(rows: Rows | None) -> None:
                receiver_cells.list_patches(patches, listed, count, rows=rows)

            def gather(rows: Rows | None) -> None:
                receiver_cells.gather_light(
                    place, *camera, scene, desk, listed, count, wide, step, bounced, lit, rows=rows
                )

            receiver_cells.make_send_light_kernel(place)
            receiver_cells.make_gather_light_kernel(place)
            lit_patches = rows_of(wide, len(patches), 0)
            passes.append(Pass(send, rows=len(patches), extent=lit_patches))
            passes.append(Pass(arrange, rows=len(patches), extent=lit_patches))
            passes.append(Pass(gather, rows=len(bounced), extent=rows_of(step, len(bounced), 2)))
            if config.share:
                again = functools.partial(estimate, bounced=True)
                passes.append(Pass(again, rows=len(share), extent=rows_of(size, len(share), 2)))
        return passes + last


def _keep_planes(config: relight.RelightConfig, request: Request) -> relight.RelightConfig:
    """Where all proxies are planes, cells know that: most of their rays are then left out."""
    proxies = trace_config(request.scene).proxies
    if not set(proxies) <= {int(PLANE)}:
        return config
    return dataclasses.replace(config, trace=dataclasses.replace(config.trace, proxies=proxies))


def _grain(features: Features) -> Grain:
    return GRAINS[features.relight_method]


def _stride(request: Request, pixels: int) -> int:
    """Pixels per cell, growing with the frame."""
    return 1 if pixels == 1 else max(1, round(pixels * request.size[1] / STRIDE_ROWS))


def _cells(request: Request, pixels: int) -> tuple[int, int]:
    width, height = request.size
    stride = _stride(request, pixels)
    return -(-height // stride), -(-width // stride)


def make_cells(features: Features, arrays: Arrays) -> relight.ReceiverCells:
    """The cells of a request as kernels read them."""
    cells = relight.ReceiverCells()
    if features.relight_method in GRAINS:
        grain, request = _grain(features), features.request
        cells.share_stride, cells.bounced_stride = _stride(request, grain.share), _stride(request, grain.bounced)
    if features.ambient_visibility:
        cells.share, cells.share_surface = arrays["relight_share"], arrays["relight_share_surface"]
    if features.bounced:
        cells.bounced, cells.bounced_surface = arrays["relight_bounced"], arrays["relight_bounced_surface"]
    return cells
