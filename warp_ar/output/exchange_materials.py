"""What exchange formats can say of surfaces: materials with pictures, as UsdPreviewSurface and glTF know them.

A mesh with materials of its own keeps all of them, each for its triangles. What the scene's models have and the formats
lack is put into the nearest thing: a Phong lobe of exponent n becomes GGX of alpha = sqrt(2 / (n + 2)), which is as
wide, and its colour the reflectance straight on; a mirror becomes a metal without roughness.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.scene.description import Object
from warp_ar.scene.emissive_picture import load_emission
from warp_ar.scene.geometry import Mesh
from warp_ar.scene.materials import (
    RGB,
    Color,
    EmissiveMaterial,
    FileMaterial,
    MetallicRoughnessMaterial,
    MirrorMaterial,
    PhongMaterial,
)
from warp_ar.scene.mesh_files import load_texture
from warp_ar.scene.mesh_materials import IDENTITY, MeshMaterial, TextureUse, Wrap
from warp_ar.scene.object_materials import materials_of
from warp_ar.signature import sign_png
from warp_ar.srgb import decode_srgb, encode_srgb

Array = npt.NDArray[np.float64]
Codes = npt.NDArray[np.uint8]

WHITE: RGB = (1.0, 1.0, 1.0)


@dataclasses.dataclass(frozen=True, eq=False)
class Picture:
    """A picture, and how it lies on the surface."""

    codes: Codes
    """RGB, or RGBA where alpha counts, (h, w, 3 or 4), row 0 at the top."""
    uv_set: int = 0
    """Which texture coordinates: 0 ``Mesh.uvs``, 1 ``Mesh.uvs_second``."""
    transform: tuple[float, ...] = IDENTITY
    """As ``TextureUse.transform``."""
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
    """Beyond the border along u and v."""
    nearest: bool = False
    """Whether texels are shown as squares."""

    @property
    def placing(self) -> tuple[float, float, float, float, float]:
        """Scale along u and v, counter-clockwise turn in radians, then offsets, for v that points up."""
        a, b, c, d, e, f = self.transform
        turn = math.atan2(d, a)
        return math.hypot(a, d), e * math.cos(turn) - b * math.sin(turn), turn, c, f

    def encode(self) -> bytes:
        """PNG."""
        order = cv2.COLOR_RGB2BGR if self.codes.shape[2] == 3 else cv2.COLOR_RGBA2BGRA
        done, data = cv2.imencode(".png", cv2.cvtColor(self.codes, order))
        assert done
        return sign_png(data.tobytes())

    @property
    def digest(self) -> bytes:
        """Equal for equal codes."""
        return hashlib.blake2b(self.codes.tobytes(), person=b"%d" % self.codes.shape[1]).digest()


@dataclasses.dataclass(frozen=True)
class ExchangeMaterial:
    """A material as UsdPreviewSurface and glTF know it: metallic-roughness, or an explicit specular colour."""

    base_color: RGB = (0.8, 0.8, 0.8)
    """Linear; multiplies the texture."""
    metallic: float = 0.0
    roughness: float = 1.0
    """Perceptual: alpha is its square."""
    specular: RGB | None = None
    """Reflectance straight on where it is given; None: by ``metallic``, 0.04 for what is no metal."""
    texture: Picture | None = None
    """Of the base colour, sRGB-encoded; of opacity, where ``alpha`` is not ``opaque``."""
    emission: RGB = (0.0, 0.0, 0.0)
    """Radiance that it sends out; multiplies ``glow``."""
    glow: Picture | None = None
    """Picture of the emission, sRGB-encoded."""
    metallic_roughness: Picture | None = None
    """G times roughness, B times metallic, linear."""
    normal: Picture | None = None
    """Normal in the tangent frame, 0.5 + 0.5 n, linear."""
    normal_scale: float = 1.0
    """Factor of the normal's first two components."""
    occlusion: Picture | None = None
    """R, linear: the share of the environment that reaches a point."""
    occlusion_strength: float = 1.0
    """Share of the occlusion that counts."""
    alpha: Literal["opaque", "mask", "blend"] = "opaque"
    """As ``MeshMaterial.alpha``."""
    opacity: float = 1.0
    """Constant factor of alpha."""
    cutoff: float = 0.5
    """Alpha from which on a mask is there."""
    double_sided: bool = True
    """Whether triangles are seen from behind."""
    unlit: bool = False
    """Whether the base colour is shown as it is."""
    name: str = ""
    """The file's name for it."""

    @property
    def pictures(self) -> dict[str, Picture]:
        """Its pictures by what they are of; the base colour's name is empty."""
        named = {
            "": self.texture,
            "emission": self.glow,
            "metallic_roughness": self.metallic_roughness,
            "normal": self.normal,
            "occlusion": self.occlusion,
        }
        return {name: picture for name, picture in named.items() if picture is not None}


def exchange_materials_of(item: Object, mesh: Mesh) -> tuple[ExchangeMaterial, ...]:
    """Materials of an object's triangles, in the order of ``Mesh.materials``; one where it has none of its own."""
    return tuple(_exchange_material(item, mesh, material) for material in materials_of(item).materials)


