"""Layers of frames as files: one OpenEXR of several parts per frame, and PNGs of those layers that PNG can hold.

    picture = (1 - alpha) max(plate * shadow_ratio + added_light + mirror_ball, 0) + objects
    code = encode(exposureScale * picture)

The first part, ``picture``, is that sum as linear radiance, there where all five layers are. Radiance and ratios are
16-bit floats, as compositors expect; depth, positions, motion and numbers of surfaces have 32 bits. A part is named as
its layer, and so are its channels (``objects.R``), but for those that OpenEXR names itself: ``R``, ``G``, ``B``, ``A``
of the picture and ``Z`` of the depth. ``coverage`` becomes Cryptomatte's ``CryptoObject``.

PNGs lie in a folder per layer: the plate in the codes of the camera; numbers of surfaces, 1 more than in ``ids``, 0 for
none; depth in tenths of a millimetre, 0 where there is nothing or it is beyond 6.5535 m; normals as 32767.5 (n + 1).
"""

from __future__ import annotations

import dataclasses
import functools
import pathlib
from collections.abc import Callable, Mapping
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import OpenEXR

from warp_ar.engine.layers import compose_layers
from warp_ar.errors import SinkError, reason
from warp_ar.exr_file import write_exr
from warp_ar.files import write_whole
from warp_ar.output.cryptomatte import matte_channels, matte_header
from warp_ar.output.folder_sink import FolderSink
from warp_ar.output.sink import make_folder
from warp_ar.signals import REC_709
from warp_ar.signature import PROGRAM, sign_png
from warp_ar.stages.request import PICTURE_LAYERS

Layers = Mapping[str, npt.NDArray[Any]]

PICTURES = ("plate", "ids", "depth", "normals")
"""Layers that PNG can hold."""
DEPTH_STEP = 1e-4
"""Metres per step of a depth in a PNG."""

_HALF_MAX = 65504.0
_COMPONENTS = {"objects": "RGBA", "normals": "XYZ", "position": "XYZ", "motion": "XY", "ids": "I"}
_FULL = ("position", "motion", "depth", "normals")
"""Layers of 32 bits."""


@dataclasses.dataclass(frozen=True)
class LayerFrame:
    """One frame's layers, and what a file of them says beside."""

    layers: Layers
    """By the names of ``LAYERS``."""
    frame: npt.NDArray[np.uint8]
    """The camera's frame, RGB."""
    names: tuple[str, ...]
    """Of the surfaces, by their numbers."""
    exposure_scale: float = 1.0
    """Factor on the composed radiance in the picture."""
    transfer: str = "srgb"
    """How the picture encodes radiance."""
    camera_from_world: npt.NDArray[np.float64] | None = None
    """(4, 4), camera axes x right, y down, z forward, metres; None where it is not known."""
    camera_matrix: npt.NDArray[np.float64] | None = None
    """(3, 3), pixels, their centres at integers."""

    @property
    def shape(self) -> tuple[int, ...]:
        """(height, width, 3)."""
        return self.frame.shape

    def copy(self) -> LayerFrame:
        """One whose frame may outlast the source's; layers are a result's own copies."""
        return dataclasses.replace(self, frame=self.frame.copy())


def write_layers(path: pathlib.Path, frame: LayerFrame) -> None:
    """Write the OpenEXR of one frame.

    Raises:
        SinkError: The file cannot be written.
    """
    layers = frame.layers
    parts = []
    if set(PICTURE_LAYERS) <= layers.keys():
        picture = compose_layers(layers)
        parts.append(_part("picture", {c: _half(picture[..., k]) for k, c in enumerate("RGB")}, frame))
    for name, values in layers.items():
        if name == "coverage":
            channels: dict[str, Any] = matte_channels(values, frame.names)
            parts.append(_part(name, channels, frame, matte_header(frame.names)))
        else:
            parts.append(_part(name, _channels(name, values), frame))
    try:
        write_whole(path, functools.partial(write_exr, image=OpenEXR.File(parts)))
    except (RuntimeError, OSError) as error:
        raise SinkError(f"{path} cannot be written: {reason(error)}") from error


