"""A shot as other programs take it: the camera's way and lens, surfaces with their materials and motion, lights.

Lengths are metres, angles radians but where a name says degrees, the world is the marker's, z up. Radiance is in camera
values: 1 is where the camera clips. Exchange formats know fewer materials than scenes do; ``Look`` is what all of them
can say.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.scene import Camera, Pose, Scene
from warp_ar.scene.description import Light, Object, Proxy
from warp_ar.scene.emissive_picture import load_emission
from warp_ar.scene.geometry import Mesh, make_mesh, rotation_matrix
from warp_ar.scene.materials import (
    RGB,
    Color,
    EmissiveMaterial,
    FileMaterial,
    Material,
    MetallicRoughnessMaterial,
    MirrorMaterial,
    PhongMaterial,
)
from warp_ar.scene.mesh_cache import load_kept_mesh
from warp_ar.scene.mesh_files import load_texture
from warp_ar.scene.names import surface_names
from warp_ar.scene.object_materials import look_of as materials_of
from warp_ar.scene.object_shapes import ObjectShape, object_shapes, part_placements
from warp_ar.scene.shapes import box_mesh, disk_mesh, sphere_mesh, torus_mesh, tube_mesh
from warp_ar.signature import sign_png
from warp_ar.srgb import decode_srgb, encode_srgb

Matrix = npt.NDArray[np.float64]

WHITE: RGB = (1.0, 1.0, 1.0)
FILM_WIDTH = 0.036
"""Metres of film that lenses are told for: 36 mm. Only its ratio to the focal length matters to a picture."""


@dataclasses.dataclass(frozen=True)
class Look:
    """A material as UsdPreviewSurface and glTF know it: metallic-roughness, or an explicit specular colour."""

    base_color: RGB = (0.8, 0.8, 0.8)
    """Linear; multiplies the texture."""
    metallic: float = 0.0
    roughness: float = 1.0
    """Perceptual: alpha is its square."""
    specular: RGB | None = None
    """Reflectance straight on where it is given; None: by ``metallic``, 0.04 for what is no metal."""
    texture: npt.NDArray[np.uint8] | None = None
    """Of the base colour: RGB, sRGB-encoded, row 0 at the top."""
    emission: RGB = (0.0, 0.0, 0.0)
    """Radiance that it sends out; multiplies ``glow``."""
    glow: npt.NDArray[np.uint8] | None = None
    """Picture of the emission: RGB, sRGB-encoded, row 0 at the top."""


@dataclasses.dataclass(frozen=True)
class Body:
    """A surface of the shot."""

    name: str
    mesh: Mesh
    look: Look
    proxy: bool
    """Physical: it is in the plate and only receives light and shadow."""
    placements: tuple[Matrix, ...]
    """``world_from_mesh``, (4, 4), of every frame; one where it stands still."""


@dataclasses.dataclass(frozen=True)
class Shot:
    """What an exchange file tells."""

    scene: Scene
    """Its camera is that of the frames."""
    fps: float
    """Frames per second."""
    poses: tuple[Pose | None, ...]
    """``camera_from_world`` of every frame; None where the marker was lost."""
    plate: Path | None = None
    """The frames, relative to the file's folder: a video, or a folder of pictures."""
    environment: Path | None = None
    """Latlong OpenEXR in the axes ``y-up``."""
    radiance: npt.NDArray[np.float32] | None = None
    """The same, (height, 2 height, 3), z-up, for files that hold it themselves."""
    others: tuple[tuple[Path, tuple[float, float, float]], ...] = ()
    """Of each mirror ball after the first whose light is interpolated: its environment, as ``environment``, and where
    it stands, metres."""

    @property
    def camera(self) -> Camera:
        """The camera of the frames."""
        return self.scene.camera

    @property
    def seconds(self) -> tuple[float, ...]:
        """When the frames were taken."""
        return tuple(index / self.fps for index in range(len(self.poses)))

    def camera_placements(self) -> dict[int, Matrix]:
        """``world_from_camera`` by frame, (4, 4), of a camera that looks along its -z, its y up, as in USD and glTF."""
        found = {}
        for index, pose in enumerate(self.poses):
            if pose is not None:
                inverse = pose.inverse()
                found[index] = placement(inverse.rotation @ np.diag([1.0, -1.0, -1.0]), inverse.translation)
        return found

    def bodies(self) -> list[Body]:
        """Virtual objects, then proxies, by the names of ``surface_names``."""
        names, scene = surface_names(self.scene), self.scene
        items: Sequence[ObjectShape | Proxy] = (*object_shapes(scene), *scene.proxies)
        return [self._body(name, item) for name, item in zip(names, items, strict=False)]

    def _body(self, name: str, shape: ObjectShape | Proxy) -> Body:
        item = shape if isinstance(shape, Proxy) else shape.item
        if isinstance(shape, ObjectShape) and shape.moving is not None and shape.mesh is not None:
            placed = [part_placements(shape.item, shape.moving, seconds)[shape.part] for seconds in self.seconds]
            return Body(name, shape.mesh, look_of(shape.item, shape.mesh), False, tuple(placed))
        mesh = mesh_of(item)
        if isinstance(item, Proxy):
            at = (placement(rotation_matrix(item.rotate), np.array(item.at)),)
            return Body(name, mesh, Look(), True, at)
        times = self.seconds if item.animate is not None else (0.0,)
        poses = [item.pose_at(seconds) for seconds in times]
        return Body(name, mesh, look_of(item, mesh), False, tuple(placement(item.scale * r, t) for r, t in poses))

    def light_placements(self, light: Light) -> tuple[Matrix, ...]:
        """``world_from_light``, (4, 4), of every frame, of a light that shines along its -z; one if it stands still."""
        times = self.seconds if light.animate is not None else (0.0,)
        return tuple(placement(_turn_to(direction), at) for at, direction in map(light.pose_at, times))


