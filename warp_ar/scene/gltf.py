"""glTF 2.0 and GLB: nodes, meshes, primitives, materials and pictures.

Read here and not through trimesh, which drops samplers, texture transforms, the second set of texture coordinates,
vertex colours beside a texture, and the strength of emission.

References:
    Khronos, glTF 2.0 specification; appendix A has what is said of skins and morph targets.
"""

from __future__ import annotations

import dataclasses
import struct
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.errors import SceneError
from warp_ar.files import limits, too_much
from warp_ar.pictures import decode_picture, picture_size
from warp_ar.scene.gltf_animation import animation_names, moves_morph_targets, read_animation
from warp_ar.scene.gltf_arrays import GltfArrays
from warp_ar.scene.gltf_materials import SUPPORTED, GltfMaterials
from warp_ar.scene.mesh_assets import Assets, fail, image_bytes, objects, read_gltf
from warp_ar.scene.mesh_parts import LARGEST, MeshPart
from warp_ar.scene.node_animation import Anchor, NodeTrack
from warp_ar.scene.texture_codes import encode_texture

_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_UP: Final = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""From +Y up to +Z up."""
_MOST_IMAGES: Final = 4
"""Largest number of pixels of all pictures together, in pictures of the largest size."""
_MOST_PLACES: Final = 20_000
"""Nodes of a file, and primitives that they place, at most."""
_COMPRESSED: Final = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")


@dataclasses.dataclass
class GltfContents:
    """What a file holds, in its world turned to +Z up."""

    parts: list[MeshPart]
    """Triangles, one part per primitive and place."""
    images: list[npt.NDArray[np.uint8]]
    """Pictures that materials name, RGBA."""
    notes: list[str]
    """What is not shown."""
    carriers: list[int] = dataclasses.field(default_factory=list)
    """Number of the anchor that each part hangs on, and in whose coordinates it is; -1: in the world."""
    anchors: tuple[Anchor, ...] = ()
    """Nodes that the animation moves."""
    duration: float = 0.0
    """Of the animation, in seconds."""


def load_gltf(path: Path, data: bytes, assets: Assets, *, animation: str | int | None = None) -> GltfContents:
    """Read the triangles of a file's scene, with materials.

    Args:
        path: The file, for messages.
        data: Its bytes.
        assets: Finds the files that it names.
        animation: Name or number of the animation that is to move it; None: all stands as at the start.

    Raises:
        SceneError: It is damaged, too large, names what is missing, or cannot be read without an extension.
    """
    return _Reader(path, data, assets).contents(animation)


@dataclasses.dataclass
class _Rig:
    """What an animation moves."""

    anchors: list[Anchor] = dataclasses.field(default_factory=list)
    places: dict[int, tuple[int, npt.NDArray[np.float64]]] = dataclasses.field(default_factory=dict)
    """By node that moves: its anchor, and its transform below that."""
    below: dict[int, tuple[int, npt.NDArray[np.float64]]] = dataclasses.field(default_factory=dict)
    """Likewise of all nodes; those that stand still have anchor -1."""
    duration: float = 0.0


class _Reader:
    """Walks one file."""

    def __init__(self, path: Path, data: bytes, assets: Assets) -> None:
        self._path, self._assets = path, assets
        self._header, self._buffers = read_gltf(path, data, assets)
        self._arrays = GltfArrays(path, self._header, self._buffers)
        self._materials = GltfMaterials(path, self._header, self._take_image, self._note)
        self._nodes, self._meshes, self._skins = (
            objects(path, self._header, key) for key in ("nodes", "meshes", "skins")
        )
        self._primitives: dict[tuple[int, int], MeshPart | None] = {}
        self._images: dict[int, int] = {}
        self._decoded: list[npt.NDArray[np.uint8]] = []
        self._pixels = self._elements = 0
        self._notes: dict[str, None] = {}
        self._parents: dict[int, int] = {}

    def contents(self, animation: str | int | None) -> GltfContents:
        """All that the scene shows."""
        self._look_at_extensions()
        if animation is None and animation_names(self._path, self._header):
            self._note("animations (an object's key play names one)")
        if objects(self._path, self._header, "cameras"):
            self._note("cameras")
        if len(self._nodes) > _MOST_PLACES:
            fail(self._path, f"it has {len(self._nodes):,} nodes; at most {_MOST_PLACES:,} are read: join them")
        parts: list[MeshPart] = []
        world = self._world_transforms()
        shown = [node["mesh"] for index in world if "mesh" in (node := self._nodes[index])]
        places = sum(
            len(objects(self._path, self._meshes[number], "primitives"))
            for number in self._indices(shown, "nodes' meshes", len(self._meshes))
        )
        if places > _MOST_PLACES:
            fail(self._path, f"its nodes place {places:,} primitives; at most {_MOST_PLACES:,} are read: join them")
        rig = _Rig() if animation is None else self._rig(animation, world)
        carriers: list[int] = []
        for index, transform in world.items():
            node = self._nodes[index]
            if "mesh" in node:
                place = rig.places.get(index)
                if "skin" in node:
                    place = None
                parts += self._mesh(node, _UP @ transform if place is None else place[1], world)
                carriers += [-1 if place is None else place[0]] * (len(parts) - len(carriers))
        self._note_still([self._nodes[index] for index in world], animation)
        return GltfContents(parts, self._decoded, list(self._notes), carriers, tuple(rig.anchors), rig.duration)

    def _note(self, what: str) -> None:
        self._notes.setdefault(what)

    def _note_still(self, shown: list[dict[str, Any]], animation: str | int | None) -> None:
        """Say, once for both, that skins and morph targets do not move, where an animation would have them do so."""
        animated = bool(animation_names(self._path, self._header))
        skins = animated and any("skin" in node and "mesh" in node for node in shown)
        morphs = animated and moves_morph_targets(self._path, self._header, animation)
        if still := [name for name, there in (("skins", skins), ("morph targets", morphs)) if there]:
            self._note(f"movement of {' and '.join(still)} (they stand as at the start)")

    def _look_at_extensions(self) -> None:
        used, required = (self._header.get(key, []) for key in ("extensionsUsed", "extensionsRequired"))
        if not isinstance(used, list) or not isinstance(required, list):
            fail(self._path, "extensionsUsed or extensionsRequired is no list")
        for name in required:
            if name in _COMPRESSED:
                fail(self._path, f"it is compressed with {name}; save it without compression")
        # A file should list all that it uses; what a material has and the list lacks is left out as well.
        own = [item.get("extensions") for item in objects(self._path, self._header, "materials")]
        found = [name for table in own if isinstance(table, dict) for name in table]
        for name in dict.fromkeys(str(name)[:60] for name in [*used, *required, *found]):
            if name not in SUPPORTED:
                self._note(name)

    # ---- nodes ---------------------------------------------------------------------------------------------------

    def _indices(self, value: object, what: str, count: int) -> list[int]:
        if value is None:
            return []
        if not isinstance(value, list):
            fail(self._path, f"{what} are {str(value)[:30]!r}; a list of numbers is right")
        for entry in value:
            if isinstance(entry, bool) or not isinstance(entry, int) or not 0 <= entry < count:
                fail(self._path, f"{what} hold {str(entry)[:20]}; there are {count}, counted from 0")
        return value

    def _world_transforms(self) -> dict[int, npt.NDArray[np.float64]]:
        """Transform of every node of the scene that is shown, (4, 4)."""
        scenes = objects(self._path, self._header, "scenes")
        number = self._header.get("scene", 0)
        if scenes:
            (number,) = self._indices([number], "the scene's number", len(scenes))
            waiting = [(node, np.eye(4)) for node in self._roots(scenes[number])]
        else:
            count = len(self._nodes)
            children = {
                child for node in self._nodes for child in self._indices(node.get("children"), "children", count)
            }
            waiting = [(node, np.eye(4)) for node in range(len(self._nodes)) if node not in children]
            if self._nodes and not waiting:
                fail(self._path, "its nodes stand below each other in a circle")
        found: dict[int, npt.NDArray[np.float64]] = {}
        waiting.reverse()
        while waiting:
            index, parent = waiting.pop()
            if index in found:
                fail(self._path, f"node {index} is reached twice: nodes form no tree")
            node = self._nodes[index]
            local = self._local(node, index)
            with np.errstate(invalid="ignore", over="ignore"):
                found[index] = parent @ local
            if not (np.abs(found[index]) < LARGEST).all():
                fail(self._path, f"node {index} has a transform that is not finite, or above {LARGEST:g}")
            children_of = self._indices(node.get("children"), f"children of node {index}", len(self._nodes))
            self._parents.update(dict.fromkeys(children_of, index))
            waiting += [(child, found[index]) for child in reversed(children_of)]
        return found

    def _roots(self, scene: dict[str, Any]) -> list[int]:
        return self._indices(scene.get("nodes"), "the scene's nodes", len(self._nodes))

    def _numbers(self, node: dict[str, Any], index: int, key: str, default: list[float]) -> npt.NDArray[np.float64]:
        value = node.get(key, default)
        sound = isinstance(value, list) and len(value) == len(default)
        if not sound or any(isinstance(v, bool) or not isinstance(v, int | float) for v in value):
            fail(self._path, f"node {index} has {key} {str(value)[:30]!r}; {len(default)} numbers are right")
        return np.array([float(v) if abs(v) < LARGEST else np.inf for v in value])

    def _local(self, node: dict[str, Any], index: int) -> npt.NDArray[np.float64]:
        if "matrix" in node:
            return self._numbers(node, index, "matrix", [0.0] * 16).reshape(4, 4).T
        with np.errstate(invalid="ignore", over="ignore"):  # the caller asks whether it is finite
            return self._track(node, index).transform_at(0.0)

    def _track(self, node: dict[str, Any], index: int) -> NodeTrack:
        """A node's translation, rotation and scale."""
        rotation = self._numbers(node, index, "rotation", [0.0, 0.0, 0.0, 1.0])
        length = float(np.sqrt((rotation * rotation).sum()))
        if not 0.0 < length < np.inf:
            fail(self._path, f"node {index} has a rotation without length")
        scale = self._numbers(node, index, "scale", [1.0, 1.0, 1.0])
        return NodeTrack(self._numbers(node, index, "translation", [0.0, 0.0, 0.0]), rotation / length, scale, {})

    def _rig(self, wanted: str | int, world: dict[int, npt.NDArray[np.float64]]) -> _Rig:
        """The nodes that an animation moves, and what hangs on them."""
        animation = read_animation(self._path, self._header, self._arrays, wanted, self._note)
        rig = _Rig(duration=animation.duration)
        numbers: dict[int, int] = {}
        for index in world:  # each after its parent
            carrier, below = rig.below.get(self._parents.get(index, -1), (-1, _UP))
            node, samplers = self._nodes[index], animation.samplers.get(index)
            if samplers is None:
                rig.below[index] = carrier, below @ self._local(node, index)
            else:
                if "matrix" in node:
                    fail(self._path, f"an animation moves node {index}, which has a matrix; translation, rotation and "
                         "scale are right")  # fmt: skip
                track = dataclasses.replace(self._track(node, index), samplers=samplers)
                numbers[index] = len(rig.anchors)
                rig.anchors.append(Anchor(carrier, below, track))
                rig.below[index] = numbers[index], np.eye(4)
            if rig.below[index][0] >= 0:
                rig.places[index] = rig.below[index]
        return rig

    # ---- meshes --------------------------------------------------------------------------------------------------

    def _mesh(
        self, node: dict[str, Any], transform: npt.NDArray[np.float64], world: dict[int, npt.NDArray[np.float64]]
    ) -> list[MeshPart]:
        (number,) = self._indices([node["mesh"]], "a node's mesh", len(self._meshes))
        primitives = objects(self._path, self._meshes[number], "primitives")
        parts = []
        for primitive in primitives:
            if primitive.get("mode", _TRIANGLES) not in (_TRIANGLES, _STRIP, _FAN):
                self._note("points and lines")
                continue
            # The same triangles may stand at thousands of nodes.
            alike = "weights" not in node
            key = (number, id(primitive))
            if not alike or key not in self._primitives:
                self._primitives[key] = self._primitive(primitive, self._meshes[number], node)
            part = self._primitives[key] if alike else self._primitives.pop(key)
            if part is None:
                continue
            self._elements += len(part.faces)
            if self._elements > limits().mesh_elements:
                raise SceneError(too_much(f"{self._path}", self._elements, "faces", "mesh_elements"))
            bones = self._bones(node, primitive, world) if "skin" in node else None
            # A skinned mesh stands where its joints are, whatever its own node says.
            moved = part.moved(transform) if bones is None else part.bent(np.einsum("ij,njk->nik", _UP, bones))
            if moved is not None:
                parts.append(moved)
        return parts

    def _primitive(self, primitive: dict[str, Any], mesh: dict[str, Any], node: dict[str, Any]) -> MeshPart | None:
        attributes = primitive.get("attributes")
        if not isinstance(attributes, dict):
            fail(self._path, "a primitive has no attributes")
        if "POSITION" not in attributes:
            self._note("primitives without positions")
            return None
        vertices = np.asarray(self._arrays.read(attributes["POSITION"], "POSITION", (3,)), dtype=np.float64)
        count = len(vertices)

        def attribute(name: str, *widths: int) -> npt.NDArray[np.float64] | None:
            if name not in attributes:
                return None
            values = self._arrays.read(attributes[name], name, widths)
            if len(values) != count:
                fail(self._path, f"{name} has {len(values)} elements, POSITION {count}")
            return np.asarray(values, dtype=np.float64)

        vertices, normals = self._morphed(primitive, mesh, node, vertices, attribute("NORMAL", 3))
        colors = attribute("COLOR_0", 3, 4)
        if colors is not None and colors.shape[1] == 3:
            colors = np.concatenate([colors, np.ones((count, 1))], axis=1)
        faces = self._faces(primitive, count)
        if len(faces) > limits().mesh_elements:
            raise SceneError(too_much(f"{self._path}", len(faces), "faces", "mesh_elements"))
        if not len(faces):
            return None
        return MeshPart.checked(
            f"{self._path}",
            vertices,
            faces,
            normals,
            uvs=(_upward(attribute("TEXCOORD_0", 2)), _upward(attribute("TEXCOORD_1", 2))),
            colors=None if colors is None else np.clip(colors, 0.0, 1.0),
            tangents=attribute("TANGENT", 4),
            material=self._materials.read(primitive.get("material")),
            crease=0.0,  # "When normals are not specified, client implementations MUST calculate flat normals"
        )

    def _faces(self, primitive: dict[str, Any], count: int) -> npt.NDArray[np.int64]:
        if "indices" in primitive:
            indices = self._arrays.read(primitive["indices"], "indices", (1,))[:, 0]
            if indices.dtype.kind != "u":
                fail(self._path, "indices are no whole numbers without sign")
            indices = indices.astype(np.int64)
            if len(indices) and int(indices.max()) >= count:
                raise SceneError(
                    f"{self._path}: a face has vertex index {int(indices.max())}; there are {count} vertices from 0 on"
                )
        else:
            indices = np.arange(count, dtype=np.int64)
        mode = primitive.get("mode", _TRIANGLES)
        if mode == _TRIANGLES:
            return indices[: len(indices) // 3 * 3].reshape(-1, 3)
        if len(indices) < 3:
            return np.zeros((0, 3), np.int64)
        a, b, c = indices[:-2], indices[1:-1], indices[2:]
        if mode == _FAN:
            return np.stack([np.broadcast_to(indices[0], b.shape), b, c], axis=-1)
        odd = np.arange(len(a)) % 2 == 1
        return np.stack([a, np.where(odd, c, b), np.where(odd, b, c)], axis=-1)

    def _morphed(
        self,
        primitive: dict[str, Any],
        mesh: dict[str, Any],
        node: dict[str, Any],
        vertices: npt.NDArray[np.float64],
        normals: npt.NDArray[np.float64] | None,
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64] | None]:
        """Vertices moved by morph targets at the weights that the file starts with."""
        targets = objects(self._path, primitive, "targets")
        weights = node.get("weights", mesh.get("weights"))
        if not targets or not isinstance(weights, list):
            return vertices, normals
        for weight, target in zip(weights, targets, strict=False):
            if isinstance(weight, bool) or not isinstance(weight, int | float) or not abs(weight) < LARGEST:
                fail(self._path, f"a morph target has the weight {str(weight)[:20]!r}, which is no finite number")
            for name, values in (("POSITION", vertices), ("NORMAL", normals)):
                if weight and name in target and values is not None:
                    delta = self._arrays.read(target[name], f"{name} of a morph target", (3,))
                    if len(delta) != len(values):
                        fail(self._path, f"{name} of a morph target has {len(delta)} elements, not {len(values)}")
                    moved = values + weight * np.asarray(delta, dtype=np.float64)
                    vertices, normals = (moved, normals) if name == "POSITION" else (vertices, moved)
        return vertices, normals

    def _bones(
        self,
        node: dict[str, Any],
        primitive: dict[str, Any],
        world: dict[int, npt.NDArray[np.float64]],
    ) -> npt.NDArray[np.float64] | None:
        """Transform of each vertex by the joints as they stand, (n, 4, 4); None: nothing says which."""
        (number,) = self._indices([node["skin"]], "a node's skin", len(self._skins))
        skin, attributes = self._skins[number], primitive["attributes"]
        joints = self._indices(skin.get("joints"), "joints of a skin", len(self._nodes))
        if not joints or "JOINTS_0" not in attributes or "WEIGHTS_0" not in attributes:
            return None
        if "JOINTS_1" in attributes:
            self._note("joints beyond four per vertex")
        inverse = np.tile(np.eye(4), (len(joints), 1, 1))
        if "inverseBindMatrices" in skin:
            values = self._arrays.read(skin["inverseBindMatrices"], "inverseBindMatrices", (16,))
            if len(values) < len(joints):
                fail(self._path, f"a skin has {len(joints)} joints and {len(values)} inverse bind matrices")
            inverse = values[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1)
        count = len(self._arrays.read(attributes["POSITION"], "POSITION", (3,)))
        places = self._arrays.read(attributes["JOINTS_0"], "JOINTS_0", (4,))
        weights = np.asarray(self._arrays.read(attributes["WEIGHTS_0"], "WEIGHTS_0", (4,)), dtype=np.float64)
        if len(places) != count or len(weights) != count or places.dtype.kind != "u":
            fail(self._path, f"JOINTS_0 and WEIGHTS_0 are not of {count} vertices")
        if count and int(places.max()) >= len(joints):
            fail(self._path, f"JOINTS_0 holds {int(places.max())}; the skin has {len(joints)} joints, from 0 on")
        bones = np.stack([world.get(joint, np.eye(4)) for joint in joints]) @ inverse
        total = weights.sum(axis=1, keepdims=True)
        if not (np.isfinite(bones).all() and np.isfinite(total).all() and (total > 0.0).all()):
            fail(self._path, "a skin has bind matrices or weights that are not finite, or weights without sum")
        weights = weights / total
        return np.asarray(np.einsum("nj,njab->nab", weights, bones[places.astype(np.int64)]), dtype=np.float64)

    # ---- pictures ------------------------------------------------------------------------------------------------

    def _take_image(self, index: object) -> int:
        if not isinstance(index, int) or index not in self._images:
            data = image_bytes(self._path, self._header, index, self._buffers, self._assets)
            assert isinstance(index, int)
            size = picture_size(data) or (0, 0)
            self._pixels += size[0] * size[1]
            if self._pixels > _MOST_IMAGES * limits().picture_pixels:
                raise SceneError(too_much(f"{self._path}: its pictures", self._pixels, "pixels", "picture_pixels"))
            self._images[index] = len(self._decoded)
            self._decoded.append(decode_rgba(data, f"{self._path}: its image {index}"))
        return self._images[index]


