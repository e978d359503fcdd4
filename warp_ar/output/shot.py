"""Shot for exchange with other programs: camera track and lens, surfaces with materials and motion, lights.

Lengths are metres, angles radians unless a name contains degrees, and the world is the marker's, z up. Radiance is in
camera values: 1 is where the camera clips.

Exchange formats (UsdPreviewSurface and glTF) support fewer materials than scenes: metallic-roughness, or an explicit
specular colour, with pictures. A mesh with materials of its own keeps all of them. A Phong lobe of exponent n becomes
GGX of alpha = sqrt(2 / (n + 2)), which has the same width, with the lobe's colour as reflectance at normal incidence. A
mirror becomes a metal with roughness 0.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from warp_ar.scene import Camera, Pose, Scene
from warp_ar.scene.description import Light, Object, Proxy
from warp_ar.scene.geometry import Mesh, placement, rotation_matrix
from warp_ar.scene.materials import (
    RGB,
    Color,
    EmissiveMaterial,
    FileMaterial,
    MeshMaterial,
    MetallicRoughnessMaterial,
    MirrorMaterial,
    PhongMaterial,
    TextureUse,
)
from warp_ar.scene.object_materials import materials_of
from warp_ar.scene.object_materials import mesh_of as object_mesh
from warp_ar.scene.object_shapes import ObjectShape, object_shapes, part_placements, surface_names
from warp_ar.scene.ray_mesh import make_mesh, mesh_key
from warp_ar.scene.shapes import box_mesh, rect_mesh, sphere_mesh
from warp_ar.scene.texture_pack import joint_picture
from warp_ar.scene.textures import linear_texture, load_emission, load_texture
from warp_ar.signature import encode_png

Codes = npt.NDArray[np.uint8]
Matrix = npt.NDArray[np.float64]

FILM_WIDTH = 0.036
"""Film width, metres, that focal lengths refer to: 36 mm. Only their ratio matters to a picture."""


@dataclasses.dataclass(frozen=True, eq=False)
class Picture:
    """Picture with its placement on the surface."""

    codes: Codes
    """RGB, or RGBA if alpha is used, (h, w, 3 or 4), row 0 at the top."""
    use: TextureUse = dataclasses.field(default_factory=lambda: TextureUse(0))
    """Set of texture coordinates, transform and wrapping."""

    @property
    def placing(self) -> tuple[float, float, float, float, float]:
        """Return scale along u and v, counter-clockwise rotation in radians, and offsets, for v pointing up."""
        a, b, c, d, e, f = self.use.transform
        turn = math.atan2(d, a)
        return math.hypot(a, d), e * math.cos(turn) - b * math.sin(turn), turn, c, f

    def encode(self) -> bytes:
        """Return the picture as PNG."""
        return encode_png(self.codes)

    @property
    def digest(self) -> bytes:
        """Return a hash of the codes."""
        return hashlib.blake2b(self.codes.tobytes(), person=b"%d" % self.codes.shape[1]).digest()


@dataclasses.dataclass(frozen=True)
class ExchangeMaterial:
    """Material in the form of UsdPreviewSurface and glTF."""

    base_color: RGB = (0.8, 0.8, 0.8)
    """Base colour, linear RGB; multiplies the texture."""
    metallic: float = 0.0
    roughness: float = 1.0
    """Perceptual roughness: alpha is its square."""
    specular: RGB | None = None
    """Reflectance at normal incidence; None: by ``metallic``, with 0.04 for non-metals."""
    pictures: Mapping[str, Picture] = dataclasses.field(default_factory=dict)
    """Pictures by use: "" (base colour and opacity), emission, metallic_roughness, normal, occlusion."""
    own: MeshMaterial = dataclasses.field(default_factory=MeshMaterial)
    """The scene's material, for properties that all formats share: alpha, emission, factors of pictures."""


