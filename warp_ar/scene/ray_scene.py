"""A scene as rays meet it: meshes, materials, textures and lights on a device, and what of the screen they can touch.

Positions are metres in the world, angles of the device's records radians, colours linear RGB.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ar import scene as scenes
from warp_ar.errors import SceneError
from warp_ar.kernels import structs
from warp_ar.kernels.visibility import TraceConfig
from warp_ar.kernels.wide_bvh import build_wide_bvh
from warp_ar.scene import Pose
from warp_ar.scene.geometry import Mesh, load_texture, rotation_matrix, silhouette_tolerance, torus_mesh
from warp_ar.scene.mesh_cache import load_kept_mesh

FloatArray = npt.NDArray[np.float64]

Rect = tuple[int, int, int, int]
"""Part of the screen: row_start, row_stop, column_start, column_stop; all zero where nothing of it is needed."""

EMPTY: Final[Rect] = (0, 0, 0, 0)

BOX_MARGIN: Final = 2.0**-18
"""How much larger than its triangle a box of the BVH is, in radii of the mesh; see ``kernels/visibility.py``."""

BVH_CONSTRUCTOR: Final = "sah"
"""On CUDA; Warp's own choice there is quicker to build, and a fifth to a half slower to walk."""
BVH_LEAF_SIZE: Final = 1
"""Triangles per leaf there: a ray that tests triangles holds up those beside it that still walk."""

_SHAPES: Final = {"plane": structs.PLANE, "box": structs.BOX, "mesh": structs.MESH, "sphere": structs.SPHERE}
_LIGHTS: Final = {"point": structs.POINT, "spot": structs.SPOT, "directional": structs.DIRECTIONAL}
_MODELS: Final[dict[type, int]] = {
    scenes.LambertMaterial: structs.LAMBERT,
    scenes.PhongMaterial: structs.PHONG,
    scenes.MetallicRoughnessMaterial: structs.METALLIC_ROUGHNESS,
    scenes.MirrorMaterial: structs.MIRROR,
}

SHADOW_REACH: Final = 12.0
"""How far an object's shadow of the environment is followed, in radii of the sphere around it.

A sphere that rests on a desk hides (r / d)^3 of an even sky's light from a point at distance d: under 1/512 from 8
radii on. A lamp's shadow ends within 12 radii if the lamp stands 10 degrees high or more.
"""

# Sides of the pyramid around a spot's cone: 8 sides reach 8 % farther out than the cone at their edges.
_CONE_SIDES: Final = 8
# From this half angle on a pyramid would be nearly flat; the cone is then taken to reach everything.
_WIDE_CONE: Final = math.radians(75.0)
# Planes whose normals have a larger cosine, 2.6 degrees, send each other less than a hundredth of their light.
_ONE_WAY: Final = 0.999
# Faces of a box as (2, 2, 2) corner indices; the first is that of a plane, whose box has no height.
_FACES: Final = (
    (0, 2, 6, 4),
    (1, 3, 7, 5),
    (0, 1, 5, 4),
    (2, 3, 7, 6),
    (0, 1, 3, 2),
    (4, 5, 7, 6),
)
_CORNERS: Final = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])


def shape_kind(item: scenes.Object | scenes.Proxy) -> int:
    """Kind of ``structs.Shape`` that an object or proxy becomes; a torus becomes a fine mesh."""
    return int(structs.MESH if item.shape == "torus" else _SHAPES[item.shape])


def light_kind(light: scenes.Light) -> int:
    """Kind of ``structs.Light`` that a light becomes."""
    return int(_LIGHTS[light.kind])


def has_sized_lights(scene: scenes.Scene) -> bool:
    """Whether any virtual light has a radius, and so a soft shadow."""
    return any(light.radius > 0.0 for light in scene.lights)


def trace_config(scene: scenes.Scene) -> TraceConfig:
    """Which kinds of shape the rays of ``scene`` can meet."""
    return TraceConfig(
        objects=tuple(sorted({shape_kind(item) for item in scene.objects})),
        proxies=tuple(sorted({shape_kind(item) for item in scene.proxies})),
    )


