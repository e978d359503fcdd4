"""Request: the input of a plan."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal, TypeAlias

from warp_ar.scene import Scene
from warp_ar.stages.quality import Quality


@dataclasses.dataclass(frozen=True)
class Layer:
    """Layer of the picture, or a property of each pixel, that can be requested by name."""

    resource: str
    """Name of its array."""
    neutral: float | None
    """Value where the layer has no content; None: the frame itself."""
    summary: str
    """Meaning and unit."""


LAYERS: Mapping[str, Layer] = MappingProxyType(
    {
        "plate": Layer("plate", None, "the frame as linear radiance, 1 where the camera clips"),
        "objects": Layer("layer_objects", 0.0, "virtual objects: premultiplied linear radiance, coverage"),
        "shadow_ratio": Layer("layer_shadow_ratio", 1.0, "factor on the plate: shadows of the environment's light"),
        "added_light": Layer("layer_added_light", 0.0, "linear radiance that virtual lights add to the plate"),
        "mirror_ball": Layer(
            "layer_mirror_ball", 0.0, "change of the plate's radiance in the mirror balls, and in receivers that mirror"
        ),
        "ids": Layer("surface_ids", -1.0, "surface at the pixel's centre: objects, then proxies, then balls; -1: none"),
        "coverage": Layer("coverage", 0.0, "four surfaces that cover most of a pixel: number and share in turn"),
        "depth": Layer("depth", float("inf"), "metres along the camera's axis at the pixel's centre; infinite: none"),
        "normals": Layer("normals", 0.0, "unit normal at the pixel's centre, world, toward the camera"),
        "position": Layer("position", 0.0, "place at the pixel's centre, world, metres"),
        "motion": Layer("motion", 0.0, "pixels that the surface has moved since the frame before: x right, y down"),
    }
)
"""Layers by their names in ``outputs``; a layer that a scene does not need has its neutral value."""
PICTURE_LAYERS = ("plate", "objects", "shadow_ratio", "added_light", "mirror_ball")
"""Layers of which the picture is composed."""


Estimates: TypeAlias = Literal["synchronous", "delayed", "real_time"]
"""Frame in which light estimated from a frame takes effect: the same frame, which waits for it; a fixed time later; or
as soon as a separate process has it, so that no frame waits and pictures of two runs may differ."""


@dataclasses.dataclass(frozen=True)
class Request:
    """Input of a plan; equal requests give equal plans."""

    scene: Scene
    """Scene to show."""
    quality: Quality
    """Method of every stage, and sizes."""
    size: tuple[int, int]
    """Width and height of the frames in pixels."""
    outputs: tuple[str, ...] = ("image",)
    """Names of the requested outputs: ``image``, ``environment``, ``pose``, and any of ``LAYERS``."""
    exposures: tuple[float, ...] = ()
    """Exposures of alternating frames relative to the shown one, longest first; empty: there is only one."""
    estimates: Estimates = "delayed"
    """Frame in which light estimated from a frame takes effect."""
    emitters: bool = False
    """True if a captured light has positions of its emitters, as passed to ``Pipeline.take_light``."""
    linear: bool = False
    """True if frames also come as linear radiance of more than 8 bits."""

    @property
    def resources(self) -> tuple[str, ...]:
        """Resources with the outputs."""
        return tuple(LAYERS[name].resource if name in LAYERS else name for name in self.outputs)

    @property
    def asks_for_layers(self) -> bool:
        """True if a layer is requested."""
        return not LAYERS.keys().isdisjoint(self.outputs)

    def asks_for(self, resource: str) -> bool:
        """Return True if a resource is requested."""
        return resource in self.resources
