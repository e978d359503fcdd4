"""STMaps: pictures that tell compositors from where to take each pixel, to take a lens's distortion out or put it in.

Red is s, from 0 at the left edge to 1 at the right; green is t, from 0 at the bottom to 1 at the top. Pixel centres lie
at half-integers of the size, so column j has s = (j + 0.5) / width. 32 bits, for a pixel of a wide frame is less than a
half can tell. What lies outside the frame has coordinates outside 0..1.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import OpenEXR

from warp_ar.errors import SinkError, reason
from warp_ar.exr_file import write_exr
from warp_ar.files import write_whole
from warp_ar.scene import Camera
from warp_ar.scene.pixel_rays import pixel_rays
from warp_ar.signature import PROGRAM


def undistort_map(camera: Camera) -> npt.NDArray[np.float32]:
    """(height, width, 2) s and t: where the frame shows what a pinhole with the same numbers shows at each pixel."""
    columns, rows = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    x, y = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    points = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    none = np.zeros(3)
    found, _ = cv2.projectPoints(points, none, none, camera.matrix(), np.array(camera.distortion))
    return _coordinates(camera, found.reshape(camera.height, camera.width, 2))


def distort_map(camera: Camera) -> npt.NDArray[np.float32]:
    """(height, width, 2) s and t: where a pinhole with the same numbers shows what the frame shows at each pixel."""
    rays = pixel_rays(camera).astype(np.float64)
    return _coordinates(camera, rays * (camera.fx, camera.fy) + (camera.cx, camera.cy))


def _coordinates(camera: Camera, pixels: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    s = (pixels[..., 0] + 0.5) / camera.width
    t = 1.0 - (pixels[..., 1] + 0.5) / camera.height
    return np.stack([s, t], -1).astype(np.float32)


def write_stmap(path: Path, coordinates: npt.NDArray[np.float32]) -> None:
    """Write an STMap as OpenEXR: R is s, G is t, B is 0.

    Raises:
        SinkError: The file cannot be written.
    """
    values = np.concatenate([coordinates, np.zeros_like(coordinates[..., :1])], -1)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "software": PROGRAM}
    image = OpenEXR.File(header, {"RGB": np.ascontiguousarray(values)})
    try:
        write_whole(path, functools.partial(write_exr, image=image))
    except (RuntimeError, OSError) as error:
        raise SinkError(f"{path} cannot be written: {reason(error)}") from error
