"""Photographs with EXIF, as tests write them from linear renders."""

from __future__ import annotations

import numpy as np
from PIL import Image, TiffImagePlugin
from PIL.TiffImagePlugin import IFDRational

FOCAL_35MM = 35


def encode_srgb(linear, most=255):
    """Codes of linear values, clipped at 1."""
    x = np.clip(linear, 0.0, 1.0)
    return np.round(most * np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055))


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


def write_dng(path, linear, *, denominator, iso=100, f_number=1.0):
    """Write a raw photograph of linear RGB: a sensor in Bayer's pattern with its own white and colours."""
    white = np.array([0.5, 1.0, 0.6])
    codes = np.round(65535 * np.clip(linear * white, 0, 1)).astype("<u2")
    sensor = codes[..., 1].copy()
    sensor[0::2, 0::2], sensor[1::2, 1::2] = codes[0::2, 0::2, 0], codes[1::2, 1::2, 2]
    # From XYZ to the sensor; white is that of D65.
    rgb = [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
    matrix = np.round(1e6 * white[:, None] * np.linalg.inv(rgb)).astype(int)
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    for tag, kind, value in (
        (254, 4, 0), (256, 4, codes.shape[1]), (257, 4, codes.shape[0]), (258, 3, 16), (259, 3, 1), (262, 3, 32803),
        (271, 2, "Test"), (272, 2, "Camera"), (274, 3, 1), (277, 3, 1), (278, 4, codes.shape[0]), (284, 3, 1),
        (279, 4, sensor.nbytes), (33421, 3, (2, 2)), (33422, 1, bytes([0, 1, 1, 2])),
        (34665, 4, {33434: IFDRational(1, denominator), 33437: IFDRational(round(10 * f_number), 10), 34855: iso}),
        (50706, 1, bytes([1, 4, 0, 0])), (50708, 2, "Test Camera"), (50717, 4, 65535),
        (50721, 10, tuple(IFDRational(int(v), 10**6) for v in matrix.ravel())),
        (50728, 5, tuple(IFDRational(int(1000 * v), 1000) for v in white)), (50778, 3, 21), (273, 4, 0),
    ):  # fmt: skip
        tags.tagtype[tag] = kind
        tags[tag] = value
    prefix = b"II*\0\x08\0\0\0"
    # Pillow moves the pixels' offset, 273, to the end of the tags.
    path.write_bytes(prefix + tags.tobytes(len(prefix)) + sensor.tobytes())
    return path
