"""Pictures of radiance, as what an emitting surface shows: codes of 8 bits under a brightest value.

Linear pictures, Radiance and OpenEXR, are kept as sRGB codes of their values over the largest one: what is darker than
1 / 6600 of that is black, and steps are 1 % or finer from a twentieth of it on.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from warp_ar.errors import SceneError
from warp_ar.exr_file import read_linear_picture
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
    radiance = read_linear_picture(path, SceneError, str(path)).color
    if radiance.min(initial=0.0) < 0.0:
        raise SceneError(f"{path}: holds radiance that is negative; expected 0 or more everywhere")
    peak = max(float(radiance.max(initial=0.0)), 1e-6)
    return encode_texture(radiance / peak, encoded=True), peak