def _is_black(color: scenes.Color) -> bool:
    return not isinstance(color, Path) and not any(color)


def reflects_diffusely(material: scenes.Material) -> bool:
    """Whether a material shows the environment's irradiance."""
    match material:
        case scenes.LambertMaterial():
            return not _is_black(material.base_color)
        case scenes.PhongMaterial():
            return not _is_black(material.diffuse)
        case scenes.MetallicRoughnessMaterial():
            return material.metallic < 1.0 and not _is_black(material.base_color)
    return False


def reflects_glossily(material: scenes.Material) -> bool:
    """Whether a material shows the environment's prefiltered light."""
    match material:
        case scenes.PhongMaterial():
            return not _is_black(material.specular)
        case scenes.MirrorMaterial():
            return not _is_black(material.base_color)
        case scenes.MetallicRoughnessMaterial():
            return True
    return False


def material_model(material: scenes.Material) -> int:
    """Model of ``structs.Material`` that a material becomes."""
    return _MODELS[type(material)]


def has_textures(scene: scenes.Scene) -> bool:
    """Whether any virtual object may have a texture: meshes bring their own, which only reading them tells."""
    return any(
        item.shape == "mesh" or any(isinstance(value, Path) for value in vars(item.material).values())
        for item in scene.objects
    )


def skeleton(scene: scenes.Scene) -> Any:
    """What of a scene arrays and kernels are made for; scenes that share it differ in numbers alone."""
    objects = tuple(
        (
            item.shape,
            _mesh_key(item),
            type(item.material),
            tuple(value for value in vars(item.material).values() if isinstance(value, Path)),
            reflects_diffusely(item.material),
            reflects_glossily(item.material),
        )
        for item in scene.objects
    )
    lights = tuple(light.kind for light in scene.lights)
    return scene.camera, scene.marker, scene.probes, scene.proxies, objects, lights


@dataclasses.dataclass(frozen=True, eq=False)
class RayMesh:
    """A mesh that rays can meet, moved so that the centre of its bounding box is its origin."""

    mesh: Any
    """``wp.Mesh`` whose corners are not shared: corner k of face f is point 3 f + k."""
    center: FloatArray
    """Where its origin lies in the coordinates of the source, (3,)."""
    half: FloatArray
    """Half sizes of its bounding box, (3,)."""
    normals: npt.NDArray[np.float32]
    """Unit normal of each corner, (3 m, 3)."""
    uvs: npt.NDArray[np.float32]
    """Texture coordinates of each corner, (3 m, 2)."""
    tree: Any
    """On CPU what rays walk, of ``kernels.wide_bvh``; None: they walk the ``wp.Mesh``'s own."""

    @property
    def tree_address(self) -> int:
        """What ``structs.Shape.tree`` is to be."""
        return 0 if self.tree is None else int(self.tree.ptr)


