"""Virtual light on the physical desk."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import warp as wp

from warp_ar.kernels import relight
from warp_ar.ray_scene import trace_config
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Pass, Request, Rows, Stage, Wiring
from warp_ar.stages.room_samples import knows_lamps
from warp_ar.stages.shade import casts_soft, sees_near
from warp_ar.stages.visibility import GrowingRows


class Relight(Stage):
    """Adds what virtual lights send to the proxies, shadowed, to the desk in the frame."""

    name = "relight"
    rungs = relight.RUNGS
    summary = "virtual light and its shadows on the physical desk"

    @classmethod
    def wire(cls, request: Request) -> Wiring | LeftOut:
        """Reads what its rung needs to know of the room and the desk."""
        if not request.scene.lights:
            return LeftOut("the scene has no virtual light")
        if not request.scene.proxies:
            return LeftOut("the scene has no proxy for virtual light to fall on")
        rung = relight_rung(request)
        reads = ["pose", "lights", "objects"]
        if rung != "flat":
            reads += ["frame", "key_lights"]
        if rung in ("relief", "reflectance"):
            reads.append("summed_area")
        if rung == "reflectance":
            reads.append(irradiance_name(request))
            reads += ["lamps"] * knows_lamps(request)
        return Wiring(tuple(reads), ("physical_added",))

    def gives_way(self) -> tuple[str, ...]:
        """Only the picture waits for both; what objects mirror of the desk waits for this alone longer."""
        return () if sees_near(self.request) else ("room_shadow",)

    def arrays(self) -> Mapping[str, ArraySpec]:
        """The added radiance."""
        width, height = self.request.size
        return {"physical_added": ArraySpec((height, width), wp.vec3)}

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """One pass over the rows that light can reach."""
        reads, irradiance = self.wiring.reads, irradiance_name(self.request)
        config = relight_config(self.request)
        relight.make_relight_kernel(config)

        def launch(rows: Rows | None) -> None:
            relight.relight(
                config,
                arrays["params"],
                arrays["rays"],
                arrays["frame"],
                arrays["decode"],
                arrays["summed_area"] if "summed_area" in reads else None,
                arrays["ray_scene"],
                arrays["probes"],
                arrays["light_array"],
                arrays["key_lights"] if "key_lights" in reads else None,
                arrays[irradiance] if irradiance in reads else None,
                arrays["physical_added"],
                lamps=arrays["lamps"] if "lamps" in reads else None,
                rows=rows,
            )

        return [Pass(launch, rows=self.request.size[1], extent=GrowingRows(arrays["light_rows"]))]


def relight_config(request: Request) -> relight.RelightConfig:
    """What the relighting of a request's desk calls for."""
    rung = relight_rung(request)
    return relight.RelightConfig(
        rung,
        trace_config(request.scene),
        "sh" if irradiance_name(request) == "irradiance_sh" else "map",
        bool(request.scene.probes),
        casts_soft(request),
        rung == "reflectance" and knows_lamps(request),
    )


def relight_rung(request: Request) -> str:
    """The quality's rung, or ``flat`` where no ball tells anything of the room."""
    return request.quality.rung(Relight.name) if request.scene.probes else relight.RUNGS[0]


def irradiance_name(request: Request) -> str:
    """Resource that holds the room's irradiance at this quality."""
    return "irradiance_sh" if request.quality.rung("diffuse") == "sh2" else "irradiance_map"
