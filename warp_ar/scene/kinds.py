"""Kinds of shapes, materials and lights of a scene, which decide the kernels and arrays to make.

Numbers, such as positions and colours, decide neither.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from warp_ar import scene as scenes
from warp_ar.kernels import structs
from warp_ar.kernels.rays.trace import TraceConfig
from warp_ar.scene.area_lights import emits
from warp_ar.scene.geometry import rotation_matrix
from warp_ar.scene.materials import MeshMaterial
from warp_ar.scene.object_materials import materials_of, reflects_diffusely, reflects_glossily
from warp_ar.scene.ray_mesh import mesh_key

_SHAPES: Final = {"plane": structs.PLANE, "box": structs.BOX, "mesh": structs.MESH, "sphere": structs.SPHERE}
_LIGHTS: Final = {"point": structs.POINT, "spot": structs.SPOT, "directional": structs.DIRECTIONAL}
_MODELS: Final[dict[type, int]] = {
    scenes.LambertMaterial: structs.LAMBERT,
    scenes.PhongMaterial: structs.PHONG,
    scenes.MetallicRoughnessMaterial: structs.METALLIC_ROUGHNESS,
    scenes.MirrorMaterial: structs.MIRROR,
}
# Planes whose normals have a larger cosine (an angle below 2.6 degrees) exchange less than a hundredth of their light.
_ONE_WAY: Final = 0.999


def shape_kind(item: scenes.Object | scenes.Proxy) -> int:
    """Return the kind of ``structs.Shape`` of an object or proxy.

    Shapes without analytic intersection become meshes.
    """
    if isinstance(item, scenes.Object) and mesh_key(item) is not None:
        return int(structs.MESH)
    return int(_SHAPES[item.shape])


def light_kind(light: scenes.Light) -> int:
    """Return the kind of ``structs.Light`` of a light."""
    return int(_LIGHTS[light.kind])


def trace_config(scene: scenes.Scene) -> TraceConfig:
    """Return the kinds of shapes that rays can meet in ``scene``, and if hits need per-triangle data."""
    made_of = [materials_of(item) for item in scene.objects]
    return TraceConfig(
        objects=tuple(sorted({shape_kind(item) for item in scene.objects})),
        proxies=tuple(sorted({shape_kind(item) for item in scene.proxies})),
        detail=any(one.holed or one.bumpy for one in made_of),
        stretched=any(item.play is not None for item in scene.objects),
    )


def material_model(material: MeshMaterial) -> int:
    """Return the model of ``structs.Material`` of a material."""
    return _MODELS[type(material.surface)]


def skeleton(scene: scenes.Scene) -> tuple[tuple[str, Any], ...]:
    """Return all properties that decide kernels and array sizes, by name.

    Scenes with equal skeletons differ in numbers only.
    """
    whole = ("camera", "marker", "has_marker", "pose", "captured", "probes", "proxies")
    parts = [(name, getattr(scene, name)) for name in whole]
    parts += [("the number of objects", len(scene.objects)), ("the number of lights", len(scene.lights))]
    for index, item in enumerate(scene.objects):
        label, made_of = f"objects[{index}]", materials_of(item).materials
        pictures = tuple(value for value in vars(item.material).values() if isinstance(value, Path))
        lobes = any(map(reflects_diffusely, made_of)), any(map(reflects_glossily, made_of))
        parts += [
            (f"{label}.shape", item.shape),
            (f"{label}.marker", item.marker),
            (f"the mesh of {label}", mesh_key(item)),
            (f"{label}.play", item.play and item.play.animation),
            (f"{label}.material", (type(item.material), pictures, lobes, tuple(map(emits, made_of)))),
        ]
    for index, light in enumerate(scene.lights):
        parts += [(f"lights[{index}].kind", light.kind), (f"lights[{index}].marker", light.marker)]
    return tuple(parts)


def difference(before: scenes.Scene, after: scenes.Scene) -> str:
    """Return the name of the first property in which the skeletons of two scenes differ; empty if they are equal."""
    pairs = zip(skeleton(before), skeleton(after), strict=False)  # if lengths differ, so does an earlier part
    return next((name for (name, old), (_, new) in pairs if old != new), "")


def proxies_face(scene: scenes.Scene) -> bool:
    """Return True if light from one proxy can reach a proxy.

    A single plane or box, and planes with one normal, exchange none.
    """
    if any(proxy.shape == "mesh" for proxy in scene.proxies):
        return True  # a mesh may face itself
    normals = [rotation_matrix(proxy.rotate)[:, 2] for proxy in scene.proxies if proxy.shape == "plane"]
    turned = any(float(a @ b) < _ONE_WAY for a in normals for b in normals)
    return len(scene.proxies) > 1 and (len(normals) < len(scene.proxies) or turned)
