"""Light that clipping lost in the ball is put back, by what the card and other surfaces show of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import warp as wp

from warp_ar import recovery
from warp_ar.kernels import environment
from warp_ar.kernels import recover as kernels
from warp_ar.kernels.structs import RoomLamp
from warp_ar.ray_scene import trace_config
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Pass, Request, Rows, Stage, Wiring
from warp_ar.stages.unwrap import NO_PROBE

EVERY_FRAME = 3
"""Frames at a stream's start that are each estimated from: clips of a few frames get all that recovery can do."""
EVERY_SECONDS = 0.2
"""Between estimates after that, and no fewer than ``EVERY_FRAME`` frames: light follows as fast as a switched lamp."""
MOST_LAMPS = recovery.MOST_CANDIDATES * len(recovery.DISTANCES)


class Recover(Stage):
    """Estimates what clipped texels lack from surfaces that the same light falls on.

    It comes after filling, not before: what the surfaces receive depends on the whole room, the part behind the ball
    included, and a lamp's recovered energy must not be spread into the unseen by filling.
    """

    name: ClassVar[str] = "recover"
    rungs: ClassVar[tuple[str, ...]] = recovery.RUNGS
    summary: ClassVar[str] = "puts back the light that clipping lost in the ball, by what it falls on"
    remembers: ClassVar[tuple[str, ...]] = ("recover_excess", "lamps")

    @classmethod
    def wire(cls, request: Request) -> Wiring | LeftOut:
        """Needs a mirror ball and a rung that does something."""
        if not request.scene.probes:
            return LeftOut(NO_PROBE)
        if not recovers(request):
            return LeftOut("the quality takes the light as the camera clipped it")
        return Wiring(
            ("filled_radiance", "environment_confidence", "environment_clipped", "frame", "pose"),
            ("environment", "lamps") if request.quality.rung(cls.name) == "shading" else ("environment",),
        )

    def arrays(self) -> Mapping[str, ArraySpec]:
        """The map, the two sides of the equations, and what readers have seen."""
        height = self.request.quality.environment_height
        shape = (height, 2 * height)
        cells = kernels.cell_shape(*shape)
        self._surfaces = recovery.find_surfaces(self.request.scene, card_only=self.rung == "white_card")
        points = len(self._surfaces.points)
        return {
            "environment": ArraySpec(shape, wp.vec3),
            **{name: ArraySpec((recovery.PEAKS,), RoomLamp) for name in self.wiring.writes if name == "lamps"},
            "recover_excess": ArraySpec(cells, wp.vec3),
            "recover_cells": ArraySpec(cells, kernels.Cell),
            "recover_points": ArraySpec((points,), kernels.SurfacePoint),
            "recover_observations": ArraySpec((points,), kernels.Observation),
            "recover_traced": ArraySpec((points,), wp.int32),
            "recover_transfer": ArraySpec((points, cells[0] * cells[1]), wp.float32),
            "recover_mirrored": ArraySpec((points, cells[0] * cells[1]), wp.float32),
            "recover_lamps": ArraySpec((MOST_LAMPS,), wp.vec4),
            "recover_lamp_transfer": ArraySpec((points, MOST_LAMPS), wp.float32),
            "recover_published": ArraySpec(shape, wp.vec3),
            "recover_difference": ArraySpec((height,), wp.float32),
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Both sides of the equations on the device, their solution on the host, and its effect on the map."""
        scene = self.request.scene
        height = self.request.quality.environment_height
        proxies = trace_config(scene).proxies
        self._arrays, self._on_cpu = arrays, device.is_cpu
        arrays["recover_points"].assign(self._surfaces.points)
        self._solver = recovery.Recovery(self._surfaces, scene.marker.white, scene.probes[0].center, rung=self.rung)
        cells = arrays["recover_cells"]
        points = len(self._surfaces.points)
        self.estimate: recovery.Estimate | None = None
        self._frames, self._waited, self._last = 0, 0, 0.0
        arrays.add("recover_status", self.status)

        def condense(rows: Rows | None) -> None:
            kernels.condense_cells(
                arrays["filled_radiance"],
                arrays["environment_confidence"],
                arrays["environment_clipped"],
                arrays["probes"],
                arrays["ray_scene"],
                cells,
                proxies=proxies,
                rows=rows,
            )

        def observe(rows: Rows | None) -> None:
            kernels.observe_surfaces(
                arrays["frame"],
                arrays["decode"],
                arrays["params"],
                arrays["probes"],
                arrays["ray_scene"],
                arrays["recover_points"],
                arrays["recover_observations"],
                proxies=proxies,
                rows=rows,
            )

        def transfer(rows: Rows | None) -> None:
            kernels.trace_transfer(
                arrays["recover_points"],
                arrays["recover_observations"],
                cells,
                arrays["probes"],
                arrays["ray_scene"],
                arrays["recover_traced"],
                arrays["recover_transfer"],
                arrays["recover_mirrored"],
                proxies=proxies,
                rows=rows,
            )

        def trace(lamps: Any) -> Any:
            count = len(lamps)
            target = arrays["recover_lamp_transfer"][:, :count]
            arrays["recover_lamps"][:count].assign(lamps)
            kernels.trace_lamps(
                arrays["recover_points"],
                arrays["recover_observations"],
                arrays["recover_lamps"][:count],
                arrays["probes"],
                arrays["ray_scene"],
                target,
                proxies=proxies,
            )
            return np.array(target.numpy(), np.float64)

        def solve(rows: Rows | None) -> None:
            due = self._due()
            self._frames += 1
            self._waited += 1
            if not due:
                return
            self._waited, self._last = 0, arrays["seconds"]()
            self.estimate = self._solver.update(
                cells.numpy(),
                arrays["recover_transfer"].numpy(),
                arrays["recover_mirrored"].numpy(),
                arrays["recover_observations"].numpy(),
                trace,
            )
            arrays["recover_excess"].assign(self.estimate.excess)

            records = np.zeros(recovery.PEAKS, np.dtype(RoomLamp.numpy_dtype()))
            for record, lamp in zip(records, self.estimate.lamps, strict=False):
                record["direction"], record["distance"], record["power"] = lamp.direction, lamp.distance, lamp.power
            if "lamps" in arrays:
                arrays["lamps"].assign(records)

        def add(rows: Rows | None) -> None:
            kernels.add_excess(
                arrays["filled_radiance"],
                arrays["environment_confidence"],
                arrays["environment_clipped"],
                cells,
                arrays["recover_excess"],
                arrays["environment"],
                rows=rows,
            )

        def measure(rows: Rows | None) -> None:
            environment.measure_difference(
                arrays["environment"], arrays["recover_published"], arrays["recover_difference"], rows=rows
            )

        passes = [
            Pass(condense, rows=cells.shape[0], extent=lambda: (0, cells.shape[0] * self._due())),
            Pass(observe, rows=points, extent=lambda: (0, points * self._due())),
            Pass(transfer, rows=points, extent=lambda: (0, points * self._due())),
            Pass(solve, on_host=True),
            Pass(add, rows=height),
        ]
        return [*passes, Pass(measure, rows=height)] if self._on_cpu else passes

    def _due(self) -> bool:
        """Whether this frame is one to estimate from."""
        waited = abs(self._arrays["seconds"]() - self._last) > EVERY_SECONDS - 1e-3
        return self._frames < EVERY_FRAME or (waited and self._waited + 1 >= EVERY_FRAME)

    def resume(self, other: Stage) -> None:
        """Keep the lamps that were found, and when; on another rung, or on another desk, look anew."""
        if not isinstance(other, Recover) or other.rung != self.rung:
            return
        mine, yours = self.request.scene, other.request.scene
        if (mine.marker, mine.probes, mine.proxies) == (yours.marker, yours.probes, yours.proxies):
            self._solver, self.estimate = other._solver, other.estimate
            self._frames, self._waited, self._last = other._frames, other._waited, other._last

    def changed(self, name: str) -> bool:
        """As ``Fill.changed``."""
        if not self._on_cpu or name == "lamps":
            return True
        if not self._arrays["recover_difference"].numpy().max() > 1.0:
            return False
        wp.copy(self._arrays["recover_published"], self._arrays["environment"])
        return True

    def status(self) -> Mapping[str, Any]:
        """What the last estimate rests on, for reports."""
        if self.estimate is None:
            return {}
        lamps = [
            {
                "direction": [round(float(x), 4) for x in lamp.direction],
                "distance": round(lamp.distance, 3) if np.isfinite(lamp.distance) else None,
                "power": [round(float(x), 4) for x in lamp.power],
            }
            for lamp in self.estimate.lamps
        ]
        return {"lower_bound": list(self.estimate.lower_bound), "lamps": lamps}


def recovers(request: Request) -> bool:
    """Whether the quality asks for recovery."""
    return request.quality.rung("recover") not in ("default", "clipped")