def make_ray_mesh(mesh: Mesh, device: Any) -> RayMesh:
    """Build the BVH of a mesh with a margin around every triangle, so that no ray slips through a shared edge.

    The BVH is built over triangles that span the enlarged boxes; then the true corners take their place. Nothing is
    refitted afterwards, so the boxes keep their margin, and the triangles that rays are tested against are exact.
    Meshes stand still in their own space: the tree is built once, so it is the one that is walked fastest. On CPU that
    is one of ``kernels.wide_bvh``, and Warp's own, which only holds the triangles, the one that is built fastest.

    Args:
        mesh: The triangles.
        device: Warp device.
    """
    low, high = (bound.astype(np.float64) for bound in mesh.bounds)
    center = 0.5 * (low + high)
    # Vertices at one position stay at one position to the last bit: every corner is computed the same way.
    corners = (mesh.vertices.astype(np.float64) - center).astype(np.float32)[mesh.faces]
    half = np.abs(corners).reshape(-1, 3).max(axis=0).astype(np.float64)
    margin = np.float32(BOX_MARGIN * np.linalg.norm(half))
    boxes = np.stack([corners.min(axis=1) - margin, corners.max(axis=1) + margin, corners[:, 0]], axis=1)
    points = wp.array(boxes.reshape(-1, 3), dtype=wp.vec3, device=device)
    indices = wp.array(np.arange(corners.shape[0] * 3, dtype=np.int32), dtype=wp.int32, device=device)
    on_cpu = points.device.is_cpu
    constructor = "median" if on_cpu else BVH_CONSTRUCTOR
    ray_mesh = wp.Mesh(points=points, indices=indices, bvh_constructor=constructor, bvh_leaf_size=BVH_LEAF_SIZE)
    wp.copy(points, wp.array(corners.reshape(-1, 3), dtype=wp.vec3, device=device))
    tree = build_wide_bvh(corners, float(margin)) if on_cpu else None
    uvs = np.zeros((len(mesh.vertices), 2), np.float32) if mesh.uvs is None else mesh.uvs
    normals = mesh.normals[mesh.faces].reshape(-1, 3)
    return RayMesh(ray_mesh, center, half, normals, uvs[mesh.faces].reshape(-1, 2), tree)


def linear_texture(texture: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """Linear RGB of an sRGB-encoded picture (IEC 61966-2-1), (h, w, 3)."""
    code = np.arange(256) / 255.0
    table = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4).astype(np.float32)
    return table[texture]


class _Textures:
    """Textures packed one after another; equal files are packed once."""

    def __init__(self) -> None:
        self.records: list[tuple[int, int, int]] = []
        self.texels: list[npt.NDArray[np.float32]] = []
        self._known: dict[tuple[Path | None, int], int] = {}
        self._size = 0

    def add(self, color: scenes.Color, mesh: Mesh | None) -> tuple[tuple[float, float, float], int]:
        """Constant factor and texture index of a colour, multiplied by the mesh's own texture if there is one."""
        path = color if isinstance(color, Path) else None
        factor = (1.0, 1.0, 1.0) if isinstance(color, Path) else color
        own = None if mesh is None else mesh.texture
        if path is None and own is None:
            return factor, -1
        key = (path, id(own) if own is not None else 0)
        if key not in self._known:
            pictures = [linear_texture(p) for p in (None if path is None else load_texture(path), own) if p is not None]
            height, width = (max(p.shape[axis] for p in pictures) for axis in (0, 1))
            fitted = [cv2.resize(p, (width, height), interpolation=cv2.INTER_LINEAR) for p in pictures]
            self._known[key] = len(self.records)
            self.records.append((self._size, width, height))
            self.texels.append(functools.reduce(np.multiply, fitted).reshape(-1, 3))
            self._size += width * height
        return factor, self._known[key]