def _half(values: npt.NDArray[Any]) -> npt.NDArray[np.float16]:
    return np.ascontiguousarray(np.clip(values, -_HALF_MAX, _HALF_MAX), np.float16)


def _channels(name: str, values: npt.NDArray[Any]) -> dict[str, npt.NDArray[Any]]:
    if name == "depth":
        return {"Z": np.ascontiguousarray(values, np.float32)}
    if name == "ids":
        return {"ids.I": np.ascontiguousarray(values + 1).astype(np.uint32)}
    keep: Callable[[Any], Any] = functools.partial(np.ascontiguousarray, dtype=np.float32) if name in _FULL else _half
    return {f"{name}.{c}": keep(values[..., k]) for k, c in enumerate(_COMPONENTS.get(name, "RGB"))}


def _part(name: str, channels: dict[str, Any], frame: LayerFrame, more: Mapping[str, Any] | None = None) -> Any:
    header: dict[str, Any] = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "software": PROGRAM,
        "chromaticities": REC_709,
        "exposureScale": float(frame.exposure_scale),
        "transfer": frame.transfer,
        **(more or {}),
    }
    if frame.camera_from_world is not None:
        header["cameraFromWorld"] = frame.camera_from_world.astype(np.float32)
        # OpenEXR's own attribute maps rows, to a camera that looks along its -z with y up.
        rows = (np.diag([1.0, -1.0, -1.0, 1.0]) @ frame.camera_from_world).T
        header["worldToCamera"] = np.ascontiguousarray(rows, np.float32)  # it is written as it lies in memory
    if frame.camera_matrix is not None:
        header["cameraMatrix"] = frame.camera_matrix.astype(np.float32)
    return OpenEXR.Part(header, channels, name)


def encode_picture(name: str, frame: LayerFrame) -> bytes:
    """PNG of a layer of ``PICTURES``."""
    values = frame.layers[name]
    if name == "plate":
        picture: npt.NDArray[Any] = cv2.cvtColor(frame.frame, cv2.COLOR_RGB2BGR)
    elif name == "ids":
        picture = (values + 1).astype(np.uint16)
    elif name == "depth":
        steps = np.rint(values / DEPTH_STEP)
        picture = np.where(steps <= 65535.0, steps, 0.0).astype(np.uint16)
    else:
        picture = np.ascontiguousarray(np.rint(32767.5 * (values + 1.0)).astype(np.uint16)[..., ::-1])
    done, data = cv2.imencode(".png", picture)
    assert done
    return sign_png(data.tobytes())


class LayerSink(FolderSink):
    """A folder of ``NNNN.exr`` with the layers of each frame; with ``pictures`` also ``LAYER/NNNN.png``.

    Args:
        path: The folder.
        overwrite: Whether numbered files that this program did not write may go.
        pictures: Names of layers to write as PNG, of ``PICTURES``.

    Raises:
        SinkError: A folder cannot be made or written to, or holds files that may not go.
    """

    _suffix = ".exr"

    def __init__(self, path: str | pathlib.Path, *, overwrite: bool = False, pictures: tuple[str, ...] = ()) -> None:
        super().__init__(path, overwrite=overwrite)
        self._pictures = pictures
        for name in pictures:
            make_folder(self._path / name)
            self._find_earlier(self._path / name, ".png", overwrite=overwrite)

    def _check(self, image: Any) -> None:
        if not isinstance(image, LayerFrame):
            raise SinkError(f"layers of a frame are a LayerFrame, not {type(image).__name__}")

    def _store(self, index: int, image: Any) -> None:
        write_layers(self._path / f"{index:04d}.exr", image)
        for name in self._pictures:
            path = self._path / name / f"{index:04d}.png"
            try:
                write_whole(path, encode_picture(name, image))
            except OSError as error:
                raise SinkError(f"{path} cannot be written: {reason(error)}") from error
