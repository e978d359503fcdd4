"""Photographs with EXIF, as tests write them from linear renders."""

from __future__ import annotations

import numpy as np
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

FOCAL_35MM = 35


def encode_srgb(linear):
    """Codes of linear values, clipped at 1."""
    x = np.clip(linear, 0.0, 1.0)
    return np.round(255 * np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055))


def write_photo(path, codes, *, denominator=None, iso=100, f_number=1.0, focal_35mm=FOCAL_35MM, orientation=None):
    """Write a JPEG; ``denominator`` is that of its exposure time, None leaves exposures out of EXIF."""
    exif = Image.Exif()
    if orientation is not None:
        exif[0x0112] = orientation
    fields = exif.get_ifd(0x8769)
    if denominator is not None:
        fields[0x829A] = IFDRational(1, denominator)
        fields[0x829D] = IFDRational(round(10 * f_number), 10)
        fields[0x8827] = iso
    fields[0xA405] = focal_35mm
    Image.fromarray(np.asarray(codes, np.uint8)).save(path, quality=94, exif=exif.tobytes())
    return path
