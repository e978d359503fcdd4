"""Materials as trimesh has them: OBJ's material libraries with their PBR extension, and glTF's in memory.

MTL's illumination models are Phong's: Kd is the diffuse colour, Ks and Ns the lobe, which is left out where ``illum``
is 0 or 1. A library that says Pr or Pm means a metallic-roughness material.

References:
    Wavefront, "Object Files (.obj), Appendix B1", material library file; the Pr, Pm, norm and map_Ke of the PBR
    extension.
"""

from __future__ import annotations

import math
import re
from typing import Any, Final, cast

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.errors import SceneError
from warp_ar.scene.gltf import decode_rgba
from warp_ar.scene.materials import RGB, LambertMaterial, Material, MetallicRoughnessMaterial, PhongMaterial
from warp_ar.scene.mesh_assets import Assets
from warp_ar.scene.mesh_materials import MeshMaterial, TextureUse

ByteArray = npt.NDArray[np.uint8]

_LEFT_OUT: Final = {
    "map_bump": "bump maps",
    "bump": "bump maps",
    "disp": "displacement maps",
    "map_ns": "maps of Ns",
    "refl": "reflection maps",
    "tf": "transmission (Tf)",
    "pc": "clearcoat (Pc)",
    "ps": "sheen (Ps)",
    "aniso": "anisotropy",
}
"""Keys of a library that are not shown, in words."""

CHALK: Final[RGB] = (0.8, 0.8, 0.8)
"""Diffuse colour of a material that says none."""
_MADE_UP: Final = (2, 2)
"""Size of the picture that trimesh makes up where there is none."""

_OPTIONS: Final = {"-bm": 1, "-blendu": 1, "-blendv": 1, "-cc": 1, "-clamp": 1, "-imfchan": 1, "-mm": 2, "-texres": 1}
"""Options of a map, and how many words follow; -o, -s and -t have one to three numbers."""


def parse_library(text: str) -> dict[str, dict[str, Any]]:
    """Return the materials of an OBJ's library by name: their words by key in lower case."""
    found: dict[str, dict[str, Any]] = {}
    values: dict[str, Any] = {}
    for line in re.sub(r"\\[ \t]*\r?\n", " ", text).splitlines():
        key, *words = re.sub(r"(^|\s)#.*", "", line).split() or [""]
        if key.lower() == "newmtl":
            name = " ".join(words)
            values = {"name": name}
            found.setdefault(name, values)
        elif words:
            values[key.lower()] = words
    return found


def read_library(
    label: str, values: dict[str, Any], images: list[ByteArray], notes: list[str], assets: Assets
) -> MeshMaterial:
    """Return a material of `parse_library`.

    Args:
        label: The file, for messages.
        values: Words of the material by key.
        images: Pictures so far, RGBA; those of the material are added.
        notes: What is not shown so far; what the material has of it is added.
        assets: Finds the files that the library names.

    Raises:
        SceneError: A picture is missing or damaged.
    """
    return _Library(label, values, images, notes, assets).read(None)


def read_library_material(label: str, source: Any, images: list[ByteArray], notes: list[str]) -> MeshMaterial | None:
    """Return a material of trimesh; None if it says nothing.

    Args:
        label: The mesh, for messages.
        source: trimesh's material, or None.
        images: Pictures so far, RGBA; those of the material are added.
        notes: What is not shown so far; what the material has of it is added.

    Raises:
        SceneError: A picture is missing or damaged.
    """
    if source is None:
        return None
    if type(source).__name__ == "PBRMaterial":
        return _PbrInMemory(label, source, images).read()
    values = getattr(source, "kwargs", None) or {}
    image = _own_picture(label, source, images)
    if not values and image is None:
        return None
    values = {"name": getattr(source, "name", ""), **values}
    return _Library(label, values, images, notes, None).read(image)


def _own_picture(label: str, source: Any, images: list[ByteArray]) -> TextureUse | None:
    """The colour's picture that trimesh has opened."""
    image = getattr(source, "image", None)
    # Where a file has coordinates but no texture, trimesh makes a grey one up; only pictures from files have a format.
    made_up = getattr(image, "format", None) is None and getattr(image, "size", None) == _MADE_UP
    return None if image is None or made_up else _add_picture(label, image, images)


