"""Device representation of a scene for ray intersection: meshes, materials, textures and lights.

Positions are in world metres, angles in device records are radians, and colours are linear RGB.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ar import scene as scenes
from warp_ar.device import exclusive
from warp_ar.errors import SceneError
from warp_ar.kernels import structs
from warp_ar.scene.area_lights import make_area_table
from warp_ar.scene.geometry import Mesh, rotation_matrix
from warp_ar.scene.kinds import light_kind, material_model, shape_kind
from warp_ar.scene.materials import MeshMaterial
from warp_ar.scene.mesh_parts import LARGEST
from warp_ar.scene.object_materials import is_detailed, materials_of, mesh_of
from warp_ar.scene.object_shapes import ObjectShape, object_shapes, part_placements, split_linear
from warp_ar.scene.pose import Pose
from warp_ar.scene.ray_mesh import (
    FloatArray,
    RayMesh,
    bend_ray_mesh,
    make_mesh,
    make_ray_mesh,
    mesh_key,
    shared_ray_mesh,
    texture_density,
)
from warp_ar.scene.screen_extents import NOTHING, Outline, ball_outline, box_faces, lit_faces
from warp_ar.scene.texture_pack import TexturePack, mask_cutoff
from warp_ar.scene.textures import DECODE

_ALPHA: Final = {"opaque": structs.OPAQUE, "mask": structs.MASKED, "blend": structs.BLENDED}
_NOWHERE: Final[Mapping[scenes.Marker, Pose | None]] = {}
_AWAY: Final = (0.0, 0.0, -1e5)
_BEHIND: Final = -1e3
_AWAY_SCALE: Final = 1e-6
"""Scale of a shape whose marker is lost: no ray hits it, and kernels need no test for it."""


class HostScene:
    """Host side of a scene: owns the arrays of the device's ``RayScene``, and moves animated parts."""

    def __init__(self, scene: scenes.Scene, device: Any) -> None:
        """Load the scene's meshes and textures and put them on ``device``.

        Raises:
            SceneError: A mesh or texture cannot be read, or a mesh without texture coordinates has a textured material.
        """
        self._meshes: dict[Any, tuple[Mesh, RayMesh, int]] = {}
        self._corners = 0
        self._bent: dict[Any, float] = {}
        self._textures = textures = TexturePack()
        self.probes = scene.probes
        materials = self._take(scene, device)
        self._proxies = self._shape_records(scene.proxies, device)
        self._fixed_proxies = self._proxies.copy()
        self._lights = np.zeros(len(scene.lights), structs.struct_dtype(structs.Light))
        self._mirrors: tuple[Outline, Outline] | None = None
        self._placed = b""  # objects whose outlines are the polygons below
        self._outline = NOTHING
        self._receivers: Outline | None = None
        self._gain = np.ones(3)
        self.ray_scene = ray_scene = structs.RayScene()
        self._add_corners(ray_scene, device)
        self.write_objects(np.zeros_like(self._objects), 0.0)
        self.write_proxies(np.zeros_like(self._proxies))
        self.write_lights(np.zeros_like(self._lights), 0.0)

        records = np.zeros(len(textures.records), structs.struct_dtype(structs.Texture))
        for record, values in zip(records, textures.records, strict=True):
            for name, value in values.items():
                record[name] = value
        ray_scene.objects = wp.array(self._objects, dtype=structs.Shape, device=device)
        ray_scene.proxies = wp.array(self._proxies, dtype=structs.Shape, device=device)
        ray_scene.materials = wp.array(materials, dtype=structs.Material, device=device)
        ray_scene.textures = wp.array(records, dtype=structs.Texture, device=device)
        texels = np.concatenate([np.zeros(0, np.uint32), *textures.texels])
        textures.texels.clear()
        ray_scene.texels = wp.array(texels, dtype=wp.uint32, device=device)
        ray_scene.decode_table = wp.array(DECODE, dtype=wp.float32, device=device)
        ray_scene.pixel_spread = 1.0 / max(scene.camera.fx, scene.camera.fy)
        self._write_area_lights(device)

    def set_pixel_spread(self, spread: float) -> None:
        """Set the angle of a pixel, radians, if it differs from that of the scene's camera."""
        self.ray_scene.pixel_spread = spread

    def _write_area_lights(self, device: Any) -> None:
        """Write the table of area lights; ``update`` may change its numbers."""
        keys = map(mesh_key, self._shapes)
        meshes = [None if key is None else self._meshes[key][0] for key in keys]
        table = make_area_table([shape.item for shape in self._shapes], meshes)
        self.has_area_lights = len(table.lights) > 0
        if not self.has_area_lights:
            return
        scene = self.ray_scene
        if scene.emitting_shares is not None and scene.emitting_shares.shape == table.shares.shape:
            scene.area_lights.assign(table.lights)
            scene.emitting_faces.assign(table.faces)
            scene.emitting_shares.assign(table.shares)
            return
        scene.area_lights = wp.array(table.lights, dtype=structs.AreaLight, device=device)
        scene.emitting_faces = wp.array(table.faces, dtype=wp.vec3i, device=device)
        scene.emitting_shares = wp.array(table.shares, dtype=wp.float32, device=device)

    def _add_corners(self, ray_scene: Any, device: Any) -> None:
        """Upload the corners and triangles of all meshes; arrays that no mesh needs stay empty."""
        meshes = list(self._meshes.values())
        rays = [mesh for _, mesh, _ in meshes]
        ray_scene.vertex_normals = _vectors([mesh.normals for mesh in rays], 3, wp.vec3, device)
        ray_scene.vertex_uvs = _vectors([mesh.uvs for mesh in rays], 2, wp.vec2, device)
        if not is_detailed(self.scene):
            return
        fields = (
            ("vertex_uvs_second", "uvs_second", (0.0, 0.0), wp.vec2),
            ("vertex_colors", "colors", (1.0, 1.0, 1.0, 1.0), wp.vec4),
            ("vertex_tangents", "tangents", (1.0, 0.0, 0.0, 1.0), wp.vec4),
        )
        for name, own, default, dtype in fields:
            values = [getattr(mesh, own) for mesh, _, _ in meshes]
            if any(value is not None for value in values):
                parts = [
                    np.tile(np.array(default, np.float32), (3 * len(mesh.faces), 1))
                    if value is None
                    else value[mesh.faces].reshape(-1, len(default))
                    for (mesh, _, _), value in zip(meshes, values, strict=True)
                ]
                setattr(ray_scene, name, _vectors(parts, len(default), dtype, device))
        numbers = [
            np.zeros(len(mesh.faces), np.int32) if mesh.triangle_materials is None else mesh.triangle_materials
            for mesh, _, _ in meshes
        ]
        numbers = [np.zeros(0, np.int32), *numbers]
        ray_scene.triangle_materials = wp.array(np.concatenate(numbers), dtype=wp.int32, device=device)
        densities = [texture_density(mesh) for mesh, _, _ in meshes]
        ray_scene.triangle_density = _vectors(densities, 2, wp.vec2, device)

    def update(self, scene: scenes.Scene) -> None:
        """Replace the numbers by those of another scene with the same ``skeleton``: poses, sizes, materials, lights."""
        device = self.ray_scene.materials.device
        self.ray_scene.materials.assign(self._take(scene, device))
        self._write_area_lights(device)

    def _take(self, scene: scenes.Scene, device: Any) -> npt.NDArray[Any]:
        """Store the numbers of a scene, and return the records of its materials."""
        self.scene = scene
        self._shapes = object_shapes(scene)
        self._objects = self._shape_records(self._shapes, device)
        self._place_objects()
        self._lit: Outline | None = None
        self._balls = ball_outline(self.probes)
        self._glossy = np.array([proxy.material is not None for proxy in scene.proxies], bool)
        self._lights_edited = True
        return self._material_records()

    @property
    def shape_count(self) -> int:
        """Return the number of records of ``write_objects``: one per object, or per separately moving part."""
        return len(self._shapes)

    def _place_objects(self) -> None:
        made_of = [materials_of(item) for item in self.scene.objects]
        counts = [len(one.materials) for one in made_of]
        starts = np.cumsum([0, *counts])
        self._objects["material"] = [starts[shape.index] for shape in self._shapes]
        self._objects["holed"] = [made_of[shape.index].holed for shape in self._shapes]
        # Centres in local coordinates: a mesh is stored relative to the centre of its bounding box.
        self._centers = [
            record["scale"] * self._meshes[key][1].center if key is not None else np.zeros(3)
            for record, key in zip(self._objects, map(mesh_key, self._shapes), strict=True)
        ]

    def _material_records(self) -> npt.NDArray[Any]:
        materials = [(item, material) for item in self.scene.objects for material in materials_of(item).materials]
        records = np.zeros(len(materials), structs.struct_dtype(structs.Material))
        for record, (item, material) in zip(records, materials, strict=True):
            self._fill_material(record, item, material)
        return records

    def _shape_records(self, shapes: Sequence[ObjectShape | scenes.Proxy], device: Any) -> npt.NDArray[Any]:
        """Return records of ``structs.Shape`` with all values that do not move."""
        records = np.zeros(len(shapes), structs.struct_dtype(structs.Shape))
        for record, shape in zip(records, shapes, strict=True):
            item = shape.item if isinstance(shape, ObjectShape) else shape
            scale = getattr(item, "scale", 1.0)
            rotation = rotation_matrix(item.rotate)
            position = np.array(item.at)
            record["kind"], record["scale"], record["material"] = shape_kind(item), scale, -1
            key = mesh_key(shape)
            if key is not None:
                _, mesh, record["first_vertex"] = self._load(key, device)
                record["mesh"] = mesh.mesh.id
                record["extent"], record["smooth"] = mesh.half, 1
                position = position + rotation @ (scale * mesh.center)
            elif isinstance(item, scenes.Object) and item.shape == "sphere":
                record["extent"] = item.radius
            else:
                record["extent"][: len(item.size)] = 0.5 * np.array(item.size)
            record["rotation"], record["position"] = rotation, position
        return records

    def _load(self, key: Any, device: Any) -> tuple[Mesh, RayMesh, int]:
        """Return the mesh, ray mesh and first corner index of a file or torus, made once."""
        if key not in self._meshes:
            mesh = make_mesh(key)
            shared = isinstance(key, Path) or any(key is shape.mesh for shape in self._shapes)
            ray_mesh = shared_ray_mesh(mesh, device) if shared else make_ray_mesh(mesh, device)
            self._meshes[key] = (mesh, ray_mesh, self._corners)
            self._corners += len(ray_mesh.normals)
        return self._meshes[key]

    def _fill_material(self, record: Any, item: scenes.Object, material: MeshMaterial) -> None:
        """Write a material of an object to a record of ``structs.Material``."""
        mesh = mesh_of(item)
        surface = material.surface
        assert not isinstance(surface, scenes.FileMaterial | scenes.EmissiveMaterial)
        first = surface.base_color
        specular = surface.specular if isinstance(surface, scenes.PhongMaterial) else (0.0, 0.0, 0.0)
        for color in (first, specular):
            if isinstance(color, Path) and mesh is not None and mesh.uvs is None:
                raise SceneError(
                    f"{item.file}: the mesh has no texture coordinates for the texture {color}; "
                    "unwrap it, or give the material a plain colour"
                )
        images = () if mesh is None else mesh.images
        add = self._textures.add
        cutoff = mask_cutoff(material)
        record["model"] = material_model(material)
        record["base_color"], path = _factor(first)
        record["base_texture"] = add(material.base, images, encoded=True, cutoff=cutoff, path=path)
        record["specular"], path = _factor(specular)
        record["specular_texture"] = add(material.specular, images, encoded=True, path=path)
        if isinstance(surface, scenes.PhongMaterial):
            record["shininess"] = surface.shininess
        elif isinstance(surface, scenes.MetallicRoughnessMaterial):
            record["metallic"], record["roughness"] = surface.metallic, surface.roughness
        record["alpha_mode"] = _ALPHA[material.alpha]
        record["opacity"], record["cutoff"] = material.opacity, material.cutoff
        record["single_sided"], record["unlit"] = not material.double_sided, material.unlit
        record["emission"] = material.emission
        for name in ("metallic_roughness", "normal", "occlusion"):
            record[f"{name}_texture"] = add(getattr(material, name), images, encoded=False)
        image = item.material.image if isinstance(item.material, scenes.EmissiveMaterial) else None
        record["emissive_texture"] = add(material.emissive, images, encoded=True, path=image, clamp=True)
        record["normal_scale"], record["occlusion_strength"] = material.normal_scale, material.occlusion_strength

    def write_objects(
        self, records_out: npt.NDArray[Any], seconds: float, places: Mapping[scenes.Marker, Pose | None] = _NOWHERE
    ) -> bool:
        """Write the virtual objects' records for a time.

        Args:
            records_out: Records of ``structs.Shape``, ``shape_count`` of them.
            seconds: Time since the first frame.
            places: ``world_from_marker`` of every marker to which parts of the scene are attached; None for a lost
                marker.

        Returns:
            True if any record differs from its former content.
        """
        placed: dict[int, FloatArray] = {}
        bent = False
        for record, shape, center in zip(self._objects, self._shapes, self._centers, strict=True):
            item = shape.item
            if shape.moving is not None:
                if shape.index not in placed:
                    placed[shape.index] = part_placements(item, shape.moving, seconds)
                bent |= self._bend(record, shape, seconds)
                center = self._meshes[mesh_key(shape)][1].center
                _place_part(record, item, placed[shape.index][shape.part], center, places)
            elif item.animate is not None or item.marker is not None or seconds == 0.0:
                rotation, position = item.pose_at(seconds)
                _place(record, item, rotation, position + rotation @ center, places)
        return _update(records_out, self._objects) or bent

    def _bend(self, record: Any, shape: ObjectShape, seconds: float) -> bool:
        """Deform a part for a time since the first frame; return False if its triangles are up to date."""
        if shape.bend is None or shape.moving is None or shape.item.play is None:
            return False
        key, now = mesh_key(shape), shape.item.play.time_at(seconds, shape.moving.duration)
        if self._bent.get(key, 0.0) == now:
            return False
        self._bent[key] = now
        bent, (mesh, ray_mesh, first) = shape.bend(now), self._meshes[key]
        scene, device = self.ray_scene, ray_mesh.mesh.device
        with exclusive(device):
            ray_mesh = bend_ray_mesh(ray_mesh, bent)
            scene.vertex_normals[first : first + len(ray_mesh.normals)].assign(ray_mesh.normals)
            if bent.tangents is not None and scene.vertex_tangents is not None and scene.vertex_tangents.size:
                tangents = bent.tangents[bent.faces].reshape(-1, 4)
                scene.vertex_tangents[first : first + len(tangents)].assign(tangents)
        self._meshes[key] = mesh, ray_mesh, first
        record["extent"] = ray_mesh.half
        return True

    def set_gain(self, gain: npt.NDArray[np.float64]) -> None:
        """Set the factor on virtual lights: the camera's gain relative to its first frame, RGB; initially 1."""
        self._gain, self._lights_edited = gain, True

    def write_proxies(
        self, records_out: npt.NDArray[Any], places: Mapping[scenes.Marker, Pose | None] = _NOWHERE
    ) -> bool:
        """Write the records, of ``structs.Shape``, of proxies at the places of their markers.

        ``places`` holds ``world_from_marker`` of every such marker, None for a lost one. Return True if any record
        differs from its former content.
        """
        for record, fixed, item in zip(self._proxies, self._fixed_proxies, self.scene.proxies, strict=True):
            if item.marker is not None:
                _place(record, item, fixed["rotation"], fixed["position"], places)
        changed = _update(records_out, self._proxies)
        if changed:
            self._lit = self._receivers = self._mirrors = None
        return changed

    def place_probes(self, pose: Pose, places: Mapping[scenes.Marker, Pose | None] = _NOWHERE) -> bool:
        """Move ``probes`` to the places of their markers, far behind the camera while a marker is lost.

        Return True if any moved.

        Args:
            pose: ``camera_from_world``.
            places: ``world_from_marker`` of every marker that moves a ball; None for a lost marker.
        """
        if all(probe.marker is None for probe in self.scene.probes):
            return False
        behind = pose.inverse().apply(np.array([0.0, 0.0, _BEHIND]))
        placed = []
        for probe in self.scene.probes:
            if probe.marker is not None:
                place = places.get(probe.marker)
                x, y, z = map(float, behind if place is None else place.apply(np.array(probe.center)))
                probe = dataclasses.replace(probe, center=(x, y, z))
            placed.append(probe)
        if tuple(placed) == self.probes:
            return False
        self.probes = tuple(placed)
        self._balls = ball_outline(self.probes)
        return True

    def write_lights(
        self, records_out: npt.NDArray[Any], seconds: float, places: Mapping[scenes.Marker, Pose | None] = _NOWHERE
    ) -> bool:
        """Write the virtual lights' records, of ``structs.Light``, for a time since the first frame.

        ``places`` holds ``world_from_marker`` of every marker to which lights are attached, None for a lost one. Return
        True if any record differs from its former content.
        """
        for record, light in zip(self._lights, self.scene.lights, strict=True):
            if light.animate is None and light.marker is None and seconds != 0.0 and not self._lights_edited:
                continue
            self._lit = None
            position, direction = light.pose_at(seconds)
            place = None if light.marker is None else places.get(light.marker)
            if place is not None:
                position, direction = place.apply(position), place.rotation @ direction
            record["position"], record["direction"] = position, direction
            record["kind"] = light_kind(light)
            lost = light.marker is not None and place is None
            record["intensity"] = 0.0 if lost else light.intensity * np.array(light.color) * self._gain
            record["inner_angle"], record["outer_angle"] = map(math.radians, (light.inner_angle, light.outer_angle))
            record["attenuation"], record["radius"] = light.attenuation, light.radius
        self._lights_edited = False
        return _update(records_out, self._lights)

    def object_outline(self) -> Outline:
        """Return the outline of all virtual objects."""
        placed = self._objects.tobytes()
        if placed != self._placed:
            self._placed = placed
            self._outline = _outline_of(self._objects)
        return self._outline

    def _receiver_outline(self) -> Outline:
        """Return the outline of all proxies."""
        if self._receivers is None:
            self._receivers = _outline_of(self._proxies)
        return self._receivers

    def light_outline(self, *, bounced: bool = False) -> Outline:
        """Return the outline of the regions of proxies that virtual lights illuminate.

        With ``bounced``, the outline also covers the reflections of that light.
        """
        if self._lit is None:
            lights = self._lights[self._lights["intensity"].any(axis=1)]  # the others emit nothing
            faces = [box_faces(record) for record in _present(self._proxies)]
            self._lit = Outline([part for light in lights for own in faces for part in lit_faces(light, own)])
            if self.has_area_lights:
                self._lit = self._receiver_outline()  # emitters may be large: everything counts as lit
        return self._receiver_outline() if bounced and self._lit.polygons else self._lit

    def mirror_outline(self, *, receivers: bool = False) -> Outline:
        """Return the outline of mirror balls, and with ``receivers`` also of proxies with specular reflection."""
        if not receivers:
            return self._balls
        if self._mirrors is None or self._mirrors[0] is not self._balls:
            faces = _outline_of(self._proxies[self._glossy]).polygons
            self._mirrors = self._balls, Outline([*self._balls.polygons, *faces])
        return self._mirrors[1]

    def shadow_outline(self) -> Outline:
        """Return the outline within which virtual objects can change the environment's light on proxies."""
        return self._receiver_outline() if self.object_outline().polygons else NOTHING


