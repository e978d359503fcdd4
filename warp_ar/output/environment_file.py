"""Environments as OpenEXR, one or one per frame."""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np
import numpy.typing as npt
import OpenEXR

from warp_ar.errors import SinkError, reason
from warp_ar.output.folder_sink import FolderSink


class EnvironmentSink(FolderSink):
    """A folder of ``NNNN.exr``, numbered from 0, each as `write_environment` writes it."""

    def _check(self, image: npt.NDArray[Any]) -> None:
        _check_environment(image)

    def _store(self, index: int, image: npt.NDArray[Any]) -> None:
        write_environment(self._path / f"{index:04d}.exr", image)


def write_environment(path: str | pathlib.Path, radiance: npt.NDArray[np.float32]) -> None:
    """Write a latlong environment as a 32-bit float OpenEXR, ZIP-compressed, channels R, G, B.

    Args:
        path: The file; folders that are missing on the way are made.
        radiance: Linear RGB in camera values, float32, (height, width, 3); row 0 looks toward +z, the centre column
            toward +x, columns grow toward +y.

    Raises:
        SinkError: The array is of another kind, or the file cannot be written.
    """
    path = pathlib.Path(path)
    _check_environment(radiance)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        OpenEXR.File(header, {"RGB": np.ascontiguousarray(radiance)}).write(str(path))
    except (RuntimeError, OSError) as error:
        raise SinkError(f"{path} cannot be written: {reason(error)}") from error


def read_environment(path: str | pathlib.Path) -> npt.NDArray[np.float32]:
    """Read an OpenEXR with channels R, G, B as float32 (height, width, 3); alpha and other channels are left out.

    Raises:
        SinkError: The file is missing, no OpenEXR, or has no R, G and B.
    """
    path = pathlib.Path(path)
    if not path.is_file():
        raise SinkError(f"there is no file {path}; an environment is an OpenEXR file")
    try:
        with OpenEXR.File(str(path)) as file:
            channels = {name: np.array(channel.pixels, np.float32) for name, channel in file.channels().items()}
    except (RuntimeError, OSError, ValueError) as error:
        raise SinkError(f"{path} cannot be read as OpenEXR: {reason(error)}") from error
    for name in ("RGB", "RGBA"):
        if name in channels:
            return np.ascontiguousarray(channels[name][..., :3])
    if not {"R", "G", "B"} <= channels.keys():
        raise SinkError(f"{path} has channels {', '.join(channels)}; R, G and B are needed")
    return np.stack([channels[name] for name in "RGB"], axis=-1)


def _check_environment(radiance: npt.NDArray[Any]) -> None:
    if radiance.dtype != np.float32 or radiance.ndim != 3 or radiance.shape[2] != 3 or not radiance.size:
        raise SinkError(f"an environment is float32 (height, width, 3), not {radiance.dtype} {radiance.shape}")
