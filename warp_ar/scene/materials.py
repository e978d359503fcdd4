"""Reflection models of virtual objects, as scene files name them."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Final, TypeAlias

from warp_ar.scene.checks import check_number, check_reflectance, check_vector

RGB: TypeAlias = tuple[float, float, float]
Color: TypeAlias = RGB | Path
"""Linear RGB, or the path of a texture (sRGB-encoded picture)."""


@dataclasses.dataclass(frozen=True)
class PhongMaterial:
    """Diffuse plus a cosine lobe about the mirror direction."""

    diffuse: Color = (0.8, 0.8, 0.8)
    """Diffuse reflectance."""
    specular: Color = (0.2, 0.2, 0.2)
    """Reflectance of the lobe."""
    shininess: float = 32.0
    """Exponent of the lobe, from 0 (widest) on."""

    def __post_init__(self) -> None:
        """Raise a SceneError that names the first value that cannot be."""
        check_reflectance(self, "diffuse")
        check_reflectance(self, "specular")
        check_number(self, "shininess", low=0.0)


@dataclasses.dataclass(frozen=True)
class MetallicRoughnessMaterial:
    """glTF's BRDF: GGX with alpha = roughness squared, F0 = 0.04 for what is no metal."""

    base_color: Color = (0.8, 0.8, 0.8)
    """Diffuse reflectance of a non-metal, F0 of a metal."""
    metallic: float = 0.0
    """0 (no metal) to 1 (metal)."""
    roughness: float = 0.5
    """0 (mirror) to 1 (matt)."""

    def __post_init__(self) -> None:
        """Raise a SceneError that names the first value that cannot be."""
        check_reflectance(self, "base_color")
        check_number(self, "metallic", low=0.0, high=1.0)
        check_number(self, "roughness", low=0.0, high=1.0)


@dataclasses.dataclass(frozen=True)
class LambertMaterial:
    """Perfectly diffuse."""

    base_color: Color = (0.8, 0.8, 0.8)
    """Diffuse reflectance."""

    def __post_init__(self) -> None:
        """Raise a SceneError that names the first value that cannot be."""
        check_reflectance(self, "base_color")


@dataclasses.dataclass(frozen=True)
class MirrorMaterial:
    """Perfect mirror."""

    base_color: Color = (1.0, 1.0, 1.0)
    """Reflectance, the same at every angle."""

    def __post_init__(self) -> None:
        """Raise a SceneError that names the first value that cannot be."""
        check_reflectance(self, "base_color")


@dataclasses.dataclass(frozen=True)
class EmissiveMaterial:
    """Sends out light of its own, alike in all directions, and reflects none."""

    color: RGB = (1.0, 1.0, 1.0)
    """Factor on the radiance per channel."""
    intensity: float = 1.0
    """Radiance in camera values: 1 is what the camera clips."""
    image: Path | None = None
    """Picture that multiplies the radiance: sRGB-encoded, or linear radiance (HDR, OpenEXR)."""
    two_sided: bool = False
    """Whether the back of an open surface emits too; else it is not there from behind, but throws a shadow."""

    def __post_init__(self) -> None:
        """Raise a SceneError that names the first value that cannot be."""
        check_vector(self, "color", low=0.0)
        check_number(self, "intensity", low=0.0)


@dataclasses.dataclass(frozen=True)
class FileMaterial:
    """The materials that the mesh's file brings; matt white where it brings none."""


Material: TypeAlias = (
    FileMaterial | PhongMaterial | MetallicRoughnessMaterial | LambertMaterial | MirrorMaterial | EmissiveMaterial
)

OF_THE_FILE: Final = FileMaterial()
"""What an object has that names no material."""
