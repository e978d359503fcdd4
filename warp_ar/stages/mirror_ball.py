"""What mirror balls show of what is virtual."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels import mirror_ball
from warp_ar.kernels.reflect import DistantLight
from warp_ar.kernels.relight import RelightConfig, make_receiver
from warp_ar.scene.ray_scene import trace_config
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Numerics, Pass, Rows, Stage, Wiring
from warp_ar.stages.features import Features
from warp_ar.stages.shared.distant_light import distant_light_arrays, distant_light_reads, make_distant_light
from warp_ar.stages.shared.picture import make_picture
from warp_ar.stages.shared.relighting import relight_config, relight_reads
from warp_ar.stages.shared.rows import GrowingRows
from warp_ar.stages.shared.shading import shade_config

SAMPLES: Mapping[str, int] = {"single": 1, "smooth": 4, "brute_force": 64}
"""Rays per pixel, by method; cheapest first, after ``none``."""


def mirror_config(features: Features) -> mirror_ball.MirrorBallConfig:
    """What the mirrored part of a request's scene calls for."""
    layers = features.layers
    # What a ball shows of an object is too small for what surrounds it at close range.
    shading = None
    if "virtual" in layers:
        shading = dataclasses.replace(shade_config(features), near_field=False, edge_samples=1)
    lit = "physical_added" in layers
    return mirror_ball.MirrorBallConfig(
        trace_config(features.request.scene),
        SAMPLES[features.request.quality.method("mirror_ball")],
        shading,
        mirrored_relighting(features) if lit else None,
        "shadow_ratio" in layers,
    )


def mirrored_relighting(features: Features) -> RelightConfig:
    """How the desk that a ball shows responds: cells of the frame say nothing about it."""
    return dataclasses.replace(relight_config(features), ambient_visibility=False, bounced=False)


class MirrorBall(Stage):
    """Virtual objects, light and shadow as the mirror balls of the frame show them."""

    name: ClassVar[str] = "mirror_ball"
    methods: ClassVar[Mapping[str, str]] = {
        "none": "nothing (the paper)",
        "single": "one ray per pixel",
        "smooth": "4 rays per pixel",
        "brute_force": "64 rays per pixel",
    }
    summary: ClassVar[str] = "what the mirror ball in the picture shows of virtual objects, light and shadows"
    subject: ClassVar[str] = "what the mirror ball in the picture shows of virtual objects"
    converges: ClassVar[bool] = True
    unseen_method: ClassVar[str | None] = "none"
    numerics: ClassVar[Numerics] = Numerics(
        precision="float32; points put back onto the ball and onto what it mirrors",
        bound=2e-4,
        cause="twenty roundings, turned by the ball's curvature; edges fall to either side",
        measured=1.8e-05,
        rows=(1, 3, 5, 6, 8, 9, 13, 14, 17, 18),
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Reads what the objects and the desk are lit by."""
        quality = features.request.quality
        if not features.request.scene.probes:
            return LeftOut("the scene has no mirror ball")
        if quality.method(cls.name) not in SAMPLES:
            return LeftOut(f"the quality {quality.name!r} leaves the ball as the camera saw it")
        layers = features.layers
        if "mirrored" not in layers:
            return LeftOut("the scene has nothing virtual that a ball could mirror")
        reads = {"pose", "frame"}
        if "virtual" in layers:
            reads |= {"objects", *distant_light_reads(features)}
            reads |= {"lights"} if shade_config(features).lights else set()
        if "physical_added" in layers:
            # The ball shows the desk too small for a pixel's surroundings to mean anything.
            reads |= set(relight_reads(features)) - {"summed_area", "environment_samples"}
        if "shadow_ratio" in layers:
            reads.add("shadow_ratio")
        return Wiring(tuple(sorted(reads)), ("mirrored",))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """The change, and the table of reflectance where materials need it."""
        width, height = self.request.size
        return {
            "mirrored": ArraySpec((height, width), wp.vec3),
            **distant_light_arrays(self.features, self.name),
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """One pass over the rows in which a ball can be."""
        config = mirror_config(self.features)
        mirror_ball.make_mirror_ball_kernel(config)
        reads = self.wiring.reads
        relighting = mirrored_relighting(self.features)
        irradiance = self.features.irradiance
        lit = config.relight is not None
        receiver = make_receiver(
            relighting,
            make_picture(arrays),
            probes=arrays["probes"],
            key_lights=arrays["key_lights"] if "key_lights" in reads else None,
            irradiance=arrays[irradiance] if lit and irradiance in reads else None,
            emitters=arrays["lamps"] if "lamps" in reads else None,
        )
        shading = config.shade
        distant = DistantLight() if shading is None else make_distant_light(self.features, arrays, self.name)
        inputs = (
            arrays["params"],
            arrays["ray_scene"],
            arrays["light_array"] if "lights" in reads else None,
            distant,
            receiver,
            arrays["shadow_ratio"] if config.ratio else None,
        )

        def launch(rows: Rows | None) -> None:
            mirror_ball.mirror_ball(config, *inputs, arrays["mirrored"], rows=rows)

        return [Pass(launch, rows=self.request.size[1], extent=GrowingRows(arrays["ball_rows"]))]