def placement(linear: Any, translation: Any) -> Matrix:
    """A (4, 4) matrix that maps columns: x to linear x + translation."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, translation
    return matrix


def _turn_to(direction: Matrix) -> Matrix:
    """A rotation that turns -z to a unit direction."""
    back = -direction
    side = np.cross([0.0, 1.0, 0.0] if abs(back[1]) < 0.9 else [1.0, 0.0, 0.0], back)
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(back, side), back], axis=-1)


def mesh_of(item: Object | Proxy) -> Mesh:
    """Triangles of an object or a proxy, before scale and pose."""
    if isinstance(item, Object) and item.mesh is not None:
        return item.mesh
    if item.file is not None:
        return load_kept_mesh(item.file)
    if isinstance(item, Object) and item.shape == "sphere":
        return sphere_mesh(item.radius)
    if isinstance(item, Object) and item.shape == "torus":
        return torus_mesh(item.major_radius, item.minor_radius)
    if item.shape == "box":
        return box_mesh(item.size)
    if isinstance(item, Object) and item.shape == "disk":
        return disk_mesh(item.radius)
    if isinstance(item, Object) and item.shape == "tube":
        return tube_mesh(item.radius, item.length)
    x, y = (0.5 * length for length in item.size[:2])
    corners = [[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]]
    return make_mesh(corners, [[0, 1, 2], [0, 2, 3]], [[0, 0, 1]] * 4, [[0, 0], [1, 0], [1, 1], [0, 1]])


def look_of(item: Object, mesh: Mesh) -> Look:
    """What exchange formats can say of an object's material; of several, the first.

    A Phong lobe of exponent n becomes GGX of alpha = sqrt(2 / (n + 2)), which is as wide, and its colour the
    reflectance straight on; a mirror becomes a metal without roughness.
    """
    first = materials_of(item).materials[0]
    glow = None if first.emissive is None or mesh.uvs is None else mesh.images[first.emissive.image][..., :3]
    if isinstance(item.material, EmissiveMaterial) and item.material.image is not None:
        glow = load_emission(item.material.image)[0]
    look = _reflection_of(first.surface, mesh)
    return dataclasses.replace(look, emission=first.emission, glow=glow if any(first.emission) else None)


def _reflection_of(material: Material, mesh: Mesh) -> Look:
    """What ``look_of`` says of reflected light."""
    assert not isinstance(material, FileMaterial | EmissiveMaterial)
    if isinstance(material, PhongMaterial):
        alpha = math.sqrt(2.0 / (material.shininess + 2.0))
        factor, texture = _colored(material.diffuse, mesh)
        specular = _mean_color(material.specular)
        return Look(factor, 0.0, math.sqrt(alpha), specular, texture)
    factor, texture = _colored(material.base_color, mesh)
    if isinstance(material, MetallicRoughnessMaterial):
        return Look(factor, material.metallic, material.roughness, None, texture)
    if isinstance(material, MirrorMaterial):
        return Look(factor, 1.0, 0.0, None, texture)
    return Look(factor, 0.0, 1.0, (0.0, 0.0, 0.0), texture)


def _colored(color: Color, mesh: Mesh) -> tuple[RGB, npt.NDArray[np.uint8] | None]:
    """Factor and texture of a colour; a texture that the mesh brings is multiplied by the material's."""
    if not isinstance(color, Path):
        return color, mesh.texture
    own = load_texture(color)
    if mesh.texture is None:
        return WHITE, own
    height, width = (max(a, b) for a, b in zip(own.shape[:2], mesh.texture.shape[:2], strict=True))
    first, second = (to_linear(cv2.resize(one, (width, height))) for one in (own, mesh.texture))
    return WHITE, to_srgb(first * second)


