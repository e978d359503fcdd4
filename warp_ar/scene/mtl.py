"""OBJ's material libraries with their PBR extension.

MTL's illumination models are Phong's: Kd is the diffuse colour, Ks and Ns define the specular lobe, which ``illum`` 0
and 1 leave out. A material with Pr or Pm becomes a metallic-roughness material.

References:
    Wavefront, "Object Files (.obj), Appendix B1", material library file; the Pr, Pm, norm and map_Ke of the PBR
    extension.
"""

from __future__ import annotations

import dataclasses
import itertools
import re
from typing import Any, Final, cast

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.scene.materials import (
    RGB,
    LambertMaterial,
    Material,
    MeshMaterial,
    MetallicRoughnessMaterial,
    PhongMaterial,
    TextureUse,
    Wrap,
)
from warp_ar.scene.mesh_source import MeshSource
from warp_ar.scene.messages import is_number

ByteArray = npt.NDArray[np.uint8]

_KNOWN: Final = "name|k[adse]|n[si]|d|tr|illum|p[rm]|map_(k[dsen]|d|p[rm])|norm|pcr|anisor|sharpness"
"""Pattern of keys that are read, and of keys without effect in this lighting."""

CHALK: Final[RGB] = (0.8, 0.8, 0.8)
"""Diffuse colour of a material that defines none."""

_OPTIONS: Final = {
    **dict.fromkeys(("-blendu", "-blendv", "-boost", "-bm", "-cc", "-clamp", "-imfchan", "-texres", "-type"), 1),
    "-mm": 2,
    **dict.fromkeys(("-o", "-s", "-t"), 3),
}
"""Options of a map, and the number of words after each; of three numbers the last two may be omitted."""
_NOT_FOLLOWED: Final = {
    "-boost": ("sharpness of maps (-boost)", ["0"]),
    "-cc": ("colour correction of maps (-cc)", ["off"]),
    "-mm": ("ranges of maps (-mm)", ["0", "1"]),
    "-t": ("turbulence of maps (-t)", ["0", "0", "0"]),
}
"""Unsupported options that change a map: their description, and the values at which they have no effect."""


@dataclasses.dataclass(frozen=True)
class _Map:
    """Picture that a library refers to, with its placement on the surface."""

    picture: ByteArray
    """RGBA."""
    transform: tuple[float, ...]
    """Transform of texture coordinates, in the form of ``TextureUse.transform``."""
    clamped: bool
    """True if the picture does not repeat."""
    channel: int | None
    """Channel from which a scalar map is read; None if the library names none."""
    strength: float
    """Factor of a bump or normal map."""

    def values(self) -> ByteArray:
        """Return the values of a scalar map, (h, w); the green channel is the default."""
        return self.picture[..., 1 if self.channel is None else self.channel]


def parse_library(text: str) -> dict[str, dict[str, Any]]:
    """Return the materials of an OBJ's library by name, each as its words by lower-case key."""
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


def read_library(source: MeshSource, values: dict[str, Any]) -> MeshMaterial:
    """Return one material of `parse_library`.

    Follows:
        Kd, Ks, Ns, Ke, d, Tr, illum, Pr, Pm; map_Kd, map_Ks, map_Ke, map_d, map_Pr, map_Pm, norm, map_Kn; their -s, -o,
        -clamp, -imfchan; -bm of normal maps.

    Args:
        source: The mesh's file, to which the material's pictures and notes are added.
        values: Words of the material by key.

    Raises:
        SceneError: Damaged.
    """
    return _Library(source, values).read()


