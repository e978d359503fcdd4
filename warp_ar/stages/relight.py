"""Stage ``relight``: virtual light on the receiver."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels.cells import SurfaceCells, cell_shape, cell_stride
from warp_ar.kernels.receiver import receiver_cells, relight
from warp_ar.kernels.receiver.environment_shadow import count_partials
from warp_ar.kernels.receiver.receiver import Receiver, ReceiverCells, RelightConfig
from warp_ar.kernels.structs import PLANE, filled
from warp_ar.scene.kinds import trace_config
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Numerics, Pass, Reach, Rows, Stage, Wiring, over_rows
from warp_ar.stages.features import AREA_CELLS, Features, area_method, sheds_light
from warp_ar.stages.request import Request
from warp_ar.stages.shared.edge_lists import edge_arrays, make_edge_lists
from warp_ar.stages.shared.environment_sets import SAMPLES
from warp_ar.stages.shared.lighting import find_receiver, relight_config, relight_reads, relight_variant
from warp_ar.stages.shared.picture import GrowingRows


@dataclasses.dataclass(frozen=True)
class Grain:
    """Resolution of the receiver's cells (blocks of pixels with one estimate each)."""

    samples: int
    """Samples of the environment for ambient visibility."""
    ambient: int
    """Pixels per cell of ambient visibility, in frames of ``STRIDE_ROWS`` rows; 1: a cell per pixel of any frame."""
    bounced: int = 1
    """Pixels per cell of bounced light, in frames of ``STRIDE_ROWS`` rows."""
    patch: int = 1
    """Pixels per patch that reflects bounced light, in frames of ``STRIDE_ROWS`` rows."""


GRAINS: Mapping[str, Grain] = MappingProxyType(
    {
        "reflectance": Grain(64, 8),
        "bounce": Grain(128, 4, 8, 16),
        "brute_force": Grain(SAMPLES, 1, 1, 4),
    }
)
"""Resolutions of the methods that measure the receiver's reflectance."""


