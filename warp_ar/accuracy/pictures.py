"""Crops of pictures around changed regions, and error maps."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.accuracy.cases import Image

Box = tuple[slice, slice]
"""Rows and columns of a crop."""
CROP_WIDTH = 360
"""Approximate width of crops in pixels: smaller regions are enlarged by whole factors, larger ones are averaged."""
CROP_ASPECT = 4.0 / 3.0
"""Width of a crop divided by its height."""


def error_colors(errors: npt.NDArray[Any]) -> Image:
    """Return a picture of FLIP, 0 to 1, in colours from black through red to yellow.

    Colours follow the square root of FLIP, so that small errors are visible.
    """
    scaled = (np.sqrt(np.clip(errors, 0.0, 1.0)) * 255.0 + 0.5).astype(np.uint8)
    colors = cv2.applyColorMap(scaled, cv2.COLORMAP_INFERNO)
    return np.ascontiguousarray(colors[..., ::-1], dtype=np.uint8)


def bounding_box(region: npt.NDArray[np.bool_], shape: tuple[int, int]) -> Box:
    """Return the box around a region, widened to the aspect ratio of a crop within the picture.

    The result is the whole picture if the region is empty.

    Args:
        region: Mask of the region.
        shape: Height and width of the picture.
    """
    height, width = shape
    rows, columns = np.nonzero(region)
    if len(rows) == 0:
        return slice(0, height), slice(0, width)
    # Quantiles are used, because a few outlying pixels would extend the box to the whole picture.
    top, bottom = np.quantile(rows, [0.01, 0.99])
    left, right = np.quantile(columns, [0.01, 0.99])
    high = max(bottom - top, (right - left) / CROP_ASPECT, 60.0) * 1.15 + 8.0
    high = min(high, height, width / CROP_ASPECT)
    wide = high * CROP_ASPECT
    y = min(max(0.5 * (top + bottom) - 0.5 * high, 0.0), height - high)
    x = min(max(0.5 * (left + right) - 0.5 * wide, 0.0), width - wide)
    return slice(int(y), math.ceil(y + high)), slice(int(x), math.ceil(x + wide))


def crop(image: Image, box: Box) -> Image:
    """Return a part of a picture, of about ``CROP_WIDTH``.

    A small part is enlarged by an integer factor without interpolation, so that its pixels are visible. A large one is
    averaged.
    """
    part = image[box]
    times = max(1, round(CROP_WIDTH / part.shape[1]))
    if times > 1:
        return np.ascontiguousarray(np.kron(part, np.ones((times, times, 1), np.uint8)))
    if part.shape[1] <= CROP_WIDTH:
        return np.ascontiguousarray(part)
    size = CROP_WIDTH, max(1, round(part.shape[0] * CROP_WIDTH / part.shape[1]))
    return np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_AREA), np.uint8)
