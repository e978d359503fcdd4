"""Reflection models of virtual objects, as scene files name them, and materials that a mesh file brings.

glTF's core material is the model of the latter, one per group of triangles; what OBJ's material libraries and vertex
colours say is put into the same form. Pictures lie beside the mesh (``Mesh.images``), a material names them by number.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Final, Literal, TypeAlias

from warp_ar.scene.fields import COLOR, LIGHT_COLOR, Checked, Key, Share

RGB: TypeAlias = tuple[float, float, float]
Color: TypeAlias = RGB | Path
"""Linear RGB, or the path of a texture (sRGB-encoded picture)."""
Tint: TypeAlias = Annotated[Color, COLOR]


@dataclasses.dataclass(frozen=True)
class PhongMaterial(Checked):
    """Diffuse plus a cosine lobe about the mirror direction."""

    diffuse: Tint = (0.8, 0.8, 0.8)
    """Diffuse reflectance."""
    specular: Tint = (0.2, 0.2, 0.2)
    """Reflectance of the lobe."""
    shininess: Annotated[float, Key("-", "64.0", low=0.0)] = 32.0
    """Exponent of the lobe, from 0 (widest) on."""

    @property
    def base_color(self) -> Color:
        """Diffuse reflectance, by the name that the other models have for theirs."""
        return self.diffuse


@dataclasses.dataclass(frozen=True)
class MetallicRoughnessMaterial(Checked):
    """glTF's BRDF: GGX with alpha = roughness squared, F0 = 0.04 for what is no metal."""

    base_color: Tint = (0.8, 0.8, 0.8)
    """Diffuse reflectance of a non-metal, F0 of a metal."""
    metallic: Share = 0.0
    """0 (no metal) to 1 (metal)."""
    roughness: Share = 0.5
    """0 (mirror) to 1 (matt)."""


@dataclasses.dataclass(frozen=True)
class LambertMaterial(Checked):
    """Perfectly diffuse."""

    base_color: Tint = (0.8, 0.8, 0.8)
    """Diffuse reflectance."""


@dataclasses.dataclass(frozen=True)
class MirrorMaterial(Checked):
    """Perfect mirror."""

    base_color: Tint = (1.0, 1.0, 1.0)
    """Reflectance, the same at every angle."""


@dataclasses.dataclass(frozen=True)
class EmissiveMaterial(Checked):
    """Sends out light of its own, alike in all directions, and reflects none."""

    color: Annotated[RGB, LIGHT_COLOR] = (1.0, 1.0, 1.0)
    """Factor on the radiance per channel."""
    intensity: Annotated[float, Key("camera values", "4.0", low=0.0)] = 1.0
    """Radiance in camera values: 1 is what the camera clips."""
    image: Annotated[Path | None, Key("-", '"picture.png"', right="a picture")] = None
    """Picture that multiplies the radiance: sRGB-encoded, or linear radiance (HDR, OpenEXR)."""
    two_sided: Annotated[bool, Key("-", "true")] = False
    """True if the back of an open surface emits too; else it is not there from behind, but throws a shadow."""


@dataclasses.dataclass(frozen=True)
class FileMaterial:
    """The materials that the mesh's file brings; matt white where it brings none."""


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
"""Texture coordinates as they are."""


@dataclasses.dataclass(frozen=True)
class TextureUse:
    """A picture, how it is read, and where it lies on the surface."""

    image: int
    """Index into ``Mesh.images``."""
    uv_set: int = 0
    """Set of texture coordinates: 0 ``Mesh.uvs``, 1 ``Mesh.uvs_second``."""
    transform: tuple[float, ...] = IDENTITY
    """Rows (a, b, c), (d, e, f): the picture is read at (a u + b v + c, d u + e v + f), v up the picture."""
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
    """Beyond the border along u and v."""
    nearest: bool = False
    """True if the texel that is nearest is shown as a square, as a sampler's magnification filter may ask."""


_CHALK: Final = LambertMaterial()


@dataclasses.dataclass(frozen=True)
class MeshMaterial:
    """Appearance of a group of triangles; a texture's value is multiplied by the constant of the same name."""

    surface: Material = _CHALK
    """The reflection model and its constants; never ``FileMaterial``."""
    name: str = ""
    """The file's name for it."""
    alpha: Literal["opaque", "mask", "blend"] = "opaque"
    """Effect of alpha: none; cut away below ``cutoff``; show as large a share of the points."""
    opacity: float = 1.0
    """Constant factor of alpha."""
    cutoff: float = 0.5
    """Alpha from which on a mask is there."""
    double_sided: bool = True
    """True if triangles are seen from behind; of a closed mesh nobody sees those."""
    unlit: bool = False
    """True if the base colour is shown as it is: 1 is the camera's clipping value."""
    emission: RGB = (0.0, 0.0, 0.0)
    """Radiance that it sends out itself, in camera values."""
    base: TextureUse | None = None
    """RGB, sRGB-encoded, times the surface's first colour; A times ``opacity``."""
    specular: TextureUse | None = None
    """RGB, sRGB-encoded, times the specular colour of Phong's model."""
    metallic_roughness: TextureUse | None = None
    """G times roughness, B times metallic, linear."""
    normal: TextureUse | None = None
    """Normal in the tangent frame, 0.5 + 0.5 n, linear."""
    normal_scale: float = 1.0
    """Factor of the normal's first two components."""
    occlusion: TextureUse | None = None
    """R, linear: the share of the environment that reaches a point."""
    occlusion_strength: float = 1.0
    """Share of the occlusion that counts."""
    emissive: TextureUse | None = None
    """RGB, sRGB-encoded, times ``emission``."""
    roughness_span: tuple[float, float] = (1.0, 1.0)
    """Least and largest factor that the texture gives the roughness."""
    metallic_span: tuple[float, float] = (1.0, 1.0)
    """Least and largest factor that the texture gives metallic."""

    @property
    def textures(self) -> tuple[TextureUse, ...]:
        """All that it has."""
        found = (self.base, self.specular, self.metallic_roughness, self.normal, self.occlusion, self.emissive)
        return tuple(use for use in found if use is not None)

    @property
    def plain(self) -> bool:
        """Return whether its surface's constants say everything."""
        dark = not any(self.emission)
        return not self.textures and self.alpha == "opaque" and self.double_sided and not self.unlit and dark
