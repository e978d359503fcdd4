"""Layers of the picture, such as depth, as outputs of a pipeline: on the device, on the host, and without a marker."""

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
"""Name of an output that stands for the five layers from which ``Result.radiance`` composes the picture."""
OUTPUTS = ("image", "environment", "pose", RADIANCE)
"""Outputs that are not layers."""

_COMPONENTS = {"objects": 4, "coverage": 8, "motion": 2, "ids": 0, "depth": 0}
"""Number of components per pixel of layers, by name; 0 stands for an array (height, width). Other layers have three."""


def check_outputs(outputs: Sequence[str]) -> None:
    """Check the names of outputs.

    Raises:
        UsageError: A name is unknown.
    """
    known = (*OUTPUTS, *LAYERS)
    for name in outputs:
        if name not in known:
            close = difflib.get_close_matches(str(name), known, 1)
            hint = f"did you mean {close[0]!r}? " if close else ""
            raise UsageError(f"outputs: {name!r} is unknown; {hint}expected any of {', '.join(known)}")


@dataclasses.dataclass(frozen=True)
class LayerArrays:
    """Layers of one frame in the pipeline's memory, valid until the next frame is rendered."""

    arrays: Mapping[str, Any]
    """Warp arrays or NumPy arrays, by the layers' names."""
    scale: Any = None
    """Array (1,) of the exposure's scale; None: the scale is 1."""

    def with_plate(self, radiance: npt.NDArray[np.float32], clip: npt.NDArray[np.float32]) -> LayerArrays:
        """Return the layers with the plate, the frame before anything virtual, at its full bit depth.

        In channels that clip, the plate is the larger of ``radiance`` and the present layer, which estimates clipped
        values.

        Args:
            radiance: Linear radiance of the frame at full bit depth, (height, width, 3).
            clip: Radiance at which each channel clips, (3,).
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
    """Return a host copy of a Warp or NumPy array."""
    if not isinstance(array, wp.array):
        return np.array(array)
    with exclusive(array.device):
        return np.array(array.numpy())


def expand_outputs(outputs: Sequence[str]) -> tuple[str, ...]:
    """Return the outputs with ``radiance`` replaced by the five layers of the picture."""
    wanted = [name for output in outputs for name in (PICTURE_LAYERS if output == RADIANCE else (output,))]
    return tuple(dict.fromkeys(wanted))


def compose_layers(layers: Mapping[str, npt.NDArray[Any]]) -> npt.NDArray[np.float32]:
    """Return the picture's linear radiance, (height, width, 3), composed of five layers and not scaled by the exposure.

    Args:
        layers: Arrays of the layers, by name.
    """
    physical = layers["plate"] * layers["shadow_ratio"] + layers["added_light"] + layers["mirror_ball"]
    objects = layers["objects"]
    # Wide primaries may make the plate negative. Pixels without virtual content keep such values.
    laid = (layers["shadow_ratio"] != 1.0) | (layers["added_light"] != 0.0) | (layers["mirror_ball"] != 0.0)
    physical = np.where(laid, np.maximum(physical, 0.0), physical)
    picture: npt.NDArray[np.float32] = (1.0 - objects[..., 3:]) * physical + objects[..., :3]
    return picture


def layer_arrays(request: Request, arrays: Arrays) -> LayerArrays:
    """Return the requested layers from the pipeline's arrays."""
    found = {name: arrays[LAYERS[name].resource] for name in request.outputs if name in LAYERS}
    return LayerArrays(found, arrays["expose_scale"] if found and "expose_scale" in arrays else None)


def neutral_layers(request: Request, frame: Any, decode: npt.NDArray[np.float32]) -> LayerArrays:
    """Return the layers of a frame without virtual content, such as one whose marker is lost.

    Args:
        request: Request with the names of the layers.
        frame: The frame, uint8 RGB (height, width, 3), or a Warp array of it.
        decode: Linear value of each 8-bit code, (256, 3).
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