def _outline_of(records: npt.NDArray[Any]) -> Outline:
    """Return the outline of shapes by their records."""
    return Outline([face for record in _present(records) for face in box_faces(record)])


def _present(records: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the records of shapes whose marker is not lost."""
    there: npt.NDArray[Any] = records[records["position"][:, 2] > 0.5 * _AWAY[2]]
    return there


def _place(
    record: Any,
    item: scenes.Object | scenes.Proxy,
    rotation: FloatArray,
    position: FloatArray,
    places: Mapping[scenes.Marker, Pose | None],
) -> None:
    """Write a shape's placement, given in its marker's frame.

    While the marker is lost, it is shrunk to ``_AWAY_SCALE``.
    """
    record["scale"] = getattr(item, "scale", 1.0)
    if item.marker is None:
        record["rotation"], record["position"] = rotation, position
        return
    place = places.get(item.marker)
    if place is None:
        record["position"], record["scale"] = _AWAY, _AWAY_SCALE
        return
    record["rotation"], record["position"] = place.rotation @ rotation, place.apply(position)


def _place_part(
    record: Any,
    item: scenes.Object,
    placement: FloatArray,
    center: FloatArray,
    places: Mapping[scenes.Marker, Pose | None],
) -> None:
    """Write the placement (4, 4) of a part of an object.

    ``center`` is the part's mesh centre in its own coordinates.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        linear, position = placement[:3, :3], placement[:3, :3] @ center + placement[:3, 3]
        if item.marker is not None:
            place = places.get(item.marker)
            if place is None:
                linear = np.zeros((3, 3))
            else:
                linear, position = place.rotation @ linear, place.apply(position)
    scale, rotation, inverse, stretch = split_linear(linear)
    if scale == 0.0 or not (np.abs(position) < LARGEST).all():
        record["position"], record["scale"], record["stretch"] = _AWAY, _AWAY_SCALE, 0.0
        record["rotation"] = np.eye(3)
        return
    record["scale"], record["rotation"], record["position"] = scale, rotation, position
    record["stretch"], record["inverse"] = stretch, inverse


def _factor(color: scenes.Color) -> tuple[tuple[float, float, float], Path | None]:
    """Return the constant factor and the picture of a colour."""
    return ((1.0, 1.0, 1.0), color) if isinstance(color, Path) else (color, None)


def _vectors(parts: Iterable[npt.NDArray[np.float32]], length: int, dtype: Any, device: Any) -> Any:
    return wp.array(np.concatenate([np.zeros((0, length), np.float32), *parts]), dtype=dtype, device=device)


def _update(records_out: npt.NDArray[Any], records: npt.NDArray[Any]) -> bool:
    # Compared as bytes, including padding: NumPy takes ten times as long to compare records field by field.
    if records_out.tobytes() == records.tobytes():
        return False
    records_out.view(np.uint8)[...] = records.view(np.uint8)
    return True