def _add_picture(label: str, image: Any, images: list[ByteArray]) -> TextureUse:
    try:
        images.append(np.asarray(image.convert("RGBA"), dtype=np.uint8).copy())
    except (OSError, ValueError, SyntaxError, MemoryError, EOFError) as error:
        raise SceneError(f"{label}: a texture of the mesh cannot be read ({' '.join(str(error).split())})") from error
    return TextureUse(len(images) - 1)


class _Library:
    """Reads one material of a library."""

    def __init__(
        self,
        label: str,
        values: dict[str, Any],
        images: list[ByteArray],
        notes: list[str],
        assets: Assets | None,
    ) -> None:
        self._label, self._values = label, values
        self._images, self._notes, self._assets = images, notes, assets

    def read(self, base: TextureUse | None) -> MeshMaterial:
        """The material, with the picture of its colour if it has one."""
        for key, words in _LEFT_OUT.items():
            if key in self._values and words not in self._notes:
                self._notes.append(words)
        base = base or self._use(self._picture("map_kd"))
        white = (1.0, 1.0, 1.0)
        diffuse = self._color("kd", white if base is not None else CHALK)
        specular = self._color("ks", (0.0, 0.0, 0.0))
        opacity = self._number("d", 1.0 - self._number("tr", 0.0, 0.0, 1.0), 0.0, 1.0)
        base, alpha = self._with_alpha(base, opacity)
        maps = self._picture("map_pr"), self._picture("map_pm")
        specular_map = self._picture("map_ks")
        # A lobe without an exponent is none: some programs use Ks for numbers of their own.
        shiny = (any(specular) and "ns" in self._values) or specular_map is not None
        surface: Material
        if maps != (None, None) or "pr" in self._values or "pm" in self._values:
            metallic = self._number("pm", 1.0 if maps[1] is not None else 0.0, 0.0, 1.0)
            roughness = self._number("pr", 1.0 if maps[0] is not None else 0.5, 0.0, 1.0)
            surface, specular_map = MetallicRoughnessMaterial(diffuse, metallic, roughness), None
        elif shiny and self._number("illum", 2.0, 0.0, 10.0) >= 2.0:
            if specular_map is not None and not any(specular):
                specular = white
            # Diffuse and lobe together reflect no more than arrives.
            most = max(a + b for a, b in zip(diffuse, specular, strict=True))
            diffuse, specular = (
                cast(RGB, tuple(value / max(most, 1.0) for value in color)) for color in (diffuse, specular)
            )
            surface = PhongMaterial(diffuse, specular, self._number("ns", 32.0, 0.0, 1e4))
        else:
            surface, specular_map = LambertMaterial(diffuse), None
        glow = self._picture("map_ke")
        emission = self._color("ke", white if glow is not None else (0.0, 0.0, 0.0), most=1e6)
        if glow is not None and not any(emission):
            emission = white
        return MeshMaterial(
            surface=surface,
            name=str(self._values.get("name") or "")[:80],
            alpha=cast(Any, alpha),
            opacity=opacity,
            emission=emission,
            base=base,
            specular=self._use(specular_map),
            metallic_roughness=self._use(self._pack(*maps)),
            normal=self._use(self._picture("norm") if "norm" in self._values else self._picture("map_kn")),
            emissive=self._use(glow),
        )

    def _use(self, picture: ByteArray | None) -> TextureUse | None:
        if picture is None:
            return None
        self._images.append(picture)
        return TextureUse(len(self._images) - 1)

    def _with_alpha(self, base: TextureUse | None, opacity: float) -> tuple[TextureUse | None, str]:
        """The colour's picture with the alpha that ``map_d`` says, and what alpha does."""
        mask = self._picture("map_d")
        if mask is None:
            return base, "blend" if opacity < 1.0 else "opaque"
        # A picture without alpha says it in its brightness.
        shown = mask[..., 3] if mask[..., 3].min() < 255 else mask[..., 1]
        color = np.full((*shown.shape, 4), 255, np.uint8) if base is None else self._images[base.image].copy()
        if color.shape[:2] != shown.shape:
            shown = cv2.resize(shown, color.shape[1::-1], interpolation=cv2.INTER_LINEAR)
        color[..., 3] = shown
        return self._use(color), "mask"

    def _pack(self, roughness: ByteArray | None, metallic: ByteArray | None) -> ByteArray | None:
        """Two pictures in the channels of one."""
        first = roughness if roughness is not None else metallic
        if first is None:
            return None
        packed = np.full_like(first, 255)
        for channel, picture in ((1, roughness), (2, metallic)):
            if picture is not None:
                fitted = picture
                if picture.shape != first.shape:
                    fitted = np.asarray(cv2.resize(picture, first.shape[1::-1]), dtype=np.uint8)
                packed[..., channel] = fitted[..., 1]
        return packed

    def _picture(self, key: str) -> ByteArray | None:
        """A picture that the library names."""
        words = self._values.get(key)
        if not isinstance(words, list) or not words or self._assets is None:
            return None
        rest = [str(word) for word in words]
        while len(rest) > 1 and rest[0].startswith("-"):
            option, rest = rest[0].lower(), rest[1:]
            if option in _OPTIONS:
                rest = rest[_OPTIONS[option] :]
            else:  # -o, -s, -t
                self._notes.extend(["offsets and scales of maps"] * ("offsets and scales of maps" not in self._notes))
                count = 0
                while rest and count < 3 and _is_number(rest[0]):
                    rest, count = rest[1:], count + 1
        name = " ".join(rest)
        return decode_rgba(self._assets.get(name), f"{self._label}: {name}")

    def _color(self, key: str, default: RGB, most: float = 1.0) -> RGB:
        value = self._values.get(key, default)
        items = value if isinstance(value, list | tuple) else [value]
        if not all(_is_number(item) for item in items) or len(items) not in (1, 3):
            return default
        numbers = [min(max(float(item), 0.0), most) for item in items]
        return cast(RGB, tuple(numbers if len(numbers) == 3 else numbers * 3))

    def _number(self, key: str, default: float, low: float, high: float) -> float:
        value = self._values.get(key, default)
        first = value[0] if isinstance(value, list) and value else value
        return min(max(float(first), low), high) if _is_number(first) else default