class HostScene:
    """The host's side of a scene: owns what the device's ``RayScene`` points to, and moves what is animated."""

    def __init__(self, scene: scenes.Scene, device: Any) -> None:
        """Load the scene's meshes and textures and put them on ``device``.

        Raises:
            SceneError: A mesh or texture cannot be read, or a texture is asked of a mesh without texture coordinates.
        """
        self.scene = scene
        self._meshes: dict[Any, tuple[Mesh, RayMesh, int]] = {}
        self._corners = 0
        textures = _Textures()
        self._objects = self._shape_records(scene.objects, device)
        self._proxies = self._shape_records(scene.proxies, device)
        self._textures = textures
        materials = self._material_records()
        self._place_objects()
        self._lights = np.zeros(len(scene.lights), _dtype(structs.Light))
        self._lit: Outline | None = None
        self._bounced: Outline | None = None
        self._placed = b""  # the objects that the polygons below are of
        self._outline = Outline(())
        self._shaded: Outline | None = None
        self._balls = _ball_outline(scene)
        self._lights_edited = False
        self.write_objects(np.zeros_like(self._objects), 0.0)
        self.write_lights(np.zeros_like(self._lights), 0.0)

        records = np.zeros(len(textures.records), _dtype(structs.Texture))
        for record, (offset, width, height) in zip(records, textures.records, strict=True):
            record["offset"], record["width"], record["height"] = offset, width, height
        ray_scene = structs.RayScene()
        ray_scene.objects = wp.array(self._objects, dtype=structs.Shape, device=device)
        ray_scene.proxies = wp.array(self._proxies, dtype=structs.Shape, device=device)
        ray_scene.materials = wp.array(materials, dtype=structs.Material, device=device)
        ray_scene.textures = wp.array(records, dtype=structs.Texture, device=device)
        meshes = [mesh for _, mesh, _ in self._meshes.values()]
        ray_scene.texels = _vectors(textures.texels, 3, wp.vec3, device)
        ray_scene.vertex_normals = _vectors([mesh.normals for mesh in meshes], 3, wp.vec3, device)
        ray_scene.vertex_uvs = _vectors([mesh.uvs for mesh in meshes], 2, wp.vec2, device)
        self.ray_scene = ray_scene

    def update(self, scene: scenes.Scene) -> None:
        """Take the numbers of another scene with the same ``skeleton``: poses, sizes, materials, lights."""
        self.scene = scene
        self._objects = self._shape_records(scene.objects, self.ray_scene.materials.device)
        self._place_objects()
        self.ray_scene.materials.assign(self._material_records())
        self._lit = None
        self._balls = _ball_outline(scene)
        self._lights_edited = True

    def _place_objects(self) -> None:
        self._objects["material"] = np.arange(len(self.scene.objects))
        # Centres in local coordinates: a mesh is stored about the middle of its bounding box, wherever its origin was.
        self._centers = [
            record["scale"] * self._meshes[key][1].center if key is not None else np.zeros(3)
            for record, key in zip(self._objects, map(_mesh_key, self.scene.objects), strict=True)
        ]

    def _material_records(self) -> npt.NDArray[Any]:
        records = np.zeros(len(self.scene.objects), _dtype(structs.Material))
        for record, item in zip(records, self.scene.objects, strict=True):
            self._fill_material(record, item, self._textures)
        return records

    def _shape_records(self, items: Sequence[scenes.Object | scenes.Proxy], device: Any) -> npt.NDArray[Any]:
        """Records of ``structs.Shape`` with all that does not move."""
        records = np.zeros(len(items), _dtype(structs.Shape))
        for record, item in zip(records, items, strict=True):
            scale = getattr(item, "scale", 1.0)
            rotation = rotation_matrix(item.rotate)
            position = np.array(item.at)
            record["kind"], record["scale"], record["material"] = shape_kind(item), scale, -1
            key = _mesh_key(item)
            if key is not None:
                _, mesh, record["first_vertex"] = self._load(key, device)
                record["mesh"], record["tree"] = mesh.mesh.id, mesh.tree_address
                record["extent"], record["smooth"] = mesh.half, 1
                position = position + rotation @ (scale * mesh.center)
            elif isinstance(item, scenes.Object) and item.shape == "sphere":
                record["extent"] = item.radius
            else:
                record["extent"][: len(item.size)] = 0.5 * np.array(item.size)
            record["rotation"], record["position"] = rotation, position
        return records

    def _load(self, key: Any, device: Any) -> tuple[Mesh, RayMesh, int]:
        """Mesh of a file or torus and where its corners start, made once."""
        if key not in self._meshes:
            mesh = load_kept_mesh(key) if isinstance(key, Path) else torus_mesh(*key)
            ray_mesh = make_ray_mesh(mesh, device)
            self._meshes[key] = (mesh, ray_mesh, self._corners)
            self._corners += len(ray_mesh.normals)
        return self._meshes[key]

    def _fill_material(self, record: Any, item: scenes.Object, textures: _Textures) -> None:
        """Write the material of an object into a record of ``structs.Material``."""
        key = _mesh_key(item)
        mesh = None if key is None else self._meshes[key][0]
        material = item.material
        first = material.diffuse if isinstance(material, scenes.PhongMaterial) else material.base_color
        colors = (first, material.specular) if isinstance(material, scenes.PhongMaterial) else (first,)
        if mesh is not None and mesh.uvs is None:
            for color in colors:
                if isinstance(color, Path):
                    raise SceneError(
                        f"{item.file}: the mesh has no texture coordinates for the texture {color}; "
                        "unwrap it, or give the material a plain colour"
                    )
        record["base_color"], record["base_texture"] = textures.add(first, mesh)
        record["specular_texture"] = -1
        record["model"] = material_model(material)
        if isinstance(material, scenes.PhongMaterial):
            record["shininess"] = material.shininess
            record["specular"], record["specular_texture"] = textures.add(material.specular, None)
        elif isinstance(material, scenes.MetallicRoughnessMaterial):
            record["metallic"], record["roughness"] = material.metallic, material.roughness

    def write_objects(self, records_out: npt.NDArray[Any], seconds: float) -> bool:
        """Write the virtual objects as they stand ``seconds`` after the first frame.

        Args:
            records_out: Records of ``structs.Shape``, one per object.
            seconds: Time since the first frame.

        Returns:
            Whether anything is not where ``records_out`` had it.
        """
        for record, item, center in zip(self._objects, self.scene.objects, self._centers, strict=True):
            if item.animate is not None or seconds == 0.0:
                rotation, position = item.pose_at(seconds)
                record["rotation"], record["position"] = rotation, position + rotation @ center
        return _update(records_out, self._objects)

    def write_lights(self, records_out: npt.NDArray[Any], seconds: float) -> bool:
        """Write the virtual lights as they stand ``seconds`` after the first frame; arguments as ``write_objects``."""
        for record, light in zip(self._lights, self.scene.lights, strict=True):
            if light.animate is None and seconds != 0.0 and not self._lights_edited:
                continue
            self._lit = None
            record["position"], record["direction"] = light.pose_at(seconds)
            record["kind"] = light_kind(light)
            record["intensity"] = light.intensity * np.array(light.color)
            record["inner_angle"], record["outer_angle"] = map(math.radians, (light.inner_angle, light.outer_angle))
            record["attenuation"], record["radius"] = light.attenuation, light.radius
        self._lights_edited = False
        return _update(records_out, self._lights)

    def object_outline(self) -> Outline:
        """Where virtual objects are."""
        self._follow_objects()
        return self._outline

    def _follow_objects(self) -> None:
        """Forget what was found out about moved objects; clipping polygons takes longer than a kernel."""
        placed = self._objects.tobytes()
        if placed != self._placed:
            self._placed = placed
            self._outline = Outline([face for record in self._objects for face in _faces(record)])
            self._shaded = None

    def light_outline(self, *, bounced: bool = False) -> Outline:
        """Where virtual light or its shadows can fall on proxies; if ``bounced``, what lit proxies send on as well."""
        if self._lit is None:
            faces = [_faces(record) for record in self._proxies]
            self._lit = Outline([part for light in self._lights for own in faces for part in _lit_faces(light, own)])
            self._bounced = None
        if not bounced:
            return self._lit
        if self._bounced is None:
            self._bounced = Outline([*self._lit.polygons, *_bounced_faces(self._lights, self._proxies)])
        return self._bounced

    def ball_outline(self) -> Outline:
        """Where mirror balls are."""
        return self._balls

    def shadow_outline(self) -> Outline:
        """Where virtual objects can change the environment on proxies."""
        self._follow_objects()
        if self._shaded is None:
            proxies = [_faces(record) for record in self._proxies]
            self._shaded = Outline(
                [part for record in self._objects for faces in proxies for part in _shaded_faces(record, faces)]
            )
        return self._shaded


