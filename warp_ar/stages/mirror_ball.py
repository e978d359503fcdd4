"""What mirror balls show of what is virtual."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels import mirror_ball
from warp_ar.kernels.reflect import DistantLight
from warp_ar.kernels.relight import RelightConfig, make_receiver
from warp_ar.kernels.shade import ShadeConfig
from warp_ar.scene.ray_scene import trace_config
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Pass, Request, Rows, Stage, Wiring
from warp_ar.stages.composite import layer_names, mirrors_virtual
from warp_ar.stages.reflect import distant_light_arrays, distant_light_config, distant_light_reads, make_distant_light
from warp_ar.stages.relight import Relight, irradiance_name, relight_config
from warp_ar.stages.shade import shade_config
from warp_ar.stages.variants import relight_variant, shade_variant, shares_kernels, trace_variant
from warp_ar.stages.visibility import GrowingRows

SAMPLES: Mapping[str, int] = {"single": 1, "smooth": 4, "brute_force": 64}
"""Rays per pixel, by method; cheapest first, after ``none``."""


def mirror_config(request: Request) -> mirror_ball.MirrorBallConfig:
    """What the mirrored part of a request's scene calls for."""
    layers = layer_names(request)
    shading = mirrored_shading(request) if "virtual" in layers else None
    lit = "physical_added" in layers
    return mirror_ball.MirrorBallConfig(
        trace_config(request.scene),
        SAMPLES[request.quality.method("mirror_ball")],
        shading,
        mirrored_relighting(request) if lit else None,
        "shadow_ratio" in layers,
    )


def mirror_variant(request: Request, device: Any) -> mirror_ball.MirrorBallConfig:
    """What is compiled: where any scene shares it, a scene without objects or lights finds none when it looks."""
    if not shares_kernels(device):
        return mirror_config(request)
    return mirror_ball.MirrorBallConfig(
        trace_variant(trace_config(request.scene), device),
        SAMPLES[request.quality.method("mirror_ball")],
        shade_variant(mirrored_shading(request), request, device),
        relight_variant(mirrored_relighting(request), request, device),
        ratio=True,
    )


def mirrored_shading(request: Request) -> ShadeConfig:
    """How objects look: what a ball shows of one is too small for what surrounds it at close range."""
    return dataclasses.replace(shade_config(request), near=False, edge_samples=1)


def mirrored_relighting(request: Request) -> RelightConfig:
    """How the desk that a ball shows responds: cells of the frame say nothing about it."""
    return dataclasses.replace(relight_config(request), share=False, bounced=False)


class MirrorBall(Stage):
    """Virtual objects, light and shadow as the mirror balls of the frame show them."""

    name: ClassVar[str] = "mirror_ball"
    methods: ClassVar[tuple[str, ...]] = ("none", *SAMPLES)
    summary: ClassVar[str] = "what the mirror ball in the picture shows of virtual objects, light and shadows"

    @classmethod
    def wire(cls, request: Request) -> Wiring | LeftOut:
        """Reads what the objects and the desk are lit by."""
        if not request.scene.probes:
            return LeftOut("the scene has no mirror ball")
        if not mirrors_virtual(request):
            return LeftOut(f"the quality {request.quality.name!r} leaves the ball as the camera saw it")
        layers = layer_names(request)
        if "mirrored" not in layers:
            return LeftOut("the scene has nothing virtual that a ball could mirror")
        reads = {"pose", "frame"}
        if "virtual" in layers:
            config = shade_config(request)
            reads |= {"objects", *distant_light_reads(config.distant)}
            reads |= {"lights"} if config.lights else set()
        if "physical_added" in layers:
            # The ball shows the desk too small for a pixel's surroundings to mean anything.
            wiring = Relight.wire(request)
            assert isinstance(wiring, Wiring)
            reads |= set(wiring.reads) - {"summed_area", "environment_samples"}
        if "shadow_ratio" in layers:
            reads.add("shadow_ratio")
        return Wiring(tuple(sorted(reads)), ("mirrored",))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """The change, and the table of reflectance where materials need it."""
        width, height = self.request.size
        return {
            "mirrored": ArraySpec((height, width), wp.vec3),
            **distant_light_arrays(distant_light_config(self.request), self.name),
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """One pass over the rows in which a ball can be."""
        config = mirror_config(self.request)
        variant = mirror_variant(self.request, device)
        mirror_ball.make_mirror_ball_kernel(variant)
        reads = self.wiring.reads
        relighting = mirrored_relighting(self.request)
        irradiance = irradiance_name(self.request)
        lit = config.relight is not None
        desk = make_receiver(
            relighting,
            arrays["frame"],
            arrays["decode"],
            None,
            arrays["probes"],
            arrays["key_lights"] if "key_lights" in reads else None,
            arrays[irradiance] if lit and irradiance in reads else None,
            arrays["lamps"] if "lamps" in reads else None,
        )
        shading = config.shade
        distant = (
            DistantLight() if shading is None else make_distant_light(shading.distant, self.request, arrays, self.name)
        )
        inputs = (
            arrays["params"],
            arrays["rays"],
            arrays["ray_scene"],
            arrays["light_array"] if "lights" in reads else None,
            distant,
            desk,
            arrays["shadow_ratio"] if config.ratio else None,
        )

        def launch(rows: Rows | None) -> None:
            mirror_ball.mirror_ball(variant, *inputs, arrays["mirrored"], rows=rows)

        return [Pass(launch, rows=self.request.size[1], extent=GrowingRows(arrays["ball_rows"]))]