def _mean_color(color: Color) -> RGB:
    if not isinstance(color, Path):
        return color
    r, g, b = to_linear(load_texture(color)).mean(axis=(0, 1)).tolist()
    return r, g, b


def to_linear(codes: npt.NDArray[np.uint8]) -> Matrix:
    """Linear values of sRGB codes."""
    return decode_srgb(codes.astype(np.float64) / 255.0)


def to_srgb(values: Matrix) -> npt.NDArray[np.uint8]:
    """Codes of linear values, sRGB-encoded."""
    return np.rint(255.0 * encode_srgb(np.clip(values, 0.0, 1.0))).astype(np.uint8)


def encode_texture(texture: npt.NDArray[np.uint8]) -> bytes:
    """PNG of a texture."""
    done, data = cv2.imencode(".png", cv2.cvtColor(texture, cv2.COLOR_RGB2BGR))
    assert done
    return sign_png(data.tobytes())


def texture_file(path: Path, name: str, kind: str = "") -> Path:
    """Where a texture of a body goes that cannot lie in the file itself; ``kind``: "emission" for that of its light."""
    return path.with_name("_".join(part for part in (path.stem, name, kind) if part) + ".png")


def texture_files(scene: Scene, path: Path) -> dict[str, Path]:
    """All of them, by the names of their bodies and what they are of."""
    found = {}
    for name, shape in zip(surface_names(scene), object_shapes(scene), strict=False):
        item, mesh = shape.item, shape.mesh or mesh_of(shape.item)
        look = look_of(item, mesh)
        if mesh.uvs is not None and look.texture is not None:
            found[name] = texture_file(path, name)
        if mesh.uvs is not None and look.glow is not None:
            found[f"{name}_emission"] = texture_file(path, name, "emission")
    return found


def key_frames(placements: Sequence[Matrix]) -> Sequence[Matrix]:
    """Placements without repetition: one if all are equal."""
    return placements[:1] if all(np.array_equal(one, placements[0]) for one in placements) else placements
