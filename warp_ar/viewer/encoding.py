"""Pictures as the page takes them."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.srgb import encode_srgb

JPEG_QUALITY: Final = 85
"""At 640x480 a desk takes 60 KB; at 95 it takes twice that."""


def encode_jpeg(image: npt.NDArray[np.uint8]) -> bytes:
    """JPEG of an RGB picture."""
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    return bytes(cv2.imencode(".jpg", bgr, (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY))[1])


def encode_light(light: npt.NDArray[np.float32]) -> bytes:
    """PNG of an environment: x / (1 + x), so that what clips in the camera still shows, encoded as sRGB."""
    value = np.maximum(light, 0.0)
    value = value / (1.0 + value)
    return bytes(cv2.imencode(".png", np.uint8(np.round(encode_srgb(value)[..., ::-1] * 255.0)))[1])