def _exchange_material(item: Object, mesh: Mesh, own: MeshMaterial) -> ExchangeMaterial:
    uses = {"": own.base, "emission": own.emissive}
    uses |= {name: getattr(own, name) for name in ("metallic_roughness", "normal", "occlusion")}
    pictures = {}
    for name, use in uses.items():
        if use is not None and (mesh.uvs if use.uv_set == 0 else mesh.uvs_second) is not None:
            channels = 4 if name == "" and own.alpha != "opaque" else 3
            pictures[name] = Picture(np.ascontiguousarray(mesh.images[use.image][..., :channels]), use)
    if isinstance(item.material, EmissiveMaterial) and item.material.image is not None and mesh.uvs is not None:
        pictures["emission"] = Picture(load_emission(item.material.image)[0])
    if not any(own.emission):
        pictures.pop("emission", None)
    material = own.surface
    assert not isinstance(material, FileMaterial | EmissiveMaterial)
    color = material.base_color
    factor, texture = _colored(color, pictures.pop("", None), mesh)
    if texture is not None:
        pictures = {"": texture, **pictures}
    if isinstance(material, PhongMaterial):
        specular = _mean_color(material.specular)
        if own.specular is not None:
            shown = linear_texture(mesh.images[own.specular.image][..., :3]).mean(axis=(0, 1), dtype=np.float64)
            specular = (specular[0] * shown[0], specular[1] * shown[1], specular[2] * shown[2])
        return ExchangeMaterial(factor, 0.0, (2.0 / (material.shininess + 2.0)) ** 0.25, specular, pictures, own)
    if isinstance(material, MetallicRoughnessMaterial):
        return ExchangeMaterial(factor, material.metallic, material.roughness, None, pictures, own)
    if isinstance(material, MirrorMaterial):
        return ExchangeMaterial(factor, 1.0, 0.0, None, pictures, own)
    return ExchangeMaterial(factor, 0.0, 1.0, (0.0, 0.0, 0.0), pictures, own)


def _colored(color: Color, base: Picture | None, mesh: Mesh) -> tuple[RGB, Picture | None]:
    """Return factor and texture of a colour; a texture of the mesh is multiplied by that of the material."""
    if not isinstance(color, Path):
        return color, base
    if mesh.uvs is None:
        return _mean_color(color), None
    use = TextureUse(0) if base is None else base.use
    codes = joint_picture(None if base is None else mesh.images[use.image], color)
    return (1.0, 1.0, 1.0), Picture(np.ascontiguousarray(codes[..., : base.codes.shape[2] if base else 3]), use)


def _mean_color(color: Color) -> RGB:
    if not isinstance(color, Path):
        return color
    r, g, b = linear_texture(load_texture(color)).mean(axis=(0, 1), dtype=np.float64).tolist()
    return r, g, b


def texture_plan(path: Path, name: str, materials: Sequence[ExchangeMaterial]) -> dict[tuple[int, str], Path]:
    """Return the paths of a body's pictures that are stored beside the file, by material and use.

    Equal pictures share a file.
    """
    found: dict[tuple[int, str], Path] = {}
    known: dict[bytes, Path] = {}
    for number, material in enumerate(materials):
        for kind, picture in material.pictures.items():
            parts = (path.stem, name, str(number) if number else "", kind)
            file = path.with_name("_".join(part for part in parts if part) + ".png")
            found[number, kind] = known.setdefault(picture.digest, file)
    return found


def used_materials(item: Object, mesh: Mesh) -> tuple[tuple[ExchangeMaterial, ...], npt.NDArray[np.int64] | None]:
    """Return the materials used by triangles, and the material index of each triangle, (m,); None: all the first."""
    materials = [_exchange_material(item, mesh, material) for material in materials_of(item).materials]
    if len(materials) == 1 or mesh.triangle_materials is None:
        return (materials[0],), None
    used, numbers = np.unique(mesh.triangle_materials, return_inverse=True)
    return tuple(materials[number] for number in used), None if len(used) == 1 else numbers.reshape(-1)


@dataclasses.dataclass(frozen=True)
class Body:
    """Surface of the shot."""

    name: str
    mesh: Mesh
    materials: tuple[ExchangeMaterial, ...]
    """Materials of its triangles, at least one."""
    proxy: bool
    """True for physical geometry, which is in the plate and only receives light and shadow."""
    placements: tuple[Matrix, ...]
    """``world_from_mesh``, (4, 4), of every frame; a single one if it does not move."""
    numbers: npt.NDArray[np.int64] | None = None
    """Index into ``materials`` of each triangle, (m,); None: all the first."""
    colors: npt.NDArray[np.float32] | None = None
    """Factors of base colour and alpha at vertices, (n, 4), linear."""

    def triangles_of(self, number: int) -> npt.NDArray[np.int64]:
        """Return the indices of triangles with a material."""
        if self.numbers is None:
            return np.arange(len(self.mesh.faces))
        return np.flatnonzero(self.numbers == number)