def proxies_face(scene: scenes.Scene) -> bool:
    """Whether light that proxies send can reach one: not if there is one plane or box, or planes that look one way."""
    if any(proxy.shape == "mesh" for proxy in scene.proxies):
        return True  # which may face itself
    normals = [rotation_matrix(proxy.rotate)[:, 2] for proxy in scene.proxies if proxy.shape == "plane"]
    turned = any(float(a @ b) < _ONE_WAY for a in normals for b in normals)
    return len(scene.proxies) > 1 and (len(normals) < len(scene.proxies) or turned)


def _dtype(struct: Any) -> Any:
    return np.dtype(struct.numpy_dtype())


def _mesh_key(item: scenes.Object | scenes.Proxy) -> Any:
    """What a mesh is made from: a file, or the radii and tolerance of a torus; None for what rays meet analytically."""
    if item.shape == "mesh":
        return item.file
    if isinstance(item, scenes.Object) and item.shape == "torus":
        outer = item.scale * (item.major_radius + item.minor_radius)
        return item.major_radius, item.minor_radius, silhouette_tolerance(outer) / item.scale
    return None


def _vectors(parts: Iterable[npt.NDArray[np.float32]], length: int, dtype: Any, device: Any) -> Any:
    return wp.array(np.concatenate([np.zeros((0, length), np.float32), *parts]), dtype=dtype, device=device)