def _exchange_material(item: Object, mesh: Mesh, material: MeshMaterial) -> ExchangeMaterial:
    def picture(use: TextureUse | None, channels: int = 3) -> Picture | None:
        if use is None or (mesh.uvs if use.uv_set == 0 else mesh.uvs_second) is None:
            return None
        codes = np.ascontiguousarray(mesh.images[use.image][..., :channels])
        return Picture(codes, use.uv_set, use.transform, use.wrap, use.nearest)

    base = picture(material.base, 3 if material.alpha == "opaque" else 4)
    emission, glow = material.emission, picture(material.emissive)
    if isinstance(item.material, EmissiveMaterial) and item.material.image is not None and mesh.uvs is not None:
        glow = Picture(load_emission(item.material.image)[0])
    return dataclasses.replace(
        _reflection_of(material, base, mesh),
        emission=emission,
        glow=glow if any(emission) else None,
        metallic_roughness=picture(material.metallic_roughness),
        normal=picture(material.normal),
        normal_scale=material.normal_scale,
        occlusion=picture(material.occlusion),
        occlusion_strength=material.occlusion_strength,
        alpha=material.alpha,
        opacity=material.opacity,
        cutoff=material.cutoff,
        double_sided=material.double_sided,
        unlit=material.unlit,
        name=material.name,
    )


def _reflection_of(own: MeshMaterial, base: Picture | None, mesh: Mesh) -> ExchangeMaterial:
    """What ``_exchange_material`` says of the colours and the lobe of reflected light."""
    material = own.surface
    assert not isinstance(material, FileMaterial | EmissiveMaterial)
    if isinstance(material, PhongMaterial):
        alpha = math.sqrt(2.0 / (material.shininess + 2.0))
        factor, texture = _colored(material.diffuse, base, mesh)
        specular = _mean_color(material.specular)
        if own.specular is not None:
            shown = to_linear(mesh.images[own.specular.image][..., :3]).mean(axis=(0, 1))
            specular = (specular[0] * shown[0], specular[1] * shown[1], specular[2] * shown[2])
        return ExchangeMaterial(factor, 0.0, math.sqrt(alpha), specular, texture)
    factor, texture = _colored(material.base_color, base, mesh)
    if isinstance(material, MetallicRoughnessMaterial):
        return ExchangeMaterial(factor, material.metallic, material.roughness, None, texture)
    if isinstance(material, MirrorMaterial):
        return ExchangeMaterial(factor, 1.0, 0.0, None, texture)
    return ExchangeMaterial(factor, 0.0, 1.0, (0.0, 0.0, 0.0), texture)


def _colored(color: Color, base: Picture | None, mesh: Mesh) -> tuple[RGB, Picture | None]:
    """Factor and texture of a colour; a texture that the mesh brings is multiplied by the material's."""
    if not isinstance(color, Path):
        return color, base
    own = load_texture(color)
    if mesh.uvs is None:
        return _mean_color(color), None
    if base is None:
        return WHITE, Picture(own)
    codes = base.codes
    height, width = (max(a, b) for a, b in zip(own.shape[:2], codes.shape[:2], strict=True))
    both = cv2.resize(codes, (width, height))
    product = to_srgb(to_linear(cv2.resize(own, (width, height))) * to_linear(both[..., :3]))
    return WHITE, dataclasses.replace(base, codes=np.concatenate([product, both[..., 3:]], axis=-1))


def _mean_color(color: Color) -> RGB:
    if not isinstance(color, Path):
        return color
    r, g, b = to_linear(load_texture(color)).mean(axis=(0, 1)).tolist()
    return r, g, b


def to_linear(codes: Codes) -> Array:
    """Linear values of sRGB codes."""
    return decode_srgb(codes.astype(np.float64) / 255.0)


def to_srgb(values: Array) -> Codes:
    """Codes of linear values, sRGB-encoded."""
    return np.rint(255.0 * encode_srgb(np.clip(values, 0.0, 1.0))).astype(np.uint8)


def vertex_colors(item: Object, mesh: Mesh) -> npt.NDArray[np.float32] | None:
    """Factors of base colour and alpha at vertices, (n, 4), linear, where the object shows them."""
    return mesh.colors if isinstance(item.material, FileMaterial) else None


def texture_plan(path: Path, name: str, materials: Sequence[ExchangeMaterial]) -> dict[tuple[int, str], Path]:
    """Where the pictures of a body go that cannot lie in the file itself, by material and what they are of.

    Equal pictures share a file.
    """
    found: dict[tuple[int, str], Path] = {}
    known: dict[bytes, Path] = {}
    for number, material in enumerate(materials):
        for kind, picture in material.pictures.items():
            parts = (path.stem, name, str(number) if number else "", kind)
            file = path.with_name("_".join(part for part in parts if part) + ".png")
            found[number, kind] = known.setdefault(picture.digest, file)
    return found


def used_materials(item: Object, mesh: Mesh) -> tuple[tuple[ExchangeMaterial, ...], npt.NDArray[np.int64] | None]:
    """Materials that triangles have, and which of them each has, (m,); None: all the first."""
    materials = exchange_materials_of(item, mesh)
    if len(materials) == 1 or mesh.triangle_materials is None:
        return materials[:1], None
    used, numbers = np.unique(mesh.triangle_materials, return_inverse=True)
    return tuple(materials[number] for number in used), None if len(used) == 1 else numbers.reshape(-1)


def placed_by(picture: Picture) -> dict[str, Any]:
    """KHR_texture_transform of a picture, whose v runs down; nothing where it lies as it is."""
    if picture.transform == IDENTITY:
        return {}
    across, up, turn, c, f = picture.placing
    b, e = picture.transform[1], picture.transform[4]
    return {"offset": [c + b, 1.0 - e - f], "rotation": turn, "scale": [across, up]}
