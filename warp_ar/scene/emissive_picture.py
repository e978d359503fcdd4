"""Pictures of radiance, as what an emitting surface shows: codes of 8 bits under a brightest value.

Linear pictures, Radiance and OpenEXR, are kept as sRGB codes of their values over the largest one: what is darker than
1 / 6600 of that is black, and steps are 1 % or finer from a twentieth of it on.
"""

from __future__ import annotations

import functools
import re
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt
import OpenEXR

from warp_ar.errors import SceneError
from warp_ar.exr_file import exr_problem
from warp_ar.files import limits, read_bytes, too_much
from warp_ar.scene.mesh_files import load_texture
from warp_ar.scene.texture_codes import encode_texture

RADIANCE_SUFFIXES: Final = (".exr", ".hdr")
"""Of files that hold linear radiance."""


def load_emission(path: Path) -> tuple[npt.NDArray[np.uint8], float]:
    """A picture to emit, kept as long as the file is the same.

    Args:
        path: Linear radiance (Radiance, OpenEXR with R, G and B), or what ``load_texture`` reads.

    Returns:
        (h, w, 3) RGB, sRGB-encoded, row 0 at the top, and what its largest code stands for.

    Raises:
        SceneError: The file is missing, no such picture, too large, or holds a value that is not finite or negative.
    """
    try:
        status = path.stat()
        stamp = status.st_mtime_ns, status.st_size
    except OSError:
        stamp = 0, 0  # reading it says what is wrong
    return _load(path, stamp)


@functools.lru_cache(maxsize=4)
def _load(path: Path, stamp: tuple[int, int]) -> tuple[npt.NDArray[np.uint8], float]:
    if path.suffix.lower() not in RADIANCE_SUFFIXES:
        return load_texture(path), 1.0
    radiance = _read_exr(path) if path.suffix.lower() == ".exr" else _read_hdr(path)
    if not np.isfinite(radiance).all() or radiance.min(initial=0.0) < 0.0:
        raise SceneError(f"{path}: holds radiance that is negative or not finite; expected 0 or more everywhere")
    peak = max(float(radiance.max(initial=0.0)), 1e-6)
    return encode_texture(radiance / peak, encoded=True), peak


def _check_size(path: Path, width: int, height: int) -> None:
    if width * height > limits().picture_pixels:
        raise SceneError(too_much(f"{path} is {width}x{height}: it", width * height, "pixels", "picture_pixels"))


def _read_hdr(path: Path) -> npt.NDArray[Any]:
    """Linear RGB of a Radiance file, (h, w, 3); its header is looked at before anything is unpacked."""
    data = read_bytes(path, "picture_bytes", SceneError)
    size = re.search(rb"\n-Y (\d{1,9}) \+X (\d{1,9})\n", data[:4096])
    if not data.startswith(b"#?") or size is None:
        raise SceneError(f"{path}: no Radiance picture with rows from the top (-Y ... +X ...)")
    _check_size(path, int(size[2]), int(size[1]))
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if picture is None or picture.ndim != 3 or picture.dtype != np.float32:
        raise SceneError(f"{path}: the Radiance picture is damaged")
    return np.ascontiguousarray(picture[..., 2::-1])


def _read_exr(path: Path) -> npt.NDArray[Any]:
    """Linear RGB of an OpenEXR file, (h, w, 3)."""
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            low, high = (np.asarray(corner, np.int64) for corner in file.header()["dataWindow"])
        _check_size(path, *(int(side) for side in high - low + 1))
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = file.channels()
            if not {"R", "G", "B"} <= set(channels):
                raise SceneError(f"{path}: has channels {', '.join(sorted(channels))}; expected R, G and B")
            return np.stack([np.array(channels[name].pixels, np.float32) for name in "RGB"], axis=-1)
    except (RuntimeError, OSError, ValueError) as error:
        if isinstance(error, SceneError):
            raise
        raise SceneError(f"{path} cannot be read as OpenEXR: {exr_problem(path, error)}") from error