def _update(records_out: npt.NDArray[Any], records: npt.NDArray[Any]) -> bool:
    if records_out.tobytes() == records.tobytes():
        return False
    records_out[...] = records
    return True


def _faces(record: Any) -> list[FloatArray]:
    """Faces of the box around a shape in the world, (4, 3) each."""
    half = np.array(record["extent"], np.float64)
    # Float32 records are rounded; a part in a million more keeps the box around what the device sees.
    corners = _CORNERS * (half * (1.0 + 1e-6)) * float(record["scale"])
    corners = corners @ np.array(record["rotation"], np.float64).T + np.array(record["position"], np.float64)
    if record["kind"] == structs.PLANE:
        return [corners[[0, 2, 6, 4]]]
    return [corners[list(face)] for face in _FACES]


def _ball_outline(scene: scenes.Scene) -> Outline:
    """Boxes around the mirror balls."""
    boxes = [np.array(probe.center) + probe.radius * _CORNERS for probe in scene.probes]
    return Outline([box[list(face)] for box in boxes for face in _FACES])


def _clip(polygon: FloatArray, normal: FloatArray, offset: float) -> FloatArray:
    """The part of a convex polygon (n, 3) where normal . p >= offset (Sutherland, Hodgman); empty if there is none."""
    height = polygon @ normal - offset
    if (height >= 0.0).all():
        return polygon
    points: list[FloatArray] = []
    for index in range(len(polygon)):
        a, b = height[index - 1], height[index]
        if (a < 0.0) != (b < 0.0):
            points.append(polygon[index - 1] + (polygon[index] - polygon[index - 1]) * (a / (a - b)))
        if b >= 0.0:
            points.append(polygon[index])
    return np.array(points).reshape(-1, 3)


def _lit_faces(light: Any, faces: list[FloatArray]) -> list[FloatArray]:
    """Parts of a box's faces that a light may reach.

    A spot's cone is taken as the pyramid around it. For a mesh, whose surface lies inside its box, the parts of the
    faces inside the pyramid and, if the light is in the box, the light itself span all that can be lit.
    """
    if light["kind"] != structs.SPOT or light["outer_angle"] >= _WIDE_CONE:
        return faces
    apex = np.array(light["position"], np.float64)
    axis = np.array(light["direction"], np.float64)
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    across = np.cross(axis, side)
    # A plane that touches the cone along a line contains its apex; its normal leans by the half angle toward the axis.
    outer = float(light["outer_angle"]) + 1e-6
    parts = []
    for face in faces:
        part = face
        for turn in np.arange(_CONE_SIDES) * (2.0 * math.pi / _CONE_SIDES):
            outward = math.cos(turn) * side + math.sin(turn) * across
            normal = math.sin(outer) * axis - math.cos(outer) * outward
            part = _clip(part, normal, float(normal @ apex) - 1e-9)
            if len(part) == 0:
                break
        if len(part):
            parts.append(part)
    if len(faces) > 1:
        center = np.mean([face.mean(axis=0) for face in faces], axis=0)
        if all((apex - face.mean(axis=0)) @ (center - face.mean(axis=0)) >= 0.0 for face in faces):
            parts.append(apex[None, :])
    return parts