def _upward(uvs: npt.NDArray[np.float64] | None) -> npt.NDArray[np.float64] | None:
    """Texture coordinates with v up the picture; glTF's runs down."""
    return None if uvs is None else uvs * np.array([1.0, -1.0]) + np.array([0.0, 1.0])


def decode_rgba(data: bytes, label: str) -> npt.NDArray[np.uint8]:
    """A picture as (h, w, 4) RGBA of 8 bits; grey becomes RGB, alpha is 255 where there is none.

    Raises:
        SceneError: It cannot be decoded.
    """
    # glTF: pictures lie as they are, whatever their EXIF says.
    picture = decode_picture(data, cv2.IMREAD_UNCHANGED, SceneError, label)
    clear = transparent_code(data)
    if clear is not None and picture.dtype in (np.uint8, np.uint16):
        return _with_clear_code(picture, data, clear)
    if picture.dtype in (np.float32, np.float64):
        alpha = picture[..., 3:] if picture.ndim == 3 else picture[..., :0]
        codes = encode_texture(np.clip(np.nan_to_num(picture), 0.0, 1.0), encoded=True)
        picture = codes if not alpha.size else np.concatenate([codes[..., :3], np.uint8(255 * np.clip(alpha, 0, 1))], 2)
    if picture.dtype == np.uint16:
        picture = np.round(picture / 257.0).astype(np.uint8)
    if picture.dtype != np.uint8 or picture.ndim not in (2, 3):
        raise SceneError(f"{label} has {picture.dtype} values; 8 or 16 bits are right")
    channels = 1 if picture.ndim == 2 else picture.shape[2]
    if channels == 2:  # grey and alpha
        picture = np.concatenate([np.repeat(picture[..., :1], 3, axis=2), picture[..., 1:]], axis=2)
    elif channels != 4:
        code = cv2.COLOR_GRAY2RGBA if channels == 1 else cv2.COLOR_BGR2RGBA
        return np.asarray(cv2.cvtColor(picture, code), dtype=np.uint8)
    else:
        picture = picture[..., [2, 1, 0, 3]]
    return np.ascontiguousarray(picture, dtype=np.uint8)


