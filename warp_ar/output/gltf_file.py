"""Export of a shot as binary glTF 2.0 (``.glb``), with KHR_lights_punctual and EXT_lights_image_based.

glTF is y-up: the node ``shot`` rotates the marker's z-up world, and all other nodes are below it. A glTF camera has a
central principal point and square pixels except for its aspect ratio. Parameters that it cannot express, including lens
distortion, are in the camera's ``extras``; the environment's file name is in the asset's ``extras``. Intensities in
candela and lux hold camera values: a white surface that faces a light of intensity I at distance d has radiance I / (pi
d^2).

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
from trimesh.transformations import quaternion_from_matrix

from warp_ar.files import store
from warp_ar.output.shot import Body, ExchangeMaterial, Matrix, Picture, Shot, key_frames
from warp_ar.scene.description import Light
from warp_ar.scene.materials import IDENTITY
from warp_ar.signature import PROGRAM

GLTF_SUFFIX = ".glb"

_FLOAT, _INDEX = 5126, 5125
_VERTICES, _INDICES = 34962, 34963
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_Y_UP = [-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]
"""Quaternion (x, y, z, w) that rotates z up to y up."""
_EVEN = 1e-6
"""Relative difference of the axes' lengths below which a placement counts as rotation with uniform scale."""
_WRAPS = {"repeat": 10497, "clamp": 33071, "mirror": 33648}
_NEAREST, _LINEAR, _TRILINEAR = 9728, 9729, 9987
_DIELECTRIC = 0.04
"""Reflectance of non-metals at normal incidence."""


def write_glb(path: Path, shot: Shot) -> list[Path]:
    """Write a shot as glTF.

    Returns:
        The file that was written.

    Raises:
        SinkError: It cannot be written.
    """
    store(path, _Builder(shot).encode())
    return [path]