def _outward(face: FloatArray, center: FloatArray, kind: int, rotation: FloatArray) -> FloatArray:
    """Unit normal of a face of a shape: a plane's own, a box's away from its middle."""
    if kind == structs.PLANE:
        return rotation[:, 2]
    away = face.mean(axis=0) - center
    normal = np.cross(face[1] - face[0], face[2] - face[1])
    length = float(np.linalg.norm(normal))
    return normal * (math.copysign(1.0, float(normal @ away)) / length) if length > 0.0 else np.zeros(3)


def _bounced_faces(lights: npt.NDArray[Any], proxies: npt.NDArray[Any]) -> list[FloatArray]:
    """Parts of the proxies' faces before which some lit face stands, and behind which it does not.

    The surface of a mesh lies in its box and looks every way: it sends from all of its box to all sides.
    """
    sources: list[tuple[FloatArray, FloatArray | None]] = []  # lit parts, and the normal if there is one
    for record in proxies:
        faces, rotation = _faces(record), np.array(record["rotation"], np.float64)
        center = np.mean([face.mean(axis=0) for face in faces], axis=0)
        for light in lights:
            if record["kind"] == structs.MESH:
                if _lit_faces(light, faces):
                    sources += [(face, None) for face in faces]
                continue
            for face in faces:
                facing = _outward(face, center, int(record["kind"]), rotation)
                at, direction = (np.array(light[name], np.float64) for name in ("position", "direction"))
                directional = light["kind"] == structs.DIRECTIONAL
                if (float(-direction @ facing) if directional else float((at - face[0]) @ facing)) > 0.0:
                    sources += [(part, facing) for part in _lit_faces(light, [face])]
    reached: list[FloatArray] = []
    for record in proxies:
        faces, rotation = _faces(record), np.array(record["rotation"], np.float64)
        center = np.mean([face.mean(axis=0) for face in faces], axis=0)
        for face in faces:
            inward = -_outward(face, center, int(record["kind"]), rotation)
            for part, normal in sources:
                if record["kind"] != structs.MESH and (part @ inward >= float(face[0] @ inward) - 1e-9).all():
                    continue
                seen = face if normal is None else _clip(face, normal, float(normal @ part[0]) - 1e-9)
                if len(seen):
                    reached.append(seen)
    return reached


def _shaded_faces(record: Any, faces: list[FloatArray]) -> list[FloatArray]:
    """Parts of a box's faces inside the cube of ``SHADOW_REACH`` around an object, and of the cube's inside the box."""
    radius = float(record["scale"]) * float(np.linalg.norm(record["extent"]))
    center = np.array(record["position"], np.float64)
    cube = [center + SHADOW_REACH * radius * _CORNERS[list(face)] for face in _FACES]
    near = [_clip_to_cube(face, center, SHADOW_REACH * radius) for face in faces]
    if len(faces) > 1:  # a mesh lies inside its box, where the cube may end
        middle = np.mean([face.mean(axis=0) for face in faces], axis=0)
        for part in cube:
            for face in faces:
                inward = middle - face.mean(axis=0)
                if len(part):
                    part = _clip(part, inward, float(inward @ face[0]))
            near.append(part)
    return [part for part in near if len(part)]


def _clip_to_cube(polygon: FloatArray, center: FloatArray, reach: float) -> FloatArray:
    """The part of a convex polygon within ``reach`` of a point along every axis."""
    for axis in np.eye(3):
        for normal in (axis, -axis):
            if len(polygon):
                polygon = _clip(polygon, normal, float(normal @ center) - reach)
    return polygon


