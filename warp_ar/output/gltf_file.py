"""A shot as binary glTF 2.0 (``.glb``), with KHR_lights_punctual and EXT_lights_image_based.

glTF is y-up: the node ``shot`` turns the marker's world, z up, and everything else stands below it as in the scene. A
camera of glTF looks at its picture's middle and has square pixels but for its aspect; what it cannot say, and the
lens's distortion, stand in its ``extras``, as does the file of the environment in those of the asset. Intensities are
told as candela and lux of camera values: a white surface that faces a light of intensity I at distance d has radiance
I / (pi d^2).

References:
    Khronos Group, "glTF 2.0 Specification", KHR_lights_punctual, KHR_materials_specular,
    KHR_materials_emissive_strength, KHR_materials_unlit, KHR_texture_transform, EXT_lights_image_based.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_ar.errors import SinkError, reason
from warp_ar.files import write_whole
from warp_ar.output.exchange_materials import ExchangeMaterial, Picture, placed_by
from warp_ar.output.shot import Body, Matrix, Shot, key_frames
from warp_ar.scene.description import Light
from warp_ar.scene.materials import RGB
from warp_ar.signature import PROGRAM

GLTF_SUFFIX = ".glb"

_FLOAT, _INDEX = 5126, 5125
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_Y_UP = [-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]
"""Quaternion, x first, that turns z up to y up."""
_EVEN = 1e-6
"""Relative difference of the axes' lengths below which a placement is a turn and one scale for all frames."""
_WRAPS = {"repeat": 10497, "clamp": 33071, "mirror": 33648}
_NEAREST, _LINEAR, _TRILINEAR = 9728, 9729, 9987
_DIELECTRIC = 0.04
"""Reflectance straight on of what is no metal."""


def write_glb(path: Path, shot: Shot) -> list[Path]:
    """Write a shot as glTF.

    Returns:
        The file that was written.

    Raises:
        SinkError: It cannot be written.
    """
    builder = _Builder(shot)
    try:
        write_whole(path, builder.encode())
    except OSError as error:
        raise SinkError(f"{path} cannot be written: {reason(error)}") from error
    return [path]