def quaternions(rotations: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return unit quaternions (x, y, z, w) of rotations (n, 3, 3), with signs chosen for continuity."""
    padded = np.tile(np.eye(4), (len(rotations), 1, 1))
    padded[:, :3, :3] = rotations
    found = np.array([np.roll(quaternion_from_matrix(matrix, isprecise=True), -1) for matrix in padded])
    found[1:] *= np.cumprod(np.where((found[1:] * found[:-1]).sum(-1) < 0.0, -1.0, 1.0))[:, None]
    return found


class _Builder:
    """Collector of nodes, accessors and binary data."""

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
        }
        self._animation: dict[str, Any] = {"name": "shot", "channels": [], "samplers": []}
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
        """Return the bytes of the file."""
        if self._animation["channels"]:
            self._tree["animations"] = [self._animation]
        self._tree["buffers"] = [{"byteLength": len(self._bytes)}]
        text = json.dumps(self._tree, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        data = bytes(self._bytes) + bytes(-len(self._bytes) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

    def _add(self, kind: str, entry: Any, *, once: bool = False) -> int:
        """Add an entry to a list of the tree and return its index; with ``once``, an equal entry is reused."""
        entries = self._tree.setdefault(kind, [])
        if once and entry in entries:
            return int(entries.index(entry))
        entries.append(entry)
        return len(entries) - 1

    def _extend(self, entry: dict[str, Any], extension: str, told: dict[str, Any]) -> None:
        self._add("extensionsUsed", extension, once=True)
        entry.setdefault("extensions", {})[extension] = told

    def _view(self, data: bytes, target: int | None = None) -> int:
        self._bytes += bytes(-len(self._bytes) % 4)
        view = {"buffer": 0, "byteOffset": len(self._bytes), "byteLength": len(data)}
        self._bytes += data
        return self._add("bufferViews", view if target is None else {**view, "target": target})

    def _accessor(self, values: npt.NDArray[Any], target: int | None = None, *, bounds: bool = False) -> int:
        values = np.ascontiguousarray(values, np.uint32 if target == _INDICES else np.float32)
        entry: dict[str, Any] = {
            "bufferView": self._view(values.tobytes(), target),
            "componentType": _INDEX if target == _INDICES else _FLOAT,
            "count": len(values),
            "type": _TYPES[1 if values.ndim == 1 else values.shape[1]],
        }
        if bounds:
            entry["min"] = np.atleast_1d(values.min(axis=0)).tolist()
            entry["max"] = np.atleast_1d(values.max(axis=0)).tolist()
        return self._add("accessors", entry)

    def _add_node(self, node: dict[str, Any], placements: dict[int, Matrix]) -> None:
        """Add a node below the root, with its placements by frame."""
        self._tree["nodes"][0]["children"].append(self._add("nodes", node))
        if not placements:
            return
        matrices = np.stack(list(placements.values()))
        lengths = np.linalg.norm(matrices[:, :3, :3], axis=1)
        moved = {"translation": matrices[:, :3, 3]}
        if np.ptp(lengths) <= _EVEN * lengths.max():
            scale = float(np.cbrt(np.linalg.det(matrices[0, :3, :3])))
            if abs(scale - 1.0) > 1e-12:
                node["scale"] = [scale] * 3
            self._set_keys(node, placements, {**moved, "rotation": quaternions(matrices[:, :3, :3] / scale)})
            return
        # Any linear map is U S V^T: a node is rotated by V^T, and a parent node in its place by U S.
        inner = {"name": f"{node['name']}_inner", "mesh": node.pop("mesh")}
        node["children"] = [self._add("nodes", inner)]
        outer, scales, turned = np.linalg.svd(matrices[:, :3, :3])
        # Both must be rotations: a reflection goes into the last scale.
        signs, turned_signs = np.sign(np.linalg.det(outer)), np.sign(np.linalg.det(turned))
        outer[:, :, 2] *= signs[:, None]
        turned[:, 2, :] *= turned_signs[:, None]
        scales[:, 2] *= signs * turned_signs
        self._set_keys(node, placements, {**moved, "rotation": quaternions(outer), "scale": scales})
        self._set_keys(inner, placements, {"rotation": quaternions(turned)})

    def _set_keys(
        self, node: dict[str, Any], placements: dict[int, Matrix], values: dict[str, npt.NDArray[Any]]
    ) -> None:
        """Set a node's placement, with keyframes if there are several."""
        node.update({path: keys[0].tolist() for path, keys in values.items()})
        if len(placements) < 2:
            return
        seconds = tuple(frame / self._shot.fps for frame in placements)
        if seconds not in self._times:
            self._times[seconds] = self._accessor(np.array(seconds), bounds=True)
        index = next(k for k, known in enumerate(self._tree["nodes"]) if known is node)
        samplers, channels = self._animation["samplers"], self._animation["channels"]
        for path, keys in values.items():
            output = self._accessor(keys)
            channels.append({"sampler": len(samplers), "target": {"node": index, "path": path}})
            samplers.append({"input": self._times[seconds], "interpolation": "LINEAR", "output": output})

    def _add_camera(self) -> None:
        camera = self._shot.camera
        lens = {
            "yfov": 2.0 * math.atan(0.5 * camera.height / camera.fy),
            "aspectRatio": camera.width / camera.fx / (camera.height / camera.fy),
            "znear": 0.01,
            "zfar": 1000.0,
        }
        extras = {
            "size": [camera.width, camera.height],
            "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
            "distortion": list(camera.distortion),
        }
        index = self._add("cameras", {"type": "perspective", "perspective": lens, "extras": extras})
        self._add_node({"name": "camera", "camera": index}, self._shot.camera_placements())

    def _add_body(self, body: Body) -> None:
        mesh = body.mesh
        attributes = {
            "POSITION": self._accessor(mesh.vertices, _VERTICES, bounds=True),
            "NORMAL": self._accessor(mesh.normals, _VERTICES),
        }
        for name, coordinates in (("TEXCOORD_0", mesh.uvs), ("TEXCOORD_1", mesh.uvs_second)):
            if coordinates is not None:
                # v points down in glTF.
                attributes[name] = self._accessor(coordinates * np.array([1.0, -1.0]) + np.array([0.0, 1.0]), _VERTICES)
        if mesh.tangents is not None and any("normal" in material.pictures for material in body.materials):
            attributes["TANGENT"] = self._accessor(mesh.tangents, _VERTICES)
        if body.colors is not None:
            attributes["COLOR_0"] = self._accessor(body.colors, _VERTICES)
        primitives = [
            {
                "attributes": attributes,
                "indices": self._accessor(mesh.faces[body.triangles_of(number)].reshape(-1), _INDICES),
                "material": self._add_material(body.name, material),
            }
            for number, material in enumerate(body.materials)
        ]
        index = self._add("meshes", {"name": body.name, "primitives": primitives})
        node = {"name": body.name, "mesh": index, "extras": {"proxy": body.proxy}}
        self._add_node(node, dict(enumerate(key_frames(body.placements))))

    def _add_material(self, name: str, material: ExchangeMaterial) -> int:
        own, textures = material.own, {kind: self._texture(picture) for kind, picture in material.pictures.items()}
        surface: dict[str, Any] = {
            "baseColorFactor": [*material.base_color, own.opacity],
            "metallicFactor": material.metallic,
            "roughnessFactor": material.roughness,
        }
        label = f"{name}_{own.name}" if own.name else name
        entry: dict[str, Any] = {"name": label, "pbrMetallicRoughness": surface, "doubleSided": own.double_sided}
        for kind, place, key, factor in (
            ("", surface, "baseColorTexture", {}),
            ("metallic_roughness", surface, "metallicRoughnessTexture", {}),
            ("normal", entry, "normalTexture", {"scale": own.normal_scale}),
            ("occlusion", entry, "occlusionTexture", {"strength": own.occlusion_strength}),
            ("emission", entry, "emissiveTexture", {}),
        ):
            if kind in textures:
                place[key] = {**textures[kind], **factor}
        if own.alpha != "opaque":
            entry["alphaMode"] = own.alpha.upper()
            entry |= {"alphaCutoff": own.cutoff} if own.alpha == "mask" else {}
        if own.unlit:
            self._extend(entry, "KHR_materials_unlit", {})
        if any(own.emission):
            # Factors are at most 1; the strength extension takes the rest.
            entry["emissiveFactor"] = _bounded(own.emission)
            if max(own.emission) > 1.0:
                self._extend(entry, "KHR_materials_emissive_strength", {"emissiveStrength": max(own.emission)})
        if material.specular is not None:
            # A factor is at most 1; the colour, which is unbounded, takes the rest.
            strength = min(1.0, max(material.specular) / _DIELECTRIC)
            color = [0.0 if strength == 0.0 else value / (_DIELECTRIC * strength) for value in material.specular]
            told = {"specularFactor": strength, "specularColorFactor": color}
            self._extend(entry, "KHR_materials_specular", told)
        return self._add("materials", entry)

    def _texture(self, picture: Picture) -> dict[str, Any]:
        """Return a reference to a picture with its sampler and texture transform; equal pictures are stored once."""
        use = picture.use
        wrap_s, wrap_t = (_WRAPS[wrap] for wrap in use.wrap)
        magnified = _NEAREST if use.nearest else _LINEAR
        sampler = {"wrapS": wrap_s, "wrapT": wrap_t, "magFilter": magnified, "minFilter": _TRILINEAR}
        digest = picture.digest
        if digest not in self._images:
            self._images[digest] = self._add_image(picture.encode())
        texture = {"source": self._images[digest], "sampler": self._add("samplers", sampler, once=True)}
        made: dict[str, Any] = {"index": self._add("textures", texture, once=True)}
        if use.uv_set:
            made["texCoord"] = use.uv_set
        if use.transform != IDENTITY:
            # v points down in glTF.
            across, up, turn, c, f = picture.placing
            offset = [c + use.transform[1], 1.0 - use.transform[4] - f]
            self._extend(made, "KHR_texture_transform", {"offset": offset, "rotation": turn, "scale": [across, up]})
        return made

    def _add_image(self, png: bytes) -> int:
        return self._add("images", {"bufferView": self._view(png), "mimeType": "image/png"})

    def _add_environment(self, radiance: npt.NDArray[np.float32]) -> None:
        from warp_ar.output.gltf_environment import EXTENSION, image_based_light

        self._extend(self._tree, EXTENSION, {"lights": [image_based_light(radiance, self._add_image)]})
        self._extend(self._tree["scenes"][0], EXTENSION, {"light": 0})

    def _add_light(self, index: int, light: Light) -> None:
        entry: dict[str, Any] = {
            "name": f"light_{index}",
            "type": light.kind,
            "color": _bounded(light.color),
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
        node: dict[str, Any] = {"name": f"light_{index}"}
        self._extend(node, "KHR_lights_punctual", {"light": len(lights) - 1})
        self._add_node(node, dict(enumerate(key_frames(self._shot.light_placements(light)))))


def _bounded(color: Sequence[float]) -> list[float]:
    """Return a colour within 0..1; its largest channel is part of the light's intensity."""
    most = max(1.0, *color)
    return [value / most for value in color]