@functools.lru_cache(maxsize=8)
def _ray_bounds(camera: scenes.Camera) -> tuple[npt.NDArray[Any], ...]:
    """Smallest and largest x / z of each column's rays and y / z of each row's, a pixel's own width included.

    In ascending order: where a lens bends rows or columns back, a bound is that of all columns to one side.
    """
    if not any(camera.distortion):
        x = (np.arange(camera.width) - camera.cx) / camera.fx
        y = (np.arange(camera.height) - camera.cy) / camera.fy
        bounds = (x, x, y, y)
    else:
        from warp_ar.scene.pixel_rays import pixel_rays

        rays = pixel_rays(camera).astype(np.float64)
        bounds = (rays[..., 0].min(0), rays[..., 0].max(0), rays[..., 1].min(1), rays[..., 1].max(1))
    return (
        np.minimum.accumulate(bounds[0][::-1])[::-1] - 1.0 / camera.fx,
        np.maximum.accumulate(bounds[1]) + 1.0 / camera.fx,
        np.minimum.accumulate(bounds[2][::-1])[::-1] - 1.0 / camera.fy,
        np.maximum.accumulate(bounds[3]) + 1.0 / camera.fy,
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Outline:
    """Convex polygons in the world, looked at in every frame from somewhere else."""

    polygons: Sequence[FloatArray]
    """(n, 3) each."""

    @functools.cached_property
    def corners(self) -> FloatArray:
        """Those of all polygons, (n, 3)."""
        return np.concatenate(self.polygons)


def screen_rects(outlines: Sequence[Outline], pose: Pose, camera: scenes.Camera) -> list[Rect]:
    """Smallest rectangles of pixels whose rays can meet the convex hulls of outlines, one pixel of margin included.

    Safe for what reaches behind the camera: polygons are clipped just in front of it. Safe for any distortion: pixels
    are picked by their undistorted rays, not by distorting the polygons. All at once, because a frame has several, and
    NumPy takes no longer for all than for one.

    Args:
        outlines: What to look at, each by itself.
        pose: ``camera_from_world``.
        camera: The camera of the frames.
    """
    rects = [EMPTY] * len(outlines)
    parts = {index: outline.corners for index, outline in enumerate(outlines) if outline.polygons}
    if not parts:
        return rects
    points = pose.apply(np.concatenate(list(parts.values())))
    if points[:, 2].min() < _nearest(points):
        clipped = {index: _in_front(outlines[index], pose) for index in parts}
        parts = {index: part for index, part in clipped.items() if len(part)}
        if not parts:
            return rects
        points = np.concatenate(list(parts.values()))
    projected = points[:, :2] / points[:, 2:]
    starts = list(itertools.accumulate(map(len, parts.values()), initial=0))[:-1]
    low, high = np.minimum.reduceat(projected, starts), np.maximum.reduceat(projected, starts)
    x_low, x_high, y_low, y_high = _ray_bounds(camera)
    edges = (
        y_high.searchsorted(low[:, 1]),
        y_low.searchsorted(high[:, 1], "right"),
        x_high.searchsorted(low[:, 0]),
        x_low.searchsorted(high[:, 0], "right"),
    )
    for index, top, bottom, left, right in zip(parts, *(edge.tolist() for edge in edges), strict=True):
        if top < bottom and left < right:
            rects[index] = top, bottom, left, right
    return rects


def _nearest(points: FloatArray) -> float:
    """Depth from which on points of the camera's space are looked at."""
    return 1e-6 * max(float(np.abs(points).max()), 1e-12)


def _in_front(outline: Outline, pose: Pose) -> FloatArray:
    """Corners of what is left of an outline, in the camera's space, when what is behind the camera is cut off."""
    points = pose.apply(outline.corners)
    near = _nearest(points)
    if points[:, 2].min() >= near:
        return points
    forward = np.array([0.0, 0.0, 1.0])
    return np.concatenate([_clip(pose.apply(polygon), forward, near) for polygon in outline.polygons])
