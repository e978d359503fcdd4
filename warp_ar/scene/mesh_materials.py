"""Materials that a mesh file brings: one per group of triangles, with textures.

glTF's core material is the model; what OBJ's material libraries and vertex colours say is put into the same form.
Pictures lie beside the mesh (``Mesh.images``), a material names them by number.
"""

from __future__ import annotations

import dataclasses
import json
from typing import Any, Final, Literal, TypeAlias

from warp_ar.scene.materials import (
    RGB,
    LambertMaterial,
    Material,
    MetallicRoughnessMaterial,
    MirrorMaterial,
    PhongMaterial,
)

Wrap: TypeAlias = Literal["repeat", "clamp", "mirror"]
"""What lies beyond a picture's border."""

IDENTITY: Final = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
"""Texture coordinates as they are."""


@dataclasses.dataclass(frozen=True)
class TextureUse:
    """A picture, how it is read, and where it lies on the surface."""

    image: int
    """Which of ``Mesh.images``."""
    uv_set: int = 0
    """Which texture coordinates: 0 ``Mesh.uvs``, 1 ``Mesh.uvs_second``."""
    transform: tuple[float, ...] = IDENTITY
    """Rows (a, b, c), (d, e, f): the picture is read at (a u + b v + c, d u + e v + f), v up the picture."""
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
    """Beyond the border along u and v."""
    nearest: bool = False
    """Whether the texel that is nearest is shown as a square, as a sampler's magnification filter may ask."""


_CHALK: Final = LambertMaterial()


@dataclasses.dataclass(frozen=True)
class MeshMaterial:
    """How a group of triangles looks; a texture's value is multiplied by the constant of the same name."""

    surface: Material = _CHALK
    """The reflection model and its constants; never ``FileMaterial``."""
    name: str = ""
    """The file's name for it."""
    alpha: Literal["opaque", "mask", "blend"] = "opaque"
    """What alpha does: nothing; cut away below ``cutoff``; show as large a share of the points."""
    opacity: float = 1.0
    """Constant factor of alpha."""
    cutoff: float = 0.5
    """Alpha from which on a mask is there."""
    double_sided: bool = True
    """Whether triangles are seen from behind; of a closed mesh nobody sees those."""
    unlit: bool = False
    """Whether the base colour is shown as it is: 1 is the camera's clipping value."""
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
        """Whether its surface's constants say everything."""
        dark = not any(self.emission)
        return not self.textures and self.alpha == "opaque" and self.double_sided and not self.unlit and dark


_SURFACES: Final[dict[str, type[Any]]] = {
    kind.__name__: kind for kind in (LambertMaterial, PhongMaterial, MetallicRoughnessMaterial, MirrorMaterial)
}


def dump_materials(materials: tuple[MeshMaterial, ...]) -> str:
    """Materials as text for ``parse_materials``."""
    return json.dumps([{**dataclasses.asdict(item), "model": type(item.surface).__name__} for item in materials])


def parse_materials(text: str) -> tuple[MeshMaterial, ...]:
    """Materials as ``dump_materials`` wrote them.

    Raises:
        ValueError: It did not.
    """

    def tuples(value: Any) -> Any:
        return tuple(map(tuples, value)) if isinstance(value, list) else value

    def use(value: Any) -> Any:
        return TextureUse(**{key: tuples(item) for key, item in value.items()}) if isinstance(value, dict) else value

    found = []
    for item in json.loads(text):
        model, surface = item.pop("model"), item.pop("surface")
        kind = _SURFACES.get(model)
        if kind is None:
            raise ValueError(f"no surface {model}")
        values = {key: use(tuples(value)) for key, value in item.items()}
        found.append(MeshMaterial(surface=kind(**{key: tuples(value) for key, value in surface.items()}), **values))
    return tuple(found)
