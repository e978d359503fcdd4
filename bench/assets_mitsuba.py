"""A mesh file as Mitsuba's path tracer shows it: its ``principled`` with the file's factors and textures.

Metallic-roughness is ``principled`` with ``specular`` 0.5 (F0 = 0.04); normal maps are ``normalmap``, cut into
triangles that carry their picture and those that carry its mirror image; alpha is ``mask``; what emits is an area
light. Not shown: occlusion textures (paths find it), vertex colours beside a texture, the second wrap mode where two
differ, the second set of texture coordinates.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from bench.mitsuba_scene import environment, rgb, sensor
from warp_ar.kernels.color import decode_table
from warp_ar.scene import Camera, Pose
from warp_ar.scene.geometry import Mesh
from warp_ar.scene.materials import MetallicRoughnessMaterial
from warp_ar.scene.mesh_materials import MeshMaterial, TextureUse
from warp_ar.scene.object_materials import is_closed

Array = npt.NDArray[Any]
Dict = dict[str, Any]

DEPTH = 16
"""Most bounces of a path."""


def render_mitsuba(mesh: Mesh, camera: Camera, pose: Pose, radiance: Array, samples: int) -> tuple[Array, Array]:
    """Linear radiance, premultiplied, (h, w, 3), and coverage, (h, w), of a mesh in the world.

    Args:
        mesh: Already where it stands.
        camera: Without distortion.
        pose: ``camera_from_world``.
        radiance: Latlong environment, (h, 2 h, 3).
        samples: Paths per pixel.
    """
    film = {**sensor(camera, pose)}
    film["film"] = {**film["film"], "pixel_format": "rgba"}
    base = {"type": "scene", "sensor": film}
    shapes = _shapes(mesh, emitting=True)
    silhouettes = _shapes(mesh, emitting=False)
    sky = {"sky": environment(np.ascontiguousarray(radiance, np.float32))}

    def shot(parts: Dict, light: Dict, integrator: Dict, count: int) -> Array:
        return np.array(
            mi.render(mi.load_dict({**base, **parts, **light, "integrator": integrator}), spp=count, seed=1)
        )

    path = {"type": "path", "max_depth": DEPTH}
    emits = any(shape.is_emitter() for shape in shapes.values())
    whole = shot(shapes, sky, {**path, "hide_emitters": not emits}, samples)
    if not emits:
        return np.maximum(whole[..., :3], 0.0), np.clip(whole[..., 3], 0.0, 1.0)
    # A light that is hidden is hidden whether it is sky or surface; so the sky is taken off afterwards.
    cover = np.clip(shot(silhouettes, sky, {**path, "max_depth": 2, "hide_emitters": True}, samples)[..., 3], 0.0, 1.0)
    behind = shot({}, sky, path, 16)[..., :3]
    return np.maximum(whole[..., :3] - (1.0 - cover[..., None]) * behind, 0.0), cover


def _shapes(mesh: Mesh, *, emitting: bool) -> Dict:
    """One shape per material, and per way round that its pictures lie."""
    materials = mesh.materials or (MeshMaterial(surface=MetallicRoughnessMaterial((1.0, 1.0, 1.0), 0.0, 1.0)),)
    numbers = np.zeros(len(mesh.faces), int) if mesh.triangle_materials is None else mesh.triangle_materials
    mirrored = np.zeros(len(mesh.faces), bool)
    if mesh.uvs is not None:
        corners = mesh.uvs[mesh.faces].astype(float)
        p, q = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        mirrored = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0] < 0.0
    closed = is_closed(mesh)
    found: Dict = {}
    for number, material in enumerate(materials):
        for flip in (False, True):
            mine = (numbers == number) & (mirrored == flip if material.normal is not None else not flip)
            if mine.any():
                shape = _shape(mesh, mine, material, flip=flip, closed=closed, emitting=emitting)
                found[f"shape_{number}_{int(flip)}"] = shape
    return found


def _shape(mesh: Mesh, mine: Array, material: MeshMaterial, *, flip: bool, closed: bool, emitting: bool) -> Any:
    faces = mesh.faces[mine]
    used, inverse = np.unique(faces, return_inverse=True)
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(_bsdf(mesh, material, flip=flip, double=material.double_sided or closed))
    glow = _emission(mesh, material) if emitting else None
    if glow is not None:
        props["emitter"] = mi.load_dict({"type": "area", "radiance": glow})
    colored = mesh.colors is not None and material.base is None
    made = mi.Mesh("part", len(used), len(faces), has_vertex_normals=True, has_vertex_texcoords=True, props=props)
    if colored:
        colors = mesh.colors[used, :3] * np.array(material.surface.base_color)  # type: ignore[index, union-attr]
        made.add_attribute("vertex_color", 3, colors.astype(np.float32).ravel())
    values = mi.traverse(made)
    values["vertex_positions"] = mesh.vertices[used].ravel()
    values["vertex_normals"] = mesh.normals[used].ravel()
    uvs = np.zeros((len(used), 2), np.float32) if mesh.uvs is None else mesh.uvs[used]
    values["vertex_texcoords"] = (uvs * [1.0, -1.0] + [0.0, 1.0]).astype(np.float32).ravel()
    values["faces"] = inverse.reshape(-1).astype(np.uint32)
    values.update()
    return made


def _bsdf(mesh: Mesh, material: MeshMaterial, *, flip: bool, double: bool) -> Dict:
    surface = material.surface
    if not isinstance(surface, MetallicRoughnessMaterial) or isinstance(surface.base_color, str):
        raise TypeError(f"{type(surface).__name__} is not what glTF files have")
    color = np.array(surface.base_color, float)
    base: Dict = rgb(color)
    if material.base is not None:
        base = _texture(mesh, material.base, lambda p: _linear(p) * color)
    elif mesh.colors is not None:
        base = {"type": "mesh_attribute", "name": "vertex_color"}
    rough: Any = surface.roughness
    metal: Any = surface.metallic
    if material.metallic_roughness is not None:
        use = material.metallic_roughness
        rough = _texture(mesh, use, lambda p: p[..., 1:2] / 255.0 * surface.roughness)
        metal = _texture(mesh, use, lambda p: p[..., 2:3] / 255.0 * surface.metallic)
    made: Dict = {"type": "principled", "base_color": base, "roughness": rough, "metallic": metal, "specular": 0.5}
    if material.unlit:
        made = {"type": "diffuse", "reflectance": 0.0}
    if material.normal is not None:
        scale = np.array([material.normal_scale, material.normal_scale * (-1.0 if flip else 1.0), 1.0])

        def tilted(picture: Array) -> Array:
            normal = (picture[..., :3] / 255.0 * 2.0 - 1.0) * scale
            normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
            return 0.5 + 0.5 * normal

        made = {"type": "normalmap", "normalmap": _texture(mesh, material.normal, tilted), "bsdf": made}
    if double:
        made = {"type": "twosided", "bsdf": made}
    if material.alpha == "opaque":
        return made
    opacity: Any = material.opacity
    if material.base is not None:
        opacity = _texture(mesh, material.base, lambda p: p[..., 3:4] / 255.0 * material.opacity)
        if material.alpha == "mask":
            opacity = _texture(
                mesh, material.base, lambda p: (p[..., 3:4] / 255.0 * material.opacity >= material.cutoff) * 1.0
            )
    return {"type": "mask", "opacity": opacity, "bsdf": made}


def _emission(mesh: Mesh, material: MeshMaterial) -> Dict | None:
    surface: Any = material.surface
    factor = np.array(surface.base_color if material.unlit else material.emission, float)
    use = material.base if material.unlit else material.emissive
    if not factor.any():
        return None
    return rgb(factor) if use is None else _texture(mesh, use, lambda p: _linear(p) * factor)


def _linear(picture: Array) -> Array:
    table = decode_table("srgb")
    return np.stack([table[picture[..., c], c] for c in range(3)], axis=-1)


def _texture(mesh: Mesh, use: TextureUse, change: Any) -> Dict:
    """A picture as it is looked up by texture coordinates whose v runs down."""
    a, b, c, d, e, f = use.transform
    # v' = 1 - v: rows and columns of the transform, which is of v up, are taken around it.
    matrix = np.array([[a, -b, b + c], [-d, e, 1.0 - e - f], [0.0, 0.0, 1.0]])
    values = np.ascontiguousarray(change(mesh.images[use.image]), np.float32)
    wrap = {"repeat": "repeat", "clamp": "clamp", "mirror": "mirror"}[use.wrap[0]]
    made: Dict = {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True, "wrap_mode": wrap}
    if use.nearest:
        made["filter_type"] = "nearest"
    if not np.array_equal(matrix, np.eye(3)):
        full = np.eye(4)
        full[:2, :2], full[:2, 3] = matrix[:2, :2], matrix[:2, 2]
        made["to_uv"] = mi.ScalarTransform4f(full)
    return made