class Relight(Stage):
    """Computes the radiance that virtual lights, with their shadows, add to the receiver in the frame."""

    name: ClassVar[str] = "relight"
    methods: ClassVar[Mapping[str, str]] = {
        "flat": "on a grey receiver",
        "paper": "blended by the frame's brightness",
        "reflectance": "times reflectance from frame and environment, with its shadows",
        "bounce": "the same, and light that lit surfaces reflect to each other",
        "brute_force": "the same at every pixel, 1,024 rays, patches of 4 pixels",
    }
    summary: ClassVar[str] = "virtual light and its shadows on the receiver"
    subject: ClassVar[str] = "virtual light on the receiver"
    settings: ClassVar[tuple[str, ...]] = ("edge_samples", "light_shadow", "area_light")
    unseen_method: ClassVar[str | None] = "paper"
    numerics: ClassVar[Numerics] = Numerics(
        "float32 over an integer table; sums over samples and patches",
        5e-5,
        "a dozen roundings, sums over a thousand terms; shadow edges fall to either side",
    )

    @classmethod
    def method_for(cls, features: Features) -> str:
        """Return the quality's method; ``flat`` without an environment."""
        return features.relight_method

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources read and written, among them those of environment and receiver that the method uses."""
        if not sheds_light(features.request.scene):
            return LeftOut("the scene has no virtual light")
        if not features.lit:
            return LeftOut("the scene has no proxy for virtual light to fall on")
        return Wiring(relight_reads(features), ("added_light",))

    def runs_after(self) -> tuple[str, ...]:
        """Return ``environment_shadow``, or no stage if a near field would wait longer for this stage."""
        return () if self.features.near_field else ("environment_shadow",)

    def idle(self, reach: Reach) -> str | None:
        """Return the reason for no effect if no light has power or reaches the receiver in the picture, else None."""
        if not reach.shines:
            return "no virtual light has any power"
        return None if reach.light else "virtual light falls on nothing in the picture"

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Declare the arrays of the added radiance, and the cells from which it is computed."""
        specs = {"added_light": ArraySpec(self.shape, wp.vec3)}
        if self.request.quality.edge_samples > 1:
            specs["relight_visibility"] = ArraySpec(self.shape, wp.int32)
            specs |= edge_arrays(self.request, self.name)
        for name, stride in _strides(self.features).items():
            cells = cell_shape(self.request.size, stride)
            specs[f"relight_{name}"] = ArraySpec(cells, wp.vec3)
            specs[f"relight_{name}_surface"] = ArraySpec(cells, wp.int32, -1)
        if self.features.bounced:
            patches = cell_shape(self.request.size, _patch_stride(self.features))
            specs["relight_patches"] = ArraySpec(patches, receiver_cells.Patch, receiver_cells.Patch())
            specs["relight_listed"] = ArraySpec(patches, receiver_cells.Patch, receiver_cells.Patch())
            specs["relight_count"] = ArraySpec(patches[:1], wp.int32)
        return specs

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Return passes for the cells, then one over the rows that light can reach."""
        config = relight_variant(relight_config(self.features), self.features, device)
        receiver = find_receiver(config, self.features, arrays, self.wiring.reads, make_cells(self.features, arrays))
        inputs = arrays["params"], arrays["ray_scene"], arrays["light_array"], receiver
        added, light_rows = arrays["added_light"], arrays["light_rows"]
        visibility = arrays["relight_visibility"] if config.edge_samples > 1 else None
        passes = self._cell_passes(config, inputs, arrays)
        own = config, *inputs, added, visibility
        passes.append(over_rows(self.height, relight.relight, *own, extent=GrowingRows(light_rows)))
        if config.edge_samples > 1:
            named: dict[str, Any] = {"edge_lists": make_edge_lists(arrays, device, self.name), "extent": light_rows}
            passes.append(over_rows(self.height, relight.smooth_edges, config, *inputs, visibility, added, **named))
        return passes

    def _cell_passes(self, config: RelightConfig, inputs: tuple[Any, Any, Any, Receiver], arrays: Arrays) -> list[Pass]:
        """Return passes for ambient visibility and bounced light of cells, if the method uses them."""
        params, scene, _, receiver = inputs
        cells, light_rows = receiver.cells, arrays["light_rows"]
        place = _keep_planes(config, self.request)
        passes: list[Pass] = []
        parts: Any = None
        if config.ambient_visibility:
            shape, device = cells.ambient.values.shape, arrays["params"].device
            threads = 1 if device.is_cpu else count_partials(*shape)
            parts = wp.empty((*shape, threads), dtype=receiver_cells.LightPart, device=device)

        def rows_of(size: int, count: int, margin: int) -> Callable[[], Rows]:
            """Return a function that returns the rows of cells read by pixels with virtual light, plus ``margin``."""

            def extent() -> Rows:
                start, stop = light_rows()
                if stop <= start:
                    return 0, 0
                return max(start // size - margin, 0), min(-(-stop // size) + margin, count)

            return extent

        def ambient_passes(bounced: bool) -> list[Pass]:
            samples = arrays["environment_samples"][: _grain(self.features).samples]
            sums = receiver_cells.sum_ambient_light, place, *inputs, samples, bounced, cells.ambient, parts
            shares = receiver_cells.find_ambient_visibility, parts, bounced, cells.ambient
            return [cell_pass(cells.ambient, *sums), cell_pass(cells.ambient, *shares)]

        def cell_pass(cells: SurfaceCells, launcher: Callable[..., None], *given: Any) -> Pass:
            count = len(cells.values)
            extent = rows_of(int(cells.stride), count, int(receiver_cells.MARGIN))
            return over_rows(count, launcher, *given, extent=extent)

        if config.area_cells:
            samples = AREA_CELLS[area_method(self.request.quality)][0]
            asked = dataclasses.replace(place, area_samples=samples)
            passes.append(
                cell_pass(cells.area, receiver_cells.estimate_area_light, asked, params, scene, receiver, cells.area)
            )
        if config.ambient_visibility:
            passes += ambient_passes(bounced=False)
        if config.bounced:
            patches, listed, count = (arrays[f"relight_{name}"] for name in ("patches", "listed", "count"))
            wide = _patch_stride(self.features)
            lit = rows_of(wide, len(patches), 0)
            gather = receiver_cells.gather_light, place, params, scene, receiver, listed, count, wide
            passes += [
                over_rows(len(patches), receiver_cells.send_light, place, *inputs, wide, patches, extent=lit),
                over_rows(len(patches), receiver_cells.list_patches, patches, listed, count, extent=lit),
                cell_pass(cells.bounced, *gather, cells.bounced),
            ]
            if config.ambient_visibility:
                passes += ambient_passes(bounced=True)
        return passes


def _keep_planes(config: RelightConfig, request: Request) -> RelightConfig:
    """Return ``config`` restricted to planes if all proxies are planes, which saves most rays of the cells."""
    proxies = trace_config(request.scene).proxies
    if not set(proxies) <= {int(PLANE)}:
        return config
    return dataclasses.replace(config, trace=dataclasses.replace(config.trace, proxies=proxies))


def _grain(features: Features) -> Grain:
    return GRAINS[features.relight_method]


def _patch_stride(features: Features) -> int:
    return int(cell_stride(_grain(features).patch, features.request.size[1]))


def _strides(features: Features) -> dict[str, int]:
    """Return the pixels along a cell for each result per cell that the request needs."""
    pixels = {}
    if features.ambient_visibility:
        pixels["ambient"] = _grain(features).ambient
    if features.bounced:
        pixels["bounced"] = _grain(features).bounced
    if features.area_cells:
        pixels["area"] = AREA_CELLS[area_method(features.request.quality)][1]
    return {name: cell_stride(count, features.request.size[1]) for name, count in pixels.items()}


def make_cells(features: Features, arrays: Arrays) -> ReceiverCells:
    """Return the ``ReceiverCells`` of the stage's arrays."""
    cells = {}
    for name, stride in _strides(features).items():
        values, surface = arrays[f"relight_{name}"], arrays[f"relight_{name}_surface"]
        cells[name] = filled(SurfaceCells(), values=values, surface=surface, stride=stride)
    return filled(ReceiverCells(), **cells)