def _is_number(value: object) -> bool:
    try:
        return math.isfinite(float(cast(Any, value)))
    except (TypeError, ValueError):
        return False


class _PbrInMemory:
    """A material of glTF that trimesh holds."""

    def __init__(self, label: str, source: Any, images: list[ByteArray]) -> None:
        self._label, self._source, self._images = label, source, images

    def read(self) -> MeshMaterial:
        """The material; alpha, factors and pictures as trimesh has them."""
        source = self._source
        color = self._factor("baseColorFactor", (1.0, 1.0, 1.0, 1.0))
        return MeshMaterial(
            surface=MetallicRoughnessMaterial(
                cast(RGB, color[:3]),
                self._factor("metallicFactor", (1.0,))[0],
                self._factor("roughnessFactor", (1.0,))[0],
            ),
            name=str(source.name or "")[:80],
            alpha=cast(Any, {"MASK": "mask", "BLEND": "blend"}.get(source.alphaMode, "opaque")),
            opacity=color[3],
            cutoff=self._factor("alphaCutoff", (0.5,))[0],
            double_sided=bool(source.doubleSided),
            emission=cast(RGB, self._factor("emissiveFactor", (0.0, 0.0, 0.0))),
            base=self._picture("baseColorTexture"),
            metallic_roughness=self._picture("metallicRoughnessTexture"),
            normal=self._picture("normalTexture"),
            occlusion=self._picture("occlusionTexture"),
            emissive=self._picture("emissiveTexture"),
        )

    def _factor(self, name: str, default: tuple[float, ...]) -> tuple[float, ...]:
        value = getattr(self._source, name, None)
        if value is None:
            return default
        array = np.atleast_1d(np.asarray(value))
        numbers = (array / 255.0 if array.dtype == np.uint8 else array).astype(float).tolist()
        return tuple(min(max(number, 0.0), 1.0) for number in [*numbers, *default[len(numbers) :]])[: len(default)]

    def _picture(self, name: str) -> TextureUse | None:
        image = getattr(self._source, name, None)
        return None if image is None else _add_picture(self._label, image, self._images)
