"""Packing of material pictures for the device: mip levels of every picture, one after another, each picture once.

A texel of a level is the mean of the linear values that it covers. Colours under an alpha mask are weighted by alpha,
so that colours of cut-out texels do not bleed in. A mask's alpha is scaled at each level so that the same share of
texels passes the cutoff as in the full picture: foliage stays as dense at a distance [Cas10].

References:
    [Cas10] Castano, "Computing Alpha Mipmaps", 2010.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.kernels import structs
from warp_ar.scene.materials import IDENTITY, MeshMaterial, TextureUse
from warp_ar.scene.textures import (
    DECODE,
    RADIANCE_SUFFIXES,
    encode_texture,
    linear_texture,
    load_emission,
    load_texture,
)

ByteArray = npt.NDArray[np.uint8]

_WRAPS: Final = {"repeat": structs.REPEATED, "clamp": structs.CLAMP, "mirror": structs.MIRRORED}


def mip_levels(picture: ByteArray, *, encoded: bool, cutoff: float | None = None) -> list[ByteArray]:
    """Return a picture and its smaller copies down to one texel.

    Args:
        picture: (h, w, 4) RGBA.
        encoded: True if RGB is sRGB-encoded; alpha is always linear.
        cutoff: Alpha cutoff of a mask; None: alpha is no mask.

    Returns:
        Levels, each with half the width and height of the one before, rounded down, at least 1.
    """
    levels = [picture]
    height, width = picture.shape[:2]
    if max(height, width) == 1:
        return levels
    first = DECODE[256 * encoded :][:256]
    values = np.concatenate([first[picture[..., :3]], picture[..., 3:].astype(np.float32) / 255.0], axis=2)
    masked = cutoff is not None and picture[..., 3].min() < 255
    covered = float((values[..., 3] >= (cutoff or 0.0)).mean())
    if masked:
        values[..., :3] *= values[..., 3:]
    while max(height, width) > 1:
        height, width = max(height // 2, 1), max(width // 2, 1)
        values = cv2.resize(values, (width, height), interpolation=cv2.INTER_AREA).reshape(height, width, 4)
        shown = values.copy()
        if masked:
            shown[..., :3] /= np.maximum(shown[..., 3:], 1e-6)
            threshold = float(np.quantile(shown[..., 3], 1.0 - covered)) if 0.0 < covered < 1.0 else cutoff or 0.0
            shown[..., 3] *= (cutoff or 0.0) / threshold if threshold > 0.0 else 1.0
        color = encode_texture(np.minimum(shown[..., :3], 1.0), encoded=encoded)
        alpha = encode_texture(shown[..., 3:], encoded=False)
        levels.append(np.concatenate([color, alpha], axis=2))
    return levels


class TexturePack:
    """Collector of the pictures that a scene's materials use."""

    def __init__(self) -> None:
        """Start with no pictures."""
        self.records: list[dict[str, Any]] = []
        """Fields of ``structs.Texture``, one record per texture."""
        self.texels: list[npt.NDArray[np.uint32]] = []
        """Texels of the pictures, one array per picture."""
        self._kept: list[Any] = []  # pictures are kept, so that their ids stay valid
        self._places: dict[Any, dict[str, Any]] = {}
        self._uses: dict[Any, int] = {}
        self._size = 0

    def add(
        self,
        use: TextureUse | None,
        images: tuple[ByteArray, ...],
        *,
        encoded: bool,
        cutoff: float | None = None,
        path: Path | None = None,
        clamp: bool = False,
    ) -> int:
        """Add a texture, and return the index of its record; -1 for none.

        Args:
            use: Texture of a mesh's file.
            images: Pictures of that file.
            encoded: True if RGB is sRGB-encoded.
            cutoff: Alpha cutoff of a mask; None: alpha is no mask.
            path: Picture of the scene, used in place of the file's or multiplied with it.
            clamp: True if the scene's picture is clamped at its border instead of repeated.
        """
        if use is None and path is None:
            return -1
        image = None if use is None else images[use.image]
        place_key = (id(image), path, encoded, cutoff)
        use = use or TextureUse(0, wrap=("clamp", "clamp") if clamp else ("repeat", "repeat"))
        key = (place_key, use.uv_set, use.transform, use.wrap, use.nearest)
        if key not in self._uses:
            if place_key not in self._places:
                self._kept.append(image)
                self._places[place_key] = self._place(joint_picture(image, path), encoded=encoded, cutoff=cutoff)
            self._uses[key] = len(self.records)
            self.records.append({**self._places[place_key], **_reading(use, self._places[place_key])})
        return self._uses[key]

    def _place(self, picture: ByteArray, *, encoded: bool, cutoff: float | None) -> dict[str, Any]:
        levels = mip_levels(picture, encoded=encoded, cutoff=cutoff)
        place = {
            "offset": self._size,
            "width": picture.shape[1],
            "height": picture.shape[0],
            "levels": len(levels),
            "decode": 256 * encoded,
        }
        for level in levels:
            self.texels.append(np.ascontiguousarray(level).view("<u4").ravel())
            self._size += level.shape[0] * level.shape[1]
        return place


def _reading(use: TextureUse, place: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a record that describe sampling: transform, wrapping and filter."""
    a, b, c, d, e, f = use.transform
    area = abs(a * e - b * d) if use.transform != IDENTITY else 1.0
    return {
        "wrap_u": _WRAPS[use.wrap[0]],
        "wrap_v": _WRAPS[use.wrap[1]],
        "nearest": int(use.nearest),
        "uv_set": use.uv_set,
        "row_u": (a, b, c),
        "row_v": (d, e, f),
        "size": math.sqrt(area * place["width"] * place["height"]),
    }


def joint_picture(image: ByteArray | None, path: Path | None) -> ByteArray:
    """Return the picture of the mesh file or of the scene, or their product in linear light, (h, w, 4)."""
    if path is None:
        assert image is not None
        return image
    own = load_emission(path)[0] if path.suffix.lower() in RADIANCE_SUFFIXES else load_texture(path)
    if image is None:
        return np.concatenate([own, np.full((*own.shape[:2], 1), 255, np.uint8)], axis=2)
    height, width = (max(image.shape[axis], own.shape[axis]) for axis in (0, 1))
    first, second = (
        cv2.resize(linear_texture(picture), (width, height), interpolation=cv2.INTER_LINEAR)
        for picture in (own, np.ascontiguousarray(image[..., :3]))
    )
    alpha = cv2.resize(image[..., 3], (width, height), interpolation=cv2.INTER_LINEAR)
    return np.concatenate([encode_texture(first * second, encoded=True), alpha.reshape(height, width, 1)], axis=2)


def mask_cutoff(material: MeshMaterial) -> float | None:
    """Return the alpha cutoff of a material's base colour for ``mip_levels``; None if it is no mask."""
    return {"opaque": None, "mask": material.cutoff, "blend": 0.5}[material.alpha]
