"""Which kinds of shape, material and light a scene has: what arrays and kernels are made for, but no numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from warp_ar import scene as scenes
from warp_ar.kernels import structs
from warp_ar.kernels.rays.trace import TraceConfig
from warp_ar.scene.area_lights import emits
from warp_ar.scene.geometry import rotation_matrix
from warp_ar.scene.mesh_materials import MeshMaterial
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
# Planes whose normals have a larger cosine, 2.6 degrees, send each other less than a hundredth of their light.
_ONE_WAY: Final = 0.999


def shape_kind(item: scenes.Object | scenes.Proxy) -> int:
    """Kind of ``structs.Shape`` that an object or proxy becomes; what has no kind of its own becomes a fine mesh."""
    if isinstance(item, scenes.Object) and mesh_key(item) is not None:
        return int(structs.MESH)
    return int(_SHAPES[item.shape])


def light_kind(light: scenes.Light) -> int:
    """Kind of ``structs.Light`` that a light becomes."""
    return int(_LIGHTS[light.kind])


def has_sized_lights(scene: scenes.Scene) -> bool:
    """Whether any virtual light has a radius, and so a soft shadow."""
    return any(light.radius > 0.0 for light in scene.lights)


def trace_config(scene: scenes.Scene) -> TraceConfig:
    """Which kinds of shape the rays of ``scene`` can meet, and whether triangles must be asked for more."""
    made_of = [materials_of(item) for item in scene.objects]
    return TraceConfig(
        objects=tuple(sorted({shape_kind(item) for item in scene.objects})),
        proxies=tuple(sorted({shape_kind(item) for item in scene.proxies})),
        detail=any(one.holed or one.bumpy for one in made_of),
        stretched=any(item.play is not None for item in scene.objects),
    )


def material_model(material: MeshMaterial) -> int:
    """Model of ``structs.Material`` that a material becomes."""
    return _MODELS[type(material.surface)]


def skeleton(scene: scenes.Scene) -> Any:
    """What of a scene arrays and kernels are made for; scenes that share it differ in numbers alone."""
    objects = tuple(
        (
            item.shape,
            item.marker,
            mesh_key(item),
            item.play and item.play.animation,
            type(item.material),
            tuple(value for value in vars(item.material).values() if isinstance(value, Path)),
            any(map(reflects_diffusely, materials_of(item).materials)),
            any(map(reflects_glossily, materials_of(item).materials)),
            tuple(map(emits, materials_of(item).materials)),
        )
        for item in scene.objects
    )
    lights = tuple((light.kind, light.marker) for light in scene.lights)
    place = scene.camera, scene.marker, scene.has_marker, scene.pose, scene.captured
    return *place, scene.probes, scene.proxies, objects, lights


def proxies_face(scene: scenes.Scene) -> bool:
    """Whether light that proxies send can reach one: not if there is one plane or box, or planes that look one way."""
    if any(proxy.shape == "mesh" for proxy in scene.proxies):
        return True  # which may face itself
    normals = [rotation_matrix(proxy.rotate)[:, 2] for proxy in scene.proxies if proxy.shape == "plane"]
    turned = any(float(a @ b) < _ONE_WAY for a in normals for b in normals)
    return len(scene.proxies) > 1 and (len(normals) < len(scene.proxies) or turned)
