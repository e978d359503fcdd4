"""Reflection models of virtual objects in scene files, and materials of mesh files.

Materials of mesh files have the form of glTF's core material, one per group of triangles; OBJ's material libraries and
vertex colours are converted to it. Pictures are stored with the mesh (``Mesh.images``), and a material refers to them
by index.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Final, Literal, TypeAlias

from warp_ar.scene.fields import COLOR, LIGHT_COLOR, Checked, Key, Share

RGB: TypeAlias = tuple[float, float, float]
Color: TypeAlias = RGB | Path
"""Linear RGB, or the path of an sRGB-encoded picture."""
Tint: TypeAlias = Annotated[Color, COLOR]


@dataclasses.dataclass(frozen=True)
class PhongMaterial(Checked):
    """Diffuse plus a cosine lobe about the mirror direction."""

    diffuse: Tint = (0.8, 0.8, 0.8)
    """Diffuse reflectance, linear RGB."""
    specular: Tint = (0.2, 0.2, 0.2)
    """Reflectance of the lobe, linear RGB."""
    shininess: Annotated[float, Key("-", "64.0", low=0.0)] = 32.0
    """Exponent of the lobe, from 0 (widest)."""

    @property
    def base_color(self) -> Color:
        """Return the diffuse reflectance, under the name that the other models use."""
        return self.diffuse


@dataclasses.dataclass(frozen=True)
class MetallicRoughnessMaterial(Checked):
    """glTF's BRDF: GGX with alpha = roughness squared, and F0 = 0.04 for non-metals."""

    base_color: Tint = (0.8, 0.8, 0.8)
    """Diffuse reflectance of a non-metal or F0 of a metal, linear RGB."""
    metallic: Share = 0.0
    """0 (no metal) to 1 (metal)."""
    roughness: Share = 0.5
    """0 (mirror) to 1 (matt)."""


@dataclasses.dataclass(frozen=True)
class LambertMaterial(Checked):
    """Perfectly diffuse."""

    base_color: Tint = (0.8, 0.8, 0.8)
    """Diffuse reflectance, linear RGB."""


@dataclasses.dataclass(frozen=True)
class MirrorMaterial(Checked):
    """Perfect mirror."""

    base_color: Tint = (1.0, 1.0, 1.0)
    """Reflectance at every angle, linear RGB."""


@dataclasses.dataclass(frozen=True)
class EmissiveMaterial(Checked):
    """Surface that emits equally in all directions and reflects nothing."""

    color: Annotated[RGB, LIGHT_COLOR] = (1.0, 1.0, 1.0)
    """Factor per channel, linear RGB."""
    intensity: Annotated[float, Key("camera values", "4.0", low=0.0)] = 1.0
    """Radiance, camera values: 1 clips."""
    image: Annotated[Path | None, Key("-", '"picture.png"', right="a picture")] = None
    """Picture that multiplies the radiance: sRGB-encoded, or linear (HDR, OpenEXR)."""
    two_sided: Annotated[bool, Key("-", "true")] = False
    """True if the back of an open surface emits too; else it is invisible from behind, but throws a shadow."""


@dataclasses.dataclass(frozen=True)
class FileMaterial:
    """Materials of the mesh's file; matt white if the file has none."""


Material: TypeAlias = (
    FileMaterial | PhongMaterial | MetallicRoughnessMaterial | LambertMaterial | MirrorMaterial | EmissiveMaterial
)

MATERIALS: Final[dict[str, type[Material]]] = {
    "phong": PhongMaterial,
    "metallic_roughness": MetallicRoughnessMaterial,
    "lambert": LambertMaterial,
    "mirror": MirrorMaterial,
    "emissive": EmissiveMaterial,
    "file": FileMaterial,
}
"""Reflection models by their names in scene files."""
OF_THE_FILE: Final = FileMaterial()
"""Material of an object that names none."""


Wrap: TypeAlias = Literal["repeat", "clamp", "mirror"]
"""Continuation of a picture beyond its border."""

IDENTITY: Final = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
"""Transform that leaves texture coordinates unchanged."""


@dataclasses.dataclass(frozen=True)
class TextureUse:
    """Use of a picture as a texture: its sampling and its placement on the surface."""

    image: int
    """Index into ``Mesh.images``."""
    uv_set: int = 0
    """Set of texture coordinates: 0 ``Mesh.uvs``, 1 ``Mesh.uvs_second``."""
    transform: tuple[float, ...] = IDENTITY
    """Rows (a, b, c), (d, e, f): the picture is sampled at (a u + b v + c, d u + e v + f), v pointing up."""
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
    """Continuation beyond the border along u and v."""
    nearest: bool = False
    """True for nearest-neighbour magnification."""


_CHALK: Final = LambertMaterial()


@dataclasses.dataclass(frozen=True)
class MeshMaterial:
    """Appearance of a group of triangles; each texture multiplies the constant of the same name."""

    surface: Material = _CHALK
    """Reflection model with its constants; never a ``FileMaterial``."""
    name: str = ""
    """Name in the file."""
    alpha: Literal["opaque", "mask", "blend"] = "opaque"
    """Use of alpha: ignored; a cut-out below ``cutoff``; or the fraction of the surface that is shown."""
    opacity: float = 1.0
    """Constant factor of alpha."""
    cutoff: float = 0.5
    """Smallest alpha that a mask shows."""
    double_sided: bool = True
    """True if the back of triangles is visible."""
    unlit: bool = False
    """True if the base colour is shown as radiance, without lighting; 1 clips."""
    emission: RGB = (0.0, 0.0, 0.0)
    """Emitted radiance, camera values."""
    base: TextureUse | None = None
    """Base colour texture: RGB, sRGB-encoded, multiplies the base colour; A multiplies ``opacity``."""
    specular: TextureUse | None = None
    """Specular texture: RGB, sRGB-encoded, multiplies Phong's specular colour."""
    metallic_roughness: TextureUse | None = None
    """Linear texture: G multiplies roughness, B multiplies metallic."""
    normal: TextureUse | None = None
    """Normal map in the tangent frame, stored as 0.5 + 0.5 n, linear."""
    normal_scale: float = 1.0
    """Factor of the normal's first two components."""
    occlusion: TextureUse | None = None
    """Linear texture: R is the share of the environment's light that reaches a point."""
    occlusion_strength: float = 1.0
    """Strength of the occlusion, 0 to 1."""
    emissive: TextureUse | None = None
    """Emission texture: RGB, sRGB-encoded, multiplies ``emission``."""
    roughness_span: tuple[float, float] = (1.0, 1.0)
    """Smallest and largest value of the texture's roughness factor."""
    metallic_span: tuple[float, float] = (1.0, 1.0)
    """Smallest and largest value of the texture's metallic factor."""

    @property
    def textures(self) -> tuple[TextureUse, ...]:
        """Return all textures of the material."""
        found = (self.base, self.specular, self.metallic_roughness, self.normal, self.occlusion, self.emissive)
        return tuple(use for use in found if use is not None)

    @property
    def plain(self) -> bool:
        """Return True if the surface's constants alone describe the material."""
        dark = not any(self.emission)
        return not self.textures and self.alpha == "opaque" and self.double_sided and not self.unlit and dark