def transparent_code(data: bytes) -> tuple[int, ...] | None:
    """Return the grey or the colour that is transparent in a PNG, which OpenCV leaves out; None if there is none."""
    if not data.startswith(b"\x89PNG") or data[25:26] not in (b"\0", b"\2"):
        return None
    at = data.find(b"tRNS", 33)
    count = 1 if data[25] == 0 else 3
    if at < 0 or at > data.find(b"IDAT") or len(data) < at + 4 + 2 * count:
        return None
    return struct.unpack_from(f">{count}H", data, at + 4)


def _with_clear_code(picture: npt.NDArray[Any], data: bytes, clear: tuple[int, ...]) -> npt.NDArray[np.uint8]:
    """Return RGBA of 8 bits in which one code of a PNG is transparent."""
    depth = data[24]
    scale = 255 // ((1 << depth) - 1) if depth < 8 else 1  # grey of fewer bits was spread over 8
    color = (
        picture[..., None] if picture.ndim == 2 else picture[..., 2::-1] if picture.shape[2] > 2 else picture[..., :1]
    )
    same = (color[..., : len(clear)] == np.array(clear) * scale).all(2)
    codes = np.round(color / 257.0) if color.dtype == np.uint16 else color
    codes = np.broadcast_to(codes, (*codes.shape[:2], 3))
    alpha = np.where(same, 0, 255)[..., None]
    return np.ascontiguousarray(np.concatenate([codes, alpha], 2), dtype=np.uint8)
