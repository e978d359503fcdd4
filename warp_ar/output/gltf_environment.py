"""Environment within a glTF by EXT_lights_image_based, which Babylon.js and others read.

The extension stores a cube for each of a few roughness values, evenly spaced from 0 to 1, and nine harmonics of
irradiance. A face is a PNG with RGBD encoding: radiance is (R, G, B)^2.2 / D, with all four from 0 to 1, as Babylon.js
decodes it; the extension does not state a transfer. Faces are OpenGL's, mirrored left to right, as the extension
requires. Harmonics have the signs of Condon and Shortley (minus in y, x, yz and xz), which Babylon.js expects.

Radiance of roughness r in direction n, viewed along n, is the mean over directions l with weight D(h) (n . l), with GGX
of alpha = r^2 and the half vector h of n and l. The density D(h) (n . h) of the half vector becomes D(h) / 4 over l,
because n is also the direction of view ([Kar13]).

References:
    Khronos Group, EXT_lights_image_based. [Kar13] Karis 2013, Real Shading in Unreal Engine 4.
"""

from __future__ import annotations

import math
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.light.captured import latlong_directions, texel_solid_angles
from warp_ar.light.latlong_axes import world_from_marker
from warp_ar.output.environment_axes import LOBE, cube_directions, project_radiance, to_cube
from warp_ar.signature import encode_png

Array = npt.NDArray[np.float64]

EXTENSION: Final = "EXT_lights_image_based"
LARGEST: Final = 64
"""Edge, in texels, of the sharpest level."""
SMALLEST: Final = 16
"""Edge, in texels, of the roughest level."""
GAMMA: Final = 2.2

_FILTERED_ROWS = 32
"""Number of rows of the map from which rough levels are filtered."""
_SIGNS = np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0])


def irradiance_coefficients(radiance: npt.NDArray[np.float32]) -> Array:
    """Return the harmonics of irradiance in glTF's world, y up, (9, 3)."""
    return np.asarray(project_radiance(radiance, "y-up") * (LOBE * _SIGNS)[:, None])


def specular_cubes(radiance: npt.NDArray[np.float32]) -> list[npt.NDArray[np.float32]]:
    """Return prefiltered cubes (6, size, size, 3) for roughness 0 to 1, from size ``LARGEST`` to ``SMALLEST``.

    Args:
        radiance: Latlong (height, 2 height, 3), z-up.
    """
    levels = round(math.log2(LARGEST / SMALLEST)) + 1
    sharp = to_cube(radiance, "opengl", LARGEST).reshape(6, LARGEST, LARGEST, 3)
    rough = [_filtered(radiance, LARGEST >> k, (k / (levels - 1)) ** 2) for k in range(1, levels)]
    return [np.ascontiguousarray(cube[:, :, ::-1]) for cube in (sharp, *rough)]


def _filtered(radiance: npt.NDArray[np.float32], size: int, alpha: float) -> npt.NDArray[np.float32]:
    """Return a cube with OpenGL's faces, prefiltered by GGX with ``alpha``."""
    rows = min(_FILTERED_ROWS, len(radiance))
    source = cv2.resize(radiance, (2 * rows, rows), interpolation=cv2.INTER_AREA).reshape(-1, 3).astype(np.float64)
    toward = latlong_directions(rows).reshape(-1, 3)
    area = np.broadcast_to(texel_solid_angles(rows), (rows, 2 * rows)).reshape(-1)
    normals = cube_directions("opengl", size).reshape(-1, 3) @ world_from_marker("opengl")
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    faces = np.empty((len(normals), 3))
    for start in range(0, len(normals), 1024):  # limits the weights to a few megabytes at once
        part = slice(start, start + 1024)
        cos_theta = np.clip(normals[part] @ toward.T, 0.0, 1.0)
        cos_half = 0.5 * (1.0 + cos_theta)  # its square, because h halves the angle between n and l
        weights = area * cos_theta / (1.0 + (alpha * alpha - 1.0) * cos_half) ** 2
        faces[part] = weights @ source / weights.sum(1, keepdims=True)
    return faces.reshape(6, size, size, 3).astype(np.float32)


def encode_rgbd(radiance: npt.NDArray[np.float32]) -> bytes:
    """Return a face, (size, size, 3), as a PNG in RGBD."""
    most = np.maximum(radiance.max(-1, keepdims=True), 1e-6)
    divisor = np.clip(np.floor(255.0 / np.maximum(most, 1.0)), 1.0, 255.0) / 255.0
    color = np.clip(radiance * divisor, 0.0, 1.0) ** (1.0 / GAMMA)
    codes = np.rint(255.0 * np.concatenate([color, divisor], -1)).astype(np.uint8)
    return encode_png(codes)


def image_based_light(radiance: npt.NDArray[np.float32], add_image: Any) -> dict[str, Any]:
    """Return the extension's entry for one light.

    Args:
        radiance: Latlong (height, 2 height, 3), z-up.
        add_image: Function that adds a PNG to the file and returns its index.
    """
    return {
        "name": "environment",
        "intensity": 1.0,
        "irradianceCoefficients": irradiance_coefficients(radiance).tolist(),
        "specularImageSize": LARGEST,
        "specularImages": [[add_image(encode_rgbd(face)) for face in cube] for cube in specular_cubes(radiance)],
    }