@dataclasses.dataclass(frozen=True)
class Shot:
    """Contents of an exchange file."""

    scene: Scene
    """Scene with the camera of the frames."""
    fps: float
    """Frames per second."""
    poses: tuple[Pose | None, ...]
    """``camera_from_world`` of every frame; None if the marker was lost."""
    plate: Path | None = None
    """Video, or folder of pictures, with the frames; relative to the file's folder."""
    environment: Path | None = None
    """Latlong OpenEXR in the axes ``y-up``."""
    radiance: npt.NDArray[np.float32] | None = None
    """Radiance of the environment, (height, 2 height, 3), z-up, for formats that embed it."""
    others: tuple[tuple[Path, tuple[float, float, float]], ...] = ()
    """Environment file and position in metres of each interpolated mirror ball after the first."""

    @property
    def camera(self) -> Camera:
        """The camera of the frames."""
        return self.scene.camera

    @property
    def seconds(self) -> tuple[float, ...]:
        """Times of the frames."""
        return tuple(index / self.fps for index in range(len(self.poses)))

    def camera_placements(self) -> dict[int, Matrix]:
        """Return ``world_from_camera``, (4, 4), by frame, for a camera that faces -z with y up, as in USD and glTF."""
        found = {}
        for index, pose in enumerate(self.poses):
            if pose is not None:
                inverse = pose.inverse()
                found[index] = placement(inverse.rotation @ np.diag([1.0, -1.0, -1.0]), inverse.translation)
        return found

    def bodies(self) -> list[Body]:
        """Return virtual objects, then proxies, named as in ``surface_names``."""
        names, scene = surface_names(self.scene), self.scene
        items: Sequence[ObjectShape | Proxy] = (*object_shapes(scene), *scene.proxies)
        return [self._body(name, item) for name, item in zip(names, items, strict=False)]

    def _body(self, name: str, shape: ObjectShape | Proxy) -> Body:
        if isinstance(shape, Proxy):
            at = (placement(rotation_matrix(shape.rotate), np.array(shape.at)),)
            return Body(name, mesh_of(shape), (ExchangeMaterial(),), True, at)
        item = shape.item
        mesh = shape.mesh or mesh_of(item)
        materials, numbers = used_materials(item, mesh)
        colors = mesh.colors if isinstance(item.material, FileMaterial) else None
        return Body(name, mesh, materials, False, self._placements(shape), numbers, colors)

    def _placements(self, shape: ObjectShape) -> tuple[Matrix, ...]:
        """Return ``world_from_mesh`` of every frame; a single one if the shape does not move."""
        item = shape.item
        if shape.moving is not None and shape.mesh is not None:
            return tuple(part_placements(item, shape.moving, seconds)[shape.part] for seconds in self.seconds)
        times = self.seconds if item.animate is not None else (0.0,)
        return tuple(placement(item.scale * r, t) for r, t in map(item.pose_at, times))

    def light_placements(self, light: Light) -> tuple[Matrix, ...]:
        """Return ``world_from_light``, (4, 4), of every frame, for a light that shines along -z.

        A single one if it is static.
        """
        times = self.seconds if light.animate is not None else (0.0,)
        return tuple(placement(_turn_to(direction), at) for at, direction in map(light.pose_at, times))


def _turn_to(direction: Matrix) -> Matrix:
    """Return a rotation of -z to a unit direction."""
    back = -direction
    side = np.cross([0.0, 1.0, 0.0] if abs(back[1]) < 0.9 else [1.0, 0.0, 0.0], back)
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(back, side), back], axis=-1)


def mesh_of(item: Object | Proxy) -> Mesh:
    """Return the triangles of an object or a proxy, before scale and pose."""
    mesh = object_mesh(item) if isinstance(item, Object) else None
    if mesh is not None:
        return mesh
    if isinstance(item, Object) and item.shape == "sphere":
        return sphere_mesh(item.radius)
    if item.shape == "box":
        return box_mesh(item.size)
    if item.shape in ("plane", "rect"):
        return rect_mesh(item.size)
    return make_mesh(mesh_key(item))


def texture_files(scene: Scene, path: Path) -> dict[str, Path]:
    """Return the pictures stored beside a file, by body name and use."""
    found = {}
    for name, shape in zip(surface_names(scene), object_shapes(scene), strict=False):
        materials, _ = used_materials(shape.item, shape.mesh or mesh_of(shape.item))
        for (number, kind), file in texture_plan(path, name, materials).items():
            found["_".join(part for part in (name, str(number) if number else "", kind) if part)] = file
    return found


def key_frames(placements: Sequence[Matrix]) -> Sequence[Matrix]:
    """Return placements reduced to one if all are equal."""
    return placements[:1] if all(np.array_equal(one, placements[0]) for one in placements) else placements
