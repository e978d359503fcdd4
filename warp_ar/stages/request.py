"""What a plan is made for."""

from __future__ import annotations

import dataclasses

from warp_ar.scene import Scene
from warp_ar.stages.quality import Quality


@dataclasses.dataclass(frozen=True)
class Request:
    """What a plan is made for; equal requests give equal plans."""

    scene: Scene
    """What the user wants to see."""
    quality: Quality
    """The method of every stage, and its numbers."""
    size: tuple[int, int]
    """Width and height of the frames in pixels."""
    outputs: tuple[str, ...] = ("image",)
    """Names of the resources that the caller wants: ``image``, ``environment``, ``pose``."""
    exposures: tuple[float, ...] = ()
    """Exposures between which frames alternate, longest first, over the one that is shown; empty: only one."""
    synchronous: bool = False
    """Whether a frame waits for what is estimated from it; else that takes effect some frames later."""
