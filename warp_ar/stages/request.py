"""Requests: the input of a plan."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal, TypeAlias

from warp_ar.scene import Scene
from warp_ar.stages.quality import Quality


@dataclasses.dataclass(frozen=True)
class Layer:
    """A layer of the picture, or what is known of each of its pixels, that can be asked for by name."""

    resource: str
    """Array that holds it."""
    neutral: float | None
    """Its value where it changes or says nothing; None: the frame itself."""
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
"""Every layer, by the name by which ``outputs`` ask for it; one that a scene does not call for is neutral."""
PICTURE_LAYERS = ("plate", "objects", "shadow_ratio", "added_light", "mirror_ball")
"""Those that make the picture."""


Estimates: TypeAlias = Literal["synchronous", "delayed", "real_time"]
"""When light that is estimated from a frame takes effect: in that frame, which waits for it; a fixed time later; or as
soon as a process beside the frames has it, so that no frame waits and pictures of two runs may differ by when it is."""


@dataclasses.dataclass(frozen=True)
class Request:
    """Input of a plan; equal requests give equal plans."""

    scene: Scene
    """Scene to show."""
    quality: Quality
    """The method of every stage, and its numbers."""
    size: tuple[int, int]
    """Width and height of the frames in pixels."""
    outputs: tuple[str, ...] = ("image",)
    """Names of what the caller wants: ``image``, ``environment``, ``pose``, and any of ``LAYERS``."""
    exposures: tuple[float, ...] = ()
    """Exposures between which frames alternate, longest first, over the one that is shown; empty: only one."""
    estimates: Estimates = "delayed"
    """When light that is estimated from a frame takes effect."""
    emitters: bool = False
    """True if a captured light comes with its emitters' places, as ``Pipeline.take_light`` gives them."""
    linear: bool = False
    """True if frames come as linear radiance too, of more than 8 bits."""

    @property
    def resources(self) -> tuple[str, ...]:
        """Resources that hold the outputs."""
        return tuple(LAYERS[name].resource if name in LAYERS else name for name in self.outputs)

    @property
    def asks_for_layers(self) -> bool:
        """True if a layer is one of the outputs."""
        return not LAYERS.keys().isdisjoint(self.outputs)

    def asks_for(self, resource: str) -> bool:
        """Return whether a resource is one of the outputs."""
        return resource in self.resources
