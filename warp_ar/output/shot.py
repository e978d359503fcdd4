"""A shot as other programs take it: the camera's way and lens, surfaces with their materials and motion, lights.

Lengths are metres, angles radians but where a name says degrees, the world is the marker's, z up. Radiance is in camera
values: 1 is where the camera clips. Exchange formats know fewer materials than scenes do; ``ExchangeMaterial`` is what
all of them can say.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_ar.output.exchange_materials import ExchangeMaterial, texture_plan, used_materials, vertex_colors
from warp_ar.scene import Camera, Pose, Scene
from warp_ar.scene.description import Light, Object, Proxy
from warp_ar.scene.geometry import Mesh, make_mesh, rotation_matrix
from warp_ar.scene.mesh_cache import load_kept_mesh
from warp_ar.scene.names import surface_names
from warp_ar.scene.object_shapes import ObjectShape, object_shapes, part_placements
from warp_ar.scene.shapes import box_mesh, disk_mesh, sphere_mesh, torus_mesh, tube_mesh

Matrix = npt.NDArray[np.float64]

FILM_WIDTH = 0.036
"""Metres of film that lenses are told for: 36 mm. Only its ratio to the focal length matters to a picture."""


@dataclasses.dataclass(frozen=True)
class Body:
    """A surface of the shot."""

    name: str
    mesh: Mesh
    materials: tuple[ExchangeMaterial, ...]
    """Materials that its triangles have, one or more."""
    proxy: bool
    """Physical: it is in the plate and only receives light and shadow."""
    placements: tuple[Matrix, ...]
    """``world_from_mesh``, (4, 4), of every frame; one where it stands still."""
    numbers: npt.NDArray[np.int64] | None = None
    """Which of ``materials`` each triangle has, (m,); None: all the first."""
    colors: npt.NDArray[np.float32] | None = None
    """Factors of base colour and alpha at vertices, (n, 4), linear."""

    def triangles_of(self, number: int) -> npt.NDArray[np.int64]:
        """Which triangles have a material."""
        if self.numbers is None:
            return np.arange(len(self.mesh.faces))
        return np.flatnonzero(self.numbers == number)


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
        if isinstance(shape, Proxy):
            at = (placement(rotation_matrix(shape.rotate), np.array(shape.at)),)
            return Body(name, mesh_of(shape), (ExchangeMaterial(),), True, at)
        item = shape.item
        mesh = shape.mesh or mesh_of(item)
        materials, numbers = used_materials(item, mesh)
        return Body(name, mesh, materials, False, self._placements(shape), numbers, vertex_colors(item, mesh))

    def _placements(self, shape: ObjectShape) -> tuple[Matrix, ...]:
        """``world_from_mesh`` of every frame; one where it stands still."""
        item = shape.item
        if shape.moving is not None and shape.mesh is not None:
            return tuple(part_placements(item, shape.moving, seconds)[shape.part] for seconds in self.seconds)
        times = self.seconds if item.animate is not None else (0.0,)
        return tuple(placement(item.scale * r, t) for r, t in map(item.pose_at, times))

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


def texture_files(scene: Scene, path: Path) -> dict[str, Path]:
    """Pictures that go beside a file, by the names of their bodies and what they are of."""
    found = {}
    for name, shape in zip(surface_names(scene), object_shapes(scene), strict=False):
        materials, _ = used_materials(shape.item, shape.mesh or mesh_of(shape.item))
        for (number, kind), file in texture_plan(path, name, materials).items():
            found["_".join(part for part in (name, str(number) if number else "", kind) if part)] = file
    return found


def key_frames(placements: Sequence[Matrix]) -> Sequence[Matrix]:
    """Placements without repetition: one if all are equal."""
    return placements[:1] if all(np.array_equal(one, placements[0]) for one in placements) else placements