def quaternions(rotations: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Unit quaternions, x first, of rotations (n, 3, 3), each on the side of the one before.

    The largest of the four components is found from the diagonal, the others by it [Shepperd 1978].
    """
    r = rotations
    trace = np.trace(r, axis1=1, axis2=2)
    squares = np.stack([1 + 2 * np.diagonal(r, axis1=1, axis2=2)[:, k] - trace for k in range(3)] + [1 + trace], -1)
    sums = {(0, 1): r[:, 0, 1] + r[:, 1, 0], (0, 2): r[:, 0, 2] + r[:, 2, 0], (1, 2): r[:, 1, 2] + r[:, 2, 1]}
    differences = (r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1])
    products = np.empty((len(r), 4, 4))
    for k in range(4):
        products[:, k, k] = squares[:, k]
    for (a, b), values in sums.items():
        products[:, a, b] = products[:, b, a] = values
    for k, values in enumerate(differences):
        products[:, k, 3] = products[:, 3, k] = values
    found = np.take_along_axis(products, squares.argmax(-1)[:, None, None], 1)[:, 0]
    found /= np.linalg.norm(found, axis=-1, keepdims=True)
    for k in range(1, len(found)):
        if found[k] @ found[k - 1] < 0.0:
            found[k] = -found[k]
    return found


class _Builder:
    """Collects nodes, accessors and bytes."""

    def __init__(self, shot: Shot) -> None:
        self._shot = shot
        self._bytes = bytearray()
        extras: dict[str, Any] = {"plate": None if shot.plate is None else shot.plate.as_posix(), "fps": shot.fps}
        if shot.environment is not None:
            extras["environment"] = shot.environment.name
        if shot.others:
            extras["other_environments"] = [{"file": file.name, "at": list(at)} for file, at in shot.others]
        self._tree: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": PROGRAM, "extras": extras},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"name": "shot", "rotation": _Y_UP, "children": []}],
            "bufferViews": [],
            "accessors": [],
            "extensionsUsed": [],
        }
        self._channels: list[dict[str, Any]] = []
        self._samplers: list[dict[str, Any]] = []
        self._times: dict[tuple[float, ...], int] = {}
        self._images: dict[bytes, int] = {}
        self._add_camera()
        for body in shot.bodies():
            self._add_body(body)
        for index, light in enumerate(shot.scene.lights):
            self._add_light(index, light)
        if shot.radiance is not None:
            self._add_environment(shot.radiance)

    def encode(self) -> bytes:
        """The file."""
        tree = self._tree
        if self._channels:
            tree["animations"] = [{"name": "shot", "channels": self._channels, "samplers": self._samplers}]
        if not tree["extensionsUsed"]:
            del tree["extensionsUsed"]
        tree["buffers"] = [{"byteLength": len(self._bytes)}]
        text = json.dumps(tree, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        data = bytes(self._bytes) + bytes(-len(self._bytes) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

    def _view(self, data: bytes, target: int | None = None) -> int:
        self._bytes += bytes(-len(self._bytes) % 4)
        view = {"buffer": 0, "byteOffset": len(self._bytes), "byteLength": len(data)}
        self._tree["bufferViews"].append(view if target is None else {**view, "target": target})
        self._bytes += data
        return len(self._tree["bufferViews"]) - 1

    def _accessor(self, values: npt.NDArray[Any], *, indices: bool = False, bounds: bool = False) -> int:
        values = np.ascontiguousarray(values, np.uint32 if indices else np.float32)
        lanes = 1 if values.ndim == 1 else values.shape[1]
        target = 34963 if indices else 34962 if lanes > 1 and not bounds else None
        entry: dict[str, Any] = {
            "bufferView": self._view(values.tobytes(), target),
            "componentType": _INDEX if indices else _FLOAT,
            "count": len(values),
            "type": _TYPES[lanes],
        }
        if bounds:
            entry["min"], entry["max"] = (
                np.atleast_1d(values.min(axis=0)).tolist(),
                np.atleast_1d(values.max(axis=0)).tolist(),
            )
        self._tree["accessors"].append(entry)
        return len(self._tree["accessors"]) - 1

    def _use(self, extension: str) -> None:
        if extension not in self._tree["extensionsUsed"]:
            self._tree["extensionsUsed"].append(extension)

    def _add_node(self, node: dict[str, Any], placements: dict[int, Matrix]) -> None:
        """A node below the root, placed by its frames."""
        index = len(self._tree["nodes"])
        self._tree["nodes"][0]["children"].append(index)
        self._tree["nodes"].append(node)
        if not placements:
            return
        matrices = np.stack(list(placements.values()))
        lengths = np.linalg.norm(matrices[:, :3, :3], axis=1)
        if np.ptp(lengths) > _EVEN * lengths.max():
            self._place_stretched(index, node, placements, matrices)
            return
        scale = np.cbrt(np.linalg.det(matrices[0, :3, :3]))
        turns = quaternions(matrices[:, :3, :3] / scale)
        node["translation"], node["rotation"] = matrices[0, :3, 3].tolist(), turns[0].tolist()
        if abs(scale - 1.0) > 1e-12:
            node["scale"] = [float(scale)] * 3
        self._add_keys(index, placements, {"translation": matrices[:, :3, 3], "rotation": turns})

    def _add_keys(self, index: int, placements: dict[int, Matrix], values: dict[str, npt.NDArray[Any]]) -> None:
        """Keyframes of a node, if it has more than one placement."""
        if len(placements) < 2:
            return
        times = self._time_accessor(tuple(frame / self._shot.fps for frame in placements))
        for path, keys in values.items():
            self._samplers.append({"input": times, "interpolation": "LINEAR", "output": self._key_values(keys)})
            self._channels.append({"sampler": len(self._samplers) - 1, "target": {"node": index, "path": path}})

    def _place_stretched(
        self, index: int, node: dict[str, Any], placements: dict[int, Matrix], matrices: npt.NDArray[np.float64]
    ) -> None:
        """Any linear map is U S V^T: a node turns by V^T, and one above it, in its place in the tree, by U S."""
        inner = {key: node.pop(key) for key in ("mesh",) if key in node}
        self._tree["nodes"].append({"name": f"{node['name']}_inner", **inner})
        child = len(self._tree["nodes"]) - 1
        node["children"] = [child]
        outer, scales, turned = np.linalg.svd(matrices[:, :3, :3])
        # Both must be rotations: a mirror goes into the last scale.
        for way in (outer, turned):
            mirrored = np.linalg.det(way) < 0.0
            scales[mirrored, 2] *= -1.0
            if way is outer:
                way[mirrored, :, 2] *= -1.0
            else:
                way[mirrored, 2, :] *= -1.0
        values = {"translation": matrices[:, :3, 3], "rotation": quaternions(outer), "scale": scales}
        turns = quaternions(turned)
        node.update({key: keys[0].tolist() for key, keys in values.items()})
        self._tree["nodes"][child]["rotation"] = turns[0].tolist()
        self._add_keys(index, placements, values)
        self._add_keys(child, placements, {"rotation": turns})

    def _time_accessor(self, seconds: tuple[float, ...]) -> int:
        if seconds not in self._times:
            self._times[seconds] = self._accessor(np.array(seconds), bounds=True)
        return self._times[seconds]

    def _key_values(self, values: npt.NDArray[Any]) -> int:
        values = np.ascontiguousarray(values, np.float32)
        self._tree["accessors"].append(
            {
                "bufferView": self._view(values.tobytes()),
                "componentType": _FLOAT,
                "count": len(values),
                "type": _TYPES[values.shape[1]],
            }
        )
        return len(self._tree["accessors"]) - 1

    def _add_camera(self) -> None:
        camera = self._shot.camera
        self._tree["cameras"] = [
            {
                "type": "perspective",
                "perspective": {
                    "yfov": 2.0 * math.atan(0.5 * camera.height / camera.fy),
                    "aspectRatio": camera.width / camera.fx / (camera.height / camera.fy),
                    "znear": 0.01,
                    "zfar": 1000.0,
                },
                "extras": {
                    "size": [camera.width, camera.height],
                    "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
                    "distortion": list(camera.distortion),
                },
            }
        ]
        self._add_node({"name": "camera", "camera": 0}, self._shot.camera_placements())

    def _add_body(self, body: Body) -> None:
        mesh = body.mesh
        attributes = {
            "POSITION": self._positions(mesh.vertices),
            "NORMAL": self._accessor(mesh.normals),
        }
        for name, coordinates in (("TEXCOORD_0", mesh.uvs), ("TEXCOORD_1", mesh.uvs_second)):
            if coordinates is not None:
                # v runs down the picture.
                attributes[name] = self._accessor(coordinates * np.array([1.0, -1.0]) + np.array([0.0, 1.0]))
        if mesh.tangents is not None and any(material.normal is not None for material in body.materials):
            attributes["TANGENT"] = self._accessor(mesh.tangents)
        if body.colors is not None:
            attributes["COLOR_0"] = self._accessor(body.colors)
        primitives = [
            {
                "attributes": attributes,
                "indices": self._accessor(mesh.faces[body.triangles_of(number)].reshape(-1), indices=True),
                "material": self._add_material(body.name, material),
            }
            for number, material in enumerate(body.materials)
        ]
        self._tree.setdefault("meshes", []).append({"name": body.name, "primitives": primitives})
        node = {"name": body.name, "mesh": len(self._tree["meshes"]) - 1, "extras": {"proxy": body.proxy}}
        self._add_node(node, dict(enumerate(key_frames(body.placements))))

    def _positions(self, vertices: npt.NDArray[np.float32]) -> int:
        index = self._accessor(vertices, bounds=True)
        self._tree["bufferViews"][self._tree["accessors"][index]["bufferView"]]["target"] = 34962
        return index

    def _add_material(self, name: str, material: ExchangeMaterial) -> int:
        surface: dict[str, Any] = {
            "baseColorFactor": [*material.base_color, material.opacity],
            "metallicFactor": material.metallic,
            "roughnessFactor": material.roughness,
        }
        label = f"{name}_{material.name}" if material.name else name
        entry: dict[str, Any] = {"name": label, "pbrMetallicRoughness": surface, "doubleSided": material.double_sided}
        if material.texture is not None:
            surface["baseColorTexture"] = self._add_texture(material.texture)
        if material.metallic_roughness is not None:
            surface["metallicRoughnessTexture"] = self._add_texture(material.metallic_roughness)
        if material.normal is not None:
            entry["normalTexture"] = {**self._add_texture(material.normal), "scale": material.normal_scale}
        if material.occlusion is not None:
            strength = material.occlusion_strength
            entry["occlusionTexture"] = {**self._add_texture(material.occlusion), "strength": strength}
        if material.alpha != "opaque":
            entry["alphaMode"] = material.alpha.upper()
            entry |= {"alphaCutoff": material.cutoff} if material.alpha == "mask" else {}
        if material.unlit:
            self._use("KHR_materials_unlit")
            entry.setdefault("extensions", {})["KHR_materials_unlit"] = {}
        if any(material.emission):
            self._add_emission(entry, material)
        if material.specular is not None:
            self._add_specular(entry, material.specular)
        self._tree.setdefault("materials", []).append(entry)
        return len(self._tree["materials"]) - 1

    def _add_specular(self, entry: dict[str, Any], specular: RGB) -> None:
        """A factor goes to 1 at most; what is beyond is the colour's, which may be any."""
        self._use("KHR_materials_specular")
        factor = max(specular) / _DIELECTRIC
        strength = min(1.0, factor)
        color = [0.0 if strength == 0.0 else value / (_DIELECTRIC * strength) for value in specular]
        told = {"specularFactor": strength, "specularColorFactor": color}
        entry.setdefault("extensions", {})["KHR_materials_specular"] = told

    def _add_texture(self, picture: Picture) -> dict[str, Any]:
        """A reference to a picture with its sampler and its place; equal pictures are held once."""
        wraps = [_WRAPS[wrap] for wrap in picture.wrap]
        magnified = _NEAREST if picture.nearest else _LINEAR
        sampler = {"wrapS": wraps[0], "wrapT": wraps[1], "magFilter": magnified, "minFilter": _TRILINEAR}
        samplers = self._tree.setdefault("samplers", [])
        if sampler not in samplers:
            samplers.append(sampler)
        if picture.digest not in self._images:
            self._images[picture.digest] = self._add_image(picture.encode())
        texture = {"source": self._images[picture.digest], "sampler": samplers.index(sampler)}
        textures = self._tree.setdefault("textures", [])
        if texture not in textures:
            textures.append(texture)
        made: dict[str, Any] = {"index": textures.index(texture)}
        if picture.uv_set:
            made["texCoord"] = picture.uv_set
        if placed := placed_by(picture):
            self._use("KHR_texture_transform")
            made["extensions"] = {"KHR_texture_transform": placed}
        return made

    def _add_emission(self, entry: dict[str, Any], material: ExchangeMaterial) -> None:
        """Factors go to 1 at most; what is beyond is the strength's."""
        entry["emissiveFactor"] = list(_bounded(material.emission))
        if material.glow is not None:
            entry["emissiveTexture"] = self._add_texture(material.glow)
        if max(material.emission) > 1.0:
            self._use("KHR_materials_emissive_strength")
            strength = {"emissiveStrength": max(material.emission)}
            entry.setdefault("extensions", {})["KHR_materials_emissive_strength"] = strength

    def _add_image(self, png: bytes) -> int:
        self._tree.setdefault("images", []).append({"bufferView": self._view(png), "mimeType": "image/png"})
        return len(self._tree["images"]) - 1

    def _add_environment(self, radiance: npt.NDArray[np.float32]) -> None:
        from warp_ar.output.gltf_environment import EXTENSION, image_based_light  # here, for it loads Warp

        self._use(EXTENSION)
        lights = [image_based_light(radiance, self._add_image)]
        self._tree.setdefault("extensions", {})[EXTENSION] = {"lights": lights}
        self._tree["scenes"][0]["extensions"] = {EXTENSION: {"light": 0}}

    def _add_light(self, index: int, light: Light) -> None:
        self._use("KHR_lights_punctual")
        entry: dict[str, Any] = {
            "name": f"light_{index}",
            "type": light.kind,
            "color": list(_bounded(light.color)),
            "intensity": light.intensity * max(1.0, *light.color),
        }
        if light.kind == "spot":
            outer = min(math.radians(light.outer_angle), math.pi / 2.0)
            inner = min(math.radians(light.inner_angle), outer - 1e-6)
            entry["spot"] = {"innerConeAngle": max(0.0, inner), "outerConeAngle": outer}
        if light.radius or light.attenuation != (0.0, 0.0, 1.0):
            entry["extras"] = {"radius": light.radius, "attenuation": list(light.attenuation)}
        lights = self._tree.setdefault("extensions", {}).setdefault("KHR_lights_punctual", {"lights": []})["lights"]
        lights.append(entry)
        node = {"name": f"light_{index}", "extensions": {"KHR_lights_punctual": {"light": len(lights) - 1}}}
        self._add_node(node, dict(enumerate(key_frames(self._shot.light_placements(light)))))


def _bounded(color: Sequence[float]) -> Sequence[float]:
    """A colour within 0..1; the light's intensity has taken its largest channel."""
    most = max(1.0, *color)
    return [value / most for value in color]
