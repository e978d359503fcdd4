"""The layers among a pipeline's outputs: on the device, copied to the host, and those of a lost frame."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ar.device import exclusive
from warp_ar.errors import UsageError
from warp_ar.stages.base import Arrays
from warp_ar.stages.request import LAYERS, PICTURE_LAYERS, Request

RADIANCE = "radiance"
"""Asks for the five layers that the picture is composed of, so that ``Result.radiance`` is there."""
OUTPUTS = ("image", "environment", "pose", RADIANCE)
"""Outputs of results beside layers."""

_COMPONENTS = {"objects": 4, "coverage": 8, "motion": 2, "ids": 0, "depth": 0}
"""Numbers per pixel of those layers that have not three; 0: the pixel is the number."""


def check_outputs(outputs: Sequence[str]) -> None:
    """Check the names of outputs.

    Raises:
        UsageError: There is no output of that name.
    """
    known = (*OUTPUTS, *LAYERS)
    for name in outputs:
        if name not in known:
            close = difflib.get_close_matches(str(name), known, 1)
            hint = f"did you mean {close[0]!r}? " if close else ""
            raise UsageError(f"outputs: {name!r} is unknown; {hint}expected any of {', '.join(known)}")


@dataclasses.dataclass(frozen=True)
class LayerArrays:
    """The layers of one frame where they lie, valid until the next is rendered."""

    arrays: Mapping[str, Any]
    """Warp arrays or NumPy arrays, by the layers' names."""
    scale: Any = None
    """(1,) array of the exposure's scale; None: it is 1."""

    def with_plate(self, radiance: npt.NDArray[np.float32], clip: npt.NDArray[np.float32]) -> LayerArrays:
        """With the plate at its full depth; where that clips too, what was guessed of it stays.

        Args:
            radiance: (height, width, 3).
            clip: From which on each channel clips, (3,).
        """
        if "plate" not in self.arrays:
            return self
        deep = radiance
        if np.isfinite(clip).any():
            deep = np.where(radiance >= clip, np.maximum(radiance, copied(self.arrays["plate"])), radiance)
        return dataclasses.replace(self, arrays={**self.arrays, "plate": deep})

    def to_host(self) -> LayerArrays:
        """Return copies on the host: float32 (height, width[, components]), ``ids`` int32."""
        scale = None if self.scale is None else copied(self.scale)
        return LayerArrays({name: copied(array) for name, array in self.arrays.items()}, scale)


def copied(array: Any) -> npt.NDArray[Any]:
    """A copy of one's own of a Warp array, or of one of the host."""
    if not isinstance(array, wp.array):
        return np.array(array)
    with exclusive(array.device):
        return np.array(array.numpy())


def expand_outputs(outputs: Sequence[str]) -> tuple[str, ...]:
    """Outputs with the layers that ``radiance`` is composed of in its place."""
    wanted = [name for output in outputs for name in (PICTURE_LAYERS if output == RADIANCE else (output,))]
    return tuple(dict.fromkeys(wanted))


def compose_layers(layers: Mapping[str, npt.NDArray[Any]]) -> npt.NDArray[np.float32]:
    """Linear radiance of the picture, (height, width, 3), of its five layers; scaled by the exposure it is encoded."""
    physical = layers["plate"] * layers["shadow_ratio"] + layers["added_light"] + layers["mirror_ball"]
    objects = layers["objects"]
    # A plate in wide primaries may be negative where nothing is laid over it; there it stays as it is.
    laid = (layers["shadow_ratio"] != 1.0) | (layers["added_light"] != 0.0) | (layers["mirror_ball"] != 0.0)
    physical = np.where(laid, np.maximum(physical, 0.0), physical)
    picture: npt.NDArray[np.float32] = (1.0 - objects[..., 3:]) * physical + objects[..., :3]
    return picture


def layer_arrays(request: Request, arrays: Arrays) -> LayerArrays:
    """The layers that a request asks for, of its pipeline's arrays."""
    found = {name: arrays[LAYERS[name].resource] for name in request.outputs if name in LAYERS}
    return LayerArrays(found, arrays["expose_scale"] if found and "expose_scale" in arrays else None)


def neutral_layers(request: Request, frame: Any, decode: npt.NDArray[np.float32]) -> LayerArrays:
    """Layers of a frame over which nothing is laid, such as one whose marker is lost.

    Args:
        request: Names the layers.
        frame: The frame, uint8 RGB (height, width, 3), or a Warp array of it.
        decode: (256, 3) linear value of each code.
    """
    width, height = request.size
    found: dict[str, Any] = {}
    for name in request.outputs:
        if name not in LAYERS:
            continue
        neutral = LAYERS[name].neutral
        if neutral is None:
            codes = copied(frame)
            found[name] = np.stack([decode[codes[..., c], c] for c in range(3)], axis=-1).astype(np.float32)
            continue
        components = _COMPONENTS.get(name, 3)
        shape = (height, width, components) if components else (height, width)
        found[name] = np.full(shape, neutral, np.int32 if name == "ids" else np.float32)
        if name == "coverage":
            found[name][..., 0::2] = -1.0
    return LayerArrays(found)
