"""Materials of glTF 2.0, and of the extensions that stay within its core model.

References:
    Khronos, glTF 2.0 specification, 3.8 and 3.9; KHR_texture_transform, KHR_materials_emissive_strength,
    KHR_materials_unlit, EXT_texture_webp.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, cast

from warp_ar.scene.materials import RGB, MetallicRoughnessMaterial
from warp_ar.scene.mesh_assets import fail, objects
from warp_ar.scene.mesh_materials import IDENTITY, MeshMaterial, TextureUse, Wrap

SUPPORTED: Final = (
    "KHR_materials_emissive_strength",
    "KHR_materials_unlit",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
    "EXT_texture_webp",
)
"""Extensions that are followed."""

_WRAPS: Final[dict[int, Wrap]] = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
_NEAREST: Final = 9728
_BRIGHTEST: Final = 1e6
"""Largest radiance that a material may send out: exposure and encoding keep their digits."""


class GltfMaterials:
    """Reads the materials of one file, each once."""

    def __init__(
        self, path: Path, header: dict[str, Any], take_image: Callable[[object], int], note: Callable[[str], None]
    ) -> None:
        """Read nothing yet.

        Args:
            path: The file, for messages.
            header: Its JSON.
            take_image: Gives the number in ``Mesh.images`` of an image of the file.
            note: Told of what is left out.
        """
        self._path, self._take_image, self._note = path, take_image, note
        self._materials, self._textures, self._samplers = (
            objects(path, header, key) for key in ("materials", "textures", "samplers")
        )
        self._known: dict[int, MeshMaterial] = {}

    def read(self, index: object) -> MeshMaterial:
        """A material by its number, as the file has it; None is glTF's default.

        Raises:
            SceneError: There is none, or it names a texture that is not there, or a factor is no number.
        """
        if index is None:
            return self._material({}, "")
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(self._materials):
            fail(self._path, f"a mesh names material {str(index)[:20]}; there are {len(self._materials)} from 0 on")
        if index not in self._known:
            item = self._materials[index]
            self._known[index] = self._material(item, str(item.get("name", ""))[:80])
        return self._known[index]

    def _material(self, item: dict[str, Any], name: str) -> MeshMaterial:
        label = f"material {name!r}" if name else "a material"
        reflection = self._table(item, "pbrMetallicRoughness", label)
        extensions = self._table(item, "extensions", label)
        color = self._numbers(reflection, "baseColorFactor", (1.0, 1.0, 1.0, 1.0), 1.0, label)
        metallic = self._number(reflection, "metallicFactor", 1.0, 1.0, label)
        roughness = self._number(reflection, "roughnessFactor", 1.0, 1.0, label)
        normal, occlusion = (self._table(item, key, label) for key in ("normalTexture", "occlusionTexture"))
        strength = self._table(extensions, "KHR_materials_emissive_strength", label)
        glow = self._number(strength, "emissiveStrength", 1.0, _BRIGHTEST, label)
        emission = [glow * value for value in self._numbers(item, "emissiveFactor", (0.0, 0.0, 0.0), 1.0, label)]
        mode = item.get("alphaMode", "OPAQUE")
        if mode not in ("OPAQUE", "MASK", "BLEND"):
            fail(self._path, f"{label} has alphaMode {str(mode)[:20]!r}; OPAQUE, MASK or BLEND are right")
        return MeshMaterial(
            surface=MetallicRoughnessMaterial(cast(RGB, tuple(color[:3])), metallic, roughness),
            name=name,
            alpha=cast(Any, mode.lower()),
            opacity=color[3],
            cutoff=self._number(item, "alphaCutoff", 0.5, 1e6, label),
            double_sided=item.get("doubleSided") is True,
            unlit="KHR_materials_unlit" in extensions,
            emission=cast(RGB, tuple(emission)),
            base=self._use(reflection, "baseColorTexture", label),
            metallic_roughness=self._use(reflection, "metallicRoughnessTexture", label),
            normal=self._use(item, "normalTexture", label),
            normal_scale=self._number(normal, "scale", 1.0, 1e3, label, low=-1e3),
            occlusion=self._use(item, "occlusionTexture", label),
            occlusion_strength=self._number(occlusion, "strength", 1.0, 1.0, label),
            emissive=self._use(item, "emissiveTexture", label) if any(emission) else None,
        )

    def _table(self, parent: dict[str, Any], key: str, label: str) -> dict[str, Any]:
        value = parent.get(key)
        if value is None:
            return {}
        if not isinstance(value, dict):
            fail(self._path, f"{label} has {key} {str(value)[:30]!r}, which is no object")
        return value

    def _number(
        self, item: dict[str, Any], key: str, default: float, high: float, label: str, *, low: float = 0.0
    ) -> float:
        value = item.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            fail(self._path, f"{label} has {key} {str(value)[:30]!r}, which is no finite number")
        return min(max(float(value), low), high)

    def _numbers(
        self, item: dict[str, Any], key: str, default: tuple[float, ...], high: float, label: str
    ) -> tuple[float, ...]:
        value = item.get(key, default)
        if not isinstance(value, list | tuple) or len(value) != len(default):
            fail(self._path, f"{label} has {key} {str(value)[:30]!r}; a list of {len(default)} numbers is right")
        return tuple(self._number({key: entry}, key, 0.0, high, label) for entry in value)

    def _use(self, item: dict[str, Any], key: str, label: str) -> TextureUse | None:
        reference = self._table(item, key, label)
        if not reference:
            return None
        index = reference.get("index")
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(self._textures):
            fail(self._path, f"{label} names texture {str(index)[:20]}; there are {len(self._textures)} from 0 on")
        texture = self._textures[index]
        source = texture.get("source")
        webp = self._table(self._table(texture, "extensions", label), "EXT_texture_webp", label)
        source = webp.get("source", source)
        if source is None:
            self._note("a texture in a format of an extension")
            return None
        transform = self._table(self._table(reference, "extensions", label), "KHR_texture_transform", label)
        uv_set = transform.get("texCoord", reference.get("texCoord", 0))
        if uv_set not in (0, 1):
            self._note("texture coordinates beyond the second set")
            return None
        sampler = texture.get("sampler")
        settings: dict[str, Any] = {}
        if sampler is not None:
            if isinstance(sampler, bool) or not isinstance(sampler, int) or not 0 <= sampler < len(self._samplers):
                fail(self._path, f"texture {index} names sampler {str(sampler)[:20]}; there are {len(self._samplers)}")
            settings = self._samplers[sampler]
        wraps = [settings.get(name, 10497) for name in ("wrapS", "wrapT")]
        if any(not isinstance(wrap, int) or wrap not in _WRAPS for wrap in wraps):
            fail(self._path, f"texture {index} wraps as {str(wraps)[:30]}; {', '.join(map(str, _WRAPS))} are right")
        return TextureUse(
            image=self._take_image(source),
            uv_set=int(uv_set),
            transform=self._transform(transform, label),
            wrap=(_WRAPS[wraps[0]], _WRAPS[wraps[1]]),
            nearest=settings.get("magFilter") == _NEAREST,
        )

    def _transform(self, item: dict[str, Any], label: str) -> tuple[float, ...]:
        """KHR_texture_transform for coordinates whose v points up.

        glTF's v runs down, and (u', v') = T R S (u, v). With w = 1 - v the rows are those of u' and 1 - v'.
        """
        if not item:
            return IDENTITY
        offset, scale = self._pair(item, "offset", 0.0, label), self._pair(item, "scale", 1.0, label)
        angle = self._number(item, "rotation", 0.0, 1e6, label, low=-1e6)
        cos, sin = math.cos(angle), math.sin(angle)
        a, b, c = cos * scale[0], sin * scale[1], offset[0]
        d, e, f = -sin * scale[0], cos * scale[1], offset[1]
        return (a, -b, b + c, -d, e, 1.0 - e - f)

    def _pair(self, item: dict[str, Any], key: str, default: float, label: str) -> list[float]:
        value = item.get(key, [default, default])
        if not isinstance(value, list) or len(value) != 2:
            fail(self._path, f"{label} has {key} {str(value)[:30]!r}; a list of 2 numbers is right")
        return [self._number({key: entry}, key, default, 1e6, label, low=-1e6) for entry in value]
