"""Environments as OpenEXR, one or one per frame."""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np
import numpy.typing as npt
import OpenEXR

from warp_ar.errors import SinkError, reason
from warp_ar.files import is_file, limits, too_much, write_whole
from warp_ar.output.folder_sink import FolderSink
from warp_ar.output.places import check_replaceable
from warp_ar.signature import PROGRAM


class EnvironmentSink(FolderSink):
    """A folder of ``NNNN.exr``, numbered from 0, each as `write_environment` writes it."""

    _suffix = ".exr"

    def _check(self, image: npt.NDArray[Any]) -> None:
        _check_environment(image)

    def _store(self, index: int, image: npt.NDArray[Any]) -> None:
        write_environment(self._path / f"{index:04d}.exr", image, overwrite=True)


def write_environment(path: str | pathlib.Path, radiance: npt.NDArray[np.float32], *, overwrite: bool = False) -> None:
    """Write a latlong environment as a 32-bit float OpenEXR, ZIP-compressed, channels R, G, B.

    Args:
        path: The file; folders that are missing on the way are made.
        radiance: Linear RGB in camera values, float32, (height, width, 3); row 0 looks toward +z, the centre column
            toward +x, columns grow toward +y.
        overwrite: Whether a file that this program did not write may be replaced.

    Raises:
        SinkError: The array is of another kind, or the file cannot be written or may not be replaced.
    """
    path = pathlib.Path(path)
    _check_environment(radiance)
    check_replaceable(path, overwrite=overwrite)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "software": PROGRAM}
    image = OpenEXR.File(header, {"RGB": np.ascontiguousarray(radiance)})
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, lambda part: image.write(str(part)))
    except (RuntimeError, OSError) as error:
        raise SinkError(f"{path} cannot be written: {reason(error)}") from error


def read_environment(path: str | pathlib.Path) -> npt.NDArray[np.float32]:
    """Read an OpenEXR with channels R, G, B as float32 (height, width, 3); alpha and other channels are left out.

    Raises:
        SinkError: The file is missing, no OpenEXR, or has no R, G and B.
    """
    path = pathlib.Path(path)
    if not is_file(path):
        raise SinkError(f"there is no file {path}; an environment is an OpenEXR file")
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            low, high = (np.asarray(corner, np.int64) for corner in file.header()["dataWindow"])
        width, height = (int(side) for side in high - low + 1)
        if width * height > limits().picture_pixels:
            raise SinkError(too_much(f"{path} is {width}x{height}: it", width * height, "pixels", "picture_pixels"))
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
