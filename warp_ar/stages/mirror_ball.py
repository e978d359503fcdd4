"""Stage ``mirror_ball``: reflections of virtual content in mirror balls."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels.objects.reflect import DistantLight
from warp_ar.kernels.receiver import mirror_ball
from warp_ar.kernels.receiver.receiver import RelightConfig
from warp_ar.scene.kinds import trace_config
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Numerics, Pass, Reach, Stage, Wiring, over_rows
from warp_ar.stages.features import Features
from warp_ar.stages.shared import lighting
from warp_ar.stages.shared.picture import GrowingRows, frame_reads

SIDES: Mapping[str, int] = {"single": 1, "smooth": 2, "brute_force": 8}
"""Square roots of the rays per pixel, by method; cheapest first, after ``none``."""


def mirror_config(features: Features) -> mirror_ball.MirrorBallConfig:
    """Return the kernel's configuration with only the features that the scene needs."""
    layers = features.layers
    shading = lighting.mirrored_shading(features) if "virtual" in layers else None
    lit = "added_light" in layers
    return mirror_ball.MirrorBallConfig(
        trace_config(features.request.scene),
        shading,
        mirrored_relighting(features) if lit else None,
        "shadow_ratio" in layers,
    )


def mirror_variant(features: Features, device: Any) -> mirror_ball.MirrorBallConfig:
    """Return the kernel's configuration to compile: the scene's own on CUDA, one for any scene on CPU."""
    if not lighting.shares_kernels(device):
        return mirror_config(features)
    return mirror_ball.MirrorBallConfig(
        lighting.trace_variant(trace_config(features.request.scene), device),
        lighting.shade_variant(lighting.mirrored_shading(features), features, device),
        lighting.relight_variant(mirrored_relighting(features), features, device),
        ratio=True,
    )


def mirrored_relighting(features: Features) -> RelightConfig:
    """Return the configuration for relighting the receiver in reflections, without cells of the frame."""
    return dataclasses.replace(
        lighting.relight_config(features), ambient_visibility=False, bounced=False, area_cells=False
    )


def _reads(features: Features, *, lit: bool) -> set[str]:
    """Return the resources that light the objects and, if ``lit``, the receiver."""
    reads = {"pose", *frame_reads(features)}
    if "virtual" in features.layers:
        reads |= {"objects", *lighting.distant_light_reads(features)}
        reads |= {"lights"} if lighting.shade_config(features).lights else set()
    if lit:
        reads |= set(lighting.relight_reads(features)) - {"environment_samples"}
    if features.shadowed:
        reads.add("shadow_ratio")
    return reads


class MirrorBall(Stage):
    """Computes reflections of virtual objects, light and shadow in the frame's mirror balls."""

    name: ClassVar[str] = "mirror_ball"
    methods: ClassVar[Mapping[str, str]] = {
        "none": "nothing",
        "single": "one ray per pixel",
        "smooth": "4 rays per pixel",
        "brute_force": "64 rays per pixel",
    }
    summary: ClassVar[str] = "reflections of virtual objects, light and shadows in the mirror ball"
    subject: ClassVar[str] = "reflections of virtual objects in the mirror ball"
    converges: ClassVar[bool] = True
    unseen_method: ClassVar[str | None] = "none"
    numerics: ClassVar[Numerics] = Numerics(
        "float32; points put back onto the ball and onto what it mirrors",
        2e-4,
        "twenty roundings, turned by the ball's curvature; edges fall to either side",
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources read and written, with the resources that light the objects and the receiver."""
        quality = features.request.quality
        if not features.request.scene.probes:
            return LeftOut("the scene has no mirror ball")
        if quality.method(cls.name) not in SIDES:
            return LeftOut(f"the quality {quality.name!r} leaves the ball as the camera saw it")
        if "mirror_ball" not in features.layers:
            return LeftOut("the scene has nothing virtual that a ball could mirror")
        return Wiring(tuple(sorted(_reads(features, lit=features.lit))), ("mirror_ball",))

    def idle(self, reach: Reach) -> str | None:
        """Return the reason that no ball shows a change, or None. Objects outside the picture may be reflected."""
        if not reach.balls:
            return "no mirror ball is in the picture"
        dark = not reach.falls and not self.request.scene.objects
        return "virtual light falls on nothing" if dark else None

    def reads_for(self, reach: Reach) -> tuple[str, ...]:
        """Return the inputs that are read: those of the receiver's response only if virtual light falls on it."""
        if reach.falls:
            return self.wiring.reads
        unlit = _reads(self.features, lit=False)
        return tuple(name for name in self.wiring.reads if name in unlit)

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Declare the array of the change of each pixel's radiance."""
        return {"mirror_ball": ArraySpec(self.shape, wp.vec3)}

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Return one pass over the rows in which a ball can be."""
        config = mirror_config(self.features)
        variant = mirror_variant(self.features, device)
        reads = self.wiring.reads
        receiver = lighting.find_receiver(mirrored_relighting(self.features), self.features, arrays, reads)
        distant = DistantLight() if config.shade is None else lighting.make_distant_light(self.features, arrays)
        inputs = (
            arrays["params"],
            arrays["ray_scene"],
            arrays["light_array"] if "lights" in reads else None,
            distant,
            receiver,
            arrays["shadow_ratio"] if config.ratio else None,
        )
        out, extent = arrays["mirror_ball"], GrowingRows(arrays["ball_rows"])
        side = SIDES[self.request.quality.method(self.name)]
        return [over_rows(self.height, mirror_ball.mirror_ball, variant, *inputs, side, out, extent=extent)]
