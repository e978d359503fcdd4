"""Reflections of virtual content in mirror balls."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels.launch import takes_few_blocks
from warp_ar.kernels.objects.reflect import DistantLight
from warp_ar.kernels.receiver import mirror_ball
from warp_ar.kernels.receiver.receiver import RelightConfig, make_receiver
from warp_ar.scene.kinds import trace_config
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Numerics, Pass, Reach, Rows, Stage, Wiring, clearing
from warp_ar.stages.features import Features
from warp_ar.stages.shared.lighting import (
    distant_light_arrays,
    distant_light_reads,
    make_distant_light,
    make_other_balls,
    mirrored_shading,
    relight_config,
    relight_reads,
    relight_variant,
    shade_config,
    shade_variant,
    shares_kernels,
    trace_variant,
)
from warp_ar.stages.shared.picture import GrowingRows, find_picture, frame_reads

SAMPLES: Mapping[str, int] = {"single": 1, "smooth": 4, "brute_force": 64}
"""Rays per pixel, by method; cheapest first, after ``none``."""


def mirror_config(features: Features) -> mirror_ball.MirrorBallConfig:
    """What the mirrored part of a request's scene calls for."""
    layers = features.layers
    shading = mirrored_shading(features) if "virtual" in layers else None
    lit = "added_light" in layers
    return mirror_ball.MirrorBallConfig(
        trace_config(features.request.scene),
        shading,
        mirrored_relighting(features) if lit else None,
        "shadow_ratio" in layers,
    )


def mirror_variant(features: Features, device: Any) -> mirror_ball.MirrorBallConfig:
    """What is compiled: where any scene shares it, a scene without objects or lights finds none when it looks."""
    if not shares_kernels(device):
        return mirror_config(features)
    return mirror_ball.MirrorBallConfig(
        trace_variant(trace_config(features.request.scene), device),
        shade_variant(mirrored_shading(features), features, device),
        relight_variant(mirrored_relighting(features), features, device),
        ratio=True,
    )


def mirrored_relighting(features: Features) -> RelightConfig:
    """How the receiver that a ball shows responds: cells of the frame say nothing about it."""
    return dataclasses.replace(relight_config(features), ambient_visibility=False, bounced=False)


def _reads(features: Features, *, lit: bool) -> set[str]:
    """What objects and, if ``lit``, the receiver are lit by."""
    reads = {"pose", *frame_reads(features)}
    if "virtual" in features.layers:
        reads |= {"objects", *distant_light_reads(features)}
        reads |= {"lights"} if shade_config(features).lights else set()
    if lit:
        reads |= set(relight_reads(features)) - {"environment_samples"}
    if features.shadowed:
        reads.add("shadow_ratio")
    return reads


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
        """Reads what the objects and the receiver are lit by."""
        quality = features.request.quality
        if not features.request.scene.probes:
            return LeftOut("the scene has no mirror ball")
        if quality.method(cls.name) not in SAMPLES:
            return LeftOut(f"the quality {quality.name!r} leaves the ball as the camera saw it")
        if "mirror_ball" not in features.layers:
            return LeftOut("the scene has nothing virtual that a ball could mirror")
        return Wiring(tuple(sorted(_reads(features, lit=features.lit))), ("mirror_ball",))

    def idle(self, reach: Reach) -> str | None:
        """A ball may show what is out of the picture itself."""
        if not reach.balls:
            return "no mirror ball is in the picture"
        dark = not reach.falls and not self.request.scene.objects
        return "virtual light falls on nothing" if dark else None

    def reads_for(self, reach: Reach) -> tuple[str, ...]:
        """How the receiver responds matters only where virtual light falls on it."""
        if reach.falls:
            return self.wiring.reads
        unlit = _reads(self.features, lit=False)
        return tuple(name for name in self.wiring.reads if name in unlit)

    def arrays(self) -> Mapping[str, ArraySpec]:
        """The change, and the table of reflectance where materials need it."""
        width, height = self.request.size
        return {
            "mirror_ball": ArraySpec((height, width), wp.vec3),
            **distant_light_arrays(self.features, self.name),
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """One pass over the rows in which a ball can be."""
        config = mirror_config(self.features)
        variant = mirror_variant(self.features, device)
        mirror_ball.make_mirror_ball_kernel(variant)
        reads = self.wiring.reads
        relighting = mirrored_relighting(self.features)
        irradiance = self.features.irradiance
        lit = config.relight is not None
        samples = SAMPLES[self.request.quality.method(self.name)]
        receiver = make_receiver(
            relighting,
            find_picture(arrays),
            probes=arrays["probes"],
            key_lights=arrays["key_lights"] if "key_lights" in reads else None,
            irradiance=arrays[irradiance] if lit and irradiance in reads else None,
            emitters=arrays["emitters"] if "emitters" in reads else None,
            others=make_other_balls(self.features, arrays, reads),
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

        out = arrays["mirror_ball"]

        cleared = takes_few_blocks(mirror_ball.launch_shape(out.shape, samples, device), device)
        first = [clearing(out)] if cleared else []

        def launch(rows: Rows | None) -> None:
            mirror_ball.mirror_ball(variant, *inputs, out, samples=samples, cleared=cleared, rows=rows)

        if device.is_cpu or samples > 1 or not config.ratio:
            return [*first, Pass(launch, rows=self.request.size[1], extent=GrowingRows(arrays["ball_rows"]))]
        # All but the shadows comes first, and need not wait for them.
        shows = wp.full(out.shape, wp.vec2(-1.0, -1.0), dtype=wp.vec2, device=device)
        early = tuple(name for name in reads if name != "shadow_ratio")

        def trace(rows: Rows | None) -> None:
            mirror_ball.mirror_ball(variant, *inputs[:-1], None, out, shows_out=shows, cleared=cleared)

        def shade(rows: Rows | None) -> None:
            mirror_ball.shade_mirrored(arrays["params"], receiver.picture, arrays["shadow_ratio"], shows, out)

        return [*first, Pass(trace, reads=early), Pass(shade)]