class _Library:
    """Reader of one material of a library."""

    def __init__(self, source: MeshSource, values: dict[str, Any]) -> None:
        self._source, self._values = source, values

    def read(self) -> MeshMaterial:
        """Return the material, with its base colour picture if it has one."""
        for key, words in self._values.items():
            nothing = {1.0} if key == "tf" else {0.0}  # no effect
            shown = (
                re.fullmatch(_KNOWN, key)
                or (key == "map_ka" and "map_kd" in self._values)
                or not isinstance(words, list)
            )
            if not shown and not (all(map(is_number, words)) and set(map(float, words)) == nothing):
                self._source.note(f"the key {key[:40]} of materials")
        color = self._map("map_kd", color=True)
        white = (1.0, 1.0, 1.0)
        diffuse = self._color("kd", CHALK if color is None else white)
        specular = self._color("ks", (0.0, 0.0, 0.0))
        opacity = self._number("d", 1.0 - self._number("tr", 0.0, 0.0, 1.0), 0.0, 1.0)
        mask = self._map("map_d")
        alpha = "mask" if mask is not None else "blend" if opacity < 1.0 else "opaque"
        base = self._use(color if mask is None else self._masked(color, mask))
        maps = self._map("map_pr"), self._map("map_pm")
        specular_map = self._map("map_ks", color=True)
        # A specular colour without exponent is ignored: some programs use Ks for other purposes.
        exponent = self._number("ns", 0.0, 0.0, 1e4)
        shiny = (any(specular) and exponent > 0.0) or specular_map is not None
        surface: Material
        if maps != (None, None) or "pr" in self._values or "pm" in self._values:
            metallic = self._number("pm", 1.0 if maps[1] is not None else 0.0, 0.0, 1.0)
            roughness = self._number("pr", 1.0 if maps[0] is not None else 0.5, 0.0, 1.0)
            surface, specular_map = MetallicRoughnessMaterial(diffuse, metallic, roughness), None
        elif shiny and self._number("illum", 2.0, 0.0, 10.0) >= 2.0:
            if specular_map is not None and not any(specular):
                specular = white
            # Energy conservation: diffuse and specular reflectance sum to at most 1.
            most = max(a + b for a, b in zip(diffuse, specular, strict=True))
            diffuse, specular = (
                cast(RGB, tuple(value / max(most, 1.0) for value in color)) for color in (diffuse, specular)
            )
            surface = PhongMaterial(diffuse, specular, exponent or 32.0)
        else:
            surface, specular_map = LambertMaterial(diffuse), None
        glow = self._map("map_ke", color=True)
        emission = self._color("ke", white if glow is not None else (0.0, 0.0, 0.0), most=1e6)
        if glow is not None and not any(emission):
            emission = white
        normal = self._map("norm" if "norm" in self._values else "map_kn")
        return MeshMaterial(
            surface=surface,
            name=str(self._values.get("name") or "")[:80],
            alpha=cast(Any, alpha),
            opacity=opacity,
            emission=emission,
            base=base,
            specular=self._use(specular_map),
            metallic_roughness=self._use(self._pack(*maps)),
            normal=self._use(normal),
            normal_scale=1.0 if normal is None else normal.strength,
            emissive=self._use(glow),
        )

    def _use(self, one: _Map | None) -> TextureUse | None:
        if one is None:
            return None
        self._source.images.append(one.picture)
        way: Wrap = "clamp" if one.clamped else "repeat"
        return TextureUse(len(self._source.images) - 1, transform=one.transform, wrap=(way, way))

    def _masked(self, color: _Map | None, mask: _Map) -> _Map:
        """Return the colour picture with the alpha of ``map_d``."""
        # A mask without alpha channel stores alpha as brightness.
        own = mask.channel is None and mask.picture[..., 3].min() < 255
        shown = mask.picture[..., 3] if own else mask.values()
        if color is None:
            color = dataclasses.replace(mask, picture=np.full((*shown.shape, 4), 255, np.uint8))
        return self._with_channels(color, {3: (mask, shown)})

    def _pack(self, roughness: _Map | None, metallic: _Map | None) -> _Map | None:
        """Return the roughness and metallic pictures combined in the channels of one picture."""
        first = roughness or metallic
        if first is None:
            return None
        white = dataclasses.replace(first, picture=np.full_like(first.picture, 255))
        found = {1: roughness, 2: metallic}
        return self._with_channels(white, {k: (one, one.values()) for k, one in found.items() if one is not None})

    def _with_channels(self, into: _Map, channels: dict[int, tuple[_Map, ByteArray]]) -> _Map:
        """Return a copy of the picture ``into`` with some channels replaced.

        Args:
            into: The picture.
            channels: For each replaced channel's number, the picture that its values come from, and these values.
        """
        picture = into.picture.copy()
        for channel, (one, values) in channels.items():
            if (one.transform, one.clamped) != (into.transform, into.clamped):
                self._source.note("maps of one material that are placed differently")
            if values.shape != picture.shape[:2]:
                values = np.asarray(cv2.resize(values, picture.shape[1::-1]), dtype=np.uint8)
            picture[..., channel] = values
        return dataclasses.replace(into, picture=picture)

    def _map(self, key: str, *, color: bool = False) -> _Map | None:
        """Return a picture that the library refers to; in sRGB if it is a colour."""
        words = self._values.get(key)
        if not isinstance(words, list) or not all(isinstance(word, str) for word in words):
            return None
        rest = list(words)
        name: list[str] = []
        said: dict[str, list[str]] = {}
        while rest:
            word, option = rest.pop(0), ""
            if rest and (word.lower() in _OPTIONS or (not name and re.match("-[A-Za-z]", word))):
                option = word.lower()
            if not option:
                name.append(word)
                continue
            most = _OPTIONS.get(option, 3)
            numbers = list(itertools.takewhile(is_number, rest[:most]))
            said[option] = numbers if most == 3 else rest[:most]
            del rest[: len(said[option])]
            unchanged = _NOT_FOLLOWED.get(option, ("", said[option]))[1]
            if option not in _OPTIONS:
                self._source.note(f"the option {option[:20]} of maps")
            elif said[option] != unchanged[: len(said[option])]:
                self._source.note(_NOT_FOLLOWED[option][0])
        path = " ".join(name)
        u, v = ([float(word) for word in said.get(key, [])][:2] for key in ("-s", "-o"))
        (su, sv), (ou, ov) = [*u, *(1.0, 1.0)[len(u) :]], [*v, *(0.0, 0.0)[len(v) :]]
        channel = said.get("-imfchan", ["l"])[0].lower()
        strength = said.get("-bm", ["1"])[0]
        return _Map(
            self._source.picture(path, color=color),
            (su, 0.0, ou, 0.0, sv, ov),
            said.get("-clamp", ["off"])[0].lower() == "on",
            {"r": 0, "g": 1, "b": 2, "m": 3}.get(channel),
            float(strength) if is_number(strength) else 1.0,
        )

    def _color(self, key: str, default: RGB, most: float = 1.0) -> RGB:
        numbers = self._numbers(key, (1, 3), 0.0, most)
        return cast(RGB, tuple((3 * numbers)[:3])) if numbers else default

    def _number(self, key: str, default: float, low: float, high: float) -> float:
        return next(iter(self._numbers(key, (1,), low, high)), default)

    def _numbers(self, key: str, counts: tuple[int, ...], low: float, high: float) -> list[float]:
        """Return the numbers of a key, clamped to a range, in one of the allowed counts.

        Return an empty list if the key is missing.
        """
        value = self._values.get(key, [])
        words = list(value) if isinstance(value, list | tuple) else [value]
        if words[:1] == ["-halo"]:
            self._source.note("-halo of d")
            words = words[1:]
        if words and (len(words) not in counts or not all(map(is_number, words))):
            self._source.note(f"the value {key} {' '.join(map(str, words))[:40]}, which is not {counts[-1]} numbers")
            return []
        if any(not low <= float(word) <= high for word in words):
            self._source.note(f"a value of {key} beyond {low:g} to {high:g}")
        return [min(max(float(word), low), high) for word in words]
