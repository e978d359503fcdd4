"""The picture at the camera's own exposure."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import warp as wp

from warp_ar.kernels import composite
from warp_ar.kernels.codes import by_warps
from warp_ar.kernels.launch import copy
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Pass, Request, Rows, Stage, Wiring
from warp_ar.stages.variants import composite_variant


class Composite(Stage):
    """Lays virtual light and virtual objects over the frame."""

    name = "composite"
    methods = ("default",)
    summary = "frame, virtual light on the desk and virtual objects, in linear light"

    @classmethod
    def wire(cls, request: Request) -> Wiring | LeftOut:
        """Left out where nothing is laid over the frame, and where the exposure stage does it in its own pass."""
        layers = layer_names(request)
        if exposes(request):
            return LeftOut("the exposure stage composes what it exposes")
        if not layers:
            return LeftOut("nothing virtual is laid over the frame")
        return Wiring(("frame", *layers), ("image",))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """The picture."""
        width, height = self.request.size
        return {"image": ArraySpec((height, width), wp.vec3ub)}

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """On CPU a plain copy, then a pass over the rows that a layer can reach; on CUDA one pass over all."""
        config = composite_config(layer_names(self.request))
        width, height = self.request.size
        variant = composite_variant(config, device)
        composite.make_composite_kernel(variant, by_warps(device, width))
        image, frame, layers = arrays["image"], arrays["frame"], layers_of(arrays)

        def launch(rows: Rows | None) -> None:
            composite.composite(
                variant,
                arrays["params"],
                frame,
                arrays["decode"],
                arrays["encode"],
                layers,
                image,
                rows=rows,
            )

        if not device.is_cpu:
            return [Pass(launch, rows=height)]
        extents = [arrays["object_rows"]] * config.virtual + [arrays["light_rows"]] * config.added
        extents += [arrays["shadow_rows"]] * config.ratio + [arrays["ball_rows"]] * config.mirrored
        return [Pass(lambda rows: copy(image, frame)), Pass(launch, rows=height, extent=union_of(extents))]


def layer_names(request: Request) -> tuple[str, ...]:
    """Resources that are laid over the frame."""
    scene = request.scene
    layers = []
    if scene.objects:
        layers.append("virtual")
    if scene.lights and scene.proxies:
        layers.append("physical_added")
    if shadows_environment(request):
        layers.append("shadow_ratio")
    if layers and mirrors_virtual(request):
        layers.append("mirrored")
    return tuple(layers)


def mirrors_virtual(request: Request) -> bool:
    """Whether balls are to show what is virtual."""
    return bool(request.scene.probes) and request.quality.method("mirror_ball") not in ("default", "none")


def shadows_environment(request: Request) -> bool:
    """Whether virtual objects change the environment on the desk."""
    scene = request.scene
    wanted = request.quality.method("environment_shadow") not in ("default", "none")
    return bool(wanted and scene.objects and scene.proxies and scene.probes)


def shares_environment(request: Request) -> bool:
    """Whether relighting asks which part of the environment reaches the desk."""
    scene = request.scene
    asks = request.quality.method("relight") in ("bounce", "brute_force")
    return bool(asks and scene.lights and scene.proxies and scene.probes)


def exposes(request: Request) -> bool:
    """Whether the scene asks for another exposure; ``auto`` does where virtual light falls on the desk."""
    scale = request.scene.exposure.scale
    return "physical_added" in layer_names(request) if isinstance(scale, str) else scale != 1.0


def layers_of(arrays: Arrays) -> composite.Layers:
    """The layers that there are, as kernels read them."""
    names = ("virtual", "physical_added", "shadow_ratio", "mirrored")
    return composite.make_layers(*(arrays.get(name) for name in names))


def composite_config(layers: tuple[str, ...]) -> composite.CompositeConfig:
    """Which layers to compile in."""
    return composite.CompositeConfig(
        virtual="virtual" in layers,
        added="physical_added" in layers,
        ratio="shadow_ratio" in layers,
        mirrored="mirrored" in layers,
    )


def union_of(extents: list[Callable[[], Rows]]) -> Callable[[], Rows]:
    """The rows from the first to the last of several extents, of which some may be empty."""

    def union() -> Rows:
        filled = [rows for rows in (extent() for extent in extents) if rows[1] > rows[0]]
        return (min(rows[0] for rows in filled), max(rows[1] for rows in filled)) if filled else (0, 0)

    return union
