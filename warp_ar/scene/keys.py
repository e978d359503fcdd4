"""Keys of a scene file's sections that depend on a kind or shape; the others are the fields of the dataclasses."""

from __future__ import annotations

import dataclasses
from typing import Any, Final

from warp_ar.scene.materials import (
    EmissiveMaterial,
    FileMaterial,
    LambertMaterial,
    Material,
    MetallicRoughnessMaterial,
    MirrorMaterial,
    PhongMaterial,
)

IN_MEMORY: Final = (("object", "mesh"),)
"""Section and field of what only a scene in memory can have."""
INTRINSICS: Final = ("width", "height", "fx", "fy", "cx", "cy", "distortion")
PROXY_KEYS: Final = {"plane": ("size",), "box": ("size",), "mesh": ("file",)}
OBJECT_KEYS: Final = {
    "mesh": ("file",),
    "sphere": ("radius",),
    "box": ("size",),
    "torus": ("major_radius", "minor_radius"),
    "rect": ("size",),
    "disk": ("radius",),
    "tube": ("radius", "length"),
}
LIGHT_KEYS: Final = {
    "point": ("at", "attenuation", "radius"),
    "spot": ("at", "target", "direction", "inner_angle", "outer_angle", "attenuation", "radius"),
    "directional": ("direction",),
}
AREA_LIGHT_KEYS: Final = {
    "rect": ("at", "rotate", "size", "image", "two_sided"),
    "disk": ("at", "rotate", "radius", "two_sided"),
    "sphere": ("at", "rotate", "radius"),
    "tube": ("at", "rotate", "radius", "length"),
}
MATERIALS: Final[dict[str, type[Material]]] = {
    "phong": PhongMaterial,
    "metallic_roughness": MetallicRoughnessMaterial,
    "lambert": LambertMaterial,
    "mirror": MirrorMaterial,
    "emissive": EmissiveMaterial,
    "file": FileMaterial,
}


def keys_of(*classes: type[Any]) -> list[str]:
    """Names of the fields of dataclasses, each once."""
    return list(dict.fromkeys(field.name for kind in classes for field in dataclasses.fields(kind)))
